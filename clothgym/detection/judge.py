"""How much a detector misses, counted while a simulation runs."""

from __future__ import annotations

from typing import Any

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.detection.brute_force import BruteForce
from clothgym.detection.intersections import Intersections
from clothgym.kernels import dop_pairs
from clothgym.mesh import Surface


class Judge:
    """A detector, and beside it every pair: what may touch and was not listed is counted. The detector answers.

    Args:
        tree: any detector.
        surface: its faces.
        vertex_count: V.

    Attributes:
        near, missed: pairs whose distance is within both radii and their relative way, in all searches; those not listed.
        hits, missed_hits: pairs of an edge and a face that intersect; those not listed.
    """

    def __init__(self, tree: Any, surface: Surface, vertex_count: int) -> None:
        self.tree, self.surface = tree, surface
        self._every = BruteForce(surface, np.zeros((vertex_count, 3)))
        self._places: tuple[FloatArray, FloatArray, FloatArray] = (np.zeros((0, 3)),) * 3
        self.near = self.missed = self.hits = self.missed_hits = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.__dict__["tree"], name)

    def refit(self, start: FloatArray, end: FloatArray, radius: float | FloatArray) -> None:
        """As `Hierarchy.refit`."""
        self.tree.refit(start, end, radius)
        self._every.refit(start, end, radius)
        radii = np.broadcast_to(np.asarray(radius, np.float64), (len(start),)).copy()
        self._places = start.copy(), end - start, radii

    def search(self, near: bool, hits: bool) -> None:
        """As `Hierarchy.search`."""
        self.tree.search(near, hits)
        self._every.search(near, hits)
        if near:
            for kind, name in enumerate(("vertex_face", "edge_edge")):
                true = self._true(kind, self._keys(self._every, kind, name))
                self.near += len(true)
                self.missed += len(np.setdiff1d(true, self._keys(self.tree, kind, name), assume_unique=True))
        if hits:
            true, found = ({tuple(h) for h in self._hits(tree).tolist()} for tree in (self._every, self.tree))
            self.hits += len(true)
            self.missed_hits += len(true - found)

    def edges_against_faces(self) -> IntArray:
        """As `Hierarchy.edges_against_faces`."""
        self.search(near=False, hits=True)
        return self.tree.edge_face[: self.tree.counts[2]]

    def _keys(self, tree: Any, kind: int, name: str) -> Any:
        count = int(tree.counts[kind])
        keys = np.empty(count, np.int64)
        dop_pairs.encode(getattr(tree, name), count, self._columns(kind), kind == 1, keys)
        return keys

    def _columns(self, kind: int) -> int:
        return len(self.surface.edges if kind == 1 else self.surface.faces)

    def _true(self, kind: int, keys: Any) -> Any:
        """Keys of the pairs that may come within their radii."""
        s, weights = self.surface, np.empty((len(keys), 3))
        x, ways, radii = self._places
        count = dop_pairs.measure(x, ways, radii, s.faces, s.edges, kind, self._columns(kind), 0.0, keys, weights)
        return keys[:count]

    def _hits(self, tree: Any) -> IntArray:
        edge_face = tree.edge_face[: tree.counts[2]].copy()
        return Intersections(self._places[0], self.surface, edge_face).edge_triangle


def watch(simulation: Any) -> Judge:
    """Puts a judge beside the detector of a simulation, from the next step on; steps then take as long as trying all pairs.

    Raises:
        ValueError: the scene has no self-collision, so nothing is looked for.
    """
    stages = [stage for stage in simulation.pipeline.stages if hasattr(stage, "candidates")]
    if not stages:
        raise ValueError("watch: the scene has no self-collision, so there is no detector")
    candidates = stages[0].candidates
    judge = Judge(candidates.tree, simulation.model.surface, simulation.model.vertex_count)
    candidates.tree = judge
    return judge
