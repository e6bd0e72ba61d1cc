"""XPBD of springs that stand in runs: the k-th of a run joins slots first_i + k and first_j + k, and no two of a run share
a slot, so that a compiler turns the loop over a run into vector instructions. Coordinates stand in arrays of their own.

In double precision p holds positions. In single precision it holds what they have moved since the substep began at x, `base`:
velocities come from differences of positions, and a step of 1e-5 m beside a position of 1 m would leave two digits of them.

Indices are unsigned: for signed ones numba asks at each access whether they count from the end, and no loop is vectorised.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import bare, highest, kernel, lanes_from, lower, lowest, put_lanes, total, upper
from clothgym.kernels.integrate import add_grip_forces

CHUNK = 1024
"""Springs that are worked on at a time: their corrections fit into the nearest cache."""

_AHEAD = 1.5
"""How far vertices have strayed is looked up where so much growth as in the last substep would use up the slack,"""
_KEPT_AHEAD = 4.0
"""and positions are kept where so much would, so that the substep can be taken back."""

LANES = 16
"""The number of slots is a multiple of this, so that no loop over all of them has a remainder."""


class SpringRuns(NamedTuple):
    """Springs of a model for substeps of one length; N entries, gaps of runs included, then the springs that fit no run."""

    slot: NDArray  # (V,) int32 slot of each vertex
    mobility: NDArray  # (M,) inverse mass of each slot [1/kg]; 0 = pinned or no vertex there
    runs: NDArray  # (R, 4) uint64: first slot of the one ends, of the other ends, length, first entry
    loose: NDArray  # (L, 2) int32 slots of springs in no run; their entries are the last L
    rest: NDArray  # (N,) [m]
    alpha: NDArray  # (N,) compliance / dt^2 [1/kg]
    share: NDArray  # (N,) 1 / (inverse masses + alpha) [kg]; 0 = no spring there, or both ends pinned


class RunSpace(NamedTuple):
    """What a step works on; all of the precision in which it is done."""

    x: NDArray  # (3, M) positions where the substep began [m]
    p: NDArray  # (3, M) positions, or in single precision the way since x [m]
    carry: NDArray  # (3, M) what x is short of [m]; (3, 0) in double precision
    a: NDArray  # (3, M) what external acceleration adds in a substep: velocity [m/s], in single precision way [m]
    pull: NDArray  # (CHUNK,) corrections per length
    multipliers: NDArray  # (N,) [N s^2] of the running substep
    constants: NDArray  # (2,) share of the way that damping takes, least length of a spring [m]


class Course(NamedTuple):
    """What was decided for a sheet (`height_field.Tube`), in slots."""

    ways: NDArray  # (5, M) those of the tube; last: 0, or infinity where there is no vertex
    plane: NDArray  # (2, 3) unit axes
    limits: NDArray  # (3,) [m] slack, and by how much the ways differ along both axes
    before: NDArray  # (3, M) scratch: positions where the last substep began [m]


@bare
def _difference(p, base, i, j):
    if base is None:
        return p[j] - p[i]
    return (base[j] - base[i]) + (p[j] - p[i])


@bare
def _move(p, base, i0, j0, length, mobility, pull):
    """Moves both ends along one axis."""
    for k in range(length):
        g = pull[k] * _difference(p, base, i0 + k, j0 + k)
        p[i0 + k] += mobility[i0 + k] * g
        p[j0 + k] -= mobility[j0 + k] * g


@bare
def _project_chunk(px, py, pz, bx, by, bz, i0, j0, length, entry, springs, pull, multipliers, least):
    """A piece of a run; `multipliers` is None in a substep's only sweep, which finds zeros and leaves nothing."""
    rest = springs.rest
    share = springs.share
    alpha = springs.alpha
    for k in range(length):
        dx = _difference(px, bx, i0 + k, j0 + k)
        dy = _difference(py, by, i0 + k, j0 + k)
        dz = _difference(pz, bz, i0 + k, j0 + k)
        size = math.sqrt(dx * dx + dy * dy + dz * dz) + least
        if multipliers is None:
            change = (size - rest[entry + k]) * share[entry + k]
        else:
            change = (size - rest[entry + k] - alpha[entry + k] * multipliers[entry + k]) * share[entry + k]
            multipliers[entry + k] += change
        pull[k] = change / size
    _move(px, bx, i0, j0, length, springs.mobility, pull)
    _move(py, by, i0, j0, length, springs.mobility, pull)
    _move(pz, bz, i0, j0, length, springs.mobility, pull)


@bare
def _project_loose(px, py, pz, bx, by, bz, springs, multipliers, least):
    """Springs in no run, one after the other."""
    loose = springs.loose
    w = springs.mobility
    first = springs.rest.shape[0] - loose.shape[0]
    for k in range(loose.shape[0]):
        i = np.uint64(loose[k, 0])
        j = np.uint64(loose[k, 1])
        s = first + k
        dx = _difference(px, bx, i, j)
        dy = _difference(py, by, i, j)
        dz = _difference(pz, bz, i, j)
        size = math.sqrt(dx * dx + dy * dy + dz * dz) + least
        if multipliers is None:
            change = (size - springs.rest[s]) * springs.share[s]
        else:
            change = (size - springs.rest[s] - springs.alpha[s] * multipliers[s]) * springs.share[s]
            multipliers[s] += change
        g = change / size
        px[i] += w[i] * (g * dx)
        py[i] += w[i] * (g * dy)
        pz[i] += w[i] * (g * dz)
        px[j] -= w[j] * (g * dx)
        py[j] -= w[j] * (g * dy)
        pz[j] -= w[j] * (g * dz)


@bare
def _project_runs(px, py, pz, bx, by, bz, springs, pull, multipliers, least):
    """One sweep of XPBD [Macklin 2016, eq. 18] over all springs."""
    runs = springs.runs
    chunk = np.uint64(CHUNK)
    for r in range(runs.shape[0]):
        length = runs[r, 2]
        for start in range(np.uint64(0), length, chunk):
            _project_chunk(
                px, py, pz, bx, by, bz, runs[r, 0] + start, runs[r, 1] + start, min(chunk, length - start),
                runs[r, 3] + start, springs, pull, multipliers, least,
            )  # fmt: skip
    _project_loose(px, py, pz, bx, by, bz, springs, multipliers, least)


@bare
def _load(x, v, space, springs, motion, kept, relative):
    """The state into slots, and the way of the first substep."""
    slot = springs.slot
    wind = motion.external.shape[0] > 0
    for i in range(x.shape[0]):
        s = slot[i]
        moves = springs.mobility[s] > 0.0
        for c in range(3):
            g = motion.gravity[c]
            if wind:
                g += motion.external[i, c]
            added = motion.dt * g if moves else 0.0
            way = motion.dt * (kept * v[i, c] + added) if moves else 0.0
            space.x[c, s] = x[i, c]
            if relative:
                space.a[c, s] = motion.dt * added
                space.carry[c, s] = x[i, c] - space.x[c, s]
                space.p[c, s] = way
            else:
                space.a[c, s] = added
                space.p[c, s] = x[i, c] + way


@bare
def _advance(x, p, a, kept, dt, inverse):
    """Begins the next substep along one axis: p is where the last one ended, and moves on with what damping leaves. Returns
    by how much the moves of the last substep differ [m], slots without a vertex included.

    To the last bit what `integrate.finish_substep` and `integrate.accelerate` do: that a sheet is worked on in slots must not
    show.
    """
    zero = lanes_from(x, 0) * 0.0
    low = upper(zero, math.inf)
    high = lower(zero, -math.inf)
    for n in range(np.uint64(0), np.uint64(x.shape[0]), np.uint64(LANES)):
        begin = lanes_from(x, n)
        end = lanes_from(p, n)
        move = end - begin
        low = lower(move, low)
        high = upper(move, high)
        put_lanes(x, n, end)
        put_lanes(p, n, end + dt * (kept * (move * inverse) + lanes_from(a, n)))
    return highest(high) - lowest(low)


@bare
def _advance_relative(x, p, carry, a, lost):
    """The same where p is relative to x; what rounding would take from x waits for the next substep."""
    for i in range(x.shape[0]):
        move = p[i] + carry[i]
        reached = x[i] + move
        carry[i] = move - (reached - x[i])
        x[i] = reached
        p[i] += a[i] - lost * p[i]  # kept is too near 1 for single precision


@bare
def _store(x, v, begin, end, springs, dt):
    """The slots into the state: where the last substep ended, and its velocity; begin, end (3, M) [m]."""
    inverse = 1.0 / dt
    for i in range(x.shape[0]):
        s = springs.slot[i]
        moves = springs.mobility[s] > 0.0
        for c in range(3):
            if moves:
                v[i, c] = (end[c, s] - begin[c, s]) * inverse
                x[i, c] = end[c, s]
            else:
                v[i, c] = 0.0


@bare
def _store_relative(x, v, space, springs, dt):
    """The same in single precision."""
    for i in range(x.shape[0]):
        s = springs.slot[i]
        moves = springs.mobility[s] > 0.0
        for c in range(3):
            if moves:
                v[i, c] = space.p[c, s] / dt
                begin = np.float64(space.x[c, s]) + space.carry[c, s]
                x[i, c] = begin + space.p[c, s]
            else:
                v[i, c] = 0.0


@bare
def _hold_grips(space, springs, grips, dt, time, relative):
    """`integrate.hold_grips` on slots."""
    for n in range(grips.vertices.shape[0]):
        s = springs.slot[grips.vertices[n]]
        w = springs.mobility[s]
        if w == 0.0:
            continue
        alpha = 1.0 / (grips.stiffness[n] * dt * dt)
        square = 0.0
        for c in range(3):
            target = grips.targets[n, c] + time * grips.velocities[n, c]
            if relative:
                target -= np.float64(space.x[c, s]) + space.carry[c, s]
            change = (target - space.p[c, s] - alpha * grips.multipliers[n, c]) / (w + alpha)
            space.p[c, s] -= w * grips.multipliers[n, c]
            grips.multipliers[n, c] += change
            square += grips.multipliers[n, c] ** 2
        size = math.sqrt(square)
        limit = grips.force_limit[n] * dt * dt
        scale = limit / size if size > limit else 1.0
        for c in range(3):
            grips.multipliers[n, c] *= scale
            space.p[c, s] += w * grips.multipliers[n, c]


@bare
def _keep_above_ground(space, springs, radii, ground, relative):
    """`integrate.keep_above_ground` on slots."""
    p = space.p
    for i in range(radii.shape[0]):
        s = springs.slot[i]
        floor = ground.height + radii[i]
        if relative:
            floor -= np.float64(space.x[1, s]) + space.carry[1, s]
        depth = floor - p[1, s]
        if depth <= 0.0 or springs.mobility[s] == 0.0:
            continue
        p[1, s] += depth
        bx = 0.0 if relative else space.x[0, s]
        bz = 0.0 if relative else space.x[2, s]
        dx = p[0, s] - bx
        dz = p[2, s] - bz
        slide = math.sqrt(dx * dx + dz * dz)
        if slide > 0.0:
            keep = max(0.0, 1.0 - ground.friction * depth / slide)
            p[0, s] = bx + keep * dx
            p[2, s] = bz + keep * dz


@bare
def _sweep(space, springs, base_x, base_y, base_z, single):
    px = space.p[0]
    py = space.p[1]
    pz = space.p[2]
    least = space.constants[1]
    if single:
        _project_runs(px, py, pz, base_x, base_y, base_z, springs, space.pull, None, least)
    else:
        _project_runs(px, py, pz, base_x, base_y, base_z, springs, space.pull, space.multipliers, least)


@bare
def project_in_runs(p, springs, space, once):
    """One sweep over all springs for positions p (V, 3) that other constraints change too; `once` if it is the substep's only
    one, else space.multipliers go on."""
    slot = springs.slot
    for i in range(p.shape[0]):
        s = np.uint64(slot[i])
        for c in range(3):
            space.p[c, s] = p[i, c]
    _sweep(space, springs, None, None, None, once)
    for i in range(p.shape[0]):
        s = np.uint64(slot[i])
        for c in range(3):
            p[i, c] = space.p[c, s]


@bare
def _substep_sweeps(space, springs, base_x, base_y, base_z, radii, motion, ground, grips, substep, relative):
    """All sweeps of a substep."""
    if motion.sweeps > 1:
        space.multipliers[:] = 0.0
    grips.multipliers[:] = 0.0
    for _ in range(motion.sweeps):
        _sweep(space, springs, base_x, base_y, base_z, motion.sweeps == 1)
        _hold_grips(space, springs, grips, motion.dt, (substep + 1) * motion.dt, relative)
        if ground.height > -math.inf:
            _keep_above_ground(space, springs, radii, ground, relative)


@bare
def _strayed(x, y, z, share, course):
    """How far vertices are at most from where they were expected [m], as `height_field.stays` has it; NaN if one is nowhere."""
    expected_a = course.ways[0]
    expected_b = course.ways[1]
    ahead_a = course.ways[2]
    ahead_b = course.ways[3]
    nobody = course.ways[4]
    ax = course.plane[0, 0]
    ay = course.plane[0, 1]
    az = course.plane[0, 2]
    bx = course.plane[1, 0]
    by = course.plane[1, 1]
    bz = course.plane[1, 2]
    lost = lanes_from(x, 0) * 0.0
    low_a = low_b = upper(lost, math.inf)
    high_a = high_b = lower(lost, -math.inf)
    for n in range(np.uint64(0), np.uint64(x.shape[0]), np.uint64(LANES)):
        px = lanes_from(x, n)
        py = lanes_from(y, n)
        pz = lanes_from(z, n)
        a = ax * px + ay * py + az * pz - (lanes_from(expected_a, n) + share * lanes_from(ahead_a, n))
        b = bx * px + by * py + bz * pz - (lanes_from(expected_b, n) + share * lanes_from(ahead_b, n))
        none = lanes_from(nobody, n)
        low_a = lower(a + none, low_a)
        low_b = lower(b + none, low_b)
        high_a = upper(a - none, high_a)
        high_b = upper(b - none, high_b)
        lost = lost + (a - a) + (b - b)
    wide = highest(high_a) - lowest(low_a)
    deep = highest(high_b) - lowest(low_b)
    return 0.5 * math.sqrt(wide * wide + deep * deep) + total(lost)


@bare
def _substeps(x, v, space, springs, radii, motion, ground, grips, first, last):
    """See `xpbd_substeps_in_runs`."""
    kept = 1.0 / (1.0 + motion.damping * motion.dt)
    inverse = 1.0 / motion.dt
    _load(x, v, space, springs, motion, kept, False)
    for n in range(first, last):
        if n > first:
            for axis in range(3):
                _advance(space.x[axis], space.p[axis], space.a[axis], kept, motion.dt, inverse)
        _substep_sweeps(space, springs, None, None, None, radii, motion, ground, grips, n, False)
        add_grip_forces(grips, motion.dt)
    _store(x, v, space.x, space.p, springs, motion.dt)


@bare
def _copy(values, to):
    for i in range(values.shape[0]):
        for c in range(3):
            to[i, c] = values[i, c]


@bare
def _keep(x, before):
    for n in range(np.uint64(0), np.uint64(x.shape[0]), np.uint64(LANES)):
        put_lanes(before, n, lanes_from(x, n))


@bare
def _along(x, v, space, springs, radii, motion, ground, grips, first, last, course, base, horizon):
    """See `xpbd_substeps_along`; returns the substep that was not made, and whether the state is that before it."""
    kept = 1.0 / (1.0 + motion.damping * motion.dt)
    inverse = 1.0 / motion.dt
    slack = course.limits[0]
    pace_a = course.limits[1] / horizon
    pace_b = course.limits[2] / horizon
    _load(x, v, space, springs, motion, kept, False)
    strayed = _strayed(space.x[0], space.x[1], space.x[2], (first - base) / horizon, course)
    growth = 0.0
    looked = known = True
    for n in range(first, last):
        if n > first:
            known = n == first + 1 or strayed + _KEPT_AHEAD * growth > slack
            wide = pace_a
            deep = pace_b
            for axis in range(3):
                if known:
                    _keep(space.x[axis], course.before[axis])
                moved = _advance(space.x[axis], space.p[axis], space.a[axis], kept, motion.dt, inverse)
                wide += abs(course.plane[0, axis]) * moved
                deep += abs(course.plane[1, axis]) * moved
            # a box that grows on either side grows its half diagonal by no more than half its growth's
            growth = (0.5 + 1e-9) * math.sqrt(wide * wide + deep * deep)
            if not looked:
                strayed += growth
                if not strayed <= slack:
                    strayed = _strayed(space.x[0], space.x[1], space.x[2], (n - base) / horizon, course)
                    if not strayed <= slack:
                        return n - 1, False
        _substep_sweeps(space, springs, None, None, None, radii, motion, ground, grips, n, False)
        looked = n + 1 == last or (n > first and strayed + _AHEAD * growth > slack)
        if looked:
            strayed = _strayed(space.p[0], space.p[1], space.p[2], (n + 1 - base) / horizon, course)
            if not strayed <= slack:
                if n > first and known:
                    _store(x, v, course.before, space.x, springs, motion.dt)
                return n, known
        add_grip_forces(grips, motion.dt)
    _store(x, v, space.x, space.p, springs, motion.dt)
    return last, True


@kernel
def xpbd_substeps_in_runs(x, v, space, springs, radii, motion, ground, grips, first, last):
    """`integrate.xpbd_substeps` for springs in runs, in double precision, from substep `first` up to `last`."""
    _substeps(x, v, space, springs, radii, motion, ground, grips, first, last)


@kernel
def xpbd_substeps_along(x, v, space, springs, radii, motion, ground, grips, first, last, course, base, horizon, forces):
    """The same as long as a sheet keeps to its course: a motion that began at substep `base` and takes `horizon` of them.
    Returns the substep that was not made because it might not; forces (A, 3) is scratch.

    How far vertices have strayed is known from time to time. From one substep to the next it grows by no more than moves
    differ from those expected, and they differ by no more than the box of all moves is wide in the plane: as long as that is
    below the slack, no vertex has to be looked at. Where one may have to soon, the positions before are kept, with which a
    substep that is seen to leave the course is taken back. If it comes out of the blue, those before it are made once more.
    """
    _copy(grips.forces, forces)
    left, known = _along(x, v, space, springs, radii, motion, ground, grips, first, last, course, base, horizon)
    if not known:
        _copy(forces, grips.forces)
        if left > first:
            _substeps(x, v, space, springs, radii, motion, ground, grips, first, left)
    return left


@kernel
def xpbd_substeps_in_single_runs(x, v, space, springs, radii, motion, ground, grips, first, last):
    """The same in single precision; positions of the state keep double precision."""
    kept = 1.0 / (1.0 + motion.damping * motion.dt)
    space.constants[0] = 1.0 - kept
    lost = space.constants[0]
    _load(x, v, space, springs, motion, kept, True)
    for n in range(first, last):
        if n > first:
            for axis in range(3):
                _advance_relative(space.x[axis], space.p[axis], space.carry[axis], space.a[axis], lost)
        _substep_sweeps(space, springs, space.x[0], space.x[1], space.x[2], radii, motion, ground, grips, n, True)
        add_grip_forces(grips, motion.dt)
    _store_relative(x, v, space, springs, motion.dt)
