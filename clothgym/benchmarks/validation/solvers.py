"""Solvers by name: what Fidelity knows of integrators and membranes, and simulations made with them at a wanted time step."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import clothgym as cg
from clothgym.fidelity import INTEGRATORS, MEMBRANES, Fidelity
from clothgym.scene import Scene

EXPLICIT = ("symplectic_euler", "runge_kutta")
"""Integrators with a largest stable time step."""
IMPLICIT = ("implicit_euler", "global")
"""Integrators that stay accurate at rest with long time steps."""
VARIANTS: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = {
    "": ((), {}),
    "2": (("implicit_euler",), {"time_order": 2}),
    "float32": (("xpbd",), {"precision": "float32"}),
}
"""Variants of integrators by the name after the colon: who has them, and what they set."""
_PLAIN = {"untangling": "none", "contacts_near_hits": "keep"}


class NotAvailable(Exception):
    """A solver that does not do what a case needs; the message says what."""


def solvers(membrane: str | None = None, reduced: bool = False) -> list[str]:
    """Names "integrator", "integrator:variant", with "+membrane" for all but springs, of all that Fidelity accepts;
    `reduced`: those with less precision too, which sheets of some size have."""
    found = []
    for kind in MEMBRANES if membrane is None else (membrane,):
        for integrator in INTEGRATORS:
            for variant in VARIANTS:
                name = integrator + (f":{variant}" if variant else "") + ("" if kind == "springs" else f"+{kind}")
                if variant and integrator not in VARIANTS[variant][0]:
                    continue
                if variant == "float32" and (not reduced or kind != "springs"):
                    continue
                try:
                    fidelity(name)
                except NotAvailable:
                    continue
                found.append(name)
    return found


def split(solver: str) -> tuple[str, str, str]:
    """Integrator, variant and membrane of a name."""
    method, _, membrane = solver.partition("+")
    integrator, _, variant = method.partition(":")
    return integrator, variant, membrane or "springs"


def fidelity(solver: str, bending: str = "none", **fields: Any) -> Fidelity:
    """The settings of a solver; what it solves, it solves far below the errors that are looked for.

    Raises:
        NotAvailable: Fidelity does not take them together.
    """
    integrator, variant, membrane = split(solver)
    chosen: dict[str, Any] = {**_PLAIN, "integrator": integrator, "substeps": 0 if integrator in EXPLICIT else 8}
    if integrator in IMPLICIT:
        # the few steps that "global" takes by default leave stiff strips restless
        chosen |= {"time_order": 1, "tolerance": 1e-7, "solver_steps": 50}
    chosen |= {"membrane": membrane, "bending": bending, **VARIANTS[variant][1], **fields}
    try:
        return Fidelity(**chosen)
    except ValueError as reason:
        raise NotAvailable(str(reason)) from None


def rounding(solver: str) -> float:
    """Relative size that counts as rounding: double precision accumulates over thousands of steps."""
    return 1e-3 if split(solver)[1] == "float32" else 1e-9


def simulate(scene: Scene, solver: str, dt: float, every: float, bending: str = "none", **fields: Any) -> cg.Simulation:
    """A simulation whose steps last `every` [s] and whose substeps last at most `dt` [s], and no more than is stable."""
    scene = dataclasses.replace(scene, step=every)
    wanted = max(1, math.ceil(every / dt * (1.0 - 1e-9)))
    if split(solver)[0] in EXPLICIT:
        simulation = cg.Simulation(scene, fidelity(solver, bending, **fields, substeps=0))
        if simulation.pipeline.substeps >= wanted:
            return simulation
    return cg.Simulation(scene, fidelity(solver, bending, **fields, substeps=wanted))
