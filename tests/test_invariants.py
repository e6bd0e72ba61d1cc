"""What no action and no sequence of calls breaks: finite numbers, momentum, bits after a restore."""

from __future__ import annotations

import contextlib
import math

import clothgym_envs  # noqa: F401  registers the environments
import gymnasium as gym
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from light_scenes import HUGE, light, sheet_scene

import clothgym as cg
from clothgym.benchmarks.stability.watch import not_finite, shown_arrays
from clothgym.fidelity import INTEGRATORS

PROPERTY = settings(
    max_examples=20, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)


# ---------------------------------------------------------------------------------------------------------------
# environments


@pytest.fixture(scope="module", params=["clothgym/UntangleLayers-v0", "clothgym/DressRing-v0"])
def env(request):
    made = gym.make(request.param).unwrapped
    yield made
    made.close()


def test_actions_that_are_no_numbers_change_nothing(env):
    env.reset(seed=3)
    at, steps = env.simulation.state_hash(), env.steps
    shape = env.action_space.shape
    for bad in (
        np.full(shape, math.nan), np.where(np.arange(shape[0]) == 1, math.nan, 0.0), np.full(shape, "1"), np.full(shape, 1j),
        [None] * shape[0], "abc", None, math.nan, np.zeros(shape[0] + 1), [[0.0], [0.0, 1.0]], [HUGE] * shape[0],
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"^action") as error:
            env.step(bad)
        assert "\n" not in str(error.value)
        assert (env.simulation.state_hash(), env.steps) == (at, steps)
    _, reward, terminated, _, info = env.step(np.zeros(shape))
    assert math.isfinite(reward) and not terminated and info["degraded"] == 0


def test_actions_beyond_the_bounds_are_clipped_even_infinite_ones(env):
    signs = np.where(np.arange(env.action_space.shape[0]) % 2, 1.0, -1.0)
    hashes = set()
    for action in (signs, 1e300 * signs, math.inf * signs):
        env.reset(seed=3)
        observation, reward, *_, info = env.step(action)
        assert np.isfinite(observation).all() and math.isfinite(reward)
        assert not not_finite(info)
        hashes.add(env.simulation.state_hash())
    assert len(hashes) == 1


@pytest.mark.parametrize("where", ["values", "reward", "state"])
def test_a_nan_inside_an_environment_ends_the_episode_with_finite_numbers(env, monkeypatch, where):
    env.reset(seed=4)
    env.step(np.zeros(env.action_space.shape))
    before = env.simulation.state_hash()
    with monkeypatch.context() as patch:
        if where == "values":
            values, calls = env._values, []

            def broken():
                calls.append(1)
                out = values()
                return out | {"max_strain": math.nan} if len(calls) == 1 else out

            patch.setattr(env, "_values", broken)
        elif where == "reward":
            patch.setattr(env, "_judge", lambda action: ({"length": math.nan}, False))
        else:
            patch.setattr(env, "_act", lambda action: env.simulation._state.velocities.__setitem__((3, 1), math.nan))
        observation, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
    assert (terminated, truncated) == (True, False)
    assert info["failure"] in (1, 2)
    assert reward < -15.0 and math.isfinite(reward)
    assert env.observation_space.contains(observation)
    assert not not_finite(info)
    assert env.simulation.state_hash() == before


def test_environments_count_flags(env):
    env.reset(seed=5)
    *_, info = env.step(np.zeros(env.action_space.shape))
    assert info["degraded"] == 0 and type(info["degraded"]) is int
    env.simulation.set_velocities(np.tile([0.0, 400.0, 0.0], (env.simulation.model.vertex_count, 1)))
    assert env._info(False)["degraded"] == len(env.simulation.flags()) == 1


# ---------------------------------------------------------------------------------------------------------------
# random searches for a state that breaks an invariant

_NUMBER = st.floats(-5.0, 5.0) | st.sampled_from([1e-300, 5e-324, 1e6, -1e9])
_BAD = st.sampled_from([math.nan, math.inf, -math.inf, 1e10, "x", None])


class AnySequenceOfCalls(RuleBasedStateMachine):
    """Any calls in any order: the state stays finite, pins stay, refused calls change nothing, replays are exact."""

    @initialize(integrator=st.sampled_from(INTEGRATORS), seed=st.integers(0, 3))
    def begin(self, integrator, seed):
        self.make = lambda: cg.Simulation(sheet_scene(ground=-0.3), light(integrator))
        self.sim = self.make()
        self.pinned = self.sim.positions[[0, 3]].copy()
        self.calls: list = []
        self.kept = None

    def call(self, name, *args):
        self.calls.append((name, args))
        with contextlib.suppress(cg.SimulationError):
            getattr(self.sim, name)(*args)

    @rule(count=st.integers(1, 3))
    def step(self, count):
        self.call("step", count)

    @rule(seed=st.integers(0, 99), size=st.sampled_from([1e-9, 1e-3, 0.05, 1.0]))
    def push(self, seed, size):
        moved = self.sim.positions + np.random.default_rng(seed).normal(0.0, size, (16, 3))
        moved[[0, 3]] = self.pinned
        self.call("set_positions", moved)

    @rule(seed=st.integers(0, 99), size=st.sampled_from([1e-3, 1.0, 100.0, 1e5]))
    def throw(self, seed, size):
        self.call("set_velocities", np.random.default_rng(seed).normal(0.0, size, (16, 3)))

    @rule(place=st.tuples(_NUMBER, _NUMBER, _NUMBER))
    def place(self, place):
        self.call("place_grip", 0, place)

    @rule(velocity=st.tuples(_NUMBER, _NUMBER, _NUMBER))
    def move(self, velocity):
        self.call("move_grip", 0, velocity)

    @rule(vertices=st.lists(st.integers(0, 15), max_size=4))
    def grasp(self, vertices):
        self.call("grasp", 0, vertices)

    @rule()
    def release(self):
        self.call("release", 0)

    @rule()
    def keep(self):
        self.kept = (self.sim.snapshot(), self.sim.state_hash())

    @precondition(lambda self: self.kept is not None)
    @rule()
    def restore(self):
        self.call("restore", self.kept[0])
        assert self.sim.state_hash() == self.kept[1], "restore is not exact"

    @rule(
        bad=_BAD, name=st.sampled_from(["set_positions", "set_velocities", "place_grip", "move_grip", "grasp", "step"])
    )
    def refused(self, bad, name):
        at = self.sim.state_hash()
        given_ = {
            "set_positions": ([[bad] * 3] * 16,), "set_velocities": ([[bad] * 3] * 16,), "place_grip": (0, [bad] * 3),
            "move_grip": (0, [0.0, bad, 0.0]), "grasp": (0, [bad]), "step": (bad,),
        }[name]  # fmt: skip
        with pytest.raises(ValueError, match=r"^[a-z]+.*( is | = |expected)"):
            getattr(self.sim, name)(*given_)
        assert self.sim.state_hash() == at

    @invariant()
    def everything_shown_is_finite(self):
        if hasattr(self, "sim"):
            assert not not_finite(shown_arrays(self.sim))

    @invariant()
    def pins_stay(self):
        if hasattr(self, "sim"):
            assert (self.sim.positions[[0, 3]] == self.pinned).all()

    def teardown(self):
        if not hasattr(self, "sim"):
            return
        assert not not_finite(self.sim.metrics())
        again = self.make()
        for name, args in self.calls:
            with contextlib.suppress(cg.SimulationError):
                getattr(again, name)(*args)
        assert again.state_hash() == self.sim.state_hash(), "the same calls gave other bits"


def test_any_sequence_of_calls_keeps_the_invariants():
    run_state_machine_as_test(
        AnySequenceOfCalls,
        settings=settings(PROPERTY, max_examples=25, stateful_step_count=12),
    )


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_free_cloth_keeps_its_momentum(integrator):
    mesh = cg.grid(0.4, 0.4, 3, 3)
    material = cg.Material(stretch=1e3, shear=1e2, damping=0.0)
    scene = cg.Scene((cg.Cloth(mesh, material),), gravity=(0.0, 0.0, 0.0), self_collision=False)

    @PROPERTY
    @given(seed=st.integers(0, 10**6), size=st.floats(1e-6, 0.1), speed=st.floats(1e-3, 50.0))
    def keeps(seed, size, speed):
        rng = np.random.default_rng(seed)
        sim = cg.Simulation(scene, light(integrator))
        sim.set_positions(scene.start + rng.normal(0.0, size, (16, 3)))
        sim.set_velocities(rng.normal(0.0, speed, (16, 3)) + rng.normal(0.0, speed, 3))
        m, scale = sim.model.masses[:, None], float(sim.model.masses.sum() * speed)
        before = (m * sim.velocities).sum(axis=0)
        unsolved = 0.0
        try:
            for _ in range(3):
                sim.step()
                unsolved += sim._frame.unbalanced * scene.step * m.sum()
        except cg.SimulationError:
            return
        # an iterative solve that ends at its tolerance, or at its last iteration, leaves what it says
        iterative = integrator in ("implicit_euler", "global")
        assert iterative or unsolved == 0.0
        if iterative and sim.metrics()["work"].get("unconverged", 0) == 0:
            assert unsolved < sim.fidelity.tolerance * sim.time * m.sum()
        assert np.abs((m * sim.velocities).sum(axis=0) - before).max() < 1e-9 * max(scale, 1.0) + 1.001 * unsolved

    keeps()


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_restore_continues_with_the_same_bits(integrator):
    @settings(PROPERTY, max_examples=8)
    @given(seed=st.integers(0, 10**6), size=st.floats(1e-4, 0.1), before=st.integers(0, 3), after=st.integers(1, 3))
    def continues(seed, size, before, after):
        sim = cg.Simulation(sheet_scene(ground=-0.1), light(integrator))
        moved = sim.scene.start + np.random.default_rng(seed).normal(0.0, size, (16, 3))
        sim.set_positions(moved)
        sim.place_grip(0, moved[9])
        sim.grasp(0, [9, 10])
        sim.move_grip(0, (0.1, 0.5, -0.2))
        hashes = []
        try:
            sim.step(before)
            snapshot = sim.snapshot()
            for _ in range(2):
                sim.restore(snapshot)
                sim.step(after)
                hashes.append(sim.state_hash())
        except cg.SimulationError:
            return
        assert hashes[0] == hashes[1]

    continues()
