"""What `intersections` takes and gives: kinds of meshes and arrays, empty results, and bad input by name."""

from __future__ import annotations

import meshes
import naive
import numpy as np
import pytest
import trimesh
from intersection_cases import exact_scene, rows

import clothgym as cg


def test_surface_and_trimesh_stand_for_faces():
    vertices, faces = meshes.crumple(8, 0)
    expected = cg.intersections(vertices, faces)
    surface = cg.Surface(faces)
    assert rows(cg.intersections(vertices, surface).edge_triangle) == rows(expected.edge_triangle)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert rows(cg.intersections(mesh).edge_triangle) == rows(expected.edge_triangle)
    # reused while the vertices move
    moving, _ = meshes.crumple(8, 1)
    assert rows(cg.intersections(moving, surface).edge_triangle) == naive.exact_hits(moving, faces)
    assert rows(cg.intersections(vertices, surface).edge_triangle) == rows(expected.edge_triangle)


@pytest.mark.parametrize("dtype", [np.int32, np.int64, np.uint32, list])
def test_face_types(dtype):
    vertices, faces = meshes.crossing_sheets(5, 0)
    given = faces.tolist() if dtype is list else faces.astype(dtype)
    assert rows(cg.intersections(vertices, given).edge_triangle) == exact_scene("crossing_sheets-0").hits


def test_float32_vertices_are_taken_as_they_are():
    vertices, faces = meshes.crumple(8, 0)
    single = vertices.astype(np.float32)
    hits = cg.intersections(single, faces)
    assert rows(hits.edge_triangle) == naive.exact_hits(single.astype(np.float64), faces)
    assert np.asarray(hits.points).dtype == np.float64


def test_strided_input_is_neither_changed_nor_misread():
    vertices, faces = meshes.crumple(8, 0)
    wide = np.zeros((len(vertices), 6))
    wide[:, ::2] = vertices
    kept, kept_faces = wide.copy(), faces.copy()
    hits = cg.intersections(wide[:, ::2], np.asfortranarray(faces))
    assert rows(hits.edge_triangle) == exact_scene("crumple-0").hits
    hits.gradient()
    assert np.array_equal(wide, kept)
    assert np.array_equal(faces, kept_faces)


def test_same_input_same_bits():
    vertices, faces = meshes.crumple(8, 1)
    first, second = cg.intersections(vertices, faces), cg.intersections(vertices, faces)
    assert first.length == second.length
    assert np.array_equal(first.points, second.points)
    assert np.array_equal(first.gradient(), second.gradient())


@pytest.mark.parametrize(
    ("vertices", "faces"),
    [
        pytest.param(*meshes.grid(4, 4), id="flat sheet"),
        pytest.param(np.zeros((0, 3)), np.zeros((0, 3), dtype=int), id="nothing"),
        pytest.param(np.ones((5, 3)), np.zeros((0, 3), dtype=int), id="no faces"),
        pytest.param(np.eye(3), np.array([[0, 1, 2]]), id="one face"),
        pytest.param(np.eye(3), np.array([[0, 1, 2], [1, 2, 0], [0, 2, 1]]), id="one face three times"),
    ],
)
def test_no_hits_give_empty_arrays_of_the_right_shape(vertices, faces):
    hits = cg.intersections(vertices, faces)
    assert hits.length == 0
    assert np.shape(hits.edge_triangle) == np.shape(hits.points) == (0, 3)
    assert np.shape(hits.pairs) == (0, 2)
    assert np.shape(hits.segments) == (0, 2, 3)
    assert np.shape(hits.contour) == np.shape(hits.hit_contour) == (0,)
    assert len(hits.contours) == 0
    assert np.array_equal(hits.gradient(), np.zeros((len(vertices), 3)))


def test_vertices_without_faces_are_no_matter():
    vertices, faces = meshes.crumple(8, 0)
    more = np.concatenate([vertices, np.full((7, 3), 0.5)])
    hits = cg.intersections(more, faces)
    assert rows(hits.edge_triangle) == exact_scene("crumple-0").hits
    assert np.shape(hits.gradient()) == (len(more), 3)


def test_faces_that_repeat_an_id_make_no_edges():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [0.2, -1, 0.3], [0.25, 1, 0.3]])
    hits = cg.intersections(vertices, np.array([[0, 1, 2], [3, 4, 4]]))
    assert len(hits.edge_triangle) == 0
    assert hits.skipped_faces == 1


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_bad_vertex_is_named(value):
    vertices, faces = meshes.grid(3, 3)
    vertices[5, 1] = value
    with pytest.raises(ValueError, match=r"vertices\[5, 1\]"):
        cg.intersections(vertices, faces)


@pytest.mark.parametrize("value", [16, -1, 10**6])
def test_bad_face_is_named(value):
    vertices, faces = meshes.grid(3, 3)
    faces[7, 2] = value
    with pytest.raises(ValueError, match=rf"faces\[7, 2\] is {value}"):
        cg.intersections(vertices, faces)


@pytest.mark.parametrize(
    ("vertices", "faces", "field"),
    [
        (np.zeros((4, 2)), [[0, 1, 2]], "vertices"),
        (np.zeros(12), [[0, 1, 2]], "vertices"),
        (np.zeros((4, 3)), [[0, 1, 2, 3]], "faces"),
        (np.zeros((4, 3)), [0, 1, 2], "faces"),
        (np.zeros((4, 3)), [[0.0, 1.0, 2.0]], "faces"),
    ],
)
def test_wrong_shapes_and_types_are_named(vertices, faces, field):
    with pytest.raises(ValueError, match=field):
        cg.intersections(vertices, np.asarray(faces))
