"""What the regions that contours cut off do to their hits: which way out, how fast they shrink, what they lie behind."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import bare, kernel
from clothgym.kernels.sides import BLOCK, closest_in_boxes, fill_boxes
from clothgym.kernels.vec3 import cross, triangle_normal


class Regions(NamedTuple):
    """Regions as `Enclosed` has them, in the order of their contours."""

    contour: NDArray  # (R,)
    side: NDArray  # (R,) +1 or -1; 0 where both sides together cut it off
    start: NDArray  # (R + 1,)
    members: NDArray  # vertices


class Segments(NamedTuple):
    """Segments of contours and the hits at their beginnings."""

    contour: NDArray  # (S,)
    first_hit: NDArray  # (S,)
    pair_faces: NDArray  # (S, 2)
    lengths: NDArray  # (S,) [m]
    hit_face: NDArray  # (H,)
    hit_side: NDArray  # (H,) +1 or -1


class Around(NamedTuple):
    """Hits contour by contour, and the faces around every vertex."""

    order: NDArray  # (H,) hits
    bounds: NDArray  # (C + 1,) of each contour in `order`
    hit_face: NDArray  # (H,)
    hit_side: NDArray  # (H,) +1 or -1
    start: NDArray  # (V + 1,)
    faces: NDArray


@bare
def _outward(x, e0, e1, frames, h, inside_end):
    """+1 or -1, as a hit's normal shows to the end of its edge that is not the inside one; 0 where none is."""
    if inside_end < 0:
        return 0.0
    along = 0.0
    for c in range(3):
        along += (x[e1, c] - x[e0, c]) * frames[h, 3 + c]
    along = -along if inside_end == 1 else along
    return 1.0 if along >= 0.0 else -1.0


@kernel
def outward_normals(x, edges, hit_edge, frames, inside_end, normals):
    """Per hit, normals (H, 3): that of its face, frames (H, 8), towards the end of its edge that is not inside_end (H,); 0
    where that is -1."""
    for h in range(hit_edge.shape[0]):
        sign = _outward(x, edges[hit_edge[h], 0], edges[hit_edge[h], 1], frames, h, inside_end[h])
        for c in range(3):
            normals[h, c] = sign * frames[h, 3 + c]


@kernel
def push_out(x, edges, hit_edge, frames, contour, side, inside_end, h0, sums, targets):
    """Sets the relative displacement (H, 3) [m] of the hits of all contours that cut something off: h0 along the outward normal
    or, on a side that does not separate, along the mean of the others. Scratch: sums (C, 4), all 0."""
    for h in range(hit_edge.shape[0]):
        if inside_end[h] < 0:
            continue
        sign = _outward(x, edges[hit_edge[h], 0], edges[hit_edge[h], 1], frames, h, inside_end[h])
        for c in range(3):
            direction = sign * frames[h, 3 + c]
            targets[h, c] = h0 * direction
            sums[contour[h], c] += side[h] * direction
        sums[contour[h], 3] += 1.0
    for g in range(sums.shape[0]):
        if sums[g, 3] == 0.0:
            continue
        for c in range(3):
            sums[g, c] /= sums[g, 3]
        size = math.sqrt(sums[g, 0] * sums[g, 0] + sums[g, 1] * sums[g, 1] + sums[g, 2] * sums[g, 2])
        for c in range(3):
            sums[g, c] /= size if size > 0.0 else 1.0
    for h in range(hit_edge.shape[0]):
        if inside_end[h] < 0 and sums[contour[h], 3] > 0.0:
            for c in range(3):
                targets[h, c] = h0 * (side[h] * sums[contour[h], c])


@bare
def _dot(ax, ay, az, bx, by, bz):
    """Scalar product; the first and the last term are added first."""
    return (ax * bx + az * bz) + ay * by


@bare
def _leaving(x, faces, face, inside, wanted, nx, ny, nz):
    """Sign of the normal's way from the corners of a face that lie inside to those that do not; 0 where all or none do."""
    number = 0
    for k in range(3):
        number += (inside[faces[face, k]] & wanted) != 0
    if number == 0 or number == 3:
        return 0.0
    wx = 0.0
    wy = 0.0
    wz = 0.0
    for k in range(3):
        v = faces[face, k]
        share = -1.0 / number if inside[v] & wanted else 1.0 / (3 - number)
        wx += share * x[v, 0]
        wy += share * x[v, 1]
        wz += share * x[v, 2]
    way = _dot(nx, ny, nz, wx, wy, wz)
    return 1.0 if way > 0.0 else (-1.0 if way < 0.0 else 0.0)


@kernel
def area_slopes(x, faces, segments, regions, flattest, slopes, others):
    """How fast the regions of each contour lose area when its side +1 moves against its side -1: the sum of slopes (C, 3) and
    others (C, 3) [m], both all 0 before.

    Of a segment of length l between faces A and B, the region on B loses l N_A.D / sin(A, B) when B moves by D against A, with
    N_A turned to where B's corners outside of the region are; `flattest` is the least sine that counts.
    """
    contours = slopes.shape[0]
    begin = np.zeros(contours + 1, np.int64)
    for s in range(segments.contour.shape[0]):
        begin[segments.contour[s] + 1] += 1
    for c in range(contours):
        begin[c + 1] += begin[c]
    order = np.empty(segments.contour.shape[0], np.int64)
    for s in range(segments.contour.shape[0]):
        c = segments.contour[s]
        order[begin[c]] = s
        begin[c] += 1
    inside = np.zeros(x.shape[0], np.uint8)  # one bit for each side of the contour
    first = 0
    while first < regions.contour.shape[0]:
        c = regions.contour[first]
        stop = first
        while stop < regions.contour.shape[0] and regions.contour[stop] == c:
            for n in range(regions.start[stop], regions.start[stop + 1]):
                inside[regions.members[n]] |= 1 << (np.int64(regions.side[stop]) + 1)
            stop += 1
        for n in range(begin[c - 1] if c > 0 else 0, begin[c]):
            s = order[n]
            # the first hit of a segment pierces face A with an edge of face B
            h = segments.first_hit[s]
            a = segments.hit_face[h]
            b = segments.pair_faces[s, 0] + segments.pair_faces[s, 1] - a
            ax, ay, az, _ = triangle_normal(x, faces[a, 0], faces[a, 1], faces[a, 2])
            bx, by, bz, _ = triangle_normal(x, faces[b, 0], faces[b, 1], faces[b, 2])
            ux, uy, uz = cross(ax, ay, az, bx, by, bz)
            weight = segments.lengths[s] / max(math.sqrt(_dot(ux, uy, uz, ux, uy, uz)), flattest)
            side = segments.hit_side[h]
            wanted = 1 << (np.int64(side) + 1) | 2
            pull = weight * side * _leaving(x, faces, b, inside, wanted, ax, ay, az)
            slopes[c, 0] += pull * ax
            slopes[c, 1] += pull * ay
            slopes[c, 2] += pull * az
            wanted = 1 << (1 - np.int64(side)) | 2
            pull = weight * -side * _leaving(x, faces, a, inside, wanted, bx, by, bz)
            others[c, 0] += pull * bx
            others[c, 1] += pull * by
            others[c, 2] += pull * bz
        for n in range(regions.start[first], regions.start[stop]):
            inside[regions.members[n]] = 0
        first = stop


@bare
def _add_face(faces, face, inside, side, seen, region, patch, count):
    """Adds a face to those that a region lies behind, once, unless it is the region's own; returns how many there are."""
    if seen[face] == region:
        return count
    seen[face] = region
    own = np.int64(inside[faces[face, 0]]) + inside[faces[face, 1]] + inside[faces[face, 2]]
    if own == 3 or (side == 0.0 and own > 0):
        return count
    patch[count] = face
    return count + 1


@kernel
def nearest_behind(x, faces, around, regions, behind, nearest, weights, distance):
    """Closest point to each vertex (M,) of all regions on what its region lies behind: faces that the contour pierces on its
    side, and those of the regions on the contour's other side, without the region's own.

    Fills, in the order of the regions' vertices, nearest faces (M,), weights (M, 3) and distances (M,) [m]; behind (R,) says
    whether there is such a face.
    """
    seen = np.full(faces.shape[0], -1, np.int32)
    inside = np.zeros(x.shape[0], np.bool_)
    patch = np.empty(faces.shape[0], np.int32)
    for r in range(regions.contour.shape[0]):
        c = regions.contour[r]
        side = regions.side[r]
        for n in range(regions.start[r], regions.start[r + 1]):
            inside[regions.members[n]] = True
        count = 0
        for n in range(around.bounds[c], around.bounds[c + 1]):
            h = around.order[n]
            if side == 0.0 or around.hit_side[h] == side:
                count = _add_face(faces, around.hit_face[h], inside, side, seen, r, patch, count)
        other = r
        while other > 0 and regions.contour[other - 1] == c:
            other -= 1
        while other < regions.contour.shape[0] and regions.contour[other] == c:
            if regions.side[other] != side:
                for n in range(regions.start[other], regions.start[other + 1]):
                    v = regions.members[n]
                    for k in range(around.start[v], around.start[v + 1]):
                        count = _add_face(faces, around.faces[k], inside, side, seen, r, patch, count)
            other += 1
        for n in range(regions.start[r], regions.start[r + 1]):
            inside[regions.members[n]] = False
        behind[r] = count > 0
        if count == 0:
            continue
        # in the order of the surface neighbours share a box
        chosen = patch[:count]
        chosen.sort()
        triangles = np.empty((count, 3), np.int32)
        for n in range(count):
            for k in range(3):
                triangles[n, k] = faces[chosen[n], k]
        boxes = np.empty((count, 6), np.float64)
        blocks = np.empty(((count + BLOCK - 1) // BLOCK, 6), np.float64)
        fill_boxes(x, triangles, boxes, blocks)
        guess = 0
        for n in range(regions.start[r], regions.start[r + 1]):
            guess, wa, wb, wc, best = closest_in_boxes(x, regions.members[n], triangles, boxes, blocks, guess)
            nearest[n] = chosen[guess]
            weights[n, 0] = wa
            weights[n, 1] = wb
            weights[n, 2] = wc
            distance[n] = math.sqrt(best)
