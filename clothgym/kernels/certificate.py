"""The certificate of separation: proof, for every substep, that what was apart stays apart."""

from __future__ import annotations

import math

import numpy as np

from clothgym._jit import device, inlined, kernel
from clothgym.kernels.joining import root_of
from clothgym.kernels.near_pairs import KEEP, look, stir

_ATTEMPTS = 4


@inlined
def _along(p, separation, n, v):
    return separation[n, 0] * p[v, 0] + separation[n, 1] * p[v, 1] + separation[n, 2] * p[v, 2]


@inlined
def _gap(p, quads, n, kind, separation):
    """Gap along the pair's separating direction."""
    a = _along(p, separation, n, np.uint64(quads[n, 0]))
    b = _along(p, separation, n, np.uint64(quads[n, 1]))
    c = _along(p, separation, n, np.uint64(quads[n, 2]))
    d = _along(p, separation, n, np.uint64(quads[n, 3]))
    high = c if c > d else d
    if kind == 0:
        return a - (b if b > high else high)
    return (a if a < b else b) - high


@inlined
def _extremes(p, quads, n, kind, separation):
    """Gap along the pair's separating direction and the two vertices that bound it."""
    nx = separation[n, 0]
    ny = separation[n, 1]
    nz = separation[n, 2]
    split = 1 if kind == 0 else 2
    low = math.inf
    high = -math.inf
    i = quads[n, 0]
    j = quads[n, 3]
    for k in range(4):
        v = quads[n, k]
        s = nx * p[v, 0] + ny * p[v, 1] + nz * p[v, 2]
        if k < split:
            if s < low:
                low = s
                i = v
        elif s > high:
            high = s
            j = v
    return low - high, i, j


@inlined
def _needed(separation, thickness, quads, n):
    one = min(thickness[np.uint64(quads[n, 0])], thickness[np.uint64(quads[n, 1])])
    two = min(thickness[np.uint64(quads[n, 2])], thickness[np.uint64(quads[n, 3])])
    return KEEP * min(separation[n, 3], one, two)


@device
def keep_apart(x, p, inverse_masses, thickness, quads, kinds, count, separation, rounds):
    """Makes sure that no pair that was apart at x crosses on the straight way to p; changes p where needed.

    Two convex primitives whose closest points are d > 0 apart are separated by a plane across the line of these points.
    Along linear paths the gap across that fixed direction is concave in time, so a positive gap at both ends proves that
    the pair stayed apart. Pairs without the proof are first pushed apart (`rounds` sweeps), then joined to zones that
    move as one, which always has it [Bridson 2002, rigid impact zones, translation only]. Linear momentum is kept.
    Returns (pairs repaired, vertices moved in zones).
    """
    repaired = 0
    for _ in range(rounds):
        bad = 0
        for n in range(count):
            if separation[n, 3] < 0.0:
                continue
            need = _needed(separation, thickness, quads, n)
            if _gap(p, quads, n, kinds[n], separation) >= need:
                continue
            bad += 1
            gap, i, j = _extremes(p, quads, n, kinds[n], separation)
            total = inverse_masses[i] + inverse_masses[j]
            if total == 0.0:
                continue
            push = (1.5 * need - gap) / total
            for c in range(3):
                p[i, c] += push * inverse_masses[i] * separation[n, c]
                p[j, c] -= push * inverse_masses[j] * separation[n, c]
        repaired += bad
        if bad == 0:
            return repaired, 0
    vertices = x.shape[0]
    parent = np.arange(vertices)
    mean = np.zeros((vertices, 3), np.float64)
    mass = np.zeros(vertices, np.float64)
    held = np.zeros(vertices, np.bool_)
    moved = 0
    while True:
        bad = 0
        for n in range(count):
            if separation[n, 3] < 0.0:
                continue
            if _gap(p, quads, n, kinds[n], separation) >= _needed(separation, thickness, quads, n) * 0.5:
                continue
            joined = False
            root = root_of(parent, quads[n, 0])
            for k in range(1, 4):
                other = root_of(parent, quads[n, k])
                if other != root:
                    parent[max(root, other)] = min(root, other)
                    root = min(root, other)
                    joined = True
            if joined:
                bad += 1
        if bad == 0:
            return repaired, moved
        mean[:] = 0.0
        mass[:] = 0.0
        held[:] = False
        for i in range(vertices):
            root = root_of(parent, i)
            if inverse_masses[i] == 0.0:
                if not held[root]:
                    held[root] = True
                    mass[root] = 1.0
                    for c in range(3):
                        mean[root, c] = p[i, c] - x[i, c]
            elif not held[root]:
                mass[root] += 1.0 / inverse_masses[i]
                for c in range(3):
                    mean[root, c] += (p[i, c] - x[i, c]) / inverse_masses[i]
        moved = 0
        for i in range(vertices):
            root = root_of(parent, i)
            moved += root != i
            # a lone vertex is its own mean and stays where it was predicted
            for c in range(3):
                p[i, c] = x[i, c] + mean[root, c] / mass[root]


@device
def prove_all(x, p, inverse_masses, thickness, watched, count, apart, both, leave, rounds):
    """Makes sure that no watched pair crosses on the straight way from x to p; changes p where needed.

    Near pairs are proved by what has moved since they were measured, or by `keep_apart`; far ones by what has moved, and
    those for which that does not suffice become near. Returns (pairs measured, pairs repaired, vertices moved in zones, 1
    where pushing apart what came near brought others near too often, else 0).
    """
    measured = 0
    repaired = 0
    zoned = 0
    for attempt in range(_ATTEMPTS):
        new = 0
        _, far, unproved = stir(p, watched)
        if far:
            new = look(x, p, watched, count, apart, both, leave)
            _, _, unproved = stir(p, watched)
        measured += new
        if (attempt > 0 and new == 0) or not unproved:
            return measured, repaired, zoned, 0
        pushed, moved = keep_apart(
            x, p, inverse_masses, thickness, watched.quads, watched.kinds, count, watched.separation, rounds
        )
        repaired += pushed
        zoned += moved
        if pushed == 0 and moved == 0:
            return measured, repaired, zoned, 0
    return measured, repaired, zoned, 1


@kernel
def prove(x, p, inverse_masses, thickness, watched, count, apart, both, leave, rounds):
    """See `prove_all`."""
    return prove_all(x, p, inverse_masses, thickness, watched, count, apart, both, leave, rounds)
