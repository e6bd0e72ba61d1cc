"""Every strategy: momentum, memory, direction; and the ways in which a simulation takes their corrections."""

from __future__ import annotations

import dataclasses
from functools import cache

import meshes
import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym.commands.untangle import untangle as untangle_command
from clothgym.detection.contours import Enclosed
from clothgym.mesh import vertex_areas
from clothgym.response import untangling
from clothgym.response.untangling import Context, Corrections
from clothgym.response.untangling.area import area_gradients
from clothgym.response.untangling.coherence import coherence
from clothgym.response.untangling.exact import Exact
from clothgym.response.untangling.hybrid import hybrid_targets
from clothgym.scenes.canonical import draw

NAMES = tuple(untangling.STRATEGIES)
MESHES = {
    "crossing": lambda: meshes.crossing_sheets(6, 2),
    "dent": lambda: meshes.poked_sphere(2, 0.08),
    "ribbon": lambda: meshes.strip_through_plane(0.2, 0.3),
    "fold": lambda: meshes.overfolded_sheet(5, 0),
    "crumple": lambda: meshes.crumple(8, 0),
    "sheets": lambda: meshes.many_sheets(5, 3, 2),
    "seam": lambda: meshes.seam_of_three(4, 0),
}


@cache
def mesh_of(name: str) -> meshes.Mesh:
    return MESHES[name]()


def context_of(mesh, h0: float = 0.05, inverse_masses=None, strategy: str = "local", g0: float = 1.0) -> Context:
    hits = cg.intersections(*mesh)
    weights = np.ones(len(mesh[0])) if inverse_masses is None else inverse_masses
    areas = vertex_areas(hits.vertices, hits.surface.faces)
    return Context(hits, weights, areas, h0, g0, untangling.memory(untangling.get(strategy)))


def propose(strategy: str, context: Context) -> np.ndarray:
    return untangling.get(strategy).propose(context).displacements


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


def fidelity(**settings) -> cg.Fidelity:
    return cg.Fidelity(**({"substeps": 4, "sweeps": 4, "untangling_passes": 1} | settings))


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


# ---------------------------------------------------------------------------------------------------------------
# channels


@pytest.fixture(scope="module")
def start():
    return draw("Closed", 2.0, 12, 3).scene


def after_one_step(scene, **settings) -> cg.Simulation:
    sim = cg.Simulation(scene, fidelity(untangling="hybrid", **settings))
    sim.step()
    return sim


def test_an_acceleration_brings_a_correction_about_by_the_end_of_the_step(start):
    """Free vertices, no springs in the way: x += share a T^2 / 2."""
    model_free = dataclasses.replace(start.cloths[0].material, stretch=1e-6, shear=1e-6, flexion=1e-6, damping=0.0)
    cloths = [dataclasses.replace(c, material=dataclasses.replace(model_free, thickness=1e-5)) for c in start.cloths]
    loose = dataclasses.replace(start, cloths=cloths)
    none = {"displacement_share": 0.0, "velocity_share": 0.0}
    still = after_one_step(loose, **none)
    assert np.abs(still.positions - loose.start).max() < 1e-6
    half, full = (
        after_one_step(loose, acceleration_share=share, **none).positions - loose.start for share in (0.5, 1.0)
    )
    at_once = after_one_step(loose, velocity_share=0.0, easing=0).positions - loose.start
    largest = np.abs(at_once).max()
    assert largest > 1e-3
    # substeps move by the speed at their ends: n + 1 instead of n of 2 n parts
    assert full == pytest.approx(at_once * (4 + 1) / 4, abs=0.02 * largest)
    assert half == pytest.approx(0.5 * full, abs=0.02 * largest)
    sim = cg.Simulation(loose, fidelity(untangling="hybrid", penalty_stiffness=3.0, **none))
    sim.step()
    pushed = 0.5 * (sim.positions - loose.start) + 0.0
    mass = sim.model.masses.mean()
    assert 2 * pushed == pytest.approx(at_once * (4 + 1) / 8 * 3.0 / mass * loose.step**2, abs=0.02 * largest)


@pytest.mark.parametrize("settings", [
    {"displacement_share": 0.0, "velocity_share": 1.0},
    {"displacement_share": 0.5, "velocity_share": 0.0, "acceleration_share": 0.5},
    {"displacement_share": 0.0, "velocity_share": 0.0, "penalty_stiffness": 20.0},
])  # fmt: skip
def test_every_channel_resolves_a_dent_and_keeps_momentum(start, settings):
    # the speed limit takes momentum where it acts
    sim = cg.Simulation(start, fidelity(untangling="hybrid", speed_limit=100.0, **settings))
    masses = sim.model.masses
    sim.step(12)
    assert sim.last_intersections.hit_count == 0
    impulse = (masses[:, None] * sim.velocities).sum(axis=0)
    assert np.abs(impulse).max() <= 1e-9 * (masses[:, None] * np.abs(sim.velocities)).sum() + 1e-12


def test_accelerations_end_with_the_tangle(start):
    sim = cg.Simulation(start, fidelity(untangling="hybrid", displacement_share=0.0, acceleration_share=1.0))
    sim.step()
    assert np.abs(sim._frame.external).max() > 0
    sim.step(12)
    assert not sim._frame.external.any()
    assert [s.name for s in sim.pipeline.stages if "external" in s.writes] == [
        "intersections [untangle hybrid x1, contact off_any]"
    ]
    windy = cg.Simulation(dataclasses.replace(start, wind=(0.3, 0.0, 0.0)), sim.fidelity)
    windy.step()
    both = windy._frame.external.copy()
    calm = cg.Simulation(start, sim.fidelity)
    calm.step()
    blown = cg.Simulation(windy.scene, dataclasses.replace(sim.fidelity, untangling="none"))
    blown.step()
    assert both == pytest.approx(calm._frame.external + blown._frame.external, abs=1e-9)


def test_without_displacement_there_is_one_pass_a_step(start):
    sim = cg.Simulation(start, fidelity(untangling_passes=4, displacement_share=0.0))
    sim.step()
    assert sim.metrics()["untangling_passes"] == 1
    assert "x1," in sim.pipeline.describe()


# ---------------------------------------------------------------------------------------------------------------
# contact beside hits, bodies, names


def test_limited_contact_keeps_the_distance_that_there_is():
    """Two sheets at less than their thickness, beside an intersection: full contact parts them, limited contact does not, and
    neither lets them come nearer."""
    thin = dataclasses.replace(draw("BIBI", 1.0, 12, 2).scene.cloths[0].material, thickness=0.01, flexion=0.0)
    flat = cg.grid(0.3, 0.3, 6, 6)
    pin = cg.grid(0.03, 0.3, 1, 6)
    through = pin.vertices[:, [0, 2, 1]] * [1.0, 0.3, 1.0] + np.array([0.011, 0.0, 0.013])
    above = flat.vertices + np.array([0.003, 0.004, 0.002])
    cloths = [
        cg.Cloth(flat, thin, name="below", pins=range(len(flat.vertices))),
        cg.Cloth((above, flat.faces), thin, name="above"),
        cg.Cloth((through, pin.faces), thin, name="through", pins=range(len(pin.vertices))),
    ]
    scene = cg.Scene(cloths, gravity=(0.0, -1.0, 0.0), step=0.01)
    count = len(flat.vertices)
    lift = {}
    for near in ("limited", "keep", "off_any"):
        sim = cg.Simulation(scene, fidelity(untangling="none", contacts_near_hits=near, rings=10))
        sim.step(6)
        lift[near] = float(np.median(sim.positions[count : 2 * count, 1])) - 0.004
    assert lift["keep"] > 0.003
    assert abs(lift["limited"]) < 0.0005
    assert lift["off_any"] < -0.001


def body_scene() -> cg.Scene:
    """A sheet that a thin upright plate, a body without a volume to speak of, goes through."""
    sheet = cg.grid(0.3, 0.3, 10, 10)
    rng = np.random.default_rng(3)
    sheet.vertices[:] += rng.uniform(-3e-4, 3e-4, sheet.vertices.shape)
    plate = trimesh.creation.box((0.004, 0.1, 0.12))
    plate.vertices += [0.0131, -0.04, 0.0071]
    return cg.Scene(
        [cg.Cloth(sheet)], bodies=[cg.Body(plate.subdivide().subdivide())], gravity=(0.0, 0.0, 0.0), step=0.01
    )


def test_cloth_is_untangled_from_a_body_and_the_body_stays():
    scene = body_scene()
    settings = {"untangling": "hybrid", "body_tolerance": 1e-4, "body_faces": 0, "map_size": 32}
    sim = cg.Simulation(scene, fidelity(untangle_bodies=True, **settings))
    plain = cg.Simulation(scene, fidelity(**settings))
    assert "bodies]" in sim.pipeline.describe()
    stage = sim.pipeline.stages[1]
    hits = stage._look(sim._frame)
    assert hits.hit_count > 10
    components = {c.components for c in hits.contours}
    assert all(len(joined) == 2 for joined in components), "the body's own faces are left out"
    for other in (sim, plain):
        for _ in range(40):
            other.step()
    assert stage._look(sim._frame).hit_count == 0
    assert stage._look(plain._frame).hit_count > 0
    assert plain.metrics()["untangling_passes"] == 0 < sim.metrics()["untangling_passes"]


def test_a_wrong_name_is_told_in_one_line():
    with pytest.raises(ValueError) as error:
        cg.untangle(*mesh_of("dent"), strategy="locale")
    text = str(error.value)
    assert "\n" not in text and all(name in text for name in (*NAMES, "none", "package.module:Name"))
    with pytest.raises(ValueError, match=r"strategy = 'locale': expected one of none, local"):
        cg.Simulation(cg.scenes.make("pile", count=2), cg.Fidelity(untangling="locale"))
    told = untangle_command.__annotations__["strategy"]
    import clothgym.commands.untangle as module

    assert "_STRATEGIES" in told
    assert all(name in module._STRATEGIES.replace(".", ",").split(", ") or name in module._STRATEGIES for name in NAMES)
