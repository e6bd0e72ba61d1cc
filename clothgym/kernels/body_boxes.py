"""The body in object space, as the comparison that the paper makes: parts, each with a tree of boxes [Vassilev 2001, Table 1].

A point is tested against every part whose box it is near, down to the triangles, and answers with the nearest of these.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import bare, kernel
from clothgym.kernels.raster import face_normal


class PartBoxes(NamedTuple):
    """Trees of all parts, one after the other; children stand behind their parents."""

    roots: NDArray  # (P,) first node of each part
    child_start: NDArray  # (N,)
    child_count: NDArray  # (N,) 0 = leaf
    node_face: NDArray  # (N,) face of a leaf
    boxes: NDArray  # (N, 6) low x, y, z, high x, y, z [m]
    corners: NDArray  # (F, 9) [m]
    normals: NDArray  # (F, 3)


@kernel
def refit(vertices, faces, s):
    """Boxes, corners and normals for vertices (V, 3) [m]."""
    for f in range(faces.shape[0]):
        nx, ny, nz = face_normal(vertices, faces, f)
        size = math.sqrt(nx * nx + ny * ny + nz * nz)
        scale = 1.0 / size if size > 0.0 else 0.0
        s.normals[f, 0] = nx * scale
        s.normals[f, 1] = ny * scale
        s.normals[f, 2] = nz * scale
        for k in range(3):
            for c in range(3):
                s.corners[f, 3 * k + c] = vertices[faces[f, k], c]
    for node in range(s.child_count.shape[0] - 1, -1, -1):
        for c in range(3):
            low, high = np.inf, -np.inf
            if s.child_count[node] == 0:
                f = s.node_face[node]
                for k in range(3):
                    low = min(low, s.corners[f, 3 * k + c])
                    high = max(high, s.corners[f, 3 * k + c])
            for child in range(s.child_start[node], s.child_start[node] + s.child_count[node]):
                low = min(low, s.boxes[child, c])
                high = max(high, s.boxes[child, 3 + c])
            s.boxes[node, c] = low
            s.boxes[node, 3 + c] = high


@bare
def _outside(boxes, node, x, y, z, reach):
    return (
        x < boxes[node, 0] - reach
        or y < boxes[node, 1] - reach
        or z < boxes[node, 2] - reach
        or x > boxes[node, 3] + reach
        or y > boxes[node, 4] + reach
        or z > boxes[node, 5] + reach
    )


@bare
def _to_segment(x, y, z, corners, f, i, j):
    """Squared distance of a point to a side of a face."""
    ax, ay, az = corners[f, 3 * i], corners[f, 3 * i + 1], corners[f, 3 * i + 2]
    ux, uy, uz = corners[f, 3 * j] - ax, corners[f, 3 * j + 1] - ay, corners[f, 3 * j + 2] - az
    px, py, pz = x - ax, y - ay, z - az
    length = ux * ux + uy * uy + uz * uz
    t = 0.0
    if length > 0.0:
        t = min(1.0, max(0.0, (px * ux + py * uy + pz * uz) / length))
    px, py, pz = px - t * ux, py - t * uy, pz - t * uz
    return px * px + py * py + pz * pz


@bare
def _to_face(x, y, z, s, f):
    """Distance of a point to a face, and the side of the face's plane that it is on."""
    nx, ny, nz = s.normals[f, 0], s.normals[f, 1], s.normals[f, 2]
    c = s.corners
    height = nx * (x - c[f, 0]) + ny * (y - c[f, 1]) + nz * (z - c[f, 2])
    inside = True
    for i in range(3):
        j = 3 * ((i + 1) % 3)
        i3 = 3 * i
        ux, uy, uz = c[f, j] - c[f, i3], c[f, j + 1] - c[f, i3 + 1], c[f, j + 2] - c[f, i3 + 2]
        # inwards from the side, within the plane
        wx, wy, wz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
        if wx * (x - c[f, i3]) + wy * (y - c[f, i3 + 1]) + wz * (z - c[f, i3 + 2]) < 0.0:
            inside = False
    if inside:
        return abs(height), height >= 0.0
    square = min(_to_segment(x, y, z, c, f, 0, 1), _to_segment(x, y, z, c, f, 1, 2), _to_segment(x, y, z, c, f, 2, 0))
    return math.sqrt(square), height >= 0.0


@kernel
def query(points, s, reach, stack, distances, normals, nearest):
    """Signed distance [m] to the nearest face within reach, that face's normal, and the face, for points (N, 3); inf, zero
    and -1 beyond.

    Returns tests of boxes and of faces. Of faces as near as each other, at a common edge, the one decides whose plane the
    point is further from.
    """
    box_tests = 0
    face_tests = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        best, best_height, chosen, front = reach, 0.0, -1, True
        for part in range(s.roots.shape[0]):
            stack[0] = s.roots[part]
            top = 1
            while top > 0:
                top -= 1
                node = stack[top]
                box_tests += 1
                if _outside(s.boxes, node, x, y, z, reach):
                    continue
                count = s.child_count[node]
                if count > 0:
                    for child in range(s.child_start[node], s.child_start[node] + count):
                        stack[top] = child
                        top += 1
                    continue
                f = s.node_face[node]
                face_tests += 1
                distance, above = _to_face(x, y, z, s, f)
                height = abs(
                    s.normals[f, 0] * (x - s.corners[f, 0])
                    + s.normals[f, 1] * (y - s.corners[f, 1])
                    + s.normals[f, 2] * (z - s.corners[f, 2])
                )
                if distance < best * (1.0 - 1e-9) or (distance <= best * (1.0 + 1e-9) and height > best_height):
                    best, best_height, chosen, front = distance, height, f, above
        distances[i] = np.inf
        nearest[i] = chosen
        for c in range(3):
            normals[i, c] = 0.0
        if chosen >= 0:
            distances[i] = best if front else -best
            for c in range(3):
                normals[i, c] = s.normals[chosen, c]
    return box_tests, face_tests
