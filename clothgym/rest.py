"""The shape of a cloth without strain: one place per vertex, or corners per face where panels are sewn together."""

from __future__ import annotations

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.mesh import Mesh, Surface


class RestShape:
    """What is read off a rest shape.

    A sewn vertex has another place in each of its panels, so a garment's rest shape is given by the corners of its
    faces, each face in its own plane; lengths across a seam are the mean of both sides, which sewn edges of different
    length share between them.

    Args:
        mesh: whose rest shape it is.
        rest: (V, 3) or (F, 3, 3) [m].

    Attributes:
        face_areas: (F,) [m^2].
        vertex_areas: (V,) a third of the area of all faces at each vertex [m^2].
        least_altitudes: (V,) least altitude of the faces with area at each vertex [m]; infinite where there is none.
    """

    def __init__(self, mesh: Mesh, rest: FloatArray) -> None:
        self.faces, self.count = mesh.faces, len(mesh.vertices)
        self.places = rest if rest.ndim == 2 else None
        self.corners: FloatArray = rest[mesh.faces] if rest.ndim == 2 else rest
        sides = self.corners - np.roll(self.corners, 1, axis=1)
        self.face_areas: FloatArray = 0.5 * np.linalg.norm(np.cross(sides[:, 1], sides[:, 2]), axis=1)
        thirds = np.repeat(self.face_areas / 3.0, 3)
        self.vertex_areas: FloatArray = np.bincount(self.faces.ravel(), thirds, minlength=self.count).astype(float)
        longest = np.linalg.norm(sides, axis=2).max(axis=1)
        altitude = np.divide(2.0 * self.face_areas, longest, out=np.zeros_like(longest), where=longest > 0)
        altitude[altitude == 0.0] = np.inf  # a face without area bounds nothing
        self.least_altitudes: FloatArray = np.full(self.count, np.inf)
        np.minimum.at(self.least_altitudes, self.faces.ravel(), np.repeat(altitude, 3))
        self._told: tuple[Surface, IntArray, FloatArray] | None = None

    def pair_lengths(self, pairs: IntArray, surface: Surface) -> FloatArray:
        """(P,) rest distance of vertex pairs [m]; with corners per face they must be edges, or opposite one."""
        if self.places is not None:
            return np.linalg.norm(self.places[pairs[:, 1]] - self.places[pairs[:, 0]], axis=1)
        keys, lengths = self._distances(surface)
        wide = np.sort(np.asarray(pairs, np.int64), axis=1)
        wanted = wide[:, 0] * self.count + wide[:, 1]
        place = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
        if len(wanted) and not (keys[place] == wanted).all():
            a, b = pairs[int(np.argmax(keys[place] != wanted))]
            raise ValueError(f"rest: the distance of vertices {a} and {b} is not told by the corners of faces")
        return lengths[place]

    def _distances(self, surface: Surface) -> tuple[IntArray, FloatArray]:
        """What the corners of faces tell: pairs a < b as a V + b (P,), sorted, and their rest distances (P,) [m].

        Kept, since each kind of spring asks for it.
        """
        if self._told is None or self._told[0] is not surface:
            across, across_lengths = self.opposite_lengths(surface)
            known = np.concatenate([surface.edges, across]).astype(np.int64)
            keys, first = np.unique(known[:, 0] * self.count + known[:, 1], return_index=True)
            lengths = np.concatenate([self.edge_lengths(surface), across_lengths])
            self._told = surface, keys, lengths[first]
        return self._told[1:]

    def bent_lengths(self, pairs: IntArray, middles: IntArray, surface: Surface) -> FloatArray:
        """(P,) rest distance [m] of pairs with a vertex between them on a line of the grid; with corners per face, where no
        plane holds both ends, the way over that vertex."""
        if self.places is not None:
            return self.pair_lengths(pairs, surface)
        first, second = (np.column_stack([pairs[:, k], middles]) for k in range(2))
        return self.pair_lengths(first, surface) + self.pair_lengths(second, surface)

    def edge_lengths(self, surface: Surface) -> FloatArray:
        """(E,) rest length of every edge [m]: the mean over the faces at it."""
        if self.places is not None:
            return self.pair_lengths(surface.edges, surface)
        corners = self.corners[surface.face_ids]
        # edges (0,1), (1,2), (2,0) of each face
        lengths = np.linalg.norm(corners[:, [1, 2, 0]] - corners, axis=2).ravel()
        sums = np.bincount(surface.face_edges.ravel(), lengths, minlength=len(surface.edges))
        return sums / surface.edge_face_count

    def opposite_lengths(self, surface: Surface) -> tuple[IntArray, FloatArray]:
        """Pairs of vertices opposite an edge that two faces share, each once, and their rest distance [m].

        With corners per face, the distance is that of the two faces laid into one plane.
        """
        two = np.flatnonzero(surface.edge_face_count == 2)
        if len(two) == 0:
            return np.zeros((0, 2), np.int32), np.zeros(0)
        first = surface.edge_face_ids[surface.edge_face_start[two]]
        second = surface.edge_face_ids[surface.edge_face_start[two] + 1]
        ends = surface.edges[two]
        pairs = np.stack([surface.faces[f].sum(axis=1) - ends.sum(axis=1) for f in (first, second)], axis=1)
        proper = pairs[:, 0] != pairs[:, 1]
        pairs, first, second, ends = pairs[proper], first[proper], second[proper], ends[proper]
        unique, index = np.unique(np.sort(pairs, axis=1), axis=0, return_index=True)
        if self.places is not None:
            return unique, self.pair_lengths(unique, surface)
        first, second, ends = first[index], second[index], ends[index]
        one, two_ = (self.laid_out(surface, faces, ends) for faces in (first, second))
        return unique, np.hypot(one[:, 0] - two_[:, 0], one[:, 1] + two_[:, 1])

    def laid_out(self, surface: Surface, faces: IntArray, ends: IntArray) -> FloatArray:
        """(N, 2): of each face the corner that is not on its edge, along the edge from its middle, and above it [m]."""
        ids, corners = surface.faces[faces], self.corners[surface.face_ids[faces]]
        rows = np.arange(len(faces))
        start = corners[rows, np.argmax(ids == ends[:, :1], axis=1)]
        end = corners[rows, np.argmax(ids == ends[:, 1:], axis=1)]
        tip = corners[rows, np.argmax((ids != ends[:, :1]) & (ids != ends[:, 1:]), axis=1)]
        along = end - start
        size = np.maximum(np.linalg.norm(along, axis=1), 1e-300)
        way = tip - 0.5 * (start + end)
        share = np.einsum("ij,ij->i", way, along) / size
        return np.stack([share, np.sqrt(np.maximum((way * way).sum(axis=1) - share**2, 0.0))], axis=1)
