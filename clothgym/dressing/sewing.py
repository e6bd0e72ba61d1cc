"""Closing a garment around a body.

Springs along the seams, as in [Vassilev 2001], stall where the two sides meet inside a limb. Here every seam is welded at
its midpoints first, so that it is closed by construction, and the edges that this stretched are shortened on a ramp:
the panels are drawn around the body instead of being pulled into it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.detection.body_maps import BodyMaps
from clothgym.garment import Garment
from clothgym.kernels import sewing
from clothgym.mesh import Mesh, Surface
from clothgym.response.body import body_contact
from clothgym.rest import RestShape

RAMP = 150
"""Iterations in which over-long edges come down to their rest lengths."""
_AFTER = 60
_KEEP = 0.9
_SWEEPS = 6
_CHUNK = 15
_ORDER_SEED = 0


def _shape(garment: Garment) -> tuple[Surface, RestShape]:
    corners = np.concatenate([garment.rest_corners, np.zeros((len(garment.faces), 3, 1))], axis=2)
    mesh = Mesh(garment.vertices, garment.faces)
    return Surface(garment.faces, len(garment.vertices)), RestShape(mesh, corners)


def rest_of(garment: Garment) -> tuple[Surface, FloatArray]:
    """Topology of a garment and the rest length of every edge (E,) [m]."""
    surface, shape = _shape(garment)
    return surface, shape.edge_lengths(surface)


def opening_lengths(garment: Garment) -> list[float]:
    """Rest length [m] of each opening."""
    surface, rest = rest_of(garment)
    length = {(int(a), int(b)): float(r) for (a, b), r in zip(surface.edges, rest)}
    return [
        sum(length[min(a, b), max(a, b)] for a, b in zip(loop.tolist(), np.roll(loop, -1).tolist()))
        for loop in garment.openings
    ]


def sew(
    garment: Garment,
    maps: BodyMaps,
    tolerance: float,
    progress: Callable[[float, float], None] | None = None,
) -> FloatArray:
    """Positions (V, 3) [m] of the closed garment around the body.

    Args:
        garment: welded, where its panels are placed.
        maps: of the body.
        tolerance: distance that vertices keep from the body [m].
        progress: called with the iterations done and all of them.
    """
    surface, shape = _shape(garment)
    # vertices opposite an edge keep their distance too: without it the drawn-in cloth folds and crosses itself
    across, across_rest = shape.opposite_lengths(surface)
    ends = np.concatenate([surface.edges, across])
    rest = np.concatenate([shape.edge_lengths(surface), across_rest])
    # sweeps in the order of the mesh would draw everything to one side
    order = np.random.default_rng(_ORDER_SEED).permutation(len(ends))
    ends, rest = np.ascontiguousarray(ends[order], np.int32), rest[order]
    x = np.array(garment.vertices)
    before, p = x.copy(), np.empty_like(x)
    start = np.linalg.norm(x[ends[:, 1]] - x[ends[:, 0]], axis=1)
    weights = np.ones(len(x))
    # faces are left out: a face across a limb would throw its corners about
    contact = body_contact(maps.map, garment.faces, len(x), tolerance, face_parts=0)
    total = RAMP + _AFTER
    for first in range(0, total, _CHUNK):
        sewing.close_seams(
            x, before, p, weights, ends, rest, start, first, min(_CHUNK, total - first), RAMP, _KEEP, _SWEEPS, contact
        )  # fmt: skip
        if progress is not None:
            progress(min(first + _CHUNK, total), total)
    return x
