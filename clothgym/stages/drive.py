"""Pinned vertices that move: straight within a step, from where they are to where their motion wants them at its end."""

from __future__ import annotations

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.model import ClothModel
from clothgym.stages.frame import Frame


class Drive:
    """Velocities of the driven vertices for the coming step; `ContactSubsteps` moves them."""

    reads: tuple[str, ...] = ("positions",)
    writes: tuple[str, ...] = ("velocities", "driven")

    def __init__(self, model: ClothModel) -> None:
        scene = model.scene
        self.driven = [
            (cloth.motion, vertices, np.array(cloth.pins, np.int64))
            for cloth, (_, vertices, _) in zip(scene.cloths, model.ranges)
            if cloth.motion is not None
        ]
        self.name = f"drive [{', '.join(cloth.name for cloth in scene.cloths if cloth.motion is not None)}]"
        self.start, self.step = scene.start, scene.step
        self.ids = np.concatenate([vertices.start + pins for _, vertices, pins in self.driven])
        self.velocities: FloatArray = np.zeros((len(self.ids), 3))

    def run(self, frame: Frame) -> None:
        state = frame.state
        # the end comes from the start of the scene: what a step leaves undone, the next one makes up for
        at = state.time + self.step
        ends = [motion.vertices(self.start[vertices], at)[pins] for motion, vertices, pins in self.driven]
        self.velocities[:] = (np.concatenate(ends) - state.positions[self.ids]) / self.step
        state.velocities[self.ids] = self.velocities

    def predict(self, frame: Frame, dt: float) -> None:
        """Moves them on in a substep of dt [s]."""
        frame.predicted[self.ids] = frame.state.positions[self.ids] + dt * self.velocities
