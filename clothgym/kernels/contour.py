"""Edge-triangle hits, their pairs, contours with sides, contour length and its exact gradient.

[Volino 2006] section 2; the closed-form gradient and the parity of sides are derived in docs/papers.md.
A hit is an edge e = (e0, e1) that crosses a face a = (a0, a1, a2) at P = (1 - t) e0 + t e1 = sum_j w_j a_j.
Every face b at the edge makes one end of the segment of the face pair {a, b}.
"""

from __future__ import annotations

import math

import numpy as np

from clothgym._jit import device, kernel
from clothgym.kernels.predicates import orient3d_sign
from clothgym.kernels.primitives import edge_hits_triangle
from clothgym.kernels.vec3 import cross, dot, length, triangle_normal, unit

_KAPPA_EPS2 = 1e-6
"""(E.N)^2 below about this no longer steers: kappa = (E.S)(E.N) / ((E.N)^2 + eps^2) keeps its sign and stays finite."""


@device
def _shared_vertices(faces, a, b):
    count = 0
    for i in range(3):
        for j in range(3):
            if faces[a, i] == faces[b, j]:
                count += 1
    return count


@device
def _one_side(x, faces, a, b):
    """Whether all vertices of face b that are not on face a lie strictly on one side of its plane (exactly decided)."""
    a0 = faces[a, 0]
    a1 = faces[a, 1]
    a2 = faces[a, 2]
    side = 0
    for j in range(3):
        v = faces[b, j]
        if v == a0 or v == a1 or v == a2:
            continue
        s, _ = orient3d_sign(x, a0, a1, a2, v)
        if side == 0:
            side = s
        elif s != side:
            return False
    return True


@device
def _boxes_apart(x, faces, a, b):
    for c in range(3):
        p = x[faces[a, 0], c]
        q = x[faces[a, 1], c]
        r = x[faces[a, 2], c]
        u = x[faces[b, 0], c]
        v = x[faces[b, 1], c]
        w = x[faces[b, 2], c]
        if max(p, q, r) < min(u, v, w) or max(u, v, w) < min(p, q, r):
            return True
    return False


@device
def _apart_along_centres(x, faces, a, b):
    """Whether faces without a shared vertex are separated along the line of their centres, by a safe margin.

    Spares flat neighbourhoods the exact predicates: there every plane test is a tie.
    """
    ux = 0.0
    uy = 0.0
    uz = 0.0
    for j in range(3):
        ux += x[faces[b, j], 0] - x[faces[a, j], 0]
        uy += x[faces[b, j], 1] - x[faces[a, j], 1]
        uz += x[faces[b, j], 2] - x[faces[a, j], 2]
    o = faces[a, 0]
    high = 0.0
    low = math.inf
    size = 0.0
    for j in range(3):
        v = faces[a, j]
        p = dot(ux, uy, uz, x[v, 0] - x[o, 0], x[v, 1] - x[o, 1], x[v, 2] - x[o, 2])
        high = max(high, p)
        size = max(size, abs(p))
        v = faces[b, j]
        p = dot(ux, uy, uz, x[v, 0] - x[o, 0], x[v, 1] - x[o, 1], x[v, 2] - x[o, 2])
        low = min(low, p)
        size = max(size, abs(p))
    scale = abs(ux) + abs(uy) + abs(uz)
    largest = abs(x[o, 0]) + abs(x[o, 1]) + abs(x[o, 2])
    return low - high > 1e-12 * (size + scale * largest)


@device
def _apart_at_vertex(x, faces, a, b):
    """Whether two faces that share one vertex lie in opposite half-spaces there, by a safe margin."""
    v = -1
    for i in range(3):
        for j in range(3):
            if faces[a, i] == faces[b, j]:
                v = faces[a, i]
    ux = 0.0
    uy = 0.0
    uz = 0.0
    for side in range(2):
        face = a if side == 0 else b
        sign = -1.0 if side == 0 else 1.0
        bx = 0.0
        by = 0.0
        bz = 0.0
        for j in range(3):
            w = faces[face, j]
            if w != v:
                dx, dy, dz, _ = unit(x[w, 0] - x[v, 0], x[w, 1] - x[v, 1], x[w, 2] - x[v, 2])
                bx += dx
                by += dy
                bz += dz
        bx, by, bz, _ = unit(bx, by, bz)
        ux += sign * bx
        uy += sign * by
        uz += sign * bz
    largest = abs(x[v, 0]) + abs(x[v, 1]) + abs(x[v, 2])
    for side in range(2):
        face = a if side == 0 else b
        sign = -1.0 if side == 0 else 1.0
        for j in range(3):
            w = faces[face, j]
            if w == v:
                continue
            dx = x[w, 0] - x[v, 0]
            dy = x[w, 1] - x[v, 1]
            dz = x[w, 2] - x[v, 2]
            if sign * dot(ux, uy, uz, dx, dy, dz) <= 1e-12 * (abs(dx) + abs(dy) + abs(dz) + largest):
                return False
    return True


@kernel
def find_hits(x, faces, face_edges, edges, edge_owner, pairs, keys):
    """Hits among candidate face pairs, each edge tested from its owner face only.

    Shapes: x (V, 3); faces (F, 3); face_edges (F, 3) edge ids; edges (E, 2); edge_owner (E,) face ids; pairs (C, 2).
    Writes edge_id * F + face_id to keys (K,) as far as they fit; returns (hits found, edge-triangle tests).
    """
    found = 0
    tests = 0
    face_count = faces.shape[0]
    for n in range(pairs.shape[0]):
        a = pairs[n, 0]
        b = pairs[n, 1]
        shared = _shared_vertices(faces, a, b)
        if shared >= 2:
            continue
        if shared == 1:
            if _apart_at_vertex(x, faces, a, b):
                continue
        elif _boxes_apart(x, faces, a, b) or _apart_along_centres(x, faces, a, b):
            continue
        if _one_side(x, faces, a, b) or _one_side(x, faces, b, a):
            continue
        for side in range(2):
            edge_face = a if side == 0 else b
            face = b if side == 0 else a
            a0 = faces[face, 0]
            a1 = faces[face, 1]
            a2 = faces[face, 2]
            for k in range(3):
                edge = face_edges[edge_face, k]
                if edge_owner[edge] != edge_face:
                    continue
                e0 = edges[edge, 0]
                e1 = edges[edge, 1]
                if e0 == a0 or e0 == a1 or e0 == a2 or e1 == a0 or e1 == a1 or e1 == a2:
                    continue
                tests += 1
                hit, _, _, _, _, _ = edge_hits_triangle(x, e0, e1, a0, a1, a2)
                if hit:
                    if found < keys.shape[0]:
                        keys[found] = np.int64(edge) * face_count + face
                    found += 1
    return found, tests


@device
def _in_plane_parameter(x, e0, e1, a0, a1, a2):
    """Middle of the part of an edge that lies in a triangle of the same plane; 0.5 where there is none."""
    nx, ny, nz, _ = triangle_normal(x, a0, a1, a2)
    low = 0.0
    high = 1.0
    for i in range(3):
        p = a0 if i == 0 else (a1 if i == 1 else a2)
        q = a1 if i == 0 else (a2 if i == 1 else a0)
        ix, iy, iz = cross(nx, ny, nz, x[q, 0] - x[p, 0], x[q, 1] - x[p, 1], x[q, 2] - x[p, 2])
        f0 = dot(ix, iy, iz, x[e0, 0] - x[p, 0], x[e0, 1] - x[p, 1], x[e0, 2] - x[p, 2])
        f1 = dot(ix, iy, iz, x[e1, 0] - x[p, 0], x[e1, 1] - x[p, 1], x[e1, 2] - x[p, 2])
        if f0 < 0.0 and f1 > 0.0:
            low = max(low, f0 / (f0 - f1))
        elif f0 > 0.0 and f1 < 0.0:
            high = min(high, f0 / (f0 - f1))
        elif f0 < 0.0 and f1 < 0.0:
            return 0.5
    if low > high:
        return 0.5
    return 0.5 * (low + high)


@kernel
def place_hits(x, faces, edges, hit_edge, hit_face, parameters, weights, points):
    """Where each hit lies: parameters t (H,), weights (H, 3) and points (H, 3) [m], from exactly signed volumes."""
    for h in range(hit_edge.shape[0]):
        e0 = edges[hit_edge[h], 0]
        e1 = edges[hit_edge[h], 1]
        a0 = faces[hit_face[h], 0]
        a1 = faces[hit_face[h], 1]
        a2 = faces[hit_face[h], 2]
        _, d0, d1, w0, w1, w2 = edge_hits_triangle(x, e0, e1, a0, a1, a2)
        if d0 == d1:  # both exactly zero: the edge lies in the plane
            t = _in_plane_parameter(x, e0, e1, a0, a1, a2)
        else:
            t = min(max(d0 / (d0 - d1), 0.0), 1.0)
        total = w0 + w1 + w2
        if total == 0.0:
            w0 = 1.0
            w1 = 1.0
            w2 = 1.0
            total = 3.0
        parameters[h] = t
        weights[h, 0] = w0 / total
        weights[h, 1] = w1 / total
        weights[h, 2] = w2 / total
        for c in range(3):
            points[h, c] = (1.0 - t) * x[e0, c] + t * x[e1, c]


@kernel
def segment_ends(hit_edge, hit_face, edge_face_start, edge_face_ids, face_count, keys, owners):
    """One entry per hit and face at its edge: the packed face pair and the hit. Returns the number of entries."""
    n = 0
    for h in range(hit_edge.shape[0]):
        face = np.int64(hit_face[h])
        for k in range(edge_face_start[hit_edge[h]], edge_face_start[hit_edge[h] + 1]):
            other = np.int64(edge_face_ids[k])
            keys[n] = min(face, other) * face_count + max(face, other)
            owners[n] = h
            n += 1
    return n


@device
def _root(parent, parity, h):
    """Root of h and the parity of the path to it, with path compression."""
    root = h
    side = 0
    while parent[root] != root:
        side ^= parity[root]
        root = parent[root]
    node = h
    node_side = side
    while parent[node] != root and parent[node] != node:
        following = parent[node]
        following_side = node_side ^ parity[node]
        parent[node] = root
        parity[node] = node_side
        node = following
        node_side = following_side
    return root, side


@kernel
def join_contours(first, second, hit_face, contour, side, consistent):
    """Contours by weighted union-find over the pairs' hits (first, second), -1 where a pair has one hit only.

    Writes contour (H,) ids in order of their smallest hit, side (H,) 0 or 1, consistent (H,) per contour id; returns
    the number of contours. Two hits that pierce the same face carry edges of the same surface: same side.
    """
    count = hit_face.shape[0]
    parent = np.arange(count)
    parity = np.zeros(count, np.int64)
    broken = np.zeros(count, np.bool_)
    for n in range(first.shape[0]):
        if second[n] < 0:
            continue
        relation = 0 if hit_face[first[n]] == hit_face[second[n]] else 1
        ra, sa = _root(parent, parity, first[n])
        rb, sb = _root(parent, parity, second[n])
        if ra == rb:
            if sa ^ sb != relation:
                broken[ra] = True
            continue
        if rb < ra:
            ra, rb = rb, ra
        parent[rb] = ra
        parity[rb] = sa ^ sb ^ relation
        broken[ra] = broken[ra] or broken[rb]
    contours = 0
    ids = np.empty(count, np.int64)
    for h in range(count):
        root, s = _root(parent, parity, h)
        if root == h:
            ids[h] = contours
            consistent[contours] = not broken[h]
            contours += 1
        contour[h] = ids[root]
        side[h] = s
    return contours


@device
def edge_direction_sum(x, faces, edges, edge_face_start, edge_face_ids, edge, nx, ny, nz):
    """S = sum_i R_i: unit directions of the segments that start at this hit, each into its face [Volino 2006, 2.1]."""
    e0 = edges[edge, 0]
    e1 = edges[edge, 1]
    ex, ey, ez, _ = unit(x[e1, 0] - x[e0, 0], x[e1, 1] - x[e0, 1], x[e1, 2] - x[e0, 2])
    sx = 0.0
    sy = 0.0
    sz = 0.0
    for k in range(edge_face_start[edge], edge_face_start[edge + 1]):
        b = edge_face_ids[k]
        mx, my, mz, _ = triangle_normal(x, faces[b, 0], faces[b, 1], faces[b, 2])
        rx, ry, rz = cross(nx, ny, nz, mx, my, mz)
        size = length(rx, ry, rz)
        if size < 1e-15:  # coplanar: no direction of its own
            continue
        o = faces[b, 0]
        if o == e0 or o == e1:
            o = faces[b, 1]
        if o == e0 or o == e1:
            o = faces[b, 2]
        cx = x[o, 0] - x[e0, 0]
        cy = x[o, 1] - x[e0, 1]
        cz = x[o, 2] - x[e0, 2]
        along = dot(cx, cy, cz, ex, ey, ez)
        toward = dot(rx, ry, rz, cx - along * ex, cy - along * ey, cz - along * ez)
        sign = 1.0 if toward > 0.0 else -1.0
        sx += sign * rx / size
        sy += sign * ry / size
        sz += sign * rz / size
    return sx, sy, sz


@kernel
def hit_frames(x, faces, edges, edge_face_start, edge_face_ids, hit_edge, hit_face, frames):
    """Per hit, frames (H, 8): S (3), N (3), kappa = (E.S)/(E.N) regularised, and kappa unregularised.

    (E.S)/(E.N) is signed: no absolute value anywhere in it.
    """
    for h in range(hit_edge.shape[0]):
        edge = hit_edge[h]
        e0 = edges[edge, 0]
        e1 = edges[edge, 1]
        ex, ey, ez, _ = unit(x[e1, 0] - x[e0, 0], x[e1, 1] - x[e0, 1], x[e1, 2] - x[e0, 2])
        face = hit_face[h]
        nx, ny, nz, _ = triangle_normal(x, faces[face, 0], faces[face, 1], faces[face, 2])
        sx, sy, sz = edge_direction_sum(x, faces, edges, edge_face_start, edge_face_ids, edge, nx, ny, nz)
        en = dot(ex, ey, ez, nx, ny, nz)
        es = dot(ex, ey, ez, sx, sy, sz)
        frames[h, 0] = sx
        frames[h, 1] = sy
        frames[h, 2] = sz
        frames[h, 3] = nx
        frames[h, 4] = ny
        frames[h, 5] = nz
        frames[h, 6] = es * en / (en * en + _KAPPA_EPS2)
        frames[h, 7] = es / en if en != 0.0 else 0.0


@kernel
def add_hit_gradient(faces, edges, hit_edge, hit_face, parameters, weights, frames, gradient):
    """Adds d length / d vertices of all hits to gradient (V, 3): exact, closed form, without the loop-vertex terms."""
    for h in range(hit_edge.shape[0]):
        t = parameters[h]
        kappa = frames[h, 7]
        for c in range(3):
            pull = frames[h, c] - kappa * frames[h, 3 + c]
            gradient[edges[hit_edge[h], 0], c] -= (1.0 - t) * pull
            gradient[edges[hit_edge[h], 1], c] -= t * pull
            for j in range(3):
                gradient[faces[hit_face[h], j], c] -= weights[h, j] * kappa * frames[h, 3 + c]


@kernel
def add_loop_gradient(x, points, loop_hit, loop_vertex, gradient):
    """Adds the terms of segments that end at a shared (loop) vertex: d length / d x_v += unit(x_v - P)."""
    for n in range(loop_hit.shape[0]):
        v = loop_vertex[n]
        h = loop_hit[n]
        dx = x[v, 0] - points[h, 0]
        dy = x[v, 1] - points[h, 1]
        dz = x[v, 2] - points[h, 2]
        size = math.sqrt(dx * dx + dy * dy + dz * dz)
        if size > 0.0:
            gradient[v, 0] += dx / size
            gradient[v, 1] += dy / size
            gradient[v, 2] += dz / size
