"""What is read off a rest shape: per vertex and per corner, seams, and bent pairs."""

from __future__ import annotations

import math

import numpy as np
import pytest

import clothgym as cg
from clothgym import materials
from clothgym.mesh import Mesh, Surface
from clothgym.model import FLEXION, STRUCTURAL, ClothModel
from clothgym.rest import RestShape


def flat(cells=5, jitter=0.2, seed=0):
    """A level sheet of uneven triangles."""
    mesh = cg.grid(1.0, 0.7, cells, cells)
    rng = np.random.default_rng(seed)
    spread = np.ptp(mesh.vertices, axis=0)
    vertices = mesh.vertices + jitter / cells * rng.uniform(-0.5, 0.5, mesh.vertices.shape) * (spread > 0)
    return Mesh(np.ascontiguousarray(vertices), mesh.faces)


def naive_areas(corners):
    return np.array([0.5 * np.linalg.norm(np.cross(b - a, c - a)) for a, b, c in corners])


def turn(angle):
    return np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])


def test_corners_of_a_flat_sheet_say_the_same_as_its_vertices():
    mesh = flat()
    surface = Surface(mesh.faces, len(mesh.vertices))
    one, two = RestShape(mesh, mesh.vertices), RestShape(mesh, mesh.vertices[mesh.faces])
    assert one.face_areas == pytest.approx(two.face_areas, rel=1e-12)
    assert one.vertex_areas == pytest.approx(two.vertex_areas, rel=1e-12)
    assert one.least_altitudes == pytest.approx(two.least_altitudes, rel=1e-12)
    assert one.edge_lengths(surface) == pytest.approx(two.edge_lengths(surface), rel=1e-12)
    pairs, lengths = one.opposite_lengths(surface)
    others, unfolded = two.opposite_lengths(surface)
    assert np.array_equal(pairs, others)
    assert lengths == pytest.approx(unfolded, rel=1e-9)
    naive = set()
    for a, b in surface.edges.tolist():
        tips = [int(v) for f in mesh.faces if a in f and b in f for v in f if v not in (a, b)]
        naive |= {tuple(sorted(tips))} if len(tips) == 2 else set()
    assert {tuple(pair) for pair in pairs.tolist()} == naive


def test_against_plain_loops():
    mesh = flat(4)
    shape, surface = RestShape(mesh, mesh.vertices[mesh.faces]), Surface(mesh.faces, len(mesh.vertices))
    areas = naive_areas(mesh.vertices[mesh.faces])
    assert shape.face_areas == pytest.approx(areas)
    per_vertex, least = np.zeros(len(mesh.vertices)), np.full(len(mesh.vertices), math.inf)
    for face, area in zip(mesh.faces, areas):
        sides = [np.linalg.norm(mesh.vertices[face[k]] - mesh.vertices[face[k - 1]]) for k in range(3)]
        for v in face:
            per_vertex[v] += area / 3.0
            least[v] = min(least[v], 2.0 * area / max(sides))
    assert shape.vertex_areas == pytest.approx(per_vertex)
    assert shape.vertex_areas.sum() == pytest.approx(areas.sum())
    assert shape.least_altitudes == pytest.approx(least)
    for (a, b), length in zip(surface.edges, shape.edge_lengths(surface)):
        assert length == pytest.approx(np.linalg.norm(mesh.vertices[a] - mesh.vertices[b]))


def test_where_each_face_lies_does_not_matter():
    """Corners are of planes of their own: moving and turning each by itself changes nothing."""
    mesh = flat(4)
    surface = Surface(mesh.faces, len(mesh.vertices))
    rng = np.random.default_rng(1)
    corners = mesh.vertices[mesh.faces]
    moved = np.empty_like(corners)
    for f, face in enumerate(corners):
        moved[f] = face @ turn(rng.uniform(0, 6)).T + rng.normal(0, 3, 3)
    one, two = RestShape(mesh, corners), RestShape(mesh, moved)
    assert one.edge_lengths(surface) == pytest.approx(two.edge_lengths(surface), rel=1e-9)
    assert one.opposite_lengths(surface)[1] == pytest.approx(two.opposite_lengths(surface)[1], rel=1e-8)
    assert one.vertex_areas == pytest.approx(two.vertex_areas, rel=1e-9)


PAIR = np.array([[0, 1, 2], [1, 0, 3]], np.int32)  # both have the edge 0-1


def test_a_seam_shares_the_mean_of_both_sides():
    left = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.5, 0.8, 0]])
    right = np.array([[1.2, 0, 0], [0.0, 0, 0], [0.6, -0.5, 0]])  # vertices 1, 0, 3: a seam edge of 1.2
    corners = np.stack([left, right])
    mesh = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0.8, 0], [0.5, -0.5, 0]]), PAIR)
    surface = Surface(PAIR, 4)
    shape = RestShape(mesh, corners)
    lengths = dict(zip(map(tuple, surface.edges.tolist()), shape.edge_lengths(surface)))
    assert lengths[0, 1] == pytest.approx(1.1)
    assert lengths[0, 2] == pytest.approx(math.hypot(0.5, 0.8))
    assert lengths[0, 3] == pytest.approx(math.hypot(0.6, 0.5))
    assert shape.face_areas == pytest.approx([0.4, 0.3])
    pairs, across = shape.opposite_lengths(surface)
    assert pairs.tolist() == [[2, 3]]
    assert across == pytest.approx([1.3]), "both tips stand over the middle of their edge"


@pytest.mark.parametrize("bend", [0.0, 0.7, 2.0, 3.1])
def test_bent_pairs_are_unfolded(bend):
    """Corners per face have no fold between them, however bent the places are; places per vertex keep it."""
    places = np.array([[0.1, 0, 0], [1.0, 0, 0], [0.3, 0.8, 0], [0.7, -0.5 * math.cos(bend), 0.5 * math.sin(bend)]])
    mesh, surface = Mesh(places, PAIR), Surface(PAIR, 4)
    _, unfolded = RestShape(mesh, places[PAIR]).opposite_lengths(surface)
    assert unfolded == pytest.approx([math.hypot(0.4, 1.3)])
    _, straight = RestShape(mesh, places).opposite_lengths(surface)
    assert straight == pytest.approx([np.linalg.norm(places[2] - places[3])])
    assert bend == 0.0 or straight[0] < unfolded[0]


def test_faces_without_area_bound_nothing():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [5, 5, 5]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 2], [2, 1, 0]], np.int32)
    mesh, surface = Mesh(vertices, faces), Surface(faces, 5)
    assert surface.skipped_faces == 1
    for rest in (vertices, vertices[faces]):
        shape = RestShape(mesh, rest)
        assert shape.face_areas == pytest.approx([0.5, 0.0, 0.0, 0.5])
        assert shape.vertex_areas == pytest.approx([1 / 3, 1 / 3, 1 / 3, 0, 0])
        assert shape.least_altitudes[[0, 1, 2]] == pytest.approx(math.sqrt(0.5))
        assert np.isinf(shape.least_altitudes[[3, 4]]).all()
        lengths = dict(zip(map(tuple, surface.edges.tolist()), shape.edge_lengths(surface)))
        assert lengths == pytest.approx({(0, 1): 1, (0, 2): 1, (1, 2): math.sqrt(2), (0, 3): 2, (1, 3): 1})
        pairs, lengths = shape.opposite_lengths(surface)
        # 0-1 has three faces; 0-2 and 1-2 have the same face twice, whose tips are one vertex
        assert len(pairs) == len(lengths) == 0
        assert np.isfinite(lengths).all()


def test_an_empty_surface():
    mesh = Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.int32))
    shape = RestShape(mesh, np.zeros((3, 3)))
    pairs, lengths = shape.opposite_lengths(Surface(mesh.faces, 3))
    assert pairs.shape == (0, 2)
    assert lengths.shape == (0,)
    assert not shape.vertex_areas.any()


def tube(around=12, along=4, girth=1.2, height=0.8):
    """A closed sleeve of two panels and their corners: (mesh in space, (F, 3, 2) flat corners)."""
    radius = girth / (2 * math.pi)
    angles = np.arange(around) * 2 * math.pi / around
    ring = np.stack([radius * np.cos(angles), 0.0 * angles, radius * np.sin(angles)], axis=1)
    vertices = np.concatenate([ring + np.array([0.0, height * k / along, 0.0]) for k in range(along + 1)])
    faces, corners = [], []
    for k in range(along):
        for i in range(around):
            u, w, low, high = girth * i / around, girth * (i + 1) / around, height * k / along, height * (k + 1) / along
            a, b = k * around + i, k * around + (i + 1) % around
            faces += [(a, b, b + around), (a, b + around, a + around)]
            corners += [((u, low), (w, low), (w, high)), ((u, low), (w, high), (u, high))]
    return Mesh(vertices, np.array(faces, np.int32)), np.array(corners)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_sleeve_has_the_lengths_of_its_panels(dimensions):
    mesh, corners = tube()
    if dimensions == 3:
        corners = np.concatenate([corners, np.zeros((*corners.shape[:2], 1))], axis=2)
    scene = cg.Scene([cg.Cloth(mesh, rest=corners)])
    model = ClothModel(scene)
    cell, row = 1.2 / 12, 0.8 / 4
    edges = model.spring_kinds == STRUCTURAL
    lengths = np.unique(model.spring_rest[edges].round(9))
    assert lengths == pytest.approx(sorted([cell, row, math.hypot(cell, row)]))
    ends = np.sort(model.spring_ends[edges], axis=1)  # springs stand in the order of their colours
    assert model.edge_rest == pytest.approx(model.spring_rest[edges][np.lexsort((ends[:, 1], ends[:, 0]))])
    flexion = np.unique(model.spring_rest[model.spring_kinds == FLEXION].round(9))
    assert flexion == pytest.approx(
        sorted([math.hypot(cell, row), math.hypot(2 * cell, row), math.hypot(cell, 2 * row)])
    )
    cotton = materials.get("cotton")
    assert model.masses.sum() == pytest.approx(1.2 * 0.8 * cotton.density)
    assert model.vertex_areas.sum() == pytest.approx(1.2 * 0.8)
    bent = ClothModel(cg.Scene([cg.Cloth(mesh)]))
    assert bent.spring_rest[bent.spring_kinds == STRUCTURAL].min() < cell, "chords of the circle are shorter"
    assert len(bent.spring_rest) == len(model.spring_rest)


def test_bodies_without_seams_do_not_notice():
    """A cloth by corners and the same by vertices move alike."""
    mesh = flat(4)
    runs = []
    for rest in (mesh.vertices, mesh.vertices[mesh.faces]):
        sim = cg.Simulation(cg.Scene([cg.Cloth(mesh, rest=rest, pins=[0, 4])], self_collision=False))
        sim.step(5)
        runs.append(np.array(sim.positions))
    assert runs[0] == pytest.approx(runs[1], abs=1e-9)
