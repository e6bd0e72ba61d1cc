"""Continuous tests: the first time at which a vertex meets a triangle, or two edges meet, on straight ways [Provot 1997].

The four points are coplanar at the roots of a cubic. Around each root, where the cubic lies within its rounding error, the
distance decides, by conservative advancement: a step never goes further than the distance allows. So motion that is
coplanar throughout needs no case of its own, and what is not decided after many steps counts as contact.
"""

from __future__ import annotations

import math

import numpy as np

from clothgym._jit import device, kernel
from clothgym.kernels.primitives import edge_edge_distance, vertex_triangle_distance

_STEPS = 512
_TOUCH = 1e-9
"""Distance that counts as contact, in sizes of the pair and its ways."""


@device
def _triple(p, i, q, j, r, k):
    """Determinant of row i of p, row j of q, row k of r."""
    return (
        p[i, 0] * (q[j, 1] * r[k, 2] - q[j, 2] * r[k, 1])
        - p[i, 1] * (q[j, 0] * r[k, 2] - q[j, 2] * r[k, 0])
        + p[i, 2] * (q[j, 0] * r[k, 1] - q[j, 1] * r[k, 0])
    )


@device
def _value(c, t):
    return ((c[3] * t + c[2]) * t + c[1]) * t + c[0]


@device
def _crossing(c, level, low, high):
    """Where the cubic, monotone between low and high, passes a level; a time at or before it."""
    rising = _value(c, high) > _value(c, low)
    for _ in range(60):
        middle = 0.5 * (low + high)
        if (_value(c, middle) < level) == rising:
            low = middle
        else:
            high = middle
    return low


@device
def _distance_at(points, ways, t, kind, moved):
    for n in range(4):
        for k in range(3):
            moved[n, k] = points[n, k] + t * ways[n, k]
    if kind == 1:
        return edge_edge_distance(moved, 0, 1, 2, 3)
    return vertex_triangle_distance(moved, 0, 1, 2, 3)


@device
def _advance(points, ways, kind, begin, end, threshold, touch, speed, moved):
    """First time in [begin, end] at which the distance is at most the threshold, inf = never; early rather than late."""
    t = begin
    for _ in range(_STEPS):
        gap = _distance_at(points, ways, t, kind, moved) - threshold
        if gap <= touch:
            return t
        if gap > speed * (end - t):
            return math.inf
        t += gap / speed
    return t


@device
def _first_time(points, ways, kind, eps, moved, sides, turns, c, marks):
    split = 2 if kind == 1 else 1
    speed = 0.0
    size = 0.0
    for i in range(4):
        for j in range(i + 1, 4):
            gap = 0.0
            way = 0.0
            for k in range(3):
                gap += (points[i, k] - points[j, k]) ** 2
                way += (ways[i, k] - ways[j, k]) ** 2
            size = max(size, math.sqrt(gap) + math.sqrt(way))
            if i < split <= j:
                speed = max(speed, math.sqrt(way))
    speed *= 1.0 + 1e-9
    touch = _TOUCH * (size + eps)
    if eps > 0.0:
        return _advance(points, ways, kind, 0.0, 1.0, eps, touch, speed, moved)
    for k in range(3):
        if kind == 1:
            sides[0, k] = points[1, k] - points[0, k]
            turns[0, k] = ways[1, k] - ways[0, k]
            sides[1, k] = points[3, k] - points[2, k]
            turns[1, k] = ways[3, k] - ways[2, k]
            sides[2, k] = points[2, k] - points[0, k]
            turns[2, k] = ways[2, k] - ways[0, k]
        else:
            for n in range(3):
                far = 0 if n == 0 else n + 1
                sides[n, k] = points[far, k] - points[1, k]
                turns[n, k] = ways[far, k] - ways[1, k]
    noise = 1e-14
    for n in range(3):
        length = 0.0
        for k in range(3):
            length += abs(sides[n, k]) + abs(turns[n, k])
        noise *= length
    c[0] = _triple(sides, 0, sides, 1, sides, 2)
    c[1] = _triple(turns, 0, sides, 1, sides, 2) + _triple(sides, 0, turns, 1, sides, 2)
    c[1] += _triple(sides, 0, sides, 1, turns, 2)
    c[2] = _triple(turns, 0, turns, 1, sides, 2) + _triple(turns, 0, sides, 1, turns, 2)
    c[2] += _triple(sides, 0, turns, 1, turns, 2)
    c[3] = _triple(turns, 0, turns, 1, turns, 2)
    # between these times the cubic is monotone
    marks[0] = 0.0
    count = 1
    discriminant = c[2] * c[2] - 3.0 * c[3] * c[1]
    if discriminant > 0.0:
        q = -(c[2] + math.copysign(math.sqrt(discriminant), c[2]))
        first = q / (3.0 * c[3]) if c[3] != 0.0 else math.inf
        second = c[1] / q if q != 0.0 else math.inf
        if second < first:
            first, second = second, first
        if 0.0 < first < 1.0:
            marks[count] = first
            count += 1
        if 0.0 < second < 1.0 and second > first:
            marks[count] = second
            count += 1
    marks[count] = 1.0
    for n in range(count):
        low = marks[n]
        high = marks[n + 1]
        at_low = _value(c, low)
        at_high = _value(c, high)
        begin = low
        end = high
        if abs(at_low) > noise:
            if abs(at_high) > noise and (at_high > 0.0) == (at_low > 0.0):
                continue
            begin = _crossing(c, math.copysign(noise, at_low), low, high)
        if abs(at_high) > noise:
            end = _crossing(c, math.copysign(noise, at_high), begin, high)
        # the widths of the intervals above are halved 60 times: a step of rounding in t belongs to both
        begin = max(begin - 1e-14, 0.0)
        t = _advance(points, ways, kind, begin, min(end + 1e-14, 1.0), 0.0, touch, speed, moved)
        if t <= 1.0:
            return t
    return math.inf


@kernel
def first_times(x, ways, quads, kinds, eps, times):
    """First time, as a share of the step, at which pairs come as near as `eps`; inf = not in this step.

    Args:
        x, ways: (V, 3) positions at the start [m] and straight ways within the step [m].
        quads: (N, 4) vertex ids: (vertex, triangle) for kind 0, (edge, edge) for kind 1.
        kinds: (N,) int8.
        eps: [m]; 0 = contact, to 1e-9 of the size of the pair. Never later than the true time, up to that tolerance.
        times: (N,) written.
    """
    points = np.empty((4, 3), np.float64)
    travel = np.empty((4, 3), np.float64)
    moved = np.empty((4, 3), np.float64)
    sides = np.empty((3, 3), np.float64)
    turns = np.empty((3, 3), np.float64)
    c = np.empty(4, np.float64)
    marks = np.empty(4, np.float64)
    for n in range(len(quads)):
        for i in range(4):
            for k in range(3):
                points[i, k] = x[quads[n, i], k]
                travel[i, k] = ways[quads[n, i], k]
        times[n] = _first_time(points, travel, kinds[n], eps, moved, sides, turns, c, marks)
