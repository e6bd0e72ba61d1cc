"""One run: what it costs, how far it is from the converged run, and whether it blew up."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import time
import tracemalloc
from dataclasses import dataclass
from typing import Any

import numpy as np

import clothgym as cg
from clothgym import metrics
from clothgym.arrays import FloatArray, IntArray
from clothgym.benchmarks.tradeoff.subjects import SUBJECTS, scene_of
from clothgym.model import STRUCTURAL, ClothModel

BURST_STRETCH = 2.0
"""A spring between neighbours three times its length: the run has blown up."""
BURST_ENERGY = 1.0
"""Kinetic energy and height above those of the start, in weight x size + energy at the start, likewise."""
_LOOK_EVERY, _LOOK_EVERY_TANGLED = 10, 2
"""Frames from one look at intersections and penetration to the next, for they cost more than a step; and where cloth starts
tangled, since it is soon over."""
_WARM_STEPS = 2


_CUTS = 4
"""Each face is looked at in the middle of the squared number of equal triangles, so that no choice of `body_faces` is judged
by the very points that it keeps outside."""


@dataclass
class Trajectory:
    """What is seen of a run after each of T frames."""

    positions: FloatArray  # (T, V, 3) [m]
    stretch: FloatArray  # (T,) of the longest structural spring
    stretch_p99: FloatArray  # (T,)
    heights: FloatArray  # (T,) mean height [m]
    energies: FloatArray  # (T,) kinetic + potential [weight x size]
    penetration: float  # deepest seen [m]
    contours: FloatArray  # contour length [m] of some frames, the start first
    hits: int  # at the end
    flags: list[str]
    ended: tuple[float, str] | None  # when and why the run blew up
    milliseconds: float  # of processor time
    work: dict[str, int]


class Springs:
    """Pairs of neighbours and their rest lengths: the same for every membrane."""

    def __init__(self, scene: cg.Scene) -> None:
        model = ClothModel(scene)
        chosen = model.spring_kinds == STRUCTURAL
        self.ends: IntArray = model.spring_ends[chosen]
        self.rest: FloatArray = model.spring_rest[chosen]

    def stretch(self, x: FloatArray) -> FloatArray:
        """(S,) length over rest length - 1."""
        return np.linalg.norm(x[self.ends[:, 1]] - x[self.ends[:, 0]], axis=1) / self.rest - 1.0


def deepest_point(sim: cg.Simulation) -> float:
    """Depth [m] of the deepest of many points of the cloth below the bodies' true surface; 0 without bodies."""
    if not sim.scene.bodies:
        return 0.0
    x, corners = sim.positions, sim.positions[sim.model.faces]
    weights = np.array(
        [
            ((3 * i + k) / (3 * _CUTS), (3 * j + k) / (3 * _CUTS), 1.0 - (3 * (i + j) + 2 * k) / (3 * _CUTS))
            for k in (1, 2)
            for i in range(_CUTS)
            for j in range(_CUTS + 1 - k - i)
        ]
    )
    points = np.concatenate([x, np.einsum("pc,fcx->fpx", weights, corners).reshape(-1, 3)])
    return float(max(0.0, -sim.body_mesh.signed_distance(points).min()))


def follow(sim: cg.Simulation, seconds: float) -> Trajectory:
    """Runs a simulation from its start, until its time is over or it blows up. Only steps count as cost."""
    scene, model = sim.scene, sim.model
    springs = Springs(scene)
    with contextlib.suppress(cg.SimulationError):
        sim.step(_WARM_STEPS)  # loads kernels
    sim.reset()
    free = model.masses[model.inverse_masses > 0].sum()
    size = float(np.ptp(sim.positions, axis=0).max())
    weight = float(free * np.linalg.norm(scene.gravity)) * size
    start = metrics.kinetic_energy(model, sim.velocities) + metrics.potential_energy(model, sim.positions)
    stored = start - metrics.gravity_energy(model, sim.positions)
    looks = scene.self_collision or bool(scene.bodies)
    seen: list[tuple[FloatArray, float, float, float, float]] = []
    contours = [sim.last_intersections.length if looks else 0.0]
    flags: set[str] = set()
    deepest, spent, ended = 0.0, 0.0, None
    every = _LOOK_EVERY_TANGLED if contours[0] > 0.0 else _LOOK_EVERY
    frames = round(seconds / scene.step)
    for frame in range(frames):
        began = time.process_time()
        try:
            sim.step()
        except cg.SimulationError as error:
            ended = (sim.time, " ".join(str(error).split()))
            break
        spent += time.process_time() - began
        x, v = sim.positions, sim.velocities
        stretch = springs.stretch(x)
        energy = metrics.kinetic_energy(model, v) + metrics.potential_energy(model, x)
        longest, p99 = float(stretch.max()), float(np.quantile(stretch, 0.99))
        seen.append((x.copy(), longest, p99, float(x[:, 1].mean()), (energy - start) / weight))
        if looks and ((frame + 1) % every == 0 or frame == frames - 1):
            deepest = max(deepest, deepest_point(sim))
            contours.append(sim.last_intersections.length)
            flags.update(flag.split()[0] for flag in sim.flags())
        rise = metrics.kinetic_energy(model, v) + metrics.gravity_energy(model, x) - (start - stored)
        if longest > BURST_STRETCH:
            ended = (sim.time, f"a spring is {1.0 + longest:.3g} times as long as at rest")
        elif rise > BURST_ENERGY * (weight + stored) and scene.calm:
            ended = (sim.time, f"energy rose by {rise / weight:.3g} weight x size")
        if ended:
            break
    flags.update(flag.split()[0] for flag in sim.flags())
    return Trajectory(
        positions=np.array([row[0] for row in seen]).reshape(-1, model.vertex_count, 3),
        stretch=np.array([row[1] for row in seen]),
        stretch_p99=np.array([row[2] for row in seen]),
        heights=np.array([row[3] for row in seen]),
        energies=np.array([row[4] for row in seen]),
        penetration=deepest,
        contours=np.array(contours),
        hits=sim.last_intersections.hit_count if looks else 0,
        flags=sorted(flags),
        ended=ended,
        milliseconds=1e3 * spent,
        work=dict(sim.metrics()["work"]),
    )


def fidelity_of(fields: dict[str, Any], scene: cg.Scene) -> cg.Fidelity:
    """A preset ("base", by default balanced) with other fields changed; with "finer", so many times the substeps that it
    would choose."""
    changed = {name: value for name, value in fields.items() if name not in ("base", "finer")}
    fidelity = dataclasses.replace(cg.Fidelity.preset(fields.get("base", "balanced")), **changed)
    if "finer" not in fields:
        return fidelity
    return dataclasses.replace(fidelity, substeps=fields["finer"] * cg.Simulation(scene, fidelity).pipeline.substeps)


@functools.lru_cache(maxsize=8)
def _converged(subject: str, membrane: str, bending: str, check: bool) -> Trajectory:
    it = SUBJECTS[subject]
    fields = it.check if check else it.reference
    assert fields is not None
    scene = scene_of(subject)
    fidelity = fidelity_of({**fields, "membrane": membrane, "bending": bending}, scene)
    return follow(cg.Simulation(scene, fidelity), it.seconds)


def reference(subject: str, membrane: str, bending: str, checked: bool) -> dict[str, Any]:
    """The row of a converged run: its numbers, and if `checked`, its distance to another run at high effort."""
    it, run = SUBJECTS[subject], _converged(subject, membrane, bending, False)
    return {
        **_summary(run, it.seconds),
        "heights": run.heights[:: max(1, len(run.heights) // 12)],
        "check": distances(_converged(subject, membrane, bending, True), run, _frames(subject)) if checked else None,
    }


def _frames(subject: str) -> int:
    """Frames until the horizon."""
    return round(SUBJECTS[subject].horizon / scene_of(subject).step)


def memory(scene: cg.Scene, fidelity: cg.Fidelity) -> float:
    """Most memory [MB] that Python and numpy held for assembling and two steps, beyond that of the scene."""
    tracemalloc.start()
    try:
        sim = cg.Simulation(scene, fidelity)
        with contextlib.suppress(cg.SimulationError):
            sim.step(2)
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


def run(subject: str, fields: dict[str, Any]) -> dict[str, Any]:
    """The row of one setting; see the columns of `show.tables`. A setting that is refused says so in `refused`."""
    it, scene = SUBJECTS[subject], scene_of(subject)
    try:
        fidelity = fidelity_of(fields, scene)
        sim = cg.Simulation(scene, fidelity)
    except ValueError as error:
        return {"refused": " ".join(str(error).split())}
    found = follow(sim, it.seconds)
    step: Any = sim.pipeline.stages[-1]
    result = {
        **_summary(found, it.seconds),
        "refused": "",
        "vertices": sim.model.vertex_count,
        "substeps": sim.pipeline.substeps,
        "sweeps": step.step.sweeps if step.step.integrator.in_sweeps else None,
        "memory_mb": memory(scene, fidelity),
    }
    if it.reference is not None:
        result |= distances(found, _converged(subject, fidelity.membrane, fidelity.bending, False), _frames(subject))
    return result


def _summary(found: Trajectory, seconds: float) -> dict[str, Any]:
    frames = max(1, len(found.heights))
    start = found.contours[0]
    return {
        "ms_per_second": found.milliseconds * (1.0 if found.ended is None else math.nan) / seconds,
        "stretch": _most(found.stretch),
        "stretch_p99": _most(found.stretch_p99),
        "penetration": found.penetration,
        "contour_share": float(found.contours.mean() / start) if start > 0.0 else None,
        "contour_end": float(found.contours[-1]),
        "hits": found.hits,
        "energy_gain": _most(found.energies),
        "flags": found.flags,
        "blew_up_at": found.ended[0] if found.ended else None,
        "why": found.ended[1] if found.ended else "",
        "work_per_frame": {name: count / frames for name, count in found.work.items() if count},
    }


def _most(values: FloatArray) -> float | None:
    return float(values.max()) if len(values) else None


def distances(found: Trajectory, converged: Trajectory, horizon: int) -> dict[str, Any]:
    """How far a run is from the converged one, stretch over all frames, the rest over the first `horizon`; None for what
    cannot be said of a run that blew up."""
    frames = len(converged.heights)
    if found.ended is not None or len(found.heights) < frames:
        names = ("stretch_error", "stretch_p99_error", "rms_distance", "max_distance", "height_error", "energy_error")
        return dict.fromkeys(names)
    early = slice(horizon)
    apart = np.linalg.norm(found.positions[early] - converged.positions[early], axis=2)
    return {
        "stretch_error": abs(float(found.stretch.max() - converged.stretch.max())),
        "stretch_p99_error": abs(float(found.stretch_p99.max() - converged.stretch_p99.max())),
        "rms_distance": float(np.sqrt((apart**2).mean())),
        "max_distance": float(apart.max()),
        "height_error": float(np.abs(found.heights - converged.heights)[early].max()),
        "energy_error": float(np.abs(found.energies - converged.energies)[early].max()),
    }
