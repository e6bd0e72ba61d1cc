"""The scene "shells", and the measure that tells whether it was resolved on the right side."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from clothgym import Fidelity, Simulation, Surface, grid, intersections, scenes
from clothgym.detection.sides import Sides, closest_points, side_error, signed_sides
from clothgym.scenes import shells


def _distance(point: np.ndarray, triangle: np.ndarray) -> float:
    """Distance of a point and a triangle: its plane if the foot is inside, else the nearest of the three edges."""
    a, b, c = triangle
    normal = np.cross(b - a, c - a)
    area = normal @ normal
    foot = point - ((point - a) @ normal) / area * normal
    weights = [np.cross(q - p, foot - p) @ normal / area for p, q in ((a, b), (b, c), (c, a))]
    if min(weights) >= 0.0:
        return float(np.linalg.norm(point - foot))
    distances = []
    for p, q in ((a, b), (b, c), (c, a)):
        t = np.clip((point - p) @ (q - p) / ((q - p) @ (q - p)), 0.0, 1.0)
        distances.append(np.linalg.norm(point - p - t * (q - p)))
    return float(min(distances))


def test_distances_agree_with_trying_every_triangle() -> None:
    rng = np.random.default_rng(0)
    sheet = grid(1.0, 1.0, 7, 5)
    x = sheet.vertices + rng.normal(0.0, 0.03, sheet.vertices.shape)
    points = rng.uniform(-0.8, 0.8, (60, 3))
    face, weights, distance = closest_points(points, x, sheet.faces)
    _, again = signed_sides(points, x, sheet.faces)
    naive = [min(_distance(p, x[f]) for f in sheet.faces) for p in points]
    assert np.abs(distance - naive).max() < 1e-12
    assert np.array_equal(distance, again)
    place = np.einsum("pc,pcx->px", weights, x[sheet.faces[face]])
    assert np.abs(np.linalg.norm(points - place, axis=1) - distance).max() < 1e-12
    assert np.abs(weights.sum(axis=1) - 1.0).max() < 1e-12


def test_signs_of_closed_surfaces_agree_with_another_library() -> None:
    igl = pytest.importorskip("igl")
    rng = np.random.default_rng(1)
    # spikes: the plain normal of the closest face would be wrong beside their tips
    shape = trimesh.creation.icosphere(2)
    x = np.asarray(shape.vertices) * np.where(rng.random(len(shape.vertices)) < 0.2, 1.8, 1.0)[:, None]
    points = rng.normal(size=(3000, 3))
    signs, distance = signed_sides(points, x, shape.faces)
    expected = igl.signed_distance(points, x, np.asarray(shape.faces), igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)[0]
    winding = igl.winding_number(x, np.asarray(shape.faces), points)
    assert np.abs(distance - np.abs(expected)).max() < 1e-12
    assert np.array_equal(signs < 0, winding > 0.5)
    assert 0.2 < (signs < 0).mean() < 0.8


def test_points_beside_a_border_are_neutral_and_all_others_have_a_side() -> None:
    sheet = grid(1.0, 1.0, 8, 8)
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-1, 1, 500), rng.uniform(-0.5, 0.5, 500), rng.uniform(-1, 1, 500)])
    signs, distance = signed_sides(points, sheet.vertices, sheet.faces)
    above = np.abs(points[:, [0, 2]]).max(axis=1) < 0.5
    assert np.array_equal(signs[above], np.sign(points[above, 1]))  # the grid's faces look up
    assert np.all(signs[~above] == 0.0)
    assert np.allclose(distance[above], np.abs(points[above, 1]))
    on_it, zero = signed_sides([[0.03, 0.0, 0.01]], sheet.vertices, sheet.faces)
    assert on_it[0] == 0.0
    assert zero[0] == 0.0


def test_sides_do_not_depend_on_numbering_place_or_reused_topology() -> None:
    rng = np.random.default_rng(3)
    sheet = grid(1.0, 1.0, 9, 9)
    x = sheet.vertices + rng.normal(0.0, 0.02, sheet.vertices.shape)
    points = rng.uniform(-0.7, 0.7, (200, 3))
    signs, distance = signed_sides(points, x, sheet.faces)
    order = rng.permutation(len(x))
    rank = np.argsort(order)
    other_faces = rank[sheet.faces][rng.permutation(len(sheet.faces))]
    other_signs, other_distance = signed_sides(points, x[order], other_faces)
    assert np.array_equal(signs, other_signs)
    assert np.abs(distance - other_distance).max() < 1e-15
    assert np.array_equal(signed_sides(points, x, Surface(sheet.faces, len(x)))[0], signs)
    shift = np.array([3.0, -2.0, 1.0])
    assert np.array_equal(signed_sides(points + shift, x + shift, sheet.faces)[0], signs)
    assert np.array_equal(signed_sides(points, x, sheet.faces[:, ::-1])[0], -signs)  # turned over


def test_side_error_counts_wrong_vertices_of_a_stack() -> None:
    sheet = grid(0.4, 0.4, 10, 10)
    count = len(sheet.vertices)
    faces = np.concatenate([sheet.faces, sheet.faces + count])
    lower, upper = slice(0, count), slice(count, 2 * count)
    clean = np.concatenate([sheet.vertices, sheet.vertices + np.array([0.001, 0.02, 0.002])])
    sides = Sides(faces, lower, upper)
    required = sides.signs(clean)
    assert set(required[:count]) == {-1.0, 0.0}  # below, or beside the border
    assert set(required[count:]) == {1.0, 0.0}
    assert sides.error(clean, required) == 0.0
    swapped = clean.copy()
    swapped[upper, 1] = -0.02
    assert sides.error(swapped, required) > 0.95
    pushed = clean.copy()
    centre = 5 * 11 + 5
    pushed[centre, 1] = 0.05  # one vertex through the other sheet; none of the other's comes to its far side
    assert 1 / (2 * count) <= sides.error(pushed, required) < 0.1
    assert side_error(pushed, faces, lower, upper, required) == sides.error(pushed, required)
    assert sides.error(swapped, np.zeros(2 * count)) == 0.0  # nothing asked for
    with pytest.raises(ValueError, match="required: expected 242 signs"):
        sides.error(clean, required[:-1])
    with pytest.raises(ValueError, match="second = slice"):
        Sides(faces[: len(sheet.faces)], lower, upper)
    with pytest.raises(ValueError, match="faces: a surface needs at least one face"):
        signed_sides(clean, clean, np.zeros((0, 3), np.int32))


def test_clean_shells_are_apart_by_the_gap() -> None:
    inner, outer = shells.clean_shells()
    count = len(inner.vertices)
    both = np.concatenate([inner.vertices, outer.vertices])
    assert intersections(both, np.concatenate([inner.faces, outer.faces + count])).hit_count == 0
    signs, distance = signed_sides(inner.vertices, outer.vertices, outer.faces)
    assert not (signs > 0).any()
    assert np.median(distance) == pytest.approx(shells.GAPS[1] - shells.GAPS[0], rel=0.05)
    assert distance.min() > 0.006  # thickness of contact is 4 mm
    assert shells.side_error(both) == 0.0
    assert shells.outside(both) == 0.0
    neck = shells.neck_border(inner)
    assert 10 <= len(neck) <= 30
    assert inner.vertices[list(neck), 1].min() > np.quantile(inner.vertices[:, 1], 0.9)


def test_shells_start_with_closed_and_open_contours_that_grow_with_the_push() -> None:
    lengths = []
    for push in (0.0, 0.03, 0.06):
        scene = scenes.make("shells", push=push, seed=1)
        found = intersections(scene.start, Simulation(scene, Fidelity(untangling="none")).faces)
        kinds = [contour.kind for contour in found.contours]
        lengths.append(found.length)
        error = shells.side_error(scene.start)
        assert (error > 0.0) == (push > 0.0)
        if push:
            assert kinds.count("Closed") == 2
            assert len(kinds) == 3  # the one over the hem is open
            assert shells.outside(scene.start) > 0.02
    assert lengths[0] == 0.0 < lengths[1] < lengths[2]
    assert scenes.make("shells", seed=2) != scenes.make("shells", seed=3)
    assert scenes.make("shells", seed=2) == scenes.make("shells", seed=2)


def test_shells_stay_tangled_by_themselves_and_hybrid_brings_them_back_on_the_right_side() -> None:
    scene = scenes.make("shells")
    idle = Simulation(scene, Fidelity(untangling="none"))
    before = idle.metrics()
    idle.step(5)
    assert idle.metrics()["hits"] == before["hits"] > 100
    assert shells.side_error(idle.positions) > 0.03
    sim = Simulation(scene, Fidelity(untangling="hybrid"))
    sim.step(20)
    after = sim.metrics()
    assert after["hits"] == 0
    assert shells.side_error(sim.positions) == 0.0
    assert shells.outside(sim.positions) == 0.0
    assert after["max_strain"] < 0.15
    pins = list(scene.cloths[0].pins)
    assert np.array_equal(sim.positions[pins], scene.start[pins])
    sim.step(10)
    assert sim.metrics()["hits"] == 0
