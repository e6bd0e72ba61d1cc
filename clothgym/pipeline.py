"""The pipeline: an ordered tuple of bound stages, assembled from a scene and a fidelity.

What a scene does not have adds no stage, allocates no array, imports no module and compiles no kernel.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.fidelity import Fidelity
from clothgym.kernels import integrate
from clothgym.kernels.integrate import Grips, Ground, Motion
from clothgym.model import ClothModel
from clothgym.state import ClothState

SPEED_CAP = 1e4
"""Speeds above this [m/s] count as diverged."""


class Frame:
    """What stages share while a step runs: the state, the model, and named buffers."""

    def __init__(self, model: ClothModel, state: ClothState) -> None:
        self.model = model
        self.state = state
        self.predicted: FloatArray = np.zeros((model.vertex_count, 3))
        self.external: FloatArray = np.zeros((0, 3))
        self.body_forces: FloatArray = np.zeros((0, 3))
        self.last_intersections: Any = None
        self.untangling_passes = 0
        self.work: dict[str, int] = {}
        self.profile: dict[str, list[float]] = {}
        self.set_grips()

    def clock(self, name: str, started: float) -> float:
        """Books the time since `started` under a name; returns now."""
        now = time.perf_counter()
        entry = self.profile[name]
        entry[0] += 1
        entry[1] += now - started
        return now

    def set_grips(self) -> None:
        """The grippers' anchors for the coming step, from the state."""
        state, specs = self.state, self.model.scene.grips
        held = len(state.held_vertices)
        counts = np.bincount(state.held_by, minlength=len(specs))[state.held_by] if held else np.ones(0)
        stiffness = np.array([specs[g].stiffness for g in state.held_by], float) / counts
        limit = np.array([specs[g].slip_force for g in state.held_by], float) / counts
        grips = state.grip_positions[state.held_by] if held else np.zeros((0, 3))
        self.grips = Grips(
            np.ascontiguousarray(state.held_vertices, np.int32),
            np.ascontiguousarray(grips + state.held_offsets),
            np.ascontiguousarray(state.grip_velocities[state.held_by] if held else np.zeros((0, 3))),
            np.ascontiguousarray(stiffness, float),
            np.ascontiguousarray(limit, float),
            np.zeros((held, 3)),
            np.zeros((held, 3)),
        )

    def diverged(self) -> str:
        """What is out of bounds in the state, or nothing."""
        x, v = self.state.positions, self.state.velocities
        if not (np.isfinite(x).all() and np.isfinite(v).all()):
            return "positions are no longer finite"
        speed = float(np.sqrt(np.einsum("ij,ij->i", v, v).max()))
        return f"a speed of {speed:.3g} m/s passed the cap of {SPEED_CAP:g} m/s" if speed > SPEED_CAP else ""

    def count(self, name: str, amount: int) -> None:
        """Adds to a work counter."""
        self.work[name] = self.work.get(name, 0) + int(amount)


class Stage(Protocol):
    """One step of the pipeline. `reads` and `writes` name state arrays and buffers."""

    name: str
    reads: tuple[str, ...]
    writes: tuple[str, ...]

    def run(self, frame: Frame) -> None: ...


class Pipeline:
    """Stages in order. `profile` maps stage name to (calls, seconds)."""

    def __init__(self, stages: tuple[Stage, ...], substeps: int, dt: float, detector: Any = None) -> None:
        self.stages = stages
        self.detector = detector
        self.substeps, self.dt = substeps, dt
        self.profile: dict[str, list[float]] = {}
        for stage in stages:
            self.profile[stage.name] = [0, 0.0]
            for part in getattr(stage, "parts", ()):  # inner loops report their own parts
                self.profile[f"{stage.name}: {part}"] = [0, 0.0]

    def run(self, frame: Frame) -> tuple[str, str] | None:
        """Advances the frame's state by one step; the stage and what diverged in it, if anything did."""
        frame.profile = self.profile
        for stage in self.stages:
            started = time.perf_counter()
            stage.run(frame)
            frame.clock(stage.name, started)
            if "positions" in stage.writes and (diverged := frame.diverged()):
                return stage.name, diverged
        return None

    def forget(self) -> None:
        """Drops what the detection keeps from step to step; results do not depend on it, work counters do."""
        if hasattr(self.detector, "forget"):
            self.detector.forget()

    def describe(self) -> str:
        """One line per stage: name, what it reads and writes."""
        width = max(len(stage.name) for stage in self.stages)
        lines = [f"step of {self.substeps * self.dt:.6g} s in {self.substeps} substeps of {self.dt:.6g} s"]
        for number, stage in enumerate(self.stages, 1):
            lines.append(f"{number}. {stage.name:<{width}}  {', '.join(stage.reads)} -> {', '.join(stage.writes)}")
        return "\n".join(lines)


class _Wind:
    name = "wind"
    reads: tuple[str, ...] = ("positions", "velocities")
    writes: tuple[str, ...] = ("external",)

    def __init__(self, model: ClothModel) -> None:
        from clothgym.kernels.wind import wind_acceleration

        self.kernel: Callable[..., Any] = wind_acceleration
        self.wind = np.asarray(model.scene.wind, float)
        self.drag = model.scene.wind_drag

    def run(self, frame: Frame) -> None:
        if len(frame.external) == 0:
            frame.external = np.zeros((frame.model.vertex_count, 3))
        state, model = frame.state, frame.model
        self.kernel(
            state.positions,
            state.velocities,
            model.faces,
            model.inverse_masses,
            self.wind,
            self.drag,
            model.scene.step,
            frame.external,
        )


class _Step:
    """Constants that every integrating stage needs."""

    def __init__(self, model: ClothModel, fidelity: Fidelity, substeps: int) -> None:
        scene = model.scene
        # without contact, forces need no sweeps
        sweeps = fidelity.sweeps if scene.self_collision or fidelity.integrator == "xpbd" else 1
        self.substeps, self.sweeps = substeps, fidelity.sweeps
        self.dt = scene.step / substeps
        self.explicit = fidelity.integrator == "symplectic_euler"
        self.limit = fidelity.stretch_limit if fidelity.velocity_modification != "none" else -1.0
        self.relative = fidelity.velocity_modification == "relative"
        self.gravity = np.asarray(scene.gravity, float)
        self.damping = model.damping
        self.ground = Ground(-np.inf if scene.ground is None else float(scene.ground), model.friction)
        self.radii = 0.5 * model.thickness
        self.multipliers = np.zeros(0 if self.explicit else len(model.spring_rest))
        self.forces = np.zeros((model.vertex_count if self.explicit else 0, 3))
        self.label = f"{fidelity.integrator} {substeps}x{sweeps}"
        if self.limit >= 0:
            self.label += f", velocity modification {fidelity.velocity_modification} above {self.limit:g}"

    def motion(self, frame: Frame) -> Motion:
        return Motion(self.dt, self.sweeps, self.gravity, self.damping, frame.external, self.limit, self.relative)


class _Integrate:
    """All substeps in one kernel: nothing but springs, grips and ground can act."""

    reads: tuple[str, ...] = ("positions", "velocities")
    writes: tuple[str, ...] = ("positions", "velocities")

    def __init__(self, step: _Step, windy: bool) -> None:
        self.step = step
        self.name = f"integrate [{step.label}]"
        if windy:
            self.reads = ("positions", "velocities", "external")

    def run(self, frame: Frame) -> None:
        s, state = self.step, frame.state
        x, v, p, cloth, motion = (
            state.positions,
            state.velocities,
            frame.predicted,
            frame.model.arrays,
            self.step.motion(frame),
        )
        if s.explicit:
            integrate.euler_substeps(x, v, p, s.forces, cloth, s.radii, motion, s.ground, frame.grips, 0, s.substeps)
        else:
            integrate.xpbd_substeps(
                x, v, p, cloth, s.radii, motion, s.ground, frame.grips, s.multipliers, 0, s.substeps
            )


class _IntegrateOnBody(_Integrate):
    """The same with a body, still in one kernel."""

    writes = ("positions", "velocities", "body_forces")

    def __init__(self, step: _Step, body: Any, windy: bool) -> None:
        super().__init__(step, windy)
        from clothgym.kernels import body_contact

        self.kernels, self.body = body_contact, body
        self.name = f"{self.name[:-1]}, {body.label}]"

    def run(self, frame: Frame) -> None:
        s, state, cloth = self.step, frame.state, frame.model.arrays
        motion, contact = s.motion(frame), self.body.begin(frame)
        x, v, p = state.positions, state.velocities, frame.predicted
        if s.explicit:
            self.kernels.euler_substeps_on_body(
                x, v, p, s.forces, cloth, s.radii, motion, s.ground, frame.grips, contact, s.substeps
            )
        else:
            self.kernels.xpbd_substeps_on_body(
                x, v, p, cloth, s.radii, motion, s.ground, frame.grips, s.multipliers, contact, s.substeps
            )


class _Rebuild:
    """A new tree where the old one has grown too loose."""

    reads: tuple[str, ...] = ("positions",)
    writes: tuple[str, ...] = ("tree",)

    def __init__(self, candidates: Any, growth: float) -> None:
        self.candidates = candidates
        self.name = f"tree [rebuilt at {growth:g}x]"

    def run(self, frame: Frame) -> None:
        self.candidates.tree.renew(frame.state.positions)


class _FacePairs:
    """Pairs of primitives whose boxes, swept along the expected motion of the step, overlap."""

    name = "face pairs"
    reads: tuple[str, ...] = ("positions", "velocities")
    writes: tuple[str, ...] = ("face_pairs",)

    def __init__(self, candidates: Any, scene_step: float, substeps: int, gravity: FloatArray) -> None:
        self.candidates, self.step, self.substeps, self.gravity = candidates, scene_step, substeps, gravity

    def run(self, frame: Frame) -> None:
        self.look(frame, self.substeps)

    def look(self, frame: Frame, horizon: int) -> None:
        """Looks `horizon` substeps ahead."""
        state, ahead = frame.state, self.step * horizon / self.substeps
        fall = (0.5 * ahead * ahead) * self.gravity
        free = (frame.model.inverse_masses > 0)[:, None]
        travel = ahead * state.velocities + np.where(free, fall, 0.0)
        self.candidates.expect(state.positions, travel, horizon)
        frame.count("box_pairs", self.candidates.box_pairs)


class _Untangle:
    """Hits, the passes of a strategy against them, and the vertices that contact leaves alone.

    Memoryless: everything follows from the current positions.
    """

    reads: tuple[str, ...] = ("positions", "velocities", "face_pairs")
    writes: tuple[str, ...] = ("positions", "velocities", "face_pairs", "apart")

    def __init__(self, candidates: Any, model: ClothModel, fidelity: Fidelity, pairs: _FacePairs, apart: Any) -> None:
        from clothgym.detection.intersections import Intersections
        from clothgym.kernels.untangling import mark_ring
        from clothgym.response import untangling

        self.answer = untangling.answer
        self.strategy = untangling.get(fidelity.untangling)
        self.passes = fidelity.untangling_passes if self.strategy is not None else 0
        self.name = (
            f"intersections [untangle {fidelity.untangling} x{self.passes}, contact {fidelity.contacts_near_hits}]"
        )
        if self.strategy is None:
            self.writes = ("apart",)
        self.candidates, self.fidelity, self.pairs, self.apart = candidates, fidelity, pairs, apart
        self.find, self.mark_ring = Intersections, mark_ring
        self.context = untangling.Context
        self.h0 = fidelity.h0 * model.mean_edge
        self.stack = np.zeros(model.vertex_count, np.int64)

    def run(self, frame: Frame) -> None:
        state, model, fidelity = frame.state, frame.model, self.fidelity
        self.apart[:] = False
        tree = self.candidates.tree
        moved = False
        for _ in range(max(1, self.passes)):
            # boxes of the positions alone: those of the whole step hold many times as much
            tree.refit(state.positions, state.positions, 0.0)
            hits = self.find(state.positions.copy(), model.surface, edge_face=tree.edges_against_faces())
            frame.count("edge_triangle_tests", hits.edge_triangle_tests)
            frame.count("hits", hits.hit_count)
            self.apart[:] = False
            if hits.hit_count == 0:
                break
            inside = None
            if self.strategy is not None:
                frame.untangling_passes += 1
                context = self.context(hits, model.inverse_masses, model.vertex_areas, self.h0, fidelity.g0)
                moves, inside = self.answer(self.strategy, context)
                self._apply(frame, moves)
                moved = True
            if fidelity.contacts_near_hits != "keep":
                self._mark(model, hits, inside)
        if moved:
            # what is tangled soon goes elsewhere than expected
            self.pairs.look(frame, 1)

    def _mark(self, model: ClothModel, hits: Any, inside: Any) -> None:
        """Vertices around the hits, and inside enclosed regions: contact there would lock the wrong side."""
        edges, faces = model.surface.edges[hits.hit_edge], model.surface.faces[hits.hit_face]
        seeds = np.unique(np.concatenate([edges.ravel(), faces.ravel()])).astype(np.int64)
        start, neighbours, _ = model.surface.neighbourhood
        self.mark_ring(start, neighbours, seeds, self.fidelity.rings, self.apart, self.stack)
        if inside is not None:
            self.apart |= inside

    def _apply(self, frame: Frame, moved: FloatArray) -> None:
        """Moves vertices; a share of the displacement per step also becomes velocity, up to the speed limit."""
        state, fidelity = frame.state, self.fidelity
        state.positions += moved
        if fidelity.velocity_share == 0.0:
            return
        before = np.sqrt(np.einsum("ij,ij->i", state.velocities, state.velocities))
        state.velocities += (fidelity.velocity_share / frame.model.scene.step) * moved
        after = np.sqrt(np.einsum("ij,ij->i", state.velocities, state.velocities))
        allowed = np.maximum(before, fidelity.speed_limit)
        fast = after > allowed
        state.velocities[fast] *= (allowed[fast] / after[fast])[:, None]


class _PrimitivePairs:
    name = "primitive pairs"
    reads: tuple[str, ...] = ("positions", "face_pairs")
    writes: tuple[str, ...] = ("quads",)

    def __init__(self, candidates: Any) -> None:
        self.candidates = candidates

    def run(self, frame: Frame) -> None:
        self.candidates.gather()
        frame.count("primitive_pairs", self.candidates.count)


class _ContactSubsteps:
    """Substeps with contact: predict, closest points, sweeps with contact last, certificate, new velocities."""

    reads: tuple[str, ...] = ("positions", "velocities", "quads", "apart")
    writes: tuple[str, ...] = ("positions", "velocities")
    parts = ("predict", "find again", "closest points", "solve", "certify", "advance")
    _ATTEMPTS = 4

    def __init__(
        self, step: _Step, candidates: Any, model: ClothModel, fidelity: Fidelity, apart: Any, windy: bool
    ) -> None:
        from clothgym.kernels import certificate, contact
        from clothgym.response.contact import ContactBuffers

        self.step, self.candidates, self.apart = step, candidates, apart
        self.kernels, self.certify = contact, certificate.certify
        self.contacts = ContactBuffers(max(1024, len(model.faces)))
        self.spare = ContactBuffers(1024)  # looking again must not forget what pressed
        self.near = (
            fidelity.contacts_near_hits == "off_both",
            fidelity.yield_force if fidelity.contacts_near_hits == "yield" else 0.0,
        )
        self.rounds = fidelity.repair_rounds
        self.name = f"contact substeps [{step.label}]"
        if fidelity.untangling == "none" and fidelity.contacts_near_hits == "keep":
            self.reads = ("positions", "velocities", "quads")  # no stage looks for intersections
        if windy:
            self.reads = (*self.reads, "external")

    def _predict(self, frame: Frame, motion: Motion) -> None:
        state, cloth = frame.state, frame.model.arrays
        if self.step.explicit:
            integrate.euler_predict(state.positions, state.velocities, frame.predicted, self.step.forces, cloth, motion)
        else:
            integrate.xpbd_predict(state.positions, state.velocities, frame.predicted, cloth, motion)

    def _solve(self, frame: Frame, motion: Motion, substep: int) -> None:
        s, model = self.step, frame.model
        self.kernels.solve(
            frame.state.positions, frame.predicted, model.arrays, self.contacts.arrays, self.contacts.active,
            model.friction, s.radii, motion, s.ground, frame.grips, s.multipliers, substep, not s.explicit,
        )  # fmt: skip

    def _answer(self, frame: Frame) -> None:
        """Velocities after contact."""
        contacts, model = self.contacts, frame.model
        self.kernels.stop_rebound(
            frame.state.velocities, model.inverse_masses, contacts.arrays, contacts.active, self.step.dt
        )

    def run(self, frame: Frame) -> None:
        s, state, model, found = self.step, frame.state, frame.model, self.candidates
        x, v, p = state.positions, state.velocities, frame.predicted
        motion = s.motion(frame)
        base, horizon = 0, found.horizon  # candidates hold for the substeps base .. base + horizon - 1
        for n in range(s.substeps):
            now = time.perf_counter()
            self._predict(frame, motion)
            now = frame.clock(f"{self.name}: predict", now)
            done = n - base
            late = done < horizon and (found.outdated(x, done / horizon) or found.outdated(p, (done + 1) / horizon))
            if late or done >= horizon:
                # what changes its mind is looked at again soon, what kept its course for twice as long
                base, horizon = n, 1 if late else min(2 * horizon, s.substeps - n)
                found.expect(x, horizon * (p - x))
                found.gather()
                frame.count("rebuilds", 1)
                now = frame.clock(f"{self.name}: find again", now)
            self.contacts.narrow(x, p, found, self.apart, *self.near)
            frame.count("contacts", self.contacts.active)
            now = frame.clock(f"{self.name}: closest points", now)
            self._solve(frame, motion, n)
            now = frame.clock(f"{self.name}: solve", now)
            share = (n + 1 - base) / horizon
            for _ in range(self._ATTEMPTS):
                if found.outdated(p, share):
                    # something moved further than expected: look again around where everything really goes
                    found.expect(x, p - x)
                    found.gather()
                    self.spare.narrow(x, p, found, self.apart, *self.near)
                    base, horizon, share = n, 1, 1.0
                    frame.count("rebuilds", 1)
                    now = frame.clock(f"{self.name}: find again", now)
                repaired, zoned = self.certify(
                    x, p, model.inverse_masses, model.thickness, found.quads, found.kinds, found.count,
                    found.separation, self.rounds,
                )  # fmt: skip
                frame.count("repaired", repaired)
                frame.count("zoned", zoned)
                now = frame.clock(f"{self.name}: certify", now)
                if not found.outdated(p, share):
                    break
            else:
                frame.count("unproved", 1)
            integrate.finish(x, v, p, s.dt)
            self._answer(frame)
            frame.clock(f"{self.name}: advance", now)
        found.book(frame.count)


class _ContactSubstepsOnBody(_ContactSubsteps):
    """The same with a body, which has the last word in every sweep."""

    writes = (*_ContactSubsteps.writes, "body_forces")

    def __init__(self, step: _Step, body: Any, *others: Any) -> None:
        super().__init__(step, *others)
        from clothgym.kernels import body_contact

        self.body_kernels, self.body = body_contact, body
        self.name = f"{self.name[:-1]}, {body.label}]"

    def run(self, frame: Frame) -> None:
        self.contact = self.body.begin(frame)
        super().run(frame)

    def _solve(self, frame: Frame, motion: Motion, substep: int) -> None:
        s, model = self.step, frame.model
        self.body_kernels.solve_on_body(
            frame.state.positions, frame.predicted, model.arrays, self.contacts.arrays, self.contacts.active,
            model.friction, s.radii, motion, s.ground, frame.grips, s.multipliers, substep, not s.explicit, self.contact,
        )  # fmt: skip

    def _answer(self, frame: Frame) -> None:
        super()._answer(frame)
        self.body_kernels.answer_body(frame.state.velocities, frame.model.inverse_masses, self.contact, self.step.dt)


def assemble(model: ClothModel, fidelity: Fidelity) -> Pipeline:
    """The stages that a scene requires, bound to its arrays.

    Raises:
        ValueError: a substep of symplectic Euler longer than the safe time step; the message states the limit.
    """
    scene = model.scene
    substeps = fidelity.substeps or 8
    if fidelity.integrator == "symplectic_euler":
        limit = model.safe_time_step()
        if fidelity.substeps == 0:
            substeps = max(1, int(np.ceil(scene.step / (0.9 * limit))))
        elif scene.step / substeps > limit:
            raise ValueError(
                f"fidelity.substeps = {substeps}: a substep of {scene.step / substeps:.3g} s exceeds the stability limit of "
                f"{limit:.3g} s of symplectic Euler for this scene; use at least "
                f"{int(np.ceil(scene.step / limit))} substeps, or 0 to choose them"
            )
    step = _Step(model, fidelity, substeps)
    windy = any(c != 0.0 for c in scene.wind) and scene.wind_drag > 0.0
    stages: list[Stage] = [_Wind(model)] if windy else []
    body: Any = None
    if scene.bodies:
        from clothgym.response.body import BodyResponse

        body = BodyResponse(model, fidelity)
    if not scene.self_collision:
        stages.append(_IntegrateOnBody(step, body, windy) if body else _Integrate(step, windy))
        return Pipeline(tuple(stages), substeps, step.dt)
    from clothgym.response.contact import Candidates

    tree = _detector(model, fidelity)
    candidates = Candidates(model, tree)
    if fidelity.rebuild_growth > 0.0:
        stages.append(_Rebuild(candidates, fidelity.rebuild_growth))
    apart = np.zeros(model.vertex_count, np.bool_)
    pairs = _FacePairs(candidates, scene.step, substeps, np.asarray(scene.gravity, float))
    stages.append(pairs)
    if fidelity.untangling != "none" or fidelity.contacts_near_hits != "keep":
        stages.append(_Untangle(candidates, model, fidelity, pairs, apart))
    stages.append(_PrimitivePairs(candidates))
    if body:
        stages.append(_ContactSubstepsOnBody(step, body, candidates, model, fidelity, apart, windy))
    else:
        stages.append(_ContactSubsteps(step, candidates, model, fidelity, apart, windy))
    return Pipeline(tuple(stages), substeps, step.dt, tree)


def _detector(model: ClothModel, fidelity: Fidelity) -> Any:
    """What finds the pairs that may touch."""
    surface, start = model.surface, model.scene.start
    if fidelity.detection == "brute_force":
        from clothgym.detection.brute_force import BruteForce

        return BruteForce(surface, start)
    if fidelity.detection == "mezger":
        from clothgym.detection.mezger import MezgerHierarchy, pattern_corners

        places = None
        if fidelity.build_space == "pattern":
            places = pattern_corners(surface, [(cloth.mesh.faces, cloth.rest) for cloth in model.scene.cloths])
        return MezgerHierarchy(surface, start, fidelity, places)
    if fidelity.rebuild_growth > 0.0:
        from clothgym.detection.rebuilt import RebuiltHierarchy

        return RebuiltHierarchy(surface, start, fidelity.k, fidelity.arity, fidelity.rebuild_growth)
    from clothgym.detection.hierarchy import Hierarchy

    return Hierarchy(surface, start, fidelity.k, fidelity.arity)
