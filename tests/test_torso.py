"""The torso of the package's bodies."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from clothgym import Surface, intersections, rig
from clothgym.detection.sides import signed_sides
from clothgym.torso import torso


def test_torsos_are_read_only_and_an_edge_length_out_of_range_is_named() -> None:
    with pytest.raises(ValueError, match="read-only"):
        torso(rig.load("female")).vertices[0, 0] = 1.0
    with pytest.raises(ValueError, match=r"torso\.edge_length = 0\.5: out of range"):
        torso(rig.load("male"), 0.5)


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


@pytest.mark.parametrize("name", rig.NAMES)
def test_torso_is_an_even_manifold_tube_with_four_borders(name: str) -> None:
    loaded = rig.load(name)
    mesh = torso(loaded)
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
    loaded = rig.load("female")
    mesh = torso(loaded)
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
    coarse = torso(rig.load("female"), 0.04)
    assert 400 <= len(coarse.faces) <= 800
    again = torso.__wrapped__(rig.load("female"), 0.04)
    assert np.array_equal(again.vertices, coarse.vertices)  # the same bits every time
    assert np.array_equal(again.faces, coarse.faces)
