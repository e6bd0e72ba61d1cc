"""Cloths and bodies that come and go while a simulation runs [Mezger 2003: "the dynamic addition of objects"]."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import clothgym as cg

FIDELITY = cg.Fidelity(substeps=4, sweeps=4)


def sheet(name: str, height: float, count: int = 6) -> cg.Cloth:
    mesh = cg.grid(0.3, 0.3, count, count)
    return cg.Cloth(mesh.transformed(translation=(0.003 * height, height, 0.0)), name=name)


def running(*cloths: cg.Cloth, **scene) -> cg.Simulation:
    sim = cg.Simulation(cg.Scene(list(cloths), ground=0.0, step=0.01, **scene), FIDELITY)
    sim.step(5)
    return sim


def test_what_stays_keeps_its_state():
    sim = running(sheet("low", 0.05), sheet("high", 0.30))
    x, v, now = sim.positions.copy(), sim.velocities.copy(), sim.time
    sim.add(sheet("new", 0.5))
    assert sim.time == now and sim.step_count == 5
    assert (sim.positions[: len(x)] == x).all() and (sim.velocities[: len(v)] == v).all()
    assert (sim.velocities[len(v) :] == 0.0).all()
    assert [name for name, _, _ in sim.cloth_ranges] == ["low", "high", "new"]
    sim.remove("low")
    assert (sim.positions[:49] == x[49:]).all() and (sim.velocities[:49] == v[49:]).all()
    sim.remove("new")
    assert len(sim.positions) == 49


def test_an_addition_far_away_changes_nothing():
    """The course of what was there is bit for bit that of a simulation that nothing was added to."""
    alone, other = running(sheet("low", 0.05)), running(sheet("low", 0.05))
    other.add(sheet("far", 5.0))
    alone.step(10)
    other.step(10)
    assert (other.positions[:49] == alone.positions).all()
    other.remove("far")
    alone.step(5)
    other.step(5)
    assert (other.positions == alone.positions).all()


def test_what_is_added_takes_part():
    sim = running(sheet("low", 0.02))
    sim.add(sheet("high", 0.08))
    for _ in range(60):
        sim.step()
        assert sim.metrics()["hits"] == 0
    low, high = sim.positions[:49], sim.positions[49:]
    assert (high[:, 1] > low[:, 1].min()).all() and high[:, 1].mean() > low[:, 1].mean()
    assert abs(high[:, 1].mean()) < 0.03, "it came down"


def test_a_body_catches_what_falls_and_lets_it_go():
    sim = running(sheet("cloth", 0.5))
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    ball.apply_translation([0.0, 0.2, 0.0])
    sim.add(cg.Body(ball, name="ball"))
    sim.step(60)
    assert sim.positions[:, 1].max() > 0.29
    assert np.linalg.norm(sim.body_forces, axis=1).max() > 0.0
    assert sim.penetration_depth() < 3e-3
    sim.remove("ball")
    assert sim.body_forces.shape == (0, 3)
    sim.step(60)
    assert sim.positions[:, 1].max() < 0.1


def test_grippers_keep_what_stays_and_lose_what_goes():
    sim = cg.Simulation(
        cg.Scene([sheet("one", 0.5), sheet("two", 0.8)], grips=[cg.Grip(radius=0.05)] * 2, self_collision=False),
        FIDELITY,
    )
    for grip, vertex in ((0, 0), (1, 49)):
        sim.place_grip(grip, sim.positions[vertex])
        assert sim.grasp(grip) > 0
    before = sim.positions[sim.held(1)].copy()
    sim.step(3)
    sim.remove("one")
    assert len(sim.held(0)) == 0 and len(sim.held(1)) == len(before)
    assert sim.held(1).max() < 49
    sim.step(20)
    assert np.linalg.norm(sim.positions[sim.held(1)] - before, axis=1).max() < 0.02, "still held"


def test_the_changed_simulation_is_reset_copied_and_repeated():
    import copy

    sim = running(sheet("low", 0.05))
    sim.add(sheet("high", 0.2))
    twin = copy.deepcopy(sim)
    for each in (sim, twin):
        each.step(5)
    assert sim.state_hash() == twin.state_hash()
    sim.reset()
    assert (sim.positions == sim.scene.start).all() and len(sim.positions) == 98


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda s: s.add("sheet"), "add: expected a Cloth or a Body, got str"),
        (lambda s: s.add(sheet("low", 1.0)), "name = 'low': the scene has something of that name"),
        (lambda s: s.remove("none"), "name = 'none': the scene has 0 things"),
        (lambda s: s.remove("low"), "name = 'low': a scene needs at least one cloth"),
    ],
)
def test_mistakes_are_one_line_and_change_nothing(act, message):
    sim = running(sheet("low", 0.05))
    before = sim.state_hash()
    with pytest.raises(ValueError, match=message):
        act(sim)
    assert sim.state_hash() == before
