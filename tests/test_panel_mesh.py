"""Triangulated panels: quality, border, orientation."""

from __future__ import annotations

import math
from itertools import pairwise

import garmentcode as gc
import numpy as np
import pytest

from clothgym import pattern as patterns
from clothgym.panel_mesh import PanelMesh, edge_counts, inside, mesh_panel, split_edges
from clothgym.pattern import Edge, Panel, Pattern

L_SHAPE = [[0, 0], [0.5, 0], [0.5, 0.2], [0.2, 0.2], [0.2, 0.6], [0, 0.6]]


def polygon(vertices) -> Panel:
    return Panel("p", vertices, tuple(Edge((k, (k + 1) % len(vertices))) for k in range(len(vertices))))


def dart() -> Panel:
    """A square with a narrow slit from its top."""
    return polygon([[0, 0], [0.4, 0], [0.4, 0.4], [0.203, 0.4], [0.2, 0.2], [0.197, 0.4], [0, 0.4]])


PANELS = {
    **{f"{name} {panel.name}": panel for name in patterns.names() for panel in Pattern.load(name).panels},
    "L": polygon(L_SHAPE),
    "L clockwise": polygon(L_SHAPE[::-1]),
    "turned": polygon(np.array(L_SHAPE) @ [[0.8, 0.6], [-0.6, 0.8]] + 3.0),
    "disc": Panel(
        "p", [[0, 0], [0.3, 0]], (Edge((0, 1), "circle", (0.15, 0, 1)), Edge((1, 0), "circle", (0.15, 0, 1)))
    ),
}


def corners(mesh: PanelMesh) -> np.ndarray:
    return mesh.vertices[mesh.faces]


def areas(mesh: PanelMesh) -> np.ndarray:
    a, b, c = corners(mesh).transpose(1, 0, 2)
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def least_angles(mesh: PanelMesh) -> np.ndarray:
    x = corners(mesh)
    angles = []
    for k in range(3):
        u, w = x[:, k - 1] - x[:, k], x[:, k - 2] - x[:, k]
        angles.append(np.arccos((u * w).sum(axis=1) / np.linalg.norm(u, axis=1) / np.linalg.norm(w, axis=1)))
    return np.degrees(np.min(angles, axis=0))


def sharpest(mesh: PanelMesh) -> float:
    """Least angle [degrees] at a corner of the panel: no mesh has larger ones everywhere."""
    found = []
    for before, after in zip([mesh.edge_vertices[-1], *mesh.edge_vertices], mesh.edge_vertices):
        u, w = (mesh.vertices[end] - mesh.vertices[after[0]] for end in (before[-2], after[1]))
        found.append(math.degrees(math.atan2(abs(u[0] * w[1] - u[1] * w[0]), u @ w)))
    return min(found)


def shoelace(p: np.ndarray) -> float:
    return 0.5 * sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(p, np.roll(p, -1, axis=0)))


def check(panel: Panel, mesh: PanelMesh, counts: list[int]) -> None:
    """A disc whose border is the samples, every face the way the loop runs."""
    assert [len(ids) - 1 for ids in mesh.edge_vertices] == counts
    for k, ids in enumerate(mesh.edge_vertices):
        assert (mesh.vertices[ids] == panel.sample(k, counts[k])).all()
        assert ids[-1] == mesh.edge_vertices[(k + 1) % len(counts)][0]
    border = {(int(a), int(b)) for ids in mesh.edge_vertices for a, b in pairwise(ids)}
    directed = [(int(f[i]), int(f[(i + 1) % 3])) for f in mesh.faces for i in range(3)]
    present = set(directed)
    assert len(present) == len(directed)
    assert {(a, b) for a, b in directed if (b, a) not in present} == border  # run as the loop runs
    edges = {(min(e), max(e)) for e in directed}
    assert len(mesh.vertices) - len(edges) + len(mesh.faces) == 1
    assert set(mesh.faces.ravel().tolist()) == set(range(len(mesh.vertices)))
    area = areas(mesh)
    assert (np.sign(area) == np.sign(panel.signed_area)).all()
    assert area.sum() == pytest.approx(shoelace(mesh.vertices[: mesh.border_count]), rel=1e-12)


@pytest.mark.parametrize("name", PANELS)
@pytest.mark.parametrize("edge_length", [0.02, 0.013])
def test_even_triangles_that_cover_the_panel(name, edge_length):
    panel = PANELS[name]
    mesh = mesh_panel(panel, edge_length)
    check(panel, mesh, edge_counts(panel, edge_length))
    assert np.percentile(least_angles(mesh), 5) >= 30.0
    assert least_angles(mesh).min() > 15.0
    x = corners(mesh)
    lengths = np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2)
    assert np.median(lengths) == pytest.approx(edge_length, rel=0.1)
    sharp = sharpest(mesh) < 40.0  # the cap of a sleeve ends in points
    assert lengths.max() < (1.7 if sharp else 1.65) * edge_length
    assert lengths.min() > 0.5 * edge_length
    assert np.abs(areas(mesh)).sum() == pytest.approx(abs(panel.signed_area), rel=0.02)


def test_given_counts_hold_though_the_spacing_differs():
    panel = PANELS["L"]
    counts = [count + round(0.23 * count) * (1 if k % 2 else -1) for k, count in enumerate(edge_counts(panel, 0.02))]
    mesh = mesh_panel(panel, 0.02, counts)
    check(panel, mesh, counts)
    assert np.percentile(least_angles(mesh), 5) >= 30.0
    with pytest.raises(ValueError, match="counts: expected 6 positive numbers, got \\[1, 2\\]"):
        mesh_panel(panel, 0.02, [1, 2])


def test_a_narrow_slit_gets_a_finer_border():
    panel = dart()
    # legs of unequal counts: the tips of one side lie within the circles of the other
    counts = [20, 20, 10, 3, 10, 10, 20]
    with pytest.raises(ValueError, match=r"panel 'p': edge . is too coarse for the outline there"):
        mesh_panel(panel, 0.02, counts)
    mesh = mesh_panel(panel, 0.02)
    check(panel, mesh, [len(ids) - 1 for ids in mesh.edge_vertices])
    blunt = mesh_panel(polygon([[0, 0], [0.4, 0], [0.4, 0.004], [0, 0.004]]), 0.02)  # thinner than an edge is long
    assert areas(blunt).sum() == pytest.approx(0.4 * 0.004)


def test_coarse_chords_of_curves_are_refined_until_they_do_not_cross():
    # a crescent: its two arcs, cut into one piece each, would be the same chord
    panel = Panel("p", [[0, 0], [0.3, 0]], (Edge((0, 1), "circle", (0.16, 0, 1)), Edge((1, 0), "circle", (0.22, 0, 0))))
    mesh = mesh_panel(panel, 0.5)
    check(panel, mesh, [len(ids) - 1 for ids in mesh.edge_vertices])


def test_inside_agrees_with_the_winding_number():
    rng = np.random.default_rng(2)
    panel = Pattern.load("sleeveless_shirt").panel("front")
    border = panel.outline(0.03)
    points = rng.uniform(border.min(axis=0) - 0.05, border.max(axis=0) + 0.05, (400, 2))
    angle = np.zeros(len(points))
    for a, b in zip(border, np.roll(border, -1, axis=0)):
        u, w = a - points, b - points
        angle += np.arctan2(u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0], (u * w).sum(axis=1))
    assert (inside(points, border) == (np.abs(angle) > np.pi)).all()
    assert 100 < inside(points, border).sum() < 300


def test_meshing_twice_gives_the_same():
    first, second = (mesh_panel(PANELS["skirt front"], 0.02) for _ in range(2))
    assert (first.vertices == second.vertices).all() and (first.faces == second.faces).all()


@pytest.mark.parametrize("count", [1, 2])
def test_split_edges_puts_vertices_onto_inner_edges(count):
    panel = polygon([[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]])
    border = tuple(np.array([k, (k + 1) % 4], np.int32) for k in range(4))
    coarse = PanelMesh(panel.vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32), border)
    split = split_edges(coarse, {(0, 2): count})
    check(panel, split, [1, 1, 1, 1])
    assert len(split.faces) == 2 * (count + 1)
    assert split.vertices[4] == pytest.approx([0.1 / (count + 1)] * 2)


@pytest.mark.parametrize("name", ["shirt_mean", "dress_pencil"])
def test_foreign_panels(name):
    for panel in Pattern.load(gc.foreign(name)).panels:
        mesh = mesh_panel(panel, 0.025)
        check(panel, mesh, edge_counts(panel, 0.025))
        assert np.percentile(least_angles(mesh), 5) >= 30.0
        outside = np.sign(panel.translation[2])  # fronts stand at positive z and look there, backs the other way
        placed = panel.placed(mesh.vertices)[mesh.faces]
        normals = np.cross(placed[:, 1] - placed[:, 0], placed[:, 2] - placed[:, 0])
        assert (np.sign(normals[:, 2]) == outside).all()


def test_bad_edge_lengths_are_named():
    with pytest.raises(ValueError, match="edge_length = 0: out of range"):
        mesh_panel(PANELS["L"], 0)
