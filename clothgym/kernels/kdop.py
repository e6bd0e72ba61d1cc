"""k-DOPs: intervals along k/2 axes [Mezger 2003, 3.1], and the refit of a hierarchy of them (eq. 2).

Intervals are unnormalised (n . p with components of n in {-1, 0, 1}), so an inflation by a distance d widens an
interval by |n| d: the paper's eps/2 holds for unit normals only and would miss proximities on the diagonal axes.
"""

from __future__ import annotations

import math

import numpy as np

from clothgym._jit import device, kernel

_SIX = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
_EIGHT = [(1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)]
_TWELVE = [(1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1), (0, 1, 1), (0, 1, -1)]

AXES: dict[int, np.ndarray] = {
    6: np.array(_SIX, np.float64),
    8: np.array(_EIGHT, np.float64),
    14: np.array(_SIX + _EIGHT, np.float64),
    18: np.array(_SIX + _TWELVE, np.float64),
    26: np.array(_SIX + _EIGHT + _TWELVE, np.float64),
}
"""Axes (k/2, 3) of each k-DOP, the three main axes first: they reject soonest."""


@kernel
def vertex_intervals(start, end, axes, axis_lengths, radius, intervals):
    """Interval of each vertex on its way from `start` to `end`, widened by its own radius [m].

    Shapes: start, end (V, 3); axes (A, 3); axis_lengths (A,); radius (V,) or (1,) for all; intervals (V, 2 A) as low, high,
    low, high, ...
    """
    for v in range(start.shape[0]):
        for a in range(axes.shape[0]):
            p = axes[a, 0] * start[v, 0] + axes[a, 1] * start[v, 1] + axes[a, 2] * start[v, 2]
            q = axes[a, 0] * end[v, 0] + axes[a, 1] * end[v, 1] + axes[a, 2] * end[v, 2]
            pad = radius[v if radius.shape[0] > 1 else 0] * axis_lengths[a]
            intervals[v, 2 * a] = min(p, q) - pad
            intervals[v, 2 * a + 1] = max(p, q) + pad


@kernel
def refit(child_start, child_count, node_face, faces, intervals, boxes):
    """Boxes of all nodes, leaves from the intervals of their vertices, parents from their children [Mezger 2003, eq. 2].

    Nodes are stored breadth-first, so one reversed pass meets children before parents. Shapes: child_start,
    child_count, node_face (N,); faces (F, 3); intervals (V, 2 A); boxes (N, 2 A).
    """
    width = boxes.shape[1]
    for node in range(boxes.shape[0] - 1, -1, -1):
        face = node_face[node]
        if face >= 0:
            i = faces[face, 0]
            j = faces[face, 1]
            k = faces[face, 2]
            for a in range(0, width, 2):
                boxes[node, a] = min(intervals[i, a], intervals[j, a], intervals[k, a])
                boxes[node, a + 1] = max(intervals[i, a + 1], intervals[j, a + 1], intervals[k, a + 1])
        else:
            first = child_start[node]
            for a in range(0, width, 2):
                low = boxes[first, a]
                high = boxes[first, a + 1]
                for child in range(first + 1, first + child_count[node]):
                    low = min(low, boxes[child, a])
                    high = max(high, boxes[child, a + 1])
                boxes[node, a] = low
                boxes[node, a + 1] = high


_MARGIN = 2.0**-20
"""Of intervals in single precision, coordinates being 0 .. 1: more than all roundings on the way there."""


@device
def _frame(start, end, radius, origin):
    """Writes the low corner of the box of all ways, halved, to origin (3,); returns the scale that makes it 0 .. 1.

    Halves keep differences of the largest numbers finite.
    """
    same = radius.shape[0] == 1
    extent = 0.0
    for k in range(3):
        low = math.inf
        high = -math.inf
        for v in range(start.shape[0]):
            pad = radius[0 if same else v]
            p = start[v, k]
            q = end[v, k]
            low = min(low, 0.5 * min(p, q) - 0.5 * pad)
            high = max(high, 0.5 * max(p, q) + 0.5 * pad)
        origin[k] = low
        extent = max(extent, high - low)
    return 1.0 / max(extent, 1e-290)


@device
def _vertex_ways(start, end, radius, axes, axis_lengths, origin, scale, ways):
    """Intervals of each vertex in single precision, with a margin: what overlaps in exact numbers overlaps here."""
    same = radius.shape[0] == 1
    for v in range(start.shape[0]):
        pad = 0.5 * radius[0 if same else v]
        px = (0.5 * start[v, 0] - origin[0]) * scale
        py = (0.5 * start[v, 1] - origin[1]) * scale
        pz = (0.5 * start[v, 2] - origin[2]) * scale
        qx = (0.5 * end[v, 0] - origin[0]) * scale
        qy = (0.5 * end[v, 1] - origin[1]) * scale
        qz = (0.5 * end[v, 2] - origin[2]) * scale
        for a in range(axes.shape[0]):
            p = axes[a, 0] * px + axes[a, 1] * py + axes[a, 2] * pz
            q = axes[a, 0] * qx + axes[a, 1] * qy + axes[a, 2] * qz
            wide = pad * axis_lengths[a] * scale + _MARGIN
            row = 6 * (a // 3) + a % 3
            ways[v, row] = np.float32((p if p < q else q) - wide)
            ways[v, row + 3] = np.float32((p if p > q else q) + wide)


@device
def _shapes(x, origin, scale, clusters):
    """Planes of faces, starts and ways of edges, places of vertices in single precision, from coordinates 0 .. 1.

    Ways are differences of doubles, so that their direction is as good as their own digits. The plane of a face that is
    next to nothing or to a line is 0 n = 0, which keeps nothing away.
    """
    ids = clusters.ids
    shapes = clusters.shapes
    half = 0.5 * scale
    faces = np.int64(clusters.edge_start[0])
    edges = np.int64(clusters.vertex_start[0])
    for b in range(np.int64(clusters.vertex_start[clusters.vertex_start.shape[0] - 1])):
        for n in range(16):
            i = ids[b, 1, n]
            if i < 0:
                break
            px = (0.5 * x[i, 0] - origin[0]) * scale
            py = (0.5 * x[i, 1] - origin[1]) * scale
            pz = (0.5 * x[i, 2] - origin[2]) * scale
            j = ids[b, 2, n]
            ux = half * (x[j, 0] - x[i, 0])
            uy = half * (x[j, 1] - x[i, 1])
            uz = half * (x[j, 2] - x[i, 2])
            if b < faces:
                k = ids[b, 3, n]
                wx = half * (x[k, 0] - x[i, 0])
                wy = half * (x[k, 1] - x[i, 1])
                wz = half * (x[k, 2] - x[i, 2])
                nx = uy * wz - uz * wy
                ny = uz * wx - ux * wz
                nz = ux * wy - uy * wx
                size = math.sqrt(nx * nx + ny * ny + nz * nz)
                long = max(ux * ux + uy * uy + uz * uz, wx * wx + wy * wy + wz * wz)
                inverse = 1.0 / size if size > 1e-6 * long and size > 1e-30 else 0.0
                shapes[b, 0, n] = np.float32(inverse * nx)
                shapes[b, 1, n] = np.float32(inverse * ny)
                shapes[b, 2, n] = np.float32(inverse * nz)
                shapes[b, 3, n] = np.float32(inverse * (nx * px + ny * py + nz * pz))
                continue
            shapes[b, 0, n] = np.float32(px)
            shapes[b, 1, n] = np.float32(py)
            shapes[b, 2, n] = np.float32(pz)
            if b < edges:
                shapes[b, 3, n] = np.float32(ux)
                shapes[b, 4, n] = np.float32(uy)
                shapes[b, 5, n] = np.float32(uz)


@kernel
def refit_clusters(start, end, radius, still, axes, axis_lengths, clusters, ways):
    """Boxes of `clusters.Clusters` around their primitives on the way from `start` to `end` (V, 3) [Mezger 2003, eq. 2].

    radius (V,) or (1,) for all [m] widens them; axes (A, 3), A a multiple of three, axis_lengths (A,); ways (V, 2 A) is
    scratch. still: start is end and radius one for all; then the shapes of the primitives are written too, and twice the
    radius is returned in units of the boxes, otherwise -1.
    """
    origin = np.empty(3, np.float64)
    scale = _frame(start, end, radius, origin)
    _vertex_ways(start, end, radius, axes, axis_lengths, origin, scale, ways)
    if still:
        _shapes(start, origin, scale, clusters)
    boxes = clusters.boxes
    ids = clusters.ids
    leaves = clusters.edge_start.shape[0] - 1
    for row in range(0, boxes.shape[1], 6):
        for b in range(leaves):
            for n in range(16):
                i = ids[b, 1, n]
                if i < 0:
                    break
                j = ids[b, 2, n]
                k = ids[b, 3, n]
                for r in range(row, row + 3):
                    low = ways[i, r]
                    high = ways[i, r + 3]
                    p = ways[j, r]
                    q = ways[j, r + 3]
                    low = p if p < low else low
                    high = q if q > high else high
                    p = ways[k, r]
                    q = ways[k, r + 3]
                    boxes[b, r, n] = p if p < low else low
                    boxes[b, r + 3, n] = q if q > high else high
        for b in range(leaves, np.int64(clusters.vertex_start[leaves])):
            for n in range(16):
                i = ids[b, 1, n]
                if i < 0:
                    break
                j = ids[b, 2, n]
                for r in range(row, row + 3):
                    low = ways[i, r]
                    high = ways[i, r + 3]
                    p = ways[j, r]
                    q = ways[j, r + 3]
                    boxes[b, r, n] = p if p < low else low
                    boxes[b, r + 3, n] = q if q > high else high
    levels = clusters.levels
    arity = clusters.arity
    first = 0
    many = leaves
    for level in range(levels.shape[0] - 1):
        for child in range(many):
            b = np.int64(levels[level]) + child // arity
            n = child % arity
            for row in range(0, boxes.shape[1], 6):
                for r in range(row, row + 3):
                    low = boxes[first + child, r, 0]
                    high = boxes[first + child, r + 3, 0]
                    for m in range(1, 16):
                        p = boxes[first + child, r, m]
                        q = boxes[first + child, r + 3, m]
                        low = p if p < low else low
                        high = q if q > high else high
                    boxes[b, r, n] = low
                    boxes[b, r + 3, n] = high
        first = np.int64(levels[level])
        many = np.int64(levels[level + 1]) - first
    return radius[0] * scale if still else -1.0
