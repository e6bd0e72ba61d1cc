"""Exact intersections of surfaces: hits, pairs, segments, contours, length and its gradient; and proximities."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import FloatArray, IntArray, check_number
from clothgym.detection.hierarchy import Hierarchy
from clothgym.kernels import contour as contour_kernels
from clothgym.kernels import proximity
from clothgym.mesh import Surface, as_surface


@dataclass(frozen=True)
class Contour:
    """One intersection contour.

    Attributes:
        length: [m], each segment once.
        hit_count: number of hits.
        closed: every hit's segments all continue at another hit.
        ends: how an open contour ends, sorted letters: B = at a border edge, I = in the inside of a face that a border
            edge pierces (the same point seen from the other surface), L = at a loop vertex.
        kind: "Closed", "LL", "BLI" (one loop vertex), "BBII" (both borders on one side), "BIBI" (one on each side),
            "branched" (a seam of three or more faces on the way), or "Open" for any other.
        self_contour: both sides lie on one connected component.
        consistent: its two sides can be told apart (False for figures like Eight).
        components: ids of the connected components that it joins.
    """

    length: float
    hit_count: int
    closed: bool
    kind: str
    self_contour: bool
    consistent: bool
    components: tuple[int, ...]


class Intersections:
    """All intersections of a surface with itself (several meshes may be one surface).

    Attributes:
        edge_triangle: (H, 3) e0, e1 (e0 < e1), face id; sorted.
        parameters: (H,) t of the point P = (1 - t) e0 + t e1.
        weights: (H, 3) barycentric weights of P in the face.
        points: (H, 3) P [m].
        pairs: (S, 2) intersecting face pairs a < b, sorted.
        segments: (S, 2, 3) [m]; a pair with one shared vertex has its segment from the hit to that (loop) vertex.
        contour: (S,) contour of each segment; hit_contour: (H,) of each hit; hit_side: (H,) +1 or -1.
        skipped_faces: faces with a repeated vertex id, left out.
        edge_triangle_tests: exact tests that were made.
    """

    def __init__(self, vertices: FloatArray, surface: Surface, pairs: IntArray) -> None:
        self.vertices = vertices
        self.surface = surface
        self.skipped_faces = surface.skipped_faces
        s = surface.arrays
        keys = np.empty(max(256, len(surface.faces) // 4), np.int64)
        # predicates multiply three coordinates: scaled by a power of two, their roundings stay far from over- and underflow
        largest = float(np.abs(vertices).max()) if len(vertices) else 0.0
        power = 0 if largest == 0.0 else 300 - int(np.frexp(largest)[1])
        scaled = np.ldexp(vertices, power)
        while True:
            found, tests = contour_kernels.find_hits(scaled, s.faces, s.face_edges, s.edges, s.edge_owner, pairs, keys)
            if found <= len(keys):
                break
            keys = np.empty(found, np.int64)
        self.edge_triangle_tests = int(tests)
        keys = np.sort(keys[:found])
        face_count = max(len(s.faces), 1)
        self.hit_edge: IntArray = (keys // face_count).astype(np.int32)
        self.hit_face: IntArray = (keys % face_count).astype(np.int32)
        self.hit_count = int(found)
        self.parameters = np.empty(found)
        self.weights = np.empty((found, 3))
        self.points = np.empty((found, 3))
        contour_kernels.place_hits(
            scaled, s.faces, s.edges, self.hit_edge, self.hit_face, self.parameters, self.weights, self.points
        )
        self.points = np.ldexp(self.points, -power)
        self._join()

    def _join(self) -> None:
        """Pairs, segments and contours from the hits."""
        s, found = self.surface.arrays, self.hit_count
        per_hit = np.diff(s.edge_face_start)[self.hit_edge]
        ends = int(per_hit.sum())
        keys, owners = np.empty(ends, np.int64), np.empty(ends, np.int64)
        face_count = max(len(s.faces), 1)
        contour_kernels.segment_ends(
            self.hit_edge, self.hit_face, s.edge_face_start, s.edge_face_ids, face_count, keys, owners
        )
        order = np.argsort(keys, kind="stable")
        keys, owners = keys[order], owners[order]
        starts = np.flatnonzero(np.r_[True, keys[1:] != keys[:-1]]) if ends else np.zeros(0, np.int64)
        sizes = np.diff(np.r_[starts, ends])
        self.first_hit: NDArray[np.int64] = owners[starts]
        self.second_hit: NDArray[np.int64] = np.full(len(starts), -1, np.int64)
        two = sizes >= 2
        self.second_hit[two] = owners[starts[two] + 1]
        self._pair_faces = np.stack([keys[starts] // face_count, keys[starts] % face_count], 1).astype(np.int32)
        self.hits_per_pair = sizes
        hit_contour, side = np.empty(found, np.int64), np.empty(found, np.int64)
        consistent = np.ones(found, np.bool_)
        count = contour_kernels.join_contours(
            self.first_hit, self.second_hit, self.hit_face, hit_contour, side, consistent
        )
        self.contour_count = int(count)
        self.hit_contour = hit_contour
        self.hit_side = 1.0 - 2.0 * side
        self.contour_consistent = consistent[:count]
        self.contour = hit_contour[self.first_hit] if len(self.first_hit) else np.zeros(0, np.int64)
        # the end of a one-hit segment is the vertex that both faces share
        self.loop_vertex: NDArray[np.int64] = np.full(len(starts), -1, np.int64)
        single = np.flatnonzero(~two)
        if len(single):
            a, b = s.faces[self._pair_faces[single, 0]], s.faces[self._pair_faces[single, 1]]
            shared = (a[:, :, None] == b[:, None, :]).any(axis=2)
            one = shared.sum(axis=1) == 1
            self.loop_vertex[single[one]] = a[one][shared[one]]
        second = np.where(two, self.second_hit, self.first_hit)
        finish = self.points[second] if found else np.zeros((0, 3))
        loops = self.loop_vertex >= 0
        finish[loops] = self.vertices[self.loop_vertex[loops]]
        start = self.points[self.first_hit] if found else np.zeros((0, 3))
        self.segments = np.stack([start, finish], axis=1)
        self.segment_lengths = np.linalg.norm(finish - start, axis=1)

    @property
    def pairs(self) -> IntArray:
        """(S, 2) intersecting face pairs, a < b, sorted; ids of the faces as given."""
        return self.surface.face_ids[self._pair_faces]

    @property
    def edge_triangle(self) -> IntArray:
        """(H, 3) e0, e1, face id."""
        faces = self.surface.face_ids[self.hit_face][:, None]
        return np.concatenate([self.surface.edges[self.hit_edge], faces], axis=1)

    @property
    def length(self) -> float:
        """Total contour length [m], each segment once (half of the paper's, which counts both surfaces)."""
        return float(self.segment_lengths.sum())

    def __len__(self) -> int:
        return self.hit_count

    @cached_property
    def frames(self) -> FloatArray:
        """(H, 8) S, N, kappa regularised, kappa: what all corrections are made of [Volino 2006, 2.1]."""
        frames = np.empty((self.hit_count, 8))
        s = self.surface.arrays
        contour_kernels.hit_frames(
            self.vertices, s.faces, s.edges, s.edge_face_start, s.edge_face_ids, self.hit_edge, self.hit_face, frames
        )
        return frames

    def gradient(self) -> FloatArray:
        """(V, 3) exact d length / d vertices: sums to zero, has no moment, and x . g = length."""
        gradient = np.zeros_like(self.vertices)
        s = self.surface.arrays
        contour_kernels.add_hit_gradient(
            s.faces, s.edges, self.hit_edge, self.hit_face, self.parameters, self.weights, self.frames, gradient
        )
        loops = np.flatnonzero(self.loop_vertex >= 0)
        contour_kernels.add_loop_gradient(
            self.vertices, self.points, self.first_hit[loops], self.loop_vertex[loops], gradient
        )
        return gradient

    @cached_property
    def contour_lengths(self) -> FloatArray:
        """(C,) length of each contour [m]."""
        return np.bincount(self.contour, self.segment_lengths, minlength=self.contour_count).astype(np.float64)

    @cached_property
    def contours(self) -> list[Contour]:
        """Every contour with its kind, in order of its smallest hit."""
        s = self.surface
        degree = s.edge_face_count[self.hit_edge]
        components = s.components
        hit_counts = np.bincount(self.hit_contour, minlength=self.contour_count)
        on_edge = components[s.edges[self.hit_edge, 0]] if self.hit_count else np.zeros(0, np.int64)
        on_face = components[s.faces[self.hit_face, 0]] if self.hit_count else np.zeros(0, np.int64)
        loops = np.bincount(self.contour[self.loop_vertex >= 0], minlength=self.contour_count)
        open_pair = (self.hits_per_pair == 1) & (self.loop_vertex < 0)
        holes = np.bincount(self.contour[open_pair], minlength=self.contour_count)
        order = np.argsort(self.hit_contour, kind="stable")
        bounds = np.cumsum(np.r_[0, hit_counts])
        result = []
        for c in range(self.contour_count):
            hits = order[bounds[c] : bounds[c + 1]]
            borders = hits[degree[hits] == 1]
            joined = tuple(int(i) for i in np.unique(np.r_[on_edge[hits], on_face[hits]]))
            closed = bool(len(borders) == 0 and loops[c] == 0 and holes[c] == 0)
            if (degree[hits] > 2).any():
                kind = "branched"
            elif closed:
                kind = "Closed"
            elif loops[c] == 2 and len(borders) == 0:
                kind = "LL"
            elif loops[c] == 1 and len(borders) == 1:
                kind = "BLI"
            elif loops[c] == 0 and len(borders) == 2 and self.contour_consistent[c]:
                kind = "BBII" if self.hit_side[borders[0]] == self.hit_side[borders[1]] else "BIBI"
            else:
                kind = "Open"
            result.append(
                Contour(
                    length=float(self.contour_lengths[c]),
                    hit_count=int(hit_counts[c]),
                    closed=closed,
                    kind=kind,
                    self_contour=len(joined) == 1,
                    consistent=bool(self.contour_consistent[c]),
                    components=joined,
                )
            )
        return result


@dataclass(frozen=True)
class Proximities:
    """Pairs of primitives closer than a distance.

    Attributes:
        vertex_triangle: (P, 2) vertex id, face id; sorted.
        vertex_triangle_distance: (P,) [m].
        edge_edge: (Q, 4) a0 < a1, b0 < b1; sorted.
        edge_edge_distance: (Q,) [m].
        skipped_faces: faces with a repeated vertex id, left out.
    """

    vertex_triangle: IntArray
    vertex_triangle_distance: FloatArray
    edge_edge: IntArray
    edge_edge_distance: FloatArray
    skipped_faces: int


def intersections(vertices: Any, faces: Any = None) -> Intersections:
    """Every intersection of a triangle soup with itself, decided exactly, ties broken by vertex index.

    Args:
        vertices: (V, 3) [m], or a mesh with `.vertices` and `.faces` (trimesh) as the only argument.
        faces: (F, 3) vertex ids, or a `Surface` that is reused while the vertices move.

    Raises:
        ValueError: names the offending index.
    """
    x, surface = as_surface(vertices, faces)
    tree = _tree(surface, x)
    tree.refit(x, x, 0.0)
    return Intersections(x, surface, tree.self_pairs())


def proximities(vertices: Any, faces: Any = None, distance: float | None = None) -> Proximities:
    """Every vertex-triangle and edge-edge pair closer than `distance` [m].

    A triangle that contains the vertex, and edges that share a vertex, are no pair. `proximities(mesh, distance=d)` takes
    a trimesh alone.

    Raises:
        ValueError: names the offending index, or a distance that is not positive and finite.
    """
    if distance is None and isinstance(faces, float | int):
        faces, distance = None, faces
    distance = check_number(distance, "distance", 0.0, 1e12)
    x, surface = as_surface(vertices, faces)
    tree = _tree(surface, x)
    # half the distance on both boxes, and a hair more: the interval sums are rounded
    scale = float(np.abs(x).max()) if len(x) else 0.0
    tree.refit(x, x, 0.5 * distance + 1e-14 * scale)
    pairs = tree.self_pairs()
    capacity = max(256, 4 * len(surface.faces))
    while True:
        quads, kinds = np.empty((capacity, 4), np.int32), np.empty(capacity, np.uint8)
        distances = np.empty(capacity)
        found = proximity.find_proximities(x, surface.arrays, distance, pairs, quads, kinds, distances)
        if found <= capacity:
            break
        capacity = found
    quads, kinds, distances = quads[:found], kinds[:found], distances[:found]
    points, edges = kinds == 0, kinds == 1
    vt = quads[points][:, :2]
    vt[:, 1] = surface.face_ids[vt[:, 1]]
    vt_order = np.lexsort((vt[:, 1], vt[:, 0]))
    ee = quads[edges]
    ee_order = np.lexsort((ee[:, 3], ee[:, 2], ee[:, 1], ee[:, 0]))
    return Proximities(
        vt[vt_order], distances[points][vt_order], ee[ee_order], distances[edges][ee_order], surface.skipped_faces
    )


def _tree(surface: Surface, vertices: FloatArray) -> Hierarchy:
    """The surface's own tree, made at first use: its topology is reused while the vertices move."""
    tree = getattr(surface, "_tree", None)
    if tree is None or tree._intervals.shape[0] != len(vertices):
        tree = Hierarchy(surface, vertices)
        surface._tree = tree  # type: ignore[attr-defined]
    return tree
