"""XPBD: springs as constraints with compliance, projected in sweeps [Macklin 2016, 2019]: stable at any step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from clothgym import batches, promise
from clothgym.fidelity import Fidelity
from clothgym.kernels import integrate
from clothgym.kernels.integrate import Ground, Motion
from clothgym.model import ClothModel
from clothgym.stages.frame import Frame
from clothgym.stages.integrators import Integrator

if TYPE_CHECKING:
    from clothgym.response.body import BodyResponse


class Xpbd(Integrator):
    """Springs as constraints with compliance, projected in sweeps [Macklin 2016, 2019]: stable at any step.

    Where nothing but springs, grips and ground acts on a grid, the kernel of a step sees the springs in runs.
    """

    in_sweeps = True

    def __init__(self, model: ClothModel, fidelity: Fidelity) -> None:
        super().__init__(model, fidelity)
        scene = model.scene
        alone = model.constraint_count == len(model.spring_rest)
        if alone and not scene.bodies:
            layout = spring_layout(model)
            if len(layout.runs) > 0:
                touches = scene.self_collision
                dtype = np.dtype(np.float64 if touches else fidelity.precision)
                self.runs = Runs(model, layout, scene.step / self.substeps, dtype)
                self.spring_runs = (self.runs.arrays, self.runs.space) if touches else None
                return
        self.multipliers = np.zeros(model.constraint_count)

    def _substeps(self, model: ClothModel, fidelity: Fidelity) -> int:
        substeps, self.sweeps = promise.effort(model, fidelity)
        if fidelity.substeps == 0:
            self.remark = f"stretch within {100.0 * fidelity.stretch_error:.3g} %"
        return substeps

    def predict(self, frame: Frame, motion: Motion) -> None:
        state = frame.state
        integrate.xpbd_predict(state.positions, state.velocities, frame.predicted, frame.model.arrays, motion)

    def run(self, frame: Frame, motion: Motion, radii: np.ndarray, ground: Ground) -> None:
        state = frame.state
        if self.runs is not None:
            self.runs.step(state.positions, state.velocities, radii, motion, ground, frame.grips, 0, self.substeps)
            return
        integrate.xpbd_substeps(
            state.positions, state.velocities, frame.predicted, frame.model.arrays, radii, motion, ground, frame.grips,
            self.multipliers, 0, self.substeps,
        )  # fmt: skip

    def run_on_body(self, frame: Frame, motion: Motion, radii: np.ndarray, ground: Ground, body: BodyResponse) -> None:
        from clothgym.kernels import body_contact

        if not body.asked_in_sweeps:
            return super().run_on_body(frame, motion, radii, ground, body)
        state, contact = frame.state, body.begin(frame)
        body_contact.xpbd_substeps_on_body(
            state.positions, state.velocities, frame.predicted, frame.model.arrays, radii, motion, ground, frame.grips,
            self.multipliers, contact, self.substeps,
        )  # fmt: skip


def spring_layout(model: ClothModel) -> batches.Layout:
    """The cheapest layout of a model's springs; grids have runs."""
    grids = [
        (vertices.start, vertices.stop - vertices.start, batches.grid_columns(cloth.mesh))
        for cloth, (_, vertices, _) in zip(model.scene.cloths, model.ranges)
    ]
    return batches.layout(model.spring_ends, model.vertex_count, grids)


class Runs:
    """The springs of a model in runs, for substeps of a length, and what their kernel works on.

    Args:
        model: must have no energies but springs.
        layout: of its springs.
        dt: length of a substep [s].
        dtype: float64 or float32.
    """

    def __init__(self, model: ClothModel, layout: batches.Layout, dt: float, dtype: np.dtype) -> None:
        from clothgym.kernels import spring_runs

        ends, w = model.spring_ends, model.inverse_masses
        self.layout = layout
        entries, lanes = self.layout.entries, spring_runs.LANES
        slots = -(-self.layout.slot_count // lanes) * lanes
        real = entries >= 0
        springs = entries[real]
        alpha, share, rest = np.ones(len(entries)), np.zeros(len(entries)), np.ones(len(entries))
        alpha[real] = 1.0 / (model.spring_stiffness[springs] * dt * dt)
        both = w[ends[springs]].sum(axis=1)
        share[real] = np.where(both > 0.0, 1.0 / (both + alpha[real]), 0.0)
        rest[real] = model.spring_rest[springs]
        mobility = np.zeros(slots)
        mobility[self.layout.slot] = w
        loose = ends[springs[len(springs) - self.layout.loose_count :]]
        self.arrays = spring_runs.SpringRuns(
            self.layout.slot,
            mobility.astype(dtype),
            self.layout.runs.astype(np.uint64),
            np.ascontiguousarray(self.layout.slot[loose].reshape(-1, 2)),
            rest.astype(dtype),
            alpha.astype(dtype),
            share.astype(dtype),
        )
        single = dtype == np.float32
        self.space = spring_runs.RunSpace(
            np.zeros((3, slots), dtype),
            np.zeros((3, slots), dtype),
            np.zeros((3, slots if single else 0), dtype),
            np.zeros((3, slots), dtype),
            np.zeros(spring_runs.CHUNK, dtype),
            np.zeros(len(entries), dtype),
            np.array([1.0, 1e-20], dtype),
        )
        self._kernels, self._forces = spring_runs, np.zeros((0, 3))
        self._substeps = spring_runs.xpbd_substeps_in_single_runs if single else spring_runs.xpbd_substeps_in_runs

    def step(self, x, v, radii, motion, ground, grips, first, last) -> None:  # type: ignore[no-untyped-def]
        """Substeps `first` up to `last` of a step; x, v (V, 3) are changed."""
        self._substeps(x, v, self.space, self.arrays, radii, motion, ground, grips, first, last)

    def step_along(self, x, v, radii, motion, ground, grips, first, last, course, base, horizon) -> int:  # type: ignore[no-untyped-def]
        """The same in double precision, as long as a sheet keeps to its course: a motion that began at substep `base` and takes
        `horizon` of them. Returns the substep that was not made because it might not."""
        if len(self._forces) < len(grips.forces):
            self._forces = np.zeros(grips.forces.shape)
        return int(
            self._kernels.xpbd_substeps_along(
                x, v, self.space, self.arrays, radii, motion, ground, grips, first, last, course, base, horizon,
                self._forces[: len(grips.forces)],
            )
        )  # fmt: skip
