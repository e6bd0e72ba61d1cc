"""Bending of a triangle and the three that share its edges: by hinge angles, or quadratic in the positions.

The six vertices of such a patch determine one quadratic height field, so the three hinge angles t of a triangle determine
its curvatures (k_uu, k_vv, k_uv) = P t, exactly for every quadratic surface over every mesh; the triangle then holds

    A/2 (B_u k_uu^2 + B_v k_vv^2 + 2 sqrt(B_u B_v) k_uv^2) = 1/2 (t - t0) . Q (t - t0)

with t0 the angles of the rest shape [Phaal 1992 takes such patches for plates; here with angles, so that turning is free].
An energy of single hinges [Grinspun 2003] cannot do that: on a grid of right triangles its stiffness depends on the
direction (see docs/materials.md for numbers). At a free border the curvature that no angle tells is the least one, which
is the state without moment.

For a cloth that is flat at rest and does not stretch, the second derivatives of the positions are curvatures times the
normal. P applied to the jumps of the slope, which are linear in the positions, gives the energy 1/2 sum_a |W_a x|^2 with
a constant Hessian: the idea of [Bergou 2006], with the weights of the patch.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.vec3 import cross, dot, solve3


class HingeArrays(NamedTuple):
    """Patches that bend by angles; constant while a simulation lives."""

    stencils: NDArray  # (N, 6) int32: triangle 0, 1, 2; then what lies across edges (0,1), (1,2), (2,0); none: vertex 0
    stiffness: NDArray  # (N, 6) [N m]: Q00, Q01, Q02, Q11, Q12, Q22; a hinge that is none has no stiffness
    rest: NDArray  # (N, 3) [rad]


class QuadraticArrays(NamedTuple):
    """Patches that bend by second differences; constant while a simulation lives."""

    stencils: NDArray  # (N, 6) int32, as above
    weights: NDArray  # (N, 3, 6) [(N/m)^(1/2)]: energy 1/2 sum_a |sum_p weights[n, a, p] x_p|^2


NO_HINGES = HingeArrays(np.zeros((0, 6), np.int32), np.zeros((0, 6)), np.zeros((0, 3)))
NO_QUADRATIC = QuadraticArrays(np.zeros((0, 6), np.int32), np.zeros((0, 3, 6)))


@device
def hinge_angle(x, a, b, c, d, g):
    """Signed angle [rad] of the hinge between triangles (a, b, c) and (b, a, d), and its gradient.

    Zero when flat, positive when d rises to the side that the normal of (a, b, c) points to; in (-pi, pi). A triangle
    without area has no angle: 0, without gradient.

    Args:
        x: (V, 3) [m].
        g: (4, 3) [1/m], written: gradient by a, b, c, d.
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
        return 0.0
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
    return angle


@device
def _patch_angles(x, stencil, stiffness, rest, g, turned):
    """Angles minus rest angles of a patch into turned (3,), their gradients by its six vertices into g (3, 6, 3)."""
    g[:] = 0.0
    one = np.empty((4, 3))
    for i in range(3):
        j = i + 1 if i < 2 else 0
        k = 3 - i - j
        turned[i] = 0.0
        if stiffness[5 if i == 2 else 3 * i] == 0.0:
            continue
        turned[i] = hinge_angle(x, stencil[i], stencil[j], stencil[k], stencil[3 + i], one) - rest[i]
        for axis in range(3):
            g[i, i, axis] = one[0, axis]
            g[i, j, axis] = one[1, axis]
            g[i, k, axis] = one[2, axis]
            g[i, 3 + i, axis] = one[3, axis]


@device
def hinge_energy(x, hinges):
    """[J]."""
    total = 0.0
    g = np.empty((3, 6, 3))
    t = np.empty(3)
    for n in range(hinges.stencils.shape[0]):
        q = hinges.stiffness[n]
        _patch_angles(x, hinges.stencils[n], q, hinges.rest[n], g, t)
        total += 0.5 * (q[0] * t[0] * t[0] + q[3] * t[1] * t[1] + q[5] * t[2] * t[2])
        total += q[1] * t[0] * t[1] + q[2] * t[0] * t[2] + q[4] * t[1] * t[2]
    return total


@device
def add_hinge_forces(x, hinges, f):
    """Adds minus the gradient of the energy to f (V, 3) [N]."""
    g = np.empty((3, 6, 3))
    t = np.empty(3)
    for n in range(hinges.stencils.shape[0]):
        stencil = hinges.stencils[n]
        q = hinges.stiffness[n]
        _patch_angles(x, stencil, q, hinges.rest[n], g, t)
        m0 = q[0] * t[0] + q[1] * t[1] + q[2] * t[2]
        m1 = q[1] * t[0] + q[3] * t[1] + q[4] * t[2]
        m2 = q[2] * t[0] + q[4] * t[1] + q[5] * t[2]
        for p in range(6):
            for axis in range(3):
                f[stencil[p], axis] -= m0 * g[0, p, axis] + m1 * g[1, p, axis] + m2 * g[2, p, axis]


@device
def project_hinges(p, hinges, w, dt, multipliers, first):
    """One Gauss-Seidel sweep of XPBD; the three angles of a patch are solved together, as in `project_membrane`.

    Args:
        p: (V, 3) [m], changed.
        w: (V,) inverse masses [1/kg].
        multipliers: (C,) [N m s^2]; three a patch from `first` on.
    """
    square = dt * dt
    g = np.empty((3, 6, 3))
    t = np.empty(3)
    for n in range(hinges.stencils.shape[0]):
        stencil = hinges.stencils[n]
        q = hinges.stiffness[n]
        _patch_angles(p, stencil, q, hinges.rest[n], g, t)
        m00 = 0.0
        m01 = 0.0
        m02 = 0.0
        m11 = 0.0
        m12 = 0.0
        m22 = 0.0
        for v in range(6):
            wv = w[stencil[v]]
            for axis in range(3):
                m00 += wv * g[0, v, axis] * g[0, v, axis]
                m01 += wv * g[0, v, axis] * g[1, v, axis]
                m02 += wv * g[0, v, axis] * g[2, v, axis]
                m11 += wv * g[1, v, axis] * g[1, v, axis]
                m12 += wv * g[1, v, axis] * g[2, v, axis]
                m22 += wv * g[2, v, axis] * g[2, v, axis]
        k00 = square * q[0]
        k01 = square * q[1]
        k02 = square * q[2]
        k11 = square * q[3]
        k12 = square * q[4]
        k22 = square * q[5]
        at = first + 3 * n
        r0, r1, r2 = solve3(
            1.0 + k00 * m00 + k01 * m01 + k02 * m02, k00 * m01 + k01 * m11 + k02 * m12, k00 * m02 + k01 * m12 + k02 * m22,
            k01 * m00 + k11 * m01 + k12 * m02, 1.0 + k01 * m01 + k11 * m11 + k12 * m12, k01 * m02 + k11 * m12 + k12 * m22,
            k02 * m00 + k12 * m01 + k22 * m02, k02 * m01 + k12 * m11 + k22 * m12, 1.0 + k02 * m02 + k12 * m12 + k22 * m22,
            -multipliers[at] - k00 * t[0] - k01 * t[1] - k02 * t[2],
            -multipliers[at + 1] - k01 * t[0] - k11 * t[1] - k12 * t[2],
            -multipliers[at + 2] - k02 * t[0] - k12 * t[1] - k22 * t[2],
        )  # fmt: skip
        multipliers[at] += r0
        multipliers[at + 1] += r1
        multipliers[at + 2] += r2
        for v in range(6):
            wv = w[stencil[v]]
            for axis in range(3):
                p[stencil[v], axis] += wv * (r0 * g[0, v, axis] + r1 * g[1, v, axis] + r2 * g[2, v, axis])


@kernel
def hinge_hessian(x, cloth, blocks):
    """Second derivatives of the hinge energy, positive semi-definite (Gauss-Newton: exact at the rest angles).

    Args:
        x: (V, 3) [m].
        cloth: `ClothArrays`; stencils are cloth.hinges.stencils (N, 6).
        blocks: (N, 6, 6, 3, 3) [N/m], written: blocks[n, i, j] = sum_ab Q_ab grad_i t_a grad_j t_b^T.
    """
    hinges = cloth.hinges
    g = np.empty((3, 6, 3))
    t = np.empty(3)
    h = np.empty((3, 6, 3))
    for n in range(hinges.stencils.shape[0]):
        q = hinges.stiffness[n]
        _patch_angles(x, hinges.stencils[n], q, hinges.rest[n], g, t)
        for i in range(6):
            for axis in range(3):
                h[0, i, axis] = q[0] * g[0, i, axis] + q[1] * g[1, i, axis] + q[2] * g[2, i, axis]
                h[1, i, axis] = q[1] * g[0, i, axis] + q[3] * g[1, i, axis] + q[4] * g[2, i, axis]
                h[2, i, axis] = q[2] * g[0, i, axis] + q[4] * g[1, i, axis] + q[5] * g[2, i, axis]
        for i in range(6):
            for j in range(6):
                for r in range(3):
                    for s in range(3):
                        blocks[n, i, j, r, s] = (
                            g[0, i, r] * h[0, j, s] + g[1, i, r] * h[1, j, s] + g[2, i, r] * h[2, j, s]
                        )


@device
def quadratic_energy(x, quadratic):
    """[J]."""
    total = 0.0
    for n in range(quadratic.stencils.shape[0]):
        for a in range(3):
            for axis in range(3):
                c = 0.0
                for v in range(6):
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
                for v in range(6):
                    c += weights[v] * x[stencil[v], axis]
                for v in range(6):
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
        for v in range(6):
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
            for v in range(6):
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
            for v in range(6):
                p[stencil[v], axis] += w[stencil[v]] * (weights[0, v] * r0 + weights[1, v] * r1 + weights[2, v] * r2)


@kernel
def quadratic_hessian(cloth, blocks):
    """Second derivatives of the quadratic bending energy: constant, positive semi-definite, exact.

    Args:
        cloth: `ClothArrays`; stencils are cloth.quadratic.stencils (N, 6).
        blocks: (N, 6, 6, 3, 3) [N/m], written: a multiple of the identity each.
    """
    quadratic = cloth.quadratic
    for n in range(quadratic.stencils.shape[0]):
        weights = quadratic.weights[n]
        for i in range(6):
            for j in range(6):
                value = weights[0, i] * weights[0, j] + weights[1, i] * weights[1, j] + weights[2, i] * weights[2, j]
                for r in range(3):
                    for s in range(3):
                        blocks[n, i, j, r, s] = value if r == s else 0.0
