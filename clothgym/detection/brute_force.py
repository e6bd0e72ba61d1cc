"""Every pair of primitives: the comparator for the hierarchy, exchangeable with it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import FloatArray, IntArray
from clothgym.kernels import dop_pairs, kdop, proximity
from clothgym.mesh import Surface

_LARGEST = 10_000


class BruteForce:
    """Same face as `Hierarchy`, without a tree: every pair of primitives whose 26-DOPs overlap, sorted by ids."""

    def __init__(self, surface: Surface, vertices: FloatArray, k: int = 0, arity: int = 0) -> None:
        self.surface = surface
        count = len(surface.faces)
        if count > _LARGEST:
            raise ValueError(
                f"fidelity.detection = 'brute_force': {count} faces make too many pairs; at most {_LARGEST}"
            )
        self._ways = np.zeros((len(vertices), 26))
        self._lengths = np.sqrt((kdop.AXES[26] ** 2).sum(axis=1))
        self.vertex_face: IntArray = np.empty((64, 2), np.int32)
        self.edge_edge: IntArray = np.empty((64, 2), np.int32)
        self.edge_face: IntArray = np.empty((64, 2), np.int32)
        self.counts: NDArray[np.int64] = np.zeros(4, np.int64)
        self.box_tests = 0

    def refit(self, start: FloatArray, end: FloatArray, radius: float | FloatArray) -> None:
        """Boxes around the vertices on their way from start to end (V, 3), widened by radius [m], one for all or (V,)."""
        pads = np.atleast_1d(np.asarray(radius, np.float64))
        kdop.vertex_intervals(start, end, kdop.AXES[26], self._lengths, pads, self._ways)

    def search(self, near: bool, hits: bool) -> None:
        """As `Hierarchy.search`."""
        s = self.surface
        points = np.arange(len(self._ways), dtype=np.int32).reshape(-1, 1)
        owned = np.ascontiguousarray(points[: s.vertex_count][s.vertex_owner >= 0])
        wanted = [("vertex_face", owned, s.faces), ("edge_edge", s.edges, s.edges)] if near else []
        if hits:
            wanted.append(("edge_face", s.edges, s.faces))
        for name, first, second in wanted:
            while True:
                found = proximity.every_pair(self._ways, first, second, getattr(self, name))
                if found <= len(getattr(self, name)):
                    break
                setattr(self, name, np.empty((int(1.3 * found) + 64, 2), np.int32))
            if name == "vertex_face":
                self.vertex_face[:found, 0] = owned[self.vertex_face[:found, 0], 0]
            kind = ("vertex_face", "edge_edge", "edge_face").index(name)
            pairs = getattr(self, name)
            self.counts[kind] = dop_pairs.keep_overlapping(kind, s.faces, s.edges, self._ways, pairs, found)

    def edges_against_faces(self) -> IntArray:
        """As `Hierarchy.edges_against_faces`."""
        self.search(near=False, hits=True)
        return self.edge_face[: self.counts[2]]
