"""Soft anchors of grippers as forces: a pull of k d, limited; for integrators that solve for it with everything else."""

from __future__ import annotations

import math

from clothgym._jit import bare, kernel


@bare
def pull(x, grips, time, a):
    """Force of anchor a per distance [N/m]; the share of its second derivative that is missing along the pull, over the
    square of the distance (at the force limit: all of it); the way to the target [m]."""
    v = grips.vertices[a]
    dx = grips.targets[a, 0] + time * grips.velocities[a, 0] - x[v, 0]
    dy = grips.targets[a, 1] + time * grips.velocities[a, 1] - x[v, 1]
    dz = grips.targets[a, 2] + time * grips.velocities[a, 2] - x[v, 2]
    size = math.sqrt(dx * dx + dy * dy + dz * dz)
    if grips.stiffness[a] * size <= grips.force_limit[a]:
        return grips.stiffness[a], 0.0, dx, dy, dz
    return grips.force_limit[a] / size, 1.0 / (size * size), dx, dy, dz


@bare
def add_grip_pulls(x, grips, time, f):
    """Adds the pulls of all anchors to f (V, 3) [N]; time [s] since the start of the step moves their targets."""
    for a in range(grips.vertices.shape[0]):
        k, _, dx, dy, dz = pull(x, grips, time, a)
        v = grips.vertices[a]
        f[v, 0] += k * dx
        f[v, 1] += k * dy
        f[v, 2] += k * dz


@bare
def grip_energy(x, grips, time):
    """k d^2 / 2 up to the force limit, linear beyond [J]."""
    total = 0.0
    for a in range(grips.vertices.shape[0]):
        v = grips.vertices[a]
        square = 0.0
        for c in range(3):
            square += (grips.targets[a, c] + time * grips.velocities[a, c] - x[v, c]) ** 2
        size = math.sqrt(square)
        k = grips.stiffness[a]
        limit = grips.force_limit[a]
        total += 0.5 * k * square if k * size <= limit else limit * (size - 0.5 * limit / k)
    return total


@bare
def book_pulls(p, inverse_masses, grips, time, dt):
    """Books the pulls at the end p of a substep, as `integrate.hold` books its projections."""
    for a in range(grips.vertices.shape[0]):
        if inverse_masses[grips.vertices[a]] == 0.0:
            continue
        k, _, dx, dy, dz = pull(p, grips, time, a)
        d = (dx, dy, dz)
        for c in range(3):
            grips.multipliers[a, c] = k * d[c] * dt * dt
            grips.forces[a, c] += k * d[c]


@kernel
def book_grip_forces(p, inverse_masses, grips, time, dt):
    """See `book_pulls`."""
    book_pulls(p, inverse_masses, grips, time, dt)
