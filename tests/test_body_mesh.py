"""Exact signed distance to closed meshes, against another library and against trying every triangle."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from clothgym import Surface, rig
from clothgym.detection.body_mesh import BodyMesh


def _spiky(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A sphere with spikes: beside their tips the plain normal of the closest face has the wrong sign."""
    rng = np.random.default_rng(seed)
    shape = trimesh.creation.icosphere(2)
    return np.asarray(shape.vertices) * np.where(rng.random(162) < 0.2, 1.8, 1.0)[:, None], np.asarray(shape.faces)


def _everywhere(x: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points near and far, deep inside, and moved off vertices, edges and faces along no special direction."""
    size = np.ptp(x, axis=0).max()
    centre = x.mean(axis=0)
    chosen = x[faces[rng.integers(0, len(faces), 300)]]
    edges = 0.5 * (chosen[:, 0] + chosen[:, 1])
    on = np.concatenate([chosen[:, 0], edges, np.einsum("pc,pcx->px", rng.dirichlet([1, 1, 1], 300), chosen)])
    return np.concatenate(
        [
            on + rng.normal(0, 0.005 * size, on.shape),
            on + rng.normal(0, 1e-9 * size, on.shape),
            centre + rng.normal(0, 0.5 * size, (300, 3)),
            centre + rng.normal(0, 0.02 * size, (50, 3)),
            centre + rng.normal(0, 50.0 * size, (50, 3)),
        ]
    )


def _closest(p: np.ndarray, x: np.ndarray, faces: np.ndarray) -> float:
    """Distance of a point to every triangle: planes where the foot is inside, else segments."""
    a, b, c = (x[faces[:, n]] for n in range(3))
    n = np.cross(b - a, c - a)
    nn = (n * n).sum(axis=1)
    along = ((p - a) * n).sum(axis=1)
    foot = p - (along / nn)[:, None] * n
    inside = np.ones(len(faces), bool)
    least = np.inf
    for s, t in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(t - s, foot - s) * n).sum(axis=1) >= 0.0
        share = np.clip(((p - s) * (t - s)).sum(axis=1) / ((t - s) ** 2).sum(axis=1), 0.0, 1.0)
        least = min(least, float(np.linalg.norm(p - s - share[:, None] * (t - s), axis=1).min()))
    if inside.any():
        least = min(least, float((np.abs(along) / np.sqrt(nn))[inside].min()))
    return least


def test_distances_agree_with_every_triangle_and_signs_with_winding_numbers() -> None:
    igl = pytest.importorskip("igl")
    for seed in range(3):
        x, faces = _spiky(seed)
        points = _everywhere(x, faces, np.random.default_rng(seed))
        found = BodyMesh(x, faces).signed_distance(points)
        naive = np.array([_closest(p, x, faces) for p in points])
        assert np.abs(np.abs(found) - naive).max() < 1e-12 * np.abs(points).max()
        away = np.abs(found) > 1e-12
        inside = igl.winding_number(x, faces, points) > 0.5
        assert np.array_equal((found < 0)[away], inside[away])
        assert 100 < inside[away].sum() < away.sum() - 100


def test_distances_to_a_body_agree_with_another_library() -> None:
    igl = pytest.importorskip("igl")
    body = rig.load("female")
    x = body.posed("walk:0.25")
    points = _everywhere(x, body.faces, np.random.default_rng(0))
    expected = igl.signed_distance(points, x, body.faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)[0]
    true = BodyMesh(x, body.faces)
    found = true.signed_distance(points)
    assert np.abs(np.abs(found) - np.abs(expected)).max() < 1e-12 * np.abs(points).max()
    away = np.abs(found) > 1e-12
    assert np.array_equal(found[away] < 0, expected[away] < 0)
    inside = igl.winding_number(x, body.faces, points) > 0.5
    assert ((found < 0) != inside)[away].mean() < 2e-3  # the skin passes through itself at the toes
    assert np.array_equal(true.depth(points), np.maximum(-found, 0.0))
    places, ids = true.closest(points)
    assert np.abs(np.linalg.norm(points - places, axis=1) - np.abs(found)).max() < 1e-12 * np.abs(points).max()
    for p, f in zip(places[:200], ids[:200]):
        assert _closest(p, x, body.faces[f : f + 1]) < 1e-12


def test_points_on_vertices_edges_and_faces_are_at_distance_zero() -> None:
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    true = BodyMesh(box.vertices, box.faces)
    x = np.asarray(box.vertices)[box.faces]
    on = np.concatenate([x[:, 0], 0.5 * (x[:, 0] + x[:, 1]), x.mean(axis=1)])
    assert np.abs(true.signed_distance(on)).max() < 1e-15
    assert true.signed_distance([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.5, 1.0, 1.7], [3.5, 5.0, 1.5]]) == pytest.approx(
        [-0.5, -0.1, 0.2, 5.0]
    )


def test_answers_do_not_depend_on_neighbours_in_the_list() -> None:
    x, faces = _spiky(4)
    true = BodyMesh(x, faces)
    rng = np.random.default_rng(5)
    points = np.concatenate([_everywhere(x, faces, rng), x])  # exact ties at the vertices
    distance, (_, face) = true.signed_distance(points), true.closest(points)
    order = rng.permutation(len(points))
    assert np.array_equal(true.signed_distance(points[order]), distance[order])
    assert np.array_equal(true.closest(points[order])[1], face[order])


def test_a_moved_surface_answers_as_one_built_anew() -> None:
    body = rig.load("male")
    surface = Surface(body.faces, len(body.vertices))
    true = BodyMesh(body.vertices, surface)
    x = body.posed("arms_down")
    true.move(x)
    points = _everywhere(x, body.faces, np.random.default_rng(6))
    assert np.array_equal(true.signed_distance(points), BodyMesh(x, surface).signed_distance(points))


def test_penetration_samples_every_triangle_evenly() -> None:
    ball = trimesh.creation.icosphere(3, radius=0.5)
    true = BodyMesh(ball.vertices, ball.faces)
    rng = np.random.default_rng(7)
    x = rng.uniform(-1.0, 1.0, (60, 3))
    faces = rng.permutation(60).reshape(-1, 3)
    depths = true.penetration(x, faces)
    assert depths.shape == (20 * 45,)
    weights = np.array([(8 - j - k, j, k) for j in range(9) for k in range(9 - j)]) / 8
    points = np.einsum("sc,fcx->fsx", weights, x[faces]).reshape(-1, 3)
    assert np.abs(depths - true.depth(points)).max() < 1e-15
    assert (depths > 0).sum() > 20
    assert true.penetration(x, faces, samples=3).reshape(20, 3).max() == true.depth(x).max()
    shell = np.asarray(ball.vertices) * 1.01
    assert true.penetration(shell, ball.faces).max() == 0.0
    # corners outside, middle inside: only samples within the triangle see it
    through = np.array([[-1.0, 0.4, -1.0], [1.0, 0.4, -1.0], [0.0, 0.4, 1.2]])
    assert true.penetration(through, [[0, 1, 2]], samples=3).max() == 0.0
    assert true.penetration(through, [[0, 1, 2]]).max() == pytest.approx(0.1, abs=0.02)


def test_bad_input_is_named() -> None:
    box = trimesh.creation.box()
    true = BodyMesh(box.vertices, box.faces)
    with pytest.raises(ValueError, match="samples = 44: expected 3, 6"):
        true.penetration(box.vertices, box.faces, samples=44)
    with pytest.raises(ValueError, match="needs at least one face"):
        BodyMesh(box.vertices, [[0, 0, 1]])
    with pytest.raises(ValueError, match=r"points.*is nan"):
        true.depth([[0.0, np.nan, 0.0]])
    with pytest.raises(ValueError, match="expected 8 rows"):
        true.move(np.zeros((7, 3)))
    assert true.signed_distance(np.zeros((0, 3))).shape == (0,)


def test_faces_without_area_do_not_disturb() -> None:
    box = trimesh.creation.box()
    x = np.asarray(box.vertices)
    faces = np.concatenate([[[0, 0, 1]], box.faces])
    points = _everywhere(x, np.asarray(box.faces), np.random.default_rng(8))
    true = BodyMesh(x, faces)
    assert np.array_equal(true.signed_distance(points), BodyMesh(x, box.faces).signed_distance(points))
    assert np.array_equal(true.closest(points)[1], BodyMesh(x, box.faces).closest(points)[1] + 1)
