"""The classical Runge-Kutta method of order 4, which [Vassilev 2001, section 3] names and sets aside for its cost.

Stable on the imaginary axis up to w dt = sqrt(8), for four evaluations of the forces: per evaluation that is 0.35 of the
step of symplectic Euler. Velocities at the ends of steps are found along with p here; (p - x) / dt is a mean over the step.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.anchors import add_grip_pulls, book_pulls
from clothgym.kernels.elastic import add_elastic_forces
from clothgym.kernels.integrate import keep_above_ground


class Rates(NamedTuple):
    """Buffers of one step, each (V, 3)."""

    positions: NDArray  # of the running stage [m]
    velocities: NDArray  # of the running stage [m/s]
    accelerations: NDArray  # of the running stage [m/s^2]
    position_sum: NDArray  # weighted sum of the stages' velocities [m/s]
    velocity_sum: NDArray  # weighted sum of the stages' accelerations [m/s^2]


@device
def _accelerate(x, v, a, cloth, motion, grips, time):
    """a = f(x) / m + g - c v + wind; 0 for pins."""
    a[:] = 0.0
    add_elastic_forces(x, cloth, a)
    add_grip_pulls(x, grips, time, a)
    wind = motion.external.shape[0] > 0
    for i in range(x.shape[0]):
        w = cloth.inverse_masses[i]
        for c in range(3):
            if w == 0.0:
                a[i, c] = 0.0
                continue
            a[i, c] = w * a[i, c] + motion.gravity[c] - motion.damping * v[i, c]
            if wind:
                a[i, c] += motion.external[i, c]


@device
def _step(x, v, p, ends, cloth, motion, grips, substep, rates):
    """Positions p and velocities `ends` at the end of a step from x, v."""
    xs, vs, a = rates.positions, rates.velocities, rates.accelerations
    count = x.shape[0]
    for i in range(count):
        free = cloth.inverse_masses[i] > 0.0
        for c in range(3):
            xs[i, c] = x[i, c]
            vs[i, c] = v[i, c] if free else 0.0
            ends[i, c] = vs[i, c]
            rates.position_sum[i, c] = 0.0
            rates.velocity_sum[i, c] = 0.0
    for stage in range(4):
        time = (substep + (0.0 if stage == 0 else 1.0 if stage == 3 else 0.5)) * motion.dt
        _accelerate(xs, vs, a, cloth, motion, grips, time)
        weight = 1.0 / 6.0 if stage == 0 or stage == 3 else 1.0 / 3.0
        ahead = motion.dt if stage == 2 else 0.5 * motion.dt
        for i in range(count):
            for c in range(3):
                rates.position_sum[i, c] += weight * vs[i, c]
                rates.velocity_sum[i, c] += weight * a[i, c]
                xs[i, c] = x[i, c] + ahead * vs[i, c]
                vs[i, c] = ends[i, c] + ahead * a[i, c]
    for i in range(count):
        for c in range(3):
            p[i, c] = x[i, c] + motion.dt * rates.position_sum[i, c]
            ends[i, c] += motion.dt * rates.velocity_sum[i, c]
    book_pulls(p, cloth.inverse_masses, grips, (substep + 1) * motion.dt, motion.dt)


@device
def _copy(p, free):
    for i in range(p.shape[0]):
        for c in range(3):
            free[i, c] = p[i, c]


@device
def _finish(x, v, p, free, ends, dt, lasting):
    for i in range(x.shape[0]):
        square = 0.0
        late = 0.0
        for c in range(3):
            pushed = p[i, c] - free[i, c]
            square += pushed * pushed
            late -= pushed * (dt * ends[i, c] - free[i, c] + x[i, c])
        lasting[i] = 0.0
        if square == 0.0:
            for c in range(3):
                v[i, c] = ends[i, c]
                x[i, c] = p[i, c]
            continue
        share = min(1.0, max(0.0, late / square))
        mean = 0.0
        rest = 0.0
        for c in range(3):
            mean += (p[i, c] - x[i, c]) ** 2
            rest += (dt * ends[i, c] - free[i, c] + x[i, c] + share * (p[i, c] - free[i, c])) ** 2
        scale = math.sqrt(mean / rest) if rest > mean else 1.0
        for c in range(3):
            pushed = p[i, c] - free[i, c]
            late = dt * ends[i, c] - free[i, c] + x[i, c] + share * pushed
            v[i, c] = (p[i, c] - x[i, c] + scale * late) / dt
            lasting[i] += (dt * (v[i, c] - ends[i, c]) - pushed) * pushed / square
            x[i, c] = p[i, c]


@kernel
def runge_kutta_predict(x, v, p, free, ends, cloth, motion, grips, substep, rates):
    """p and its copy `free` at the end of a step without ground and contact; velocities there in `ends`."""
    _step(x, v, p, ends, cloth, motion, grips, substep, rates)
    _copy(p, free)


@kernel
def finish_second_order(x, v, p, free, ends, dt, lasting):
    """x = p, and the velocity that belongs to it: `ends`, and what ground and contact did, which moved p from `free`.

    A push that lasts all the step changes the velocity by twice what it changes the mean velocity of the step, one from an
    impact by the same. A push counts twice as far as it stops the acceleration that the mean does not show yet, and never
    so that the end's velocity differs from the mean by more than the mean itself. So what slides is slowed by all of its
    friction, what rests is at rest, and what hits does not bounce. Lasting (V,) is the share that counted twice.
    """
    _finish(x, v, p, free, ends, dt, lasting)


@kernel
def runge_kutta_substeps(x, v, p, free, ends, cloth, motion, rates, radii, ground, grips, lasting, count):
    """`count` substeps without contacts between cloths."""
    for n in range(count):
        _step(x, v, p, ends, cloth, motion, grips, n, rates)
        _copy(p, free)
        keep_above_ground(x, p, cloth.inverse_masses, radii, ground)
        _finish(x, v, p, free, ends, motion.dt, lasting)


@kernel
def count_lasting(moved, lasting):
    """Scales what a body moved (V, 3) [m] to the impulse that `finish_second_order` made of it."""
    for i in range(moved.shape[0]):
        for c in range(3):
            moved[i, c] *= 1.0 + lasting[i]
