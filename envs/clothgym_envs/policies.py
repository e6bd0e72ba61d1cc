"""Scripted policies: null, random, and what a person would try; the opponents of every learner.

A policy has `reset(env)` at the start of an episode and `act(observation, info) -> action`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from clothgym.arrays import FloatArray


class Policy(Protocol):
    """Anything that acts."""

    def reset(self, env: Any) -> None:
        """A new episode of this environment has begun."""
        ...

    def act(self, observation: Any, info: dict[str, Any]) -> np.ndarray:
        """The next action."""
        ...


class Zero:
    """Does nothing."""

    def reset(self, env: Any) -> None:
        self.shape = env.action_space.shape

    def act(self, observation: Any, info: dict[str, Any]) -> np.ndarray:
        return np.zeros(self.shape, np.float32)


class Random:
    """Uniform actions, from the episode's seed."""

    def reset(self, env: Any) -> None:
        self.shape = env.action_space.shape
        self.rng = np.random.default_rng([env.unwrapped.episode_seed, 1])

    def act(self, observation: Any, info: dict[str, Any]) -> np.ndarray:
        return self.rng.uniform(-1.0, 1.0, self.shape).astype(np.float32)


class _Layers:
    """What the policies of UntangleLayers share: go to a vertex, pinch it, carry it along a path."""

    speed = 0.25
    period = 0.05

    def reset(self, env: Any) -> None:
        self.env = env.unwrapped
        self.grips = len(self.env.gripper_positions)
        self.goals: list[dict[str, Any] | None] = [None] * self.grips

    def act(self, observation: Any, info: dict[str, Any]) -> np.ndarray:
        commands = np.zeros((self.grips, 4))
        commands[:, 3] = -1.0
        for g in range(self.grips):
            if self.goals[g] is None or self._done(g):
                self.goals[g] = self._choose(g)
            if self.goals[g] is not None:
                commands[g] = self._follow(g)
        return commands.ravel().astype(np.float32)

    def _done(self, grip: int) -> bool:
        goal = self.goals[grip]
        return goal is not None and goal["left"] <= 0

    def _choose(self, grip: int) -> dict[str, Any] | None:
        """A goal: `vertex` to take, `path` a list of points to carry it through relative to where it is taken, `left` steps."""
        raise NotImplementedError

    def _follow(self, grip: int) -> FloatArray:
        goal = self.goals[grip]
        assert goal is not None
        goal["left"] -= 1
        simulation = self.env.simulation
        here = simulation.grip_positions[grip]
        if goal.get("path_points") is None:
            target = simulation.positions[goal["vertex"]]
            if np.linalg.norm(target - here) < 0.012:
                goal["path_points"] = [here + step for step in goal["path"]]
            return self._toward(here, target, 1.0 if goal.get("path_points") is not None else -1.0)
        points = goal["path_points"]
        while len(points) > 1 and np.linalg.norm(points[0] - here) < 0.015:
            points.pop(0)
        if len(points) == 1 and np.linalg.norm(points[0] - here) < 0.01:
            if goal["hold"] > 0:
                goal["hold"] -= 1
                return self._toward(here, points[0], 1.0)
            goal["left"] = 0
            return self._toward(here, points[0], -1.0)
        return self._toward(here, points[0], 1.0)

    def _toward(self, here: FloatArray, target: FloatArray, grip: float) -> FloatArray:
        velocity = (target - here) / (self.speed * self.period)
        size = float(np.abs(velocity).max())
        return np.array([*(velocity / max(size, 1.0)), grip])


class PullApart(_Layers):
    """Takes the upper sheet at the longest contour, lifts it, and drags it along the contour's summed gradient.

    Both grippers pinch at the contour, a third of its width apart, so that the buried part comes out on the whole front.
    """

    lift = 0.1
    drag = 0.16

    def _choose(self, grip: int) -> dict[str, Any] | None:
        contours = self.env.longest_contours()
        if not contours:
            return None
        contour = contours[0]
        direction = contour["direction"] * np.array([1.0, 0.0, 1.0])
        size = float(np.linalg.norm(direction))
        sideways = direction / size if size > 0.1 else np.zeros(3)
        up = np.array([0.0, 1.0, 0.0])
        path = [self.lift * up, self.lift * up + self.drag * sideways]
        return {"vertex": self._vertex_at(contour, grip), "path": path, "left": 70, "hold": 2}

    def _vertex_at(self, contour: dict[str, Any], grip: int) -> int:
        """The vertex of the upper sheet nearest to the contour's middle, moved along the contour to the gripper's side."""
        simulation = self.env.simulation
        points = contour["points"]
        offsets = points - contour["centroid"]
        _, _, axes = np.linalg.svd(offsets, full_matrices=False)
        along = axes[0] if axes[0][0] >= 0 else -axes[0]  # gripper 0 starts at the left
        reach = float(np.abs(offsets @ along).max())
        target = contour["centroid"] + (grip - 0.5) * 0.8 * reach * along
        of_sheet = np.flatnonzero(simulation.model.cloth_of_vertex == contour["upper"])
        distance = np.linalg.norm(simulation.positions[of_sheet] - target, axis=1)
        return int(of_sheet[np.argmin(distance)])


class Gradient(_Layers):
    """Both grippers take the two vertices with the largest gradient of the contour length and follow it downhill."""

    reach = 0.1

    def _choose(self, grip: int) -> dict[str, Any] | None:
        simulation = self.env.simulation
        hits = simulation.last_intersections
        if hits.hit_count == 0:
            return None
        gradient = hits.gradient()
        size = np.linalg.norm(gradient, axis=1) * (simulation.model.inverse_masses > 0)
        other = self.goals[1 - grip] if self.grips > 1 else None
        if other is not None:
            taken = simulation.positions[other["vertex"]]
            size[np.linalg.norm(simulation.positions - taken, axis=1) < 0.05] = 0.0
        vertex = int(np.argmax(size))
        if size[vertex] == 0.0:
            return None
        step = -self.reach * gradient[vertex] / size[vertex]
        return {"vertex": vertex, "path": [step], "left": 40, "hold": 2}


_COMMON: dict[str, Callable[[], Policy]] = {"zero": Zero, "random": Random}
_BY_TASK: dict[str, dict[str, Callable[[], Policy]]] = {
    "clothgym/UntangleLayers-v0": {"pull_apart": PullApart, "gradient": Gradient},
}


def names(env_id: str) -> tuple[str, ...]:
    """Policies of an environment.

    Raises:
        ValueError: an id that is not one of ours.
    """
    key = env_id.removeprefix("clothgym_envs:")
    if key not in _BY_TASK:
        raise ValueError(f"ENV = {env_id!r}: expected one of {', '.join(_BY_TASK)}")
    return (*_COMMON, *_BY_TASK[key])


def get(env_id: str, name: str) -> Policy:
    """A policy by name.

    Raises:
        ValueError: no such environment or policy; names what there is.
    """
    known = names(env_id)
    if name not in known:
        raise ValueError(f"policy = {name!r}: expected one of {', '.join(known)}")
    made = _COMMON.get(name) or _BY_TASK[env_id.removeprefix("clothgym_envs:")][name]
    return made()
