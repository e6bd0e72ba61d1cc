"""Pairs of primitives under watch within a step: which of them are near, by what they move and not by measuring them again.

A pair is far until all vertices together have moved so much that it may be within 1.25 thicknesses. Near pairs keep their
closest points and the direction between them until they have moved by a quarter of a thickness against each other; a gap along
that direction can fall by no more than that. A look over all pairs brings this up to date. It is due when some vertex has moved
further against the mean than the pair that can bear least allows: a pile at rest is looked at once a step.

Pairs are "quads" of four vertex ids; kind 0 is (v, a, b, c), kind 1 is (a0, a1, b0, b1).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import bare, inlined, kernel
from clothgym.kernels.primitives import closest_on_edges, closest_on_triangle

ACTIVE = 1.25
"""Pairs that may come nearer than this many thicknesses are near; nothing is known of the distance of others."""
_AWAY = 1.5
"""Pairs that are further than this apart may be far: between both there is time until the next look."""
KEEP = 0.2
"""Share of a pair's distance (at most of its thickness) that a substep must leave along the separating direction."""
_REFRESH = 0.25
"""Thicknesses, and twice the share of the distance, that near pairs move before their closest points are found again."""

_LEAD = 4.0
"""Substeps like the next one for which far pairs should not need another look, if that is a short way."""

FAR, NEAR, TOUCHING, LEFT = 0, 1, 2, 3
"""Touching pairs have no side to keep; those left alone lie beside an intersection."""

LOOK, OPEN, PROOF, WAY = 0, 1, 2, 3
"""Places in `Watched.least`: relative motion [m] since the last look up to which no pair needs another; no far pair comes near;
all near ones are proved apart. Then the sum of all such motions from look to look."""


class Watched(NamedTuple):
    """Pairs of a step and what is known of them; K pairs, V vertices."""

    quads: NDArray  # (K, 4) int32 vertex ids
    kinds: NDArray  # (K,) uint8
    rest: NDArray  # (K,) thickness [m]
    gaps: NDArray  # (K,) distance when measured [m]
    ways: NDArray  # (K,) near: how far they have moved against each other since [m]
    holds: NDArray  # (K,) far: way of all vertices [m] up to which it is; near: -inf; left alone: inf
    states: NDArray  # (K,) uint8
    weights: (
        NDArray  # (K, 4) near, and all where pairs were found: signed barycentric weights of the closest points, sum 0
    )
    separation: NDArray  # (K, 4) near: direction from the second side to the first, distance; -1 = nothing is certified
    seen: NDArray  # (V, 3) where all vertices were at the last look [m]
    links: NDArray  # (K,) int64 scratch: the next near pair of the same vertex with a triangle, -1 = none
    heads: NDArray  # (V,) int64 scratch: the first one
    moves: NDArray  # (V, 6) scratch: way since the last look, way ahead [m]
    sizes: NDArray  # (V,) scratch: way since the last look, less what all went on average [m]
    least: NDArray  # (4,) [m] what the pair that can bear least allows, and how far all have come


@inlined
def closest_weights(x, quads, n, kind):
    """Signed barycentric weights of the closest points, positive for the first side."""
    if kind == 0:
        wa, wb, wc = closest_on_triangle(x, quads[n, 0], quads[n, 1], quads[n, 2], quads[n, 3])
        return 1.0, -wa, -wb, -wc
    s, t = closest_on_edges(x, quads[n, 0], quads[n, 1], quads[n, 2], quads[n, 3])
    return 1.0 - s, s, -(1.0 - t), -t


@inlined
def combine(x, quads, n, w0, w1, w2, w3, c):
    return w0 * x[quads[n, 0], c] + w1 * x[quads[n, 1], c] + w2 * x[quads[n, 2], c] + w3 * x[quads[n, 3], c]


@inlined
def left_apart(apart, quads, n, kind, both):
    """Whether contact leaves this pair alone because it lies beside an intersection."""
    if kind == 0:
        one = apart[quads[n, 0]]
        two = apart[quads[n, 1]] or apart[quads[n, 2]] or apart[quads[n, 3]]
    else:
        one = apart[quads[n, 0]] or apart[quads[n, 1]]
        two = apart[quads[n, 2]] or apart[quads[n, 3]]
    return (one and two) if both else (one or two)


@bare
def _drift(p, seen):
    """How far all went on average."""
    mx = 0.0
    my = 0.0
    mz = 0.0
    for i in range(p.shape[0]):
        mx += p[i, 0] - seen[i, 0]
        my += p[i, 1] - seen[i, 1]
        mz += p[i, 2] - seen[i, 2]
    return mx / p.shape[0], my / p.shape[0], mz / p.shape[0]


@bare
def spread(p, watched):
    """Twice the longest way [m] since the last look, less what all go on average: no two vertices moved further against
    each other."""
    seen = watched.seen
    mx, my, mz = _drift(p, seen)
    most = 0.0
    total = 0.0
    for i in range(p.shape[0]):
        dx = p[i, 0] - seen[i, 0] - mx
        dy = p[i, 1] - seen[i, 1] - my
        dz = p[i, 2] - seen[i, 2] - mz
        square = dx * dx + dy * dy + dz * dz
        most = square if square > most else most
        total += square
    return 2.0 * math.sqrt(most) + (total - total)


@inlined
def _square(moves, i, j, c):
    dx = moves[i, c] - moves[j, c]
    dy = moves[i, c + 1] - moves[j, c + 1]
    dz = moves[i, c + 2] - moves[j, c + 2]
    return dx * dx + dy * dy + dz * dz


@inlined
def _relative(moves, quads, n, kind, c):
    """How far both sides can have moved against each other [m]."""
    i = np.uint64(quads[n, 0])
    j = np.uint64(quads[n, 1])
    k = np.uint64(quads[n, 2])
    m = np.uint64(quads[n, 3])
    one = _square(moves, i, k, c)
    two = _square(moves, i, m, c)
    one = one if one > two else two
    two = _square(moves, i if kind == 0 else j, j if kind == 0 else k, c)
    one = one if one > two else two
    if kind == 1:
        two = _square(moves, j, m, c)
        one = one if one > two else two
    return math.sqrt(one)


@inlined
def _at_most(sizes, quads, n, kind):
    """No less than `_relative`, and far cheaper."""
    a = sizes[np.uint64(quads[n, 0])]
    b = sizes[np.uint64(quads[n, 1])]
    c = sizes[np.uint64(quads[n, 2])]
    d = sizes[np.uint64(quads[n, 3])]
    c = c if c > d else d
    if kind == 0:
        return a + (b if b > c else c)
    return (a if a > b else b) + c


@inlined
def _measure(x, n, quads, kinds, weights, separation, known):
    """Closest points of a pair at x, written; returns their distance, 0 if they touch. `known`: the weights are those at x."""
    if known:
        w0 = weights[n, 0]
        w1 = weights[n, 1]
        w2 = weights[n, 2]
        w3 = weights[n, 3]
    else:
        w0, w1, w2, w3 = closest_weights(x, quads, n, kinds[n])
    nx = combine(x, quads, n, w0, w1, w2, w3, 0)
    ny = combine(x, quads, n, w0, w1, w2, w3, 1)
    nz = combine(x, quads, n, w0, w1, w2, w3, 2)
    distance = math.sqrt(nx * nx + ny * ny + nz * nz)
    if distance < 1e-12:
        return 0.0
    weights[n, 0] = w0
    weights[n, 1] = w1
    weights[n, 2] = w2
    weights[n, 3] = w3
    separation[n, 0] = nx / distance
    separation[n, 1] = ny / distance
    separation[n, 2] = nz / distance
    return distance


@bare
def look(x, p, watched, count, apart, both, leave):
    """Brings what is known of all pairs to positions x, for a substep that leads to p.

    Afterwards pairs that are not near stay further apart than 1.25 thicknesses on the straight way from x to p. Pairs beside
    an intersection (apart (V,)) are left alone with `leave`, else near without a certificate. Returns how many pairs were
    measured.
    """
    moves = watched.moves
    seen = watched.seen
    sizes = watched.sizes
    way = spread(x, watched)
    # where pairs were found, their closest points are known; all may have gone a common way since
    known = watched.least[WAY] == 0.0 and way == 0.0
    came = watched.least[WAY] + way
    mx, my, mz = _drift(x, seen)
    for i in range(x.shape[0]):
        dx = x[i, 0] - seen[i, 0] - mx
        dy = x[i, 1] - seen[i, 1] - my
        dz = x[i, 2] - seen[i, 2] - mz
        sizes[i] = math.sqrt(dx * dx + dy * dy + dz * dz)
        for c in range(3):
            moves[i, c] = x[i, c] - seen[i, c]
            moves[i, 3 + c] = p[i, c] - x[i, c]
            seen[i, c] = x[i, c]
    ahead = spread(p, watched)
    # what is due within the next few substeps is not left to looks of their own
    goes = came + ahead + min(_LEAD * ahead, 0.5 * _REFRESH * watched.rest[0])
    # taken out of their tuple once: in the loop, each would be counted as a reference
    quads = watched.quads
    kinds = watched.kinds
    rests = watched.rest
    gaps = watched.gaps
    ways = watched.ways
    holds = watched.holds
    states = watched.states
    weights = watched.weights
    separation = watched.separation
    due = math.inf
    proof = math.inf
    opens = math.inf
    measured = 0
    for n in range(count):
        hold = holds[n]
        if hold > goes:
            opens = hold if hold < opens else opens
            continue
        rest = rests[n]
        kind = kinds[n]
        if states[n] == NEAR:
            gap = gaps[n]
            limit = min(_REFRESH * rest, 0.5 * gap)
            way = ways[n] + _at_most(sizes, quads, n, kind)
            if not way <= 0.5 * limit:
                way = ways[n] + _relative(moves, quads, n, kind, 0)
            if way <= 0.5 * limit:
                ways[n] = way
                due = min(due, limit - way)
                if separation[n, 3] >= 0.0:
                    proof = min(proof, gap - way - KEEP * min(gap, rest))
                continue
        # what is known no longer suffices
        beside = left_apart(apart, quads, n, kind, both)
        separation[n, 3] = -1.0
        if beside and leave:
            states[n] = LEFT
            holds[n] = math.inf
            continue
        measured += 1
        gap = _measure(x, n, quads, kinds, weights, separation, known)
        gaps[n] = gap
        ways[n] = 0.0
        holds[n] = -math.inf
        if gap == 0.0:
            states[n] = TOUCHING
            due = 0.0
        elif gap > _AWAY * rest and gap - _relative(moves, quads, n, kind, 3) > ACTIVE * rest:
            states[n] = FAR
            holds[n] = came + gap - ACTIVE * rest
            opens = min(opens, holds[n])
        else:
            states[n] = NEAR
            due = min(due, _REFRESH * rest, 0.5 * gap)
            if not beside:
                separation[n, 3] = gap
                proof = min(proof, gap - KEEP * min(gap, rest))
    watched.least[WAY] = came
    watched.least[OPEN] = opens - came
    watched.least[LOOK] = min(due, opens - came)
    watched.least[PROOF] = proof
    return measured


@kernel
def begin(start, watched, count):
    """Pairs whose distances are known at positions `start` (V, 3), before any look."""
    for n in range(count):
        watched.states[n] = FAR
        watched.separation[n, 3] = -1.0
        watched.holds[n] = watched.gaps[n] - ACTIVE * watched.rest[n]
    watched.seen[:] = start
    watched.least[:] = -1.0
    watched.least[WAY] = 0.0
