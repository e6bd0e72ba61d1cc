"""Maps, boxes and the k-DOP tree in the same step: what cloth does on a body is not up to the collider."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym import materials
from clothgym.detection.body_mesh import BodyMesh
from clothgym.motion import Keyframes
from clothgym.response.body_surface import COLLIDERS

G = 9.81
CALM = dataclasses.replace(materials.get("cotton"), damping=8.0, stretch=1000.0)
FREE = dataclasses.replace(CALM, damping=0.0)
ALL = ("maps", "boxes", "dop")
TOLERANCE = cg.Fidelity().body_tolerance


def sheet(size=0.12, cells=6, at=(0.0, 0.0, 0.0), matrix=None):
    """Level, its middle in the origin, turned, then moved."""
    mesh = cg.grid(size, size, cells, cells)
    flat = mesh.vertices - mesh.vertices.mean(axis=0)
    if np.ptp(flat[:, 1]) > 0.5 * size:
        flat = flat[:, [0, 2, 1]] * [1, 1, -1]
    return (flat if matrix is None else flat @ matrix.T) + at, mesh.faces


def box(size=(0.5, 0.1, 0.3), at=(0.0, 0.0, 0.0), matrix=None):
    mesh = trimesh.creation.box(size)
    for _ in range(3):
        mesh = mesh.subdivide()
    return (mesh.vertices if matrix is None else mesh.vertices @ matrix.T) + at, mesh.faces


def run(cloth, bodies, collider="maps", material=CALM, self_collision=False, step=0.01, **fidelity):
    scene = cg.Scene([cg.Cloth(cloth, material)], bodies=bodies, self_collision=self_collision, step=step)
    return cg.Simulation(scene, cg.Fidelity(body_collider=collider, **({"substeps": 16} | fidelity)))


def weight(sim):
    return float(sim.model.masses.sum()) * G


# ---------------------------------------------------------------------------------------------------------------
# the same with each


@pytest.mark.parametrize("self_collision", [False, True])
def test_cloth_rests_on_a_ball_alike(self_collision):
    """A patch that does not fold: where it comes to rest is the same, and the ball carries its weight."""
    ball = trimesh.creation.icosphere(4, 0.3)
    found = {}
    for collider in ALL:
        body = cg.Body((ball.vertices, ball.faces), "ball", friction=0.6)
        sim = run(sheet(0.12, 6, (0.01, 0.304, 0.0)), [body], collider, self_collision=self_collision)
        sim.step(60)
        forces = []
        for _ in range(10):
            sim.step()
            forces.append(sim.contact_force()[0])
        assert np.mean(forces, axis=0) == pytest.approx([0.0, weight(sim), 0.0], abs=0.01 * weight(sim)), collider
        assert np.abs(sim.velocities).max() < 5e-3, collider
        assert sim.body_mesh.signed_distance(sim.positions).min() > TOLERANCE - 3e-4, collider
        assert sim.body_mesh.penetration(sim.positions, sim.faces).max() == 0.0
        found[collider] = np.array(sim.positions)
    for other in ("boxes", "dop"):
        assert np.abs(found[other] - found["maps"]).max() < 1e-3, other


@pytest.mark.parametrize("integrator", ["xpbd", "symplectic_euler", "implicit_euler"])
@pytest.mark.parametrize("collider", ["boxes", "dop"])
@pytest.mark.parametrize("angle", [0.25, 0.5])
def test_an_incline(angle, collider, integrator):
    """Cloth slides where tan(angle) > mu, with g (sin - mu cos)."""
    mu, steps = 0.3, 15
    matrix = trimesh.transformations.rotation_matrix(angle, (0.6, 0, 0.8))[:3, :3]
    cloth = sheet(0.1, 4, matrix @ [0.0, 0.05 + TOLERANCE, 0.0], matrix)
    body = cg.Body(box((0.6, 0.1, 0.6), matrix=matrix), friction=mu)
    sim = run(cloth, [body], collider, FREE, integrator=integrator, substeps=0)
    start = np.array(sim.positions)
    sim.step(steps)
    expected = max(0.0, G * (math.sin(angle) - mu * math.cos(angle))) * 0.5 * (steps * 0.01) ** 2
    went = np.linalg.norm((sim.positions - start).mean(axis=0))
    assert went == pytest.approx(expected, rel=0.08, abs=2e-4)


@pytest.mark.parametrize("collider", ["boxes", "dop"])
def test_the_papers_response_gives_back_its_share(collider):
    """Eq. 12: what falls at v leaves with C_refl v."""
    body = cg.Body(box(), rebound=0.6, slide=0.97)
    sim = run(sheet(0.1, 4, (0.0, 0.1, 0.0)), [body], collider, FREE, step=0.005, body_response="velocity")
    fastest, leaving = 0.0, 0.0
    for _ in range(40):
        sim.step()
        speed = float(sim.velocities[:, 1].mean())
        fastest, leaving = min(fastest, speed), max(leaving, speed)
    assert -fastest == pytest.approx(math.sqrt(2 * G * 0.047), rel=0.06)
    assert leaving == pytest.approx(-0.6 * fastest, rel=0.1)


@pytest.mark.parametrize("collider", ALL)
def test_cloth_rides_on_a_table_that_moves(collider):
    vertices, faces = box()
    ways = np.linspace(0.0, 0.1, 11)
    frames = [vertices + np.array([0.5 * way, way, 0.0]) for way in ways]
    body = cg.Body((vertices, faces), friction=2.0, motion=Keyframes(np.linspace(0.0, 0.5, 11), frames))
    sim = run(sheet(0.1, 4, (0.0, 0.05 + TOLERANCE, 0.0)), [body], collider, CALM)
    start = np.array(sim.positions)
    sim.step(50)
    assert (sim.positions - start).mean(axis=0) == pytest.approx([0.05, 0.1, 0.0], abs=4e-3)
    assert sim.penetration_depth() == 0.0


@pytest.mark.parametrize("collider", ["boxes", "dop"])
def test_the_same_bits_again_and_no_memory(collider):
    ball = trimesh.creation.icosphere(3, 0.1)
    sim = run(sheet(0.2, 8, (0.0, 0.105, 0.0)), [cg.Body((ball.vertices, ball.faces))], collider)
    sim.step(5)
    snapshot = sim.snapshot()
    sim.step(5)
    first = sim.state_hash()
    sim.restore(snapshot)
    sim.step(5)
    assert sim.state_hash() == first
    sim.reset()
    sim.step(10)
    assert sim.state_hash() == first


def test_a_garment_hangs_alike():
    """From where it hangs by the maps it goes on hanging by the others; the shoulders carry it."""
    draped = cg.drape("sleeveless_shirt", "female", edge_length=0.04, self_collision=False)
    start = draped.simulation
    snapshot, x = start.snapshot(), np.array(start.positions)
    for collider in ALL:
        sim = cg.Simulation(start.scene, dataclasses.replace(start.fidelity, body_collider=collider))
        sim.restore(snapshot)
        forces = []
        before = (sim.model.masses[:, None] * sim.velocities).sum(axis=0)
        for _ in range(12):
            sim.step()
            forces.append(sim.contact_force())
        gained = (sim.model.masses[:, None] * sim.velocities).sum(axis=0) - before
        mean = np.mean(forces, axis=0)
        of = dict(zip(sim.body_parts, mean.tolist()))
        carried = mean.sum(axis=0) - gained / (
            12 * sim.scene.step
        )  # what another collider holds a little otherwise moves
        assert carried == pytest.approx([0.0, weight(sim), 0.0], abs=0.01 * weight(sim)), collider
        upper = sum(of[f"female: {part}"][1] for part in ("trunk", "left_arm", "right_arm"))
        assert upper == pytest.approx(mean.sum(axis=0)[1], rel=0.02), of
        assert of["female: trunk"][1] > 0.6 * upper, "the caps of the arms bear the rest"
        moved = np.linalg.norm(sim.positions - x, axis=1)
        assert np.sqrt((moved**2).mean()) < 3e-3, (collider, moved.max())
        assert sim.body_mesh.penetration(sim.positions, sim.faces).max() < 2e-3


# ---------------------------------------------------------------------------------------------------------------
# what colliders in object space find


@pytest.mark.parametrize("collider", ["boxes", "dop"])
def test_planes_of_vertices_are_at_the_exact_distance(collider):
    rng = np.random.default_rng(0)
    mesh = trimesh.creation.icosphere(2, 0.1)
    mesh.apply_scale([1.0, 0.7, 1.4])
    points, faces = sheet(0.3, 30, (0.0, 0.06, 0.0))
    points = points + rng.normal(0.0, 0.004, points.shape)
    sim = run((points, faces), [cg.Body((mesh.vertices, mesh.faces))], collider)
    response = sim.pipeline.stages[0].body
    response.begin(sim._frame)
    sim._frame.predicted[:] = points
    found = response.look(sim._frame, 0.001).found
    exact = BodyMesh(mesh.vertices, mesh.faces).signed_distance(points)
    near = found.near
    assert near[np.abs(exact) < TOLERANCE + 2e-3].all() and near.sum() > 20
    distance = (found.planes[:, :3] * points).sum(axis=1) + found.planes[:, 3]
    assert distance[near] == pytest.approx(exact[near], abs=1e-9)
    assert np.linalg.norm(found.planes[near, :3], axis=1) == pytest.approx(1.0)
    count = int(found.number[0])
    assert count > 0
    weights = found.weights[:count]
    assert weights.sum(axis=1) == pytest.approx(1.0)
    places = np.einsum("nk,nkc->nc", weights, points[found.corners[:count]])
    distance = (found.point_planes[:count, :3] * places).sum(axis=1) + found.point_planes[:count, 3]
    exact = BodyMesh(mesh.vertices, mesh.faces).signed_distance(places)
    # beside a vertex or an edge of the body its own pair knows no other feature that may be nearer
    assert (np.sign(distance) == np.sign(exact)).mean() > 0.97
    assert (np.abs(distance) > np.abs(exact) - 1e-9).all()


def test_a_tree_of_boxes_for_each_part():
    sim = run(sheet(at=(0.0, 1.9, 0.0)), [cg.Body("female")], "boxes")
    assert "5 trees of boxes" in sim.pipeline.describe()
    assert set(COLLIDERS) == {"boxes", "dop"}


def spike(height=0.1, width=0.03):
    """A pyramid with its tip up."""
    base = [[x, 0.0, z] for x in (-width, width) for z in (-width, width)]
    vertices = np.array([*base, [0.0, height, 0.0]])
    faces = np.array([[0, 4, 1], [1, 4, 3], [3, 4, 2], [2, 4, 0], [0, 1, 3], [0, 3, 2]])
    return vertices, faces[:, ::-1] if trimesh.Trimesh(vertices, faces).volume < 0 else faces


def test_edges_and_vertices_of_the_body_hold_what_vertices_of_the_cloth_do_not():
    """A coarse sheet falls on a tip between its vertices: vertices alone let it through, the k-DOP tree's pairs do not."""
    deep = {}
    for name, fidelity in {
        "vertices": {"body_faces": 0},
        "dop": {"collider": "dop"},
        "texels": {"body_texels": True, "body_faces": 0},
    }.items():
        sim = run(sheet(0.24, 2, (0.035, 0.106, 0.023)), [cg.Body(spike(), friction=1.0)], material=FREE, **fidelity)
        sim.step(12)
        deep[name] = sim.body_mesh.penetration(sim.positions, sim.faces, 496).max()
    assert deep["vertices"] > 0.01
    assert deep["dop"] < 2e-3
    assert deep["texels"] < 2e-3


# ---------------------------------------------------------------------------------------------------------------
# forces by part


def test_each_body_has_its_own_force():
    """A light and a heavy sheet on two tables."""
    bodies = [cg.Body(box((0.3, 0.1, 0.3), (x, 0.0, 0.0)), "table", friction=0.6) for x in (-0.3, 0.3)]
    cloths = [
        cg.Cloth(sheet(size, 4, (x, 0.05 + TOLERANCE, 0.0)), CALM, name=f"{x}") for size, x in ((0.1, -0.3), (0.2, 0.3))
    ]
    sim = cg.Simulation(cg.Scene(cloths, bodies=bodies, self_collision=False, step=0.01))
    sim.step(20)
    first, second = (float(sim.model.masses[part].sum()) * G for _, part, _ in sim.cloth_ranges)
    assert sim.body_parts == ("table", "table 2")
    expected = [[0.0, first, 0.0], [0.0, second, 0.0]]
    assert sim.contact_force() == pytest.approx(np.array(expected), abs=0.01 * first)
    assert sim.contact_force().sum(axis=0) == pytest.approx(sim.body_forces.sum(axis=0))


def test_parts_of_a_users_body():
    vertices, faces = box()
    right = (vertices[faces].mean(axis=1)[:, 0] > 0.0).astype(int)
    body = cg.Body((vertices, faces), "desk", friction=0.6, parts=(("left", "right"), right))
    again = cg.Body.from_json(body.to_json())
    assert again.parts[0] == ("left", "right") and np.array_equal(again.parts[1], right)
    sim = run(sheet(0.1, 4, (0.06, 0.05 + TOLERANCE, 0.0)), [again])
    sim.step(20)
    assert sim.body_parts == ("desk: left", "desk: right")
    left, right = sim.contact_force()
    assert right[1] == pytest.approx(weight(sim), rel=0.01)
    assert not left.any()


def test_without_bodies_there_are_no_parts():
    sim = cg.Simulation(cg.Scene([cg.Cloth(sheet())], self_collision=False))
    sim.step()
    assert sim.body_parts == () and sim.contact_force().shape == (0, 3)


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        (("left",), "expected \\(names, the number"),
        ((("a", "a"), np.zeros(12, int)), "names = \\('a', 'a'\\)"),
        ((("a", "b"), np.zeros(11, int)), "expected \\(12,\\) whole numbers"),
        ((("a", "b"), np.zeros(12)), "expected \\(12,\\) whole numbers, got float64"),
        ((("a", "b"), np.full(12, 2)), "number 2: there are 2 names"),
    ],
)
def test_wrong_parts_are_refused(parts, told):
    mesh = trimesh.creation.box((1, 1, 1))
    with pytest.raises(ValueError, match=f"body 'body': parts: {told}"):
        cg.Body((mesh.vertices, mesh.faces), parts=parts)


@pytest.mark.parametrize("field", [{"map_size": 90}, {"body_texels": True}, {"body_views": "zy"}])
def test_what_only_maps_have_is_refused_with_others(field):
    with pytest.raises(ValueError, match="works with body_collider 'maps' only"):
        cg.Fidelity(body_collider="dop", **field)
