"""Contact: closest points, complete candidates, the certificate, friction, and piles that never intersect."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import naive_mechanics as naive
import numpy as np
import pytest

import clothgym as cg
from clothgym.detection.brute_force import BruteForce
from clothgym.detection.hierarchy import Hierarchy
from clothgym.detection.mezger import MezgerHierarchy
from clothgym.detection.sides import Sides
from clothgym.kernels import certificate, near_pairs
from clothgym.kernels import contact as kernels
from clothgym.kernels.integrate import Grips, Ground, Motion
from clothgym.model import ClothModel
from clothgym.response.contact import Candidates, ContactBuffers, watched_pairs
from clothgym.response.strays import Strays
from clothgym.stages.contact import ContactSubsteps

CONTACT_ONLY = cg.Fidelity(untangling="none", substeps=4, flat_check=False)


def no_grips() -> Grips:
    return Grips(np.zeros(0, np.int32), *(np.zeros((0, 3)) for _ in range(2)), np.zeros(0), np.zeros(0),
                 np.zeros((0, 3)), np.zeros((0, 3)))  # fmt: skip


def stack(count: int = 3, cells: int = 3, gap: float = 0.03, pinned=(), **settings) -> cg.Scene:
    """Level sheets of 30 cm above each other, a little shifted; no gravity unless asked for."""
    scene = {"gravity": (0.0, 0.0, 0.0)} | {k: settings.pop(k) for k in ("gravity", "ground", "step") if k in settings}
    material = cg.Material(**({"thickness": 0.01, "damping": 0.0} | settings))
    mesh = cg.grid(0.3, 0.3, cells, cells)
    cloths = []
    for k in range(count):
        placed = mesh.transformed(translation=(0.011 * k, gap * (k + 1), 0.007 * k))
        cloths.append(cg.Cloth(placed, material, (0, cells) if k in pinned else (), mesh.vertices, f"sheet {k}"))
    return cg.Scene(cloths, **scene)


def narrowed(x, p, quads, kinds, thickness, apart=None, w=None) -> tuple[ContactBuffers, near_pairs.Watched]:
    """Contacts on the way from x to p, and what is known of every given pair."""
    w = np.ones(len(x)) if w is None else w
    pairs = SimpleNamespace(
        watched=watched_pairs(len(quads), len(x)), count=len(quads), model=SimpleNamespace(inverse_masses=w)
    )
    pairs.watched.quads[:], pairs.watched.kinds[:], pairs.watched.rest[:] = quads, kinds, thickness
    # nothing is known of any distance: every pair is measured
    near_pairs.begin(x + 1.0, pairs.watched, len(quads))
    buffers = ContactBuffers(16)
    apart = np.zeros(len(x), np.bool_) if apart is None else apart
    buffers.narrow(x, p, pairs, apart, False, 0.0)
    return buffers, pairs.watched


def every_quad(faces) -> tuple[np.ndarray, np.ndarray]:
    points, lines = naive.all_quads(faces)
    return np.concatenate([points, lines]), np.r_[np.zeros(len(points), np.uint8), np.ones(len(lines), np.uint8)]


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
# candidates


def listed(candidates: Candidates) -> set[tuple]:
    """Pairs in a form that does not depend on the order of edges and of their ends."""
    found = set()
    for quad, kind in zip(candidates.quads[: candidates.count].tolist(), candidates.kinds.tolist(), strict=False):
        found.add(normal_form(quad, kind))
    assert len(found) == candidates.count, "a pair comes twice"
    return found


def normal_form(quad, kind) -> tuple:
    if kind == 0:
        return (0, quad[0], *sorted(quad[1:]))
    return (1, *sorted((tuple(sorted(quad[:2])), tuple(sorted(quad[2:])))))


@pytest.mark.parametrize("tree", [Hierarchy, BruteForce])
@pytest.mark.parametrize("seed", range(4))
def test_no_pair_within_thickness_is_missing(tree, seed):
    """While no vertex is further than its slack from where it was expected, at every time of the step."""
    rng = np.random.default_rng(seed)
    scene = stack(3, 2, gap=0.04, thickness=[0.005, 0.03][seed % 2])
    model = ClothModel(scene)
    x = scene.start + rng.normal(0, 0.02, scene.start.shape)
    travel = rng.normal(0, [0.003, 0.1][seed // 2], x.shape)
    travel[model.cloth_of_vertex == 1] += [0.0, 0.1, 0.05]
    candidates = Candidates(model, tree(model.surface, x, 18, 4))
    candidates.expect(x, travel)
    candidates.gather()
    found = listed(candidates)
    points, lines = naive.all_quads(model.faces)
    near = set()
    for time in np.linspace(0, 1, 9):
        for _ in range(6):
            off = rng.normal(size=x.shape)
            off *= (candidates.slack * rng.choice([0.0, 1.0, 1.0], len(x)) / np.linalg.norm(off, axis=1))[:, None]
            now = x + time * travel + off
            assert not candidates.outdated(now - 1e-12 * off, time)
            for kind, quads, distances in zip(
                (0, 1), (points, lines), naive.quad_distances(now, points, lines), strict=True
            ):
                close = distances <= model.thickness[quads].min(axis=1)
                near |= {normal_form(quad, kind) for quad in quads[close].tolist()}
    assert len(near) > 20
    assert near <= found
    assert len(found) < len(points) + len(lines), "everything is a candidate: the test shows nothing"


@pytest.mark.parametrize("tree", [Hierarchy, BruteForce])
def test_pairs_at_the_very_edge_of_their_slack_are_listed(tree):
    """Straight above each other, both at the end of their slack, thickness apart: the worst case that is promised."""
    mesh = cg.grid(0.2, 0.2, 1, 1)
    for inside, expected in ((-1e-9, True), (1e-3, False)):
        gap = 1.0
        for _ in range(3):  # slack depends on thickness only, while nothing is expected to move
            lift = mesh.transformed(translation=(0.0, gap, 0.0))
            material = cg.Material(thickness=0.01)
            model = ClothModel(cg.Scene([cg.Cloth(mesh, material), cg.Cloth(lift, material)]))
            start = np.concatenate([mesh.vertices, lift.vertices])
            candidates = Candidates(model, tree(model.surface, start, 18, 4))
            candidates.expect(start, np.zeros_like(start))
            candidates.gather()
            gap = 0.01 + 2.0 * candidates.slack[0] + inside
        across = [quad for quad in candidates.quads[: candidates.count].tolist() if min(quad) < 4 <= max(quad)]
        assert bool(across) == expected
        if expected:
            assert {min(q) for q in across} | {max(q) for q in across} >= {0, 3, 4, 7}


def test_common_motion_needs_no_second_look():
    """What goes where it was expected to go is looked for once a step."""
    sim = cg.Simulation(stack(3, 3), dataclasses.replace(CONTACT_ONLY, substeps=8))
    sim.set_velocities(np.tile([3.0, -2.0, 1.0], (48, 1)))
    sim.step(2)
    assert sim.metrics()["work"].get("rebuilds", 0) == 0


def test_trees_differ_only_in_what_they_reject():
    rng = np.random.default_rng(3)
    scene = stack(4, 3, gap=0.02)
    model = ClothModel(scene)
    x, travel = scene.start + rng.normal(0, 0.01, scene.start.shape), rng.normal(0, 0.03, scene.start.shape)
    results = []
    paper = MezgerHierarchy(model.surface, x, cg.Fidelity(detection="mezger", k=6, arity=2))
    for tree in (
        Hierarchy(model.surface, x, 6, 2), Hierarchy(model.surface, x, 26, 8), BruteForce(model.surface, x), paper,
    ):  # fmt: skip
        candidates = Candidates(model, tree)
        candidates.watched = watched_pairs(3, len(x))  # far too small: grows by counting
        candidates.expect(x, travel)
        candidates.gather()
        results.append(listed(candidates))
        assert candidates.count > 100
        assert len(candidates.watched.separation) >= candidates.count
    assert results[1] == results[2] == results[3], "boxes on all axes reject what the primitives' own boxes reject"
    assert results[1] < results[0]


@pytest.mark.parametrize("seed", range(4))
def test_pairs_of_vertices_that_stray_are_listed_once(seed):
    """As many as may be, in the middle of everything, and neighbours: none missing within the new slack, the others stay."""
    rng = np.random.default_rng(seed)
    scene = stack(3, 5, gap=0.02)
    loose = cg.Mesh(np.array([[0.1, 0.03, 0.1], [0.2, 0.03, 0.1], [0.1, 0.03, 0.2], [0.15, 0.03, 0.15]]), [[0, 1, 2]])
    scene = dataclasses.replace(scene, cloths=(*scene.cloths, cg.Cloth(loose, cg.Material(thickness=0.004))))
    model = ClothModel(scene)
    x = scene.start + rng.normal(0, 0.002, scene.start.shape)
    travel = rng.normal(0, 0.002, x.shape) + np.array([0.0, 0.3, 0.0])
    candidates = Candidates(model, Hierarchy(model.surface, x))
    candidates.watched, candidates.strays = watched_pairs(1, len(x)), Strays(model.surface, 2)
    candidates.expect(x, travel)
    candidates.gather()
    before = listed(candidates)
    share = [0.2, 1.0][seed % 2]
    ids = rng.choice(len(x), 2, replace=False) if seed < 2 else np.array([44, 45])
    if seed == 3:
        ids[1] = len(x) - 1  # of no face
    now = x + share * travel
    now[ids] += (1.5 * candidates.slack[ids] + [0.0, 0.02])[:, None] * np.array([0.0, 0.6, 0.8])
    assert candidates.outdated(now, share)
    assert candidates.widen(now, share)
    assert not candidates.outdated(now, share)
    after = [
        normal_form(q, k)
        for q, k in zip(candidates.quads[: candidates.count].tolist(), candidates.kinds.tolist(), strict=False)
    ]
    assert len(after) == len(set(after))
    points, lines = naive.all_quads(model.faces)
    near, reached = set(), set()
    for kind, quads, distances in zip((0, 1), (points, lines), naive.quad_distances(x, points, lines), strict=True):
        with_stray = np.isin(quads, ids).any(axis=1) & (quads < len(x) - 1).all(axis=1)  # the last one is of no face
        reach = np.zeros(len(quads))
        for i in range(1 if kind == 0 else 2):
            for j in range(1 if kind == 0 else 2, 4):
                a, b = quads[:, i], quads[:, j]
                way = np.linalg.norm(travel[a] - travel[b], axis=1)
                reach = np.maximum(reach, way + candidates.slack[a] + candidates.slack[b])
        reach += model.thickness[quads].min(axis=1)
        near |= {normal_form(q, kind) for q in quads[with_stray & (distances <= reach * (1 - 1e-9))].tolist()}
        reached |= {normal_form(q, kind) for q in quads[with_stray & (distances <= reach * (1 + 1e-9))].tolist()}
    strayed = {pair for pair in after if np.isin(np.hstack([np.ravel(part) for part in pair[1:]]), ids).any()}
    assert near <= strayed <= reached
    assert len(near - before) > 10, "nothing new is found: the test shows nothing"
    kept = set(after) - strayed
    assert kept == {pair for pair in before if not np.isin(np.hstack([np.ravel(part) for part in pair[1:]]), ids).any()}


def test_many_strays_are_left_to_a_search_of_all_pairs():
    scene = stack(2, 5)
    model = ClothModel(scene)
    candidates = Candidates(model, Hierarchy(model.surface, scene.start))
    candidates.strays = Strays(model.surface, 2)
    for moved, times in ((list(range(20)), 0), ([3], 3)):
        candidates.expect(scene.start, np.zeros_like(scene.start))
        candidates.gather()
        slack = candidates.slack.copy()
        now = scene.start.copy()
        for n in range(times):
            now[moved] += 1.01 * candidates.slack[moved][:, None]
            assert candidates.widen(now, 1.0), n
        now[moved] += 1.01 * candidates.slack[moved][:, None]
        assert candidates.outdated(now, 1.0) and not candidates.widen(now, 1.0)
        if not times:
            assert (candidates.slack == slack).all()
    now[3] = np.nan
    candidates.expect(scene.start, np.zeros_like(scene.start))
    assert candidates.outdated(now, 1.0) and not candidates.widen(now, 1.0)


def test_expectations_go_out_of_date():
    scene = stack(2, 2)
    model = ClothModel(scene)
    candidates = Candidates(model, Hierarchy(model.surface, scene.start))
    travel = np.zeros_like(scene.start)
    travel[3] = [0.0, 0.4, 0.0]
    candidates.expect(scene.start, travel)
    assert candidates.slack[3] > candidates.slack[4] > 0
    for vertex in (3, 4):
        for share in (0.0, 0.3, 1.0):
            moved = scene.start + share * travel
            moved[vertex, 0] += 0.99 * candidates.slack[vertex]
            assert not candidates.outdated(moved, share)
            moved[vertex, 0] += 0.02 * candidates.slack[vertex]
            assert candidates.outdated(moved, share)


# ---------------------------------------------------------------------------------------------------------------
# the certificate


@pytest.mark.parametrize("rounds", [0, 1, 8])
@pytest.mark.parametrize("seed", range(5))
def test_certified_paths_never_cross(seed, rounds):
    rng = np.random.default_rng(seed)
    scene = stack(3, 3, pinned=() if seed % 2 else (1,), thickness=[0.01, 1e-4, 0.03][seed % 3])
    model = ClothModel(scene)
    x = scene.start + rng.normal(0, 0.004, scene.start.shape)
    speed = [0.02, 0.3, 2.0][seed % 3]
    p = x + rng.normal(0, speed, x.shape)
    p[:, 1] += (rng.normal(0, 2 * speed, 3))[model.cloth_of_vertex]
    pinned = model.inverse_masses == 0
    p[pinned] = x[pinned]
    quads, kinds = every_quad(model.faces)
    both = naive.all_quads(model.faces)
    assert not cg.intersections(x, model.surface).hit_count
    assert naive.collisions(x, p, model.faces, quads=both), "nothing would cross: the test shows nothing"
    _, watched = narrowed(x, p, quads, kinds, model.thickness.min())
    before = p.copy()
    certificate.keep_apart(
        x, p, model.inverse_masses, model.thickness, quads, kinds, len(quads), watched.separation, rounds
    )
    assert naive.collisions(x, p, model.faces, quads=both) == []
    for time in np.linspace(0, 1, 21):
        assert cg.intersections(x + time * (p - x), model.surface).hit_count == 0
    assert (p[pinned] == x[pinned]).all()
    if not pinned.any():
        moved = model.masses @ (p - before)
        assert moved == pytest.approx(0.0, abs=1e-12 * speed)


def test_certify_leaves_safe_paths_alone():
    scene = stack(2, 3, gap=0.05)
    model = ClothModel(scene)
    p = scene.start + np.random.default_rng(0).normal(0, 0.002, scene.start.shape)
    quads, kinds = every_quad(model.faces)
    _, watched = narrowed(scene.start, p, quads, kinds, 0.01)
    before = p.copy()
    result = certificate.keep_apart(
        scene.start, p, model.inverse_masses, model.thickness, quads, kinds, len(quads), watched.separation, 8
    )
    assert tuple(result) == (0, 0)
    assert (p == before).all()


def test_certify_alone_stops_one_vertex_at_one_triangle():
    """The vertex keeps at least a tenth of the thickness from the moving triangle, and momentum is kept."""
    x = np.array([[0.2, 0.5, 0.2], [0, 0, 0], [1, 0, 0], [0, 0, 1.0]])
    p = x + np.array([[0, -2.0, 0], [0, 0.5, 0], [0, 0.5, 0], [0, 0.5, 0]])
    w = np.array([1.0, 0.5, 0.5, 0.25])
    quads, kinds = np.array([[0, 1, 2, 3]], np.int32), np.zeros(1, np.uint8)
    for rounds in (0, 20):
        q = p.copy()
        _, watched = narrowed(x, q, quads, kinds, 0.1)
        certificate.keep_apart(x, q, w, np.full(4, 0.1), quads, kinds, 1, watched.separation, rounds)
        assert q[0, 1] - q[1:, 1].max() >= 0.01 - 1e-12
        assert (q - p).T @ (1 / w) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_no_substep_of_a_violent_run_crosses(substeps, seed):
    """Vertices thrown about at up to several 100 m/s: every straight way of every substep is free of collisions."""
    rng = np.random.default_rng(seed)
    scene = stack(3, 3, pinned=(1,) if seed % 2 else (), friction=[0.0, 0.5][seed % 2],
                  thickness=[0.01, 3e-4][seed // 3], stretch=[1e4, 100.0, 1e5][seed % 3])  # fmt: skip
    sim = cg.Simulation(
        scene, dataclasses.replace(CONTACT_ONLY, substeps=[1, 2, 8][seed % 3], repair_rounds=[8, 0][seed % 2])
    )
    both = naive.all_quads(sim.model.faces)
    free = (sim.model.inverse_masses > 0)[:, None]
    for speed in (5.0, 100.0):
        thrown = rng.normal(0, speed, scene.start.shape) + (rng.normal(0, 50, (3, 3)))[sim.model.cloth_of_vertex]
        sim.set_velocities(np.where(free, thrown, 0.0))
        sim.step(2)
    assert len(substeps) == 4 * sim.pipeline.substeps
    for x, p in substeps:
        assert naive.collisions(x, p, sim.model.faces, quads=both) == []
    assert sim.metrics()["work"]["repaired"] + sim.metrics()["work"]["zoned"] > 0
    assert cg.intersections(sim.positions, sim.model.surface).hit_count == 0


@pytest.mark.parametrize("count", [1, 4])
def test_a_gripper_that_jumps_pulls_nothing_through(substeps, count):
    """A hand placed 40 cm further moves vertices that nobody expected to move; a sheet in between must hold."""
    scene = dataclasses.replace(stack(2, 3, gap=0.05, thickness=2e-3), grips=[cg.Grip(stiffness=1e6, slip_force=1e6)])
    sim = cg.Simulation(scene, dataclasses.replace(CONTACT_ONLY, substeps=count))
    sim.place_grip(0, sim.positions[5])
    assert sim.grasp(0, [5]) == 1
    for target in ((0.0, 0.45, 0.0), (0.1, -0.4, 0.1), (-0.1, 0.5, 0.0)):
        sim.place_grip(0, target)
        sim.step()
    assert sim.metrics()["work"]["rebuilds"] > 0
    both = naive.all_quads(sim.model.faces)
    for x, p in substeps:
        assert naive.collisions(x, p, sim.model.faces, quads=both) == []
    assert sim.last_intersections.hit_count == 0


@pytest.mark.parametrize("integrator", ["xpbd", "symplectic_euler"])
@pytest.mark.parametrize("pinned", [(), (0,)])
def test_a_sheet_shot_at_another_does_not_pass_through(substeps, integrator, pinned):
    """At 50 m/s the way of one step, 83 cm, is 400 thicknesses; the sheets are 10 cm apart."""
    scene = stack(2, 3, gap=0.1, pinned=pinned, stretch=100.0, shear=30.0, thickness=2e-3)
    fidelity = dataclasses.replace(CONTACT_ONLY, integrator=integrator, substeps=0 if integrator != "xpbd" else 2)
    sim = cg.Simulation(scene, fidelity)
    both = naive.all_quads(sim.model.faces)
    lower = sim.model.cloth_of_vertex == 0
    velocities = np.zeros_like(scene.start)
    velocities[~lower, 1] = -50.0
    sim.set_velocities(velocities)
    sides = Sides(sim.model.faces, *(vertices for _, vertices, _ in sim.model.ranges))
    required = sides.signs(scene.start)
    assert np.count_nonzero(required) > 4
    for number in range(3):
        sim.step()
        assert cg.intersections(sim.positions, sim.model.surface).hit_count == 0
        if not pinned and number == 0:  # later they are wrapped around each other and sides say nothing
            assert sides.error(sim.positions, required) == 0.0
    assert sim.metrics()["work"]["contacts"] > 0
    for x, p in substeps:  # no crossing on any straight way is the proof, at every substep
        assert naive.collisions(x, p, sim.model.faces, quads=both) == []


# ---------------------------------------------------------------------------------------------------------------
# pairs under watch


@pytest.mark.parametrize("turn", [0.0, 0.02, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_pairs_that_are_not_near_stay_apart(seed, turn):
    """However vertices move between looks: what is far keeps 1.25 thicknesses on its way, near pairs keep a proved gap."""
    rng, turns = np.random.default_rng(seed), np.random.default_rng(seed + 100)
    scene = stack(3, 3, gap=0.02, thickness=0.01)
    model = ClothModel(scene)
    x = scene.start + rng.normal(0, 0.003, scene.start.shape)
    quads, kinds = every_quad(model.faces)
    _, watched = narrowed(x, x, quads, kinds, 0.01)
    apart = np.zeros(len(x), np.bool_)
    buffers = ContactBuffers(len(quads))
    pairs = SimpleNamespace(watched=watched, count=len(quads), model=model)
    points = kinds == 0
    left = measured = 0
    for n in range(40):
        size = [3e-5, 3e-4, 3e-3][n % 3]
        # all together, and each for itself
        p = x + rng.normal(0, size, x.shape) + rng.normal(0, 0.01, 3)
        p += np.cross(turns.normal(0, turn, 3), x)
        measured += buffers.narrow(x, p, pairs, apart, False, 0.0)
        before = p.copy()
        certificate.prove(x, p, model.inverse_masses, model.thickness, watched, len(quads), apart, False, True, 8)
        assert size > 1e-3 or turn > 0.0 or (p == before).all()
        for time in (0.0, 0.5, 1.0):
            now = x + time * (p - x)
            corners = [now[quads[:, k]] for k in range(4)]
            distance = np.where(points, naive.point_triangle(*corners), naive.segment_segment(*corners))
            far = watched.states == near_pairs.FAR
            assert (distance[far] > 1.25 * 0.01 - 1e-12).all()
            assert (distance > 0.0).all()
        left += far.sum()
        x = p
    assert left > 1000, "nothing is far: the test shows nothing"
    assert turn > 0.1 or measured < 0.2 * 40 * len(quads), "everything is measured anew: the test shows nothing"


def test_what_swings_beside_a_pile_does_not_matter_to_it():
    """A vertex without pairs moves to and fro by far more than any pair could bear: nothing is measured again."""
    scene = stack(3, 3, gap=0.02, thickness=0.01)
    quads, kinds = every_quad(ClothModel(scene).faces)
    x = np.concatenate([scene.start, [[2.0, 0.0, 0.0]]])
    p = x.copy()
    p[-1, 1] = 0.02  # all go 0.4 mm on average, in the other direction
    buffers, watched = narrowed(x, x, quads, kinds, 0.01)
    pairs = SimpleNamespace(watched=watched, count=len(quads), model=SimpleNamespace(inverse_masses=np.ones(len(x))))
    apart = np.zeros(len(x), np.bool_)
    for _ in range(5):
        assert buffers.narrow(x, p, pairs, apart, False, 0.0) == 0
        assert buffers.narrow(p, x, pairs, apart, False, 0.0) == 0
    p[7, 1] += 0.03  # a vertex of the pile
    assert 0 < buffers.narrow(x, p, pairs, apart, False, 0.0) < 0.2 * len(quads)


def test_redundant_pairs_press_once():
    """A vertex over another where six triangles meet: one contact from either side; over a triangle's inside: one."""
    mesh = cg.grid(0.3, 0.3, 3, 3)
    corner = mesh.vertices[5]
    for over, ends in ((corner, 2), (corner + np.array([0.066, 0.0, 0.033]), 4)):
        x = np.concatenate([mesh.vertices, over + np.array([[0, 0.008, 0], [0.02, 1.0, 0.2], [-0.02, 1.0, 0.2]])])
        faces = np.concatenate([mesh.faces, [[16, 17, 18]]])
        buffers, watched = narrowed(x, x, *every_quad(faces), 0.01)
        assert (watched.states == near_pairs.NEAR).sum() >= 1 + 5 * (ends == 2)
        rows = buffers.arrays.live[: buffers.active]
        # edges that lean over an edge below cross it, and press besides
        pressing = rows[(buffers.arrays.rest[rows] == 0.01)]
        assert len(pressing) == 1 + (ends == 2) and len(rows) <= 3
        assert (buffers.arrays.ends[pressing] == ends).all()
        assert np.abs(buffers.arrays.normals[pressing]) == pytest.approx(
            np.tile([0, 1, 0], (len(pressing), 1)), abs=1e-9
        )


@pytest.mark.parametrize("near_hits", ["off_any", "keep"])
def test_one_kernel_does_what_its_parts_do(monkeypatch, near_hits):
    """The same bits from all substeps in one kernel, and from one call after the other."""
    hashes = []
    for in_one in (True, False):
        monkeypatch.setattr(ContactSubsteps, "in_one_kernel", in_one)
        scene = stack(3, 4, gap=0.011, gravity=(0.0, -9.81, 0.0), ground=0.0, pinned=(2,))
        sim = cg.Simulation(scene, dataclasses.replace(CONTACT_ONLY, substeps=6, contacts_near_hits=near_hits))
        sim.step(25)
        assert sim.metrics()["work"]["contacts"] > 0
        hashes.append((sim.state_hash(), sim.metrics()["work"]["contacts"], sim.metrics()["clamped"]))
    assert hashes[0] == hashes[1]


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
