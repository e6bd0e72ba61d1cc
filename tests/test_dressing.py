"""Limbs, openings, depth, potential, and the proof against passing sideways, each against a slow and obvious version."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import trimesh
from clothgym_envs import dressing
from clothgym_envs.dressing import APPROACH, CORE, ENTRY, WRONG, LimbPath

STRAIGHT = LimbPath(np.array([[-0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]), 0.05)
BENT = LimbPath(np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.4, 0.2, 0.1]]), 0.04)


def ring(x: float = 0.0, y: float = 0.0, z: float = 0.0, radius: float = 0.09, count: int = 16, turned: bool = False):
    """A circle around a line along x; its normal points to +x, or to -x when turned."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False) * (-1.0 if turned else 1.0)
    return np.column_stack([np.full(count, x), y + radius * np.cos(angle), z + radius * np.sin(angle)])


def dense(limb: LimbPath, count: int = 4001) -> tuple[np.ndarray, np.ndarray]:
    """Points on a path and how far each is from the tip."""
    places, along, done = [], [], 0.0
    for end, start in zip(limb.points[:0:-1], limb.points[-2::-1]):  # from the tip on
        share = np.linspace(0.0, 1.0, count)[:, None]
        places.append(end + share * (start - end))
        along.append(done + share[:, 0] * np.linalg.norm(start - end))
        done += float(np.linalg.norm(start - end))
    return np.concatenate(places), np.concatenate(along)


# limbs


@pytest.mark.parametrize("limb", [STRAIGHT, BENT], ids=["straight", "bent"])
def test_the_closest_place_on_a_limb(limb):
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (60, 3))
    places, along, ahead = limb.closest(points)
    samples, lengths = dense(limb)
    gaps = np.linalg.norm(points[:, None] - samples, axis=2)
    assert np.linalg.norm(points - places, axis=1) == pytest.approx(gaps.min(axis=1), abs=1e-6)
    assert along == pytest.approx(lengths[gaps.argmin(axis=1)], abs=3e-4)
    assert limb.at(along) == pytest.approx(places, abs=1e-12)
    assert np.linalg.norm(ahead, axis=1) == pytest.approx(1.0)
    assert limb.at(along + 1e-6) - limb.at(along) == pytest.approx(1e-6 * ahead, abs=1e-9)
    assert dressing.path_distances(points, limb.points) == pytest.approx(gaps.min(axis=1), abs=1e-6)
    assert limb.skin_distances(points) == pytest.approx(gaps.min(axis=1) - limb.radius, abs=1e-6)


def test_lengths_run_from_the_tip():
    assert BENT.length == pytest.approx(0.3 + math.sqrt(0.06))
    assert BENT.at(0.0)[0] == pytest.approx(BENT.tip)
    assert BENT.at(BENT.length)[0] == pytest.approx(BENT.points[0])
    assert BENT.at(-0.1)[0] == pytest.approx(BENT.tip + 0.1 * np.array([0.1, 0.2, 0.1]) / math.sqrt(0.06))
    assert STRAIGHT.rooted[0] == pytest.approx([-0.5 - dressing.ROOTED, 0.0, 0.0])


def test_grippers_stay_out():
    rng = np.random.default_rng(1)
    for limb in (STRAIGHT, BENT):
        for point in rng.uniform(-0.5, 0.5, (200, 3)):
            kept = limb.keep_out(point)
            distance = limb.skin_distances(kept[None])[0]
            assert distance >= dressing.GRIPPER_RADIUS - 1e-9
            if limb.skin_distances(point[None])[0] >= dressing.GRIPPER_RADIUS:
                assert (kept == point).all()
            elif limb is STRAIGHT:
                assert distance == pytest.approx(dressing.GRIPPER_RADIUS)
    assert STRAIGHT.skin_distances(STRAIGHT.keep_out([-0.2, 0.0, 0.0])[None])[0] == pytest.approx(0.01), "on the axis"


def test_the_mesh_of_a_limb():
    limb = LimbPath(np.array([[0.3, -0.2, 0.1], [0.1, 0.3, 0.2]]), 0.05)
    vertices, faces = limb.mesh()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    capsule = math.pi * 0.05**2 * (limb.length + 4.0 / 3.0 * 0.05)
    assert mesh.volume == pytest.approx(capsule, rel=0.02)
    assert limb.skin_distances(vertices) == pytest.approx(0.0, abs=1e-9)
    assert limb.skin_distances(mesh.triangles_center).min() > -1e-3
    with pytest.raises(ValueError, match="a capsule is straight"):
        BENT.mesh()


def test_bad_limbs_are_told():
    with pytest.raises(ValueError, match="limb: points: expected at least two"):
        LimbPath(np.zeros((1, 3)), 0.1)
    with pytest.raises(ValueError, match="limb: points: expected at least two, all apart"):
        LimbPath(np.zeros((2, 3)), 0.1)
    with pytest.raises(ValueError, match=r"limb: radius = 0\.0"):
        LimbPath(np.array([[0.0, 0, 0], [1, 0, 0]]), 0.0)


# openings


def test_measures_of_a_ring():
    opening = dressing.measure(ring(0.1, 0.2, -0.3))
    assert opening.centroid == pytest.approx([0.1, 0.2, -0.3])
    assert opening.normal == pytest.approx([1.0, 0.0, 0.0], abs=1e-12)
    assert (opening.mean_radius, opening.least_radius) == pytest.approx((0.09, 0.09))
    assert dressing.measure(ring(turned=True)).normal[0] == pytest.approx(-1.0)
    flat = ring()
    flat[:, 1] = 0.0
    assert (dressing.measure(flat).normal == 0.0).all()
    assert dressing.measure(flat).least_radius == pytest.approx(0.0, abs=1e-12)


def test_measures_move_with_the_ring():
    rng = np.random.default_rng(2)
    loop = ring() + rng.normal(0.0, 0.01, (16, 3))
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    here, there = dressing.measure(loop), dressing.measure(loop @ turn.T + [1.0, 2.0, 3.0])
    assert there.centroid == pytest.approx(turn @ here.centroid + [1.0, 2.0, 3.0])
    assert there.normal == pytest.approx(turn @ here.normal)
    assert there[2:] == pytest.approx(here[2:])


def test_threading_has_a_sign():
    assert dressing.threaded(ring(-0.2), STRAIGHT) == 1
    assert dressing.threaded(ring(-0.2, turned=True), STRAIGHT) == -1
    assert dressing.threaded(ring(0.02), STRAIGHT) == 0, "in front of the tip"
    assert dressing.threaded(ring(-0.2, 0.15), STRAIGHT) == 0, "beside the limb"
    assert dressing.threaded(ring(-3.0), STRAIGHT) == 1, "behind the root: it can only have come over the tip"


def test_where_an_opening_sits():
    loop = ring(-0.1, 0.01)
    worn = dressing.worn(loop, dressing.measure(loop), STRAIGHT, 0.25)
    assert worn == pytest.approx((1, 0.4, 0.1, 0.01))
    for place, turned in ((0.1, False), (-0.1, True)):
        loop = ring(place, 0.01, turned=turned)
        worn = dressing.worn(loop, dressing.measure(loop), STRAIGHT, 0.25)
        assert worn == pytest.approx((-1 if turned else 0, 0.0, -place, 0.01)), "depth is for the right way only"
    loop = ring(-0.3)
    assert dressing.worn(loop, dressing.measure(loop), STRAIGHT, 0.25).depth == 1.0


# passing sideways


def naive_distance(a, b, p, q, count: int = 200) -> float:
    """Between two segments, by trying out places on both."""
    s = np.linspace(0.0, 1.0, count)[:, None]
    one, two = a + s * (b - a), p + s * (q - p)
    return float(np.linalg.norm(one[:, None] - two[None], axis=2).min())


def test_distances_of_edges_from_a_path():
    rng = np.random.default_rng(3)
    starts, ends = rng.uniform(-0.3, 0.3, (2, 40, 3))
    ends[0] = starts[0]  # no length
    ends[1] = starts[1] + 0.2 * (BENT.points[1] - BENT.points[0])  # parallel
    found = dressing.edge_distances(starts, ends, BENT.points)
    for n, distance in enumerate(found):
        naive = min(naive_distance(starts[n], ends[n], p, q) for p, q in zip(BENT.points, BENT.points[1:]))
        assert distance <= naive + 1e-12
        assert naive - distance < 3e-3


def naive_side(a, b, p, q) -> float:
    return float(np.dot(np.cross(b - a, q - p), p - a))


def naive_crossings(loop: np.ndarray, limb: LimbPath) -> int:
    """Signed crossings of a straight limb with the fan, in plain floating point."""
    centre, (p, q), number = loop.mean(axis=0), limb.rooted, 0
    for a, b in zip(loop, np.roll(loop, -1, axis=0)):
        normal = np.cross(a - centre, b - centre)
        below, above = np.dot(normal, p - centre), np.dot(normal, q - centre)
        if below * above >= 0.0:
            continue
        hit = p + below / (below - above) * (q - p)
        inside = [np.dot(np.cross(v - u, hit - u), normal) for u, v in ((centre, a), (a, b), (b, centre))]
        if min(inside) >= 0.0:
            number += 1 if above > 0.0 else -1
    return number


def fan_distance(loop: np.ndarray, point: np.ndarray) -> float:
    """Of a point from the fan, by trying out places on it."""
    centre = loop.mean(axis=0)
    s = np.linspace(0.0, 1.0, 60)
    rim = np.concatenate([a + s[:, None] * (b - a) for a, b in zip(loop, np.roll(loop, -1, axis=0))])
    places = centre + s[:, None, None] * (rim - centre)
    return float(np.linalg.norm(places - point, axis=2).min())


def touches(before: np.ndarray, after: np.ndarray, limb: LimbPath, times: int = 400) -> bool:
    """Whether an edge of a loop that moves linearly goes through a straight limb's path, from many moments: the edge's
    line changes its side of the path's line while the two meet within both."""
    p, q = limb.rooted
    moments = [before + t * (after - before) for t in np.linspace(0.0, 1.0, times)]
    for one, two in itertools.pairwise(moments):
        for k in range(len(one)):
            a, b = one[k], one[(k + 1) % len(one)]
            c, d = two[k], two[(k + 1) % len(two)]
            if naive_side(a, b, p, q) * naive_side(c, d, p, q) < 0.0:
                way = q - p
                flat = [v - np.dot(v - p, way) / np.dot(way, way) * way for v in (a, b)]
                along = np.dot(flat[1] - flat[0], flat[1] - flat[0])
                share = np.dot(p - flat[0], flat[1] - flat[0]) / along if along > 0.0 else -1.0
                place = np.dot(a + share * (b - a) - p, way) / np.dot(way, way)
                if 0.0 <= share <= 1.0 and 0.0 <= place <= 1.0:
                    return True
    return False


def test_what_touches_the_limbs_path_is_always_found():
    """Against linear motion looked at in many moments; slow and fast, whole rings and crumpled ones."""
    rng = np.random.default_rng(4)
    found = missed = clear = leaps = 0
    for number in range(240):
        count = int(rng.integers(3, 9))
        before = ring(*rng.uniform((-0.3, -0.15, -0.15), (0.05, 0.15, 0.15)), 0.08, count, bool(number % 2))
        before += rng.normal(0.0, 0.03, before.shape)
        reach = 10.0 ** rng.uniform(-2.5, -0.3)
        after = before + rng.normal(0.0, reach, 3) + rng.normal(0.0, 0.3 * reach, before.shape)
        told = dressing.passed_sideways(before, after, STRAIGHT)
        truth = touches(before, after, STRAIGHT, 100)
        ends = np.concatenate([before, after]), np.concatenate([np.roll(before, -1, 0), np.roll(after, -1, 0)])
        leaps += truth and dressing.edge_distances(*ends, STRAIGHT.rooted).min() > CORE * STRAIGHT.radius
        found += truth and told
        missed += truth and not told
        clear += not told
    assert missed == 0
    assert found > 25
    assert leaps > 5, "clear before and after, and through all the same"
    assert clear > 20


def test_without_a_passage_only_the_tip_changes_the_number():
    """Every change of the crossing number in linear motion that is not reported happens with the tip in the fan."""
    rng = np.random.default_rng(5)
    changes = 0
    for _ in range(400):
        x, y, z = rng.uniform(-0.04, 0.04, 3)
        before = ring(0.01 + x, y, z, count=12)
        before += rng.normal(0.0, 0.008, before.shape)
        after = before + rng.normal(0.0, 0.02, 3) + rng.normal(0.0, 0.003, before.shape)
        if dressing.passed_sideways(before, after, STRAIGHT):
            continue
        assert naive_crossings(before, STRAIGHT) == dressing.threaded(before, STRAIGHT)
        if dressing.threaded(before, STRAIGHT) == dressing.threaded(after, STRAIGHT):
            continue
        changes += 1
        moments = [before + t * (after - before) for t in np.linspace(0.0, 1.0, 60)]
        numbers = [naive_crossings(loop, STRAIGHT) for loop in moments]
        for k in np.flatnonzero(np.diff(numbers)):
            way = np.linalg.norm(moments[k + 1] - moments[k], axis=1).max()
            assert fan_distance(moments[k], STRAIGHT.tip) <= way + 2e-3
    assert changes > 30


def travel(path, turned: bool = False, steps: int = 100, radius: float = 0.09) -> tuple[bool, int]:
    """A ring along corners of a path: whether it was reported, and how often the limb goes through it at the end."""
    places = np.concatenate([np.linspace(a, b, steps) for a, b in zip(np.array(path), np.array(path)[1:])])
    loops = [ring(*place, turned=turned, radius=radius) for place in places]
    reported = any(dressing.passed_sideways(a, b, STRAIGHT) for a, b in itertools.pairwise(loops))
    return reported, dressing.threaded(loops[-1], STRAIGHT)


def test_ways_of_a_ring():
    assert travel([(0.2, 0, 0), (-0.3, 0, 0)]) == (False, 1), "over the tip"
    assert travel([(0.2, 0, 0), (-0.3, 0, 0)], turned=True) == (False, -1), "over the tip, the wrong way round"
    assert travel([(0.2, 0, 0), (-0.3, 0, 0), (0.2, 0, 0)]) == (False, 0), "on and off"
    assert travel([(-0.2, 0.2, 0), (-0.2, 0, 0)]) == (True, 1), "torn through from the side"
    assert travel([(-0.2, 0.2, 0), (-0.2, -0.2, 0)]) == (True, 0), "through and through: in and out"
    assert travel([(-0.2, 0.2, 0), (-0.2, 0, 0)], steps=2) == (True, 1), "in one leap"
    assert travel([(0.2, 0.2, 0), (-0.3, 0.2, 0)]) == (False, 0), "beside the limb"
    assert travel([(0.2, 0.04, 0.03), (-0.3, 0.04, 0.03)])[0] is False, "against the skin"
    assert travel([(0.2, 0.08, 0), (-0.3, 0.08, 0)])[0] is True, "an edge deep in the limb"
    assert travel([(-2.0, 0.3, 0), (-2.0, 0, 0)])[0] is True, "around the root's end"


def test_a_border_on_the_skin_is_no_passage():
    for sides in (12, 16, 42):
        loop = ring(-0.2, radius=STRAIGHT.radius, count=sides)
        assert not dressing.passed_sideways(loop, loop + np.array([0.004, 0.0, 0.0]), STRAIGHT)
    loop = ring(-0.2, radius=1.02 * CORE * STRAIGHT.radius, count=64)
    assert not dressing.passed_sideways(loop, loop, STRAIGHT)
    assert dressing.passed_sideways(0.9 * loop, 0.9 * loop, STRAIGHT)


# potential and forces


def worth(loop: np.ndarray, tunnelled: bool = False) -> float:
    opening = dressing.measure(loop)
    worn = dressing.worn(loop, opening, STRAIGHT, 0.25)
    return dressing.potential(worn, opening, STRAIGHT, 0.4, tunnelled)


def test_the_potential_rises_all_the_way():
    values = [worth(ring(x)) for x in np.linspace(0.4, -0.25, 131)]
    assert (np.diff(values) > 0.0).all()
    assert np.diff(values).max() < ENTRY - APPROACH + 0.02, "no leaps but the small one at the tip"
    assert values[0] == pytest.approx(0.0, abs=1e-9)
    assert values[-1] == pytest.approx(1.0)
    assert worth(ring(1e-6)) == pytest.approx(APPROACH, abs=1e-4)
    assert worth(ring(-1e-6)) == pytest.approx(ENTRY, abs=1e-4)


def test_there_is_little_to_collect_outside():
    rng = np.random.default_rng(6)
    for _ in range(300):
        loop = ring(*rng.uniform(-0.4, 0.4, 3), turned=bool(rng.random() < 0.5)) + rng.normal(0.0, 0.01, (16, 3))
        number = dressing.threaded(loop, STRAIGHT)
        value = worth(loop)
        assert WRONG <= value <= 1.0
        if number == 0:
            assert 0.0 <= value <= APPROACH
        elif number < 0:
            assert value == WRONG
        assert worth(loop, tunnelled=True) == WRONG
    assert worth(ring(-0.2, 0.15)) < 0.5 * APPROACH < worth(ring(0.05)), "beside the limb is worse than in front of it"
    assert worth(ring(0.05, turned=True)) == pytest.approx(0.5 * worth(ring(0.05)))


def test_forces():
    assert dressing.limb_force(np.zeros((0, 3))) == (0.0, 0.0)
    squeeze = np.array([[0.0, 3.0, 4.0], [0.0, -3.0, -4.0], [0.0, 0.0, 0.0]])
    assert dressing.limb_force(squeeze) == (10.0, 5.0)
    assert [dressing.force_cost(f) for f in (0.0, 10.0, 15.0, 20.0, 99.0)] == [0.0, 0.0, 0.5, 1.0, 1.0]


def test_variation_is_checked():
    known = ("ease", "mass")
    assert dressing.check_variation({"ease": 1}, known) == {"ease": 1.0}
    with pytest.raises(ValueError, match=r"options\['variation'\]\['elbow'\]: unknown; expected ease, mass"):
        dressing.check_variation({"elbow": 0.5}, known)
    with pytest.raises(ValueError, match=r"options\['variation'\]\['ease'\] = 1.5"):
        dressing.check_variation({"ease": 1.5}, known)
    with pytest.raises(ValueError, match=r"options\['variation'\] = 3: expected a dict"):
        dressing.check_variation(3, known)
