"""The hybrid scheme: contours that cut off a region push it back through, all others follow the global scheme.

The paper's own suggestion (3.2: "identify intersection regions whenever possible") with the flood fill of Baraff 2003.
"""

from __future__ import annotations

from clothgym.arrays import FloatArray
from clothgym.detection.contours import Enclosed
from clothgym.response.untangling.base import (
    Context,
    Corrections,
    displacements,
    enclosed,
    global_targets,
    marked,
    mean_direction,
)


class Hybrid:
    """Where the two ends of a cut edge lie in different regions, the end in the smaller one is inside and goes back."""

    def propose(self, context: Context) -> Corrections:
        found = enclosed(context)
        moved = displacements(context, hybrid_targets(context, found))
        return Corrections(moved, marked(len(moved), found.inside))


def hybrid_targets(context: Context, found: Enclosed) -> FloatArray:
    """(H, 3) relative displacement of each hit."""
    hits = context.intersections
    targets = global_targets(context)
    separated = found.inside_end >= 0
    directions = found.outward()
    mean = mean_direction(context, directions, separated)
    # hits on a side that does not separate go with the others of their contour
    beside = ~separated & marked(hits.contour_count, hits.hit_contour[separated])[hits.hit_contour]
    directions[beside] = hits.hit_side[beside, None] * mean[hits.hit_contour[beside]]
    pushed = separated | beside
    targets[pushed] = context.h0 * directions[pushed]
    return targets
