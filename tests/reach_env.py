"""A small environment for tests of training: a point on a line goes to a target. `reach_env:Reach-v0` works in any process."""

from __future__ import annotations

import os

import gymnasium as gym
import numpy as np

HORIZON = 10


class Reach(gym.Env):
    """Observes position and target; the action is a velocity. With `wide`, there are that many numbers more to observe."""

    def __init__(self, level: str = "easy", wide: int = 0) -> None:
        self.near = {"easy": 0.15, "hard": 0.05}[level]
        self.wide = wide
        self.observation_space = gym.spaces.Box(-2.0, 2.0, (2 + wide,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def _told(self) -> tuple:
        observation = np.zeros(2 + self.wide, np.float32)
        observation[:2] = self.position, self.target
        distance = abs(self.position - self.target)
        success = bool(distance < self.near)
        info = {
            "is_success": success,
            "progress": 1.0 - distance / 2.0,
            "failure": 0,
            "episode_seed": self.episode_seed,
        }
        return observation, info

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        super().reset(seed=seed)
        self.episode_seed = int(self.np_random.integers(10_000)) if seed is None else seed
        self.position, self.target = np.random.default_rng(self.episode_seed).uniform(-1.0, 1.0, 2)
        self.steps = 0
        return self._told()

    def step(self, action: np.ndarray) -> tuple:
        before = abs(self.position - self.target)
        self.position = float(np.clip(self.position + 0.3 * float(np.clip(action[0], -1.0, 1.0)), -2.0, 2.0))
        self.steps += 1
        observation, info = self._told()
        reward = before - abs(self.position - self.target) + (0.5 if info["is_success"] else 0.0)
        return observation, float(reward), info["is_success"], self.steps >= HORIZON and not info["is_success"], info


class Dying(Reach):
    """Ends its process in the seventh step."""

    def step(self, action: np.ndarray) -> tuple:
        if self.steps == 6:
            os._exit(3)
        return super().step(action)


for name, entry_point in (("Reach-v0", Reach), ("Dying-v0", Dying)):
    if name not in gym.registry:
        gym.register(name, entry_point=entry_point)
