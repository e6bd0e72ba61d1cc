"""Contact between cloths within a step: candidates that stay complete, closest points, projection, certificate."""

from __future__ import annotations

import numpy as np

from clothgym.arrays import BoolArray, FloatArray, IntArray
from clothgym.detection.brute_force import BruteForce
from clothgym.detection.hierarchy import Hierarchy
from clothgym.kernels import contact, kdop, proximity
from clothgym.kernels.contact import Contacts
from clothgym.mesh import SurfaceArrays
from clothgym.model import ClothModel

_ERRATIC = 0.5
"""Slack of a vertex as a share of its expected travel: fast vertices are the ones that change their mind."""


_LEEWAY = 1.0
"""And in thicknesses, for what contact and springs move a vertex within a substep."""


class Candidates:
    """Pairs of primitives that may touch within a step.

    Every vertex is expected at start + share u with share in [0, 1]. Face pairs come from boxes swept along u and widened
    by half the thickness and each vertex's slack; as long as no vertex is further than its slack from where it was expected, no
    pair is missing.
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
        self.slack: FloatArray = np.zeros(model.vertex_count)
        self.sweeps: FloatArray = np.zeros((model.vertex_count, 6))
        self.face_pairs: IntArray = np.zeros((0, 2), np.int32)
        self.gathered = 0

    def expect(self, x: FloatArray, travel: FloatArray) -> None:
        """Face pairs for vertices that leave x along `travel` (V, 3) [m]."""
        self.start[:] = x
        self.travel[:] = travel
        thickness = float(self.model.thickness.max())
        np.sqrt(np.einsum("ij,ij->i", travel, travel), out=self.slack)
        self.slack *= _ERRATIC
        self.slack += _LEEWAY * thickness
        end, pads = self.start + self.travel, self.slack + 0.5 * thickness
        kdop.vertex_intervals(self.start, end, kdop.AXES[6], np.ones(3), pads, self.sweeps)
        self.tree.refit(self.start, end, pads)
        self.face_pairs = self.tree.self_pairs()

    def gather(self) -> None:
        """Primitive pairs from the face pairs; buffers grow by counting."""
        while True:
            found = proximity.gather_quads(
                self.start,
                self.travel,
                self.surface,
                self.model.thickness,
                self.slack,
                self.sweeps,
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

    def outdated(self, x: FloatArray, share: float) -> bool:
        """Whether a vertex is further than its slack from start + share travel, so that pairs may be missing."""
        return proximity.largest_deviation(x, self.start, self.travel, share, self.slack) > 0.0


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
            np.zeros(capacity),
            np.zeros((capacity, 3)),
        )

    def narrow(
        self, x: FloatArray, p: FloatArray, candidates: Candidates, apart: BoolArray, both: bool, yield_force: float
    ) -> None:
        """Closest points of all candidates at x, and which of them are active on the way to p."""
        while True:
            active = contact.narrow(
                x,
                p,
                candidates.quads,
                candidates.kinds,
                candidates.count,
                candidates.model.thickness,
                apart,
                both,
                yield_force,
                candidates.separation,
                self.arrays,
            )
            if active <= len(self.arrays.rest):
                self.active = active
                return
            self.arrays = self._make(int(1.3 * active))
