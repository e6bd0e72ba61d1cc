"""How much a detector misses, counted while a simulation runs."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.detection.brute_force import BruteForce
from clothgym.detection.intersections import Intersections
from clothgym.kernels import dop_pairs
from clothgym.mesh import Surface

_KINDS = ("vertex_face", "edge_edge")


class Truth:
    """What may touch and what intersects, found by trying every pair.

    Args:
        surface: faces.
        vertex_count: V.
        keep: whether what was found in some places is kept until `forget`; else until the next `refit`.
    """

    def __init__(self, surface: Surface, vertex_count: int, keep: bool = False) -> None:
        self.surface, self.keep = surface, keep
        self._every = BruteForce(surface, np.zeros((vertex_count, 3)))
        self._places: tuple[FloatArray, FloatArray, FloatArray] = (np.zeros((0, 3)),) * 3
        self._name = b""
        self._known: dict[tuple[bytes, str], Any] = {}

    def forget(self) -> None:
        """Drops what was found."""
        self._known.clear()

    def refit(self, start: FloatArray, end: FloatArray, radius: float | FloatArray) -> None:
        """As `Hierarchy.refit`."""
        self._every.refit(start, end, radius)
        radii = np.broadcast_to(np.asarray(radius, np.float64), (len(start),)).copy()
        self._places = start.copy(), end - start, radii
        self._name = hashlib.sha256(b"".join(a.tobytes() for a in self._places)).digest()
        if not self.keep:
            self.forget()

    def near(self, kind: int) -> Any:
        """Keys of the pairs of one kind, vertex and face or edge and edge, that may come within their radii."""
        return self._once("near", lambda: [self._near(each) for each in range(len(_KINDS))])[kind]

    def hits(self) -> set[tuple[int, ...]]:
        """Pairs of an edge and a face that intersect."""
        return self._once("hits", lambda: self.hits_of(self._every))

    def keys(self, tree: Any, kind: int) -> Any:
        """Keys of the pairs of one kind that a detector lists."""
        count = int(tree.counts[kind])
        keys = np.empty(count, np.int64)
        dop_pairs.encode(getattr(tree, _KINDS[kind]), count, self._columns(kind), kind == 1, keys)
        return keys

    def hits_of(self, tree: Any) -> set[tuple[int, ...]]:
        """Those of its pairs of an edge and a face that intersect."""
        edge_face = tree.edge_face[: tree.counts[2]].copy()
        found = Intersections(self._places[0], self.surface, edge_face).edge_triangle
        return {tuple(row) for row in found.tolist()}

    def _once(self, what: str, find: Callable[[], Any]) -> Any:
        named = self._name, what
        if named not in self._known:
            self._every.search(near=what == "near", hits=what == "hits")
            self._known[named] = find()
        return self._known[named]

    def _near(self, kind: int) -> Any:
        s, keys = self.surface, self.keys(self._every, kind)
        weights = np.empty((len(keys), 3))
        x, ways, radii = self._places
        count = dop_pairs.measure(x, ways, radii, s.faces, s.edges, kind, self._columns(kind), 0.0, keys, weights)
        return keys[:count]

    def _columns(self, kind: int) -> int:
        return len(self.surface.edges if kind == 1 else self.surface.faces)


class Judge:
    """A detector, and beside it every pair: what may touch and was not listed is counted. The detector answers.

    Args:
        tree: any detector.
        truth: of its surface; detectors that are judged in the same states may share it.

    Attributes:
        near, missed: pairs whose distance is within both radii and their relative way, in all searches; those not listed.
        hits, missed_hits: pairs of an edge and a face that intersect; those not listed.
    """

    def __init__(self, tree: Any, truth: Truth) -> None:
        self.tree, self.truth = tree, truth
        self.near = self.missed = self.hits = self.missed_hits = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.__dict__["tree"], name)

    def refit(self, start: FloatArray, end: FloatArray, radius: float | FloatArray) -> None:
        """As `Hierarchy.refit`."""
        self.tree.refit(start, end, radius)
        self.truth.refit(start, end, radius)

    def search(self, near: bool, hits: bool) -> None:
        """As `Hierarchy.search`."""
        self.tree.search(near, hits)
        for kind in range(len(_KINDS)) if near else ():
            true = self.truth.near(kind)
            self.near += len(true)
            self.missed += len(np.setdiff1d(true, self.truth.keys(self.tree, kind), assume_unique=True))
        if hits:
            crossing = self.truth.hits()
            self.hits += len(crossing)
            self.missed_hits += len(crossing - self.truth.hits_of(self.tree))

    def edges_against_faces(self) -> IntArray:
        """As `Hierarchy.edges_against_faces`."""
        self.search(near=False, hits=True)
        return self.tree.edge_face[: self.tree.counts[2]]


def watch(simulation: Any) -> Judge:
    """Puts a judge beside the detector of a simulation, from the next step on; steps then take as long as trying all
    pairs.

    Raises:
        ValueError: the scene has no self-collision, so nothing is looked for.
    """
    stages = [stage for stage in simulation.pipeline.stages if hasattr(stage, "candidates")]
    if not stages:
        raise ValueError("watch: the scene has no self-collision, so there is no detector")
    candidates = stages[0].candidates
    judge = Judge(candidates.tree, Truth(simulation.model.surface, simulation.model.vertex_count))
    candidates.tree = judge
    return judge
