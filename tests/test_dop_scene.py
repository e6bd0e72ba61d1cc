"""`DopScene`: every technique answers as trying all pairs does, within its promise, and moves its counters."""

from __future__ import annotations

import time
from functools import cache

import meshes
import naive_dop
import numpy as np
import pytest

from clothgym.detection.dop_scene import DopScene
from clothgym.mesh import grid

EPS = 0.02


@cache
def pair():
    """Two crumpled sheets through each other, and what trying all pairs finds."""
    first = meshes.crumple(6, 1)
    second = meshes.moved(meshes.crumple(5, 2), meshes.rotation(4), (0.3, 0.2, 0.25))
    true = naive_dop.between(naive_dop.keys(*meshes.merged(first, second), EPS), len(first[0]))
    assert all(len(part) > 10 for part in true.values())
    return first, second, true


def filled(**settings) -> tuple[DopScene, int, int]:
    first, second, _ = pair()
    scene = DopScene(**settings)
    return scene, scene.add(*first), scene.add(*second)


def assert_complete(scene: DopScene, a: int, b: int) -> None:
    true = pair()[2]
    found = scene.collide(EPS)
    for key, part in (((a, a), "first"), ((a, b), "both"), ((b, b), "second")):
        assert found[key].keys() == true[part], part
        assert len(found[key]) == len(true[part]), "a pair comes twice"
        assert (found[key].distances < EPS).all()


@pytest.mark.parametrize("cones", ["none", "exact"])
@pytest.mark.parametrize("k", [6, 8, 14, 18, 26])
@pytest.mark.parametrize("arity", [2, 4, 8])
def test_the_same_pairs_as_trying_all(k, arity, cones):
    assert_complete(*filled(k=k, arity=arity, cones=cones))


@pytest.mark.parametrize("settings", [
    {"inflation": "unoriented"}, {"inflation": "oriented"}, {"inflation": "swept"}, {"separation_list": True},
    {"coherence": True}, {"groups": 0}, {"groups": 5}, {"self_collision": True, "cones": "exact", "groups": 1},
])  # fmt: skip
def test_the_same_pairs_with_every_switch(settings):
    scene, a, b = filled(**settings)
    assert_complete(scene, a, b)
    assert_complete(scene, a, b)


@pytest.mark.parametrize("name", ["seam_of_three-0", "lattice_cross-0-0-0", "repeated_faces-0", "zero_area_faces-0",
                                  "overfolded_sheet-1", "soup-2"])  # fmt: skip
def test_soups_of_every_kind(name):
    vertices, faces = meshes.EVERY[name]()
    proper = faces[[len(set(f)) == 3 for f in faces.tolist()]]
    scene = DopScene(cones="exact")
    number = scene.add(vertices, faces)
    eps = 0.05
    true = naive_dop.keys(vertices, proper, eps * (1 - 1e-9))
    found = scene.collide(eps)[number, number].keys()
    assert true <= found <= naive_dop.keys(vertices, proper, eps * (1 + 1e-9))


def test_distances_and_weights_are_those_of_the_closest_points():
    kinds = set()
    for meshes_now in (pair()[:2], pair()[1::-1]):
        scene = DopScene()
        a, b = (scene.add(*mesh) for mesh in meshes_now)
        (x, _), (y, _) = meshes_now
        near = scene.collide(EPS)[a, b]
        kinds |= set(near.kinds.tolist())
        for quad, kind, weights, distance in zip(near.quads, near.kinds, near.weights, near.distances):
            own, other = (y, x) if kind == 2 else (x, y)
            split = 2 if kind == 1 else 1
            points = np.concatenate([own[quad[:split]], other[quad[split:]]])
            if kind == 1:
                s, t, _ = weights
                gap = points[0] + s * (points[1] - points[0]) - points[2] - t * (points[3] - points[2])
            else:
                gap = points[0] - weights @ points[1:]
                assert weights.sum() == pytest.approx(1.0)
            assert np.linalg.norm(gap) == pytest.approx(distance, abs=1e-14)
            assert naive_dop.distance(points, int(kind == 1)) == pytest.approx(distance, abs=1e-10)
    assert kinds == {0, 1, 2}


def test_quads_give_the_pairs_of_their_two_triangles_with_half_the_leaves():
    mesh = grid(1.0, 1.0, 9, 9)
    quads = mesh.quads
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    rng = np.random.default_rng(0)
    lower = mesh.vertices + rng.uniform(-0.02, 0.02, mesh.vertices.shape)
    upper = mesh.vertices + rng.uniform(-0.02, 0.02, mesh.vertices.shape) + [0.03, 0.02, 0.01]
    answers, leaves = [], []
    for polygons in (faces, quads):
        scene = DopScene(cones="exact")
        a, _ = scene.add(lower, polygons), scene.add(upper, polygons)
        for x in (lower, lower * [1.0, 1.0, 0.55]):  # gathered until neighbours of neighbours are near
            scene.update(a, x)
            found = scene.collide(0.06)
            answers.append({key: near.keys() for key, near in found.items()})
        leaves.append(scene.counters["leaf_pairs"])
    assert answers[:2] == answers[2:]
    assert all(len(found) > 20 for found in answers[1].values())
    assert leaves[1] < 0.5 * leaves[0]


def test_objects_come_and_go_while_the_others_keep_what_they_hold():
    first, second, true = pair()
    scene = DopScene(separation_list=True)
    a = scene.add(*first)
    scene.collide(EPS)
    held = scene._objects[a]
    b = scene.add(*second)
    assert_complete(scene, a, b)
    c = scene.add(second[0] + 10.0, second[1], cloth=False)
    assert set(scene.collide(EPS)) == {(a, a), (a, b), (b, b), (a, c), (b, c)}
    scene.update(a, first[0] + 0.5)
    scene.update(a, first[0])
    scene.remove(c)
    assert_complete(scene, a, b)
    scene.remove(b)
    spent = scene.counters["refits"]
    assert set(scene.collide(EPS)) == {(a, a)}
    assert scene.counters["refits"] == spent, "what did not change is not refitted"
    assert scene._objects[a] is held
    d = scene.add(*second)
    assert d not in (a, b, c)
    assert_complete(scene, a, d)
    assert scene.collide(EPS)[a, d].keys() == true["both"]


def test_several_thousand_triangles_are_set_up_within_a_second():
    vertices, faces = meshes.crumple(50, 0)
    assert len(faces) == 5000
    DopScene().add(*meshes.grid(2, 2))
    seconds = []
    for _ in range(2):
        started = time.perf_counter()
        DopScene().add(vertices, faces)
        seconds.append(time.perf_counter() - started)
    assert min(seconds) < 1.0


def drifting(steps: int, speed: float, seed: int = 0):
    """Places of the first sheet of `pair` that wanders and flutters."""
    rng = np.random.default_rng(seed)
    x = pair()[0][0].copy()
    for _ in range(steps):
        x = x + speed * (0.5 * rng.normal(size=3) + rng.normal(size=x.shape))
        yield x


def true_between(x) -> set:
    first, second, _ = pair()
    found = naive_dop.keys(*meshes.merged((x, first[1]), second), EPS)
    return naive_dop.between(found, len(first[0]))


@pytest.mark.parametrize("cones", ["none", "exact"])
def test_lazy_update_keeps_its_promise_and_saves_refits(cones):
    lazy = 0.004
    scene, a, b = filled(lazy=lazy, cones=cones, inflation="unoriented")
    eager, c, _ = filled(cones=cones, inflation="unoriented")
    scene.collide(EPS), eager.collide(EPS)
    first, second, _ = pair()
    lost = 0
    for x in drifting(5, 2e-4):
        scene.update(a, x)
        eager.update(c, x)
        found = scene.collide(EPS)
        eager.collide(EPS)
        sure = naive_dop.between(naive_dop.keys(*meshes.merged((x, first[1]), second), EPS - 2.0 * lazy), len(first[0]))
        assert sure["first"] <= found[a, a].keys()
        assert sure["both"] <= found[a, b].keys()
        whole = true_between(x)
        assert found[a, b].keys() <= whole["both"], "distances are those of the places now"
        lost += len(whole["both"] - found[a, b].keys())
    assert scene.counters["refits"] < 0.5 * eager.counters["refits"]
    for x in drifting(3, 0.02):
        scene.update(a, x)
        spent = scene.counters["refits"]
        scene.collide(EPS)
        assert scene.counters["refits"] > spent


@pytest.mark.parametrize("moving", [False, True])
def test_lazy_update_of_moving_objects_holds_the_whole_step(moving):
    """Slow drift of places and ways: the boxes of an earlier step still hold the ways of this one, to b."""
    lazy = 0.003
    scene, a, b = filled(lazy=lazy, inflation="conservative", cones="exact")
    first, second, _ = pair()
    rng = np.random.default_rng(2)
    ways = 0.03 * rng.normal(size=first[0].shape) if moving else np.zeros_like(first[0])
    for x in drifting(3, 2e-4):
        scene.update(a, x, ways, 1.0)
        found = scene.collide(EPS)
        vertices, faces = meshes.merged((x, first[1]), second)
        everything = np.concatenate([ways, np.zeros_like(second[0])])
        near = naive_dop.keys_within(vertices, everything, faces, EPS - 2.0 * lazy, 3)
        true = naive_dop.between(near, len(first[0]))
        assert true["both"] <= found[a, b].keys() and true["first"] <= found[a, a].keys()
        ways = ways + 1e-4 * rng.normal(size=ways.shape)


@pytest.mark.parametrize("inflation", ["unoriented", "conservative"])
def test_coherence_misses_nothing_and_computes_less(inflation):
    """Groups that hardly move against each other keep their pairs; distances may be above the true ones, by their way."""
    scene, a, b = filled(coherence=True, inflation=inflation)
    plain, c, _ = filled(inflation=inflation)
    _, second, _ = pair()
    for found in (scene, plain):
        found.collide(EPS)
        found.reset_counters()
    worst = 0.0
    for x in drifting(6, 4e-4):
        scene.update(a, x)
        plain.update(c, x)
        answer = scene.collide(EPS)
        plain.collide(EPS)
        true = true_between(x)
        for key, part in (((a, a), "first"), ((a, b), "both"), ((b, b), "second")):
            assert true[part] <= answer[key].keys()
        near = answer[a, b]
        for quad, kind, distance in zip(near.quads, near.kinds, near.distances):
            own, other = (second[0], x) if kind == 2 else (x, second[0])
            split = 2 if kind == 1 else 1
            exact = naive_dop.distance([*own[quad[:split]], *other[quad[split:]]], int(kind == 1))
            assert exact <= distance + 1e-9
            worst = max(worst, distance - exact)
    assert worst < 2.0 * EPS
    assert scene.counters["reused_pairs"] > 0
    assert scene.counters["primitive_tests"] < 0.5 * plain.counters["primitive_tests"]
    for x in drifting(2, 0.05, 7):
        scene.update(a, x)
        assert true_between(x)["both"] <= scene.collide(EPS)[a, b].keys()


def test_coherence_looks_at_the_coming_step():
    """A fast approach is never served from a list that was made when all was still."""
    sheet = meshes.grid(6, 6)
    scene = DopScene(coherence=True, inflation="conservative")
    a, b = scene.add(*sheet), scene.add(sheet[0] - [0.0, 0.2, 0.0], sheet[1])
    assert len(scene.collide(EPS)[a, b]) == 0
    scene.update(a, sheet[0], np.tile([0.0, -0.3, 0.0], (len(sheet[0]), 1)), 1.0)
    answer = scene.collide(EPS)
    missing, occurring = scene.misses(answer, EPS)
    assert missing == 0 and occurring > 50


def test_the_separation_list_finds_the_same_and_saves_box_tests_when_little_moves():
    scene, a, b = filled(separation_list=True, inflation="unoriented")
    plain, c, _ = filled(inflation="unoriented")
    for x in drifting(20, 2e-4):
        scene.update(a, x)
        plain.update(c, x)
        found, true = scene.collide(EPS), plain.collide(EPS)
        assert [near.keys() for near in found.values()] == [near.keys() for near in true.values()]
    assert scene.counters["box_tests"] < plain.counters["box_tests"]
    assert scene.counters["stops"] > 0 == plain.counters["stops"]
    for x in drifting(3, 0.05, 3):
        scene.update(a, x)
        plain.update(c, x)
        assert scene.collide(EPS)[a, b].keys() == plain.collide(EPS)[c, 1].keys()


def test_larger_trees_test_more_boxes_but_fewer_levels_and_tighter_boxes_fewer_leaves():
    counted = {}
    for k, arity in ((6, 4), (18, 4), (26, 4), (18, 2), (18, 8)):
        scene, _, _ = filled(k=k, arity=arity, cones="none", inflation="unoriented")
        scene.collide(EPS)
        counted[k, arity] = scene.counters
    assert counted[26, 4]["leaf_pairs"] <= counted[18, 4]["leaf_pairs"] < counted[6, 4]["leaf_pairs"]
    assert counted[18, 2]["leaf_pairs"] == counted[18, 4]["leaf_pairs"] == counted[18, 8]["leaf_pairs"]
    assert counted[18, 4]["refits"] < counted[18, 2]["refits"]
    assert counted[18, 8]["refits"] < counted[18, 4]["refits"]


def test_normal_cones_prune_self_collision():
    counted = []
    for cones in ("none", "exact"):
        scene = DopScene(cones=cones)
        number = scene.add(*meshes.crumple(24, 0, 0.1))
        counted.append((scene.collide(0.004)[number, number].keys(), scene.counters))
    assert counted[0][0] == counted[1][0]
    assert counted[1][1]["box_tests"] < 0.6 * counted[0][1]["box_tests"]
    assert counted[1][1]["cone_pruned"] > 0 == counted[0][1]["cone_tests"]


def test_leaf_angles_skip_parallel_neighbours_and_keep_layers():
    vertices, faces = meshes.layers(2, 6, 0.01, 0)
    half = len(vertices) // 2
    scene = DopScene(cones="mezger", leaf_angle=0.5, groups=1)
    number = scene.add(vertices, faces)
    scene.collide(0.02)
    assert scene.counters["filtered"] > 0
    plain = DopScene(cones="mezger", groups=1)
    plain.add(vertices, faces)
    plain.collide(0.02)
    assert scene.counters["leaf_pairs"] < plain.counters["leaf_pairs"]
    apart = DopScene(cones="mezger", leaf_angle=0.5)
    a, b = apart.add(vertices[:half], faces[: len(faces) // 2]), apart.add(vertices[half:], faces[: len(faces) // 2])
    assert len(apart.collide(0.02)[a, b]) > 0, "different objects are never filtered"
    assert number == 0


def test_what_vertices_alone_do_not_see():
    """A coarse cloth across the rim of a table: no vertex near, edges in the middle of it [Mezger 2003, Fig. 7 and 8]."""
    sheet = grid(1.0, 1.0, 1, 1)
    post = meshes.moved(meshes.icosphere(0, 0.02), None, (0.31, 0.0, 0.13))
    found = {}
    for name, settings in (("full", {}), ("vertices", {"vertex_only": True}), ("10 particles", {"virtual_particles": 10}),
                           ("66 particles", {"virtual_particles": 66})):  # fmt: skip
        scene = DopScene(**settings)
        a, b = scene.add(sheet.vertices, sheet.faces), scene.add(*post, cloth=False)
        found[name] = scene.collide(0.05)[a, b], scene.counters["primitive_tests"]
    assert len(found["full"][0]) > 0 == len(found["vertices"][0])
    assert len(found["10 particles"][0]) == 0 < len(found["66 particles"][0]), (
        "particles help where they are dense enough"
    )
    assert set(found["66 particles"][0].kinds.tolist()) == {3}
    face, number, other = found["66 particles"][0].quads[0][:3]
    assert 0 <= face < 2 and 0 <= number < 66 and 0 <= other < len(post[1])


def test_bodies_are_tested_against_cloths_only():
    first, second, _ = pair()
    scene = DopScene()
    body, cloth, other = scene.add(*second, cloth=False), scene.add(*first), scene.add(*second, cloth=False)
    assert set(scene.collide(EPS)) == {(body, cloth), (cloth, cloth), (cloth, other)}
    assert set(DopScene(self_collision=False).collide(EPS)) == set()


def test_a_tree_over_the_pattern_answers_the_same():
    flat = meshes.grid(6, 6)
    first, second, _ = pair()
    scene = DopScene(build_space="pattern")
    a = scene.add(*first, pattern=flat[0][:, [0, 2]])
    b = scene.add(*second, pattern=meshes.grid(5, 5)[0])
    assert_complete(scene, a, b)
    assert not np.array_equal(scene._objects[a].tree.node_face, filled()[0]._objects[0].tree.node_face)


def test_nothing_is_allocated_again_once_warm():
    scene, a, _ = filled()
    for x in drifting(3, 1e-4):
        scene.update(a, x)
        scene.collide(EPS)
    held = [(id(link.descent.stack), id(link.descent.pairs), id(link.out)) for link in scene._links.values()]
    for x in drifting(3, 1e-4):
        scene.update(a, x)
        scene.collide(EPS)
    assert held == [(id(link.descent.stack), id(link.descent.pairs), id(link.out)) for link in scene._links.values()]


def test_buffers_grow_and_drop_nothing():
    vertices, faces = meshes.crumple(12, 3)
    scene = DopScene(cones="none", arity=8)
    number = scene.add(vertices, faces)
    near = scene.collide(0.3)[number, number]
    assert len(near) > 5000
    assert near.keys() == scene.brute_force(0.3)[number, number].keys()


@pytest.mark.parametrize(("settings", "said"), [
    ({"k": 7}, ["k = '7'", "18"]), ({"arity": 3}, ["arity = '3'"]), ({"inflation": "round"}, ["inflation = 'round'", "swept"]),
    ({"cones": True}, ["cones = True"]), ({"lazy": -1.0}, ["lazy = -1.0"]), ({"groups": 9}, ["groups = 9"]),
    ({"coherence": True, "lazy": 0.1}, ["coherence", "lazy = 0"]), ({"leaf_angle": 0.5}, ["leaf_angle = 0.5", "exact"]),
    ({"virtual_particles": 100}, ["virtual_particles = 100"]), ({"build_space": "uv"}, ["build_space = 'uv'"]),
])  # fmt: skip
def test_bad_settings_are_named(settings, said):
    with pytest.raises(ValueError) as error:
        DopScene(**settings)
    assert all(part in str(error.value) for part in said)


def test_bad_input_is_named():
    sheet = meshes.grid(2, 2)
    scene = DopScene(lazy=0.01)
    number = scene.add(*sheet)
    cases = (
        (lambda: scene.update(7, sheet[0]), "object 7"),
        (lambda: scene.remove(7), "object 7"),
        (lambda: scene.update(number, sheet[0][:3]), "positions: expected 9 rows, got 3"),
        (lambda: scene.update(number, sheet[0], np.full((9, 3), np.nan), 0.1), "velocities[0, 0] is nan"),
        (lambda: scene.collide(0.01), "epsilon = 0.01"),
        (lambda: scene.collide(-1.0), "epsilon = -1.0"),
        (lambda: scene.add(sheet[0], [[0, 1, 99]]), "faces[0, 2] is 99"),
        (lambda: scene.add(sheet[0], [[0, 1, 1]]), "at least one face"),
        (lambda: DopScene(build_space="pattern").add(*sheet), "pattern"),
    )
    for call, said in cases:
        with pytest.raises(ValueError) as error:
            call()
        assert said in str(error.value)
