"""Scripted policies of the dressing tasks: straight to the goal, along the limb, along it with care, and planning ahead."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray

_SPEED, _PERIOD = 0.25, 0.05


class Dresser(ABC):
    """Moves the gripper so that the leading opening's centroid goes where a subclass wants it."""

    goal_depth = 1.05
    """Of the wanted length: a little more than what success asks for, since the cuff swings."""

    def reset(self, env: Any) -> None:
        self.env = env.unwrapped

    def act(self, observation: Any, info: dict[str, Any]) -> np.ndarray:
        wanted = self.wanted(info) / (_SPEED * _PERIOD)
        return (wanted / max(1.0, float(np.abs(wanted).max()))).astype(np.float32)

    @abstractmethod
    def wanted(self, info: dict[str, Any]) -> FloatArray:
        """(3,) way of the opening's centroid in this step [m]; faster than possible is slowed down, not turned."""

    @property
    def goal(self) -> FloatArray:
        """(3,) where the opening's centroid has to be at the end [m]."""
        return self.env.limb.at(self.goal_depth * self.env.wanted)[0]


class Straight(Dresser):
    """Straight to the goal, whatever is in the way."""

    def wanted(self, info: dict[str, Any]) -> FloatArray:
        return self.goal - self.env.openings[0].centroid


class Axis(Dresser):
    """Onto the prolongation of the limb first, then along the limb, with the opening's centroid on the path all the time."""

    gain = 0.5
    """Share of the way off the path that it wants to make good in a step."""
    share = 0.6
    """Share of the room between limb and opening that the centroid may be off the path when the tip enters."""
    gap = 0.02
    """[m] in front of the cap where it waits until it is on the path."""

    def wanted(self, info: dict[str, Any]) -> FloatArray:
        opening, worn, limb = self.env.openings[0], self.env.worn[0], self.env.limb
        path = limb.at(worn.along)[0]
        aside = path - opening.centroid
        excess = worn.offset - self.share * max(opening.mean_radius - limb.radius, 0.0)
        step, far = _SPEED * _PERIOD, -worn.along - limb.radius
        if worn.threaded != 1 and excess > 0.0:
            if far <= 0.0:  # beside the limb: out to the front
                return limb.at(-limb.radius - 2.0 * self.gap)[0] - path
            step *= min(1.0, max(far - self.gap, 0.0) / excess)  # on the path when it arrives
        left = self.goal_depth * self.env.wanted - worn.along
        forward = limb.at(worn.along + np.clip(left, -step, step))[0] - path
        return forward + self.gain * aside


class AxisForceLimit(Axis):
    """Along the limb, slower the more force there is."""

    firm = 5.0
    """[N] at which it stops going on."""

    def wanted(self, info: dict[str, Any]) -> FloatArray:
        return super().wanted(info) * max(0.0, 1.0 - info["force_max"] / self.firm)


class CrossEntropy(Axis):
    """Cross-entropy method over corrections to the axis policy, tried out on a copy from the current state.

    A plan is a constant correction of the action (3 numbers) for `depth` steps on top of what `Axis` does. The first
    candidate is no correction, so no plan is worse, as far as `depth` steps show. The value of a plan is its return.
    Budget: `iterations` x `candidates` rollouts of `depth` steps, every `replan` steps. It sees the future: an upper
    reference, not an opponent. Everything is drawn from the episode's seed.
    """

    candidates, elites, iterations, depth, replan, spread = 8, 3, 2, 12, 4, 0.4

    def reset(self, env: Any) -> None:
        super().reset(env)
        self.rng = np.random.default_rng([self.env.episode_seed, 2])
        self.twin = copy.deepcopy(self.env)
        self.left, self.correction, self.rollouts = 0, np.zeros(3), 0

    def act(self, observation: Any, info: dict[str, Any]) -> np.ndarray:
        if self.left == 0:
            self.correction, self.left = self.plan(info), self.replan
        self.left -= 1
        return self._corrected(super().act(observation, info), self.correction)

    @staticmethod
    def _corrected(action: FloatArray, correction: FloatArray) -> np.ndarray:
        return np.clip(action + correction, -1.0, 1.0).astype(np.float32)

    def plan(self, info: dict[str, Any]) -> FloatArray:
        """(3,) the best correction found."""
        state = self.env.get_state()
        mean, spread = np.zeros(3), np.full(3, self.spread)
        tried: list[tuple[float, int, FloatArray]] = []
        for iteration in range(self.iterations):
            drawn = mean + spread * self.rng.standard_normal((self.candidates, 3))
            if iteration == 0:
                drawn[0] = 0.0
            for correction in drawn:
                tried.append((self.value(state, info, correction), len(tried), correction))
            best = np.array([entry[2] for entry in sorted(tried, key=lambda e: (-e[0], e[1]))[: self.elites]])
            mean, spread = best.mean(axis=0), np.maximum(best.std(axis=0), 0.1)
        return max(tried, key=lambda entry: (entry[0], -entry[1]))[2]

    def value(self, state: dict[str, Any], info: dict[str, Any], correction: FloatArray) -> float:
        """Return of `depth` steps with a correction, on the copy."""
        twin, hand, total = self.twin, Axis(), 0.0
        twin.set_state(state)
        hand.reset(twin)
        self.rollouts += 1
        for _ in range(self.depth):
            _, reward, terminated, truncated, info = twin.step(self._corrected(hand.act(None, info), correction))
            total += reward
            if terminated or truncated:
                break
        return total
