"""The area scheme: a contour moves as a whole so that the regions that it cuts off lose area fastest.

The paper's other suggestion (3.2: "combine the intersection contour length reduction criterion with an intersection area
reduction criterion"), alone: what is long but straight has no slope in length, and the full slope in area.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import BoolArray, FloatArray
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


def area_gradients(found: Enclosed) -> tuple[FloatArray, BoolArray]:
    """How fast the regions of each contour lose area when its side +1 moves against its side -1.

    Of a segment of length l between faces A and B, the region on B loses l N_A.D / sin(A, B) when B moves by D against A, with
    N_A turned to where B's corners outside of the region are.

    Returns:
        (C, 3) [m] loss of area per displacement, and which contours cut off anything (C,).
    """
    hits = found.hits
    has = marked(hits.contour_count, found.contour)
    segments = np.flatnonzero(has[hits.contour])
    # the first hit of a segment pierces face A with an edge of face B
    h = hits.first_hit[segments]
    a = hits.hit_face[h]
    b = hits.pair_faces[segments].sum(axis=1) - a
    normals = _normals(hits, a), _normals(hits, b)
    across = np.cross(*normals)
    weight = hits.segment_lengths[segments] / np.maximum(np.sqrt(np.einsum("ij,ij->i", across, across)), _FLATTEST)
    contour = hits.contour[segments]
    side = hits.hit_side[h]
    slopes = np.zeros((hits.contour_count, 3))
    for face, other, own in ((b, normals[0], side), (a, normals[1], -side)):
        way = np.einsum("ij,ij->i", other, _outward(found, face, contour, own))
        pull = (weight * own * np.sign(way))[:, None] * other
        for axis in range(3):
            slopes[:, axis] += np.bincount(contour, pull[:, axis], minlength=hits.contour_count)
    return slopes, has


def _outward(found: Enclosed, faces: NDArray[Any], contour: NDArray[np.int64], side: NDArray[Any]) -> FloatArray:
    """(S, 3) from the corners of faces (S,) that lie in a region of that side of a contour to those that do not; 0 where all
    or none do."""
    hits = found.hits
    count = len(hits.vertices)
    sizes = np.diff(found.start)
    of_region = (3 * found.contour + found.side.astype(np.int64) + 1) * count
    inside = np.repeat(of_region, sizes) + found.inside
    corners = hits.surface.faces[faces].astype(np.int64)
    within = np.zeros(corners.shape, np.bool_)
    for where in (side.astype(np.int64), np.zeros(len(side), np.int64)):
        within |= np.isin((3 * contour + where + 1)[:, None] * count + corners, inside)
    number = within.sum(axis=1)
    mixed = (number > 0) & (number < 3)
    share = np.where(within, -1.0 / np.maximum(number, 1)[:, None], 1.0 / np.maximum(3 - number, 1)[:, None])
    return np.einsum("sk,skc->sc", share * mixed[:, None], hits.vertices[corners])


def _normals(hits: Intersections, faces: NDArray[Any]) -> FloatArray:
    """(N, 3) unit normals of faces, 0 where they have no area."""
    x, corners = hits.vertices, hits.surface.faces[faces]
    normals = np.cross(x[corners[:, 1]] - x[corners[:, 0]], x[corners[:, 2]] - x[corners[:, 0]])
    size = np.linalg.norm(normals, axis=1)
    return normals / np.where(size > 0.0, size, 1.0)[:, None]
