"""Closest points on a surface, and on which side of it a point lies, by angle-weighted normals [Baerentzen 2005]."""

from __future__ import annotations

import math

from clothgym._jit import bare, device, kernel
from clothgym.kernels.primitives import closest_on_triangle
from clothgym.kernels.vec3 import dot, triangle_normal

BLOCK = 16
"""Consecutive faces that share a box, so that far ones are rejected together."""


@device
def fill_boxes(x, faces, boxes, blocks):
    """Fills boxes (F, 6) [low, high] of the faces and blocks (ceil(F / BLOCK), 6) of every BLOCK consecutive faces."""
    for f in range(len(faces)):
        b = f // BLOCK
        for axis in range(3):
            low = min(x[faces[f, 0], axis], x[faces[f, 1], axis], x[faces[f, 2], axis])
            high = max(x[faces[f, 0], axis], x[faces[f, 1], axis], x[faces[f, 2], axis])
            boxes[f, axis] = low
            boxes[f, 3 + axis] = high
            if f % BLOCK == 0:
                blocks[b, axis] = low
                blocks[b, 3 + axis] = high
            else:
                blocks[b, axis] = min(blocks[b, axis], low)
                blocks[b, 3 + axis] = max(blocks[b, 3 + axis], high)


@kernel
def face_boxes(x, faces, boxes, blocks):
    """`fill_boxes` for all faces of a surface."""
    fill_boxes(x, faces, boxes, blocks)


@device
def _box_distance2(x, v, boxes, b):
    """Squared distance of vertex v and a box, 0 inside."""
    total = 0.0
    for axis in range(3):
        gap = max(boxes[b, axis] - x[v, axis], x[v, axis] - boxes[b, 3 + axis])
        if gap > 0.0:
            total += gap * gap
    return total


@device
def _closest_on_face(x, v, faces, f):
    """Squared distance of vertex v and face f, and the weights of the closest point."""
    wa, wb, wc = closest_on_triangle(x, v, faces[f, 0], faces[f, 1], faces[f, 2])
    total = 0.0
    for axis in range(3):
        along = wa * x[faces[f, 0], axis] + wb * x[faces[f, 1], axis] + wc * x[faces[f, 2], axis]
        total += (x[v, axis] - along) * (x[v, axis] - along)
    return total, wa, wb, wc


@bare
def closest_in_boxes(x, v, faces, boxes, blocks, guess):
    """Closest point to vertex v of some faces with their boxes: the face, its weights, the squared distance; first guess: the
    face of a vertex nearby."""
    best, wa, wb, wc = _closest_on_face(x, v, faces, guess)
    chosen = guess
    for b in range(len(blocks)):
        if _box_distance2(x, v, blocks, b) >= best:
            continue
        for f in range(b * BLOCK, min((b + 1) * BLOCK, len(faces))):
            if f == guess or _box_distance2(x, v, boxes, f) >= best:
                continue
            d, qa, qb, qc = _closest_on_face(x, v, faces, f)
            if d < best:
                best, wa, wb, wc, chosen = d, qa, qb, qc, f
    return chosen, wa, wb, wc, best


@kernel
def closest_faces(x, first, faces, boxes, blocks, face, weights, distance):
    """Closest point of a surface to each vertex first, first + 1, ... of x: face, barycentric weights, distance [m].

    The surface has at least one face. The face of one point is the first guess for the next.
    """
    guess = 0
    for p in range(len(distance)):
        guess, wa, wb, wc, best = closest_in_boxes(x, first + p, faces, boxes, blocks, guess)
        face[p] = guess
        weights[p, 0], weights[p, 1], weights[p, 2] = wa, wb, wc
        distance[p] = math.sqrt(best)


@kernel
def vertex_frames(x, faces, edges, edge_face_start, normals, border):
    """Fills normals (V, 3), the sum of the face normals around each vertex weighted by their angles (not unit), and
    border (V,): whether the vertex lies on an edge with one face."""
    normals[:] = 0.0
    border[:] = False
    for e in range(len(edges)):
        if edge_face_start[e + 1] - edge_face_start[e] == 1:
            border[edges[e, 0]] = True
            border[edges[e, 1]] = True
    for f in range(len(faces)):
        nx, ny, nz, _ = triangle_normal(x, faces[f, 0], faces[f, 1], faces[f, 2])
        for corner in range(3):
            a, b, c = faces[f, corner], faces[f, (corner + 1) % 3], faces[f, (corner + 2) % 3]
            ux, uy, uz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
            wx, wy, wz = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
            size = math.sqrt(dot(ux, uy, uz, ux, uy, uz) * dot(wx, wy, wz, wx, wy, wz))
            if size > 0.0:
                angle = math.acos(min(max(dot(ux, uy, uz, wx, wy, wz) / size, -1.0), 1.0))
                normals[a, 0] += angle * nx
                normals[a, 1] += angle * ny
                normals[a, 2] += angle * nz


@kernel
def side_signs(x, first, surface, normals, border, face, weights, signs):
    """Fills signs (P,): +1 on the side that the normal of the closest point shows to, -1 behind, 0 where the closest
    point lies on a border or the point on the surface."""
    for p in range(len(signs)):
        v, f = first + p, face[p]
        zeros, lone, missing = 0, 0, 0  # corners without weight; the one that has it all; the one opposite an edge
        for corner in range(3):
            if weights[p, corner] == 0.0:
                zeros += 1
                missing = corner
            else:
                lone = corner
        signs[p] = 0.0
        nx, ny, nz = 0.0, 0.0, 0.0
        if zeros == 0:
            nx, ny, nz, _ = triangle_normal(x, surface.faces[f, 0], surface.faces[f, 1], surface.faces[f, 2])
        elif zeros == 1:
            e = surface.face_edges[f, (missing + 1) % 3]
            begin, end = surface.edge_face_start[e], surface.edge_face_start[e + 1]
            if end - begin == 1:
                continue
            for k in range(begin, end):
                g = surface.edge_face_ids[k]
                mx, my, mz, _ = triangle_normal(x, surface.faces[g, 0], surface.faces[g, 1], surface.faces[g, 2])
                nx, ny, nz = nx + mx, ny + my, nz + mz
        else:
            corner_vertex = surface.faces[f, lone]
            if border[corner_vertex]:
                continue
            nx, ny, nz = normals[corner_vertex, 0], normals[corner_vertex, 1], normals[corner_vertex, 2]
        along = 0.0
        for axis in range(3):
            closest = 0.0
            for corner in range(3):
                closest += weights[p, corner] * x[surface.faces[f, corner], axis]
            along += (x[v, axis] - closest) * (nx if axis == 0 else ny if axis == 1 else nz)
        if along > 0.0:
            signs[p] = 1.0
        elif along < 0.0:
            signs[p] = -1.0
