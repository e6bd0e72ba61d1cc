"""Contact between cloths within a step: candidates that stay complete, closest points, projection, certificate."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import BoolArray, FloatArray, IntArray
from clothgym.detection.brute_force import BruteForce
from clothgym.detection.height_field import HeightFields
from clothgym.detection.hierarchy import Hierarchy
from clothgym.detection.mezger import MezgerHierarchy
from clothgym.kernels import bulk, contact, near_pairs, proximity
from clothgym.kernels.contact import Contacts
from clothgym.kernels.near_pairs import Watched
from clothgym.kernels.strays import Ways, strays_from
from clothgym.model import ClothModel
from clothgym.response.strays import Strays

if TYPE_CHECKING:
    from clothgym.detection.faults import Faults

_ERRATIC = 0.5
"""Slack of a vertex as a share of its expected travel beside that of all: fast vertices are the ones that change their mind."""

_LEEWAY = 0.5
"""And in thicknesses, for what contact and springs move a vertex within a substep; twice as much within four or more."""

_PER_PAIR = {"quads", "kinds", "rest", "gaps", "ways", "states", "weights", "separation", "links"}
"""Fields of `Watched` with a row for each pair; the others have one for each vertex."""


class Candidates:
    """Pairs of primitives that may touch within a step.

    Every vertex is expected at start + share u with share in [0, 1]. Boxes are swept along u and widened by half the
    thickness and each vertex's slack; as long as no vertex is further than its slack from where it was expected, no
    pair is missing.

    Sheets that are height fields, and stay so, have no pairs: `flat` says that this was decided, and pairs are not searched
    as long as it holds.

    Attributes:
        ahead: steps for which a decision is tried: twice as many after each that held, 1 after one that did not.
        most_ahead: its first and largest value; more than 1 for whoever books in `spent` how many substeps have used it up.
    """

    def __init__(
        self, model: ClothModel, tree: Hierarchy | BruteForce | MezgerHierarchy, flat_check: bool = False
    ) -> None:
        self.model, self.tree = model, tree
        sheets = HeightFields(model.surface, near_pairs.ACTIVE * model.thickness) if flat_check else None
        self.sheets = sheets if sheets is not None and sheets.possible else None
        self.flat = False
        count = len(model.faces)
        self.watched = watched_pairs(8 * count, model.vertex_count)
        self.count = 0
        self.horizon = self.ahead = self.most_ahead = 1
        self.spent = 0
        self.start: FloatArray = np.zeros((model.vertex_count, 3))
        self.travel: FloatArray = np.zeros((model.vertex_count, 3))
        self.slack: FloatArray = np.zeros(model.vertex_count)
        self._end: FloatArray = np.zeros((model.vertex_count, 3))
        self.strays = Strays(model.surface)
        self._leeway = 0.0
        self._bulk = np.zeros(bulk.BULK)
        self._widths: FloatArray = np.zeros(model.vertex_count)
        self._thickness = float(model.thickness.max())
        self.gathered = 0
        self._booked: dict[str, int] = {}
        self.faults: Faults | None = None

    @property
    def box_pairs(self) -> int:
        """Pairs of primitives whose boxes overlap."""
        return 0 if self.flat else int(self.tree.counts[0] + self.tree.counts[1])

    def settle(self, x: FloatArray, travel: FloatArray, horizon: int = 1) -> bool:
        """Whether nothing can touch when vertices leave x along `travel` (V, 3) [m], in `horizon` substeps."""
        self.flat = self.sheets is not None and self.sheets.decide(x, travel)
        if self.flat:
            self.horizon, self.spent, self.count = horizon, 0, 0
        return self.flat

    def lasts(self, substeps: int) -> bool:
        """Whether what was settled in an earlier step holds for so many substeps more.

        Whoever made those that are spent has looked whether vertices kept to their course; who moves them in any other way,
        between two steps, has to say so: `forget`.
        """
        return self.flat and 0 < self.spent <= self.horizon - substeps

    def forget(self) -> None:
        """Drops what was settled: results do not depend on it, work counters do."""
        self.flat, self.spent, self.ahead = False, 0, self.most_ahead

    def book(self, count: Callable[[str, int], None]) -> None:
        """Reports what the tree has counted since the last time."""
        for name, total in getattr(self.tree, "counters", {"box_tests": self.tree.box_tests}).items():
            if total != self._booked.get(name, 0):
                count(name, total - self._booked.get(name, 0))
                self._booked[name] = total

    def expect(self, x: FloatArray, travel: FloatArray, horizon: int = 1) -> None:
        """Pairs of boxes for vertices that leave x along `travel` (V, 3) [m], in `horizon` substeps.

        Nothing is searched if nothing could touch so far and `settle` says so again.
        """
        if self.flat and self.settle(x, travel, horizon):
            return
        self.horizon = horizon
        self.start[:] = x
        self.travel[:] = travel
        np.add(self.start, self.travel, out=self._end)
        self._leeway = _LEEWAY * min(math.sqrt(horizon), 2.0) * self._thickness
        self.strays.begin()
        bulk.slacks(self.start, self._end, _ERRATIC, self._leeway, self._bulk, self.slack)
        np.add(self.slack, 0.5 * self._thickness, out=self._widths)
        self.tree.refit(self.start, self._end, self._widths)
        self.tree.search(near=True, hits=False)

    def gather(self) -> None:
        """Primitive pairs from the pairs of boxes; buffers grow by counting."""
        if self.flat:
            return
        surface, tree = self.model.surface, self.tree
        while True:
            found = proximity.gather_quads(
                self.start,
                self.travel,
                surface.faces,
                surface.edges,
                self.model.thickness,
                self.slack,
                tree.vertex_face[: tree.counts[0]],
                tree.edge_edge[: tree.counts[1]],
                self.watched.quads,
                self.watched.kinds,
                self.watched.rest,
                self.watched.gaps,
                self.watched.weights,
            )
            if found <= len(self.watched.quads):
                break
            self.watched = watched_pairs(int(1.3 * found), len(self.start))
        self.count = found = self._keep_seen(0, found)
        near_pairs.begin(self.start, self.watched, found)
        self.gathered += found

    def _keep_seen(self, first: int, count: int) -> int:
        """Of the pairs `first` to `count`, those that faulty detection does not ignore; returns how many there are then."""
        if self.faults is None:
            return count
        w = self.watched
        seen = first + np.flatnonzero(self.faults.seen(w.quads[first:count]))
        for values in (w.quads, w.kinds, w.rest, w.gaps, w.weights):
            values[first : first + len(seen)] = values[seen]
        return first + len(seen)

    @property
    def quads(self) -> IntArray:
        """(K, 4) vertex ids of the pairs, of which the first `count` are valid."""
        return self.watched.quads

    @property
    def kinds(self) -> NDArray[np.uint8]:
        """(K,) 0 = vertex and triangle, 1 = two edges."""
        return self.watched.kinds

    def outdated(self, x: FloatArray, share: float) -> bool:
        """Whether a vertex is further than its slack from start + share travel, so that pairs may be missing."""
        if self.flat and self.sheets is not None:
            return not self.sheets.stays(x, share)
        return bool(strays_from(x, self.start, self.travel, share, self.slack))

    def widen(self, x: FloatArray, share: float) -> bool:
        """Gives more slack to the vertices that strayed from start + share travel to x (V, 3), and searches their pairs again;
        False if they are too many: then all pairs have to be searched.

        What is known of other pairs stays. Afterwards contacts have to be collected again.
        """
        ways = Ways(self.start, self.travel, self.slack, self.model.thickness)
        if self.flat or not self.strays.listed(x, share, ways, self._leeway):
            return False
        left = self.strays.drop(self.watched, self.count)
        while (found := self.strays.search(ways, self.watched, left)) > len(self.watched.quads):
            self.watched = grown(self.watched, int(1.3 * found), left)
        self.count = self._keep_seen(left, found)
        near_pairs.join(self.watched, left, self.count)
        return True


def watched_pairs(capacity: int, vertex_count: int) -> Watched:
    """Room for so many pairs of primitives."""
    return Watched(
        np.zeros((capacity, 4), np.int32),
        np.zeros(capacity, np.uint8),
        np.zeros(capacity),
        np.zeros(capacity),
        np.zeros(capacity),
        np.zeros(capacity, np.uint8),
        np.zeros((capacity, 4)),
        np.zeros((capacity, 4)),
        np.zeros((vertex_count, 3)),
        np.zeros((vertex_count, 3)),
        np.zeros(capacity, np.int64),
        np.zeros(vertex_count, np.int64),
        np.zeros((vertex_count, 9)),
        np.zeros(bulk.BULK + 1),
        np.zeros(vertex_count),
        np.zeros(vertex_count),
        np.zeros((vertex_count, 3)),
        np.zeros(vertex_count, np.bool_),
    )


def grown(watched: Watched, capacity: int, count: int) -> Watched:
    """The first `count` pairs, and all that is known of them, with room for more."""
    larger = watched_pairs(capacity, len(watched.start))
    for name, old, new in zip(Watched._fields, watched, larger, strict=True):
        per_pair = name in _PER_PAIR
        new[: count if per_pair else None] = old[: count if per_pair else None]
    return larger


class ContactBuffers:
    """Contacts of near pairs; capacity grows by counting.

    Attributes:
        known: how many are collected; negative = not since pairs were found or measured last.
        active: how many of them are live within the substep.
    """

    def __init__(self, capacity: int) -> None:
        self.known, self.active = -1, 0
        self.arrays = self._make(capacity)

    @staticmethod
    def _make(capacity: int) -> Contacts:
        return Contacts(
            np.zeros((capacity, 4), np.int32),
            np.zeros(capacity, np.int64),
            np.zeros((capacity, 4)),
            np.zeros((capacity, 3)),
            np.zeros(capacity),
            np.zeros(capacity),
            np.zeros(capacity),
            np.zeros(capacity),
            np.zeros(capacity),
            np.zeros(capacity),
            np.zeros((capacity, 3)),
            np.zeros(capacity, np.int64),
        )

    def forget(self) -> None:
        """Collects contacts again at the next look: pairs were found anew."""
        self.known = -1

    def grow(self, wanted: int) -> None:
        """Room for more contacts, which have to be collected again."""
        self.arrays, self.known = self._make(int(1.3 * wanted)), -1

    def narrow(
        self, x: FloatArray, p: FloatArray, candidates: Candidates, apart: BoolArray, both: bool, yield_force: float
    ) -> int:
        """Contacts on the way from x to p (V, 3); returns how many pairs were measured for them."""
        measured = 0
        while True:
            known, self.active, new = contact.narrow(
                x,
                p,
                candidates.watched,
                candidates.count,
                candidates.model.inverse_masses,
                apart,
                both,
                yield_force,
                self.known,
                self.arrays,
            )
            measured += int(new)
            if known <= len(self.arrays.rest):
                self.known = int(known)
                return measured
            self.grow(known)
