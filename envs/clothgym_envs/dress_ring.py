"""DressRing: one gripper pulls a sewn cuff onto one straight limb; the smoke test that must be learned in minutes."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import clothgym as cg
from clothgym import fidelity as fidelities
from clothgym.arrays import FloatArray, IntArray
from clothgym.body import Body
from clothgym.garment import Garment, assemble
from clothgym.materials import Material
from clothgym.pattern import Pattern
from clothgym.recording.frames import Camera
from clothgym_envs import dressing
from clothgym_envs.base import ClothEnv, ObservationLayout
from clothgym_envs.dressing import GRIPPER_RADIUS, LimbPath, Opening, Worn, measure

VERTICES = {"draft": 60, "balanced": 120, "accurate": 400}
SPEED = 0.25
HELD_STEPS = 5
WANTED = 0.25
"""Length of the limb that the cuff's leading opening has to pass [m]."""
CUFF_LENGTH, LIMB_RADIUS = 0.10, 0.045
_USUAL_RADIUS = 2.0 * LIMB_RADIUS
STRETCH, FLEXION = 5e3, 3.0
"""[N/m] of the springs of a draft cuff, stiff enough to stay round."""
GRIP = cg.Grip(radius=0.06, stiffness=300.0, slip_force=40.0)
HOLD = 0.5 * math.pi
"""[rad] to both sides of the top of the leading border that the gripper holds."""
_BEYOND_ROOT = 0.30
"""[m] the limb goes on behind the wanted length; grippers get `_STOP` of it, so the cuff cannot come around its end."""
_STOP = 0.05
_START = np.array([0.15, 0.1, 0.0])
"""[m] from the tip to the middle of the leading opening before the start offset: in front and above, so that the straight
way to the goal leads through the limb's side."""
_WORKSPACE = np.array([[-0.55, -0.45, -0.45], [0.55, 0.5, 0.45]])
"""[m] around the tip."""
_SETTLE = 12
"""Simulator steps in which the cuff comes to hang before an episode begins."""
_DRAWS = 8
"""Times that a start is drawn until the cuff hangs without crossing itself: one in thirty does not, on the hard level."""
_STEPS = 3
"""Simulator steps in a control period."""
_NOISE = 5e-3
"""[m] standard deviation of sensed places at noise 1."""
_MAX_DELAY = 2
VARIATIONS = (
    "shoulder", "yaw", "radius", "ease", "stiffness", "mass", "friction", "start_x", "start_y", "start_z", "noise", "delay",
)  # fmt: skip
"""What an episode draws, each in [0, 1]; `DressRingEnv` tells what the ends mean."""
_LEVELS: dict[str, dict[str, tuple[float, float]]] = {
    "easy": dict.fromkeys(VARIATIONS, (0.5, 0.5))
    | {"shoulder": (0.25, 0.75), "yaw": (0.25, 0.75), "ease": (1.0, 1.0), "noise": (0.0, 0.0), "delay": (0.0, 0.0)}
    | {"start_x": (0.0, 1.0), "start_y": (0.0, 1.0), "start_z": (0.0, 1.0)},
    "medium": dict.fromkeys(VARIATIONS, (0.25, 0.75)) | {"noise": (0.0, 0.5), "delay": (0.0, 0.5)}
    | {"start_x": (0.0, 1.0), "start_y": (0.0, 1.0), "start_z": (0.0, 1.0)},
    "hard": dict.fromkeys(VARIATIONS, (0.0, 1.0)) | {"ease": (0.0, 2.0 / 9.0)},
}  # fmt: skip


class Cuff(NamedTuple):
    """A sewn cuff on a cylinder around x, its leading border at x = 0. Turn 0 is to the front, pi / 2 on top."""

    vertices: FloatArray  # (V, 3) [m]
    faces: IntArray  # (F, 3)
    rest: FloatArray  # (F, 3, 2) corners of each face in its panel [m]
    leading: IntArray  # border loop that goes on first; its normal points to the trailing one
    trailing: IntArray
    turn: FloatArray  # (V,) [rad] around the tube


@functools.lru_cache(maxsize=8)
def _sewn(count: int) -> tuple[Garment, FloatArray, FloatArray]:
    """The package's cuff of about so many vertices at its usual size, with the turn [rad] and the place along the tube of
    each vertex, from 0 to 1."""
    circumference = 2.0 * math.pi * _USUAL_RADIUS
    pattern = Pattern.load("cuff")
    width, height = np.ptp(pattern.panels[0].vertices, axis=0)
    scale = np.array([CUFF_LENGTH / width, 0.5 * circumference / height])
    panels = tuple(dataclasses.replace(panel, vertices=panel.vertices * scale) for panel in pattern.panels)
    edge = math.sqrt(2.0 / math.sqrt(3.0) * circumference * CUFF_LENGTH / count)
    # the count of vertices is no smooth function of the edge
    tried = [
        assemble(dataclasses.replace(pattern, panels=panels), edge * f) for f in (0.98, 1.02, 1.04, 1.05, 1.06, 1.1)
    ]
    garment = min(tried, key=lambda g: abs(len(g.vertices) - count))
    turn, along = np.zeros(len(garment.vertices)), np.zeros(len(garment.vertices))
    for number, (mesh, ids) in enumerate(zip(garment.panel_meshes, garment.welded)):
        around = math.pi * mesh.vertices[:, 1] / (0.5 * circumference)
        turn[ids] = around if number == 0 else math.pi - around
        along[ids] = mesh.vertices[:, 0] / CUFF_LENGTH + 0.5
    return garment, turn, along


def cuff(count: int, circumference: float, length: float = CUFF_LENGTH) -> Cuff:
    """The cuff of the package, sewn from its two panels, for a circumference and a length [m], of about `count` vertices."""
    garment, turn, along = _sewn(count)
    radius = circumference / (2.0 * math.pi)
    vertices = np.column_stack([length * along, radius * np.sin(turn), radius * np.cos(turn)])
    rest = garment.rest_corners * np.array([length / CUFF_LENGTH, radius / _USUAL_RADIUS])
    loops = sorted(garment.openings, key=lambda loop: vertices[loop, 0].mean())
    loops = [loop if measure(vertices[loop]).normal[0] > 0.0 else loop[::-1].copy() for loop in loops]
    return Cuff(vertices, garment.faces, rest, loops[0], loops[1], turn)


class DressRingEnv(ClothEnv):
    """A cuff, 10 cm long, hangs from a gripper in front of a limb and above it; it has to go over the tip and up the limb.

    The limb is a capsule, from its tip about along -x; its root is out of reach. The gripper holds the upper half of the
    cuff's leading border by soft anchors (300 N/m in all, slipping above 40 N). It is a sphere of 1 cm that cannot enter
    the limb.

    Action (3): velocity of the gripper in units of 0.25 m/s, 1 mm a substep, below the collider's tolerance.

    Observation: places are told relative to the limb's tip, which is what has to be found (`limb/tip` has it in the world).
    At the draft fidelity the cuff does not collide with itself. That helps nobody: contours count as everywhere, and
    success asks for less than an edge of them.

    Success for 5 steps on end: both openings threaded the right way, the leading one at a depth of 0.9 of 25 cm, contour
    length below an edge, strain at most 0.15, penetration at most 5 mm, and never `tunnelled` (see
    `dressing.passed_sideways`, asked of both borders at every simulator step). Where both borders are on the limb without
    ever having passed sideways, cloth between them can be in the limb only, which is penetration. After a force above 20 N
    at any time of the episode it is `success_unsafe` instead, and the episode goes on.

    `force_limb` is the sum of the sizes of all contact forces on the limb [N]; `force_max` the larger of that and the
    gripper's anchor force. `progress` is 0.9 x the depth, 0 when tunnelled, 1 for success; `progress_along` is Assistive Gym's
    measure, how far the opening's centroid is along the limb, threaded or not, offered for comparison.

    Reward: 10 x (potential now - before), see `dressing.potential`; - 0.02 |a|^2; - 0.1 clip(strain - 0.15, 0, 1);
    - 0.1 clip(contour growth in edges, 0, 1); - 0.1 x force cost (`dressing.force_cost`); + 5 success.

    Args:
        level: "easy": ease 2, limb tilted up to 15 and turned up to 7.5 degrees, start +-10 cm, all else in the middle;
            "medium": half of all ranges, start +-10 cm; "hard": all ranges, ease 1.1 to 1.3.
        fidelity: "draft" 60, "balanced" 120, "accurate" 400 vertices, or a Fidelity (60).
        obs: "state".

    `reset(options={"variation": {...}})` fixes what the seed would draw, each 0 to 1: shoulder (limb tilted -30 to 30
    degrees up), yaw (-15 to 15 degrees to the front), radius (0.036 to 0.054 m), ease (opening / limb circumference 1.1 to
    2), stiffness (x 0.3 to 3), mass (0.1 to 0.4 kg/m^2), friction (0 to 0.6), start_x, start_y, start_z (-10 to 10 cm),
    noise (of places, standard deviation 0 to 5 mm), delay (0 to 2 steps; past actions are observed). Bodies do not move
    and a straight limb has no elbow, so wearer motion and elbow are unknown names here.
    """

    worst_cost_per_step = 0.02 * 3 + 0.3

    def __init__(
        self,
        render_mode: str | None = None,
        level: str = "easy",
        fidelity: str | cg.Fidelity = "draft",
        obs: str = "state",
    ) -> None:
        super().__init__(render_mode, level, fidelity, obs)
        self.fidelity = fidelities.get(fidelity)
        name = fidelity if isinstance(fidelity, str) else "draft"
        self.vertices = VERTICES[name]
        self._finer = math.sqrt(self.vertices / VERTICES["draft"])
        self._self_collision = name != "draft"
        self.horizon, self.wanted, self.potential = 60, WANTED, 0.0
        self.reward_terms = {
            n: 0.0 for n in ("potential", "action", "strain", "contour", "force", "success", "failure")
        }
        self.action_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
        fields: list[tuple[str, int, str, float]] = [
            ("gripper/position", 3, "m", 0.3),
            ("gripper/velocity", 3, "m/s", SPEED),
            ("gripper/holding", 1, "", 1.0),
            ("gripper/force", 3, "N", 5.0),
        ]
        for opening in ("leading", "trailing"):
            fields += [
                (f"{opening}/centroid", 3, "m", 0.3),
                (f"{opening}/normal", 3, "", 1.0),
                (f"{opening}/mean_radius", 1, "m", 0.1),
                (f"{opening}/least_radius", 1, "m", 0.1),
            ]
        fields += [("limb/start", 3, "m", 0.3), ("limb/tip", 3, "m", 0.3), ("limb/radius", 1, "m", 0.05)]
        for opening in ("leading", "trailing"):
            fields += [
                (f"{opening}/depth", 1, "wanted lengths", 1.0),
                (f"{opening}/offset", 1, "m", 0.2),
                (f"{opening}/threaded", 1, "", 1.0),
            ]
        fields += [
            ("max_strain", 1, "", 0.15),
            ("mean_strain", 1, "", 0.05),
            ("contour_length", 1, "edges", 1.0),
            ("penetration", 1, "m", 0.005),
            ("force_sum", 1, "N", 10.0),
            ("force_peak", 1, "N", 5.0),
            ("time_left", 1, "horizons", 1.0),
            ("past_actions", 3 * _MAX_DELAY, "", 1.0),
        ]
        self.layout = ObservationLayout(fields)
        self.observation_space = self.layout.space
        self._noise_seed = 0
        self._prepare(dict.fromkeys(VARIATIONS, 0.5))

    # --- an episode -------------------------------------------------------------------------------------------------

    def _prepare(self, variation: dict[str, float]) -> None:
        """The scene of an episode: limb, cuff and where they start all follow from the variation."""
        self.variation = dict(variation)
        v = variation
        shoulder, yaw = math.radians(60.0 * v["shoulder"] - 30.0), math.radians(30.0 * v["yaw"] - 15.0)
        way = np.array([math.cos(shoulder) * math.cos(yaw), math.sin(shoulder), math.cos(shoulder) * math.sin(yaw)])
        radius = LIMB_RADIUS * (0.8 + 0.4 * v["radius"])
        length = WANTED + _BEYOND_ROOT
        root = np.array([-length, 0.0, 0.0])
        tip = root + length * way
        self.limb = LimbPath(np.array([root, tip]), radius)
        self.camera = Camera(tuple(tip + np.array([0.45, 0.35, 1.05])), tuple(tip + np.array([0.05, 0.03, 0.0])))
        ease = 1.1 + 0.9 * v["ease"]
        stiffness = 10.0 ** ((2.0 * v["stiffness"] - 1.0) * math.log10(3.0))
        friction = 0.6 * v["friction"]
        self.cuff = cuff(self.vertices, 2.0 * math.pi * ease * radius)
        # bending energy of springs across edges of length h goes with h^4: the same cuff at every fidelity
        material = Material(
            density=0.1 + 0.3 * v["mass"], stretch=STRETCH * stiffness, flexion=FLEXION * stiffness * self._finer**4, shear=0.0,
            damping=4.0, friction=friction,
        )  # fmt: skip
        start = 0.2 * np.array([v["start_x"], v["start_y"], v["start_z"]]) - 0.1
        place = tip + _START + start
        cloth = cg.Cloth((self.cuff.vertices + place, self.cuff.faces), material, rest=self.cuff.rest, name="cuff")
        scene = cg.Scene(
            [cloth],
            bodies=[Body(self.limb.mesh(), name="limb", friction=friction)],
            grips=[GRIP],
            self_collision=self._self_collision,
            step=self.control_period / _STEPS,
            duration=self.horizon * self.control_period,
            name="dress_ring",
        )
        self.simulation = cg.Simulation(scene, self.fidelity)
        self.edge = float(self.simulation.model.edge_rest.mean())
        self.held_turn = np.abs((self.cuff.turn - 0.5 * math.pi + math.pi) % (2.0 * math.pi) - math.pi)
        self._start = place + np.array([0.0, self.cuff.vertices[:, 1].max() + GRIPPER_RADIUS, 0.0])
        self._approach = 0.4
        self._delay = round(_MAX_DELAY * v["delay"])
        self._noise_size = _NOISE * v["noise"]

    def _begin(self, rng: np.random.Generator, options: dict[str, Any]) -> None:
        given = options.pop("variation", {})
        if options:
            raise ValueError(f"options[{min(options)!r}]: DressRing knows 'variation' only")
        fixed = dressing.check_variation(given, VARIATIONS)
        for _ in range(_DRAWS):
            drawn = {name: float(rng.uniform(*_LEVELS[self.level][name])) for name in VARIATIONS}
            self._noise_seed = int(rng.integers(2**31))
            self._prepare(drawn | fixed)
            self._settle()
            if self.simulation.last_intersections.hit_count == 0:
                break
        self._past = np.zeros((_MAX_DELAY, 3))
        self._held_steps, self._tunnelled, self._peak_force = 0, False, 0.0
        self._contour_edges = 0.0
        self._measure()
        self.potential = self._worth()

    def _settle(self) -> None:
        """From the start of the scene until the cuff hangs from the gripper."""
        sim, leading = self.simulation, self.cuff.leading
        sim.reset()
        sim.place_grip(0, self._start)
        sim.grasp(0, leading[self.held_turn[leading] <= HOLD + 1e-9])
        sim.step(_SETTLE)

    def _act(self, action: FloatArray) -> None:
        sim, limb, borders = self.simulation, self.limb, (self.cuff.leading, self.cuff.trailing)
        done = action if self._delay == 0 else self._past[self._delay - 1].copy()
        self._past = np.concatenate([action[None], self._past[:-1]])
        before = [sim.positions[border] for border in borders]
        for _ in range(_STEPS):
            here = sim.grip_positions[0]
            there = self._allowed(here + sim.scene.step * SPEED * done)
            sim.move_grip(0, (there - here) / sim.scene.step)
            sim.step()
            after = [sim.positions[border] for border in borders]
            for one, two in zip(before, after):
                self._tunnelled = self._tunnelled or dressing.passed_sideways(one, two, limb)
            before = after
            self._peak_force = max(self._peak_force, *self._forces())

    def _allowed(self, place: FloatArray) -> FloatArray:
        """Where a gripper that wants to be somewhere comes to be: inside the workspace, not beyond the wanted length,
        and not in the limb."""
        place = np.clip(place, *(self.limb.tip + _WORKSPACE))
        ahead = self.limb.points[0] - self.limb.tip
        ahead = ahead / self.limb.length
        place = place - max(0.0, float((place - self.limb.tip) @ ahead) - WANTED - _STOP) * ahead
        return self.limb.keep_out(place)

    def _forces(self) -> tuple[float, float]:
        """Sum of the contact forces on the limb, and the gripper's [N]."""
        sim = self.simulation
        return dressing.limb_force(sim.body_forces)[0], float(np.linalg.norm(sim.grip_forces[0]))

    def _measure(self) -> None:
        """What reward, info and observation share."""
        x = self.simulation.positions
        loops = [x[border] for border in (self.cuff.leading, self.cuff.trailing)]
        self.openings: list[Opening] = [measure(loop) for loop in loops]
        self.worn: list[Worn] = [
            dressing.worn(loop, opening, self.limb, WANTED) for loop, opening in zip(loops, self.openings)
        ]
        model = self.simulation.model
        ends = model.surface.edges
        lengths = np.sqrt(((x[ends[:, 1]] - x[ends[:, 0]]) ** 2).sum(axis=1))
        self._strains = lengths / model.edge_rest - 1.0
        # the body's mesh lies in the capsule, so where nothing is in the capsule there is nothing to look up
        points = np.concatenate([x, x[model.faces].mean(axis=1)])
        inside = self.limb.skin_distances(points).min() < 0.0
        self._depth = self.simulation.penetration_depth() if inside else 0.0

    def _strain(self) -> float:
        return float(self._strains.max())

    def _penetration(self) -> float:
        return self._depth

    def _worth(self) -> float:
        return dressing.potential(self.worn[0], self.openings[0], self.limb, self._approach, self._tunnelled)

    def _dressed(self) -> bool:
        """All that success asks for, now."""
        return (
            all(worn.threaded == 1 for worn in self.worn)
            and self.worn[0].depth >= dressing.NEEDED_DEPTH
            and not self._tunnelled
            and self._strain() <= dressing.MAX_STRAIN
            and self.simulation.last_intersections.length < self.edge
            and self._penetration() <= dressing.MAX_PENETRATION
        )

    def _judge(self, action: FloatArray) -> tuple[dict[str, float], bool]:
        before, self.potential = self.potential, self._worth()
        edges, self._contour_edges = self._contour_edges, self.simulation.last_intersections.length / self.edge
        self._held_steps = self._held_steps + 1 if self._dressed() else 0
        success = self._held_steps >= HELD_STEPS and self._peak_force <= dressing.UNSAFE_FORCE
        terms = {
            "potential": 10.0 * (self.potential - before),
            "action": -0.02 * float(action @ action),
            "strain": -0.1 * min(max(self._strain() - dressing.MAX_STRAIN, 0.0), 1.0),
            "contour": -0.1 * min(max(self._contour_edges - edges, 0.0), 1.0),
            "force": -0.1 * dressing.force_cost(max(self._forces())),
            "success": 5.0 if success else 0.0,
            "failure": 0.0,
        }
        return terms, success

    # --- what is seen -----------------------------------------------------------------------------------------------

    def _values(self) -> dict[str, Any]:
        sim, tip = self.simulation, self.limb.tip
        total, peak = dressing.limb_force(sim.body_forces)
        values: dict[str, Any] = {
            "gripper/position": sim.grip_positions[0] - tip,
            "gripper/velocity": sim.snapshot().grip_velocities[0],
            "gripper/holding": float(len(sim.held(0)) > 0),
            "gripper/force": sim.grip_forces[0],
            "limb/start": self.limb.at(WANTED)[0] - tip,
            "limb/tip": tip,
            "limb/radius": self.limb.radius,
            "max_strain": self._strain(),
            "mean_strain": float(self._strains.mean()),
            "contour_length": sim.last_intersections.length / self.edge,
            "penetration": self._penetration(),
            "force_sum": total,
            "force_peak": peak,
            "time_left": 1.0 - self.steps / self.horizon,
            "past_actions": self._past,
        }
        for name, opening, worn in zip(("leading", "trailing"), self.openings, self.worn):
            values[f"{name}/centroid"] = opening.centroid - tip
            values[f"{name}/normal"] = opening.normal
            values[f"{name}/mean_radius"] = opening.mean_radius
            values[f"{name}/least_radius"] = opening.least_radius
            values[f"{name}/depth"] = worn.along / WANTED  # in front of the tip too
            values[f"{name}/offset"] = worn.offset
            values[f"{name}/threaded"] = worn.threaded
        if self._noise_size > 0.0:
            noise = np.random.default_rng([self._noise_seed, self.steps]).normal(0.0, self._noise_size, (3, 3))
            for name, error in zip(("gripper/position", "leading/centroid", "trailing/centroid"), noise):
                values[name] = values[name] + error
        return values

    def _details(self) -> dict[str, Any]:
        first, (limb_force, grip_force) = self.worn[0], self._forces()
        dressed = self._held_steps >= HELD_STEPS
        safe = self._peak_force <= dressing.UNSAFE_FORCE
        return {
            "progress": 1.0 if dressed and safe else (0.0 if self._tunnelled else dressing.NEEDED_DEPTH * first.depth),
            "progress_along": min(max(first.along / WANTED, 0.0), 1.0),
            "success_unsafe": bool(dressed and not safe),
            "depth": float(first.depth),
            "threaded": int(first.threaded),
            "offset": float(first.offset),
            "tunnelled": bool(self._tunnelled),
            "dressed_steps": int(self._held_steps),
            "force_limb": limb_force,
            "force_max": max(limb_force, grip_force),
        }

    # --- state ------------------------------------------------------------------------------------------------------

    def set_state(self, state: dict[str, Any]) -> None:
        """Back to a state of this environment, bit for bit; of another episode too, whose limb and cuff come along."""
        if state["task"]["variation"] != self.variation:
            self._prepare(state["task"]["variation"])
        super().set_state(state)

    def _task_state(self) -> dict[str, Any]:
        return {
            "variation": dict(self.variation),
            "noise_seed": self._noise_seed,
            "past": self._past.copy(),
            "held_steps": self._held_steps,
            "tunnelled": self._tunnelled,
            "peak_force": self._peak_force,
            "contour_edges": self._contour_edges,
            "potential": self.potential,
        }

    def _set_task_state(self, state: dict[str, Any]) -> None:
        self._noise_seed = state["noise_seed"]
        self._past = state["past"].copy()
        self._held_steps = state["held_steps"]
        self._tunnelled = state["tunnelled"]
        self._peak_force = state["peak_force"]
        self._contour_edges = state["contour_edges"]
        self.potential = state["potential"]
        self._measure()


__all__ = ["DressRingEnv"]
