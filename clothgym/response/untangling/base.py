"""What a strategy is given and what it returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clothgym.arrays import BoolArray, FloatArray
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
    """

    intersections: Intersections
    inverse_masses: FloatArray
    areas: FloatArray
    h0: float
    g0: float


@dataclass(frozen=True)
class Corrections:
    """Displacements (V, 3) [m], and vertices (V,) that contact should leave alone beyond the rings around hits."""

    displacements: FloatArray
    apart: BoolArray | None = None


def displacements(context: Context, targets: FloatArray) -> FloatArray:
    """Vertex displacements (V, 3) that give each hit its relative displacement (H, 3) of edge against face.

    The sum over the hits of a contour is scaled as a whole so that no vertex moves further than h0; linear and angular
    momentum of free vertices are kept.
    """
    hits = context.intersections
    s = hits.surface.arrays
    total = np.zeros_like(hits.vertices)
    order = np.argsort(hits.hit_contour, kind="stable")
    kernels.distribute(
        s.faces,
        s.edges,
        context.inverse_masses,
        hits.hit_edge,
        hits.hit_face,
        hits.parameters,
        hits.weights,
        targets,
        order,
        hits.hit_contour,
        context.h0,
        total,
    )
    return total


def global_targets(context: Context) -> FloatArray:
    """(H, 3) relative displacement of each hit from the summed gradient of its contour [Volino 2006, 2.3]."""
    hits = context.intersections
    totals = np.zeros((hits.contour_count, 3))
    kernels.contour_gradients(hits.frames, hits.hit_contour, hits.hit_side, totals)
    targets = np.empty((hits.hit_count, 3))
    kernels.global_targets(totals, hits.hit_contour, hits.hit_side, context.h0, context.g0, targets)
    broken = ~hits.contour_consistent[hits.hit_contour]
    if broken.any():  # sides that cannot be told apart have no common direction
        targets[broken] = local_targets(context)[broken]
    return targets


def local_targets(context: Context) -> FloatArray:
    """(H, 3) relative displacement of each hit from its own gradient [Volino 2006, 2.2]."""
    hits = context.intersections
    targets = np.empty((hits.hit_count, 3))
    kernels.local_targets(hits.frames, context.h0, context.g0, targets)
    return targets
