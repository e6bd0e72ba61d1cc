"""The image-space body collider [Vassilev 2001, section 5]: maps of front, back and outline, drawn by the rasteriser."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import BoolArray, FloatArray, as_points
from clothgym.body import Body, joined
from clothgym.kernels import body_map, body_outline, raster
from clothgym.kernels.body_map import BodyMap
from clothgym.mesh import Surface

VIEWS = ("x", "y", "z")
"""Axes along which a pair of views may look."""

_COLOUR_LEVELS = 127.5
"""A byte of a colour holds twice as many."""
_LEAST_MARGIN_PIXELS = 2
_MOST_MARGIN_PIXELS = 100
"""Texels of small bodies are no finer than this part of the margin: it would fill the memory."""


class BodyMaps:
    """Front, back and outline of all bodies of a scene as planes per texel, seen along one axis or more.

    Texels beside the body within the margin copy front and back of the nearest texel on it. The plane of the outline gives
    the tolerance at the sides, for which the paper adds one layer of pixels.

    What a pair of views cannot see: concavities behind the outermost surfaces (armpits from the side, between arm and trunk
    where the arm lies in front, the inside of a bowl from its side) count as filled; surfaces along the view away from the
    outline (the sides of an arm that points forward in front of the trunk) have no plane of their own. A point is inside
    where all pairs say so.

    Attributes:
        map: what kernels read.
        pixel: size of a texel of the first pair [m], the error of discretisation across the view [Vassilev 2001, eq. 11].
        filled: (rows, columns) whether a texel of the first pair lies on the body itself; row 0 at the bottom.

    Args:
        bodies: at least one.
        map_size: texels along the longer side of the bodies' extent across the view.
        margin: [m] how far beside the body it is felt; at least the tolerance plus what a point may sink in a substep.
        normals: "face", "interpolated" or "bytes", see `Fidelity.body_normals`.
        views: axes of the pairs, of `VIEWS`.
        tolerance: [m] that will be asked for. A plane holds as far along its view as the body has parts so near; with more, it
            would hold cloth off where the body curves away from it.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        map_size: int = 360,
        margin: float = 0.015,
        normals: str = "face",
        views: str = "z",
        tolerance: float = 0.003,
    ) -> None:
        self.vertices, self.faces = joined(bodies)
        self.map_size, self.margin, self.normals, self.views = map_size, margin, normals, views
        self.tolerance = tolerance
        self._surface = Surface(self.faces, len(self.vertices))
        self.render(self.vertices)

    def render(
        self,
        vertices: ArrayLike,
        before: ArrayLike | None = None,
        dt: float = 0.0,
        near: FloatArray | None = None,
    ) -> None:
        """Draws the maps for moved vertices (V, 3) [m].

        Args:
            before: (V, 3) where they were dt [s] earlier; None: they stand.
            near: (2, 3) box [m]: points outside it will not be asked about, so nothing is drawn there; None: everywhere.
        """
        self.vertices = as_points(vertices, "vertices", len(self.vertices))
        velocities = np.zeros((0, 3))
        if before is not None and dt > 0.0:
            velocities = (self.vertices - as_points(before, "before", len(self.vertices))) / dt
        low, high = box = np.empty((2, 3))
        body_map.extent(self.vertices, self.faces, box)
        normals = np.empty((0 if self.normals == "face" else len(self.vertices), 3))
        if len(normals):
            raster.vertex_normals(self.vertices, self.faces, normals)
        views = [_View(self, VIEWS.index(axis), low, high, near) for axis in self.views]
        texels = sum(view.rows * view.columns for view in views)
        planes, bounds = np.empty((texels, body_map.PLANES), np.float32), np.empty((texels, 2), np.float32)
        flow = np.empty((texels if len(velocities) else 0, 9), np.float32)
        first = 0
        for view in views:
            part = slice(first, first + view.rows * view.columns)
            view.draw(self, normals, velocities, dt, low, planes[part], bounds[part], flow[part])
            view.first, first = first, part.stop
        self.pixel, self.filled = views[0].pixel, views[0].filled
        x, y, z = low.tolist()
        others = [view.place for view in views[1:]] + (3 - len(views)) * [None]
        self.map = BodyMap(planes, bounds, flow, (x, y, z), views[0].place, *others)

    def query(self, points: ArrayLike, tolerance: float) -> tuple[FloatArray, FloatArray]:
        """Signed distances (N,) [m] and normals (N, 3) for points nearer than the tolerance; inf and zero for others."""
        p = as_points(points, "points")
        distances, normals = np.empty(len(p)), np.empty((len(p), 3))
        body_map.query(p, self.map, float(tolerance), distances, normals)
        return distances, normals


class _View:
    """One pair of views: where its texels lie, and how they are drawn."""

    filled: BoolArray
    first = 0

    def __init__(
        self, maps: BodyMaps, axis: int, low: FloatArray, high: FloatArray, near: FloatArray | None = None
    ) -> None:
        self.axis = axis
        self.axes = np.array([(axis + 1) % 3, (axis + 2) % 3, axis])
        across = (high - low)[self.axes[:2]]
        self.pixel = max(float(across.max()), 1e-9) / maps.map_size
        self.pixel = max(self.pixel, maps.margin / _MOST_MARGIN_PIXELS)
        border = math.ceil(maps.margin / self.pixel) + _LEAST_MARGIN_PIXELS
        self.columns, self.rows = (math.ceil(float(size) / self.pixel) + 2 * border for size in across)
        self.left, self.bottom = (float(low[k]) - border * self.pixel for k in self.axes[:2])
        if near is not None:
            self.left, self.columns = self._cut(self.left, self.columns, near[:, self.axes[0]])
            self.bottom, self.rows = self._cut(self.bottom, self.rows, near[:, self.axes[1]])
        self.middle, self.eye = float(low[axis]), float(high[axis]) + 1.0

    def _cut(self, start: float, count: int, wanted: FloatArray) -> tuple[float, int]:
        """Start [m] and number of the texels that lie between two places; at least one, and the same texels as before."""
        first, last = np.floor((wanted - start) / self.pixel).clip(0, count - 1).astype(int).tolist()
        return start + first * self.pixel, last - first + 1

    @property
    def place(self) -> body_map.View:
        """What kernels read."""
        return body_map.View(
            self.first, self.rows, self.columns, self.axis, self.left, self.bottom, self.middle, self.pixel
        )

    def draw(
        self,
        maps: BodyMaps,
        normals: FloatArray,
        velocities: FloatArray,
        dt: float,
        origin: FloatArray,
        planes: np.ndarray,
        bounds: np.ndarray,
        flow: np.ndarray,
    ) -> None:
        """Fills the rows of this view."""
        layers = self._layers(maps)
        depths = np.empty((2, self.rows, self.columns), np.float32)
        levels = _COLOUR_LEVELS if maps.normals == "bytes" else 0.0
        body_map.planes_of_layers(
            maps.vertices, normals, velocities, maps.faces, layers, origin, self.axes, levels, planes, depths, flow
        )
        self.filled = depths[0] > -np.inf
        reach = 0.5 + maps.tolerance / self.pixel  # from the middle of a texel
        body_outline.depth_bounds(depths, flow, self.axis, dt, reach, np.empty_like(depths), bounds)
        surface = maps._surface
        edge_count = len(surface.edges)
        chosen = np.empty(edge_count, np.int32)
        count = body_outline.outline_edges(
            maps.vertices, surface.faces, surface.face_edges, surface.edge_face_count, self.axes,
            np.empty(edge_count, np.int32), chosen,
        )  # fmt: skip
        lines, nearest = np.empty((count, 5)), np.empty((self.rows, self.columns))
        owner = np.empty((self.rows, self.columns), np.int32)
        place = np.array([self.left, self.bottom, self.pixel])
        body_outline.nearest_outline(
            maps.vertices, surface.edges, chosen, count, place, self.axes, self.filled, maps.margin / self.pixel + 1.0,
            lines, np.empty(count, np.bool_), nearest, owner,
        )  # fmt: skip
        body_outline.write_outline(
            maps.vertices, velocities, surface.edges, chosen, place, self.axes, self.filled, lines, owner, origin,
            planes, bounds, flow,
        )  # fmt: skip

    def _layers(self, maps: BodyMaps) -> raster.Layers:
        """Front and back drawn from far along the axis."""
        scale = 1.0 / self.pixel
        a, b, c = self.axes
        matrix = np.zeros((4, 4))
        matrix[0, a], matrix[0, 3] = scale, -self.left * scale
        matrix[1, b], matrix[1, 3] = -scale, (self.bottom + self.rows * self.pixel) * scale
        matrix[2, c], matrix[2, 3] = -1.0, self.eye
        matrix[3, 3] = 1.0
        image = np.empty((len(maps.vertices), 4))
        raster.project(maps.vertices, matrix, image)
        layers = raster.new_layers(2, self.rows, self.columns)
        raster.rasterise(image, maps.faces, 0.0, layers)
        return layers
