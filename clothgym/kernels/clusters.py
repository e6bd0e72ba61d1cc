"""Bounding-volume hierarchy of clusters of triangles: its order, and its traversal against itself [Mezger 2003, 4 and 6.2].

A leaf holds 16 faces and the edges and vertices that these own. Boxes are tested 16 at a time, without branches, so a test of
one box against a block costs hardly more than one against another.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel

LANES = 16
"""Boxes that are tested together: a loop of 16 becomes vector instructions, one of 8 is unrolled into scalars."""

LEAF = 16
"""Faces of a leaf, and what fits a block: on a regular sheet they own 8 vertices and 24 edges."""

MARGIN = 2.0**-18
"""Of distances in single precision, coordinates being 0 .. 1: more than all roundings on the way there."""

_DE_BRUIJN = 0x077CB531
_BIT = np.zeros(32, np.uint8)
for _bit in range(32):
    _BIT[((_DE_BRUIJN << _bit) & 0xFFFFFFFF) >> 27] = _bit


class Clusters(NamedTuple):
    """Leaves of 16 faces, what they own, and the boxes of everything, 16 to a block.

    Blocks in order: the faces of each leaf, the edges and the vertices that a leaf owns (as many blocks as they need), then
    the nodes: of every leaf, of every `arity` leaves, ... up to one block. Lane n of block b on one level of nodes is block
    arity b + n of the level below, so the tree needs no pointers.
    """

    boxes: NDArray[np.float32]  # (B, 6 G, 16) G groups of three axes: three lows, three highs; empty lanes: low > high
    shapes: NDArray[np.float32]  # (B, 6, 16) at rest: plane of a face, start and way of an edge, place of a vertex
    ids: NDArray[np.int32]  # (B, 4, 16) face, edge or vertex id, then its vertex ids (one repeated); -1 = none
    edge_start: NDArray[np.int32]  # (L + 1,) first edge block of each leaf
    vertex_start: NDArray[np.int32]  # (L + 1,) first vertex block of each leaf
    levels: NDArray[np.int32]  # (N + 1,) first node block of each level, leaves first
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


@device
def _lowest(mask):
    """Position of the lowest set bit of a mask of up to 32 bits."""
    low = mask & (~mask + np.uint64(1))
    return np.int64(_BIT[((low * np.uint64(_DE_BRUIJN)) >> np.uint64(27)) & np.uint64(31)])


@device
def _lanes(boxes, b, row, x0, y0, z0, x1, y1, z1, least):
    """Bit mask of the boxes of block b that overlap the given one by `least` on the three axes from `row` on."""
    mask = np.uint64(0)
    for n in range(LANES):
        p = x1 - boxes[b, row, n]
        q = y1 - boxes[b, row + 1, n]
        r = z1 - boxes[b, row + 2, n]
        s = boxes[b, row + 3, n] - x0
        t = boxes[b, row + 4, n] - y0
        u = boxes[b, row + 5, n] - z0
        p = p if p < q else q
        r = r if r < s else s
        t = t if t < u else u
        p = p if p < r else r
        p = p if p < t else t
        mask |= np.uint64(p >= least) << np.uint64(n)
    return mask


@device
def _other_axes(boxes, b, box, lane, mask):
    """What is left of a mask of block b after the axes behind the first three."""
    for row in range(6, boxes.shape[1], 6):
        if mask == 0:
            break
        mask &= _lanes(
            boxes, b, row, boxes[box, row, lane], boxes[box, row + 1, lane], boxes[box, row + 2, lane],
            boxes[box, row + 3, lane], boxes[box, row + 4, lane], boxes[box, row + 5, lane], np.float32(0.0),
        )  # fmt: skip
    return mask


@device
def _lanes_of_strangers(boxes, ids, b, v, w, x0, y0, z0, x1, y1, z1, least):
    """`_lanes` of the first three axes, for primitives that have neither vertex v nor w.

    In one loop with the boxes: alone, the comparison of ids is small enough to be unrolled into scalars.
    """
    mask = np.uint64(0)
    for n in range(LANES):
        p = x1 - boxes[b, 0, n]
        q = y1 - boxes[b, 1, n]
        r = z1 - boxes[b, 2, n]
        s = boxes[b, 3, n] - x0
        t = boxes[b, 4, n] - y0
        u = boxes[b, 5, n] - z0
        p = p if p < q else q
        r = r if r < s else s
        t = t if t < u else u
        p = p if p < r else r
        p = p if p < t else t
        i = ids[b, 1, n]
        j = ids[b, 2, n]
        k = ids[b, 3, n]
        strange = (i != v) & (j != v) & (k != v) & (i != w) & (j != w) & (k != w)
        mask |= np.uint64((p >= least) & strange) << np.uint64(n)
    return mask


@device
def _planes_near(shapes, b, x, y, z, u, v, w, reach):
    """Bit mask of the faces of block b whose plane comes within `reach` of an edge (start x, y, z; way u, v, w)."""
    mask = np.uint64(0)
    for n in range(LANES):
        s = shapes[b, 0, n] * x + shapes[b, 1, n] * y + shapes[b, 2, n] * z - shapes[b, 3, n]
        t = s + shapes[b, 0, n] * u + shapes[b, 1, n] * v + shapes[b, 2, n] * w
        low = s if s < t else t
        high = s if s > t else t
        mask |= np.uint64((low <= reach) & (high >= -reach)) << np.uint64(n)
    return mask


@device
def _edges_near(shapes, b, x, y, z, ux, uy, uz, reach):
    """Bit mask of the edges of block b that may come within `reach` of an edge: no plane across the line of their middles,
    and none along both, keeps them further apart."""
    mask = np.uint64(0)
    zero = np.float32(0.0)
    far = reach * reach
    uu = np.float32(0.01) * (ux * ux + uy * uy + uz * uz)
    for n in range(LANES):
        px = shapes[b, 0, n] - x
        py = shapes[b, 1, n] - y
        pz = shapes[b, 2, n] - z
        wx = shapes[b, 3, n]
        wy = shapes[b, 4, n]
        wz = shapes[b, 5, n]
        mx = px + px + wx - ux
        my = py + py + wy - uy
        mz = pz + pz + wz - uz
        high = mx * ux + my * uy + mz * uz
        low = mx * wx + my * wy + mz * wz
        high = high if high > zero else zero
        low = low if low < zero else zero
        gap = mx * px + my * py + mz * pz + low - high
        across = (gap > zero) & (gap * gap > far * (mx * mx + my * my + mz * mz))
        nx = uy * wz - uz * wy
        ny = uz * wx - ux * wz
        nz = ux * wy - uy * wx
        gap = nx * px + ny * py + nz * pz
        nn = nx * nx + ny * ny + nz * nz
        # nearly parallel edges: the direction across both is not to be trusted
        along = (gap * gap > far * nn) & (nn > uu * (wx * wx + wy * wy + wz * wz))
        mask |= np.uint64(not (across | along)) << np.uint64(n)
    return mask


@device
def _cross(
    boxes, shapes, ids, first, stop, block, stop_block, same, box, lane, least, reach, line, faces, pairs, found
):
    """Pairs of primitives in blocks first .. stop whose box reaches a leaf's, with those in block .. stop_block.

    same: both are the same blocks, so that each pair comes once; least: overlap of boxes that counts; reach: distance of the
    shapes that counts, < 0 = they move; line: first .. stop are edges, else vertices; faces: block .. stop_block are faces,
    else edges. Returns how many pairs there are now, and how many blocks were tested.
    """
    more = boxes.shape[1] > 6
    zero = np.float32(0.0)
    tests = np.int64(0)
    lx0, ly0, lz0 = boxes[box, 0, lane], boxes[box, 1, lane], boxes[box, 2, lane]
    lx1, ly1, lz1 = boxes[box, 3, lane], boxes[box, 4, lane], boxes[box, 5, lane]
    for b in range(first, stop):
        mask = _lanes(boxes, b, 0, lx0, ly0, lz0, lx1, ly1, lz1, least)
        if more and mask != 0:
            mask = _other_axes(boxes, b, box, lane, mask)
        tests += 1
        while mask != 0:
            n = _lowest(mask)
            mask &= mask - np.uint64(1)
            v = ids[b, 1, n]
            w = ids[b, 2, n]
            x0, y0, z0 = boxes[b, 0, n], boxes[b, 1, n], boxes[b, 2, n]
            x1, y1, z1 = boxes[b, 3, n], boxes[b, 4, n], boxes[b, 5, n]
            for c in range(b if same else block, stop_block):
                near = _lanes_of_strangers(boxes, ids, c, v, w, x0, y0, z0, x1, y1, z1, least)
                if more and near != 0:
                    near = _other_axes(boxes, c, b, n, near)
                tests += 1
                if same and c == b:
                    near &= ~np.uint64((2 << n) - 1)
                if near != 0 and reach >= zero:
                    px, py, pz = shapes[b, 0, n], shapes[b, 1, n], shapes[b, 2, n]
                    ux = shapes[b, 3, n] if line else zero
                    uy = shapes[b, 4, n] if line else zero
                    uz = shapes[b, 5, n] if line else zero
                    if faces:
                        near &= _planes_near(shapes, c, px, py, pz, ux, uy, uz, reach)
                    else:
                        near &= _edges_near(shapes, c, px, py, pz, ux, uy, uz, reach)
                while near != 0:
                    m = _lowest(near)
                    near &= near - np.uint64(1)
                    if found < pairs.shape[0]:
                        pairs[found, 0] = ids[b, 0, n]
                        pairs[found, 1] = ids[c, 0, m]
                    found += 1
    return np.int64(found), tests


@device
def _leaves_near(boxes, levels, arity, i, least, stack, leaves):
    """Leaves from i on whose boxes overlap that of leaf i; returns how many, and how many blocks were tested."""
    shift = 1 if arity == 2 else (2 if arity == 4 else (3 if arity == 8 else 4))
    box = levels[0] + i // arity
    lane = i % arity
    found = np.int64(0)
    tests = np.int64(0)
    more = boxes.shape[1] > 6
    x0, y0, z0 = boxes[box, 0, lane], boxes[box, 1, lane], boxes[box, 2, lane]
    x1, y1, z1 = boxes[box, 3, lane], boxes[box, 4, lane], boxes[box, 5, lane]
    stack[0, 0] = levels.shape[0] - 2
    stack[0, 1] = 0
    top = 1
    while top > 0:
        top -= 1
        level = stack[top, 0]
        block = stack[top, 1]
        mask = _lanes(boxes, levels[level] + block, 0, x0, y0, z0, x1, y1, z1, least)
        if more and mask != 0:
            mask = _other_axes(boxes, levels[level] + block, box, lane, mask)
        tests += 1
        # only leaves from i on: the others have looked this way before
        own = (i >> (shift * level)) - arity * block
        if own > 0:
            mask &= ~np.uint64((1 << min(own, 62)) - 1)
        while mask != 0:
            child = arity * block + _lowest(mask)
            mask &= mask - np.uint64(1)
            if level > 0:
                stack[top, 0] = level - 1
                stack[top, 1] = child
                top += 1
            else:
                leaves[found] = child
                found += 1
    return found, tests


@kernel
def near_pairs(clusters, reach, counts, stack, leaves, vertex_face, edge_edge):
    """Vertex-face and edge-edge pairs without a common vertex whose boxes overlap, each once [Mezger 2003, 6.2].

    reach: what `refit_clusters` returned; primitives at rest are sifted by their shapes. As many as fit are written to
    vertex_face (C, 2) and edge_edge (C, 2); counts[:2] receives how many there are. stack (S, 2) and leaves (L,) are
    scratch: S = arity times levels is enough. Returns the number of tests of a box against a block.
    """
    boxes = clusters.boxes
    shapes = clusters.shapes
    ids = clusters.ids
    edge_start = clusters.edge_start
    vertex_start = clusters.vertex_start
    levels = clusters.levels
    arity = clusters.arity
    points = np.int64(0)
    lines = np.int64(0)
    work = np.int64(0)
    least = np.float32(0.0)
    far = np.float32(reach + MARGIN) if reach >= 0.0 else np.float32(-1.0)
    for i in range(edge_start.shape[0] - 1):
        beside, tests = _leaves_near(boxes, levels, arity, i, least, stack, leaves)
        work += tests
        for other in range(beside):
            j = leaves[other]
            box_i = levels[0] + i // arity
            box_j = levels[0] + j // arity
            lines, tests = _cross(
                boxes, shapes, ids, edge_start[i], edge_start[i + 1], edge_start[j], edge_start[j + 1], i == j,
                box_j, j % arity, least, far, True, False, edge_edge, lines,
            )  # fmt: skip
            work += tests
            for side in range(1 if i == j else 2):
                a = i if side == 0 else j
                b = j if side == 0 else i
                box = box_j if side == 0 else box_i
                points, tests = _cross(
                    boxes, shapes, ids, vertex_start[a], vertex_start[a + 1], b, b + 1, False,
                    box, b % arity, least, far, False, True, vertex_face, points,
                )  # fmt: skip
                work += tests
    counts[0] = points
    counts[1] = lines
    return work


@kernel
def crossing_pairs(clusters, reach, counts, stack, leaves, edge_face):
    """Pairs of an edge and a face without a common vertex whose boxes overlap, each once; see `near_pairs`.

    Boxes that were widened for near pairs of primitives at rest count as if they were not. In a loop of its own: in one with
    the near pairs it took twice as long. counts[2] receives how many there are.
    """
    boxes = clusters.boxes
    shapes = clusters.shapes
    ids = clusters.ids
    edge_start = clusters.edge_start
    levels = clusters.levels
    arity = clusters.arity
    found = np.int64(0)
    work = np.int64(0)
    still = reach >= 0.0
    least = np.float32(reach) if still else np.float32(0.0)
    pierced = np.float32(MARGIN) if still else np.float32(-1.0)
    for i in range(edge_start.shape[0] - 1):
        beside, tests = _leaves_near(boxes, levels, arity, i, least, stack, leaves)
        work += tests
        for other in range(beside):
            j = leaves[other]
            for side in range(1 if i == j else 2):
                a = i if side == 0 else j
                b = j if side == 0 else i
                found, tests = _cross(
                    boxes, shapes, ids, edge_start[a], edge_start[a + 1], b, b + 1, False,
                    levels[0] + b // arity, b % arity, least, pierced, True, True, edge_face, found,
                )  # fmt: skip
                work += tests
    counts[2] = found
    return work
