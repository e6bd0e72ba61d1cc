"""Exact distances of the primitives of two objects, or of one with itself: what a hierarchy's leaf pairs are for.

Kinds: 0 = (vertex of a; triangle of b), 1 = (edge of a; edge of b), 2 = (vertex of b; triangle of a), 3 = (virtual particle
of a; triangle of b), 4 = the same the other way. An object with itself has kinds 0, 1 and 3 only.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.primitives import closest_on_edges, closest_on_triangle

VERTEX_TRIANGLE, EDGE_EDGE, TRIANGLE_VERTEX, PARTICLE_TRIANGLE, TRIANGLE_PARTICLE = range(5)


class Shape(NamedTuple):
    """An object as the exact tests see it; polygon p has the triangles triangle_start[p] to triangle_start[p + 1]."""

    x: NDArray[np.float64]  # (V, 3) [m]
    d: NDArray[np.float64]  # (V, 3) way within the step [m]
    faces: NDArray[np.int32]  # (T, 3)
    edges: NDArray[np.int32]  # (E, 2)
    face_edges: NDArray[np.int32]  # (T, 3)
    vertex_owner: NDArray[np.int32]  # (V,)
    edge_owner: NDArray[np.int32]  # (E,)
    triangle_start: NDArray[np.int64]  # (P + 1,)


class Reports(NamedTuple):
    """What is found, C rows."""

    quads: NDArray[np.int32]  # (C, 4) kinds 0, 2: vertex, corners; 1: two edges' ends; 3, 4: face, particle, face, -1
    kinds: NDArray[np.int8]  # (C,)
    weights: NDArray[np.float64]  # (C, 3) barycentrics on the triangle, or (s, t, 0) of two edges
    distances: NDArray[np.float64]  # (C,) [m] at the positions x
    polygons: NDArray[np.int32]  # (C, 2) of a and of b


@device
def _load(points, row, x, i):
    points[row, 0] = x[i, 0]
    points[row, 1] = x[i, 1]
    points[row, 2] = x[i, 2]


@device
def _relative(d, i, e, j):
    dx = d[i, 0] - e[j, 0]
    dy = d[i, 1] - e[j, 1]
    dz = d[i, 2] - e[j, 2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@device
def _apart(points, split, rows, reach):
    """Whether the boxes of points[:split] and points[split:rows] are more than the reach apart."""
    for k in range(3):
        low = points[0, k]
        high = low
        for n in range(1, split):
            low = min(low, points[n, k])
            high = max(high, points[n, k])
        far_low = points[split, k]
        far_high = far_low
        for n in range(split + 1, rows):
            far_low = min(far_low, points[n, k])
            far_high = max(far_high, points[n, k])
        if low - reach > far_high or far_low - reach > high:
            return True
    return False


@device
def _gap(points, w0, w1, w2, kind):
    """Distance for the stored weights of a pair in points: vertex then triangle, or two edges."""
    total = 0.0
    for k in range(3):
        if kind == EDGE_EDGE:
            g = points[0, k] + w0 * (points[1, k] - points[0, k]) - points[2, k] - w1 * (points[3, k] - points[2, k])
        else:
            g = points[0, k] - w0 * points[1, k] - w1 * points[2, k] - w2 * points[3, k]
        total += g * g
    return math.sqrt(total)


@device
def _write(out, n, q0, q1, q2, q3):
    if n < len(out.kinds):
        out.quads[n, 0] = q0
        out.quads[n, 1] = q1
        out.quads[n, 2] = q2
        out.quads[n, 3] = q3


@device
def _measured(out, n, kind, w0, w1, w2, distance, pairs, row):
    if n < len(out.kinds):
        out.kinds[n] = kind
        out.weights[n, 0] = w0
        out.weights[n, 1] = w1
        out.weights[n, 2] = w2
        out.distances[n] = distance
        out.polygons[n, 0] = pairs[row, 0]
        out.polygons[n, 1] = pairs[row, 1]
    return n + 1


@kernel
def find_vertices(a, b, flip, same, eps, margin, kind, samples, pairs, found, out):
    """Vertices, or virtual particles, of a that are nearer to triangles of b than eps + max(margin, relative way) [m].

    Args:
        a, b: `Shape`; the same one twice where `same` is set: then a call with flip = 0 and one with 1 find all.
        flip: column of `pairs` that holds the polygons of a.
        eps, margin: [m].
        kind: what is reported; particles for the last two.
        samples: (S, 3) barycentrics of the particles of a triangle.
        pairs: (C, 2) polygons.
        found: reports that `out` holds already; `out` is filled as far as it goes.

    Returns:
        Reports now, and distances computed.
    """
    points = np.empty((4, 3), np.float64)
    tests = 0
    particles = kind >= PARTICLE_TRIANGLE
    count = len(samples) if particles else 3
    for row in range(len(pairs)):
        p = pairs[row, flip]
        q = pairs[row, 1 - flip]
        if same == 1 and p == q and flip == 1:
            continue
        for t in range(a.triangle_start[p], a.triangle_start[p + 1]):
            for u in range(b.triangle_start[q], b.triangle_start[q + 1]):
                if same == 1 and t == u:
                    continue
                i, j, k = b.faces[u, 0], b.faces[u, 1], b.faces[u, 2]
                _load(points, 1, b.x, i)
                _load(points, 2, b.x, j)
                _load(points, 3, b.x, k)
                for source in range(count):
                    v = a.faces[t, source % 3]
                    if particles:
                        travel = 0.0
                        for axis in range(3):
                            points[0, axis] = 0.0
                            for corner in range(3):
                                points[0, axis] += samples[source, corner] * a.x[a.faces[t, corner], axis]
                            for corner in range(3):
                                travel = max(travel, _relative(a.d, a.faces[t, axis], b.d, b.faces[u, corner]))
                    else:
                        if a.vertex_owner[v] != t or (same == 1 and (v == i or v == j or v == k)):
                            continue
                        _load(points, 0, a.x, v)
                        travel = _relative(a.d, v, b.d, i)
                        travel = max(travel, _relative(a.d, v, b.d, j), _relative(a.d, v, b.d, k))
                    reach = eps + max(margin, travel * (1.0 + 1e-12))
                    if _apart(points, 1, 4, reach):
                        continue
                    tests += 1
                    w0, w1, w2 = closest_on_triangle(points, 0, 1, 2, 3)
                    distance = _gap(points, w0, w1, w2, kind)
                    if distance < reach:
                        if particles:
                            _write(out, found, t, source, u, -1)
                        else:
                            _write(out, found, v, i, j, k)
                        found = _measured(out, found, kind, w0, w1, w2, distance, pairs, row)
    return found, tests


@kernel
def find_edges(a, b, same, eps, margin, pairs, found, out):
    """Edges of a and of b nearer than eps + max(margin, relative way) [m]; arguments and answer as `find_vertices`."""
    points = np.empty((4, 3), np.float64)
    tests = 0
    for row in range(len(pairs)):
        p = pairs[row, 0]
        q = pairs[row, 1]
        for t in range(a.triangle_start[p], a.triangle_start[p + 1]):
            for u in range(b.triangle_start[q], b.triangle_start[q + 1]):
                if same == 1 and p == q and u <= t:
                    continue
                for n in range(9):
                    e = a.face_edges[t, n // 3]
                    f = b.face_edges[u, n % 3]
                    if a.edge_owner[e] != t or b.edge_owner[f] != u:
                        continue
                    g, h = (f, e) if same == 1 and f < e else (e, f)
                    a0, a1, b0, b1 = a.edges[g, 0], a.edges[g, 1], b.edges[h, 0], b.edges[h, 1]
                    if same == 1 and (a0 == b0 or a0 == b1 or a1 == b0 or a1 == b1):
                        continue
                    _load(points, 0, a.x, a0)
                    _load(points, 1, a.x, a1)
                    _load(points, 2, b.x, b0)
                    _load(points, 3, b.x, b1)
                    travel = max(_relative(a.d, a0, b.d, b0), _relative(a.d, a0, b.d, b1))
                    travel = max(travel, _relative(a.d, a1, b.d, b0), _relative(a.d, a1, b.d, b1))
                    reach = eps + max(margin, travel * (1.0 + 1e-12))
                    if _apart(points, 2, 4, reach):
                        continue
                    tests += 1
                    w0, w1 = closest_on_edges(points, 0, 1, 2, 3)
                    distance = _gap(points, w0, w1, 0.0, EDGE_EDGE)
                    if distance < reach:
                        _write(out, found, a0, a1, b0, b1)
                        found = _measured(out, found, EDGE_EDGE, w0, w1, 0.0, distance, pairs, row)
    return found, tests


@kernel
def refresh(a, b, eps, slack, reports, near):
    """Distances (C,) of stored pairs from their stored weights, and whether each may come within eps in the step (uint8).

    The stored weights are no longer those of the closest points: after a relative way of slack (C,) [m] the distance is above
    the true one by at most twice the slack.
    """
    points = np.empty((4, 3), np.float64)
    for n in range(len(near)):
        kind = reports.kinds[n]
        split = 2 if kind == EDGE_EDGE else 1
        travel = 0.0
        for k in range(4):
            turned = kind == TRIANGLE_VERTEX
            if (k < split) != turned:
                _load(points, k, a.x, reports.quads[n, k])
            else:
                _load(points, k, b.x, reports.quads[n, k])
        for i in range(split):
            for j in range(split, 4):
                if kind == TRIANGLE_VERTEX:
                    travel = max(travel, _relative(b.d, reports.quads[n, i], a.d, reports.quads[n, j]))
                else:
                    travel = max(travel, _relative(a.d, reports.quads[n, i], b.d, reports.quads[n, j]))
        distance = _gap(points, reports.weights[n, 0], reports.weights[n, 1], reports.weights[n, 2], kind)
        reports.distances[n] = distance
        near[n] = 1 if distance < eps + travel + 2.0 * slack[n] else 0
