"""Normal and velocity cones, and what the tests of self-collision promise."""

from __future__ import annotations

import math

import meshes
import naive
import naive_dop
import numpy as np
import pytest

from clothgym.detection.dop_object import DopObject
from clothgym.detection.dop_scene import DopScene
from clothgym.kernels import cones, dop_traversal

SHEETS = {
    "gentle": lambda: meshes.crumple(10, 0, 0.12),
    "crumple": lambda: meshes.crumple(9, 1),
    "spiky": lambda: meshes.spiky(6, 0),
    "overfolded": lambda: meshes.overfolded_sheet(5, 1),
}


def built(vertices, faces, tight: int = 1, ways=None) -> DopObject:
    item = DopObject(vertices, faces, None, 18, 4, 2, True)
    item.update(vertices, ways, 0.0 if ways is None else 1.0)
    item.refit(0.0, 2, 1.0, 0.0, tight, True)
    return item


def faces_of(item: DopObject, node: int) -> list[int]:
    tree = item.tree
    if tree.child_count[node] == 0:
        return [int(tree.node_face[node])]
    first = tree.child_start[node]
    return [f for child in range(first, first + tree.child_count[node]) for f in faces_of(item, child)]


def clear(item: DopObject, node: int, reach: float, rule: int = dop_traversal.EXACT) -> bool:
    """What the test of self-collision says about a node."""
    counts = np.zeros(8, np.int64)
    rules = dop_traversal.Rules(rule, 0.5 * math.pi, 0.0, reach, 0.0)
    dop_traversal.traverse(
        item.tree, item.tree, 1, item.seen, item.lengths, rules, np.zeros((0, 0), np.uint8), np.array([[node, node]]),
        np.zeros((4096, 2), np.int64), np.zeros((1, 2), np.int32), np.zeros((0, 2), np.int64), counts,
    )  # fmt: skip
    return bool(counts[dop_traversal.CONE_TESTS] == 1 and counts[dop_traversal.CONE_PRUNED] == 1)


@pytest.mark.parametrize("tight", [0, 1])
@pytest.mark.parametrize("name", SHEETS)
def test_normal_cones_hold_every_normal(name, tight):
    vertices, faces = SHEETS[name]()
    item = built(vertices, faces, tight)
    normals = naive_dop.normals(vertices, faces)
    for node in range(len(item.tree.child_count)):
        half = item.tree.normal_half[node]
        assert 0.0 <= half <= math.pi
        if half < math.pi:
            assert naive_dop.largest_angle(item.tree.normal_axis[node], normals[faces_of(item, node)]) <= half + 1e-7


def test_the_tighter_merge_is_tighter():
    vertices, faces = SHEETS["gentle"]()
    paper, tight = (built(vertices, faces, t).tree.normal_half for t in (0, 1))
    assert tight.mean() < 0.9 * paper.mean()


def test_velocity_cones_and_their_balls_hold_every_velocity():
    rng = np.random.default_rng(0)
    vertices, faces = SHEETS["crumple"]()
    for spread in (0.05, 0.4, 3.0):
        ways = np.array([1.0, 0.2, 0.0]) + spread * rng.normal(size=vertices.shape)
        ways[rng.uniform(size=len(ways)) < 0.2] = 0.0
        item = built(vertices, faces, ways=ways)
        tree = item.tree
        radii = np.zeros((1, 1))
        for node in range(len(tree.child_count)):
            own = ways[np.unique(faces[faces_of(item, node)])]
            speeds = np.linalg.norm(own, axis=1)
            assert tree.speed_high[node] == pytest.approx(speeds.max(), rel=1e-12)
            assert tree.speed_low[node] == pytest.approx(speeds.min(), rel=1e-12, abs=1e-15)
            assert naive_dop.largest_angle(tree.speed_axis[node], own) <= tree.speed_half[node] + 1e-7
            cones.group_travel(tree, np.array([node]), tree, np.array([node]), radii)
            spread_of = np.linalg.norm(own[:, None] - own[None], axis=2).max()
            assert radii[0, 0] >= spread_of * (1.0 - 1e-9)


@pytest.mark.parametrize("name", SHEETS)
def test_a_clear_region_holds_no_pair_within_reach(name):
    vertices, faces = SHEETS[name]()
    item = built(vertices, faces)
    edge = np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).mean()
    said = 0
    for reach in (0.0, 0.05 * edge, 0.4 * edge):
        for node in range(len(item.tree.child_count)):
            if clear(item, node, reach):
                part = faces[faces_of(item, node)]
                said += len(part) > 1
                assert not naive_dop.keys(vertices, part, reach if reach > 0.0 else 1e-12)
                if reach == 0.0:
                    assert not naive.exact_hits(vertices, part)
    assert said > 5, "no region was ever called clear: the test has nothing to say"


def test_a_flat_sheet_is_clear_at_the_root_and_costs_no_box():
    vertices, faces = meshes.grid(20, 20)
    scene = DopScene(cones="exact")
    scene.add(vertices, faces)
    assert len(scene.collide(0.02)[0, 0]) == 0
    assert (scene.counters["box_tests"], scene.counters["cone_tests"], scene.counters["primitive_tests"]) == (0, 1, 0)
    plain = DopScene(cones="none")
    plain.add(vertices, faces)
    plain.collide(0.02)
    assert plain.counters["box_tests"] > 1000


def test_triangles_flatter_than_the_reach_are_never_clear():
    vertices, faces = meshes.grid(8, 8)
    item = built(vertices, faces)
    altitude = item.tree.altitude[0]
    assert clear(item, 0, 0.99 * altitude)
    assert not clear(item, 0, 1.01 * altitude)
    assert naive_dop.keys(vertices, faces, 1.01 * altitude), "the bound is sharp on a grid"


def ramp(turns: float = 1.15, cells: int = 40):
    """A strip that winds once and a little more around an axis, nearly level, and passes through its own beginning: small
    normal cone, outline that crosses itself [Mezger 2003, Fig. 5]."""
    vertices, faces = meshes.grid(cells, 6, 1.0, 1.0)
    angle = 2.0 * np.pi * turns * vertices[:, 0]
    radius = 1.0 + 0.3 * vertices[:, 2]
    height = 0.01 * np.sin(np.pi * vertices[:, 0]) + 0.08 * (vertices[:, 0] - 0.5) * (vertices[:, 2] - 0.5)
    return np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=1), faces


def test_the_papers_criterion_misses_what_the_outline_shows():
    vertices, faces = ramp()
    hits = naive.exact_intersections(vertices, faces).pairs
    assert len(hits) > 5
    assert built(vertices, faces, 0).tree.normal_half[0] < 0.25 * math.pi
    eps = 0.003
    true = naive_dop.keys(vertices, faces, eps)

    def missing(**settings) -> int:
        scene = DopScene(**settings)
        scene.add(vertices, faces, pattern=meshes.grid(40, 6)[0])
        return len(true - scene.collide(eps)[0, 0].keys())

    assert missing(cones="none") == missing(cones="exact") == 0
    assert missing(cones="mezger", groups=0) == len(true)
    remedy = missing(cones="mezger", groups=2, build_space="pattern")
    assert remedy == 0, "the ends are separated by a group: the paper's remedy"
    assert missing(cones="mezger", groups=2) > 0, "a tree built where the ends lie on each other groups them"


def test_broken_topology_is_never_called_clear():
    """Edges with three faces, turned faces, holes, and two sheets that do not hang together."""
    grid = meshes.grid(4, 4)
    vertices, faces = grid
    turned = faces.copy()
    turned[3] = turned[3][::-1]
    holed = np.delete(faces, [9, 10], axis=0)
    apart = meshes.merged(grid, meshes.moved(grid, None, (0.0, 0.01, 0.0)))
    doubled = np.concatenate([faces, faces[:1]])
    for x, f in ((vertices, turned), (vertices, holed), apart, (vertices, doubled)):
        assert not clear(built(x, f), 0, 1e-3)
    assert clear(built(*grid), 0, 1e-3)
