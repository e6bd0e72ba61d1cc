"""Contact: closest points, friction, and piles that never intersect."""

from __future__ import annotations

import dataclasses

import naive_mechanics as naive
import numpy as np
import pytest
from contact_cases import CONTACT_ONLY, every_quad, narrowed, stack

import clothgym as cg
from clothgym.kernels import contact as kernels
from clothgym.kernels.integrate import Grips, Ground, Motion
from clothgym.model import ClothModel


def no_grips() -> Grips:
    return Grips(np.zeros(0, np.int32), *(np.zeros((0, 3)) for _ in range(2)), np.zeros(0), np.zeros(0),
                 np.zeros((0, 3)), np.zeros((0, 3)))  # fmt: skip


def clouds(seed: int):
    """Positions of 300 pairs: general, flat, thin, parallel, and with coinciding points."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(300, 4, 3))
    x[50:80, :, 2] = 0.0  # all in one plane
    x[80:110, 3] = x[80:110, 2] + 1e-3 * rng.normal(size=(30, 3))  # thin triangles, short edges
    x[110:140, 3] = x[110:140, 2] + 0.7 * (x[110:140, 1] - x[110:140, 0])  # parallel edges
    x[140:160] = np.round(x[140:160])  # exact ties
    x[160:170, 3] = x[160:170, 2]  # edges without length
    x[170:180, 3] = 0.5 * (x[170:180, 1] + x[170:180, 2])  # triangles without area
    return x.reshape(-1, 3), np.arange(1200, dtype=np.int32).reshape(-1, 4)


# ---------------------------------------------------------------------------------------------------------------
# closest points


@pytest.mark.parametrize("kind", [0, 1])
@pytest.mark.parametrize("seed", [0, 1])
def test_closest_points_are_the_closest(kind, seed):
    x, quads = clouds(seed)
    buffers, watched = narrowed(x, x, quads, np.full(len(quads), kind), 100.0)
    separation = watched.separation
    corners = [x[quads[:, k]] for k in range(4)]
    expected = (naive.point_triangle if kind == 0 else naive.segment_segment)(*corners)
    touching = expected < 1e-12
    found = np.where(separation[:, 3] < 0, 0.0, separation[:, 3])
    assert found == pytest.approx(expected, abs=1e-9, rel=1e-9)
    proper = separation[:, 3] >= 0
    assert proper.sum() >= len(quads) - touching.sum() - 5
    weights = watched.weights[proper]
    sides = [slice(0, 1), slice(1, 4)] if kind == 0 else [slice(0, 2), slice(2, 4)]
    for side, total in zip(sides, (1.0, -1.0), strict=True):
        assert weights[:, side].sum(axis=1) == pytest.approx(total, abs=1e-12)
        assert (weights[:, side] * total >= -1e-12).all()
    between = np.einsum("nk,nkc->nc", weights, x[quads[proper]])
    # every pair has vertices of its own: all vertices with a triangle press, and all edges that cross
    inside = (np.abs(weights) > 0).all(axis=1)
    assert buffers.active == (proper.sum() if kind == 0 else inside.sum())
    assert between == pytest.approx(separation[proper, :3] * separation[proper, 3:], abs=1e-9)
    assert np.linalg.norm(separation[proper, :3], axis=1) == pytest.approx(1.0)


def test_references_agree_with_dense_sampling():
    x, quads = clouds(5)
    corners = [x[quads[:, k]] for k in range(4)]
    s, t = np.meshgrid(np.linspace(0, 1, 41), np.linspace(0, 1, 41))
    s, t = s.ravel(), t.ravel()
    inside = s + t <= 1
    on = [corners[1][:, None] + s[inside, None] * (corners[2] - corners[1])[:, None]
          + t[inside, None] * (corners[3] - corners[1])[:, None]]  # fmt: skip
    sampled = np.linalg.norm(on[0] - corners[0][:, None], axis=2).min(axis=1)
    exact = naive.point_triangle(*corners)
    assert (exact <= sampled + 1e-12).all() and (sampled - exact).max() < 0.15
    a = corners[0][:, None] + s[:, None] * (corners[1] - corners[0])[:, None]
    b = corners[2][:, None] + t[:, None] * (corners[3] - corners[2])[:, None]
    sampled = np.linalg.norm(a - b, axis=2).min(axis=1)
    exact = naive.segment_segment(*corners)
    assert (exact <= sampled + 1e-12).all() and (sampled - exact).max() < 0.15


def test_a_pair_is_active_from_its_predicted_distance():
    x = np.array([[0.2, 0.5, 0.2], [0, 0, 0], [1, 0, 0], [0, 0, 1.0]])
    others = np.random.default_rng(0).normal(0.0, 30.0, (3000, 3))  # rest: on average, nothing moves
    x = np.concatenate([x, others - others.mean(axis=0)])
    for lift, active in ((0.126, 0), (0.124, 1), (-3.0, 1)):  # 1.25 thicknesses
        p = x.copy()
        p[0, 1] = lift
        buffers, watched = narrowed(x, p, [[0, 1, 2, 3]], [0], 0.1)
        assert buffers.active == active
        assert watched.gaps[0] == pytest.approx(0.5)
        assert watched.separation[0] == pytest.approx([0, 1, 0, 0.5 if active else -1.0])
    assert buffers.arrays.approach[0] == pytest.approx(-3.5)


def test_pairs_beside_an_intersection_are_left_alone():
    x = np.array([[0.2, 0.05, 0.2], [0, 0, 0], [1, 0, 0], [0, 0, 1.0]])
    for marked in range(4):
        apart = np.zeros(4, np.bool_)
        apart[marked] = True
        buffers, watched = narrowed(x, x, [[0, 1, 2, 3]], [0], 0.1, apart)
        assert buffers.active == 0
        assert watched.separation[0, 3] < 0


def test_contact_buffers_grow():
    x, quads = clouds(2)
    small, _ = narrowed(x, x, quads[:5], np.zeros(5), 100.0)
    large, _ = narrowed(x, x, quads, np.zeros(len(quads)), 100.0)
    assert large.active > 16
    assert np.array_equal(large.arrays.quads[: small.active], small.arrays.quads[: small.active])
    assert (large.arrays.rest[: large.active] == 100.0).all()


# ---------------------------------------------------------------------------------------------------------------
# projection, friction, rebound


def solved(x, p, w, thickness, friction, sweeps, quads=((0, 1, 2, 3),), kinds=(0,)):
    """Positions after contact sweeps without springs, and the contacts."""
    buffers, _ = narrowed(x, p, np.array(quads, np.int32), np.array(kinds), thickness, w=w)
    p = p.copy()
    cloth = cg.kernels.springs.ClothArrays(w, np.zeros((0, 2), np.int32), np.zeros(0), np.zeros(0))
    motion = Motion(0.01, sweeps, np.zeros(3), 0.0, np.zeros((0, 3)), -1.0, True)
    kernels.solve(x, p, cloth, buffers.arrays, buffers.active, friction, np.zeros(len(x)), motion, Ground(-np.inf, 0.0),
                  no_grips(), np.zeros(0), 0, False, None)  # fmt: skip
    return p, buffers


FLOOR = np.array([[0.25, 0.06, 0.25], [0, 0, 0], [1, 0, 0], [0, 0, 1.0]])


@pytest.mark.parametrize(
    ("pull", "friction", "kept"), [(0.3, 0.0, 0.3), (0.3, 0.5, 0.3 - 0.5 * 0.09), (0.03, 0.5, 0.0)]
)
def test_friction_of_one_contact_stays_in_its_cone(pull, friction, kept):
    """A vertex pressed 9 cm too deep onto an immovable triangle: it may hold back at most mu times that."""
    w = np.array([1.0, 0.0, 0.0, 0.0])
    p = FLOOR.copy()
    p[0] += [pull, -0.05, 0.0]
    q, buffers = solved(FLOOR, p, w, 0.1, friction, 10)
    assert buffers.active == 1
    assert q[0, 1] == pytest.approx(0.1, abs=1e-12)
    assert q[0, 0] - FLOOR[0, 0] == pytest.approx(kept, abs=1e-12)
    assert buffers.arrays.pressed[0] == pytest.approx(0.09)
    assert np.linalg.norm(buffers.arrays.dragged[0]) <= friction * 0.09 * (1 + 1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_contact_keeps_momentum_and_cones(seed):
    rng = np.random.default_rng(seed)
    scene = stack(3, 3, gap=0.012)
    model = ClothModel(scene)
    x = scene.start + rng.normal(0, 0.001, scene.start.shape)
    p = x + rng.normal(0, 0.01, x.shape)
    quads, kinds = every_quad(model.faces)
    w = rng.uniform(1, 9, len(x))
    q, buffers = solved(x, p, w, 0.01, 0.4, 6, quads, kinds)
    pressed, dragged = (getattr(buffers.arrays, name)[: buffers.active] for name in ("pressed", "dragged"))
    assert (pressed > 0).sum() > 20
    assert np.abs(q - p).max() > 1e-3
    assert (q - p).T @ (1 / w) == pytest.approx(0.0, abs=1e-13)
    assert (pressed >= 0).all()
    assert (np.linalg.norm(dragged, axis=1) <= 0.4 * pressed * (1 + 1e-9)).all()
    assert np.einsum("ij,ij->i", dragged, buffers.arrays.normals[: buffers.active]) == pytest.approx(0.0, abs=1e-12)


def test_contact_never_pulls():
    w = np.ones(4)
    p = FLOOR + np.array(
        [[0, 0.06, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
    )  # 12 cm apart: active, but further than the thickness
    q, buffers = solved(FLOOR, p, w, 0.1, 0.5, 10)
    assert buffers.active == 1
    assert (q == p).all()


def test_colliding_sheets_do_not_rebound():
    """Two equal sheets meet at 2 m/s: momentum stays, and they leave each other with almost no speed."""
    scene = stack(2, 4, gap=0.03, stretch=500.0, shear=100.0, friction=0.0, flexion=0.0)
    sim = cg.Simulation(scene, dataclasses.replace(CONTACT_ONLY, substeps=8))
    lower = sim.model.cloth_of_vertex == 0
    sim.set_velocities(np.where(lower[:, None], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]))
    masses = sim.model.masses
    before = masses @ sim.velocities
    sim.step(4)
    assert masses @ sim.velocities == pytest.approx(before, abs=1e-12)
    speed = [sim.velocities[part, 1].mean() for part in (lower, ~lower)]
    assert sim.metrics()["work"]["contacts"] > 0
    assert abs(speed[1] - speed[0]) < 0.1
    distance = sim.positions[~lower, 1].mean() - sim.positions[lower, 1].mean()
    assert 0.008 < distance < 0.015


# ---------------------------------------------------------------------------------------------------------------
# piles


def pile(count: int = 5, cells: int = 6, seed: int = 0) -> cg.Scene:
    rng = np.random.default_rng(seed)
    mesh = cg.grid(0.6, 0.6, cells, cells)
    material = cg.Material(density=0.15, stretch=3e3, shear=5e2, flexion=1.0, damping=4.0, friction=0.1, thickness=5e-3)
    cloths = []
    for k in range(count):
        c, s = np.cos(a := rng.uniform(0, 6)), np.sin(a)
        place = [*rng.uniform(-0.05, 0.05, 2), 0.0]
        turned = mesh.transformed([[c, 0, s], [0, 1, 0], [-s, 0, c]], [place[0], 0.05 + 0.02 * k, place[1]])
        vertices = turned.vertices + rng.uniform(-0.004, 0.004, (len(turned.vertices), 1)) * [0, 1, 0]
        cloths.append(cg.Cloth(cg.Mesh(vertices, mesh.faces, mesh.quads), material, (), mesh.vertices))
    return cg.Scene(cloths, ground=0.0, step=0.01)


@pytest.mark.parametrize(("seed", "integrator"), [(0, "xpbd"), (1, "xpbd"), (2, "symplectic_euler")])
def test_a_pile_never_intersects_and_comes_to_rest(seed, integrator):
    sim = cg.Simulation(pile(seed=seed), cg.Fidelity(untangling="none", integrator=integrator, substeps=0))
    for _ in range(60):
        sim.step()
        assert sim.last_intersections.hit_count == 0
    assert sim.positions[:, 1].min() > -1e-4
    assert sim.positions[:, 1].max() < 0.06
    assert sim.metrics()["max_speed"] < 0.5
    heights = [sim.positions[part, 1].mean() for _, part, _ in sim.cloth_ranges]
    assert (np.diff(heights) > 0.5 * 5e-3).all(), "the order of the layers is lost"
    assert sim.metrics()["max_strain"] < 0.05


@pytest.mark.parametrize("shifted", [False, True])
def test_sheets_that_start_on_each_other_do_not_end_interlocked(shifted):
    """Layers at distance zero have no side to keep: untangling must sort out what contact cannot."""
    mesh = cg.grid(0.4, 0.4, 4, 4)
    upper = mesh if not shifted else mesh.transformed(translation=(0.013, 0.0, 0.021))
    sim = cg.Simulation(cg.Scene([cg.Cloth(mesh), cg.Cloth(upper)], ground=-0.3), cg.Fidelity())
    sim.set_velocities(np.random.default_rng(0).normal(0, 0.05, (50, 3)))
    sim.step(40)
    assert np.isfinite(sim.positions).all()
    assert sim.last_intersections.hit_count == 0


def test_a_rest_shape_with_a_flat_face_keeps_a_thickness():
    """One triangle without area must not switch contact off at its vertices."""
    mesh = cg.grid(0.4, 0.4, 4, 4)
    faces = np.concatenate([mesh.faces, [[0, 1, 2]]])  # three vertices of the first row
    model = ClothModel(cg.Scene([cg.Cloth((mesh.vertices, faces), cg.Material(thickness=2e-3))]))
    assert model.thickness == pytest.approx(2e-3)
