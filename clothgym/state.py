"""The state of a simulation: everything that the next step depends on."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from clothgym.arrays import FloatArray, IntArray


@dataclass
class ClothState:
    """Positions and velocities (V, 3), time, and what the grippers hold.

    Attributes:
        grip_positions: (G, 3) [m]; grip_velocities: (G, 3) [m/s].
        held_vertices: (A,) vertex ids; held_by: (A,) gripper of each; held_offsets: (A, 3) from its gripper [m].
    """

    positions: FloatArray
    velocities: FloatArray
    time: float
    step: int
    grip_positions: FloatArray
    grip_velocities: FloatArray
    held_vertices: IntArray
    held_by: IntArray
    held_offsets: FloatArray

    def copy(self) -> ClothState:
        """An independent copy."""
        return ClothState(
            self.positions.copy(),
            self.velocities.copy(),
            self.time,
            self.step,
            self.grip_positions.copy(),
            self.grip_velocities.copy(),
            self.held_vertices.copy(),
            self.held_by.copy(),
            self.held_offsets.copy(),
        )

    def hash(self) -> str:
        """Digest of every bit."""
        digest = hashlib.sha256()
        for array in (
            self.positions,
            self.velocities,
            np.array([self.time, self.step], np.float64),
            self.grip_positions,
            self.grip_velocities,
            self.held_vertices,
            self.held_by,
            self.held_offsets,
        ):
            digest.update(str(array.shape).encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:32]
