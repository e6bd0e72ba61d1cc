"""What a strategy is given and what it returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from clothgym.arrays import BoolArray, FloatArray
from clothgym.detection.contours import Enclosed
from clothgym.detection.intersections import Intersections
from clothgym.kernels import untangling as kernels


@dataclass(frozen=True)
class Context:
    """A tangled surface.

    Attributes:
        intersections: hits, contours and sides at the current vertices.
        inverse_masses: (V,) 0 = must not move.
        areas: (V,) rest area of each vertex [m^2].
        h0: largest displacement of a vertex by one contour [m].
        g0: gradient at which corrections saturate [Volino 2006, eq. 5].
        memory: (M,) numbers of a strategy with `memory_size` = M, its own to change: zero when a tangle begins, kept from pass
            to pass until it is resolved, part of the state of a simulation. Length 0 for all others, which are memoryless.
    """

    intersections: Intersections
    inverse_masses: FloatArray
    areas: FloatArray
    h0: float
    g0: float
    memory: FloatArray = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def enclosed(self) -> Enclosed:
        """The regions that contours cut off, by rest area; found when first asked for."""
        return Enclosed(self.intersections, self.areas)


@dataclass(frozen=True)
class Corrections:
    """Displacements (V, 3) [m], and vertices (V,) that contact should leave alone beyond the rings around hits."""

    displacements: FloatArray
    apart: BoolArray | None = None


def displacements(context: Context, targets: FloatArray, strides: FloatArray | None = None) -> FloatArray:
    """Vertex displacements (V, 3) that give each hit its relative displacement (H, 3) of edge against face.

    The sum over the hits of a contour is scaled as a whole so that no vertex moves further than h0, or than the contour's
    own stride (C,) [m]; linear and angular momentum of free vertices are kept.
    """
    hits = context.intersections
    s = hits.surface.arrays
    total = np.zeros_like(hits.vertices)
    kernels.distribute(
        s.faces,
        s.edges,
        context.inverse_masses,
        hits.hit_edge,
        hits.hit_face,
        hits.parameters,
        hits.weights,
        targets,
        hits.by_contour[0],
        hits.hit_contour,
        np.full(hits.contour_count, context.h0) if strides is None else strides,
        total,
    )
    return total


def contour_gradients(context: Context) -> FloatArray:
    """(C, 3) sum of s_h G_h over the hits of each contour [Volino 2006, 2.3]."""
    hits = context.intersections
    totals = np.zeros((hits.contour_count, 3))
    kernels.contour_gradients(hits.frames, hits.hit_contour, hits.hit_side, totals)
    return totals


def together(context: Context, totals: FloatArray) -> FloatArray:
    """(H, 3) relative displacement of each hit along a direction of its whole contour, totals (C, 3), by eq. 5.

    A contour whose sides cannot be told apart has no common direction and is left to the local scheme.
    """
    hits = context.intersections
    targets = np.empty((hits.hit_count, 3))
    kernels.global_targets(totals, hits.hit_contour, hits.hit_side, context.h0, context.g0, targets)
    if not hits.contour_consistent.all():
        broken = ~hits.contour_consistent[hits.hit_contour]
        targets[broken] = local_targets(context)[broken]
    return targets


def global_targets(context: Context) -> FloatArray:
    """(H, 3) relative displacement of each hit from the summed gradient of its contour [Volino 2006, 2.3]."""
    return together(context, contour_gradients(context))


def local_targets(context: Context) -> FloatArray:
    """(H, 3) relative displacement of each hit from its own gradient [Volino 2006, 2.2]."""
    hits = context.intersections
    targets = np.empty((hits.hit_count, 3))
    kernels.local_targets(hits.frames, context.h0, context.g0, targets)
    return targets


def marked(count: int, vertices: np.ndarray) -> BoolArray:
    """(count,) true at these vertices."""
    mask = np.zeros(count, np.bool_)
    mask[vertices] = True
    return mask
