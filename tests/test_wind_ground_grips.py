"""What acts on a cloth from outside: wind, the ground, and grippers."""

from __future__ import annotations

import numpy as np
import pytest
from ladders import UPRIGHT, G, lone, rests_on_the_ground

import clothgym as cg

# ---------------------------------------------------------------------------------------------------------------
# wind


def windy(wind, turn=None, integrator="xpbd", drag=0.5) -> cg.Simulation:
    mesh = cg.grid(1.0, 0.6, 4, 3)
    placed = mesh if turn is None else mesh.transformed(rotation=turn)
    cloth = cg.Cloth(placed, cg.Material(density=0.2, damping=0.0), rest=mesh.vertices)
    scene = lone(cloth, gravity=(0, 0, 0), wind=wind, wind_drag=drag, step=1e-3)
    return cg.Simulation(scene, cg.Fidelity(integrator=integrator, substeps=1 if integrator == "xpbd" else 20))


@pytest.mark.parametrize("integrator", ["xpbd", "symplectic_euler"])
def test_wind_across_and_along_a_sheet(integrator):
    across = windy((0.0, 4.0, 0.0), integrator=integrator)
    across.step()
    expected = 1e-3 * 0.5 * 4.0 / 0.2  # drag times speed over areal density
    assert across.velocities == pytest.approx(np.tile([0.0, expected, 0.0], (20, 1)), rel=1e-9, abs=1e-12)
    along = windy((3.0, 0.0, -2.0), integrator=integrator)
    along.step()
    assert np.abs(along.velocities).max() < 1e-12


def test_wind_pushes_a_leaning_sheet_along_its_normal():
    c, s = np.cos(0.6), np.sin(0.6)
    sim = windy((0.0, 4.0, 0.0), np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]))
    sim.step()
    normal = np.array([-s, c, 0.0])
    expected = 1e-3 * 0.5 * 4.0 * c / 0.2 * normal
    assert sim.velocities == pytest.approx(np.tile(expected, (20, 1)), rel=1e-6, abs=1e-10)


def test_a_sheet_that_moves_with_the_wind_feels_none():
    sim = windy((0.0, 4.0, 0.0))
    sim.set_velocities(np.tile([0.0, 4.0, 0.0], (20, 1)))
    sim.step()
    assert sim.velocities == pytest.approx(np.tile([0.0, 4.0, 0.0], (20, 1)), abs=1e-10)


def test_strong_drag_brings_the_cloth_to_the_speed_of_the_wind():
    """Within the documented range of wind_drag nothing may become faster than the air that drives it."""
    sim = windy((0.0, 4.0, 0.0), drag=2000.0)
    for _ in range(10):
        sim.step()
        assert np.abs(sim.velocities).max() <= 4.0 * (1 + 1e-6)


# ---------------------------------------------------------------------------------------------------------------
# ground


@pytest.mark.parametrize("integrator", ["xpbd", "symplectic_euler"])
@pytest.mark.parametrize("self_collision", [False, True])
def test_a_sheet_comes_to_rest_on_the_ground_and_stays(integrator, self_collision):
    fidelity = cg.Fidelity(integrator=integrator, substeps=8 if integrator == "xpbd" else 0)
    rests_on_the_ground(fidelity, self_collision, steps=(60, 60), slowest=1e-3)


def test_frictionless_ground_does_not_stop_a_sheet():
    mesh = cg.grid(0.4, 0.4, 3, 3)
    material = cg.Material(thickness=4e-3, damping=0.0, friction=0.0)
    placed = mesh.transformed(translation=(0, 0.002, 0))
    sim = cg.Simulation(lone(cg.Cloth(placed, material, rest=mesh.vertices), ground=0.0))
    sim.set_velocities(np.tile([0.3, 0.0, 0.0], (16, 1)))
    sim.step(30)
    assert sim.velocities[:, 0] == pytest.approx(0.3, rel=1e-6)


# ---------------------------------------------------------------------------------------------------------------
# grippers


def held_sheet(grip=None, vertices=(0, 1, 2, 3, 4), **material) -> cg.Simulation:
    """A sheet hung upright, its top row held by one gripper."""
    mesh = cg.grid(0.4, 0.4, 4, 4)
    placed = mesh.transformed(rotation=UPRIGHT, translation=(0, 1.0, 0))
    values = {"damping": 4.0, "stretch": 500.0, "shear": 50.0} | material
    cloth = cg.Cloth(placed, cg.Material(**values), rest=mesh.vertices)
    sim = cg.Simulation(lone(cloth, grips=[grip or cg.Grip(radius=0.3)]))
    sim.place_grip(0, placed.vertices[2])
    assert sim.grasp(0, list(vertices)) == len(vertices)
    return sim


def test_a_gripper_feels_the_weight():
    sim = held_sheet()
    sim.step(200)
    weight = sim.model.masses.sum() * G
    assert sim.grip_forces[0] == pytest.approx([0.0, weight, 0.0], rel=0.01, abs=0.01 * weight)
    assert sim.held(0).tolist() == [0, 1, 2, 3, 4]
    sag = 1.2 - sim.positions[:5, 1].mean()
    assert sag == pytest.approx(weight / 500.0, rel=0.05), "the anchor's stiffness is that of the whole gripper"


def test_above_its_force_the_cloth_slips_out():
    weight = 0.4 * 0.4 * 0.15 * G
    strong, weak = (held_sheet(cg.Grip(radius=0.3, slip_force=share * weight)) for share in (1.5, 0.5))
    for sim in (strong, weak):
        sim.step(200)
    assert len(strong.held(0)) == 5
    assert strong.positions[:, 1].min() > 0.7
    assert len(weak.held(0)) == 0
    assert weak.positions[:, 1].max() < 0.0
    assert (weak.grip_forces == 0.0).all()


def test_grip_force_never_exceeds_the_slip_force():
    sim = held_sheet(cg.Grip(radius=0.3, slip_force=0.6))
    sim.move_grip(0, (0.0, 20.0, 0.0))
    largest = 0.0
    for _ in range(5):
        sim.step()
        largest = max(largest, float(np.linalg.norm(sim.grip_forces[0])))
    assert 0.5 < largest <= 0.6 * (1 + 1e-9)


def test_release_lets_go():
    sim = held_sheet()
    sim.step(5)
    sim.release(0)
    before = sim.positions[:, 1].mean()
    sim.step(20)
    assert len(sim.held(0)) == 0
    assert (sim.grip_forces == 0.0).all()
    assert before - sim.positions[:, 1].mean() > 0.2


def test_held_cloth_follows_its_gripper():
    sim = held_sheet()
    sim.step(120)
    before = sim.positions.copy()
    sim.move_grip(0, (0.1, 0.05, -0.02))
    sim.step(60)
    sim.move_grip(0, (0.0, 0.0, 0.0))
    sim.step(120)
    assert sim.positions - before == pytest.approx(np.tile([0.1, 0.05, -0.02], (25, 1)), abs=2e-3)
    assert sim.grip_positions[0] - sim.scene.start[2] == pytest.approx([0.1, 0.05, -0.02], abs=1e-12)


def test_grasp_takes_what_is_within_the_radius():
    sim = held_sheet(cg.Grip(radius=0.105), vertices=())
    assert sim.grasp(0) == 4  # the middle of the top row, its neighbours, and the vertex below
    distance = np.linalg.norm(sim.positions - sim.grip_positions[0], axis=1)
    assert sorted(sim.held(0).tolist()) == np.flatnonzero(distance <= 0.105).tolist()
    assert sim.grasp(0) == 4, "held vertices are taken once"


def test_a_vertex_named_twice_is_held_once():
    sim = held_sheet(vertices=())
    assert sim.grasp(0, [3, 3]) == 1
    assert sim.held(0).tolist() == [3]


@pytest.mark.parametrize(("call", "message"), [
    (lambda s: s.grasp(1), "grip = 1"),
    (lambda s: s.grasp(0, [25]), "vertices"),
    (lambda s: s.grasp(0, [-1]), "vertices"),
    (lambda s: s.place_grip(0, (0, np.nan, 0)), r"position\[0, 1\] is nan"),
    (lambda s: s.move_grip(0, (1, 2)), "velocity"),
    (lambda s: s.release(-1), "grip = -1"),
])  # fmt: skip
def test_bad_calls_of_grippers_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(held_sheet())
