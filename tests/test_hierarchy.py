"""The k-DOP tree against brute force over boxes and over geometry, for every k and arity."""

from __future__ import annotations

import itertools
import tracemalloc
from functools import partial

import meshes
import naive_mechanics as naive
import numpy as np
import pytest

import clothgym as cg
from clothgym.detection.brute_force import BruteForce
from clothgym.detection.hierarchy import Hierarchy
from clothgym.detection.intersections import Intersections
from clothgym.detection.mezger import MezgerHierarchy
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


KINDS = ("vertex_face", "edge_edge", "edge_face")


def listed(tree) -> dict[str, set[tuple[int, int]]]:
    """What a detector lists, by kind; a pair of edges with the smaller id first."""
    tree.search(near=True, hits=True)
    found = {}
    for kind, count in zip(KINDS, tree.counts):
        pairs = [tuple(p) for p in getattr(tree, kind)[:count].tolist()]
        found[kind] = {(min(p), max(p)) if kind == "edge_edge" else p for p in pairs}
        assert len(found[kind]) == len(pairs), "a pair comes twice"
    return found


def overlapping(surface, start, end, radius, axes) -> dict[str, set[tuple[int, int]]]:
    """Pairs of primitives without a common vertex whose intervals along unit axes, widened by each vertex's own radius (V, 1),
    overlap on every axis."""
    units = np.asarray(axes, float) / np.linalg.norm(axes, axis=1)[:, None]
    low = np.minimum(start @ units.T, end @ units.T) - radius
    high = np.maximum(start @ units.T, end @ units.T) + radius
    points = np.flatnonzero(surface.vertex_owner >= 0)[:, None]
    found = {}
    for kind, first, second in zip(
        KINDS, (points, surface.edges, surface.edges), (surface.faces, surface.edges, surface.faces)
    ):
        meet = (low[first].min(axis=1)[:, None] <= high[second].max(axis=1)).all(axis=2)
        meet &= (low[second].min(axis=1) <= high[first].max(axis=1)[:, None]).all(axis=2)
        meet &= ~(first[:, None, :, None] == second[None, :, None, :]).any(axis=(2, 3))
        rows, columns = np.nonzero(np.triu(meet, 1) if kind == "edge_edge" else meet)
        rows = points[rows, 0] if kind == "vertex_face" else rows
        found[kind] = set(zip(rows.tolist(), columns.tolist()))
    return found


def assert_exactly(tree, surface, start, end, radius, axes) -> None:
    """Boxes in single precision widen by a hair: pairs that are further apart may not come, nearer ones must."""
    size = max(float(np.ptp(start, axis=0).max()), 1.0)
    pads = np.broadcast_to(radius, len(start))[:, None] + np.array([-1e-9, 4e-6]).reshape(2, 1, 1) * size
    found = listed(tree)
    tight, wide = (overlapping(surface, start, end, pad, axes) for pad in pads)
    for kind in KINDS:
        assert tight[kind] <= found[kind] <= wide[kind], kind
        assert len(found[kind]) > 0


def mezger(surface, vertices, k=18, arity=4):
    return MezgerHierarchy(surface, np.asarray(vertices, float), cg.Fidelity(detection="mezger", k=k, arity=arity))


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
    assert_exactly(tree, surface, start, end, radius, EXPECTED_AXES[k])
    tree.refit(end, end.copy(), 0.0)  # another array: what rests is sifted further, see test_sifting.py
    assert_exactly(tree, surface, end, end, 0.0, EXPECTED_AXES[k])


@pytest.mark.parametrize("make", [Hierarchy, mezger])
@pytest.mark.parametrize("k", DOPS)
def test_no_near_pair_of_moving_primitives_is_missing(k, make):
    """The same from geometry: primitives that come within the sum of their radii at some time of the way."""
    surface, start, end, _ = moving_mesh(2)
    reach = 0.03
    tree = make(surface, start, k, 4)
    tree.refit(start, end, 0.5 * reach)
    found = listed(tree)
    points, lines = naive.all_quads(surface.faces)
    face_id = {tuple(sorted(f)): n for n, f in enumerate(surface.faces.tolist())}
    edge_id = {tuple(e): n for n, e in enumerate(surface.edges.tolist())}
    near = {"vertex_face": set(), "edge_edge": set()}
    for time in np.linspace(0, 1, 7):
        distances, between = naive.quad_distances(start + time * (end - start), points, lines)
        for v, *corners in points[distances <= reach].tolist():
            near["vertex_face"].add((v, face_id[tuple(sorted(corners))]))
        for a0, a1, b0, b1 in lines[between <= reach].tolist():
            near["edge_edge"].add(tuple(sorted(edge_id[tuple(sorted(e))] for e in ((a0, a1), (b0, b1)))))
    for kind, pairs in near.items():
        assert len(pairs) > 20
        assert pairs <= found[kind]


def uneven(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Small triangles, most of them crowded in a corner: splits at the centre are as unequal as can be."""
    rng = np.random.default_rng(count)
    centres = rng.exponential(1.0, (count, 1, 3)) ** 3
    return (centres + 1e-3 * rng.normal(size=(count, 3, 3))).reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def used(clusters, first, stop):
    """(B, 16) which lanes of blocks first .. stop hold a primitive, and the ids of these in order."""
    ids = clusters.ids[first:stop, 0]
    return ids >= 0, ids[ids >= 0].tolist()


@pytest.mark.parametrize("by_component", [True, False])
@pytest.mark.parametrize("arity", [*ARITIES, 16])
@pytest.mark.parametrize(
    "name", ["sheets", "many sheets", "one point", "line", "single", "two", "uneven 20", "uneven 600"]
)
def test_every_primitive_is_in_one_leaf(name, arity, by_component):
    makers = {
        "sheets": lambda: meshes.many_sheets(3, 4, 0), "one point": lambda: meshes.everything_at_one_point(9, 40, 0),
        "line": lambda: meshes.on_a_line(9, 40, 0), "single": lambda: (np.eye(3), [[0, 1, 2]]),
        "two": lambda: meshes.single_hit(), "uneven 20": lambda: uneven(20), "uneven 600": lambda: uneven(600),
        "many sheets": lambda: meshes.merged(meshes.many_sheets(5, 7, 1), meshes.many_sheets(9, 2, 2)),
    }  # fmt: skip
    vertices, faces = makers[name]()
    surface = cg.Surface(faces, len(vertices))
    c = Hierarchy(surface, np.asarray(vertices, float), 18, arity, by_component).clusters
    leaves = -(-len(surface.faces) // 16)
    edge_start, vertex_start, levels = c.edge_start.tolist(), c.vertex_start.tolist(), c.levels.tolist()
    assert len(edge_start) == len(vertex_start) == leaves + 1
    assert (edge_start[0], vertex_start[0], levels[0]) == (leaves, edge_start[-1], vertex_start[-1])
    lanes, found = used(c, 0, leaves)
    assert sorted(found) == list(range(len(surface.faces)))
    assert lanes[:-1].all(), "all leaves but the last are full"
    assert sorted(used(c, edge_start[0], edge_start[-1])[1]) == list(range(len(surface.edges)))
    owned = np.flatnonzero(surface.vertex_owner >= 0).tolist()
    assert sorted(used(c, vertex_start[0], vertex_start[-1])[1]) == owned
    for leaf in range(leaves):
        members = used(c, leaf, leaf + 1)[1]
        assert (
            (surface.edge_owner[used(c, edge_start[leaf], edge_start[leaf + 1])[1]][:, None] == members)
            .any(axis=1)
            .all()
        )
        points = used(c, vertex_start[leaf], vertex_start[leaf + 1])[1]
        assert (surface.vertex_owner[points][:, None] == members).any(axis=1).all()
    for block, given in ((0, surface.faces), (edge_start[0], surface.edges[:, [0, 1, 1]])):
        stop = leaves if block == 0 else edge_start[-1]
        ids = c.ids[block:stop].transpose(0, 2, 1).reshape(-1, 4)
        ids = ids[ids[:, 0] >= 0]
        assert (ids[:, 1:] == given[ids[:, 0]]).all()
    sizes = np.diff(levels).tolist()
    assert sizes[-1] == 1
    for below, above in itertools.pairwise([leaves, *sizes]):
        assert above == -(-below // arity)


def test_components_keep_to_themselves():
    """Leaves hold faces of one component but where two meet in the order; small components are together."""
    vertices, faces = meshes.merged(meshes.many_sheets(4, 8, 3), uneven(30))
    surface = cg.Surface(faces, len(vertices))
    shared = {}
    for by_component in (True, False):
        c = Hierarchy(surface, vertices, by_component=by_component).clusters
        parts = np.minimum(surface.components[surface.faces[:, 0]], 4)
        shared[by_component] = sum(
            len({parts[f] for f in block[block >= 0]}) > 1 for block in c.ids[: len(c.edge_start) - 1, 0]
        )
    assert shared[True] <= 4 < shared[False]


@pytest.mark.parametrize("arity", [2, 4, 8, 16])
@pytest.mark.parametrize("k", [6, 8, 14, 26])
def test_boxes_hold_their_children(k, arity):
    surface, start, end, radius = moving_mesh(3)
    tree = Hierarchy(surface, start, k, arity)
    tree.refit(start, end, radius)
    c = tree.clusters
    low, high = (c.boxes[:, np.flatnonzero(np.arange(c.boxes.shape[1]) % 6 // 3 == side)] for side in (0, 1))
    first, count = 0, len(c.edge_start) - 1
    for level in range(len(c.levels) - 1):
        for n in range(count):
            block, lane = c.levels[level] + n // arity, n % arity
            assert (low[block, :, lane] == low[first + n].min(axis=1)).all()
            assert (high[block, :, lane] == high[first + n].max(axis=1)).all()
        first, count = c.levels[level], c.levels[level + 1] - c.levels[level]
    for leaf in range(len(c.edge_start) - 1):  # what a leaf owns lies in the box of its faces
        for starts in (c.edge_start, c.vertex_start):
            for block in range(starts[leaf], starts[leaf + 1]):
                some = c.ids[block, 0] >= 0
                assert (low[block][:, some] >= low[leaf].min(axis=1)[:, None]).all()
                assert (high[block][:, some] <= high[leaf].max(axis=1)[:, None]).all()


@pytest.mark.parametrize("make", ["moving", "needles", "seam", "far", "point"])
@pytest.mark.parametrize("tree", [partial(Hierarchy, k=6, arity=4), partial(Hierarchy, k=6, arity=16), BruteForce, mezger,
                                  partial(mezger, k=8, arity=2)])  # fmt: skip
def test_search_lists_exactly_the_overlapping_primitives(make, tree):
    start, faces = {
        "moving": lambda: meshes.many_sheets(3, 3, 4), "needles": lambda: meshes.needles(20, 5, 1e-8),
        "seam": lambda: meshes.seam_of_three(3, 1), "far": lambda: meshes.moved(meshes.crumple(6, 2), None, (1e7, 0, -3e8)),
        "point": lambda: meshes.everything_at_one_point(12, 30, 0),
    }[make]()  # fmt: skip
    rng = np.random.default_rng(0)
    surface = cg.Surface(faces, len(start))
    end, radius = start + 0.05 * rng.normal(size=start.shape), rng.uniform(0.0, 0.05, len(start))
    found = tree(surface, start)
    found.refit(start, end, radius)
    found.search(near=True, hits=False)
    near = found.counts.tolist()
    found.search(near=False, hits=True)
    assert found.counts.tolist()[:2] == near[:2], "what is not asked for stays"
    axes = EXPECTED_AXES[6 if isinstance(found, Hierarchy) else 26]
    if isinstance(found, MezgerHierarchy):  # exact cones leave out what is too far away although boxes overlap
        found = MezgerHierarchy(surface, start, cg.Fidelity(detection="mezger", k=found.fidelity.k, cones="none"))
        found.refit(start, end, radius)
    assert_exactly(found, surface, start, end, radius, axes)


def test_buffers_grow_and_nothing_is_dropped():
    vertices, faces = meshes.everything_at_one_point(12, 300, 1)
    surface = cg.Surface(faces, len(vertices))
    tree = Hierarchy(surface, np.asarray(vertices, float))
    tree.refit(vertices, vertices, 0.0)
    brute = BruteForce(surface, vertices)
    brute.refit(vertices, vertices, 0.0)
    paper = mezger(surface, vertices)
    paper.refit(vertices, vertices, 0.0)
    for lists in (tree, brute, paper):
        for name in ("vertex_face", "edge_edge", "edge_face"):
            setattr(lists, name, np.zeros((1, 2), np.int32))
        lists.search(near=True, hits=True)
        assert all(
            len(getattr(lists, n)) >= c > 1 for n, c in zip(("vertex_face", "edge_edge", "edge_face"), lists.counts)
        )
    assert tree.counts[:3].tolist() == brute.counts[:3].tolist() == paper.counts[:3].tolist()


def test_no_allocation_once_warm():
    surface, start, end, radius = moving_mesh(4)
    tree = Hierarchy(surface, start)
    for _ in range(2):
        tree.refit(start, end, radius)
        tree.search(near=True, hits=True)
    kept = [id(value) for value in vars(tree).values() if isinstance(value, np.ndarray)]
    tracemalloc.start()
    for _ in range(5):
        tree.refit(end, start, radius)
        tree.search(near=True, hits=True)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept == [id(value) for value in vars(tree).values() if isinstance(value, np.ndarray)]
    assert peak < 20_000, "numpy reports what it allocates"


def test_box_tests_count_the_work_of_one_traversal_only():
    """Work counters compare machines and methods: a buffer that grows on the way must not count twice."""
    surface, start, end, radius = moving_mesh(4)
    small, large = Hierarchy(surface, start), Hierarchy(surface, start)
    for name in KINDS:
        setattr(small, name, np.zeros((1, 2), np.int32))
    for tree in (small, large):
        tree.refit(start, end, radius)
        tree.search(near=True, hits=True)
    assert small.box_tests == large.box_tests > 0


def test_tighter_boxes_give_fewer_pairs_and_the_tree_beats_brute_force():
    surface, start, end, radius = moving_mesh(5)
    pairs, tests = {}, {}
    for k in DOPS:
        tree = Hierarchy(surface, start, k, 4)
        tree.refit(start, end, 0.2 * radius)
        pairs[k] = listed(tree)["edge_edge"]
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
        tree.search(near=True, hits=True)
        assert tree.box_tests < 0.2 * len(faces) * (len(faces) - 1) / 2


@pytest.mark.parametrize("tree", [Hierarchy, BruteForce])
def test_one_face_and_no_face(tree):
    one = cg.Surface([[0, 1, 2]], 3)
    single = tree(one, np.eye(3))
    empty = tree(cg.Surface(np.zeros((0, 3), int), 3), np.eye(3))
    for found in (single, empty):
        found.refit(np.eye(3), np.eye(3), 1.0)
        found.search(near=True, hits=True)
        assert found.counts[:3].tolist() == [0, 0, 0]


@pytest.mark.parametrize("seed", range(3))
def test_brute_force_finds_the_same_hits(seed):
    surface, vertices, _, _ = moving_mesh(seed + 6)
    every = BruteForce(surface, vertices)
    every.refit(vertices, vertices, 0.0)
    brute = Intersections(vertices, surface, every.edges_against_faces())
    assert brute.hit_count > 10
    for k, arity in itertools.product((6, 18, 26), (2, 4, 8)):
        for make in (Hierarchy, mezger):
            tree = make(surface, vertices, k, arity)
            tree.refit(vertices, vertices, 0.0)
            found = Intersections(vertices, surface, tree.edges_against_faces())
            assert np.array_equal(found.edge_triangle, brute.edge_triangle)
            assert np.array_equal(found.pairs, brute.pairs)
            assert found.length == brute.length


@pytest.mark.parametrize("make", [Hierarchy, mezger])
def test_a_tree_built_in_one_pose_serves_another(make):
    surface, start, end, _ = moving_mesh(9)
    tree = make(surface, start)
    turned = end @ meshes.rotation(3).T * 2.0
    tree.refit(turned, turned, 0.0)
    fresh = make(surface, turned)
    fresh.refit(turned, turned, 0.0)
    assert listed(tree)["edge_face"] == listed(fresh)["edge_face"] or make is mezger  # cones prune other regions
    hits = [Intersections(turned, surface, t.edges_against_faces()).edge_triangle for t in (tree, fresh)]
    assert len(hits[0]) > 10 and np.array_equal(*hits)
