"""The hybrid scheme: contours that cut off a region push it back through, all others follow the global scheme.

The paper's own suggestion (3.2: "identify intersection regions whenever possible") with the flood fill of Baraff 2003.
"""

from __future__ import annotations

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.detection.contours import Enclosed
from clothgym.kernels import pushes as kernels
from clothgym.response.untangling.base import (
    Context,
    Corrections,
    displacements,
    global_targets,
    marked,
)


class Hybrid:
    """Where the two ends of a cut edge lie in different regions, the end in the smaller one is inside and goes back."""

    def propose(self, context: Context) -> Corrections:
        found = context.enclosed
        moved = displacements(context, hybrid_targets(context, found))
        return Corrections(moved, marked(len(moved), found.inside))


def hybrid_targets(context: Context, found: Enclosed) -> FloatArray:
    """(H, 3) relative displacement of each hit."""
    hits = context.intersections
    targets = global_targets(context)
    kernels.push_out(
        hits.vertices,
        hits.surface.edges,
        hits.hit_edge,
        hits.frames,
        hits.hit_contour,
        hits.hit_side,
        found.inside_end,
        context.h0,
        np.zeros((hits.contour_count, 4)),
        targets,
    )
    return targets
