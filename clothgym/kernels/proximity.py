"""Pairs of primitives that are near, or may come near within a step: vertex-triangle and edge-edge.

Pairs are "quads" of four vertex ids; kind 0 is (v, a, b, c), kind 1 is (a0, a1, b0, b1). Each vertex and edge is reported by
its owner face only, so no pair comes twice.
"""

from __future__ import annotations

import math

from clothgym._jit import device, kernel
from clothgym.kernels.primitives import edge_edge_distance, vertex_triangle_distance


@device
def _travel(u, i, j):
    dx = u[i, 0] - u[j, 0]
    dy = u[i, 1] - u[j, 1]
    dz = u[i, 2] - u[j, 2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@device
def _emit(quads, kinds, found, a, b, c, d, kind):
    if found < quads.shape[0]:
        quads[found, 0] = a
        quads[found, 1] = b
        quads[found, 2] = c
        quads[found, 3] = d
        kinds[found] = kind
    return found + 1


@device
def _vertex_triangle_boxes_apart(x, v, a, b, c, reach):
    for k in range(3):
        p = x[v, k]
        if p < min(x[a, k], x[b, k], x[c, k]) - reach or p > max(x[a, k], x[b, k], x[c, k]) + reach:
            return True
    return False


@device
def _edge_boxes_apart(x, a0, a1, b0, b1, reach):
    for k in range(3):
        if min(x[a0, k], x[a1, k]) - reach > max(x[b0, k], x[b1, k]):
            return True
        if min(x[b0, k], x[b1, k]) - reach > max(x[a0, k], x[a1, k]):
            return True
    return False


@device
def _sweeps_apart_vertex(sweeps, v, a, b, c):
    for k in range(0, 6, 2):
        if sweeps[v, k] > max(sweeps[a, k + 1], sweeps[b, k + 1], sweeps[c, k + 1]):
            return True
        if sweeps[v, k + 1] < min(sweeps[a, k], sweeps[b, k], sweeps[c, k]):
            return True
    return False


@device
def _sweeps_apart_edges(sweeps, a0, a1, b0, b1):
    for k in range(0, 6, 2):
        if min(sweeps[a0, k], sweeps[a1, k]) > max(sweeps[b0, k + 1], sweeps[b1, k + 1]):
            return True
        if min(sweeps[b0, k], sweeps[b1, k]) > max(sweeps[a0, k + 1], sweeps[a1, k + 1]):
            return True
    return False


@kernel
def gather_quads(x, u, surface, thickness, slack, sweeps, pairs, quads, kinds):
    """Pairs of primitives that can come within their thickness while every vertex moves by u, within its slack [m].

    x, u (V, 3): positions and expected displacements; thickness, slack (V,); sweeps (V, 6): each vertex's way as a box, widened
    by slack and half the thickness; pairs (C, 2) face pairs whose swept, inflated boxes overlap. Each vertex and edge is
    emitted by its owner face only, so no pair comes twice. Returns the number found; as many as fit are written.

    The cheap boxes come first; then a pair stays if its distance now is within thickness + relative travel + slack.
    """
    faces = surface.faces
    found = 0
    for n in range(pairs.shape[0]):
        for side in range(2):
            first = pairs[n, side]
            second = pairs[n, 1 - side]
            a = faces[second, 0]
            b = faces[second, 1]
            c = faces[second, 2]
            for k in range(3):
                v = faces[first, k]
                if surface.vertex_owner[v] != first or v == a or v == b or v == c:
                    continue
                if _sweeps_apart_vertex(sweeps, v, a, b, c):
                    continue
                reach = min(thickness[v], thickness[a], thickness[b], thickness[c]) + slack[v]
                reach += max(_travel(u, v, a) + slack[a], _travel(u, v, b) + slack[b], _travel(u, v, c) + slack[c])
                if _vertex_triangle_boxes_apart(x, v, a, b, c, reach):
                    continue
                if vertex_triangle_distance(x, v, a, b, c) <= reach:
                    found = _emit(quads, kinds, found, v, a, b, c, 0)
        first = pairs[n, 0]
        second = pairs[n, 1]
        for k in range(3):
            ea = surface.face_edges[first, k]
            if surface.edge_owner[ea] != first:
                continue
            a0 = surface.edges[ea, 0]
            a1 = surface.edges[ea, 1]
            for m in range(3):
                eb = surface.face_edges[second, m]
                if surface.edge_owner[eb] != second:
                    continue
                b0 = surface.edges[eb, 0]
                b1 = surface.edges[eb, 1]
                if a0 == b0 or a0 == b1 or a1 == b0 or a1 == b1:
                    continue
                if _sweeps_apart_edges(sweeps, a0, a1, b0, b1):
                    continue
                reach = min(thickness[a0], thickness[a1], thickness[b0], thickness[b1])
                reach += max(
                    slack[a0] + max(_travel(u, a0, b0) + slack[b0], _travel(u, a0, b1) + slack[b1]),
                    slack[a1] + max(_travel(u, a1, b0) + slack[b0], _travel(u, a1, b1) + slack[b1]),
                )
                if _edge_boxes_apart(x, a0, a1, b0, b1, reach):
                    continue
                if edge_edge_distance(x, a0, a1, b0, b1) <= reach:
                    found = _emit(quads, kinds, found, a0, a1, b0, b1, 1)
    return found


@kernel
def largest_deviation(x, start, u, share, slack):
    """By how much [m] some vertex is further than its slack from where it was expected, start + share u; < 0 = none is."""
    worst = -math.inf
    for i in range(x.shape[0]):
        dx = x[i, 0] - start[i, 0] - share * u[i, 0]
        dy = x[i, 1] - start[i, 1] - share * u[i, 1]
        dz = x[i, 2] - start[i, 2] - share * u[i, 2]
        worst = max(worst, math.sqrt(dx * dx + dy * dy + dz * dz) - slack[i])
    return worst


@kernel
def find_proximities(x, surface, distance, pairs, quads, kinds, distances):
    """Every vertex-triangle and edge-edge pair closer than `distance` [m]; as many as fit are written, all counted."""
    faces = surface.faces
    found = 0
    for n in range(pairs.shape[0]):
        for side in range(2):
            first = pairs[n, side]
            second = pairs[n, 1 - side]
            a = faces[second, 0]
            b = faces[second, 1]
            c = faces[second, 2]
            for k in range(3):
                v = faces[first, k]
                if surface.vertex_owner[v] != first or v == a or v == b or v == c:
                    continue
                if _vertex_triangle_boxes_apart(x, v, a, b, c, distance):
                    continue
                d = vertex_triangle_distance(x, v, a, b, c)
                if d < distance:
                    if found < quads.shape[0]:
                        quads[found, 0] = v
                        quads[found, 1] = second
                        kinds[found] = 0
                        distances[found] = d
                    found += 1
        first = pairs[n, 0]
        second = pairs[n, 1]
        for k in range(3):
            ea = surface.face_edges[first, k]
            if surface.edge_owner[ea] != first:
                continue
            for m in range(3):
                eb = surface.face_edges[second, m]
                if surface.edge_owner[eb] != second:
                    continue
                e = min(ea, eb)
                f = max(ea, eb)
                a0 = surface.edges[e, 0]
                a1 = surface.edges[e, 1]
                b0 = surface.edges[f, 0]
                b1 = surface.edges[f, 1]
                if a0 == b0 or a0 == b1 or a1 == b0 or a1 == b1:
                    continue
                if _edge_boxes_apart(x, a0, a1, b0, b1, distance):
                    continue
                d = edge_edge_distance(x, a0, a1, b0, b1)
                if d < distance:
                    if found < quads.shape[0]:
                        quads[found, 0] = a0
                        quads[found, 1] = a1
                        quads[found, 2] = b0
                        quads[found, 3] = b1
                        kinds[found] = 1
                        distances[found] = d
                    found += 1
    return found
