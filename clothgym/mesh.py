"""Topology of triangle surfaces, regular grids, and what is read off a rest shape."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import FARTHEST, SQUARABLE, FloatArray, IntArray, as_faces, as_points, check_number


class SurfaceArrays(NamedTuple):
    """The topology that kernels read."""

    faces: IntArray  # (F, 3)
    edges: IntArray  # (E, 2), e0 < e1, sorted
    face_edges: IntArray  # (F, 3) edges (0,1), (1,2), (2,0) of each face
    vertex_owner: IntArray  # (V,) the face that reports for a vertex, -1 = no face has it
    edge_owner: IntArray  # (E,) the face that reports for an edge
    edge_face_start: IntArray  # (E + 1,)
    edge_face_ids: IntArray  # all faces at each edge


class Surface:
    """Topology of a triangle soup: unique edges, ownership and adjacency, built once and reused while vertices move.

    Faces that repeat a vertex id have no area on any shape and are left out (`skipped_faces`); ids in all results still
    refer to the faces as given. Any number of faces may share an edge.

    Args:
        faces: (F, 3) integer vertex ids.
        vertex_count: number of vertices; default: the largest id + 1.

    Raises:
        ValueError: wrong shape or an id out of range, by index.
    """

    def __init__(self, faces: ArrayLike, vertex_count: int | None = None) -> None:
        given = as_faces(faces, vertex_count)
        self.given_faces = given
        self.vertex_count = int(given.max()) + 1 if vertex_count is None and len(given) else int(vertex_count or 0)
        proper = (given[:, 0] != given[:, 1]) & (given[:, 1] != given[:, 2]) & (given[:, 2] != given[:, 0])
        self.face_ids = np.flatnonzero(proper).astype(np.int32)
        self.skipped_faces = int(len(given) - len(self.face_ids))
        self.faces: IntArray = np.ascontiguousarray(given[proper])
        count = len(self.faces)
        corners = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
        corners.sort(axis=1)
        keys = corners[:, 0] * max(self.vertex_count, 1) + corners[:, 1]
        unique, inverse = np.unique(keys, return_inverse=True)
        self.edges: IntArray = np.stack([unique // max(self.vertex_count, 1), unique % max(self.vertex_count, 1)], 1)
        self.edges = np.ascontiguousarray(self.edges, dtype=np.int32)
        self.face_edges: IntArray = np.ascontiguousarray(inverse.reshape(count, 3), dtype=np.int32)
        flat = self.face_edges.ravel()
        by_edge = np.argsort(flat, kind="stable")
        self.edge_face_ids = (by_edge // 3).astype(np.int32)
        counts = np.bincount(flat, minlength=len(self.edges))
        self.edge_face_start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        self.edge_owner = self.edge_face_ids[self.edge_face_start[:-1]] if count else np.zeros(0, np.int32)
        self.vertex_owner = np.full(self.vertex_count, -1, np.int32)
        if count:
            vertices = self.faces.ravel()
            self.vertex_owner[vertices[::-1]] = (np.arange(3 * count, dtype=np.int32) // 3)[::-1]
        self.arrays = SurfaceArrays(
            self.faces,
            self.edges,
            self.face_edges,
            self.vertex_owner,
            self.edge_owner,
            self.edge_face_start,
            self.edge_face_ids,
        )

    @property
    def edge_face_count(self) -> IntArray:
        """(E,) faces at each edge: 1 at a border, 2 inside, 3 and more at a seam."""
        return np.diff(self.edge_face_start)

    @cached_property
    def neighbourhood(self) -> tuple[IntArray, IntArray, IntArray]:
        """Vertex adjacency as CSR: start (V + 1,), neighbour ids, and the edge that leads to each."""
        ends = np.concatenate([self.edges[:, 0], self.edges[:, 1]])
        others = np.concatenate([self.edges[:, 1], self.edges[:, 0]])
        ids = np.tile(np.arange(len(self.edges), dtype=np.int32), 2)
        order = np.lexsort((others, ends))
        start = np.concatenate([[0], np.cumsum(np.bincount(ends, minlength=self.vertex_count))]).astype(np.int32)
        return start, np.ascontiguousarray(others[order], np.int32), np.ascontiguousarray(ids[order], np.int32)

    @cached_property
    def faces_around(self) -> tuple[IntArray, IntArray]:
        """Faces at each vertex as CSR: start (V + 1,) and face ids."""
        corners = self.faces.ravel()
        start = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=self.vertex_count))]).astype(np.int32)
        return start, (np.argsort(corners, kind="stable") // 3).astype(np.int32)

    @cached_property
    def components(self) -> IntArray:
        """(V,) connected component of each vertex, numbered by the smallest vertex id."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        ones = np.ones(len(self.edges), np.int8)
        graph = coo_array((ones, (self.edges[:, 0], self.edges[:, 1])), shape=(self.vertex_count,) * 2)
        return connected_components(graph, directed=False)[1].astype(np.int32)

    def check_vertices(self, vertices: ArrayLike) -> FloatArray:
        """Finite (V, 3) float64 vertices that cover every id.

        Raises:
            ValueError: wrong shape, too few rows, or an entry that is not finite or beyond 1e150, by index.
        """
        x = as_points(vertices, limit=SQUARABLE)
        if len(x) < self.vertex_count:
            bad = int(np.argmax((self.given_faces >= len(x)).any(axis=1)))
            column = int(np.argmax(self.given_faces[bad] >= len(x)))
            raise ValueError(
                f"faces[{bad}, {column}] is {int(self.given_faces[bad, column])}: no such vertex id of {len(x)} vertices"
            )
        return x


def as_surface(vertices: Any, faces: Any = None) -> tuple[FloatArray, Surface]:
    """Vertices and topology from (vertices, faces), (vertices, Surface) or a mesh with `.vertices` and `.faces` alone.

    Raises:
        ValueError: as `Surface` and `Surface.check_vertices`.
    """
    if faces is None:
        if not (hasattr(vertices, "vertices") and hasattr(vertices, "faces")):
            raise ValueError("faces: missing; give (vertices, faces), (vertices, Surface) or one trimesh.Trimesh")
        vertices, faces = np.asarray(vertices.vertices), np.asarray(vertices.faces)
    if isinstance(faces, Surface):
        return faces.check_vertices(vertices), faces
    x = as_points(vertices, limit=SQUARABLE)
    return x, Surface(faces, len(x))


@dataclass(frozen=True)
class Mesh:
    """A rest shape: vertices (V, 3) [m], faces (F, 3), and quads (Q, 4) where the mesh is a grid."""

    vertices: FloatArray
    faces: IntArray
    quads: IntArray | None = None

    def transformed(self, rotation: ArrayLike | None = None, translation: ArrayLike = (0.0, 0.0, 0.0)) -> Mesh:
        """A rigidly moved copy; rotation (3, 3) first."""
        turned = self.vertices if rotation is None else self.vertices @ np.asarray(rotation, float).T
        return Mesh(turned + np.asarray(translation, float), self.faces, self.quads)


def copied(given: Any, where: str) -> tuple[FloatArray, IntArray]:
    """Own copies of the vertices (V, 3) and faces (F, 3) of a Mesh, a trimesh or a pair (vertices, faces).

    Raises:
        ValueError: none of these, wrong shapes, ids out of range or numbers that are not finite; begins with `where`.
    """
    if hasattr(given, "vertices") and hasattr(given, "faces"):
        vertices, faces = given.vertices, given.faces
    elif isinstance(given, tuple | list) and len(given) == 2:
        vertices, faces = given
    else:
        raise ValueError(f"{where}: mesh: expected a Mesh, a trimesh or (vertices, faces), got {given!r:.80}")
    points = as_points(vertices, f"{where}: vertices", limit=FARTHEST).copy()
    return points, as_faces(faces, len(points), f"{where}: faces").copy()


def grid(width: float, height: float, columns: int, rows: int) -> Mesh:
    """A rectangle in the x-z plane around the origin with `columns` x `rows` quads, each cut into two triangles.

    Diagonals alternate (union-jack), so that the triangles prefer no direction. Vertex id = row * (columns + 1) + column;
    row 0 lies at the largest z.
    """
    width, height = (
        check_number(width, "grid: width", 0.0, FARTHEST),
        check_number(height, "grid: height", 0.0, FARTHEST),
    )
    columns = int(check_number(columns, "grid: columns", 1, 10_000, integer=True))
    rows = int(check_number(rows, "grid: rows", 1, 10_000, integer=True))
    xs = np.linspace(-0.5 * width, 0.5 * width, columns + 1)
    zs = np.linspace(0.5 * height, -0.5 * height, rows + 1)
    vertices = np.stack([np.tile(xs, rows + 1), np.zeros((columns + 1) * (rows + 1)), np.repeat(zs, columns + 1)], 1)
    r, c = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a = (r * (columns + 1) + c).ravel()
    quads = np.stack([a, a + 1, a + columns + 2, a + columns + 1], axis=1).astype(np.int32)
    even = ((r + c) % 2 == 0).ravel()
    first = np.where(even[:, None], quads[:, [0, 1, 2]], quads[:, [0, 1, 3]])
    second = np.where(even[:, None], quads[:, [0, 2, 3]], quads[:, [1, 2, 3]])
    faces = np.stack([first, second], axis=1).reshape(-1, 3)
    return Mesh(vertices, np.ascontiguousarray(faces, np.int32), np.ascontiguousarray(quads))


def face_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(F,) areas [m^2]."""
    u = vertices[faces[:, 1]] - vertices[faces[:, 0]]
    w = vertices[faces[:, 2]] - vertices[faces[:, 0]]
    return 0.5 * np.linalg.norm(np.cross(u, w), axis=1)


def vertex_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(V,) a third of the area of all faces at each vertex [m^2]."""
    shares = np.repeat(face_areas(vertices, faces) / 3.0, 3)
    return np.bincount(faces.ravel(), shares, minlength=len(vertices)).astype(np.float64)
