"""Slow, obvious references for the rasteriser: exact point-in-triangle tests and ray casting."""

from __future__ import annotations

from fractions import Fraction

import numpy as np


def covered_pixels(corners, width, height):
    """(H, W) bool: pixels of one triangle, in exact arithmetic, for (3, 2) pixel positions with y down.

    A centre on an edge belongs to a top or left edge exactly when the centre, moved right by an infinitesimal step and
    down by a step infinitely smaller still, lies strictly inside.
    """
    p = [(Fraction(float(x)), Fraction(float(y))) for x, y in corners]
    area = (p[1][0] - p[0][0]) * (p[2][1] - p[0][1]) - (p[2][0] - p[0][0]) * (p[1][1] - p[0][1])
    covered = np.zeros((height, width), bool)
    if area == 0:
        return covered
    sign = 1 if area > 0 else -1
    for row in range(height):
        for column in range(width):
            x, y = Fraction(2 * column + 1, 2), Fraction(2 * row + 1, 2)
            inside = True
            for k in range(3):
                (ax, ay), (bx, by) = p[k], p[(k + 1) % 3]
                value = sign * ((bx - ax) * (y - ay) - (by - ay) * (x - ax))
                moved_right, moved_down = -sign * (by - ay), sign * (bx - ax)
                inside = inside and (value, moved_right, moved_down) > (0, 0, 0)
            covered[row, column] = inside
    return covered


def cast_rays(vertices, faces, rays, width, height, near):
    """Every hit of the ray through each pixel centre with each triangle, in float64.

    Returns:
        depth (F, H, W), +inf where missed; barycentrics (F, H, W, 3); clearance (F, H, W), the smallest barycentric,
        negative where missed; front (F, H, W) bool.
    """
    i, j = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    origin = rays[0] + i[..., None] * rays[1] + j[..., None] * rays[2]
    direction = rays[3] + i[..., None] * rays[4] + j[..., None] * rays[5]
    a, b, c = (vertices[faces[:, k]][:, None, None, :] for k in range(3))
    normal = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (direction * normal).sum(-1)
        depth = ((a - origin) * normal).sum(-1) / slope
        point = origin + depth[..., None] * direction
        square = (normal**2).sum(-1)
        wb = (np.cross(point - a, c - a) * normal).sum(-1) / square
        wc = (np.cross(b - a, point - a) * normal).sum(-1) / square
    barycentrics = np.stack([1 - wb - wc, wb, wc], axis=-1)
    clearance = np.where(np.isfinite(depth), barycentrics.min(-1), -np.inf)
    depth = np.where((clearance >= 0) & (depth >= near), depth, np.inf)
    return depth, barycentrics, clearance, slope < 0
