"""Which side of a surface points are on: was a tangle resolved the right way round?"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import FloatArray, IntArray, as_points
from clothgym.kernels import sides as kernels
from clothgym.mesh import Surface, as_surface


def closest_points(x: ArrayLike, vertices: ArrayLike, faces: Any) -> tuple[IntArray, FloatArray, FloatArray]:
    """The point of a surface closest to each of the points x (P, 3) [m].

    Returns:
        Face ids (P,), barycentric weights (P, 3), distances (P,) [m].

    Raises:
        ValueError: as `signed_sides`.
    """
    points, y, surface = _checked(x, vertices, faces)
    stacked = np.concatenate([y, points])
    face, weights, distances = _closest(stacked, len(y), surface)
    return surface.face_ids[face], weights, distances


def signed_sides(x: ArrayLike, vertices: ArrayLike, faces: Any) -> tuple[FloatArray, FloatArray]:
    """Side of a surface on which each point lies, by its closest point.

    Where that lies on an edge or a vertex, the normal is the angle-weighted one, which gives the true side of any
    consistently oriented surface that does not intersect itself.

    Args:
        x: (P, 3) points [m].
        vertices: (V, 3) of the surface [m].
        faces: (F, 3) vertex ids, consistently oriented, or a `Surface` (quicker when it is used again).

    Returns:
        signs (P,): +1 = on the side of the normals (faces run counter-clockwise seen from there), -1 = behind, 0 =
        neutral: the closest point lies on the border of the surface, or the point on the surface; distances (P,) [m].

    Raises:
        ValueError: names the offending index, or a surface without faces.
    """
    points, y, surface = _checked(x, vertices, faces)
    return _signs(np.concatenate([y, points]), len(y), surface)


class Sides:
    """On which side of each other two parts of a scene are; topology is built once.

    Args:
        faces: (F, 3) vertex ids of the whole scene; faces with all vertices in a part belong to it.
        first, second: vertex slices of the two parts, as in `Simulation.cloth_ranges`.

    Raises:
        ValueError: a part without faces.
    """

    def __init__(self, faces: ArrayLike, first: slice, second: slice) -> None:
        self.first, self.second = first, second
        self._surfaces = []
        for name, part in (("first", first), ("second", second)):
            all_faces = np.asarray(faces)
            own = ((all_faces >= part.start) & (all_faces < part.stop)).all(axis=1)
            surface = Surface(all_faces[own] - part.start, part.stop - part.start)
            if len(surface.faces) == 0:
                raise ValueError(f"{name} = {part}: no face has all its vertices there")
            self._surfaces.append(surface)

    def signs(self, positions: FloatArray) -> FloatArray:
        """(P,) signs of the first part's vertices against the second's surface, then the other way round.

        Args:
            positions: (V, 3) of the whole scene [m].

        Returns:
            +1, -1 or 0, as `signed_sides`.
        """
        one, two = positions[self.first], positions[self.second]
        against_second, _ = _signs(np.concatenate([two, one]), len(two), self._surfaces[1])
        against_first, _ = _signs(np.concatenate([one, two]), len(one), self._surfaces[0])
        return np.concatenate([against_second, against_first])

    def error(self, positions: FloatArray, required: ArrayLike) -> float:
        """Share of the vertices with a required side that are on the other one; 0 = all right, 1 = all wrong.

        Args:
            positions: (V, 3) of the whole scene [m].
            required: (P,) signs in the order of `signs`, usually those of the clean state: 0 asks for nothing. Neutral
                vertices are on no wrong side.

        Raises:
            ValueError: wrong length.
        """
        asked = np.asarray(required, float)
        count = (self.first.stop - self.first.start) + (self.second.stop - self.second.start)
        if asked.shape != (count,):
            raise ValueError(f"required: expected {count} signs, got shape {asked.shape}")
        binding = int(np.count_nonzero(asked))
        return float(np.count_nonzero(self.signs(positions) * asked < 0.0) / binding) if binding else 0.0


def side_error(positions: FloatArray, faces: ArrayLike, first: slice, second: slice, required: ArrayLike) -> float:
    """Share of the vertices of two parts that are on the wrong side of the other part; `Sides.error` is quicker when
    the question is asked again."""
    return Sides(faces, first, second).error(as_points(positions, "positions"), required)


def _checked(x: ArrayLike, vertices: ArrayLike, faces: Any) -> tuple[FloatArray, FloatArray, Surface]:
    points = as_points(x, "x")
    y, surface = as_surface(vertices, faces)
    if len(surface.faces) == 0:
        raise ValueError("faces: a surface needs at least one face with three different vertices")
    return points, y, surface


def _closest(stacked: FloatArray, first: int, surface: Surface) -> tuple[IntArray, FloatArray, FloatArray]:
    """Faces, weights and distances for the points that follow the surface's vertices."""
    points, count = len(stacked) - first, len(surface.faces)
    boxes = np.empty((count, 6))
    blocks = np.empty((-(-count // kernels.BLOCK), 6))
    kernels.face_boxes(stacked, surface.faces, boxes, blocks)
    face, weights, distances = np.zeros(points, np.int32), np.zeros((points, 3)), np.zeros(points)
    kernels.closest_faces(stacked, first, surface.faces, boxes, blocks, face, weights, distances)
    return face, weights, distances


def _signs(stacked: FloatArray, first: int, surface: Surface) -> tuple[FloatArray, FloatArray]:
    face, weights, distances = _closest(stacked, first, surface)
    s = surface.arrays
    normals, border = np.empty((first, 3)), np.empty(first, np.bool_)
    kernels.vertex_frames(stacked, s.faces, s.edges, s.edge_face_start, normals, border)
    signs = np.empty(len(distances))
    kernels.side_signs(stacked, first, s, normals, border, face, weights, signs)
    return signs, distances
