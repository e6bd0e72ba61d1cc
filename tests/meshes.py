"""Small test meshes with known defects. Every maker returns (vertices (V, 3) float64, faces (F, 3) int64).

GENERAL: crossings in general position, in which every statement of the theory must hold (a flat sheet's own faces
may be coplanar: they touch nothing). DEGENERATE: scenes full of exact zeros, each under two numberings: lattices,
coplanar and coincident sheets, zero-area faces. SPECIAL: repeated or impossible faces, and near zeros.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]


def rotation(seed: int) -> np.ndarray:
    """A random proper rotation."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def merged(*parts: Mesh) -> Mesh:
    """One mesh of separate parts, vertex ids in order of the parts."""
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    return np.concatenate([part[0] for part in parts]), np.concatenate([p[1] + o for p, o in zip(parts, offsets)])


def moved(mesh: Mesh, matrix=None, offset=(0.0, 0.0, 0.0)) -> Mesh:
    """The mesh after x -> matrix x + offset."""
    vertices = mesh[0] if matrix is None else mesh[0] @ np.asarray(matrix, dtype=float).T
    return vertices + np.asarray(offset, dtype=float), mesh[1]


def jittered(mesh: Mesh, amplitude: float, seed: int) -> Mesh:
    """Every coordinate moved by up to the amplitude."""
    noise = np.random.default_rng(seed).uniform(-amplitude, amplitude, mesh[0].shape)
    return mesh[0] + noise, mesh[1]


def relabelled(mesh: Mesh, seed: int) -> tuple[Mesh, np.ndarray, np.ndarray]:
    """New vertex ids, face order and corner order; returns mesh, new id of each vertex, old id of each face."""
    rng = np.random.default_rng(seed)
    vertices, faces = mesh
    new_id, face_order = rng.permutation(len(vertices)), rng.permutation(len(faces))
    moved_vertices = np.empty_like(vertices)
    moved_vertices[new_id] = vertices
    shuffled = rng.permuted(new_id[faces[face_order]], axis=1)
    return (moved_vertices, shuffled), new_id, face_order


def grid(columns: int, rows: int, width: float = 1.0, depth: float = 1.0, alternate: bool = False) -> Mesh:
    """A sheet in the plane y = 0 from the origin along x and z; `alternate` turns every second diagonal."""
    x, z = np.meshgrid(np.linspace(0, width, columns + 1), np.linspace(0, depth, rows + 1), indexing="ij")
    vertices = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    faces = []
    for i in range(columns):
        for j in range(rows):
            a, b = i * (rows + 1) + j, (i + 1) * (rows + 1) + j
            if alternate and (i + j) % 2:
                faces += [[a, a + 1, b], [b, a + 1, b + 1]]
            else:
                faces += [[a, a + 1, b + 1], [a, b + 1, b]]
    return vertices, np.array(faces, dtype=np.int64)


UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""The rotation (x, y, z) -> (x, z, -y): z becomes y."""


def upright(mesh: Mesh) -> Mesh:
    """A sheet of the plane y = 0 stood up into the plane z = 0, its depth along y."""
    return moved(mesh, UPRIGHT)


# ---------------------------------------------------------------------------------------------------------------
# general position


def crossing_sheets(cells: int, seed: int) -> Mesh:
    """Two sheets that cross at an angle, each a little uneven; the second sticks out on one side (BIBI or BBII)."""
    rng = np.random.default_rng(seed)
    first = jittered(grid(cells, cells), 0.1 / cells, seed)
    second = jittered(upright(grid(cells, cells, 0.9, 1.1, alternate=True)), 0.1 / cells, seed + 1000)
    turn = rotation_about((0, 1, 0), rng.uniform(-0.4, 0.4)) @ rotation_about((1, 0, 0), rng.uniform(-0.4, 0.4))
    return merged(first, moved(second, turn, (rng.uniform(0.05, 0.4), -0.5, rng.uniform(0.4, 0.6))))


def rotation_about(axis, angle: float) -> np.ndarray:
    """Rotation matrix about an axis through the origin, angle in radians."""
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def grazing_sheets(angle: float) -> Mesh:
    """Two sheets whose planes make a small angle and meet in a line across both."""
    turn = rotation_about((1, 0, 0.2), angle) @ rotation_about((0, 1, 0), 0.3)
    second = moved(grid(3, 3, 0.8, 0.8, alternate=True), None, (-0.4, 0, -0.37))
    return merged(grid(3, 3), moved(second, turn, (0.43, 0, 0.52)))


def many_sheets(count: int, cells: int, seed: int) -> Mesh:
    """Wavy unit squares at random places and turns in a box."""
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(count):
        vertices, faces = grid(cells, cells, alternate=bool(k % 2))
        vertices = vertices - [0.5, 0, 0.5]
        phase = rng.uniform(0, 6, 4)
        vertices[:, 1] += 0.08 * np.sin(5 * vertices[:, 0] + phase[0]) * np.sin(4 * vertices[:, 2] + phase[1])
        sheet = jittered((vertices, faces), 0.02 / cells, int(rng.integers(1 << 30)))
        parts.append(moved(sheet, rotation(int(rng.integers(1 << 30))), rng.uniform(-0.3, 0.3, 3)))
    return merged(*parts)


def overfolded_sheet(cells: int, seed: int) -> Mesh:
    """A sheet folded past flat at one end of its crease only: the contour starts at a loop vertex of the crease."""
    vertices, faces = grid(2 * cells, cells, 2.0, 1.0)
    vertices[:, 0] -= 1.0
    angle = np.pi * (0.85 + 0.3 * vertices[:, 2] ** 2)
    right = vertices[:, 0] > 1e-9
    reach = vertices[right, 0]
    vertices[right, 0] = reach * np.cos(angle[right])
    vertices[right, 1] = reach * np.sin(angle[right])
    return moved(jittered((vertices, faces), 0.03 / cells, seed), rotation(seed))


def crumple(cells: int, seed: int, amplitude: float = 0.35) -> Mesh:
    """A sheet displaced by a few smooth random waves in all directions, large enough to cross itself."""
    rng = np.random.default_rng(seed)
    vertices, faces = grid(cells, cells, alternate=True)
    displaced = vertices.copy()
    for _ in range(6):
        wave, phase = rng.normal(0, 6, 2), rng.uniform(0, 2 * np.pi, 3)
        angle = vertices[:, [0]] * wave[0] + vertices[:, [2]] * wave[1]
        displaced += amplitude * rng.normal(size=3) / np.sqrt(6) * np.sin(angle + phase)
    return jittered((displaced, faces), 0.01 / cells, seed)


def spiky(cells: int, seed: int, amplitude: float = 0.9) -> Mesh:
    """A sheet with every vertex moved on its own by about a cell: neighbours cross, many loop vertices."""
    return jittered(grid(cells, cells), amplitude / cells, seed)


def seam_of_three(cells: int, seed: int) -> Mesh:
    """Three half sheets that share one line (edges with three faces), and a sheet that cuts through the line."""
    wings = []
    for angle in (0.3, 2.2, 4.4):
        wings.append(moved(grid(cells, cells, 0.6, 1.0), rotation_about((0, 0, 1), angle)))
    vertices, faces = welded(merged(*wings))
    cutter = moved(upright(grid(cells, cells, 1.3, 1.3, alternate=True)), rotation_about((1, 2, 0.5), 0.25))
    mesh = merged((vertices, faces), moved(cutter, None, (-0.6, -0.7, 0.47)))
    return jittered(mesh, 0.02 / cells, seed)


def welded(mesh: Mesh, digits: int = 9) -> Mesh:
    """Vertices at the same place become one."""
    _, first, inverse = np.unique(np.round(mesh[0], digits), axis=0, return_index=True, return_inverse=True)
    return mesh[0][first], inverse.ravel()[mesh[1]]


def soup(count: int, seed: int, size: float = 0.5) -> Mesh:
    """Separate triangles at random places of the unit box."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(0, 1, (count, 1, 3)) + rng.uniform(-size, size, (count, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def tangle(vertex_count: int, face_count: int, seed: int) -> Mesh:
    """Random faces over few random vertices: edges with any number of faces, all pairs cross or share vertices."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (vertex_count, 3)), random_faces(vertex_count, face_count, rng)


def random_faces(vertex_count: int, face_count: int, rng: np.random.Generator) -> np.ndarray:
    """Faces of three different random ids; the same three may come twice."""
    return np.array([rng.choice(vertex_count, 3, replace=False) for _ in range(face_count)], dtype=np.int64)


def icosphere(subdivisions: int, radius: float = 1.0) -> Mesh:
    """Sphere of 20 * 4^subdivisions faces, vertices on the sphere."""
    g = (1 + 5**0.5) / 2
    vertices = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g)]
    vertices += [(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    points = [np.array(v, dtype=float) / np.linalg.norm(v) for v in vertices]
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2)]
    faces += [(10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5)]
    faces += [(2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
    for _ in range(subdivisions):
        middle: dict[tuple[int, int], int] = {}

        def halved(a: int, b: int, middle=middle) -> int:
            key = (min(a, b), max(a, b))
            if key not in middle:
                between = points[a] + points[b]
                middle[key] = len(points)
                points.append(between / np.linalg.norm(between))
            return middle[key]

        finer = []
        for a, b, c in faces:
            ab, bc, ca = halved(a, b), halved(b, c), halved(c, a)
            finer += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = finer
    return radius * np.array(points), np.array(faces, dtype=np.int64)


def poked_sphere(subdivisions: int, depth: float) -> Mesh:
    """Unit sphere, turned at random, that pokes its lowest `depth` through a sheet in the plane y = 0."""
    ball = moved(icosphere(subdivisions), rotation(5), (0.013, 1.0 - depth, -0.021))
    return merged(ball, moved(grid(7, 7, 4.0, 4.0), None, (-2.03, 0, -2.07)))


def pyramid_poke(depth: float, half_width: float = 0.5, height: float = 1.0) -> Mesh:
    """A square pyramid, apex down by `depth` through the plane y = 0: contour length 8 half_width depth / height."""
    w = half_width
    corners = np.array([[0.0, -depth, 0.0], *([sx * w, height - depth, sz * w] for sx, sz in _CORNERS)])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]], dtype=np.int64)
    turned = moved((corners, faces), rotation_about((0, 1, 0), 0.37), (0.031, 0, -0.017))
    return merged(turned, moved(grid(5, 5, 2.0, 2.0), None, (-1.07, 0, -1.03)))


_CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def strip_through_plane(width: float, lean: float, cells: int = 4) -> Mesh:
    """A strip right through a larger sheet, its long side leaning `lean` off the normal in its own plane."""
    strip = moved(upright(grid(cells, 5 * cells, width, 2.0)), None, (-width / 2, -1.03, 0))
    leaning = moved(strip, rotation_about((0, 1, 0), 0.41) @ rotation_about((0, 0, 1), lean), (0.02, 0, 0.03))
    return merged(leaning, moved(grid(9, 9, 3.0, 3.0), None, (-1.53, 0, -1.48)))


def crossed_squares(offset: float, cells: int = 5) -> Mesh:
    """X of two unit squares: the planes y = 0 and z = 0, the second `offset` further along the common line x."""
    flat = moved(grid(cells, cells), None, (0, 0, -0.5123))
    return merged(flat, moved(upright(grid(cells, cells)), None, (offset, -0.4871, 0)))


def single_hit() -> Mesh:
    """Two triangles with the common vertex 0, of which the edge (1, 2) of the first pierces the second: one hit."""
    vertices = [[0, 0, 0], [0.9, 0.6, -0.31], [1.1, -0.7, 0.43], [1.7, 0.11, -0.8], [1.6, -0.13, 1.1]]
    return np.array(vertices), np.array([[0, 1, 2], [0, 3, 4]])


def layers(count: int, cells: int, gap: float, seed: int) -> Mesh:
    """Wavy sheets above each other with about `gap` between them."""
    parts = []
    for k in range(count):
        vertices, faces = grid(cells, cells, alternate=bool(k % 2))
        vertices[:, 1] = 0.1 * np.sin(4 * vertices[:, 0]) * np.cos(3 * vertices[:, 2]) + k * gap
        parts.append(jittered((vertices, faces), min(0.3 * gap, 0.2 / cells), seed + k))
    return merged(*parts)


# ---------------------------------------------------------------------------------------------------------------
# exact degeneracy


def lattice_cross(shift: tuple[float, float, float], spacing: float = 1.0, cells: int = 3) -> Mesh:
    """A flat and an upright sheet of one lattice, shifted by parts of a cell: vertices on vertices, edges and faces."""
    flat = grid(cells, cells, cells, cells)
    standing = moved(upright(grid(cells, cells, cells, cells, alternate=True)), None, (0, -1, 1))
    vertices, faces = merged(flat, moved(standing, None, shift))
    return vertices * spacing, faces


def coplanar_sheets(shift: tuple[float, float], cells: int = 4) -> Mesh:
    """Two sheets in the same plane, shifted within it."""
    first, second = grid(cells, cells, cells, cells), grid(cells, cells, cells, cells, alternate=True)
    return merged(first, moved(second, None, (shift[0], 0, shift[1])))


def doubled_sheet(cells: int, seed: int) -> Mesh:
    """A crumpled sheet and its exact copy on other vertices, and a flat one through both."""
    sheet = crumple(cells, seed)
    return merged(sheet, (sheet[0].copy(), sheet[1]), moved(grid(cells, cells), None, (0.05, 0.02, 0.03)))


def repeated_faces(cells: int, seed: int) -> Mesh:
    """Crossing sheets in which a third of all faces occurs again, some with other corner order."""
    vertices, faces = crossing_sheets(cells, seed)
    rng = np.random.default_rng(seed)
    again = rng.choice(len(faces), len(faces) // 3, replace=False)
    return vertices, np.concatenate([faces, rng.permuted(faces[again], axis=1)])


def zero_area_faces(cells: int, seed: int) -> Mesh:
    """Crossing sheets in which vertices are put on neighbours and on middles of edges: slivers of no area."""
    vertices, faces = lattice_cross((0.5, 0.0, 0.0), cells=cells)
    rng = np.random.default_rng(seed)
    for corners in faces[rng.choice(len(faces), len(faces) // 3, replace=False)]:
        if rng.random() < 0.5:
            vertices[corners[0]] = vertices[corners[1]]
        else:
            vertices[corners[0]] = (vertices[corners[1]] + vertices[corners[2]]) / 2
    return vertices, faces


def lattice_tangle(vertex_count: int, face_count: int, seed: int, size: int = 3) -> Mesh:
    """Random faces over vertices with whole coordinates of a tiny lattice, many at the same place."""
    rng = np.random.default_rng(seed)
    vertices = rng.integers(0, size, (vertex_count, 3)).astype(float)
    return vertices, random_faces(vertex_count, face_count, rng)


def everything_at_one_point(vertex_count: int, face_count: int, seed: int) -> Mesh:
    """Random faces whose vertices all lie at the same place."""
    rng = np.random.default_rng(seed)
    return np.full((vertex_count, 3), 0.7), random_faces(vertex_count, face_count, rng)


def on_a_line(vertex_count: int, face_count: int, seed: int) -> Mesh:
    """Random faces whose vertices all lie on one line."""
    rng = np.random.default_rng(seed)
    along = rng.integers(-4, 5, (vertex_count, 1)).astype(float)
    return along * np.array([[1.0, 2.0, -1.0]]), random_faces(vertex_count, face_count, rng)


def flat_tangle(vertex_count: int, face_count: int, seed: int) -> Mesh:
    """Random faces whose vertices all lie in one plane, the coordinates not whole."""
    rng = np.random.default_rng(seed)
    vertices = rng.uniform(-1, 1, (vertex_count, 3))
    vertices[:, seed % 3] = 0.1
    return vertices, random_faces(vertex_count, face_count, rng)


def partly_folded_faces(cells: int, seed: int) -> Mesh:
    """Crossing sheets of which some faces repeat a vertex id (no triangles: to be skipped and counted)."""
    vertices, faces = crossing_sheets(cells, seed)
    faces = faces.copy()
    chosen = np.random.default_rng(seed).choice(len(faces), len(faces) // 6, replace=False)
    faces[chosen, 1] = faces[chosen, 0]
    return vertices, faces


def turned_lattice(cells: int, seed: int) -> Mesh:
    """Lattice-aligned sheets after a rotation: touching features that are now apart by rounding only."""
    shift = ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.5, 0.5, 0.5), (0.0, 0.0, 0.5))[seed % 4]
    return moved(lattice_cross(shift, 0.1, cells), rotation(seed), (0.31, -1.7, 0.05))


def far_lattice(cells: int, offset: float) -> Mesh:
    """Lattice-aligned sheets far from the origin: coordinates have few digits left, differences none to lose."""
    return moved(lattice_cross((0.5, 0.0, 0.0), 0.1, cells), None, (offset, -offset, 0.7 * offset))


def needles(count: int, seed: int, thickness: float) -> Mesh:
    """Separate long triangles of nearly no width, many nearly parallel, and a few wide ones."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(count, 1, 3)) * np.where(rng.random((count, 1, 1)) < 0.5, 1e-7, 1.0) + [[[1.0, 0.3, -0.2]]]
    along = np.array([0.0, 1.0, 0.6])[None, :, None] * axis
    corners = rng.uniform(-0.3, 0.3, (count, 1, 3)) + along + thickness * rng.normal(size=(count, 3, 3))
    wide = rng.uniform(-0.5, 1.2, (count // 3, 3, 3))
    return np.concatenate([corners, wide]).reshape(-1, 3), np.arange(3 * (count + len(wide))).reshape(-1, 3)


def flat_fan(count: int, seed: int) -> Mesh:
    """Triangles in one plane around one common vertex, overlapping at whole lattice directions, and a wall on it."""
    rng = np.random.default_rng(seed)
    rim = rng.integers(-3, 4, (2 * count, 2)).astype(float)
    vertices = np.zeros((2 * count + 1, 3))
    vertices[1:, [0, 2]] = rim
    faces = np.array([[0, 2 * k + 1, 2 * k + 2] for k in range(count)], dtype=np.int64)
    wall = moved(upright(grid(3, 2, 6.0, 2.0)), None, (-3.0, -1.0, 0.0))
    return merged((vertices, faces), wall)


def shuffled(make: Callable[[], Mesh], seed: int) -> Mesh:
    """The mesh under other vertex ids: ties are broken the other way."""
    return relabelled(make(), seed)[0]


def nearly_flat(cells: int, seed: int, scale: float) -> Mesh:
    """Two sheets in nearly one plane: determinants of the size of their own rounding, but not all zero."""
    first, second = grid(cells, cells), moved(grid(cells, cells, alternate=True), None, (0.37, 0, 0.21))
    vertices, faces = merged(first, second)
    noise = np.random.default_rng(seed).uniform(-scale, scale, len(vertices))
    vertices[:, 1] += 0.3 + 0.7 * vertices[:, 0] - 0.9 * vertices[:, 2] + noise
    return vertices, faces


GENERAL: dict[str, Callable[[], Mesh]] = {
    **{f"crossing_sheets-{seed}": partial(crossing_sheets, 5, seed) for seed in range(4)},
    **{f"many_sheets-{seed}": partial(many_sheets, 4, 4, seed) for seed in range(3)},
    **{f"overfolded_sheet-{seed}": partial(overfolded_sheet, 5, seed) for seed in range(3)},
    **{f"crumple-{seed}": partial(crumple, 8, seed) for seed in range(4)},
    **{f"spiky-{seed}": partial(spiky, 6, seed) for seed in range(3)},
    **{f"seam_of_three-{seed}": partial(seam_of_three, 4, seed) for seed in range(3)},
    **{f"soup-{seed}": partial(soup, 40, seed) for seed in range(3)},
    **{f"tangle-{seed}": partial(tangle, 14, 30, seed) for seed in range(4)},
    "poked_sphere": partial(poked_sphere, 2, 0.13),
    "pyramid_poke": partial(pyramid_poke, 0.23),
    "strip_through_plane": partial(strip_through_plane, 0.3, 0.35),
    "single_hit": single_hit,
}

DEGENERATE: dict[str, Callable[[], Mesh]] = {
    **{
        f"lattice_cross-{dx:g}-{dy:g}-{dz:g}": partial(lattice_cross, (dx, dy, dz))
        for dx in (0.0, 0.5)
        for dy in (0.0, 0.5)
        for dz in (0.0, 0.5)
    },
    "lattice_cross-tenths": partial(lattice_cross, (0.0, 0.0, 0.0), 0.1),
    "lattice_cross-thirds": partial(lattice_cross, (1 / 3, 0.0, 1 / 3), 0.1),
    **{f"coplanar_sheets-{dx:g}-{dz:g}": partial(coplanar_sheets, (dx, dz)) for dx in (0.0, 0.5) for dz in (0.0, 0.25)},
    **{f"doubled_sheet-{seed}": partial(doubled_sheet, 5, seed) for seed in range(2)},
    "repeated_lattice_faces": lambda: (lambda v, f: (v, np.concatenate([f, f[::2, ::-1]])))(*lattice_cross((0, 0, 0))),
    **{f"zero_area_faces-{seed}": partial(zero_area_faces, 4, seed) for seed in range(3)},
    **{f"lattice_tangle-{seed}": partial(lattice_tangle, 20, 40, seed) for seed in range(6)},
    **{f"lattice_tangle-tiny-{seed}": partial(lattice_tangle, 14, 40, seed, 2) for seed in range(3)},
    "everything_at_one_point": partial(everything_at_one_point, 12, 30, 0),
    **{f"on_a_line-{seed}": partial(on_a_line, 12, 30, seed) for seed in range(2)},
    **{f"flat_tangle-{seed}": partial(flat_tangle, 14, 30, seed) for seed in range(3)},
    **{f"flat_fan-{seed}": partial(flat_fan, 12, seed) for seed in range(2)},
}

SPECIAL: dict[str, Callable[[], Mesh]] = {
    **{f"repeated_faces-{seed}": partial(repeated_faces, 4, seed) for seed in range(2)},
    **{f"partly_folded_faces-{seed}": partial(partly_folded_faces, 5, seed) for seed in range(2)},
    **{f"nearly_flat-{scale:g}": partial(nearly_flat, 4, 3, scale) for scale in (0.0, 1e-16, 1e-15, 1e-12)},
    **{f"turned_lattice-{seed}": partial(turned_lattice, 4, seed) for seed in range(4)},
    **{f"far_lattice-{offset:g}": partial(far_lattice, 4, offset) for offset in (1e3, 1e7, 1e11)},
    **{f"needles-{thickness:g}": partial(needles, 24, 7, thickness) for thickness in (1e-3, 1e-8, 1e-15)},
}
"""General position with repeated or impossible faces, and sheets whose determinants drown in rounding."""

DEGENERATE |= {f"{name}-shuffled": partial(shuffled, make, 11) for name, make in list(DEGENERATE.items())}
EVERY: dict[str, Callable[[], Mesh]] = {**GENERAL, **DEGENERATE, **SPECIAL}
