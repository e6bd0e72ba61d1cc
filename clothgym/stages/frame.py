"""What stages share while a step runs."""

from __future__ import annotations

import time
from typing import Protocol

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.kernels.integrate import Grips, largest_speed
from clothgym.model import ClothModel
from clothgym.state import ClothState

SPEED_CAP = 1e4
"""Speeds above this [m/s] count as diverged."""


class Frame:
    """What stages share while a step runs: the state, the model, and named buffers.

    Attributes:
        settled: whether nothing could touch in the last step, nor can in this one: no pairs, and nothing to do for stages that
            work on them.
    """

    def __init__(self, model: ClothModel, state: ClothState) -> None:
        self.model = model
        self.state = state
        self.predicted: FloatArray = np.zeros((model.vertex_count, 3))
        self.external: FloatArray = np.zeros((0, 3))
        self.body_forces: FloatArray = np.zeros((0, 3))
        self.untangling_passes = 0
        self.clamped = 0
        self.unbalanced = 0.0
        self.substep = 0
        self.settled = False
        self.work: dict[str, int] = {}
        self.profile: dict[str, list[float]] = {}
        self.set_grips()

    def clock(self, name: str, started: float) -> float:
        """Books the time since `started` under a name; returns now."""
        now = time.perf_counter()
        entry = self.profile[name]
        entry[0] += 1
        entry[1] += now - started
        return now

    def set_grips(self) -> None:
        """The grippers' anchors for the coming step, from the state; what is measured a step begins anew."""
        self.unbalanced = 0.0
        state, specs = self.state, self.model.scene.grips
        held = len(state.held_vertices)
        counts = np.bincount(state.held_by, minlength=len(specs))[state.held_by] if held else np.ones(0)
        stiffness = np.array([specs[g].stiffness for g in state.held_by], float) / counts
        limit = np.array([specs[g].slip_force for g in state.held_by], float) / counts
        grips = state.grip_positions[state.held_by] if held else np.zeros((0, 3))
        self.grips = Grips(
            np.ascontiguousarray(state.held_vertices, np.int32),
            np.ascontiguousarray(grips + state.held_offsets),
            np.ascontiguousarray(state.grip_velocities[state.held_by] if held else np.zeros((0, 3))),
            np.ascontiguousarray(stiffness, float),
            np.ascontiguousarray(limit, float),
            np.zeros((held, 3)),
            np.zeros((held, 3)),
        )

    def diverged(self) -> str:
        """What is out of bounds in the state, or nothing."""
        speed = largest_speed(self.state.positions, self.state.velocities)
        if speed != speed:
            return "positions are no longer finite"
        if not (np.isfinite(self.grips.forces).all() and np.isfinite(self.body_forces).all()):
            return "contact or grip forces are no longer finite"
        return f"a speed of {speed:.3g} m/s passed the cap of {SPEED_CAP:g} m/s" if speed > SPEED_CAP else ""

    def count(self, name: str, amount: int) -> None:
        """Adds to a work counter."""
        self.work[name] = self.work.get(name, 0) + int(amount)


class Stage(Protocol):
    """One step of the pipeline. `reads` and `writes` name state arrays and buffers.

    One with `of_pairs` = True is left out of steps in which nothing can touch, but for the first of them, in which it puts its
    arrays in order.
    """

    name: str
    reads: tuple[str, ...]
    writes: tuple[str, ...]

    def run(self, frame: Frame) -> None: ...
