"""Bending of triangle meshes: by hinge angles, or quadratic in the positions.

The curvature of a triangle is that of Morley's element for plates: S = sum_i t_i (l_i / A) m_i m_i^T over its edges with
length l and outward normal m, where t_i is the angle from the plane of the triangle to the surface at the edge. The hinge
angle T of an edge is split between its two triangles, t = T/2 + p on one side and T/2 - p on the other. Morley's element
finds p by solving for all edges together. Here p is read off the five hinges of both triangles, by the least weights that
are right for every quadratic surface. A triangle with area A then holds

    A/2 (B_u S_uu^2 + B_v S_vv^2 + 2 sqrt(B_u B_v) S_uv^2)

This is exact for quadratic surfaces on every mesh, and constant curvature is in equilibrium on every mesh, because both
parts of an angle sum to it. The usual energies fail one or the other and stay off under refinement: single hinges
[Grinspun 2003] depend on the direction of the grid by a factor of 3, equal halves [Grinspun 2006] are 10 % too stiff on
irregular triangles (docs/materials.md has the numbers). At a free border the curvature that no hinge tells is the least.

For a cloth that is flat at rest and does not stretch, the second derivatives of the positions are curvatures times the
normal; with the jumps of slope, which are linear in the positions, in place of the angles, the energy becomes
1/2 sum_a |W_a x|^2 with a constant Hessian: the idea of [Bergou 2006] with the weights above.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.vec3 import cross, dot, solve3


class HingeArrays(NamedTuple):
    """Hinges and the patches of triangles that couple them; constant while a simulation lives.

    A patch is a triangle with its neighbours: stencil vertices 0, 1, 2, then those across edges (0,1), (1,2), (2,0), then
    two beyond each neighbour. What is missing at a border repeats vertex 0 and has no weight.
    """

    vertices: NDArray  # (H, 4) int32: edge a, b; c and d opposite
    rest: NDArray  # (H,) [rad]
    stencils: NDArray  # (N, 12) int32
    hinges: NDArray  # (N, 9) int32: of the triangle's own edges, then two of each neighbour
    local: NDArray  # (N, 9, 4) int32: places of the hinges' vertices in the stencil
    weights: NDArray  # (N, 3, 9) [(N m)^(1/2)]: energy 1/2 sum_a (sum_h weights[n, a, h] angle_h)^2
    reach: NDArray  # (N,) int32: hinges with weight are among the first 3 or 9


class QuadraticArrays(NamedTuple):
    """Patches that bend by second differences; constant while a simulation lives."""

    stencils: NDArray  # (N, 12) int32, as above
    weights: NDArray  # (N, 3, 12) [(N/m)^(1/2)]: energy 1/2 sum_a |sum_p weights[n, a, p] x_p|^2
    reach: NDArray  # (N,) int32: vertices with weight are among the first 6 or 12


NO_HINGES = HingeArrays(
    np.zeros((0, 4), np.int32), np.zeros(0), np.zeros((0, 12), np.int32), np.zeros((0, 9), np.int32),
    np.zeros((0, 9, 4), np.int32), np.zeros((0, 3, 9)), np.zeros(0, np.int32),
)  # fmt: skip
NO_QUADRATIC = QuadraticArrays(np.zeros((0, 12), np.int32), np.zeros((0, 3, 12)), np.zeros(0, np.int32))


@device
def hinge_angle(x, a, b, c, d, g):
    """Signed angle [rad] of the hinge between triangles (a, b, c) and (b, a, d), and its gradient.

    Zero when flat, positive when d rises to the side that the normal of (a, b, c) points to; in (-pi, pi).

    Args:
        x: (V, 3) [m].
        g: (4, 3) [1/m], written: gradient by a, b, c, d.

    Returns:
        The angle, and whether there is one: a triangle without area has none, and its gradient is zero.
    """
    ex = x[b, 0] - x[a, 0]
    ey = x[b, 1] - x[a, 1]
    ez = x[b, 2] - x[a, 2]
    cx = x[c, 0] - x[a, 0]
    cy = x[c, 1] - x[a, 1]
    cz = x[c, 2] - x[a, 2]
    dx = x[d, 0] - x[a, 0]
    dy = x[d, 1] - x[a, 1]
    dz = x[d, 2] - x[a, 2]
    nx, ny, nz = cross(ex, ey, ez, cx, cy, cz)
    mx, my, mz = cross(dx, dy, dz, ex, ey, ez)
    edge = ex * ex + ey * ey + ez * ez
    nn = nx * nx + ny * ny + nz * nz
    mm = mx * mx + my * my + mz * mz
    # areas below 1e-12 of the squared edge are rounding errors
    least = 1e-24 * edge * edge
    if nn <= least or mm <= least:
        for v in range(4):
            g[v, 0] = 0.0
            g[v, 1] = 0.0
            g[v, 2] = 0.0
        return 0.0, False
    size = math.sqrt(edge)
    tx, ty, tz = cross(mx, my, mz, nx, ny, nz)
    angle = math.atan2(dot(tx, ty, tz, ex, ey, ez) / size, dot(nx, ny, nz, mx, my, mz))
    tc = dot(cx, cy, cz, ex, ey, ez) / edge
    td = dot(dx, dy, dz, ex, ey, ez) / edge
    nn = size / nn
    mm = size / mm
    g[2, 0] = nn * nx
    g[2, 1] = nn * ny
    g[2, 2] = nn * nz
    g[3, 0] = mm * mx
    g[3, 1] = mm * my
    g[3, 2] = mm * mz
    for k in range(3):
        g[0, k] = -(1.0 - tc) * g[2, k] - (1.0 - td) * g[3, k]
        g[1, k] = -tc * g[2, k] - td * g[3, k]
    return angle, True


@device
def turn_hinges(x, hinges, turned, g):
    """Angles minus rest angles of all hinges into turned (H,), their gradients into g (H, 4, 3)."""
    for h in range(hinges.vertices.shape[0]):
        v = hinges.vertices[h]
        angle, proper = hinge_angle(x, v[0], v[1], v[2], v[3], g[h])
        turned[h] = angle - hinges.rest[h] if proper else 0.0


@device
def patch_rows(hinges, n, turned, g, rows, c):
    """Curvature terms c (3,) of patch n [(N m)^(1/2)] and their gradients by the stencil into rows (3, 12, 3)."""
    reach = hinges.reach[n]
    weights = hinges.weights[n]
    rows[:] = 0.0
    c[:] = 0.0
    for k in range(reach):
        h = hinges.hinges[n, k]
        for a in range(3):
            weight = weights[a, k]
            c[a] += weight * turned[h]
            for v in range(4):
                at = hinges.local[n, k, v]
                rows[a, at, 0] += weight * g[h, v, 0]
                rows[a, at, 1] += weight * g[h, v, 1]
                rows[a, at, 2] += weight * g[h, v, 2]


@device
def hinge_energy(x, hinges):
    """[J]."""
    count = hinges.vertices.shape[0]
    turned = np.empty(count)
    turn_hinges(x, hinges, turned, np.empty((count, 4, 3)))
    total = 0.0
    for n in range(hinges.stencils.shape[0]):
        for a in range(3):
            c = 0.0
            for k in range(hinges.reach[n]):
                c += hinges.weights[n, a, k] * turned[hinges.hinges[n, k]]
            total += 0.5 * c * c
    return total


@device
def add_hinge_forces(x, hinges, f):
    """Adds minus the gradient of the energy to f (V, 3) [N]."""
    count = hinges.vertices.shape[0]
    if count == 0:
        return
    turned = np.empty(count)
    g = np.empty((count, 4, 3))
    turn_hinges(x, hinges, turned, g)
    moments = np.zeros(count)
    for n in range(hinges.stencils.shape[0]):
        weights = hinges.weights[n]
        for a in range(3):
            c = 0.0
            for k in range(hinges.reach[n]):
                c += weights[a, k] * turned[hinges.hinges[n, k]]
            for k in range(hinges.reach[n]):
                moments[hinges.hinges[n, k]] += weights[a, k] * c
    for h in range(count):
        for v in range(4):
            i = hinges.vertices[h, v]
            f[i, 0] -= moments[h] * g[h, v, 0]
            f[i, 1] -= moments[h] * g[h, v, 1]
            f[i, 2] -= moments[h] * g[h, v, 2]


@device
def project_hinges(p, hinges, w, dt, multipliers, first):
    """One Gauss-Seidel sweep of XPBD; the three curvatures of a patch are solved together.

    The terms have unit compliance, since their weights hold the rigidity: (1 + dt^2 J W J^T) change = -(multipliers +
    dt^2 c). Angles and gradients are those at the start of the sweep; within it, angles change along their gradients.

    Args:
        p: (V, 3) [m], changed.
        w: (V,) inverse masses [1/kg].
        multipliers: (C,) [(N m)^(1/2) s^2]; three a patch from `first` on.
    """
    count = hinges.vertices.shape[0]
    if count == 0:
        return
    turned = np.empty(count)
    g = np.empty((count, 4, 3))
    turn_hinges(p, hinges, turned, g)
    start = p.copy()
    rows = np.empty((3, 12, 3))
    c = np.empty(3)
    square = dt * dt
    for n in range(hinges.stencils.shape[0]):
        stencil = hinges.stencils[n]
        patch_rows(hinges, n, turned, g, rows, c)
        size = 6 if hinges.reach[n] == 3 else 12
        m00 = 0.0
        m01 = 0.0
        m02 = 0.0
        m11 = 0.0
        m12 = 0.0
        m22 = 0.0
        for v in range(size):
            i = stencil[v]
            wv = square * w[i]
            for axis in range(3):
                r0 = rows[0, v, axis]
                r1 = rows[1, v, axis]
                r2 = rows[2, v, axis]
                m00 += wv * r0 * r0
                m01 += wv * r0 * r1
                m02 += wv * r0 * r2
                m11 += wv * r1 * r1
                m12 += wv * r1 * r2
                m22 += wv * r2 * r2
                moved = p[i, axis] - start[i, axis]
                c[0] += r0 * moved
                c[1] += r1 * moved
                c[2] += r2 * moved
        at = first + 3 * n
        z0, z1, z2 = solve3(
            1.0 + m00, m01, m02, m01, 1.0 + m11, m12, m02, m12, 1.0 + m22,
            -multipliers[at] - square * c[0], -multipliers[at + 1] - square * c[1], -multipliers[at + 2] - square * c[2],
        )  # fmt: skip
        multipliers[at] += z0
        multipliers[at + 1] += z1
        multipliers[at + 2] += z2
        for v in range(size):
            i = stencil[v]
            for axis in range(3):
                p[i, axis] += w[i] * (z0 * rows[0, v, axis] + z1 * rows[1, v, axis] + z2 * rows[2, v, axis])


@kernel
def hinge_rows(x, cloth, rows):
    """Factors of `hinge_hessian`: blocks[n, i, j] = sum_a rows[n, a, i] rows[n, a, j]^T.

    Args:
        x: (V, 3) [m].
        cloth: `ClothArrays`; stencils are cloth.hinges.stencils (N, 12).
        rows: (N, 3, 12, 3) [(N/m)^(1/2)], written.
    """
    hinges = cloth.hinges
    count = hinges.vertices.shape[0]
    turned = np.empty(count)
    g = np.empty((count, 4, 3))
    turn_hinges(x, hinges, turned, g)
    c = np.empty(3)
    for n in range(hinges.stencils.shape[0]):
        patch_rows(hinges, n, turned, g, rows[n], c)


@kernel
def hinge_hessian(x, cloth, blocks):
    """Second derivatives of the hinge energy, positive semi-definite (Gauss-Newton: exact at the rest angles).

    Args:
        x: (V, 3) [m].
        cloth: `ClothArrays`; stencils are cloth.hinges.stencils (N, 12).
        blocks: (N, 12, 12, 3, 3) [N/m], written: blocks[n, i, j] = d^2 E / dx_i dx_j.
    """
    hinges = cloth.hinges
    count = hinges.vertices.shape[0]
    turned = np.empty(count)
    g = np.empty((count, 4, 3))
    turn_hinges(x, hinges, turned, g)
    rows = np.empty((3, 12, 3))
    c = np.empty(3)
    for n in range(hinges.stencils.shape[0]):
        patch_rows(hinges, n, turned, g, rows, c)
        for i in range(12):
            for j in range(12):
                for r in range(3):
                    for s in range(3):
                        blocks[n, i, j, r, s] = (
                            rows[0, i, r] * rows[0, j, s]
                            + rows[1, i, r] * rows[1, j, s]
                            + rows[2, i, r] * rows[2, j, s]
                        )


@device
def quadratic_energy(x, quadratic):
    """[J]."""
    total = 0.0
    for n in range(quadratic.stencils.shape[0]):
        for a in range(3):
            for axis in range(3):
                c = 0.0
                for v in range(quadratic.reach[n]):
                    c += quadratic.weights[n, a, v] * x[quadratic.stencils[n, v], axis]
                total += 0.5 * c * c
    return total


@device
def add_quadratic_forces(x, quadratic, f):
    """Adds minus the gradient of the energy to f (V, 3) [N]."""
    for n in range(quadratic.stencils.shape[0]):
        stencil = quadratic.stencils[n]
        for a in range(3):
            weights = quadratic.weights[n, a]
            for axis in range(3):
                c = 0.0
                for v in range(quadratic.reach[n]):
                    c += weights[v] * x[stencil[v], axis]
                for v in range(quadratic.reach[n]):
                    f[stencil[v], axis] -= weights[v] * c


@device
def project_quadratic(p, quadratic, w, dt, multipliers, first):
    """One Gauss-Seidel sweep of XPBD; the three second differences of a patch are solved together, axis by axis.

    Args:
        p: (V, 3) [m], changed.
        w: (V,) inverse masses [1/kg].
        multipliers: (C,) [N^(1/2) m^(1/2) s^2]; nine a patch from `first` on.
    """
    square = dt * dt
    for n in range(quadratic.stencils.shape[0]):
        stencil = quadratic.stencils[n]
        weights = quadratic.weights[n]
        m00 = 0.0
        m01 = 0.0
        m02 = 0.0
        m11 = 0.0
        m12 = 0.0
        m22 = 0.0
        for v in range(quadratic.reach[n]):
            wv = square * w[stencil[v]]
            m00 += wv * weights[0, v] * weights[0, v]
            m01 += wv * weights[0, v] * weights[1, v]
            m02 += wv * weights[0, v] * weights[2, v]
            m11 += wv * weights[1, v] * weights[1, v]
            m12 += wv * weights[1, v] * weights[2, v]
            m22 += wv * weights[2, v] * weights[2, v]
        for axis in range(3):
            c0 = 0.0
            c1 = 0.0
            c2 = 0.0
            for v in range(quadratic.reach[n]):
                at = p[stencil[v], axis]
                c0 += weights[0, v] * at
                c1 += weights[1, v] * at
                c2 += weights[2, v] * at
            row = first + 9 * n + 3 * axis
            r0, r1, r2 = solve3(
                1.0 + m00, m01, m02, m01, 1.0 + m11, m12, m02, m12, 1.0 + m22,
                -multipliers[row] - square * c0,
                -multipliers[row + 1] - square * c1,
                -multipliers[row + 2] - square * c2,
            )  # fmt: skip
            multipliers[row] += r0
            multipliers[row + 1] += r1
            multipliers[row + 2] += r2
            for v in range(quadratic.reach[n]):
                p[stencil[v], axis] += w[stencil[v]] * (weights[0, v] * r0 + weights[1, v] * r1 + weights[2, v] * r2)


@kernel
def quadratic_hessian(cloth, blocks):
    """Second derivatives of the quadratic bending energy: constant, positive semi-definite, exact.

    Args:
        cloth: `ClothArrays`; stencils are cloth.quadratic.stencils (N, 12).
        blocks: (N, 12, 12, 3, 3) [N/m], written: a multiple of the identity each.
    """
    quadratic = cloth.quadratic
    for n in range(quadratic.stencils.shape[0]):
        weights = quadratic.weights[n]
        for i in range(12):
            for j in range(12):
                value = weights[0, i] * weights[0, j] + weights[1, i] * weights[1, j] + weights[2, i] * weights[2, j]
                for r in range(3):
                    for s in range(3):
                        blocks[n, i, j, r, s] = value if r == s else 0.0
