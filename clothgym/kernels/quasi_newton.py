"""A global solver: the objective of an implicit step by L-BFGS, started with one constant matrix that is factored once.

The constant matrix is that of projective dynamics [Liu 2013; Bouaziz 2014]: inertia, and for each energy a bound of its
second derivatives in all directions, the same for x, y and z. With it alone each step would be one of projective dynamics
(so for springs [Liu 2017, section 4]); the pairs of steps and changes of slope that L-BFGS keeps add what the matrix does
not know. The minimum is that of the energies themselves, as for Newton's method.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.implicit import objective, slope


class Factor(NamedTuple):
    """P A P^T = L D L^T of the constant matrix A of the free vertices; L has ones on its diagonal, which are not kept."""

    order: NDArray  # (n,) int32: vertex of each row
    columns: NDArray  # (n + 1,) int32: entries of L below the diagonal, column by column
    rows: NDArray  # (nnz,) int32
    values: NDArray  # (nnz,)
    inverses: NDArray  # (n,) 1 / D [m/N]


class Memory(NamedTuple):
    """What L-BFGS keeps of its last K steps, in a ring, and buffers."""

    steps: NDArray  # (K, V, 3) [m]
    changes: NDArray  # (K, V, 3) of the gradient [N]
    curvatures: NDArray  # (K,) steps . changes [J]
    shares: NDArray  # (K,)
    gradient: NDArray  # (V, 3) [N]
    before: NDArray  # (V, 3) gradient of the step before [N]
    direction: NDArray  # (V, 3) [m]
    trial: NDArray  # (V, 3) [m]
    sorted: NDArray  # (n, 3) right-hand sides in the factor's order


@device
def back_substitute(factor, b, z, y):
    """z = A^-1 b for the three columns at once, z may be b; pins keep what z has. y (n, 3) is a buffer."""
    order = factor.order
    columns = factor.columns
    rows = factor.rows
    values = factor.values
    count = order.shape[0]
    for k in range(count):
        i = order[k]
        y[k, 0] = b[i, 0]
        y[k, 1] = b[i, 1]
        y[k, 2] = b[i, 2]
    for k in range(count):
        a0 = y[k, 0]
        a1 = y[k, 1]
        a2 = y[k, 2]
        for n in range(columns[k], columns[k + 1]):
            r = rows[n]
            value = values[n]
            y[r, 0] -= value * a0
            y[r, 1] -= value * a1
            y[r, 2] -= value * a2
    for k in range(count - 1, -1, -1):
        a0 = y[k, 0] * factor.inverses[k]
        a1 = y[k, 1] * factor.inverses[k]
        a2 = y[k, 2] * factor.inverses[k]
        for n in range(columns[k], columns[k + 1]):
            r = rows[n]
            value = values[n]
            a0 -= value * y[r, 0]
            a1 -= value * y[r, 1]
            a2 -= value * y[r, 2]
        y[k, 0] = a0
        y[k, 1] = a1
        y[k, 2] = a2
        i = order[k]
        z[i, 0] = a0
        z[i, 1] = a1
        z[i, 2] = a2


@kernel
def solve_factored(factor, b, z, y):
    """See `back_substitute`."""
    back_substitute(factor, b, z, y)


@device
def _dot(a, b):
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i, 0] * b[i, 0] + a[i, 1] * b[i, 1] + a[i, 2] * b[i, 2]
    return total


@device
def _add(a, scale, b):
    """b += scale a."""
    for i in range(a.shape[0]):
        b[i, 0] += scale * a[i, 0]
        b[i, 1] += scale * a[i, 1]
        b[i, 2] += scale * a[i, 2]


@device
def _find_direction(factor, memory, first, kept):
    """direction = -(inverse of the Hessian as L-BFGS knows it) gradient, by the two loops [Nocedal 1980]."""
    d = memory.direction
    capacity = memory.curvatures.shape[0]
    for i in range(d.shape[0]):
        for c in range(3):
            d[i, c] = -memory.gradient[i, c]
    for k in range(kept - 1, -1, -1):
        n = (first + k) % capacity
        memory.shares[n] = _dot(memory.steps[n], d) / memory.curvatures[n]
        _add(memory.changes[n], -memory.shares[n], d)
    back_substitute(factor, d, d, memory.sorted)
    for k in range(kept):
        n = (first + k) % capacity
        _add(memory.steps[n], memory.shares[n] - _dot(memory.changes[n], d) / memory.curvatures[n], d)


@device
def _go(p, length, direction, trial):
    for i in range(p.shape[0]):
        for axis in range(3):
            trial[i, axis] = p[i, axis] + length * direction[i, axis]


@device
def _remember(memory, length, first, kept):
    """Keeps the last step and the change of the gradient, from `before` to `gradient`, if they say anything."""
    capacity = memory.curvatures.shape[0]
    slot = (first + kept) % capacity
    s = memory.steps[slot]
    c = memory.changes[slot]
    curvature = 0.0
    for i in range(s.shape[0]):
        for axis in range(3):
            s[i, axis] = length * memory.direction[i, axis]
            c[i, axis] = memory.gradient[i, axis] - memory.before[i, axis]
            curvature += s[i, axis] * c[i, axis]
    if curvature <= 0.0:
        return first, kept
    memory.curvatures[slot] = curvature
    return ((first + 1) % capacity, kept) if kept == capacity else (first, kept + 1)


@kernel
def minimise(p, y, weights, cloth, grips, time, factor, memory, tolerance, steps):
    """Minimises the objective from p on, until what is unbalanced is below `tolerance` [m/s^2] (see `implicit.slope`).

    It ends after `steps` too, if half of what was unbalanced at the start is gone: otherwise, it goes on up to 10 times as far.
    Steps are as long as slopes at both ends say; the objective itself is asked only where these are in doubt.

    Returns steps, line searches that were shortened, and what is unbalanced at the end [m/s^2].
    """
    g, d, trial, before = memory.gradient, memory.direction, memory.trial, memory.before
    first = 0
    kept = 0
    shortened = 0
    n = 0
    left = slope(p, y, weights, cloth, grips, time, g)
    enough = 0.5 * left
    while left > tolerance and (n < steps or (left > enough and n < 10 * steps)):
        _find_direction(factor, memory, first, kept)
        descent = _dot(g, d)
        if not descent < 0.0:
            break
        for i in range(p.shape[0]):
            for axis in range(3):
                before[i, axis] = g[i, axis]
        length = 1.0
        energy = math.nan
        found = False
        for _ in range(40):
            _go(p, length, d, trial)
            left = slope(trial, y, weights, cloth, grips, time, g)
            ahead = _dot(g, d)
            found = ahead <= 0.5 * abs(descent)
            if found and ahead < descent:  # steeper than at the start: not convex in between, so ask
                if math.isnan(energy):
                    energy = objective(p, y, weights, cloth, grips, time)
                reached = objective(trial, y, weights, cloth, grips, time)
                found = reached <= energy + 1e-4 * length * descent + 1e-14 * abs(energy)
            if found:
                break
            shortened += 1
            # where a parabola through both slopes is least
            length *= min(0.7, max(0.1, descent / (descent - ahead))) if ahead > descent else 0.5
        if not found:
            break
        for i in range(p.shape[0]):
            for axis in range(3):
                p[i, axis] = trial[i, axis]
        first, kept = _remember(memory, length, first, kept)
        n += 1
    return n, shortened, left
