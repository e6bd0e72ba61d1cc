"""The k-DOP hierarchy of one surface [Mezger 2003]: built once, refitted while the vertices move."""

from __future__ import annotations

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.kernels import bvh, kdop
from clothgym.mesh import Surface


class Hierarchy:
    """Bounding-volume tree over the triangles of a surface.

    Args:
        surface: topology.
        vertices: (V, 3) [m] the shape whose triangles are grouped (rest or first pose).
        k: 6, 8, 14, 18 or 26 half-spaces a box.
        arity: 2, 4 or 8 children a node.

    Attributes:
        box_tests: overlap tests since the tree was built.
    """

    def __init__(self, surface: Surface, vertices: FloatArray, k: int = 18, arity: int = 4) -> None:
        self.surface = surface
        self.k, self.arity = k, arity
        self._axes = kdop.AXES[k]
        self._axis_lengths = np.sqrt((self._axes**2).sum(axis=1))
        count = len(surface.faces)
        capacity = max(2 * count, 1)
        self._child_start = np.zeros(capacity, np.int64)
        self._child_count = np.zeros(capacity, np.int64)
        self._node_face = np.full(capacity, -1, np.int64)
        nodes = 0
        if count:
            centroids = np.ascontiguousarray(vertices[surface.faces].mean(axis=1))
            nodes = bvh.build(
                centroids,
                self._axes,
                self._axis_lengths,
                arity,
                self._child_start,
                self._child_count,
                self._node_face,
            )
        self._child_start = self._child_start[:nodes].copy()
        self._child_count = self._child_count[:nodes].copy()
        self._node_face = self._node_face[:nodes].copy()
        self._boxes = np.zeros((nodes, 2 * len(self._axes)))
        self._intervals = np.zeros((len(vertices), 2 * len(self._axes)))
        self._stack = np.zeros((4096, 2), np.int64)
        self._pairs = np.zeros((max(16 * count, 64), 2), np.int32)
        self.box_tests = 0

    def refit(self, start: FloatArray, end: FloatArray, radius: float | FloatArray) -> None:
        """Boxes around the triangles on their way from start to end (V, 3), widened by radius [m], one for all or (V,)."""
        pads = np.atleast_1d(np.asarray(radius, np.float64))
        kdop.vertex_intervals(start, end, self._axes, self._axis_lengths, pads, self._intervals)
        kdop.refit(
            self._child_start, self._child_count, self._node_face, self.surface.faces, self._intervals, self._boxes
        )

    def self_pairs(self) -> IntArray:
        """(C, 2) candidate face pairs a < b whose boxes overlap; valid until the next call."""
        while True:
            found, tests, overflow = bvh.self_pairs(
                self._child_start, self._child_count, self._node_face, self._boxes, self._stack, self._pairs
            )
            if overflow:
                self._stack = np.zeros((4 * len(self._stack), 2), np.int64)
            elif found > len(self._pairs):
                self._pairs = np.zeros((int(1.3 * found) + 64, 2), np.int32)
            else:
                self.box_tests += tests
                return self._pairs[:found]
