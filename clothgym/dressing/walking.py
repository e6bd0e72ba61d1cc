"""A dressed body that walks on the spot: whether the garments stay on, and clean."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from clothgym import rig
from clothgym.arrays import check_number
from clothgym.dressing.draping import Draped
from clothgym.dressing.layers import effort_of, openings, scene_of
from clothgym.motion import Walk
from clothgym.scene import Scene
from clothgym.simulation import Simulation

STRIDE = 1.2
"""[s] two steps."""
PARTS = 2
"""Steps in a frame of 1/60 s: what a limb moves in one must not be more than its cloth can follow."""
_DAMPING = 2.0
"""[1/s] least damping of walking cloth: it moves through air."""
_SAMPLES = 10


@dataclass(frozen=True, eq=False)
class Walked:
    """What became of garments on a walking body.

    Attributes:
        report: worn (at the end, every opening), hits_max and hits_longest (frames in a row with hits), depth_p99_max (the
            worst frame's 99th percentile) and depth_max [m], seconds (wall), walk_seconds (simulated).
        frames: for each frame of 1/60 s its hits and its 99th percentile of depth [m].
    """

    simulation: Simulation
    report: dict[str, Any]
    frames: tuple[tuple[int, float], ...]


def walk(
    garments: Draped | Sequence[Draped],
    seconds: float = 6.0,
    pose: str = "rest",
    on_frame: Callable[[Simulation], None] | None = None,
) -> Walked:
    """Lets a dressed body of the package walk.

    Args:
        garments: on the same body, the inner ones first.
        seconds: how long, from standing in the pose [s]; the walk begins small and is itself after a second.
        pose: that the body was dressed in.
        on_frame: called with the simulation at the start and after each frame of 1/60 s.

    Raises:
        ValueError: garments on different bodies, or on one that is not of the package.
        SimulationError: the walk diverged.
    """
    worn = [garments] if isinstance(garments, Draped) else list(garments)
    check_number(seconds, "walk: seconds", 0.0, 1e4)
    started = time.perf_counter()
    scene = walking_scene(worn, seconds, pose)
    simulation = Simulation(scene, effort_of(worn, PARTS))
    frames, told = frame_by_frame(simulation, seconds, on_frame)
    (moving,) = scene.bodies
    limbs = rig.load(moving.name).limbs(moving.motion.rotations(simulation.time))  # type: ignore[union-attr]
    found = openings(worn, simulation, limbs)
    report = {
        "worn": all(opening.right for opening in found),
        "openings": [{"expected": w.expected, "through": list(w.through), "right": w.right} for w in found],
        "hits_longest": _longest([hits > 0 for hits, _ in frames]),
        **told,
        "seconds": time.perf_counter() - started,
    }
    return Walked(simulation, report, frames)


def frame_by_frame(
    simulation: Simulation, seconds: float, on_frame: Callable[[Simulation], None] | None
) -> tuple[tuple[tuple[int, float], ...], dict[str, Any]]:
    """Lets a dressed body move in frames of 1/60 s, `PARTS` steps each: `Walked.frames`, and what its report tells of them."""
    frames: list[tuple[int, float]] = []
    deepest = 0.0
    if on_frame is not None:
        on_frame(simulation)
    for _ in range(round(60.0 * seconds)):
        simulation.step(PARTS)
        depths = simulation.body_mesh.penetration(simulation.positions, simulation.faces, _SAMPLES)
        frames.append((int(simulation.last_intersections.hit_count), float(np.percentile(depths, 99))))
        deepest = max(deepest, float(depths.max()))
        if on_frame is not None:
            on_frame(simulation)
    told = {
        "hits_max": max((hits for hits, _ in frames), default=0),
        "hits_end": frames[-1][0] if frames else 0,
        "depth_p99_max": max((depth for _, depth in frames), default=0.0),
        "depth_max": deepest,
        "walk_seconds": simulation.time,
    }
    return tuple(frames), told


def walking_scene(garments: Sequence[Draped], seconds: float = 6.0, pose: str = "rest") -> Scene:
    """The scene of a dressed body of the package that is about to walk.

    Raises:
        ValueError: as `walk`.
    """
    scene = scene_of(garments, "walk", damping=_DAMPING)
    (body,) = scene.bodies
    if body.name not in rig.NAMES:
        raise ValueError(f"walk: body {body.name!r}: has no skeleton; expected one of {', '.join(rig.NAMES)}")
    moving = dataclasses.replace(body, motion=Walk(body.name, pose, stride=STRIDE))
    step = 1.0 / (60.0 * PARTS)
    return dataclasses.replace(scene, bodies=(moving,), step=step, duration=seconds, name=f"{scene.name}, walking")


def _longest(marks: Sequence[bool]) -> int:
    """The longest run of marks."""
    longest = run = 0
    for mark in marks:
        run = run + 1 if mark else 0
        longest = max(longest, run)
    return longest
