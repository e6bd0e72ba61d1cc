"""Time integration of a scene in which cloth cannot touch cloth."""

from __future__ import annotations

from typing import Any

import numpy as np

from clothgym.fidelity import Fidelity
from clothgym.kernels.integrate import Ground, Motion
from clothgym.model import ClothModel
from clothgym.stages import integrators
from clothgym.stages.frame import Frame


class Step:
    """The integrator of a scene and the constants of its substeps."""

    def __init__(self, model: ClothModel, fidelity: Fidelity) -> None:
        scene = model.scene
        self.integrator = integrators.get(model, fidelity)
        self.substeps = self.integrator.substeps
        self.sweeps = self.integrator.sweeps
        self.dt = scene.step / self.substeps
        self.corrections = fidelity.position_modification
        limited = fidelity.velocity_modification != "none" or self.corrections > 0
        self.limit = fidelity.stretch_limit if limited else -1.0
        self.relative = fidelity.velocity_modification == "relative"
        self.gravity = np.asarray(scene.gravity, float)
        self.damping = model.damping
        self.ground = Ground(-np.inf if scene.ground is None else float(scene.ground), model.friction)
        self.radii = 0.5 * model.thickness
        # without contact, only what is projected needs sweeps
        shown = self.sweeps if scene.self_collision or self.integrator.in_sweeps else 1
        self.label = f"{fidelity.integrator} {self.substeps}x{shown}"
        if self.integrator.remark:
            self.label += f" for {self.integrator.remark}"
        if self.corrections > 0:
            self.label += f", position modification x{self.corrections} above {self.limit:g}"
        elif self.limit >= 0:
            self.label += f", velocity modification {fidelity.velocity_modification} above {self.limit:g}"

    def motion(self, frame: Frame) -> Motion:
        return Motion(
            self.dt, self.sweeps, self.gravity, self.damping, frame.external, self.limit, self.relative, self.corrections
        )  # fmt: skip


class Integrate:
    """All substeps: nothing but the cloth's own forces, grips and ground can act."""

    reads: tuple[str, ...] = ("positions", "velocities")
    writes: tuple[str, ...] = ("positions", "velocities")

    def __init__(self, step: Step, windy: bool) -> None:
        self.step = step
        self.name = f"integrate [{step.label}]"
        if windy:
            self.reads = ("positions", "velocities", "external")

    def run(self, frame: Frame) -> None:
        s = self.step
        s.integrator.run(frame, s.motion(frame), s.radii, s.ground)


class IntegrateOnBody(Integrate):
    """The same with a body."""

    writes = ("positions", "velocities", "body_forces")

    def __init__(self, step: Step, body: Any, windy: bool) -> None:
        super().__init__(step, windy)
        self.body = body
        self.clamped = np.zeros(len(step.radii), np.bool_)
        self.name = f"{self.name[:-1]}, {body.label}]"

    def run(self, frame: Frame) -> None:
        s = self.step
        s.integrator.run_on_body(frame, s.motion(frame), s.radii, s.ground, self.body)
        self.clamped[:] = False
        frame.clamped = self.body.clamped(self.clamped)
