"""The annealed scheme: global, with strides that shrink with what is left of each contour."""

from __future__ import annotations

import numpy as np

from clothgym.response.untangling.base import Context, Corrections, displacements, global_targets

_LONG = 8.0
"""A contour of this many h0 takes full strides."""

_LEAST = 0.2
"""Share of h0 that the shortest contour still takes."""


class Annealed:
    """Large tangles are pulled apart in large strides, small ones are not thrown across. Memoryless: the length tells."""

    def propose(self, context: Context) -> Corrections:
        hits = context.intersections
        strides = context.h0 * np.clip(hits.contour_lengths / (_LONG * context.h0), _LEAST, 1.0)
        targets = global_targets(context) * (strides / context.h0)[hits.hit_contour, None]
        return Corrections(displacements(context, targets, strides))
