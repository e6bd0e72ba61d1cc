"""Triangle meshes of flat panels: even triangles whose border is sampled as the seams ask.

Seeds on a hexagonal lattice, Delaunay triangulation (scipy) and a few smoothing passes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from clothgym.arrays import BoolArray, FloatArray, IntArray, check_number
from clothgym.pattern import Panel, crossings

_CLEARANCE = 0.62
"""Least distance of a seed from the border, in edge lengths."""
_SMOOTHING = 6
_SLIVER = 1e-6
"""Triangles with less than this many squares of the edge length are left out: points on a straight border."""
_HALVINGS = 6


@dataclass(frozen=True, eq=False)
class PanelMesh:
    """A meshed panel.

    Attributes:
        vertices: (V, 2) [m] in the panel's own coordinates: first the samples of the border, in the order of the loop,
            then the inner ones.
        faces: (F, 3) run the way the panel's loop runs: counter-clockwise seen from its outside.
        edge_vertices: for each edge of the panel the ids of its samples from its start to its end, both included.
        quads: (Q, 4) in a mesh of rectangular topology, two faces each; None in one of triangles.
    """

    vertices: FloatArray
    faces: IntArray
    edge_vertices: tuple[IntArray, ...]
    quads: IntArray | None = None

    @property
    def border_count(self) -> int:
        """Number of vertices on the border; they come first."""
        return sum(len(ids) - 1 for ids in self.edge_vertices)


def edge_counts(panel: Panel, edge_length: float) -> list[int]:
    """Pieces into which each edge is cut when nothing is sewn to it."""
    return [max(1, round(panel.length(k) / edge_length)) for k in range(len(panel.edges))]


def mesh_panel(panel: Panel, edge_length: float = 0.02, counts: Sequence[int] | None = None) -> PanelMesh:
    """Meshes a panel; edges that would not survive the triangulation are cut finer.

    Args:
        panel: the outline.
        edge_length: wanted length of the edges inside [m].
        counts: pieces of each edge; they hold exactly or the call fails. Default: pieces of about `edge_length`, finer
            where the panel is too narrow for them.

    Raises:
        ValueError: an edge length out of range, or names the panel and the edge that cannot be met.
    """
    check_number(edge_length, "edge_length", 1e-4, 10.0)
    pieces = edge_counts(panel, edge_length) if counts is None else [int(count) for count in counts]
    if len(pieces) != len(panel.edges) or min(pieces) < 1:
        raise ValueError(f"counts: expected {len(panel.edges)} positive numbers, got {pieces}")
    for _ in range(_HALVINGS if counts is None else 1):
        mesh, lost = triangulate(panel, pieces, edge_length)
        if not lost:
            assert mesh is not None
            return mesh
        pieces = [2 * count if k in lost else count for k, count in enumerate(pieces)]
    raise ValueError(f"panel {panel.name!r}: edge {lost[0]} is too coarse for the outline there")


def triangulate(panel: Panel, counts: Sequence[int], edge_length: float) -> tuple[PanelMesh | None, list[int]]:
    """One try: the mesh, or None and the edges that the triangulation did not keep."""
    samples = [panel.sample(k, count)[:-1] for k, count in enumerate(counts)]
    border = np.concatenate(samples)
    starts = np.concatenate([[0], np.cumsum(counts)])
    count = len(border)
    owner = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    following = (np.arange(count) + 1) % count
    bad = _cut_off(border, panel, owner)
    if bad:
        return None, bad
    points = np.concatenate([border, _seeds(border, edge_length)])
    faces = _delaunay(points, border, edge_length)
    for _ in range(_SMOOTHING):
        points = _smoothed(points, faces, len(border))
        faces = _delaunay(points, border, edge_length)
    n = len(points)
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    keys, times = np.unique(directed.min(axis=1) * n + directed.max(axis=1), return_counts=True)
    loop = np.minimum(np.arange(count), following) * n + np.maximum(np.arange(count), following)
    place = np.minimum(np.searchsorted(keys, loop), max(len(keys) - 1, 0))
    kept = (keys[place] == loop) & (times[place] == 1) if len(keys) else np.zeros(count, bool)
    lost = sorted({int(k) for k in owner[~kept]})
    if not lost and len(faces) != 2 * n - count - 2:  # Euler: a disc with all vertices
        lost = sorted({int(k) for k in owner})
    if lost:
        return None, lost
    if panel.signed_area < 0.0:
        faces = faces[:, ::-1]
    edge_vertices = tuple((np.arange(a, b + 1) % count).astype(np.int32) for a, b in pairwise(starts))
    return PanelMesh(points, np.ascontiguousarray(faces, np.int32), edge_vertices), []


def split_edges(mesh: PanelMesh, cuts: Mapping[tuple[int, int], int]) -> PanelMesh:
    """A copy with so many new vertices, evenly spaced, on some inner edges (pairs of ids)."""
    points, faces = list(mesh.vertices), mesh.faces.tolist()
    for (a, b), count in cuts.items():
        start, step = points[a], (points[b] - points[a]) / (count + 1)
        line = [a, *range(len(points), len(points) + count), b]
        points += [start + n * step for n in range(1, count + 1)]
        around = [face for face in faces if a in face and b in face]
        faces = [face for face in faces if not (a in face and b in face)]
        for face in around:
            for u, v in pairwise(line):
                faces.append([u if corner == a else v if corner == b else corner for corner in face])
    return PanelMesh(np.array(points), np.array(faces, np.int32), mesh.edge_vertices)


def inside(points: FloatArray, border: FloatArray) -> BoolArray:
    """Which of (N, 2) points lie within a closed polygon (M, 2), by the even-odd rule."""
    result = np.zeros(len(points), bool)
    x, y = points[:, 0], points[:, 1]
    for (x0, y0), (x1, y1) in zip(border, np.roll(border, -1, axis=0)):
        if y0 != y1:
            result ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
    return result


def _cut_off(border: FloatArray, panel: Panel, owner: IntArray) -> list[int]:
    """Edges of a polygon of samples that crosses itself although the outline does not: coarse chords of curves."""
    if len(border) < 3:
        return sorted({int(k) for k in owner})
    found = {int(k) for k in owner[np.concatenate(crossings(border))]}
    curved = {k for k in found if panel.edges[k].kind != "line"}
    return sorted(curved or found)


def _seeds(border: FloatArray, h: float) -> FloatArray:
    """Points of a hexagonal lattice inside, clear of the border."""
    low, high = border.min(axis=0), border.max(axis=0)
    rise = 0.5 * math.sqrt(3.0) * h
    columns, rows = math.ceil((high[0] - low[0]) / h) + 2, math.ceil((high[1] - low[1]) / rise) + 1
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    x = (column - 0.5 * (columns - 1) + 0.5 * (row % 2) - 0.25) * h
    y = (row - 0.5 * (rows - 1)) * rise
    points = np.column_stack([x.ravel(), y.ravel()]) + 0.5 * (low + high)
    points = points[inside(points, border)]
    return points[_clearance(points, border, h) >= _CLEARANCE * h]


def _clearance(points: FloatArray, border: FloatArray, h: float) -> FloatArray:
    """Distances of points from a polygon, to about a hundredth of h."""
    along = np.roll(border, -1, axis=0) - border
    pieces = np.maximum(1, np.ceil(4.0 * np.linalg.norm(along, axis=1) / h)).astype(int)
    segment = np.repeat(np.arange(len(border)), pieces)
    share = np.concatenate([np.arange(n) / n for n in pieces])
    dense = border[segment] + share[:, None] * along[segment]
    return np.asarray(cKDTree(dense).query(points)[0]) if len(points) else np.zeros(0)


def _delaunay(points: FloatArray, border: FloatArray, h: float) -> IntArray:
    """(F, 3) counter-clockwise triangles within the border."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    try:
        faces = Delaunay(points - centre).simplices.astype(np.int32)
    except QhullError:  # all points on one line
        return np.zeros((0, 3), np.int32)
    u, w = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    area = 0.5 * (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0])
    faces = np.where((area < 0.0)[:, None], faces[:, ::-1], faces)
    keep = np.abs(area) > _SLIVER * h * h
    keep[keep] = inside(points[faces[keep]].mean(axis=1), border)
    faces = faces[keep]
    return faces[np.lexsort(np.sort(faces, axis=1).T[::-1])]


def _smoothed(points: FloatArray, faces: IntArray, count: int) -> FloatArray:
    """Inner points (all but the first `count`) moved to the area-weighted mean of the triangles around them."""
    corners = points[faces]
    u, w = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.abs(u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0])
    centre = corners.mean(axis=1)
    ids = faces.ravel()
    weight = np.bincount(ids, np.repeat(area, 3), minlength=len(points))
    total = [np.bincount(ids, np.repeat(area * centre[:, k], 3), minlength=len(points)) for k in range(2)]
    mean = np.column_stack(total) / np.maximum(weight, 1e-300)[:, None]
    moved = points.copy()
    inner = (np.arange(len(points)) >= count) & (weight > 0.0)
    moved[inner] = mean[inner]
    return moved
