"""Bounding-volume hierarchy with one triangle a leaf, for queries of points: top-down build [Mezger 2003, 4.1-4.2]."""

from __future__ import annotations

import numpy as np

from clothgym._jit import device, kernel


@device
def _split(order, start, stop, projections, axis_lengths):
    """Reorders order[start:stop] along the longest side and returns the split position.

    The longest side is the largest interval divided by |n| (unit length, unlike the paper's text). The plane lies at the
    interval's centre; a side that stays empty falls back to equal halves.
    """
    best = -1.0
    axis = 0
    centre = 0.0
    for a in range(projections.shape[1]):
        low = projections[order[start], a]
        high = low
        for n in range(start + 1, stop):
            p = projections[order[n], a]
            low = min(low, p)
            high = max(high, p)
        side = (high - low) / axis_lengths[a]
        if side > best:
            best = side
            axis = a
            centre = 0.5 * (low + high)
    i = start
    j = stop - 1
    while i <= j:
        if projections[order[i], axis] <= centre:
            i += 1
        else:
            order[i], order[j] = order[j], order[i]
            j -= 1
    if i == start or i == stop:
        i = (start + stop) // 2
    return i


@kernel
def build(centroids, axes, axis_lengths, arity, child_start, child_count, node_face):
    """Builds the tree over triangle centroids (F, 3) and returns the number of nodes.

    `arity` 2, 4 or 8: that many children come from 1, 2 or 3 successive binary splits. Leaves hold one triangle each.
    Outputs (capacity 2 F): child_start, child_count (0 for leaves), node_face (-1 for inner nodes).
    """
    count = centroids.shape[0]
    order = np.arange(count)
    projections = np.empty((count, axes.shape[0]), np.float64)
    for f in range(count):
        for a in range(axes.shape[0]):
            projections[f, a] = (
                axes[a, 0] * centroids[f, 0] + axes[a, 1] * centroids[f, 1] + axes[a, 2] * centroids[f, 2]
            )
    levels = 1 if arity == 2 else (2 if arity == 4 else 3)
    starts = np.empty(2 * count, np.int64)
    stops = np.empty(2 * count, np.int64)
    ranges = np.empty((2, 8, 2), np.int64)
    starts[0] = 0
    stops[0] = count
    nodes = 1
    node = 0
    while node < nodes:
        if stops[node] - starts[node] == 1:
            node_face[node] = order[starts[node]]
            child_start[node] = 0
            child_count[node] = 0
            node += 1
            continue
        parts = 1
        now = 0
        ranges[0, 0, 0] = starts[node]
        ranges[0, 0, 1] = stops[node]
        for _ in range(levels):
            made = 0
            for p in range(parts):
                first = ranges[now, p, 0]
                last = ranges[now, p, 1]
                if last - first == 1:
                    ranges[1 - now, made, 0] = first
                    ranges[1 - now, made, 1] = last
                    made += 1
                else:
                    middle = _split(order, first, last, projections, axis_lengths)
                    ranges[1 - now, made, 0] = first
                    ranges[1 - now, made, 1] = middle
                    ranges[1 - now, made + 1, 0] = middle
                    ranges[1 - now, made + 1, 1] = last
                    made += 2
            now = 1 - now
            parts = made
        node_face[node] = -1
        child_start[node] = nodes
        child_count[node] = parts
        for p in range(parts):
            starts[nodes] = ranges[now, p, 0]
            stops[nodes] = ranges[now, p, 1]
            nodes += 1
        node += 1
    return nodes
