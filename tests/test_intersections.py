"""Intersections: against exact arithmetic, packaged libraries, closed forms and invariants."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import pairwise

import meshes
import naive
import numpy as np
import pytest
from intersection_cases import exact_scene, rows

import clothgym as cg

ROUND_OFF = 2.0**-53


def assert_equals_exact(hits, exact: naive.Exact) -> None:
    """Hits, pairs and contours, all of them and nothing else, in the documented order."""
    assert rows(hits.edge_triangle) == exact.hits
    assert rows(hits.pairs) == list(exact.pairs)
    contour = naive.exact_contours(exact)
    assert np.asarray(hits.hit_contour).tolist() == contour
    assert np.asarray(hits.contour).tolist() == [contour[ends[0]] for ends in exact.pairs.values()]
    assert hits.skipped_faces == exact.skipped_faces


def pair_counts(hits, faces) -> dict[tuple[int, int], int]:
    """How many hits each face pair has, from the library's hits alone."""
    incident = naive.incident_faces(faces)
    counts: dict[tuple[int, int], int] = {}
    for e0, e1, a in rows(hits.edge_triangle):
        for b in incident[e0, e1]:
            pair = (min(a, b), max(a, b))
            counts[pair] = counts.get(pair, 0) + 1
    return counts


# ---------------------------------------------------------------------------------------------------------------
# the oracles themselves


def test_oracle_polynomial_is_the_really_perturbed_determinant():
    rng = np.random.default_rng(2)
    eps = Fraction(1, 2**13)
    zeros = 0
    for _ in range(40):
        coordinates = [tuple(int(c) for c in row) for row in rng.integers(0, 3, (4, 3))]
        ids = [int(i) for i in rng.permutation(4)]
        moved = [[Fraction(x) + eps ** (2 ** (3 * i + c)) for c, x in enumerate(coordinates[i])] for i in ids]
        value = naive.determinant(*moved)
        zeros += naive.determinant(*(coordinates[i] for i in ids)) == 0
        assert naive.perturbed_sign(coordinates, ids) == (1 if value > 0 else -1)
        polynomial = naive.perturbed_polynomial(coordinates, ids)
        assert sum(coefficient * eps**exponent for exponent, coefficient in polynomial.items()) == value
    assert zeros > 5


def test_oracle_sign_is_antisymmetric_on_coincident_points():
    coordinates = [(1, 2, 3)] * 4
    base = naive.perturbed_sign(coordinates, (0, 1, 2, 3))
    for order in naive.permutations(range(4)):
        assert naive.perturbed_sign(coordinates, order) == base * naive.parity(order)


def test_oracle_integer_coordinates_are_exact():
    values = np.array([[0.1, -1e-300, 5e-324], [1e10, 3.0, -0.7]])
    (a, b) = naive.exact_coordinates(values)
    scale = Fraction(a[0]) / Fraction(0.1)
    assert [Fraction(x) / scale for x in (*a, *b)] == [Fraction(float(x)) for x in values.ravel()]


def test_scenes_contain_what_they_claim():
    loops = {name: len(naive.loop_vertices(exact_scene(name))) for name in meshes.EVERY}
    zeros = {name: exact_scene(name).zeros for name in meshes.EVERY}
    degrees = {name: max(map(len, exact_scene(name).incident.values())) for name in meshes.EVERY}
    undecided = {name: sum(t is None for t in exact_scene(name).parameters) for name in meshes.EVERY}
    for name in meshes.EVERY:
        # a coplanar sheet on top of another is moved off it as a whole unless its ids are mixed
        expect_none = name.startswith("coplanar_sheets") and not name.endswith("shuffled")
        assert (len(exact_scene(name).hits) > 0) != expect_none, name
    for name in meshes.DEGENERATE:
        assert zeros[name] > 100, name
    for kind in ("overfolded_sheet", "crumple", "spiky", "tangle", "lattice_tangle", "single_hit", "flat_fan"):
        assert all(loops[name] > 0 for name in meshes.EVERY if name.startswith(kind)), kind
    for kind in ("crossing_sheets", "many_sheets", "soup"):
        assert all(loops[name] == 0 for name in meshes.EVERY if name.startswith(kind)), kind
    for name in meshes.EVERY:
        if name.startswith("seam_of_three"):
            exact = exact_scene(name)
            assert degrees[name] == 3
            assert any(len(exact.incident[e0, e1]) == 3 for e0, e1, _ in exact.hits)
    assert all(undecided[name] > 0 for name in meshes.DEGENERATE if "flat_tangle" in name or "one_point" in name)
    assert all(undecided[name] == 0 for name in meshes.GENERAL)
    assert all(exact_scene(name).skipped_faces > 5 for name in meshes.SPECIAL if name.startswith("partly_folded"))
    assert any(zeros[name] > 0 for name in meshes.SPECIAL if name.startswith("nearly_flat"))
    vertices, _ = meshes.DEGENERATE["lattice_tangle-tiny-0"]()
    assert len(np.unique(vertices, axis=0)) < len(vertices)
    vertices, faces = meshes.DEGENERATE["zero_area_faces-0"]()
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert (np.linalg.norm(np.cross(b - a, c - a), axis=1) == 0).sum() > 5


@pytest.mark.parametrize("name", meshes.EVERY)
def test_oracle_keeps_the_invariants(name):
    assert naive.broken_pairs(exact_scene(name)) == []


# Where features touch exactly (turned_lattice-0, far_lattice) a library without perturbation may well differ.
NOT_TOUCHING = [name for name in meshes.SPECIAL if name != "turned_lattice-0" and not name.startswith("far_lattice")]


@pytest.mark.parametrize("name", [*meshes.GENERAL, *NOT_TOUCHING])
def test_oracle_agrees_with_exact_library(name):
    assert igl_pairs(*meshes.EVERY[name]()) == list(exact_scene(name).pairs)


def igl_pairs(vertices, faces) -> list[tuple[int, int]]:
    """Intersecting face pairs by CGAL's exact predicates, sorted."""
    cgal = pytest.importorskip("igl.copyleft.cgal")
    found = cgal.remesh_self_intersections(
        np.ascontiguousarray(vertices), np.ascontiguousarray(faces, dtype=np.int64), detect_only=True
    )[2]
    return sorted(rows(np.sort(found, axis=1)))


# ---------------------------------------------------------------------------------------------------------------
# against exact arithmetic


@pytest.mark.parametrize("name", meshes.EVERY)
def test_hits_pairs_and_contours_equal_exact(name):
    assert_equals_exact(cg.intersections(*meshes.EVERY[name]()), exact_scene(name))


@pytest.mark.parametrize("seed", range(60))
def test_random_small_meshes_equal_exact(seed):
    rng = np.random.default_rng(seed)
    vertex_count, face_count = int(rng.integers(6, 16)), int(rng.integers(8, 36))
    makers = (meshes.tangle, meshes.lattice_tangle, meshes.flat_tangle, meshes.on_a_line)
    vertices, faces = makers[seed % 4](vertex_count, face_count, seed)
    if seed % 8 >= 4:
        vertices = vertices @ meshes.rotation(seed).T * 0.1 + 0.3
    exact = naive.exact_intersections(vertices, faces)
    assert len(exact.hits) > 0
    assert_equals_exact(cg.intersections(vertices, faces), exact)


@pytest.mark.parametrize("name", meshes.EVERY)
def test_pairs_have_two_hits_or_one_with_a_shared_vertex(name):
    vertices, faces = meshes.EVERY[name]()
    hits = cg.intersections(vertices, faces)
    counts = pair_counts(hits, faces)
    assert sorted(counts) == rows(hits.pairs)
    for (a, b), count in counts.items():
        shared = len(set(faces[a].tolist()) & set(faces[b].tolist()))
        assert (shared, count) in ((0, 2), (1, 1)), (a, b)
    for e0, e1, face in rows(hits.edge_triangle):
        assert e0 < e1
        assert not {e0, e1} & set(faces[face].tolist())


@pytest.mark.parametrize("power", [-400, -300, -60, 60, 200, 350])
@pytest.mark.parametrize("name", ["crumple-0", "lattice_cross-0-0-0-shuffled", "turned_lattice-1", "nearly_flat-1e-16"])
def test_scaling_by_a_power_of_two_changes_no_hit(name, power):
    vertices, faces = meshes.EVERY[name]()
    assert rows(cg.intersections(vertices * 2.0**power, faces).edge_triangle) == exact_scene(name).hits


def test_coordinates_that_underflow_are_decided_exactly():
    vertices, faces = meshes.coplanar_sheets((0.5, 0.25))
    vertices[:, 1] = np.random.default_rng(0).integers(-2, 3, len(vertices)) * 5e-324
    exact = naive.exact_intersections(vertices, faces)
    assert len(exact.hits) > 0
    assert rows(cg.intersections(vertices, faces).edge_triangle) == exact.hits


@pytest.mark.parametrize("name", meshes.EVERY)
def test_points_and_segments(name):
    exact = exact_scene(name)
    hits = cg.intersections(exact.vertices, exact.faces)
    points, segments = np.asarray(hits.points), np.asarray(hits.segments)
    assert points.shape == (len(exact.hits), 3)
    assert segments.shape == (len(exact.pairs), 2, 3)
    assert np.isfinite(points).all()
    assert np.isfinite(segments).all()

    tolerance = naive.point_tolerances(exact)
    decided = np.isfinite(tolerance)
    gap = np.linalg.norm(points - naive.exact_points(exact), axis=1)
    assert (gap[decided] <= tolerance[decided]).all(), (gap[decided] / tolerance[decided]).max()
    for point, (e0, e1, _) in zip(points, exact.hits):
        start, end = exact.vertices[e0], exact.vertices[e1]
        slack = 4 * ROUND_OFF * max(np.abs(start).max(), np.abs(end).max())
        assert (point >= np.minimum(start, end) - slack).all()
        assert (point <= np.maximum(start, end) + slack).all()

    for segment, (pair, ends) in zip(segments, exact.pairs.items()):
        expected = [points[hit].tolist() for hit in ends]
        expected += [exact.vertices[v].tolist() for v in naive.shared_vertices(exact, pair)]
        assert sorted(segment.tolist()) == sorted(expected)
    lengths = np.linalg.norm(segments[:, 0] - segments[:, 1], axis=1)
    assert hits.length == pytest.approx(lengths.sum(), rel=1e-13, abs=1e-300)


@pytest.mark.parametrize("name", [*meshes.GENERAL, "repeated_faces-0", "repeated_faces-1", "partly_folded_faces-0"])
def test_length_equals_rational_length(name):
    exact = exact_scene(name)
    hits = cg.intersections(exact.vertices, exact.faces)
    expected = naive.exact_segment_lengths(exact)
    tolerance = naive.point_tolerances(exact)
    allowed = np.array([tolerance[list(ends)].sum() for ends in exact.pairs.values()]) + 1e-15
    lengths = np.linalg.norm(np.subtract(hits.segments[:, 0], hits.segments[:, 1]), axis=1)
    assert (np.abs(lengths - expected) <= allowed).all()
    assert hits.length > 0
    assert hits.length == pytest.approx(math.fsum(expected), rel=1e-12)


@pytest.mark.parametrize("name", [name for name in meshes.DEGENERATE if name.startswith("lattice_cross")])
def test_length_of_lattice_sheets(name):
    exact = exact_scene(name)
    expected = naive.exact_segment_lengths(exact)
    segments = np.asarray(cg.intersections(exact.vertices, exact.faces).segments)
    lengths = np.linalg.norm(segments[:, 0] - segments[:, 1], axis=1)
    decided = np.isfinite(expected)
    assert decided.sum() > len(expected) / 3
    assert np.allclose(lengths[decided], expected[decided], rtol=1e-12, atol=1e-14)
    if decided.all() and not name.endswith("-shuffled"):
        first, second = exact.vertices[:16, 0], exact.vertices[16:, 0]
        overlap = min(first.max(), second.max()) - max(first.min(), second.min())
        assert lengths.sum() == pytest.approx(overlap, rel=1e-12)


# ---------------------------------------------------------------------------------------------------------------
# contours


@pytest.mark.parametrize("name", [name for name in meshes.GENERAL if not name.startswith(("soup", "tangle"))])
def test_contour_list_sums_up_its_segments(name):
    exact = exact_scene(name)
    hits = cg.intersections(exact.vertices, exact.faces)
    label, closed = naive.exact_contours(exact), naive.contour_is_closed(exact)
    assert len(hits.contours) == len(closed) > 0
    lengths = np.linalg.norm(np.subtract(hits.segments[:, 0], hits.segments[:, 1]), axis=1)
    for number, contour in enumerate(hits.contours):
        assert contour.closed == closed[number]
        assert contour.hit_count == label.count(number)
        assert contour.length == pytest.approx(lengths[np.asarray(hits.contour) == number].sum(), rel=1e-12)
    assert sum(contour.length for contour in hits.contours) == pytest.approx(hits.length, rel=1e-12)


@pytest.mark.parametrize(
    ("make", "kind", "closed", "self_contour"),
    [
        pytest.param(lambda: meshes.pyramid_poke(0.23), "closed", True, False, id="pyramid"),
        pytest.param(lambda: meshes.poked_sphere(2, 0.13), "closed", True, False, id="sphere"),
        pytest.param(lambda: meshes.strip_through_plane(0.3, 0.35), "bbii", False, False, id="strip"),
        pytest.param(lambda: meshes.crossed_squares(0.3123), "bibi", False, False, id="half-overlap"),
        pytest.param(lambda: meshes.overfolded_sheet(5, 0), "bli", False, True, id="overfolded"),
    ],
)
def test_contour_kind(make, kind, closed, self_contour):
    (contour,) = cg.intersections(*make()).contours
    assert contour.kind.lower() == kind
    assert contour.closed is closed
    assert contour.self_contour is self_contour


# ---------------------------------------------------------------------------------------------------------------
# closed forms


@pytest.mark.parametrize("offset", [-0.6123, -0.2345, 0.1234, 0.7071])
def test_length_of_crossed_squares_is_one_minus_the_offset(offset):
    assert cg.intersections(*meshes.crossed_squares(offset)).length == pytest.approx(1 - abs(offset), rel=1e-12)


@pytest.mark.parametrize("lean", [0.0, 0.2, -0.35, 0.6])
@pytest.mark.parametrize("cells", [1, 4])
def test_length_of_a_strip_through_a_plane(lean, cells):
    length = cg.intersections(*meshes.strip_through_plane(0.3, lean, cells)).length
    assert length == pytest.approx(0.3 / math.cos(lean), rel=1e-12)


@pytest.mark.parametrize("depth", [1e-6, 0.05, 0.1, 0.2, 0.4, 0.8])
def test_length_of_a_pyramid_poke_is_linear_in_depth(depth):
    hits = cg.intersections(*meshes.pyramid_poke(depth, half_width=0.5, height=1.0))
    assert hits.length == pytest.approx(8 * 0.5 * depth, rel=1e-9)
    assert len(hits.contours) == 1


def test_length_of_a_poked_sphere_converges_to_its_circle():
    depth = 0.3
    circle = 2 * math.pi * math.sqrt(2 * depth - depth**2)
    errors = [circle - cg.intersections(*meshes.poked_sphere(n, depth)).length for n in (1, 2, 3, 4)]
    assert all(error > 0 for error in errors)
    ratios = [coarse / fine for coarse, fine in pairwise(errors)]
    assert all(2.5 < ratio < 6.5 for ratio in ratios), ratios
    assert errors[-1] < 0.005 * circle


# ---------------------------------------------------------------------------------------------------------------
# invariance


@pytest.mark.parametrize("name", meshes.GENERAL)
def test_relabelling_changes_names_only(name):
    vertices, faces = meshes.GENERAL[name]()
    (new_vertices, new_faces), new_id, old_face = meshes.relabelled((vertices, faces), 3)
    before, after = cg.intersections(vertices, faces), cg.intersections(new_vertices, new_faces)
    new_face = np.argsort(old_face)
    named = [(*sorted((new_id[e0], new_id[e1])), new_face[face]) for e0, e1, face in rows(before.edge_triangle)]
    assert sorted(named) == rows(after.edge_triangle)
    assert sorted(tuple(sorted(new_face[list(pair)].tolist())) for pair in rows(before.pairs)) == rows(after.pairs)
    assert after.length == pytest.approx(before.length, rel=1e-12)
    assert len(after.contours) == len(before.contours)


@pytest.mark.parametrize("name", meshes.GENERAL)
def test_rigid_motion_and_scale(name):
    vertices, faces = meshes.GENERAL[name]()
    before = cg.intersections(vertices, faces)
    matrix, offset = meshes.rotation(9), np.array([0.4, -2.3, 1.1])
    for scale in (1.0, 0.37):
        after = cg.intersections(scale * vertices @ matrix.T + offset, faces)
        assert rows(after.edge_triangle) == rows(before.edge_triangle)
        assert rows(after.pairs) == rows(before.pairs)
        assert np.allclose(after.points, scale * np.asarray(before.points) @ matrix.T + offset, rtol=0, atol=1e-11)
        assert after.length == pytest.approx(scale * before.length, rel=1e-11)


@pytest.mark.parametrize("name", ["lattice_cross-0-0-0", "lattice_tangle-2", "coplanar_sheets-0.5-0-shuffled"])
def test_translation_on_the_lattice_keeps_ties(name):
    vertices, faces = meshes.DEGENERATE[name]()
    offset = np.array([16.0, -8.0, 1024.0])
    before, after = cg.intersections(vertices, faces), cg.intersections(vertices + offset, faces)
    assert rows(after.edge_triangle) == rows(before.edge_triangle)
    assert np.allclose(after.points, np.asarray(before.points) + offset, rtol=0, atol=1e-9)


# ---------------------------------------------------------------------------------------------------------------
# large meshes against packaged libraries


def large_mesh(cells: int, seed: int, sheets: int = 2) -> meshes.Mesh:
    """Crumpled sheets through each other and themselves, 2 * sheets * cells^2 faces."""
    parts = [meshes.crumple(cells, seed + 50 * k) for k in range(sheets)]
    return meshes.merged(*(meshes.moved(part, None, (0.1 * k, 0.05 * k, 0.0)) for k, part in enumerate(parts)))


@pytest.mark.parametrize(("cells", "seed", "sheets"), [(36, 0, 2), (36, 1, 3), (50, 2, 2), (70, 3, 2)])
def test_large_meshes_agree_with_exact_library(cells, seed, sheets):
    vertices, faces = large_mesh(cells, seed, sheets)
    hits = cg.intersections(vertices, faces)
    assert len(faces) >= 5000
    assert len(hits.pairs) > 500
    assert rows(hits.pairs) == igl_pairs(vertices, faces)


@pytest.mark.parametrize("tangled", [True, False])
def test_has_intersections_agrees_with_ipctk(tangled):
    ipctk = pytest.importorskip("ipctk")
    vertices, faces = large_mesh(50, 4) if tangled else meshes.layers(3, 45, 0.05, 1)
    edges = ipctk.edges(np.asfortranarray(faces.astype(np.int32)))
    mesh = ipctk.CollisionMesh(np.asfortranarray(vertices), edges, np.asfortranarray(faces.astype(np.int32)))
    assert len(faces) >= 5000
    assert ipctk.has_intersections(mesh, np.asfortranarray(vertices)) is tangled
    assert (len(cg.intersections(vertices, faces).edge_triangle) > 0) is tangled


def test_scene_of_medium_size_equals_exact():
    vertices, faces = meshes.many_sheets(8, 10, 5)
    exact = naive.exact_intersections(vertices, faces)
    assert len(faces) == 1600
    assert len(exact.hits) > 300
    assert_equals_exact(cg.intersections(vertices, faces), exact)


@pytest.mark.parametrize("name", ["many_sheets", "crumple-1", "seam_of_three-1"])
def test_pairs_too_many_for_one_number_are_sorted_the_same(name, monkeypatch):
    mesh = (meshes.GENERAL | {"many_sheets": lambda: meshes.many_sheets(5, 5, 0)})[name]()
    one, other = cg.intersections(*mesh), cg.intersections(*mesh)
    assert one.hit_count > 5 and one.contour_count > 0
    monkeypatch.setattr("clothgym.detection.intersections._LARGEST", 0)
    for attribute in ("first_hit", "second_hit", "loop_vertex", "pair_faces", "hits_per_pair", "hit_contour"):
        assert (getattr(other, attribute) == getattr(one, attribute)).all()
