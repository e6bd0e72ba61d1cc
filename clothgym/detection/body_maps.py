"""The image-space body collider [Vassilev 2001, section 5]: maps of the front and the back, rendered by the rasteriser."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import FloatArray, IntArray, as_points
from clothgym.kernels import body_map, raster
from clothgym.kernels.body_map import BodyMap

if TYPE_CHECKING:
    from clothgym.body import Body

_LEAST_MARGIN_PIXELS = 2
_BOUND_PIXELS = 2


class BodyMaps:
    """Front and back of all bodies of a scene as planes per texel, seen along z.

    Texels beside the body within the margin copy the planes of the nearest texel on it: that is the tolerance at the
    sides, for which the paper adds one layer of pixels.

    What two views cannot see: concavities behind the outermost surfaces (armpits from the side, between arm and trunk
    where the arm lies in front) count as filled.

    Attributes:
        map: what kernels read.
        pixel: size of a texel [m], the error of discretisation in x and y [Vassilev 2001, eq. 11].
        filled: (rows, columns) whether a texel lies on the body itself; row 0 at the bottom.

    Args:
        bodies: at least one.
        map_size: texels along the longer side of the bodies' extent in x and y.
        margin: [m] how far beside the body it is felt; at least the tolerance plus what a point may sink in a substep.
    """

    def __init__(self, bodies: Sequence[Body], map_size: int = 360, margin: float = 0.015) -> None:
        self.vertices: FloatArray = np.concatenate([body.mesh.vertices for body in bodies])
        starts = np.cumsum([0, *(len(body.mesh.vertices) for body in bodies)])
        self.faces: IntArray = np.concatenate([b.mesh.faces + np.int32(s) for b, s in zip(bodies, starts)])
        self.map_size, self.margin = map_size, margin
        self.render(self.vertices)

    def render(self, vertices: ArrayLike) -> None:
        """Draws the maps for moved vertices (V, 3) [m]."""
        self.vertices = as_points(vertices, "vertices", len(self.vertices))
        used = self.vertices[np.unique(self.faces)]
        low, high = used.min(axis=0), used.max(axis=0)
        extent = high - low
        self.pixel = max(float(max(extent[0], extent[1])), 1e-9) / self.map_size
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
        planes = np.empty((rows * columns, 8), np.float32)
        depths = np.empty((2, rows, columns), np.float32)
        frame = np.array([left, bottom, middle, self.pixel])
        body_map.planes_of_layers(self.vertices, normals, self.faces, layers, frame, planes, depths)
        self.filled = np.isfinite(depths[0])
        bounds = self._dilate(planes, depths)
        self.map = BodyMap(planes, bounds, rows, columns, left, bottom, middle, self.pixel)

    def _dilate(self, planes: np.ndarray, depths: np.ndarray) -> np.ndarray:
        """Copies the planes of the nearest texel of the body into those beside it; returns the bounds in z (N, 2)."""
        from scipy.ndimage import distance_transform_edt, maximum_filter, minimum_filter

        distance, (row, column) = distance_transform_edt(~self.filled, return_indices=True)
        near = (distance > 0.0) & (distance <= self.margin / self.pixel + 1.0)
        nearest = (row * self.filled.shape[1] + column)[near]
        planes[np.flatnonzero(near)] = planes[nearest]
        # a surface nearer than a texel or two to a point shows in one of the texels around it
        size = 2 * _BOUND_PIXELS + 1
        bounds = np.stack([minimum_filter(depths[1], size).ravel(), maximum_filter(depths[0], size).ravel()], axis=1)
        beyond = np.flatnonzero(near)[~np.isfinite(bounds[near.ravel(), 0])]
        bounds[beyond] = bounds[nearest[~np.isfinite(bounds[near.ravel(), 0])]]
        return np.ascontiguousarray(bounds, np.float32)

    def query(self, points: ArrayLike, tolerance: float) -> tuple[FloatArray, FloatArray]:
        """Signed distances (N,) [m] and normals (N, 3) for points nearer than the tolerance; inf and zero for others."""
        p = as_points(points, "points")
        distances, normals = np.empty(len(p)), np.empty((len(p), 3))
        body_map.query(p, self.map, float(tolerance), distances, normals)
        return distances, normals
