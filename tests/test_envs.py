"""Both environments: the interface, actions, reproducibility, reward and end, pictures."""

from __future__ import annotations

import contextlib
import copy
import math
import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
from clothgym_envs import policies
from clothgym_envs.base import SPEED_CAP, STRAIN_CAP, TRAIN_SEEDS, ClothEnv
from env_cases import IDS, LAYERS, LEVELS, RING, SMALL, bits, id_of, in_contact, play, random_actions, shared
from gymnasium.utils.env_checker import check_env

import clothgym as cg

NEARLY = {LAYERS: ("pull_apart", "clean_steps", 3, 7), RING: ("axis", "dressed_steps", 3, 2)}
"""A policy that succeeds, the counter of good steps on end, how many are reached, and how many are missing then."""
ALWAYS = {
    "is_success": bool,
    "progress": float,
    "contour_length": float,
    "contour_count": int,
    "max_strain": float,
    "penetration_depth": float,
    "force_max": float,
    "failure": int,
}


def kinds_of(env_id: str) -> list[str]:
    """The kinds of observation that a task offers."""
    offered = []
    for kind in ("state", "points", "depth"):
        with contextlib.suppress(ValueError):
            gym.make(env_id, obs=kind).close()
            offered.append(kind)
    assert "state" in offered
    return offered


CASES = [(env_id, level, obs) for env_id in IDS for level in LEVELS for obs in kinds_of(env_id)]


@pytest.fixture(params=IDS)
def env(request) -> ClothEnv:
    return shared(request.param)


@pytest.fixture(scope="session", params=IDS)
def idle(request) -> tuple[ClothEnv, list[tuple]]:
    """An episode in which nothing is done: its first answer (observation, info), then those of every step."""
    env = gym.make(request.param).unwrapped
    answers = [env.reset(seed=4)]
    while True:
        answers.append(env.step(np.zeros(env.action_space.shape, np.float32)))
        if answers[-1][2] or answers[-1][3]:
            return env, answers


def begin(env: ClothEnv, seed: int) -> tuple:
    observation, info = env.reset(seed=seed)
    return observation.tobytes(), bits(info), env.simulation.state_hash()


# the interface


@pytest.mark.parametrize(("env_id", "level", "obs"), CASES)
def test_checker_of_gymnasium(env_id, level, obs):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(shared(env_id, level, obs), skip_render_check=level != "easy")


@pytest.mark.parametrize(("env_id", "level", "obs"), CASES)
def test_checker_of_stable_baselines(env_id, level, obs):
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(shared(env_id, level, obs))


@pytest.mark.parametrize(("env_id", "level", "obs"), CASES)
def test_spaces_are_finite_boxes(env_id, level, obs):
    env = shared(env_id, level, obs)
    assert np.isfinite(env.observation_space.low).all()
    assert np.isfinite(env.observation_space.high).all()
    assert env.observation_space.dtype == np.float32
    assert (env.action_space.low == -1.0).all()
    assert (env.action_space.high == 1.0).all()


@pytest.mark.parametrize(("env_id", "level", "obs"), CASES)
def test_plain_types_and_the_same_info_at_every_step(env_id, level, obs):
    env = shared(env_id, level, obs)
    observation, first = env.reset(seed=1)
    types = {name: type(value) for name, value in first.items()}
    assert {name: types.get(name) for name in ALWAYS} == ALWAYS
    assert types["episode_seed"] is int
    assert any(name.startswith("reward/") for name in types)
    for action in random_actions(env, 4):
        observation, reward, terminated, truncated, info = env.step(action)
        assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)
        assert {name: type(value) for name, value in info.items()} == types
        assert all(math.isfinite(value) for value in info.values())
        assert 0.0 <= info["progress"] <= 1.0
        assert env.observation_space.contains(observation)


def test_what_is_unknown_is_refused():
    for env_id in IDS:
        for wrong, text in (
            ({"level": "extreme"}, "level = 'extreme'"),
            ({"obs": "pixels"}, "obs = 'pixels'"),
            ({"fidelity": "best"}, "fidelity = 'best'"),
            ({"render_mode": "human_eye"}, "render_mode = 'human_eye'"),
        ):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # gymnasium warns of the render mode as well
                with pytest.raises(ValueError, match=text):
                    gym.make(env_id, **wrong)
    with pytest.raises(ValueError, match="vertices = 3: out of range"):
        gym.make(LAYERS, vertices=3)


def test_options_are_checked(env):
    with pytest.raises(ValueError, match="options\\['wind'\\]"):
        env.reset(seed=0, options={"wind": 3})
    env.reset(seed=0, options={})


@pytest.mark.parametrize("env_id", IDS)
def test_a_fidelity_of_ones_own(env_id):
    rough = cg.Fidelity(substeps=2, sweeps=2)
    env = gym.make(env_id, fidelity=rough, **SMALL[env_id]).unwrapped
    env.reset(seed=0)
    assert env.simulation.pipeline.substeps == 2
    if env_id == LAYERS:
        assert env.simulation.fidelity.untangling == "none", "the hand untangles, not the simulator"


def test_names_cover_the_observation(env):
    observation, _ = env.reset(seed=2)
    covered = np.zeros(len(observation), int)
    for field in env.obs_layout.values():
        covered[field.slice] += 1
        assert field.scale > 0.0
        assert isinstance(field.unit, str)
    assert (covered == 1).all()


# actions


def test_actions_that_cannot_be_done(env):
    env.reset(seed=0)
    before = env.simulation.state_hash()
    good = np.zeros(env.action_space.shape)
    with pytest.raises(ValueError, match="expected shape"):
        env.step(good[:-1])
    with pytest.raises(ValueError, match="expected shape"):
        env.step(good[None])
    bad = good.copy()
    bad[1] = np.nan
    with pytest.raises(ValueError, match="action\\[1\\] is nan"):
        env.step(bad)
    assert env.simulation.state_hash() == before
    assert env.steps == 0


def test_actions_out_of_range_are_clipped(env):
    wild = random_actions(env, 1)[0] * 7.0
    wild[0] = np.inf
    env.reset(seed=3)
    there = play(env, wild[None])
    env.reset(seed=3)
    assert play(env, np.clip(wild, -1.0, 1.0)[None]) == there


def test_no_step_before_the_first_reset(env):
    fresh = type(env)()
    with pytest.raises(RuntimeError, match="call reset first"):
        fresh.step(np.zeros(fresh.action_space.shape))


# reproducibility


def test_same_seed_same_bits(env):
    actions = random_actions(env, 6)
    one = (begin(env, 11), play(env, actions))
    begin(env, 12)
    play(env, actions[:3])
    assert (begin(env, 11), play(env, actions)) == one
    assert begin(env, 12) != one[0]


def test_many_resets_are_as_one(env):
    fresh = type(env)()
    actions = random_actions(env, 3)
    once = begin(fresh, 21)
    for number in range(20):
        begin(env, 21 if number % 2 else 100 + number)
        if number % 5 == 0:
            play(env, actions[:1])
    assert begin(env, 21) == once
    assert play(env, actions) == play(fresh, actions)


def test_without_a_seed_an_episode_can_be_repeated(env):
    env.reset(seed=77)
    drawn = [env.reset()[1]["episode_seed"] for _ in range(5)]
    env.reset(seed=77)
    assert [env.reset()[1]["episode_seed"] for _ in range(5)] == drawn
    assert len(set(drawn)) == 5
    assert all(seed in TRAIN_SEEDS for seed in drawn)
    observation, info = env.reset()
    state = env.simulation.state_hash()
    again, _ = env.reset(seed=info["episode_seed"])
    assert env.simulation.state_hash() == state
    assert again.tobytes() == observation.tobytes()


def test_a_state_continues_to_the_bit(env):
    in_contact(env)
    actions = random_actions(env, 5, 1)
    state = env.get_state()
    onwards = play(env, actions)
    env.reset(seed=123)
    play(env, actions[:2])
    for _ in range(2):  # a state can be used more than once
        env.set_state(state)
        assert play(env, actions) == onwards


def test_a_state_half_way_to_success_continues_to_the_bit(env):
    name, counter, reached, missing = NEARLY[id_of(env)]
    observation, info = env.reset(seed=1)
    policy = policies.get(id_of(env), name)
    policy.reset(env)
    while info[counter] < reached:  # counters and potential are no longer those of the start
        observation, _, _, _, info = env.step(policy.act(observation, info))
    state, nothing = env.get_state(), np.zeros((missing, *env.action_space.shape))
    onwards = play(env, nothing)
    assert onwards[-1][2], "ends in success"
    env.reset(seed=2)
    env.set_state(state)
    assert play(env, nothing) == onwards


def test_a_state_moves_to_another_environment(env):
    in_contact(env)
    other = type(env)()
    other.reset(seed=0)
    other.set_state(env.get_state())
    assert other._info(False) == env._info(False), "what was measured in the last step comes along"
    assert (other.layout.pack(other._values()) == env.layout.pack(env._values())).all()
    actions = random_actions(env, 3, 2)
    assert play(other, actions) == play(env, actions)


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))], ids=["deepcopy", "pickle"]
)
def test_a_copy_continues_to_the_bit(env, duplicate):
    in_contact(env)
    twin = duplicate(env)
    actions = random_actions(env, 4, 3)
    assert play(twin, actions) == play(env, actions)
    assert begin(twin, 8) == begin(env, 8)
    assert twin.reset()[1]["episode_seed"] == env.reset()[1]["episode_seed"]


def test_grasps_and_contact_are_under_way_in_these_tests(env):
    in_contact(env)
    sim = env.simulation
    assert len(sim.held(0)) > 1
    assert sim.last_intersections.hit_count > 0 or np.abs(sim.body_forces).max(initial=0.0) > 0.0
    assert np.abs(sim.grip_forces).max() > 1e-3


# reward and end


def test_terms_add_up_to_the_reward(env):
    env.reset(seed=6)
    for action in random_actions(env, 5):
        _, reward, _, _, info = env.step(action)
        assert reward == pytest.approx(sum(v for name, v in info.items() if name.startswith("reward/")), abs=1e-12)


def test_time_runs_out_at_the_horizon(idle):
    env, answers = idle
    assert len(answers) == env.horizon + 1
    assert [a[2] or a[3] for a in answers[1:-1]] == [False] * (env.horizon - 1)
    assert answers[-1][2:4] == (False, True)
    assert answers[-1][4]["is_success"] is False
    with pytest.raises(RuntimeError, match="the episode is over"):
        env.step(np.zeros(env.action_space.shape))


def test_the_potential_telescopes(idle):
    env, answers = idle
    if id_of(env) == LAYERS:
        gained = sum(answer[4]["reward/length"] for answer in answers[1:])
        change = 1.0 - min(answers[-1][4]["contour_length"] / answers[0][1]["contour_length"], 1.0)
    else:
        gained = sum(answer[4]["reward/potential"] for answer in answers[1:])
        fresh = type(env)()
        fresh.reset(seed=4)
        change = env.potential - fresh.potential
    assert gained == pytest.approx(10.0 * change, abs=1e-9)


def test_no_failure_beats_doing_nothing(idle):
    env, answers = idle
    rewards = np.array([answer[1] for answer in answers[1:]])
    for failed_at in range(1, env.horizon + 1):
        floor = -(15.0 + env.worst_cost_per_step * (env.horizon - failed_at + 1))
        assert floor < rewards[failed_at - 1 :].sum(), f"failing at step {failed_at} would pay"


@pytest.mark.parametrize("kind", ["diverged", "raced", "speed", "strain"])
def test_a_failure_ends_at_the_last_good_state(env, kind, monkeypatch):
    in_contact(env)
    keys = set(env.reset(seed=5)[1])
    in_contact(env)
    before, held, forces = (
        env.simulation.state_hash(),
        env.simulation.held(0).tolist(),
        env.simulation.grip_forces.copy(),
    )
    steps, code = env.steps, {"diverged": 1, "raced": 2, "speed": 2, "strain": 3}[kind]
    step = env.simulation.step

    def breaking(*_):
        step()  # something has been simulated before it breaks
        quantity = "positions are no longer finite" if kind == "diverged" else "a speed of 2e+04 m/s passed the cap"
        raise cg.SimulationError("solve", quantity, 0.0, "")

    if kind in ("diverged", "raced"):
        monkeypatch.setattr(env.simulation, "step", breaking)
    elif kind == "speed":
        velocities = np.zeros((env.simulation.model.vertex_count, 3))
        velocities[-5:, 1] = 1e3
        monkeypatch.setattr(env, "_act", lambda action: env.simulation.set_velocities(velocities))
        assert np.abs(velocities).max() > SPEED_CAP
    else:
        points = np.array(env.simulation.positions)
        points[-1] += STRAIN_CAP
        monkeypatch.setattr(env, "_act", lambda action: env.simulation.set_positions(points))
    observation, reward, terminated, truncated, info = env.step(random_actions(env, 1)[0])
    assert (terminated, truncated) == (True, False)
    assert info["failure"] == code
    assert info["is_success"] is False
    assert reward == -(15.0 + env.worst_cost_per_step * (env.horizon - steps))
    assert reward == info["reward/failure"] == sum(v for name, v in info.items() if name.startswith("reward/"))
    assert set(info) == keys
    assert all(math.isfinite(value) for value in info.values())
    assert env.observation_space.contains(observation)
    assert env.simulation.state_hash() == before
    assert env.simulation.held(0).tolist() == held
    assert (env.simulation.grip_forces == forces).all()
    with pytest.raises(RuntimeError, match="the episode is over"):
        env.step(np.zeros(env.action_space.shape))
    monkeypatch.undo()
    assert env.reset(seed=1)[1]["failure"] == 0


def test_a_real_divergence_is_a_failure(env):
    """No fakes: a cloth that is shot away."""
    env.reset(seed=2)
    velocities = np.zeros((env.simulation.model.vertex_count, 3))
    velocities[env.simulation.cloth_ranges[-1][1], 1] = 1e3
    env.simulation.set_velocities(velocities)
    _, reward, terminated, _, info = env.step(np.zeros(env.action_space.shape))
    assert terminated
    assert info["failure"] in (2, 3)
    assert reward < -15.0


# pictures


def test_pictures(env):
    picture_maker = gym.make(id_of(env), render_mode="rgb_array")
    picture_maker.reset(seed=1)
    base = picture_maker.unwrapped
    before = base.simulation.state_hash()
    picture = picture_maker.render()
    assert picture.shape == (256, 256, 3)
    assert picture.dtype == np.uint8
    assert picture.reshape(-1, 3).std(axis=0).min() > 5.0
    assert base.simulation.state_hash() == before
    assert (picture_maker.render() == picture).all()
    shifted = np.array(base.simulation.positions)
    shifted[:, 1] += 0.1
    base.simulation.set_positions(shifted)
    assert (picture_maker.render() != picture).mean() > 0.02
    base.render_mode = "depth_array"
    depth = base.render()
    assert depth.shape == (256, 256)
    assert depth.dtype == np.uint8
    assert len(np.unique(depth)) > 10


def test_pictures_need_a_mode(env):
    assert env.render_mode is None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert env.render() is None
    assert any("render_mode" in str(w.message) for w in caught)


def test_frames_a_second_follow_from_the_control_period(env):
    assert env.metadata["render_fps"] == round(1.0 / env.control_period)
    assert "human" not in env.metadata["render_modes"]
