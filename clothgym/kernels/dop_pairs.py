"""Pairs of primitives out of pairs of faces: by ownership, each once, and in an order that no tree decides [Mezger 2003, 6].

A pair is a key: row * N + column, N columns. Kinds: 0 = vertex, face; 1 = edge, edge (row < column); 2 = edge, face. What a
key needs is that the boxes of both primitives overlap on all 13 axes of the 26-DOP. Boxes of leaves hold these on the axes that
they have, so the keys of every tree, of every k and of trying all pairs are the same ones.
"""

from __future__ import annotations

import math

import numpy as np

from clothgym._jit import device, kernel
from clothgym.kernels.primitives import closest_on_edges, closest_on_triangle


@device
def _apart(ways, p0, p1, q0, q1, q2):
    """Whether the boxes of vertices p0, p1 and of q0, q1, q2 are apart on some axis."""
    for a in range(0, ways.shape[1], 2):
        high = max(ways[p0, a + 1], ways[p1, a + 1])
        if high < ways[q0, a] and high < ways[q1, a] and high < ways[q2, a]:
            return True
        low = min(ways[p0, a], ways[p1, a])
        if low > ways[q0, a + 1] and low > ways[q1, a + 1] and low > ways[q2, a + 1]:
            return True
    return False


@device
def _ends(faces, edges, kind, row, column):
    """Vertices p0, p1 and q0, q1, q2 of a pair; fewer are repeated."""
    if kind == 0:
        return row, row, faces[column, 0], faces[column, 1], faces[column, 2]
    if kind == 1:
        return edges[row, 0], edges[row, 1], edges[column, 0], edges[column, 1], edges[column, 1]
    return edges[row, 0], edges[row, 1], faces[column, 0], faces[column, 1], faces[column, 2]


@device
def _add(ways, faces, edges, kind, row, column, columns, keys, found):
    p0, p1, q0, q1, q2 = _ends(faces, edges, kind, row, column)
    if p0 == q0 or p0 == q1 or p0 == q2 or p1 == q0 or p1 == q1 or p1 == q2 or _apart(ways, p0, p1, q0, q1, q2):
        return found
    if found < keys.shape[0]:
        keys[found] = np.int64(row) * columns + column
    return found + 1


@kernel
def expand(pairs, count, surface, ways, near, hits, points, lines, crossings, counts):
    """Keys of the pairs of primitives without a common vertex that pairs of faces own, and whose boxes overlap.

    Args:
        pairs: (C, 2) int32, the first `count` are read; each unordered pair of two faces once.
        surface: `mesh.SurfaceArrays`.
        ways: (V, 26) low, high on each axis of the 26-DOP.
        near, hits: whether vertex-face and edge-edge pairs, and whether edge-face pairs, are wanted.
        points, lines, crossings: int64 keys of kinds 0, 1, 2; as many as fit are written.
        counts: (4,) int64; the first three receive how many there are of what is wanted, the others stay.
    """
    faces = surface.faces
    edges = surface.edges
    face_edges = surface.face_edges
    face_count = faces.shape[0]
    edge_count = edges.shape[0]
    first = 0
    second = 0
    third = 0
    for n in range(count):
        for side in range(2):
            p = pairs[n, side]
            q = pairs[n, 1 - side]
            for k in range(3):
                v = faces[p, k]
                if near and surface.vertex_owner[v] == p:
                    first = _add(ways, faces, edges, 0, v, q, face_count, points, first)
                e = face_edges[p, k]
                if surface.edge_owner[e] != p:
                    continue
                if hits:
                    third = _add(ways, faces, edges, 2, e, q, face_count, crossings, third)
                if near and side == 0:
                    for m in range(3):
                        f = face_edges[q, m]
                        if surface.edge_owner[f] == q:
                            second = _add(ways, faces, edges, 1, min(e, f), max(e, f), edge_count, lines, second)
    if near:
        counts[0] = first
        counts[1] = second
    if hits:
        counts[2] = third


@kernel
def encode(pairs, count, columns, alike, keys):
    """Keys of pairs (C, 2); of pairs of one kind of primitive the smaller id comes first (alike)."""
    for n in range(count):
        row = np.int64(pairs[n, 0])
        column = np.int64(pairs[n, 1])
        if alike and column < row:
            row, column = column, row
        keys[n] = row * columns + column


@kernel
def decode(keys, count, columns, pairs):
    """Rows and columns of keys, into pairs (C, 2) int32."""
    for n in range(count):
        pairs[n, 0] = keys[n] // columns
        pairs[n, 1] = keys[n] % columns


@kernel
def keep_overlapping(kind, faces, edges, ways, pairs, count):
    """Of pairs (C, 2) those whose boxes overlap on all axes of `ways` (V, 26), moved to the front; returns how many."""
    kept = 0
    for n in range(count):
        row = pairs[n, 0]
        column = pairs[n, 1]
        p0, p1, q0, q1, q2 = _ends(faces, edges, kind, row, column)
        if not _apart(ways, p0, p1, q0, q1, q2):
            pairs[kept, 0] = row
            pairs[kept, 1] = column
            kept += 1
    return kept


@device
def _relative(u, radius, i, j):
    """What two vertices may come nearer in the step, and their radii [m]."""
    dx = u[i, 0] - u[j, 0]
    dy = u[i, 1] - u[j, 1]
    dz = u[i, 2] - u[j, 2]
    return math.sqrt(dx * dx + dy * dy + dz * dz) + radius[i] + radius[j]


@device
def _gap(x, kind, p0, p1, q0, q1, q2, w0, w1, w2):
    """Distance [m] of the points with these weights: barycentrics on the triangle, or (s, t, -) along two edges."""
    total = 0.0
    for k in range(3):
        if kind == 1:
            g = x[p0, k] + w0 * (x[p1, k] - x[p0, k]) - x[q0, k] - w1 * (x[q1, k] - x[q0, k])
        else:
            g = x[p0, k] - w0 * x[q0, k] - w1 * x[q1, k] - w2 * x[q2, k]
        total += g * g
    return math.sqrt(total)


@device
def _reach(u, radius, p0, p1, q0, q1, q2):
    """Distance now from which a pair may still come within its radii during the step [m]."""
    reach = max(_relative(u, radius, p0, q0), _relative(u, radius, p0, q1), _relative(u, radius, p0, q2))
    if p1 != p0:
        reach = max(reach, _relative(u, radius, p1, q0), _relative(u, radius, p1, q1))
    return reach * (1.0 + 1e-9)


@kernel
def measure(x, u, radius, faces, edges, kind, columns, margin, keys, weights):
    """Closest points of pairs of kind 0 or 1; those that stay apart by more than their radii and the margin [m] are dropped.

    x, u (V, 3): positions and ways [m]; radius (V,); keys (C,) int64, shortened in place; weights (C, 3) written. Returns how
    many stay.
    """
    kept = 0
    for n in range(keys.shape[0]):
        p0, p1, q0, q1, q2 = _ends(faces, edges, kind, keys[n] // columns, keys[n] % columns)
        if kind == 1:
            w0, w1 = closest_on_edges(x, p0, p1, q0, q1)
            w2 = 0.0
        else:
            w0, w1, w2 = closest_on_triangle(x, p0, q0, q1, q2)
        if _gap(x, kind, p0, p1, q0, q1, q2, w0, w1, w2) <= _reach(u, radius, p0, p1, q0, q1, q2) + margin:
            keys[kept] = keys[n]
            weights[kept, 0] = w0
            weights[kept, 1] = w1
            weights[kept, 2] = w2
            kept += 1
    return kept


@kernel
def still_near(x, u, radius, ways, faces, edges, kind, columns, keys, weights, slack, chosen):
    """Of kept pairs those whose boxes overlap now, and, for kinds 0 and 1, that may come within their radii in the step.

    weights (C, 3): of the closest points when they were computed; after a relative way of slack (C,) [m] their distance is
    above the true one by at most twice the slack. chosen (C,) int64 receives the keys; returns how many.
    """
    found = 0
    for n in range(keys.shape[0]):
        p0, p1, q0, q1, q2 = _ends(faces, edges, kind, keys[n] // columns, keys[n] % columns)
        if _apart(ways, p0, p1, q0, q1, q2):
            continue
        if kind < 2:
            gap = _gap(x, kind, p0, p1, q0, q1, q2, weights[n, 0], weights[n, 1], weights[n, 2])
            if gap > _reach(u, radius, p0, p1, q0, q1, q2) + 2.0 * slack[n]:
                continue
        chosen[found] = keys[n]
        found += 1
    return found


@kernel
def tree_size(tree, x):
    """Sum over all nodes of a `dop_traversal.Tree` of half the surface of their tight axis-parallel boxes [m^2]; x (V, 3).

    Uses the first six columns of `tree.boxes` as scratch.
    """
    boxes = tree.boxes
    total = 0.0
    for node in range(len(tree.child_count) - 1, -1, -1):
        for k in range(3):
            low = math.inf
            high = -math.inf
            if tree.child_count[node] == 0:
                for n in range(4):
                    at = x[tree.corners[tree.node_face[node], n], k]
                    low = min(low, at)
                    high = max(high, at)
            else:
                for child in range(tree.child_start[node], tree.child_start[node] + tree.child_count[node]):
                    low = min(low, boxes[child, 2 * k])
                    high = max(high, boxes[child, 2 * k + 1])
            boxes[node, 2 * k] = low
            boxes[node, 2 * k + 1] = high
        dx = boxes[node, 1] - boxes[node, 0]
        dy = boxes[node, 3] - boxes[node, 2]
        dz = boxes[node, 5] - boxes[node, 4]
        total += dx * dy + dy * dz + dz * dx
    return total


@kernel
def leaf_size(ids, leaves, x):
    """The same for the leaves of `clusters.Clusters`: ids (B, 4, 16), of which the first `leaves` blocks hold faces."""
    total = 0.0
    side = np.empty(3, np.float64)
    for block in range(leaves):
        for k in range(3):
            low = math.inf
            high = -math.inf
            for n in range(ids.shape[2]):
                if ids[block, 0, n] < 0:
                    break
                for corner in range(1, 4):
                    at = x[ids[block, corner, n], k]
                    low = min(low, at)
                    high = max(high, at)
            side[k] = high - low
        total += side[0] * side[1] + side[1] * side[2] + side[2] * side[0]
    return total
