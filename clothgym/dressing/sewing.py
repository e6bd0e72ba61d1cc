"""Closing a garment around a body.

Forces along the seams, as in [Vassilev 2001], may stall where the two sides meet inside a limb. By default every seam is
welded at its midpoints first, so that it is closed by construction, and the edges that this stretched are shortened on a
ramp: the panels are drawn around the body instead of being pulled into it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from clothgym.arrays import FloatArray, IntArray, check_choice
from clothgym.detection.body_maps import BodyMaps
from clothgym.garment import Garment
from clothgym.kernels import sewing
from clothgym.mesh import Mesh, Surface
from clothgym.response.body import body_contact
from clothgym.rest import RestShape

CLOSINGS = ("weld", "forces")

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
    closing: str = "weld",
) -> tuple[FloatArray, float]:
    """Positions (V, 3) [m] of the closed garment around the body, and the widest gap that was left to weld [m].

    Args:
        garment: where its panels are placed.
        maps: of the body.
        tolerance: distance that vertices keep from the body [m].
        progress: called with the iterations done and all of them.
        closing: "weld": seams start closed at their midpoints, and what that stretched is shortened; "forces": panels start
            as they are placed, and both sides of each seam are drawn together, then welded, as [Vassilev 2001] has it.
    """
    check_choice(closing, "closing", CLOSINGS)
    x, faces, ends, rest = _welded(garment) if closing == "weld" else _apart(garment)
    # sweeps in the order of the mesh would draw everything to one side
    order = np.random.default_rng(_ORDER_SEED).permutation(len(ends))
    ends, rest = np.ascontiguousarray(ends[order], np.int32), rest[order]
    before, p = x.copy(), np.empty_like(x)
    start = np.linalg.norm(x[ends[:, 1]] - x[ends[:, 0]], axis=1)
    weights = np.ones(len(x))
    # faces are left out: a face across a limb would throw its corners about
    contact = body_contact(maps.map, faces, len(x), tolerance, face_parts=0)
    total = RAMP + _AFTER
    for first in range(0, total, _CHUNK):
        sewing.close_seams(
            x, before, p, weights, ends, rest, start, first, min(_CHUNK, total - first), RAMP, _KEEP, _SWEEPS, contact
        )  # fmt: skip
        if progress is not None:
            progress(min(first + _CHUNK, total), total)
    return (x, 0.0) if closing == "weld" else _joined(garment, x)


def _welded(garment: Garment) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
    """Positions, faces, and pairs with the distances that they shall have [m]."""
    ends, rest = _pairs(*_shape(garment), garment.quads is None)
    return np.array(garment.vertices), garment.faces, ends, rest


def _pairs(surface: Surface, shape: RestShape, stiff: bool) -> tuple[IntArray, FloatArray]:
    """Edges; stiff: vertices opposite an edge too. Without them fine triangles, drawn in, fold and cross each other; with
    them coarse quads cannot follow the body."""
    across, across_rest = shape.opposite_lengths(surface)
    count = len(across) if stiff else 0
    ends = np.concatenate([surface.edges, across[:count]])
    return ends, np.concatenate([shape.edge_lengths(surface), across_rest[:count]])


def _apart(garment: Garment) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
    """The same for panels that are not sewn yet; what a seam joins shall have no distance."""
    meshes = garment.panel_meshes
    x = np.concatenate(garment.panel_vertices)
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.ascontiguousarray(np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts)]), np.int32)
    surface = Surface(faces, len(x))
    corners = np.concatenate([garment.rest_corners, np.zeros((len(faces), 3, 1))], axis=2)
    shape = RestShape(Mesh(x, faces), corners)
    pairs, lengths = _pairs(surface, shape, garment.quads is None)
    ids = np.concatenate(garment.welded)
    order = np.argsort(ids, kind="stable")
    same = ids[order[1:]] == ids[order[:-1]]
    seams = np.column_stack([order[:-1][same], order[1:][same]])
    return x, faces, np.concatenate([pairs, seams]), np.concatenate([lengths, np.zeros(len(seams))])


def _joined(garment: Garment, x: FloatArray) -> tuple[FloatArray, float]:
    """Welds the copies of each vertex at their mean; the largest way that one of them makes, doubled, is the gap [m]."""
    ids = np.concatenate(garment.welded)
    copies = np.bincount(ids)
    means = np.column_stack([np.bincount(ids, x[:, k]) for k in range(3)]) / copies[:, None]
    return np.ascontiguousarray(means), 2.0 * float(np.linalg.norm(x - means[ids], axis=1).max())
