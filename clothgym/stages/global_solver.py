"""A global solver as an integrator: implicit steps by L-BFGS with a constant matrix that is factored once."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from clothgym.arrays import FloatArray
from clothgym.fidelity import Fidelity
from clothgym.kernels import bending, quasi_newton
from clothgym.kernels.quasi_newton import Factor, Memory
from clothgym.model import ClothModel
from clothgym.stages.frame import Frame
from clothgym.stages.implicit_euler import Implicit

_KEPT = 8
"""Steps that L-BFGS remembers."""
_SHARE = 0.25
"""Of the stiffness in all directions in the constant matrix: threads resist along themselves only. Measured on hanging
sheets with few steps: 1 hinders what bends, 0.1 stretches too far before the line search learns."""


class GlobalSolver(Implicit):
    """Steps of quasi-Newton, each with one back-substitution of a constant system.

    Few of them leave a solve far from its tolerance, but with little error in what is large and smooth, and less strain
    than sweeps of the same cost.
    """

    few = 5

    def __init__(self, model: ClothModel, fidelity: Fidelity) -> None:
        super().__init__(model, fidelity)
        self.factor = factorise(constant_matrix(model, self.weights), np.flatnonzero(model.inverse_masses > 0.0))
        count = model.vertex_count
        buffers = [np.zeros((count, 3)) for _ in range(4)]
        self.memory = Memory(
            np.zeros((_KEPT, count, 3)), np.zeros((_KEPT, count, 3)), np.zeros(_KEPT), np.zeros(_KEPT),
            buffers[0], buffers[1], buffers[2], buffers[3], np.zeros((len(self.factor.order), 3)),
        )  # fmt: skip

    def minimise(self, frame: Frame, time: float) -> None:
        steps, shortened, left = quasi_newton.minimise(
            frame.predicted, self.targets, self.weights, frame.model.arrays, frame.grips, time, self.factor, self.memory,
            self.tolerance, self.steps,
        )  # fmt: skip
        frame.count("solver_steps", steps)
        frame.count("shortened", shortened)
        frame.count("unconverged", not left <= self.tolerance)
        self.weigh(frame, self.memory.gradient)


def constant_matrix(model: ClothModel, weights: FloatArray) -> scipy.sparse.csc_array:
    """(V, V) [N/m]: inertia, and a share of the trace of the blocks of each energy's second derivatives, unstrained.

    For a spring the trace is its stiffness, which projective dynamics takes in all directions.
    """
    arrays = model.arrays
    k, m = arrays.spring_stiffness, arrays.membrane
    springs = np.array([[1.0, -1.0], [-1.0, 1.0]]) * k[:, None, None]
    s = m.shape
    weft = np.stack([-s[:, 0] - s[:, 1], s[:, 0], s[:, 1]], axis=1)
    warp = np.stack([-s[:, 2] - s[:, 3], s[:, 2], s[:, 3]], axis=1)
    triangles = (m.stiffness[:, 0] + m.stiffness[:, 3])[:, None, None] * weft[:, :, None] * weft[:, None, :]
    triangles += (m.stiffness[:, 2] + m.stiffness[:, 3])[:, None, None] * warp[:, :, None] * warp[:, None, :]
    rows = np.zeros((len(arrays.hinges.stencils), 3, 12, 3))
    bending.hinge_rows(model.scene.start, arrays, rows)
    q = arrays.quadratic.weights
    parts = [
        (arrays.spring_ends, springs), (m.faces, triangles),
        (arrays.hinges.stencils, np.einsum("naic,najc->nij", rows, rows)),
        (arrays.quadratic.stencils, np.einsum("nai,naj->nij", q, q)),
    ]  # fmt: skip
    count = model.vertex_count
    matrix = scipy.sparse.diags_array(weights, format="csc")
    for stencils, blocks in parts:
        rows, columns = np.broadcast_arrays(stencils[:, :, None], stencils[:, None, :])
        entries = (_SHARE * blocks.ravel(), (rows.ravel(), columns.ravel()))
        matrix = matrix + scipy.sparse.coo_array(entries, shape=(count, count)).tocsc()
    matrix.eliminate_zeros()  # places of patches that have no vertex
    return matrix


def factorise(matrix: scipy.sparse.csc_array, free: np.ndarray) -> Factor:
    """Of the rows and columns of the free vertices, in an order of little fill."""
    part = matrix[free][:, free].tocsc()
    found = scipy.sparse.linalg.splu(
        part, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    lower = scipy.sparse.tril(found.L, -1).tocsc()
    lower.sort_indices()
    return Factor(
        np.ascontiguousarray(free[np.argsort(found.perm_c)], np.int32),
        np.ascontiguousarray(lower.indptr, np.int32),
        np.ascontiguousarray(lower.indices, np.int32),
        np.ascontiguousarray(lower.data),
        1.0 / found.U.diagonal(),
    )
