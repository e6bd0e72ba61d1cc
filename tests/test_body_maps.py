"""The body's maps against analytic solids, exact distances, and a naive version."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from naive_body import NaiveMaps, box_distance, capsule_distance, ellipsoid_distance, sphere_distance

from clothgym.body import Body, load
from clothgym.detection.body_maps import BodyMaps
from clothgym.detection.body_mesh import BodyMesh
from clothgym.kernels import body_map

TOLERANCE, MARGIN = 0.003, 0.015
NOBODY, FRONT, BACK = 0, body_map.FRONT, body_map.BACK


def turn(axis, angle):
    return trimesh.transformations.rotation_matrix(angle, axis)[:3, :3]


def fine_box(size, cuts=4):
    mesh = trimesh.creation.box(size)
    for _ in range(cuts):
        mesh = mesh.subdivide()
    return mesh


def ball(radius=0.1, cuts=4):
    return trimesh.creation.icosphere(cuts, radius)


def capsule():
    mesh = trimesh.creation.capsule(0.3, 0.05, count=[48, 48])
    return mesh if abs(mesh.bounds[0, 2] + mesh.bounds[1, 2]) < 1e-9 else mesh.apply_translation([0, 0, -0.15])


RADII = np.array([0.06, 0.15, 0.1])
SIZE = (0.3, 0.2, 0.25)
ENDS = np.array([[0.0, 0.0, -0.15], [0.0, 0.0, 0.15]])
STRAIGHT, TILTED = np.eye(3), turn([1, 0.3, 0.2], 0.8)


def egg():
    return ball(1.0, 5).apply_transform(np.diag([*RADII, 1.0]))


SOLIDS = {
    "sphere": (ball, lambda p: sphere_distance(p, 0.1), STRAIGHT),
    "ellipsoid": (egg, lambda p: ellipsoid_distance(p, RADII), STRAIGHT),
    "ellipsoid tilted": (egg, lambda p: ellipsoid_distance(p, RADII), TILTED),
    "capsule along z": (capsule, lambda p: capsule_distance(p, *ENDS, 0.05), STRAIGHT),
    "capsule along y": (capsule, lambda p: capsule_distance(p, *ENDS, 0.05), turn([1, 0, 0], math.pi / 2)),
    "capsule along x": (capsule, lambda p: capsule_distance(p, *ENDS, 0.05), turn([0, 1, 0], math.pi / 2)),
    "capsule tilted": (capsule, lambda p: capsule_distance(p, *ENDS, 0.05), TILTED),
    "box": (lambda: fine_box(SIZE), lambda p: box_distance(p, SIZE), STRAIGHT),
    "box tilted about z": (lambda: fine_box(SIZE), lambda p: box_distance(p, SIZE), turn([0, 0, 1], 0.3)),
    "box tilted about x": (lambda: fine_box(SIZE), lambda p: box_distance(p, SIZE), turn([1, 0, 0], 0.3)),
}  # fmt: skip
"""Mesh, exact distance, and how both are turned."""


def around(mesh, count=6000, reach=0.012, seed=0):
    """Points within `reach` of a surface, and where they come from."""
    places, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    offsets = np.random.default_rng(seed).uniform(-reach, reach, count)
    return places + offsets[:, None] * mesh.face_normals[faces]


def gradient(distance, points, h=1e-5):
    steps = h * np.eye(3)
    return np.stack([(distance(points + s) - distance(points - s)) / (2 * h) for s in steps], axis=1)


def turned(name):
    """A solid's mesh and exact distance in the world."""
    make, distance, matrix = SOLIDS[name]
    mesh = trimesh.Trimesh(*(lambda m: (m.vertices @ matrix.T, m.faces))(make()), process=False)
    return mesh, lambda points: distance(points @ matrix)


def lies(maps):
    """Left, bottom and size of the texels of the only pair of views, rows and columns."""
    view = maps.map.one
    return view.left, view.bottom, view.pixel, view.rows, view.columns


def maps_of(mesh, size=240, margin=MARGIN, normals="face"):
    return BodyMaps([Body((mesh.vertices, mesh.faces))], size, margin, normals)


# ---------------------------------------------------------------------------------------------------------------
# solids with known distances


@pytest.mark.parametrize("name", SOLIDS)
def test_distances_and_normals_near_the_surface(name):
    """In front, at the back and at the sides alike; a texel that an edge crosses holds the plane of one of its sides."""
    mesh, exact = turned(name)
    maps = maps_of(mesh)
    points = around(mesh, reach=0.002)
    s, (found, normals) = exact(points), maps.query(points, TOLERANCE)
    assert np.isfinite(found).all(), "within the tolerance, and told to be outside"
    error = np.abs(found - s)
    assert np.percentile(error, 99) < max(1e-3, 1.5 * maps.pixel)
    assert np.median(error) < 2e-4
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=1e-6)
    agree = (normals * gradient(exact, points)).sum(axis=1)
    # texels at edges of the box mix the normals of both sides
    assert np.percentile(agree, 10) > math.cos(math.radians(25)), "a response that hardly leads out"
    assert np.median(agree) > math.cos(math.radians(6))


@pytest.mark.parametrize("name", SOLIDS)
def test_nothing_inside_is_missed_and_little_outside_is_felt(name):
    mesh, exact = turned(name)
    maps = maps_of(mesh)
    points = around(mesh)
    s, (found, _) = exact(points), maps.query(points, TOLERANCE)
    felt = np.isfinite(found)
    assert felt[s < -1e-4].all()
    assert (~felt[s < TOLERANCE - 3e-4]).mean() < 0.012
    assert felt[s > TOLERANCE + 1e-3].mean() < 0.04
    deep = felt & (s < 0.0)
    assert (found[deep] < 0.5e-3).all(), "inside, and told to be clearly outside"
    assert (found[deep] > 2.2 * s[deep] - 2e-3).mean() > 0.98, "a push far beyond the surface"


DIRECTIONS = [
    (0, 0, 1),
    (0, 0, -1),
    (1, 0, 0),
    (-1, 0, 0),
    (0, 1, 0),
    (0, -1, 0),
    (0.6, 0, 0.8),
    (0.8, 0, -0.6),
    (0.96, 0, 0.28),
]


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_tolerance_is_the_same_all_around(direction):
    """A finger that comes nearer to a ball is felt at the tolerance, whatever side it comes from."""
    maps = maps_of(ball(cuts=5))
    gaps = np.linspace(-0.001, 0.008, 181)
    points = (0.1 + gaps)[:, None] * np.asarray(direction, float)
    found, normals = maps.query(points, TOLERANCE)
    felt = np.isfinite(found)
    first = gaps[felt].max()
    assert first == pytest.approx(TOLERANCE, abs=2.0 * maps.pixel)
    assert felt[gaps <= first].all()
    assert (normals[felt] @ np.asarray(direction, float)).min() > math.cos(math.radians(12))


STEEP = ["capsule along y", "capsule along z", "box tilted about z", "sphere", "ellipsoid tilted"]


@pytest.mark.parametrize("name", STEEP)
def test_nothing_is_felt_in_front_of_steep_outlines(name):
    """Planes of the outline are steep and would reach far in front of the body and behind it."""
    mesh, exact = turned(name)
    maps = maps_of(mesh)
    rng = np.random.default_rng(1)
    (low, high), reach = mesh.bounds, np.array([0.02, 0.02, 0.3])
    points = rng.uniform(low - reach, high + reach, (40_000, 3))
    s, (found, _) = exact(points), maps.query(points, TOLERANCE)
    away = s > 0.02
    assert away.sum() > 5_000
    assert not np.isfinite(found[away]).any()
    assert np.isfinite(found[s < -1e-4]).all(), "anything deep inside is felt, too"


@pytest.mark.parametrize("name", ["ball", "limb"])
def test_steep_planes_hold_no_cloth_off(name):
    """Texels beside the outline hold planes along the view, from which a round body curves away: planes of texels of 4.4 mm
    may be asked no further than the body has parts near that texel."""
    mesh = ball(0.08) if name == "ball" else trimesh.creation.capsule(0.3, 0.08, count=[48, 48])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.4 if name == "limb" else 0.0, [1, 0, 0]))
    maps = maps_of(mesh, round(mesh.extents[:2].max() / 0.0044))
    points = around(mesh, 40_000, 0.015)
    s = BodyMesh(mesh.vertices, mesh.faces).signed_distance(points)
    felt = np.isfinite(maps.query(points, TOLERANCE)[0])
    assert s[felt].max() < TOLERANCE + 4e-3
    assert felt[s < TOLERANCE - 3e-4].mean() > 0.995
    assert felt[s < 0.0].all()


def test_finer_maps_are_no_worse():
    mesh, exact = turned("ellipsoid tilted")
    points = around(mesh, reach=0.003)
    s, errors, missed = exact(points), [], []
    for size in (60, 120, 240, 480):
        found, _ = maps_of(mesh, size).query(points, TOLERANCE)
        felt = np.isfinite(found)
        errors.append(np.percentile(np.abs(found - s)[felt & (s < TOLERANCE)], 95))
        missed.append((~felt[s < TOLERANCE - 5e-4]).mean())
    # beyond some size the planes' extrapolation is what remains
    assert max(errors[1:]) < errors[0], errors
    assert max(errors[2:]) < 1.25 * errors[1], errors
    assert max(missed) < 0.02, missed
    assert missed[-1] <= missed[0] + 1e-3


def test_a_texel_is_the_error_in_x_and_y():
    """[Vassilev 2001, eq. 11]: size over map size; what a texel stores lies within half of one from its points."""
    for size in (40, 160):
        mesh = ball()
        maps = maps_of(mesh, size)
        assert maps.pixel == pytest.approx(0.2 / size)
        points = around(mesh, 2000, 1e-9)
        # distance along z from the plane, where the surface is shallow: second order in the texel
        front = points[:, 2] > 0.08
        found, _ = maps.query(points, TOLERANCE)
        bound = maps.pixel**2 / (0.1 * 0.8**3) + 2e-4
        assert np.abs(found[front]).max() < bound
    tall = maps_of(fine_box((0.1, 0.4, 0.1), 1), 100)
    assert tall.pixel == pytest.approx(0.4 / 100), "along the longer side"


# ---------------------------------------------------------------------------------------------------------------
# against the naive version


@pytest.mark.parametrize("normals_of", ["face", "interpolated"])
@pytest.mark.parametrize("name", ["sphere", "capsule tilted", "box tilted about x", "box tilted about z"])
def test_the_same_as_naive_maps(name, normals_of):
    matrix = SOLIDS[name][2]
    coarse = {
        "sphere": lambda: ball(cuts=2),
        "capsule tilted": lambda: trimesh.creation.capsule(0.3, 0.05, count=[10, 10]),
    }
    mesh = coarse.get(name, lambda: fine_box(SIZE, 2))()
    mesh = trimesh.Trimesh(mesh.vertices @ matrix.T, mesh.faces, process=False)
    maps = maps_of(mesh, 60, normals=normals_of)
    naive = NaiveMaps(mesh.vertices, mesh.faces, lies(maps), normals_of == "interpolated")
    points = around(mesh, 250, 0.01, seed=3)
    points = np.concatenate([points, np.random.default_rng(2).uniform(*(1.1 * mesh.bounds), (150, 3))])
    found, normals = maps.query(points, TOLERANCE)
    compared = hits = ties = 0
    for point, distance, normal in zip(points, found, normals):
        expected = naive.query(point, TOLERANCE, 0.5 + TOLERANCE / maps.pixel)
        if expected is None:
            continue
        compared += 1
        if math.isinf(expected[0]) or math.isinf(distance):
            near = abs(min(expected[0], distance) - TOLERANCE) < 1e-5
            assert math.isinf(expected[0]) == math.isinf(distance) or near
            continue
        hits += 1
        alike = abs(distance - expected[0]) < 2e-5 and np.abs(normal - expected[1]).max() < 2e-2
        ties += not alike  # a texel as far from one side of the outline as from another
        assert alike or (normal[2] == 0.0 and expected[1][2] == 0.0) or abs(distance - expected[0]) < 1e-5
    assert ties < 0.03 * hits
    assert compared > 200
    assert hits > 100


def test_planes_of_texels_are_tangents_of_the_smooth_mesh():
    mesh = ball(cuts=2)
    maps = maps_of(mesh, 48, normals="interpolated")
    m, (_, _, _, rows, columns) = maps.map, lies(maps)
    naive = NaiveMaps(mesh.vertices, mesh.faces, lies(maps), True)
    shown = 0
    for row in range(rows):
        for column in range(columns):
            here = naive.ray((row, column))
            assert maps.filled[row, column] == (here is not None)
            if here is None:
                continue
            shown += 1
            planes = m.planes[row * columns + column].astype(float)
            for side, (place, normal) in enumerate(here):
                assert planes[4 * side : 4 * side + 3] == pytest.approx(normal, abs=5e-3)
                local = place - m.origin
                assert planes[4 * side : 4 * side + 3] @ local + planes[4 * side + 3] == pytest.approx(0.0, abs=1e-5)
    assert shown > 1000


def test_planes_of_neighbours_join_unless_they_are_interpolated():
    """At the same place on a facet, planes of two texels that both show it answer alike; interpolated ones do not."""
    mesh = ball(cuts=1)
    jumps = {}
    for normals in ("face", "interpolated"):
        maps = maps_of(mesh, 120, normals=normals)
        m, (left, bottom, pixel, _, columns) = maps.map, lies(maps)
        middle = mesh.triangles_center
        shown = middle[mesh.face_normals[:, 2] > 0.6]
        seen = []
        for point in shown:
            for row in (-1, 0, 1):
                for column in (-1, 0, 1):
                    at = (*np.floor((point[:2] - (left, bottom)) / pixel).astype(int), column, row)
                    plane = m.planes[at[1] * columns + at[0], :4].astype(float)
                    seen.append(abs(plane[:3] @ (point - m.origin) + plane[3]))
        jumps[normals] = max(seen)
    assert jumps["face"] < 1e-6 < 1e-5 < jumps["interpolated"]


def test_mirrored_bodies_answer_mirrored():
    mesh = trimesh.Trimesh(*(lambda m: (m.vertices @ TILTED.T, m.faces))(capsule()), process=False)
    mirror = np.array([-1.0, 1.0, 1.0])
    other = trimesh.Trimesh(mesh.vertices * mirror, mesh.faces[:, ::-1], process=False)
    points = around(mesh, 4000)
    found, normals = maps_of(mesh, normals="interpolated").query(points, TOLERANCE)
    seen, seen_normals = maps_of(other, normals="interpolated").query(points * mirror, TOLERANCE)
    both = np.isfinite(found) & np.isfinite(seen)
    assert (np.isfinite(found) != np.isfinite(seen)).mean() < 0.01
    # texels are not mirrored exactly: the extent is no whole number of them
    assert np.percentile(np.abs(found[both] - seen[both]), 99) < 1e-3
    assert np.percentile(np.abs(normals * mirror - seen_normals)[both].max(axis=1), 90) < 0.1
    front = turn([0, 1, 0], math.pi)
    behind = trimesh.Trimesh(mesh.vertices @ front.T, mesh.faces, process=False)
    back, _ = maps_of(behind, normals="interpolated").query(points @ front.T, TOLERANCE)
    both = np.isfinite(found) & np.isfinite(back)
    assert np.percentile(np.abs(found[both] - back[both]), 99) < 1e-3, "front and back are treated alike"


# ---------------------------------------------------------------------------------------------------------------
# a true body


@pytest.fixture(scope="module")
def female():
    body = load("female", "a_pose")
    maps = BodyMaps([body], 360, MARGIN)
    mesh = trimesh.Trimesh(body.mesh.vertices, body.mesh.faces, process=False)
    points = around(mesh, 24_000)
    exact = BodyMesh(body.mesh.vertices, body.mesh.faces).signed_distance(points)
    # the fingers and toes are thinner than what is asked about
    trunk = (points[:, 1] > 0.12) & (np.abs(points[:, 0]) < 0.45)
    return maps, points[trunk], exact[trunk], maps.query(points[trunk], TOLERANCE)[0]


def test_real_penetration_of_the_female_is_found(female):
    _, _, s, found = female
    inside = s < -0.001
    assert inside.sum() > 5_000
    assert np.isfinite(found[inside]).all()


def test_how_well_the_females_shell_is_known(female):
    """Bounds are what was measured, with a margin."""
    _, _, s, found = female
    felt = np.isfinite(found)
    assert (~felt[s < TOLERANCE]).mean() < 0.015
    error = np.abs(found - s)[felt & (np.abs(s) < 0.008)]
    assert np.median(error) < 4e-4
    assert np.percentile(error, 95) < 4e-3
    assert felt[s > 0.008].mean() < 0.04, "space that counts as filled"


# ---------------------------------------------------------------------------------------------------------------
# odd bodies and places


def test_points_beside_and_off_the_map_are_outside():
    maps = maps_of(ball())
    far = np.array(
        [[1.0, 0, 0], [-1, 0, 0], [0, 5, 0], [0, -5, 0], [0, 0, 3], [0, 0, -3], [1e9, -1e9, 0], [0.1, 0.1, 0]]
    )
    found, normals = maps.query(far, TOLERANCE)
    assert np.isinf(found).all()
    assert not normals.any()
    assert maps.query(np.zeros((0, 3)), TOLERANCE)[0].shape == (0,)
    with pytest.raises(ValueError, match=r"points\[1, 2\] is nan"):
        maps.query([[0, 0, 0], [0, 0, math.nan]], TOLERANCE)
    with pytest.raises(ValueError, match="vertices: expected 2562 rows"):
        maps.render(np.zeros((3, 3)))


def test_texels_hold_three_unit_normals_or_nothing():
    maps = maps_of(ball(), 80)
    planes = maps.map.planes[:, :12].reshape(-1, 3, 4).astype(float)
    used = np.isfinite(planes[:, 0, 3])
    assert used.reshape(maps.filled.shape)[maps.filled].all()
    sizes = np.linalg.norm(planes[used][:, :, :3], axis=2)
    assert sizes == pytest.approx(1.0, abs=1e-5)
    assert not np.isfinite(planes[~used][:, 0, 3]).any()
    assert (planes[used][:, 0, 2] >= 0.0).all()
    assert (planes[used][:, 1, 2] <= 0.0).all()
    assert not planes[used][:, 2, 2].any(), "the outline's plane stands along z"
    assert not np.isnan(planes).any()


def test_several_bodies_share_a_map():
    one, two = ball(0.05), ball(0.08)
    two.apply_translation([0.3, 0.1, -0.2])
    maps = BodyMaps([Body((m.vertices, m.faces)) for m in (one, two)], 240, MARGIN)
    points = np.concatenate([around(one, 2000), around(two, 2000)])
    s = np.minimum(sphere_distance(points, 0.05), sphere_distance(points - [0.3, 0.1, -0.2], 0.08))
    found, _ = maps.query(points, TOLERANCE)
    felt = np.isfinite(found)
    assert felt[s < -1e-4].all()
    assert felt[s > 0.006].mean() < 0.01
    assert np.percentile(np.abs(found - s)[felt & (np.abs(s) < 0.002)], 98) < 1.5e-3
    between = np.array([[0.15, 0.05, -0.1], [0.15, 0.0, 0.0]])
    assert np.isinf(maps.query(between, TOLERANCE)[0]).all()


def test_one_behind_the_other_counts_as_filled_between():
    """What two views cannot see."""
    one, two = ball(0.05), ball(0.05)
    two.apply_translation([0, 0, -0.3])
    maps = BodyMaps([Body((m.vertices, m.faces)) for m in (one, two)], 120, MARGIN)
    assert maps.query([[0.0, 0.0, -0.15]], TOLERANCE)[0][0] < -0.02
    assert np.isinf(maps.query([[0.0, 0.0, 0.06], [0.0, 0.0, -0.36]], TOLERANCE)[0]).all()


def test_the_hole_of_a_ring_is_open():
    mesh = trimesh.creation.torus(0.1, 0.03, 64, 32)  # around z
    maps = maps_of(mesh)
    points = around(mesh, 4000, 0.008)
    s = np.hypot(np.hypot(points[:, 0], points[:, 1]) - 0.1, points[:, 2]) - 0.03
    found, _ = maps.query(points, TOLERANCE)
    felt = np.isfinite(found)
    assert felt[s < -2e-4].all()
    assert felt[s > TOLERANCE + 1.5e-3].mean() < 0.05
    middle = np.random.default_rng(0).uniform(-0.03, 0.03, (500, 3))
    assert np.isinf(maps.query(middle, TOLERANCE)[0]).all()


def test_a_body_with_a_hole_in_its_surface():
    """Where one side is missing nothing is felt; beside that, all is as before."""
    mesh = ball()
    kept = mesh.triangles_center[:, 2] < 0.07
    body = Body((mesh.vertices, mesh.faces[kept]))
    maps = BodyMaps([body], 240, MARGIN)
    found, _ = maps.query([[0, 0, 0.099], [0, 0, 0.0], [0, 0, -0.099]], TOLERANCE)
    assert np.isinf(found).all()
    side = np.array([[0.099, 0, 0], [0, -0.099, 0], [0.099 * math.sin(1.2), 0, 0.099 * math.cos(1.2)]])
    assert maps.query(side, TOLERANCE)[0] == pytest.approx([-0.001] * 3, abs=1e-3)


def test_bodies_thinner_than_a_texel_are_not_seen():
    """Nothing covers the middle of a texel: an empty map, no crash."""
    thin = trimesh.creation.box((0.5, 1e-6, 1e-6))
    maps = maps_of(thin, 8)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 3))
    assert not maps.filled.any() or np.isfinite(maps.map.planes[maps.filled.ravel()]).all()
    assert not np.isnan(maps.query(points, TOLERANCE)[0]).any()
    needle = maps_of(trimesh.creation.box((1e-7, 1e-7, 0.4)), 8)
    assert not np.isnan(needle.query(points, TOLERANCE)[0]).any()


@pytest.mark.parametrize("offset", [(1e3, 0, 0), (0, -1e3, 0), (0, 0, 1e3), (-1e3, 1e3, -1e3)])
def test_far_from_the_origin(offset):
    mesh, exact = turned("box tilted about z")
    points = around(mesh, 2000, 0.002)
    s = exact(points)
    far = trimesh.Trimesh(mesh.vertices + offset, mesh.faces, process=False)
    found, normals = maps_of(far).query(points + offset, TOLERANCE)
    here, here_normals = maps_of(mesh).query(points, TOLERANCE)
    assert np.percentile(np.abs(found - s), 99) < 1e-3
    assert np.percentile(np.abs(found - here), 99) < 1e-4
    assert np.median(np.abs(normals - here_normals).max(axis=1)) < 1e-4


def test_sides_are_told_by_where_points_are():
    maps = maps_of(ball())
    m = maps.map

    def side(x, y, z, m):
        return body_map.sides_of(x, y, z, m, 0.0)

    assert side(0.0, 0.0, 0.2, m) == FRONT
    assert side(0.0, 0.0, -0.2, m) == BACK
    assert side(0.0, 0.0, 0.05, m) == FRONT, "inside, nearer to the front"
    assert side(0.0, 0.0, -0.05, m) == BACK
    assert side(0.5, 0.0, 0.0, m) == NOBODY
    assert side(0.0, 0.099, 0.5, m) == FRONT, "far in front of a steep place"
    assert side(0.0, 0.101, -0.5, m) == BACK, "beside it, in the margin"
    texel, plane, distance = body_map.find_plane(0.0, 0.0, -0.05, 0.0, 0.0, -0.05, FRONT, m, TOLERANCE, 0.0)
    assert (plane, texel >= 0) == (0, True), "came from the front: leads back there"
    assert distance == pytest.approx(-0.15, abs=1e-3)
    texel, plane, distance = body_map.find_plane(0.098, 0.0, 0.0, 0.098, 0.0, 0.0, FRONT, m, TOLERANCE, 0.0)
    assert plane == 2
    assert distance == pytest.approx(-0.002, abs=5e-4)
