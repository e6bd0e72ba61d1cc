"""One object of a `DopScene`: its polygons, their hierarchy, and what of it is up to date."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import as_points
from clothgym.detection.dop_tree import DopTree, as_places
from clothgym.kernels import cones, oriented
from clothgym.kernels.dop_primitives import Shape
from clothgym.mesh import Surface


class DopObject(DopTree):
    """Polygons that move, and their boxes and cones.

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
        places = points if pattern is None else as_places(pattern, len(points))
        super().__init__(faces, len(points), places, k, arity, depth, regions)
        self.surface = Surface(self.triangles, len(points))
        nodes, groups = len(self.tree.child_count), len(self.group_nodes)
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
        self._no_radius = np.zeros(1)

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
                self.positions, self.ways, self._no_radius, self.seen, self.seen_ways, self._no_radius,
                self.group_start, self.members, lazy, self._stale_groups,
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
            tree, self._projections, self._ends, self.axes, self.lengths, np.array([0.5 * reach]), 1.0, wide, mode,
            self._stale,
        )  # fmt: skip
        return refitted
