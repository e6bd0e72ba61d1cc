"""The torso of a body of the package as an open tube, evenly remeshed."""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from functools import lru_cache

import numpy as np

from clothgym.arrays import FloatArray, IntArray, check_number, read_only
from clothgym.kernels import sides
from clothgym.mesh import Mesh, Surface, face_areas
from clothgym.rig import ARM_BONES, Rig

_NECK_BONES = ("neck_01", "head")
_NECK_LEVEL, _ARM_LEVEL = 0.5, 0.75
"""Weights at which the torso ends; arms have theirs well up the shoulder, where 0.5 would leave no strap."""
_BORDER_SMOOTHING = 4
_REMESH_ROUNDS = 6


@lru_cache(maxsize=8)
def torso(rig: Rig, edge_length: float = 0.022) -> Mesh:
    """The trunk as an open tube with four borders (neck, two armholes, hip), remeshed evenly; arrays are read-only.

    It is cut where neck and head have half of the weight, where the arms have most of it, and level with the middle of
    the pelvis bone, above the legs.

    Args:
        rig: from `rig.load`.
        edge_length: mean length of its edges [m], 0.01 to 0.06.

    Raises:
        ValueError: an edge length out of range.
    """
    check_number(edge_length, "torso.edge_length", 0.01, 0.06)
    neck = rig.weights[:, [rig.bone(name) for name in _NECK_BONES]].sum(axis=1)
    arms = rig.weights[:, [n for n, name in enumerate(rig.bones) if name.startswith(ARM_BONES)]].sum(axis=1)
    pelvis = rig.bone("pelvis")
    hip = 0.5 * (rig.head[pelvis, 1] + rig.tail[pelvis, 1])
    vertices, faces = rig.vertices, rig.faces
    fields = np.column_stack(
        [_NECK_LEVEL - _smoothed(rig, neck), _ARM_LEVEL - _smoothed(rig, arms), vertices[:, 1] - hip]
    )
    for column in range(fields.shape[1]):
        vertices, faces, fields = _clip(vertices, faces, fields, column)
    vertices, faces = _largest_component(vertices, faces)
    remesher = _Remesher(vertices, faces, edge_length)
    for _ in range(_REMESH_ROUNDS):
        remesher.split_long()
        remesher.collapse_short()
        remesher.flip()
        remesher.smooth()
    mesh = remesher.mesh()
    return Mesh(read_only(mesh.vertices), read_only(mesh.faces))


def _smoothed(rig: Rig, values: FloatArray) -> FloatArray:
    """A field over the body's vertices (V,), averaged with the neighbours a few times."""
    start, neighbours, _ = Surface(rig.faces, len(rig.vertices)).neighbourhood
    owner = np.repeat(np.arange(len(values)), np.diff(start))
    degree = np.maximum(np.diff(start), 1)
    for _ in range(_BORDER_SMOOTHING):
        values = 0.5 * values + 0.5 * np.bincount(owner, values[neighbours], minlength=len(values)) / degree
    return values


def _clip(
    vertices: FloatArray, faces: IntArray, fields: FloatArray, column: int
) -> tuple[FloatArray, IntArray, FloatArray]:
    """The part of a surface where a column of fields (V, C), linear over each face, is positive; fields go along."""
    level = np.where(fields[:, column] == 0.0, 1e-12, fields[:, column])
    values = np.column_stack([vertices, fields])
    points = list(values)
    made: dict[tuple[int, int], int] = {}

    def crossing(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in made:
            t = level[key[0]] / (level[key[0]] - level[key[1]])
            made[key] = len(points)
            points.append((1.0 - t) * values[key[0]] + t * values[key[1]])
        return made[key]

    positive = level > 0.0
    counts = positive[faces].sum(axis=1)
    kept = faces[counts == 3].tolist()
    for face in faces[(counts == 1) | (counts == 2)].tolist():
        while positive[face[0]] == positive[face[1]] or positive[face[0]] == positive[face[2]]:
            face = face[1:] + face[:1]  # until corner 0 is the odd one out
        a, b, c = face
        ab, ca = crossing(a, b), crossing(c, a)
        kept.extend([[a, ab, ca]] if positive[a] else [[ab, b, c], [ab, c, ca]])
    clipped, kept_faces = _compact(np.asarray(points), np.asarray(kept, np.int32).reshape(-1, 3))
    return np.ascontiguousarray(clipped[:, :3]), kept_faces, clipped[:, 3:]


def _compact(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Without the rows (V, C) of vertices that no face uses."""
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], np.ascontiguousarray(inverse.reshape(-1, 3), np.int32)


def _largest_component(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """The connected part with the greatest area."""
    component = Surface(faces, len(vertices)).components[faces[:, 0]]
    return _compact(vertices, faces[component == np.bincount(component, face_areas(vertices, faces)).argmax()])


class _Remesher:
    """Even triangles on a surface by splits, collapses, flips and smoothing [Botsch 2004]; borders keep their place."""

    def __init__(self, vertices: FloatArray, faces: IntArray, length: float) -> None:
        self.original = (np.ascontiguousarray(vertices), faces)
        surface = Surface(faces, len(vertices))
        self.border = vertices[surface.edges[surface.edge_face_count == 1]]
        self.points = [np.array(p) for p in vertices]
        self.faces: dict[int, tuple[int, int, int]] = {}
        self.around: list[set[int]] = [set() for _ in vertices]
        self.next_face = 0
        self.length = length
        self._add(faces.tolist())

    def mesh(self) -> Mesh:
        """Vertices and faces from top to bottom, so that neighbours lie close in memory."""
        vertices, faces = _compact(np.asarray(self.points), np.asarray(list(self.faces.values()), np.int32))
        order = np.argsort(-vertices[:, 1], kind="stable")
        rank = np.empty(len(order), np.int32)
        rank[order] = np.arange(len(order), dtype=np.int32)
        faces = rank[faces]
        return Mesh(vertices[order], np.ascontiguousarray(faces[np.argsort(faces.min(axis=1), kind="stable")]))

    def _add(self, faces: Iterable[Iterable[int]]) -> None:
        for face in faces:
            a, b, c = face
            self.faces[self.next_face] = (a, b, c)
            for v in (a, b, c):
                self.around[v].add(self.next_face)
            self.next_face += 1

    def _remove(self, face: int) -> tuple[int, int, int]:
        corners = self.faces.pop(face)
        for v in corners:
            self.around[v].discard(face)
        return corners

    def _edges(self) -> list[tuple[int, int]]:
        return sorted({(min(f[i], f[i - 1]), max(f[i], f[i - 1])) for f in self.faces.values() for i in range(3)})

    def _size(self, a: int, b: int) -> float:
        d = self.points[a] - self.points[b]
        return float(np.sqrt(d @ d))

    def _neighbours(self, v: int) -> set[int]:
        return {u for f in self.around[v] for u in self.faces[f]} - {v}

    def _shared(self, a: int, b: int) -> list[int]:
        return sorted(self.around[a] & self.around[b])

    def _on_border(self, v: int) -> bool:
        return len(self._neighbours(v)) != len(self.around[v])

    def _normal(self, a: int, b: int, c: int) -> FloatArray:
        p = self.points[a]
        u, w = self.points[b] - p, self.points[c] - p
        return np.array([u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]])

    def split_long(self) -> None:
        """Halves edges longer than 4/3 of the wanted length, longest first."""
        limit = 4.0 / 3.0 * self.length
        heap = [(-size, a, b) for a, b in self._edges() if (size := self._size(a, b)) > limit]
        heapq.heapify(heap)
        while heap:
            _, a, b = heapq.heappop(heap)
            shared = self._shared(a, b)
            if not shared:
                continue
            middle = len(self.points)
            self.points.append(0.5 * (self.points[a] + self.points[b]))
            self.around.append(set())
            for face in shared:
                corners = self._remove(face)
                self._add(tuple(middle if v == old else v for v in corners) for old in (a, b))
            for v in self._neighbours(middle):
                if (size := self._size(v, middle)) > limit:
                    heapq.heappush(heap, (-size, min(v, middle), max(v, middle)))

    def collapse_short(self) -> None:
        """Joins the ends of edges shorter than 4/5 of the wanted length where the surface stays a manifold, keeps its
        borders and turns no face over."""
        low, high = 0.8 * self.length, 4.0 / 3.0 * self.length
        heap = [(size, a, b) for a, b in self._edges() if (size := self._size(a, b)) < low]
        heapq.heapify(heap)
        while heap:
            size, a, b = heapq.heappop(heap)
            shared = self._shared(a, b)
            if not shared or size != self._size(a, b):
                continue
            border_a, border_b = self._on_border(a), self._on_border(b)
            if border_a and border_b and len(shared) == 2:
                continue  # would join two borders, or one with itself
            if len(self._neighbours(a) & self._neighbours(b)) != len(shared):
                continue
            if border_a != border_b:
                place = self.points[a if border_a else b]
            else:
                place = 0.5 * (self.points[a] + self.points[b])
            if not self._may_join(a, b, place, high):
                continue
            for face in shared:
                self._remove(face)
            self._add([tuple(a if v == b else v for v in self._remove(f)) for f in sorted(self.around[b])])
            self.points[a] = np.array(place)
            for v in self._neighbours(a):
                if (size := self._size(v, a)) < low:
                    heapq.heappush(heap, (size, min(v, a), max(v, a)))

    def _may_join(self, a: int, b: int, place: FloatArray, high: float) -> bool:
        """No edge at the new place is too long, and no face around turns by more than about 60 degrees."""
        for v in (self._neighbours(a) | self._neighbours(b)) - {a, b}:
            d = self.points[v] - place
            if d @ d > high * high:
                return False
        for face in self.around[a] ^ self.around[b]:
            corners = self.faces[face]
            before = self._normal(*corners)
            p, q, r = (place if v in (a, b) else self.points[v] for v in corners)
            after = np.cross(q - p, r - p)
            if before @ after <= 0.5 * np.sqrt((before @ before) * (after @ after)):
                return False
        return True

    def flip(self) -> None:
        """Turns inner edges where that brings the vertices closer to six neighbours (four on a border)."""
        live = {v for f in self.faces.values() for v in f}
        excess = {v: len(self._neighbours(v)) - (4 if self._on_border(v) else 6) for v in live}
        for a, b in self._edges():
            shared = self._shared(a, b)
            if len(shared) != 2:
                continue
            first, second = (self.faces[f] for f in shared)
            if first[(first.index(a) + 1) % 3] != b:
                first, second = second, first  # first runs a -> b
            c, d = sum(first) - a - b, sum(second) - a - b
            if c == d or d in self._neighbours(c):
                continue
            change = sum(abs(excess[v] + step) - abs(excess[v]) for v, step in ((a, -1), (b, -1), (c, 1), (d, 1)))
            if change >= 0:
                continue
            old = self._normal(*first) + self._normal(*second)
            new = ((c, a, d), (d, b, c))
            sizes = [self._normal(*face) for face in new]
            if any(n @ old <= 0.7 * np.sqrt((n @ n) * (old @ old)) for n in sizes):
                continue
            for face in shared:
                self._remove(face)
            self._add(new)
            for v, step in ((a, -1), (b, -1), (c, 1), (d, 1)):
                excess[v] += step

    def smooth(self) -> None:
        """Moves inner vertices towards the mean of their neighbours and border vertices along the border, and all back
        onto the original surface."""
        live = sorted({v for f in self.faces.values() for v in f})
        moved = {}
        for v in live:
            around = sorted(self._neighbours(v))
            p = self.points[v]
            if self._on_border(v):
                before, after = (self.points[u] for u in around if len(self._shared(u, v)) == 1)
                moved[v] = 0.5 * (p + 0.5 * (before + after))
                continue
            step = np.mean([self.points[u] for u in around], axis=0) - p
            normal = np.sum([self._normal(*self.faces[f]) for f in sorted(self.around[v])], axis=0)
            moved[v] = p + 0.7 * (step - (step @ normal) / (normal @ normal) * normal)
        on_border = np.array([self._on_border(v) for v in live])
        places = np.asarray([moved[v] for v in live])
        places[on_border] = _closest_on_segments(places[on_border], self.border)
        places[~on_border] = _closest_on_surface(places[~on_border], *self.original)
        for v, place in zip(live, places):
            self.points[v] = place


def _closest_on_segments(x: FloatArray, segments: FloatArray) -> FloatArray:
    """Closest points (N, 3) on segments (S, 2, 3)."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    t = ((x[:, None] - start) * along).sum(axis=2) / np.maximum((along * along).sum(axis=1), 1e-30)
    places = start + np.clip(t, 0.0, 1.0)[:, :, None] * along
    nearest = ((x[:, None] - places) ** 2).sum(axis=2).argmin(axis=1)
    return places[np.arange(len(x)), nearest]


def _closest_on_surface(x: FloatArray, vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Closest points (N, 3) on a surface."""
    stacked = np.concatenate([vertices, x])
    boxes, blocks = np.empty((len(faces), 6)), np.empty((-(-len(faces) // sides.BLOCK), 6))
    sides.face_boxes(stacked, faces, boxes, blocks)
    face, weights, distance = np.zeros(len(x), np.int32), np.zeros((len(x), 3)), np.zeros(len(x))
    sides.closest_faces(stacked, len(vertices), faces, boxes, blocks, face, weights, distance)
    return np.einsum("pc,pcx->px", weights, vertices[faces[face]])
