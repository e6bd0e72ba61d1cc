"""Software rasteriser on bare arrays: depth, triangle id and barycentrics per pixel, then shading from these.

Image-space vertices are homogeneous rows (X, Y, Z, W): the vertex lies at pixel position (X / W, Y / W), x to the
right and y **down**, and Z is its distance from the camera plane in metres. W = Z for a perspective camera and 1 for
an orthographic one. Pixel (row j, column i) is sampled at its centre (i + 0.5, j + 0.5).

Coverage is exact: positions are snapped to 1/4096 pixel, edge functions are integers, and a pixel centre that lies on
an edge belongs to the triangle for which this edge is a top or left one. So a pixel inside a mesh without cracks is
covered once by every sheet of it, and never twice across a shared edge.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.vec3 import cross, dot

SUBPIXEL_BITS = 12
SUBPIXELS = 1 << SUBPIXEL_BITS
HALF_PIXEL = SUBPIXELS // 2
GUARD_PIXELS = 65536.0
"""Triangles that reach further out are clipped: then every edge function stays below 2^62."""

NO_TRIANGLE = -1
_CLIP_CAPACITY = 9
"""A triangle cut by five planes has at most eight corners."""


class Layers(NamedTuple):
    """What the rasteriser writes: one layer for pictures, two for the front and back side of a body.

    One layer: both orientations, nearest wins.
    Two layers: layer 0 keeps the nearest front-facing triangle (counter-clockwise as seen by the camera), layer 1 the
    **farthest** back-facing one, that is the side that an opposite camera on the same pixels would see.
    At equal depth the triangle that comes first in the list stays.
    """

    depth: NDArray[np.float32]
    """(L, H, W) [m] distance from the camera plane; +inf (layer 1: -inf) where nothing was drawn."""
    triangle: NDArray[np.int32]
    """(L, H, W) face id, or -1."""
    barycentrics: NDArray[np.float32]
    """(L, H, W, 2) weights of the face's second and third vertex; undefined where nothing was drawn."""


def new_layers(count: int, height: int, width: int) -> Layers:
    """Cleared buffers with 1 or 2 layers."""
    layers = Layers(
        np.empty((count, height, width), np.float32),
        np.empty((count, height, width), np.int32),
        np.zeros((count, height, width, 2), np.float32),
    )
    clear_layers(layers)
    return layers


def clear_layers(layers: Layers) -> None:
    """Makes buffers ready for the next image. Barycentrics keep old values: the triangle id tells which are valid."""
    layers.depth[0] = np.inf
    layers.depth[1:] = -np.inf
    layers.triangle[:] = NO_TRIANGLE


@kernel
def project(vertices, matrix, image):
    """Image-space vertices.

    Args:
        vertices: (V, 3) float64 [m].
        matrix: (4, 4) float64, applied to (x, y, z, 1).
        image: (V, 4) float64, written.
    """
    for i in range(vertices.shape[0]):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        for k in range(4):
            image[i, k] = matrix[k, 0] * x + matrix[k, 1] * y + matrix[k, 2] * z + matrix[k, 3]


@device
def _snap(i, corner, snapped, lens):
    snapped[i, 0] = np.int64(np.floor(corner[0] / corner[3] * SUBPIXELS + 0.5))
    snapped[i, 1] = np.int64(np.floor(corner[1] / corner[3] * SUBPIXELS + 0.5))
    lens[i, 0] = corner[2]
    lens[i, 1] = 1.0 / corner[3]


@device
def _top_left(dx, dy):
    """0 for a top or left edge of a triangle with positive area (y down), -1 for the others: added to its function."""
    if dy < 0 or (dy == 0 and dx > 0):
        return np.int64(0)
    return np.int64(-1)


@device
def _fill(corners, face, snapped, lens, mix, layers):
    """Draws one triangle.

    Args:
        corners: three row numbers of `snapped` and `lens`.
        snapped: (N, 2) int64 [1/4096 pixel].
        lens: (N, 2) float64 distance [m] and 1 / W.
        mix: (3, 2) barycentrics (second, third) of the corners within the face; differs from
            (0, 0), (1, 0), (0, 1) only for the pieces of a clipped face.
    """
    a, b, c = corners
    ax, ay = snapped[a, 0], snapped[a, 1]
    bx, by = snapped[b, 0], snapped[b, 1]
    cx, cy = snapped[c, 0], snapped[c, 1]
    _, height, width = layers.depth.shape
    min_x = max((min(ax, bx, cx) + HALF_PIXEL - 1) >> SUBPIXEL_BITS, 0)
    max_x = min((max(ax, bx, cx) - HALF_PIXEL) >> SUBPIXEL_BITS, width - 1)
    min_y = max((min(ay, by, cy) + HALF_PIXEL - 1) >> SUBPIXEL_BITS, 0)
    max_y = min((max(ay, by, cy) - HALF_PIXEL) >> SUBPIXEL_BITS, height - 1)
    if min_x > max_x or min_y > max_y:
        return
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if area == 0:
        return
    # y points down, so counter-clockwise for the viewer is a negative area.
    slot_b, slot_c = 1, 2
    layer, sign = 0, 1.0
    if area < 0:
        b, c, bx, by, cx, cy = c, b, cx, cy, bx, by
        slot_b, slot_c = 2, 1
        area = -area
    elif layers.depth.shape[0] > 1:
        layer, sign = 1, -1.0

    bias_a, bias_b, bias_c = _top_left(cx - bx, cy - by), _top_left(ax - cx, ay - cy), _top_left(bx - ax, by - ay)
    px = (min_x << SUBPIXEL_BITS) + HALF_PIXEL
    py = (min_y << SUBPIXEL_BITS) + HALF_PIXEL
    row_a = (cx - bx) * (py - by) - (cy - by) * (px - bx) + bias_a
    row_b = (ax - cx) * (py - cy) - (ay - cy) * (px - cx) + bias_b
    row_c = (bx - ax) * (py - ay) - (by - ay) * (px - ax) + bias_c
    right_a, right_b, right_c = (by - cy) * SUBPIXELS, (cy - ay) * SUBPIXELS, (ay - by) * SUBPIXELS
    down_a, down_b, down_c = (cx - bx) * SUBPIXELS, (ax - cx) * SUBPIXELS, (bx - ax) * SUBPIXELS

    za, zb, zc = lens[a, 0], lens[b, 0], lens[c, 0]
    wa, wb, wc = lens[a, 1], lens[b, 1], lens[c, 1]
    affine = wa == wb and wb == wc
    per_area = 1.0 / area
    mix_a1, mix_a2 = mix[0, 0], mix[0, 1]
    mix_b1, mix_b2 = mix[slot_b, 0], mix[slot_b, 1]
    mix_c1, mix_c2 = mix[slot_c, 0], mix[slot_c, 1]
    for y in range(min_y, max_y + 1):
        ea, eb, ec = row_a, row_b, row_c
        entered = False
        for x in range(min_x, max_x + 1):
            if (ea | eb | ec) >= 0:
                entered = True
                if affine:
                    la, lb, lc = (ea - bias_a) * per_area, (eb - bias_b) * per_area, (ec - bias_c) * per_area
                else:
                    # 1 / W is linear in the image, the weights are not: weigh by 1 / W, then make the sum 1.
                    la, lb, lc = (ea - bias_a) * wa, (eb - bias_b) * wb, (ec - bias_c) * wc
                    total = 1.0 / (la + lb + lc)
                    la, lb, lc = la * total, lb * total, lc * total
                z = np.float32(la * za + lb * zb + lc * zc)
                if sign * z < sign * layers.depth[layer, y, x]:
                    layers.depth[layer, y, x] = z
                    layers.triangle[layer, y, x] = face
                    layers.barycentrics[layer, y, x, 0] = np.float32(la * mix_a1 + lb * mix_b1 + lc * mix_c1)
                    layers.barycentrics[layer, y, x, 1] = np.float32(la * mix_a2 + lb * mix_b2 + lc * mix_c2)
            elif entered:
                break  # a triangle is convex: nothing more in this row
            ea += right_a
            eb += right_b
            ec += right_c
        row_a += down_a
        row_b += down_b
        row_c += down_c


@device
def _plane_distance(corner, plane, near):
    if plane == 0:
        return corner[2] - near
    reach = GUARD_PIXELS * corner[3]
    if plane == 1:
        return reach + corner[0]
    if plane == 2:
        return reach - corner[0]
    if plane == 3:
        return reach + corner[1]
    return reach - corner[1]


@device
def _clip(polygon, count, near):
    """Cuts a convex polygon by the near plane and the guard band; returns the new corner count.

    Args:
        polygon: (2, 9, 6) float64: X, Y, Z, W and two barycentrics; [0] is cut in place, [1] is scratch.
    """
    for plane in range(5):
        made = 0
        for k in range(count):
            following = k + 1 if k + 1 < count else 0
            dk = _plane_distance(polygon[0, k], plane, near)
            df = _plane_distance(polygon[0, following], plane, near)
            if dk >= 0.0:
                for n in range(6):
                    polygon[1, made, n] = polygon[0, k, n]
                made += 1
            if (dk >= 0.0) != (df >= 0.0):
                # From the kept end to the lost one, so that both neighbours of an edge get the same point bit by bit.
                kept, lost, dkept, dlost = (k, following, dk, df) if dk >= 0.0 else (following, k, df, dk)
                t = dkept / (dkept - dlost)
                for n in range(6):
                    polygon[1, made, n] = polygon[0, kept, n] + t * (polygon[0, lost, n] - polygon[0, kept, n])
                made += 1
        count = made
        for k in range(count):
            for n in range(6):
                polygon[0, k, n] = polygon[1, k, n]
    return count


@kernel
def rasterise(image, faces, near, layers):
    """Draws triangles into cleared or partly filled layers.

    Faces of zero area, outside the image or with a vertex that is not finite leave no trace; what lies nearer than
    `near` is cut off.

    Args:
        image: (V, 4) float64 image-space vertices.
        faces: (F, 3) int32.
        near: [m] smallest distance drawn; above 0 for a perspective camera.
        layers: Layers, written. Two layers split by orientation.
    """
    vertex_count = image.shape[0]
    snapped = np.empty((vertex_count + _CLIP_CAPACITY, 2), np.int64)
    lens = np.empty((vertex_count + _CLIP_CAPACITY, 2), np.float64)
    state = np.zeros(vertex_count, np.uint8)  # 0 draw as it is, 1 clip, 2 not finite
    polygon = np.empty((2, _CLIP_CAPACITY, 6), np.float64)
    whole = np.zeros((3, 2), np.float64)
    whole[1, 0] = 1.0
    whole[2, 1] = 1.0
    piece = np.empty((3, 2), np.float64)
    for i in range(vertex_count):
        x, y, z, w = image[i, 0], image[i, 1], image[i, 2], image[i, 3]
        reach = GUARD_PIXELS * w
        if not np.isfinite(x + y + z + w):
            state[i] = 2
        elif z >= near and w > 0.0 and abs(x) <= reach and abs(y) <= reach:
            _snap(i, image[i], snapped, lens)
        else:
            state[i] = 1
    for face in range(faces.shape[0]):
        a, b, c = np.int64(faces[face, 0]), np.int64(faces[face, 1]), np.int64(faces[face, 2])
        worst = max(state[a], state[b], state[c])
        if worst == 2:
            continue
        mix, pieces = whole, 1
        if worst == 1:
            for k in range(3):
                vertex = faces[face, k]
                for n in range(4):
                    polygon[0, k, n] = image[vertex, n]
                polygon[0, k, 4] = whole[k, 0]
                polygon[0, k, 5] = whole[k, 1]
            count = _clip(polygon, 3, near)
            for k in range(count):
                _snap(vertex_count + k, polygon[0, k], snapped, lens)
            mix, pieces = piece, count - 2
        for k in range(pieces):
            if worst == 1:
                a, b, c = vertex_count, vertex_count + k + 1, vertex_count + k + 2
                for n in range(2):
                    piece[0, n] = polygon[0, 0, 4 + n]
                    piece[1, n] = polygon[0, k + 1, 4 + n]
                    piece[2, n] = polygon[0, k + 2, 4 + n]
            _fill((a, b, c), face, snapped, lens, mix, layers)


@device
def face_normal(vertices, faces, face):
    """Normal with the length of twice the area."""
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    return cross(ux, uy, uz, vx, vy, vz)


@device
def _blend(values, a, b, c, k, lb, lc):
    return (1.0 - lb - lc) * values[a, k] + lb * values[b, k] + lc * values[c, k]


@kernel
def vertex_normals(vertices, faces, normals):
    """Unit normals, the mean of the faces around a vertex weighted by area; (0, 0, 0) where there is no area.

    Args:
        vertices: (V, 3) float64 [m].
        faces: (F, 3) int32.
        normals: (V, 3) float64, written.
    """
    normals[:] = 0.0
    for face in range(faces.shape[0]):
        gx, gy, gz = face_normal(vertices, faces, face)
        for k in range(3):
            vertex = faces[face, k]
            normals[vertex, 0] += gx
            normals[vertex, 1] += gy
            normals[vertex, 2] += gz
    for i in range(vertices.shape[0]):
        length = np.sqrt(normals[i, 0] ** 2 + normals[i, 1] ** 2 + normals[i, 2] ** 2)
        scale = 1.0 / length if length > 0.0 else 0.0
        for k in range(3):
            normals[i, k] *= scale


@kernel
def shade(vertices, normals, faces, colours, lights, layers, picture):
    """Colours the pixels of layer 0: normals interpolated and renormalised per pixel, turned to the viewer.

    Brightness = 0.38 + 0.18 sky + 0.24 headlight + 0.38 key light, where sky is 1 for a normal that points up.

    Args:
        vertices: (V, 3) float64 [m].
        normals: (V, 3) float64 unit normals; where they vanish the face's own is used.
        faces: (F, 3) int32.
        colours: (F, 6) float32 in [0, 1]: red, green, blue of the front, then of the back of each face.
        lights: (3, 3) float64: eye position, or the direction to the viewer of an orthographic camera; direction of
            the key light; and (1, 0, 0) for perspective or (0, 0, 0) for orthographic.
        layers: Layers, read.
        picture: (H, W, 3) float32, written where a triangle was drawn.
    """
    perspective = lights[2, 0]
    for y in range(picture.shape[0]):
        for x in range(picture.shape[1]):
            face = layers.triangle[0, y, x]
            if face < 0:
                continue
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            lb, lc = np.float64(layers.barycentrics[0, y, x, 0]), np.float64(layers.barycentrics[0, y, x, 1])
            gx, gy, gz = face_normal(vertices, faces, face)
            ex = lights[0, 0] - perspective * _blend(vertices, a, b, c, 0, lb, lc)
            ey = lights[0, 1] - perspective * _blend(vertices, a, b, c, 1, lb, lc)
            ez = lights[0, 2] - perspective * _blend(vertices, a, b, c, 2, lb, lc)
            nx = _blend(normals, a, b, c, 0, lb, lc)
            ny = _blend(normals, a, b, c, 1, lb, lc)
            nz = _blend(normals, a, b, c, 2, lb, lc)
            square = dot(nx, ny, nz, nx, ny, nz)
            if square < 1e-12:
                nx, ny, nz = gx, gy, gz
                square = dot(nx, ny, nz, nx, ny, nz)
            front = dot(gx, gy, gz, ex, ey, ez) >= 0.0
            turn = (1.0 if front else -1.0) / np.sqrt(max(square, 1e-300))
            nx, ny, nz = nx * turn, ny * turn, nz * turn
            head = dot(nx, ny, nz, ex, ey, ez) / np.sqrt(dot(ex, ey, ez, ex, ey, ez) + 1e-300)
            key = dot(nx, ny, nz, lights[1, 0], lights[1, 1], lights[1, 2])
            light = 0.38 + 0.18 * (0.5 + 0.5 * ny) + 0.24 * max(head, 0.0) + 0.38 * max(key, 0.0)
            first = 0 if front else 3
            for k in range(3):
                picture[y, x, k] = np.float32(min(colours[face, first + k] * light, 1.0))


@device
def _checker(u, v, width):
    """Checkerboard of unit cells averaged over a square of the given width: -1 to 1."""
    fold = 1.0
    for p in (u, v):
        low, high = 0.5 * (p - 0.5 * width), 0.5 * (p + 0.5 * width)
        fold *= 2.0 * (abs(low - np.floor(low) - 0.5) - abs(high - np.floor(high) - 0.5)) / width
    return fold


@kernel
def draw_ground(rays, plane, tones, depth, picture):
    """Draws a horizontal checkered plane behind and below what is there, faded into the background far away.

    A camera below the plane looks through it.

    Args:
        rays: (6, 3) float64: origin of the ray through pixel position (0, 0), its change per pixel to the right and
            per pixel down, then the same for the direction; a point at depth d is origin + d direction.
        plane: (6,) float64 [m]: height, cell size, nearest depth drawn, centre x, centre z, radius of the fade.
        tones: (2, 3) float32 colours of the cells.
        depth: (H, W) float32 [m], written.
        picture: (H, W, 3) float32, blended.
    """
    across = np.sqrt(dot(rays[1, 0], rays[1, 1], rays[1, 2], rays[1, 0], rays[1, 1], rays[1, 2]))
    spread = np.sqrt(dot(rays[4, 0], rays[4, 1], rays[4, 2], rays[4, 0], rays[4, 1], rays[4, 2]))
    for j in range(depth.shape[0]):
        for i in range(depth.shape[1]):
            x, y = i + 0.5, j + 0.5
            fall = rays[3, 1] + x * rays[4, 1] + y * rays[5, 1]
            if fall >= -1e-9:
                continue
            distance = (plane[0] - (rays[0, 1] + x * rays[1, 1] + y * rays[2, 1])) / fall
            if distance < plane[2] or distance >= depth[j, i]:
                continue
            dx = rays[3, 0] + x * rays[4, 0] + y * rays[5, 0]
            dz = rays[3, 2] + x * rays[4, 2] + y * rays[5, 2]
            px = rays[0, 0] + x * rays[1, 0] + y * rays[2, 0] + distance * dx
            pz = rays[0, 2] + x * rays[1, 2] + y * rays[2, 2] + distance * dz
            ox, oz = (px - plane[3]) / plane[5], (pz - plane[4]) / plane[5]
            cover = np.exp(-(ox * ox + oz * oz))
            slant = np.sqrt(dx * dx + fall * fall + dz * dz) / -fall
            footprint = max((across + distance * spread) * slant / plane[1], 1e-6)
            tone = 0.5 + 0.5 * _checker(px / plane[1], pz / plane[1], footprint)
            depth[j, i] = distance
            for k in range(3):
                wanted = tones[0, k] + tone * (tones[1, k] - tones[0, k])
                picture[j, i, k] += np.float32(cover * (wanted - picture[j, i, k]))


@kernel
def draw_lines(ends, colour, stroke, depth, picture):
    """Draws thick segments with round ends and soft borders over a picture.

    Args:
        ends: (S, 2, 4) float64 image-space end points.
        colour: (3,) float32.
        stroke: (5,) float64: half width [pixel]; depth bias [m] and depth bias as a share of the distance: a line is
            drawn when it is nearer than what is there plus the bias; nearest depth drawn [m]; 1 = ignore the depth.
        depth: (H, W) float32 [m], read.
        picture: (H, W, 3) float32, blended.
    """
    height, width = depth.shape
    reach = stroke[0] + 0.5
    near = stroke[3]
    for s in range(ends.shape[0]):
        z0, z1 = ends[s, 0, 2], ends[s, 1, 2]
        if not (z0 >= near or z1 >= near):
            continue
        t0 = (near - z0) / (z1 - z0) if z0 < near else 0.0
        t1 = (near - z0) / (z1 - z0) if z1 < near else 1.0
        w0 = ends[s, 0, 3] + t0 * (ends[s, 1, 3] - ends[s, 0, 3])
        w1 = ends[s, 0, 3] + t1 * (ends[s, 1, 3] - ends[s, 0, 3])
        x0 = (ends[s, 0, 0] + t0 * (ends[s, 1, 0] - ends[s, 0, 0])) / w0
        y0 = (ends[s, 0, 1] + t0 * (ends[s, 1, 1] - ends[s, 0, 1])) / w0
        x1 = (ends[s, 0, 0] + t1 * (ends[s, 1, 0] - ends[s, 0, 0])) / w1
        y1 = (ends[s, 0, 1] + t1 * (ends[s, 1, 1] - ends[s, 0, 1])) / w1
        if not np.isfinite(x0 + y0 + x1 + y1):
            continue
        q0, q1 = z0 + t0 * (z1 - z0), z0 + t1 * (z1 - z0)
        dx, dy = x1 - x0, y1 - y0
        square = dx * dx + dy * dy
        length = np.sqrt(square)
        low = np.int64(min(max(min(y0, y1) - reach, 0.0), height))
        high = np.int64(max(min(max(y0, y1) + reach, height - 1.0), -1.0))
        for j in range(low, high + 1):
            y = j + 0.5
            left, right = min(x0, x1) - reach, max(x0, x1) + reach
            if abs(dy) > 1e-9:
                # The band around the endless line crosses this row only here.
                middle, half = x0 + (y - y0) * dx / dy, reach * length / abs(dy)
                left, right = max(left, middle - half), min(right, middle + half)
            first = np.int64(min(max(left, 0.0), width))
            last = np.int64(max(min(right, width - 1.0), -1.0))
            for i in range(first, last + 1):
                x = i + 0.5
                t = ((x - x0) * dx + (y - y0) * dy) / square if square > 0.0 else 0.0
                t = min(max(t, 0.0), 1.0)
                ox, oy = x - x0 - t * dx, y - y0 - t * dy
                cover = min(reach - np.sqrt(ox * ox + oy * oy), 1.0)
                if cover <= 0.0:
                    continue
                share = t * w0 / (t * w0 + (1.0 - t) * w1)  # 1 / W is linear along the segment in the image
                distance = q0 + share * (q1 - q0)
                if stroke[4] == 0.0 and distance * (1.0 - stroke[2]) - stroke[1] > depth[j, i]:
                    continue
                for k in range(3):
                    picture[j, i, k] += np.float32(cover * (colour[k] - picture[j, i, k]))


@kernel
def resolve(picture, factor, image):
    """Averages blocks of pixels and rounds to bytes.

    Args:
        picture: (H * factor, W * factor, 3) float32 in [0, 1].
        factor: samples per pixel and direction.
        image: (H, W, 3) uint8, written.
    """
    scale = 255.0 / (factor * factor)
    for j in range(image.shape[0]):
        for i in range(image.shape[1]):
            for k in range(3):
                total = 0.0
                for y in range(factor):
                    for x in range(factor):
                        total += picture[j * factor + y, i * factor + x, k]
                image[j, i, k] = np.uint8(min(max(total * scale, 0.0), 255.0) + 0.5)
