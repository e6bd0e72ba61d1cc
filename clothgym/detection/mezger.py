"""The hierarchy of [Mezger 2003] with every technique of the paper, for the simulation: one face a leaf."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import FloatArray, IntArray
from clothgym.detection.descent import Descent
from clothgym.detection.dop_tree import DopTree, components
from clothgym.detection.dop_view import DopView, Kept
from clothgym.fidelity import Fidelity
from clothgym.kernels import dop_pairs
from clothgym.mesh import Surface

_KINDS = ("vertex_face", "edge_edge", "edge_face")
_COUNTS = (
    "box_tests",
    "leaf_pairs",
    "cone_tests",
    "cone_pruned",
    "filtered",
    "reused_groups",
    "stops",
    "outline_tests",
)
_OWN = ("refits", "primitive_tests", "reused_pairs", "trees_built")


class MezgerHierarchy:
    """Same face as `Hierarchy`, with the techniques that the fidelity names.

    Pairs come sorted by their ids, and they are those whose boxes overlap on all axes of the 26-DOP: so a technique that misses
    nothing changes no bit of a simulation, whatever is kept from search to search, and `BruteForce` gives the same ones.

    Args:
        surface: topology.
        vertices: (V, 3) [m] where the cloths start.
        fidelity: k, arity, and the fields of detection = "mezger".
        places: (F, 3, 3) corners in the pattern, for build_space = "pattern".

    Attributes:
        vertex_face, edge_edge, edge_face, counts, box_tests: as `Hierarchy`.
        counters: sums since it was made, of box_tests, leaf_pairs (pairs of faces), cone_tests, cone_pruned, filtered (by the
            leaf angle), reused_groups (pairs of them), stops, outline_tests, refits (nodes), primitive_tests (closest points
            that it computes), reused_pairs (of primitives) and trees_built.

    Raises:
        ValueError: no face with three different vertices.
    """

    def __init__(
        self, surface: Surface, vertices: FloatArray, fidelity: Fidelity, places: FloatArray | None = None
    ) -> None:
        self.surface, self.fidelity = surface, fidelity
        self._first = self._built(vertices[surface.faces] if places is None else places, vertices)
        self._first_size = dop_pairs.tree_size(self._first.tree, vertices)
        self._descent = Descent(fidelity.separation_list > 0)
        self._keys = [np.zeros(4096, np.int64) for _ in _KINDS]
        self._columns = (len(surface.faces), len(surface.edges), len(surface.faces))
        self._tests = np.zeros(8, np.int64)
        self.vertex_face: IntArray = np.empty((64, 2), np.int32)
        self.edge_edge: IntArray = np.empty((64, 2), np.int32)
        self.edge_face: IntArray = np.empty((64, 2), np.int32)
        self.counts: NDArray[np.int64] = np.zeros(4, np.int64)
        self.counters = dict.fromkeys((*_COUNTS, *_OWN), 0)
        self._adopt(self._first, self._first_size)

    @property
    def box_tests(self) -> int:
        return self.counters["box_tests"]

    def _built(self, corners: FloatArray, x: FloatArray) -> DopTree:
        f, s = self.fidelity, self.surface
        return DopTree(
            s.faces, s.vertex_count, laid_out(s, corners, x), f.k, f.arity, f.face_groups, f.cones == "exact"
        )

    def forget(self) -> None:
        """Back to the first tree, without anything from earlier searches: results are the same, counters begin alike."""
        if self._tree is not self._first:
            self._adopt(self._first, self._first_size)
        self._moving.forget()
        self._resting.forget()

    def _adopt(self, tree: DopTree, size: float) -> None:
        self._tree, self._size = tree, size
        self._moving = DopView(tree, self.surface, self.fidelity, moving=True)
        self._resting = DopView(tree, self.surface, self.fidelity, moving=False)
        self._view = self._resting

    def renew(self, x: FloatArray) -> None:
        """A new tree over x (V, 3) if the boxes have `rebuild_growth` times the surface that they began with."""
        if dop_pairs.tree_size(self._tree.tree, x) > self.fidelity.rebuild_growth * self._size:
            tree = self._built(x[self.surface.faces], x)
            self._adopt(tree, dop_pairs.tree_size(tree.tree, x))
            self.counters["trees_built"] += 1

    def refit(self, start: FloatArray, end: FloatArray, radius: float | FloatArray) -> None:
        """Boxes as `Hierarchy.refit`; those of the same array twice are kept apart from those of ways."""
        self._view = self._resting if end is start else self._moving
        self.counters["refits"] += self._view.refit(start, end, radius)

    def search(self, near: bool, hits: bool) -> None:
        """As `Hierarchy.search`; pairs are sorted."""
        view = self._view
        skip = view.reusable(near, hits)
        found = self._traverse(view, skip)
        self._expand(view, found, near, hits)
        for n, name in enumerate(_KINDS):
            if not (hits if n == 2 else near):
                continue
            keys = self._keys[n][: self.counts[n]]
            if self.fidelity.coherence > 0.0:
                keys = self._merge(view, n, keys, skip)
            keys.sort()
            pairs = getattr(self, name)
            if len(keys) > len(pairs):
                pairs = np.empty((int(1.3 * len(keys)) + 64, 2), np.int32)
                setattr(self, name, pairs)
            dop_pairs.decode(keys, len(keys), self._columns[n], pairs)
            self.counts[n] = len(keys)

    def edges_against_faces(self) -> IntArray:
        """As `Hierarchy.edges_against_faces`."""
        self.search(near=False, hits=True)
        return self.edge_face[: self.counts[2]]

    def _traverse(self, view: DopView, skip: Any) -> int:
        """Number of pairs of faces, which are in `_descent`, whose boxes overlap and that nothing excludes."""
        start = view.first_pairs(self.fidelity.separation_list)
        found, stopped = self._descent.run(
            view.tree, view.tree, 1, view.seen, self._tree.lengths, view.rules, skip, start, counts=self._tests
        )
        for name, count in zip(_COUNTS, self._tests.tolist()):
            self.counters[name] += count
        self.counts[3] = self._tests[0]
        if self.fidelity.separation_list:
            view.stops = self._descent.stops[:stopped].copy()
        return found

    def _expand(self, view: DopView, found: int, near: bool, hits: bool) -> None:
        while True:
            dop_pairs.expand(
                self._descent.pairs, found, self.surface.arrays, view.wide_ways, near, hits, *self._keys, self.counts
            )
            small = [n for n in range(3) if (hits if n == 2 else near) and self.counts[n] > len(self._keys[n])]
            if not small:
                return
            for n in small:
                self._keys[n] = np.zeros(int(1.3 * self.counts[n]) + 64, np.int64)

    def _merge(self, view: DopView, kind: int, keys: Any, skip: Any) -> Any:
        """New keys with those kept of pairs of groups that were skipped; what may matter in this step."""
        s, columns, margin = self.surface, self._columns[kind], 3.0 * self.fidelity.coherence
        weights = np.empty((len(keys), 3))
        if kind < 2:
            self.counters["primitive_tests"] += len(keys)
            count = dop_pairs.measure(
                view.start, view.ways, view.radius, s.faces, s.edges, kind, columns, margin, keys, weights
            )
            keys, weights = keys[:count], weights[:count]
        owners = (s.vertex_owner, s.edge_owner, s.edge_owner)[kind], (None, s.edge_owner, None)[kind]
        row, column = keys // columns, keys % columns
        groups = (
            self._tree.polygon_group[owners[0][row]],
            self._tree.polygon_group[column if owners[1] is None else owners[1][column]],
        )
        kept, new = view.kept[kind], Kept(keys.copy(), weights.copy(), *groups)
        if kept is not None:
            kept = kept.taken(skip[kept.first, kept.second] == 1)
            self.counters["reused_pairs"] += len(kept.keys)
            new = kept.joined(new)
        view.kept[kind] = new
        chosen = np.empty(len(new.keys), np.int64)
        slack = view.slack[new.first, new.second]
        count = dop_pairs.still_near(
            view.start, view.ways, view.radius, view.own_ways, s.faces, s.edges, kind, columns, new.keys, new.weights,
            slack, chosen,
        )  # fmt: skip
        return chosen[:count]


def pattern_corners(surface: Surface, rests: list[tuple[IntArray, FloatArray]]) -> FloatArray:
    """(F, 3, 3) corners of all faces in the pattern [m].

    Args:
        surface: of all cloths together.
        rests: faces (F, 3) and rest shape, (V, 3) or (F, 3, 3), of each cloth.
    """
    corners = np.concatenate([rest[faces] if rest.ndim == 2 else rest for faces, rest in rests])
    return corners[surface.face_ids]


def laid_out(surface: Surface, corners: FloatArray, x: FloatArray) -> FloatArray:
    """Corners (F, 3, 3) moved piece by piece, so far apart that a tree over them splits pieces from each other first.

    A piece is what hangs together in these corners: a cloth, or a panel of a pattern. The paper has a hierarchy for every
    object; here they are subtrees of one. Pieces are in the order of their places in x (V, 3) along the longest axis.
    """
    named = np.concatenate([surface.faces.reshape(-1, 1), corners.reshape(-1, 3)], axis=1)
    unique, inverse = np.unique(named, axis=0, return_inverse=True)
    place: IntArray = np.ascontiguousarray(inverse.reshape(-1, 3), np.int32)
    _, piece = np.unique(components(place, len(unique)), return_inverse=True)
    pieces = int(piece.max()) + 1
    if pieces == 1:
        return corners
    sizes = np.bincount(piece)
    centres = np.stack([np.bincount(piece, row) / sizes for row in x[surface.faces].mean(axis=1).T], axis=1)
    rank = np.empty(pieces, np.int64)
    rank[np.argsort(centres[:, np.ptp(centres, axis=0).argmax()], kind="stable")] = np.arange(pieces)
    low, high = np.full((pieces, 3), np.inf), np.full((pieces, 3), -np.inf)
    np.minimum.at(low, piece, corners.min(axis=1))
    np.maximum.at(high, piece, corners.max(axis=1))
    # the digits of a number in base 2, read in base 4: the middle of every run of pieces lies in a gap
    bits = np.arange(max(int(rank.max()).bit_length(), 1))
    shift = -low
    shift[:, 0] += 4.0 * float((high - low).max()) * ((rank[:, None] >> bits & 1) * 4.0**bits).sum(axis=1)
    return corners + shift[piece][:, None, :]
