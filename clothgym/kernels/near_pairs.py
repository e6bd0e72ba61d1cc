"""Pairs of primitives under watch within a step: which of them are near, by what they move and not by measuring them again.

A pair is far until its vertices have moved so much that it may be within 1.25 thicknesses. Near pairs keep their closest points
and the direction between them until they have moved by a quarter of a thickness against each other; a gap along that direction
can fall by no more than that. What a pair can bear is shared out among its vertices, and each vertex keeps the least of its
shares, counted against what all vertices move on average. A look over all pairs is due when a vertex has used up its own:
a pile at rest is looked at once a step, and what swings beside it does not matter to it.

What all vertices move on average is a shift and a turn (`kernels.bulk`): no distance gets shorter by it, so only what vertices
move beside it can bring them nearer, all along a straight way.

Pairs are "quads" of four vertex ids; kind 0 is (v, a, b, c), kind 1 is (a0, a1, b0, b1).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import bare, inlined, kernel
from clothgym.kernels.bulk import BULK, bulk_of, roots, squares_of_ways
from clothgym.kernels.primitives import closest_on_edges, closest_on_triangle

ACTIVE = 1.25
"""Pairs that may come nearer than this many thicknesses are near; nothing is known of the distance of others."""
_AWAY = 1.5
"""Pairs that are further than this apart may be far: between both there is time until the next look."""
KEEP = 0.2
"""Share of a pair's distance (at most of its thickness) that a substep must leave along the separating direction."""
_REFRESH = 0.25
"""Thicknesses, and twice the share of the distance, that near pairs move before their closest points are found again."""

_TURNED = 0.1
"""Radians that all turn on average before closest points are found again: directions go with the cloth, what is kept of them
does not."""

_LEAD = 4.0
"""Substeps like the next one for which far pairs should not need another look, if that is a short way."""

FAR, NEAR, TOUCHING, LEFT = 0, 1, 2, 3
"""Touching pairs have no side to keep; those left alone lie beside an intersection."""

_NOT_YET = math.nan
"""Allowed before the first look: no way is within it."""
TURN = BULK
"""Place in `Watched.bulk`."""
LOOK, OPEN, PROOF = 0, 1, 2
"""Columns of `Watched.allowed`. Beyond it: near pairs need another look; far ones may have come near; near ones are no longer
proved apart."""


class Watched(NamedTuple):
    """Pairs of a step and what is known of them; K pairs, V vertices."""

    quads: NDArray  # (K, 4) int32 vertex ids
    kinds: NDArray  # (K,) uint8
    rest: NDArray  # (K,) thickness [m]
    gaps: NDArray  # (K,) distance when measured [m]; far: at `start`, or less
    ways: NDArray  # (K,) near: how far they have moved against each other since [m]
    states: NDArray  # (K,) uint8
    weights: (
        NDArray  # (K, 4) near, and all where pairs were found: signed barycentric weights of the closest points, sum 0
    )
    separation: NDArray  # (K, 4) near: direction from the second side to the first, distance; -1 = nothing is certified
    start: NDArray  # (V, 3) where all vertices were when pairs were found [m]
    seen: NDArray  # (V, 3) where they were at the last look [m]
    links: NDArray  # (K,) int64 scratch: the next near pair of the same vertex with a triangle, -1 = none
    heads: NDArray  # (V,) int64 scratch: the first one
    moves: NDArray  # (V, 9) scratch: way since the last look, way ahead, way since the start [m]
    bulk: NDArray  # (BULK + 1,) of `seen`, and how far all have turned since then [rad]
    sizes: NDArray  # (V,) way since the last look, less what all went on average [m]; after `stir` its square
    aheads: NDArray  # (V,) scratch: way ahead, less what all go on average [m]
    allowed: NDArray  # (V, 3) [m] such ways since the last look that the pairs of each vertex can bear
    spent: NDArray  # (V,) bool scratch: far pairs of this vertex are looked at


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
def stir(p, watched):
    """Squares of the ways since the last look into `sizes`; whether near pairs need another look, far pairs need one, and near
    pairs are not proved apart. All three where a position is not finite."""
    squares = watched.sizes
    allowed = watched.allowed
    turn = squares_of_ways(p, watched.seen, watched.bulk, squares)
    watched.bulk[TURN] = turn
    near = turn <= _TURNED
    far = True
    proved = True
    for i in range(p.shape[0]):
        square = squares[i]
        near &= square <= allowed[i, LOOK] * allowed[i, LOOK]
        far &= square <= allowed[i, OPEN] * allowed[i, OPEN]
        proved &= square <= allowed[i, PROOF] * allowed[i, PROOF]
    return not near, not far, not proved


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
def _sides(sizes, quads, n, kind):
    """The greater of the sizes on either side; their sum is no less than `_relative`, and far cheaper."""
    a = sizes[np.uint64(quads[n, 0])]
    b = sizes[np.uint64(quads[n, 1])]
    c = sizes[np.uint64(quads[n, 2])]
    d = sizes[np.uint64(quads[n, 3])]
    c = c if c > d else d
    if kind == 0:
        return a, (b if b > c else c)
    return (a if a > b else b), c


@inlined
def _allow(allowed, column, quads, n, kind, room, one, two):
    """Shares out what a pair can bear among both sides: what they will move, and between a third and two thirds of the rest,
    more for the one that will move more."""
    total = one + two
    share = (one + total) / (3.0 * total) if total > 0.0 else 0.5
    share = one + share * (room - total) if room > total else share * room
    for k in range(4):
        v = np.uint64(quads[n, k])
        mine = share if k == 0 or (k == 1 and kind == 1) else room - share
        allowed[v, column] = min(allowed[v, column], mine)


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
def _begin_look(x, p, watched):
    """Ways of the vertices since the last look and ahead, and whose far pairs have to be looked at. Returns whether this is the
    first look, where pairs were found, and how far all turned since the last one [rad]."""
    moves = watched.moves
    seen = watched.seen
    start = watched.start
    sizes = watched.sizes
    aheads = watched.aheads
    allowed = watched.allowed
    spent = watched.spent
    turn = squares_of_ways(x, seen, watched.bulk, sizes)
    bulk_of(x, watched.bulk)
    squares_of_ways(p, x, watched.bulk, aheads)
    roots(sizes)
    roots(aheads)
    short = 0.5 * _REFRESH * watched.rest[0]
    first = math.isnan(allowed[0, OPEN])
    for i in range(x.shape[0]):
        # what is due within the next few substeps is not left to looks of their own
        needed = aheads[i] + min(_LEAD * aheads[i], short)
        left = allowed[i, OPEN] - sizes[i]
        spent[i] = not needed <= left
        allowed[i, OPEN] = math.inf if spent[i] else left
        allowed[i, LOOK] = math.inf
        allowed[i, PROOF] = math.inf
        for c in range(3):
            moves[i, c] = x[i, c] - seen[i, c]
            moves[i, 3 + c] = p[i, c] - x[i, c]
            moves[i, 6 + c] = x[i, c] - start[i, c]
            first &= x[i, c] == start[i, c]
            seen[i, c] = x[i, c]
    return first, turn


@bare
def look(x, p, watched, count, apart, both, leave):
    """Brings what is known of all pairs to positions x, for a substep that leads to p.

    Afterwards pairs that are not near stay further apart than 1.25 thicknesses on the straight way from x to p. Pairs beside
    an intersection (apart (V,)) are left alone with `leave`, else near without a certificate. Returns how many pairs were
    measured.
    """
    known, turn = _begin_look(x, p, watched)
    # taken out of their tuple once: in the loop, each would be counted as a reference
    moves = watched.moves
    sizes = watched.sizes
    aheads = watched.aheads
    allowed = watched.allowed
    spent = watched.spent
    quads = watched.quads
    kinds = watched.kinds
    rests = watched.rest
    gaps = watched.gaps
    ways = watched.ways
    states = watched.states
    weights = watched.weights
    separation = watched.separation
    measured = 0
    for n in range(count):
        state = states[n]
        kind = kinds[n]
        if state == FAR:
            due = spent[np.uint64(quads[n, 0])] | spent[np.uint64(quads[n, 1])]
            due |= spent[np.uint64(quads[n, 2])] | spent[np.uint64(quads[n, 3])]
            if not due:
                continue
        elif state == LEFT:
            continue
        rest = rests[n]
        one, two = _sides(aheads, quads, n, kind)
        if state == NEAR:
            gap = gaps[n]
            limit = min(_REFRESH * rest, 0.5 * gap)
            first, second = _sides(sizes, quads, n, kind)
            way = ways[n] + first + second + turn * (gap + ways[n])
            if not way <= 0.5 * limit:
                way = ways[n] + _relative(moves, quads, n, kind, 0)
            if way <= 0.5 * limit:
                ways[n] = way
                _allow(allowed, LOOK, quads, n, kind, limit - way, one, two)
                if separation[n, 3] >= 0.0:
                    _allow(allowed, PROOF, quads, n, kind, gap - way - KEEP * min(gap, rest), one, two)
                continue
        elif state == FAR:
            # it can have come nearer by no more than its sides have moved against each other since the start
            gap = gaps[n] - _relative(moves, quads, n, kind, 6)
            if gap > _AWAY * rest and gap - one - two > ACTIVE * rest:
                _allow(allowed, OPEN, quads, n, kind, gap - ACTIVE * rest, one, two)
                continue
        # what is known no longer suffices
        beside = left_apart(apart, quads, n, kind, both)
        separation[n, 3] = -1.0
        if beside and leave:
            states[n] = LEFT
            continue
        measured += 1
        gap = _measure(x, n, quads, kinds, weights, separation, known)
        ways[n] = 0.0
        if gap > _AWAY * rest and gap - one - two > ACTIVE * rest:
            states[n] = FAR
            _allow(allowed, OPEN, quads, n, kind, gap - ACTIVE * rest, one, two)
            gap -= _relative(moves, quads, n, kind, 6)  # later ways are counted from the start
        elif gap == 0.0:
            states[n] = TOUCHING
            _allow(allowed, LOOK, quads, n, kind, 0.0, one, two)
        else:
            states[n] = NEAR
            _allow(allowed, LOOK, quads, n, kind, min(_REFRESH * rest, 0.5 * gap), one, two)
            if not beside:
                separation[n, 3] = gap
                _allow(allowed, PROOF, quads, n, kind, gap - KEEP * min(gap, rest), one, two)
        gaps[n] = gap
    return measured


@bare
def _append(watched, first, count):
    """Pairs of which nothing is known but their distances at the start."""
    for n in range(first, count):
        watched.states[n] = FAR
        watched.separation[n, 3] = -1.0


@kernel
def begin(start, watched, count):
    """Pairs whose distances are known at positions `start` (V, 3), before any look."""
    watched.start[:] = start
    watched.seen[:] = start
    bulk_of(start, watched.bulk)
    watched.allowed[:] = _NOT_YET
    _append(watched, 0, count)


@kernel
def join(watched, first, count):
    """The same for pairs `first` to `count`, beside others that have been looked at."""
    _append(watched, first, count)
    for n in range(first, count):
        for k in range(4):
            watched.allowed[watched.quads[n, k], OPEN] = _NOT_YET
