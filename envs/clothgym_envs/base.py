"""What every environment shares: spaces with names, checked actions, failures that never pay, state, pictures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

import clothgym as cg
from clothgym.arrays import FloatArray, as_floats, check_choice

TRAIN_SEEDS = range(0, 10_000)
VALIDATION_SEEDS = range(10_000, 10_100)
TEST_SEEDS = range(20_000, 20_100)

FAILURES = {0: "none", 1: "not finite", 2: "speed", 3: "strain"}
SPEED_CAP = 50.0
STRAIN_CAP = 10.0
LEVELS = ("easy", "medium", "hard")
_BOUND = 2.0
"""Observations are scaled to about [-1, 1] and clipped into [-2, 2]."""


@dataclass(frozen=True)
class ObservedField:
    """A named part of the observation: raw value = observation[slice] * scale, in the unit."""

    slice: slice
    unit: str
    scale: float


class ObservationLayout:
    """Names, units and scales of a flat observation, in order."""

    def __init__(self, fields: list[tuple[str, int, str, float]]) -> None:
        self.fields: dict[str, ObservedField] = {}
        start = 0
        for name, size, unit, scale in fields:
            self.fields[name] = ObservedField(slice(start, start + size), unit, scale)
            start += size
        self.size = start
        self.space = gym.spaces.Box(-_BOUND, _BOUND, (start,), np.float32)

    def pack(self, values: dict[str, Any]) -> np.ndarray:
        """Scaled, clipped, float32; every field must be given."""
        out = np.zeros(self.size)
        for name, field in self.fields.items():
            out[field.slice] = np.ravel(values[name]) / field.scale
        return np.clip(out, -_BOUND, _BOUND).astype(np.float32)


class ClothEnv(gym.Env[np.ndarray, np.ndarray], ABC):
    """Base of all environments.

    A subclass sets `control_period`, `simulation`, `layout`, `action_space`, and implements `_begin(rng, options)` (a new
    episode from a generator), `_act(action)` (apply and simulate one control period), `_values()` (observed values by name)
    and `_judge(action)` (reward terms, success). Rewards: difference of a potential, small costs, a terminal part.

    Failure: the last finite state is kept, the episode terminates, and the reward is the floor -(15 + the worst that the
    remaining steps could cost), so that no way of dying pays.
    """

    metadata = {"render_modes": ["rgb_array", "depth_array"], "render_fps": 20}
    control_period = 0.05
    worst_cost_per_step = 0.0
    simulation: cg.Simulation
    layout: ObservationLayout
    horizon: int

    def __init__(self, render_mode: str | None, level: str, fidelity: str | cg.Fidelity, obs: str) -> None:
        check_choice(level, "level", LEVELS)
        check_choice(obs, "obs", ("state",))
        if render_mode is not None:
            check_choice(render_mode, "render_mode", ("rgb_array", "depth_array"))
        self.render_mode = render_mode
        self.level = level
        self.episode_seed = -1
        self.steps = 0
        self._over = True
        self._failure = 0
        self.reward_terms: dict[str, float] = {}

    # --- for subclasses ---------------------------------------------------------------------------------------------

    @abstractmethod
    def _begin(self, rng: np.random.Generator, options: dict[str, Any]) -> None:
        """Begins an episode, drawn from the generator alone."""

    @abstractmethod
    def _act(self, action: FloatArray) -> None:
        """Applies an action and simulates one control period."""

    def _measure(self) -> None:
        """Reads off the state what `_check`, `_judge`, `_values` and `_details` share; called after every action."""

    @abstractmethod
    def _values(self) -> dict[str, Any]:
        """Observed values by name, in their units."""

    @abstractmethod
    def _judge(self, action: FloatArray) -> tuple[dict[str, float], bool]:
        """Reward terms of the step, and whether it ended in success."""

    @abstractmethod
    def _details(self) -> dict[str, Any]:
        """Task-specific part of info: the same keys with the same types at every step."""

    # --- the Gymnasium interface ------------------------------------------------------------------------------------

    @property
    def obs_layout(self) -> dict[str, ObservedField]:
        """Name -> slice, unit, scale of each part of the observation."""
        return self.layout.fields

    @property
    def profile(self) -> dict[str, tuple[int, float]]:
        """Wall time per stage of the simulation; never part of info."""
        return self.simulation.profile

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode, computed from one number: the given seed, or one drawn from the training range.

        Raises:
            ValueError: an option that the task does not know.
        """
        super().reset(seed=seed)
        # without a seed the episode is drawn from the environment's generator, which an earlier seed started
        drawn = int(self.np_random.integers(TRAIN_SEEDS.start, TRAIN_SEEDS.stop)) if seed is None else int(seed)
        self.episode_seed = drawn
        self.steps, self._failure, self._over = 0, 0, False
        self._begin(np.random.default_rng(drawn), dict(options or {}))
        self.reward_terms = {name: 0.0 for name in self.reward_terms}
        return self._observe(), self._info(False)

    def _observe(self) -> np.ndarray:
        """The observation.

        Raises:
            SimulationError: a value in it is no number.
        """
        observation = self.layout.pack(self._values())
        if np.isnan(observation).any():
            name = next(n for n, field in self.layout.fields.items() if np.isnan(observation[field.slice]).any())
            raise cg.SimulationError("observe", f"{name} is no number", self.simulation.time, "the episode ends")
        return observation

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control period. Actions beyond [-1, 1], infinite ones too, are clipped.

        Raises:
            ValueError: an action that is no number, has the wrong shape or holds NaN; nothing has changed then.
            RuntimeError: the episode is over or was never begun.
        """
        if self._over:
            raise RuntimeError("step: the episode is over; call reset first")
        act = as_floats(action, "action")
        if act.shape != self.action_space.shape:
            raise ValueError(f"action: expected shape {self.action_space.shape}, got {act.shape}")
        if np.isnan(act).any():
            raise ValueError(f"action[{int(np.argmax(np.isnan(act)))}] is nan")
        act = np.clip(act, -1.0, 1.0)
        before, forces, task = self.simulation.snapshot(), self.simulation.measured_forces(), self._task_state()
        self.steps += 1
        try:
            self._act(act)
            self._measure()
            self._failure = self._check()
            if not self._failure:
                terms, success = self._judge(act)
                reward = float(sum(terms.values()))
                if not np.isfinite(reward):
                    raise cg.SimulationError(
                        "judge", "the reward is not finite", self.simulation.time, "the episode ends"
                    )
                observation = self._observe()
        except cg.SimulationError as error:
            self._failure = 2 if "speed" in error.quantity else 1
        if self._failure:
            self.simulation.restore(before)
            self.simulation.set_measured_forces(forces)
            self._set_task_state(task)
            self._over = True
            floor = -(15.0 + self.worst_cost_per_step * (self.horizon - self.steps + 1))
            self.reward_terms = {name: 0.0 for name in self.reward_terms} | {"failure": floor}
            return self._observe(), float(floor), True, False, self._info(False)
        self.reward_terms = terms
        truncated = self.steps >= self.horizon and not success
        self._over = success or truncated
        return observation, reward, bool(success), bool(truncated), self._info(success)

    def _check(self) -> int:
        """Failure code of the current state."""
        v = self.simulation.velocities
        # written so that a NaN fails too
        if not float(np.einsum("ij,ij->i", v, v).max()) <= SPEED_CAP**2:
            return 2
        return 0 if self._strain() <= STRAIN_CAP else 3

    def _strain(self) -> float:
        return cg.metrics.max_strain(self.simulation.model, self.simulation.positions)

    def _penetration(self) -> float:
        return self.simulation.penetration_depth()

    def _info(self, success: bool) -> dict[str, Any]:
        hits = self.simulation.last_intersections
        forces = self.simulation.grip_forces
        info = {
            "is_success": bool(success),
            "contour_length": float(hits.length),
            "contour_count": int(hits.contour_count),
            "max_strain": float(self._strain()),
            "penetration_depth": float(self._penetration()),
            "force_max": float(np.linalg.norm(forces, axis=1).max()) if len(forces) else 0.0,
            "failure": int(self._failure),
            "degraded": len(self.simulation.flags()),
            "episode_seed": int(self.episode_seed),
        }
        info.update(self._details())
        info.update({f"reward/{name}": float(value) for name, value in self.reward_terms.items()})
        return info

    # --- state, for planners ----------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Everything that the rest of the episode depends on; an independent copy."""
        return {
            "simulation": self.simulation.snapshot(),
            "forces": self.simulation.measured_forces(),
            "base": (self.steps, self._over, self._failure, self.episode_seed, dict(self.reward_terms)),
            "task": self._task_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Back to a state of this environment, bit for bit."""
        self.simulation.restore(state["simulation"])
        self.simulation.set_measured_forces(state["forces"])
        self.steps, self._over, self._failure, self.episode_seed, terms = state["base"]
        self.reward_terms = dict(terms)
        self._set_task_state(state["task"])

    @abstractmethod
    def _task_state(self) -> dict[str, Any]:
        """What `get_state` keeps beside the simulation; independent copies."""

    @abstractmethod
    def _set_task_state(self, state: dict[str, Any]) -> None:
        """Back to what `_task_state` gave."""

    @property
    def gripper_positions(self) -> FloatArray:
        """(G, 3) [m]."""
        return self.simulation.grip_positions

    # --- pictures ---------------------------------------------------------------------------------------------------

    camera: Any = None
    render_size = (256, 256)

    def render(self) -> Any:
        """(256, 256, 3) uint8 picture, or (256, 256) uint8 depth, by the software rasteriser."""
        if self.render_mode is None:
            gym.logger.warn("render: no render_mode was given to gymnasium.make; nothing is drawn")
            return None
        from clothgym.recording import pictures

        width, height = self.render_size
        depth = self.render_mode == "depth_array"
        picture = pictures.draw(self.simulation, self.camera, width, height, depth=depth)
        return picture[:, :, 0] if depth else picture
