"""The image-space body collider [Vassilev 2001, section 5]: maps of front, back and outline, drawn by the rasteriser."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import FloatArray, IntArray, as_points
from clothgym.body import Body, joined
from clothgym.kernels import body_map, raster
from clothgym.kernels.body_map import BodyMap
from clothgym.mesh import Surface

_LEAST_MARGIN_PIXELS = 2
_MOST_MARGIN_PIXELS = 100
"""Texels of small bodies are no finer than this part of the margin: it would fill the memory."""
_BOUND_PIXELS = 2
_BOUND = 0.003
"""[m] of fine maps: the part of the body that a point keeps its distance from may lie this far beside it."""


class BodyMaps:
    """Front, back and outline of all bodies of a scene as planes per texel, seen along z.

    Texels beside the body within the margin copy front and back of the nearest texel on it. The plane of the outline is
    the tangent of the projected mesh at the point nearest to the texel, not that of a drawn image: it is exact to less
    than a texel. It gives the tolerance at the sides, for which the paper adds one layer of pixels.

    What two views cannot see: concavities behind the outermost surfaces (armpits from the side, between arm and trunk
    where the arm lies in front) count as filled; surfaces along z away from the outline (the sides of an arm that
    points forward in front of the trunk) have no plane of their own.

    Attributes:
        map: what kernels read.
        pixel: size of a texel [m], the error of discretisation in x and y [Vassilev 2001, eq. 11].
        filled: (rows, columns) whether a texel lies on the body itself; row 0 at the bottom.

    Args:
        bodies: at least one.
        map_size: texels along the longer side of the bodies' extent in x and y.
        margin: [m] how far beside the body it is felt; at least the tolerance plus what a point may sink in a substep.
        normals: "face" or "interpolated", see `Fidelity.body_normals`.
    """

    def __init__(
        self, bodies: Sequence[Body], map_size: int = 360, margin: float = 0.015, normals: str = "face"
    ) -> None:
        self.vertices, self.faces = joined(bodies)
        self.map_size, self.margin, self.normals = map_size, margin, normals
        self._surface = Surface(self.faces, len(self.vertices))
        self.render(self.vertices)

    def render(self, vertices: ArrayLike) -> None:
        """Draws the maps for moved vertices (V, 3) [m]."""
        self.vertices = as_points(vertices, "vertices", len(self.vertices))
        used = self.vertices[np.unique(self.faces)]
        low, high = used.min(axis=0), used.max(axis=0)
        extent = high - low
        self.pixel = max(float(max(extent[0], extent[1])), 1e-9) / self.map_size
        self.pixel = max(self.pixel, self.margin / _MOST_MARGIN_PIXELS)
        border = math.ceil(self.margin / self.pixel) + _LEAST_MARGIN_PIXELS
        columns, rows = (math.ceil(float(extent[k]) / self.pixel) + 2 * border for k in range(2))
        left, bottom, middle = float(low[0]) - border * self.pixel, float(low[1]) - border * self.pixel, float(low[2])
        top, eye = bottom + rows * self.pixel, float(high[2]) + 1.0
        scale = 1.0 / self.pixel
        matrix = np.array(
            [
                [scale, 0.0, 0.0, -left * scale],
                [0.0, -scale, 0.0, top * scale],
                [0.0, 0.0, -1.0, eye],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
        image = np.empty((len(self.vertices), 4))
        raster.project(self.vertices, matrix, image)
        layers = raster.new_layers(2, rows, columns)
        raster.rasterise(image, self.faces, 0.0, layers)
        normals = np.empty_like(self.vertices)
        raster.vertex_normals(self.vertices, self.faces, normals)
        planes = np.empty((rows * columns, 12), np.float32)
        depths = np.empty((2, rows, columns), np.float32)
        frame = np.array([left, bottom, middle, self.pixel])
        interpolate = self.normals == "interpolated"
        body_map.planes_of_layers(self.vertices, normals, self.faces, layers, frame, interpolate, planes, depths)
        self.filled = np.isfinite(depths[0])
        bounds = self._dilate(planes, depths, low[:2] - border * self.pixel)
        self.map = BodyMap(planes, bounds, rows, columns, left, bottom, middle, self.pixel)

    def _dilate(self, planes: np.ndarray, depths: np.ndarray, corner: FloatArray) -> np.ndarray:
        """Copies front and back of the nearest texel of the body into those beside it and writes the outline's planes;
        returns the bounds in z (N, 2)."""
        from scipy.ndimage import distance_transform_edt, maximum_filter, minimum_filter

        planes[:, 8:11] = 0.0
        planes[:, 11] = -np.inf
        if not self.filled.any():
            return np.tile(np.array([np.inf, -np.inf], np.float32), (len(planes), 1))
        distance, (row, column) = distance_transform_edt(~self.filled, return_indices=True)
        near = (distance > 0.0) & (distance <= self.margin / self.pixel + 1.0)
        nearest = (row * self.filled.shape[1] + column)[near]
        planes[np.flatnonzero(near), :8] = planes[nearest, :8]
        # a surface near a point shows in one of the texels around it
        size = 2 * max(_BOUND_PIXELS, math.ceil(_BOUND / self.pixel)) + 1
        bounds = np.stack([minimum_filter(depths[1], size).ravel(), maximum_filter(depths[0], size).ravel()], axis=1)
        beyond = np.flatnonzero(near)[~np.isfinite(bounds[near.ravel(), 0])]
        bounds[beyond] = bounds[nearest[~np.isfinite(bounds[near.ravel(), 0])]]
        self._add_outline(planes, near, corner)
        return np.ascontiguousarray(bounds, np.float32)

    def _add_outline(self, planes: np.ndarray, near: np.ndarray, corner: FloatArray) -> None:
        """Writes the planes of the outline for texels on the body and near it."""
        segments = self._segments() - corner
        columns = self.filled.shape[1]
        outside, inside = np.flatnonzero(near), np.flatnonzero(self.filled)
        # what is nearest to a point beside the body is always a piece of its outline; edges that the body hides lie behind
        beside = self._centres(outside, columns)
        foot, owner = _nearest_on(segments, beside, 0.5 * self.pixel)
        on_body = self._centres(inside, columns)
        shown = segments[np.unique(owner)]
        foot_inside, _ = _nearest_on(shown, on_body, 0.5 * self.pixel)
        for texels, centres, feet, sign in ((outside, beside, foot, 1.0), (inside, on_body, foot_inside, -1.0)):
            way = sign * (centres - feet)
            size = np.sqrt(np.einsum("ij,ij->i", way, way))
            told = size > 1e-6 * self.pixel  # on the outline itself front and back must do
            normal = way[told] / size[told, None]
            planes[texels[told], 8:10] = normal
            planes[texels[told], 11] = -np.einsum("ij,ij->i", normal, feet[told])

    def _centres(self, texels: np.ndarray, columns: int) -> FloatArray:
        """(N, 2) from the lower left corner of the map [m]."""
        return self.pixel * (np.stack([texels % columns, texels // columns], axis=1) + 0.5)

    def _segments(self) -> FloatArray:
        """(S, 2, 2) edges in x and y [m] where the body turns from front to back, and borders of holes."""
        surface, xy = self._surface, self.vertices[:, :2]
        a, b, c = (xy[surface.faces[:, k]] for k in range(3))
        one, two = b - a, c - a
        front = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0] > 0.0
        seen = np.bincount(surface.face_edges[front].ravel(), minlength=len(surface.edges))
        count = surface.edge_face_count
        return xy[surface.edges[((seen > 0) & (seen < count)) | (count == 1)]]

    def query(self, points: ArrayLike, tolerance: float) -> tuple[FloatArray, FloatArray]:
        """Signed distances (N,) [m] and normals (N, 3) for points nearer than the tolerance; inf and zero for others."""
        p = as_points(points, "points")
        distances, normals = np.empty(len(p)), np.empty((len(p), 3))
        body_map.query(p, self.map, float(tolerance), distances, normals)
        return distances, normals


def _nearest_on(segments: FloatArray, points: FloatArray, spacing: float) -> tuple[FloatArray, IntArray]:
    """The nearest point (N, 2) of segments (S, 2, 2) to each of points (N, 2), and its segment (N,)."""
    from scipy.spatial import cKDTree

    start, way = segments[:, 0], segments[:, 1] - segments[:, 0]
    squared = np.einsum("ij,ij->i", way, way)
    counts = np.ceil(np.sqrt(squared) / spacing).astype(np.int64) + 1
    owner = np.repeat(np.arange(len(segments)), counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = number / np.maximum(counts - 1, 1)[owner]
    tree = cKDTree(start[owner] + share[:, None] * way[owner])
    # the segments of the two nearest samples: one of them is nearest, or as good as
    chosen = owner[tree.query(points, k=min(2, len(owner)))[1].reshape(len(points), -1)]
    gap = points[:, None] - start[chosen]
    t = np.einsum("nki,nki->nk", gap, way[chosen]) / np.maximum(squared[chosen], 1e-300)
    feet = start[chosen] + np.clip(t, 0.0, 1.0)[:, :, None] * way[chosen]
    far = points[:, None] - feet
    best = np.einsum("nki,nki->nk", far, far).argmin(axis=1)
    rows = np.arange(len(points))
    return feet[rows, best], chosen[rows, best]
