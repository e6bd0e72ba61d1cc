"""Global intersection analysis [Baraff 2003]: what lies in a region that went through is pulled back through the other surface.

Regions come from a flood fill; a vertex in one attracts the nearest point of the surface that it lies behind instead of keeping
away from it. Contours that cut nothing off cannot be decided: their surroundings are left alone ("flypaper").
"""

from __future__ import annotations

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.detection.contours import Enclosed
from clothgym.kernels import untangling as kernels
from clothgym.response.untangling.base import Context, Corrections, marked

_BEYOND = 0.1
"""Share of h0 that a vertex is pulled beyond the surface: on it, it would still be in the way."""

_SWEEPS = 8


class GlobalIntersectionAnalysis:
    """Pulls every inside vertex towards its nearest point of the surface, by at most h0."""

    def propose(self, context: Context) -> Corrections:
        hits = context.intersections
        found = context.enclosed
        total = np.zeros_like(hits.vertices)
        ids, shares, targets, group = _pulls(found, context.h0)
        if len(ids):
            start = np.arange(0, 4 * len(ids) + 1, 4)
            kernels.pull_stencils(
                start, ids.ravel(), shares.ravel(), targets, group, context.inverse_masses, _SWEEPS, context.h0, total
            )
        return Corrections(total, marked(len(total), found.inside))


def _pulls(found: Enclosed, h0: float) -> tuple[np.ndarray, FloatArray, FloatArray, np.ndarray]:
    """Vertices (N, 4) of each pull, an inside one and the face it goes to, their shares (N, 4), the relative displacement
    (N, 3) [m] and the contour (N,)."""
    x, faces = found.hits.vertices, found.hits.surface.faces
    behind, face, weights, distance = found.way_back
    sizes = np.diff(found.start)
    at = np.repeat(behind, sizes)
    vertices, group = found.inside[at], np.repeat(found.contour, sizes)[at]
    face, weights, distance = face[at], weights[at], distance[at]
    corners = faces[face]
    way = np.einsum("nk,nkc->nc", weights, x[corners]) - x[vertices]
    size = np.minimum(h0, distance + _BEYOND * h0) / np.maximum(distance, 1e-300)
    ids = np.column_stack([vertices, corners])
    return ids, np.column_stack([np.ones(len(vertices)), -weights]), way * size[:, None], group
