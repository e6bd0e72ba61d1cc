"""The pipeline: an ordered tuple of bound stages, assembled from a scene and a fidelity.

What a scene does not have adds no stage, allocates no array, imports no module and compiles no kernel.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.fidelity import Fidelity
from clothgym.model import ClothModel
from clothgym.stages.frame import Frame, Stage
from clothgym.stages.integrate import Integrate, IntegrateOnBody, Step


class Pipeline:
    """Stages in order. `profile` maps stage name to (calls, seconds)."""

    def __init__(self, stages: tuple[Stage, ...], substeps: int, dt: float, detector: Any = None) -> None:
        self.stages = stages
        self._plan = tuple((s, "positions" in s.writes, getattr(s, "of_pairs", False)) for s in stages)
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
        for stage, moves, of_pairs in self._plan:
            if of_pairs and frame.settled:
                continue
            started = time.perf_counter()
            stage.run(frame)
            frame.clock(stage.name, started)
            if moves and (diverged := frame.diverged()):
                return stage.name, diverged
        return None

    @property
    def memory(self) -> FloatArray:
        """(M,) what the strategy against intersections remembers at the start: a new array of zeros."""
        return np.zeros(max((getattr(stage, "memory_size", 0) for stage in self.stages), default=0))

    def forget(self) -> None:
        """Drops what the detection keeps from step to step; results do not depend on it, work counters do."""
        for part in (self.detector, *self.stages):
            if hasattr(part, "forget"):
                part.forget()

    def describe(self) -> str:
        """One line per stage: name, what it reads and writes."""
        width = max(len(stage.name) for stage in self.stages)
        lines = [f"step of {self.substeps * self.dt:.6g} s in {self.substeps} substeps of {self.dt:.6g} s"]
        for number, stage in enumerate(self.stages, 1):
            lines.append(f"{number}. {stage.name:<{width}}  {', '.join(stage.reads)} -> {', '.join(stage.writes)}")
        return "\n".join(lines)


def assemble(model: ClothModel, fidelity: Fidelity) -> Pipeline:
    """The stages that a scene requires, bound to its arrays.

    Raises:
        ValueError: a substep of symplectic Euler longer than the safe time step; the message states the limit.
    """
    scene = model.scene
    step = Step(model, fidelity)
    windy = any(c != 0.0 for c in scene.wind) and scene.wind_drag > 0.0
    stages: list[Stage] = []
    if windy:
        from clothgym.stages.wind import Wind

        stages.append(Wind(model))
    body: Any = None
    if scene.bodies:
        body = _body_response(model, fidelity)
    if not scene.self_collision:
        stages.append(IntegrateOnBody(step, body, windy) if body else Integrate(step, windy))
        return Pipeline(tuple(stages), step.substeps, step.dt)
    from clothgym.response.contact import Candidates
    from clothgym.stages.contact import ContactSubsteps, ContactSubstepsOnBody
    from clothgym.stages.pairs import FacePairs, Ignore, PrimitivePairs, Rebuild

    tree = _detector(model, fidelity)
    candidates = Candidates(model, tree, fidelity.flat_check and fidelity.detection == "hierarchy")
    drive: Any = None
    if any(cloth.motion for cloth in scene.cloths):
        from clothgym.stages.drive import Drive

        drive = Drive(model)
        stages.append(drive)
    if scene.ignored > 0.0:
        stages.append(Ignore(candidates, scene.ignored))
    if fidelity.rebuild_growth > 0.0:
        stages.append(Rebuild(candidates, fidelity.rebuild_growth))
    apart = np.zeros(model.vertex_count, np.bool_)
    pairs = FacePairs(candidates, scene.step, step.substeps, np.asarray(scene.gravity, float))
    stages.append(pairs)
    if fidelity.untangling != "none" or fidelity.contacts_near_hits != "keep":
        from clothgym.stages.untangle import Untangle, UntangleOnBody

        kind = UntangleOnBody if body and fidelity.untangle_bodies else Untangle
        stages.append(kind(candidates, model, fidelity, pairs, apart, windy))
        windy = windy or "external" in stages[-1].writes
    stages.append(PrimitivePairs(candidates))
    if body:
        stages.append(ContactSubstepsOnBody(step, body, candidates, model, fidelity, apart, windy))
    else:
        stages.append(ContactSubsteps(step, candidates, model, fidelity, apart, windy))
    if drive:
        stages[-1].follow(drive)  # type: ignore[attr-defined]
    return Pipeline(tuple(stages), step.substeps, step.dt, tree)


def _body_response(model: ClothModel, fidelity: Fidelity) -> Any:
    """What keeps cloth off the bodies."""
    if fidelity.body_collider == "maps":
        from clothgym.response.body import BodyResponse

        return BodyResponse(model, fidelity)
    from clothgym.response import body_surface

    return body_surface.COLLIDERS[fidelity.body_collider](model, fidelity)


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
