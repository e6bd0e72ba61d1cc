"""Traversal of a hierarchy of clusters against itself: pairs of primitives whose boxes overlap [Mezger 2003, 6.2].

A search runs in rounds, since its outcomes are as good as random and every branch upon one costs more than a test: first the
boxes of many primitives are tested against blocks of 16, and whatever has found something is noted without a branch; then the
notes are sifted by more axes and by the shapes of the primitives, and only what is left is written one by one.

Ids are unsigned in here: they need no look for negative ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import bits, device, kernel, lanes, lower, lowest_bit, upper
from clothgym.kernels.clusters import MARGIN

_ZERO = np.uint64(0)
_ONE = np.uint64(1)
_TWO = np.uint64(2)
_FOUR = np.uint64(4)
_ALL = np.uint64(0xFFFF)

NOTES = 1024
"""Notes that a round holds at least."""

_TOUCHING, _PIERCING, _POINTS = 0, 1, 2
"""Marks: edges for near pairs, edges for hits, vertices."""

_MOST = 3 * 48 + 1
"""Notes that a pair of leaves can add: a leaf owns at most 48 edges, in 3 blocks; and one that does not count."""


class Scratch(NamedTuple):
    """What a search writes for itself."""

    stack: NDArray[np.int64]  # (S, 2) nodes on the way down: level and block; arity times levels is enough
    leaves: NDArray[np.uint64]  # (L,) leaves beside one
    masks: NDArray[np.uint64]  # (L, 2, 3, 3) for each leaf beside one, and both ways: blocks by three kinds of marks
    notes: NDArray[np.uint32]  # (3, 3, N) of three rounds: a primitive (block and lane), another block, mask of lanes


def scratch(leaves: int, levels: int, arity: int) -> Scratch:
    """Room for searches of a hierarchy of that size."""
    return Scratch(
        np.empty((arity * levels, 2), np.int64),
        np.empty(leaves, np.uint64),
        np.empty((leaves, 2, 3, 3), np.uint64),
        np.empty((3, 3, NOTES + _MOST), np.uint32),
    )


@device
def _overlap(low_x, low_y, low_z, high_x, high_y, high_z, x0, y0, z0, x1, y1, z1):
    """By how much boxes overlap the given one, on that of three axes where they do so least."""
    below = lower(lower(x1 - low_x, y1 - low_y), z1 - low_z)
    above = lower(lower(high_x - x0, high_y - y0), high_z - z0)
    return lower(below, above)


@device
def _overlaps(boxes, b, row, x0, y0, z0, x1, y1, z1):
    """The same for the boxes of block b, on the three axes from `row` on."""
    return _overlap(
        lanes(boxes, b, row), lanes(boxes, b, row + 1), lanes(boxes, b, row + 2),
        lanes(boxes, b, row + 3), lanes(boxes, b, row + 4), lanes(boxes, b, row + 5),
        x0, y0, z0, x1, y1, z1,
    )  # fmt: skip


@device
def _strangers(i, j, k, v, w):
    """Lanes of the primitives (i, j, k) that have neither vertex v nor w."""
    return (i != v) & (j != v) & (k != v) & (i != w) & (j != w) & (k != w)


@device
def _other_axes(boxes, b, box, lane, mask):
    """What is left of a mask of block b after the axes behind the first three."""
    for row in range(6, boxes.shape[1], 6):
        if mask == _ZERO:
            break
        gap = _overlaps(
            boxes, b, row, boxes[box, row, lane], boxes[box, row + 1, lane], boxes[box, row + 2, lane],
            boxes[box, row + 3, lane], boxes[box, row + 4, lane], boxes[box, row + 5, lane],
        )  # fmt: skip
        mask &= bits(gap >= np.float32(0.0))
    return mask


@device
def _planes_near(shapes, b, x, y, z, u, v, w, reach):
    """Lanes of the faces of block b whose plane comes within `reach` of an edge (start x, y, z; way u, v, w)."""
    nx = lanes(shapes, b, 0)
    ny = lanes(shapes, b, 1)
    nz = lanes(shapes, b, 2)
    start = nx * x + ny * y + nz * z - lanes(shapes, b, 3)
    end = start + nx * u + ny * v + nz * w
    return (lower(start, end) <= reach) & (upper(start, end) >= -reach)


@device
def _edges_near(shapes, b, x, y, z, ux, uy, uz, reach):
    """Lanes of the edges of block b that may come within `reach` of an edge: no plane across the line of their middles,
    and none along both, keeps them further apart."""
    zero = np.float32(0.0)
    far = reach * reach
    uu = np.float32(0.01) * (ux * ux + uy * uy + uz * uz)
    px = lanes(shapes, b, 0) - x
    py = lanes(shapes, b, 1) - y
    pz = lanes(shapes, b, 2) - z
    wx = lanes(shapes, b, 3)
    wy = lanes(shapes, b, 4)
    wz = lanes(shapes, b, 5)
    mx = px + px + wx - ux
    my = py + py + wy - uy
    mz = pz + pz + wz - uz
    high = upper(mx * ux + my * uy + mz * uz, zero)
    low = lower(mx * wx + my * wy + mz * wz, zero)
    gap = mx * px + my * py + mz * pz + low - high
    beside = (gap <= zero) | (gap * gap <= far * (mx * mx + my * my + mz * mz))
    nx = uy * wz - uz * wy
    ny = uz * wx - ux * wz
    nz = ux * wy - uy * wx
    gap = nx * px + ny * py + nz * pz
    nn = nx * nx + ny * ny + nz * nz
    # nearly parallel edges: the direction across both is not to be trusted
    return beside & ((gap * gap <= far * nn) | (nn <= uu * (wx * wx + wy * wy + wz * wz)))


@device
def _leaves_near(boxes, levels, shift, i, least, scratch):
    """Leaves from i on whose boxes overlap that of leaf i; returns how many, and how many blocks were tested."""
    stack = scratch.stack
    leaves = scratch.leaves
    box = levels[0] + (i >> shift)
    lane = i & ((_ONE << shift) - _ONE)
    found = _ZERO
    tests = _ZERO
    more = boxes.shape[1] > 6
    x0, y0, z0 = boxes[box, 0, lane], boxes[box, 1, lane], boxes[box, 2, lane]
    x1, y1, z1 = boxes[box, 3, lane], boxes[box, 4, lane], boxes[box, 5, lane]
    stack[0, 0] = levels.shape[0] - 2
    stack[0, 1] = 0
    top = _ONE
    while top > _ZERO:
        top -= _ONE
        level = np.uint64(stack[top, 0])
        block = np.uint64(stack[top, 1])
        b = levels[level] + block
        mask = bits(_overlaps(boxes, b, 0, x0, y0, z0, x1, y1, z1) >= least)
        if more and mask != _ZERO:
            mask = _other_axes(boxes, b, box, lane, mask)
        tests += _ONE
        # only leaves from i on: the others have looked this way before
        own = np.int64(i >> (shift * level)) - np.int64(block << shift)
        if own > 0:
            mask &= ~((_ONE << np.uint64(min(own, 62))) - _ONE)
        while mask != _ZERO:
            child = (block << shift) + lowest_bit(mask)
            mask &= mask - _ONE
            if level > _ZERO:
                stack[top, 0] = level - _ONE
                stack[top, 1] = child
                top += _ONE
            else:
                leaves[found] = child
                found += _ONE
    return found, tests


@device
def _mark(clusters, shift, i, beside, near, least, scratch):
    """Masks of what leaf i owns that reaches the box of each leaf beside it, and the other way round; see `_TOUCHING`.

    least: overlap of boxes that counts for hits; vertices are marked for near pairs only. Apart from what is done with the
    marks, whose registers it would take.
    """
    boxes = clusters.boxes
    masks = scratch.masks
    zero = np.float32(0.0)
    more = boxes.shape[1] > 6
    for other in range(beside):
        for side in range(np.uint64(2)):
            a = scratch.leaves[other] if side == _ONE else i
            b = i if side == _ONE else scratch.leaves[other]
            box = clusters.levels[0] + (b >> shift)
            lane = b & ((_ONE << shift) - _ONE)
            x0, y0, z0 = boxes[box, 0, lane], boxes[box, 1, lane], boxes[box, 2, lane]
            x1, y1, z1 = boxes[box, 3, lane], boxes[box, 4, lane], boxes[box, 5, lane]
            first = clusters.edge_start[a]
            for block in range(first, clusters.edge_start[a + _ONE]):
                overlap = _overlaps(boxes, block, 0, x0, y0, z0, x1, y1, z1)
                touching = bits(overlap >= zero)
                piercing = bits(overlap >= least)
                if more:
                    touching = _other_axes(boxes, block, box, lane, touching)
                masks[other, side, _TOUCHING, block - first] = touching
                masks[other, side, _PIERCING, block - first] = touching & piercing
            first = clusters.vertex_start[a]
            for block in range(first, clusters.vertex_start[a + _ONE] if near else first):
                touching = bits(_overlaps(boxes, block, 0, x0, y0, z0, x1, y1, z1) >= zero)
                if more:
                    touching = _other_axes(boxes, block, box, lane, touching)
                masks[other, side, _POINTS, block - first] = touching


@device
def _scan_edges(boxes, ids, first, stop, block, stop_block, masks, notes, count):
    """Notes of the marked edges in blocks first .. stop and those in block .. stop_block; masks (3,) of the marked ones.

    Edges with a common vertex are no pair; of equal blocks each pair comes once. Returns how many notes there are now, and how
    many blocks were tested, the marks included.
    """
    tests = stop - first
    for b in range(first, stop):
        mask = masks[b - first]
        while mask != _ZERO:
            n = lowest_bit(mask)
            mask &= mask - _ONE
            v, w = ids[b, 1, n], ids[b, 2, n]
            px, py, pz = boxes[b, 0, n], boxes[b, 1, n], boxes[b, 2, n]
            qx, qy, qz = boxes[b, 3, n], boxes[b, 4, n], boxes[b, 5, n]
            for c in range(b if block < b else block, stop_block):
                near = _overlaps(boxes, c, 0, px, py, pz, qx, qy, qz) >= np.float32(0.0)
                found = bits(near & _strangers(lanes(ids, c, 1), lanes(ids, c, 2), lanes(ids, c, 3), v, w))
                found &= ~((_TWO << n) - _ONE) if b == c else _ALL
                notes[0, count] = (b << _FOUR) | n
                notes[1, count] = c
                notes[2, count] = found
                count += np.uint64(found != _ZERO)
                tests += _ONE
    return count, tests


@device
def _scan_faces(boxes, ids, first, stop, c, least, masks, notes, count):
    """The same for edges or vertices in blocks first .. stop and the faces of block c; least: overlap of boxes that counts."""
    tests = stop - first
    # all that is known of the faces stays in registers
    i, j, k = lanes(ids, c, 1), lanes(ids, c, 2), lanes(ids, c, 3)
    low_x, low_y, low_z = lanes(boxes, c, 0), lanes(boxes, c, 1), lanes(boxes, c, 2)
    high_x, high_y, high_z = lanes(boxes, c, 3), lanes(boxes, c, 4), lanes(boxes, c, 5)
    for b in range(first, stop):
        mask = masks[b - first]
        while mask != _ZERO:
            n = lowest_bit(mask)
            mask &= mask - _ONE
            overlap = _overlap(
                low_x, low_y, low_z, high_x, high_y, high_z,
                boxes[b, 0, n], boxes[b, 1, n], boxes[b, 2, n], boxes[b, 3, n], boxes[b, 4, n], boxes[b, 5, n],
            )  # fmt: skip
            found = bits((overlap >= least) & _strangers(i, j, k, ids[b, 1, n], ids[b, 2, n]))
            notes[0, count] = (b << _FOUR) | n
            notes[1, count] = c
            notes[2, count] = found
            count += np.uint64(found != _ZERO)
            tests += _ONE
    return count, tests


@device
def _sift(boxes, shapes, notes, count, reach, line, faces):
    """Notes that are left after the axes behind the first three and, unless reach < 0, by the shapes of primitives at rest.

    line: the primitives are edges, else vertices; faces: those in the blocks are faces, else edges.
    """
    zero = np.float32(0.0)
    kept = _ZERO
    if boxes.shape[1] > 6:
        for q in range(count):
            which = notes[0, q]
            c = np.uint64(notes[1, q])
            mask = _other_axes(
                boxes, c, np.uint64(which >> _FOUR), np.uint64(which & np.uint64(15)), np.uint64(notes[2, q])
            )
            notes[0, kept] = which
            notes[1, kept] = c
            notes[2, kept] = mask
            kept += np.uint64(mask != _ZERO)
        count = kept
    if reach < zero:
        return count
    kept = _ZERO
    for q in range(count):
        which = notes[0, q]
        c = np.uint64(notes[1, q])
        b = np.uint64(which >> _FOUR)
        n = np.uint64(which & np.uint64(15))
        px, py, pz = shapes[b, 0, n], shapes[b, 1, n], shapes[b, 2, n]
        ux = shapes[b, 3, n] if line else zero
        uy = shapes[b, 4, n] if line else zero
        uz = shapes[b, 5, n] if line else zero
        if faces:
            close = _planes_near(shapes, c, px, py, pz, ux, uy, uz, reach)
        else:
            close = _edges_near(shapes, c, px, py, pz, ux, uy, uz, reach)
        mask = bits(close) & np.uint64(notes[2, q])
        notes[0, kept] = which
        notes[1, kept] = c
        notes[2, kept] = mask
        kept += np.uint64(mask != _ZERO)
    return kept


@device
def _write(clusters, notes, count, reach, line, faces, pairs, found):
    """Sifts the notes and appends what is left to the pairs, as far as they fit; returns how many there are."""
    ids = clusters.ids
    count = _sift(clusters.boxes, clusters.shapes, notes, count, reach, line, faces)
    for q in range(count):
        which = notes[0, q]
        c = np.uint64(notes[1, q])
        first = ids[np.uint64(which >> _FOUR), 0, np.uint64(which & np.uint64(15))]
        mask = np.uint64(notes[2, q])
        while mask != _ZERO:
            m = lowest_bit(mask)
            mask &= mask - _ONE
            if found < pairs.shape[0]:
                pairs[found, 0] = first
                pairs[found, 1] = ids[c, 0, m]
            found += 1
    return found


@device
def _shift(arity):
    return _ONE if arity == 2 else (_TWO if arity == 4 else (np.uint64(3) if arity == 8 else _FOUR))


@kernel
def overlapping_pairs(clusters, reach, near, hits, counts, scratch, vertex_face, edge_edge, edge_face):
    """Pairs of primitives without a common vertex whose boxes overlap, each once [Mezger 2003, 6.2].

    near: vertex-face and edge-edge; hits: edge-face. reach: what `refit_clusters` returned; primitives at rest are sifted by
    their shapes, and for hits boxes that were widened count as if they were not. As many as fit are written to vertex_face,
    edge_edge, edge_face (C, 2); counts[:2] (near) and counts[2] (hits) receive how many there are. Returns the number of
    tests of a box against a block.
    """
    boxes = clusters.boxes
    ids = clusters.ids
    edge_start = clusters.edge_start
    vertex_start = clusters.vertex_start
    levels = clusters.levels
    masks = scratch.masks
    notes = scratch.notes
    shift = _shift(clusters.arity)
    still = reach >= 0.0
    zero = np.float32(0.0)
    least = np.float32(reach) if still else zero
    close = np.float32(reach + MARGIN) if still else np.float32(-1.0)
    pierced = np.float32(MARGIN) if still else np.float32(-1.0)
    points = 0
    lines = 0
    crossings = 0
    of_points = _ZERO
    of_lines = _ZERO
    of_crossings = _ZERO
    work = _ZERO
    for i in range(np.uint64(edge_start.shape[0] - 1)):
        beside, tests = _leaves_near(boxes, levels, shift, i, zero if near else least, scratch)
        work += tests
        _mark(clusters, shift, i, beside, near, least, scratch)
        for other in range(beside):
            j = scratch.leaves[other]
            if near:
                of_lines, tests = _scan_edges(
                    boxes, ids, edge_start[i], edge_start[i + _ONE], edge_start[j], edge_start[j + _ONE],
                    masks[other, 0, _TOUCHING], notes[0], of_lines,
                )  # fmt: skip
                work += tests
            for side in range(1 if i == j else 2):
                a = i if side == 0 else j
                b = j if side == 0 else i
                if near:
                    of_points, tests = _scan_faces(
                        boxes, ids, vertex_start[a], vertex_start[a + _ONE], b, zero,
                        masks[other, side, _POINTS], notes[1], of_points,
                    )  # fmt: skip
                    work += tests
                if hits:
                    of_crossings, tests = _scan_faces(
                        boxes, ids, edge_start[a], edge_start[a + _ONE], b, least,
                        masks[other, side, _PIERCING], notes[2], of_crossings,
                    )  # fmt: skip
                    work += tests
            if of_lines > np.uint64(NOTES):
                lines = _write(clusters, notes[0], of_lines, close, True, False, edge_edge, lines)
                of_lines = _ZERO
            if of_points > np.uint64(NOTES):
                points = _write(clusters, notes[1], of_points, close, False, True, vertex_face, points)
                of_points = _ZERO
            if of_crossings > np.uint64(NOTES):
                crossings = _write(clusters, notes[2], of_crossings, pierced, True, True, edge_face, crossings)
                of_crossings = _ZERO
    if near:
        counts[0] = _write(clusters, notes[1], of_points, close, False, True, vertex_face, points)
        counts[1] = _write(clusters, notes[0], of_lines, close, True, False, edge_edge, lines)
    if hits:
        counts[2] = _write(clusters, notes[2], of_crossings, pierced, True, True, edge_face, crossings)
    return np.int64(work)
