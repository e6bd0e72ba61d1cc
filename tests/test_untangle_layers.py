"""UntangleLayers: what counts as a success, its starts, and what its grippers read."""

from __future__ import annotations

import numpy as np
import pytest
from clothgym_envs import untangle_layers
from clothgym_envs.base import ClothEnv
from env_cases import LAYERS, LEVELS, in_contact, shared

import clothgym as cg


@pytest.fixture
def layers() -> ClothEnv:
    return shared(LAYERS)


def test_named_values_are_true(layers):
    in_contact(layers, seed=4)  # lengths above twice the first one are cut off
    observation, _, _, _, info = layers.step(np.full(8, 0.1, np.float32))
    sim = layers.simulation

    def seen(name: str) -> np.ndarray:
        field = layers.obs_layout[name]
        return observation[field.slice].astype(float) * field.scale

    for g in range(2):
        assert seen(f"gripper_{g}/position") == pytest.approx(sim.grip_positions[g], abs=1e-6)
        assert seen(f"gripper_{g}/force") == pytest.approx(sim.grip_forces[g], abs=1e-6), "up to the slip force"
        assert seen(f"gripper_{g}/holding")[0] == float(len(sim.held(g)) > 0)
    assert seen("gripper_0/velocity") == pytest.approx([0.025, 0.025, 0.025], abs=1e-6)
    assert seen("length")[0] == pytest.approx(sim.last_intersections.length / layers._start_length, rel=1e-5)
    assert seen("max_strain")[0] == pytest.approx(info["max_strain"], abs=1e-6)
    middle = sim.positions[layers._ranges[1]].mean(axis=0)
    assert seen("centroids")[3:6] == pytest.approx(middle, abs=1e-6)
    assert seen("time_left")[0] == pytest.approx(1.0 - 9 / layers.horizon)
    assert seen("contour_0/length")[0] == pytest.approx(
        layers.longest_contours()[0]["length"] / layers._start_length, rel=1e-5
    )


def settled(env: ClothEnv, positions: np.ndarray, steps: int, monkeypatch=None) -> dict:
    """Puts the cloth somewhere and waits; with monkeypatch nothing moves meanwhile."""
    env.simulation.set_positions(positions)
    if monkeypatch is not None:
        monkeypatch.setattr(env, "_act", lambda action: None)
    for _ in range(steps):
        _, _, terminated, _, info = env.step(np.zeros(8))
        if terminated:
            break
    return info


def test_the_clean_stack_is_a_success(layers):
    layers.reset(seed=1)
    info = settled(layers, layers._clean, 12)
    assert info["is_success"]
    assert info["progress"] == 1.0
    assert info["clean_steps"] == 10
    assert info["reward/success"] == 5.0


def test_the_wrong_order_is_no_success(layers):
    layers.reset(seed=1)
    swapped = layers._clean.copy()
    swapped[layers._ranges[0], 1] += 0.03  # the lower sheet is on top now
    swapped[layers._ranges[1], 1] -= 0.01
    info = settled(layers, swapped, 14)
    assert info["hits"] == 0
    assert info["clean_steps"] == 14
    assert info["side_error"] > 0.5
    assert not info["is_success"]
    assert info["progress"] < 0.5


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.3, 1.3])
def test_a_crushed_or_stretched_sheet_is_no_success(layers, size, monkeypatch):
    layers.reset(seed=1)
    positions, sheet = layers._clean.copy(), layers._ranges[1]
    middle = positions[sheet].mean(axis=0)
    positions[sheet] = middle + [0.0, 0.05, 0.0] + size * (positions[sheet] - middle)
    info = settled(layers, positions, 14, monkeypatch)
    assert info["hits"] == 0
    assert info["side_error"] == 0.0
    assert not info["is_success"]
    assert info["clean_steps"] == 0


def test_a_pinched_contour_is_no_success(layers, monkeypatch):
    _, start = layers.reset(seed=1)
    hits = layers.simulation.last_intersections
    around = np.unique(
        np.concatenate([hits.surface.edges[hits.hit_edge].ravel(), hits.surface.faces[hits.hit_face].ravel()])
    )
    positions = np.array(layers.simulation.positions)
    positions[around] = positions[around].mean(axis=0) + 1e-4 * (positions[around] - positions[around].mean(axis=0))
    info = settled(layers, positions, 14, monkeypatch)
    assert info["contour_length"] < 1e-3 * start["contour_length"], "the length alone can be pinched away"
    assert not info["is_success"]


def test_doing_nothing_untangles_nothing(layers):
    for seed in range(20_000, 20_010):
        _, start = layers.reset(seed=seed)
        for _ in range(15):
            _, _, terminated, _, info = layers.step(np.zeros(8))
            assert not terminated
            assert info["hits"] > 0
        assert info["contour_length"] > 0.7 * start["contour_length"]


@pytest.mark.parametrize("level", LEVELS)
def test_every_start_is_tangled_and_known(level):
    env = shared(LAYERS, level)
    for seed in range(4):
        _, info = env.reset(seed=seed)
        assert info["contour_length"] > 2.0 * env.edge
        assert info["side_error"] > 0.01
        assert not info["is_success"]
        assert cg.intersections(env._clean, env.simulation.faces).hit_count == 0
        assert env._start_length == pytest.approx(info["contour_length"])


def test_wrong_vertices_are_those_that_went_through(layers):
    layers.reset(seed=1)
    below, above = layers.wrong_vertices(0, 1)
    first, second = layers._ranges
    assert ((below >= first.start) & (below < first.stop)).all()
    assert ((above >= second.start) & (above < second.stop)).all()
    moved = np.abs(np.array(layers.simulation.positions) - layers._clean)[:, 1]
    assert moved[above].min() > 0.1 * moved.max(), "none of them was left where it was"
    assert len(above) > 3


def test_a_gripper_reads_the_weight_it_carries(layers, monkeypatch):
    monkeypatch.setattr(untangle_layers, "CLEAN_STEPS", 1000)  # the episode goes on
    layers.reset(seed=1)
    sim, sheet = layers.simulation, layers._ranges[1]
    positions = layers._clean.copy()
    positions[sheet, 1] += 0.45
    sim.set_positions(positions)
    centre = sheet.start + 7 * 15 + 7
    sim.place_grip(0, positions[centre])
    action = np.array([0, 0, 0, 1, 0, 0, 0, -1], float)
    read = []
    for _ in range(95):
        observation, _, terminated, truncated, info = layers.step(action)
        assert not (terminated or truncated)
        field = layers.obs_layout["gripper_0/force"]
        read.append(observation[field.slice] * field.scale)
    assert sim.positions[sheet, 1].min() > 0.05, "it hangs free"
    weight = 9.81 * sim.model.masses[sheet].sum()
    mean = np.mean(read[-20:], axis=0)
    assert mean[1] == pytest.approx(weight, rel=0.01)
    assert np.abs(mean[[0, 2]]).max() < 0.01 * weight
    assert info["force_max"] == pytest.approx(weight, rel=0.02)


def test_grippers_stay_in_their_workspace(layers):
    layers.reset(seed=1)
    for _ in range(6):
        layers.step(np.array([0, -1, 0, -1, 0, -1, 0, -1]))
    for _ in range(6):
        layers.step(np.array([0, -1, 0, -1, 0, -1, 0, -1]))
    assert layers.gripper_positions[:, 1] == pytest.approx([0.004, 0.004])
