"""The Runge-Kutta method of order 4 as an integrator."""

from __future__ import annotations

import math

import numpy as np

from clothgym.fidelity import Fidelity
from clothgym.kernels import runge_kutta
from clothgym.kernels.integrate import Grips, Ground, Motion
from clothgym.kernels.runge_kutta import Rates
from clothgym.model import ClothModel
from clothgym.stages.frame import Frame
from clothgym.stages.integrators import NO_GRIPS, Integrator


class RungeKutta(Integrator):
    """Springs as forces at four points of a step: order 4 in time, stable below a limit.

    Anchors of grippers are forces too. Ground and contact act at the ends of substeps: a splitting, of order 1 in time.
    """

    def __init__(self, model: ClothModel, fidelity: Fidelity) -> None:
        super().__init__(model, fidelity)
        shape = (model.vertex_count, 3)
        self.free, self.ends, self.lasting = np.zeros(shape), np.zeros(shape), np.zeros(model.vertex_count)
        self.rates = Rates(*(np.zeros(shape) for _ in range(5)))

    def _substeps(self, model: ClothModel, fidelity: Fidelity) -> int:
        limit, step = safe_time_step(model), model.scene.step
        if fidelity.substeps == 0:
            return max(1, math.ceil(step / (0.9 * limit)))
        if step / fidelity.substeps > limit:
            raise ValueError(
                f"fidelity.substeps = {fidelity.substeps}: a substep of {step / fidelity.substeps:.3g} s exceeds the "
                f"stability limit of {limit:.3g} s of the Runge-Kutta method for this scene; use at least "
                f"{math.ceil(step / limit)} substeps, or 0 to choose them"
            )
        return fidelity.substeps

    def loose_grips(self, frame: Frame) -> Grips:
        return NO_GRIPS

    def predict(self, frame: Frame, motion: Motion) -> None:
        state = frame.state
        runge_kutta.runge_kutta_predict(
            state.positions, state.velocities, frame.predicted, self.free, self.ends, frame.model.arrays, motion,
            frame.grips, frame.substep, self.rates,
        )  # fmt: skip

    def finish(self, frame: Frame, dt: float) -> None:
        x, v, p = frame.state.positions, frame.state.velocities, frame.predicted
        runge_kutta.finish_second_order(x, v, p, self.free, self.ends, dt, self.lasting)

    def weigh_pushes(self, moved: np.ndarray) -> None:
        runge_kutta.count_lasting(moved, self.lasting)

    def run(self, frame: Frame, motion: Motion, radii: np.ndarray, ground: Ground) -> None:
        state = frame.state
        runge_kutta.runge_kutta_substeps(
            state.positions, state.velocities, frame.predicted, self.free, self.ends, frame.model.arrays, motion,
            self.rates, radii, ground, frame.grips, self.lasting, self.substeps,
        )  # fmt: skip


def safe_time_step(model: ClothModel) -> float:
    """Largest time step [s] for which the method is provably stable for small strains.

    An undamped mode is stable for w dt < sqrt(8). With damping c a mode sits at Re z = -c dt / 2; up to Re z = -0.7 the
    region of stability is wider there than on the axis, and in the whole left half-plane it holds |z| < 2.61. Every
    anchor counts as if one vertex bore all of it.
    """
    euler, c = model.safe_time_step(), model.damping
    if not math.isfinite(euler):
        return math.inf if c == 0.0 else 2.6 / c
    anchors = max((grip.stiffness for grip in model.scene.grips), default=0.0) * float(model.inverse_masses.max())
    # (w dt)^2 = 4 - 2 c dt at symplectic Euler's limit
    fastest = math.sqrt((4.0 - 2.0 * c * euler) / euler**2 + anchors)
    if c <= 0.49 * fastest:
        return math.sqrt(8.0) / fastest
    return 2.6 / max(fastest, c)
