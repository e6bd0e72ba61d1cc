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
def refit(tree, projections, ends, axes, lengths, radius, dt, wide, mode, stale):
    """Boxes (N, 2 A) of all stale nodes, children before parents.

    Args:
        tree: reads corners and velocity cones, writes boxes.
        projections, ends: (V, A) of the positions, and of those at the end of the step (mode SWEPT; else unread).
        axes, lengths: (A, 3), (A,).
        radius: (V,) or (1,) for all: what a box holds around its vertices [m], half the distance of proximities.
        dt: time covered [s].
        wide: half-angle from which a cone has no direction [rad]: ORIENTED then takes max(eps / 2, speed dt) on all sides, as
            the paper prints it, CONSERVATIVE the sum.
        mode: one of the four above.
        stale: (N,) uint8.
    """
    same = radius.shape[0] == 1
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
            inner_low = low = math.inf
            inner_high = high = -math.inf
            for n in range(4):
                c = tree.corners[polygon, n]
                pad = radius[0 if same else c] * lengths[a] * (1.0 + 1e-12)
                at = projections[c, a]
                inner_low = min(inner_low, at)
                inner_high = max(inner_high, at)
                low = min(low, at - pad)
                high = max(high, at + pad)
                if mode == SWEPT:
                    low = min(low, ends[c, a] - pad)
                    high = max(high, ends[c, a] + pad)
            if directed:
                along = axes[a, 0] * nx + axes[a, 1] * ny + axes[a, 2] * nz
                if mode == ORIENTED:
                    high += max(along, 0.0) * travel
                    low -= max(-along, 0.0) * travel
                else:
                    high += directed_travel(along, lengths[a], cosine, sine) * travel
                    low -= directed_travel(-along, lengths[a], cosine, sine) * travel
            elif mode == ORIENTED:
                low = min(low, inner_low - travel * lengths[a])
                high = max(high, inner_high + travel * lengths[a])
            elif mode == CONSERVATIVE:
                low -= travel * lengths[a]
                high += travel * lengths[a]
            tree.boxes[node, 2 * a] = low
            tree.boxes[node, 2 * a + 1] = high


@kernel
def widest(tree, radius, stale):
    """Largest radius [m] of the vertices below each stale node, into `tree.radius` (N,); radius (V,) or (1,) for all."""
    for node in range(len(tree.child_count) - 1, -1, -1):
        if stale[node] == 0:
            continue
        most = 0.0
        if tree.child_count[node] > 0:
            first = tree.child_start[node]
            for child in range(first, first + tree.child_count[node]):
                most = max(most, tree.radius[child])
        else:
            for n in range(4):
                most = max(most, radius[0 if radius.shape[0] == 1 else tree.corners[tree.node_face[node], n]])
        tree.radius[node] = most


@kernel
def mark_stale(x, d, r, seen, seen_d, seen_r, start, members, tolerance, stale):
    """Groups that must be refitted because a vertex is further than the tolerance [m] from where its group's boxes saw it.

    x, d: positions and ways (V, 3) [m]; r: radii (V,) or (1,) for all [m], what they grew by counts as well; seen, seen_d,
    seen_r: those that the boxes hold, brought up to date here for every vertex of a group that must. start (G + 1,), members:
    vertices of each group, borders belong to several; stale (G,) uint8, written: a group that shares a vertex that changed is
    stale too. A way counts at both ends, so it is bounded in between.
    """
    fresh = np.zeros(x.shape[0], np.uint8)
    own = r.shape[0] == x.shape[0]
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
            limit = tolerance - max(0.0, r[i if own else 0] - seen_r[i if own else 0])
            if limit < 0.0 or near > limit * limit or far > limit * limit:
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
            if own:
                seen_r[i] = r[i]
    for g in range(len(stale)):
        if stale[g] == 0:
            for n in range(start[g], start[g + 1]):
                if fresh[members[n]] == 1:
                    stale[g] = 1
                    break
