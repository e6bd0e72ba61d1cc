"""Every pair of faces: the comparator for the hierarchy, exchangeable with it."""

from __future__ import annotations

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.mesh import Surface

_LARGEST = 10_000


class BruteForce:
    """Same face as `Hierarchy`, without boxes: every pair of faces is a candidate."""

    def __init__(self, surface: Surface, vertices: FloatArray, k: int = 0, arity: int = 0) -> None:
        self.surface = surface
        count = len(surface.faces)
        if count > _LARGEST:
            raise ValueError(
                f"fidelity.detection = 'brute_force': {count} faces make too many pairs; at most {_LARGEST}"
            )
        first, second = np.triu_indices(count, 1)
        self._pairs = np.stack([first, second], axis=1).astype(np.int32)
        self.box_tests = 0

    def refit(self, start: FloatArray, end: FloatArray, radius: float | FloatArray) -> None:
        """Nothing to refit."""

    def self_pairs(self) -> IntArray:
        """(F (F - 1) / 2, 2) all face pairs."""
        return self._pairs
