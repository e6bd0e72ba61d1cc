"""Geometry of bending: the hinges of a rest shape, and the weights that turn their angles into curvatures of triangles.

Symmetric tensors are written as (H_11, H_22, 2^(1/2) H_12), so that rotations are orthogonal and norms are Frobenius'.
See `kernels.bending` for what is done here and why.
"""

from __future__ import annotations

import numpy as np

from clothgym.arrays import BoolArray, FloatArray, IntArray
from clothgym.kernels.bending import HingeArrays, QuadraticArrays
from clothgym.materials import Material
from clothgym.mesh import Surface
from clothgym.rest import RestShape

_LEAST_SINGULAR = 0.05
"""Of the angles of five hinges as functions of the curvature: what they tell less of is not read off them."""
_MIRROR = np.array([1.0, 1.0, -1.0])
_NO = -1


def flat_corners(corners: FloatArray) -> FloatArray:
    """(F, 3, 2) corners of faces (F, 3, 3) along weft and warp [m], counter-clockwise.

    The weft runs along the x axis of the rest shape, which is the first axis of a panel's plane, laid onto the face (of
    faces that stand across it, the z axis); the warp lies in the face at a right angle to it.
    """
    e, f = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e, f)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    weft = np.array([1.0, 0.0, 0.0]) - normal * normal[:, :1]
    across = np.linalg.norm(weft, axis=1) < 1e-3
    weft[across] = np.array([0.0, 0.0, 1.0]) - normal[across] * normal[across, 2:]
    weft /= np.maximum(np.linalg.norm(weft, axis=1, keepdims=True), 1e-300)
    warp = np.cross(normal, weft)
    from_first = corners - corners[:, :1]
    return np.stack([np.einsum("fci,fi->fc", from_first, axis) for axis in (weft, warp)], axis=2)


def proper_faces(rest_shape: RestShape) -> BoolArray:
    """(F,) faces of the rest shape with an area beyond rounding errors."""
    sides = rest_shape.corners - np.roll(rest_shape.corners, 1, axis=1)
    return np.asarray(rest_shape.face_areas > 1e-10 * (sides * sides).sum(axis=(1, 2)))


class Hinges:
    """Edges between two faces with area, and what their angles tell of the curvature.

    The frame of a hinge has its first axis along the edge, as the first face runs through it, its second to that face.

    Attributes:
        of_edge: (E,) hinge of each edge of the surface, -1 = none.
        faces: (H, 2) both faces, numbers in surface.faces; sides: (H, 2) which of their edges it is.
        agree: (H,) 1 if the second face runs through the edge the other way round, as in an oriented mesh, else -1.
        vertices: (H, 4) edge, then what lies opposite in the first and the second face.
        jumps: (H, 4) [1/m]: applied to heights of these vertices over the flat rest shape, the angle.
        angle: (H, 3) [m]: applied to the curvature of a quadratic surface in the frame, the angle.
        share: (H, 3) [m]: likewise, what the first face has of the angle beyond its half.
        rest: (H,) angles of the rest shape [rad]; 0 where each face lies in a plane of its own.
    """

    def __init__(self, rest_shape: RestShape, surface: Surface) -> None:
        proper = proper_faces(rest_shape)[surface.face_ids]
        edges = np.flatnonzero(surface.edge_face_count == 2)
        pair = np.stack([surface.edge_face_ids[surface.edge_face_start[edges] + k] for k in range(2)], axis=1)
        tips = surface.faces[pair].sum(axis=2) - surface.edges[edges].sum(axis=1, keepdims=True)
        kept = proper[pair].all(axis=1) & (tips[:, 0] != tips[:, 1])
        edges, tips = edges[kept], tips[kept]
        self.faces: IntArray = pair[kept]
        self.of_edge: IntArray = np.full(len(surface.edges), _NO)
        self.of_edge[edges] = np.arange(len(edges))
        self.sides = np.argmax(surface.face_edges[self.faces] == edges[:, None, None], axis=2)
        first, second = self.faces.T
        ends = np.stack([surface.faces[first, (self.sides[:, 0] + k) % 3] for k in range(2)], axis=1)
        self.agree = np.where(surface.faces[second, self.sides[:, 1]] == ends[:, 1], 1, -1)
        self.vertices: IntArray = np.concatenate([ends, tips], axis=1).astype(np.int32)
        areas = rest_shape.face_areas[surface.face_ids]
        (x, h), (y, k) = (rest_shape.laid_out(surface, faces, ends).T for faces in (first, second))
        one, two = 2.0 * areas[first] / h, 2.0 * areas[second] / k  # the edge may be longer on one side of a seam
        tx, ty = x / one, y / two
        self.jumps: FloatArray = np.stack(
            [(tx - 0.5) / h + (ty - 0.5) / k, -(tx + 0.5) / h - (ty + 0.5) / k, 1.0 / h, 1.0 / k], axis=1
        )
        own = np.stack([0.5 * (x * x - 0.25 * one * one) / h, 0.5 * h, np.sqrt(0.5) * x], axis=1)
        other = np.stack([0.5 * (y * y - 0.25 * two * two) / k, 0.5 * k, -np.sqrt(0.5) * y], axis=1)
        self.angle: FloatArray = own + other
        self.share: FloatArray = 0.5 * (own - other)
        self.rest: FloatArray = np.zeros(len(edges))
        if rest_shape.places is not None:
            self.rest = _angles(rest_shape.places[self.vertices])


class BendingPatches:
    """Curvatures of all faces that have a hinge, as functions of the hinges around; see `kernels.bending`.

    Attributes:
        hinges: of the rest shape.
        stencils, numbers, local, reach: as `stencils`, `hinges`, `local`, `reach` of `HingeArrays`.
        curvatures: (N, 3, 9) [1/m]: applied to the angles of its hinges, the curvature of a face along weft and warp.
        sides: (N, 9) 1 where the first face of a hinge and the triangle look to the same side, else -1.
        areas: (N,) [m^2].
    """

    def __init__(self, rest_shape: RestShape, surface: Surface) -> None:
        self.hinges = hinges = Hinges(rest_shape, surface)
        of_face = hinges.of_edge[surface.face_edges]  # (F, 3)
        own = np.flatnonzero((of_face != _NO).any(axis=1))
        self._rest_shape, self._surface, self._of_face, self._own = rest_shape, surface, of_face, own
        count = len(own)
        triangles = surface.faces[own]
        self.areas: FloatArray = rest_shape.face_areas[surface.face_ids[own]]
        numbers = np.full((count, 9), _NO)
        numbers[:, :3] = of_face[own]
        self.stencils: IntArray = np.repeat(triangles[:, :1], 12, axis=1)
        self.stencils[:, :3] = triangles
        self.sides: FloatArray = np.ones((count, 9))
        split = np.zeros((count, 3, 9))  # the share of each own edge, from all angles
        weights = self._share_weights()
        for i in range(3):
            there = np.flatnonzero(numbers[:, i] != _NO)
            h = numbers[there, i]
            second = (hinges.faces[h, 1] == own[there]) & (hinges.faces[h, 0] != own[there])
            other = 1 - second.astype(int)
            neighbour, side = hinges.faces[h, other], hinges.sides[h, other]
            self.stencils[there, 3 + i] = hinges.vertices[h, 2 + other]
            turned = np.where(second, hinges.agree[h], 1)
            self.sides[there, i] = turned
            places = [i, (i + 1) % 3, (i + 2) % 3, 3 + 2 * i, 4 + 2 * i]
            for k in range(2):
                far = of_face[neighbour, (side + 1 + k) % 3]
                numbers[there, places[3 + k]] = far
                seen = far != _NO
                second_there = hinges.faces[far, 0] != neighbour
                self.sides[there, places[3 + k]] = hinges.agree[h] * np.where(second_there, hinges.agree[far], 1)
                beyond = 2 + ~second_there
                self.stencils[there[seen], 6 + 2 * i + k] = hinges.vertices[far, beyond][seen]
            # the other face's hinges come last in the list of the first face, and the other way round
            order = np.where(second[:, None], [0, 3, 4, 1, 2], [0, 1, 2, 3, 4])
            sign = np.where(second, -1.0, 1.0)[:, None]
            split[there[:, None], i, places] += sign * np.take_along_axis(weights[h], order, axis=1)
            split[there, i, i] += 0.5
            split[there, i] *= turned[:, None]
        self.curvatures: FloatArray = self._edge_curvatures(numbers[:, :3] != _NO) @ split
        self.curvatures *= (numbers != _NO)[:, None, :]
        far_weight = np.abs(self.curvatures[:, :, 3:]).max(axis=(1, 2), initial=0.0)
        near = far_weight < 1e-12 * np.abs(self.curvatures).max(axis=(1, 2), initial=0.0)
        self.curvatures[near, :, 3:] = 0.0
        self.reach: IntArray = np.where(near, 3, 9).astype(np.int32)
        self.numbers: IntArray = np.maximum(numbers, 0).astype(np.int32)
        same = self.stencils[:, None, None, :] == hinges.vertices[self.numbers][:, :, :, None]
        self.local: IntArray = np.ascontiguousarray(same.argmax(axis=3), np.int32)
        self.stencils = np.ascontiguousarray(self.stencils, np.int32)

    def _share_weights(self) -> FloatArray:
        """(H, 5): the share of the first face beyond its half, from the angles of the hinge itself, of the next two edges
        of the first face and of the next two of the second: the least weights right for every quadratic surface."""
        hinges, count = self.hinges, len(self.hinges.faces)
        rows = np.zeros((count, 5, 3))
        rows[:, 0] = hinges.angle
        signs = np.ones((count, 5))
        for s in range(2):
            face, side = hinges.faces[:, s], hinges.sides[:, s]
            view = np.ones(count) if s == 0 else hinges.agree.astype(float)
            for k in range(2):
                there = (side + 1 + k) % 3
                h = self._of_face[face, there]
                # of a hinge that this face is the second of, and runs through as the first does, all is mirrored
                against = (hinges.faces[h, 0] != face) & (hinges.agree[h] == -1)
                row = np.where(against[:, None], hinges.angle[h] * _MIRROR, hinges.angle[h])
                row = np.einsum("ni,nij->nj", row, _turn(*self._direction(face, side, there)))
                row = np.where(view[:, None] < 0, row * _MIRROR, row)
                rows[:, 1 + 2 * s + k] = np.where((h != _NO)[:, None], row, 0.0)
                signs[:, 1 + 2 * s + k] = view * np.where(against, -1.0, 1.0)
        sizes = np.linalg.norm(rows, axis=2, keepdims=True)
        sizes[sizes == 0.0] = 1.0
        inverse = np.linalg.pinv(rows / sizes, rcond=_LEAST_SINGULAR) if count else np.zeros((0, 3, 5))
        return np.einsum("ni,nik->nk", hinges.share, inverse) / sizes[:, :, 0] * signs

    def _direction(self, face: IntArray, one: IntArray, two: IntArray) -> tuple[FloatArray, FloatArray]:
        """Cosine and sine of the angle from edge `one` to edge `two` of faces, as they run."""
        corners = self._rest_shape.corners[self._surface.face_ids[face]]
        rows = np.arange(len(face))
        a, b = (corners[rows, (k + 1) % 3] - corners[rows, k] for k in (one, two))
        size = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
        area = self._rest_shape.face_areas[self._surface.face_ids[face]]
        way = np.where((two - one) % 3 == 1, 1.0, -1.0)
        return (a * b).sum(axis=1) / size, way * 2.0 * area / size

    def _edge_curvatures(self, hinged: BoolArray) -> FloatArray:
        """(N, 3, 3) [1/m]: applied to the angles at the edges, the curvature along weft and warp; at edges without hinge
        the angle is that of least curvature."""
        flat = flat_corners(self._rest_shape.corners[self._surface.face_ids[self._own]])
        edge = np.roll(flat, -1, axis=1) - flat
        size = np.linalg.norm(edge, axis=2)
        m = np.stack([edge[:, :, 1], -edge[:, :, 0]], axis=1) / size[:, None, :]
        terms = np.stack([m[:, 0] ** 2, m[:, 1] ** 2, np.sqrt(2.0) * m[:, 0] * m[:, 1]], axis=1)
        terms *= (size / self.areas[:, None])[:, None, :]
        free = np.where(hinged[:, None, :], 0.0, terms)
        if len(free):
            terms = terms - free @ np.linalg.pinv(free, rcond=1e-9) @ terms
        return np.where(hinged[:, None, :], terms, 0.0)

    def _rigidity(self, material: Material) -> FloatArray:
        """(N, 3, 1) [(N m)^(1/2) m]: square roots of what the squares of the three curvatures hold."""
        weft, warp = material.bending, material.bending_along_warp
        return np.sqrt(self.areas[:, None] * np.array([weft, warp, np.sqrt(weft * warp)]))[:, :, None]

    def hinge_arrays(self, material: Material) -> HingeArrays:
        """Arrays of `bending` = "hinge"."""
        weights = np.ascontiguousarray(self._rigidity(material) * self.curvatures)
        return HingeArrays(
            self.hinges.vertices, self.hinges.rest, self.stencils, self.numbers, self.local, weights, self.reach
        )

    def quadratic_arrays(self, material: Material) -> QuadraticArrays:
        """Arrays of `bending` = "quadratic", which is flat at rest; jumps are vectors, which know no sides."""
        by_angle = self._rigidity(material) * self.curvatures * self.sides[:, None, :]
        weights = np.zeros((len(self.areas), 3, 12))
        rows = np.arange(len(self.areas))
        for k in range(9):
            for v in range(4):
                jump = self.hinges.jumps[self.numbers[:, k], v]
                weights[rows, :, self.local[:, k, v]] += by_angle[:, :, k] * jump[:, None]
        return QuadraticArrays(self.stencils, weights, np.where(self.reach == 3, 6, 12).astype(np.int32))


def _turn(cosine: FloatArray, sine: FloatArray) -> FloatArray:
    """(N, 3, 3): a symmetric tensor in axes turned by an angle."""
    c, s, cs = cosine * cosine, sine * sine, np.sqrt(2.0) * cosine * sine
    rows = [[c, s, cs], [s, c, -cs], [-cs, cs, c - s]]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def _angles(x: FloatArray) -> FloatArray:
    """(H,) hinge angles [rad] of places (H, 4, 3), signed as in `kernels.bending.hinge_angle`."""
    a, b, c, d = (x[:, k] for k in range(4))
    n, m = np.cross(b - a, c - a), np.cross(d - a, b - a)
    size = np.maximum(np.linalg.norm(b - a, axis=1), 1e-300)
    return np.arctan2((np.cross(m, n) * (b - a)).sum(axis=1) / size, (n * m).sum(axis=1))
