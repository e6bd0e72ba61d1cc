"""Faulty detection on purpose: a share of all collisions and hits is ignored [Volino 2006, 3.1.2]."""

from __future__ import annotations

import numpy as np

from clothgym.arrays import BoolArray, IntArray


class Faults:
    """Which pairs detection misses in a step: a hash of their vertices and the step decides.

    A pair that is ignored stays so for the whole step. Drawn anew in every substep, each pair would be seen half of the time,
    and nothing would ever go through.

    Args:
        share: of the pairs that are ignored, 0 to 1.

    Attributes:
        step: number of the running step.
    """

    def __init__(self, share: float) -> None:
        self.share, self.step = share, 0
        self._limit = np.uint64(min(int(share * 2.0**64), 2**64 - 1))

    def seen(self, vertices: IntArray) -> BoolArray:
        """(N,) which of the pairs are not ignored.

        Args:
            vertices: (N, K) ids of both primitives of each pair, in any order.
        """
        mixed = _mixed(vertices.astype(np.uint64) + np.uint64(1)).sum(axis=1, dtype=np.uint64)
        step = _mixed(np.array([self.step], np.uint64) ^ np.uint64(0x5851F42D4C957F2D))
        seen: BoolArray = _mixed(mixed ^ step) >= self._limit
        return seen


def _mixed(values: np.ndarray) -> np.ndarray:
    """A hash of each of some unsigned integers [splitmix64, Steele 2014]."""
    z = values + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
