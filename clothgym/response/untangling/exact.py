"""The exact scheme: a step against the true gradient of the contour length, loop vertices included."""

from __future__ import annotations

import numpy as np

from clothgym.detection.contours import grouped
from clothgym.kernels import untangling as kernels
from clothgym.response.untangling.base import Context, Corrections

_STEEPEST = 1.0
"""kappa saturates here: where an edge nearly lies in a face, or two faces are nearly parallel, it grows without bound (up to 74
in a tangle whose median is 0.01), and one such hit would use up the whole stride of its contour."""


class Exact:
    """dx = beta M^-1 g per contour, beta = what would bring the length to zero if it were linear, or what h0 allows.

    Moves contours by their ends and pinches what cannot get out: a reference, no remedy.
    """

    def __init__(self, steepest: float = _STEEPEST) -> None:
        self.steepest = steepest

    def propose(self, context: Context) -> Corrections:
        hits = context.intersections
        s = hits.surface.arrays
        total = np.zeros_like(hits.vertices)
        kernels.exact_steps(
            s.faces,
            s.edges,
            kernels.Hits(hits.hit_edge, hits.hit_face, hits.parameters, hits.weights, *hits.by_contour),
            hits.frames,
            kernels.Strings(
                hits.first_hit,
                hits.second_hit,
                hits.loop_vertex,
                hits.segments,
                *grouped(hits.contour, hits.contour_count),
            ),
            self.steepest,
            context.inverse_masses,
            context.h0,
            total,
        )
        return Corrections(total)
