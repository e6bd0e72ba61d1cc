"""The bodies of the package, and their torsos."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from clothgym import Surface, body, intersections
from clothgym.detection.sides import signed_sides


@pytest.mark.parametrize(("name", "height"), [("female", 1.590), ("male", 1.730)])
def test_load_gives_a_closed_body_with_skeleton_and_weights(name: str, height: float) -> None:
    loaded = body.load(name)
    assert loaded.name == name
    assert loaded.vertices.shape == (13380, 3)
    assert loaded.faces.shape == (26756, 3)
    assert loaded.vertices[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    assert loaded.vertices[:, 1].max() == pytest.approx(height, abs=2e-3)
    mesh = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0.03  # outside is where the faces run counter-clockwise
    assert len(loaded.bones) == 53
    assert loaded.parent.shape == (53,)
    assert loaded.head.shape == loaded.tail.shape == (53, 3)
    assert loaded.parent[loaded.bone("Root")] == -1
    assert loaded.parent[loaded.bone("calf_l")] == loaded.bone("thigh_l")
    assert loaded.weights.shape == (13380, 53)
    assert np.abs(loaded.weights.sum(axis=1) - 1.0).max() < 1e-12
    assert loaded.weights.min() >= 0.0
    # z to the front: the toes are in front of the ankles
    assert loaded.tail[loaded.bone("foot_l"), 2] > loaded.head[loaded.bone("foot_l"), 2]


def test_bodies_are_read_once_and_cannot_be_written() -> None:
    loaded = body.load("female")
    assert body.load("female") is loaded
    with pytest.raises(ValueError, match="read-only"):
        loaded.vertices[0, 0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        body.torso(loaded).vertices[0, 0] = 1.0


def test_bad_names_and_values_are_named() -> None:
    with pytest.raises(ValueError, match="body = 'dwarf': expected one of female, male"):
        body.load("dwarf")
    with pytest.raises(ValueError, match="bone = 'wing'"):
        body.load("male").bone("wing")
    with pytest.raises(ValueError, match=r"torso\.edge_length = 0\.5: out of range"):
        body.torso(body.load("male"), 0.5)


def _borders(mesh: object) -> list[np.ndarray]:
    """Vertices of each border loop, from the highest to the lowest."""
    surface = Surface(mesh.faces, len(mesh.vertices))
    edges = surface.edges[surface.edge_face_count == 1]
    assert np.all(np.bincount(edges.ravel())[np.unique(edges)] == 2), "a border is a simple loop"
    parent = {int(v): int(v) for v in edges.ravel()}

    def root(v: int) -> int:
        while parent[v] != v:
            v = parent[v]
        return v

    for a, b in edges.tolist():
        parent[root(a)] = root(b)
    loops: dict[int, list[int]] = {}
    for v in parent:
        loops.setdefault(root(v), []).append(v)
    return sorted((mesh.vertices[loop] for loop in loops.values()), key=lambda x: -x[:, 1].mean())


@pytest.mark.parametrize("name", body.NAMES)
def test_torso_is_an_even_manifold_tube_with_four_borders(name: str) -> None:
    loaded = body.load(name)
    mesh = body.torso(loaded)
    surface = Surface(mesh.faces, len(mesh.vertices))
    assert 1000 <= len(mesh.faces) <= 2500
    assert surface.edge_face_count.max() == 2
    assert surface.components.max() == 0
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert shape.is_winding_consistent
    assert shape.euler_number == -2  # a sphere with four holes
    assert intersections(mesh.vertices, mesh.faces).hit_count == 0
    lengths = np.linalg.norm(mesh.vertices[surface.edges[:, 1]] - mesh.vertices[surface.edges[:, 0]], axis=1)
    assert lengths.mean() == pytest.approx(0.022, rel=0.05)
    assert lengths.min() > 0.4 * 0.022
    assert lengths.max() < 1.6 * 0.022
    assert np.degrees(shape.face_angles).min() > 20.0

    neck, *armholes, hip = _borders(mesh)
    assert len(armholes) == 2
    assert neck[:, 1].min() > loaded.head[loaded.bone("spine_03"), 1]
    assert np.abs(neck[:, 0].mean()) < 0.01
    assert {np.sign(hole[:, 0].mean()) for hole in armholes} == {-1.0, 1.0}
    assert np.ptp(hip[:, 1]) < 1e-9  # cut level
    assert loaded.head[loaded.bone("thigh_l"), 1] < hip[0, 1] < loaded.head[loaded.bone("spine_01"), 1]


def test_torso_lies_on_the_body_and_faces_outwards() -> None:
    loaded = body.load("female")
    mesh = body.torso(loaded)
    _, distance = signed_sides(mesh.vertices, loaded.vertices, loaded.faces)
    assert distance.max() < 2e-3  # borders cut corners, all else lies on the body
    assert np.quantile(distance, 0.9) < 1e-6
    centroids = mesh.vertices[mesh.faces].mean(axis=1)
    across = np.cross(
        mesh.vertices[mesh.faces[:, 1]] - mesh.vertices[mesh.faces[:, 0]],
        mesh.vertices[mesh.faces[:, 2]] - mesh.vertices[mesh.faces[:, 0]],
    )
    normals = across / np.linalg.norm(across, axis=1, keepdims=True)
    signs, _ = signed_sides(centroids + 5e-3 * normals, loaded.vertices, loaded.faces)
    assert (signs > 0).mean() > 0.98


def test_torso_follows_the_wanted_edge_length() -> None:
    coarse = body.torso(body.load("female"), 0.04)
    assert 400 <= len(coarse.faces) <= 800
    again = body.torso.__wrapped__(body.load("female"), 0.04)
    assert np.array_equal(again.vertices, coarse.vertices)  # the same bits every time
    assert np.array_equal(again.faces, coarse.faces)
