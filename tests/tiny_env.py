"""An environment with nothing but what recorders rely on, registered for every test of a file that imports `registered`."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from clothgym.errors import SimulationError
from clothgym.fidelity import Fidelity

SIDE = 5


class TinySimulation:
    """A hanging net of springs: chaotic enough that one wrong bit shows after a few steps."""

    stiffness = 400.0

    def __init__(self, rng: np.random.Generator) -> None:
        u, v = np.meshgrid(np.linspace(0, 1, SIDE), np.linspace(0, 1, SIDE), indexing="ij")
        i = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
        lower = np.stack([i[:-1, :-1], i[:-1, 1:], i[1:, 1:]], axis=-1).reshape(-1, 3)
        upper = np.stack([i[:-1, :-1], i[1:, 1:], i[1:, :-1]], axis=-1).reshape(-1, 3)
        self.faces = np.concatenate([lower, upper])
        self.edges = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]]])
        self._x = np.stack([u.ravel(), 0.01 * rng.normal(size=u.size), v.ravel()], axis=1)
        self.rest = np.linalg.norm(self._x[self.edges[:, 0]] - self._x[self.edges[:, 1]], axis=1)
        self._v = np.zeros_like(self._x)
        self.time = 0.0
        self.cloth_ranges = [("net", slice(0, SIDE * SIDE), slice(0, len(self.faces)))]
        self.scene = SimpleNamespace(ground=-1.0)

    @property
    def positions(self) -> np.ndarray:
        view = self._x.view()
        view.flags.writeable = False
        return view

    @property
    def body_meshes(self) -> list[tuple[str, np.ndarray, np.ndarray]]:
        return [("ball", np.eye(3) * 0.1 + self.time, np.array([[0, 1, 2]]))]

    @property
    def last_intersections(self) -> Any:
        count = round(self.time * 20) % 3
        return SimpleNamespace(segments=np.zeros((count, 2, 3)), contour=np.arange(count), points=np.ones((count, 3)))

    def state_hash(self) -> str:
        import hashlib

        return hashlib.sha256(self._x.tobytes() + self._v.tobytes()).hexdigest()[:16]

    def step(self, push: np.ndarray) -> None:
        for _ in range(4):
            span = self._x[self.edges[:, 1]] - self._x[self.edges[:, 0]]
            length = np.linalg.norm(span, axis=1)
            pull = (self.stiffness * (length - self.rest) / length)[:, None] * span
            force = np.zeros_like(self._x)
            np.add.at(force, self.edges[:, 0], pull)
            np.add.at(force, self.edges[:, 1], -pull)
            self._v = 0.999 * (self._v + 0.005 * (force + np.array([0.0, -9.81, 0.0])))
            self._v[0] = push
            self._x = self._x + 0.005 * self._v
        self.time += 0.02


class TinyEnv(gym.Env[np.ndarray, Any]):
    """The contract that RerunRecorder relies on, and nothing more."""

    def __init__(self, level: str = "easy", fidelity: Any = "draft", discrete: bool = False, hook: Any = None) -> None:
        if level not in ("easy", "hard"):
            raise ValueError(f"level = {level!r}: expected easy or hard")
        self.level, self.discrete = level, discrete
        self.fidelity = fidelity if isinstance(fidelity, Fidelity) else Fidelity.preset(fidelity)
        self.observation_space = gym.spaces.Box(-10, 10, (3,), np.float32)
        self.action_space = gym.spaces.Discrete(5) if discrete else gym.spaces.Box(-1, 1, (3,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.episode_seed = int(self.np_random.integers(10_000)) if seed is None else seed
        rng = np.random.default_rng(self.episode_seed)
        self.simulation = TinySimulation(rng)
        self.mass = 1.0 + (options or {}).get("variation", {}).get("mass", rng.random())
        return self._observe(), self._info(0.0)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        numbers = np.asarray(action, dtype=np.float64)
        if np.isnan(numbers).any():
            raise ValueError("action holds a NaN")
        push = np.array([numbers - 2.0, 0, 0]) if self.discrete else 0.25 * numbers
        if np.all(push == 0.25):
            raise SimulationError("integrate", "speed", self.simulation.time, "less speed")
        self.simulation.step(push / self.mass)
        lowest = float(self.simulation.positions[:, 1].min())
        return self._observe(), lowest, lowest < -0.9, False, self._info(lowest)

    @property
    def gripper_positions(self) -> np.ndarray:
        return self.simulation.positions[:1]

    def _observe(self) -> np.ndarray:
        return self.simulation.positions[-1].astype(np.float32)

    def _info(self, lowest: float) -> dict[str, Any]:
        return {"is_success": False, "contour_length": 0.0, "reward/depth": lowest, "episode_seed": self.episode_seed}


ID = "clothgym/TinyNet-v7"


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    gym.register(ID, entry_point=TinyEnv, max_episode_steps=30)
    yield
    gym.registry.pop(ID)
