"""Scripted policies: they act within bounds, change nothing by thinking, repeat themselves, and do what they claim."""

from __future__ import annotations

from functools import cache

import clothgym_envs
import gymnasium as gym
import numpy as np
import pytest
from clothgym_envs import dress_policies, policies
from clothgym_envs.planning import CrossEntropy
from clothgym_envs.policies import Gradient, Pull, PullApart, Puller

LAYERS = "clothgym/UntangleLayers-v0"


CASES = [(env_id, name) for env_id in clothgym_envs.ENVIRONMENTS for name in policies.names(env_id)]


@cache
def shared(env_id: str):
    """One environment for all tests of a task."""
    return gym.make(env_id).unwrapped


@pytest.fixture
def env():
    return shared(LAYERS)


@pytest.fixture
def brief(monkeypatch):
    """Planners that try little."""
    for name, value in (("candidates", 2), ("iterations", 2), ("elites", 2), ("depth", 4)):
        monkeypatch.setattr(CrossEntropy, name, value)
        monkeypatch.setattr(dress_policies.CrossEntropy, name, value)


def play(env, policy, seed: int, steps: int) -> tuple[list[bytes], dict]:
    observation, info = env.reset(seed=seed)
    policy.reset(env)
    actions = []
    for _ in range(steps):
        action = policy.act(observation, info)
        actions.append(action.tobytes())
        observation, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            break
    return actions, info


def test_every_environment_has_opponents():
    for env_id in clothgym_envs.ENVIRONMENTS:
        names = policies.names(env_id)
        assert {"zero", "random"} <= set(names)
        assert len(names) > 2
        assert policies.names(f"clothgym_envs:{env_id}") == names


def test_unknown_names_are_told():
    with pytest.raises(ValueError, match="policy = 'best': expected one of zero, random, pull_apart"):
        policies.get(LAYERS, "best")
    with pytest.raises(ValueError, match="ENV = 'CartPole-v1'"):
        policies.get("CartPole-v1", "zero")


@pytest.mark.parametrize(("env_id", "name"), CASES)
def test_actions_are_legal_and_thinking_changes_nothing(env_id, name, brief):
    env, policy = shared(env_id), policies.get(env_id, name)
    observation, info = env.reset(seed=3)
    policy.reset(env)
    for _ in range(5):
        before = env.simulation.state_hash(), env.steps, env.simulation.grip_forces.copy()
        action = policy.act(observation, info)
        assert (env.simulation.state_hash(), env.steps) == before[:2]
        assert (env.simulation.grip_forces == before[2]).all()
        assert action.dtype == np.float32
        assert env.action_space.contains(action)
        observation, _, _, _, info = env.step(action)


@pytest.mark.parametrize(("env_id", "name"), CASES)
def test_an_episode_repeats_itself(env_id, name, brief):
    env, policy = shared(env_id), policies.get(env_id, name)
    first = play(env, policy, 3, 6)
    play(env, policy, 4, 3)
    assert play(env, policy, 3, 6) == first, "whatever the policy did before"
    assert play(env, policies.get(env_id, name), 3, 6) == first


def test_random_differs_between_episodes(env):
    policy = policies.get(LAYERS, "random")
    assert play(env, policy, 3, 2)[0] != play(env, policy, 4, 2)[0]


def test_zero_does_nothing(env):
    actions, _ = play(env, policies.get(LAYERS, "zero"), 3, 2)
    assert actions[0] == np.zeros(8, np.float32).tobytes()


# hands


def test_a_pull_is_carried_out(env):
    _, info = env.reset(seed=1)
    hand = Puller()
    hand.reset(env)
    lower, upper = env.free_vertices
    vertices = [int(upper[20]), int(lower[-20])]
    hand.pull = Pull(
        list(vertices), np.array([[[0.0, 0.05, 0.0], [0.0, 0.03, 0.0]], [[0.02, 0.05, 0.0], [0.0, 0.03, 0.0]]])
    )
    closed, highest = None, np.zeros(2)
    for _ in range(40):
        action = hand.act(None, info) if closed is None or hand.pull is not None else None
        if action is None:
            break
        _, _, _, _, info = env.step(action)
        if closed is None and len(env.simulation.held(0)):
            closed = env.gripper_positions.copy()
            assert vertices[0] in env.simulation.held(0)
            assert vertices[1] in env.simulation.held(1)
        if closed is not None and hand.pull is not None:
            highest = np.maximum(highest, env.gripper_positions[:, 1] - closed[:, 1])
    assert closed is not None
    assert highest == pytest.approx([0.05, 0.03], abs=0.013)
    assert len(env.simulation.held(0)) == 0, "opens at the end"


def test_a_pull_out_of_reach_is_given_up(env):
    env.reset(seed=1)
    hand = Puller()
    hand.reset(env)
    hand.pull = Pull([0, 1], np.zeros((1, 2, 3)), left=2)
    for _ in range(2):
        assert hand.follow(hand.pull)[3] == -1.0
        assert hand.pull is not None
    hand.follow(hand.pull)
    assert hand.pull is None


def test_pull_apart_takes_the_buried_part_and_holds_what_lies_on_it(env):
    for seed in range(5):
        _, info = env.reset(seed=seed)
        policy = PullApart()
        policy.reset(env)
        pull = policy.choose(info)
        on_top, buried = env.wrong_vertices(0, 1)
        lifting = int(np.argmax(pull.paths[0, :, 1]))
        assert pull.vertices[lifting] in buried
        assert pull.vertices[1 - lifting] in on_top
        assert pull.paths[0, lifting, 1] == PullApart.lift
        assert pull.paths[0, 1 - lifting, 1] < 0.0
        points = env.longest_contours()[0]["points"]
        near = np.linalg.norm(points - env.simulation.positions[pull.vertices[lifting]], axis=1).min()
        assert near < PullApart.beside * env.edge


def test_gradient_takes_the_steepest_vertices(env):
    _, info = env.reset(seed=2)
    policy = Gradient()
    policy.reset(env)
    pull = policy.choose(info)
    gradient = env.simulation.last_intersections.gradient()
    size = np.linalg.norm(gradient, axis=1) * (env.simulation.model.inverse_masses > 0)
    assert pull.vertices[0] == np.argmax(size)
    x = env.simulation.positions
    assert np.linalg.norm(x[pull.vertices[0]] - x[pull.vertices[1]]) >= Gradient.apart
    for vertex, step in zip(pull.vertices, pull.paths[0]):
        assert gradient[vertex] @ step == pytest.approx(-Gradient.reach * size[vertex])


@pytest.mark.parametrize("seed", [1, 2])
def test_pull_apart_untangles(env, seed):
    actions, info = play(env, PullApart(), seed, env.horizon)
    assert info["is_success"]
    assert info["max_strain"] < 0.15
    assert len(actions) < env.horizon


@pytest.mark.parametrize("level", ["medium", "hard"])
def test_pull_apart_makes_way_with_more_sheets(level):
    env = gym.make(LAYERS, level=level, vertices=9).unwrapped
    _, start = env.reset(seed=1)
    _, info = play(env, PullApart(), 1, 30)
    assert info["side_error"] < start["side_error"]


def test_clean_cloth_is_left_alone(env):
    _, info = env.reset(seed=1)
    env.simulation.set_positions(env._clean)
    _, _, _, _, info = env.step(np.zeros(8))
    for policy in (PullApart(), Gradient(), CrossEntropy()):
        policy.reset(env)
        action = policy.act(None, info)
        assert (action.reshape(2, 4) == [0, 0, 0, -1]).all()


# planning


def test_the_plan_foretells_the_episode(env):
    """What a rollout promises is what the environment then does, to the bit."""
    _, info = env.reset(seed=7)
    for action in np.random.default_rng(0).uniform(-1, 1, (3, 8)):
        _, _, _, _, info = env.step(action)
    planner = CrossEntropy()
    planner.reset(env)
    scripted = PullApart()
    scripted.reset(env)
    pull = scripted.choose(info)
    planner.depth = 12
    promised = planner._value(env.get_state(), pull)
    hand = Puller()
    hand.reset(env)
    hand.pull = pull
    total = 0.0
    for _ in range(planner.depth):
        _, reward, _, _, _ = env.step(hand.follow(hand.pull))
        total += reward - planner.step_cost
    assert promised == total
    assert planner.twin.simulation.state_hash() == env.simulation.state_hash()


def test_the_planner_is_never_worse_than_its_first_guess(env, monkeypatch):
    for name, value in (("candidates", 3), ("iterations", 2), ("depth", 20)):
        monkeypatch.setattr(CrossEntropy, name, value)
    values: list[float] = []
    rollout = CrossEntropy._value

    def listening(self, state, pull):
        values.append(rollout(self, state, pull))
        return values[-1]

    monkeypatch.setattr(CrossEntropy, "_value", listening)
    _, info = env.reset(seed=8)
    planner = CrossEntropy()
    planner.reset(env)
    state = env.get_state()
    pull = planner.choose(info)
    assert planner.rollouts == len(values) == 6
    assert rollout(planner, state, pull) == max(values) >= values[0]
    assert len(set(values)) > 3, "different pulls are tried"
