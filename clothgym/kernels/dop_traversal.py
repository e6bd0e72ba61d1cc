"""Traversal of one hierarchy against itself and of two against each other, with every way to prune [Mezger 2003, 5-6].

One kernel does both: it starts from a list of node pairs (the roots, or the pairs where the last traversal stopped: the
separation list), tests each when it comes up, and descends into the node with the longer box.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.cones import region_is_clear, speed_ball
from clothgym.kernels.vec3 import dot

NO_CONES, PAPER, EXACT = 0, 1, 2
CONES = {"none": NO_CONES, "mezger": PAPER, "exact": EXACT}

BOX_TESTS, LEAF_PAIRS, CONE_TESTS, CONE_PRUNED, FILTERED, REUSED, STOPS, OUTLINE_TESTS = range(8)


class Tree(NamedTuple):
    """A hierarchy of N nodes over P polygons with V vertices, breadth-first; leaves hold one polygon each."""

    child_start: NDArray[np.int64]  # (N,)
    child_count: NDArray[np.int64]  # (N,) 0 = leaf
    node_face: NDArray[np.int64]  # (N,) polygon of a leaf, -1 inside
    node_group: NDArray[np.int32]  # (N,) face group, -1 = several
    clique: NDArray[np.uint8]  # (N,) all groups below share vertices with each other, and all polygons hang together
    group_adjacent: NDArray[np.uint8]  # (G, G)
    component: NDArray[np.int32]  # (P,) connected component
    corners: NDArray[np.int32]  # (P, 4) a triangle repeats its last one
    border_start: NDArray[np.int64]  # (N + 1,)
    border: NDArray[np.int32]  # vertices around each region in order; none where the outline is no single loop
    boxes: NDArray[np.float64]  # (N, 2 A) inflated
    normal_axis: NDArray[np.float64]  # (N, 3)
    normal_half: NDArray[np.float64]  # (N,) [rad]
    altitude: NDArray[np.float64]  # (N,) [m] least of all triangles
    radius: NDArray[np.float64]  # (N,) [m] EXACT: every two vertices must keep both their radii beside the rules' reach
    speed_axis: NDArray[np.float64]  # (N, 3)
    speed_half: NDArray[np.float64]  # (N,) [rad]
    speed_low: NDArray[np.float64]  # (N,) [m/s]
    speed_high: NDArray[np.float64]  # (N,) [m/s]


class Rules(NamedTuple):
    """What may be pruned."""

    cones: int  # NO_CONES, PAPER, EXACT
    close_angle: float  # PAPER: apex angle from which a region may touch itself [rad]
    leaf_angle: float  # PAPER: least angle of two faces in the same or adjacent groups [rad]; 0 = every pair is tested
    reach: float  # EXACT: distance that a region must keep from itself [m]
    dt: float  # EXACT: time for which it must [s]


@device
def _overlap(a, i, b, j):
    for n in range(0, a.shape[1], 2):
        if a[i, n] > b[j, n + 1] or b[j, n] > a[i, n + 1]:
            return False
    return True


@device
def _longest_side(boxes, i, lengths):
    side = 0.0
    for n in range(lengths.shape[0]):
        side = max(side, (boxes[i, 2 * n + 1] - boxes[i, 2 * n]) / lengths[n])
    return side


@device
def _insignificant(adjacent, axis, p, q, i, j, least):
    """Whether two leaves in the same or adjacent groups share a vertex, or are too parallel to be looked at (6.2)."""
    if adjacent == 0:
        return False
    for m in range(16):
        if p[m // 4] == q[m % 4]:
            return True
    return dot(axis[i, 0], axis[i, 1], axis[i, 2], axis[j, 0], axis[j, 1], axis[j, 2]) > least


@device
def _self_clear(tree, i, x, rules, plane, counts):
    if rules.cones == NO_CONES:
        return False
    counts[CONE_TESTS] += 1
    if rules.cones == PAPER:
        return tree.clique[i] == 1 and 2.0 * tree.normal_half[i] < rules.close_angle
    reach = rules.reach + 2.0 * tree.radius[i]
    if rules.dt > 0.0:
        _, _, _, radius = speed_ball(tree, i)
        reach += 2.0 * radius * rules.dt
    if tree.normal_half[i] < 1.57 and tree.altitude[i] > reach and tree.border_start[i + 1] > tree.border_start[i]:
        counts[OUTLINE_TESTS] += 1
        return region_is_clear(tree, i, x, reach, plane)
    return False


@device
def _push(stack, top, i, j):
    stack[top, 0] = i
    stack[top, 1] = j
    return top + 1


@kernel
def traverse(a, b, same, x, lengths, rules, skip, start, stack, pairs, stops, counts):
    """Pairs of polygons whose boxes overlap and that no rule excludes.

    Args:
        a, b: two trees; the same one twice where `same` is set: then each unordered pair comes once.
        x: (V, 3) positions [m] of tree a that its cones were made of (EXACT).
        lengths: (A,) of the axes.
        rules: `Rules`.
        skip: (G_a, G_b) uint8: pairs of groups whose last results are reused; (0, 0) = none.
        start: (S, 2) pairs of nodes to begin with.
        stack: (T, 2) int64.
        pairs: (C, 2) int32 polygons found.
        stops: (D, 2) int64 pairs of nodes where the descent stopped; (0, 2) = not wanted.
        counts: (8,) int64, overwritten; see the names above.

    Returns:
        Pairs found (as many as fit are written), stops found, and whether the stack was too small.
    """
    # taken out of the tuples once: every access within the loop would be compiled on its own
    start_a, count_a, face_a, group_a, boxes_a = a.child_start, a.child_count, a.node_face, a.node_group, a.boxes
    start_b, count_b, face_b, group_b, boxes_b = b.child_start, b.child_count, b.node_face, b.node_group, b.boxes
    corners_a = a.corners
    counts[:] = 0
    found = 0
    stopped = 0
    wanted = stops.shape[0] > 0
    least = math.cos(rules.leaf_angle)
    longest = 1
    if same == 1 and rules.cones == EXACT:
        for i in range(len(count_a)):
            longest = max(longest, a.border_start[i + 1] - a.border_start[i])
    plane = np.empty((longest, 2), np.float64)
    for entry in range(len(start)):
        top = _push(stack, 0, start[entry, 0], start[entry, 1])
        while top > 0:
            if top + 80 > stack.shape[0]:
                return found, stopped, True
            top -= 1
            i = stack[top, 0]
            j = stack[top, 1]
            ending = False
            grouped = skip.shape[0] > 0 and group_a[i] >= 0 and group_b[j] >= 0
            if grouped and skip[group_a[i], group_b[j]] == 1:
                counts[REUSED] += 1
                ending = True
            if not ending and same == 1 and i == j:
                if _self_clear(a, i, x, rules, plane, counts):
                    counts[CONE_PRUNED] += 1
                    ending = True
                elif count_a[i] == 0:
                    ending = True
                    polygon = face_a[i]
                    if corners_a[polygon, 2] != corners_a[polygon, 3] and rules.leaf_angle == 0.0:
                        counts[LEAF_PAIRS] += 1
                        if found < pairs.shape[0]:
                            pairs[found, 0] = polygon
                            pairs[found, 1] = polygon
                        found += 1
                else:
                    first = start_a[i]
                    last = first + count_a[i]
                    for m in range(first, last):
                        for n in range(m, last):
                            top = _push(stack, top, m, n)
                    continue
            if not ending:
                counts[BOX_TESTS] += 1
                if not _overlap(boxes_a, i, boxes_b, j):
                    ending = True
                elif count_a[i] == 0 and count_b[j] == 0:
                    ending = True
                    skipped = False
                    if same == 1 and rules.leaf_angle > 0.0:
                        adjacent = a.group_adjacent[group_a[i], group_a[j]]
                        if a.component[face_a[i]] != a.component[face_a[j]]:
                            adjacent = np.uint8(0)
                        p_corners = corners_a[face_a[i]]
                        q_corners = corners_a[face_a[j]]
                        skipped = _insignificant(adjacent, a.normal_axis, p_corners, q_corners, i, j, least)
                    if skipped:
                        counts[FILTERED] += 1
                    else:
                        counts[LEAF_PAIRS] += 1
                        if found < pairs.shape[0]:
                            p = face_a[i]
                            q = face_b[j]
                            pairs[found, 0] = min(p, q) if same == 1 else p
                            pairs[found, 1] = max(p, q) if same == 1 else q
                        found += 1
            if ending:
                if wanted:
                    if stopped < stops.shape[0]:
                        stops[stopped, 0] = i
                        stops[stopped, 1] = j
                    stopped += 1
                continue
            descend_a = count_b[j] == 0
            if not descend_a and count_a[i] > 0:
                descend_a = _longest_side(boxes_a, i, lengths) >= _longest_side(boxes_b, j, lengths)
            if descend_a:
                for m in range(start_a[i], start_a[i] + count_a[i]):
                    top = _push(stack, top, m, j)
            else:
                for n in range(start_b[j], start_b[j] + count_b[j]):
                    top = _push(stack, top, i, n)
    counts[STOPS] = stopped
    return found, stopped, False


@kernel
def outlines(child_start, child_count, node_face, twins, corners, vertex_count, border_start, border):
    """Directed outline of the region of each node as a loop of vertices, empty where it is no single simple loop.

    twins (P, 4): the polygon across each side, which runs the side the other way; -1 = none or not unique. Writes
    border_start (N + 1,) and as much of border as fits; returns the room needed.
    """
    count = len(child_count)
    leaves = np.ones(count, np.int64)
    low = np.zeros(count, np.int64)
    for node in range(count - 1, -1, -1):
        if child_count[node] > 0:
            leaves[node] = 0
            for child in range(child_start[node], child_start[node] + child_count[node]):
                leaves[node] += leaves[child]
    ranked = np.empty(leaves[0], np.int64)
    rank = np.empty(len(corners), np.int64)
    for node in range(count):
        begin = low[node]
        for child in range(child_start[node], child_start[node] + child_count[node]):
            low[child] = begin
            begin += leaves[child]
        if child_count[node] == 0:
            ranked[low[node]] = node_face[node]
            rank[node_face[node]] = low[node]
    following = np.full(vertex_count, -1, np.int32)
    needed = 0
    for node in range(count):
        border_start[node] = needed
        sides = 0
        origin = -1
        simple = True
        for place in range(low[node], low[node] + leaves[node]):
            polygon = ranked[place]
            size = 3 if corners[polygon, 2] == corners[polygon, 3] else 4
            for k in range(size):
                twin = twins[polygon, k]
                if twin >= 0 and low[node] <= rank[twin] < low[node] + leaves[node]:
                    continue
                origin = corners[polygon, k]
                simple = simple and following[origin] < 0
                following[origin] = corners[polygon, (k + 1) % size]
                sides += 1
        loop = 0
        if simple and sides > 0:
            v = origin
            while loop < sides:
                if needed + loop < len(border):
                    border[needed + loop] = v
                loop += 1
                v = following[v]
                if v < 0 or v == origin:
                    break
            simple = loop == sides and v == origin
        for place in range(low[node], low[node] + leaves[node]):
            for k in range(4):
                following[corners[ranked[place], k]] = -1
        if simple:
            needed += loop
    border_start[count] = needed
    return needed
