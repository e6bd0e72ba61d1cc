"""What many vertices move together: the shift and the turn nearest to all their ways.

x goes to x + m + w x (x - c). Whatever m and w are, no distance gets shorter by that: |d + w x d| >= |d|. So what is known of
distances only wears off by what vertices move beside it.
"""

from __future__ import annotations

import math

from clothgym._jit import bare, kernel

BULK = 9
"""Numbers of a bulk: its centre [m], and the inverse of its inertia (of unit masses) [1/m^2]."""


@bare
def bulk_of(x, bulk):
    """Centre and inverse of the inertia (of unit masses) of positions x; an inverse of zero where they lie on a line."""
    cx = 0.0
    cy = 0.0
    cz = 0.0
    n = x.shape[0]
    for i in range(n):
        cx += x[i, 0]
        cy += x[i, 1]
        cz += x[i, 2]
    cx /= n
    cy /= n
    cz /= n
    xx = 0.0
    yy = 0.0
    zz = 0.0
    xy = 0.0
    xz = 0.0
    yz = 0.0
    for i in range(n):
        rx = x[i, 0] - cx
        ry = x[i, 1] - cy
        rz = x[i, 2] - cz
        xx += rx * rx
        yy += ry * ry
        zz += rz * rz
        xy -= rx * ry
        xz -= rx * rz
        yz -= ry * rz
    size = xx + yy + zz
    xx, yy, zz = yy + zz, xx + zz, xx + yy
    a = yy * zz - yz * yz
    b = xz * yz - xy * zz
    c = xy * yz - xz * yy
    det = xx * a + xy * b + xz * c
    scale = 1.0 / det if det > 1e-9 * size * size * size else 0.0
    bulk[0] = cx
    bulk[1] = cy
    bulk[2] = cz
    bulk[3] = scale * a
    bulk[4] = scale * b
    bulk[5] = scale * c
    bulk[6] = scale * (xx * zz - xz * xz)
    bulk[7] = scale * (xy * xz - xx * yz)
    bulk[8] = scale * (xx * yy - xy * xy)


@bare
def squares_of_ways(p, seen, bulk, squares):
    """Squares of how far each vertex has come from `seen`, less what all have on average; returns how far they turned [rad].

    The mean motion is the shift and the turn nearest to all ways (least squares); bulk: of `seen`.
    """
    cx = bulk[0]
    cy = bulk[1]
    cz = bulk[2]
    mx = 0.0
    my = 0.0
    mz = 0.0
    tx = 0.0
    ty = 0.0
    tz = 0.0
    n = p.shape[0]
    for i in range(n):
        dx = p[i, 0] - seen[i, 0]
        dy = p[i, 1] - seen[i, 1]
        dz = p[i, 2] - seen[i, 2]
        rx = seen[i, 0] - cx
        ry = seen[i, 1] - cy
        rz = seen[i, 2] - cz
        mx += dx
        my += dy
        mz += dz
        tx += ry * dz - rz * dy
        ty += rz * dx - rx * dz
        tz += rx * dy - ry * dx
    wx = bulk[3] * tx + bulk[4] * ty + bulk[5] * tz
    wy = bulk[4] * tx + bulk[6] * ty + bulk[7] * tz
    wz = bulk[5] * tx + bulk[7] * ty + bulk[8] * tz
    # shift at the origin instead of the centre
    mx = mx / n - (wy * cz - wz * cy)
    my = my / n - (wz * cx - wx * cz)
    mz = mz / n - (wx * cy - wy * cx)
    for i in range(n):
        sx = seen[i, 0]
        sy = seen[i, 1]
        sz = seen[i, 2]
        dx = p[i, 0] - sx - mx - (wy * sz - wz * sy)
        dy = p[i, 1] - sy - my - (wz * sx - wx * sz)
        dz = p[i, 2] - sz - mz - (wx * sy - wy * sx)
        squares[i] = dx * dx + dy * dy + dz * dz
    return math.sqrt(wx * wx + wy * wy + wz * wz)


@bare
def roots(sizes):
    """The roots of squares, in their place; returns the greatest."""
    one = 0.0
    two = 0.0
    for i in range(sizes.shape[0]):
        size = math.sqrt(sizes[i])
        sizes[i] = size
        # two of them, for each comparison waits for the one before
        if i % 2 == 0:
            one = size if size > one else one
        else:
            two = size if size > two else two
    return one if one > two else two


@kernel
def slacks(x, end, share, least, bulk, slack):
    """Into slack (V,): `least` [m], and a share of how far each vertex goes from x to end (V, 3), or goes beside what all do if
    that is less: a few that are fast take the mean along.

    bulk (BULK,) is scratch.
    """
    bulk_of(x, bulk)
    squares_of_ways(end, x, bulk, slack)
    for i in range(slack.shape[0]):
        dx = end[i, 0] - x[i, 0]
        dy = end[i, 1] - x[i, 1]
        dz = end[i, 2] - x[i, 2]
        own = dx * dx + dy * dy + dz * dz
        slack[i] = least + share * math.sqrt(own if own < slack[i] else slack[i])
