"""Super-elasticity: the three ways against it that [Vassilev 2001, section 4] compares, side by side, and XPBD.

Cloth so soft that its springs may be integrated with the steps of 2001 hangs far too long. Stiffer springs (4.1) need
smaller steps; position modification [Provot 1995] (4.2) "proved to work for locally distributed deformations but no tests
were conducted for global elongation"; velocity modification (4.3) "works fine not only for local but also for global
deformations".
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np

import clothgym as cg
from clothgym import metrics
from clothgym.benchmarks.stability.limits import Unguarded
from clothgym.benchmarks.tradeoff.measure import Springs
from clothgym.pipeline import assemble
from clothgym.stages.frame import Frame

CELLS = 20
SOFT = 5.0
"""[N/m] of structural springs: the whole weight, hung by a side, stretches the topmost by 0.3 of their length."""
LIMIT = 0.1
"""Strain that modifications allow, as the papers have it (Provot: 10 %, Vassilev: 1 to 15 %)."""
PLACES = {"corners": (0, CELLS), "side": tuple(range(CELLS + 1))}
"""Held vertices: two corners, where stretch is local, or a whole side, where all of the cloth above the middle has it."""
SECONDS = 5.0
_FRAME = 1.0 / 60.0
_BISECTIONS, _SUBSTEPS = 6, 4

ARMS: dict[str, dict[str, Any]] = {
    "soft springs": {},
    "(a) springs x 4": {"stiffer": 4.0},
    "(a) springs x 16": {"stiffer": 16.0},
    "(a) springs x 64": {"stiffer": 64.0},
    "(b) position, 1 sweep": {"position_modification": 1},
    "(b) position, 4 sweeps": {"position_modification": 4},
    "(b) position, 32 sweeps": {"position_modification": 32},
    "(c) velocity, literal": {"velocity_modification": "literal"},
    "(c) velocity, relative": {"velocity_modification": "relative"},
    "xpbd, soft springs": {"integrator": "xpbd"},
    "xpbd, springs x 64": {"integrator": "xpbd", "stiffer": 64.0},
}
"""What each arm changes of soft springs with symplectic Euler."""


def scene(place: str, stiffer: float = 1.0) -> cg.Scene:
    """A sheet of 1 m that hangs at rest length in its plane, held at a place; masses are equal, nothing else acts."""
    mesh = cg.grid(1.0, 1.0, CELLS, CELLS)
    upright = np.ascontiguousarray(mesh.vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0])
    material = cg.Material(density=0.15, stretch=SOFT * stiffer, shear=0.5 * SOFT * stiffer, flexion=0.0, damping=2.0)
    cloth = cg.Cloth(
        cg.Mesh(upright, mesh.faces, mesh.quads), material, PLACES[place], mesh.vertices, equal_masses=True
    )
    return cg.Scene((cloth,), self_collision=False, step=_FRAME, name="strain")


def fidelity(arm: str) -> cg.Fidelity:
    """Of an arm, at the time step that it chooses itself."""
    fields = {key: value for key, value in ARMS[arm].items() if key != "stiffer"}
    return cg.Fidelity(**{"integrator": "symplectic_euler", "stretch_limit": LIMIT, **fields})


def run(arm: str, place: str) -> dict[str, Any]:
    """An arm at its own time step, and at a quarter of it; with explicit integration also the largest step that holds."""
    subject = scene(place, ARMS[arm].get("stiffer", 1.0))
    chosen = fidelity(arm)
    sim = cg.Simulation(subject, chosen)
    own, limit = sim.pipeline.substeps, sim.model.safe_time_step()
    result: dict[str, Any] = {
        "substeps": own,
        "own": hang(subject, chosen, own),
        "finer": hang(subject, chosen, 4 * own),
        "largest_step": None,
        "predicted_step": None,
    }
    if chosen.integrator == "symplectic_euler":
        result["predicted_step"] = limit
        result["largest_step"] = largest_step(subject, chosen, limit, result["finer"])
    return result


def hang(subject: cg.Scene, chosen: cg.Fidelity, substeps: int, seconds: float = SECONDS) -> dict[str, Any]:
    """Stretch, rest and cost of a run with so many substeps a frame, allowed or not.

    Returns:
        peak and end: largest stretch of a structural spring, over all frames and of the last; over: share of springs that
        are longer than allowed at the end (by more than a tenth of what is allowed); p99 at the end; drop: mean height
        below the start at the end [m]; speed: rms at the end [m/s]; ms_per_second; blew_up_at [s] or None.
    """
    model = Unguarded(subject, chosen)
    pipeline = assemble(model, dataclasses.replace(chosen, substeps=substeps, sweeps=1))
    state = cg.Simulation(subject).snapshot()
    frame, springs = Frame(model, state), Springs(subject)
    start = state.positions[:, 1].mean()
    peak, spent, ended = 0.0, 0.0, None
    stretch = springs.stretch(state.positions)
    for number in range(round(seconds / subject.step)):
        began = time.process_time()
        diverged = pipeline.run(frame)
        spent += time.process_time() - began
        stretch = springs.stretch(state.positions)
        peak = max(peak, float(stretch.max()))
        if diverged is not None or not peak < 20.0:
            ended = number * subject.step
            break
    if ended is not None:
        return {"blew_up_at": ended, "peak": None, "end": None}
    masses = model.masses
    return {
        "blew_up_at": None,
        "peak": peak,
        "end": float(stretch.max()),
        "p99": float(np.quantile(stretch, 0.99)),
        "over": float((stretch > 1.1 * LIMIT).mean()),
        "drop": float(start - state.positions[:, 1].mean()),
        "speed": float(np.sqrt(2.0 * metrics.kinetic_energy(model, state.velocities) / masses.sum())),
        "ms_per_second": 1e3 * spent / seconds,
    }


def largest_step(subject: cg.Scene, chosen: cg.Fidelity, predicted: float, fine: dict[str, Any]) -> float | None:
    """Largest substep [s] in 2 s of which the peak stretch stays within 0.1 + 1.5 times that of a fine run; None where the
    fine run itself blew up."""
    if fine["peak"] is None:
        return None
    low, high = 0.25 * predicted, 4.0 * predicted
    for _ in range(_BISECTIONS):
        middle = (low * high) ** 0.5
        timed = dataclasses.replace(subject, step=_SUBSTEPS * middle)
        found = hang(timed, chosen, _SUBSTEPS, 2.0)
        holds = found["peak"] is not None and found["peak"] <= 0.1 + 1.5 * fine["peak"]
        low, high = (middle, high) if holds else (low, middle)
    return low
