"""The area scheme: a contour moves as a whole so that the regions that it cuts off lose area fastest.

The paper's other suggestion (3.2: "combine the intersection contour length reduction criterion with an intersection area
reduction criterion"), alone: what is long but straight has no slope in length, and the full slope in area.
"""

from __future__ import annotations

import numpy as np

from clothgym.arrays import BoolArray, FloatArray
from clothgym.detection.contours import Enclosed
from clothgym.kernels import pushes as kernels
from clothgym.response.untangling.base import (
    Context,
    Corrections,
    contour_gradients,
    displacements,
    marked,
    together,
)

_FLATTEST = 0.1
"""Sine of the angle of two faces below which they count as so steep: between parallel faces a contour moves infinitely fast."""


class Area:
    """Contours that cut nothing off follow the global scheme."""

    def propose(self, context: Context) -> Corrections:
        hits = context.intersections
        found = context.enclosed
        slopes, has = area_gradients(found)
        totals = contour_gradients(context)
        lengths = np.maximum(hits.contour_lengths, 1e-300)
        totals[has] = slopes[has] / lengths[has, None]
        return Corrections(displacements(context, together(context, totals)), marked(len(hits.vertices), found.inside))


def area_gradients(found: Enclosed) -> tuple[FloatArray, BoolArray]:
    """How fast the regions of each contour lose area when its side +1 moves against its side -1.

    Returns:
        (C, 3) [m] loss of area per displacement, and which contours cut off anything (C,).
    """
    hits = found.hits
    segments = kernels.Segments(
        hits.contour, hits.first_hit, hits.pair_faces, hits.segment_lengths, hits.hit_face, hits.hit_side
    )
    one, other = np.zeros((hits.contour_count, 3)), np.zeros((hits.contour_count, 3))
    kernels.area_slopes(hits.vertices, hits.surface.faces, segments, found.regions, _FLATTEST, one, other)
    return one + other, marked(hits.contour_count, found.contour)
