"""Contact between cloths within a step: candidates that stay complete, closest points, projection, certificate."""

from __future__ import annotations

import numpy as np

from clothgym.arrays import BoolArray, FloatArray, IntArray
from clothgym.detection.brute_force import BruteForce
from clothgym.detection.hierarchy import Hierarchy
from clothgym.kernels import contact as kernels
from clothgym.kernels.contact import Contacts
from clothgym.mesh import SurfaceArrays
from clothgym.model import ClothModel


class Candidates:
    """Pairs of primitives that may touch within a step.

    Every vertex is expected at start + share u with share in [0, 1]. Face pairs come from boxes swept along u and widened
    by half the thickness and the slack; as long as no vertex is further than the slack from where it was expected, no pair
    is missing. `deviation` says how far they are.
    """

    def __init__(self, model: ClothModel, tree: Hierarchy | BruteForce) -> None:
        self.model, self.tree = model, tree
        self.surface: SurfaceArrays = model.surface.arrays
        count = len(model.faces)
        self.quads: IntArray = np.zeros((8 * count, 4), np.int32)
        self.kinds = np.zeros(8 * count, np.uint8)
        self.separation: FloatArray = np.zeros((8 * count, 4))
        self.count = 0
        self.start: FloatArray = np.zeros((model.vertex_count, 3))
        self.travel: FloatArray = np.zeros((model.vertex_count, 3))
        self.slack = 0.0
        self.face_pairs: IntArray = np.zeros((0, 2), np.int32)
        self.gathered = 0

    def expect(self, x: FloatArray, travel: FloatArray) -> None:
        """Face pairs for vertices that leave x along `travel` (V, 3) [m]."""
        self.start[:] = x
        self.travel[:] = travel
        largest = float(np.sqrt(np.einsum("ij,ij->i", travel, travel).max()))
        thickness = float(self.model.thickness.max())
        self.slack = 0.5 * thickness + 0.05 * largest
        self.tree.refit(self.start, self.start + self.travel, 0.5 * thickness + self.slack)
        self.face_pairs = self.tree.self_pairs()

    def gather(self) -> None:
        """Primitive pairs from the face pairs; buffers grow by counting."""
        while True:
            found = kernels.gather_quads(
                self.start,
                self.travel,
                self.surface,
                self.model.thickness,
                self.slack,
                self.face_pairs,
                self.quads,
                self.kinds,
            )
            if found <= len(self.quads):
                break
            capacity = int(1.3 * found)
            self.quads = np.zeros((capacity, 4), np.int32)
            self.kinds = np.zeros(capacity, np.uint8)
            self.separation = np.zeros((capacity, 4))
        self.count = found
        self.gathered += found

    def deviation(self, x: FloatArray, share: float) -> float:
        """Largest distance [m] of a vertex from start + share travel."""
        return kernels.largest_deviation(x, self.start, self.travel, share)


class ContactBuffers:
    """Active contacts; capacity grows by counting."""

    def __init__(self, capacity: int) -> None:
        self.active = 0
        self.arrays = self._make(capacity)

    @staticmethod
    def _make(capacity: int) -> Contacts:
        return Contacts(
            np.zeros((capacity, 4), np.int32),
            np.zeros((capacity, 4)),
            np.zeros((capacity, 3)),
            np.zeros(capacity),
            np.zeros(capacity),
            np.zeros(capacity),
            np.zeros((capacity, 3)),
        )

    def narrow(self, x: FloatArray, p: FloatArray, candidates: Candidates, apart: BoolArray, both: bool) -> None:
        """Closest points of all candidates at x, and which of them are active on the way to p."""
        while True:
            active = kernels.narrow(
                x,
                p,
                candidates.quads,
                candidates.kinds,
                candidates.count,
                candidates.model.thickness,
                apart,
                both,
                candidates.separation,
                self.arrays,
            )
            if active <= len(self.arrays.rest):
                self.active = active
                return
            self.arrays = self._make(int(1.3 * active))
