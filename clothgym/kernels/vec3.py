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
