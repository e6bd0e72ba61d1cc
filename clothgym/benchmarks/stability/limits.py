"""The largest stable time step of explicit integration: measured by bisection beside what is predicted for it."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.arrays import FloatArray
from clothgym.model import ClothModel
from clothgym.pipeline import assemble
from clothgym.stages.frame import Frame

GRIDS: dict[str, tuple[tuple[float, float, float], float]] = {
    "1, 0, 0": ((1.0, 0.0, 0.0), 4.0),
    "1, 1, 0": ((1.0, 1.0, 0.0), 8.0),
    "1, 1, 1": ((1.0, 1.0, 1.0), 10.125),
    "1, .5, .5": ((1.0, 0.5, 0.5), 6.25),
    "1, .1, .05": ((1.0, 0.1, 0.05), 4.4),
}
"""Springs of an endless grid (structural, diagonal, skipping one vertex) and their lambda_max [K/m] in the flat state."""
PAPER = 0.4 * math.pi
"""[Vassilev 2001, eq. 4]: dt <= 0.4 pi sqrt(m / K), in sqrt(m / K)."""
CELLS = 12
STRETCH, DENSITY = 1e3, 0.15
SUBSTEPS = 600
LONG = (6000, 0.1)
"""Substeps of a long run, and its time step in exact limits: what creeps up shows there."""
_BISECTIONS = 11
_GROWTH = 100.0
"""Energy over that of the start above which a run has grown: bounded oscillation stays far below."""
_BURST = 100.0
"""Strain above which a run has burst."""


class Unguarded(ClothModel):
    """A model that does not refuse time steps beyond the limit, to find out where it lies."""

    def safe_time_step(self) -> float:
        return math.inf


def grid_scene(springs: tuple[float, float, float], damping: float, pinned: bool = False) -> cg.Scene:
    """A free square grid in space, without gravity, of equal masses."""
    structural, shear, flexion = springs
    mesh = cg.grid(1.0, 1.0, CELLS, CELLS)
    material = cg.Material(
        density=DENSITY, stretch=STRETCH * structural, shear=STRETCH * shear, flexion=STRETCH * flexion, damping=damping
    )
    pins = (0, CELLS) if pinned else ()
    cloth = cg.Cloth(mesh, material, pins, mesh.vertices, equal_masses=True)
    return cg.Scene((cloth,), self_collision=False, gravity=(0.0, 0.0, 0.0))


def unit(scene: cg.Scene) -> float:
    """sqrt(m / K) [s] of a grid."""
    return math.sqrt(float(ClothModel(scene).masses[0]) / STRETCH)


def lambda_max(model: ClothModel) -> float:
    """Largest eigenvalue [1/s^2] of M^-1 K of the springs at rest, dense: what the finite grid really has."""
    count = model.vertex_count
    matrix = np.zeros((count, 3, count, 3))
    rest = model.scene.cloths[0].rest
    root = np.sqrt(model.inverse_masses)
    for (i, j), k in zip(model.spring_ends, model.spring_stiffness):
        n = rest[j] - rest[i]
        n /= np.linalg.norm(n)
        block = k * np.outer(n, n)
        for a, b, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
            matrix[a, :, b, :] += sign * root[a] * root[b] * block
    return float(np.linalg.eigvalsh(matrix.reshape(3 * count, 3 * count))[-1])


def euler_limit(square: float, damping: float) -> float:
    """Largest dt with (w dt)^2 <= 4 - 2 c dt [s] for w^2 = square [1/s^2] and damping c [1/s]."""
    return (-damping + math.sqrt(damping * damping + 4.0 * square)) / square


def _start(scene: cg.Scene, amplitude: float) -> FloatArray:
    """Every vertex off its rest place by up to `amplitude` edges."""
    rest = scene.cloths[0].rest
    return rest + amplitude / CELLS * np.random.default_rng(1).uniform(-1.0, 1.0, rest.shape)


def outcome(
    scene: cg.Scene, fidelity: cg.Fidelity, amplitude: float, dt: float, substeps: int = SUBSTEPS
) -> tuple[float, float]:
    """Peak energy over that of the start, and peak strain, in so many substeps of `dt`; infinite when it diverged."""
    chunk = 20
    timed = dataclasses.replace(scene, step=chunk * dt)
    model = Unguarded(timed)
    pipeline = assemble(model, dataclasses.replace(fidelity, substeps=chunk))
    sim = cg.Simulation(timed, cg.Fidelity())  # for a state of the right shape
    state = sim.snapshot()
    state.positions[:] = _start(scene, amplitude)
    frame = Frame(model, state)
    energy = start = cg.metrics.potential_energy(model, state.positions)
    strain = cg.metrics.max_strain(model, state.positions)
    for _ in range(substeps // chunk):
        if pipeline.run(frame) is not None:
            return math.inf, math.inf
        x, v = state.positions, state.velocities
        energy = max(energy, cg.metrics.potential_energy(model, x) + cg.metrics.kinetic_energy(model, v))
        strain = max(strain, cg.metrics.max_strain(model, x))
        if strain > 10.0 * _BURST:
            return math.inf, math.inf
    return energy / start, strain


def run(grid: str, amplitude: float, modification: str, damping: float, integrator: str) -> dict[str, Any]:
    """Bisects for the largest dt whose energy does not grow, and the largest whose strain does not burst.

    Args:
        grid: of `GRIDS`.
        amplitude: displacements at the start [edges].
        damping: c sqrt(m / K).

    Returns:
        All times in sqrt(m / K): `quiet` (energy stays below `_GROWTH` times the start's), `bounded` (strain stays below
        `_BURST`); `long_strain`: peak strain of a `LONG` run far below the limit, None = diverged; and the predictions
        `gershgorin`, `exact` (dense eigenvalues of this very grid), `endless` (table) and `paper`.
    """
    springs, table = GRIDS[grid]
    plain = grid_scene(springs, 0.0)
    second = unit(plain)
    scene = grid_scene(springs, damping / second)
    fidelity = cg.Fidelity(integrator=integrator, velocity_modification=modification)
    model = ClothModel(scene)
    c = model.damping
    exact = euler_limit(lambda_max(model), c)

    def largest(allowed: Any) -> float:
        low, high = 0.1 * exact, 4.0 * exact
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if allowed(outcome(scene, fidelity, amplitude, middle)) else (low, middle)
        return low / second

    long = outcome(scene, fidelity, amplitude, LONG[1] * exact, LONG[0])[1]
    return {
        "quiet": largest(lambda peaks: peaks[0] <= _GROWTH),
        "bounded": largest(lambda peaks: peaks[1] <= _BURST),
        "long_strain": long if math.isfinite(long) else None,
        "gershgorin": model.safe_time_step() / second,
        "exact": exact / second,
        "endless": euler_limit(table / second**2, c) / second,
        "paper": PAPER,
    }


__all__ = ["GRIDS", "PAPER", "Unguarded", "euler_limit", "grid_scene", "lambda_max", "outcome", "run", "unit"]
