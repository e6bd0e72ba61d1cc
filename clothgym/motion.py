"""How bodies move: prescribed, a function of time alone, so that a state needs to remember nothing about it.

dish = Body(mesh, motion=Turns((Turn((0, 1, 0), rate=1.0), Turn((0, 0, 1), rate=0.02))))
woman = Body("female", motion=Walk("female"))
film = Body((frames[0], faces), motion=Keyframes(times, frames))
"""

from __future__ import annotations

import base64
import dataclasses
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from clothgym import rig
from clothgym.arrays import FloatArray, as_vector, check_choice, check_each, check_flag, check_number, read_only

_LATEST = 1e6
_SAME_SHAPE = 1e-3
"""[m] a mesh that lies further than this from a pose, after the best shift, is not of that pose."""


class Motion(Protocol):
    """What a body may be given: where its vertices are at a time."""

    def vertices(self, start: FloatArray, time: float) -> FloatArray:
        """(V, 3) [m] at a time [s] >= 0; `start` (V, 3) is the body's mesh."""
        ...

    def to_json(self) -> dict[str, Any]:
        """Plain values with a `kind`."""
        ...


@dataclass(frozen=True)
class Turn:
    """A steady turn about a fixed axis.

    Attributes:
        axis: direction; counter-clockwise seen from its tip.
        rate: [rad/s].
        centre: a point on the axis [m].
        begin, end: [s] it turns between these times.
    """

    axis: tuple[float, float, float]
    rate: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    begin: float = 0.0
    end: float = _LATEST

    def __post_init__(self) -> None:
        axis = as_vector(self.axis, "turn.axis", 1e9)
        if not np.linalg.norm(axis) > 0.0:
            raise ValueError(f"turn.axis = {self.axis!r}: has no direction")
        object.__setattr__(self, "axis", tuple(float(c) for c in axis))
        object.__setattr__(self, "centre", tuple(float(c) for c in as_vector(self.centre, "turn.centre", 1e6)))
        object.__setattr__(self, "rate", check_number(self.rate, "turn.rate", -1e4, 1e4))
        object.__setattr__(self, "begin", check_number(self.begin, "turn.begin", 0.0, _LATEST))
        object.__setattr__(self, "end", check_number(self.end, "turn.end", self.begin, _LATEST))

    def matrix(self, time: float) -> FloatArray:
        """(3, 3) rotation since the start [Rodrigues]."""
        angle = self.rate * (min(max(time, self.begin), self.end) - self.begin)
        x, y, z = np.asarray(self.axis) / np.linalg.norm(self.axis)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)


@dataclass(frozen=True)
class Turns:
    """A rigid motion: turns one after the other, each about an axis that those before it do not carry along.

    A dish that spins about its own axis while that tilts: the spin first, then the tilt.
    """

    turns: tuple[Turn, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "turns", check_each(self.turns, "turns", Turn))

    def vertices(self, start: FloatArray, time: float) -> FloatArray:
        """See `Motion`."""
        points = start
        for turn in self.turns:
            points = (points - turn.centre) @ turn.matrix(time).T + turn.centre
        return points

    def to_json(self) -> dict[str, Any]:
        """See `Motion`."""
        return {"kind": "turns", "turns": [dataclasses.asdict(turn) for turn in self.turns]}


@dataclass(frozen=True, eq=False)
class Keyframes:
    """A sequence of shapes, with straight ways between them; before the first and after the last the body stands.

    Attributes:
        times: (T,) [s], rising.
        frames: (T, V, 3) [m]; copied and read-only.
        loop: after the last time it goes on from the first one.
    """

    times: Any
    frames: Any
    loop: bool = False

    def __post_init__(self) -> None:
        times, frames = np.array(self.times, np.float64), np.array(self.frames, np.float64)
        if times.ndim != 1 or len(times) < 2 or not np.isfinite(times).all() or not (np.diff(times) > 0.0).all():
            raise ValueError("keyframes.times: expected two or more finite times that rise")
        if times[0] < 0.0:
            raise ValueError(f"keyframes.times[0] = {times[0]:g}: must not be negative")
        if frames.ndim != 3 or frames.shape[0] != len(times) or frames.shape[2] != 3:
            raise ValueError(f"keyframes.frames: expected ({len(times)}, V, 3), got {frames.shape}")
        if not np.isfinite(frames).all():
            raise ValueError("keyframes.frames: not all numbers are finite")
        object.__setattr__(self, "times", read_only(times))
        object.__setattr__(self, "frames", read_only(frames))
        object.__setattr__(self, "loop", check_flag(self.loop, "keyframes.loop"))

    def vertices(self, start: FloatArray, time: float) -> FloatArray:
        """See `Motion`."""
        first, last = float(self.times[0]), float(self.times[-1])
        if self.loop and time > first:
            time = first + math.fmod(time - first, last - first)
        at = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2))
        share = (time - self.times[at]) / (self.times[at + 1] - self.times[at])
        share = min(max(share, 0.0), 1.0)
        return (1.0 - share) * self.frames[at] + share * self.frames[at + 1]

    def to_json(self) -> dict[str, Any]:
        """See `Motion`; frames as base64 of little-endian float64."""
        data = base64.b64encode(np.ascontiguousarray(self.frames, "<f8").tobytes()).decode("ascii")
        return {"kind": "keyframes", "times": self.times.tolist(), "shape": self.frames.shape, "frames": data,
                "loop": self.loop}  # fmt: skip


@dataclass(frozen=True)
class Walk:
    """A body of the package that goes from a pose into a walk on the spot.

    Attributes:
        body: "female" or "male".
        pose: where it starts, a name of `rig.poses()`.
        lead: [s] in which it goes from the pose into the walk.
        stride: [s] of two steps.
    """

    body: str = "female"
    pose: str = "rest"
    lead: float = 1.0
    stride: float = 1.2

    def __post_init__(self) -> None:
        check_choice(self.body, "walk.body", rig.NAMES)
        rig.load(self.body).rotations(self.pose)  # raises for a pose that there is none
        object.__setattr__(self, "lead", check_number(self.lead, "walk.lead", 1e-3, 1e3))
        object.__setattr__(self, "stride", check_number(self.stride, "walk.stride", 1e-2, 1e3))

    def rotations(self, time: float) -> dict[str, FloatArray]:
        """The pose at a time, as `Rig.posed` takes it: the walk, from the pose on by a share that rises smoothly."""
        skin = rig.load(self.body)
        walk = skin.rotations(f"walk:{math.fmod(time / self.stride, 1.0)!r}")
        share = min(time / self.lead, 1.0)
        return rig.blended(skin.rotations(self.pose), walk, share * share * (3.0 - 2.0 * share))

    def vertices(self, start: FloatArray, time: float) -> FloatArray:
        """See `Motion`; the body's mesh is that of the pose, wherever it was put.

        Raises:
            ValueError: the mesh of something else, or of another pose.
        """
        skin, posed = rig.load(self.body), _posed(self.body, self.pose)
        if len(start) != len(posed):
            raise ValueError(f"walk.body = {self.body!r}: the mesh has {len(start)} vertices, not {len(posed)}")
        off = float(np.ptp(start - posed, axis=0).max())
        if off > _SAME_SHAPE:
            raise ValueError(
                f"walk.body = {self.body!r}: the mesh is not that of walk.pose = {self.pose!r}, {off:.3g} m off"
            )
        return start + (skin.posed(self.rotations(time)) - posed)

    def to_json(self) -> dict[str, Any]:
        """See `Motion`."""
        return {"kind": "walk", **dataclasses.asdict(self)}


@lru_cache(maxsize=4)
def _posed(body: str, pose: str) -> FloatArray:
    return read_only(rig.load(body).posed(pose))


def from_json(values: Any) -> Motion | None:
    """A motion from its plain values; None stays None.

    Raises:
        ValueError: an unknown kind, a missing or unknown field, by name.
    """
    if values is None:
        return None
    fields = dict(values)
    kind = fields.pop("kind", None)
    try:
        if kind == "turns":
            return Turns(tuple(Turn(**turn) for turn in fields.pop("turns")), **fields)
        if kind == "walk":
            return Walk(**fields)
        if kind == "keyframes":
            frames = np.frombuffer(base64.b64decode(fields.pop("frames")), "<f8").reshape(fields.pop("shape"))
            return Keyframes(frames=frames, **fields)
    except (TypeError, KeyError) as error:
        raise ValueError(f"motion {kind!r}: missing or unknown field: {error}") from error
    raise ValueError(f"motion.kind = {kind!r}: expected turns, keyframes or walk")
