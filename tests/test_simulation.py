"""The simulation as a whole: determinism, snapshots, looking, and divergence."""

from __future__ import annotations

import copy
import dataclasses
import json
import pickle

import numpy as np
import pytest
from small_scenes import CONTACT, pile, tangle

import clothgym as cg


def in_contact() -> cg.Simulation:
    sim = cg.Simulation(pile(), CONTACT)
    sim.step(6)
    assert sim.metrics()["work"]["contacts"] > 100
    return sim


# ---------------------------------------------------------------------------------------------------------------
# determinism, reset, snapshots, copies


@pytest.mark.parametrize("make", [pile, tangle, lambda: cg.scenes.make("hanging_sheet", resolution=6)])
def test_same_calls_give_the_same_bits(make):
    hashes = []
    for _ in range(2):
        sim = cg.Simulation(make(), cg.Fidelity(substeps=4))
        sim.reset(seed=3)
        sim.step(8)
        hashes.append(sim.state_hash())
    assert hashes[0] == hashes[1]
    sim.step()
    assert sim.state_hash() != hashes[0]


def test_the_hash_sees_every_part_of_the_state():
    sim = cg.Simulation(pile(grips=[cg.Grip()]), CONTACT)
    changes = [
        lambda s: s.positions.__setitem__((0, 0), np.nextafter(s.positions[0, 0], 9.0)),
        lambda s: s.velocities.__setitem__((3, 2), 1e-300),
        lambda s: setattr(s, "time", 1e-9), lambda s: setattr(s, "step", 1),
        lambda s: s.grip_positions.__setitem__((0, 0), 1e-9), lambda s: s.grip_velocities.__setitem__((0, 1), 1e-9),
        lambda s: (setattr(s, "held_vertices", np.array([4], np.int32)), setattr(s, "held_by", np.zeros(1, np.int32)),
                   setattr(s, "held_offsets", np.zeros((1, 3)))),
    ]  # fmt: skip
    hashes = {sim.state_hash()}
    for change in changes:
        state = sim.snapshot()
        change(state)
        hashes.add(state.hash())
    assert len(hashes) == len(changes) + 1
    held = []
    for offset in (0.0, 1e-9):
        state = sim.snapshot()
        state.held_vertices, state.held_by = np.array([4], np.int32), np.zeros(1, np.int32)
        state.held_offsets = np.full((1, 3), offset)
        held.append(state.hash())
    assert held[0] != held[1]


def test_twenty_resets_are_one_reset():
    sim = cg.Simulation(tangle(), cg.Fidelity(substeps=4))
    fresh = sim.state_hash()
    sim.step(5)
    after = sim.state_hash()
    work = sim.metrics()["work"]
    for number in range(20):
        sim.reset(seed=number)
        assert sim.state_hash() == fresh
        assert sim.metrics()["work"] == {} and sim.metrics()["untangling_passes"] == 0
        assert all(calls == 0 and seconds == 0.0 for calls, seconds in sim.profile.values())
    sim.step(5)
    assert sim.state_hash() == after
    assert sim.metrics()["work"] == work


@pytest.mark.parametrize("grips", [0, 1])
def test_snapshot_and_restore_in_the_middle_of_contact(grips):
    sim = cg.Simulation(pile(grips=[cg.Grip()] * grips), CONTACT)
    if grips:
        sim.place_grip(0, sim.positions[60])
        assert sim.grasp(0, [60, 61]) == 2
        sim.move_grip(0, (0.0, 0.2, 0.1))
    sim.step(6)
    snapshot, at = sim.snapshot(), sim.state_hash()
    sim.step(6)
    after = sim.state_hash()
    assert snapshot.hash() == at, "the snapshot moved along"
    sim.restore(snapshot)
    assert (sim.state_hash(), sim.step_count) == (at, 6)
    sim.step(6)
    assert sim.state_hash() == after
    other = cg.Simulation(sim.scene, sim.fidelity)
    other.step(2)
    other.restore(snapshot)
    other.step(6)
    assert other.state_hash() == after, "something outside the state takes part in a step"
    assert snapshot.hash() == at


def test_snapshots_of_other_scenes_are_refused():
    sim = cg.Simulation(pile(), CONTACT)
    with pytest.raises(ValueError, match="snapshot"):
        sim.restore(cg.Simulation(pile(2), CONTACT).snapshot())
    with pytest.raises(ValueError, match="snapshot"):
        cg.Simulation(pile(grips=[cg.Grip()]), CONTACT).restore(sim.snapshot())


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))])
def test_copies_go_on_alike_and_apart(copied):
    sim = in_contact()
    twin = copied(sim)
    assert twin.state_hash() == sim.state_hash()
    assert twin.metrics() == sim.metrics()
    before = sim.state_hash()
    twin.step(4)
    assert sim.state_hash() == before
    sim.step(4)
    assert sim.state_hash() == twin.state_hash()


def test_looking_changes_nothing():
    blind, seen = cg.Simulation(tangle(), cg.Fidelity(substeps=4)), cg.Simulation(tangle(), cg.Fidelity(substeps=4))
    for _ in range(6):
        blind.step()
        seen.step()
        seen.metrics()
        _ = seen.last_intersections.gradient(), seen.last_intersections.contours, seen.profile, seen.pipeline.describe()
        seen.snapshot()
    assert blind.state_hash() == seen.state_hash()
    assert blind.metrics() == seen.metrics()


def test_last_intersections_follow_the_state():
    sim = cg.Simulation(tangle(), cg.Fidelity(substeps=4))
    start = sim.snapshot()
    length = sim.metrics()["contour_length"]
    assert length == pytest.approx(cg.intersections(sim.positions, sim.faces).length)
    assert length > 0.1
    sim.set_positions(sim.positions + np.linspace(0, 9, 3).repeat(36)[:, None] * [0, 1, 0])
    assert sim.metrics()["contour_length"] == 0.0
    sim.restore(start)
    assert sim.metrics()["contour_length"] == length
    sim.step(3)
    assert sim.metrics()["contour_length"] == pytest.approx(cg.intersections(sim.positions, sim.faces).length)


# ---------------------------------------------------------------------------------------------------------------
# what can be read and set


def test_metrics_of_a_known_state():
    mesh = cg.grid(0.4, 0.4, 2, 2)
    scene = cg.Scene([cg.Cloth(mesh, cg.Material(density=0.5, stretch=100.0, shear=0.0, flexion=0.0))], name="one")
    sim = cg.Simulation(scene, CONTACT)
    sim.set_positions(mesh.vertices * [1.1, 1, 1] + [0, 2.0, 0])
    sim.set_velocities(np.tile([0.0, 3.0, 4.0], (9, 1)))
    found = sim.metrics()
    assert found["max_strain"] == pytest.approx(0.1)
    assert found["kinetic_energy"] == pytest.approx(0.5 * 0.08 * 25.0)
    assert found["potential_energy"] == pytest.approx(0.08 * 9.81 * 2.0 + 6 * 0.5 * 100.0 * 0.02**2)
    assert found["max_speed"] == pytest.approx(5.0)
    assert (found["time"], found["contour_length"], found["hits"], found["penetration_depth"]) == (0.0, 0.0, 0, 0.0)
    for name in ("contour_count", "untangling_passes", "work"):
        assert name in found
    json.dumps(found)


def test_energy_of_an_undamped_swing_is_kept():
    scene = cg.scenes.make("hanging_sheet", resolution=6)
    cloth = dataclasses.replace(
        scene.cloths[0], material=cg.Material(stretch=200.0, shear=50.0, flexion=0.0, damping=0.0)
    )
    sim = cg.Simulation(
        dataclasses.replace(scene, cloths=[cloth]), cg.Fidelity(integrator="symplectic_euler", substeps=400)
    )

    def energy():
        found = sim.metrics()
        return found["kinetic_energy"] + found["potential_energy"]

    start = energy()
    sim.step(25)
    assert sim.metrics()["kinetic_energy"] > 0.1
    assert energy() == pytest.approx(start, abs=0.01 * sim.metrics()["kinetic_energy"])


def test_views_cannot_be_written():
    sim = cg.Simulation(pile(grips=[cg.Grip()]), CONTACT)
    for view in (sim.positions, sim.velocities, sim.faces, sim.grip_positions, sim.grip_forces):
        with pytest.raises(ValueError, match="read-only"):
            view[0] = 1.0
    assert sim.positions.shape == sim.velocities.shape == (75, 3)


def test_set_positions_copies_and_checks():
    sim = cg.Simulation(pile(), CONTACT)
    wanted = sim.positions + 0.5
    sim.set_positions(wanted)
    assert (sim.positions == wanted).all()
    wanted[0] = 9.0
    assert sim.positions[0, 0] != 9.0
    bad = np.zeros((75, 3))
    bad[7, 2] = np.inf
    for setter, name in ((sim.set_positions, "positions"), (sim.set_velocities, "velocities")):
        before = sim.state_hash()
        for values, message in (
            (np.zeros((74, 3)), f"{name}: expected 75 rows, got 74"),
            (np.zeros((75, 2)), f"{name}: expected shape"),
            (bad, rf"{name}\[7, 2\] is inf"),
        ):
            with pytest.raises(ValueError, match=message):
                setter(values)
        assert sim.state_hash() == before
    sim.set_positions(np.asarray(sim.positions, np.float32).tolist())
    assert sim.positions.dtype == np.float64


def test_time_steps_and_profile():
    sim = in_contact()
    assert (sim.step_count, sim.time) == (6, pytest.approx(0.06))
    names = [stage.name for stage in sim.pipeline.stages]
    assert set(names) <= set(sim.profile)
    calm = 0
    for stage in sim.pipeline.stages:
        calls, seconds = sim.profile[stage.name]
        if getattr(stage, "of_pairs", False):
            calm = calm or 6 - calls
            calls += calm
        assert calls == 6 and seconds > 0
    assert 0 < calm < sim.metrics()["work"]["decided_flat"]  # the first decided step runs all stages
    parts = [key for key in sim.profile if key not in names]
    assert len(parts) >= 5
    assert sum(sim.profile[part][1] for part in parts) <= 1.01 * sim.profile[names[-1]][1]
    sim.step(0)
    assert sim.step_count == 6


# ---------------------------------------------------------------------------------------------------------------
# divergence


def test_divergence_keeps_the_last_finite_state():
    sim = in_contact()
    before = sim.snapshot()
    sim.set_velocities(np.full((75, 3), 1e8))
    set_to = sim.state_hash()
    with pytest.raises(cg.SimulationError, match="speed") as error:
        sim.step()
    assert isinstance(error.value, RuntimeError)
    assert error.value.time == pytest.approx(0.06)
    for part in (error.value.stage, error.value.quantity, "substeps"):
        assert part in str(error.value)
    assert sim.state_hash() == set_to and sim.step_count == 6
    sim.restore(before)
    sim.step(2)
    again = cg.Simulation(sim.scene, sim.fidelity)
    again.restore(before)
    again.step(2)
    assert sim.state_hash() == again.state_hash(), "a diverged step left something behind"
