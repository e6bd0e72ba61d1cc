"""Slow, obvious reference versions, written from the definitions and from nothing else.

Intersections are decided in exact integer arithmetic (every double is an integer times a power of two) under the
symbolic perturbation of the library: coordinate c of the vertex with index i is x[i, c] + eps^(2^(3 i + c)), eps -> 0+.
Lengths come from rational hit points; gradients from complex steps, central differences, and the per-hit formula;
distances from the smallest of all feasible candidates. Nothing here imports the library.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from itertools import permutations
from typing import NamedTuple

import networkx as nx
import numpy as np

# ---------------------------------------------------------------------------------------------------------------
# exact orientation


def exact_coordinates(vertices) -> list[tuple[int, int, int]]:
    """The vertices times one common power of two, as Python integers: no rounding, and no sign changes."""
    rows = [[float(value).as_integer_ratio() for value in row] for row in np.asarray(vertices, dtype=np.float64)]
    scale = max((denominator for row in rows for _, denominator in row), default=1)
    return [tuple(numerator * (scale // denominator) for numerator, denominator in row) for row in rows]


def determinant(a, b, c, d):
    """det of the rows (x, y, z, 1) of a, b, c, d, in the arithmetic of its arguments."""
    ux, uy, uz = a[0] - d[0], a[1] - d[1], a[2] - d[2]
    vx, vy, vz = b[0] - d[0], b[1] - d[1], b[2] - d[2]
    wx, wy, wz = c[0] - d[0], c[1] - d[1], c[2] - d[2]
    return ux * (vy * wz - vz * wy) - uy * (vx * wz - vz * wx) + uz * (vx * wy - vy * wx)


def parity(order) -> int:
    return -1 if sum(order[i] > order[j] for i in range(4) for j in range(i + 1, 4)) % 2 else 1


_SIGNED_PERMUTATIONS = [(parity(order), order) for order in permutations(range(4))]


def perturbed_polynomial(coordinates, ids) -> dict[int, int]:
    """The perturbed 4x4 determinant as a polynomial in eps: exponent -> coefficient, all 24 terms multiplied out.

    A factor of a row i and a column c < 3 is x[i, c] + eps^(2^(3 i + c)); the last column is 1. The exponents of two
    different factors are different powers of two, so their sum is their bitwise or.
    """
    total: dict[int, int] = {}
    for sign, columns in _SIGNED_PERMUTATIONS:
        product = {0: sign}
        for vertex, column in zip(ids, columns):
            if column == 3:
                continue
            value, power = coordinates[vertex][column], 1 << (3 * int(vertex) + column)
            expanded: dict[int, int] = {}
            for exponent, coefficient in product.items():
                expanded[exponent] = expanded.get(exponent, 0) + coefficient * value
                expanded[exponent | power] = expanded.get(exponent | power, 0) + coefficient
            product = expanded
        for exponent, coefficient in product.items():
            total[exponent] = total.get(exponent, 0) + coefficient
    return total


def perturbed_sign(coordinates, ids) -> int:
    """+1 or -1, never 0: the sign of the nonzero term of lowest order in eps."""
    value = determinant(*(coordinates[i] for i in ids))
    if value == 0:
        polynomial = perturbed_polynomial(coordinates, ids)
        value = polynomial[min(exponent for exponent, coefficient in polynomial.items() if coefficient != 0)]
    return 1 if value > 0 else -1


# ---------------------------------------------------------------------------------------------------------------
# hits, pairs, contours


class Exact(NamedTuple):
    """What a mesh's intersections are, exactly.

    hits: list of (e0, e1, face) with e0 < e1, sorted. parameters: per hit the exact t of P = e0 + t (e1 - e0) as a
    Fraction, None where the edge lies in the triangle's plane. pairs: {(a, b): its hits}, a < b. incident: {(e0, e1):
    faces}. zeros: quadruples of vertices with a determinant of exactly zero, decided by the perturbation.
    """

    vertices: np.ndarray
    faces: np.ndarray
    hits: list[tuple[int, int, int]]
    parameters: list[Fraction | None]
    pairs: dict[tuple[int, int], list[int]]
    incident: dict[tuple[int, int], list[int]]
    skipped_faces: int
    zeros: int


def incident_faces(faces) -> dict[tuple[int, int], list[int]]:
    """Every undirected edge of the faces with three different ids, and the faces at it."""
    incident: dict[tuple[int, int], list[int]] = {}
    for face, corners in enumerate(np.asarray(faces).tolist()):
        if len(set(corners)) == 3:
            for k in range(3):
                a, b = corners[k], corners[(k + 1) % 3]
                incident.setdefault((min(a, b), max(a, b)), []).append(face)
    return incident


def box_candidates(vertices, faces, edges) -> list[tuple[int, int]]:
    """(edge row, face) whose closed boxes touch, in order; the perturbation is too small to join separate boxes."""
    face_low, face_high = vertices[faces].min(axis=1), vertices[faces].max(axis=1)
    found = []
    for row, edge in enumerate(edges):
        low, high = vertices[list(edge)].min(axis=0), vertices[list(edge)].max(axis=0)
        touching = ((low <= face_high) & (face_low <= high)).all(axis=1)
        found += [(row, int(face)) for face in np.flatnonzero(touching)]
    return found


def exact_intersections(vertices, faces) -> Exact:
    """All hits and pairs of a mesh, by testing every edge against every face whose box it touches."""
    vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces)
    coordinates = exact_coordinates(vertices)
    incident = incident_faces(faces)
    edges = sorted(incident)
    zeros: set[tuple[int, ...]] = set()

    @cache
    def sign(*ids: int) -> int:
        if determinant(*(coordinates[i] for i in ids)) == 0:
            zeros.add(tuple(sorted(ids)))
        return perturbed_sign(coordinates, ids)

    hits, parameters = [], []
    for row, face in box_candidates(vertices, faces, edges) if len(faces) else []:
        (e0, e1), (a0, a1, a2) = edges[row], faces[face].tolist()
        if len({a0, a1, a2}) < 3 or {e0, e1} & {a0, a1, a2}:
            continue
        if sign(a0, a1, a2, e0) == sign(a0, a1, a2, e1):
            continue
        side = sign(e0, e1, a0, a1)
        if sign(e0, e1, a1, a2) != side or sign(e0, e1, a2, a0) != side:
            continue
        triangle = (coordinates[a0], coordinates[a1], coordinates[a2])
        above, below = determinant(*triangle, coordinates[e0]), determinant(*triangle, coordinates[e1])
        hits.append((e0, e1, face))
        parameters.append(None if above == below else Fraction(above, above - below))
    order = sorted(range(len(hits)), key=hits.__getitem__)
    hits, parameters = [hits[i] for i in order], [parameters[i] for i in order]

    pairs: dict[tuple[int, int], list[int]] = {}
    for hit, (e0, e1, a) in enumerate(hits):
        for b in incident[e0, e1]:
            pairs.setdefault((min(a, b), max(a, b)), []).append(hit)
    skipped = sum(len(set(corners)) < 3 for corners in faces.tolist())
    return Exact(vertices, faces, hits, parameters, dict(sorted(pairs.items())), incident, skipped, len(zeros))


def exact_hits(vertices, faces) -> list[tuple[int, int, int]]:
    """The hits only."""
    return exact_intersections(vertices, faces).hits


def shared_vertices(exact: Exact, pair) -> set[int]:
    """Vertex ids that both faces of a pair have."""
    return set(exact.faces[pair[0]].tolist()) & set(exact.faces[pair[1]].tolist())


def loop_vertices(exact: Exact) -> list[int]:
    """The shared vertex of every pair that has one: where its segment ends without a hit."""
    return [v for pair in exact.pairs for v in shared_vertices(exact, pair)]


def broken_pairs(exact: Exact) -> list[tuple[tuple[int, int], int, int]]:
    """(pair, shared vertices, hits) of all pairs that break "0 shared: 2 hits, 1 shared: 1 hit, else none"."""
    counts = [(pair, len(shared_vertices(exact, pair)), len(hits)) for pair, hits in exact.pairs.items()]
    return [row for row in counts if row[1:] not in ((0, 2), (1, 1))]


def exact_contours(exact: Exact) -> list[int]:
    """Contour of every hit: parts of the graph that joins the two hits of each pair, in order of their first hit."""
    graph = nx.Graph()
    graph.add_nodes_from(range(len(exact.hits)))
    graph.add_edges_from(hits for hits in exact.pairs.values() if len(hits) == 2)
    label = [0] * len(exact.hits)
    for number, part in enumerate(sorted(nx.connected_components(graph), key=min)):
        for hit in part:
            label[hit] = number
    return label


def contour_is_closed(exact: Exact) -> list[bool]:
    """Per contour: no hit of a border edge, no loop vertex, and both hits of every pair."""
    label = exact_contours(exact)
    closed = [True] * (max(label, default=-1) + 1)
    for hit, (e0, e1, _) in enumerate(exact.hits):
        if len(exact.incident[e0, e1]) == 1:
            closed[label[hit]] = False
    for hits in exact.pairs.values():
        if len(hits) == 1:
            closed[label[hits[0]]] = False
    return closed


# ---------------------------------------------------------------------------------------------------------------
# points and lengths


def exact_point(exact: Exact, hit: int) -> tuple[Fraction, Fraction, Fraction] | None:
    """The rational hit point, None where the edge lies in the triangle's plane."""
    t = exact.parameters[hit]
    if t is None:
        return None
    e0, e1, _ = exact.hits[hit]
    start, end = ([Fraction(float(value)) for value in exact.vertices[i]] for i in (e0, e1))
    return tuple(p + t * (q - p) for p, q in zip(start, end))


def exact_points(exact: Exact) -> np.ndarray:
    """(H, 3) hit points, each coordinate the double nearest to the rational one; NaN where there is none."""
    points = np.full((len(exact.hits), 3), np.nan)
    for hit in range(len(exact.hits)):
        point = exact_point(exact, hit)
        if point is not None:
            points[hit] = [float(value) for value in point]
    return points


def point_tolerances(exact: Exact) -> np.ndarray:
    """(H,) how far a correct double-precision hit point may lie from the exact one; inf where t is undecided.

    t = above / (above - below): the rounding of a determinant of differences up to d is a few u d^3, so that of the
    point is |e1 - e0| times this over |above - below|.
    """
    tolerance = np.full(len(exact.hits), np.inf)
    for hit, (e0, e1, face) in enumerate(exact.hits):
        if exact.parameters[hit] is None:
            continue
        corners = [[Fraction(float(value)) for value in exact.vertices[i]] for i in (*exact.faces[face], e0, e1)]
        above, below = determinant(*corners[:3], corners[3]), determinant(*corners[:3], corners[4])
        block = exact.vertices[[*exact.faces[face], e0, e1]]
        extent = float((block.max(axis=0) - block.min(axis=0)).max())
        edge = float(np.linalg.norm(exact.vertices[e1] - exact.vertices[e0]))
        amplification = edge * extent**3 / float(abs(above - below))
        tolerance[hit] = 64 * 2.0**-53 * amplification + 8 * 2.0**-53 * float(np.abs(block).max())
    return tolerance


def exact_segment_lengths(exact: Exact) -> np.ndarray:
    """(S,) length of each pair's segment, rounded once; NaN where an end point is undecided."""
    lengths = np.full(len(exact.pairs), np.nan)
    for row, (pair, hits) in enumerate(exact.pairs.items()):
        ends = [exact_point(exact, hit) for hit in hits]
        if len(ends) == 1:
            (v,) = shared_vertices(exact, pair)
            ends.append(tuple(Fraction(float(value)) for value in exact.vertices[v]))
        if None not in ends:
            lengths[row] = math.sqrt(sum((p - q) ** 2 for p, q in zip(*ends)))
    return lengths


def exact_length(vertices, faces) -> float:
    """Total contour length, each segment once, from rational points."""
    return math.fsum(exact_segment_lengths(exact_intersections(vertices, faces)))


# ---------------------------------------------------------------------------------------------------------------
# the gradient of the length


def length_of_hits(exact: Exact, vertices):
    """Length as an analytic function of the vertices with the hits held fixed; complex vertices are welcome."""
    hits = np.array(exact.hits, dtype=int).reshape(-1, 3)
    e0, e1 = vertices[hits[:, 0]], vertices[hits[:, 1]]
    a0, a1, a2 = (vertices[exact.faces[hits[:, 2], k]] for k in range(3))
    normal = np.cross(a1 - a0, a2 - a0)
    above, below = ((e0 - a0) * normal).sum(axis=1), ((e1 - a0) * normal).sum(axis=1)
    points = e0 + (above / (above - below))[:, None] * (e1 - e0)
    total = 0.0
    for pair, ends in exact.pairs.items():
        first = points[ends[0]]
        second = points[ends[1]] if len(ends) == 2 else vertices[min(shared_vertices(exact, pair))]
        total = total + np.sqrt(((first - second) ** 2).sum())
    return total


def complex_step_gradient(vertices, faces) -> np.ndarray:
    """(V, 3) derivative of the length to machine precision: Im L(x + i h) / h with h so small that h^2 vanishes."""
    exact = exact_intersections(vertices, faces)
    gradient = np.zeros_like(exact.vertices)
    step = 1e-40
    involved = {v for e0, e1, face in exact.hits for v in (e0, e1, *exact.faces[face].tolist())}
    for vertex in sorted(involved | set(loop_vertices(exact))):
        for axis in range(3):
            moved = exact.vertices.astype(complex)
            moved[vertex, axis] += 1j * step
            gradient[vertex, axis] = length_of_hits(exact, moved).imag / step
    return gradient


def central_differences(length_and_hits: Callable, vertices, step: float, entries) -> dict[tuple[int, int], float]:
    """Central differences of the length for the (vertex, axis) entries around which the hits stay the same.

    `length_and_hits(vertices)` returns the length and anything comparable that stands for the set of hits.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    _, here = length_and_hits(vertices)
    found = {}
    for vertex, axis in entries:
        ends = []
        for direction in (1.0, -1.0):
            moved = vertices.copy()
            moved[vertex, axis] += direction * step
            ends.append((moved[vertex, axis], *length_and_hits(moved)))
        if ends[0][2] == here == ends[1][2]:
            found[vertex, axis] = (ends[0][1] - ends[1][1]) / (ends[0][0] - ends[1][0])
    return found


class HitFrame(NamedTuple):
    """Quantities of one hit, in the letters of [Volino 2006]; G = S - 2 kappa N is its equation (4)."""

    edge: tuple[int, int]
    face: int
    t: float
    weights: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    s: np.ndarray
    kappa: float

    @property
    def gradient_vector(self) -> np.ndarray:
        return self.s - 2 * self.kappa * self.normal


def hit_frames(exact: Exact) -> list[HitFrame]:
    """The frame of every hit, one by one."""
    frames = []
    for e0, e1, face in exact.hits:
        corners = exact.vertices[exact.faces[face]]
        direction = exact.vertices[e1] - exact.vertices[e0]
        edge = direction / np.linalg.norm(direction)
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        t = float((corners[0] - exact.vertices[e0]) @ normal / (direction @ normal))
        point = exact.vertices[e0] + t * direction
        weights = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), np.append(point, 1.0), rcond=None)[0]
        s = np.zeros(3)
        for other in exact.incident[e0, e1]:
            (third,) = set(exact.faces[other].tolist()) - {e0, e1}
            inward = exact.vertices[third] - exact.vertices[e0]
            inward = inward - (inward @ edge) * edge
            along = np.cross(normal, np.cross(edge, inward))
            along /= np.linalg.norm(along)
            s += along if along @ inward > 0 else -along
        kappa = float((edge @ s) / (edge @ normal))
        frames.append(HitFrame((e0, e1), face, t, weights, point, normal, s, kappa))
    return frames


def formula_gradient(vertices, faces) -> np.ndarray:
    """(V, 3) gradient by the per-hit formula, plain loops, with the loop-vertex terms."""
    exact = exact_intersections(vertices, faces)
    frames = hit_frames(exact)
    gradient = np.zeros_like(exact.vertices)
    for frame in frames:
        along_normal = frame.kappa * frame.normal
        gradient[frame.edge[0]] -= (1 - frame.t) * (frame.s - along_normal)
        gradient[frame.edge[1]] -= frame.t * (frame.s - along_normal)
        for vertex, weight in zip(exact.faces[frame.face], frame.weights):
            gradient[vertex] -= weight * along_normal
    for pair, hits in exact.pairs.items():
        for v in shared_vertices(exact, pair):
            away = frames[hits[0]].point - exact.vertices[v]
            gradient[v] -= away / np.linalg.norm(away)
    return gradient


# ---------------------------------------------------------------------------------------------------------------
# distances


def _dot(a, b):
    return (a * b).sum(axis=-1)


def point_segment_distance(p, a, b):
    """Distances of points to segments, row by row; a segment without length is its point."""
    along = b - a
    square = _dot(along, along)
    t = np.clip(_dot(p - a, along) / np.where(square > 0, square, 1.0), 0.0, 1.0)
    return np.linalg.norm(p - (a + t[..., None] * along), axis=-1)


def point_triangle_distance(p, a, b, c):
    """Distances of points to triangles, row by row: the smallest of three sides and, where it counts, the plane."""
    best = point_segment_distance(p, a, b)
    best = np.minimum(best, point_segment_distance(p, b, c))
    best = np.minimum(best, point_segment_distance(p, c, a))
    normal = np.cross(b - a, c - a)
    square = _dot(normal, normal)
    inside = square > 0
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= _dot(np.cross(end - start, p - start), normal) >= 0
    plane = np.abs(_dot(p - a, normal)) / np.sqrt(np.where(square > 0, square, 1.0))
    return np.where(inside, np.minimum(best, plane), best)


def segment_segment_distance(p0, p1, q0, q1):
    """Distances of segments, row by row: the smallest of four end points and of the lines' own closest points.

    The latter are clipped into both segments and then refined by turns, so every candidate is a true distance.
    """
    best = point_segment_distance(p0, q0, q1)
    for point, start, end in ((p1, q0, q1), (q0, p0, p1), (q1, p0, p1)):
        best = np.minimum(best, point_segment_distance(point, start, end))
    u, v, r = p1 - p0, q1 - q0, p0 - q0
    cross = np.cross(u, v)
    square = _dot(cross, cross)
    safe = np.where(square > 0, square, 1.0)
    s = np.clip(_dot(np.cross(v, r), cross) / safe, 0.0, 1.0)
    t = np.clip(_dot(np.cross(u, r), cross) / safe, 0.0, 1.0)
    uu, vv = (np.where(w > 0, w, 1.0) for w in (_dot(u, u), _dot(v, v)))
    for _ in range(4):
        best = np.minimum(best, np.linalg.norm(r + s[..., None] * u - t[..., None] * v, axis=-1))
        t = np.clip(_dot(r + s[..., None] * u, v) / vv, 0.0, 1.0)
        s = np.clip(_dot(t[..., None] * v - r, u) / uu, 0.0, 1.0)
    return best


def _rational(rows) -> list[list[Fraction]]:
    return [[Fraction(float(value)) for value in row] for row in rows]


def _inner(a, b) -> Fraction:
    return sum((x * y for x, y in zip(a, b)), Fraction(0))


def _minus(a, b):
    return [x - y for x, y in zip(a, b)]


def _outer(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _rational_point_segment(p, a, b) -> Fraction:
    along, away = _minus(b, a), _minus(p, a)
    square = _inner(along, along)
    t = min(max(_inner(away, along) / square, Fraction(0)), Fraction(1)) if square else Fraction(0)
    rest = [x - t * y for x, y in zip(away, along)]
    return _inner(rest, rest)


def exact_point_triangle_distance(p, a, b, c) -> float:
    """Rational all the way to the square root."""
    p, a, b, c = _rational([p, a, b, c])
    best = min(_rational_point_segment(p, *side) for side in ((a, b), (b, c), (c, a)))
    normal = _outer(_minus(b, a), _minus(c, a))
    square = _inner(normal, normal)
    sides = ((a, b), (b, c), (c, a))
    if square and all(_inner(_outer(_minus(end, start), _minus(p, start)), normal) >= 0 for start, end in sides):
        best = min(best, _inner(_minus(p, a), normal) ** 2 / square)
    return math.sqrt(best)


def exact_segment_segment_distance(p0, p1, q0, q1) -> float:
    """Rational all the way to the square root."""
    p0, p1, q0, q1 = _rational([p0, p1, q0, q1])
    ends = ((p0, q0, q1), (p1, q0, q1), (q0, p0, p1), (q1, p0, p1))
    best = min(_rational_point_segment(*end) for end in ends)
    u, v, r = _minus(p1, p0), _minus(q1, q0), _minus(p0, q0)
    cross = _outer(u, v)
    square = _inner(cross, cross)
    if square:
        s, t = _inner(_outer(v, r), cross) / square, _inner(_outer(u, r), cross) / square
        if 0 <= s <= 1 and 0 <= t <= 1:
            best = min(best, _inner(r, cross) ** 2 / square)
    return math.sqrt(best)


class Near(NamedTuple):
    """Rows as the library's, sorted, with their distances."""

    vertex_triangle: np.ndarray
    vertex_triangle_distance: np.ndarray
    edge_edge: np.ndarray
    edge_edge_distance: np.ndarray


def proximities(vertices, faces, distance: float) -> Near:
    """Every vertex-triangle and edge-edge pair closer than the distance, by trying them all."""
    x, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces)
    whole = np.array([face for face, corners in enumerate(faces.tolist()) if len(set(corners)) == 3], dtype=int)
    triangles = faces[whole].reshape(-1, 3)
    rows, distances = [np.zeros((0, 2), dtype=int)], [np.zeros(0)]
    for vertex in np.unique(triangles):
        others = np.flatnonzero((triangles != vertex).all(axis=1))
        a, b, c = (x[triangles[others, k]] for k in range(3))
        gap = point_triangle_distance(np.broadcast_to(x[vertex], a.shape), a, b, c)
        close = gap < distance
        rows.append(np.stack([np.full(close.sum(), vertex), whole[others[close]]], axis=1))
        distances.append(gap[close])
    edge_rows, edge_distances = [np.zeros((0, 4), dtype=int)], [np.zeros(0)]
    edges = np.array(sorted(incident_faces(faces)), dtype=int).reshape(-1, 2)
    for row, (a0, a1) in enumerate(edges):
        later = edges[row + 1 :]
        later = later[(later != a0).all(axis=1) & (later != a1).all(axis=1)]
        shape = (len(later), 3)
        start, end = np.broadcast_to(x[a0], shape), np.broadcast_to(x[a1], shape)
        gap = segment_segment_distance(start, end, x[later[:, 0]], x[later[:, 1]])
        close = gap < distance
        edge_rows.append(np.column_stack([np.tile([a0, a1], (close.sum(), 1)), later[close]]))
        edge_distances.append(gap[close])
    return Near(*(np.concatenate(part) for part in (rows, distances, edge_rows, edge_distances)))
