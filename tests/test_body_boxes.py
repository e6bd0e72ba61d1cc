"""The object-space collider against exact distances."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from clothgym import rig
from clothgym.detection.body_boxes import BodyBoxes
from clothgym.detection.body_mesh import BodyMesh

REACH = 0.01


@pytest.mark.parametrize("arity", [2, 4, 8])
def test_distances_are_exact_within_reach(arity):
    mesh = trimesh.creation.icosphere(2, 0.1)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.3, (1, 2, 3)))
    rng = np.random.default_rng(0)
    parts = rng.integers(0, 3, len(mesh.faces))
    points = rng.uniform(-0.13, 0.13, (4000, 3))
    exact = BodyMesh(mesh.vertices, mesh.faces)
    s = exact.signed_distance(points)
    found, normals = BodyBoxes(mesh.vertices, mesh.faces, parts, arity).query(points, REACH)
    near = np.abs(s) < REACH
    assert near.sum() > 300
    assert np.array_equal(np.isfinite(found), near)
    assert found[near] == pytest.approx(s[near], abs=1e-12)
    assert not normals[~near].any()
    on = points[near] - s[near][:, None] * normals[near]
    assert np.abs(exact.signed_distance(on)).max() < 2e-3


def test_the_body_has_five_parts():
    skin = rig.load("female")
    parts = skin.face_parts()
    middle = np.asarray(skin.vertices)[skin.faces].mean(axis=1)
    assert sorted(np.unique(parts)) == [0, 1, 2, 3, 4]
    assert (middle[parts == 1, 0] > 0.05).all() and (middle[parts == 2, 0] < -0.05).all()
    knee = np.abs(middle[:, 1] - 0.45) < 0.05
    assert set(parts[knee & (middle[:, 0] > 0)]) <= {1, 3}
    assert (parts[middle[:, 1] > 1.45] == 0).all(), "the head belongs to the trunk"
    boxes = BodyBoxes(skin.vertices, skin.faces, parts)
    rng = np.random.default_rng(1)
    points = middle[rng.integers(0, len(middle), 3000)] + rng.normal(0.0, 0.004, (3000, 3))
    s = BodyMesh(skin.vertices, skin.faces).signed_distance(points)
    found, _ = boxes.query(points, REACH)
    near = np.abs(s) < REACH - 1e-9
    assert np.abs(np.abs(found[near]) - np.abs(s[near])).max() < 1e-9
    assert (np.sign(found[near]) == np.sign(s[near])).mean() > 0.995
    before = boxes.face_tests
    boxes.move(skin.vertices + np.array([0.0, 5.0, 0.0]))
    assert np.isinf(boxes.query(points, REACH)[0]).all()
    assert boxes.face_tests == before
