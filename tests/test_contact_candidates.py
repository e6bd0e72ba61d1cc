"""Candidates of contact: no pair is missing, strays are listed once, and what is not near stays apart."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import naive_mechanics as naive
import numpy as np
import pytest
from contact_cases import CONTACT_ONLY, every_quad, narrowed, stack

import clothgym as cg
from clothgym.detection.brute_force import BruteForce
from clothgym.detection.hierarchy import Hierarchy
from clothgym.detection.mezger import MezgerHierarchy
from clothgym.kernels import certificate, near_pairs
from clothgym.model import ClothModel
from clothgym.response.contact import Candidates, ContactBuffers, watched_pairs
from clothgym.response.strays import Strays
from clothgym.stages.contact import ContactSubsteps

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
