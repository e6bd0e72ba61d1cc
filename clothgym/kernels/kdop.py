"""k-DOPs: intervals along k/2 axes [Mezger 2003, 3.1], and the refit of a hierarchy of them (eq. 2).

Intervals are unnormalised (n . p with components of n in {-1, 0, 1}), so an inflation by a distance d widens an
interval by |n| d: the paper's eps/2 holds for unit normals only and would miss proximities on the diagonal axes.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import kernel

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
