"""UntangleLayers: two grippers pull sheets apart that were pushed through each other."""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium as gym
import numpy as np

import clothgym as cg
from clothgym import fidelity as fidelities
from clothgym.arrays import FloatArray, IntArray, check_number
from clothgym.detection.sides import Sides
from clothgym.recording.frames import Camera
from clothgym.scenes.layers import SIDE, draw_stack, stack_scene
from clothgym_envs.base import ClothEnv, ObservationLayout

SHEETS = {"easy": 2, "medium": 3, "hard": 5}
VERTICES = {"draft": 15, "balanced": 21, "accurate": 41}
MAX_SHEETS = 5
SLOTS = 6
GRIPS = 2
CLEAN_STEPS = 10
SIDE_TOLERANCE = 0.01
SPEED = 0.25
REACH = 0.04
_WORKSPACE = np.array([[-0.5, 0.004, -0.5], [0.5, 0.6, 0.5]])
_STRAIN_FREE = 0.15
_CRUSHED = 0.5
_PAIRS = [(i, j) for i in range(MAX_SHEETS) for j in range(i + 1, MAX_SHEETS)]


class UntangleLayersEnv(ClothEnv):
    """Sheets of 40 cm lie on the ground, pushed through each other; the lowest is pinned at two corners.

    Action (8): per gripper velocity x, y, z in units of 0.25 m/s, then grip: > 0 closes, else opens. A closing gripper takes
    the nearest vertex within 4 cm and the vertices of the same sheet within 1.5 edges of it, by a soft anchor (200 N/m, slips
    above 5 N). At 0.25 m/s a gripper moves 1 mm a substep, below the collision margin.

    The simulator's own untangling is off. Beside an intersection, contact gives way above 0.02 N, so that layers do not pass
    through each other by their weight, but can be pulled apart.

    Reward: 10 x decrease of clip(L / L0, 0, 1); - 0.02 |a|^2; - 0.1 clip(strain - 0.15, 0, 1); at the end + 5 for success and
    - 5 x side error. Success: no hits, strain at most 0.15 and no edge below half its rest length for 10 steps; at most 1 % of
    the vertices of any two sheets on the wrong side of the other.

    Args:
        level: "easy" 2, "medium" 3, "hard" 5 sheets.
        fidelity: "draft" 15, "balanced" 21, "accurate" 41 vertices a side, or a Fidelity (15).
        obs: "state".
        vertices: vertices a side, instead of the fidelity's.
    """

    worst_cost_per_step = 0.02 * 8 + 0.1

    def __init__(
        self,
        render_mode: str | None = None,
        level: str = "easy",
        fidelity: str | cg.Fidelity = "draft",
        obs: str = "state",
        vertices: int | None = None,
    ) -> None:
        super().__init__(render_mode, level, fidelity, obs)
        self.sheets = SHEETS[level]
        side = VERTICES[fidelity] if isinstance(fidelity, str) and fidelity in VERTICES else 15
        self.vertices = side if vertices is None else int(check_number(vertices, "vertices", 5, 81, integer=True))
        self.fidelity = dataclasses.replace(
            fidelities.get(fidelity), untangling="none", contacts_near_hits="yield", yield_force=0.02
        )
        self.horizon = max(100, 60 * (self.sheets - 1))
        self.scene = stack_scene(self.sheets, self.vertices, GRIPS)
        self.simulation = cg.Simulation(self.scene, self.fidelity)
        self._substeps = round(self.control_period / self.scene.step)
        self._edge = SIDE / (self.vertices - 1)
        ranges = [vertices for _, vertices, _ in self.simulation.cloth_ranges]
        self._ranges = ranges
        self._pairs = [(i, j) for i, j in _PAIRS if j < self.sheets]
        self._sides = [Sides(self.simulation.faces, ranges[i], ranges[j]) for i, j in self._pairs]
        self._required: list[FloatArray] = [np.zeros(0)] * len(self._pairs)
        self._clean = np.zeros((0, 3))
        self._start_length = 1.0
        self._clean_count = 0
        self._side_error = 0.0
        self.reward_terms = {name: 0.0 for name in ("length", "action", "strain", "success", "side_error", "failure")}
        self.action_space = gym.spaces.Box(-1.0, 1.0, (4 * GRIPS,), np.float32)
        fields: list[tuple[str, int, str, float]] = []
        for g in range(GRIPS):
            fields += [
                (f"gripper_{g}/position", 3, "m", 0.3),
                (f"gripper_{g}/velocity", 3, "m/s", SPEED),
                (f"gripper_{g}/holding", 1, "", 1.0),
                (f"gripper_{g}/force", 3, "N", 2.5),  # slips at 5 N, the bound
            ]
        for slot in range(SLOTS):
            fields += [
                (f"contour_{slot}/present", 1, "", 1.0),
                (f"contour_{slot}/length", 1, "start lengths", 1.0),
                (f"contour_{slot}/centroid", 3, "m", 0.3),
                (f"contour_{slot}/shortening", 3, "", 1.0),
                (f"contour_{slot}/closed", 1, "", 1.0),
                (f"contour_{slot}/self", 1, "", 1.0),
                (f"contour_{slot}/hits", 1, "", 50.0),
                (f"contour_{slot}/upper_sheet", 1, "", float(MAX_SHEETS)),
                (f"contour_{slot}/lower_sheet", 1, "", float(MAX_SHEETS)),
            ]
        fields += [
            ("required_order", len(_PAIRS), "", 1.0),
            ("clean_centroids", 3 * MAX_SHEETS, "m", 0.3),
            ("centroids", 3 * MAX_SHEETS, "m", 0.3),
            ("side_errors", len(_PAIRS), "", 1.0),
            ("length", 1, "start lengths", 1.0),
            ("contour_count", 1, "", 10.0),
            ("max_strain", 1, "", 0.5),
            ("clean_steps", 1, "steps", float(CLEAN_STEPS)),
            ("time_left", 1, "horizons", 1.0),
        ]
        self.layout = ObservationLayout(fields)
        self.observation_space = self.layout.space
        self.camera = Camera((0.4, 0.5, 0.75), (0.0, 0.05, 0.0))

    # --- an episode -------------------------------------------------------------------------------------------------

    def _begin(self, rng: np.random.Generator, options: dict[str, Any]) -> None:
        if options:
            raise ValueError(f"options[{min(options)!r}]: UntangleLayers knows no options")
        stack = draw_stack(self.scene, rng)
        self.simulation.reset()
        self.simulation.set_positions(stack.start)
        self._clean, self._start_length = stack.clean, stack.length
        self._required = [sides.signs(stack.clean) for sides in self._sides]
        for g in range(GRIPS):
            self.simulation.place_grip(g, (0.12 if g else -0.12, 0.1, rng.uniform(-0.05, 0.05)))
        self._clean_count = 0
        self._side_error = self._side_errors().max(initial=0.0)

    def _act(self, action: FloatArray) -> None:
        sim = self.simulation
        commands = action.reshape(GRIPS, 4)
        for g in range(GRIPS):
            close = bool(commands[g, 3] > 0.0)
            if not close:
                sim.release(g)
            elif len(sim.held(g)) == 0:
                self._close(g)
        for _ in range(self._substeps):
            for g in range(GRIPS):
                # stop at the border of the workspace
                here = sim.grip_positions[g]
                there = np.clip(here + sim.scene.step * SPEED * commands[g, :3], *_WORKSPACE)
                sim.move_grip(g, (there - here) / sim.scene.step)
            sim.step()

    def _close(self, grip: int) -> None:
        """Takes a pinch of one sheet."""
        sim = self.simulation
        x = sim.positions
        distance = np.linalg.norm(x - sim.grip_positions[grip], axis=1)
        free = np.setdiff1d(np.arange(len(x)), sim.held(1 - grip))
        nearest = int(free[np.argmin(distance[free])])
        if distance[nearest] > REACH:
            return
        sheet = sim.model.cloth_of_vertex == sim.model.cloth_of_vertex[nearest]
        near = np.linalg.norm(x - x[nearest], axis=1) <= 1.5 * self._edge
        sim.grasp(grip, np.flatnonzero(sheet & near))

    def _side_errors(self) -> FloatArray:
        """(P,) share of wrong vertices for each pair of sheets."""
        x = np.array(self.simulation.positions)
        return np.array([s.error(x, r) for s, r in zip(self._sides, self._required, strict=True)])

    def _shortest_edge(self) -> float:
        """Least edge length / rest length."""
        model, x = self.simulation.model, self.simulation.positions
        ends, rest = model.surface.edges, model.edge_rest
        lengths = np.linalg.norm(x[ends[:, 1]] - x[ends[:, 0]], axis=1)
        return float((lengths[rest > 0] / rest[rest > 0]).min())

    @property
    def edge(self) -> float:
        """Rest length of an edge along the sheets' sides [m]."""
        return self._edge

    @property
    def sheet_pairs(self) -> list[tuple[int, int]]:
        """(lower, upper) of every two sheets."""
        return list(self._pairs)

    @property
    def free_vertices(self) -> list[IntArray]:
        """Of each sheet, the ids of the vertices that are not pinned."""
        free = self.simulation.model.inverse_masses > 0.0
        return [np.flatnonzero(free[r]) + r.start for r in self._ranges]

    def wrong_vertices(self, lower: int, upper: int) -> tuple[IntArray, IntArray]:
        """Ids of the vertices of two sheets that are on the wrong side of the other one: of the lower, of the upper."""
        n = self._pairs.index((lower, upper))
        wrong = self._sides[n].signs(np.array(self.simulation.positions)) * self._required[n] < 0.0
        first, second = self._ranges[lower], self._ranges[upper]
        count = first.stop - first.start
        return np.flatnonzero(wrong[:count]) + first.start, np.flatnonzero(wrong[count:]) + second.start

    def _judge(self, action: FloatArray) -> tuple[dict[str, float], bool]:
        hits = self.simulation.last_intersections
        before, now = self._length_share, min(hits.length / self._start_length, 1.0)
        self._length_share = now
        # pinched or crushed to a point is not untangled
        whole = self._strain() <= _STRAIN_FREE and self._shortest_edge() >= _CRUSHED
        clean = hits.hit_count == 0 and whole
        self._clean_count = self._clean_count + 1 if clean else 0
        errors = self._side_errors()
        self._pair_errors = errors
        self._side_error = float(errors.max(initial=0.0))
        success = self._succeeded()
        end = success or self.steps >= self.horizon
        terms = {
            "length": 10.0 * (before - now),
            "action": -0.02 * float(action @ action),
            "strain": -0.1 * float(np.clip(self._strain() - _STRAIN_FREE, 0.0, 1.0)),
            "success": 5.0 if success else 0.0,
            "side_error": -5.0 * self._side_error if end else 0.0,
            "failure": 0.0,
        }
        return terms, success

    _length_share = 1.0
    _pair_errors = np.zeros(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        self._length_share = 1.0
        self._pair_errors = np.zeros(len(self._pairs))
        return super().reset(seed=seed, options=options)

    # --- what is seen -----------------------------------------------------------------------------------------------

    def _values(self) -> dict[str, Any]:
        sim = self.simulation
        values: dict[str, Any] = {}
        velocities = sim.snapshot().grip_velocities
        for g in range(GRIPS):
            values[f"gripper_{g}/position"] = sim.grip_positions[g]
            values[f"gripper_{g}/velocity"] = velocities[g]
            values[f"gripper_{g}/holding"] = float(len(sim.held(g)) > 0)
            values[f"gripper_{g}/force"] = sim.grip_forces[g]
        self._contour_values(values)
        order, errors = np.zeros(len(_PAIRS)), np.zeros(len(_PAIRS))
        for n, (i, j) in enumerate(_PAIRS):
            if j < self.sheets:
                order[n] = 1.0
                errors[n] = self._pair_errors[self._pairs.index((i, j))]
        clean, now = np.zeros((MAX_SHEETS, 3)), np.zeros((MAX_SHEETS, 3))
        for k, vertices in enumerate(self._ranges):
            clean[k] = self._clean[vertices].mean(axis=0)
            now[k] = sim.positions[vertices].mean(axis=0)
        hits = sim.last_intersections
        values.update(
            required_order=order,
            clean_centroids=clean,
            centroids=now,
            side_errors=errors,
            length=hits.length / self._start_length,
            contour_count=hits.contour_count,
            max_strain=self._strain(),
            clean_steps=self._clean_count,
            time_left=1.0 - self.steps / self.horizon,
        )
        return values

    def longest_contours(self) -> list[dict[str, Any]]:
        """Up to six longest contours: length [m], centroid [m], points of its hits [m], unit direction in which the upper
        sheet has to move so that the contour shortens most, closed, self, hits, upper and lower sheet."""
        hits = self.simulation.last_intersections
        if hits.hit_count == 0:
            return []
        sheet = self.simulation.model.cloth_of_vertex
        surface = hits.surface
        edge_sheet = sheet[surface.edges[hits.hit_edge, 0]]
        face_sheet = sheet[surface.faces[hits.hit_face, 0]]
        frames = hits.frames
        pull = frames[:, 0:3] - 2.0 * frames[:, 6:7] * frames[:, 3:6]
        result = []
        for c in np.argsort(-hits.contour_lengths, kind="stable")[:SLOTS]:
            members = hits.hit_contour == c
            upper = max(edge_sheet[members].max(), face_sheet[members].max())
            lower = min(edge_sheet[members].min(), face_sheet[members].min())
            sign = np.where(edge_sheet[members] == upper, 1.0, -1.0)
            direction = (sign[:, None] * pull[members]).sum(axis=0)
            size = float(np.linalg.norm(direction))
            kind = hits.contours[c]
            result.append(
                {
                    "length": float(hits.contour_lengths[c]),
                    "centroid": hits.points[members].mean(axis=0),
                    "points": hits.points[members],
                    "direction": direction / size if size > 1e-9 else np.zeros(3),
                    "closed": kind.closed,
                    "self": kind.self_contour,
                    "hits": kind.hit_count,
                    "upper": int(upper),
                    "lower": int(lower),
                }
            )
        return result

    def _contour_values(self, values: dict[str, Any]) -> None:
        contours = self.longest_contours()
        for slot in range(SLOTS):
            c = contours[slot] if slot < len(contours) else None
            name = f"contour_{slot}"
            values[f"{name}/present"] = float(c is not None)
            values[f"{name}/length"] = c["length"] / self._start_length if c else 0.0
            values[f"{name}/centroid"] = c["centroid"] if c else np.zeros(3)
            values[f"{name}/shortening"] = c["direction"] if c else np.zeros(3)
            values[f"{name}/closed"] = float(c["closed"]) if c else 0.0
            values[f"{name}/self"] = float(c["self"]) if c else 0.0
            values[f"{name}/hits"] = c["hits"] if c else 0.0
            values[f"{name}/upper_sheet"] = c["upper"] if c else 0.0
            values[f"{name}/lower_sheet"] = c["lower"] if c else 0.0

    def _succeeded(self) -> bool:
        """Clean for long enough, and every sheet on its own side."""
        return self._clean_count >= CLEAN_STEPS and self._side_error <= SIDE_TOLERANCE

    def _details(self) -> dict[str, Any]:
        hits = self.simulation.last_intersections
        success = self._succeeded()
        left = 1.0 - min(hits.length / self._start_length, 1.0)
        return {
            "progress": 1.0 if success else float(left * (1.0 - self._side_error)),
            "hits": int(hits.hit_count),
            "side_error": float(self._side_error),
            "clean_steps": int(self._clean_count),
        }

    def _task_state(self) -> dict[str, Any]:
        return {
            "clean": self._clean.copy(),
            "required": [r.copy() for r in self._required],
            "start_length": self._start_length,
            "clean_count": self._clean_count,
            "side_error": self._side_error,
            "pair_errors": self._pair_errors.copy(),
            "length_share": self._length_share,
        }

    def _set_task_state(self, state: dict[str, Any]) -> None:
        self._clean = state["clean"].copy()
        self._required = [r.copy() for r in state["required"]]
        self._start_length = state["start_length"]
        self._clean_count = state["clean_count"]
        self._side_error = state["side_error"]
        self._pair_errors = state["pair_errors"].copy()
        self._length_share = state["length_share"]


__all__ = ["UntangleLayersEnv"]
