"""Motion of a body: its vertices at even times, straight between them."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import FloatArray, check_number


@dataclass(frozen=True, eq=False)
class Motion:
    """A sequence of vertices; faces stay.

    Attributes:
        frames: (T, V, 3) [m], kept in single precision: 0.1 um of a person.
        rate: frames in a second [1/s].
        loop_from: after the last frame this one follows, and so on for ever; None = the body stays as it is in the last.

    Raises:
        ValueError: names the field and the value.
    """

    frames: NDArray[np.float32]
    rate: float = 60.0
    loop_from: int | None = None

    def __post_init__(self) -> None:
        frames = np.array(self.frames, np.float32)
        if frames.ndim != 3 or frames.shape[2] != 3 or len(frames) == 0:
            raise ValueError(f"motion: frames: expected (T, V, 3) with T > 0, got shape {frames.shape}")
        if not np.isfinite(frames).all():
            bad = tuple(int(i) for i in np.argwhere(~np.isfinite(frames))[0])
            raise ValueError(f"motion: frames[{', '.join(map(str, bad))}] is not finite")
        frames.setflags(write=False)
        object.__setattr__(self, "frames", frames)
        object.__setattr__(self, "rate", check_number(self.rate, "motion: rate", 1e-3, 1e6))
        if self.loop_from is not None:
            first = check_number(self.loop_from, "motion: loop_from", 0, len(frames) - 1, integer=True)
            object.__setattr__(self, "loop_from", int(first))

    def at(self, time: float) -> FloatArray:
        """(V, 3) vertices [m] at a time [s]; before 0 the first frame's."""
        count = len(self.frames)
        place = max(time, 0.0) * self.rate
        index = int(np.floor(place))
        share = place - index
        a, b = (self.frames[self._number(n, count)] for n in (index, index + 1))
        return (1.0 - share) * a.astype(np.float64) + share * b.astype(np.float64)

    def _number(self, n: int, count: int) -> int:
        if n < count:
            return n
        if self.loop_from is None:
            return count - 1
        return self.loop_from + (n - self.loop_from) % (count - self.loop_from)

    def to_json(self) -> dict[str, Any]:
        """Plain values; frames as the bytes of little-endian singles in base 64."""
        data = base64.b64encode(self.frames.astype("<f4").tobytes()).decode("ascii")
        return {"shape": list(self.frames.shape), "frames": data, "rate": self.rate, "loop_from": self.loop_from}

    @staticmethod
    def from_json(values: dict[str, Any]) -> Motion:
        """Raises ValueError for missing or unknown fields, by name."""
        known = {"shape", "frames", "rate", "loop_from"}
        if wrong := set(values) ^ known:
            raise ValueError(f"motion.{min(wrong)}: unknown or missing field; expected {', '.join(sorted(known))}")
        frames = np.frombuffer(base64.b64decode(values["frames"]), "<f4").reshape(values["shape"])
        return Motion(frames, values["rate"], values["loop_from"])
