"""The state of a simulation: everything that the next step depends on."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass

import numpy as np

from clothgym.arrays import FloatArray, IntArray, as_ids, as_points, check_number


@dataclass
class ClothState:
    """Positions and velocities (V, 3), time, and what the grippers hold.

    Attributes:
        grip_positions: (G, 3) [m]; grip_velocities: (G, 3) [m/s].
        held_vertices: (A,) vertex ids; held_by: (A,) gripper of each; held_offsets: (A, 3) from its gripper [m].
        memory: (M,) what a strategy against intersections remembers of the present tangle; almost all remember nothing.
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
    memory: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(0))

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
            self.memory.copy(),
        )

    def check(self, vertices: int, grips: int, memory: int = 0) -> None:
        """Whether this can be the state of a scene with so many vertices and grippers, and a strategy with so much memory.

        Raises:
            ValueError: begins with "snapshot"; names what does not fit or is not finite.
        """
        for name, array, count in (("vertices", self.positions, vertices), ("grippers", self.grip_positions, grips)):
            if array.shape != (count, 3):
                raise ValueError(f"snapshot: has {len(array)} {name}, this scene has {count}")
        held = len(self.held_vertices)
        for field, count in (
            ("positions", vertices),
            ("velocities", vertices),
            ("grip_positions", grips),
            ("grip_velocities", grips),
            ("held_offsets", held),
        ):
            as_points(getattr(self, field), f"snapshot: {field}", count)
        if len(self.memory) not in (0, memory):
            raise ValueError(f"snapshot: memory: has {len(self.memory)} numbers, this strategy remembers {memory}")
        check_number(self.time, "snapshot: time", 0.0, 1e12)
        as_ids(self.held_vertices, "snapshot: held_vertices", vertices)
        if len(as_ids(self.held_by, "snapshot: held_by", grips)) != held:
            raise ValueError(f"snapshot: held_by: expected {held} entries, got {len(self.held_by)}")

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
            *((self.memory,) if len(self.memory) else ()),
        ):
            digest.update(str(array.shape).encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:32]


class Trace:
    """Since when a simulation has run on its own: nobody set its state, no gripper held.

    Costs a step next to nothing: it keeps the copy of the state that the step makes anyway.
    """

    def __init__(self) -> None:
        self.start: ClothState | None = None
        self.passes, self.held = 0, False

    def begin(self, before: ClothState, passes: int) -> None:
        """Before every step, with an own copy of the state and the untangling passes since reset."""
        if self.start is None:
            self.start, self.passes = before, passes
        self.held = self.held or len(before.held_vertices) > 0

    def untouched(self, held: int) -> ClothState | None:
        """The state from which on nothing but the scene's own forces and untangling acted, or None."""
        return None if self.held or held else self.start
