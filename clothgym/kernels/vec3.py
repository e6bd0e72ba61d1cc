"""Three-component vector algebra on scalars: numba keeps tuples of floats in registers."""

from __future__ import annotations

import math

from clothgym._jit import device


@device
def dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@device
def cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@device
def length(ax, ay, az):
    return math.sqrt(ax * ax + ay * ay + az * az)


@device
def unit(ax, ay, az):
    """Unit vector and the length; a zero vector stays zero."""
    n = math.sqrt(ax * ax + ay * ay + az * az)
    if n == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    return ax / n, ay / n, az / n, n


@device
def triangle_normal(x, a, b, c):
    """Unit normal of triangle (a, b, c) and twice its area; a zero-area triangle gives a zero normal."""
    ux = x[b, 0] - x[a, 0]
    uy = x[b, 1] - x[a, 1]
    uz = x[b, 2] - x[a, 2]
    wx = x[c, 0] - x[a, 0]
    wy = x[c, 1] - x[a, 1]
    wz = x[c, 2] - x[a, 2]
    nx, ny, nz = cross(ux, uy, uz, wx, wy, wz)
    return unit(nx, ny, nz)


@device
def solve3(a00, a01, a02, a10, a11, a12, a20, a21, a22, b0, b1, b2):
    """Three linear equations a z = b by Cramer's rule; the caller makes sure that a is regular."""
    c0 = a11 * a22 - a12 * a21
    c1 = a12 * a20 - a10 * a22
    c2 = a10 * a21 - a11 * a20
    scale = 1.0 / (a00 * c0 + a01 * c1 + a02 * c2)
    z0 = b0 * c0 + b1 * (a02 * a21 - a01 * a22) + b2 * (a01 * a12 - a02 * a11)
    z1 = b0 * c1 + b1 * (a00 * a22 - a02 * a20) + b2 * (a02 * a10 - a00 * a12)
    z2 = b0 * c2 + b1 * (a01 * a20 - a00 * a21) + b2 * (a00 * a11 - a01 * a10)
    return z0 * scale, z1 * scale, z2 * scale
