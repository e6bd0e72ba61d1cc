"""Scripted policies of the dressing tasks do what they claim."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from clothgym_envs import policies
from clothgym_envs.dress_policies import Axis, AxisForceLimit, CrossEntropy, Straight

RING = "clothgym/DressRing-v0"
SEEDS = range(10_000, 10_008)


@pytest.fixture(scope="module")
def env():
    return gym.make(RING).unwrapped


def play(env, policy, seed: int, steps: int = 60) -> tuple[dict, list[float]]:
    observation, info = env.reset(seed=seed)
    policy.reset(env)
    rewards = []
    for _ in range(steps):
        observation, reward, terminated, truncated, info = env.step(policy.act(observation, info))
        rewards.append(reward)
        if terminated or truncated:
            break
    return info, rewards


def test_names_of_the_task():
    assert policies.names(RING) == ("zero", "random", "straight", "axis", "axis_force_limit", "cem")
    for name, kind in (
        ("straight", Straight),
        ("axis", Axis),
        ("axis_force_limit", AxisForceLimit),
        ("cem", CrossEntropy),
    ):
        assert type(policies.get(RING, name)) is kind


def test_along_the_axis_it_works_and_straight_it_does_not(env):
    successes = {}
    for name in ("straight", "axis", "axis_force_limit", "zero", "random"):
        told = [play(env, policies.get(RING, name), seed)[0] for seed in SEEDS]
        successes[name] = sum(info["is_success"] for info in told)
        if name.startswith("axis"):
            assert not any(info["tunnelled"] for info in told)
    assert successes["axis"] == successes["axis_force_limit"] == len(SEEDS)
    assert successes["straight"] <= 0.7 * len(SEEDS)
    assert successes["zero"] == successes["random"] == 0


@pytest.mark.parametrize("fidelity", ["balanced", "accurate"])
def test_along_the_axis_at_other_fidelities(fidelity):
    assert play(gym.make(RING, fidelity=fidelity).unwrapped, Axis(), 10_001)[0]["is_success"]


@pytest.mark.parametrize(("level", "ease"), [("medium", 0.5), ("hard", 2.0 / 9.0)])
def test_along_the_axis_at_other_levels(level, ease):
    env, succeeded = gym.make(RING, level=level).unwrapped, 0
    for seed in range(10_000, 10_004):
        info, _ = play(env, Axis(), seed)
        succeeded += info["is_success"]
        assert not info["tunnelled"]
    assert succeeded >= (3 if level == "medium" else 1)


def test_straight_heads_for_the_goal(env):
    _, info = env.reset(seed=1)
    policy = Straight()
    policy.reset(env)
    action = policy.act(None, info).astype(float)
    way = policy.goal - env.openings[0].centroid
    assert np.abs(action).max() == pytest.approx(1.0)
    assert np.cross(action, way) == pytest.approx(0.0, abs=1e-6)
    assert env.limb.closest(policy.goal)[1][0] > env.wanted


def test_the_axis_policy_keeps_to_the_path(env):
    for seed in SEEDS:
        _, info = env.reset(seed=seed)
        policy = Axis()
        policy.reset(env)
        while not (info["is_success"] or env.steps == env.horizon):
            _, _, _, _, info = env.step(policy.act(None, info))
            if info["threaded"] == 1:
                room = env.openings[0].mean_radius - env.limb.radius
                assert info["offset"] < room


def test_beside_the_limb_the_axis_policy_goes_out_to_the_front(env):
    env.reset(seed=1)
    beside = env.limb.at(0.1)[0] + np.array([0.0, 0.0, 0.2]) - env.openings[0].centroid
    env.simulation.set_positions(np.array(env.simulation.positions) + beside)
    env._measure()
    policy = Axis()
    policy.reset(env)
    outwards = env.limb.tip - env.limb.points[0]
    assert policy.act(None, {}) @ outwards > 0.9 * np.linalg.norm(policy.act(None, {})) * np.linalg.norm(outwards)


def test_force_slows_the_careful_one(env):
    env.reset(seed=1)
    careful, quick = AxisForceLimit(), Axis()
    careful.reset(env)
    quick.reset(env)
    ways = [np.linalg.norm(careful.wanted({"force_max": force})) for force in (0.0, 2.5, 5.0, 50.0)]
    full = np.linalg.norm(quick.wanted({"force_max": 50.0}))
    assert ways == pytest.approx([full, 0.5 * full, 0.0, 0.0])


# planning


def test_the_plan_foretells_the_episode(env):
    """What a rollout promises is what the environment then does, to the bit."""
    _, info = env.reset(seed=7)
    for action in np.random.default_rng(0).uniform(-1.0, 1.0, (3, 3)):
        _, _, _, _, info = env.step(action)
    planner = CrossEntropy()
    planner.reset(env)
    correction = np.array([0.2, -0.1, 0.3])
    promised = planner.value(env.get_state(), info, correction)
    hand, total = Axis(), 0.0
    hand.reset(env)
    for _ in range(planner.depth):
        _, reward, _, _, info = env.step(planner._corrected(hand.act(None, info), correction))
        total += reward
    assert promised == total
    assert planner.twin.simulation.state_hash() == env.simulation.state_hash()


def test_the_planner_is_never_worse_than_no_correction(env, monkeypatch):
    values: list[float] = []
    rollout = CrossEntropy.value

    def listening(self, *given):
        values.append(rollout(self, *given))
        return values[-1]

    monkeypatch.setattr(CrossEntropy, "value", listening)
    _, info = env.reset(seed=8)
    planner = CrossEntropy()
    planner.reset(env)
    state = env.get_state()
    best = planner.plan(info)
    assert planner.rollouts == len(values) == planner.iterations * planner.candidates
    assert values[0] == rollout(planner, state, info, np.zeros(3))
    assert rollout(planner, state, info, best) == max(values) >= values[0]
    assert len(set(values)) > 3, "different corrections are tried"


def test_the_planner_dresses(env):
    info, rewards = play(env, CrossEntropy(), 10_000)
    assert info["is_success"]
    assert sum(rewards) > sum(play(env, Axis(), 10_000)[1]) - 0.5
