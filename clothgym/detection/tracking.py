"""Which contour is which from step to step: for observations and logs only. No strategy looks back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from clothgym.detection.intersections import Intersections


class ContourTracker:
    """Gives contours numbers that they keep while they move.

    A contour goes on as the one of the last look with which it shares most vertices of pierced faces and piercing edges: hits
    slide from edge to edge, so that most of them are new after a step, but their neighbourhood is not. Each goes on once, by
    largest overlap; all others are new and get the next number, as are all on another surface.
    """

    def __init__(self) -> None:
        self._next = 0
        self._looks = 0
        self._surface: object = None
        self._last: list[NDArray[np.int32]] = []
        self._numbers: NDArray[np.int64] = np.zeros(0, np.int64)
        self._born: dict[int, int] = {}
        self._lives: dict[int, int] = {}

    def follow(self, hits: Intersections) -> NDArray[np.int64]:
        """(C,) number of each contour; call it once for every look."""
        around = _around(hits)
        if hits.surface is not self._surface:
            self._last = []
        self._surface = hits.surface
        overlaps = []
        where: dict[int, list[int]] = {}
        for old, vertices in enumerate(self._last):
            for v in vertices.tolist():
                where.setdefault(v, []).append(old)
        for new, vertices in enumerate(around):
            met = [old for v in vertices.tolist() for old in where.get(v, ())]
            for old, count in zip(*np.unique(np.array(met, np.int64), return_counts=True), strict=True):
                overlaps.append((-int(count), int(old), new))
        numbers = np.full(len(around), -1, np.int64)
        taken: set[int] = set()
        for _, old, new in sorted(overlaps):
            if numbers[new] < 0 and old not in taken:
                numbers[new] = self._numbers[old]
                taken.add(old)
        for new in np.flatnonzero(numbers < 0).tolist():
            numbers[new] = self._next
            self._born[self._next] = self._looks
            self._next += 1
        for old, number in enumerate(self._numbers.tolist()):
            if old not in taken:
                self._lives[number] = self._looks - self._born[number]
        self._last, self._numbers = around, numbers
        self._looks += 1
        return numbers

    def ages(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """For how many looks before the last one each of these contours has been there."""
        return np.array([self._looks - 1 - self._born[n] for n in numbers.tolist()], np.int64)

    def lives(self) -> dict[int, int]:
        """How many looks each contour saw that is gone, by its number."""
        return dict(self._lives)


def _around(hits: Intersections) -> list[NDArray[np.int32]]:
    """Vertices at the hits of each contour."""
    order, bounds = hits.by_contour
    surface = hits.surface
    vertices = np.concatenate([surface.edges[hits.hit_edge[order]], surface.faces[hits.hit_face[order]]], axis=1)
    return [np.unique(vertices[bounds[c] : bounds[c + 1]]) for c in range(hits.contour_count)]
