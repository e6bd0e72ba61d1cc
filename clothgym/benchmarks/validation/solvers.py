"""Solvers by name: what Fidelity knows of integrators and membranes, and simulations made with them at a wanted time step."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import clothgym as cg
from clothgym import fidelity as fidelities
from clothgym.fidelity import INTEGRATORS, Fidelity
from clothgym.scene import Scene

EXPLICIT = ("symplectic_euler", "runge_kutta")
"""Integrators with a largest stable time step."""
IMPLICIT = ("implicit_euler", "global")
"""Integrators that stay accurate at rest with long time steps."""
_PLAIN = {"untangling": "none", "contacts_near_hits": "keep"}
_KNOWN = {field.name for field in dataclasses.fields(Fidelity)}


class NotAvailable(Exception):
    """What a case needs does not exist in this version; the message says what."""


def membranes() -> tuple[str, ...]:
    """Kinds of membrane that Fidelity knows; springs at least."""
    return tuple(getattr(fidelities, "MEMBRANES", ("springs",)))


def bendings() -> tuple[str, ...]:
    """Bending energies that Fidelity knows; flexion springs at least."""
    return tuple(name for name in getattr(fidelities, "BENDINGS", ("flexion",)) if name != "none")


def solvers(membrane: str | None = None) -> list[str]:
    """Names "integrator" (with springs) and "integrator+membrane" of all that Fidelity accepts."""
    found = []
    for kind in membranes() if membrane is None else (membrane,):
        for integrator in INTEGRATORS:
            name = integrator if kind == "springs" else f"{integrator}+{kind}"
            try:
                fidelity(name)
            except (ValueError, NotAvailable):
                continue
            found.append(name)
    return found


def split(solver: str) -> tuple[str, str]:
    """Integrator and membrane of a name."""
    integrator, _, membrane = solver.partition("+")
    return integrator, membrane or "springs"


def fidelity(solver: str, bending: str = "none", **fields: Any) -> Fidelity:
    """The settings of a solver.

    Raises:
        NotAvailable: Fidelity has no such membrane or bending energy.
        ValueError: a setting that it does not take.
    """
    integrator, membrane = split(solver)
    chosen: dict[str, Any] = {**_PLAIN, "integrator": integrator, "substeps": 0 if integrator in EXPLICIT else 8}
    if "membrane" in _KNOWN:
        chosen["membrane"] = membrane
    elif membrane != "springs":
        raise NotAvailable(f"no membrane {membrane!r} in this version")
    if "bending" in _KNOWN:
        chosen["bending"] = bending
    elif bending not in ("none", "flexion"):
        raise NotAvailable(f"no bending energy {bending!r} in this version")
    return Fidelity(**(chosen | fields))


def simulate(scene: Scene, solver: str, dt: float, every: float, bending: str = "none", **fields: Any) -> cg.Simulation:
    """A simulation whose steps last `every` [s] and whose substeps last at most `dt` [s], and no more than is stable."""
    scene = dataclasses.replace(scene, step=every)
    wanted = max(1, math.ceil(every / dt * (1.0 - 1e-9)))
    if split(solver)[0] in EXPLICIT:
        simulation = cg.Simulation(scene, fidelity(solver, bending, **fields, substeps=0))
        if simulation.pipeline.substeps >= wanted:
            return simulation
    return cg.Simulation(scene, fidelity(solver, bending, **fields, substeps=wanted))
