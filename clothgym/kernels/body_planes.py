"""What colliders in object space find before the sweeps of a substep: planes that points of the cloth have to keep to.

A plane touches the body at its point nearest to the cloth's; its normal is the way from there, or on the body itself that
of the face. So cloth is led around edges and corners, and friction, rebound and corrections are those of the maps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import bare, kernel
from clothgym.kernels.closest import feature_normal, on_face

_TOUCHING = 1e-7
"""[m] nearer than this the way to the nearest point has no direction that could be relied on."""

BODY_VERTEX, EDGES, CLOTH_VERTEX = 0, 1, 2
"""Kinds of pairs, as `dop_primitives` numbers them for a body and a cloth."""


class BodyPlanes(NamedTuple):
    """Planes as normal and offset: the signed distance of a point is normal . point + offset [m]."""

    near: NDArray  # (V,) bool: the vertex has a plane
    planes: NDArray  # (V, 4)
    flow: NDArray  # (V, 3) velocity of the body there [m/s]
    number: NDArray  # (1,) int64: how many other points of the cloth have one
    corners: NDArray  # (K, 3) int32 vertices around each
    weights: NDArray  # (K, 3) of these, sum 1
    point_planes: NDArray  # (K, 4)
    point_flow: NDArray  # (K, 3) [m/s]


@bare
def distance_to(x, y, z, planes, n):
    """Signed distance of a point to the n-th plane [m]."""
    return planes[n, 0] * x + planes[n, 1] * y + planes[n, 2] * z + planes[n, 3]


@bare
def _write(planes, n, px, py, pz, cx, cy, cz, nx, ny, nz):
    """The plane at c on the body for a point p of the cloth; n: normal of the surface there, of any length."""
    dx, dy, dz = px - cx, py - cy, pz - cz
    if dx * dx + dy * dy + dz * dz < _TOUCHING * _TOUCHING:
        dx, dy, dz = nx, ny, nz
    elif dx * nx + dy * ny + dz * nz < 0.0:
        dx, dy, dz = -dx, -dy, -dz
    size = math.sqrt(dx * dx + dy * dy + dz * dz)
    scale = 1.0 / size if size > 0.0 else 0.0
    planes[n, 0] = scale * dx
    planes[n, 1] = scale * dy
    planes[n, 2] = scale * dz
    planes[n, 3] = -scale * (dx * cx + dy * cy + dz * cz)


@kernel
def planes_on_faces(points, body, velocities, face, near, planes, flow):
    """Planes of points (N, 3) [m] whose nearest face of the body is known.

    Args:
        points: (N, 3) [m].
        body: `closest.ClosedSurface`.
        velocities: (B, 3) of the body's vertices [m/s].
        face: (N,) nearest face, -1 = none within reach.
        near: (N,) bool, written.
        planes, flow: (N, 4), (N, 3), written for those that are near.
    """
    scratch = np.empty((4, 3), np.float64)
    corners = body.corners
    for i in range(points.shape[0]):
        f = face[i]
        near[i] = f >= 0
        if f < 0:
            continue
        for k in range(3):
            scratch[0, k] = points[i, k]
        _, wa, wb, wc = on_face(corners, f, scratch)
        nx, ny, nz = feature_normal(body, f, wa, wb, wc)
        _write(
            planes, i, points[i, 0], points[i, 1], points[i, 2],
            wa * corners[f, 0] + wb * corners[f, 3] + wc * corners[f, 6],
            wa * corners[f, 1] + wb * corners[f, 4] + wc * corners[f, 7],
            wa * corners[f, 2] + wb * corners[f, 5] + wc * corners[f, 8],
            nx, ny, nz,
        )  # fmt: skip
        for k in range(3):
            flow[i, k] = (
                wa * velocities[body.faces[f, 0], k]
                + wb * velocities[body.faces[f, 1], k]
                + wc * velocities[body.faces[f, 2], k]
            )


@kernel
def nearest_of_pairs(quads, kinds, distances, polygons, least, face):
    """Of pairs of cloth vertices and faces of the body the nearest face of each vertex.

    Args:
        quads, kinds, distances, polygons: (N, 4), (N,), (N,), (N, 2) as `dop_near.Near` has them, the body first.
        least: (V,) scratch.
        face: (V,) written; -1 = none.
    """
    face[:] = -1
    for n in range(kinds.shape[0]):
        v = quads[n, 0]
        if kinds[n] == CLOTH_VERTEX and (face[v] < 0 or distances[n] < least[v]):
            least[v] = distances[n]
            face[v] = polygons[n, 0]


@bare
def _inside(w):
    return w > 0.0 and w < 1.0


@kernel
def planes_of_pairs(x, y, body, velocities, body_edges, quads, kinds, weights, found):
    """Planes for vertices of the body beside faces of the cloth, and for edges beside edges, where both are passed by their
    insides: ends and borders have pairs of their own.

    Args:
        x, y: (V, 3) of the cloth, (B, 3) of the body [m].
        body: pseudonormals.
        velocities: (B, 3) [m/s].
        body_edges: (N,) edge of the body in pairs of the kind EDGES.
        quads, kinds, weights: as `nearest_of_pairs`; (N, 3) barycentrics, or places along both edges.
        found: `BodyPlanes` with room for all pairs; number, corners, weights, point_planes and point_flow are written.
    """
    count = 0
    for n in range(kinds.shape[0]):
        if kinds[n] == BODY_VERTEX:
            v = quads[n, 0]
            a, b, c = quads[n, 1], quads[n, 2], quads[n, 3]
            wa, wb, wc = weights[n, 0], weights[n, 1], weights[n, 2]
            if not (_inside(wa) and _inside(wb) and _inside(wc)):
                continue
            cx, cy, cz = y[v, 0], y[v, 1], y[v, 2]
            nx, ny, nz = body.vertex_normals[v, 0], body.vertex_normals[v, 1], body.vertex_normals[v, 2]
            ux, uy, uz = velocities[v, 0], velocities[v, 1], velocities[v, 2]
        elif kinds[n] == EDGES:
            s, t = weights[n, 0], weights[n, 1]
            if not (_inside(s) and _inside(t)):
                continue
            i, j = quads[n, 0], quads[n, 1]
            a, b, c = quads[n, 2], quads[n, 3], quads[n, 3]
            wa, wb, wc = 1.0 - t, t, 0.0
            cx = y[i, 0] + s * (y[j, 0] - y[i, 0])
            cy = y[i, 1] + s * (y[j, 1] - y[i, 1])
            cz = y[i, 2] + s * (y[j, 2] - y[i, 2])
            e = body_edges[n]
            nx, ny, nz = body.edge_normals[e, 0], body.edge_normals[e, 1], body.edge_normals[e, 2]
            ux = velocities[i, 0] + s * (velocities[j, 0] - velocities[i, 0])
            uy = velocities[i, 1] + s * (velocities[j, 1] - velocities[i, 1])
            uz = velocities[i, 2] + s * (velocities[j, 2] - velocities[i, 2])
        else:
            continue
        px = wa * x[a, 0] + wb * x[b, 0] + wc * x[c, 0]
        py = wa * x[a, 1] + wb * x[b, 1] + wc * x[c, 1]
        pz = wa * x[a, 2] + wb * x[b, 2] + wc * x[c, 2]
        _write(found.point_planes, count, px, py, pz, cx, cy, cz, nx, ny, nz)
        found.corners[count, 0] = a
        found.corners[count, 1] = b
        found.corners[count, 2] = c
        found.weights[count, 0] = wa
        found.weights[count, 1] = wb
        found.weights[count, 2] = wc
        found.point_flow[count, 0] = ux
        found.point_flow[count, 1] = uy
        found.point_flow[count, 2] = uz
        count += 1
    found.number[0] = count
