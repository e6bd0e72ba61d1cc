"""A dressed body that moves as a sequence of its vertices does: its garments, frame by frame."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from clothgym.arrays import check_number
from clothgym.body import Body
from clothgym.detection.body_maps import BodyMaps
from clothgym.dressing.draping import Draped
from clothgym.dressing.layers import effort_of, openings
from clothgym.dressing.walking import PARTS, Walked, frame_by_frame
from clothgym.dressing.worn import carried_limbs, expected_limbs, threadings
from clothgym.mesh import Mesh
from clothgym.motion import Motion
from clothgym.response.body import REACH
from clothgym.simulation import Simulation


def play(
    draped: Draped, motion: Motion, seconds: float, on_frame: Callable[[Simulation], None] | None = None
) -> Walked:
    """Lets the body of a garment that hangs on it move.

    Args:
        draped: on the body as it stands at the start of the motion.
        motion: of the body's vertices.
        seconds: how long.
        on_frame: called with the simulation at the start and after each frame of 1/60 s.

    Returns:
        The report has worn (at the end, every opening: its limb goes through it, or any part of a body without limbs), hits_max
        and hits_end (edges through faces), depth_p99_max and depth_max [m] below the body's true surface.

    Raises:
        ValueError: seconds out of range, or a motion of other vertices.
        SimulationError: the run diverged.
    """
    check_number(seconds, "play: seconds", 0.0, 1e4)
    started = time.perf_counter()
    first = draped.simulation.scene
    cloth = dataclasses.replace(first.cloths[0], mesh=Mesh(draped.positions, draped.faces, draped.garment.quads))
    scene = dataclasses.replace(
        first,
        cloths=(cloth,),
        bodies=(dataclasses.replace(draped.body, motion=motion),),
        step=1.0 / (60.0 * PARTS),
        duration=seconds,
        name=f"{first.name}, moving",
    )
    simulation = Simulation(scene, effort_of([draped], PARTS))
    frames, told = frame_by_frame(simulation, seconds, on_frame)
    report: dict[str, Any] = {
        "worn": _worn(draped, simulation),
        **told,
        "seconds": time.perf_counter() - started,
    }
    return Walked(simulation, report, frames)


def _worn(draped: Draped, simulation: Simulation) -> bool:
    """Whether what belongs there goes through every opening where the body is now."""
    (moving,) = simulation.scene.bodies
    vertices = moving.at(simulation.time)
    if draped.body.limbs:
        found = openings([draped], simulation, carried_limbs(draped.body, vertices))
    else:
        now = Body((vertices, moving.mesh.faces), moving.name)
        tolerance = simulation.fidelity.body_tolerance
        maps = BodyMaps([now], simulation.fidelity.map_size, tolerance + REACH, tolerance=tolerance)
        expected = expected_limbs(draped.garment, now)
        found = threadings(draped.garment, np.array(simulation.positions), now, maps, expected)
    return all(opening.right for opening in found)
