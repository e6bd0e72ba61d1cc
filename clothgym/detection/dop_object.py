"""One object of a `DopScene`: its polygons, their hierarchy, and what of it is up to date."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import FloatArray, IntArray, as_faces, as_points
from clothgym.kernels import bvh, cones, dop_traversal, kdop, oriented
from clothgym.kernels.dop_primitives import Shape
from clothgym.mesh import Surface


class DopObject:
    """Triangles (F, 3) or quads (F, 4) with a hierarchy of k-DOPs that is built once.

    A quad stands for the triangles (0, 1, 2) and (0, 2, 3) and has one leaf for both.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3) or (F, 4) vertex ids; those that enclose no area because ids repeat are left out.
        pattern: (V, 2) or (V, 3) places that the tree is built over instead of the vertices; None: the vertices.
        k, arity: of the hierarchy.
        depth: level of the tree whose nodes are the face groups; 0 = one group.
        regions: whether outlines are wanted (normal cones).

    Raises:
        ValueError: wrong shapes, ids out of range, numbers that are not finite, or no face.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        pattern: ArrayLike | None,
        k: int,
        arity: int,
        depth: int,
        regions: bool,
    ) -> None:
        points = as_points(vertices).copy()
        self.corners, self.triangles, self.triangle_start = _polygons(faces, len(points))
        self.surface = Surface(self.triangles, len(points))
        self.axes = kdop.AXES[k]
        self.lengths = np.sqrt((self.axes**2).sum(axis=1))
        places = points if pattern is None else _as_places(pattern, len(points))
        start, count, face = self._build(places, arity)
        nodes = len(start)
        level = _levels(start, count)
        group, self.group_nodes = _groups(level, start, count, depth)
        groups = len(self.group_nodes)
        polygon_group = np.zeros(len(self.corners), np.int32)
        leaves = face >= 0
        polygon_group[face[leaves]] = group[leaves]
        member, self.group_start, self.members = _members(polygon_group, self.corners, len(points), groups)
        adjacent = np.ascontiguousarray((member.T @ member).toarray() > 0, np.uint8)
        border_start, border = np.zeros(nodes + 1, np.int64), np.zeros(0, np.int32)
        if regions:
            border_start, border = self._outlines(start, count, face, len(points))
        self.tree = dop_traversal.Tree(
            start, count, face, group, _cliques(group, start, count, adjacent), adjacent, self.corners,
            border_start, border, np.zeros((nodes, 2 * len(self.axes))),
            np.zeros((nodes, 3)), np.zeros(nodes), np.zeros(nodes),
            np.zeros((nodes, 3)), np.zeros(nodes), np.zeros(nodes), np.zeros(nodes),
        )  # fmt: skip
        self.polygon_group = polygon_group
        self.positions, self.ways = points, np.zeros_like(points)
        self.seen, self.seen_ways = points.copy(), np.zeros_like(points)
        self._projections = np.zeros((len(points), len(self.axes)))
        self._ends = self._projections
        self._stale = np.ones(nodes, np.uint8)
        self._stale_groups = np.ones(groups, np.uint8)
        self.changed = True
        self.moving = False
        self._held: tuple[Any, ...] = ()
        self._still = np.zeros_like(points)

    def _build(self, places: FloatArray, arity: int) -> tuple[Any, Any, Any]:
        count = len(self.corners)
        start, children = np.zeros(2 * count, np.int64), np.zeros(2 * count, np.int64)
        face = np.full(2 * count, -1, np.int64)
        centres = np.ascontiguousarray(places[self.corners].mean(axis=1))
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

    def shape(self, moving: bool = True) -> Shape:
        """What the exact tests read; without ways if not `moving`."""
        s = self.surface
        return Shape(
            self.positions, self.ways if moving else self._still, s.faces, s.edges, s.face_edges,
            s.vertex_owner, s.edge_owner, self.triangle_start,
        )  # fmt: skip

    def update(self, positions: ArrayLike, velocities: ArrayLike | None, dt: float) -> None:
        """Takes positions [m], velocities [m/s] and the step [s]; the hierarchy follows when it is next needed."""
        count = len(self.positions)
        self.positions[:] = as_points(positions, "positions", count)
        if velocities is None or dt == 0.0:
            self.ways[:] = 0.0
            self.moving = False
        else:
            np.multiply(as_points(velocities, "velocities", count), dt, out=self.ways)
            self.moving = bool(self.ways.any())
        self.changed = True

    def refit(self, reach: float, mode: int, wide: float, lazy: float, tight: int, speeds: bool) -> int:
        """Brings boxes and cones up to date and returns how many nodes that took.

        Args:
            reach: distance at which proximities are wanted [m].
            mode, wide: inflation, see `kernels.oriented`.
            lazy: what a vertex may be off before its group is refitted [m].
            tight: normal cones: -1 none, 0 as the paper, 1 the smallest.
            speeds: whether inner nodes need velocity cones.
        """
        settings = (reach, mode, wide, lazy, tight, speeds)
        if not self.changed and self._held == settings:
            return 0
        tree = self.tree
        if self._held != settings or lazy == 0.0:
            self.seen[:] = self.positions
            self.seen_ways[:] = self.ways
            self._stale[:] = 1
        else:
            oriented.mark_stale(
                self.positions, self.ways, self.seen, self.seen_ways, self.group_start, self.members, lazy,
                self._stale_groups,
            )  # fmt: skip
            some = self._stale_groups.any()
            self._stale[:] = np.where(tree.node_group < 0, some, self._stale_groups[tree.node_group])
        self.changed, self._held = False, settings
        refitted = int(np.count_nonzero(self._stale))
        if refitted == 0:
            return 0
        moving = self.moving or bool(self.seen_ways.any())
        if tight >= 0:
            cones.normal_cones(tree, self.seen, self.surface.faces, self.triangle_start, tight, self._stale)
        if speeds or (moving and mode in (oriented.ORIENTED, oriented.CONSERVATIVE)):
            cones.velocity_cones(tree, self.seen_ways, 0 if speeds else 1, self._stale)
        elif not moving:
            mode = oriented.UNORIENTED
        oriented.project(self.seen, self.axes, self._projections)
        if mode == oriented.SWEPT:
            if self._ends is self._projections:
                self._ends = np.zeros_like(self._projections)
            oriented.project(self.seen + self.seen_ways, self.axes, self._ends)
        oriented.refit(
            tree, self._projections, self._ends, self.axes, self.lengths, reach, 1.0, wide, mode, self._stale
        )
        return refitted


def _polygons(faces: ArrayLike, vertex_count: int) -> tuple[IntArray, IntArray, Any]:
    """Corners (P, 4), triangles (T, 3) and the first triangle of each polygon (P + 1,)."""
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
    return corners, triangles, start


def _as_places(pattern: ArrayLike, count: int) -> FloatArray:
    places = np.asarray(pattern, np.float64)
    if places.ndim == 2 and places.shape[1] == 2:
        places = np.concatenate([places, np.zeros((len(places), 1))], axis=1)
    return as_points(places, "pattern", count)


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
