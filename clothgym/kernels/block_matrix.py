"""Symmetric matrices of 3 x 3 blocks: second derivatives of all energies, and their products with vectors.

Second derivatives are made positive semidefinite element by element. The diagonal is kept, and what stands right of it in
rows. Pins have no equations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numpy.typing import NDArray

from clothgym._jit import device
from clothgym.kernels.anchors import pull
from clothgym.kernels.bending import hinge_rows
from clothgym.kernels.membrane import membrane_hessian


class BlockMatrix(NamedTuple):
    """A symmetric matrix of 3 x 3 blocks, and where each element's blocks go in it.

    The block (a, b) of an element with n vertices goes by slots (N, n, n): 0 .. P - 1 to the blocks, -2 - i to the diagonal of
    vertex i, and -1 nowhere: the mirror image is not kept, and pins have no equations.
    """

    rows: NDArray  # (V + 1,) int32: blocks rows[i] .. rows[i + 1] stand right of the diagonal in row i
    columns: NDArray  # (P,) int32
    diagonal: NDArray  # (V, 3, 3) [N/m]
    blocks: NDArray  # (P, 3, 3) [N/m]
    inverses: NDArray  # (V, 3, 3) of the diagonal's blocks [m/N]
    spring_slots: NDArray  # (S, 2, 2) int32
    membrane_slots: NDArray  # (M, 3, 3) int32
    membrane_blocks: NDArray  # (M, 3, 3, 3, 3) [N/m] of the elements
    hinge_slots: NDArray  # (N, 12, 12) int32
    hinge_rows: NDArray  # (N, 3, 12, 3) [(N/m)^(1/2)]: a block is the sum of products of rows
    quadratic_diagonal: NDArray  # (V,) [N/m]: what quadratic bending adds, constant; (0,) without
    quadratic_blocks: NDArray  # (P,) [N/m]


@device
def clear(weights, matrix):
    """The matrix of the inertia alone; the rows of pins are those of the identity."""
    matrix.blocks[:] = 0.0
    matrix.diagonal[:] = 0.0
    for i in range(weights.shape[0]):
        for c in range(3):
            matrix.diagonal[i, c, c] = weights[i] if weights[i] > 0.0 else 1.0


@device
def add_springs(x, cloth, matrix):
    """`elastic.spring_hessian`, added without the detour of blocks for each spring: 4 times as fast."""
    ends = cloth.spring_ends
    diagonal = matrix.diagonal
    blocks = matrix.blocks
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        dx = x[j, 0] - x[i, 0]
        dy = x[j, 1] - x[i, 1]
        dz = x[j, 2] - x[i, 2]
        square = dx * dx + dy * dy + dz * dz
        if square == 0.0:
            continue
        k = cloth.spring_stiffness[s]
        across = max(0.0, k * (1.0 - cloth.spring_rest[s] / math.sqrt(square)))
        g = (k - across) / square
        xx = g * dx * dx + across
        yy = g * dy * dy + across
        zz = g * dz * dz + across
        xy = g * dx * dy
        xz = g * dx * dz
        yz = g * dy * dz
        for e in range(2):
            n = -2 - matrix.spring_slots[s, e, e]
            if n >= 0:
                diagonal[n, 0, 0] += xx
                diagonal[n, 0, 1] += xy
                diagonal[n, 0, 2] += xz
                diagonal[n, 1, 0] += xy
                diagonal[n, 1, 1] += yy
                diagonal[n, 1, 2] += yz
                diagonal[n, 2, 0] += xz
                diagonal[n, 2, 1] += yz
                diagonal[n, 2, 2] += zz
        n = max(matrix.spring_slots[s, 0, 1], matrix.spring_slots[s, 1, 0])
        if n >= 0:
            blocks[n, 0, 0] -= xx
            blocks[n, 0, 1] -= xy
            blocks[n, 0, 2] -= xz
            blocks[n, 1, 0] -= xy
            blocks[n, 1, 1] -= yy
            blocks[n, 1, 2] -= yz
            blocks[n, 2, 0] -= xz
            blocks[n, 2, 1] -= yz
            blocks[n, 2, 2] -= zz


@device
def add_blocks(elements, slots, matrix):
    """Adds the blocks of elements (N, n, n, 3, 3) where their slots say."""
    size = slots.shape[1]
    for e in range(slots.shape[0]):
        for a in range(size):
            for b in range(size):
                n = slots[e, a, b]
                if n == -1:
                    continue
                for r in range(3):
                    for c in range(3):
                        if n >= 0:
                            matrix.blocks[n, r, c] += elements[e, a, b, r, c]
                        else:
                            matrix.diagonal[-2 - n, r, c] += elements[e, a, b, r, c]


@device
def add_grips(x, grips, time, inverse_masses, matrix):
    """An anchor at its force limit has stiffness across the pull only."""
    for a in range(grips.vertices.shape[0]):
        v = grips.vertices[a]
        if inverse_masses[v] == 0.0:
            continue
        k, lacking, dx, dy, dz = pull(x, grips, time, a)
        d = (dx, dy, dz)
        for r in range(3):
            matrix.diagonal[v, r, r] += k
            for c in range(3):
                matrix.diagonal[v, r, c] -= k * lacking * d[r] * d[c]


@device
def invert_diagonal(matrix):
    """Inverses of the blocks on the diagonal, for the preconditioner."""
    for i in range(matrix.diagonal.shape[0]):
        a = matrix.diagonal[i]
        b = matrix.inverses[i]
        b[0, 0] = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
        b[0, 1] = a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2]
        b[0, 2] = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
        b[1, 1] = a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0]
        b[1, 2] = a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]
        b[2, 2] = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
        scale = 1.0 / (a[0, 0] * b[0, 0] + a[0, 1] * b[0, 1] + a[0, 2] * b[0, 2])
        b[0, 0] *= scale
        b[0, 1] *= scale
        b[0, 2] *= scale
        b[1, 1] *= scale
        b[1, 2] *= scale
        b[2, 2] *= scale
        b[1, 0] = b[0, 1]
        b[2, 0] = b[0, 2]
        b[2, 1] = b[1, 2]


@device
def _add_membrane(x, cloth, present, matrix):
    if present is None:
        return
    membrane_hessian(x, cloth, matrix.membrane_blocks)
    add_blocks(matrix.membrane_blocks, matrix.membrane_slots, matrix)


@device
def _add_hinges(x, cloth, present, matrix):
    if present is None:
        return
    hinge_rows(x, cloth, matrix.hinge_rows)
    slots = matrix.hinge_slots
    for e in range(slots.shape[0]):
        rows = matrix.hinge_rows[e]
        for a in range(12):
            for b in range(12):
                n = slots[e, a, b]
                if n == -1:
                    continue
                for r in range(3):
                    for c in range(3):
                        value = rows[0, a, r] * rows[0, b, c] + rows[1, a, r] * rows[1, b, c]
                        value += rows[2, a, r] * rows[2, b, c]
                        if n >= 0:
                            matrix.blocks[n, r, c] += value
                        else:
                            matrix.diagonal[-2 - n, r, c] += value


@device
def _add_quadratic(present, matrix):
    if present is None:
        return
    for i in range(matrix.quadratic_diagonal.shape[0]):
        for c in range(3):
            matrix.diagonal[i, c, c] += matrix.quadratic_diagonal[i]
    for n in range(matrix.quadratic_blocks.shape[0]):
        for c in range(3):
            matrix.blocks[n, c, c] += matrix.quadratic_blocks[n]


@device
def assemble(x, weights, cloth, grips, time, matrix):
    """The matrix at positions x: inertia, what the energies keep of their second derivatives, anchors of grippers."""
    clear(weights, matrix)
    add_springs(x, cloth, matrix)
    _add_membrane(x, cloth, cloth.has_membrane, matrix)
    _add_hinges(x, cloth, cloth.has_hinges, matrix)
    _add_quadratic(cloth.has_quadratic, matrix)
    add_grips(x, grips, time, cloth.inverse_masses, matrix)
    invert_diagonal(matrix)


@device
def multiply(matrix, z, out):
    """out = matrix z, both (V, 3); returns z . out."""
    rows = matrix.rows
    columns = matrix.columns
    diagonal = matrix.diagonal
    blocks = matrix.blocks
    count = z.shape[0]
    for i in range(count):
        x = z[i, 0]
        y = z[i, 1]
        w = z[i, 2]
        out[i, 0] = diagonal[i, 0, 0] * x + diagonal[i, 0, 1] * y + diagonal[i, 0, 2] * w
        out[i, 1] = diagonal[i, 1, 0] * x + diagonal[i, 1, 1] * y + diagonal[i, 1, 2] * w
        out[i, 2] = diagonal[i, 2, 0] * x + diagonal[i, 2, 1] * y + diagonal[i, 2, 2] * w
    total = 0.0
    for i in range(count):
        x = z[i, 0]
        y = z[i, 1]
        w = z[i, 2]
        ox = out[i, 0]
        oy = out[i, 1]
        oz = out[i, 2]
        for n in range(rows[i], rows[i + 1]):
            j = columns[n]
            xj = z[j, 0]
            yj = z[j, 1]
            wj = z[j, 2]
            b00 = blocks[n, 0, 0]
            b01 = blocks[n, 0, 1]
            b02 = blocks[n, 0, 2]
            b10 = blocks[n, 1, 0]
            b11 = blocks[n, 1, 1]
            b12 = blocks[n, 1, 2]
            b20 = blocks[n, 2, 0]
            b21 = blocks[n, 2, 1]
            b22 = blocks[n, 2, 2]
            ox += b00 * xj + b01 * yj + b02 * wj
            oy += b10 * xj + b11 * yj + b12 * wj
            oz += b20 * xj + b21 * yj + b22 * wj
            out[j, 0] += b00 * x + b10 * y + b20 * w
            out[j, 1] += b01 * x + b11 * y + b21 * w
            out[j, 2] += b02 * x + b12 * y + b22 * w
        out[i, 0] = ox
        out[i, 1] = oy
        out[i, 2] = oz
        total += x * ox + y * oy + w * oz
    return total
