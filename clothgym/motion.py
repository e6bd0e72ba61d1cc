"""Prescribed motion of what does not bend: it spins about an axis and tilts."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray, as_vector, check_number

_RANGES = {"spin": (-1e4, 1e4), "tilt": (-1e4, 1e4), "tilt_start": (0.0, 1e6), "tilt_limit": (0.0, 1e4)}


@dataclass(frozen=True)
class RigidMotion:
    """Spins about an axis through a point, which tilts about another one.

    Attributes:
        centre: stays where it is [m].
        axis: of the spin, before it tilts; need not have length 1.
        spin: [rad/s].
        tilt_axis: about which the spinning thing tilts.
        tilt: [rad/s], from `tilt_start` [s] until it has tilted by `tilt_limit` [rad].

    Raises:
        ValueError: names the field and the value.
    """

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)
    spin: float = 0.0
    tilt_axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    tilt: float = 0.0
    tilt_start: float = 0.0
    tilt_limit: float = 0.5 * math.pi

    def __post_init__(self) -> None:
        for name in ("centre", "axis", "tilt_axis"):
            vector = as_vector(getattr(self, name), f"motion.{name}", 1e6)
            if name != "centre" and not np.linalg.norm(vector) > 0.0:
                raise ValueError(f"motion.{name} = {getattr(self, name)!r}: must not be zero")
            object.__setattr__(self, name, tuple(float(c) for c in vector))
        for name, (low, high) in _RANGES.items():
            object.__setattr__(self, name, check_number(getattr(self, name), f"motion.{name}", low, high))

    def places(self, start: FloatArray, time: float) -> FloatArray:
        """(N, 3) where points are at a time [s] that are at (N, 3) at time 0 [m]."""
        tilted = min(abs(self.tilt) * max(0.0, time - self.tilt_start), self.tilt_limit)
        turn = rotation(self.tilt_axis, math.copysign(tilted, self.tilt)) @ rotation(self.axis, self.spin * time)
        places: FloatArray = (start - np.array(self.centre)) @ turn.T + np.array(self.centre)
        return places

    def to_json(self) -> dict[str, Any]:
        """Plain values; floats survive exactly."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(values: dict[str, Any]) -> RigidMotion:
        """Raises ValueError for unknown fields and values out of range, by name."""
        known = [f.name for f in dataclasses.fields(RigidMotion)]
        if unknown := set(values) - set(known):
            raise ValueError(f"motion.{min(unknown)}: unknown field; known: {', '.join(known)}")
        return RigidMotion(**values)


def rotation(axis: Any, angle: float) -> FloatArray:
    """(3, 3) rotation about an axis of any length but 0 [Rodrigues]."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * (k @ k)
