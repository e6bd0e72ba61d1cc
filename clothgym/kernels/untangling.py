"""Corrections of intersection contour minimization [Volino 2006, eq. 4 and 5], and others that keep momentum."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel


class Hits(NamedTuple):
    """Hits, as `Intersections` has them."""

    edge: NDArray  # (H,)
    face: NDArray  # (H,)
    parameter: NDArray  # (H,)
    weights: NDArray  # (H, 3)
    order: NDArray  # (H,) contour by contour
    bounds: NDArray  # (C + 1,) of each contour in `order`


class Strings(NamedTuple):
    """Segments of contours."""

    first: NDArray  # (S,) hit
    second: NDArray  # (S,) hit, -1 = none
    loop: NDArray  # (S,) loop vertex, -1 = none
    ends: NDArray  # (S, 2, 3) [m]
    order: NDArray  # (S,) contour by contour
    bounds: NDArray  # (C + 1,)


@kernel
def contour_gradients(frames, contour, sign, totals):
    """Sum of s_h G_h per contour, G = S - 2 kappa N [Volino 2006, eq. 4]; totals (C, 3)."""
    for h in range(frames.shape[0]):
        for c in range(3):
            totals[contour[h], c] += sign[h] * (frames[h, c] - 2.0 * frames[h, 6] * frames[h, 3 + c])


@device
def _saturate(gx, gy, gz, h0, g0):
    """H = h0 G / sqrt(|G|^2 + g0^2) [Volino 2006, eq. 5]."""
    scale = h0 / math.sqrt(gx * gx + gy * gy + gz * gz + g0 * g0)
    return gx * scale, gy * scale, gz * scale


@kernel
def local_targets(frames, h0, g0, targets):
    """Relative displacement of each hit from its own gradient; targets (H, 3) [m]."""
    for h in range(frames.shape[0]):
        kappa = frames[h, 6]
        x, y, z = _saturate(
            frames[h, 0] - 2.0 * kappa * frames[h, 3],
            frames[h, 1] - 2.0 * kappa * frames[h, 4],
            frames[h, 2] - 2.0 * kappa * frames[h, 5],
            h0,
            g0,
        )
        targets[h, 0] = x
        targets[h, 1] = y
        targets[h, 2] = z


@kernel
def global_targets(totals, contour, sign, h0, g0, targets):
    """Relative displacement of each hit from its contour's total gradient, turned by the side of its edge."""
    for h in range(contour.shape[0]):
        x, y, z = _saturate(totals[contour[h], 0], totals[contour[h], 1], totals[contour[h], 2], h0, g0)
        targets[h, 0] = sign[h] * x
        targets[h, 1] = sign[h] * y
        targets[h, 2] = sign[h] * z


@kernel
def distribute(
    faces, edges, inverse_masses, hit_edge, hit_face, parameters, weights, targets, order, contour, caps, total
):
    """Moves edges and faces so that each hit gets its relative displacement; linear and angular momentum are kept.

    dx_i = q_i c_i H / sum_j c_j^2 q_j with c = (1 - t, t, -w). The sum over a contour's hits is scaled as a whole so that
    no vertex moves further than its cap (C,) [m]. `order` (H,) lists the hits by contour; adds to total (V, 3) [m].
    """
    scratch = np.zeros(total.shape, np.float64)
    latest = np.full(total.shape[0], -1, np.int32)  # the contour, by its start, that has touched a vertex
    touched = np.empty(total.shape[0], np.int32)
    start = 0
    count = hit_edge.shape[0]
    while start < count:
        stop = start
        while stop < count and contour[order[stop]] == contour[order[start]]:
            stop += 1
        used = 0
        for n in range(start, stop):
            h = order[n]
            t = parameters[h]
            ids = (
                edges[hit_edge[h], 0],
                edges[hit_edge[h], 1],
                faces[hit_face[h], 0],
                faces[hit_face[h], 1],
                faces[hit_face[h], 2],
            )
            shares = (1.0 - t, t, -weights[h, 0], -weights[h, 1], -weights[h, 2])
            mobility = 0.0
            for k in range(5):
                mobility += shares[k] * shares[k] * inverse_masses[ids[k]]
            if mobility == 0.0:
                continue
            for k in range(5):
                g = shares[k] * inverse_masses[ids[k]] / mobility
                if latest[ids[k]] != start:
                    latest[ids[k]] = start
                    touched[used] = ids[k]
                    used += 1
                for c in range(3):
                    scratch[ids[k], c] += g * targets[h, c]
        largest = 0.0
        for n in range(used):
            i = touched[n]
            largest = max(largest, scratch[i, 0] ** 2 + scratch[i, 1] ** 2 + scratch[i, 2] ** 2)
        largest = math.sqrt(largest)
        cap = caps[contour[order[start]]]
        scale = cap / largest if largest > cap else 1.0
        for n in range(used):
            i = touched[n]
            for c in range(3):
                total[i, c] += scale * scratch[i, c]
                scratch[i, c] = 0.0
        start = stop


@device
def _list(listed, touched, used, i):
    """Adds vertex i to the touched ones, once; returns how many there are."""
    if listed[i]:
        return used
    listed[i] = True
    touched[used] = i
    return used + 1


@kernel
def exact_steps(faces, edges, hits, frames, strings, limit, inverse_masses, cap, total):
    """Newton-like steps against the exact gradient of the length, contour by contour; adds to total (V, 3) [m].

    The gradient is the pull of a string of unit tension along every segment, on the edges that carry its ends or the loop
    vertex where it ends, and kappa N between the edge and the face of every hit. Each of these keeps momentum for itself, so
    kappa may be saturated at `limit` (exact where infinite) and segments without a second end left out. The step would bring a
    contour's length to zero if that were linear, and moves no vertex further than `cap` [m].
    """
    force = np.zeros(total.shape, np.float64)
    listed = np.zeros(total.shape[0], np.bool_)
    touched = np.empty(total.shape[0], np.int64)
    for c in range(hits.bounds.shape[0] - 1):
        used = 0
        for n in range(hits.bounds[c], hits.bounds[c + 1]):
            h = hits.order[n]
            kappa = frames[h, 7] / math.sqrt(1.0 + (frames[h, 7] / limit) ** 2)
            for k in range(5):
                if k < 2:
                    i = edges[hits.edge[h], k]
                    share = 1.0 - hits.parameter[h] if k == 0 else hits.parameter[h]
                else:
                    i = faces[hits.face[h], k - 2]
                    share = -hits.weights[h, k - 2]
                used = _list(listed, touched, used, i)
                for a in range(3):
                    force[i, a] -= share * kappa * frames[h, 3 + a]
        length = 0.0
        for n in range(strings.bounds[c], strings.bounds[c + 1]):
            s = strings.order[n]
            size = 0.0
            for a in range(3):
                size += (strings.ends[s, 1, a] - strings.ends[s, 0, a]) ** 2
            size = math.sqrt(size)
            if size == 0.0 or (strings.second[s] < 0 and strings.loop[s] < 0):
                continue
            length += size
            for end in range(2):
                pull = 1.0 / size if end == 0 else -1.0 / size
                h = strings.first[s] if end == 0 else strings.second[s]
                if h < 0:
                    i = strings.loop[s]
                    used = _list(listed, touched, used, i)
                    for a in range(3):
                        force[i, a] += pull * (strings.ends[s, 1, a] - strings.ends[s, 0, a])
                    continue
                for k in range(2):
                    i = edges[hits.edge[h], k]
                    share = 1.0 - hits.parameter[h] if k == 0 else hits.parameter[h]
                    for a in range(3):
                        force[i, a] += share * pull * (strings.ends[s, 1, a] - strings.ends[s, 0, a])
        slope = 0.0
        largest = 0.0
        for n in range(used):
            i = touched[n]
            size = force[i, 0] ** 2 + force[i, 1] ** 2 + force[i, 2] ** 2
            slope += inverse_masses[i] * size
            largest = max(largest, inverse_masses[i] * math.sqrt(size))
        scale = min(length / slope, cap / largest) if slope > 0.0 else 0.0
        for n in range(used):
            i = touched[n]
            listed[i] = False
            for a in range(3):
                total[i, a] += scale * inverse_masses[i] * force[i, a]
                force[i, a] = 0.0


@kernel
def pull_stencils(start, ids, shares, targets, group, inverse_masses, sweeps, cap, total):
    """Gives each stencil its relative displacement sum_i c_i dx_i along its target; linear momentum is kept, and angular too
    where the target lies along sum_i c_i x_i. Adds to total (V, 3) [m].

    Stencils (N,) with vertices ids and shares c (their sum is zero) from start (N + 1,) on, sorted by group; those of a group
    share vertices, so that they are met in turns (Gauss-Seidel), then scaled as a whole to a largest displacement of `cap`.
    """
    scratch = np.zeros(total.shape, np.float64)
    begin = 0
    count = group.shape[0]
    while begin < count:
        stop = begin
        while stop < count and group[stop] == group[begin]:
            stop += 1
        for _ in range(sweeps):
            for n in range(begin, stop):
                mobility = 0.0
                for k in range(start[n], start[n + 1]):
                    mobility += shares[k] * shares[k] * inverse_masses[ids[k]]
                if mobility == 0.0:
                    continue
                size = math.sqrt(targets[n, 0] ** 2 + targets[n, 1] ** 2 + targets[n, 2] ** 2)
                if size == 0.0:
                    continue
                # along the target alone: a pull across it would turn the stencil
                missing = size
                for k in range(start[n], start[n + 1]):
                    for a in range(3):
                        missing -= shares[k] * scratch[ids[k], a] * targets[n, a] / size
                for k in range(start[n], start[n + 1]):
                    pull = missing / (mobility * size) * shares[k] * inverse_masses[ids[k]]
                    for a in range(3):
                        scratch[ids[k], a] += pull * targets[n, a]
        largest = 0.0
        for k in range(start[begin], start[stop]):
            i = ids[k]
            largest = max(largest, scratch[i, 0] ** 2 + scratch[i, 1] ** 2 + scratch[i, 2] ** 2)
        largest = math.sqrt(largest)
        scale = cap / largest if largest > cap else 1.0
        for k in range(start[begin], start[stop]):
            i = ids[k]
            for a in range(3):
                total[i, a] += scale * scratch[i, a]
                scratch[i, a] = 0.0
        begin = stop


@kernel
def mark_ring(neighbour_start, neighbours, seeds, rings, marked, stack):
    """Marks vertices within `rings` edges of the seeds; stack (V,) scratch."""
    count = 0
    for n in range(seeds.shape[0]):
        if not marked[seeds[n]]:
            marked[seeds[n]] = True
            stack[count] = seeds[n]
            count += 1
    start = 0
    for _ in range(rings):
        stop = count
        for n in range(start, stop):
            v = stack[n]
            for k in range(neighbour_start[v], neighbour_start[v + 1]):
                other = neighbours[k]
                if not marked[other]:
                    marked[other] = True
                    stack[count] = other
                    count += 1
        start = stop


@kernel
def ease(x, before, edges, near, inverse_masses, sweeps, chosen, lengths):
    """Gives back what corrections have stretched and squeezed: sweeps that bring edges (E, 2) between vertices `near` (V,) to
    the lengths that they had in `before` (V, 3) [m]; x (V, 3) changes.

    Each edge moves both its ends along itself, in inverse proportion to their masses, so linear and angular momentum stay.
    Scratch: chosen (E,) int64, lengths (E,).
    """
    count = 0
    for e in range(edges.shape[0]):
        i = edges[e, 0]
        j = edges[e, 1]
        if not (near[i] and near[j]) or inverse_masses[i] + inverse_masses[j] == 0.0:
            continue
        dx = before[j, 0] - before[i, 0]
        dy = before[j, 1] - before[i, 1]
        dz = before[j, 2] - before[i, 2]
        chosen[count] = e
        lengths[count] = math.sqrt(dx * dx + dy * dy + dz * dz)
        count += 1
    for sweep in range(sweeps):
        for n in range(count):
            # there and back, so that no end of the list is favoured
            m = n if sweep % 2 == 0 else count - 1 - n
            i = edges[chosen[m], 0]
            j = edges[chosen[m], 1]
            dx = x[j, 0] - x[i, 0]
            dy = x[j, 1] - x[i, 1]
            dz = x[j, 2] - x[i, 2]
            size = math.sqrt(dx * dx + dy * dy + dz * dz)
            if size == 0.0:
                continue
            pull = (size - lengths[m]) / (size * (inverse_masses[i] + inverse_masses[j]))
            one = inverse_masses[i] * pull
            two = inverse_masses[j] * pull
            x[i, 0] += one * dx
            x[i, 1] += one * dy
            x[i, 2] += one * dz
            x[j, 0] -= two * dx
            x[j, 1] -= two * dy
            x[j, 2] -= two * dz
