"""Outlines of projected sheets: how near they come to themselves while they move, and which way their loops run."""

from __future__ import annotations

import math

from clothgym._jit import bare

_PAIRS = 64
"""Pairs of edges of an outline that are looked at, per edge: an outline with more in one place is not decided."""


@bare
def _halfway(ways, i):
    return ways[i, 0] + 0.5 * ways[i, 2], ways[i, 1] + 0.5 * ways[i, 3]


@bare
def _from_edge(ways, v, i, j):
    """Distance [m] of vertex v from edge (i, j) halfway."""
    px, py = _halfway(ways, v)
    ax, ay = _halfway(ways, i)
    bx, by = _halfway(ways, j)
    bx -= ax
    by -= ay
    px -= ax
    py -= ay
    square = bx * bx + by * by
    share = (px * bx + py * by) / square if square > 0.0 else 0.0
    share = min(max(share, 0.0), 1.0)
    px -= share * bx
    py -= share * by
    return math.sqrt(px * px + py * py)


@bare
def _side(ways, i, j, v):
    """On which side of an edge's line a vertex is halfway: 1 on the left, 0 where rounding may decide."""
    ax, ay = _halfway(ways, i)
    bx, by = _halfway(ways, j)
    px, py = _halfway(ways, v)
    one = (bx - ax) * (py - ay)
    two = (by - ay) * (px - ax)
    if abs(one - two) <= 1e-14 * (abs(one) + abs(two)):
        return 0
    return 1 if one > two else -1


@bare
def _stray(ways, i, j):
    """How far two vertices move against each other, up to halfway or from there on [m]."""
    u = ways[i, 2] - ways[j, 2]
    v = ways[i, 3] - ways[j, 3]
    return 0.5 * math.sqrt(u * u + v * v)


@bare
def _edges_clear(ways, a, b, c, d):
    """Least distance [m] at any time of a vertex of edge (a, b) or (c, d) from the other edge, if it does not end there.

    From the distances halfway, less what the vertices move against each other. Edges that cross have none: if a side is
    unclear, a vertex lies on the other edge's line for all that can be told, and where such edges cross, a vertex lies on the
    other edge, too.
    """
    stray = max(max(_stray(ways, a, c), _stray(ways, a, d)), max(_stray(ways, b, c), _stray(ways, b, d)))
    joined = a == c or a == d or b == c or b == d
    if not joined:
        through = _side(ways, a, b, c) * _side(ways, a, b, d) < 0
        if through and _side(ways, c, d, a) * _side(ways, c, d, b) < 0:
            return 0.0
    least = math.inf
    if a != c and a != d:
        least = min(least, _from_edge(ways, a, c, d))
    if b != c and b != d:
        least = min(least, _from_edge(ways, b, c, d))
    if c != a and c != b:
        least = min(least, _from_edge(ways, c, a, b))
    if d != a and d != b:
        least = min(least, _from_edge(ways, d, a, b))
    return least - stray


@bare
def _interval(ways, i, j, k):
    """Interval of an edge on its way along axis k of the plane."""
    low = min(ways[i, k] + min(ways[i, 2 + k], 0.0), ways[j, k] + min(ways[j, 2 + k], 0.0))
    high = max(ways[i, k] + max(ways[i, 2 + k], 0.0), ways[j, k] + max(ways[j, 2 + k], 0.0))
    return low, high


@bare
def _sort(lows, order, spare, first, last):
    """Sorts the edges first .. last - 1 of an outline by their lower ends: runs of 1, 2, 4 ... are merged."""
    for n in range(first, last):
        order[n] = n
    run = 1
    while run < last - first:
        for begin in range(first, last, 2 * run):
            middle = min(begin + run, last)
            end = min(begin + 2 * run, last)
            one = begin
            two = middle
            for n in range(begin, end):
                if one < middle and (two >= end or lows[order[one]] <= lows[order[two]]):
                    spare[n] = order[one]
                    one += 1
                else:
                    spare[n] = order[two]
                    two += 1
        for n in range(first, last):
            order[n] = spare[n]
        run *= 2


@bare
def clearance(shapes, c, ways, radius):
    """Least distance [m], at any time, of a vertex of an outline from an edge of it that does not end there, at most 2 radius.

    Component c of shapes (`height_field.Shapes`), on its ways in the plane (`height_field.Tube`). 0 if the outline crosses
    itself, has not exactly one counter-clockwise loop, or has too many edges in one place: time is bounded by a sort.
    """
    first = shapes.border_start[c]
    last = shapes.border_start[c + 1]
    for n in range(first, last):
        shapes.lows[n] = _interval(ways, shapes.border[n, 0], shapes.border[n, 1], 0)[0]
    _sort(shapes.lows, shapes.order, shapes.spare, first, last)
    least = 2.0 * radius
    looked = 0
    for n in range(first, last):
        e = shapes.order[n]
        a = shapes.border[e, 0]
        b = shapes.border[e, 1]
        end = _interval(ways, a, b, 0)[1] + 2.0 * radius
        low, high = _interval(ways, a, b, 1)
        low -= 2.0 * radius
        high += 2.0 * radius
        m = n + 1
        while m < last and shapes.lows[shapes.order[m]] <= end:
            f = shapes.order[m]
            m += 1
            looked += 1
            other_low, other_high = _interval(ways, shapes.border[f, 0], shapes.border[f, 1], 1)
            if other_low <= high and other_high >= low:
                least = min(least, _edges_clear(ways, a, b, shapes.border[f, 0], shapes.border[f, 1]))
        if not least > 0.0 or looked > _PAIRS * (last - first):
            return 0.0
    loops = 0
    for n in range(first, last):
        loops = max(loops, shapes.loop[n] + 1)
    if loops > 1:
        for n in range(loops):
            shapes.turns[first + n] = 0.0
        for n in range(first, last):
            px, py = _halfway(ways, shapes.border[n, 0])
            qx, qy = _halfway(ways, shapes.border[n, 1])
            shapes.turns[first + shapes.loop[n]] += 0.5 * (px * qy - py * qx)
        forward = 0
        for n in range(loops):
            # a simple loop holds at least half of a disc of this radius: far from what rounding can change
            if not abs(shapes.turns[first + n]) > 0.1 * least * least:
                return 0.0
            forward += shapes.turns[first + n] > 0.0
        if forward != 1:
            return 0.0
    return least
