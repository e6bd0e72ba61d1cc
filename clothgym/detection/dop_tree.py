"""A hierarchy of k-DOPs with one polygon a leaf, and what of it never changes [Mezger 2003, 4.1-4.2 and 5.1]."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import FloatArray, IntArray, as_faces, as_points
from clothgym.kernels import bvh, dop_traversal, kdop


class DopTree:
    """Triangles (F, 3) or quads (F, 4), the tree over them, its face groups and outlines.

    A quad stands for the triangles (0, 1, 2) and (0, 2, 3) and has one leaf for both.

    Args:
        faces: (F, 3) or (F, 4) vertex ids; those that enclose no area because ids repeat are left out.
        vertex_count: V.
        places: (V, 3) that the tree is built over [m], or (F, P, 3): of the corners of each face.
        k, arity: of the hierarchy.
        depth: level of the tree whose nodes are the face groups; 0 = one group.
        regions: whether outlines are wanted (normal cones).

    Attributes:
        tree: boxes and cones empty.
        corners: (P, 4); triangles (T, 3); triangle_start (P + 1,): triangles of each polygon.
        polygon_group: (P,) face group; group_nodes (G,) nodes that are the groups.
        group_start: (G + 1,), members: vertices of each group, those at borders in several.

    Raises:
        ValueError: wrong shapes, ids out of range, or no face.
    """

    def __init__(
        self, faces: ArrayLike, vertex_count: int, places: FloatArray, k: int, arity: int, depth: int, regions: bool
    ) -> None:
        self.corners, self.triangles, self.triangle_start, kept = _polygons(faces, vertex_count)
        self.axes = kdop.AXES[k]
        self.lengths = np.sqrt((self.axes**2).sum(axis=1))
        at = places[kept] if places.ndim == 3 else places[self.corners]
        start, count, face = self._build(np.ascontiguousarray(at.mean(axis=1)), arity)
        nodes = len(start)
        level = _levels(start, count)
        group, self.group_nodes = _groups(level, start, count, depth)
        groups = len(self.group_nodes)
        polygon_group = np.zeros(len(self.corners), np.int32)
        leaves = face >= 0
        polygon_group[face[leaves]] = group[leaves]
        member, self.group_start, self.members = _members(polygon_group, self.corners, vertex_count, groups)
        adjacent = np.ascontiguousarray((member.T @ member).toarray() > 0, np.uint8)
        border_start, border = np.zeros(nodes + 1, np.int64), np.zeros(0, np.int32)
        if regions:
            border_start, border = self._outlines(start, count, face, vertex_count)
        component = components(self.corners, vertex_count)
        whole = _whole(component, start, count, face)
        self.tree = dop_traversal.Tree(
            start, count, face, group, _cliques(group, start, count, adjacent) & whole, adjacent, component, self.corners,
            border_start, border, *self._room(nodes),
        )  # fmt: skip
        self.polygon_group = polygon_group

    def _room(self, nodes: int) -> tuple[Any, ...]:
        """Room for what changes with the vertices, in the order of `dop_traversal.Tree`."""
        return (
            np.zeros((nodes, 2 * len(self.axes))),
            np.zeros((nodes, 3)), np.zeros(nodes), np.zeros(nodes), np.zeros(nodes),
            np.zeros((nodes, 3)), np.zeros(nodes), np.zeros(nodes), np.zeros(nodes),
        )  # fmt: skip

    def with_room(self) -> dop_traversal.Tree:
        """The same tree with boxes and cones of its own."""
        return dop_traversal.Tree(*self.tree[:10], *self._room(len(self.tree.child_count)))

    def _build(self, centres: FloatArray, arity: int) -> tuple[Any, Any, Any]:
        count = len(centres)
        start, children = np.zeros(2 * count, np.int64), np.zeros(2 * count, np.int64)
        face = np.full(2 * count, -1, np.int64)
        nodes = bvh.build(centres, self.axes, self.lengths, arity, start, children, face)
        return start[:nodes].copy(), children[:nodes].copy(), face[:nodes].copy()

    def _outlines(self, start: Any, count: Any, face: Any, vertex_count: int) -> tuple[Any, Any]:
        """Outline of the region of every node."""
        twins = _twins(self.corners, vertex_count)
        border_start, border = np.zeros(len(start) + 1, np.int64), np.zeros(8 * len(face), np.int32)
        needed = dop_traversal.outlines(start, count, face, twins, self.corners, vertex_count, border_start, border)
        if needed > len(border):
            border = np.zeros(needed, np.int32)
            dop_traversal.outlines(start, count, face, twins, self.corners, vertex_count, border_start, border)
        return border_start, border[:needed].copy()


def as_places(pattern: ArrayLike, count: int) -> FloatArray:
    """(V, 3) from (V, 2) or (V, 3).

    Raises:
        ValueError: another shape, or numbers that are not finite.
    """
    places = np.asarray(pattern, np.float64)
    if places.ndim == 2 and places.shape[1] == 2:
        places = np.concatenate([places, np.zeros((len(places), 1))], axis=1)
    return as_points(places, "pattern", count)


def _polygons(faces: ArrayLike, vertex_count: int) -> tuple[IntArray, IntArray, Any, Any]:
    """Corners (P, 4), triangles (T, 3), the first triangle of each polygon (P + 1,), and which faces are left (F,)."""
    raw = np.asarray(faces)
    if raw.ndim == 2 and raw.shape[1] == 4:
        first = as_faces(raw[:, :3], vertex_count)
        second = as_faces(np.ascontiguousarray(raw[:, [0, 2, 3]]), vertex_count)
        split = np.stack([first, second], axis=1)
    else:
        split = as_faces(raw, vertex_count)[:, None, :]
    proper = (split[..., 0] != split[..., 1]) & (split[..., 1] != split[..., 2]) & (split[..., 2] != split[..., 0])
    kept = proper.any(axis=1)
    if not kept.any():
        raise ValueError("faces: needs at least one face with three different vertices")
    split, proper = split[kept], proper[kept]
    start = np.concatenate([[0], np.cumsum(proper.sum(axis=1))]).astype(np.int64)
    triangles = np.ascontiguousarray(split[proper], np.int32)
    corners = np.empty((len(split), 4), np.int32)
    corners[:, :3] = triangles[start[:-1]]
    corners[:, 3] = triangles[start[1:] - 1][:, 2]
    return corners, triangles, start, kept


def _levels(start: Any, count: Any) -> Any:
    """(N,) level of each node, 0 = root."""
    level = np.zeros(len(start), np.int32)
    first, last, now = 0, 1, 0
    while last > first:
        level[first:last] = now
        inner = np.flatnonzero(count[first:last]) + first
        if len(inner) == 0:
            break
        first, last, now = int(start[inner[0]]), int(start[inner[-1]] + count[inner[-1]]), now + 1
    return level


def _groups(level: Any, start: Any, count: Any, depth: int) -> tuple[Any, Any]:
    """Group of each node (N,), -1 above the groups' level, and the node of each group (G,)."""
    group = np.full(len(level), -1, np.int32)
    heads = np.flatnonzero((level == depth) | ((level < depth) & (count == 0)))
    group[heads] = np.arange(len(heads), dtype=np.int32)
    for now in range(depth, int(level.max())):
        for node in np.flatnonzero((level == now) & (count > 0)):
            group[start[node] : start[node] + count[node]] = group[node]
    return group, heads.astype(np.int64)


def _members(polygon_group: Any, corners: IntArray, vertex_count: int, groups: int) -> tuple[Any, Any, Any]:
    """Which vertex is in which group, as a sparse matrix (V, G) and by group."""
    from scipy.sparse import csc_array

    rows, columns = corners.ravel(), np.repeat(polygon_group, 4)
    keys = np.unique(columns.astype(np.int64) * vertex_count + rows)
    columns, rows = keys // vertex_count, keys % vertex_count
    member = csc_array((np.ones(len(keys), np.int32), (rows, columns)), shape=(vertex_count, groups))
    start = np.searchsorted(columns, np.arange(groups + 1)).astype(np.int64)
    return member, start, np.ascontiguousarray(rows, np.int64)


def components(corners: IntArray, vertex_count: int) -> Any:
    """(P,) int32 connected component of each polygon."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = np.repeat(corners[:, 0], corners.shape[1] - 1), corners[:, 1:].ravel()
    graph = coo_array((np.ones(len(ends[0]), np.int8), ends), shape=(vertex_count, vertex_count))
    return connected_components(graph, directed=False)[1].astype(np.int32)[corners[:, 0]]


def _whole(component: Any, start: Any, count: Any, face: Any) -> Any:
    """(N,) whether all polygons of a node hang together: layers above each other have the same normals."""
    low, high = np.zeros(len(start), np.int32), np.zeros(len(start), np.int32)
    for node in range(len(start) - 1, -1, -1):
        children = slice(start[node], start[node] + count[node])
        low[node] = component[face[node]] if count[node] == 0 else low[children].min()
        high[node] = component[face[node]] if count[node] == 0 else high[children].max()
    return (low == high).astype(np.uint8)


def _cliques(group: Any, start: Any, count: Any, adjacent: Any) -> Any:
    """(N,) whether all groups below a node share vertices with each other."""
    clique = np.ones(len(group), np.uint8)
    below: dict[int, set[int]] = {}
    for node in range(len(group) - 1, -1, -1):
        if group[node] >= 0:
            continue
        held: set[int] = set()
        for child in range(start[node], start[node] + count[node]):
            held |= {int(group[child])} if group[child] >= 0 else below[child]
        below[node] = held
        ids = sorted(held)
        clique[node] = adjacent[np.ix_(ids, ids)].all()
    return clique


def _twins(corners: IntArray, vertex_count: int) -> Any:
    """(P, 4) polygon across each side where just two sides meet and run against each other, else -1."""
    count = len(corners)
    size = np.where(corners[:, 2] == corners[:, 3], 3, 4)
    owner = np.repeat(np.arange(count), 4)
    side = np.tile(np.arange(4), count)
    real = side < size[owner]
    owner, side = owner[real], side[real]
    begin = corners[owner, side].astype(np.int64)
    end = corners[owner, (side + 1) % size[owner]].astype(np.int64)
    keys = np.minimum(begin, end) * vertex_count + np.maximum(begin, end)
    order = np.argsort(keys, kind="stable")
    _, first, number = np.unique(keys[order], return_index=True, return_counts=True)
    left, right = order[first[number == 2]], order[first[number == 2] + 1]
    good = (begin[left] == end[right]) & (owner[left] != owner[right])
    left, right = left[good], right[good]
    twins = np.full((count, 4), -1, np.int64)
    twins[owner[left], side[left]] = owner[right]
    twins[owner[right], side[right]] = owner[left]
    return twins
