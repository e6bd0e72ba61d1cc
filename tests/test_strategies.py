"""Untangling strategies: momentum, memory and directions."""

from __future__ import annotations

import dataclasses

import meshes
import numpy as np
import pytest
from strategy_cases import MESHES, NAMES, context_of, fidelity, mesh_of, propose

import clothgym as cg
from clothgym.detection.contours import Enclosed
from clothgym.mesh import vertex_areas
from clothgym.response import untangling
from clothgym.response.untangling import Corrections
from clothgym.response.untangling.area import area_gradients
from clothgym.response.untangling.coherence import coherence
from clothgym.response.untangling.exact import Exact
from clothgym.response.untangling.hybrid import hybrid_targets
from clothgym.scenes.canonical import draw

# ---------------------------------------------------------------------------------------------------------------
# momentum


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("strategy", NAMES)
def test_momentum_is_kept_to_rounding(strategy, name):
    """Linear and angular, with masses from 0.2 to 5, and with vertices that cannot move where no hit is."""
    mesh = mesh_of(name)
    rng = np.random.default_rng(4)
    w = rng.uniform(0.2, 5.0, len(mesh[0]))
    hits = cg.intersections(*mesh)
    far = np.ones(len(w), np.bool_)
    near = np.unique(np.r_[hits.surface.edges[hits.hit_edge].ravel(), hits.surface.faces[hits.hit_face].ravel()])
    start, neighbours, _ = hits.surface.neighbourhood
    far[near] = False
    far[np.concatenate([neighbours[start[v] : start[v + 1]] for v in near])] = False
    masses = 1.0 / w
    context = context_of(mesh, inverse_masses=w, strategy=strategy)
    moved = propose(strategy, context)
    size = (masses[:, None] * np.abs(moved)).sum()
    nulls = {"gia": ("crossing", "fold"), "global": ("ribbon",), "annealed": ("ribbon",)}
    assert (size > 1e-5) == (name not in nulls.get(strategy, ()))
    assert np.abs(masses @ moved).max() <= 1e-13 * max(size, 1e-3)
    turned = (masses[:, None] * np.cross(hits.vertices, moved)).sum(axis=0)
    assert np.abs(turned).max() <= 1e-12 * max(size, 1e-3) * np.abs(hits.vertices).max()
    if strategy not in ("gia", "flatten"):  # whose corrections reach further than the hits
        w[far] = 0.0
        assert (propose(strategy, context_of(mesh, inverse_masses=w, strategy=strategy)) == moved).all()


@pytest.mark.parametrize("name", ["crossing", "dent", "fold", "crumple"])
@pytest.mark.parametrize("strategy", NAMES)
def test_a_fixed_vertex_is_one_of_infinite_mass(strategy, name):
    mesh = mesh_of(name)
    rng = np.random.default_rng(5)
    w = rng.uniform(0.5, 2.0, len(mesh[0]))
    fixed = rng.uniform(size=len(w)) < 0.3
    w[fixed] = 0.0
    moved = propose(strategy, context_of(mesh, inverse_masses=w, strategy=strategy))
    assert (moved[fixed] == 0.0).all()
    w[fixed] = 1e-13
    heavy = propose(strategy, context_of(mesh, inverse_masses=w, strategy=strategy))
    assert heavy == pytest.approx(moved, abs=1e-9)


@pytest.mark.parametrize("name", ["crossing", "dent", "crumple", "seam"])
@pytest.mark.parametrize("strategy", NAMES)
def test_momentum_is_kept_where_hits_are_missing(strategy, name):
    """Half of the hits ignored, as [Volino 2006, 3.1.2]: contours fall to pieces, and every piece keeps its momentum."""
    mesh = mesh_of(name)
    rng = np.random.default_rng(6)
    w = rng.uniform(0.2, 5.0, len(mesh[0]))
    whole = context_of(mesh, inverse_masses=w, strategy=strategy)
    hits = whole.intersections.keeping(rng.uniform(size=whole.intersections.hit_count) < 0.5)
    assert 3 < hits.hit_count < whole.intersections.hit_count
    context = dataclasses.replace(whole, intersections=hits)
    moved = propose(strategy, context)
    size = max((np.abs(moved) / w[:, None]).sum(), 1e-3)
    assert np.abs((1.0 / w) @ moved).max() <= 1e-13 * size
    turned = (np.cross(hits.vertices, moved) / w[:, None]).sum(axis=0)
    assert np.abs(turned).max() <= 1e-12 * size * np.abs(hits.vertices).max()


@pytest.mark.parametrize("name", [*meshes.DEGENERATE, *meshes.SPECIAL])
def test_corrections_are_finite_on_any_input(name):
    mesh = meshes.EVERY[name]()
    for strategy in NAMES:
        assert np.isfinite(propose(strategy, context_of(mesh, strategy=strategy))).all(), strategy


@pytest.mark.parametrize("strategy", NAMES)
def test_no_contour_moves_a_vertex_further_than_h0(strategy):
    for name in ("crossing", "dent", "ribbon", "fold"):
        moved = propose(strategy, context_of(mesh_of(name), h0=0.03, strategy=strategy))
        # flatten adds a fold's own correction to that of its contour
        assert np.linalg.norm(moved, axis=1).max() <= (2 if strategy == "flatten" else 1) * 0.03 * (1 + 1e-12)


@pytest.mark.parametrize("strategy", NAMES)
def test_corrections_follow_relabelling(strategy):
    mesh = mesh_of("dent")
    other, new_id, _ = meshes.relabelled(mesh, 3)
    moved = propose(strategy, context_of(mesh, strategy=strategy))
    again = propose(strategy, context_of(other, strategy=strategy))
    # pulls that share vertices are met in turns, so that their order shows; twice as many rounds bring them nearer
    assert again[new_id] == pytest.approx(moved, abs=1e-3 if strategy == "gia" else 1e-10)


# ---------------------------------------------------------------------------------------------------------------
# memory


@pytest.mark.parametrize("strategy", NAMES)
def test_only_stall_remembers_and_only_in_the_context(strategy):
    chosen = untangling.get(strategy)
    assert len(untangling.memory(chosen)) == (3 if strategy == "stall" else 0)
    one = context_of(mesh_of("crossing"), strategy=strategy)
    two = context_of(mesh_of("crumple"), strategy=strategy)
    first = chosen.propose(one).displacements.copy()
    for _ in range(9):
        chosen.propose(two)
    one.memory[:] = 0.0
    assert (chosen.propose(one).displacements == first).all()
    assert not getattr(chosen, "__dict__", {}).keys() - {"steepest"}


def test_stall_hands_over_when_the_length_no_longer_falls():
    context = context_of(mesh_of("crossing"), strategy="stall")
    steps = [propose("stall", context) for _ in range(13)]
    schemes = {name: propose(name, context_of(mesh_of("crossing"))) for name in ("local", "global", "hybrid")}
    turns = [next(n for n, moved in schemes.items() if (moved == step).all()) for step in steps]
    assert turns == ["local"] * 6 + ["global"] * 7  # hybrid is global where nothing is cut off
    assert context.memory[2] == 2.0
    tip = context_of(mesh_of("ribbon"), strategy="stall")
    tip.memory[:] = tip.intersections.length, 5.0, 1.0
    assert (propose("stall", tip) == propose("hybrid", context_of(mesh_of("ribbon")))).all()
    tip.memory[:] = 0.3 * tip.intersections.length, 5.0, 2.0
    assert (propose("stall", tip) == propose("local", context_of(mesh_of("ribbon")))).all(), "a new tangle"


def test_what_stall_remembers_is_part_of_the_state():
    scene = draw("BBII", 3.0, 12, 1).scene
    sim = cg.Simulation(scene, fidelity(untangling="stall"))
    assert sim.snapshot().memory.tolist() == [0.0, 0.0, 0.0]
    sim.step(4)
    kept, digest = sim.snapshot(), sim.state_hash()
    assert kept.memory[0] > 0.0
    sim.step(8)
    end = sim.state_hash()
    assert sim.snapshot().memory[2] > 0.0
    sim.restore(kept)
    assert sim.state_hash() == digest
    sim.step(8)
    assert sim.state_hash() == end
    sim.reset()
    assert sim.snapshot().memory.tolist() == [0.0, 0.0, 0.0]
    sim.step(12)
    assert sim.state_hash() == end
    other = kept.copy()
    other.memory[0] += 1.0
    assert other.hash() != kept.hash()
    plain = cg.Simulation(scene, fidelity(untangling="hybrid"))
    assert len(plain.snapshot().memory) == 0
    with pytest.raises(ValueError, match="memory: has 3 numbers, this strategy remembers 0"):
        plain.restore(kept)
    sim.restore(plain.snapshot())
    assert sim.snapshot().memory.tolist() == [0.0, 0.0, 0.0]


def test_a_resolved_tangle_is_forgotten():
    tangle = draw("Closed", 1.0, 12, 0)
    sim = cg.Simulation(tangle.scene, fidelity(untangling="stall"))
    sim.step()
    assert sim.snapshot().memory[0] > 0.0
    sim.step(12)
    assert sim.last_intersections.hit_count == 0
    assert sim.snapshot().memory.tolist() == [0.0, 0.0, 0.0]


def test_a_memory_that_is_no_count_is_named():
    class Odd:
        memory_size = 1.5

        def propose(self, context):
            return Corrections(np.zeros_like(context.intersections.vertices))

    with pytest.raises(ValueError, match=r"memory_size = 1\.5"):
        cg.untangle(*mesh_of("crossing"), strategy=Odd())


# ---------------------------------------------------------------------------------------------------------------
# directions


@pytest.mark.parametrize("name", MESHES)
def test_exact_follows_the_gradient_where_kappa_may_be_steep(name):
    """Without a limit on kappa, a step of one contour is along -M^-1 g, loop terms included."""
    mesh = mesh_of(name)
    w = np.random.default_rng(1).uniform(0.5, 2.0, len(mesh[0]))
    context = context_of(mesh, h0=1e-4, inverse_masses=w)
    hits = context.intersections
    moved = Exact(steepest=np.inf).propose(context).displacements
    along = -w[:, None] * hits.gradient()
    if hits.contour_count == 1:
        scale = (moved * along).sum() / (along * along).sum()
        assert scale > 0
        assert moved == pytest.approx(scale * along, abs=1e-9 * np.abs(moved).max())
    assert (hits.gradient() * moved).sum() < 0
    assert np.linalg.norm(moved, axis=1).max() <= 1e-4 * hits.contour_count * (1 + 1e-12)


def test_exact_does_not_go_beyond_what_would_bring_the_length_to_zero():
    hits = context_of(mesh_of("dent"), h0=100.0).intersections
    moved = Exact(steepest=np.inf).propose(context_of(mesh_of("dent"), h0=100.0)).displacements
    assert (hits.gradient() * moved).sum() == pytest.approx(-hits.length, rel=1e-9)


def test_one_steep_hit_does_not_starve_the_others():
    context = context_of(meshes.grazing_sheets(1e-3), h0=0.1)
    typical = [
        np.median(sizes[sizes > 0])
        for steepest in (np.inf, 1.0)
        for sizes in [np.linalg.norm(Exact(steepest).propose(context).displacements, axis=1)]
    ]
    assert typical[1] > 3 * typical[0]


def area_slopes(mesh) -> np.ndarray:
    """(3,) loss of area when the part with the first vertex moves against the other."""
    hits = cg.intersections(*mesh)
    slopes, has = area_gradients(Enclosed(hits, vertex_areas(*mesh)))
    assert has.tolist() == [True]
    first = hits.surface.edges[hits.hit_edge, 0] < np.flatnonzero(hits.surface.components == 0).max() + 1
    (side,) = set(hits.hit_side[first])
    return side * slopes[0]


def test_area_gradient_of_known_shapes():
    """A ribbon of width b that leans by psi loses b / cos psi on its way out; the mantle of a pyramid 4 d s at depth d, with
    s = sqrt(1.25) the slope of its flanks; cap and disc of a sphere 2 pi R and 2 pi (R - d)."""
    for lean in (0.0, 0.4):
        up = area_slopes(meshes.strip_through_plane(0.2, lean))[1]
        assert abs(up) == pytest.approx(0.2 / np.cos(lean), rel=1e-9)
    for depth in (0.05, 0.2):
        slopes = area_slopes(meshes.pyramid_poke(depth))
        assert np.abs(slopes[[0, 2]]).max() < 1e-9
        assert slopes[1] == pytest.approx(4.0 * depth * np.sqrt(1.25), rel=1e-9)
    vertices, faces = meshes.poked_sphere(3, 0.3)
    ball = vertices[np.unique(faces[vertex_areas(vertices, faces)[faces].min(axis=1) < 0.02])]
    radius = 0.5 * np.ptp(ball[:, 0])
    expected = 2.0 * np.pi * (radius + radius - 0.3)
    assert area_slopes((vertices, faces))[1] == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("name", [*MESHES, "several"])
def test_area_gradients_and_pushes_equal_their_sums_hit_by_hit(name):
    context = context_of(meshes.many_sheets(8, 6, 3) if name == "several" else mesh_of(name))
    hits, found = context.intersections, context.enclosed
    x, faces = hits.vertices, hits.surface.faces

    def normal(face) -> np.ndarray:
        a, b, c = x[faces[face]]
        n = np.cross(b - a, c - a)
        return n / np.linalg.norm(n)

    inside = {
        (c, s): {v for r in found.of_contour[c] if found.side[r] in (0, s) for v in found.vertices(r).tolist()}
        for c in range(hits.contour_count)
        for s in (1, -1)
    }
    slopes = np.zeros((hits.contour_count, 3))
    for s in range(len(hits.contour)):
        h, c = hits.first_hit[s], hits.contour[s]
        a, side = hits.hit_face[h], int(hits.hit_side[h])
        b = hits.pair_faces[s].sum() - a
        weight = hits.segment_lengths[s] / max(np.linalg.norm(np.cross(normal(a), normal(b))), 0.1)
        for face, other, own in ((b, normal(a), side), (a, normal(b), -side)):
            within = np.array([v in inside[c, own] for v in faces[face].tolist()])
            if within.any() and not within.all():
                way = x[faces[face][~within]].mean(axis=0) - x[faces[face][within]].mean(axis=0)
                slopes[c] += weight * own * np.sign(other @ way) * other
    computed, has = area_gradients(found)
    assert has.tolist() == [len(regions) > 0 for regions in found.of_contour]
    assert computed[has] == pytest.approx(slopes[has], rel=1e-9, abs=1e-12)
    assert not computed[~has].any()

    expected = untangling.base.global_targets(context)
    for c in range(hits.contour_count):
        members = np.flatnonzero(hits.hit_contour == c)
        ways = {}
        for h in members[found.inside_end[members] >= 0]:
            out = np.diff(x[hits.surface.edges[hits.hit_edge[h]]], axis=0)[0] * (1 - 2 * found.inside_end[h])
            ways[h] = normal(hits.hit_face[h]) * np.sign(out @ normal(hits.hit_face[h]))
        if ways:
            mean = sum(hits.hit_side[h] * way for h, way in ways.items())
            for h in members:
                expected[h] = context.h0 * ways.get(h, hits.hit_side[h] * mean / np.linalg.norm(mean))
    assert hybrid_targets(context, found) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_what_cuts_nothing_off_has_no_slope_of_area():
    hits = cg.intersections(*mesh_of("crossing"))
    slopes, has = area_gradients(Enclosed(hits, np.ones(len(hits.vertices))))
    assert not has.any() and not slopes.any()


@pytest.mark.parametrize("strategy", ["hybrid", "area", "gia", "flatten"])
@pytest.mark.parametrize("name", ["ribbon", "dent"])
def test_schemes_that_know_regions_resolve_what_length_cannot(strategy, name):
    mesh = mesh_of(name)
    result = cg.untangle(*mesh, strategy=strategy, passes=40)
    assert result.resolved
    assert cg.intersections(result.vertices, mesh[1]).hit_count == 0


def test_gia_leaves_alone_what_it_cannot_decide():
    result = untangling.get("gia").propose(context_of(mesh_of("crossing")))
    assert not result.displacements.any()
    assert not result.apart.any()
    inside = untangling.get("gia").propose(context_of(mesh_of("dent")))
    assert inside.apart.any() and np.abs(inside.displacements).max() > 1e-3


def test_gia_pulls_the_inside_towards_the_other_surface():
    context = context_of(mesh_of("ribbon"))
    hits = context.intersections
    moved = propose("gia", context)
    (region,) = hits.contours[0].regions
    before = Enclosed(hits, context.areas).nearest(0)[3]
    nearer = Enclosed(cg.intersections(hits.vertices + 0.2 * moved, hits.surface), context.areas)
    assert nearer.nearest(0)[3].max() < before.max()
    assert region.depth == pytest.approx(before.max())


def test_coherent_contours_move_as_one_and_others_hit_by_hit():
    ribbon, crossing = context_of(mesh_of("ribbon")), context_of(mesh_of("crossing"))
    for context, name in ((ribbon, "local"), (crossing, "global")):
        value = coherence(context, untangling.base.contour_gradients(context))
        assert (value[0] < 0.5) == (name == "local")
        assert (propose("coherence", context) == propose(name, context)).all()
    assert coherence(ribbon, untangling.base.contour_gradients(ribbon))[0] <= 1e-12


def test_annealed_strides_shrink_with_the_contour():
    long, short = (context_of(meshes.crossed_squares(offset), h0=0.02) for offset in (0.3, 0.97))
    assert short.intersections.length < 0.05 < 8 * 0.02 < long.intersections.length
    assert (propose("annealed", long) == propose("global", long)).all()
    shorter, full = (np.abs(propose(name, short)).max() for name in ("annealed", "global"))
    assert shorter == pytest.approx(0.2 * np.abs(untangling.base.global_targets(short)).max() / 0.02 * full, rel=0.5)
    assert 0.1 * full < shorter < 0.4 * full


def test_flatten_smooths_folds_and_nothing_else():
    for name in ("crossing", "dent", "ribbon"):
        assert (propose("flatten", context_of(mesh_of(name))) == propose("hybrid", context_of(mesh_of(name)))).all()
    context = context_of(mesh_of("fold"))
    hits = context.intersections
    extra = propose("flatten", context) - propose("hybrid", context)
    (loop,) = hits.loop_vertex[hits.loop_vertex >= 0]
    start, neighbours, _ = hits.surface.neighbourhood
    ring = neighbours[start[loop] : start[loop + 1]]
    gap = np.linalg.norm(hits.vertices[ring].mean(axis=0) - hits.vertices[loop])
    moved = hits.vertices + extra
    assert np.linalg.norm(moved[ring].mean(axis=0) - moved[loop]) < gap


def test_the_null_of_length_is_none_of_area():
    context = context_of(mesh_of("ribbon"))
    totals = untangling.base.contour_gradients(context)
    frames = context.intersections.frames
    sizes = np.linalg.norm(frames[:, :3] - 2.0 * frames[:, 6:7] * frames[:, 3:6], axis=1).sum()
    assert np.linalg.norm(totals) <= 1e-12 * sizes
    slopes, _ = area_gradients(Enclosed(context.intersections, context.areas))
    assert np.linalg.norm(slopes) >= 0.9 * context.intersections.length


def test_what_lies_beyond_a_loop_vertex_is_not_inside():
    """The flood does not pass through the vertex at which both sides of a contour meet."""
    tangle = draw("LL", 2.0, 16, 3)
    hits = cg.intersections(tangle.scene.start, tangle.scene.cloths[0].mesh.faces)
    (contour,) = hits.contours
    (region,) = contour.regions
    assert contour.kind == "LL"
    assert region.side == 0 and region.share < 0.4
    assert not set(region.vertices.tolist()) & set(hits.loop_vertex.tolist())
