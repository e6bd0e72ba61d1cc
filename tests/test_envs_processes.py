"""Environments in other processes give the same episodes, without an import by the user."""

from __future__ import annotations

import functools
import itertools
import subprocess
import sys

import clothgym_envs
import gymnasium as gym
import numpy as np
import pytest
from env_cases import IDS, SMALL, random_actions, shared


@pytest.mark.parametrize("env_id", IDS)
def test_a_child_makes_it_without_the_import(tmp_path, env_id):
    code = (
        "import gymnasium, sys\n"
        f"env = gymnasium.make('clothgym_envs:{env_id}', **{SMALL[env_id]})\n"
        "env.reset(seed=3)\n"
        "print(env.unwrapped.simulation.state_hash())\n"
        "assert 'stable_baselines3' not in sys.modules and 'rerun' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
    here = gym.make(env_id, **SMALL[env_id])
    here.reset(seed=3)
    assert done.stdout.strip() == here.unwrapped.simulation.state_hash()


def reference_run(env_id: str, seeds: list[int], actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Observations and rewards (steps, environments, ...) of single environments."""
    observations, rewards = [], []
    for number, seed in enumerate(seeds):
        env = gym.make(env_id, **SMALL[env_id])
        env.reset(seed=seed)
        told = [env.step(action) for action in actions[:, number]]
        observations.append([t[0] for t in told])
        rewards.append([t[1] for t in told])
    return np.swapaxes(observations, 0, 1), np.swapaxes(rewards, 0, 1)


def make_small(env_id: str) -> gym.Env:
    return gym.make(f"clothgym_envs:{env_id}", **SMALL[env_id])


@pytest.fixture
def importable(monkeypatch):
    """Spawned children import this file by its name."""
    import os

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([os.path.dirname(__file__), os.environ.get("PYTHONPATH", "")]))


@pytest.mark.parametrize("env_id", IDS)
def test_gymnasium_vectors_in_spawned_processes(importable, env_id):
    actions = np.array([random_actions(shared(env_id), 2, seed) for seed in range(3)])
    vector = gym.vector.AsyncVectorEnv([functools.partial(make_small, env_id)] * 2, context="spawn")
    try:
        vector.reset(seed=[5, 6])
        told = [vector.step(action) for action in actions]
    finally:
        vector.close()
    observations, rewards = reference_run(env_id, [5, 6], actions)
    assert (np.array([t[0] for t in told]) == observations).all()
    assert (np.array([t[1] for t in told]) == rewards).all()
    assert all("max_strain" in t[4] for t in told)


@pytest.mark.parametrize("env_id", IDS)
def test_stable_baselines_vectors_in_spawned_processes(importable, env_id):
    vectors = pytest.importorskip("stable_baselines3.common.vec_env")
    actions = np.array([random_actions(shared(env_id), 2, seed) for seed in range(3)])
    vector = vectors.SubprocVecEnv([functools.partial(make_small, env_id)] * 2, start_method="spawn")
    try:
        vector.seed(9)
        vector.reset()
        told = [vector.step(action) for action in actions]
    finally:
        vector.close()
    observations, rewards = reference_run(env_id, [9, 10], actions)
    assert (np.array([t[0] for t in told]) == observations).all()
    assert (np.array([t[1] for t in told]) == rewards).all()


def test_ids_are_registered_once():
    for env_id, entry in clothgym_envs.ENVIRONMENTS.items():
        assert gym.spec(env_id).entry_point == entry
        assert env_id.startswith("clothgym/")
        assert gym.spec(env_id).max_episode_steps is None, "truncation is inside"
    for one, two in itertools.pairwise(sorted(clothgym_envs.ENVIRONMENTS)):
        assert one != two
