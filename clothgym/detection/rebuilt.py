"""The clustered hierarchy with a tree that is made anew when cloth has outgrown it."""

from __future__ import annotations

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.detection.hierarchy import Hierarchy
from clothgym.kernels import dop_pairs
from clothgym.mesh import Surface


class RebuiltHierarchy(Hierarchy):
    """As `Hierarchy`; near pairs come sorted by their ids, since their order would else tell which tree has found them.

    Args:
        surface, vertices, k, arity: as `Hierarchy`.
        growth: a new tree is made when the boxes of the leaves have this many times the surface that they began with.

    Attributes:
        counters: box_tests and trees_built since the start.
    """

    def __init__(self, surface: Surface, vertices: FloatArray, k: int, arity: int, growth: float) -> None:
        super().__init__(surface, vertices, k, arity)
        self._growth, self._trees_built = growth, 0
        self._first, self._first_size = self.clusters, self._leaf_size(vertices)
        self._size = self._first_size
        self._keys = np.empty(0, np.int64)

    @property
    def counters(self) -> dict[str, int]:
        return {"box_tests": self.box_tests, "trees_built": self._trees_built}

    def _leaf_size(self, x: FloatArray) -> float:
        return float(dop_pairs.leaf_size(self.clusters.ids, len(self.clusters.edge_start) - 1, x))

    def forget(self) -> None:
        """Back to the first tree: results are the same, counters begin alike."""
        self.clusters, self._size = self._first, self._first_size

    def renew(self, x: FloatArray) -> None:
        """A new tree over x (V, 3) if it is time."""
        if self._leaf_size(x) > self._growth * self._size:
            self.clusters = Hierarchy(self.surface, x, self.k, self.arity).clusters
            self._size = self._leaf_size(x)
            self._trees_built += 1

    def search(self, near: bool, hits: bool) -> None:
        """As `Hierarchy.search`; hits need no order, who looks for them sorts them."""
        super().search(near, hits)
        if not near:
            return
        for pairs, count, columns in (
            (self.vertex_face, int(self.counts[0]), len(self.surface.faces)),
            (self.edge_edge, int(self.counts[1]), len(self.surface.edges)),
        ):
            if count > len(self._keys):
                self._keys = np.empty(int(1.3 * count) + 64, np.int64)
            dop_pairs.encode(pairs, count, columns, pairs is self.edge_edge, self._keys)
            self._keys[:count].sort()
            dop_pairs.decode(self._keys, count, columns, pairs)
