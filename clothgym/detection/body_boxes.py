"""The object-space body collider that the paper compares its own with: five parts, a quad tree of boxes for each."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import FloatArray, IntArray, as_points
from clothgym.kernels import body_boxes, bvh, kdop


class BodyBoxes:
    """Trees of boxes over the parts of a body; answers as `BodyMaps.query` does.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3), counter-clockwise seen from outside.
        parts: (F,) part of each face; None: one.
        arity: children a box; 4 = the paper's quad tree.

    Attributes:
        box_tests, face_tests: of all queries.
    """

    def __init__(self, vertices: ArrayLike, faces: IntArray, parts: IntArray | None = None, arity: int = 4) -> None:
        points = as_points(vertices)
        self.faces = np.ascontiguousarray(faces, np.int32)
        owner = np.zeros(len(self.faces), np.int32) if parts is None else np.asarray(parts)
        axes, lengths = kdop.AXES[6], np.ones(3)
        centroids = points[self.faces].mean(axis=1)
        starts, counts, leaves, roots = [], [], [], []
        nodes = 0
        for part in np.unique(owner):
            members = np.flatnonzero(owner == part)
            child_start, child_count, leaf = (np.zeros(2 * len(members), np.int64) for _ in range(3))
            own = np.ascontiguousarray(centroids[members])
            made = bvh.build(own, axes, lengths, arity, child_start, child_count, leaf)
            roots.append(nodes)
            starts.append(child_start[:made] + nodes)
            counts.append(child_count[:made])
            leaves.append(np.where(leaf[:made] >= 0, members[leaf[:made]], -1))
            nodes += made
        count = len(self.faces)
        self._arrays = body_boxes.PartBoxes(
            np.array(roots, np.int64), np.concatenate(starts), np.concatenate(counts), np.concatenate(leaves),
            np.empty((nodes, 6)), np.empty((count, 9)), np.empty((count, 3)),
        )  # fmt: skip
        self._stack = np.empty(nodes + 1, np.int64)
        self.box_tests = self.face_tests = 0
        self.move(points)

    def move(self, vertices: ArrayLike) -> None:
        """Takes new places (V, 3) [m] of the same vertices: boxes are refitted."""
        body_boxes.refit(as_points(vertices), self.faces, self._arrays)

    def query(self, points: ArrayLike, tolerance: float) -> tuple[FloatArray, FloatArray]:
        """Signed distances (N,) [m] and normals (N, 3) for points nearer to the surface than the tolerance, on either side of
        it; inf and zero for others."""
        distances, normals, _ = self._query(points, tolerance)
        return distances, normals

    def nearest(self, points: ArrayLike, reach: float) -> IntArray:
        """The nearest face (N,) to points (N, 3) within reach [m]; -1 beyond."""
        return self._query(points, reach)[2]

    def _query(self, points: ArrayLike, reach: float) -> tuple[FloatArray, FloatArray, IntArray]:
        p = as_points(points, "points")
        distances, normals, nearest = np.empty(len(p)), np.empty((len(p), 3)), np.empty(len(p), np.int32)
        boxes, faces = body_boxes.query(p, self._arrays, float(reach), self._stack, distances, normals, nearest)
        self.box_tests += boxes
        self.face_tests += faces
        return distances, normals, nearest
