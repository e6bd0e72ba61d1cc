"""The coherence scheme: contours whose gradients agree move as a whole, in all others every hit goes its own way."""

from __future__ import annotations

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.response.untangling.base import (
    Context,
    Corrections,
    contour_gradients,
    displacements,
    local_targets,
    together,
)

_AGREEING = 0.5
"""Least coherence at which a contour moves as a whole; in tangled squares its median is 0.65, its first decile 0.33."""


class Coherence:
    """Coherence of a contour = |sum s G| / sum |G|: 1 = all hits pull the same way, 0 = their pulls cancel."""

    def propose(self, context: Context) -> Corrections:
        hits = context.intersections
        totals = contour_gradients(context)
        apart = coherence(context, totals) < _AGREEING
        targets = together(context, totals)
        alone = apart[hits.hit_contour]
        targets[alone] = local_targets(context)[alone]
        return Corrections(displacements(context, targets))


def coherence(context: Context, totals: FloatArray) -> FloatArray:
    """(C,) coherence of each contour, from its summed gradient totals (C, 3); 1 where no hit pulls at all."""
    hits = context.intersections
    gradients = hits.frames[:, :3] - 2.0 * hits.frames[:, 6:7] * hits.frames[:, 3:6]
    sizes = np.bincount(hits.hit_contour, np.linalg.norm(gradients, axis=1), minlength=hits.contour_count)
    return np.where(sizes > 0.0, np.linalg.norm(totals, axis=1) / np.where(sizes > 0.0, sizes, 1.0), 1.0)
