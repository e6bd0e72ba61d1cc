"""The body in image space [Vassilev 2001, section 5]: three planes per texel instead of a depth and a normal.

A texel of the map, seen along z, holds the tangent plane of the front of the body, that of its back, and that of the
nearest piece of its outline. A point is inside where it lies behind all three, at a depth z that the body has
thereabouts: a plane holds near its texel only, and steep ones would reach far in front of the body and behind it.
Distances are measured along the normals, so the tolerance is the same in front, at the back and at the sides; with the
paper's depth along z it vanishes there, and without the outline's plane surfaces that run along z have no normal: the
top of a table seen from its front, a foot, a shoulder.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.raster import face_normal


class BodyMap(NamedTuple):
    """What queries read."""

    planes: NDArray  # (rows * columns, 12) float32: normal and offset of front, back and outline; front inf = nothing
    bounds: NDArray  # (rows * columns, 2) float32: least and greatest z - middle of the body around each texel [m]
    rows: int
    columns: int
    left: float  # x of the left border [m]
    bottom: float  # y of the lower border [m]
    middle: float  # z that offsets are measured from [m]
    pixel: float  # size of a texel [m]


@kernel
def planes_of_layers(vertices, normals, faces, layers, frame, interpolate, planes, depths):
    """Tangent planes from what the rasteriser left: the point by barycentrics, and a normal.

    Args:
        vertices, normals: (V, 3) float64.
        faces: (F, 3) int32.
        layers: two `raster.Layers`, row 0 at the top.
        frame: (4,) left, bottom, middle [m], pixel [m].
        interpolate: normals of the vertices interpolated and renormalised, as the paper has them; otherwise the face's own.
        planes: (rows * columns, 12) float32, of which front and back are written; row 0 at the bottom.
        depths: (2, rows, columns) float32, written: z - middle of the front and of the back [m]; -inf, inf = nothing.
    """
    _, rows, columns = layers.depth.shape
    left, bottom, middle = frame[0], frame[1], frame[2]
    for row in range(rows):
        for column in range(columns):
            texel = row * columns + column
            # coverage is exact, so a closed surface has both sides or none; one side alone is a hole in it
            seen = layers.triangle[0, rows - 1 - row, column] >= 0 and layers.triangle[1, rows - 1 - row, column] >= 0
            for side in range(2):
                at = 4 * side
                outwards = 1.0 - 2.0 * side
                if not seen:
                    planes[texel, at] = 0.0
                    planes[texel, at + 1] = 0.0
                    planes[texel, at + 2] = 0.0
                    planes[texel, at + 3] = np.inf
                    depths[side, row, column] = -outwards * np.inf
                    continue
                face = layers.triangle[side, rows - 1 - row, column]
                wb = np.float64(layers.barycentrics[side, rows - 1 - row, column, 0])
                wc = np.float64(layers.barycentrics[side, rows - 1 - row, column, 1])
                wa = 1.0 - wb - wc
                a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                if interpolate:
                    nx = wa * normals[a, 0] + wb * normals[b, 0] + wc * normals[c, 0]
                    ny = wa * normals[a, 1] + wb * normals[b, 1] + wc * normals[c, 1]
                    nz = wa * normals[a, 2] + wb * normals[b, 2] + wc * normals[c, 2]
                else:
                    nx, ny, nz = face_normal(vertices, faces, face)
                # what is seen faces the view; interpolated normals at the outline may not
                nz = outwards * max(0.0, outwards * nz)
                size = math.sqrt(nx * nx + ny * ny + nz * nz)
                if size < 1e-12:  # normals that cancel: look along the view
                    nx, ny, nz, size = 0.0, 0.0, outwards, 1.0
                nx /= size
                ny /= size
                nz /= size
                x = wa * vertices[a, 0] + wb * vertices[b, 0] + wc * vertices[c, 0] - left
                y = wa * vertices[a, 1] + wb * vertices[b, 1] + wc * vertices[c, 1] - bottom
                z = wa * vertices[a, 2] + wb * vertices[b, 2] + wc * vertices[c, 2] - middle
                depths[side, row, column] = np.float32(z)
                planes[texel, at] = np.float32(nx)
                planes[texel, at + 1] = np.float32(ny)
                planes[texel, at + 2] = np.float32(nz)
                planes[texel, at + 3] = np.float32(-(nx * x + ny * y + nz * z))


@device
def texel_of(x, y, body):
    """Number of the texel above which a point lies, -1 outside the map."""
    column = math.floor((x - body.left) / body.pixel)
    row = math.floor((y - body.bottom) / body.pixel)
    if column < 0.0 or row < 0.0 or column >= body.columns or row >= body.rows:
        return -1
    return np.int64(row) * body.columns + np.int64(column)


@device
def plane_distance(x, y, z, texel, side, body):
    """Signed distance [m] to the plane of the front (side 0), back (1) or outline (2) of a texel; front inf: there is none."""
    at = 4 * side
    planes = body.planes
    return (
        planes[texel, at] * (x - body.left)
        + planes[texel, at + 1] * (y - body.bottom)
        + planes[texel, at + 2] * (z - body.middle)
        + planes[texel, at + 3]
    )


@device
def side_of(x, y, z, body):
    """The side of the body that a point is on: 0 front, 1 back, -1 = above no part of it."""
    texel = texel_of(x, y, body)
    if texel < 0:
        return -1
    front = plane_distance(x, y, z, texel, 0, body)
    if front == np.inf:
        return -1
    if z - body.middle > body.bounds[texel, 1]:
        return 0
    if z - body.middle < body.bounds[texel, 0]:
        return 1
    return 0 if front >= plane_distance(x, y, z, texel, 1, body) else 1


@device
def find_plane(x, y, z, came_from, body, tolerance):
    """Whether a point lies within the tolerance of the body or inside it: texel and side of the plane to respond along,
    and the signed distance to it; texel -1 = outside.

    The plane is that of the side that the point came from (`side_of` before it moved), so that no point is pushed
    through a limb to its far side; the nearer one where that is unknown. The outline's, if that is nearer than both.
    """
    texel = texel_of(x, y, body)
    if texel < 0:
        return -1, 0, 0.0
    height = z - body.middle
    if height > body.bounds[texel, 1] + tolerance or height < body.bounds[texel, 0] - tolerance:
        return -1, 0, 0.0
    front = plane_distance(x, y, z, texel, 0, body)
    if front >= tolerance:
        return -1, 0, 0.0
    back = plane_distance(x, y, z, texel, 1, body)
    if back >= tolerance:
        return -1, 0, 0.0
    outline = plane_distance(x, y, z, texel, 2, body)
    if outline >= tolerance:
        return -1, 0, 0.0
    if outline > front and outline > back:
        return texel, 2, outline
    if came_from == 0 or (came_from < 0 and front >= back):
        return texel, 0, front
    return texel, 1, back


@kernel
def query(points, body, tolerance, distances, normals):
    """The map's answer for points (N, 3): signed distance [m] to the nearest plane and its normal; inf, zero outside.

    Returns how many lie within the tolerance or inside.
    """
    found = 0
    for i in range(points.shape[0]):
        texel, side, distance = find_plane(points[i, 0], points[i, 1], points[i, 2], -1, body, tolerance)
        distances[i] = np.inf
        for c in range(3):
            normals[i, c] = 0.0
        if texel < 0:
            continue
        found += 1
        distances[i] = distance
        for c in range(3):
            normals[i, c] = body.planes[texel, 4 * side + c]
    return found
