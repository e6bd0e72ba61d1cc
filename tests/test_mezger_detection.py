"""The techniques of Mezger 2003 in the simulation: what promises to miss nothing changes no bit, whatever is kept."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache

import meshes
import naive_dop
import numpy as np
import pytest

import clothgym as cg
from clothgym.detection import judge
from clothgym.detection.brute_force import BruteForce
from clothgym.detection.dop_tree import DopTree
from clothgym.detection.mezger import MezgerHierarchy, laid_out, pattern_corners
from clothgym.kernels import dop_pairs
from clothgym.response.contact import Candidates

DRAFT = cg.Fidelity.preset("draft")
SCENES = {
    "squares": (lambda: cg.scenes.make("squares", count=4), 5),
    "drop": (lambda: cg.scenes.make("drop", resolution=12, height=0.2), 40),
    "layers": (lambda: cg.scenes.make("layers", vertices=9), 5),
}
COMPLETE = {
    "plain": {"cones": "none"},
    "default": {},
    "k 6, binary": {"k": 6, "arity": 2},
    "k 8, octree": {"k": 8, "arity": 8},
    "k 26": {"k": 26},
    "conservative": {"inflation": "conservative"},
    "conservative, all wide": {"inflation": "conservative", "wide_angle": 0.0},
    "lazy": {"lazy": 5e-4},
    "lazy, conservative": {"lazy": 2e-4, "inflation": "conservative", "face_groups": 3},
    "coherence": {"coherence": 2e-3, "cones": "none"},
    "separation list": {"separation_list": 5},
    "pattern": {"build_space": "pattern"},
    "rebuilt": {"rebuild_growth": 1.01},
    "everything": {"coherence": 1e-3, "lazy": 2e-4, "separation_list": 7, "rebuild_growth": 1.05, "inflation": "conservative",
                   "build_space": "pattern"},
}  # fmt: skip
"""Settings that promise to miss nothing."""


def mezger(**settings) -> cg.Fidelity:
    return dataclasses.replace(DRAFT, detection="mezger", **settings)


@cache
def with_brute_force(name: str) -> tuple[str, dict, np.ndarray]:
    make, steps = SCENES[name]
    sim = cg.Simulation(make(), dataclasses.replace(DRAFT, detection="brute_force"))
    sim.step(steps)
    return sim.state_hash(), sim.metrics(), last_quads(sim)


def last_quads(sim) -> np.ndarray:
    found = sim.pipeline.stages[-1].candidates
    return np.concatenate([found.kinds[: found.count, None], found.quads[: found.count]], axis=1)


@pytest.mark.parametrize("settings", COMPLETE.values(), ids=COMPLETE)
@pytest.mark.parametrize("name", SCENES)
def test_no_bit_differs_from_trying_all_pairs(name, settings):
    make, steps = SCENES[name]
    sim = cg.Simulation(make(), mezger(**settings))
    sim.step(steps)
    state, metrics, quads = with_brute_force(name)
    assert sim.state_hash() == state
    assert np.array_equal(last_quads(sim), quads)
    work = sim.metrics()["work"]
    for counter in ("primitive_pairs", "contacts", "hits", "rebuilds"):
        assert work.get(counter) == metrics["work"].get(counter), counter
    assert metrics["work"]["contacts"] > 10
    assert (metrics["work"].get("hits", 0) > 10) == (name != "drop")


@pytest.mark.parametrize("settings", [COMPLETE["everything"], COMPLETE["coherence"], {"inflation": "unoriented"}])
def test_what_is_kept_does_not_survive_reset_and_restore(settings):
    make, steps = SCENES["drop"]
    sim = cg.Simulation(make(), mezger(**settings))
    sim.step(steps - 8)
    middle = sim.snapshot()
    sim.step(8)
    state, work = sim.state_hash(), sim.metrics()["work"]
    sim.restore(middle)
    sim.step(8)
    assert sim.state_hash() == state
    sim.set_positions(sim.positions + 0.3)  # elsewhere, and back
    sim.step()
    sim.restore(middle)
    sim.step(8)
    assert sim.state_hash() == state
    for seed in range(2):
        sim.reset(seed)
        sim.step(steps)
        assert sim.state_hash() == state
        assert sim.metrics()["work"] == work, "counters begin alike"


def test_the_clustered_hierarchy_rebuilt_changes_no_bit_either():
    for name in ("drop", "layers"):
        make, steps = SCENES[name]
        hashes, built = set(), []
        for growth in (1.0, 1.01, 1e6):
            sim = cg.Simulation(make(), dataclasses.replace(DRAFT, rebuild_growth=growth))
            sim.step(steps)
            built.append(sim.metrics()["work"].get("trees_built", 0))
            hashes.add(sim.state_hash())
            work = sim.metrics()["work"]
            sim.reset()
            sim.step(steps)
            assert sim.state_hash() in hashes and sim.metrics()["work"] == work
        assert len(hashes) == 1
        assert built[0] >= built[1] >= built[2] == 0 < built[0]


# What is counted


def fluttering(speed: float = 2.0, gap: float = 0.05) -> Callable[..., cg.Simulation]:
    """A sheet above another one, which comes near at 3 m/s while every vertex goes its own way too; takes settings."""
    flat = cg.grid(0.4, 0.4, 10, 10)
    cloths = [cg.Cloth(flat.transformed(translation=(0.0, gap * n, 0.01 * n)), name=str(n)) for n in range(2)]
    scene = cg.Scene(cloths, gravity=(0.0, 0.0, 0.0), step=0.01)

    def make(**settings) -> cg.Simulation:
        sim = cg.Simulation(scene, mezger(**settings))
        rng = np.random.default_rng(0)
        v = speed * rng.normal(size=sim.positions.shape)
        v[len(flat.vertices) :, 1] -= 3.0
        sim.set_velocities(v)
        return sim

    return make


def test_misses_are_counted():
    lost = {}
    for name, settings in {
        "swept": {}, "conservative": {"inflation": "conservative"}, "oriented": {"inflation": "oriented"},
        "unoriented": {"inflation": "unoriented"}, "everything": COMPLETE["everything"],
    }.items():  # fmt: skip
        sim = fluttering()(**settings)
        watched = judge.watch(sim)
        sim.step(2)
        lost[name] = watched.missed
        assert watched.near > 1000 and watched.missed_hits == 0
    assert lost["swept"] == lost["conservative"] == lost["everything"] == 0
    assert lost["unoriented"] > 10 and lost["unoriented"] > lost["oriented"] > 0


@pytest.mark.parametrize("name", ["squares", "layers"])
def test_complete_settings_are_judged_to_miss_nothing(name):
    for settings in (COMPLETE["default"], COMPLETE["everything"]):
        sim = cg.Simulation(SCENES[name][0](), mezger(**settings))
        watched = judge.watch(sim)
        sim.step(3)
        assert (watched.missed, watched.missed_hits) == (0, 0)
        assert watched.near > 100 and watched.hits > 10


def test_judges_share_what_is_tried_and_count_the_same(monkeypatch):
    chosen = {"swept": {}, "octree": {"arity": 8}, "unoriented": {"inflation": "unoriented"}}
    alone, tried = {}, []
    search = BruteForce.search
    monkeypatch.setattr(
        BruteForce, "search", lambda self, near, hits: (tried.append(hits), search(self, near, hits))[1]
    )
    for name, settings in chosen.items():
        sim = fluttering()(**settings)
        watched = judge.watch(sim)
        sim.step(2)
        alone[name] = (watched.missed, watched.near, watched.missed_hits, watched.hits), sim.state_hash()
    assert alone["swept"] == alone["octree"] and alone["swept"][0] != alone["unoriented"][0]
    one_each = len(tried)
    tried.clear()
    sims = {name: fluttering()(**settings) for name, settings in chosen.items()}
    model = sims["swept"].model
    truth = judge.Truth(model.surface, model.vertex_count, keep=True)
    watching = {}
    for name, sim in sims.items():
        candidates = sim.pipeline.stages[-1].candidates
        candidates.tree = watching[name] = judge.Judge(candidates.tree, truth)
    for _ in range(2):
        for sim in sims.values():
            sim.step()
        truth.forget()
    for name, watched in watching.items():
        counted = watched.missed, watched.near, watched.missed_hits, watched.hits
        assert (counted, sims[name].state_hash()) == alone[name], name
    assert 0 < len(tried) <= one_each * 2 / 3, "what two runs have in common is tried twice"


def test_a_judge_needs_a_detector():
    with pytest.raises(ValueError, match="no self-collision"):
        judge.watch(cg.Simulation(cg.scenes.make("hanging_sheet", resolution=4)))


def test_the_curvature_criterion_misses_folds_and_keeps_layers():
    """A flat layer a hair above another is never pruned, for it is another object; a crumpled sheet is, wrongly."""
    flat = cg.grid(0.2, 0.2, 8, 8)
    layers = [flat.transformed(translation=(0.0, y, 0.0)).vertices for y in (0.0, 1e-3)]
    x, faces = meshes.merged(*((v, flat.faces) for v in layers))
    surface = cg.Surface(faces, len(x))
    across = {}
    for cones in ("none", "mezger"):
        for angle in (0.0, 0.5) if cones == "mezger" else (0.0,):
            tree = MezgerHierarchy(surface, x, mezger(cones=cones, leaf_angle=angle))
            tree.refit(x, x, 1e-3)
            tree.search(near=True, hits=False)
            v, f = tree.vertex_face[: tree.counts[0]].T
            across[cones, angle] = np.flatnonzero((v < len(flat.vertices)) != (f < len(flat.faces))), tree.counters
    assert len(across["none", 0.0][0]) > 100
    assert len(across["mezger", 0.0][0]) == len(across["mezger", 0.5][0]) == len(across["none", 0.0][0])
    assert across["mezger", 0.0][1]["cone_pruned"] > 0 and across["mezger", 0.5][1]["filtered"] > 0
    crumpled, faces = meshes.crumple(16, 0, 0.5)
    surface = cg.Surface(faces, len(crumpled))
    hits = {}
    for cones in ("none", "mezger", "exact"):
        tree = MezgerHierarchy(surface, crumpled, mezger(cones=cones))
        tree.refit(crumpled, crumpled, 0.0)
        hits[cones] = len(
            cg.detection.intersections.Intersections(crumpled, surface, tree.edges_against_faces()).points
        )
    assert hits["none"] == hits["exact"] >= hits["mezger"] > 0


def test_what_hardly_moves_is_looked_for_less():
    """Sheets at rest: lazy update refits less, coherence and the list test less, and all find the same."""
    counted, hashes = {}, set()
    for name, settings in {
        "plain": {}, "lazy": {"lazy": 1e-3}, "coherence": {"coherence": 2e-3}, "list": {"separation_list": 50},
    }.items():  # fmt: skip
        sim = fluttering(1e-3, 3e-3)(cones="none", **settings)
        sim.set_velocities(1e-2 * np.asarray(sim.velocities))
        sim.step(6)
        hashes.add(sim.state_hash())
        counted[name] = sim.metrics()["work"]
    assert len(hashes) == 1
    assert counted["lazy"]["refits"] < 0.6 * counted["plain"]["refits"]
    assert counted["list"]["box_tests"] < 0.8 * counted["plain"]["box_tests"]
    assert counted["coherence"]["box_tests"] < 0.6 * counted["plain"]["box_tests"]
    assert counted["coherence"]["reused_pairs"] > 0
    assert "primitive_tests" not in counted["plain"]


def test_exact_cones_and_tighter_boxes_test_less():
    counted = {}
    for name, settings in {
        "none": {"cones": "none"}, "exact": {}, "k 6": {"k": 6, "cones": "none"}, "binary": {"arity": 2, "cones": "none"},
    }.items():  # fmt: skip
        sim = cg.Simulation(SCENES["drop"][0](), mezger(**settings))
        sim.step(10)
        counted[name] = sim.metrics()["work"]
    assert counted["exact"]["box_tests"] < 0.9 * counted["none"]["box_tests"]
    assert counted["exact"]["cone_pruned"] > 0 and "cone_tests" not in counted["none"]
    assert counted["none"]["leaf_pairs"] < counted["k 6"]["leaf_pairs"]
    assert counted["none"]["refits"] < counted["binary"]["refits"]


# Parts


@pytest.mark.parametrize(("settings", "message"), [
    ({"lazy": 1e-3}, "lazy = 0.001: works with detection 'mezger' only"),
    ({"cones": "none", "detection": "brute_force"}, "cones = 'none': works with detection 'mezger' only"),
    ({"rebuild_growth": 1.5, "detection": "brute_force"}, "rebuild_growth = 1.5: works with detection 'hierarchy' or"),
    ({"detection": "mezger", "leaf_angle": 0.5}, "leaf_angle = 0.5: works with cones 'mezger' only"),
    ({"detection": "mezger", "wide_angle": 0.5}, "wide_angle = 0.5: works with inflation 'oriented' or 'conservative'"),
    ({"detection": "mezger", "inflation": "round"}, "fidelity.inflation"),
    ({"detection": "mezger", "coherence": -1.0}, "fidelity.coherence"),
])  # fmt: skip
def test_a_field_that_would_do_nothing_is_refused(settings, message):
    with pytest.raises(ValueError, match=message) as caught:
        cg.Fidelity(**settings)
    assert "\n" not in str(caught.value)


def test_fields_survive_json():
    fidelity = mezger(**COMPLETE["everything"])
    assert cg.Fidelity.from_json(fidelity.to_json()) == fidelity


def test_pieces_are_split_from_each_other_first():
    """Seven sheets through each other at one place: every node holds one of them, or whole ones."""
    sheets = [meshes.moved(meshes.grid(5, 4), meshes.rotation(n), (0.01 * n, 0.0, 0.0)) for n in range(7)]
    x, faces = sheets[0]
    for sheet in sheets[1:]:
        x, faces = meshes.merged((x, faces), sheet)
    surface = cg.Surface(faces, len(x))
    corners = laid_out(surface, x[surface.faces], x)
    for arity in (2, 4, 8):
        tree = DopTree(surface.faces, len(x), corners, 18, arity, 0, False).tree
        below = [set() for _ in tree.child_count]
        for node in range(len(below) - 1, -1, -1):
            first = tree.child_start[node]
            below[node] = {int(tree.node_face[node])} if tree.child_count[node] == 0 else set().union(
                *below[first : first + tree.child_count[node]]
            )  # fmt: skip
            of = np.bincount([f // 40 for f in below[node]], minlength=7)
            assert np.count_nonzero(of) == 1 or set(of.tolist()) <= {0, 40}
    assert len(faces) == 280
    alone = cg.Surface(sheets[0][1])
    assert laid_out(alone, sheets[0][0][alone.faces], sheets[0][0]) is not None


def test_the_pattern_of_a_sewn_cloth_has_its_panels_apart():
    flat = cg.grid(0.2, 0.2, 4, 4)
    x, faces = flat.vertices, flat.faces
    half = np.arange(len(faces)) % 32 < 16  # rows: two panels that share a seam, both drawn at the same place
    corners = x[faces] + np.where(half, 0.0, 0.1)[:, None, None] * [0.0, 0.0, 1.0]
    scene = cg.Scene(
        [cg.Cloth(flat, rest=corners), cg.Cloth(flat.transformed(translation=(0.0, 0.1, 0.0)), name="two")]
    )
    sim = cg.Simulation(scene, mezger(build_space="pattern"))
    given = pattern_corners(sim.model.surface, [(c.mesh.faces, c.rest) for c in scene.cloths])
    assert given.shape == (64, 3, 3)
    placed = laid_out(sim.model.surface, given, scene.start)
    shifts = (placed - given).reshape(64, -1, 3)
    assert np.ptp(shifts, axis=1).max() < 1e-12, "faces keep their shape"
    pieces = np.unique(shifts[:, 0].round(9), axis=0)
    assert len(pieces) == 3
    plain = cg.Simulation(scene, mezger())
    sim.step(3), plain.step(3)
    assert sim.state_hash() == plain.state_hash()
    assert sim.metrics()["work"]["box_tests"] != plain.metrics()["work"]["box_tests"]


@pytest.mark.parametrize("kind", [0, 1])
def test_stored_barycentrics_bound_the_distance(kind):
    """Kept pairs are dropped only while they are surely too far: after any motion within the slack."""
    rng = np.random.default_rng(kind)
    x = rng.uniform(size=(60, 3))
    faces = np.arange(60).reshape(-1, 3)
    surface = cg.Surface(faces, 60)
    columns = len(surface.faces if kind == 0 else surface.edges)
    rows = 60 if kind == 0 else columns
    keys = np.array([r * columns + c for r in range(rows) for c in range(columns)
                     if (r // 3 != c if kind == 0 else r // 3 < c // 3)])  # fmt: skip
    radius, still = rng.uniform(0.0, 0.1, 60), np.zeros((60, 3))
    slack = 0.05
    weights = np.empty((len(keys), 3))
    kept = keys.copy()
    count = dop_pairs.measure(x, still, radius, surface.faces, surface.edges, kind, columns, 3.0 * slack, kept, weights)
    assert 10 < count < len(keys)

    def ids(key):
        r, c = divmod(int(key), columns)
        return ([r], surface.faces[c]) if kind == 0 else (surface.edges[r], surface.edges[c])

    def needed(places):
        """Pairs within their radii, tried one by one."""
        found = set()
        for key in keys:
            p, q = ids(key)
            reach = radius[p].max() + radius[q].max()
            if naive_dop.distance(places[[*p, *q]], kind) <= reach - 1e-12:
                found.add(int(key))
        return found

    moved = (
        x + slack * 0.5 * meshes.rotation(kind)[rng.integers(0, 3, 60)]
    )  # each by half the slack: relative ways within it
    everywhere = np.tile([-10.0, 10.0], (60, 13))
    chosen = np.empty(count, np.int64)
    left = dop_pairs.still_near(
        moved, still, radius, everywhere, surface.faces, surface.edges, kind, columns, kept[:count], weights[:count],
        np.full(count, slack), chosen,
    )  # fmt: skip
    true = needed(moved)
    assert true <= set(chosen[:left].tolist()) and len(true) > 20 and left < count


def test_the_size_of_a_tree_is_the_surface_of_its_boxes():
    x, faces = meshes.crumple(6, 1)
    surface = cg.Surface(faces, len(x))
    sheet = MezgerHierarchy(surface, x, mezger(arity=2))
    tree = sheet._tree.tree
    below = [None] * len(tree.child_count)
    total = 0.0
    for node in range(len(below) - 1, -1, -1):
        first, count = tree.child_start[node], tree.child_count[node]
        inside = faces[tree.node_face[node]] if count == 0 else np.concatenate(below[first : first + count])
        below[node] = inside
        a, b, c = np.ptp(x[inside], axis=0)
        total += a * b + b * c + c * a
    assert dop_pairs.tree_size(tree, x) == pytest.approx(total)


def test_candidates_report_what_was_counted_once():
    sim = cg.Simulation(SCENES["layers"][0](), mezger())
    sim.step(2)
    found = sim.pipeline.stages[-1].candidates
    assert isinstance(found, Candidates) and isinstance(found.tree, MezgerHierarchy)
    work = sim.metrics()["work"]
    assert all(work[name] == total for name, total in found.tree.counters.items() if total)
    assert {"box_tests", "leaf_pairs", "cone_tests", "refits"} <= set(work)
