"""Inflation of boxes: what each kind holds, and what it may miss."""

from __future__ import annotations

import math

import meshes
import naive_dop
import numpy as np
import pytest

from clothgym.detection.dop_object import DopObject
from clothgym.detection.dop_scene import DopScene
from clothgym.kernels import kdop, oriented

MODES = oriented.INFLATIONS


def boxes(item: DopObject, eps: float, mode: str, wide: float = math.pi / 3) -> np.ndarray:
    item.refit(eps, MODES[mode], wide, 0.0, -1, False)
    return item.tree.boxes


@pytest.mark.parametrize("k", sorted(kdop.AXES))
def test_unoriented_boxes_are_half_eps_wider_on_unit_normals(k):
    vertices, faces = meshes.crumple(5, 0)
    item = DopObject(vertices, faces, None, k, 4, 2, False)
    tight, wider = boxes(item, 0.0, "unoriented").copy(), boxes(item, 0.02, "unoriented")
    lengths = np.linalg.norm(kdop.AXES[k], axis=1)
    assert (tight[:, ::2] - wider[:, ::2]) == pytest.approx(np.tile(0.01 * lengths, (len(tight), 1)))
    assert (wider[:, 1::2] - tight[:, 1::2]) == pytest.approx(np.tile(0.01 * lengths, (len(tight), 1)))
    projected = vertices @ kdop.AXES[k].T
    assert tight[0, ::2] == pytest.approx(projected.min(axis=0))
    assert tight[0, 1::2] == pytest.approx(projected.max(axis=0))


@pytest.mark.parametrize("k", sorted(kdop.AXES))
def test_pairs_just_within_eps_are_found_along_every_axis(k):
    """With eps / 2 unnormalised, as printed, the diagonal axes would miss these."""
    triangle = np.array([[0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0.0]])
    faces = np.array([[0, 1, 2]])
    for way in kdop.AXES[26] / np.linalg.norm(kdop.AXES[26], axis=1)[:, None]:
        scene = DopScene(k=k, cones="none", inflation="unoriented")
        scene.add(triangle, faces)
        scene.add(triangle + 0.5 * way, faces)
        assert len(scene.collide(0.5 + 1e-9)[0, 1]) > 0


@pytest.mark.parametrize("mode", ["conservative", "swept"])
@pytest.mark.parametrize("spread", [0.0, 0.1, 0.5, 3.0])
def test_conservative_boxes_hold_both_ends_of_every_way(mode, spread):
    rng = np.random.default_rng(1)
    vertices, faces = meshes.crumple(6, 2)
    ways = 0.2 * (rng.normal(size=3) + spread * rng.normal(size=vertices.shape))
    item = DopObject(vertices, faces, None, 18, 4, 2, False)
    item.update(vertices, ways, 1.0)
    held = boxes(item, 0.0, mode)
    tree, axes = item.tree, kdop.AXES[18]
    for node in np.flatnonzero(tree.child_count == 0):
        ids = faces[tree.node_face[node]]
        for share in (0.0, 0.5, 1.0):
            projected = (vertices[ids] + share * ways[ids]) @ axes.T
            assert (projected.min(axis=0) >= held[node, ::2] - 1e-12).all()
            assert (projected.max(axis=0) <= held[node, 1::2] + 1e-12).all()


def test_eq_1_as_printed_leaves_out_what_a_cone_of_some_width_reaches():
    """The axis is the mean: a corner that turns off to the side is not covered across it."""
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.0]])
    ways = np.array([[1, 0, 0.5], [1, 0, -0.5], [1, 0, 0.0]])
    item = DopObject(vertices, np.array([[0, 1, 2]]), None, 6, 2, 0, False)
    item.update(vertices, ways, 1.0)
    literal = boxes(item, 0.0, "oriented").copy()
    assert literal[0, 5] == pytest.approx(0.0, abs=1e-12) and literal[0, 4] == pytest.approx(0.0, abs=1e-12)
    full = boxes(item, 0.0, "conservative")
    assert full[0, 5] >= 0.5 and full[0, 4] <= -0.5
    assert literal[0, 0] == pytest.approx(0.0), "nothing behind the motion"
    assert literal[0, 1] == pytest.approx(0.1 + math.hypot(1.0, 0.5)), "the largest speed along the axis"


def test_wide_cones_are_inflated_on_all_sides():
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.0]])
    ways = np.array([[0.3, 0, 0], [-0.3, 0, 0.1], [0, 0.2, 0.0]])
    item = DopObject(vertices, np.array([[0, 1, 2]]), None, 6, 2, 0, False)
    item.update(vertices, ways, 1.0)
    high = np.linalg.norm(ways, axis=1).max()
    printed = boxes(item, 0.1, "oriented").copy()
    assert printed[0] == pytest.approx([-high, 0.1 + high, -high, 0.1 + high, -high, high])
    summed = boxes(item, 0.1, "conservative", wide=0.1)
    reach = high + 0.05
    assert summed[0] == pytest.approx([-reach, 0.1 + reach, -reach, 0.1 + reach, -reach, reach])
    assert boxes(item, 4.0, "oriented")[0, 4] == pytest.approx(-2.0), "the larger of eps / 2 and speed dt"


def moving_pair(seed: int, speed: float):
    rng = np.random.default_rng(seed)
    first = meshes.crumple(4, seed)
    second = meshes.moved(meshes.crumple(3, seed + 1), meshes.rotation(seed), (0.3, 0.25, 0.2))
    ways = [
        speed * (rng.normal(size=3) + 0.3 * rng.normal(size=mesh[0].shape)) for mesh in (first, second)
    ]  # fmt: skip
    return first, second, ways


@pytest.mark.parametrize("cones", ["none", "exact"])
@pytest.mark.parametrize("mode", ["conservative", "swept"])
@pytest.mark.parametrize("seed", range(3))
def test_nothing_that_comes_near_within_the_step_is_missed(mode, cones, seed):
    first, second, ways = moving_pair(seed, 0.15)
    scene = DopScene(inflation=mode, cones=cones)
    a, b = scene.add(*first), scene.add(*second)
    scene.update(a, first[0], ways[0] / 0.02, 0.02)
    scene.update(b, second[0], ways[1] / 0.02, 0.02)
    answer = scene.collide(0.01)
    vertices, faces = meshes.merged(first, second)
    true = naive_dop.between(naive_dop.keys_within(vertices, np.concatenate(ways), faces, 0.01, 4), len(first[0]))
    assert sum(len(part) for part in true.values()) > 5
    assert true["first"] <= answer[a, a].keys()
    assert true["both"] <= answer[a, b].keys()
    assert true["second"] <= answer[b, b].keys()
    missing, occurring = scene.misses(answer, 0.01)
    assert missing == 0 and occurring >= sum(len(part) for part in true.values())


def test_unoriented_inflation_misses_fast_motion_and_costs_more_when_it_is_made_not_to():
    """What the paper gains: the same misses need boxes that are large on all sides."""
    sheet = meshes.grid(16, 16)
    lower = meshes.moved(sheet, None, (0.0, -0.1, 0.0))
    found = {}
    for name, eps in (("unoriented", 0.01), ("unoriented wide", 0.13), ("conservative", 0.01), ("oriented", 0.01)):
        scene = DopScene(inflation=name.split()[0], cones="none", self_collision=False)
        a, _ = scene.add(*sheet), scene.add(*lower)
        ways = np.tile([0.0, -0.11, 0.0], (len(sheet[0]), 1))
        scene.update(a, sheet[0], ways, 1.0)
        answer = scene.collide(eps)
        found[name] = (scene.misses(answer, 0.01), scene.counters["box_tests"])
    assert found["unoriented"][0][0] == found["unoriented"][0][1] > 100
    assert found["conservative"][0][0] == found["oriented"][0][0] == found["unoriented wide"][0][0] == 0
    assert 2 * found["conservative"][1] < found["unoriented wide"][1]
