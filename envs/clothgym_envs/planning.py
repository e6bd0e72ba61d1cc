"""Planning by simulated rollouts on a copy of the environment: an honest upper reference, since it sees the future."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym_envs.policies import Pull, PullApart, Puller


class CrossEntropy(Puller):
    """Chooses each pull by the cross-entropy method over whole pulls, tried out from the current state.

    Ten numbers describe a pull: a place (2, in edges from the middle of the longest contour, towards its wrong region and along
    it), and for each gripper how far it goes up, towards and along after closing (3, [m]), and how far further into the wrong
    region it takes its vertex (1, in edges). The first candidate of every plan is the pull of `PullApart`, so that no plan is
    worse, as far as one pull shows. The best pull is carried out to its end, then it plans again.

    Budget a plan: `iterations` x `candidates` rollouts of at most `depth` steps. The value of a rollout is its return,
    less `step_cost` a step, plus `clean` when no hit is left at its end. Everything is drawn from the episode's seed.
    """

    candidates, elites, iterations, depth = 8, 3, 2, 40
    step_cost, clean = 0.05, 2.0
    spread = np.array([1.5, 1.5, 0.05, 0.04, 0.04, 0.7, 0.03, 0.04, 0.04, 0.7])

    def reset(self, env: Any) -> None:
        super().reset(env)
        self.rng = np.random.default_rng([self.env.episode_seed, 2])
        self.twin = copy.deepcopy(self.env)
        self.rollouts = 0

    def choose(self, info: dict[str, Any]) -> Pull | None:
        state = self.env.get_state()
        scripted = PullApart()
        scripted.reset(self.env)
        first = scripted.choose(info)
        if first is None or not self._crossings():
            return first
        up = 0 if first.paths[-1, 0, 1] > first.paths[-1, 1, 1] else 1
        mean = np.zeros(len(self.spread))
        mean[2], mean[6] = first.paths[-1, up, 1], first.paths[-1, 1 - up, 1]
        spread = self.spread.copy()
        tried: list[tuple[float, int, FloatArray, Pull]] = []
        for iteration in range(self.iterations):
            drawn = mean + spread * self.rng.standard_normal((self.candidates, len(mean)))
            for number, values in enumerate(drawn):
                if iteration == 0 and number == 0:
                    values, pull = mean.copy(), first
                else:
                    pull = self._pull(values)
                value = self._value(state, pull)
                tried.append((value, len(tried), values, pull))
            best = np.array(
                [entry[2] for entry in sorted(tried, key=lambda entry: (-entry[0], entry[1]))[: self.elites]]
            )
            mean, spread = best.mean(axis=0), np.maximum(best.std(axis=0), 0.25 * self.spread)
        return max(tried, key=lambda entry: (entry[0], -entry[1]))[3]

    def _crossings(self) -> list[dict[str, Any]]:
        return [c for c in self.env.longest_contours() if c["upper"] != c["lower"]]

    def _pull(self, values: FloatArray) -> Pull:
        """The pull that ten numbers describe, in the current state."""
        env, x = self.env, np.array(self.env.simulation.positions)
        contour = self._crossings()[0]
        on_top, buried = env.wrong_vertices(contour["lower"], contour["upper"])
        wrong = np.concatenate([on_top, buried])
        across = (x[wrong].mean(axis=0) - contour["centroid"] if len(wrong) else np.zeros(3)) * np.array(
            [1.0, 0.0, 1.0]
        )
        size = float(np.linalg.norm(across))
        across = across / size if size > 0.25 * env.edge else np.array([1.0, 0.0, 0.0])
        along = np.array([-across[2], 0.0, across[0]])
        place = contour["centroid"] + env.edge * (values[0] * across + values[1] * along)
        free = env.free_vertices
        jobs: list[tuple[int, FloatArray]] = []
        for ids, sheet, offset in ((buried, contour["upper"], 2), (on_top, contour["lower"], 6)):
            inward = values[offset + 3] * env.edge * across
            vertex = self.nearest(self._allowed(ids, free[sheet]), place + inward, (1.0, 0.2, 1.0))
            path = np.array([0.0, values[offset], 0.0]) + values[offset + 1] * across + values[offset + 2] * along
            jobs.append((vertex, path[None]))
        return self.pair(jobs[0], jobs[1])

    def _allowed(self, wrong: IntArray, free: IntArray) -> IntArray:
        """Vertices on the wrong side when some can move, else the whole sheet."""
        movable = np.intersect1d(wrong, free)
        return movable if len(movable) else free

    def _value(self, state: dict[str, Any], pull: Pull) -> float:
        """What a pull brings, simulated on the twin."""
        twin = self.twin
        twin.set_state(state)
        hand = Puller()
        hand.reset(twin)
        hand.pull = copy.deepcopy(pull)
        total = 0.0
        self.rollouts += 1
        for _ in range(self.depth):
            _, reward, terminated, truncated, _ = twin.step(hand.follow(hand.pull))
            total += reward - self.step_cost
            if terminated or truncated or hand.pull is None:
                break
        return total + (self.clean if twin.simulation.last_intersections.hit_count == 0 else 0.0)
