"""Contact between cloths: candidates, closest points, projection with friction, and the certificate of separation.

Vertex-triangle and edge-edge pairs are "quads" of four vertex ids; kind 0 is (v, a, b, c), kind 1 is (a0, a1, b0, b1).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.integrate import hold_grips, keep_above_ground
from clothgym.kernels.primitives import (
    closest_on_edges,
    closest_on_triangle,
    edge_edge_distance,
    vertex_triangle_distance,
)
from clothgym.kernels.springs import project_springs

_ACTIVE = 1.25
"""Pairs predicted to come nearer than this many thicknesses are projected; the certificate watches over the others."""

_KEEP = 0.2
"""Share of a pair's distance (at most of its thickness) that a substep must leave along the separating direction."""


class Contacts(NamedTuple):
    """Active contacts of a substep; capacity K."""

    quads: NDArray  # (K, 4) int32 vertex ids
    weights: NDArray  # (K, 4) signed barycentric weights, sum 0
    normals: NDArray  # (K, 3) from the second side to the first, frozen for the substep
    rest: NDArray  # (K,) thickness [m]
    limit: NDArray  # (K,) largest normal force [N]; inf except beside an intersection
    approach: NDArray  # (K,) predicted change of distance along the normal [m]
    pressed: NDArray  # (K,) accumulated normal multiplier
    dragged: NDArray  # (K, 3) accumulated friction multiplier


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


@device
def _weights(x, quads, n, kind):
    if kind == 0:
        wa, wb, wc = closest_on_triangle(x, quads[n, 0], quads[n, 1], quads[n, 2], quads[n, 3])
        return 1.0, -wa, -wb, -wc
    s, t = closest_on_edges(x, quads[n, 0], quads[n, 1], quads[n, 2], quads[n, 3])
    return 1.0 - s, s, -(1.0 - t), -t


@device
def _combine(x, quads, n, w0, w1, w2, w3, c):
    return w0 * x[quads[n, 0], c] + w1 * x[quads[n, 1], c] + w2 * x[quads[n, 2], c] + w3 * x[quads[n, 3], c]


@device
def _left_apart(apart, quads, n, kind, both):
    """Whether contact leaves this pair alone because it lies beside an intersection."""
    if kind == 0:
        one = apart[quads[n, 0]]
        two = apart[quads[n, 1]] or apart[quads[n, 2]] or apart[quads[n, 3]]
    else:
        one = apart[quads[n, 0]] or apart[quads[n, 1]]
        two = apart[quads[n, 2]] or apart[quads[n, 3]]
    return (one and two) if both else (one or two)


@kernel
def narrow(x, p, quads, kinds, count, thickness, apart, both, yield_force, separation, contacts):
    """Closest points at the start of a substep: separation (C, 4) = normal and distance, -1 where nothing is certified.

    Pairs beside an intersection (apart (V,)) are left out if yield_force [N] is 0, and may press no harder than it otherwise.
    Pairs that would be nearer than 1.25 thicknesses at the predicted positions p become active contacts. Returns how
    many are active; as many as fit are written to `contacts`.
    """
    active = 0
    capacity = contacts.quads.shape[0]
    for n in range(count):
        separation[n, 3] = -1.0
        beside = _left_apart(apart, quads, n, kinds[n], both)
        if beside and yield_force == 0.0:
            continue
        w0, w1, w2, w3 = _weights(x, quads, n, kinds[n])
        nx = _combine(x, quads, n, w0, w1, w2, w3, 0)
        ny = _combine(x, quads, n, w0, w1, w2, w3, 1)
        nz = _combine(x, quads, n, w0, w1, w2, w3, 2)
        distance = math.sqrt(nx * nx + ny * ny + nz * nz)
        if distance < 1e-12:  # touching: no side to keep
            continue
        nx /= distance
        ny /= distance
        nz /= distance
        separation[n, 0] = nx
        separation[n, 1] = ny
        separation[n, 2] = nz
        if not beside:
            separation[n, 3] = distance
        h = min(thickness[quads[n, 0]], thickness[quads[n, 1]], thickness[quads[n, 2]], thickness[quads[n, 3]])
        predicted = nx * _combine(p, quads, n, w0, w1, w2, w3, 0)
        predicted += ny * _combine(p, quads, n, w0, w1, w2, w3, 1)
        predicted += nz * _combine(p, quads, n, w0, w1, w2, w3, 2)
        if predicted > _ACTIVE * h:
            continue
        if active < capacity:
            for k in range(4):
                contacts.quads[active, k] = quads[n, k]
            contacts.weights[active, 0] = w0
            contacts.weights[active, 1] = w1
            contacts.weights[active, 2] = w2
            contacts.weights[active, 3] = w3
            contacts.normals[active, 0] = nx
            contacts.normals[active, 1] = ny
            contacts.normals[active, 2] = nz
            contacts.rest[active] = h
            contacts.limit[active] = yield_force if beside else math.inf
            contacts.approach[active] = predicted - distance
            contacts.pressed[active] = 0.0
            contacts.dragged[active, 0] = 0.0
            contacts.dragged[active, 1] = 0.0
            contacts.dragged[active, 2] = 0.0
        active += 1
    return active


@device
def _project_contacts(x, p, inverse_masses, contacts, count, friction, dt):
    """One Gauss-Seidel sweep: keep the thickness along the normal, Coulomb friction across it; momentum is kept."""
    for n in range(count):
        q = contacts.quads[n]
        w = contacts.weights[n]
        normal = contacts.normals[n]
        mobility = 0.0
        gap = -contacts.rest[n]
        for k in range(4):
            mobility += w[k] * w[k] * inverse_masses[q[k]]
            gap += w[k] * (normal[0] * p[q[k], 0] + normal[1] * p[q[k], 1] + normal[2] * p[q[k], 2])
        if mobility == 0.0:
            continue
        before = contacts.pressed[n]
        after = min(max(0.0, before - gap / mobility), contacts.limit[n] * dt * dt)
        contacts.pressed[n] = after
        push = after - before
        if push != 0.0:
            for k in range(4):
                g = push * w[k] * inverse_masses[q[k]]
                p[q[k], 0] += g * normal[0]
                p[q[k], 1] += g * normal[1]
                p[q[k], 2] += g * normal[2]
        if friction == 0.0 or (after == 0.0 and before == 0.0):
            continue
        tx = 0.0
        ty = 0.0
        tz = 0.0
        for k in range(4):
            tx += w[k] * (p[q[k], 0] - x[q[k], 0])
            ty += w[k] * (p[q[k], 1] - x[q[k], 1])
            tz += w[k] * (p[q[k], 2] - x[q[k], 2])
        along = tx * normal[0] + ty * normal[1] + tz * normal[2]
        nx = contacts.dragged[n, 0] - (tx - along * normal[0]) / mobility
        ny = contacts.dragged[n, 1] - (ty - along * normal[1]) / mobility
        nz = contacts.dragged[n, 2] - (tz - along * normal[2]) / mobility
        size = math.sqrt(nx * nx + ny * ny + nz * nz)
        limit = friction * after
        if size > limit:
            nx *= limit / size
            ny *= limit / size
            nz *= limit / size
        tx = nx - contacts.dragged[n, 0]
        ty = ny - contacts.dragged[n, 1]
        tz = nz - contacts.dragged[n, 2]
        contacts.dragged[n, 0] = nx
        contacts.dragged[n, 1] = ny
        contacts.dragged[n, 2] = nz
        for k in range(4):
            g = w[k] * inverse_masses[q[k]]
            p[q[k], 0] += g * tx
            p[q[k], 1] += g * ty
            p[q[k], 2] += g * tz


@kernel
def solve(x, p, cloth, contacts, count, friction, radii, motion, ground, grips, multipliers, substep, with_springs):
    """Sweeps over springs, grips, contacts and ground, contact last; `with_springs` is off for explicit integration."""
    multipliers[:] = 0.0
    grips.multipliers[:] = 0.0
    for _ in range(motion.sweeps):
        if with_springs:
            project_springs(p, cloth, motion.dt, multipliers)
        hold_grips(p, cloth.inverse_masses, grips, motion.dt, (substep + 1) * motion.dt)
        _project_contacts(x, p, cloth.inverse_masses, contacts, count, friction, motion.dt)
        keep_above_ground(x, p, cloth.inverse_masses, radii, ground)
    for a in range(grips.vertices.shape[0]):
        for c in range(3):
            grips.forces[a, c] += grips.multipliers[a, c] / (motion.dt * motion.dt)


@device
def _extremes(p, quads, n, kind, separation):
    """Gap along the pair's separating direction and the two vertices that bound it."""
    nx = separation[n, 0]
    ny = separation[n, 1]
    nz = separation[n, 2]
    split = 1 if kind == 0 else 2
    low = math.inf
    high = -math.inf
    i = quads[n, 0]
    j = quads[n, 3]
    for k in range(4):
        v = quads[n, k]
        s = nx * p[v, 0] + ny * p[v, 1] + nz * p[v, 2]
        if k < split:
            if s < low:
                low = s
                i = v
        elif s > high:
            high = s
            j = v
    return low - high, i, j


@device
def _needed(separation, thickness, quads, n):
    h = min(thickness[quads[n, 0]], thickness[quads[n, 1]], thickness[quads[n, 2]], thickness[quads[n, 3]])
    return _KEEP * min(separation[n, 3], h)


@device
def _find(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def certify(x, p, inverse_masses, thickness, quads, kinds, count, separation, rounds):
    """Makes sure that no pair that was apart at x crosses on the straight way to p; changes p where needed.

    Two convex primitives whose closest points are d > 0 apart are separated by a plane across the line of these points.
    Along linear paths the gap across that fixed direction is concave in time, so a positive gap at both ends proves that
    the pair stayed apart. Pairs without the proof are first pushed apart (`rounds` sweeps), then joined to zones that
    move as one, which always has it [Bridson 2002, rigid impact zones, translation only]. Linear momentum is kept.
    Returns (pairs repaired, vertices moved in zones).
    """
    repaired = 0
    for _ in range(rounds):
        bad = 0
        for n in range(count):
            if separation[n, 3] < 0.0:
                continue
            gap, i, j = _extremes(p, quads, n, kinds[n], separation)
            need = _needed(separation, thickness, quads, n)
            if gap >= need:
                continue
            bad += 1
            total = inverse_masses[i] + inverse_masses[j]
            if total == 0.0:
                continue
            push = (1.5 * need - gap) / total
            for c in range(3):
                p[i, c] += push * inverse_masses[i] * separation[n, c]
                p[j, c] -= push * inverse_masses[j] * separation[n, c]
        repaired += bad
        if bad == 0:
            return repaired, 0
    vertices = x.shape[0]
    parent = np.arange(vertices)
    mean = np.zeros((vertices, 3), np.float64)
    mass = np.zeros(vertices, np.float64)
    held = np.zeros(vertices, np.bool_)
    moved = 0
    while True:
        bad = 0
        for n in range(count):
            if separation[n, 3] < 0.0:
                continue
            gap, _, _ = _extremes(p, quads, n, kinds[n], separation)
            if gap >= _needed(separation, thickness, quads, n) * 0.5:
                continue
            joined = False
            root = _find(parent, quads[n, 0])
            for k in range(1, 4):
                other = _find(parent, quads[n, k])
                if other != root:
                    parent[max(root, other)] = min(root, other)
                    root = min(root, other)
                    joined = True
            if joined:
                bad += 1
        if bad == 0:
            return repaired, moved
        mean[:] = 0.0
        mass[:] = 0.0
        held[:] = False
        for i in range(vertices):
            root = _find(parent, i)
            if inverse_masses[i] == 0.0:
                if not held[root]:
                    held[root] = True
                    mass[root] = 1.0
                    for c in range(3):
                        mean[root, c] = p[i, c] - x[i, c]
            elif not held[root]:
                mass[root] += 1.0 / inverse_masses[i]
                for c in range(3):
                    mean[root, c] += (p[i, c] - x[i, c]) / inverse_masses[i]
        moved = 0
        for i in range(vertices):
            root = _find(parent, i)
            moved += root != i
            # a lone vertex is its own mean and stays where it was predicted
            for c in range(3):
                p[i, c] = x[i, c] + mean[root, c] / mass[root]


@kernel
def stop_rebound(v, inverse_masses, contacts, count, dt):
    """Takes away separating speed that the recovery of thickness gave to pressed contacts (restitution 0)."""
    for n in range(count):
        if contacts.pressed[n] <= 0.0:
            continue
        q = contacts.quads[n]
        w = contacts.weights[n]
        normal = contacts.normals[n]
        speed = 0.0
        mobility = 0.0
        for k in range(4):
            mobility += w[k] * w[k] * inverse_masses[q[k]]
            speed += w[k] * (normal[0] * v[q[k], 0] + normal[1] * v[q[k], 1] + normal[2] * v[q[k], 2])
        allowed = max(0.0, contacts.approach[n] / dt)
        if speed <= allowed or mobility == 0.0:
            continue
        impulse = (allowed - speed) / mobility
        for k in range(4):
            g = impulse * w[k] * inverse_masses[q[k]]
            v[q[k], 0] += g * normal[0]
            v[q[k], 1] += g * normal[1]
            v[q[k], 2] += g * normal[2]


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
