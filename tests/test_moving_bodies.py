"""Bodies that move: prescribed motions, maps drawn anew each step, cloth that is carried along, several views."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym import motion, rig
from clothgym.detection.body_maps import BodyMaps
from clothgym.detection.body_mesh import BodyMesh
from clothgym.mesh import grid
from clothgym.motion import Keyframes, Turn, Turns, Walk

TOLERANCE, MARGIN = 0.003, 0.015
UP, ASIDE = np.array([0.0, 0.3, 0.0]), np.array([0.5, 0.0, 0.0])


def box(size, centre=(0.0, 0.0, 0.0), cuts=3):
    mesh = trimesh.creation.box(size)
    for _ in range(cuts):
        mesh = mesh.subdivide()
    return np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces)


def dish(radius=0.3, depth=0.1, wall=0.02, count=48):
    """A bowl open to the top, by revolution: inner and outer side."""
    shares = np.linspace(0.0, 1.0, 13)
    inner = np.stack([radius * shares, depth * shares**2], axis=1)
    outer = inner[::-1] - (0.0, wall)
    outer[0] = inner[-1] + (0.01, -0.0)
    outline = np.concatenate([outer[::-1], inner[::-1]])
    mesh = trimesh.creation.revolve(outline, sections=count)
    turned = np.asarray(mesh.vertices)[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
    return turned, np.asarray(mesh.faces)


def test_turns_are_those_of_rodrigues():
    points = np.random.default_rng(0).normal(size=(20, 3))
    turn = Turn((1.0, 2.0, -0.5), 0.7, (0.1, 0.2, 0.3), begin=0.5, end=2.0)
    for time, angle in ((0.2, 0.0), (1.0, 0.35), (5.0, 1.05)):
        matrix = trimesh.transformations.rotation_matrix(angle, turn.axis, turn.centre)
        expected = trimesh.transform_points(points, matrix)
        assert Turns((turn,)).vertices(points, time) == pytest.approx(expected, abs=1e-12)
    spin, tilt = Turn((0, 1, 0), 2.0), Turn((0, 0, 1), 0.1)
    together = Turns((spin, tilt)).vertices(points, 1.5)
    assert together == pytest.approx(Turns((tilt,)).vertices(Turns((spin,)).vertices(points, 1.5), 1.5))


def test_keyframes_join_by_straight_ways():
    frames = np.random.default_rng(0).normal(size=(3, 5, 3))
    film = Keyframes([0.5, 1.0, 2.0], frames)
    assert np.array_equal(film.vertices(frames[0], 0.0), frames[0])
    assert np.array_equal(film.vertices(frames[0], 9.0), frames[2])
    assert film.vertices(frames[0], 1.25) == pytest.approx(0.75 * frames[1] + 0.25 * frames[2])
    loop = dataclasses.replace(film, loop=True)
    assert loop.vertices(frames[0], 0.75 + 4 * 1.5) == pytest.approx(film.vertices(frames[0], 0.75))


def test_a_body_of_the_package_walks_from_where_it_stands():
    woman = cg.Body("female", motion=Walk("female"))
    assert woman.at(0.0) == pytest.approx(cg.Body("female").mesh.vertices, abs=1e-12)


def test_a_walk_begins_in_its_pose_and_becomes_the_walk():
    skin = rig.load("female")
    start = skin.posed("a_pose") + UP
    walk = Walk("female", "a_pose", lead=0.5, stride=1.0)
    assert walk.vertices(start, 0.0) == pytest.approx(start, abs=1e-12)
    assert walk.vertices(start, 2.25) == pytest.approx(skin.posed("walk:0.25") + UP, abs=1e-9)
    times = np.arange(0.0, 1.0, 0.02)
    moved = [walk.vertices(start, t) for t in times]
    assert max(np.linalg.norm(b - a, axis=1).max() for a, b in itertools.pairwise(moved)) < 0.1, "no jump"


@pytest.mark.parametrize(
    "given", [Turns((Turn((0, 1, 0), 1.0), Turn((1, 0, 0), 0.1, begin=1.0))), Walk("male", "t_pose", 0.7, 1.1)]
)
def test_motions_survive_json(given):
    assert motion.from_json(json.loads(json.dumps(given.to_json()))) == given
    with pytest.raises(ValueError, match=r"motion.kind = 'fly'"):
        motion.from_json({"kind": "fly"})
    with pytest.raises(ValueError, match="unknown field"):
        motion.from_json({**given.to_json(), "speed": 3})


def test_scenes_with_motion_survive_json():
    vertices, faces = box((0.2, 0.2, 0.2), cuts=0)
    film = Keyframes([0.0, 1.0], [vertices, vertices + 0.1])
    scene = cg.Scene([cg.Cloth(grid(0.2, 0.2, 3, 3))], bodies=[cg.Body((vertices, faces), motion=film)])
    again = cg.Scene.from_json(scene.to_json())
    assert again == scene
    assert np.array_equal(again.bodies[0].motion.frames, film.frames)
    assert scene.moving


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Turn((0, 0, 0), 1.0), "turn.axis"),
        (lambda: Turn((0, 1, 0), math.nan), "turn.rate"),
        (lambda: Keyframes([1.0, 1.0], np.zeros((2, 4, 3))), "keyframes.times"),
        (lambda: Keyframes([0.0, 1.0], np.zeros((3, 4, 3))), "keyframes.frames"),
        (lambda: Walk("dog"), "walk.body"),
        (lambda: cg.Body("male", motion=Keyframes([0, 1], np.zeros((2, 4, 3)))), "motion"),
        (lambda: cg.Body("male", motion=Walk("female")), "walk.body = 'female': the mesh is not that of .* 'rest'"),
        (lambda: cg.Body("female", motion=Walk("female", "t_pose")), "the mesh is not that of walk.pose = 't_pose'"),
    ],
)
def test_wrong_motions_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()


# ---------------------------------------------------------------------------------------------------------------
# maps of what moves, and of several views


def test_within_a_step_planes_stand_where_they_were():
    """Age is counted back from the end of the step; on the smooth part of a body that shifts, the distance follows."""
    vertices, faces = box((0.3, 0.2, 0.25))
    shift = np.array([0.004, -0.003, 0.006])
    maps = BodyMaps([cg.Body((vertices, faces))], 240, MARGIN)
    maps.render(vertices + shift, vertices, 0.01)
    for point, normal in (((0, 0, 0.125), (0, 0, 1)), ((0.15, 0, 0), (1, 0, 0)), ((0, -0.1, 0), (0, -1, 0))):
        for share in (0.0, 0.4, 1.0):
            place = np.asarray(point) + share * shift + 0.001 * np.asarray(normal)
            texel, side, distance = find(maps, place, 0.01 * (1.0 - share))
            assert texel >= 0
            assert distance == pytest.approx(0.001, abs=2e-4)
            assert maps.map.flow[texel, 3 * side : 3 * side + 3] == pytest.approx(shift / 0.01, rel=1e-3)


def find(maps, point, age):
    from clothgym.kernels import body_map

    return body_map.find_plane(*2 * tuple(float(c) for c in point), 0, maps.map, TOLERANCE, float(age))


def test_a_bowl_is_open_for_views_from_above():
    vertices, faces = dish()
    body = cg.Body((vertices, faces))
    exact = BodyMesh(body.mesh.vertices, body.mesh.faces)
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.15, 0.03, -0.15), (0.15, 0.09, 0.15), (2000, 3))
    s = exact.signed_distance(points)
    points, s = points[s > 0.01], s[s > 0.01]
    assert len(points) > 500
    aside = BodyMaps([body], 240, MARGIN, views="z").query(points, TOLERANCE)[0]
    above = BodyMaps([body], 240, MARGIN, views="y").query(points, TOLERANCE)[0]
    both = BodyMaps([body], 240, MARGIN, views="zy").query(points, TOLERANCE)[0]
    assert np.isfinite(aside).mean() > 0.9, "its inside counts as filled, seen from its front"
    assert not np.isfinite(above).any()
    assert not np.isfinite(both).any(), "inside only where all views say so"
    near, _ = trimesh.sample.sample_surface(trimesh.Trimesh(vertices, faces, process=False), 2000, seed=1)
    inner = (near[:, 1] > 0.002) & (np.hypot(near[:, 0], near[:, 2]) < 0.25)
    found, _ = BodyMaps([body], 240, MARGIN, views="zy").query(near[inner], TOLERANCE)
    assert np.isfinite(found).mean() > 0.99
    assert np.percentile(np.abs(found[np.isfinite(found)]), 95) < 1.5e-3


def test_what_is_drawn_near_the_cloth_is_the_same():
    """Fewer texels, but those that are left hold what they held."""
    skin = rig.load("female")
    body = cg.Body((skin.posed("a_pose"), skin.faces))
    maps = BodyMaps([body], 240, MARGIN, views="zy")
    low, high = np.array([-0.2, 0.9, -0.3]), np.array([0.25, 1.2, 0.3])
    places = trimesh.sample.sample_surface(
        trimesh.Trimesh(body.mesh.vertices, skin.faces, process=False), 4000, seed=3
    )[0]
    places = places[((places > low) & (places < high)).all(axis=1)] + 0.001
    found, normals = maps.query(places, TOLERANCE)
    texels = len(maps.map.planes)
    maps.render(body.mesh.vertices, near=np.stack([low - 0.03, high + 0.03]))
    again, again_normals = maps.query(places, TOLERANCE)
    assert len(places) > 200
    assert len(maps.map.planes) < 0.5 * texels
    assert np.array_equal(np.isfinite(found), np.isfinite(again))
    alike = np.isfinite(found)
    assert np.percentile(np.abs(found - again)[alike], 99) < 1e-6
    assert np.percentile(np.abs(normals - again_normals)[alike], 99) < 1e-5


@pytest.mark.parametrize("views", ["x", "y", "z", "zy", "zyx"])
def test_views_see_a_ball_alike(views):
    mesh = trimesh.creation.icosphere(4, 0.1)
    maps = BodyMaps([cg.Body((mesh.vertices, mesh.faces))], 240, MARGIN, views=views)
    rng = np.random.default_rng(2)
    way = rng.normal(size=(4000, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    gap = rng.uniform(-0.002, 0.0025, 4000)
    found, normals = maps.query((0.1 + gap)[:, None] * way, TOLERANCE)
    assert np.isfinite(found).mean() > 0.995
    felt = np.isfinite(found)
    assert np.percentile(np.abs(found - gap)[felt], 99) < 8e-4
    assert np.percentile((normals * way).sum(axis=1)[felt], 1) > math.cos(math.radians(15))


# ---------------------------------------------------------------------------------------------------------------
# in a simulation


def on_a_table(moved, seconds=1.0, self_collision=False, friction=0.5, **fidelity):
    """A small sheet that lies on a table which moves; its start, and the simulation at the end."""
    vertices, faces = box((0.6, 0.04, 0.6), (0.0, -0.02, 0.0))
    lying = grid(0.15, 0.15, 5, 5).transformed(translation=(0.0, TOLERANCE + 1e-4, 0.0))
    body = cg.Body((vertices, faces), friction=friction, motion=moved(vertices))
    scene = cg.Scene([cg.Cloth(lying)], bodies=[body], self_collision=self_collision, step=0.01)
    sim = cg.Simulation(scene, dataclasses.replace(cg.Fidelity.preset("draft"), body_views="y", **fidelity))
    sim.step(round(seconds / scene.step))
    return lying.vertices, sim


def sliding(speed):
    def film(vertices):
        return Keyframes([0.0, 2.0], [vertices, vertices + 2.0 * np.asarray(speed)])

    return film


@pytest.mark.parametrize("self_collision", [False, True])
def test_cloth_rides_on_what_it_lies_on(self_collision):
    """A table that leaves at 0.1 m/s: friction takes the sheet along at once, and it keeps its place on the table."""
    points, sim = on_a_table(sliding((0.1, 0.0, 0.0)), self_collision=self_collision)
    way = (sim.positions - points).mean(axis=0)
    assert way[0] == pytest.approx(0.1, abs=2e-3)
    assert abs(way[2]) < 1e-3
    assert np.abs(sim.velocities.mean(axis=0) - (0.1, 0, 0)).max() < 5e-3
    assert sim.penetration_depth() < 1e-4


def test_without_friction_the_table_leaves_alone():
    points, sim = on_a_table(sliding((0.1, 0.0, 0.0)), friction=0.0)
    assert np.abs((sim.positions - points).mean(axis=0)[[0, 2]]).max() < 2e-3


def test_a_table_that_rises_lifts_the_cloth():
    points, sim = on_a_table(sliding((0.0, 0.2, 0.0)))
    assert (sim.positions - points)[:, 1].mean() == pytest.approx(0.2, abs=2e-3)
    assert sim.velocities[:, 1].mean() == pytest.approx(0.2, abs=0.02)
    assert sim.penetration_depth() < 3e-4
    weight = 9.81 * (1.0 / sim.model.inverse_masses).mean()
    assert sim.body_forces[:, 1].mean() == pytest.approx(weight, rel=0.1), "steady rise: its weight and no more"


def test_cloth_turns_with_a_turntable():
    points, sim = on_a_table(lambda v: Turns((Turn((0.0, 1.0, 0.0), 0.5),)))
    expected = Turns((Turn((0.0, 1.0, 0.0), 0.5),)).vertices(points, 1.0)
    assert np.abs(sim.positions - expected).max() < 4e-3


def test_states_remember_nothing_about_the_motion():
    _, sim = on_a_table(lambda v: Turns((Turn((0.0, 1.0, 0.0), 2.0),)), 0.1)
    kept, here = sim.snapshot(), sim.state_hash()
    sim.step(5)
    later = sim.state_hash()
    sim.restore(kept)
    assert sim.state_hash() == here
    sim.step(5)
    assert sim.state_hash() == later
    sim.reset(seed=0)
    sim.step(15)
    assert sim.state_hash() == later


def test_metrics_and_meshes_follow_the_body():
    vertices, faces = box((0.2, 0.2, 0.2))
    film = Keyframes([0.0, 0.1], [vertices, vertices + ASIDE])
    cloth = cg.Cloth(grid(0.1, 0.1, 3, 3).transformed(translation=(0.5, 0.0, 0.0)), pins=list(range(16)))
    sim = cg.Simulation(cg.Scene([cloth], bodies=[cg.Body((vertices, faces), "box", motion=film)], step=0.05))
    assert sim.penetration_depth() == 0.0
    sim.step(2)
    assert sim.penetration_depth() > 0.02
    ((name, now, _),) = sim.body_meshes
    assert name == "box"
    assert now == pytest.approx(vertices + ASIDE)


def test_a_moving_body_is_recorded(tmp_path):
    from clothgym.recording.rerun_log import RerunLog
    from clothgym.recording.rerun_read import read_recording

    _, sim = on_a_table(sliding((0.1, 0.0, 0.0)), 0.02)
    with RerunLog(tmp_path / "moving.rrd") as log:
        log.open_simulation(sim)
        log.log_simulation(0, sim)
        sim.step(3)
        log.log_simulation(1, sim)
    found = read_recording(tmp_path / "moving.rrd")
    (track,) = found.bodies.values()
    assert np.ptp(np.asarray(track.at(1))[:, 0] - np.asarray(track.at(0))[:, 0]) < 1e-6
    assert (np.asarray(track.at(1)) - np.asarray(track.at(0)))[:, 0].mean() == pytest.approx(0.003, abs=1e-6)
