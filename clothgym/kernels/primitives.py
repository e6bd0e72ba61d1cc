"""Pairs of primitives: edge against triangle (exact), closest points of point-triangle and of two edges."""

from __future__ import annotations

import math

from clothgym._jit import device
from clothgym.kernels.predicates import orient3d_sign


@device
def edge_hits_triangle(x, e0, e1, a0, a1, a2):
    """Whether edge (e0, e1) crosses triangle (a0, a1, a2), decided exactly, ties broken by vertex index.

    Returns (hit, plane value of e0, plane value of e1, edge values opposite a0, a1, a2); the last five are orient3d
    values [m^3] and only meaningful for a hit.
    """
    s0, d0 = orient3d_sign(x, a0, a1, a2, e0)
    s1, d1 = orient3d_sign(x, a0, a1, a2, e1)
    if s0 == s1:
        return False, d0, d1, 0.0, 0.0, 0.0
    q2, w2 = orient3d_sign(x, e0, e1, a0, a1)
    q0, w0 = orient3d_sign(x, e0, e1, a1, a2)
    if q0 != q2:
        return False, d0, d1, 0.0, 0.0, 0.0
    q1, w1 = orient3d_sign(x, e0, e1, a2, a0)
    if q1 != q2:
        return False, d0, d1, 0.0, 0.0, 0.0
    return True, d0, d1, w0, w1, w2


@device
def closest_on_triangle(x, v, a, b, c):
    """Barycentric weights (wa, wb, wc) of the point of triangle (a, b, c) closest to vertex v [Ericson 2005, 5.1.5]."""
    abx = x[b, 0] - x[a, 0]
    aby = x[b, 1] - x[a, 1]
    abz = x[b, 2] - x[a, 2]
    acx = x[c, 0] - x[a, 0]
    acy = x[c, 1] - x[a, 1]
    acz = x[c, 2] - x[a, 2]
    apx = x[v, 0] - x[a, 0]
    apy = x[v, 1] - x[a, 1]
    apz = x[v, 2] - x[a, 2]
    ux = aby * acz - abz * acy
    uy = abz * acx - abx * acz
    uz = abx * acy - aby * acx
    ab2 = abx * abx + aby * aby + abz * abz
    ac2 = acx * acx + acy * acy + acz * acz
    if ux * ux + uy * uy + uz * uz <= 1e-24 * max(ab2, ac2) ** 2:  # a sliver: nearest of its three sides
        best = math.inf
        r0, r1, r2 = 1.0, 0.0, 0.0
        for k in range(3):
            p = a if k == 0 else (b if k == 1 else c)
            q = b if k == 0 else (c if k == 1 else a)
            ex = x[q, 0] - x[p, 0]
            ey = x[q, 1] - x[p, 1]
            ez = x[q, 2] - x[p, 2]
            fx = x[v, 0] - x[p, 0]
            fy = x[v, 1] - x[p, 1]
            fz = x[v, 2] - x[p, 2]
            ee = ex * ex + ey * ey + ez * ez
            t = min(max((ex * fx + ey * fy + ez * fz) / ee, 0.0), 1.0) if ee > 0.0 else 0.0
            gx = fx - t * ex
            gy = fy - t * ey
            gz = fz - t * ez
            gap = gx * gx + gy * gy + gz * gz
            if gap < best:
                best = gap
                r0 = 1.0 - t if k == 0 else (0.0 if k == 1 else t)
                r1 = t if k == 0 else (1.0 - t if k == 1 else 0.0)
                r2 = 0.0 if k == 0 else (t if k == 1 else 1.0 - t)
        return r0, r1, r2
    d1 = abx * apx + aby * apy + abz * apz
    d2 = acx * apx + acy * apy + acz * apz
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    bpx = x[v, 0] - x[b, 0]
    bpy = x[v, 1] - x[b, 1]
    bpz = x[v, 2] - x[b, 2]
    d3 = abx * bpx + aby * bpy + abz * bpz
    d4 = acx * bpx + acy * bpy + acz * bpz
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and d1 - d3 > 0.0:
        t = d1 / (d1 - d3)
        return 1.0 - t, t, 0.0
    cpx = x[v, 0] - x[c, 0]
    cpy = x[v, 1] - x[c, 1]
    cpz = x[v, 2] - x[c, 2]
    d5 = abx * cpx + aby * cpy + abz * cpz
    d6 = acx * cpx + acy * cpy + acz * cpz
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0 and d2 - d6 > 0.0:
        t = d2 / (d2 - d6)
        return 1.0 - t, 0.0, t
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0 and (d4 - d3) + (d5 - d6) > 0.0:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - t, t
    total = va + vb + vc
    if total <= 0.0:  # a triangle without area that no edge region caught
        return 1.0, 0.0, 0.0
    return va / total, vb / total, vc / total


@device
def closest_on_edges(x, a0, a1, b0, b1):
    """Parameters (s, t) in [0, 1] of the closest points a0 + s (a1 - a0) and b0 + t (b1 - b0) of two edges."""
    ux = x[a1, 0] - x[a0, 0]
    uy = x[a1, 1] - x[a0, 1]
    uz = x[a1, 2] - x[a0, 2]
    vx = x[b1, 0] - x[b0, 0]
    vy = x[b1, 1] - x[b0, 1]
    vz = x[b1, 2] - x[b0, 2]
    rx = x[a0, 0] - x[b0, 0]
    ry = x[a0, 1] - x[b0, 1]
    rz = x[a0, 2] - x[b0, 2]
    a = ux * ux + uy * uy + uz * uz
    e = vx * vx + vy * vy + vz * vz
    f = vx * rx + vy * ry + vz * rz
    if a == 0.0 and e == 0.0:
        return 0.0, 0.0
    if a == 0.0:
        return 0.0, min(max(f / e, 0.0), 1.0)
    c = ux * rx + uy * ry + uz * rz
    if e == 0.0:
        return min(max(-c / a, 0.0), 1.0), 0.0
    b = ux * vx + uy * vy + uz * vz
    denominator = a * e - b * b
    s = 0.0
    if denominator > 1e-14 * a * e:
        s = min(max((b * f - c * e) / denominator, 0.0), 1.0)
    t = (b * s + f) / e
    if t < 0.0:
        t = 0.0
        s = min(max(-c / a, 0.0), 1.0)
    elif t > 1.0:
        t = 1.0
        s = min(max((b - c) / a, 0.0), 1.0)
    if denominator <= 1e-6 * a * e:  # nearly parallel: a, b, e say little about s; one of these five is the nearest
        nx = uy * vz - uz * vy
        ny = uz * vx - ux * vz
        nz = ux * vy - uy * vx
        nn = nx * nx + ny * ny + nz * nz
        best = math.inf
        bs = s
        bt = t
        for k in range(5):
            if k == 0:
                if nn == 0.0:
                    continue
                s = ((vy * rz - vz * ry) * nx + (vz * rx - vx * rz) * ny + (vx * ry - vy * rx) * nz) / nn
                t = ((uy * rz - uz * ry) * nx + (uz * rx - ux * rz) * ny + (ux * ry - uy * rx) * nz) / nn
                s = min(max(s, 0.0), 1.0)
                t = min(max(t, 0.0), 1.0)
            elif k < 3:
                s = float(k - 1)
                t = min(max((s * b + f) / e, 0.0), 1.0)
            else:
                t = float(k - 3)
                s = min(max((t * b - c) / a, 0.0), 1.0)
            gx = rx + s * ux - t * vx
            gy = ry + s * uy - t * vy
            gz = rz + s * uz - t * vz
            gap = gx * gx + gy * gy + gz * gz
            if gap < best:
                best = gap
                bs = s
                bt = t
        return bs, bt
    return s, t


@device
def vertex_triangle_distance(x, v, a, b, c):
    """Distance [m] of vertex v and triangle (a, b, c)."""
    wa, wb, wc = closest_on_triangle(x, v, a, b, c)
    dx = x[v, 0] - wa * x[a, 0] - wb * x[b, 0] - wc * x[c, 0]
    dy = x[v, 1] - wa * x[a, 1] - wb * x[b, 1] - wc * x[c, 1]
    dz = x[v, 2] - wa * x[a, 2] - wb * x[b, 2] - wc * x[c, 2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@device
def edge_edge_distance(x, a0, a1, b0, b1):
    """Distance [m] of two edges."""
    s, t = closest_on_edges(x, a0, a1, b0, b1)
    dx = x[a0, 0] + s * (x[a1, 0] - x[a0, 0]) - x[b0, 0] - t * (x[b1, 0] - x[b0, 0])
    dy = x[a0, 1] + s * (x[a1, 1] - x[a0, 1]) - x[b0, 1] - t * (x[b1, 1] - x[b0, 1])
    dz = x[a0, 2] + s * (x[a1, 2] - x[a0, 2]) - x[b0, 2] - t * (x[b1, 2] - x[b0, 2])
    return math.sqrt(dx * dx + dy * dy + dz * dz)
