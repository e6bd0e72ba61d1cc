"""The body in image space [Vassilev 2001, section 5]: three planes per texel instead of a depth and a normal.

A texel of the map, seen along z, holds the tangent plane of the front of the body, that of its back, and that of the
nearest piece of its outline. A point is inside where it lies behind all three, at a depth z that the body has
thereabouts: a plane holds near its texel only, and steep ones would reach far in front of the body and behind it.
Distances are measured along the normals, so the tolerance is the same in front, at the back and at the sides; with the
paper's depth along z it vanishes there, and without the outline's plane surfaces that run along z have no normal: the
top of a table seen from its front, a foot, a shoulder.

What one pair of views cannot see, others may: a bowl is open for views along y. A point is inside where every pair says so,
and the answer is that of the pair that has it least deep.

Bodies that move are drawn where they will be at the end of a step, with the velocity of what each plane belongs to: within
the step planes stand where they were then.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import bare, inlined, kernel, spread
from clothgym.kernels.raster import face_normal

PLANES, DRIFT = 16, 12
"""Numbers a texel, and the first of the three speeds among them."""

FRONT, BACK = 1, 2
"""Sides of the body, two bits for each pair of views; 0 = beside it, unknown."""

_CANNOT_TELL = -2
_STEP, _STEP_PIXELS = 0.015, 3.0
"""[m] and pixels: so far behind what the body has nearby a point in front of its own texel may touch that."""
_SHALLOW = 0.25
"""Tolerances that such a point may be inside by another view: deeper, its own texel would show what it touches."""


class View(NamedTuple):
    """Where the texels of a pair of views lie: plain numbers, since kernels would count references to arrays in loops.

    Seen along an axis c, a point is at (a, b) with a = c + 1 and b = c + 2, cyclic; (x, y) for views along z.
    """

    first: int  # texel
    rows: int
    columns: int
    axis: int
    left: float  # [m]
    bottom: float  # [m]
    middle: float  # c that bounds are measured from [m]
    pixel: float  # size of a texel [m]


class BodyMap(NamedTuple):
    """What queries read. Texels of all views stand one after the other."""

    planes: NDArray
    """(N, 16) float32: normal and offset from the origin of front, back and outline; the speed [m/s] along each normal of what
    the plane belongs to; one to spare. Front inf: there is nothing."""
    bounds: NDArray  # (N, 2) float32: least and greatest c of the body around each texel, from the origin [m]
    flow: NDArray  # (N, 9) float32 velocity [m/s] of what the planes belong to; (0, 9) = nothing moves
    origin: tuple[float, float, float]  # [m]
    one: View
    two: View | None
    """None makes kernels of their own, in which one pair of views costs what it would without others."""
    three: View | None


@bare
def view_point(x, y, z, axis):
    """(a, b, c) of a point seen along an axis."""
    if axis == 2:
        return x, y, z
    if axis == 1:
        return z, x, y
    return y, z, x


@kernel
def extent(vertices, faces, box):
    """Least and greatest x, y, z, box (2, 3), of the vertices (V, 3) that faces (F, 3) use [m]."""
    box[0] = np.inf
    box[1] = -np.inf
    for f in range(faces.shape[0]):
        for k in range(3):
            for c in range(3):
                value = vertices[faces[f, k], c]
                box[0, c] = min(box[0, c], value)
                box[1, c] = max(box[1, c], value)


@kernel
def planes_of_layers(vertices, normals, velocities, faces, layers, frame, view, levels, planes, depths, flow):
    """Tangent planes from what the rasteriser left: the point by barycentrics, and a normal.

    Args:
        vertices: (V, 3) float64 [m].
        normals: (V, 3) of the vertices, or (0, 3): the faces' own instead of interpolated and renormalised ones, as the paper
            has them.
        velocities: (V, 3) [m/s], or (0, 3): nothing moves.
        faces: (F, 3) int32.
        layers: two `raster.Layers`, row 0 at the top.
        frame: (3,) origin of the offsets [m].
        view: (3,) world axes of a, b, c.
        planes: (rows * columns, 16) float32, of which front and back are written; row 0 at the bottom.
        levels: 0, or that components of normals are rounded to 1 / levels, as colours of [Vassilev 2001, eq. 6 and 7] do.
        depths: (2, rows, columns) float32, written: c - origin of the front and of the back [m]; -inf, inf = nothing.
        flow: (rows * columns, 9) float32, of which front and back are written, or (0, 9).
    """
    _, rows, columns = layers.depth.shape
    along = view[2]
    normal = np.empty(3)
    point = np.empty(3)
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
                    planes[texel, DRIFT + side] = 0.0
                    depths[side, row, column] = -outwards * np.inf
                    continue
                face = layers.triangle[side, rows - 1 - row, column]
                wb = np.float64(layers.barycentrics[side, rows - 1 - row, column, 0])
                wc = np.float64(layers.barycentrics[side, rows - 1 - row, column, 1])
                wa = 1.0 - wb - wc
                a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                if normals.shape[0] > 0:
                    for k in range(3):
                        normal[k] = wa * normals[a, k] + wb * normals[b, k] + wc * normals[c, k]
                else:
                    normal[0], normal[1], normal[2] = face_normal(vertices, faces, face)
                if levels > 0:
                    size = math.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
                    for k in range(3):
                        # 0 to 2 levels stand for -1 to 1
                        colour = math.floor(levels * (normal[k] / max(size, 1e-300) + 1.0) + 0.5)
                        normal[k] = colour / levels - 1.0
                # what is seen faces the view; interpolated normals at the outline may not
                normal[along] = outwards * max(0.0, outwards * normal[along])
                size = math.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
                if size < 1e-12:  # normals that cancel: look along the view
                    normal[0], normal[1], normal[2] = 0.0, 0.0, 0.0
                    normal[along], size = outwards, 1.0
                offset = 0.0
                for k in range(3):
                    normal[k] /= size
                    point[k] = wa * vertices[a, k] + wb * vertices[b, k] + wc * vertices[c, k] - frame[k]
                    offset -= normal[k] * point[k]
                    planes[texel, at + k] = np.float32(normal[k])
                depths[side, row, column] = np.float32(point[along])
                planes[texel, at + 3] = np.float32(offset)
                drift = 0.0
                if flow.shape[0] > 0:
                    for k in range(3):
                        speed = wa * velocities[a, k] + wb * velocities[b, k] + wc * velocities[c, k]
                        flow[texel, 3 * side + k] = np.float32(speed)
                        drift += speed * normal[k]
                planes[texel, DRIFT + side] = np.float32(drift)


@bare
def texel_of(a, b, view):
    """Number of the texel above which a point lies, -1 outside the view."""
    column = math.floor((a - view.left) / view.pixel)
    row = math.floor((b - view.bottom) / view.pixel)
    if column < 0.0 or row < 0.0 or column >= view.columns or row >= view.rows:
        return -1
    return view.first + np.int64(row) * view.columns + np.int64(column)


@bare
def plane_distance(x, y, z, texel, side, body, age):
    """Signed distance [m] to the plane of the front (side 0), back (1) or outline (2) of a texel, `age` seconds before the
    map's moment; front inf: there is none."""
    at = 4 * side
    planes = body.planes
    return (
        planes[texel, at] * (x - body.origin[0])
        + planes[texel, at + 1] * (y - body.origin[1])
        + planes[texel, at + 2] * (z - body.origin[2])
        + planes[texel, at + 3]
        + planes[texel, DRIFT + side] * age
    )


@bare
def _side_in(x, y, z, view, body, age):
    a, b, c = view_point(x, y, z, view.axis)
    texel = texel_of(a, b, view)
    if texel < 0:
        return 0
    front = plane_distance(x, y, z, texel, 0, body, age)
    if front == np.inf:
        return 0
    height = c - view.middle
    if height > body.bounds[texel, 1]:
        return FRONT
    if height < body.bounds[texel, 0]:
        return BACK
    return FRONT if front >= plane_distance(x, y, z, texel, 1, body, age) else BACK


@bare
def sides_of(x, y, z, body, age):
    """The sides of the body that a point is on: FRONT or BACK in two bits for each view, 0 = above no part of it."""
    return _sides_in(x, y, z, body, body.two, body.three, age)


@bare
def _sides_in(x, y, z, body, two, three, age):
    sides = _side_in(x, y, z, body.one, body, age)
    if two is not None:  # decided when this is compiled
        sides |= _side_in(x, y, z, two, body, age) << 2
    if three is not None:
        sides |= _side_in(x, y, z, three, body, age) << 4
    return sides


@inlined
def _plane_in(x, y, z, came_from, view, body, tolerance, age):
    """`find_plane` in one view; texel _CANNOT_TELL: outside as far as this view knows, which others may know better.

    Such is a point beside the outline of an arm in front of the trunk: its texel shows the trunk, and what lies in front of
    that is outside, but the arm that begins a texel further on has no plane for its own side.
    """
    a, b, c = view_point(x, y, z, view.axis)
    texel = texel_of(a, b, view)
    if texel < 0:
        return -1, 0, 0.0
    height = c - view.middle
    if height > body.bounds[texel, 1] + tolerance or height < body.bounds[texel, 0] - tolerance:
        return -1, 0, 0.0
    front = plane_distance(x, y, z, texel, 0, body, age)
    back = plane_distance(x, y, z, texel, 1, body, age)
    outline = plane_distance(x, y, z, texel, 2, body, age)
    if front >= tolerance or back >= tolerance or outline >= tolerance:
        ahead = body.bounds[texel, 1] - height if front >= tolerance else height - body.bounds[texel, 0]
        return (_CANNOT_TELL if ahead > max(_STEP, _STEP_PIXELS * view.pixel) and outline < 0.0 else -1), 0, 0.0
    if outline > front and outline > back:
        return texel, 2, outline
    if came_from == FRONT or (came_from != BACK and front >= back):
        return texel, 0, front
    return texel, 1, back


@spread
def find_plane(x, y, z, start_x, start_y, start_z, came_from, body, tolerance, age):
    """Whether a point lies within the tolerance of the body or inside it: texel and side of the plane to respond along,
    and the signed distance to it; texel -1 = outside.

    The plane is that of the side that the point came from (`sides_of` before it moved), so that no point is pushed
    through a limb to its far side; the nearer one where that is unknown. The outline's, if that is nearer than both.
    Of several views, one whose plane the point was outside of where it started, and of these the one that has it least deep.
    """
    return _in_views(x, y, z, start_x, start_y, start_z, came_from, body, body.two, body.three, tolerance, age)


@spread
def _in_views(x, y, z, start_x, start_y, start_z, came_from, body, two, three, tolerance, age):
    texel, side, distance = _plane_in(x, y, z, came_from & 3, body.one, body, tolerance, age)
    if two is not None and texel != -1:  # None is left out when this is compiled
        passed = texel >= 0 and plane_distance(start_x, start_y, start_z, texel, side, body, age) >= 0.0
        texel, side, distance, passed = _in_view_too(
            x,
            y,
            z,
            start_x,
            start_y,
            start_z,
            (came_from >> 2) & 3,
            two,
            body,
            tolerance,
            age,
            texel,
            side,
            distance,
            passed,
        )
        if three is not None and texel != -1:
            texel, side, distance, passed = _in_view_too(
                x, y, z, start_x, start_y, start_z, (came_from >> 4) & 3, three, body, tolerance, age, texel, side, distance,
                passed,
            )  # fmt: skip
    return texel, side, distance


@inlined
def _in_view_too(
    x, y, z, start_x, start_y, start_z, came_from, view, body, tolerance, age, texel, side, distance, passed
):
    """The better one of the plane that is known, if one is, and that of one more view: none if this view sees the point
    outside.

    `passed`: whether the point started outside of the known plane.
    """
    other, other_side, other_distance = _plane_in(x, y, z, came_from, view, body, tolerance, age)
    if other < 0:
        return (texel if other == _CANNOT_TELL and distance > -_SHALLOW * tolerance else -1), side, distance, passed
    also = plane_distance(start_x, start_y, start_z, other, other_side, body, age) >= 0.0
    if texel < 0:
        return (other if other_distance > -_SHALLOW * tolerance else -1), other_side, other_distance, also
    if (also and not passed) or (also == passed and other_distance > distance):
        return other, other_side, other_distance, also
    return texel, side, distance, passed


@kernel
def query(points, body, tolerance, distances, normals):
    """The map's answer for points (N, 3): signed distance [m] to the nearest plane and its normal; inf, zero outside.

    Returns how many lie within the tolerance or inside.
    """
    found = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        texel, side, distance = find_plane(x, y, z, x, y, z, 0, body, tolerance, 0.0)
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
