"""Continuous tests: the first time of contact on straight ways, never late, never where nothing is."""

from __future__ import annotations

import math

import naive_dop
import numpy as np
import pytest

from clothgym.kernels import continuous


def first_time(points, ways, kind: int, eps: float = 0.0) -> float:
    times = np.empty(1)
    x = np.ascontiguousarray(points, np.float64)
    continuous.first_times(
        x,
        np.ascontiguousarray(ways, np.float64),
        np.arange(4, dtype=np.int32)[None],
        np.array([kind], np.int8),
        eps,
        times,
    )
    return float(times[0])


def meeting(rng, kind: int, time: float, flat: float = 1.0):
    """Four moving points that touch at a time: vertex and triangle, or edge and edge, somewhere inside."""
    points, ways = rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    points[:, 2] *= flat
    ways[:, 2] *= flat
    at = points + time * ways
    if kind == 0:
        w = rng.dirichlet([2, 2, 2])
        gap = at[0] - w @ at[1:]
        points[0] -= gap
    else:
        s, t = rng.uniform(0.1, 0.9, 2)
        gap = at[0] + s * (at[1] - at[0]) - at[2] - t * (at[3] - at[2])
        points[:2] -= gap
    return points, ways


@pytest.mark.parametrize("kind", [0, 1])
@pytest.mark.parametrize("flat", [1.0, 1e-3, 1e-7])
def test_contacts_are_found_in_time_and_are_contacts(kind, flat):
    rng = np.random.default_rng(kind)
    early = 0
    for _ in range(150):
        time = rng.uniform(0.02, 0.98)
        points, ways = meeting(rng, kind, time, flat)
        found = first_time(points, ways, kind)
        assert found <= time + 1e-7
        early += found < time - 1e-6
        assert naive_dop.distance(points + found * ways, kind) < 1e-7
    assert early < 150 or flat < 1.0


@pytest.mark.parametrize("kind", [0, 1])
def test_nothing_is_reported_where_nothing_comes_near(kind):
    rng = np.random.default_rng(5 + kind)
    seen = {"hit": 0, "none": 0}
    for _ in range(200):
        points, ways = rng.normal(size=(4, 3)), 2.0 * rng.normal(size=(4, 3))
        found = first_time(points, ways, kind)
        if found <= 1.0:
            seen["hit"] += 1
            assert naive_dop.distance(points + found * ways, kind) < 1e-7
            before = naive_dop.least_distance(points, 0.999 * found * ways, kind, 101)
            assert before > 0.0
        else:
            seen["none"] += 1
            assert naive_dop.least_distance(points, ways, kind) > 1e-6
    assert min(seen.values()) > 5


def test_motion_in_one_plane_is_decided_by_distance():
    """The cubic vanishes throughout: a vertex that slides into a triangle's side, and edges that meet end to end."""
    triangle = np.array([[3.0, 0.2, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0]])
    into = np.zeros((4, 3))
    into[0] = [-3, 0, 0]
    assert first_time(triangle, into, 0) == pytest.approx(2.2 / 3.0, abs=1e-6)
    past = triangle.copy()
    past[0, 1] += 2.0
    assert first_time(past, into, 0) == math.inf
    edges = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0.0]])
    ways = np.array([[0.0, 0, 0], [0, 0, 0], [-2, 0, 0], [-2, 0, 0]])
    assert first_time(edges, ways, 1) == pytest.approx(0.5, abs=1e-6)
    edges[2:, 1] += 0.1
    assert first_time(edges, ways, 1) == math.inf


def test_degenerate_triangles_and_still_pairs():
    line = np.array([[0.5, 1, 0], [0, 0, 0], [0.5, 0, 0], [1, 0, 0.0]])
    down = np.zeros((4, 3))
    down[0] = [0, -2, 0]
    assert first_time(line, down, 0) == pytest.approx(0.5, abs=1e-6)
    still = np.zeros((4, 3))
    assert first_time(line, still, 0) == math.inf
    touching = line.copy()
    touching[0] = [0.25, 0, 0]
    assert first_time(touching, still, 0) == 0.0
    point = np.zeros((4, 3))
    point[0] = [0, 0, 1]
    way = np.zeros((4, 3))
    way[0] = [0, 0, -4]
    assert first_time(point, way, 0) == pytest.approx(0.25, abs=1e-6)


def test_grazing_turns_and_both_crossings():
    """A vertex goes through a turning triangle twice: the first time counts."""
    points = np.array([[0.2, 0.2, -0.5], [0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    ways = np.zeros((4, 3))
    ways[0] = [0, 0, 1]
    assert first_time(points, ways, 0) == pytest.approx(0.5, abs=1e-9)
    ways[1:] = [0, 0, 0.5]
    assert first_time(points, ways, 0) == pytest.approx(1.0, abs=1e-8)
    # a side that is met exactly
    points = np.array([[0.5, 0.0, 1.0], [0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    ways = np.zeros((4, 3))
    ways[0] = [0, 0, -2]
    assert first_time(points, ways, 0) == pytest.approx(0.5, abs=1e-7)


@pytest.mark.parametrize("kind", [0, 1])
def test_times_of_a_distance(kind):
    rng = np.random.default_rng(8)
    hits = 0
    for _ in range(150):
        points, ways = 0.6 * rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
        found = first_time(points, ways, kind, 0.2)
        least = naive_dop.least_distance(points, ways, kind)
        if found <= 1.0:
            hits += 1
            assert naive_dop.distance(points + found * ways, kind) <= 0.2 + 1e-6
            if found > 1e-3:
                assert naive_dop.least_distance(points, (found - 1e-4) * ways, kind) > 0.2 - 1e-9
        else:
            assert least > 0.2
    assert 10 < hits < 140
