"""The exact gradient of the contour length: complex steps, central differences, identities, rigid and shared motion."""

from __future__ import annotations

import meshes
import naive
import networkx as nx
import numpy as np
import pytest

import clothgym as cg

SMALL = [name for name in meshes.GENERAL if name != "poked_sphere"]


def involved_entries(exact: naive.Exact) -> list[tuple[int, int]]:
    """Every coordinate of every vertex that a hit or a loop touches."""
    vertices = {v for e0, e1, face in exact.hits for v in (e0, e1, *exact.faces[face].tolist())}
    return [(v, axis) for v in sorted(vertices | set(naive.loop_vertices(exact))) for axis in range(3)]


def gradient_of(vertices, faces) -> np.ndarray:
    return np.asarray(cg.intersections(vertices, faces).gradient())


def body_meshes() -> meshes.Mesh:
    """A cloth through a closed body: what a scene with fixed vertices hands over."""
    return meshes.merged(meshes.moved(meshes.icosphere(2, 0.4), meshes.rotation(3)), meshes.many_sheets(1, 7, 8))


# ---------------------------------------------------------------------------------------------------------------
# the oracles against each other


@pytest.mark.parametrize("name", meshes.GENERAL)
def test_oracle_formula_equals_complex_step(name):
    vertices, faces = meshes.GENERAL[name]()
    exact, formula = naive.complex_step_gradient(vertices, faces), naive.formula_gradient(vertices, faces)
    assert np.abs(formula - exact).max() <= 1e-13 * np.abs(exact).max()


@pytest.mark.parametrize("name", ["crossing_sheets-0", "overfolded_sheet-0", "spiky-0", "seam_of_three-0", "tangle-0"])
def test_oracle_complex_step_equals_differences_of_rational_length(name):
    vertices, faces = meshes.GENERAL[name]()
    exact = naive.exact_intersections(vertices, faces)
    entries = involved_entries(exact)
    chosen = [entries[k] for k in np.random.default_rng(0).permutation(len(entries))[:18]]

    def length_and_hits(moved):
        here = naive.exact_intersections(moved, faces)
        return naive.math.fsum(naive.exact_segment_lengths(here)), here.hits

    gradient = naive.complex_step_gradient(vertices, faces)
    slopes = naive.central_differences(length_and_hits, vertices, 2e-7, chosen)
    assert len(slopes) > 14
    for entry, slope in slopes.items():
        assert abs(slope - gradient[entry]) <= 1e-7 * (1 + abs(gradient[entry]))


# ---------------------------------------------------------------------------------------------------------------
# the library


@pytest.mark.parametrize("name", [*meshes.GENERAL, "repeated_faces-0", "repeated_faces-1", "partly_folded_faces-0"])
def test_gradient_equals_complex_step(name):
    vertices, faces = meshes.EVERY[name]()
    expected = naive.complex_step_gradient(vertices, faces)
    gradient = gradient_of(vertices, faces)
    assert gradient.shape == vertices.shape
    assert gradient.dtype == np.float64
    assert np.abs(expected).max() > 0.1
    assert np.abs(gradient - expected).max() <= 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize("name", SMALL)
def test_gradient_equals_central_differences(name):
    vertices, faces = meshes.GENERAL[name]()
    surface = cg.Surface(faces)
    entries = involved_entries(naive.exact_intersections(vertices, faces))

    def length_and_hits(moved):
        hits = cg.intersections(moved, surface)
        return hits.length, np.asarray(hits.edge_triangle).tolist()

    gradient = gradient_of(vertices, faces)
    slopes = naive.central_differences(length_and_hits, vertices, 2e-7, entries)
    assert len(slopes) >= 0.95 * len(entries)
    for entry, slope in slopes.items():
        assert abs(slope - gradient[entry]) <= 1e-6 * (1 + abs(gradient[entry])), entry


@pytest.mark.parametrize("kind", ["overfolded_sheet", "crumple", "spiky", "tangle", "single_hit"])
def test_differences_above_cover_loop_vertices(kind):
    for name in SMALL:
        if name.startswith(kind):
            exact = naive.exact_intersections(*meshes.GENERAL[name]())
            loops = naive.loop_vertices(exact)
            assert loops
            # the loop term is no rounding matter: without it the gradient is wrong by a unit vector per loop
            frames = naive.hit_frames(exact)
            assert all(
                np.linalg.norm(frames[hits[0]].point - exact.vertices[v]) > 1e-6
                for pair, hits in exact.pairs.items()
                for v in naive.shared_vertices(exact, pair)
            )


def test_gradient_of_cloth_through_a_body():
    vertices, faces = body_meshes()
    expected = naive.complex_step_gradient(vertices, faces)
    assert naive.exact_length(vertices, faces) > 1
    assert np.abs(gradient_of(vertices, faces) - expected).max() <= 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize("angle", [1e-2, 1e-4, 1e-6, 1e-9])
def test_gradient_of_grazing_sheets(angle):
    """The flatter the angle the faster the contour moves: |g| ~ 1 / angle, and still exact."""
    vertices, faces = meshes.grazing_sheets(angle)
    hits = cg.intersections(vertices, faces)
    expected = naive.complex_step_gradient(vertices, faces)
    assert len(hits.edge_triangle) == 13
    assert np.abs(expected).max() > 0.1 / angle
    assert np.abs(np.asarray(hits.gradient()) - expected).max() <= 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize("name", meshes.GENERAL)
def test_vertices_away_from_hits_have_no_gradient(name):
    vertices, faces = meshes.GENERAL[name]()
    touched = {v for v, _ in involved_entries(naive.exact_intersections(vertices, faces))}
    untouched = [v for v in range(len(vertices)) if v not in touched]
    assert not gradient_of(vertices, faces)[untouched].any()


@pytest.mark.parametrize("name", meshes.GENERAL)
def test_sums_and_euler_identity(name):
    vertices, faces = meshes.GENERAL[name]()
    hits = cg.intersections(vertices, faces)
    gradient = np.asarray(hits.gradient())
    size = np.abs(gradient).sum()
    assert np.abs(gradient.sum(axis=0)).max() <= 1e-13 * size
    assert np.abs(np.cross(vertices, gradient).sum(axis=0)).max() <= 1e-13 * size * np.abs(vertices).max()
    assert abs((vertices * gradient).sum() - hits.length) <= 1e-13 * size * np.abs(vertices).max()


@pytest.mark.parametrize("name", ["crossing_sheets-1", "crumple-2", "seam_of_three-1", "tangle-2"])
def test_gradient_turns_with_the_mesh_and_keeps_its_size_under_scale(name):
    vertices, faces = meshes.GENERAL[name]()
    gradient, matrix = gradient_of(vertices, faces), meshes.rotation(4)
    turned = gradient_of(3.0 * vertices @ matrix.T + [0.3, 0.1, -0.2], faces)
    assert np.abs(turned - gradient @ matrix.T).max() <= 1e-10 * np.abs(gradient).max()


@pytest.mark.parametrize("name", ["crossing_sheets-1", "crumple-2", "seam_of_three-1", "tangle-2"])
def test_gradient_follows_relabelling(name):
    vertices, faces = meshes.GENERAL[name]()
    (new_vertices, new_faces), new_id, _ = meshes.relabelled((vertices, faces), 6)
    gradient = gradient_of(vertices, faces)
    assert np.abs(gradient_of(new_vertices, new_faces)[new_id] - gradient).max() <= 1e-11 * np.abs(gradient).max()


@pytest.mark.parametrize("name", [*meshes.DEGENERATE, *meshes.SPECIAL])
def test_gradient_is_finite_on_any_input(name):
    vertices, faces = meshes.EVERY[name]()
    assert np.isfinite(gradient_of(vertices, faces)).all()


# ---------------------------------------------------------------------------------------------------------------
# rigid motion of one side, and the split of a relative motion


@pytest.mark.parametrize("seed", range(4))
def test_half_the_sum_of_equation_4_is_the_gradient_over_one_side(seed):
    vertices, faces = meshes.crossing_sheets(5, seed)
    exact = naive.exact_intersections(vertices, faces)
    parts = list(nx.connected_components(nx.Graph(list(exact.incident))))
    assert len(parts) == 2
    total = np.zeros(3)
    for frame in naive.hit_frames(exact):
        total += (1.0 if frame.edge[0] in parts[0] else -1.0) * frame.gradient_vector
    gradient = gradient_of(vertices, faces)
    one_side = gradient[sorted(parts[0])].sum(axis=0)
    assert np.abs(one_side).max() > 0.01
    assert np.abs(one_side + total / 2).max() <= 1e-9 * np.abs(one_side).max()
    assert np.abs(one_side + gradient[sorted(parts[1])].sum(axis=0)).max() <= 1e-12


@pytest.mark.parametrize("alpha", [0.0, 0.25, 0.5, 1.0])
@pytest.mark.parametrize("direction", range(3))
def test_split_of_a_relative_displacement(alpha, direction):
    """One hit: the edge moves by alpha D, the triangle by -(1 - alpha) D; then dL = -(alpha S - kappa N).D + loop."""
    vertices, faces = meshes.single_hit()
    exact = naive.exact_intersections(vertices, faces)
    (frame,) = naive.hit_frames(exact)
    (loop,) = naive.loop_vertices(exact)
    assert frame.edge == (1, 2)
    assert loop == 0
    displacement = np.eye(3)[direction]
    velocity = np.zeros_like(vertices)
    velocity[[1, 2]] = alpha * displacement
    velocity[[0, 3, 4]] = -(1 - alpha) * displacement

    away = (frame.point - vertices[loop]) / np.linalg.norm(frame.point - vertices[loop])
    hit_term = -(alpha * frame.s - frame.kappa * frame.normal) @ displacement
    expected = hit_term - away @ velocity[loop]
    if alpha == 0.5:
        assert hit_term == pytest.approx(-frame.gradient_vector @ displacement / 2, abs=1e-14)
    assert (gradient_of(vertices, faces) * velocity).sum() == pytest.approx(expected, abs=1e-13)
    step = 1e-6
    ahead, behind = (cg.intersections(vertices + s * velocity, faces).length for s in (step, -step))
    assert (ahead - behind) / (2 * step) == pytest.approx(expected, abs=1e-8)


# ---------------------------------------------------------------------------------------------------------------
# known slopes


def test_half_overlapping_squares_shorten_one_to_one():
    vertices, faces = meshes.crossed_squares(0.3123)
    gradient = gradient_of(vertices, faces)
    assert gradient[36:, 0].sum() == pytest.approx(-1.0, abs=1e-12)
    assert gradient[:36, 0].sum() == pytest.approx(1.0, abs=1e-12)


def test_strip_through_a_plane_has_no_slope_along_itself():
    vertices, faces = meshes.strip_through_plane(0.3, 0.0)
    strip = np.arange(5 * 21)
    gradient = gradient_of(vertices, faces)
    assert np.abs(gradient[strip]).max() > 0.1
    assert np.abs(gradient[strip].sum(axis=0)).max() <= 1e-12


@pytest.mark.parametrize("depth", [0.05, 0.4])
def test_pyramid_poke_has_the_slope_of_its_flanks(depth):
    vertices, faces = meshes.pyramid_poke(depth, half_width=0.5, height=1.0)
    down = -gradient_of(vertices, faces)[:5, 1].sum()
    assert down == pytest.approx(8 * 0.5, rel=1e-9)


def test_a_step_against_the_gradient_shortens_the_contour():
    vertices, faces = meshes.many_sheets(4, 4, 1)
    hits = cg.intersections(vertices, faces)
    gradient = np.asarray(hits.gradient())
    step = 1e-5
    shorter = cg.intersections(vertices - step * gradient, faces).length
    assert hits.length - shorter == pytest.approx(step * (gradient**2).sum(), rel=1e-2)
