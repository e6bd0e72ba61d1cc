"""Prescribed motion: pinned vertices go where it says, and take along what lies on them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import clothgym as cg
from clothgym.motion import RigidMotion

DRAFT = dataclasses.replace(cg.Fidelity.preset("draft"), substeps=4)


def test_places_are_rigid_and_as_told():
    motion = RigidMotion((0.1, 0.2, 0.3), (0.0, 2.0, 0.0), 0.5, (0.0, 0.0, 1.0), 0.2, tilt_start=1.0, tilt_limit=0.3)
    rng = np.random.default_rng(0)
    x = rng.normal(size=(20, 3))
    for time in (0.0, 0.7, 2.0, 9.0):
        y = motion.places(x, time)
        assert np.linalg.norm(y[1:] - y[:-1], axis=1) == pytest.approx(np.linalg.norm(x[1:] - x[:-1], axis=1))
    assert motion.places(x, 0.0) == pytest.approx(x)
    centre = np.array([0.1, 0.2, 0.3])
    assert motion.places(centre[None], 5.0)[0] == pytest.approx(centre)
    quarter = RigidMotion(spin=0.5 * math.pi).places(np.array([[1.0, 0.0, 0.0]]), 1.0)[0]
    assert quarter == pytest.approx([0.0, 0.0, -1.0])
    tilted = motion.places(centre + np.array([[0.0, 1.0, 0.0]]), 9.0)[0] - centre
    assert tilted == pytest.approx([-math.sin(0.3), math.cos(0.3), 0.0])
    assert RigidMotion.from_json(motion.to_json()) == motion


def disc(motion: RigidMotion | None, friction: float = 0.6) -> cg.Scene:
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
    motion = RigidMotion(spin=1.0, tilt=0.1)
    simulation = cg.Simulation(disc(motion), DRAFT)
    start = simulation.positions.copy()
    plate = simulation.cloth_ranges[1][1]
    for _ in range(20):
        simulation.step()
        assert simulation.positions[plate] == pytest.approx(motion.places(start[plate], simulation.time), abs=1e-12)
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
    for motion in (None, RigidMotion(spin=1.0)):
        simulation = cg.Simulation(disc(motion), DRAFT)
        patch = simulation.cloth_ranges[0][1]
        simulation.step(50)
        x = simulation.positions[patch].mean(axis=0)
        turned.append(math.atan2(-x[2], x[0]) + math.atan2(0.01, 0.1))
    assert abs(turned[0]) < 0.01
    assert turned[1] == pytest.approx(0.5, abs=0.1)


def test_bad_motion_is_named():
    for given, said in (
        ({"axis": (0.0, 0.0, 0.0)}, r"motion\.axis"),
        ({"spin": float("nan")}, r"motion\.spin = nan"),
        ({"tilt_start": -1.0}, r"motion\.tilt_start = -1"),
    ):
        with pytest.raises(ValueError, match=said):
            RigidMotion(**given)
    sheet = cg.grid(1.0, 1.0, 2, 2)
    with pytest.raises(ValueError, match="moves the pinned vertices, and there are none"):
        cg.Cloth(sheet, motion=RigidMotion())
    with pytest.raises(ValueError, match="expected a RigidMotion"):
        cg.Cloth(sheet, pins=[0], motion="fast")
    with pytest.raises(ValueError, match=r"needs scene\.self_collision"):
        cg.Scene([cg.Cloth(sheet, pins=[0], motion=RigidMotion())], self_collision=False)


def test_scenes_of_before_there_was_motion_are_read():
    import json

    scene = disc(RigidMotion(spin=1.0))
    assert cg.Scene.from_json(scene.to_json()) == scene
    values = json.loads(disc(None).to_json())
    for cloth in values["cloths"]:
        del cloth["motion"]
    del values["ignored"]
    assert cg.Scene.from_json(json.dumps(values)) == disc(None)
