"""Pairs of primitives that are near, or may come near within a step: vertex-triangle and edge-edge.

Candidates are pairs of ids whose boxes overlap (`cluster_pairs.overlapping_pairs`). Pairs for contact are "quads" of four
vertex ids: kind 0 is (v, a, b, c), kind 1 is (a0, a1, b0, b1).
"""

from __future__ import annotations

import math

import numpy as np

from clothgym._jit import inlined, kernel
from clothgym.kernels.primitives import (
    closest_on_edges,
    closest_on_triangle,
    edge_edge_distance,
    vertex_triangle_distance,
)


@inlined
def travel(u, i, j):
    """How far vertices i and j are from each other in u (V, 3)."""
    dx = u[i, 0] - u[j, 0]
    dy = u[i, 1] - u[j, 1]
    dz = u[i, 2] - u[j, 2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@inlined
def _emit(quads, kinds, rest, gaps, weights, found, ids, kind, thickness, gap, closest):
    if found < quads.shape[0]:
        for k in range(4):
            quads[found, k] = ids[k]
            weights[found, k] = closest[k]
        kinds[found] = kind
        rest[found] = thickness
        gaps[found] = gap
    return found + 1


@inlined
def _vertex_triangle_apart(x, v, a, b, c, reach):
    """Whether the plane, or one across the line from the triangle's centre to the vertex, keeps both further apart than `reach`
    [m], by a safe margin. Spares most pairs their closest points."""
    ux = x[b, 0] - x[a, 0]
    uy = x[b, 1] - x[a, 1]
    uz = x[b, 2] - x[a, 2]
    wx = x[c, 0] - x[a, 0]
    wy = x[c, 1] - x[a, 1]
    wz = x[c, 2] - x[a, 2]
    px = x[v, 0] - x[a, 0]
    py = x[v, 1] - x[a, 1]
    pz = x[v, 2] - x[a, 2]
    mx = 3.0 * px - ux - wx
    my = 3.0 * py - uy - wy
    mz = 3.0 * pz - uz - wz
    size = abs(ux) + abs(uy) + abs(uz) + abs(wx) + abs(wy) + abs(wz) + abs(px) + abs(py) + abs(pz)
    far = reach * (1.0 + 1e-9) + 1e-12 * size
    far *= far
    high = mx * ux + my * uy + mz * uz
    other = mx * wx + my * wy + mz * wz
    high = high if high > other else other
    high = high if high > 0.0 else 0.0
    gap = mx * px + my * py + mz * pz - high
    across = (gap > 0.0) & (gap * gap > far * (mx * mx + my * my + mz * mz))
    nx = uy * wz - uz * wy
    ny = uz * wx - ux * wz
    nz = ux * wy - uy * wx
    gap = nx * px + ny * py + nz * pz
    nn = nx * nx + ny * ny + nz * nz
    return across | ((gap * gap > far * nn) & (nn > 1e-12 * size * size * size * size))


@inlined
def _edges_apart(x, a0, a1, b0, b1, reach):
    """The same for two edges: across the line of their middles, or by the distance of their lines."""
    ux = x[a1, 0] - x[a0, 0]
    uy = x[a1, 1] - x[a0, 1]
    uz = x[a1, 2] - x[a0, 2]
    wx = x[b1, 0] - x[b0, 0]
    wy = x[b1, 1] - x[b0, 1]
    wz = x[b1, 2] - x[b0, 2]
    px = x[b0, 0] - x[a0, 0]
    py = x[b0, 1] - x[a0, 1]
    pz = x[b0, 2] - x[a0, 2]
    mx = 2.0 * px + wx - ux
    my = 2.0 * py + wy - uy
    mz = 2.0 * pz + wz - uz
    size = abs(ux) + abs(uy) + abs(uz) + abs(wx) + abs(wy) + abs(wz) + abs(px) + abs(py) + abs(pz)
    far = reach * (1.0 + 1e-9) + 1e-12 * size
    far *= far
    high = mx * ux + my * uy + mz * uz
    low = mx * wx + my * wy + mz * wz
    high = high if high > 0.0 else 0.0
    low = low if low < 0.0 else 0.0
    gap = mx * px + my * py + mz * pz + low - high
    across = (gap > 0.0) & (gap * gap > far * (mx * mx + my * my + mz * mz))
    nx = uy * wz - uz * wy
    ny = uz * wx - ux * wz
    nz = ux * wy - uy * wx
    gap = nx * px + ny * py + nz * pz
    nn = nx * nx + ny * ny + nz * nz
    return across | ((gap * gap > far * nn) & (nn > 1e-12 * size * size * size * size))


@inlined
def _closest_on_edges(x, a0, a1, b0, b1):
    """`primitives.closest_on_edges` and their distance to the last bit, without branches but for edges that are nearly parallel
    or points."""
    ux = x[a1, 0] - x[a0, 0]
    uy = x[a1, 1] - x[a0, 1]
    uz = x[a1, 2] - x[a0, 2]
    vx = x[b1, 0] - x[b0, 0]
    vy = x[b1, 1] - x[b0, 1]
    vz = x[b1, 2] - x[b0, 2]
    rx = x[a0, 0] - x[b0, 0]
    ry = x[a0, 1] - x[b0, 1]
    rz = x[a0, 2] - x[b0, 2]
    a = ux * ux + uy * uy + uz * uz
    e = vx * vx + vy * vy + vz * vz
    f = vx * rx + vy * ry + vz * rz
    c = ux * rx + uy * ry + uz * rz
    b = ux * vx + uy * vy + uz * vz
    denominator = a * e - b * b
    if not denominator > 1e-6 * a * e:
        s, t = closest_on_edges(x, a0, a1, b0, b1)
        return s, t, edge_edge_distance(x, a0, a1, b0, b1)
    s = (b * f - c * e) / denominator
    s = s if s > 0.0 else 0.0
    s = s if s < 1.0 else 1.0
    free = (b * s + f) / e
    t = free if free > 0.0 else 0.0
    t = t if t < 1.0 else 1.0
    other = (b * t - c) / a
    other = other if other > 0.0 else 0.0
    other = other if other < 1.0 else 1.0
    s = s if t == free else other
    dx = x[a0, 0] + s * ux - x[b0, 0] - t * vx
    dy = x[a0, 1] + s * uy - x[b0, 1] - t * vy
    dz = x[a0, 2] + s * uz - x[b0, 2] - t * vz
    return s, t, math.sqrt(dx * dx + dy * dy + dz * dz)


@inlined
def _edge_edge_distance(x, a0, a1, b0, b1):
    """Distance [m] of two edges."""
    return _closest_on_edges(x, a0, a1, b0, b1)[2]


@inlined
def face_pair(x, u, thickness, slack, v, a, b, c, found, quads, kinds, rest, gaps, weights):
    """Writes vertex v and triangle (a, b, c) as pair `found` if they can come within their thickness, see `gather_quads`;
    returns how many pairs there are then."""
    least = min(thickness[v], thickness[a], thickness[b], thickness[c])
    reach = least + slack[v]
    reach += max(travel(u, v, a) + slack[a], travel(u, v, b) + slack[b], travel(u, v, c) + slack[c])
    if _vertex_triangle_apart(x, v, a, b, c, reach):
        return found
    wa, wb, wc = closest_on_triangle(x, v, a, b, c)
    dx = x[v, 0] - wa * x[a, 0] - wb * x[b, 0] - wc * x[c, 0]
    dy = x[v, 1] - wa * x[a, 1] - wb * x[b, 1] - wc * x[c, 1]
    dz = x[v, 2] - wa * x[a, 2] - wb * x[b, 2] - wc * x[c, 2]
    gap = math.sqrt(dx * dx + dy * dy + dz * dz)
    if gap <= reach:
        ids = (np.uint64(v), np.uint64(a), np.uint64(b), np.uint64(c))
        found = _emit(quads, kinds, rest, gaps, weights, found, ids, 0, least, gap, (1.0, -wa, -wb, -wc))
    return found


@inlined
def edge_pair(x, u, thickness, slack, a0, a1, b0, b1, found, quads, kinds, rest, gaps, weights):
    """The same for edges (a0, a1) and (b0, b1)."""
    least = min(thickness[a0], thickness[a1], thickness[b0], thickness[b1])
    reach = least + max(
        slack[a0] + max(travel(u, a0, b0) + slack[b0], travel(u, a0, b1) + slack[b1]),
        slack[a1] + max(travel(u, a1, b0) + slack[b0], travel(u, a1, b1) + slack[b1]),
    )
    if _edges_apart(x, a0, a1, b0, b1, reach):
        return found
    s, t, gap = _closest_on_edges(x, a0, a1, b0, b1)
    if gap <= reach:
        ids = (np.uint64(a0), np.uint64(a1), np.uint64(b0), np.uint64(b1))
        found = _emit(quads, kinds, rest, gaps, weights, found, ids, 1, least, gap, (1.0 - s, s, -(1.0 - t), -t))
    return found


@kernel
def gather_quads(x, u, faces, edges, thickness, slack, vertex_face, edge_edge, quads, kinds, rest, gaps, weights):
    """Pairs of primitives that can come within their thickness while every vertex moves by u, within its slack [m].

    x, u (V, 3): positions and expected displacements; thickness, slack (V,); vertex_face (C, 2) and edge_edge (C, 2): pairs of
    primitives whose swept, inflated boxes overlap. Returns the number found; as many as fit into quads (K, 4) are written, with
    their kinds, thickness and distance (K,) and the signed weights (K, 4) of their closest points at x.

    A pair stays if its distance now is within thickness + relative travel + slack.
    """
    found = 0
    for n in range(vertex_face.shape[0]):
        v = np.uint64(vertex_face[n, 0])
        face = np.uint64(vertex_face[n, 1])
        a, b, c = np.uint64(faces[face, 0]), np.uint64(faces[face, 1]), np.uint64(faces[face, 2])
        found = face_pair(x, u, thickness, slack, v, a, b, c, found, quads, kinds, rest, gaps, weights)
    for n in range(edge_edge.shape[0]):
        e = np.uint64(edge_edge[n, 0])
        f = np.uint64(edge_edge[n, 1])
        a0, a1, b0, b1 = np.uint64(edges[e, 0]), np.uint64(edges[e, 1]), np.uint64(edges[f, 0]), np.uint64(edges[f, 1])
        found = edge_pair(x, u, thickness, slack, a0, a1, b0, b1, found, quads, kinds, rest, gaps, weights)
    return found


@kernel
def keep_near(x, faces, edges, distance, vertex_face, edge_edge, counts, point_gaps, line_gaps):
    """Of candidate pairs those closer than `distance` [m], moved to the front with their distances.

    vertex_face (C, 2) vertex and face, edge_edge (C, 2) edge ids, counts (4,) how many there are; afterwards counts[0] and
    counts[1] say how many stayed.

    Whether a pair stays is added instead of branched on: it is as good as random. Ids are unsigned: no look for negative ones.
    """
    left = 0
    for n in range(counts[0]):
        v = np.uint64(vertex_face[n, 0])
        f = np.uint64(vertex_face[n, 1])
        a, b, c = np.uint64(faces[f, 0]), np.uint64(faces[f, 1]), np.uint64(faces[f, 2])
        vertex_face[left, 0] = v
        vertex_face[left, 1] = f
        left += not _vertex_triangle_apart(x, v, a, b, c, distance)
    kept = 0
    for n in range(left):
        v = np.uint64(vertex_face[n, 0])
        f = np.uint64(vertex_face[n, 1])
        d = vertex_triangle_distance(x, v, np.uint64(faces[f, 0]), np.uint64(faces[f, 1]), np.uint64(faces[f, 2]))
        vertex_face[kept, 0] = v
        vertex_face[kept, 1] = f
        point_gaps[kept] = d
        kept += d < distance
    counts[0] = kept
    kept = 0
    for n in range(counts[1]):
        p = np.uint64(edge_edge[n, 0])
        q = np.uint64(edge_edge[n, 1])
        e = p if p < q else q
        f = q if p < q else p
        a0, a1, b0, b1 = np.uint64(edges[e, 0]), np.uint64(edges[e, 1]), np.uint64(edges[f, 0]), np.uint64(edges[f, 1])
        d = _edge_edge_distance(x, a0, a1, b0, b1)
        edge_edge[kept, 0] = e
        edge_edge[kept, 1] = f
        line_gaps[kept] = d
        kept += d < distance
    counts[1] = kept


@kernel
def arrange(pairs, gaps, starts, names, rows, distances):
    """Sorts pairs with their distances by both ids into rows (P, 2) or (P, 4) and distances (P,), and names the ids.

    pairs (C, 2), gaps (C,): the first P count. names: (F, 1) the name of each second id, or (E, 2) names of both ids. One
    bucket for each first id, then insertion, since a bucket holds few; starts (N + 2,) is scratch, N the number of first ids.
    """
    count = rows.shape[0]
    starts[:] = 0
    for n in range(count):
        starts[pairs[n, 0] + 2] += 1
    for n in range(2, starts.shape[0]):
        starts[n] += starts[n - 1]
    for n in range(count):
        place = starts[pairs[n, 0] + 1]
        starts[pairs[n, 0] + 1] += 1
        rows[place, 0] = pairs[n, 0]
        rows[place, 1] = pairs[n, 1]
        distances[place] = gaps[n]
    for n in range(1, count):
        first = rows[n, 0]
        second = rows[n, 1]
        gap = distances[n]
        place = n
        while place > 0 and rows[place - 1, 0] == first and rows[place - 1, 1] > second:
            rows[place, 1] = rows[place - 1, 1]
            distances[place] = distances[place - 1]
            place -= 1
        rows[place, 1] = second
        distances[place] = gap
    if names.shape[1] == 1:
        for n in range(count):
            rows[n, 1] = names[rows[n, 1], 0]
    else:
        for n in range(count):
            e = rows[n, 0]
            f = rows[n, 1]
            rows[n, 0] = names[e, 0]
            rows[n, 1] = names[e, 1]
            rows[n, 2] = names[f, 0]
            rows[n, 3] = names[f, 1]


@kernel
def every_pair(ways, first, second, pairs):
    """Pairs of primitives without a common vertex whose boxes overlap, tried one by one.

    ways (V, 6): box of each vertex as low, high of each axis; first (N, 1 or 2), second (M, 2 or 3): vertex ids; the same
    array twice gives each pair once. As many as fit into pairs (C, 2) are written; returns how many there are.
    """
    same = first.shape[1] == second.shape[1]
    found = 0
    low = np.empty((second.shape[0], 3), np.float64)
    high = np.empty((second.shape[0], 3), np.float64)
    for n in range(second.shape[0]):
        for k in range(3):
            low[n, k] = ways[second[n, 0], 2 * k]
            high[n, k] = ways[second[n, 0], 2 * k + 1]
            for corner in range(1, second.shape[1]):
                low[n, k] = min(low[n, k], ways[second[n, corner], 2 * k])
                high[n, k] = max(high[n, k], ways[second[n, corner], 2 * k + 1])
    for n in range(first.shape[0]):
        v = first[n, 0]
        w = first[n, first.shape[1] - 1]
        for m in range(n + 1 if same else 0, second.shape[0]):
            apart = False
            for k in range(3):
                if max(ways[v, 2 * k + 1], ways[w, 2 * k + 1]) < low[m, k]:
                    apart = True
                if min(ways[v, 2 * k], ways[w, 2 * k]) > high[m, k]:
                    apart = True
            for corner in range(second.shape[1]):
                if second[m, corner] == v or second[m, corner] == w:
                    apart = True
            if not apart:
                if found < pairs.shape[0]:
                    pairs[found, 0] = n
                    pairs[found, 1] = m
                found += 1
    return found
