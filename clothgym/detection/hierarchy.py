"""The k-DOP hierarchy of one surface [Mezger 2003]: built once, refitted while the vertices move."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import FloatArray, IntArray
from clothgym.kernels import cluster_pairs, clusters, kdop
from clothgym.mesh import Surface

_SMALL = 4 * clusters.LEAF
"""Components with fewer faces share their leaves with others."""

_KINDS = ("vertex_face", "edge_edge", "edge_face")


class Hierarchy:
    """Bounding-volume tree over clusters of 16 triangles of a surface, and over what each cluster owns.

    Unlike the paper's, a leaf is a cluster: its triangles, edges and vertices are tested 16 at a time. Results do not depend
    on the shape that the tree was built from, only the time they take.

    Args:
        surface: topology.
        vertices: (V, 3) [m] the shape whose triangles are grouped (rest or first pose).
        k: 6, 8, 14, 18 or 26 half-spaces a box.
        arity: 2, 4, 8 or 16 children a node.
        by_component: connected components do not share leaves, since they go separate ways when they move; for a single
            query of layers that lie close, leaves that hold a bit of each are twice as fast.

    Attributes:
        vertex_face: (C, 2) vertex and face ids, edge_edge: (C, 2) edge ids, edge_face: (C, 2) edge and face ids of pairs
            without a common vertex, valid up to `counts` (3,) after `search`.
        box_tests: tests of a box against a block of 16 since the tree was built.
    """

    def __init__(
        self, surface: Surface, vertices: FloatArray, k: int = 18, arity: int = 4, by_component: bool = True
    ) -> None:
        self.surface = surface
        self.k, self.arity = k, arity
        axes = kdop.AXES[k]
        # intervals are tested three at a time: the first axes fill the last group up
        self._axes = np.ascontiguousarray(np.resize(axes, (-(-len(axes) // 3) * 3, 3)))
        self._axis_lengths = np.sqrt((self._axes**2).sum(axis=1))
        self.clusters = _clusters(surface, _order(surface, vertices, axes, by_component), 2 * len(self._axes), arity)
        count = len(surface.faces)
        self._ways = np.empty((len(vertices), 2 * len(self._axes)), np.float32)
        self._scratch = cluster_pairs.scratch(len(self.clusters.edge_start), len(self.clusters.levels), arity)
        self.vertex_face: IntArray = np.empty((4 * count + 64, 2), np.int32)
        self.edge_edge: IntArray = np.empty((12 * count + 64, 2), np.int32)
        self.edge_face: IntArray = np.empty((64, 2), np.int32)
        self.counts: NDArray[np.int64] = np.zeros(4, np.int64)
        self.box_tests = 0
        self._reach = -1.0

    def refit(self, start: FloatArray, end: FloatArray, radius: float | FloatArray) -> None:
        """Boxes around all primitives on their way from start to end (V, 3), widened by radius [m], one for all or (V,)."""
        pads = radius if isinstance(radius, np.ndarray) else np.array([radius], np.float64)
        still = start is end and len(pads) == 1
        self._reach = kdop.refit_clusters(
            start, end, pads, still, self._axes, self._axis_lengths, self.clusters, self._ways
        )

    def search(self, near: bool, hits: bool) -> None:
        """Fills vertex_face and edge_edge (near), edge_face (hits) with the pairs whose boxes overlap.

        The lists that are not asked for stay as they are; buffers grow by counting.
        """
        wanted = (_KINDS[:2] if near else ()) + (_KINDS[2:] if hits else ())
        tree, scratch, counts = self.clusters, self._scratch, self.counts
        while True:
            counts[3] = cluster_pairs.overlapping_pairs(
                tree, self._reach, near, hits, counts, scratch, self.vertex_face, self.edge_edge, self.edge_face
            )
            if not self._grown(wanted):
                break
        self.box_tests += int(counts[3])

    def _grown(self, kinds: tuple[str, ...]) -> bool:
        """Makes room for what did not fit; whether there was any."""
        grown = False
        for kind in kinds:
            count = int(self.counts[_KINDS.index(kind)])
            if count > len(getattr(self, kind)):
                setattr(self, kind, np.empty((int(1.3 * count) + 64, 2), np.int32))
                grown = True
        return grown

    def edges_against_faces(self) -> IntArray:
        """(C, 2) edges and faces that may intersect: a search for nothing else; valid until the next one."""
        self.search(near=False, hits=True)
        return self.edge_face[: self.counts[2]]


def _clusters(surface: Surface, order: NDArray[np.int64], rows: int, arity: int) -> clusters.Clusters:
    """The blocks of a surface, boxes empty, from the order of its faces in the leaves."""
    faces, count = surface.faces, len(surface.faces)
    leaves = -(-count // clusters.LEAF)
    place = np.empty(count, np.int64)
    place[order] = np.arange(count)
    owned = np.flatnonzero(surface.vertex_owner >= 0)
    edge_start, edge_place, edges = _in_leaves(place[surface.edge_owner] // clusters.LEAF, leaves)
    vertex_start, vertex_place, points = _in_leaves(place[surface.vertex_owner[owned]] // clusters.LEAF, leaves)
    edge_start += leaves
    vertex_start += edge_start[-1]
    levels = [int(vertex_start[-1])]
    size = leaves
    while size > 0 and (size > 1 or len(levels) == 1):
        size = -(-size // arity)
        levels.append(levels[-1] + size)
    boxes = _aligned((levels[-1], rows, clusters.LANES), np.float32)
    high = np.arange(rows) % 6 >= 3
    boxes[:, ~high], boxes[:, high] = np.inf, -np.inf
    ids = _aligned((levels[-1], 4, clusters.LANES), np.int32)
    ids[:] = -1
    at, lane = np.divmod(np.arange(count), clusters.LEAF)
    ids[at, 0, lane] = order
    ids[at, 1:, lane] = faces[order]
    at, lane = np.divmod(edge_place, clusters.LANES)
    ids[at + leaves, 0, lane] = edges
    ids[at + leaves, 1:, lane] = surface.edges[edges][:, [0, 1, 1]]
    at, lane = np.divmod(vertex_place, clusters.LANES)
    ids[at + edge_start[-1], :, lane] = owned[points, None]
    starts = (edge_start.astype(np.uint64), vertex_start.astype(np.uint64), np.array(levels, np.uint64))
    shapes = _aligned((int(vertex_start[-1]), 6, clusters.LANES), np.float32)
    shapes[:] = 0.0
    return clusters.Clusters(boxes, shapes, ids, *starts, arity)


def _aligned(shape: tuple[int, ...], kind: type) -> NDArray[Any]:
    """An array whose rows of 16 lie in one cache line each."""
    count = int(np.prod(shape))
    room: NDArray[Any] = np.empty(count + clusters.LANES, kind)
    first = -(room.ctypes.data // room.itemsize) % clusters.LANES
    return room[first : first + count].reshape(shape)


def _order(surface: Surface, vertices: FloatArray, axes: FloatArray, by_component: bool) -> NDArray[np.int64]:
    """Faces in the order of the leaves."""
    count = len(surface.faces)
    centroids = (vertices[surface.faces] / 3.0).sum(axis=1)
    projections = (axes / np.linalg.norm(axes, axis=1)[:, None]) @ centroids.T
    group = np.zeros(count, np.int64)
    if by_component:
        component = surface.components[surface.faces[:, 0]]
        large = np.bincount(component, minlength=1) >= _SMALL
        group = np.where(large[component], component + 1, 0)
    by_group = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[by_group], prepend=-1)) if count else np.zeros(0, np.int64)
    order = np.empty(count, np.int64)
    for first, last in zip(starts, np.append(starts[1:], count), strict=count > 0):
        members = by_group[first:last]
        local = np.empty(last - first, np.int64)
        clusters.cluster_order(np.ascontiguousarray(projections[:, members]), local)
        order[first:last] = members[local]
    return order


def _in_leaves(leaf: NDArray[np.int64], leaves: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """First block of each leaf (L + 1,); the places of primitives sorted by leaf, counted in lanes; and their ids."""
    counts = np.bincount(leaf, minlength=leaves)
    start = np.concatenate([[0], np.cumsum(-(-counts // clusters.LANES))])
    ids = np.argsort(leaf, kind="stable")
    first = np.concatenate([[0], np.cumsum(counts)])
    return start, start[leaf[ids]] * clusters.LANES + np.arange(len(leaf)) - first[leaf[ids]], ids
