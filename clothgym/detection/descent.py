"""The descent of two k-DOP trees into each other, with room for what it finds that grows by counting."""

from __future__ import annotations

from typing import Any

import numpy as np

from clothgym.arrays import IntArray
from clothgym.kernels import dop_traversal

_ROOM = 4096


class Descent:
    """Room for descents.

    Args:
        resume: whether the pairs of nodes where a descent stops are kept.

    Attributes:
        pairs: (C, 2) int32 polygons, and stops: (D, 2) int64 nodes, valid up to what `run` returns.
    """

    def __init__(self, resume: bool) -> None:
        self.stack = np.zeros((_ROOM, 2), np.int64)
        self.pairs: IntArray = np.zeros((_ROOM, 2), np.int32)
        self.stops = np.zeros((_ROOM if resume else 0, 2), np.int64)

    def run(self, *search: Any, counts: Any) -> tuple[int, int]:
        """How many pairs and stops there are; search: arguments a to start of `dop_traversal.traverse`, counts its last."""
        while True:
            found, stopped, overflow = dop_traversal.traverse(*search, self.stack, self.pairs, self.stops, counts)
            if overflow:
                self.stack = np.zeros((2 * len(self.stack), 2), np.int64)
            elif found > len(self.pairs):
                self.pairs = np.zeros((int(1.3 * found) + 64, 2), np.int32)
            elif stopped > len(self.stops) > 0:
                self.stops = np.zeros((int(1.3 * stopped) + 64, 2), np.int64)
            else:
                return int(found), int(stopped)
