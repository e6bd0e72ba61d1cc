"""Signed distance to a closed surface: nearest feature by a bounding-box tree, sign by pseudonormals [Baerentzen 2005]."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.primitives import closest_on_triangle
from clothgym.kernels.vec3 import dot, triangle_normal


class ClosedSurface(NamedTuple):
    """What the queries read."""

    child_start: NDArray[np.int64]  # (N,) first of the two children of a node, breadth-first
    node_face: NDArray[np.int64]  # (N,) face of a leaf, -1 for inner nodes
    boxes: NDArray[np.float64]  # (N, 6) low x, high x, low y, ...
    corners: NDArray[np.float64]  # (F, 9) corners of each face [m]
    faces: NDArray[np.int32]  # (F, 3)
    face_edges: NDArray[np.int32]  # (F, 3) edges (0,1), (1,2), (2,0)
    face_normals: NDArray[np.float64]  # (F, 3)
    edge_normals: NDArray[np.float64]  # (E, 3)
    vertex_normals: NDArray[np.float64]  # (V, 3)


@kernel
def prepare(x, s):
    """Fills the corners and the pseudonormals of `s` (ClosedSurface) from vertices x (V, 3).

    Face normals have unit length; an edge has the sum of its faces' normals, a vertex the sum weighted by the angles.
    """
    s.edge_normals[:] = 0.0
    s.vertex_normals[:] = 0.0
    for f in range(len(s.faces)):
        nx, ny, nz, _ = triangle_normal(x, s.faces[f, 0], s.faces[f, 1], s.faces[f, 2])
        s.face_normals[f, 0] = nx
        s.face_normals[f, 1] = ny
        s.face_normals[f, 2] = nz
        for corner in range(3):
            a, b, c = s.faces[f, corner], s.faces[f, (corner + 1) % 3], s.faces[f, (corner + 2) % 3]
            e = s.face_edges[f, corner]
            ux, uy, uz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
            wx, wy, wz = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
            size = math.sqrt(dot(ux, uy, uz, ux, uy, uz) * dot(wx, wy, wz, wx, wy, wz))
            angle = 0.0
            if size > 0.0:
                angle = math.acos(min(max(dot(ux, uy, uz, wx, wy, wz) / size, -1.0), 1.0))
            s.edge_normals[e, 0] += nx
            s.edge_normals[e, 1] += ny
            s.edge_normals[e, 2] += nz
            s.vertex_normals[a, 0] += angle * nx
            s.vertex_normals[a, 1] += angle * ny
            s.vertex_normals[a, 2] += angle * nz
            for axis in range(3):
                s.corners[f, 3 * corner + axis] = x[a, axis]


@device
def _box_gap(boxes, b, px, py, pz):
    """Squared distance of a point and a box, 0 inside."""
    gx = max(boxes[b, 0] - px, px - boxes[b, 1], 0.0)
    gy = max(boxes[b, 2] - py, py - boxes[b, 3], 0.0)
    gz = max(boxes[b, 4] - pz, pz - boxes[b, 5], 0.0)
    return gx * gx + gy * gy + gz * gz


@device
def on_face(corners, f, scratch):
    """Squared distance of the point in scratch[0] and face f, and the weights of the closest point."""
    for n in range(9):
        scratch[1 + n // 3, n % 3] = corners[f, n]
    wa, wb, wc = closest_on_triangle(scratch, 0, 1, 2, 3)
    gap = 0.0
    for axis in range(3):
        d = scratch[0, axis] - wa * scratch[1, axis] - wb * scratch[2, axis] - wc * scratch[3, axis]
        gap += d * d
    return gap, wa, wb, wc


@device
def feature_normal(s, f, wa, wb, wc):
    """Pseudonormal of the face, side or corner of face f on which its point with these weights lies."""
    zeros = (1 if wa == 0.0 else 0) + (1 if wb == 0.0 else 0) + (1 if wc == 0.0 else 0)
    if zeros == 0:
        return s.face_normals[f, 0], s.face_normals[f, 1], s.face_normals[f, 2]
    if zeros == 1:
        e = s.face_edges[f, 1 if wa == 0.0 else (2 if wb == 0.0 else 0)]
        return s.edge_normals[e, 0], s.edge_normals[e, 1], s.edge_normals[e, 2]
    v = s.faces[f, 0 if wa != 0.0 else (1 if wb != 0.0 else 2)]
    return s.vertex_normals[v, 0], s.vertex_normals[v, 1], s.vertex_normals[v, 2]


@device
def _sign(s, f, wa, wb, wc, scratch):
    """+1 outside, -1 inside: the side of the closest feature's pseudonormal, which must be face, edge or vertex."""
    nx, ny, nz = feature_normal(s, f, wa, wb, wc)
    dx = scratch[0, 0] - wa * s.corners[f, 0] - wb * s.corners[f, 3] - wc * s.corners[f, 6]
    dy = scratch[0, 1] - wa * s.corners[f, 1] - wb * s.corners[f, 4] - wc * s.corners[f, 7]
    dz = scratch[0, 2] - wa * s.corners[f, 2] - wb * s.corners[f, 5] - wc * s.corners[f, 8]
    return -1.0 if dot(dx, dy, dz, nx, ny, nz) < 0.0 else 1.0


@device
def _nearest(s, guess, scratch, nodes, gaps):
    """Nearest face to the point in scratch[0] with its weights and the signed distance; `guess` is tried first.

    Boxes as near as the best so far up to rounding are still opened and equal distances go to the lower face, so that
    the answer does not depend on the guess.
    """
    best, ba, bb, bc = on_face(s.corners, guess, scratch)
    chosen = guess
    px, py, pz = scratch[0, 0], scratch[0, 1], scratch[0, 2]
    nodes[0] = 0
    gaps[0] = _box_gap(s.boxes, 0, px, py, pz)
    top = 1
    while top > 0:
        top -= 1
        node = nodes[top]
        if gaps[top] > best * (1.0 + 1e-12):
            continue
        f = s.node_face[node]
        if f >= 0:
            if f == guess:
                continue
            gap, wa, wb, wc = on_face(s.corners, f, scratch)
            if gap < best or (gap == best and f < chosen):
                best, ba, bb, bc, chosen = gap, wa, wb, wc, f
            continue
        near = s.child_start[node]
        far = near + 1
        near_gap = _box_gap(s.boxes, near, px, py, pz)
        far_gap = _box_gap(s.boxes, far, px, py, pz)
        if far_gap < near_gap:
            near, far = far, near
            near_gap, far_gap = far_gap, near_gap
        if far_gap <= best * (1.0 + 1e-12):
            nodes[top] = far
            gaps[top] = far_gap
            top += 1
        if near_gap <= best * (1.0 + 1e-12):
            nodes[top] = near
            gaps[top] = near_gap
            top += 1
    return chosen, ba, bb, bc, _sign(s, chosen, ba, bb, bc, scratch) * math.sqrt(best)


@kernel
def signed_distances(points, s, face, weights, distance):
    """Nearest face (P,), barycentric weights (P, 3) and signed distance (P,) [m] of points (P, 3); negative inside.

    The face of one point is the first guess for the next: neighbours in space should be neighbours in order.
    """
    scratch = np.empty((4, 3), np.float64)
    nodes = np.empty(len(s.node_face) + 1, np.int64)  # a stack can never hold more than every node
    gaps = np.empty(len(s.node_face) + 1, np.float64)
    guess = np.int64(0)
    for p in range(len(points)):
        for axis in range(3):
            scratch[0, axis] = points[p, axis]
        guess, wa, wb, wc, signed = _nearest(s, guess, scratch, nodes, gaps)
        face[p] = guess
        weights[p, 0] = wa
        weights[p, 1] = wb
        weights[p, 2] = wc
        distance[p] = signed


@kernel
def sample_depths(x, faces, grid, s, depth):
    """Depth (F * S,) [m] below the surface of points on triangles (F, 3) of x (V, 3); 0 outside.

    `grid` (S, 3) holds the barycentric weights of the points. A triangle whose centre is farther outside than its
    corners are from the centre lies outside with all its points.
    """
    scratch = np.empty((4, 3), np.float64)
    nodes = np.empty(len(s.node_face) + 1, np.int64)
    gaps = np.empty(len(s.node_face) + 1, np.float64)
    guess = np.int64(0)
    count = len(grid)
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        for axis in range(3):
            scratch[0, axis] = (x[i, axis] + x[j, axis] + x[k, axis]) / 3.0
        reach = 0.0
        for corner in range(3):
            v = faces[f, corner]
            dx, dy, dz = x[v, 0] - scratch[0, 0], x[v, 1] - scratch[0, 1], x[v, 2] - scratch[0, 2]
            reach = max(reach, dot(dx, dy, dz, dx, dy, dz))
        guess, _, _, _, signed = _nearest(s, guess, scratch, nodes, gaps)
        if signed > math.sqrt(reach) * (1.0 + 1e-9):
            for n in range(count):
                depth[f * count + n] = 0.0
            continue
        for n in range(count):
            for axis in range(3):
                scratch[0, axis] = grid[n, 0] * x[i, axis] + grid[n, 1] * x[j, axis] + grid[n, 2] * x[k, axis]
            guess, _, _, _, signed = _nearest(s, guess, scratch, nodes, gaps)
            depth[f * count + n] = max(-signed, 0.0)
