"""What a `DopScene` finds: pairs of primitives that are near."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from clothgym.arrays import BoolArray, FloatArray, IntArray
from clothgym.kernels.dop_primitives import Reports


@dataclass(frozen=True)
class Near:
    """Pairs of primitives of two objects, or of one with itself; arrays are valid until the next `collide`.

    Attributes:
        quads: (N, 4) vertex ids of the objects themselves, see `kinds`.
        kinds: (N,) 0 = vertex of the first, triangle of the second; 1 = edge, edge; 2 = vertex of the second, triangle of
            the first; 3 and 4 = virtual particle (face, number) against a face, of first and second.
        weights: (N, 3) barycentrics of the closest point on the triangle, or (s, t, 0) along the two edges.
        distances: (N,) [m] now.
        polygons: (N, 2).
    """

    quads: IntArray
    kinds: Any
    weights: FloatArray
    distances: FloatArray
    polygons: IntArray

    def __len__(self) -> int:
        return len(self.kinds)

    def taken(self, rows: Any) -> Near:
        """The chosen rows."""
        return Near(self.quads[rows], self.kinds[rows], self.weights[rows], self.distances[rows], self.polygons[rows])

    def keys(self) -> set[tuple[int, ...]]:
        """What the pairs are, without their order: (kind, ids ...)."""
        rows = np.concatenate([self.kinds[:, None].astype(np.int64), self.quads], axis=1).tolist()
        return {(k, *([q[0], *sorted(q[1:])] if k in (0, 2) else q)) for k, *q in rows}


def empty_reports(count: int) -> Reports:
    """Room for that many pairs."""
    return Reports(
        np.zeros((count, 4), np.int32), np.zeros(count, np.int8), np.zeros((count, 3)), np.zeros(count),
        np.zeros((count, 2), np.int32),
    )  # fmt: skip


def filled(out: Reports, count: int) -> Near:
    """The rows that a search has written."""
    return Near(out.quads[:count], out.kinds[:count], out.weights[:count], out.distances[:count], out.polygons[:count])


def of_second(kinds: Any) -> BoolArray:
    """(N, 4) which of the four vertices belong to the second object."""
    table = np.array([[0, 1, 1, 1], [0, 0, 1, 1], [1, 0, 0, 0]], np.bool_)
    return table[kinds]


def particles(count: int) -> FloatArray:
    """(S, 3) at least this many barycentric places inside a triangle, evenly."""
    n = 0
    while n * (n + 1) // 2 < count:
        n += 1
    rows = [(3 * i + 1, 3 * j + 1, 3 * (n - 1 - i - j) + 1) for i in range(n) for j in range(n - i)]
    return np.asarray(rows, np.float64).reshape(-1, 3) / max(3 * n, 1)
