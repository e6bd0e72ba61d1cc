"""Watching a run: peaks, flags that the library raised, and how it ended."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np

import clothgym as cg
from clothgym import fidelity as fidelities
from clothgym.benchmarks.report import json_ready

OUTCOMES = ("stable", "degraded", "stopped", "refused")
STRETCH, COMPRESSION = 0.5, 0.5
"""Peak strain, and loss of length, beyond which a run counts as degraded."""
ENERGY, ENERGY_UNTANGLED = 0.1, 1.0
"""Kinetic energy + height beyond the start's energy, in (weight x size + energy at the start), likewise; the second where
untangling has moved vertices."""
FROZEN = 0.05
"""Least share of the fall that gravity and damping alone allow (at most a fifth of the size)."""


def variants(everything: bool = True) -> dict[str, dict[str, Any]]:
    """Name -> fields of `Fidelity`: every integrator there is with every velocity modification that it takes, and every
    choice of how cloth resists strain beside the usual one; those with the first integrator only, or with everything;
    with everything position modification too."""
    usual = fidelities.Fidelity()
    found: dict[str, dict[str, Any]] = {}
    for integrator in fidelities.INTEGRATORS:
        for modification in fidelities.VELOCITY_MODIFICATIONS:
            fields: dict[str, Any] = {"integrator": integrator}
            if modification != usual.velocity_modification:
                fields["velocity_modification"] = modification
            if _possible(fields):
                found[" ".join(fields.values())] = fields
        sweeps = {"integrator": integrator, "position_modification": 4}
        if everything and _possible(sweeps):
            found[f"{integrator} position"] = sweeps
        for field, choices in _MODELS.items():
            for choice in getattr(fidelities, choices, ()) if everything or integrator == usual.integrator else ():
                fields = {"integrator": integrator, field: choice}
                if choice != getattr(usual, field) and _possible(fields):
                    found[" ".join(fields.values())] = fields
    return found


_MODELS = {"membrane": "MEMBRANES", "bending": "BENDINGS", "precision": "PRECISIONS"}
"""Fields of Fidelity with choices that change forces, and the tuples of their choices, where a version has them."""


def _possible(fields: dict[str, Any]) -> bool:
    try:
        fidelities.Fidelity(**fields)
    except ValueError:
        return False
    return True


def not_finite(value: Any, name: str = "") -> list[str]:
    """Names of all numbers in a value (arrays, mappings, sequences) that are not finite."""
    if isinstance(value, dict):
        return [bad for key, part in value.items() for bad in not_finite(part, f"{name}.{key}" if name else str(key))]
    if isinstance(value, list | tuple):
        return [bad for number, part in enumerate(value) for bad in not_finite(part, f"{name}[{number}]")]
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return [] if np.isfinite(value).all() else [name]
    if isinstance(value, float | np.floating):
        return [] if math.isfinite(value) else [name]
    return []


def shown_arrays(simulation: cg.Simulation) -> dict[str, Any]:
    """Every array that a simulation shows."""
    return {
        name: getattr(simulation, name)
        for name in ("positions", "velocities", "grip_positions", "grip_forces", "body_forces")
    }


@dataclasses.dataclass
class Peaks:
    """Largest values of a run. Strains are shares of the rest length, energy is in what `ENERGY` is a share of."""

    stretch: float = 0.0
    compression: float = 0.0
    speed: float = 0.0
    energy: float | None = None
    total_energy: float = -math.inf


class Watch:
    """Measures a simulation from its start on, by formulas of its own."""

    def __init__(self, simulation: cg.Simulation, worked: bool) -> None:
        self.simulation, self.worked = simulation, worked or not simulation.scene.calm
        self.peaks = Peaks()
        model, scene = simulation.model, simulation.scene
        self.weights = np.where(model.inverse_masses > 0, model.masses, 0.0)
        self.gravity = np.asarray(scene.gravity)
        self.start = simulation.positions.copy()
        size = float(np.ptp(self.start, axis=0).max())
        motion, height = self._motion(), self._height()
        elastic = cg.metrics.potential_energy(model, self.start) - height
        self.at_start = motion + elastic + height
        self.unit = float(self.weights.sum() * np.linalg.norm(self.gravity)) * size + motion + elastic
        self.size = size
        self.look()

    def _motion(self) -> float:
        v = self.simulation.velocities
        return float(0.5 * np.einsum("i,ij,ij->", self.weights, v, v))

    def _height(self) -> float:
        return -float(np.einsum("i,ij,j->", self.weights, self.simulation.positions, self.gravity))

    def look(self) -> None:
        """Takes the current state into the peaks."""
        sim, peaks = self.simulation, self.peaks
        x, ends, rest = sim.positions, sim.model.surface.edges, sim.model.edge_rest
        ratio = np.sqrt(((x[ends[:, 0]] - x[ends[:, 1]]) ** 2).sum(axis=1))[rest > 0] / rest[rest > 0]
        peaks.stretch = max(peaks.stretch, float(ratio.max()) - 1.0)
        peaks.compression = max(peaks.compression, 1.0 - float(ratio.min()))
        peaks.speed = max(peaks.speed, float(np.sqrt((sim.velocities**2).sum(axis=1)).max()))
        total = self._motion() + cg.metrics.potential_energy(sim.model, x)
        peaks.total_energy = max(peaks.total_energy, total)
        if not self.worked and self.unit > 0.0:
            excess = (self._motion() + self._height() - self.at_start) / self.unit
            peaks.energy = max(-math.inf if peaks.energy is None else peaks.energy, excess)

    def fell(self) -> float | None:
        """How far the free vertices moved along gravity, as a share of what gravity and damping alone allow."""
        sim = self.simulation
        size = float(np.linalg.norm(self.gravity))
        if size == 0.0 or self.weights.sum() == 0.0 or sim.time == 0.0:
            return None
        c, t = sim.model.damping, sim.time
        free = size * (0.5 * t * t if c * t < 1e-3 else (t - (1.0 - math.exp(-c * t)) / c) / c)
        moved = np.average(sim.positions - self.start, axis=0, weights=self.weights) @ self.gravity / size
        return float(moved) / min(free, 0.2 * self.size)


def run(
    make: Callable[[], cg.Simulation],
    steps: int,
    act: Callable[[cg.Simulation], None] | None = None,
    worked: bool = False,
    falls: bool = False,
    budget: int = 20_000,
) -> dict[str, Any]:
    """Runs a simulation to its end, good or bad.

    Args:
        make: builds it; may refuse.
        act: called once before the first step.
        worked: forces from outside act, so energy may grow.
        falls: gravity must move the cloth.
        budget: substeps; the run is shorter where steps take many, and has one step at least.

    Returns:
        outcome (of `OUTCOMES`), error, kinds of flags that the library raised, what is wrong by this module's criteria
        and whether the library said so (`silent`: not said), every number that was not finite, peaks, steps.
    """
    result: dict[str, Any] = {"error": "", "flags": [], "wrong": [], "silent": [], "not_finite": [], "steps": 0}
    try:
        simulation = make()
        if act is not None:
            act(simulation)
    except ValueError as error:
        return result | {"outcome": "refused", "error": _line(error)}
    watch = Watch(simulation, worked)
    flags: set[str] = set()
    bad: set[str] = set()
    substeps = simulation.pipeline.substeps
    for number in range(max(1, min(steps, budget // substeps))):
        before = simulation.state_hash()
        try:
            simulation.step()
        except cg.SimulationError as error:
            result["error"] = _line(error)
            if simulation.state_hash() != before:
                bad.add("the last finite state was not kept")
            break
        result["steps"] += 1
        bad.update(not_finite(shown_arrays(simulation)))
        if number % 5 == 0:
            bad.update(not_finite(simulation.metrics()))
        flags.update(flag.split()[0] for flag in simulation.flags())
        watch.look()
    bad.update(not_finite(shown_arrays(simulation)) + not_finite(simulation.metrics()))
    fell = watch.fell() if falls and not result["error"] else None
    peaks = watch.peaks
    allowed = ENERGY_UNTANGLED if simulation.metrics()["untangling_passes"] else ENERGY
    wrong = {
        "stretch": peaks.stretch > STRETCH,
        "compression": peaks.compression > COMPRESSION,
        "energy": peaks.energy is not None and peaks.energy > allowed,
        "frozen": fell is not None and fell < FROZEN,
    }
    found = [kind for kind, here in wrong.items() if here]
    # what stands still, or rises, has no flag of that name: these are why it does
    said = flags | ({"frozen"} if flags & {"zones", "rounding", "unbalanced", "energy"} else set())
    result.update(
        outcome="stopped" if result["error"] else "degraded" if found or flags else "stable",
        flags=sorted(flags), wrong=found, silent=[kind for kind in found if kind not in said], not_finite=sorted(bad),
        peaks=dataclasses.asdict(peaks), fell=fell, substeps=substeps,
    )  # fmt: skip
    if result["outcome"] == "stopped":
        result["silent"] = []  # an error says more than a flag
    return json_ready(result)


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
