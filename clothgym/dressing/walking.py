"""A dressed body that walks on the spot: whether the garments stay on, and clean."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from clothgym import rig
from clothgym.arrays import check_number
from clothgym.detection.openings import threading
from clothgym.dressing.draping import Draped
from clothgym.dressing.worn import expected_limbs
from clothgym.mesh import Mesh
from clothgym.motion import Walk
from clothgym.scene import Scene
from clothgym.simulation import Simulation

STRIDE = 1.2
"""[s] two steps."""
_PARTS = 2
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
    fidelity = worn[0].simulation.fidelity
    substeps = max(d.simulation.pipeline.substeps for d in worn)
    fidelity = dataclasses.replace(fidelity, substeps=max(8, math.ceil(substeps / _PARTS)))
    simulation = Simulation(scene, fidelity)
    told: list[tuple[int, float]] = []
    deepest = 0.0
    if on_frame is not None:
        on_frame(simulation)
    for _ in range(round(60.0 * seconds)):
        simulation.step(_PARTS)
        depths = simulation.body_mesh.penetration(simulation.positions, simulation.faces, _SAMPLES)
        told.append((int(simulation.last_intersections.hit_count), float(np.percentile(depths, 99))))
        deepest = max(deepest, float(depths.max()))
        if on_frame is not None:
            on_frame(simulation)
    (moving,) = scene.bodies
    limbs = rig.load(moving.name).limbs(moving.motion.rotations(simulation.time))  # type: ignore[union-attr]
    x, found = np.array(simulation.positions), []
    for garment, (_, vertices, _) in zip(worn, simulation.cloth_ranges):
        expected = expected_limbs(garment.garment, garment.body)
        loops = [x[vertices][loop] for loop in garment.garment.openings]
        found += [threading(loop, limbs, name) for loop, name in zip(loops, expected)]
    report = {
        "worn": all(opening.right for opening in found),
        "openings": [{"expected": w.expected, "through": list(w.through), "right": w.right} for w in found],
        "hits_max": max((hits for hits, _ in told), default=0),
        "hits_longest": _longest([hits > 0 for hits, _ in told]),
        "hits_end": told[-1][0] if told else 0,
        "depth_p99_max": max((depth for _, depth in told), default=0.0),
        "depth_max": deepest,
        "walk_seconds": simulation.time,
        "seconds": time.perf_counter() - started,
    }
    return Walked(simulation, report, tuple(told))


def walking_scene(garments: Sequence[Draped], seconds: float = 6.0, pose: str = "rest") -> Scene:
    """The scene of a dressed body of the package that is about to walk.

    Raises:
        ValueError: as `walk`.
    """
    if not garments:
        raise ValueError("walk: garments: none given")
    body = garments[0].body
    if body.name not in rig.NAMES:
        raise ValueError(f"walk: body {body.name!r}: has no skeleton; expected one of {', '.join(rig.NAMES)}")
    for other in garments[1:]:
        if other.body.name != body.name or not np.array_equal(other.body.mesh.vertices, body.mesh.vertices):
            raise ValueError(f"walk: garments on different bodies: {body.name!r} and {other.body.name!r}")
    first = garments[0].simulation.scene
    cloths = []
    for garment in garments:
        cloth = garment.simulation.scene.cloths[0]
        loose = dataclasses.replace(cloth.material, damping=_DAMPING)  # type: ignore[type-var]
        mesh = Mesh(garment.positions, garment.faces, garment.garment.quads)
        cloths.append(dataclasses.replace(cloth, mesh=mesh, material=loose))
    moving = dataclasses.replace(body, motion=Walk(body.name, pose, stride=STRIDE))
    return dataclasses.replace(
        first,
        cloths=tuple(cloths),
        bodies=(moving,),
        step=1.0 / (60.0 * _PARTS),
        duration=seconds,
        name=f"{' and '.join(d.garment.name for d in garments)} on {body.name}, walking",
    )


def _longest(marks: Sequence[bool]) -> int:
    """The longest run of marks."""
    longest = run = 0
    for mark in marks:
        run = run + 1 if mark else 0
        longest = max(longest, run)
    return longest
