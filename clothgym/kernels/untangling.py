"""Corrections of intersection contour minimization [Volino 2006, eq. 4 and 5] and the flood fill of cut regions."""

from __future__ import annotations

import math

import numpy as np

from clothgym._jit import device, kernel


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
    faces, edges, inverse_masses, hit_edge, hit_face, parameters, weights, targets, order, contour, cap, total
):
    """Moves edges and faces so that each hit gets its relative displacement; linear and angular momentum are kept.

    dx_i = q_i c_i H / sum_j c_j^2 q_j with c = (1 - t, t, -w). The sum over a contour's hits is scaled as a whole so that
    no vertex moves further than `cap` [m]. `order` (H,) lists the hits by contour; adds to total (V, 3) [m].
    """
    scratch = np.zeros(total.shape, np.float64)
    touched = np.empty(5 * hit_edge.shape[0], np.int64)
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
                touched[used] = ids[k]
                used += 1
                for c in range(3):
                    scratch[ids[k], c] += g * targets[h, c]
        largest = 0.0
        for n in range(used):
            i = touched[n]
            largest = max(largest, scratch[i, 0] ** 2 + scratch[i, 1] ** 2 + scratch[i, 2] ** 2)
        largest = math.sqrt(largest)
        scale = cap / largest if largest > cap else 1.0
        for n in range(used):
            i = touched[n]
            for c in range(3):
                total[i, c] += scale * scratch[i, c]
                scratch[i, c] = 0.0
        start = stop


@kernel
def cut_regions(neighbour_start, neighbours, neighbour_edges, areas, edges, cut, cut_edges, label, stack, region_area):
    """Floods the vertices beside cut edges without crossing a cut edge.

    cut (E,) marks edges that the contour crosses an odd number of times, cut_edges (K,) lists them. Writes label (V,)
    region ids for reached vertices (others keep -1) and region_area [m^2]; returns the number of regions.
    """
    regions = 0
    for n in range(cut_edges.shape[0]):
        for end in range(2):
            seed = edges[cut_edges[n], end]
            if label[seed] >= 0:
                continue
            area = 0.0
            top = 1
            stack[0] = seed
            label[seed] = regions
            while top > 0:
                top -= 1
                v = stack[top]
                area += areas[v]
                for k in range(neighbour_start[v], neighbour_start[v + 1]):
                    other = neighbours[k]
                    if label[other] < 0 and not cut[neighbour_edges[k]]:
                        label[other] = regions
                        stack[top] = other
                        top += 1
            region_area[regions] = area
            regions += 1
    return regions


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
