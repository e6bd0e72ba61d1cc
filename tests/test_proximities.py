"""Proximities: nothing missing and nothing extra against trying all pairs, and the distances themselves."""

from __future__ import annotations

from functools import cache, partial

import meshes
import naive
import numpy as np
import pytest
import trimesh

import clothgym as cg

SCENES = {
    "crumple-0": (meshes.EVERY["crumple-0"], 0.06),
    "crumple-1": (meshes.EVERY["crumple-1"], 0.03),
    "overfolded_sheet-1": (meshes.EVERY["overfolded_sheet-1"], 0.08),
    "spiky-0": (meshes.EVERY["spiky-0"], 0.05),
    "layers-close": (partial(meshes.layers, 4, 6, 0.03, 0), 0.041),
    "layers-apart": (partial(meshes.layers, 3, 6, 0.2, 5), 0.25),
    "many_sheets-1": (meshes.EVERY["many_sheets-1"], 0.04),
    "seam_of_three-0": (meshes.EVERY["seam_of_three-0"], 0.07),
    "soup-2": (meshes.EVERY["soup-2"], 0.1),
    "tangle-1": (meshes.EVERY["tangle-1"], 0.2),
    "wide": (partial(meshes.crumple, 4, 3), 10.0),
    "lattice_cross": (meshes.EVERY["lattice_cross-0-0-0"], 0.7),
    "lattice_cross-half": (meshes.EVERY["lattice_cross-0.5-0.5-0.5"], 0.55),
    "lattice_cross-tenths": (meshes.EVERY["lattice_cross-tenths-shuffled"], 0.123),
    "coplanar_sheets": (meshes.EVERY["coplanar_sheets-0.5-0.25"], 0.3),
    "doubled_sheet-0": (meshes.EVERY["doubled_sheet-0"], 0.05),
    "zero_area_faces-0": (meshes.EVERY["zero_area_faces-0"], 0.6),
    "zero_area_faces-1": (meshes.EVERY["zero_area_faces-1-shuffled"], 0.6),
    "lattice_tangle-3": (meshes.EVERY["lattice_tangle-3"], 0.55),
    "everything_at_one_point": (meshes.EVERY["everything_at_one_point"], 1e-3),
    "on_a_line-0": (meshes.EVERY["on_a_line-0"], 0.4),
    "flat_tangle-1": (meshes.EVERY["flat_tangle-1"], 0.1),
    "repeated_faces-0": (meshes.EVERY["repeated_faces-0"], 0.08),
    "partly_folded_faces-0": (meshes.EVERY["partly_folded_faces-0"], 0.06),
    "partly_folded_faces-1": (meshes.EVERY["partly_folded_faces-1"], 0.12),
    "turned_lattice-2": (meshes.EVERY["turned_lattice-2"], 0.06),
    "needles-thin": (meshes.EVERY["needles-1e-08"], 0.2),
    "needles-thinnest": (meshes.EVERY["needles-1e-15"], 0.2),
    "needles": (meshes.EVERY["needles-0.001"], 0.2),
}
MARGIN = 1e-11
"""Pairs whose distance lies within this part of the mesh's size of the asked distance may go either way."""


def rows(array) -> list[tuple]:
    return [tuple(row) for row in np.asarray(array).tolist()]


@cache
def scene(name: str) -> tuple[np.ndarray, np.ndarray, float]:
    make, distance = SCENES[name]
    return *make(), distance


def assert_equal_near(near, vertices, faces, distance: float) -> None:
    """Same rows in the same order, same distances; pairs on the very border excepted."""
    margin = MARGIN * max(1.0, float(np.ptp(vertices, axis=0).max()))
    expected = naive.proximities(vertices, faces, distance + margin)
    for kind in ("vertex_triangle", "edge_edge"):
        found = dict(zip(rows(getattr(near, kind)), np.asarray(getattr(near, f"{kind}_distance")).tolist()))
        wanted = dict(zip(rows(getattr(expected, kind)), getattr(expected, f"{kind}_distance").tolist()))
        listed = rows(getattr(near, kind))
        assert len(found) == len(listed)
        assert listed == sorted(listed)
        missing = [row for row, gap in wanted.items() if gap < distance - margin and row not in found]
        extra = [row for row in found if row not in wanted]
        assert (missing, extra) == ([], []), kind
        for row, gap in found.items():
            assert gap < distance
            assert gap == pytest.approx(wanted[row], rel=1e-12, abs=margin), (kind, row)


# ---------------------------------------------------------------------------------------------------------------
# the oracle


def random_quadruples(count: int) -> np.ndarray:
    """(count, 4, 3) points: any, on a tiny lattice, and squeezed to slivers."""
    rng = np.random.default_rng(12)
    any_points = rng.normal(size=(count, 4, 3))
    lattice = rng.integers(-2, 3, (count, 4, 3)).astype(float)
    slivers = rng.normal(size=(count, 4, 3)) * [1, 1e-9, 1e-3]
    return np.concatenate([any_points, lattice, slivers])


def test_oracle_distances_equal_rational_ones():
    points = random_quadruples(150)
    p, a, b, c = (points[:, k] for k in range(4))
    to_triangle, to_edge = naive.point_triangle_distance(p, a, b, c), naive.segment_segment_distance(p, a, b, c)
    for k in range(len(points)):
        assert to_triangle[k] == pytest.approx(naive.exact_point_triangle_distance(*points[k]), abs=1e-14)
        assert to_edge[k] == pytest.approx(naive.exact_segment_segment_distance(*points[k]), abs=1e-14)


def test_oracle_distances_equal_ipctk():
    ipctk = pytest.importorskip("ipctk")
    for points in random_quadruples(100)[:100]:
        assert naive.point_triangle_distance(*points) ** 2 == pytest.approx(ipctk.point_triangle_distance(*points))
        assert naive.segment_segment_distance(*points) ** 2 == pytest.approx(ipctk.edge_edge_distance(*points))


def test_scenes_have_both_near_and_far_pairs():
    for name in SCENES:
        vertices, faces, distance = scene(name)
        near, every = naive.proximities(vertices, faces, distance), naive.proximities(vertices, faces, np.inf)
        assert len(near.vertex_triangle) > 0, name
        assert len(near.edge_edge) > 0, name
        if name not in ("wide", "everything_at_one_point"):
            assert len(near.vertex_triangle) < len(every.vertex_triangle), name
            assert len(near.edge_edge) < len(every.edge_edge), name


# ---------------------------------------------------------------------------------------------------------------
# the library


@pytest.mark.parametrize("name", SCENES)
def test_pairs_equal_trying_all(name):
    vertices, faces, distance = scene(name)
    assert_equal_near(cg.proximities(vertices, faces, distance), vertices, faces, distance)


@pytest.mark.parametrize("factor", [0.0, 0.1, 0.5, 3.0])
@pytest.mark.parametrize("name", ["crumple-1", "layers-close", "lattice_cross-tenths"])
def test_any_distance(name, factor):
    vertices, faces, distance = scene(name)
    if factor == 0.0:
        near = cg.proximities(vertices, faces, 0.0)
        assert len(near.vertex_triangle) == len(near.edge_edge) == 0
    else:
        assert_equal_near(cg.proximities(vertices, faces, factor * distance), vertices, faces, factor * distance)


@pytest.mark.parametrize("width", [1e-3, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10, 1e-13, 1e-16])
def test_slivers_and_nearly_parallel_edges_are_not_missed(width):
    """Distances of thin triangles and of edges at small angles against rational arithmetic, one pair at a time."""
    rng = np.random.default_rng(0)
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    for _ in range(25):
        axis, start = rng.normal(size=3), 0.3 * rng.normal(size=3)
        thin = [start, start + axis + width * rng.normal(size=3)]
        thin.append(start + rng.uniform(0.2, 0.8) * axis + width * rng.normal(size=3))
        beside = start + 0.1 * rng.normal(size=3) + rng.uniform(-0.8, 0.8) * axis
        other = [beside, beside + axis + width * rng.normal(size=3), beside + rng.normal(size=3)]
        vertices = np.array([*thin, *other])
        near = cg.proximities(vertices, faces, 1e3)
        for (v, face), gap in zip(rows(near.vertex_triangle), near.vertex_triangle_distance):
            expected = naive.exact_point_triangle_distance(vertices[v], *vertices[faces[face]])
            assert gap == pytest.approx(expected, rel=1e-12, abs=1e-14), (v, face)
        for edge_pair, gap in zip(rows(near.edge_edge), near.edge_edge_distance):
            expected = naive.exact_segment_segment_distance(*vertices[list(edge_pair)])
            assert gap == pytest.approx(expected, rel=1e-12, abs=1e-14), edge_pair
            just_enough = cg.proximities(vertices, faces, expected * (1 + 1e-9))
            assert edge_pair in rows(just_enough.edge_edge)
        assert len(near.vertex_triangle) == 6
        assert len(near.edge_edge) == 9


@pytest.mark.parametrize("seed", range(30))
def test_random_small_meshes(seed):
    rng = np.random.default_rng(seed)
    makers = (meshes.tangle, meshes.lattice_tangle, meshes.flat_tangle)
    vertices, faces = makers[seed % 3](int(rng.integers(5, 20)), int(rng.integers(4, 40)), seed)
    distance = float(rng.uniform(0.05, 0.6))
    assert_equal_near(cg.proximities(vertices, faces, distance), vertices, faces, distance)


def test_pairs_are_as_documented():
    vertices, faces, distance = scene("crumple-0")
    near = cg.proximities(vertices, faces, distance)
    pairs, edges = np.asarray(near.vertex_triangle), np.asarray(near.edge_edge)
    assert pairs.shape[1:] == (2,)
    assert edges.shape[1:] == (4,)
    assert np.issubdtype(pairs.dtype, np.integer)
    assert np.issubdtype(edges.dtype, np.integer)
    assert not (faces[pairs[:, 1]] == pairs[:, :1]).any()
    assert (edges[:, 0] < edges[:, 1]).all()
    assert (edges[:, 2] < edges[:, 3]).all()
    assert all((a0, a1) < (b0, b1) and not {a0, a1} & {b0, b1} for a0, a1, b0, b1 in rows(edges))
    assert np.asarray(near.vertex_triangle_distance).shape == (len(pairs),)
    assert np.asarray(near.edge_edge_distance).shape == (len(edges),)


def test_known_distances():
    """A vertex 0.25 above a face and an edge 0.5 above another edge, in coordinates without rounding."""
    vertices = np.array([[0, 0, 0], [4, 0, 0], [0, 0, 4], [1, 0.25, 1], [1, 8, 1], [2, 8, 1]], dtype=float)
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    near = cg.proximities(vertices, faces, 0.3)
    assert rows(near.vertex_triangle) == [(3, 0)]
    assert near.vertex_triangle_distance[0] == 0.25
    assert len(near.edge_edge) == 0
    assert len(cg.proximities(vertices, faces, 0.25).vertex_triangle) == 0
    assert len(cg.proximities(vertices, faces, 0.2500001).vertex_triangle) == 1

    vertices = np.array([[-1, 0, 0], [1, 0, 0], [0, -8, 0], [0, 0.5, -1], [0, 0.5, 1], [0, 8, 0]], dtype=float)
    near = cg.proximities(vertices, faces, 0.6)
    assert rows(near.edge_edge) == [(0, 1, 3, 4)]
    assert near.edge_edge_distance[0] == 0.5
    assert len(near.vertex_triangle) == 0
    assert len(cg.proximities(vertices, faces, 0.5).edge_edge) == 0


def test_crossing_features_have_distance_zero():
    vertices, faces = meshes.single_hit()
    (hit,) = naive.hit_frames(naive.exact_intersections(vertices, faces))
    vertices = np.concatenate([vertices, hit.point + np.array([[0.0, 0, 0], [0, 5, 0], [1, 5, 0]])])
    faces = np.concatenate([faces, [[5, 6, 7]]])
    near = cg.proximities(vertices, faces, 1e-9)
    assert (5, 0) in rows(near.vertex_triangle)
    assert (5, 1) in rows(near.vertex_triangle)
    assert max(near.vertex_triangle_distance) < 1e-15


def test_vertices_without_faces_do_not_count():
    vertices, faces, distance = scene("layers-close")
    more = np.concatenate([vertices, vertices[:9] + 1e-3])
    near = cg.proximities(more, faces, distance)
    assert_equal_near(near, vertices, faces, distance)
    assert np.asarray(near.vertex_triangle)[:, 0].max() < len(vertices)


def test_faces_that_repeat_an_id_do_not_count():
    vertices, faces, distance = scene("partly_folded_faces-0")
    folded = [face for face, corners in enumerate(faces.tolist()) if len(set(corners)) < 3]
    near = cg.proximities(vertices, faces, distance)
    assert near.skipped_faces == len(folded) > 0
    assert not np.isin(np.asarray(near.vertex_triangle)[:, 1], folded).any()
    assert np.asarray(near.vertex_triangle)[:, 1].max() > len(faces) - len(folded)  # ids of the faces as given


@pytest.mark.parametrize("name", ["crumple-0", "layers-close", "soup-2"])
def test_relabelling_and_rigid_motion(name):
    vertices, faces, distance = scene(name)
    before = cg.proximities(vertices, faces, distance)
    (new_vertices, new_faces), new_id, old_face = meshes.relabelled((vertices, faces), 8)
    after = cg.proximities(new_vertices @ meshes.rotation(2).T + [0.1, 0.2, 0.3], new_faces, distance)
    new_face = np.argsort(old_face)
    named = sorted((int(new_id[v]), int(new_face[face])) for v, face in rows(before.vertex_triangle))
    assert named == rows(after.vertex_triangle)
    edges = []
    for a0, a1, b0, b1 in rows(before.edge_edge):
        first, second = (sorted(new_id[list(edge)].tolist()) for edge in ((a0, a1), (b0, b1)))
        edges.append(tuple(min(first, second) + max(first, second)))
    assert sorted(edges) == rows(after.edge_edge)


def test_float32_vertices_are_taken_as_they_are():
    vertices, faces, distance = scene("layers-close")
    single = vertices.astype(np.float32)
    near = cg.proximities(single, faces, distance)
    assert_equal_near(near, single.astype(np.float64), faces, distance)
    assert np.asarray(near.vertex_triangle_distance).dtype == np.float64


def test_surface_and_trimesh_stand_for_faces():
    vertices, faces, distance = scene("crumple-0")
    expected = cg.proximities(vertices, faces, distance)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    for near in (
        cg.proximities(vertices, cg.Surface(faces), distance),
        cg.proximities(mesh, distance=distance),
        cg.proximities(vertices, faces.tolist(), distance),
    ):
        assert rows(near.vertex_triangle) == rows(expected.vertex_triangle)
        assert rows(near.edge_edge) == rows(expected.edge_edge)
        assert np.array_equal(near.edge_edge_distance, expected.edge_edge_distance)


@pytest.mark.parametrize(
    ("vertices", "faces"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), dtype=int)),
        (np.ones((4, 3)), np.zeros((0, 3), dtype=int)),
        (np.eye(3), np.array([[0, 1, 2]])),
    ],
)
def test_nothing_near(vertices, faces):
    near = cg.proximities(vertices, faces, 10.0)
    assert np.shape(near.vertex_triangle) == (0, 2)
    assert np.shape(near.edge_edge) == (0, 4)
    assert np.shape(near.vertex_triangle_distance) == np.shape(near.edge_edge_distance) == (0,)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_bad_vertex_is_named(value):
    vertices, faces = meshes.grid(3, 3)
    vertices[5, 1] = value
    with pytest.raises(ValueError, match=r"vertices\[5, 1\]"):
        cg.proximities(vertices, faces, 0.1)


@pytest.mark.parametrize("value", [16, -1])
def test_bad_face_is_named(value):
    vertices, faces = meshes.grid(3, 3)
    faces[7, 2] = value
    with pytest.raises(ValueError, match=rf"faces\[7, 2\] is {value}"):
        cg.proximities(vertices, faces, 0.1)


@pytest.mark.parametrize(
    ("vertices", "faces", "field"),
    [
        (np.zeros((4, 2)), [[0, 1, 2]], "vertices"),
        (np.zeros((4, 3)), [[0, 1, 2, 3]], "faces"),
        (np.zeros((4, 3)), [[0.0, 1.0, 2.0]], "faces"),
    ],
)
def test_wrong_shapes_and_types_are_named(vertices, faces, field):
    with pytest.raises(ValueError, match=field):
        cg.proximities(vertices, np.asarray(faces), 0.1)


@pytest.mark.parametrize("distance", [-0.1, np.nan, np.inf, "near", None])
def test_bad_distance_is_named(distance):
    with pytest.raises(ValueError, match="distance"):
        cg.proximities(*meshes.grid(2, 2), distance)


# ---------------------------------------------------------------------------------------------------------------
# a surface that is used again


def same_as_fresh(vertices, faces, surface, distance: float) -> None:
    """A surface that has seen other shapes answers like a new one, to the last bit."""
    near, fresh = (cg.proximities(vertices, s, distance) for s in (surface, cg.Surface(faces, len(vertices))))
    for name in ("vertex_triangle", "vertex_triangle_distance", "edge_edge", "edge_edge_distance"):
        assert np.array_equal(getattr(near, name), getattr(fresh, name)), name
    hits, fresh = (cg.intersections(vertices, s) for s in (surface, cg.Surface(faces, len(vertices))))
    assert np.array_equal(hits.edge_triangle, fresh.edge_triangle)
    assert np.array_equal(hits.points, fresh.points)
    assert np.array_equal(hits.segments, fresh.segments)


def test_results_do_not_depend_on_earlier_shapes():
    vertices, faces = meshes.layers(4, 12, 0.03, 3)
    surface = cg.Surface(faces, len(vertices))
    sheet = np.arange(len(vertices)) // (len(vertices) // 4)
    rng = np.random.default_rng(1)
    trees = set()
    for spread in (0.0, 0.1, 3.0, 3.0, 0.02, 0.0):
        moved = vertices + spread * sheet[:, None] * np.array([1.0, 0.3, -0.6]) + rng.normal(0, 0.003, vertices.shape)
        same_as_fresh(moved, faces, surface, 0.05)
        trees.add(id(getattr(surface, "_tree", (None,))[0]))
    assert len(trees) > 1, "a tree whose leaves are torn apart is made anew"


def test_more_vertices_than_before():
    vertices, faces, distance = scene("layers-close")
    surface = cg.Surface(faces)
    same_as_fresh(vertices, faces, surface, distance)
    same_as_fresh(np.concatenate([vertices, vertices[:5] + 7.0]), faces, surface, distance)


@pytest.mark.parametrize("scale", [1e-45, 1e-12, 1e9])
@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_any_scale_and_place(scale, offset):
    """Boxes are kept in single precision relative to the mesh: neither size nor place may lose a pair."""
    vertices, faces, distance = scene("layers-close")
    shifted = np.round(vertices * 2**20) / 2**20 + offset  # exact, so that the distances are the same numbers
    before = cg.proximities(shifted - offset, faces, distance)
    power = 2.0 ** np.round(np.log2(scale))
    after = cg.proximities(shifted * power, faces, distance * power)
    assert rows(before.vertex_triangle) == rows(after.vertex_triangle)
    assert rows(before.edge_edge) == rows(after.edge_edge)


def ribbon(turns: int, cells: int) -> meshes.Mesh:
    """A narrow strip wound up, layer upon layer, with 4 mm between them."""
    vertices, faces = meshes.grid(cells, 2, 1.0, 0.02)
    angle = 2 * np.pi * turns * vertices[:, 0]
    radius = 0.02 + 0.004 * turns * vertices[:, 0]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), vertices[:, 2]], axis=1), faces


def accordion(pleats: int, cells: int) -> meshes.Mesh:
    """A sheet in pleats whose walls stand 3 mm apart."""
    vertices, faces = meshes.grid(pleats * cells, cells, pleats * 0.1, 0.1, alternate=True)
    along = vertices[:, 0] / 0.1
    height = 0.1 * np.abs((along % 2.0) - 1.0)
    return np.stack([0.003 * along, height, vertices[:, 2]], axis=1), faces


@pytest.mark.parametrize("lattice", [False, True])
@pytest.mark.parametrize(
    "make", [partial(ribbon, 4, 70), partial(accordion, 6, 6), partial(meshes.layers, 6, 5, 0.003, 2)]
)
def test_ribbons_folds_and_layers(make, lattice):
    vertices, faces = make()
    if lattice:
        vertices = np.round(vertices * 512) / 512
    for distance in (0.002, 0.0041):
        near = cg.proximities(vertices, faces, distance)
        assert_equal_near(near, vertices, faces, distance)
    assert len(near.vertex_triangle) + len(near.edge_edge) > 50
