"""The flatten scheme: the hybrid scheme, and folds at dead ends are smoothed.

A contour of a surface with itself may end inside it, at a vertex around which the surface is folded. Length and area pull both
sides of the fold against each other there; what resolves it is to flatten the fold [Volino 2006, 3.2: "local
surface-flattening methods"].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import FloatArray
from clothgym.detection.contours import Enclosed
from clothgym.kernels import untangling as kernels
from clothgym.response.untangling.base import Context, Corrections, displacements, marked
from clothgym.response.untangling.hybrid import hybrid_targets

_ENOUGH = 1.2
"""Of the way out that a contour at a fold is pushed."""

_SHARE = 0.5
"""Of the way from a vertex to the mean of its neighbours that it is moved; all of it overshoots where neighbours move too."""


class Flatten:
    """Loop vertices and their neighbours move towards the mean of their own neighbours, which move against them; contours that
    end there push no further than their regions reach, because beside a fold everything is near the wrong side."""

    def propose(self, context: Context) -> Corrections:
        found = context.enclosed
        targets = hybrid_targets(context, found)
        loops = np.flatnonzero(context.intersections.loop_vertex >= 0)
        if len(loops) == 0:
            moved = displacements(context, targets)
        else:
            strides = reach(context, found, loops, targets)
            moved = displacements(context, targets, strides) + flattening(context, loops)
        return Corrections(moved, marked(len(moved), found.inside))


def reach(context: Context, found: Enclosed, loops: NDArray[np.int64], targets: FloatArray) -> FloatArray:
    """(C,) [m] stride of each contour: h0, or, of those that end at loop vertices, a little more than the farthest inside end
    of their edges has to go; their targets (H, 3) [m] shrink as much. `loops`: the segments that end there."""
    hits = context.intersections
    at = np.flatnonzero(marked(hits.contour_count, hits.contour[loops])[hits.hit_contour])
    contour, end, x = hits.hit_contour[at], found.inside_end[at], hits.vertices
    inner = hits.surface.edges[hits.hit_edge[at], np.where(end == 0, 0, 1)]
    way = np.abs(np.einsum("ij,ij->i", x[inner] - hits.points[at], hits.frames[at, 3:6])) * (end >= 0)
    farthest = np.zeros(hits.contour_count)
    np.maximum.at(farthest, contour, way)
    strides = np.where(farthest > 0.0, np.minimum(_ENOUGH * farthest, context.h0), context.h0)
    targets[at] *= (strides / context.h0)[contour, None]
    return strides


def flattening(context: Context, loops: NDArray[np.int64]) -> FloatArray:
    """(V, 3) displacements [m] that smooth the surface around the loop vertices of these segments; both momenta are kept."""
    hits = context.intersections
    total = np.zeros_like(hits.vertices)
    begin, neighbours, _ = hits.surface.neighbourhood
    centres, group = [], []
    for loop in loops:
        v = hits.loop_vertex[loop]
        ring = np.concatenate([[v], neighbours[begin[v] : begin[v + 1]]])
        centres.append(ring)
        group.append(np.full(len(ring), hits.contour[loop]))
    pairs = np.unique(np.column_stack([np.concatenate(group), np.concatenate(centres)]), axis=0)
    start, ids, shares, targets = [0], [], [], []
    for v in pairs[:, 1]:
        ring = neighbours[begin[v] : begin[v + 1]]
        ids.append(np.concatenate([[v], ring]))
        shares.append(np.concatenate([[1.0], np.full(len(ring), -1.0 / len(ring))]))
        way = _SHARE * (hits.vertices[ring].mean(axis=0) - hits.vertices[v])
        size = float(np.linalg.norm(way))
        targets.append(way * min(1.0, context.h0 / size) if size > 0.0 else way)
        start.append(start[-1] + len(ids[-1]))
    kernels.pull_stencils(
        np.array(start),
        np.concatenate(ids).astype(np.int64),
        np.concatenate(shares),
        np.array(targets),
        np.ascontiguousarray(pairs[:, 0]),
        context.inverse_masses,
        1,
        context.h0,
        total,
    )
    return total
