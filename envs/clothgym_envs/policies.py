"""Scripted policies: null, random, and what a person would try; the opponents of every learner.

A policy has `reset(env)` at the start of an episode and `act(observation, info) -> action`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from clothgym.arrays import FloatArray, IntArray


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


@dataclass
class Pull:
    """Both grippers go to a vertex each, close together, follow their paths, and open.

    Attributes:
        vertices: (G,) the vertex that each gripper takes.
        paths: (N, G, 3) corners of the paths, from where the grippers closed [m].
        left: steps until it is given up.
        origins: (G, 3) where the grippers closed, None before.
        corner: the corner that they are on the way to.
    """

    vertices: list[int]
    paths: FloatArray
    left: int = 40
    origins: FloatArray | None = None
    corner: int = 0


class Puller:
    """Carries out one `Pull` after the other; a subclass chooses them.

    At closing, the tips are within 3 mm of their vertices, or the gripper would take the other sheet, which is as near.
    """

    speed, period, near, arrived, floor = 0.25, 0.05, 0.003, 0.012, 0.006

    def reset(self, env: Any) -> None:
        self.env = env.unwrapped
        self.pull: Pull | None = None

    def act(self, observation: Any, info: dict[str, Any]) -> np.ndarray:
        if self.pull is None:
            self.pull = self.choose(info)
        if self.pull is None:
            return self._open()
        return self.follow(self.pull)

    def choose(self, info: dict[str, Any]) -> Pull | None:
        """The next pull; None = open the grippers and wait, which is all that a bare Puller does by itself."""
        return None

    def follow(self, pull: Pull) -> np.ndarray:
        """The action of the next step; at the end of a pull, opens and forgets it."""
        simulation = self.env.simulation
        here = np.array(simulation.grip_positions)
        pull.left -= 1
        if pull.left < 0:
            self.pull = None
            return self._open()
        if pull.origins is None:
            target = np.array(simulation.positions)[pull.vertices]
            close = bool((np.linalg.norm(target - here, axis=1) < self.near).all())
            if close:
                pull.origins = here
            return self._toward(here, target, close)
        target = pull.origins + pull.paths[pull.corner]
        target[:, 1] = np.maximum(target[:, 1], self.floor)
        if float(np.abs(target - here).max()) < self.arrived:
            pull.corner += 1
            if pull.corner == len(pull.paths):
                self.pull = None
                return self._open()
        return self._toward(here, target, True)

    def _toward(self, here: FloatArray, target: FloatArray, close: bool) -> np.ndarray:
        velocity = (target - here) / (self.speed * self.period)
        velocity /= np.maximum(np.abs(velocity).max(axis=1, keepdims=True), 1.0)
        grip = np.full((len(here), 1), 1.0 if close else -1.0)
        return np.hstack([velocity, grip]).ravel().astype(np.float32)

    def _open(self) -> np.ndarray:
        action = np.zeros((len(self.env.gripper_positions), 4), np.float32)
        action[:, 3] = -1.0
        return action.ravel()

    def nearest(self, ids: IntArray, point: FloatArray, weights: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> int:
        """The vertex among ids that is closest to a point [m]."""
        offsets = (self.env.simulation.positions[ids] - point) * np.array(weights)
        return int(ids[np.argmin(np.linalg.norm(offsets, axis=1))])

    def pair(self, up: tuple[int, FloatArray], down: tuple[int, FloatArray]) -> Pull:
        """A pull of two (vertex, path (N, 3)), each by the gripper that is nearer to the first vertex."""
        here = self.env.gripper_positions
        distance = np.linalg.norm(here - self.env.simulation.positions[up[0]], axis=1)
        jobs = [up, down] if distance[0] <= distance[1] else [down, up]
        return Pull([vertex for vertex, _ in jobs], np.stack([path for _, path in jobs], axis=1))


class PullApart(Puller):
    """Beside the longest contour one gripper lifts the buried part of the upper sheet out, while the other one holds the lower
    sheet's part that lies on top of it down on the ground.

    It has to happen close to the contour: only there does contact give way. Lifting alone would take both sheets along.
    """

    lift, press, beside = 0.16, 0.05, 2.2
    """Heights [m], and how far from the contour a vertex is taken, in edges."""

    def choose(self, info: dict[str, Any]) -> Pull | None:
        contours = self.env.longest_contours()
        if not contours:
            return None if info["side_error"] <= 0.01 else self._unfold()
        crossing = [c for c in contours if c["upper"] != c["lower"]]
        return self._apart(crossing[0]) if crossing else self._open_fold(contours[0])

    def _apart(self, contour: dict[str, Any]) -> Pull:
        env, x = self.env, np.array(self.env.simulation.positions)
        lower, upper = contour["lower"], contour["upper"]
        on_top, buried = (self._beside(ids, contour) for ids in env.wrong_vertices(lower, upper))
        free = env.free_vertices
        middle = contour["centroid"]
        # of a contour with no vertex on the wrong side, the nearest ones
        if len(buried):
            middle = x[self.nearest(buried, x[buried].mean(axis=0))]
        elif len(on_top):
            middle = x[on_top].mean(axis=0)
        taken = self.nearest(buried if len(buried) else free[upper], middle)
        held = self.nearest(on_top if len(on_top) else free[lower], middle, (1.0, 0.2, 1.0))
        return self.pair((taken, np.array([[0.0, self.lift, 0.0]])), (held, np.array([[0.0, -self.press, 0.0]])))

    def _beside(self, ids: IntArray, contour: dict[str, Any]) -> IntArray:
        """Those that can move and are near the contour."""
        x, points = self.env.simulation.positions, contour["points"]
        ids = ids[self.env.simulation.model.inverse_masses[ids] > 0.0]
        distance = np.linalg.norm(x[ids][:, None] - points[None], axis=2).min(axis=1, initial=np.inf)
        return ids[distance < self.beside * self.env.edge]

    def _open_fold(self, contour: dict[str, Any]) -> Pull:
        """A sheet that crosses itself: pulls the two sides of the contour apart across it."""
        x, ids = self.env.simulation.positions, self.env.free_vertices[contour["upper"]]
        out = contour["direction"]
        first = self.nearest(ids, contour["centroid"] + 1.5 * self.env.edge * out)
        second = self.nearest(ids[np.linalg.norm(x[ids] - x[first], axis=1) > 2.0 * self.env.edge], contour["centroid"])
        return self.pair((first, 0.08 * out[None]), (second, -0.08 * out[None]))

    def _unfold(self) -> Pull | None:
        """No contour, but wrong sides: a fold lies over. Takes it by the border and carries it outwards."""
        x = np.array(self.env.simulation.positions)
        for lower, upper in self.env.sheet_pairs:
            on_top, buried = self.env.wrong_vertices(lower, upper)
            ids = buried if len(buried) else on_top
            ids = ids[self.env.simulation.model.inverse_masses[ids] > 0.0]
            if len(ids) == 0:
                continue
            sheet = self.env.free_vertices[upper if len(buried) else lower]
            middle = x[sheet].mean(axis=0)
            outward = (x[ids].mean(axis=0) - middle) * np.array([1.0, 0.0, 1.0])
            outward /= max(float(np.linalg.norm(outward)), 1e-9)
            first = int(ids[np.argmax(np.linalg.norm(x[ids] - middle, axis=1))])
            path = np.array([[0.0, 0.15, 0.0], 0.2 * outward + np.array([0.0, 0.1, 0.0])])
            return self.pair((first, path), (self.nearest(sheet, middle), np.zeros((2, 3))))
        return None


class Gradient(Puller):
    """Both grippers take the two vertices with the largest gradient of the contour length and follow it downhill."""

    reach, apart = 0.1, 0.05

    def choose(self, info: dict[str, Any]) -> Pull | None:
        simulation = self.env.simulation
        hits = simulation.last_intersections
        if hits.hit_count == 0:
            return None
        x, gradient = simulation.positions, hits.gradient()
        size = np.linalg.norm(gradient, axis=1) * (simulation.model.inverse_masses > 0)
        chosen = []
        for _ in range(len(self.env.gripper_positions)):
            vertex = int(np.argmax(size))
            chosen.append(vertex)
            size[np.linalg.norm(x - x[vertex], axis=1) < self.apart] = 0.0
        steps = gradient[chosen]
        steps = -self.reach * steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-12)
        return Pull(chosen, steps[None])


def _cem() -> Policy:
    from clothgym_envs.planning import CrossEntropy

    return CrossEntropy()


def _dresser(name: str) -> Callable[[], Policy]:
    def make() -> Policy:
        from clothgym_envs import dress_policies

        return getattr(dress_policies, name)()

    return make


_COMMON: dict[str, Callable[[], Policy]] = {"zero": Zero, "random": Random}
_BY_TASK: dict[str, dict[str, Callable[[], Policy]]] = {
    "clothgym/DressRing-v0": {
        "straight": _dresser("Straight"),
        "axis": _dresser("Axis"),
        "axis_force_limit": _dresser("AxisForceLimit"),
        "cem": _dresser("CrossEntropy"),
    },
    "clothgym/UntangleLayers-v0": {"pull_apart": PullApart, "gradient": Gradient, "cem": _cem},
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
