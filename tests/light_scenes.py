"""A small sheet, a light fidelity and an integer beyond all floats, for tests that try extremes."""

from __future__ import annotations

import clothgym as cg

HUGE = 10**400


def sheet_scene(**changes) -> cg.Scene:
    mesh = cg.grid(0.4, 0.4, 3, 3)
    return cg.Scene((cg.Cloth(mesh, pins=(0, 3)),), **({"grips": (cg.Grip(),)} | changes))


def light(integrator: str = "xpbd") -> cg.Fidelity:
    return cg.Fidelity(integrator=integrator, substeps=4 if integrator == "xpbd" else 0, sweeps=2)
