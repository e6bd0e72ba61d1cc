"""Time integration: symplectic Euler [Vassilev 2001, eq. 3] and XPBD with small substeps [Macklin 2019].

Both predict positions p from (x, v); constraints act on p; the velocity is then (p - x) / dt. Without contacts all
substeps of a step run inside one kernel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numpy.typing import NDArray

from clothgym._jit import bare, device, kernel
from clothgym.kernels.elastic import add_elastic_forces, project_elastic
from clothgym.kernels.position_modification import modify_positions
from clothgym.kernels.springs import ClothArrays
from clothgym.kernels.velocity_modification import modify_velocities

__all__ = [
    "ClothArrays",
    "Grips",
    "Ground",
    "Motion",
    "euler_predict",
    "euler_substeps",
    "finish",
    "hold",
    "largest_speed",
    "xpbd_predict",
    "xpbd_substeps",
]


class Motion(NamedTuple):
    """Constants of one substep."""

    dt: float  # [s]
    sweeps: int
    gravity: NDArray  # (3,) [m/s^2]
    damping: float  # [1/s]
    external: NDArray  # (V, 3) or (0, 3): acceleration from wind [m/s^2]
    stretch_limit: float  # strain above which velocities or positions are modified, < 0 = off
    relative: bool
    corrections: int = 0  # sweeps of position modification; 0 = velocities are modified


class Ground(NamedTuple):
    """A horizontal plane."""

    height: float  # [m]; -inf = none
    friction: float


class Grips(NamedTuple):
    """Soft anchors: vertices held by moving points."""

    vertices: NDArray  # (A,) int32
    targets: NDArray  # (A, 3) [m] at the start of the step
    velocities: NDArray  # (A, 3) [m/s]
    stiffness: NDArray  # (A,) [N/m]
    force_limit: NDArray  # (A,) [N]
    multipliers: NDArray  # (A, 3) [N s^2] of the running substep
    forces: NDArray  # (A, 3) [N] sum over the substeps of a step


@bare
def hold_grips(p, inverse_masses, grips, dt, time):
    """XPBD projection of soft anchors with a limited force (the cloth slips through above it)."""
    for a in range(grips.vertices.shape[0]):
        v = grips.vertices[a]
        w = inverse_masses[v]
        if w == 0.0:
            continue
        alpha = 1.0 / (grips.stiffness[a] * dt * dt)
        size = 0.0
        for c in range(3):
            target = grips.targets[a, c] + time * grips.velocities[a, c]
            change = (target - p[v, c] - alpha * grips.multipliers[a, c]) / (w + alpha)
            p[v, c] -= w * grips.multipliers[a, c]
            grips.multipliers[a, c] += change
            size += grips.multipliers[a, c] ** 2
        size = math.sqrt(size)
        limit = grips.force_limit[a] * dt * dt
        scale = limit / size if size > limit else 1.0
        for c in range(3):
            grips.multipliers[a, c] *= scale
            p[v, c] += w * grips.multipliers[a, c]


@bare
def keep_above_ground(x, p, inverse_masses, radii, ground):
    """Lifts vertices to ground.height + radius and applies Coulomb friction against the position they came from."""
    for i in range(p.shape[0]):
        depth = ground.height + radii[i] - p[i, 1]
        if depth <= 0.0 or inverse_masses[i] == 0.0:
            continue
        p[i, 1] += depth
        dx = p[i, 0] - x[i, 0]
        dz = p[i, 2] - x[i, 2]
        slide = math.sqrt(dx * dx + dz * dz)
        if slide > 0.0:
            keep = max(0.0, 1.0 - ground.friction * depth / slide)
            p[i, 0] = x[i, 0] + keep * dx
            p[i, 2] = x[i, 2] + keep * dz


@bare
def accelerate(x, v, p, cloth, motion):
    """XPBD prediction: external accelerations only."""
    factor = 1.0 / (1.0 + motion.damping * motion.dt)
    wind = motion.external.shape[0] > 0
    for i in range(x.shape[0]):
        if cloth.inverse_masses[i] == 0.0:
            for c in range(3):
                p[i, c] = x[i, c]
            continue
        for c in range(3):
            a = motion.gravity[c]
            if wind:
                a += motion.external[i, c]
            # only the old velocity is damped: static forces must not depend on damping
            v[i, c] = v[i, c] * factor + motion.dt * a
            p[i, c] = x[i, c] + motion.dt * v[i, c]


@device
def euler_velocities(x, v, f, cloth, motion):
    """v += dt (f / m + g - c v) with spring forces [Vassilev 2001, eq. 1-3], then velocity modification."""
    f[:] = 0.0
    add_elastic_forces(x, cloth, f)
    wind = motion.external.shape[0] > 0
    for i in range(x.shape[0]):
        w = cloth.inverse_masses[i]
        if w == 0.0:
            continue
        for c in range(3):
            a = w * f[i, c] + motion.gravity[c] - motion.damping * v[i, c]
            if wind:
                a += motion.external[i, c]
            v[i, c] += motion.dt * a
    if motion.stretch_limit >= 0.0 and motion.corrections == 0:
        modify_velocities(x, v, cloth, motion.stretch_limit, motion.relative)
    for i in range(x.shape[0]):
        if cloth.inverse_masses[i] == 0.0:
            v[i, 0] = 0.0
            v[i, 1] = 0.0
            v[i, 2] = 0.0


@device
def euler_positions(x, v, p, f, cloth, motion):
    """p at the end of a substep of symplectic Euler [Vassilev 2001, eq. 3], without grips, ground and contact."""
    euler_velocities(x, v, f, cloth, motion)
    for i in range(x.shape[0]):
        for c in range(3):
            p[i, c] = x[i, c] + motion.dt * v[i, c]
    if motion.corrections > 0:
        modify_positions(p, cloth, motion.stretch_limit, motion.corrections)


@bare
def finish_substep(x, v, p, dt):
    inverse = 1.0 / dt  # in every loop that ends a substep: a vector of quotients takes as long as a sweep over it
    for i in range(x.shape[0]):
        for c in range(3):
            v[i, c] = (p[i, c] - x[i, c]) * inverse
            x[i, c] = p[i, c]


@bare
def start_grips(grips):
    grips.multipliers[:] = 0.0


@bare
def add_grip_forces(grips, dt):
    for a in range(grips.vertices.shape[0]):
        for c in range(3):
            grips.forces[a, c] += grips.multipliers[a, c] / (dt * dt)


@device
def xpbd_substep(x, v, p, cloth, radii, motion, ground, grips, multipliers, n):
    """Predicts p and sweeps over energies, grips and ground in substep n of a step; x stays, v is accelerated."""
    accelerate(x, v, p, cloth, motion)
    multipliers[:] = 0.0
    start_grips(grips)
    for _ in range(motion.sweeps):
        project_elastic(p, cloth, motion.dt, multipliers)
        hold_grips(p, cloth.inverse_masses, grips, motion.dt, (n + 1) * motion.dt)
        keep_above_ground(x, p, cloth.inverse_masses, radii, ground)


@kernel
def xpbd_predict(x, v, p, cloth, motion):
    """p = x + dt v after gravity, wind and damping changed v."""
    accelerate(x, v, p, cloth, motion)


@kernel
def euler_predict(x, v, p, f, cloth, motion):
    """p = x + dt v after spring forces and velocity modification changed v; position modification changes p."""
    euler_positions(x, v, p, f, cloth, motion)


@kernel
def finish(x, v, p, dt):
    """v = (p - x) / dt, x = p."""
    finish_substep(x, v, p, dt)


@kernel
def largest_speed(x, v):
    """Of velocities v (V, 3) [m/s]; NaN if an entry of positions x (V, 3) or of v is not finite."""
    largest = 0.0
    sound = True
    for i in range(x.shape[0]):
        square = v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2]
        # differences of what is not finite are NaN
        zero = (x[i, 0] - x[i, 0]) + (x[i, 1] - x[i, 1]) + (x[i, 2] - x[i, 2])
        zero += (v[i, 0] - v[i, 0]) + (v[i, 1] - v[i, 1]) + (v[i, 2] - v[i, 2])
        sound = sound and zero == 0.0
        largest = square if square > largest else largest
    return math.sqrt(largest) if sound else math.nan


@kernel
def hold(x, p, inverse_masses, radii, motion, ground, grips, substep):
    """Grips and ground on predicted positions p, for integrators that have solved everything else."""
    start_grips(grips)
    hold_grips(p, inverse_masses, grips, motion.dt, (substep + 1) * motion.dt)
    keep_above_ground(x, p, inverse_masses, radii, ground)
    add_grip_forces(grips, motion.dt)


@kernel
def xpbd_substeps(x, v, p, cloth, radii, motion, ground, grips, multipliers, first, count):
    """`count` substeps of XPBD without contacts between cloths, from substep `first` of the step on."""
    for n in range(first, first + count):
        xpbd_substep(x, v, p, cloth, radii, motion, ground, grips, multipliers, n)
        add_grip_forces(grips, motion.dt)
        finish_substep(x, v, p, motion.dt)


@kernel
def euler_substeps(x, v, p, f, cloth, radii, motion, ground, grips, first, count):
    """`count` substeps of symplectic Euler without contacts between cloths."""
    for n in range(first, first + count):
        euler_positions(x, v, p, f, cloth, motion)
        start_grips(grips)
        hold_grips(p, cloth.inverse_masses, grips, motion.dt, (n + 1) * motion.dt)
        keep_above_ground(x, p, cloth.inverse_masses, radii, ground)
        add_grip_forces(grips, motion.dt)
        finish_substep(x, v, p, motion.dt)
