"""Candidates for contact: pairs of primitives that may come near within the step."""

from __future__ import annotations

from typing import Any

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.stages.frame import Frame
from clothgym.state import ClothState


def short_horizon(substeps: int) -> int:
    """Substeps of an eighth of a step: how far to look ahead for what changes its mind, however many substeps there are."""
    return max(1, substeps // 8)


class Rebuild:
    """A new tree where the old one has grown too loose."""

    reads: tuple[str, ...] = ("positions",)
    writes: tuple[str, ...] = ("tree",)

    def __init__(self, candidates: Any, growth: float) -> None:
        self.candidates = candidates
        self.name = f"tree [rebuilt at {growth:g}x]"

    def run(self, frame: Frame) -> None:
        self.candidates.tree.renew(frame.state.positions)


class Ignore:
    """Decides which pairs detection ignores in this step."""

    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ("ignored",)

    def __init__(self, candidates: Any, share: float) -> None:
        from clothgym.detection.faults import Faults

        self.faults = candidates.faults = Faults(share)
        self.name = f"ignore [{100.0 * share:g} % of pairs]"

    def run(self, frame: Frame) -> None:
        self.faults.step = frame.state.step


class FacePairs:
    """Pairs of primitives whose boxes, swept along the expected motion of the step, overlap."""

    name = "face pairs"
    reads: tuple[str, ...] = ("positions", "velocities")
    writes: tuple[str, ...] = ("face_pairs",)

    def __init__(self, candidates: Any, scene_step: float, substeps: int, gravity: FloatArray) -> None:
        self.candidates, self.step, self.substeps, self.gravity = candidates, scene_step, substeps, gravity
        self.short = short_horizon(substeps)
        self.free = (candidates.model.inverse_masses > 0)[:, None]
        self.travel = np.zeros((len(self.free), 3))
        self.fall = np.zeros((len(self.free), 3))
        self.flat = False  # whether it was decided, before all other stages of the last step, that nothing can touch

    def run(self, frame: Frame) -> None:
        found = self.candidates
        # in the last step, too, nothing touched, from its beginning to its end
        calm = self.flat and found.flat and found.spent > 0
        if calm and found.lasts(self.substeps):
            frame.count("decided_flat", 1)
        else:
            self.look(frame, self.substeps, found.ahead)
        self.flat = found.flat
        frame.settled = calm and found.flat

    def look(self, frame: Frame, horizon: int, times: int = 1) -> None:
        """Looks `horizon` substeps ahead, or `times` as many if nothing can touch for so long."""
        state, ahead = frame.state, self.step * horizon / self.substeps
        if self._settles(state, ahead, horizon, times):
            frame.count("decided_flat", 1)
            frame.count("box_pairs", 0)
            return
        np.multiply(self.free, (0.5 * ahead * ahead) * self.gravity, out=self.fall)
        self.travel += self.fall
        self.candidates.expect(state.positions, self.travel, horizon)
        frame.count("box_pairs", self.candidates.box_pairs)

    def _settles(self, state: ClothState, seconds: float, horizon: int, times: int) -> bool:
        """Whether nothing can touch; the travel is without gravity: what stands still stays, and what falls, falls together."""
        found = self.candidates
        for tried in (times, 1) if times > 1 else (1,):
            np.multiply(state.velocities, tried * seconds, out=self.travel)
            if found.settle(state.positions, self.travel, tried * horizon):
                found.ahead = min(2 * tried, found.most_ahead)
                return True
        found.ahead = 1
        return False

    def forget(self) -> None:
        """Every run decides anew."""
        self.flat = False
        self.candidates.forget()


class PrimitivePairs:
    of_pairs = True
    name = "primitive pairs"
    reads: tuple[str, ...] = ("positions", "face_pairs")
    writes: tuple[str, ...] = ("quads",)

    def __init__(self, candidates: Any) -> None:
        self.candidates = candidates

    def run(self, frame: Frame) -> None:
        self.candidates.gather()
        frame.count("primitive_pairs", self.candidates.count)
