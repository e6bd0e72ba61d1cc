"""The scenes of Mezger 2003: sizes, and that bodies hold what falls on them; the walk keeps its trousers outside the skin."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

import clothgym as cg
from clothgym import rig
from clothgym.detection.body_mesh import BodyMesh
from clothgym.mesh import Surface
from clothgym.scenes import mezger


def test_sizes_are_the_papers():
    counts = {
        name: [(len(c.mesh.vertices), len(c.mesh.faces)) for c in cg.scenes.make(name).cloths]
        for name in ("table_cloth", "sheets_on_objects", "tape")
    }
    assert counts == {"table_cloth": [(49, 72)], "sheets_on_objects": [(441, 800)] * 2, "tape": [(1449, 2472)]}
    mesh = mezger.trousers()
    assert (len(mesh.vertices), len(mesh.faces)) == (838, 1628)
    assert len(mezger.round_table().vertices) > 100


@pytest.mark.parametrize("name", ["table_cloth", "sheets_on_objects", "tape"])
def test_scenes_start_clean_and_unstrained(name):
    scene = cg.scenes.make(name)
    simulation = cg.Simulation(scene, "draft")
    assert simulation.metrics()["hits"] == 0
    for cloth in scene.cloths:
        edges = Surface(cloth.mesh.faces).edges
        now, rest = (np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) for x in (cloth.mesh.vertices, cloth.rest))
        assert np.abs(now / rest - 1.0).max() < 0.02
    for body in scene.bodies:
        surface = Surface(body.mesh.faces, len(body.mesh.vertices))
        assert (surface.edge_face_count == 2).all(), "closed"
        assert not body.notes, "faces run counter-clockwise as given"
        assert BodyMesh(body.mesh.vertices, body.mesh.faces).signed_distance(scene.start).min() > 0.0


def test_a_round_table_holds_its_cloth():
    scene = dataclasses.replace(cg.scenes.make("table_cloth"), self_collision=False)
    simulation = cg.Simulation(scene, "draft")
    simulation.step(40)
    x, radius = simulation.positions, 0.35
    above = np.hypot(x[:, 0], x[:, 2]) < 0.9 * radius
    assert above.sum() >= 9 and x[above, 1].min() > 0.69
    assert x[:, 1].min() < 0.66, "what overhangs hangs"
    table = scene.bodies[0].mesh
    assert BodyMesh(table.vertices, table.faces).depth(x).max() < 0.005


def test_trousers_are_two_tubes_joined_at_the_hip():
    mesh = mezger.trousers()
    surface = Surface(mesh.faces, len(mesh.vertices))
    assert surface.edge_face_count.max() == 2 and len(np.unique(surface.components)) == 1
    assert len(mesh.vertices) - len(surface.edges) + len(mesh.faces) == -1
    ends = surface.edges[surface.edge_face_count == 1]
    loops = np.unique(_loops(ends))
    assert len(loops) == 3
    normals = np.cross(*(mesh.vertices[mesh.faces[:, k]] - mesh.vertices[mesh.faces[:, 0]] for k in (1, 2)))
    skin = rig.load("female")
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    nearest = BodyMesh(skin.vertices, skin.faces).closest(centres)[0]
    assert (((centres - nearest) * normals).sum(axis=1) > 0).mean() > 0.97, "normals point away from the body"


def _loops(edges) -> list[int]:
    """A name of the loop that each border edge belongs to."""
    name = {int(v): int(v) for v in edges.ravel()}
    for _ in range(len(edges)):
        for a, b in edges.tolist():
            name[a] = name[b] = min(name[a], name[b])
    return sorted(name.values())


def test_a_walk_keeps_the_trousers_outside_and_moves_straight_to_the_next_step():
    frames = list(mezger.walk(4, 0.05))
    faces = rig.load("female").faces
    mesh = mezger.trousers()
    assert len(frames) == 4
    for frame, after in pairwise(frames):
        assert frame.trousers + 0.05 * frame.trouser_velocities == pytest.approx(after.trousers, abs=1e-12)
        assert frame.body + 0.05 * frame.body_velocities == pytest.approx(after.body, abs=1e-12)
        closed = BodyMesh(frame.body, faces)
        assert closed.signed_distance(frame.trousers).min() > 0.0039
        assert closed.penetration(frame.trousers, mesh.faces, 6).max() < 2e-3
        assert cg.intersections(frame.trousers, mesh.faces).hit_count < 40
    fastest = max(np.linalg.norm(f.trouser_velocities, axis=1).max() for f in frames)
    assert 0.5 < fastest < 4.0
    edges = Surface(mesh.faces).edges
    lengths = [np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) for x in (mesh.vertices, frames[2].trousers)]
    assert np.median(np.abs(lengths[1] / lengths[0] - 1.0)) < 0.1
    with pytest.raises(ValueError, match="steps = 0"):
        next(mezger.walk(0))
