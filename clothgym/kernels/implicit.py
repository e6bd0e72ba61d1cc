"""Implicit integration: the minimum of an objective by Newton's method with preconditioned conjugate gradients.

Positions p at the end of a step of length h minimise

    E(p) = sum_i weight_i |p_i - y_i|^2 / 2 + elastic energy(p) + energy of the grips(p),

with y where the vertices would be without those energies and weight = m / h^2 [Baraff 1998; Volino 2006 and Mezger 2003 use
such engines]. Second derivatives are made positive semidefinite element by element, so every step of Newton goes downhill.
The matrix is kept as 3 x 3 blocks: the diagonal, and what stands right of it in rows. Pins have no equations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.anchors import add_grip_pulls, grip_energy
from clothgym.kernels.block_matrix import assemble, multiply
from clothgym.kernels.elastic import add_elastic_forces, elastic_energy

_ARMIJO = 1e-4
"""Share of the decrease that the slope promises which a step must reach."""


class Search(NamedTuple):
    """Buffers, each (V, 3)."""

    gradient: NDArray  # of the objective [N]
    step: NDArray  # of Newton [m]
    trial: NDArray  # positions [m]
    residual: NDArray  # of the linear system [N]
    direction: NDArray  # of the conjugate gradients [m]
    product: NDArray  # matrix times direction [N]
    conditioned: NDArray  # inverse blocks times residual [m]


# ---------------------------------------------------------------------------------------------------------------
# the objective


@device
def objective(p, y, weights, cloth, grips, time):
    """E [J]."""
    springs, membrane, bending = elastic_energy(p, cloth)
    total = springs + membrane + bending + grip_energy(p, grips, time)
    for i in range(p.shape[0]):
        dx = p[i, 0] - y[i, 0]
        dy = p[i, 1] - y[i, 1]
        dz = p[i, 2] - y[i, 2]
        total += 0.5 * weights[i] * (dx * dx + dy * dy + dz * dz)
    return total


@device
def slope(p, y, weights, cloth, grips, time, gradient):
    """Gradient of E [N]; 0 for pins. Returns its size as an acceleration [m/s^2], the root of the mean over the mass."""
    gradient[:] = 0.0
    add_elastic_forces(p, cloth, gradient)
    add_grip_pulls(p, grips, time, gradient)
    square = 0.0
    mass = 0.0
    for i in range(p.shape[0]):
        w = cloth.inverse_masses[i]
        if w == 0.0:
            gradient[i, 0] = 0.0
            gradient[i, 1] = 0.0
            gradient[i, 2] = 0.0
            continue
        mass += 1.0 / w
        for c in range(3):
            g = weights[i] * (p[i, c] - y[i, c]) - gradient[i, c]
            gradient[i, c] = g
            square += w * g * g
    return math.sqrt(square / mass) if mass > 0.0 else 0.0


# ---------------------------------------------------------------------------------------------------------------
# the solver


@device
def _condition(matrix, r, z):
    """z = inverse blocks r; returns r . z."""
    total = 0.0
    for i in range(r.shape[0]):
        b = matrix.inverses[i]
        x = r[i, 0]
        y = r[i, 1]
        w = r[i, 2]
        z[i, 0] = b[0, 0] * x + b[0, 1] * y + b[0, 2] * w
        z[i, 1] = b[1, 0] * x + b[1, 1] * y + b[1, 2] * w
        z[i, 2] = b[2, 0] * x + b[2, 1] * y + b[2, 2] * w
        total += x * z[i, 0] + y * z[i, 1] + w * z[i, 2]
    return total


@device
def conjugate_gradients(matrix, inverse_masses, search, share, cap):
    """Solves matrix step = -gradient until the residual's mean over the mass is `share` of the gradient's; iterations."""
    step, r, d, q, z = search.step, search.residual, search.direction, search.product, search.conditioned
    start = 0.0
    for i in range(step.shape[0]):
        for c in range(3):
            step[i, c] = 0.0
            r[i, c] = -search.gradient[i, c]
            start += inverse_masses[i] * r[i, c] * r[i, c]
    rho = _condition(matrix, r, d)
    for n in range(cap):
        curvature = multiply(matrix, d, q)
        if not curvature > 0.0:
            return n
        alpha = rho / curvature
        square = 0.0
        for i in range(step.shape[0]):
            for c in range(3):
                step[i, c] += alpha * d[i, c]
                r[i, c] -= alpha * q[i, c]
                square += inverse_masses[i] * r[i, c] * r[i, c]
        if square <= share * share * start:
            return n + 1
        before = rho
        rho = _condition(matrix, r, z)
        beta = rho / before
        for i in range(step.shape[0]):
            for c in range(3):
                d[i, c] = z[i, c] + beta * d[i, c]
    return cap


@kernel
def solve_linear(matrix, inverse_masses, search, share, cap):
    """`conjugate_gradients` alone, with the matrix as it was assembled last."""
    return conjugate_gradients(matrix, inverse_masses, search, share, cap)


@device
def search_line(p, y, weights, cloth, grips, time, search):
    """Moves p along search.step, halved until the objective falls by a share of what its slope promises [Armijo].

    Returns whether it does so at any length; otherwise p is as it was.
    """
    descent = 0.0
    for i in range(p.shape[0]):
        for c in range(3):
            descent += search.gradient[i, c] * search.step[i, c]
    length = 0.0
    start = 0.0
    for n in range(41):
        for i in range(p.shape[0]):
            for c in range(3):
                search.trial[i, c] = p[i, c] + length * search.step[i, c]
        reached = objective(search.trial, y, weights, cloth, grips, time)
        if n == 0:
            start = reached
            length = 1.0
        elif reached <= start + _ARMIJO * length * descent + 1e-14 * abs(start):
            for i in range(p.shape[0]):
                for c in range(3):
                    p[i, c] = search.trial[i, c]
            return True
        else:
            length *= 0.5
    return False


@kernel
def newton(p, y, weights, cloth, grips, time, matrix, search, tolerance, steps, iterations):
    """Minimises the objective from p on, until what is unbalanced is below `tolerance` [m/s^2] (see `slope`).

    Returns steps of Newton, iterations of the conjugate gradients, and what is unbalanced at the end [m/s^2].
    """
    linear = 0
    share = 0.1
    before = 0.0
    n = 0
    while True:
        left = slope(p, y, weights, cloth, grips, time, search.gradient)
        if left <= tolerance or n == steps:
            return n, linear, left
        if n > 0:
            share = min(0.1, max(1e-4, 0.9 * (left / before) ** 2))  # as exact as quadratic convergence can use
        assemble(p, weights, cloth, grips, time, matrix)
        needed = max(share, 0.5 * tolerance / left)
        linear += conjugate_gradients(matrix, cloth.inverse_masses, search, needed, iterations)
        n += 1
        if not search_line(p, y, weights, cloth, grips, time, search):
            return n, linear, left
        before = left


# ---------------------------------------------------------------------------------------------------------------
# stages of a step


@kernel
def begin_stage(x, v, y, inverse_masses, motion, h, implicit_damping):
    """y: where an implicit Euler step of length h from x, v would end without elastic forces.

    Damping acts on the old velocity as in XPBD, or on the new one (with weights (1 + c h) m / h^2 then).
    """
    damped = 1.0 / (1.0 + motion.damping * h)
    wind = motion.external.shape[0] > 0
    for i in range(x.shape[0]):
        free = inverse_masses[i] > 0.0
        for c in range(3):
            y[i, c] = x[i, c]
            if not free:
                continue
            a = motion.gravity[c]
            if wind:
                a += motion.external[i, c]
            y[i, c] += h * damped * (v[i, c] + h * a) if implicit_damping else h * (damped * v[i, c] + h * a)


@kernel
def coast(x, v, p, inverse_masses, h):
    """p = x + h v, x for pins: where a search starts."""
    for i in range(x.shape[0]):
        for c in range(3):
            p[i, c] = x[i, c] + h * v[i, c] if inverse_masses[i] > 0.0 else x[i, c]


@kernel
def between_stages(x, v, p, base, rate, dt, h):
    """From the end p of a first stage of length h: base and rate from which the second stage of length h ends the step.

    Singly diagonally implicit Runge-Kutta method of order 2, L-stable, with h = (1 - sqrt(1/2)) dt [Alexander 1977].
    On return p is where the search of the second stage starts.
    """
    for i in range(x.shape[0]):
        for c in range(3):
            mean = (p[i, c] - x[i, c]) / h
            base[i, c] = x[i, c] + (dt - h) * mean
            rate[i, c] = v[i, c] + (dt - h) / h * (mean - v[i, c])
            p[i, c] = base[i, c] + h * mean


@kernel
def end_stages(p, base, ends, free, h):
    """Velocities at the end of the second stage, and a copy of p."""
    for i in range(p.shape[0]):
        for c in range(3):
            ends[i, c] = (p[i, c] - base[i, c]) / h
            free[i, c] = p[i, c]
