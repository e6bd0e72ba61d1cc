"""The area scheme: a contour moves as a whole so that the regions that it cuts off lose area fastest.

The paper's other suggestion (3.2: "combine the intersection contour length reduction criterion with an intersection area
reduction criterion"), alone: what is long but straight has no slope in length, and the full slope in area.
"""

from __future__ import annotations

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.detection.contours import Enclosed
from clothgym.detection.intersections import Intersections
from clothgym.response.untangling.base import (
    Context,
    Corrections,
    contour_gradients,
    displacements,
    enclosed,
    marked,
    together,
)

_FLATTEST = 0.1
"""Sine of the angle of two faces below which they count as so steep: between parallel faces a contour moves infinitely fast."""


class Area:
    """Contours that cut nothing off follow the global scheme."""

    def propose(self, context: Context) -> Corrections:
        hits = context.intersections
        found = enclosed(context)
        slopes, has = area_gradients(found)
        totals = contour_gradients(context)
        lengths = np.maximum(hits.contour_lengths, 1e-300)
        totals[has] = slopes[has] / lengths[has, None]
        return Corrections(displacements(context, together(context, totals)), marked(len(hits.vertices), found.inside))


def area_gradients(found: Enclosed) -> tuple[FloatArray, np.ndarray]:
    """How fast the regions of each contour lose area when its side +1 moves against its side -1.

    Of a segment of length l between faces A and B, the region on B loses l N_A.D / sin(A, B) when B moves by D against A,
    with N_A turned to where the outside of the region is.

    Returns:
        (C, 3) [m] loss of area per displacement, and which contours cut off anything (C,).
    """
    hits = found.hits
    out = found.outward()
    normals = hits.frames[:, 3:6]
    slopes = np.zeros((hits.contour_count, 3))
    for hit in (hits.first_hit, hits.second_hit):
        whole = hit >= 0
        h = hit[whole]
        # the faces of the segment: the one that this hit pierces, and the one that its edge belongs to
        pair = hits.pair_faces[whole]
        carrier = np.where(pair[:, 0] == hits.hit_face[h], pair[:, 1], pair[:, 0])
        across = np.linalg.norm(np.cross(normals[h], _normals(hits, carrier)), axis=1)
        weight = 0.5 * hits.segment_lengths[whole] / np.maximum(across, _FLATTEST)
        pull = (weight * hits.hit_side[h])[:, None] * out[h]
        for axis in range(3):
            slopes[:, axis] += np.bincount(hits.hit_contour[h], pull[:, axis], minlength=hits.contour_count)
    return slopes, marked(hits.contour_count, found.contour)


def _normals(hits: Intersections, faces: np.ndarray) -> FloatArray:
    """(N, 3) unit normals of faces, 0 where they have no area."""
    x, corners = hits.vertices, hits.surface.faces[faces]
    normals = np.cross(x[corners[:, 1]] - x[corners[:, 0]], x[corners[:, 2]] - x[corners[:, 0]])
    size = np.linalg.norm(normals, axis=1)
    return normals / np.where(size > 0.0, size, 1.0)[:, None]
