"""Prescribed motion: pinned vertices go where it says, and take along what lies on them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import clothgym as cg
from clothgym.motion import Keyframes, Motion, Turn, Turns

DRAFT = dataclasses.replace(cg.Fidelity.preset("draft"), substeps=4)


def disc(motion: Motion | None, friction: float = 0.6) -> cg.Scene:
    """A sheet that is pinned all over, and a small one upon it."""
    material = cg.Material(density=0.15, stretch=1e3, friction=friction, thickness=4e-3, damping=0.1)
    plate, patch = cg.grid(0.4, 0.4, 6, 6), cg.grid(0.1, 0.1, 4, 4)
    upper = patch.transformed(translation=(0.1, 4e-3, 0.01))
    cloths = (
        cg.Cloth(upper, material, (), patch.vertices, "patch"),
        cg.Cloth(plate, material, range(len(plate.vertices)), None, "plate", motion=motion),
    )
    return cg.Scene(cloths, step=0.01, name="disc")


def test_driven_pins_are_where_their_motion_wants_them():
    motion = Turns((Turn((0.0, 1.0, 0.0), 1.0), Turn((0.0, 0.0, 1.0), 0.1)))
    simulation = cg.Simulation(disc(motion), DRAFT)
    start = simulation.positions.copy()
    plate = simulation.cloth_ranges[1][1]
    for _ in range(20):
        simulation.step()
        assert simulation.positions[plate] == pytest.approx(motion.vertices(start[plate], simulation.time), abs=1e-12)
        assert simulation.last_intersections.hit_count == 0
    assert "drive [plate]" in simulation.pipeline.describe()
    snapshot, after = simulation.snapshot(), []
    for _ in range(2):
        simulation.restore(snapshot)
        simulation.step(3)
        after.append(simulation.state_hash())
    assert after[0] == after[1]


def test_friction_takes_along_what_lies_on_a_turning_plate():
    turned = []
    for motion in (None, Turns((Turn((0.0, 1.0, 0.0), 1.0),))):
        simulation = cg.Simulation(disc(motion), DRAFT)
        patch = simulation.cloth_ranges[0][1]
        simulation.step(50)
        x = simulation.positions[patch].mean(axis=0)
        turned.append(math.atan2(-x[2], x[0]) + math.atan2(0.01, 0.1))
    assert abs(turned[0]) < 0.01
    assert turned[1] == pytest.approx(0.5, abs=0.1)


def test_bad_motion_is_named():
    sheet, turning = cg.grid(1.0, 1.0, 2, 2), Turns((Turn((0.0, 1.0, 0.0), 1.0),))
    with pytest.raises(ValueError, match="moves the pinned vertices, and there are none"):
        cg.Cloth(sheet, motion=turning)
    film = Keyframes([0.0, 1.0], np.zeros((2, 5, 3)))
    with pytest.raises(ValueError, match="moves another number of vertices than 9"):
        cg.Cloth(sheet, pins=[0], motion=film)
    with pytest.raises(ValueError, match=r"needs scene\.self_collision"):
        cg.Scene([cg.Cloth(sheet, pins=[0], motion=turning)], self_collision=False)


def test_scenes_of_before_there_was_motion_are_read():
    import json

    scene = disc(Turns((Turn((0.0, 1.0, 0.0), 1.0),)))
    assert cg.Scene.from_json(scene.to_json()) == scene
    values = json.loads(disc(None).to_json())
    for cloth in values["cloths"]:
        del cloth["motion"]
    del values["ignored"]
    assert cg.Scene.from_json(json.dumps(values)) == disc(None)
