"""Edge-triangle hits, their pairs, contours with sides, contour length and its exact gradient.

[Volino 2006] section 2; the closed-form gradient and the parity of sides are derived in docs/papers.md.
A hit is an edge e = (e0, e1) that crosses a face a = (a0, a1, a2) at P = (1 - t) e0 + t e1 = sum_j w_j a_j.
Every face b at the edge makes one end of the segment of the face pair {a, b}.
"""

from __future__ import annotations

import math

import numpy as np

from clothgym._jit import bare, device, inlined, kernel
from clothgym.kernels.primitives import edge_hits_triangle
from clothgym.kernels.vec3 import cross, dot, length, triangle_normal, unit

_KAPPA_EPS2 = 1e-6
"""(E.N)^2 below about this no longer steers: kappa = (E.S)(E.N) / ((E.N)^2 + eps^2) keeps its sign and stays finite."""

_EXACT = 1e-9
"""Share of their terms by which volumes may be off by no more than 1e-6 of themselves; smaller ones are computed exactly."""


@inlined
def _from_corner(x, e0, e1, a0, a1, a2):
    """From the first corner of a face: its other corners and the ends of an edge; and the sum of all their sizes."""
    ux = x[a1, 0] - x[a0, 0]
    uy = x[a1, 1] - x[a0, 1]
    uz = x[a1, 2] - x[a0, 2]
    wx = x[a2, 0] - x[a0, 0]
    wy = x[a2, 1] - x[a0, 1]
    wz = x[a2, 2] - x[a0, 2]
    px = x[e0, 0] - x[a0, 0]
    py = x[e0, 1] - x[a0, 1]
    pz = x[e0, 2] - x[a0, 2]
    qx = x[e1, 0] - x[a0, 0]
    qy = x[e1, 1] - x[a0, 1]
    qz = x[e1, 2] - x[a0, 2]
    size = abs(ux) + abs(uy) + abs(uz) + abs(wx) + abs(wy) + abs(wz)
    size += abs(px) + abs(py) + abs(pz) + abs(qx) + abs(qy) + abs(qz)
    return ux, uy, uz, wx, wy, wz, px, py, pz, qx, qy, qz, size


@inlined
def _look_at(x, e0, e1, a0, a1, a2):
    """Whether an edge passes a face by, and whether it hits it, both by a safe margin: what neither says is left to the exact
    predicates.

    It passes by on one side of the face's plane or of one across the line of their centres, or outside the three sides of the
    face; it hits if its ends lie on both sides of the plane and its line within all three sides. Branch-free; in flat
    neighbourhoods, where every determinant is a tie, it is the line of the centres that tells.
    """
    ux, uy, uz, wx, wy, wz, px, py, pz, qx, qy, qz, size = _from_corner(x, e0, e1, a0, a1, a2)
    mx = 3.0 * (px + qx) - 2.0 * (ux + wx)
    my = 3.0 * (py + qy) - 2.0 * (uy + wy)
    mz = 3.0 * (pz + qz) - 2.0 * (uz + wz)
    low = dot(mx, my, mz, px, py, pz)
    other = dot(mx, my, mz, qx, qy, qz)
    low = low if low < other else other
    high = dot(mx, my, mz, ux, uy, uz)
    other = dot(mx, my, mz, wx, wy, wz)
    high = high if high > other else other
    high = high if high > 0.0 else 0.0
    apart = low - high > 1e-12 * size * size
    nx, ny, nz = cross(ux, uy, uz, wx, wy, wz)
    low = dot(nx, ny, nz, px, py, pz)
    high = dot(nx, ny, nz, qx, qy, qz)
    margin = 1e-12 * size * size * size
    apart |= ((low > margin) & (high > margin)) | ((low < -margin) & (high < -margin))
    across = ((low > margin) & (high < -margin)) | ((low < -margin) & (high > margin))
    # the edge's line passes outside where it sees two sides of the face run differently around it
    rx, ry, rz = cross(px, py, pz, qx, qy, qz)
    first = -dot(rx, ry, rz, ux, uy, uz)
    third = dot(rx, ry, rz, wx, wy, wz)
    second = low - high - first - third
    left = (first > margin) | (second > margin) | (third > margin)
    right = (first < -margin) | (second < -margin) | (third < -margin)
    inside = (first > margin) & (second > margin) & (third > margin)
    inside |= (first < -margin) & (second < -margin) & (third < -margin)
    return apart | (left & right), across & inside


@kernel
def find_hits(x, faces, edges, edge_face, keys):
    """Hits among pairs of an edge and a face without a common vertex.

    Shapes: x (V, 3); faces (F, 3); edges (E, 2); edge_face (C, 2) ids, reordered. Writes edge_id * F + face_id to keys (C,);
    returns (hits found, pairs that did not pass by, exact tests).
    """
    left = 0
    unsure = 0
    for n in range(edge_face.shape[0]):
        edge = edge_face[n, 0]
        face = edge_face[n, 1]
        apart, hit = _look_at(x, edges[edge, 0], edges[edge, 1], faces[face, 0], faces[face, 1], faces[face, 2])
        # those that are left stand in front, with the outcome as the sign of the edge
        edge_face[left, 0] = ~edge if hit else edge
        edge_face[left, 1] = face
        left += not apart
    found = 0
    for n in range(left):
        edge = edge_face[n, 0]
        face = edge_face[n, 1]
        hit = edge < 0
        if hit:
            edge = ~edge
            edge_face[n, 0] = edge
        else:
            hit, _, _, _, _, _ = edge_hits_triangle(
                x, edges[edge, 0], edges[edge, 1], faces[face, 0], faces[face, 1], faces[face, 2]
            )
            unsure += 1
        # whether it is one is added, not branched on
        keys[found] = np.int64(edge) * faces.shape[0] + face
        found += hit
    return found, left, unsure


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


@inlined
def _volumes(x, e0, e1, a0, a1, a2):
    """Of a hit: whether these suffice, volumes under the face of e0 and e1 and those of the face's sides around the edge,
    opposite a0, a1, a2 [m^3]; by a safe margin all have the signs that exact ones have."""
    ux, uy, uz, wx, wy, wz, px, py, pz, qx, qy, qz, size = _from_corner(x, e0, e1, a0, a1, a2)
    margin = _EXACT * size * size * size
    nx, ny, nz = cross(ux, uy, uz, wx, wy, wz)
    low = dot(nx, ny, nz, px, py, pz)
    high = dot(nx, ny, nz, qx, qy, qz)
    rx, ry, rz = cross(px, py, pz, qx, qy, qz)
    w2 = -dot(rx, ry, rz, ux, uy, uz)
    w1 = dot(rx, ry, rz, wx, wy, wz)
    w0 = low - high - w1 - w2
    sure = (abs(low) > margin) & (abs(high) > margin)
    sure &= (abs(w0) > margin) & (abs(w1) > margin) & (abs(w2) > margin)
    return sure, low, high, w0, w1, w2


@kernel
def place_hits(x, faces, edges, hit_edge, hit_face, parameters, weights, points):
    """Where each hit lies: parameters t (H,), weights (H, 3) and points (H, 3) [m], from exactly signed volumes."""
    for h in range(hit_edge.shape[0]):
        e0 = edges[hit_edge[h], 0]
        e1 = edges[hit_edge[h], 1]
        a0 = faces[hit_face[h], 0]
        a1 = faces[hit_face[h], 1]
        a2 = faces[hit_face[h], 2]
        sure, d0, d1, w0, w1, w2 = _volumes(x, e0, e1, a0, a1, a2)
        if not sure:
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
def end_count(hit_edge, edge_face_start):
    """How many ends of segments there are: one per hit and face at its edge."""
    count = 0
    for h in range(hit_edge.shape[0]):
        count += edge_face_start[hit_edge[h] + 1] - edge_face_start[hit_edge[h]]
    return count


@kernel
def segment_ends(hit_edge, hit_face, edge_face_start, edge_face_ids, face_count, keys, owners):
    """One entry (N,) per hit and face at its edge: the packed face pair and the hit."""
    n = 0
    for h in range(hit_edge.shape[0]):
        face = np.int64(hit_face[h])
        for k in range(edge_face_start[hit_edge[h]], edge_face_start[hit_edge[h] + 1]):
            other = np.int64(edge_face_ids[k])
            keys[n] = min(face, other) * face_count + max(face, other)
            owners[n] = h
            n += 1


@kernel
def match_hits(keys, owners, faces, first, second, pair_faces, hits_per_pair, loop_vertex):
    """Pairs of faces from the ends of `segment_ends`, sorted by their keys (N,), then owners; returns how many.

    Writes the two hits of each pair, -1 where there is one only, its faces (S, 2), how many hits it has, and, where that is
    one, the vertex that its faces share, at which the segment ends; -1 where they share none, or more than one.
    """
    pairs = 0
    last = np.int64(-1)
    for n in range(keys.shape[0]):
        key = keys[n]
        if key == last:
            hits_per_pair[pairs - 1] += 1
            if hits_per_pair[pairs - 1] == 2:
                second[pairs - 1] = owners[n]
            continue
        last = key
        first[pairs] = owners[n]
        second[pairs] = -1
        pair_faces[pairs, 0] = key // faces.shape[0]
        pair_faces[pairs, 1] = key % faces.shape[0]
        hits_per_pair[pairs] = 1
        loop_vertex[pairs] = -1
        pairs += 1
    for s in range(pairs):
        if hits_per_pair[s] > 1:
            continue
        shared = 0
        for i in range(3):
            for j in range(3):
                if faces[pair_faces[s, 0], i] == faces[pair_faces[s, 1], j]:
                    loop_vertex[s] = faces[pair_faces[s, 0], i]
                    shared += 1
        if shared != 1:
            loop_vertex[s] = -1
    return pairs


@bare
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


@kernel
def draw_segments(x, points, first, second, loop_vertex, segments, lengths):
    """Segments (S, 2, 3) from their first hit to their second one, their loop vertex or nowhere, and their lengths (S,) [m]."""
    for s in range(first.shape[0]):
        total = 0.0
        for c in range(3):
            start = points[first[s], c]
            finish = start
            if loop_vertex[s] >= 0:
                finish = x[loop_vertex[s], c]
            elif second[s] >= 0:
                finish = points[second[s], c]
            segments[s, 0, c] = start
            segments[s, 1, c] = finish
            total += (finish - start) * (finish - start)
        lengths[s] = math.sqrt(total)


@bare
def _normal(x, faces, face, normals, known):
    """Unit normal of a face, as `triangle_normal`, kept in normals (F, 3) where it is known (F,)."""
    if not known[face]:
        known[face] = True
        nx, ny, nz, _ = triangle_normal(x, faces[face, 0], faces[face, 1], faces[face, 2])
        normals[face, 0] = nx
        normals[face, 1] = ny
        normals[face, 2] = nz
    return normals[face, 0], normals[face, 1], normals[face, 2]


@kernel
def hit_frames(x, faces, edges, edge_face_start, edge_face_ids, hit_edge, hit_face, frames):
    """Per hit, frames (H, 8): S (3), N (3), kappa = (E.S)/(E.N) regularised, and kappa unregularised.

    S = sum_i R_i: unit directions of the segments that start at this hit, each into its face [Volino 2006, 2.1]. (E.S)/(E.N)
    is signed: no absolute value anywhere in it.
    """
    # a contour meets every face that it passes at some hits in a row
    normals = np.empty((faces.shape[0], 3), np.float64)
    known = np.zeros(faces.shape[0], np.bool_)
    for h in range(hit_edge.shape[0]):
        edge = hit_edge[h]
        e0 = edges[edge, 0]
        e1 = edges[edge, 1]
        ex, ey, ez, _ = unit(x[e1, 0] - x[e0, 0], x[e1, 1] - x[e0, 1], x[e1, 2] - x[e0, 2])
        nx, ny, nz = _normal(x, faces, hit_face[h], normals, known)
        sx = 0.0
        sy = 0.0
        sz = 0.0
        for k in range(edge_face_start[edge], edge_face_start[edge + 1]):
            b = edge_face_ids[k]
            mx, my, mz = _normal(x, faces, b, normals, known)
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
