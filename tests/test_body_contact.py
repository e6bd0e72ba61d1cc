"""Cloth on bodies: newtons, friction, rebound, thin limbs, spikes, and that the same calls give the same bits."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import pickle

import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym import materials
from clothgym.detection.body_maps import BodyMaps
from clothgym.kernels import body_contact, body_map
from clothgym.response.body import body_contact as contact_of
from clothgym.response.body import face_points

G = 9.81
TOLERANCE = cg.Fidelity().body_tolerance
FREE = dataclasses.replace(materials.get("cotton"), damping=0.0, stretch=1000.0)
XPBD, EULER = cg.Fidelity(), cg.Fidelity(integrator="symplectic_euler", substeps=0)
BOTH = pytest.mark.parametrize("fidelity", [XPBD, EULER], ids=["xpbd", "symplectic_euler"])


def turn(axis, angle):
    return trimesh.transformations.rotation_matrix(angle, axis)[:3, :3]


def box(size=(0.5, 0.1, 0.3), matrix=None):
    mesh = trimesh.creation.box(size)
    for _ in range(4):
        mesh = mesh.subdivide()
    return mesh.vertices if matrix is None else mesh.vertices @ matrix.T, mesh.faces


def ball(radius=0.1, cuts=4):
    mesh = trimesh.creation.icosphere(cuts, radius)
    return mesh.vertices, mesh.faces


def pole(radius=0.02, length=0.4, axis=(0, 1, 0)):
    """A thin capsule in the middle of the world."""
    mesh = trimesh.creation.capsule(length, radius, count=[32, 32])
    vertices = mesh.vertices - mesh.bounds.mean(axis=0)
    return vertices @ trimesh.geometry.align_vectors([0, 0, 1], axis)[:3, :3].T, mesh.faces


def sheet(size=0.1, cells=4, height=0.0, matrix=None):
    """Level, its middle at `height` above the origin, then turned about the origin."""
    mesh = cg.grid(size, size, cells, cells)
    vertices = mesh.vertices - mesh.vertices.mean(axis=0)
    if np.ptp(vertices[:, 1]) > 0.5 * size:  # upright grids are laid down
        vertices = vertices[:, [0, 2, 1]] * [1, 1, -1]
    vertices = vertices + np.array([0.0, height, 0.0])
    return (vertices if matrix is None else vertices @ matrix.T), mesh.faces


def simulation(cloth, body, fidelity=XPBD, material=FREE, self_collision=False, step=0.01, pins=(), grips=(), **answer):
    bodies = body if isinstance(body, list) else [cg.Body(body, **answer)]
    piece = cg.Cloth(cloth, material, pins=pins)
    return cg.Simulation(
        cg.Scene([piece], bodies=bodies, self_collision=self_collision, step=step, grips=grips), fidelity
    )


def weight(sim):
    return sim.model.masses.sum() * G


# ---------------------------------------------------------------------------------------------------------------
# newtons


@BOTH
@pytest.mark.parametrize("self_collision", [False, True])
def test_the_body_carries_the_weight(self_collision, fidelity):
    calm = dataclasses.replace(FREE, damping=8.0)
    sim = simulation(sheet(0.1, 4, 0.05 + TOLERANCE), box(), fidelity, calm, self_collision, friction=0.6)
    sim.step(10)
    assert np.abs(sim.velocities).max() < 1e-3
    assert sim.body_forces.sum(axis=0) == pytest.approx([0.0, weight(sim), 0.0], abs=0.001 * weight(sim))
    assert sim.body_forces[:, 1] == pytest.approx(sim.model.masses * G, rel=0.05), "each vertex its own"
    assert sim.penetration_depth() == 0.0


def test_a_ball_carries_the_weight():
    """On average: on a round body cloth comes to rest slowly."""
    sim = simulation(
        sheet(0.06, 4, 0.1 + TOLERANCE), ball(), XPBD, dataclasses.replace(FREE, damping=8.0), friction=0.6
    )
    sim.step(20)
    forces = []
    for _ in range(60):
        sim.step()
        forces.append(sim.body_forces.sum(axis=0))
    assert np.mean(forces, axis=0) == pytest.approx([0.0, weight(sim), 0.0], abs=0.01 * weight(sim))
    assert sim.penetration_depth() == 0.0


@BOTH
@pytest.mark.parametrize(("response", "rebound"), [("coulomb", 0.0), ("velocity", 0.6)])
def test_all_momentum_comes_from_the_body(response, rebound, fidelity):
    """Sliding in and landing: the sum of the body's forces is what the cloth's momentum changed by beyond gravity."""
    fidelity = dataclasses.replace(fidelity, body_response=response)
    sim = simulation(sheet(height=0.1), box(), fidelity, step=0.005, rebound=rebound, slide=0.97)
    sim.set_velocities(np.tile([0.4, 0.0, -0.1], (25, 1)))
    masses = sim.model.masses[:, None]
    start, given = (masses * sim.velocities).sum(axis=0), np.zeros(3)
    for _ in range(40):
        sim.step()
        given += 0.005 * sim.body_forces.sum(axis=0)
    gained = (masses * sim.velocities).sum(axis=0) - start + 40 * 0.005 * masses.sum() * np.array([0.0, G, 0.0])
    assert gained[1] > 0.5 * masses.sum() * math.sqrt(2 * G * 0.047), "it has landed"
    assert given == pytest.approx(gained, abs=1e-6 * gained[1])


def test_no_force_without_touch():
    same = cg.Fidelity(substeps=8)  # what is chosen for a scene without contact is another
    sim = simulation(sheet(height=0.3), ball(), same)
    x, v = np.array(sim.positions), np.array(sim.velocities)
    free = cg.Simulation(dataclasses.replace(sim.scene, bodies=()), same)
    sim.step(5)
    free.step(5)
    assert not sim.body_forces.any()
    assert sim.positions.tobytes() == free.positions.tobytes(), "as if the body were not there"
    assert sim.velocities.tobytes() == free.velocities.tobytes()
    assert not np.array_equal(x, sim.positions)
    assert not np.array_equal(v, sim.velocities)
    assert free.body_forces.shape == (0, 3)
    assert free.penetration_depth() == 0.0


# ---------------------------------------------------------------------------------------------------------------
# friction


@BOTH
@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 0, 0), (0.6, 0, 0.8)], ids=["edge-on", "from the front", "askew"])
@pytest.mark.parametrize("angle", [0.25, 0.36, 0.5])
def test_an_incline(angle, axis, fidelity):
    """Cloth slides where tan(angle) > mu, with g (sin - mu cos); maps see the plane edge-on, or from the front."""
    mu, matrix, steps = 0.3, turn(axis, angle), 20
    sim = simulation(sheet(0.1, 4, 0.05 + TOLERANCE, matrix), box((0.6, 0.1, 0.6), matrix), fidelity, friction=mu)
    start = np.array(sim.positions)
    sim.step(steps)
    expected = max(0.0, G * (math.sin(angle) - mu * math.cos(angle)))
    speed = np.linalg.norm(sim.velocities.mean(axis=0))
    assert speed == pytest.approx(0.01 * steps * expected, rel=0.02, abs=1e-3)
    out = matrix[:, 1]
    assert np.abs((sim.positions - start) @ out).max() < 5e-4, "neither lifted nor sunk"
    if expected == 0.0:
        assert np.abs(sim.positions - start).max() < 1e-5, "sticks"
    pressed = sim.body_forces.sum(axis=0) @ out
    assert pressed == pytest.approx(weight(sim) * math.cos(angle), rel=0.01)


@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 0, 0)])
def test_the_papers_response_creeps_and_coulomb_does_not(axis):
    """[Vassilev 2001, eq. 12] as a law: v = C g sin(angle) dt / (1 - C), whatever the angle."""
    angle, keep, matrix = 0.2, 0.9, turn(axis, 0.2)
    for substeps in (4, 8):
        speeds = []
        for response in ("velocity", "coulomb"):
            fidelity = cg.Fidelity(substeps=substeps, body_response=response)
            body = box((0.6, 0.1, 0.6), matrix)
            sim = simulation(sheet(0.1, 4, 0.05 + TOLERANCE, matrix), body, fidelity, slide=keep, friction=0.3)
            sim.step(30)
            speeds.append(np.linalg.norm(sim.velocities.mean(axis=0)))
        dt = 0.01 / substeps
        assert speeds[0] == pytest.approx(keep * G * math.sin(angle) * dt / (1.0 - keep), rel=0.02)
        assert speeds[1] < 1e-6


def test_frictions_of_several_bodies_are_averaged():
    matrix = turn((1, 0, 0), 0.3)
    plate = box((0.6, 0.1, 0.6), matrix)
    other = (ball(0.05)[0] + [2.0, 0, 0], ball(0.05)[1])
    angle, steps = 0.3, 20
    two = [cg.Body(plate, friction=0.0), cg.Body(other, friction=0.2)]
    fine = dataclasses.replace(XPBD, map_size=1500)
    sim = simulation(sheet(0.1, 4, 0.05 + TOLERANCE, matrix), two, fine)
    sim.step(steps)
    expected = G * (math.sin(angle) - 0.1 * math.cos(angle))
    assert np.linalg.norm(sim.velocities.mean(axis=0)) == pytest.approx(0.01 * steps * expected, rel=0.03)


# ---------------------------------------------------------------------------------------------------------------
# rebound


@BOTH
@pytest.mark.parametrize("self_collision", [False, True])
@pytest.mark.parametrize("rebound", [0.0, 0.5, 0.8])
def test_rebound_height(rebound, self_collision, fidelity):
    height = 0.08
    sim = simulation(
        sheet(height=0.05 + TOLERANCE + height), box(), fidelity, FREE, self_collision, 0.002, rebound=rebound
    )
    touched, highest = False, 0.0
    for _ in range(int((1.05 + rebound) * math.sqrt(2 * height / G) / 0.002)):
        sim.step()
        touched = touched or bool(sim.body_forces.any())
        if touched:
            highest = max(highest, float(sim.positions[:, 1].mean()) - 0.05 - TOLERANCE)
    assert touched
    assert highest == pytest.approx(rebound**2 * height, rel=0.05, abs=0.002)


def answered(velocity, start=(0.0, 0.0, 0.0), **answer):
    """A vertex on the front of a ball after one substep of contact: its velocity, and its force."""
    maps = BodyMaps([cg.Body(ball())], 240, 0.02, "interpolated")  # the normal at the front is along z
    contact = contact_of(maps.map, np.array([[0, 0, 0]], np.int32), 1, TOLERANCE, 0, **answer)
    dt, mass = 1e-3, 2e-3
    x = np.array([start], float)
    p, v = x + dt * np.asarray(velocity, float), np.zeros((1, 3))
    body_contact_sweep(x, p, np.array([1.0 / mass]), contact)
    v[:] = (p - x) / dt
    body_contact.answer_body(v, np.array([1.0 / mass]), contact, dt)
    return v[0], contact.forces[0], mass / dt


def body_contact_sweep(x, p, inverse_masses, contact):
    """`solve_on_body` in little: a substep's sweep by the functions that sweeps call."""
    body_contact.begin_contact(x, p, contact, 0.0)
    body_contact.keep_off_body(x, p, inverse_masses, contact, 0.0)


def test_equation_12_acts_on_what_approaches_only():
    inside = (0.0, 0.0, 0.1 + TOLERANCE - 5e-4)  # within the tolerance
    v, force, unit = answered((1.0, 0.0, -2.0), inside, slide=0.5, rebound=0.25)
    assert v == pytest.approx([0.5, 0.0, 0.5], abs=0.03)
    assert force == pytest.approx([-0.5 * unit, 0.0, 2.5 * unit], abs=0.04 * unit)
    v, force, unit = answered((1.0, 0.0, 0.25), inside, slide=0.5, rebound=0.25)
    assert v == pytest.approx([1.0, 0.0, 0.25], abs=0.02), "was leaving by itself, and keeps its velocity"
    assert force == pytest.approx(0.0, abs=0.02 * unit)
    v, _, _ = answered((0.0, 0.0, 0.0), (0.0, 0.0, 0.09), slide=0.5, rebound=0.25)
    assert v == pytest.approx([0.0, 0.0, 0.0], abs=1e-6), "being pushed out gives no speed"
    v, force, _ = answered((1.0, 0.0, -2.0), (0.0, 0.0, 0.12), slide=0.5)
    assert v == pytest.approx([1.0, 0.0, -2.0]), "not yet there"
    assert not force.any()


# ---------------------------------------------------------------------------------------------------------------
# thin limbs


@BOTH
@pytest.mark.parametrize("self_collision", [False, True])
@pytest.mark.parametrize("axis", [(0, 1, 0), (1, 0.3, 0)], ids=["upright", "nearly level"])
@pytest.mark.parametrize("sense", [1.0, -1.0], ids=["from behind", "from the front"])
def test_cloth_thrown_at_a_thin_limb_stays_on_its_side(sense, axis, self_collision, fidelity):
    """Fast, but no further in a substep than the limb's radius."""
    radius = 0.02
    body = pole(radius, 0.5, axis)
    flat, faces = sheet(0.16, 8)
    upright = flat[:, [0, 2, 1]] * [1, 1, -1] + [0.003, 0.004, -sense * 0.04]
    sim = simulation((upright, faces), body, fidelity, FREE, self_collision, step=0.004)
    speed = 0.6 * radius / (0.004 / 8)
    sim.set_velocities(np.tile([0.0, 0.0, sense * speed], (len(flat), 1)))
    on_limb = (
        np.linalg.norm(np.cross(upright - [0, 0, upright[0, 2]], np.array(axis) / np.linalg.norm(axis)), axis=1)
        < 0.6 * radius
    )
    on_limb &= np.abs(upright[:, :2]).max(axis=1) < 0.06
    assert on_limb.sum() >= 3
    deepest, first = 0.0, 0.0
    for _ in range(6):
        sim.step()
        depth = sim.body_mesh.depth(sim.positions)
        deepest = max(deepest, depth[on_limb].max())
        assert (sense * sim.positions[on_limb, 2] < radius).all(), "through the limb to its far side"
        assert np.isfinite(sim.positions).all()
        first = first or float(sim.body_forces[:, 2].sum())
    assert first * sense < 0.0, "it was stopped"
    assert deepest < 1e-3


@pytest.mark.parametrize("self_collision", [False, True])
@pytest.mark.parametrize("sense", [1.0, -1.0], ids=["from behind", "from the front"])
def test_a_leap_past_the_middle_of_a_limb_leads_back(sense, self_collision):
    """In one substep from just outside to beyond the axis: the far side is nearer then, and still the wrong one."""
    radius = 0.02
    flat, faces = sheet(0.16, 8)
    upright = flat[:, [0, 2, 1]] * [1, 1, -1] + [0.001, 0.0, -sense * 0.025]
    sim = simulation((upright, faces), pole(radius, 0.5), XPBD, FREE, self_collision, step=0.004)
    middle = (np.abs(upright[:, 0]) < 0.3 * radius) & (np.abs(upright[:, 1]) < 0.06)
    assert middle.sum() >= 3
    sim.set_velocities(np.tile([0.0, 0.0, sense * 0.033 / (0.004 / 8)], (len(flat), 1)))
    sim.step()
    assert (sense * sim.positions[middle, 2] < -0.9 * radius).all()
    assert sim.body_mesh.depth(sim.positions[middle]).max() == 0.0


@BOTH
def test_a_gripper_cannot_press_cloth_through(fidelity):
    """A hand that goes to the far side of a limb holds on by its spring; the cloth stays in front."""
    grip = cg.Grip(radius=0.03, stiffness=200.0, slip_force=5.0)
    flat, faces = sheet(0.16, 8)
    upright = flat[:, [0, 2, 1]] * [1, 1, -1] + [0.0, 0.0, 0.026]
    calm = dataclasses.replace(FREE, damping=2.0)
    sim = simulation((upright, faces), pole(0.02, 0.5), fidelity, calm, step=0.01, grips=[grip], friction=0.5)
    sim.place_grip(0, [0.0, 0.0, 0.026])
    held = sim.grasp(0)
    assert held >= 4
    middle = [v for v in sim.held(0) if abs(upright[v, 0]) < 0.01]
    assert len(middle) == 3
    sim.move_grip(0, [0.0, 0.0, -0.3])
    pressed = 0.0
    for _ in range(11):  # then it slips, and may go around
        sim.step()
        pressed = max(pressed, float(sim.body_forces.sum(axis=0)[2]))
        assert (sim.positions[middle, 2] > 0.02).all(), "only beside the limb is there a way around"
        assert sim.body_mesh.depth(sim.positions).max() < 1e-3
    assert pressed > 3.0, "the hand did press"
    assert sim.grip_positions[0, 2] == pytest.approx(0.026 - 0.033)


# ---------------------------------------------------------------------------------------------------------------
# faces


def test_points_of_faces():
    for parts in (1, 2, 3, 5):
        points = face_points(parts)
        assert points.shape == (parts**2, 3)
        assert points.sum(axis=1) == pytest.approx(1.0)
        assert points.min() > 0.0
        assert len(np.unique(points.round(9), axis=0)) == parts**2
        assert points.mean(axis=0) == pytest.approx([1 / 3] * 3)
        # each weight takes equal steps: midpoints of equal triangles
        assert sorted(np.unique((3 * parts * points).round(9) % 1.0)) == [0.0]
    assert face_points(0).shape == (0, 3)


@BOTH
def test_faces_hold_a_coarse_sheet_on_a_spike(fidelity):
    """Vertices go by on both sides of a thin pole; only the points of the faces between feel it."""
    body = pole(0.012, 0.5)  # its top is at y = 0.25 + 0.012
    calm = dataclasses.replace(FREE, damping=5.0)
    depth = {}
    for parts in (0, 8):
        flat, faces = sheet(0.2, 2, 0.0)
        top = body[0][:, 1].max()
        cloth = flat + np.array([0.05, top + 0.01, 0.033]), faces  # the pole stands within a face
        sim = simulation(cloth, body, dataclasses.replace(fidelity, body_faces=parts), calm)
        sim.step(12)
        depth[parts] = sim.body_mesh.penetration(sim.positions, sim.faces, 45).max()
        touched = np.abs(sim.body_forces).max()
        assert (touched > 0.0) == (parts > 0)
    assert depth[0] > 0.005
    assert depth[8] < 0.002


# ---------------------------------------------------------------------------------------------------------------
# pins, bits, inputs


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
