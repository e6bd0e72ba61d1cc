"""The hybrid scheme: contours that cut off a region push it back through, all others follow the global scheme.

The paper's own suggestion (3.2: "identify intersection regions whenever possible") with the flood fill of Baraff 2003.
"""

from __future__ import annotations

import numpy as np

from clothgym.arrays import BoolArray, FloatArray
from clothgym.kernels import untangling as kernels
from clothgym.response.untangling.base import Context, Corrections, displacements, global_targets


class Hybrid:
    """Where the two ends of a cut edge lie in different regions, the end in the smaller one is inside and goes back."""

    def propose(self, context: Context) -> Corrections:
        targets = global_targets(context)
        inside = np.zeros(len(context.areas), np.bool_)
        hits = context.intersections
        order = np.argsort(hits.hit_contour, kind="stable")
        bounds = np.cumsum(np.r_[0, np.bincount(hits.hit_contour, minlength=hits.contour_count)])
        flood = _Flood(context)
        for c in range(hits.contour_count):
            if not hits.contour_consistent[c]:
                continue
            members = order[bounds[c] : bounds[c + 1]]
            directions, separated = flood.directions(members, inside)
            if not separated.any():
                continue
            sides = hits.hit_side[members]
            mean = (sides[separated, None] * directions[separated]).mean(axis=0)
            size = float(np.linalg.norm(mean))
            directions[~separated] = sides[~separated, None] * (mean / size if size > 0 else mean)
            targets[members] = context.h0 * directions
        return Corrections(displacements(context, targets), inside)


class _Flood:
    """Flood fill over the mesh, one contour at a time, with buffers that are cleaned after each."""

    def __init__(self, context: Context) -> None:
        self.context = context
        surface = context.intersections.surface
        count = len(context.areas)
        self.neighbourhood = surface.neighbourhood
        self.edges = surface.edges
        self.cut = np.zeros(len(surface.edges), np.bool_)
        self.label = np.full(count, -1, np.int64)
        self.stack = np.empty(count, np.int64)

    def directions(self, members: np.ndarray, inside: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Unit direction (M, 3) in which each hit's edge goes back, and which hits have one; marks inside vertices."""
        hits = self.context.intersections
        hit_edges = hits.hit_edge[members]
        ids, counts = np.unique(hit_edges, return_counts=True)
        cut_edges = ids[counts % 2 == 1]
        directions, separated = np.zeros((len(members), 3)), np.zeros(len(members), np.bool_)
        if len(cut_edges) == 0:
            return directions, separated
        self.cut[cut_edges] = True
        region_area = np.zeros(2 * len(cut_edges))
        start, neighbours, neighbour_edges = self.neighbourhood
        regions = kernels.cut_regions(
            start, neighbours, neighbour_edges, self.context.areas, self.edges, self.cut, cut_edges, self.label,
            self.stack, region_area,
        )  # fmt: skip
        e0, e1 = self.edges[hit_edges, 0], self.edges[hit_edges, 1]
        r0, r1 = self.label[e0], self.label[e1]
        separated = self.cut[hit_edges] & (r0 != r1)
        first_inside = region_area[r0] < region_area[r1]
        out, back = np.where(first_inside, e1, e0), np.where(first_inside, e0, e1)
        x = hits.vertices
        normals = hits.frames[members, 3:6]
        along = np.einsum("ij,ij->i", x[out] - x[back], normals)
        directions = np.where(along[:, None] >= 0, normals, -normals) * separated[:, None]
        small = np.zeros(regions, np.bool_)
        small[np.where(first_inside, r0, r1)[separated]] = True
        labelled = self.label >= 0
        inside[labelled] |= small[self.label[labelled]]
        self.label[labelled] = -1
        self.cut[cut_edges] = False
        return directions, separated
