"""Contact with bodies: weight, friction, rebound, thin limbs and faces."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import trimesh
from body_cases import BOTH, FREE, TOLERANCE, XPBD, ball, box, pole, sheet, simulation

import clothgym as cg
from clothgym.detection.body_maps import BodyMaps
from clothgym.kernels import body_contact
from clothgym.response.body import body_contact as contact_of
from clothgym.response.body import face_points

G = 9.81


def turn(axis, angle):
    return trimesh.transformations.rotation_matrix(angle, axis)[:3, :3]


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
