"""Exact intersections of surfaces: hits, pairs, segments, contours, length and its gradient; and proximities."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import BoolArray, FloatArray, IntArray, check_number
from clothgym.detection.contours import Contour, described, grouped
from clothgym.detection.hierarchy import Hierarchy
from clothgym.kernels import contour as contour_kernels
from clothgym.kernels import proximity
from clothgym.mesh import Surface, as_surface

_K, _ARITY = 6, 16
"""Of a surface's own tree: measured the fastest for single queries."""

_WORN = 1.5
"""A surface's own tree is made anew when it takes this many times the tests that it took when new, pair for pair."""

_LARGEST = 1 << 63
"""Numbers from here on have no place in 64 bits with a sign."""

_PLACED = {"parameters", "weights", "points"}
"""Attributes of `Intersections` that are made together at first use."""

_FOUND = ("vertices", "surface", "skipped_faces", "edge_triangle_tests", "exact_tests", "_scaled", "_power")
"""What does not depend on which hits are kept."""

_JOINED = {
    *("first_hit", "second_hit", "pair_faces", "hits_per_pair", "loop_vertex"),
    *("contour", "contour_count", "contour_consistent", "hit_contour", "hit_side"),
}
"""The same, from the hits."""

_DRAWN = {"segments", "segment_lengths"}
"""The same, from both."""


class Intersections:
    """All intersections of a surface with itself (several meshes may be one surface).

    Args:
        vertices: (V, 3) [m], not copied.
        surface: topology.
        edge_face: (C, 2) pairs of an edge and a face without a common vertex that may intersect (`Hierarchy.search`);
            reordered.

    Attributes:
        edge_triangle: (H, 3) e0, e1 (e0 < e1), face id; sorted.
        parameters: (H,) t of the point P = (1 - t) e0 + t e1.
        weights: (H, 3) barycentric weights of P in the face.
        points: (H, 3) P [m].
        pairs: (S, 2) intersecting face pairs a < b, sorted.
        segments: (S, 2, 3) [m]; a pair with one shared vertex has its segment from the hit to that (loop) vertex.
        contour: (S,) contour of each segment; hit_contour: (H,) of each hit; hit_side: (H,) +1 or -1.
        skipped_faces: faces with a repeated vertex id, left out.
        edge_triangle_tests: pairs of an edge and a face that did not pass each other by a safe margin.
        exact_tests: those of them that a safe margin did not decide.
    """

    def __init__(self, vertices: FloatArray, surface: Surface, edge_face: IntArray) -> None:
        self.vertices = vertices
        self.surface = surface
        self.skipped_faces = surface.skipped_faces
        s = surface.arrays
        # predicates multiply three coordinates: scaled by a power of two, their roundings stay far from over- and underflow
        largest = float(np.abs(vertices).max()) if len(vertices) else 0.0
        power = 0 if largest == 0.0 else 300 - int(np.frexp(largest)[1])
        scaled = np.ldexp(vertices, power)
        keys = np.empty(len(edge_face), np.int64)
        found, left, exact = contour_kernels.find_hits(scaled, s.faces, s.edges, edge_face, keys)
        self.edge_triangle_tests, self.exact_tests = int(left), int(exact)
        keys = np.sort(keys[:found])
        face_count = max(len(s.faces), 1)
        self.hit_edge: IntArray = (keys // face_count).astype(np.int32)
        self.hit_face: IntArray = (keys % face_count).astype(np.int32)
        self.hit_count = int(found)
        self._scaled, self._power = scaled, power

    def keeping(self, kept: BoolArray) -> Intersections:
        """The same intersections as a detector would report that saw only the hits with kept (H,) true."""
        seen = object.__new__(Intersections)
        seen.__dict__.update({name: self.__dict__[name] for name in _FOUND})
        for name in ("hit_edge", "hit_face", *sorted(_PLACED)):
            setattr(seen, name, np.ascontiguousarray(getattr(self, name)[kept]))
        seen.hit_count = int(kept.sum())
        return seen

    def __getattr__(self, name: str) -> Any:
        """Places, segments and contours are made when first asked for: who wants to know what hits need not wait for them."""
        if name in _PLACED:
            self._place()
        elif name in _JOINED:
            self._join()
        elif name in _DRAWN:
            self._draw()
        else:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return self.__dict__[name]

    def _place(self) -> None:
        """Where the hits lie."""
        s, found = self.surface.arrays, self.hit_count
        self.parameters = np.empty(found)
        self.weights = np.empty((found, 3))
        self.points = np.empty((found, 3))
        contour_kernels.place_hits(
            self._scaled, s.faces, s.edges, self.hit_edge, self.hit_face, self.parameters, self.weights, self.points
        )
        self.points = np.ldexp(self.points, -self._power)

    def _join(self) -> None:
        """Pairs of faces and contours from the hits."""
        s, found = self.surface.arrays, self.hit_count
        ends = int(contour_kernels.end_count(self.hit_edge, s.edge_face_start))
        face_count = max(len(s.faces), 1)
        keys, owners = np.empty(ends, np.int64), np.empty(ends, np.int64)
        contour_kernels.segment_ends(
            self.hit_edge, self.hit_face, s.edge_face_start, s.edge_face_ids, face_count, keys, owners
        )
        keys, owners = _by_pair(keys, owners, face_count**2, found)
        first, second, loop = (np.empty(ends, np.int64) for _ in range(3))
        pair_faces, per_pair = np.empty((ends, 2), np.int32), np.empty(ends, np.int64)
        pairs = contour_kernels.match_hits(keys, owners, s.faces, first, second, pair_faces, per_pair, loop)
        self.first_hit: NDArray[np.int64] = first[:pairs]
        self.second_hit: NDArray[np.int64] = second[:pairs]
        self.loop_vertex: NDArray[np.int64] = loop[:pairs]
        self.pair_faces, self.hits_per_pair = pair_faces[:pairs], per_pair[:pairs]
        hit_contour, side = np.empty(found, np.int64), np.empty(found, np.int64)
        consistent = np.ones(found, np.bool_)
        count = contour_kernels.join_contours(
            self.first_hit, self.second_hit, self.hit_face, hit_contour, side, consistent
        )
        self.contour_count = int(count)
        self.hit_contour = hit_contour
        self.hit_side = 1.0 - 2.0 * side
        self.contour_consistent = consistent[:count]
        self.contour = hit_contour[self.first_hit]

    def _draw(self) -> None:
        """Where the segments lie."""
        count = len(self.first_hit)
        self.segments = np.empty((count, 2, 3))
        self.segment_lengths = np.empty(count)
        contour_kernels.draw_segments(
            self.vertices,
            self.points,
            self.first_hit,
            self.second_hit,
            self.loop_vertex,
            self.segments,
            self.segment_lengths,
        )

    @property
    def pairs(self) -> IntArray:
        """(S, 2) intersecting face pairs, a < b, sorted; ids of the faces as given."""
        return self.surface.face_ids[self.pair_faces]

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
    def by_contour(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Hits in the order of their contours (H,), and where each contour's begin and end in it (C + 1,)."""
        return grouped(self.hit_contour, self.contour_count)

    @cached_property
    def contours(self) -> list[Contour]:
        """Every contour with its kind, in order of its smallest hit."""
        return described(self)


def _by_pair(
    keys: NDArray[np.int64], owners: NDArray[np.int64], pairs: int, hits: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys below `pairs`, sorted, and their owners, ids below `hits`; those of a key are in ascending order as before."""
    bits = hits.bit_length()
    if pairs << bits > _LARGEST:
        order = np.argsort(keys, kind="stable")
        return keys[order], owners[order]
    packed = np.sort((keys << bits) | owners)  # as one number, which is sorted in half the time
    return packed >> bits, packed & ((1 << bits) - 1)


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
    tree = _search(surface, x, 0.0, near=False, hits=True)
    return _hits(x, surface, tree)


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
    tree = _search(surface, x, 0.5 * distance, near=True, hits=False)
    return _near(x, surface, tree, distance)


def collisions(vertices: Any, faces: Any, distance: float) -> tuple[Proximities, Intersections]:
    """`proximities` and `intersections` from one search, which is cheaper than both after each other.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3) vertex ids, or a `Surface` that is reused while the vertices move.
        distance: of proximities [m].

    Raises:
        ValueError: names the offending index, or a distance that is not positive and finite.
    """
    distance = check_number(distance, "distance", 0.0, 1e12)
    x, surface = as_surface(vertices, faces)
    tree = _search(surface, x, 0.5 * distance, near=True, hits=True)
    return _near(x, surface, tree, distance), _hits(x, surface, tree)


def _hits(x: FloatArray, surface: Surface, tree: Hierarchy) -> Intersections:
    """What a search for hits has found."""
    return Intersections(x.copy(), surface, tree.edge_face[: tree.counts[2]])


def _near(x: FloatArray, surface: Surface, tree: Hierarchy, distance: float) -> Proximities:
    """What a search for near pairs has found."""
    point_gaps, line_gaps = np.empty(tree.counts[0]), np.empty(tree.counts[1])
    faces, edges = surface.faces, surface.edges
    proximity.keep_near(x, faces, edges, distance, tree.vertex_face, tree.edge_edge, tree.counts, point_gaps, line_gaps)
    points, lines = int(tree.counts[0]), int(tree.counts[1])
    vt, vt_gaps = np.empty((points, 2), np.int32), np.empty(points)
    ee, ee_gaps = np.empty((lines, 4), np.int32), np.empty(lines)
    face_names = surface.face_ids.reshape(-1, 1)
    proximity.arrange(tree.vertex_face, point_gaps, np.empty(len(x) + 2, np.int32), face_names, vt, vt_gaps)
    proximity.arrange(tree.edge_edge, line_gaps, np.empty(len(edges) + 2, np.int32), edges, ee, ee_gaps)
    return Proximities(vt, vt_gaps, ee, ee_gaps, surface.skipped_faces)


def _search(surface: Surface, vertices: FloatArray, radius: float, near: bool, hits: bool) -> Hierarchy:
    """The surface's own tree with the pairs of these boxes: near ones, those that may hit, or both.

    Made at first use and kept while the vertices move, until it takes much more tests than when it was new.
    """
    tree, fresh = getattr(surface, "_tree", (None, None))
    if tree is None or fresh is None or len(tree._ways) != len(vertices):
        tree, fresh = Hierarchy(surface, vertices, _K, _ARITY, by_component=False), {}
        surface._tree = (tree, fresh)  # type: ignore[attr-defined]
    tree.refit(vertices, vertices, radius)
    tree.search(near, hits)
    counts = tree.counts.tolist()
    found = (counts[0] + counts[1] if near else 0) + (counts[2] if hits else 0)
    effort = counts[3] / (len(surface.faces) + found + 1)
    if effort > _WORN * fresh.setdefault((near, hits), effort):
        del surface._tree  # type: ignore[attr-defined]
    return tree
