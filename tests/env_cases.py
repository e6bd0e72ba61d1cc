"""The environments, made once, and episodes to compare bit for bit."""

from __future__ import annotations

import clothgym_envs
import gymnasium as gym
import numpy as np
from clothgym_envs import policies
from clothgym_envs.base import ClothEnv

IDS = tuple(clothgym_envs.ENVIRONMENTS)
LEVELS = ("easy", "medium", "hard")
LAYERS = "clothgym/UntangleLayers-v0"
RING = "clothgym/DressRing-v0"
SMALL = {LAYERS: {"vertices": 7}, RING: {}}
"""What makes an environment quick to make."""


def id_of(env: ClothEnv) -> str:
    return next(i for i in IDS if clothgym_envs.ENVIRONMENTS[i].endswith(f":{type(env).__name__}"))


_made: dict[tuple[str, ...], ClothEnv] = {}


def shared(env_id: str, level: str = "easy", obs: str = "state") -> ClothEnv:
    """One environment for all tests that leave nothing behind but an episode."""
    if (env_id, level, obs) not in _made:
        _made[env_id, level, obs] = gym.make(env_id, level=level, obs=obs).unwrapped
    return _made[env_id, level, obs]


def random_actions(env: ClothEnv, count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, *env.action_space.shape)).astype(np.float32)


def play(env: ClothEnv, actions: np.ndarray) -> list[tuple]:
    """Everything that can be told about each step, to the bit."""
    told = []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        told.append(
            (observation.tobytes(), reward.hex(), terminated, truncated, bits(info), env.simulation.state_hash())
        )
    return told


def bits(info: dict) -> dict:
    return {name: value.hex() if isinstance(value, float) else value for name, value in info.items()}


def in_contact(env: ClothEnv, seed: int = 5) -> None:
    """An episode under way: grippers hold cloth, sheets touch each other or the limb."""
    env.reset(seed=seed)
    actions = random_actions(env, 8, seed)
    if id_of(env) == LAYERS:
        actions[:, 1::4] = -1.0  # down to the cloth, and closed
        actions[:, 3::4] = 1.0
    elif id_of(env) == RING:
        policy = policies.get(RING, "straight")
        policy.reset(env)
        for _ in range(30):
            if np.abs(env.simulation.body_forces).max() > 0.0:
                break
            play(env, [policy.act(None, {})])
        actions *= 0.1
    play(env, actions)
