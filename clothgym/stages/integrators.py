"""Integrators: what makes the positions p at the end of a substep out of positions x and velocities v.

An integrator predicts p; grips, contact, ground and body then act on p, and the velocity becomes (p - x) / dt.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np

from clothgym.fidelity import MOST_SUBSTEPS, Fidelity
from clothgym.kernels import integrate
from clothgym.kernels.integrate import Grips, Ground, Motion
from clothgym.model import ClothModel
from clothgym.stages.frame import Frame

if TYPE_CHECKING:
    from clothgym.response.body import BodyResponse

NO_GRIPS = Grips(
    np.zeros(0, np.int32),
    np.zeros((0, 3)),
    np.zeros((0, 3)),
    np.zeros(0),
    np.zeros(0),
    np.zeros((0, 3)),
    np.zeros((0, 3)),
)
"""Nothing is held."""


class Integrator(ABC):
    """Any integrator; `run` and `run_on_body` are as good as `predict` lets them be, and some do better in one kernel.

    Attributes:
        substeps: how many a step has.
        sweeps: how many a substep has, over contacts and what is projected.
        remark: for what the numbers were chosen, if they were.
        in_sweeps: whether the cloth's own forces are constraints, projected in every sweep of contact, and not in p yet.
        multipliers: (C,) of those constraints [N s^2]; (0,) without.
        spring_runs: springs in runs and the space to work on them, if that is all there is in the sweeps; else None.
        runs: `xpbd.Runs` of them, which a step without contact works on alone; else None.
    """

    in_sweeps = False
    spring_runs: Any = None
    runs: Any = None

    def __init__(self, model: ClothModel, fidelity: Fidelity) -> None:
        self.sweeps, self.remark = fidelity.sweeps, ""
        self.substeps = self._substeps(model, fidelity)
        self.multipliers = np.zeros(0)

    @abstractmethod
    def _substeps(self, model: ClothModel, fidelity: Fidelity) -> int:
        """Parts of a step that the fidelity asks for, or as many as the scene needs if it leaves that open."""

    @abstractmethod
    def predict(self, frame: Frame, motion: Motion) -> None:
        """Writes frame.predicted, and what of the velocities it goes by; frame.substep tells which one it is."""

    def loose_grips(self, frame: Frame) -> Grips:
        """The anchors that p does not feel yet: they are projected with the contacts."""
        return frame.grips

    def finish(self, frame: Frame, dt: float) -> None:
        """New positions and velocities from p, after everything has corrected it."""
        integrate.finish(frame.state.positions, frame.state.velocities, frame.predicted, dt)

    def weigh_pushes(self, moved: np.ndarray) -> None:  # noqa: B027 - most have nothing to weigh
        """Makes of what a body moved (V, 3) [m] what it gave to the momentum, m moved / dt, if `finish` sees that otherwise."""

    def run(self, frame: Frame, motion: Motion, radii: np.ndarray, ground: Ground) -> None:
        """All substeps of a step without contact between cloths."""
        state, w = frame.state, frame.model.inverse_masses
        for n in range(self.substeps):
            frame.substep = n
            self.predict(frame, motion)
            integrate.hold(state.positions, frame.predicted, w, radii, motion, ground, self.loose_grips(frame), n)
            self.finish(frame, motion.dt)

    def run_on_body(self, frame: Frame, motion: Motion, radii: np.ndarray, ground: Ground, body: BodyResponse) -> None:
        """The same with bodies."""
        from clothgym.kernels import body_contact
        from clothgym.kernels.contact import NO_CONTACTS

        state, model = frame.state, frame.model
        x, v, p = state.positions, state.velocities, frame.predicted
        body.begin(frame)
        for n in range(self.substeps):
            frame.substep = n
            self.predict(frame, motion)
            contact = body.look(frame, motion.dt)
            body_contact.solve_on_body(
                x, p, model.arrays, NO_CONTACTS, 0, 0.0, radii, motion, ground, self.loose_grips(frame),
                self.multipliers, n, self.in_sweeps, contact,
            )  # fmt: skip
            self.finish(frame, motion.dt)
            self.weigh_pushes(contact.moved)
            body_contact.answer_body(v, model.inverse_masses, contact, motion.dt)


class SymplecticEuler(Integrator):
    """Springs as forces: v from the forces at x, then p from the new v [Vassilev 2001, eq. 3]."""

    def __init__(self, model: ClothModel, fidelity: Fidelity) -> None:
        super().__init__(model, fidelity)
        self.forces = np.zeros((model.vertex_count, 3))

    def _substeps(self, model: ClothModel, fidelity: Fidelity) -> int:
        limit, step = model.safe_time_step(), model.scene.step
        if fidelity.substeps == 0:
            needed = max(1.0, float(np.ceil(step / (0.9 * limit))))
            if needed > MOST_SUBSTEPS:
                raise ValueError(
                    f"fidelity.substeps = 0: this scene needs {needed:.3g} substeps of {limit:.3g} s a step, more than "
                    f"{MOST_SUBSTEPS}; take softer springs, a coarser mesh or integrator 'xpbd'"
                )
            return int(needed)
        if step / fidelity.substeps > limit:
            raise ValueError(
                f"fidelity.substeps = {fidelity.substeps}: a substep of {step / fidelity.substeps:.3g} s exceeds the "
                f"stability limit of {limit:.3g} s of symplectic Euler for this scene; use at least "
                f"{int(np.ceil(step / limit))} substeps, or 0 to choose them"
            )
        return fidelity.substeps

    def predict(self, frame: Frame, motion: Motion) -> None:
        state = frame.state
        integrate.euler_predict(
            state.positions, state.velocities, frame.predicted, self.forces, frame.model.arrays, motion
        )

    def run(self, frame: Frame, motion: Motion, radii: np.ndarray, ground: Ground) -> None:
        state = frame.state
        integrate.euler_substeps(
            state.positions, state.velocities, frame.predicted, self.forces, frame.model.arrays, radii, motion, ground,
            frame.grips, 0, self.substeps,
        )  # fmt: skip

    def run_on_body(self, frame: Frame, motion: Motion, radii: np.ndarray, ground: Ground, body: BodyResponse) -> None:
        from clothgym.kernels import body_contact

        if not body.asked_in_sweeps:
            return super().run_on_body(frame, motion, radii, ground, body)
        state, contact = frame.state, body.begin(frame)
        body_contact.euler_substeps_on_body(
            state.positions, state.velocities, frame.predicted, self.forces, frame.model.arrays, radii, motion, ground,
            frame.grips, contact, self.substeps,
        )  # fmt: skip


def get(model: ClothModel, fidelity: Fidelity) -> Integrator:
    """The integrator that a fidelity names, for a model.

    Raises:
        ValueError: substeps of an explicit integrator longer than its safe time step; the message states the limit.
    """
    kinds: dict[str, type[Integrator]] = {"symplectic_euler": SymplecticEuler}
    if fidelity.integrator == "xpbd":
        from clothgym.stages.xpbd import Xpbd

        kinds["xpbd"] = Xpbd
    elif fidelity.integrator == "runge_kutta":
        from clothgym.stages.runge_kutta import RungeKutta

        kinds["runge_kutta"] = RungeKutta
    elif fidelity.integrator == "implicit_euler":
        from clothgym.stages.implicit_euler import ImplicitEuler

        kinds["implicit_euler"] = ImplicitEuler
    elif fidelity.integrator == "global":
        from clothgym.stages.global_solver import GlobalSolver

        kinds["global"] = GlobalSolver
    return kinds[fidelity.integrator](model, fidelity)
