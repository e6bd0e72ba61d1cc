"""The k-DOP tree against brute force over boxes and over geometry, for every k and arity."""

from __future__ import annotations

import itertools

import meshes
import naive_mechanics as naive
import numpy as np
import pytest

import clothgym as cg
from clothgym.detection.brute_force import BruteForce
from clothgym.detection.hierarchy import Hierarchy
from clothgym.detection.intersections import Intersections
from clothgym.fidelity import ARITIES, DOPS
from clothgym.kernels.kdop import AXES

MAIN = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
CORNERS = [(1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)]
EDGES = [(1, 1, 0), (1, -1, 0), (1, 0, 1), (1, 0, -1), (0, 1, 1), (0, 1, -1)]
EXPECTED_AXES = {6: MAIN, 8: CORNERS, 14: MAIN + CORNERS, 18: MAIN + EDGES, 26: MAIN + CORNERS + EDGES}


def moving_mesh(seed: int) -> tuple[cg.Surface, np.ndarray, np.ndarray, np.ndarray]:
    """Surface, start, end and a radius for each vertex."""
    rng = np.random.default_rng(seed)
    vertices, faces = meshes.many_sheets(4, 3, seed)
    surface = cg.Surface(faces, len(vertices))
    end = vertices + rng.normal(0, 0.05, vertices.shape) + rng.normal(0, 0.1, 3)
    return surface, vertices, end, rng.uniform(0.0, 0.04, len(vertices))


def as_set(pairs) -> set[tuple[int, int]]:
    pairs = [tuple(p) for p in np.asarray(pairs).tolist()]
    assert len(set(pairs)) == len(pairs), "a pair comes twice"
    assert all(a < b for a, b in pairs)
    return set(pairs)


def overlapping_boxes(surface, start, end, radius, axes) -> set[tuple[int, int]]:
    """Face pairs whose intervals along unit axes, widened by each vertex's own radius, overlap on every axis."""
    units = np.asarray(axes, float) / np.linalg.norm(axes, axis=1)[:, None]
    low = np.minimum(start @ units.T, end @ units.T) - radius[:, None]
    high = np.maximum(start @ units.T, end @ units.T) + radius[:, None]
    low, high = low[surface.faces].min(axis=1), high[surface.faces].max(axis=1)
    pairs = itertools.combinations(range(len(surface.faces)), 2)
    return {(a, b) for a, b in pairs if (low[a] <= high[b]).all() and (low[b] <= high[a]).all()}


def test_axes_are_those_of_the_paper():
    assert set(AXES) == set(DOPS) == set(EXPECTED_AXES)
    for k, axes in EXPECTED_AXES.items():
        assert len(AXES[k]) == k // 2
        assert {tuple(a) for a in AXES[k].tolist()} == {tuple(map(float, a)) for a in axes}


@pytest.mark.parametrize("arity", ARITIES)
@pytest.mark.parametrize("k", DOPS)
def test_pairs_are_exactly_the_overlapping_boxes(k, arity):
    surface, start, end, radius = moving_mesh(1)
    tree = Hierarchy(surface, start, k, arity)
    tree.refit(start, end, radius)
    expected = overlapping_boxes(surface, start, end, radius, EXPECTED_AXES[k])
    found = as_set(tree.self_pairs())
    assert found == expected
    assert 0 < len(found) < len(surface.faces) * (len(surface.faces) - 1) / 2
    tree.refit(end, end, 0.0)
    assert as_set(tree.self_pairs()) == overlapping_boxes(surface, end, end, 0 * radius, EXPECTED_AXES[k])


@pytest.mark.parametrize("k", DOPS)
def test_no_near_pair_of_moving_faces_is_missing(k):
    """The same from geometry: faces that come within the sum of their radii at some time of the way."""
    surface, start, end, _ = moving_mesh(2)
    reach = 0.03
    tree = Hierarchy(surface, start, k, 4)
    tree.refit(start, end, 0.5 * reach)
    found = as_set(tree.self_pairs())
    points, lines = naive.all_quads(surface.faces)
    at_vertex = [np.flatnonzero((surface.faces == v).any(axis=1)) for v in range(surface.vertex_count)]
    face_id = {tuple(sorted(f)): n for n, f in enumerate(surface.faces.tolist())}
    near = set()
    for time in np.linspace(0, 1, 7):
        distances, between = naive.quad_distances(start + time * (end - start), points, lines)
        for quad in points[distances <= reach].tolist():
            other = face_id[tuple(sorted(quad[1:]))]
            near |= {(min(f, other), max(f, other)) for f in at_vertex[quad[0]].tolist()}
        for a0, a1, b0, b1 in lines[between <= reach].tolist():
            one, two = (np.intersect1d(at_vertex[p], at_vertex[q]).tolist() for p, q in ((a0, a1), (b0, b1)))
            near |= {(min(f, g), max(f, g)) for f in one for g in two if f != g}
    assert len(near) > 100
    assert near <= found


def uneven(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Small triangles, most of them crowded in a corner: splits at the centre are as unequal as can be."""
    rng = np.random.default_rng(count)
    centres = rng.exponential(1.0, (count, 1, 3)) ** 3
    return (centres + 1e-3 * rng.normal(size=(count, 3, 3))).reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


@pytest.mark.parametrize("arity", ARITIES)
@pytest.mark.parametrize("name", ["sheets", "one point", "line", "single", "two", "uneven 20", "uneven 60"])
def test_the_tree_is_a_tree(name, arity):
    makers = {
        "sheets": lambda: meshes.many_sheets(3, 4, 0), "one point": lambda: meshes.everything_at_one_point(9, 40, 0),
        "line": lambda: meshes.on_a_line(9, 40, 0), "single": lambda: (np.eye(3), [[0, 1, 2]]),
        "two": lambda: meshes.single_hit(), "uneven 20": lambda: uneven(20), "uneven 60": lambda: uneven(60),
    }  # fmt: skip
    vertices, faces = makers[name]()
    surface = cg.Surface(faces, len(vertices))
    tree = Hierarchy(surface, np.asarray(vertices, float), 18, arity)
    start, count, face = tree._child_start, tree._child_count, tree._node_face
    leaves = face[face >= 0]
    assert sorted(leaves.tolist()) == list(range(len(surface.faces))), "every face in exactly one leaf"
    assert ((count == 0) == (face >= 0)).all()
    children = [c for n in np.flatnonzero(count) for c in range(start[n], start[n] + count[n])]
    assert sorted(children) == list(range(1, len(face))), "every node but the root has exactly one parent"
    inner = count[count > 0]
    assert ((inner >= 2) & (inner <= arity)).all()
    assert (start[count > 0] > np.flatnonzero(count)).all(), "parents come before children"
    if name == "sheets":  # uneven splits run out of faces before the last level
        assert inner.max() == arity


@pytest.mark.parametrize("k", [6, 14, 26])
def test_boxes_hold_their_children(k):
    surface, start, end, radius = moving_mesh(3)
    tree = Hierarchy(surface, start, k, 4)
    tree.refit(start, end, radius)
    boxes = tree._boxes
    for node in np.flatnonzero(tree._child_count):
        children = boxes[tree._child_start[node] : tree._child_start[node] + tree._child_count[node]]
        assert (boxes[node, 0::2] == children[:, 0::2].min(axis=0)).all()
        assert (boxes[node, 1::2] == children[:, 1::2].max(axis=0)).all()


def test_buffers_grow_and_nothing_is_dropped():
    vertices, faces = meshes.everything_at_one_point(12, 300, 1)
    surface = cg.Surface(faces, len(vertices))
    tree = Hierarchy(surface, np.asarray(vertices, float))
    tree.refit(vertices, vertices, 0.0)
    assert len(tree._pairs) < 300 * 299 / 2
    assert len(as_set(tree.self_pairs())) == 300 * 299 / 2
    before = tree.box_tests
    tree.self_pairs()
    once = tree.box_tests - before
    tree._stack = np.zeros((66, 2), np.int64)
    tree._pairs = np.zeros((1, 2), np.int32)
    assert len(as_set(tree.self_pairs())) == 300 * 299 / 2
    assert len(tree._stack) > 66
    before = tree.box_tests
    tree.self_pairs()
    assert tree.box_tests - before == once


def test_box_tests_count_the_work_of_one_traversal_only():
    """Work counters compare machines and methods: a buffer that grows on the way must not count twice."""
    surface, start, end, radius = moving_mesh(4)
    small, large = Hierarchy(surface, start), Hierarchy(surface, start)
    small._pairs = np.zeros((1, 2), np.int32)
    for tree in (small, large):
        tree.refit(start, end, radius)
        tree.self_pairs()
    assert small.box_tests == large.box_tests > 0


def test_tighter_boxes_give_fewer_pairs_and_the_tree_beats_brute_force():
    surface, start, end, radius = moving_mesh(5)
    pairs, tests = {}, {}
    for k in DOPS:
        tree = Hierarchy(surface, start, k, 4)
        tree.refit(start, end, 0.2 * radius)
        pairs[k] = as_set(tree.self_pairs())
        tests[k] = tree.box_tests
    assert pairs[26] <= pairs[18] <= pairs[6]
    assert pairs[26] <= pairs[14] <= pairs[8]
    assert pairs[14] <= pairs[6]
    assert len(pairs[26]) < len(pairs[6])
    assert tests[26] < tests[6]


def test_the_tree_tests_far_fewer_boxes_than_there_are_pairs():
    vertices, faces = meshes.layers(3, 10, 0.05, 0)
    surface = cg.Surface(faces, len(vertices))
    for arity in ARITIES:
        tree = Hierarchy(surface, vertices, 18, arity)
        tree.refit(vertices, vertices, 1e-3)
        tree.self_pairs()
        assert tree.box_tests < 0.2 * len(faces) * (len(faces) - 1) / 2


@pytest.mark.parametrize("tree", [Hierarchy, BruteForce])
def test_one_face_and_no_face(tree):
    one = cg.Surface([[0, 1, 2]], 3)
    single = tree(one, np.eye(3))
    single.refit(np.eye(3), np.eye(3), 1.0)
    assert single.self_pairs().shape == (0, 2)
    empty = tree(cg.Surface(np.zeros((0, 3), int), 3), np.eye(3))
    empty.refit(np.eye(3), np.eye(3), 1.0)
    assert empty.self_pairs().shape == (0, 2)


@pytest.mark.parametrize("seed", range(3))
def test_brute_force_finds_the_same_hits(seed):
    surface, vertices, _, _ = moving_mesh(seed + 6)
    brute = Intersections(vertices, surface, BruteForce(surface, vertices).self_pairs())
    assert brute.hit_count > 10
    for k, arity in itertools.product((6, 18, 26), (2, 4, 8)):
        tree = Hierarchy(surface, vertices, k, arity)
        tree.refit(vertices, vertices, 1e-12)
        found = Intersections(vertices, surface, tree.self_pairs())
        assert np.array_equal(found.edge_triangle, brute.edge_triangle)
        assert np.array_equal(found.pairs, brute.pairs)
        assert found.length == brute.length


def test_a_tree_built_in_one_pose_serves_another():
    surface, start, end, _ = moving_mesh(9)
    tree = Hierarchy(surface, start)
    turned = end @ meshes.rotation(3).T * 2.0
    tree.refit(turned, turned, 0.0)
    fresh = Hierarchy(surface, turned)
    fresh.refit(turned, turned, 0.0)
    assert as_set(tree.self_pairs()) == as_set(fresh.self_pairs())
