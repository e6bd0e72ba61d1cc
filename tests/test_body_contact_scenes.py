"""Scenes with bodies: pins in them, the same bits, cloth that starts inside, JSON and wrong input."""

from __future__ import annotations

import copy
import json
import math
import pickle

import numpy as np
import pytest
import trimesh
from body_cases import BOTH, FREE, TOLERANCE, XPBD, ball, pole, sheet, simulation

import clothgym as cg
from clothgym.detection.body_maps import BodyMaps
from clothgym.kernels import body_contact, body_map
from clothgym.response.body import body_contact as contact_of


@BOTH
@pytest.mark.parametrize("self_collision", [False, True])
def test_pinned_vertices_in_the_body_do_not_move(self_collision, fidelity):
    cloth = sheet(0.1, 4, 0.09)
    pins = (12, 7)
    sim = simulation(cloth, ball(), fidelity, FREE, self_collision, pins=pins)
    start = np.array(sim.positions)
    assert sim.body_mesh.depth(start[list(pins)]).min() > 0.004
    sim.step(10)
    assert np.array_equal(sim.positions[list(pins)], start[list(pins)])
    assert not sim.body_forces[list(pins)].any()
    assert not sim.velocities[list(pins)].any()
    assert np.isfinite(sim.positions).all()
    others = np.setdiff1d(np.arange(25), pins)
    assert sim.body_mesh.depth(sim.positions[others]).max() < 1e-3


def test_sides_of_pinned_vertices_are_noted_too():
    """A face with a pinned corner at the back and two free ones there is a face at the back."""
    maps = BodyMaps([cg.Body(ball())], 120, 0.02)
    contact = contact_of(maps.map, np.array([[0, 1, 2]], np.int32), 3, TOLERANCE, 3)
    x = np.array([[0.0, 0, -0.1], [0.02, 0, -0.1], [0, 0, 0.11]])
    cloth = cg.Cloth((x, [[0, 1, 2]]), pins=[0])
    scene = cg.Scene([cloth], bodies=[cg.Body(ball())], self_collision=False, gravity=(0, 0, 0))
    sim = cg.Simulation(scene)
    body_contact.begin_contact(x, x.copy(), contact, 0.0)
    assert contact.side.tolist() == [body_map.BACK, body_map.BACK, body_map.FRONT]
    sim.step()
    assert np.isfinite(sim.positions).all()


def mid_contact(fidelity=XPBD, self_collision=False):
    sim = simulation(sheet(0.16, 6, 0.1 + TOLERANCE), ball(), fidelity, FREE, self_collision, friction=0.2)
    sim.set_velocities(np.tile([0.3, -0.5, 0.1], (49, 1)))
    sim.step(6)
    assert sim.body_forces.any()
    return sim


@BOTH
@pytest.mark.parametrize("self_collision", [False, True])
def test_the_same_bits_again(self_collision, fidelity):
    one, two = mid_contact(fidelity, self_collision), mid_contact(fidelity, self_collision)
    assert one.state_hash() == two.state_hash()
    assert one.body_forces.tobytes() == two.body_forces.tobytes()
    saved, forces = one.snapshot(), one.measured_forces()
    pickled, copied = pickle.loads(pickle.dumps(one)), copy.deepcopy(one)
    one.step(5)
    ahead = one.state_hash(), one.body_forces.tobytes()
    for other in (two, pickled, copied):
        assert other.state_hash() != ahead[0]
        assert other.body_forces.tobytes() == forces[1].tobytes()
        other.step(5)
        assert (other.state_hash(), other.body_forces.tobytes()) == ahead
    one.restore(saved)
    one.set_measured_forces(forces)
    assert one.body_forces.tobytes() == forces[1].tobytes()
    one.step(5)
    assert (one.state_hash(), one.body_forces.tobytes()) == ahead
    one.reset()
    assert not one.body_forces.any()
    one.set_velocities(np.tile([0.3, -0.5, 0.1], (49, 1)))
    one.step(11)
    assert (one.state_hash(), one.body_forces.tobytes()) == ahead
    given = one.body_forces
    with pytest.raises(ValueError, match="read-only"):
        given[0] = 1.0
    with pytest.raises(ValueError, match="body forces: expected 49 rows, got 3"):
        one.set_measured_forces((forces[0], np.zeros((3, 3))))


@BOTH
@pytest.mark.parametrize("self_collision", [False, True])
def test_cloth_that_starts_inside_comes_out_quietly(self_collision, fidelity):
    """Wherever it starts: through the middle, through the outline, crumpled; and it never becomes anything but numbers."""
    rng = np.random.default_rng(0)
    for seed in range(3):
        vertices, faces = sheet(0.14, 5, 0.02 * seed)
        sim = simulation((vertices, faces), ball(), fidelity, FREE, self_collision)
        sim.set_positions(vertices + rng.normal(0.0, 0.01 * seed, vertices.shape))
        for _ in range(4):
            sim.step()
            assert np.isfinite(sim.positions).all()
            assert np.isfinite(sim.body_forces).all()
        if not self_collision:
            assert sim.body_mesh.depth(sim.positions).max() < 2e-3


def test_scenes_with_bodies_survive_json():
    mesh = sheet(0.1, 3, 0.2)
    rng = np.random.default_rng(0)
    corners = rng.normal(0.0, 0.1, (len(mesh[1]), 3, 3))
    limbs = cg.Body("female").limbs
    bodies = [cg.Body(ball(), "ball", 1 / 3, 0.1 + 0.2, 1 / 7), cg.Body(pole(), "pole", limbs=limbs)]
    scene = cg.Scene([cg.Cloth(mesh, rest=corners), cg.Cloth(mesh, rest=corners[:, :, :2])], bodies=bodies, name="both")
    text = scene.to_json()
    again = cg.Scene.from_json(text)
    assert again == scene
    assert again.to_json() == text
    assert again.cloths[0].rest.tobytes() == corners.tobytes()
    assert again.cloths[1].rest.shape == (len(mesh[1]), 3, 3)
    for one, two in zip(scene.bodies, again.bodies):
        assert one.mesh.vertices.tobytes() == two.mesh.vertices.tobytes()
        assert one.mesh.faces.tobytes() == two.mesh.faces.tobytes()
        assert (one.name, one.friction, one.slide, one.rebound) == (two.name, two.friction, two.slide, two.rebound)
        assert [limb.name for limb in one.limbs] == [limb.name for limb in two.limbs]
    one, two = cg.Simulation(scene), cg.Simulation(again)
    one.step(2)
    two.step(2)
    assert one.state_hash() == two.state_hash()
    values = json.loads(text)
    del values["bodies"][1]["slide"]
    with pytest.raises(ValueError, match=r"body\.slide: unknown or missing field"):
        cg.Scene.from_json(json.dumps(values))


def line(error) -> str:
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (lambda: cg.Body(ball(), friction=-0.1), "friction = -0.1"),
        (lambda: cg.Body(ball(), slide=1.5), "slide = 1.5"),
        (lambda: cg.Body(ball(), rebound=math.nan), "rebound = nan"),
        (lambda: cg.Body(ball(), limbs=(3,)), r"limbs\[0\] = int"),
        (lambda: cg.Body((np.full((4, 3), math.inf), [[0, 1, 2]] * 4)), "is inf: every coordinate must be finite"),
        (lambda: cg.Body((np.eye(4, 3), [[0, 1, 2]])), "at least four triangles"),
        (lambda: cg.Body((np.zeros((4, 3)), [[0, 1, 2]] * 4)), "have no area"),
        (lambda: cg.Body("nobody"), "expected one of female, male"),
        (lambda: cg.Body(7), "expected a Mesh, a trimesh"),
        (lambda: cg.Scene([cg.Cloth(sheet())], bodies=[ball()]), r"scene.bodies\[0\] = tuple: expected a Body"),
        (lambda: cg.Cloth(sheet(), rest=np.zeros((3, 3, 3))), "expected the corners of 32 faces"),
        (lambda: cg.Cloth(sheet(), rest=np.full((32, 3, 2), math.nan)), "rest corners"),
        (lambda: cg.Fidelity(map_size=4), "fidelity.map_size = 4"),
        (lambda: cg.Fidelity(body_tolerance=-1.0), "fidelity.body_tolerance = -1.0"),
        (lambda: cg.Fidelity(body_response="glue"), "fidelity.body_response = 'glue'"),
        (lambda: cg.Simulation(cg.Scene([cg.Cloth(sheet())])).body_mesh, "the scene has no bodies"),
    ],
)  # fmt: skip
def test_wrong_input_gets_one_line(wrong, told):
    with pytest.raises(ValueError, match=told) as error:
        wrong()
    line(error)


def test_the_map_that_the_contact_reads_is_the_bodies_own():
    sim = simulation(sheet(), ball())
    stage = sim.pipeline.stages[-1]
    assert stage.body.maps.map is stage.body._contact.map
    assert body_map.query.__module__ == "clothgym.kernels.body_map"
    assert "body_forces" in stage.writes
    assert "body 360 px along zy, coulomb, 9 points a face" in sim.pipeline.describe()


@pytest.mark.parametrize(("substeps", "sweeps"), [(8, 8), (8, 16), (12, 12)])
def test_cloth_comes_to_rest_on_a_ball(substeps, sweeps):
    """Where one pair of views sees the ball edge-on, on its top, the other looks straight down: nothing trembles."""
    mesh = cg.grid(0.3, 0.3, 12, 12).transformed(translation=(0.01, 0.155, 0.005))
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.15)
    cloth = cg.Cloth(mesh, cg.Material(damping=8.0))
    scene = cg.Scene([cloth], bodies=[cg.Body(sphere, friction=0.6)], self_collision=False)
    sim = cg.Simulation(scene, cg.Fidelity(substeps=substeps, sweeps=sweeps))
    sim.step(150)
    assert sim.positions[:, 1].max() > 0.15, "it lies on the ball"
    assert np.linalg.norm(sim.velocities, axis=1).max() < 1e-4
