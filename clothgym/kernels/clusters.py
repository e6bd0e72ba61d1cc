"""Bounding-volume hierarchy of clusters of triangles, and the order of its faces [Mezger 2003, 4].

A leaf holds 16 faces and the edges and vertices that these own. Boxes are tested 16 at a time (`cluster_pairs`), so a test of
one box against a block costs hardly more than one against another.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel

LANES = 16
"""Boxes that are tested together: one vector register of AVX-512, two of AVX, four of anything else."""

LEAF = 16
"""Faces of a leaf, and what fits a block: on a regular sheet they own 8 vertices and 24 edges."""

MARGIN = 2.0**-18
"""Of distances in single precision, coordinates being 0 .. 1: more than all roundings on the way there."""


class Clusters(NamedTuple):
    """Leaves of 16 faces, what they own, and the boxes of everything, 16 to a block.

    Blocks in order: the faces of each leaf, the edges and the vertices that a leaf owns (as many blocks as they need), then
    the nodes: of every leaf, of every `arity` leaves, ... up to one block. Lane n of block b on one level of nodes is block
    arity b + n of the level below, so the tree needs no pointers.
    """

    boxes: NDArray[np.float32]  # (B, 6 G, 16) G groups of three axes: three lows, three highs; empty lanes: low > high
    shapes: NDArray[np.float32]  # (B, 6, 16) at rest: plane of a face, start and way of an edge, place of a vertex
    ids: NDArray[np.int32]  # (B, 4, 16) face, edge or vertex id, then its vertex ids (one repeated); -1 = none
    edge_start: NDArray[np.uint64]  # (L + 1,) first edge block of each leaf
    vertex_start: NDArray[np.uint64]  # (L + 1,) first vertex block of each leaf
    levels: NDArray[np.uint64]  # (N + 1,) first node block of each level, leaves first
    arity: int  # children of a node: 2, 4, 8 or 16


@device
def _select(order, first, last, place, keys):
    """Reorders order[first:last] so that all before `place` have keys no larger than those from there on (Hoare)."""
    low = first
    high = last - 1
    while low < high:
        pivot = keys[order[(low + high) // 2]]
        i = low
        j = high
        while i <= j:
            while keys[order[i]] < pivot:
                i += 1
            while keys[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if place <= j:
            high = j
        elif place >= i:
            low = i
        else:
            return


@kernel
def cluster_order(projections, order):
    """Orders faces so that every leaf of them in a row lies together, and every two leaves, and every four, ...

    projections (A, F): of the centroids on axes of unit length, order (F,). Halves along the longest side, always at a power
    of two times the leaf: all leaves but the last are full, and subtrees of every arity begin where blocks of nodes begin.
    """
    count = order.shape[0]
    for f in range(count):
        order[f] = f
    stack = np.empty((64, 2), np.int64)
    stack[0, 0] = 0
    stack[0, 1] = count
    top = 1
    while top > 0:
        top -= 1
        first = stack[top, 0]
        last = stack[top, 1]
        if last - first <= LEAF:
            continue
        half = LEAF
        while 2 * half < last - first:
            half *= 2
        axis = 0
        best = -1.0
        for a in range(projections.shape[0]):
            low = projections[a, order[first]]
            high = low
            for n in range(first + 1, last):
                p = projections[a, order[n]]
                low = min(low, p)
                high = max(high, p)
            if high - low > best:
                best = high - low
                axis = a
        _select(order, first, last, first + half, projections[axis])
        stack[top, 0] = first
        stack[top, 1] = first + half
        stack[top + 1, 0] = first + half
        stack[top + 1, 1] = last
        top += 2
