"""Candidates for contact: pairs of primitives that may come near within the step."""

from __future__ import annotations

from typing import Any

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.stages.frame import Frame


class FacePairs:
    """Pairs of primitives whose boxes, swept along the expected motion of the step, overlap."""

    name = "face pairs"
    reads: tuple[str, ...] = ("positions", "velocities")
    writes: tuple[str, ...] = ("face_pairs",)

    def __init__(self, candidates: Any, scene_step: float, substeps: int, gravity: FloatArray) -> None:
        self.candidates, self.step, self.substeps, self.gravity = candidates, scene_step, substeps, gravity

    def run(self, frame: Frame) -> None:
        self.look(frame, self.substeps)

    def look(self, frame: Frame, horizon: int) -> None:
        """Looks `horizon` substeps ahead."""
        state, ahead = frame.state, self.step * horizon / self.substeps
        fall = (0.5 * ahead * ahead) * self.gravity
        free = (frame.model.inverse_masses > 0)[:, None]
        travel = ahead * state.velocities + np.where(free, fall, 0.0)
        self.candidates.expect(state.positions, travel, horizon)
        frame.count("box_pairs", self.candidates.box_pairs)


class PrimitivePairs:
    name = "primitive pairs"
    reads: tuple[str, ...] = ("positions", "face_pairs")
    writes: tuple[str, ...] = ("quads",)

    def __init__(self, candidates: Any) -> None:
        self.candidates = candidates

    def run(self, frame: Frame) -> None:
        self.candidates.gather()
        frame.count("primitive_pairs", self.candidates.count)
