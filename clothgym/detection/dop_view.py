"""Boxes and cones of a `DopTree` for one kind of search of a simulation, and what is kept for the next one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.detection.dop_tree import DopTree
from clothgym.fidelity import Fidelity
from clothgym.kernels import cones, dop_traversal, kdop, oriented
from clothgym.mesh import Surface

_ALL = kdop.AXES[26]
_ALL_LENGTHS = np.sqrt((_ALL**2).sum(axis=1))
_HAIR = 1e-9
"""What boxes and promises are widened by, as a share: more than all roundings."""


@dataclass(frozen=True)
class Kept:
    """Pairs of primitives with the barycentrics of their closest points, and the groups of both."""

    keys: Any
    weights: FloatArray
    first: Any
    second: Any

    def taken(self, rows: Any) -> Kept:
        """The chosen rows."""
        return Kept(self.keys[rows], self.weights[rows], self.first[rows], self.second[rows])

    def joined(self, other: Kept) -> Kept:
        """These, then the others."""
        return Kept(*(np.concatenate([getattr(self, n), getattr(other, n)]) for n in self.__dataclass_fields__))


class DopView:
    """Where the vertices are and go, the boxes around that, and what earlier searches left.

    Args:
        tree: its topology is read.
        surface: the same faces.
        fidelity: the fields of detection = "mezger".
        moving: whether vertices have ways; a view of positions alone needs no velocity cones.

    Attributes:
        tree: a `dop_traversal.Tree` with boxes and cones of its own.
        start, ways, radius: of the last refit, (V, 3), (V, 3), (V,) [m].
        seen: (V, 3) positions that the cones were made of.
        own_ways, wide_ways: (V, 26) intervals of the vertices, and those widened for coherence.
        rules: what the traversal may prune.
        stops: (S, 2) where the last descent stopped, or nothing.
        kept: of each kind of pair, those that the last search left.
        slack: (G, G) relative way of two groups since their pairs were looked for [m].
    """

    def __init__(self, tree: DopTree, surface: Surface, fidelity: Fidelity, moving: bool) -> None:
        self._source, self._surface, self.moving = tree, surface, moving
        count, nodes, groups = surface.vertex_count, len(tree.tree.child_count), len(tree.group_nodes)
        self.tree = tree.with_room()
        self._mode = oriented.INFLATIONS[fidelity.inflation] if moving else oriented.UNORIENTED
        self._cones = dop_traversal.CONES[fidelity.cones]
        self._exact = self._cones == dop_traversal.EXACT
        self._wide, self._lazy, self._margin = fidelity.wide_angle, fidelity.lazy, fidelity.coherence
        self.start, self.ways, self.radius = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
        self._end = np.zeros((count, 3))
        self.seen, self._seen_ways, self._seen_radius = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
        self._projections = np.zeros((count, len(tree.axes)))
        swept = self._mode == oriented.SWEPT
        self._ends = np.zeros_like(self._projections) if swept else self._projections
        self.own_ways = np.zeros((count, 2 * len(_ALL)))
        self.wide_ways = np.zeros_like(self.own_ways) if self._margin > 0.0 else self.own_ways
        self._stale, self._stale_groups = np.ones(nodes, np.uint8), np.ones(groups, np.uint8)
        extra = (4.0 if moving else 2.0) * (self._lazy + self._margin)
        travels = self._exact and self._mode != oriented.UNORIENTED
        self.rules = dop_traversal.Rules(
            self._cones, fidelity.close_angle, fidelity.leaf_angle, extra, 1.0 if travels else 0.0
        )
        self._inner_speeds = travels
        self.slack = np.zeros((groups, groups))
        self.forget()

    def forget(self) -> None:
        """As if no search had been."""
        self._fresh = True
        self.stops: Any = None
        self._age = 0
        self.kept: list[Kept | None] = [None, None, None]
        self._kinds = (False, False)
        self.slack[:] = 0.0

    def refit(self, start: FloatArray, end: FloatArray, radius: float | FloatArray) -> int:
        """Brings boxes and cones up to date; returns how many nodes that took."""
        pads = np.broadcast_to(np.asarray(radius, np.float64), (len(self.radius),))
        if self._margin > 0.0 and not self._fresh:
            self._drift(start, end, pads)
        self.start[:], self.radius[:] = start, pads
        if self.moving:
            self._end[:] = end
            np.subtract(end, start, out=self.ways)
        kdop.vertex_intervals(start, end, _ALL, _ALL_LENGTHS, self.radius, self.own_ways)
        if self._margin > 0.0:
            wide = self.radius * (1.0 + _HAIR) + 0.5 * self._margin
            kdop.vertex_intervals(start, end, _ALL, _ALL_LENGTHS, wide, self.wide_ways)
        refitted = self._mark()
        if refitted:
            self._boxes()
        return refitted

    def _mark(self) -> int:
        """Which nodes are stale [Mezger 2003, 4.3]; how many."""
        if self._fresh or self._lazy == 0.0:
            self._fresh = False
            self._stale[:] = 1
            self.seen[:], self._seen_ways[:], self._seen_radius[:] = self.start, self.ways, self.radius
        else:
            source = self._source
            oriented.mark_stale(
                self.start, self.ways, self.radius, self.seen, self._seen_ways, self._seen_radius,
                source.group_start, source.members, self._lazy, self._stale_groups,
            )  # fmt: skip
            some = self._stale_groups.any()
            group = self.tree.node_group
            self._stale[:] = np.where(group < 0, some, self._stale_groups[group])
        return int(np.count_nonzero(self._stale))

    def _boxes(self) -> None:
        tree, source, mode, stale = self.tree, self._source, self._mode, self._stale
        fat = self._seen_radius * (1.0 + _HAIR) + (self._lazy + 0.5 * self._margin)
        if self._cones != dop_traversal.NO_CONES:
            cones.normal_cones(tree, self.seen, source.triangles, source.triangle_start, 1 if self._exact else 0, stale)
        if self._exact:
            # contact and crossing are decided exactly, the cones are not
            oriented.widest(tree, np.maximum(fat, _HAIR * float(np.abs(self.seen).max())), stale)
        if self._inner_speeds or mode in (oriented.ORIENTED, oriented.CONSERVATIVE):
            cones.velocity_cones(tree, self._seen_ways, 0 if self._inner_speeds else 1, stale)
        oriented.project(self.seen, source.axes, self._projections)
        if mode == oriented.SWEPT:
            ends = self._end if self._lazy == 0.0 else self.seen + self._seen_ways
            oriented.project(ends, source.axes, self._ends)
        oriented.refit(
            tree, self._projections, self._ends, source.axes, source.lengths, fat, 1.0, self._wide, mode, stale
        )

    # Coherence

    def _drift(self, start: FloatArray, end: FloatArray, pads: FloatArray) -> None:
        """Adds to the slack what any two vertices of two groups have moved against each other, at both ends, and grown."""
        source, nodes = self._source, self._source.group_nodes
        moves = [start - self.start] + ([end - self._end] if self.moving else [])
        trees = []
        for move in moves:
            tree = source.with_room()
            cones.velocity_cones(tree, move, 0, np.ones(len(tree.child_count), np.uint8))
            trees.append(tree)
        growth = np.maximum(pads - self.radius, 0.0)
        grown = np.maximum.reduceat(growth[source.members], source.group_start[:-1])
        way, most = np.zeros_like(self.slack), np.zeros_like(self.slack)
        for a in trees:
            for b in trees:
                cones.group_travel(a, nodes, b, nodes, way)
                np.maximum(most, way, out=most)
        hair = _HAIR * (most + 1e-6 * float(np.abs(start).max()))
        self.slack += most + hair + grown[:, None] + grown[None, :]

    def reusable(self, near: bool, hits: bool) -> Any:
        """(G, G) uint8: pairs of groups whose kept pairs are still all that there are; (0, 0) without coherence."""
        if self._margin == 0.0:
            return np.zeros((0, 0), np.uint8)
        known = self._kinds
        self._kinds = (near, hits)
        if (near and not known[0]) or (hits and not known[1]):
            skip = np.zeros(self.slack.shape, np.uint8)
        else:
            skip = np.ascontiguousarray(self.slack <= self._margin, np.uint8)
        for n in range(3):
            if not (hits if n == 2 else near) or not (known[1] if n == 2 else known[0]):
                self.kept[n] = None
        self.slack[skip == 0] = 0.0
        return skip

    # The separation list

    def first_pairs(self, period: int) -> Any:
        """Pairs of nodes to begin with: the roots, or where the last descent stopped; the roots again after `period` times."""
        if period and self.stops is not None and self._age < period:
            self._age += 1
            return self.stops
        self._age = 1
        return np.zeros((1, 2), np.int64)
