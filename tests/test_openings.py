"""Openings and limbs against plain floats, the linking number, and bodies of the package."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from naive_body import linking_number

from clothgym import rig
from clothgym.detection.openings import LEGS, Threading, crossing_number, expected_limb, threading
from clothgym.rig import Limb

UP = np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])


def circle(centre=(0.0, 0.0, 0.0), radius=0.1, count=16, turned=False):
    """Around a line along y; its right-hand normal is +y, -y when turned."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False) * (1.0 if turned else -1.0)
    return np.column_stack([radius * np.cos(angle), np.zeros(count), radius * np.sin(angle)]) + np.asarray(
        centre, float
    )


def naive_crossings(loop, path):
    """Segments of the path against triangles of the fan, in plain floating point."""
    apex, number = loop.mean(axis=0), 0
    for s, e in itertools.pairwise(path):
        for a, b in zip(loop, np.roll(loop, -1, axis=0)):
            normal = np.cross(a - apex, b - apex)
            below, above = normal @ (s - apex), normal @ (e - apex)
            if (below > 0.0) == (above > 0.0):
                continue
            hit = s + below / (below - above) * (e - s)
            if min(normal @ np.cross(q - p, hit - p) for p, q in ((apex, a), (a, b), (b, apex))) >= 0.0:
                number += 1 if above > 0.0 else -1
    return number


def test_the_sense_of_a_crossing():
    assert crossing_number(circle(), UP) == 1
    assert crossing_number(circle(turned=True), UP) == -1
    assert crossing_number(circle(), UP[::-1]) == -1
    assert crossing_number(circle((0.15, 0, 0)), UP) == 0, "beside the loop"
    assert crossing_number(circle((0, 1.1, 0)), UP) == 0, "beyond the end"
    assert crossing_number(circle(), [[0, -1, 0], [0, 1, 0], [0.02, -1, 0.03]]) == 0, "there and back"
    assert (
        crossing_number(circle(), [[0, -1, 0], [0, 1, 0], [1, 1, 0], [1, -1, 0], [0.02, -1, 0], [0.02, 1, 0.01]]) == 2
    )
    twice = np.concatenate([circle(), circle((0, 0.01, 0))])
    assert crossing_number(twice, UP) == 2, "a loop that winds twice"


def test_against_plain_floats():
    rng = np.random.default_rng(0)
    seen = []
    for _ in range(300):
        loop = circle(rng.uniform(-0.05, 0.05, 3), 0.1, int(rng.integers(3, 20))) + rng.normal(0, 0.02, 3)
        loop += rng.normal(0.0, 0.03, loop.shape)
        path = rng.uniform(-0.3, 0.3, (int(rng.integers(2, 7)), 3))
        number = crossing_number(loop, path)
        assert number == naive_crossings(loop, path)
        assert crossing_number(loop[::-1], path) == -number
        assert crossing_number(loop, path[::-1]) == -number
        start = int(rng.integers(len(loop)))
        assert crossing_number(np.roll(loop, start, axis=0), path) == number
        seen.append(number)
    assert {-1, 0, 1} <= set(seen)
    assert sum(n != 0 for n in seen) > 40


def test_closed_paths_have_the_linking_number():
    rng = np.random.default_rng(1)
    seen = []
    for _ in range(40):
        loop = rng.normal(0.0, 0.2, (int(rng.integers(3, 8)), 3))
        path = rng.normal(0.0, 0.2, (int(rng.integers(3, 8)), 3))
        integral = linking_number(loop, path, 160)
        if abs(integral - round(integral)) > 0.05:
            continue  # curves that nearly touch: the sum is not there yet
        number = crossing_number(loop, np.concatenate([path, path[:1]]))
        assert number == round(integral)
        seen.append(number)
    assert len(seen) > 25
    assert {-1, 1} <= set(seen)


SQUARE = np.array([[1.0, 0, 1], [1, 0, -1], [-1, 0, -1], [-1, 0, 1]])  # fan of four triangles in y = 0, normal +y


PLACES = [(0, 0), (0.5, 0.5), (0.5, -0.5), (-0.25, 0.25), (0.5, 0.0), (0.0, 0.25), (0.0, -0.75)]


@pytest.mark.parametrize("where", PLACES)
def test_lattice_paths_through_apex_and_fan_edges_count_once(where):
    x, z = where
    for loop, sense in ((SQUARE, 1), (SQUARE[::-1], -1)):
        for way in (
            [[x, -1, z], [x, 1, z]],
            [[x, -1, z], [x, 0, z], [x, 1, z]],
            [[x, -1, z], [x, 0, z], [x, 0, z], [x, 1, z]],
        ):
            assert crossing_number(loop, np.array(way, float)) == sense, "in steps that end on the fan, too"
        touch = np.array([[x, -1, z], [x, 0, z], [x, -1, z]], float)
        assert crossing_number(loop, touch) == 0, "touches and turns back"
        along = np.array([[x, -1, z], [x, 0, z], [0.1, 0, 0.05], [0.1, 1, 0.05]], float)
        assert crossing_number(loop, along) == sense, "runs within the fan for a while"


def test_degenerate_loops_and_paths():
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert crossing_number(flat, [[1.0, -1, 0.5], [1, 1, 0.5]]) == 0
    assert crossing_number(np.zeros((5, 3)), [[1.0, -1, 1], [1, 1, 1]]) == 0
    assert crossing_number(circle() + 1e3, UP + 1e3) == 1
    repeated = np.repeat(circle(), 2, axis=0)
    assert crossing_number(repeated, UP) == 1


def test_bad_input_is_told():
    with pytest.raises(ValueError, match="loop, path: expected at least 3 and 2 points, got 2 and 2"):
        crossing_number(np.zeros((2, 3)), UP)
    with pytest.raises(ValueError, match="got 3 and 1"):
        crossing_number(np.zeros((3, 3)), UP[:1])
    with pytest.raises(ValueError, match=r"loop\[0, 1\] is nan"):
        crossing_number([[0, np.nan, 0]] * 3, UP)
    with pytest.raises(ValueError, match="limbs: none"):
        expected_limb(circle(), ())


# ---------------------------------------------------------------------------------------------------------------
# limbs of the package's bodies

LIMBS = ("head", "left_arm", "right_arm", "left_leg", "right_leg")


@pytest.fixture(scope="module", params=["female", "male"])
def limbs(request):
    return {limb.name: limb for limb in rig.load(request.param).limbs("a_pose")}


def around(limb: Limb, share: float, radius: float, turned=False):
    """A circle around a limb at a share of the way from its start to its tip (without what leaves the body)."""
    own = limb.points[limb.start : -1]
    lengths = np.linalg.norm(np.diff(own, axis=0), axis=1)
    along = share * lengths.sum()
    piece = min(int(np.searchsorted(np.cumsum(lengths), along)), len(lengths) - 1)
    rest = along - lengths[:piece].sum()
    direction = (own[piece + 1] - own[piece]) / lengths[piece]
    one = np.cross(direction, [0.0, 0.0, 1.0] if abs(direction[2]) < 0.9 else [1.0, 0, 0])
    one /= np.linalg.norm(one)
    two = np.cross(direction, one)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)[:, None] * (-1.0 if turned else 1.0)
    return own[piece] + rest * direction + radius * (np.cos(angle) * one + np.sin(angle) * two)


@pytest.mark.parametrize("name", LIMBS)
def test_loops_around_limbs(limbs, name):
    limb = limbs[name]
    assert tuple(limbs) == LIMBS
    for share in (0.3, 0.6) if name != "head" else (0.4,):
        loop = around(limb, share, 0.07)
        assert expected_limb(loop, tuple(limbs.values())) == name
        found = threading(loop, tuple(limbs.values()), name)
        assert found.crossings[name] == 1
        assert found.through == (name,)
        assert found.right
        assert threading(around(limb, share, 0.07, True), tuple(limbs.values()), name).crossings[name] == -1
        for other in set(LIMBS) - {name}:
            assert not threading(loop, tuple(limbs.values()), other).right
        away = loop + np.array([0.0, 0.0, 0.5])
        assert threading(away, tuple(limbs.values()), name).through == ()
        assert not threading(away, tuple(limbs.values()), name).right


def test_waists_and_hems_hold_both_legs(limbs):
    every = tuple(limbs.values())
    left, right = limbs["left_leg"], limbs["right_leg"]
    hip = 0.5 * (left.points[left.start] + right.points[right.start])
    knee = 0.5 * (left.points[left.start + 1] + right.points[right.start + 1])
    for centre in (hip + np.array([0.0, 0.12, 0.0]), knee, knee - [0, 0.1, 0]):
        for turned in (False, True):
            loop = circle(centre, 0.3, turned=turned)
            assert expected_limb(loop, every) == LEGS
            found = threading(loop, every, LEGS)
            assert set(found.through) == {"left_leg", "right_leg"}
            assert found.right
            assert found.crossings["left_leg"] == found.crossings["right_leg"] == (1 if turned else -1)
            assert not threading(loop, every, "left_leg").right, "the other leg is in it as well"
    one = circle(left.points[left.start + 1], 0.09)
    assert expected_limb(one, every) == "left_leg"
    assert not threading(one, every, LEGS).right


def test_what_is_right():
    def told(expected, **crossings):
        return Threading(expected, {name: crossings.get(name, 0) for name in LIMBS}).right

    assert told("head", head=1)
    assert told("head", head=-1)
    assert not told("head")
    assert not told("head", head=2), "wound twice around"
    assert not told("head", head=1, left_arm=1)
    assert not told("left_arm", right_arm=1)
    assert told(LEGS, left_leg=1, right_leg=1)
    assert told(LEGS, left_leg=-1, right_leg=-1)
    assert not told(LEGS, left_leg=1, right_leg=-1), "the opening is twisted between them"
    assert not told(LEGS, left_leg=1)
    assert not told(LEGS, left_leg=1, right_leg=1, head=1)
    assert not Threading("tail", {"head": 1}).right
    assert not Threading("head", {}).right
    assert Threading("head", {"head": 1, "left_arm": 0, "right_arm": -1}).through == ("head", "right_arm")


def test_a_body_with_one_leg_fills_no_hem():
    """Both legs are expected; one alone is not enough."""
    assert not Threading("legs", {"head": 0, "left_leg": 1}).right
    assert Threading("legs", {"head": 0, "left_leg": -1, "right_leg": -1}).right
