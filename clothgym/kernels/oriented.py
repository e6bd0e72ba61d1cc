"""Inflation of the boxes of a hierarchy: by a distance, or along the way that is expected [Mezger 2003, 3.2-3.3].

Leaves are inflated by their own velocity cones and parents hold their children (eq. 2). Intervals are unnormalised, so every
distance is times |n|; the paper's eq. 1 has eps / 2 for unit normals only.
"""

from __future__ import annotations

import math

import numpy as np

from clothgym._jit import device, kernel

UNORIENTED, ORIENTED, CONSERVATIVE, SWEPT = 0, 1, 2, 3
"""eps / 2; eq. 1 as printed; eq. 1 with the half-angle of the cone; a box around both ends of the way."""

INFLATIONS = {"unoriented": UNORIENTED, "oriented": ORIENTED, "conservative": CONSERVATIVE, "swept": SWEPT}


@kernel
def project(x, axes, projections):
    """n . x of all vertices: x (V, 3), axes (A, 3), projections (V, A)."""
    for v in range(x.shape[0]):
        for a in range(axes.shape[0]):
            projections[v, a] = axes[a, 0] * x[v, 0] + axes[a, 1] * x[v, 1] + axes[a, 2] * x[v, 2]


@device
def directed_travel(along, length, cosine, sine):
    """How far, as a share of speed times time and times |n|, a cone of directions reaches along n.

    along: n . axis; length: |n|; cosine and sine of the half-angle. The direction of the cone nearest to n counts, which is n
    itself if n lies inside.
    """
    share = along / length
    if share >= cosine:
        return length
    across = math.sqrt(max(1.0 - share * share, 0.0))
    return length * max(share * cosine + across * sine, 0.0)


@kernel
def refit(tree, projections, ends, axes, lengths, eps, dt, wide, mode, stale):
    """Boxes (N, 2 A) of all stale nodes, children before parents.

    Args:
        tree: reads corners and velocity cones, writes boxes.
        projections, ends: (V, A) of the positions, and of those at the end of the step (mode SWEPT; else unread).
        axes, lengths: (A, 3), (A,).
        eps: distance at which proximities are wanted [m]; a box takes half of it.
        dt: time covered [s].
        wide: half-angle from which a cone has no direction [rad]: ORIENTED then takes max(eps / 2, speed dt) on all sides, as
            the paper prints it, CONSERVATIVE the sum.
        mode: one of the four above.
        stale: (N,) uint8.
    """
    for node in range(len(tree.child_count) - 1, -1, -1):
        if stale[node] == 0:
            continue
        if tree.child_count[node] > 0:
            first = tree.child_start[node]
            last = first + tree.child_count[node]
            for k in range(0, 2 * len(lengths), 2):
                low = tree.boxes[first, k]
                high = tree.boxes[first, k + 1]
                for child in range(first + 1, last):
                    low = min(low, tree.boxes[child, k])
                    high = max(high, tree.boxes[child, k + 1])
                tree.boxes[node, k] = low
                tree.boxes[node, k + 1] = high
            continue
        polygon = tree.node_face[node]
        c0, c1, c2, c3 = (
            tree.corners[polygon, 0],
            tree.corners[polygon, 1],
            tree.corners[polygon, 2],
            tree.corners[polygon, 3],
        )
        travel = 0.0
        directed = False
        cosine = sine = nx = ny = nz = 0.0
        if mode == ORIENTED or mode == CONSERVATIVE:
            travel = tree.speed_high[node] * dt
            half = tree.speed_half[node]
            directed = half < wide
            nx, ny, nz = tree.speed_axis[node, 0], tree.speed_axis[node, 1], tree.speed_axis[node, 2]
            cosine = math.cos(half)
            sine = math.sin(half)
        for a in range(len(lengths)):
            low = min(projections[c0, a], projections[c1, a], projections[c2, a], projections[c3, a])
            high = max(projections[c0, a], projections[c1, a], projections[c2, a], projections[c3, a])
            pad = 0.5 * eps * lengths[a] * (1.0 + 1e-12)
            below = pad
            above = pad
            if mode == SWEPT:
                low = min(low, ends[c0, a], ends[c1, a], ends[c2, a], ends[c3, a])
                high = max(high, ends[c0, a], ends[c1, a], ends[c2, a], ends[c3, a])
            elif directed:
                along = axes[a, 0] * nx + axes[a, 1] * ny + axes[a, 2] * nz
                if mode == ORIENTED:
                    above += max(along, 0.0) * travel
                    below += max(-along, 0.0) * travel
                else:
                    above += directed_travel(along, lengths[a], cosine, sine) * travel
                    below += directed_travel(-along, lengths[a], cosine, sine) * travel
            elif mode == ORIENTED:
                above = max(pad, travel * lengths[a])
                below = above
            elif mode == CONSERVATIVE:
                above += travel * lengths[a]
                below = above
            tree.boxes[node, 2 * a] = low - below
            tree.boxes[node, 2 * a + 1] = high + above


@kernel
def mark_stale(x, d, seen, seen_d, start, members, tolerance, stale):
    """Groups that must be refitted because a vertex is further than the tolerance [m] from where its group's boxes saw it.

    x, d: positions and ways (V, 3) [m]; seen, seen_d: those that the boxes hold, brought up to date here for every vertex of a
    group that must. start (G + 1,), members: vertices of each group, borders belong to several; stale (G,) uint8, written: a
    group that shares a vertex that changed is stale too. A way counts at both ends, so it is bounded in between.
    """
    fresh = np.zeros(x.shape[0], np.uint8)
    limit = tolerance * tolerance
    for g in range(len(stale)):
        stale[g] = 0
        for n in range(start[g], start[g + 1]):
            i = members[n]
            near = 0.0
            far = 0.0
            for k in range(3):
                gap = x[i, k] - seen[i, k]
                near += gap * gap
                gap += d[i, k] - seen_d[i, k]
                far += gap * gap
            if near > limit or far > limit:
                stale[g] = 1
                break
    for g in range(len(stale)):
        if stale[g] == 1:
            for n in range(start[g], start[g + 1]):
                fresh[members[n]] = 1
    for i in range(x.shape[0]):
        if fresh[i] == 1:
            for k in range(3):
                seen[i, k] = x[i, k]
                seen_d[i, k] = d[i, k]
    for g in range(len(stale)):
        if stale[g] == 0:
            for n in range(start[g], start[g + 1]):
                if fresh[members[n]] == 1:
                    stale[g] = 1
                    break
