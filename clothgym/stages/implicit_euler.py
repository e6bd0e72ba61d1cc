"""Implicit integration as an integrator: Newton's method with preconditioned conjugate gradients."""

from __future__ import annotations

import math
from abc import abstractmethod

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.fidelity import Fidelity
from clothgym.kernels import anchors, implicit, integrate, runge_kutta
from clothgym.kernels.block_matrix import BlockMatrix
from clothgym.kernels.implicit import Search
from clothgym.kernels.integrate import Grips, Motion
from clothgym.model import ClothModel
from clothgym.stages.frame import Frame
from clothgym.stages.integrators import NO_GRIPS, Integrator

SECOND_ORDER = 1.0 - math.sqrt(0.5)
"""Length of each of the two stages of the method of order 2, in steps."""


class Implicit(Integrator):
    """Steps that end where an objective is least; how that is found is up to subclasses.

    With time_order 1 a substep is one implicit Euler step, of the same objective as XPBD's. With time_order 2 it is two
    stages, each such a step of 0.29 of the length; these damp what the step cannot resolve, and little else. Anchors of
    grippers are part of the objective. Ground, body and contact correct its result: a splitting, of order 1 in time.

    Attributes:
        few: steps of a solve at most, if the fidelity leaves that open.
    """

    few = 50

    def __init__(self, model: ClothModel, fidelity: Fidelity) -> None:
        super().__init__(model, fidelity)
        self.second_order = fidelity.time_order == 2
        self.tolerance, self.steps = fidelity.tolerance, fidelity.solver_steps or self.few
        h = model.scene.step / self.substeps * (SECOND_ORDER if self.second_order else 1.0)
        self.stage_length = h
        free = model.inverse_masses > 0.0
        self.free_mass = max(float(model.masses[free].sum()), 1e-300)
        # the method of order 2 damps the new velocity; see `kernels.implicit.begin_stage`
        drag = 1.0 + model.damping * h if self.second_order else 1.0
        self.weights: FloatArray = np.where(free, model.masses * drag / h**2, 0.0)
        shape = (model.vertex_count, 3)
        self.targets: FloatArray = np.zeros(shape)
        if self.second_order:
            self.base, self.rate, self.free, self.ends = (np.zeros(shape) for _ in range(4))
            self.lasting: FloatArray = np.zeros(model.vertex_count)

    def _substeps(self, model: ClothModel, fidelity: Fidelity) -> int:
        return fidelity.substeps or 2

    def loose_grips(self, frame: Frame) -> Grips:
        return NO_GRIPS

    @abstractmethod
    def minimise(self, frame: Frame, time: float) -> None:
        """Moves frame.predicted to the least objective; time [s] since the start of the step, for the grips."""

    def weigh(self, frame: Frame, gradient: FloatArray) -> None:
        """Books the acceleration of the whole cloth that a solve has left unbalanced, from its gradient (V, 3) [N]."""
        frame.unbalanced = max(frame.unbalanced, float(np.linalg.norm(gradient.sum(axis=0))) / self.free_mass)

    def predict(self, frame: Frame, motion: Motion) -> None:
        state, p, h = frame.state, frame.predicted, self.stage_length
        x, v, w = state.positions, state.velocities, frame.model.inverse_masses
        start = frame.substep * motion.dt
        implicit.begin_stage(x, v, self.targets, w, motion, h, self.second_order)
        implicit.coast(x, v, p, w, h)
        self.minimise(frame, start + h)
        if self.second_order:
            implicit.between_stages(x, v, p, self.base, self.rate, motion.dt, h)
            implicit.begin_stage(self.base, self.rate, self.targets, w, motion, h, True)
            self.minimise(frame, start + motion.dt)
            implicit.end_stages(p, self.base, self.ends, self.free, h)
        if len(frame.grips.vertices) > 0:
            anchors.book_grip_forces(p, w, frame.grips, start + motion.dt, motion.dt)

    def finish(self, frame: Frame, dt: float) -> None:
        x, v, p = frame.state.positions, frame.state.velocities, frame.predicted
        if self.second_order:
            runge_kutta.finish_second_order(x, v, p, self.free, self.ends, dt, self.lasting)
        else:
            integrate.finish(x, v, p, dt)

    def weigh_pushes(self, moved: FloatArray) -> None:
        if self.second_order:
            runge_kutta.count_lasting(moved, self.lasting)


class ImplicitEuler(Implicit):
    """Newton's method; its linear systems by conjugate gradients, preconditioned with the blocks on the diagonal."""

    def __init__(self, model: ClothModel, fidelity: Fidelity) -> None:
        super().__init__(model, fidelity)
        self.matrix = block_matrix(model)
        count = model.vertex_count
        self.search = Search(*(np.zeros((count, 3)) for _ in range(7)))
        self.iterations = max(100, 3 * count)  # conjugate gradients end there but for rounding

    def minimise(self, frame: Frame, time: float) -> None:
        steps, iterations, left = implicit.newton(
            frame.predicted, self.targets, self.weights, frame.model.arrays, frame.grips, time, self.matrix, self.search,
            self.tolerance, self.steps, self.iterations,
        )  # fmt: skip
        frame.count("solver_steps", steps)
        frame.count("linear_iterations", iterations)
        frame.count("unconverged", not left <= self.tolerance)
        self.weigh(frame, self.search.gradient)


def block_matrix(model: ClothModel) -> BlockMatrix:
    """The matrix of all energies of a model; what is constant in it is written."""
    arrays, count = model.arrays, model.vertex_count
    hinges, quadratic = arrays.hinges, arrays.quadratic
    # places that a patch does not have, or that have no weight, would fill the matrix with zeros
    bent = np.zeros((len(hinges.stencils), 12), np.bool_)
    patches, places = np.nonzero((hinges.weights != 0.0).any(axis=1))
    for corner in range(4):
        bent[patches, hinges.local[patches, places, corner]] = True
    stencils = [
        arrays.spring_ends,
        arrays.membrane.faces,
        np.where(bent, hinges.stencils, -1),
        np.where((quadratic.weights != 0.0).any(axis=1), quadratic.stencils, -1),
    ]
    rows, columns, slots = block_pattern(stencils, model.inverse_masses == 0.0)
    constant = np.zeros(count if arrays.has_quadratic else 0), np.zeros(len(columns) if arrays.has_quadratic else 0)
    products = np.einsum("nai,naj->nij", quadratic.weights, quadratic.weights)
    np.add.at(constant[0], -2 - slots[3][slots[3] < -1], products[slots[3] < -1])
    np.add.at(constant[1], slots[3][slots[3] >= 0], products[slots[3] >= 0])
    diagonal, blocks, inverses = (np.zeros((size, 3, 3)) for size in (count, len(columns), count))
    return BlockMatrix(
        rows, columns, diagonal, blocks, inverses, slots[0], slots[1], np.zeros((*slots[1].shape, 3, 3)), slots[2],
        np.zeros((len(slots[2]), 3, 12, 3)), *constant,
    )  # fmt: skip


def block_pattern(stencils: list[IntArray], pinned: np.ndarray) -> tuple[IntArray, IntArray, list[IntArray]]:
    """Where the blocks of elements go in a symmetric matrix of 3 x 3 blocks, see `kernels.block_matrix.BlockMatrix`.

    Args:
        stencils: for each kind of element (N, n) vertices, -1 = none.
        pinned: (V,) vertices without equations.

    Returns:
        rows (V + 1,) and columns (P,), both int32, and for each kind slots (N, n, n) int32.
    """
    count = len(pinned)
    slots, keys = [], []
    for stencil in stencils:
        left_out = (stencil < 0) | pinned[stencil]
        first, second = np.broadcast_arrays(stencil[:, :, None], stencil[:, None, :])
        ids = np.asarray(first, np.int64) * count + second
        ids[left_out[:, :, None] | left_out[:, None, :] | (first > second)] = -1
        keys.append(np.unique(ids[(ids >= 0) & (first < second)]))
        slots.append(ids)
    pairs = np.unique(np.concatenate(keys)) if keys else np.zeros(0, np.int64)
    rows = np.searchsorted(pairs, np.arange(count + 1) * count)
    for ids in slots:
        row, column = ids // count, ids % count
        # an element may name a vertex twice: such a block belongs to the diagonal too
        ids[:] = np.where(ids < 0, -1, np.where(row == column, -2 - row, np.searchsorted(pairs, ids)))
    return (
        np.ascontiguousarray(rows, np.int32),
        np.ascontiguousarray(pairs % count, np.int32),
        [np.ascontiguousarray(ids, np.int32) for ids in slots],
    )
