"""Untangling: corrections that keep momentum, the schemes on scenes with known answers, and `clothgym.untangle`."""

from __future__ import annotations

import sys
import types

import meshes
import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym.kernels import untangling as kernels
from clothgym.mesh import vertex_areas
from clothgym.response import untangling
from clothgym.response.untangling import Context, Corrections

BIBI = {"X": lambda: meshes.crossed_squares(0.3), "crossing": lambda: meshes.crossing_sheets(6, 2)}
CLOSED = {"pyramid": lambda: meshes.pyramid_poke(0.15), "sphere": lambda: meshes.poked_sphere(2, 0.08)}
RIBBON = {
    "straight": lambda: meshes.strip_through_plane(0.2, 0.0),
    "leaning": lambda: meshes.strip_through_plane(0.2, 0.3),
}


def context_of(mesh, h0: float = 0.05, g0: float = 1.0, inverse_masses=None) -> Context:
    hits = cg.intersections(*mesh)
    weights = np.ones(len(mesh[0])) if inverse_masses is None else inverse_masses
    return Context(hits, weights, vertex_areas(hits.vertices, hits.surface.faces), h0, g0)


def gradients(hits) -> np.ndarray:
    """(H, 3) G = S - 2 kappa N of every hit, from the frames."""
    return hits.frames[:, :3] - 2.0 * hits.frames[:, 6:7] * hits.frames[:, 3:6]


# ---------------------------------------------------------------------------------------------------------------
# displacement of hits


@pytest.mark.parametrize("kinematic", [0.0, 0.3])
@pytest.mark.parametrize("name", ["crossing", "crumple", "sheets"])
def test_corrections_keep_linear_and_angular_momentum(name, kinematic):
    rng = np.random.default_rng(4)
    makers = {
        "crossing": (meshes.crossing_sheets, 5, 1),
        "crumple": (meshes.crumple, 8, 0),
        "sheets": (meshes.many_sheets, 5, 3, 2),
    }
    make, *settings = makers[name]
    mesh = make(*settings)
    w = rng.uniform(0.2, 5.0, len(mesh[0]))
    w[rng.uniform(size=len(w)) < kinematic] = 0.0
    context = context_of(mesh, inverse_masses=w)
    hits = context.intersections
    assert hits.hit_count > 10
    targets = rng.normal(size=(hits.hit_count, 3))
    moved = untangling.displacements(context, targets)
    assert (moved[w == 0] == 0.0).all()
    assert np.abs(moved).max() > 1e-4
    if kinematic:
        return
    masses = 1.0 / w
    assert masses @ moved == pytest.approx(0.0, abs=1e-12)
    assert (masses[:, None] * np.cross(hits.vertices, moved)).sum(axis=0) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("fixed", [(), (0,), (2, 3, 4), (0, 1)])
def test_one_hit_gets_its_relative_displacement(fixed):
    """sum c_i dx_i = H, and no vertex moves more than h0."""
    vertices = np.array([[0.3, 0.4, 0.3], [0.2, -0.5, 0.35], [0, 0, 0], [1, 0, 0], [0, 0, 1.0]])
    edge_face = np.array([[0, 1, 5], [2, 3, 4]])
    mesh = (np.r_[vertices, [[0.2, 0.5, -3.0]]], edge_face)
    w = np.array([0.5, 2.0, 1.0, 3.0, 0.2, 1.0])
    w[list(fixed)] = 0.0
    context = context_of(mesh, h0=10.0, inverse_masses=w)
    hits = context.intersections
    rows = hits.edge_triangle.tolist()
    assert [0, 1, 1] in rows
    one = hits.keeping(np.array([row == [0, 1, 1] for row in rows]))
    context = Context(one, w, context.areas, 10.0, 1.0)
    wanted = np.array([[0.3, -0.2, 0.1]])
    moved = untangling.displacements(context, wanted)
    t = one.parameters[0]
    shares = np.r_[1 - t, t, -one.weights[0]]
    assert shares @ moved[:5] == pytest.approx(wanted[0], abs=1e-12)
    assert (moved[5] == 0).all()
    capped = untangling.displacements(Context(one, w, context.areas, 0.01, 1.0), wanted)
    assert np.linalg.norm(capped, axis=1).max() == pytest.approx(0.01)
    assert capped == pytest.approx(moved * (0.01 / np.linalg.norm(moved, axis=1).max()))


def test_each_contour_is_capped_on_its_own():
    one, two = meshes.crossed_squares(0.3), meshes.moved(meshes.crossed_squares(0.4), None, (5.0, 0, 0))
    context = context_of(meshes.merged(one, two), h0=0.01)
    hits = context.intersections
    assert hits.contour_count == 2
    targets = np.where((hits.hit_contour == 0)[:, None], [0.0, 1.0, 0.0], [0.0, 1e-6, 0.0])
    moved = np.linalg.norm(untangling.displacements(context, targets), axis=1)
    assert moved[: len(one[0])].max() == pytest.approx(0.01)
    assert 0 < moved[len(one[0]) :].max() < 1e-5


@pytest.mark.parametrize("scheme", ["local", "global"])
def test_magnitude_follows_equation_5(scheme):
    """|H| = h0 |G| / sqrt(|G|^2 + g0^2), along G."""
    for g0 in (1e-3, 1.0, 50.0):
        context = context_of(meshes.crossing_sheets(5, 1), h0=0.07, g0=g0)
        hits = context.intersections
        g = gradients(hits)
        if scheme == "local":
            targets = untangling.base.local_targets(context)
        else:
            targets = untangling.base.global_targets(context)
            sums = np.zeros((hits.contour_count, 3))
            np.add.at(sums, hits.hit_contour, hits.hit_side[:, None] * g)
            g = hits.hit_side[:, None] * sums[hits.hit_contour]
        expected = 0.07 * g / np.sqrt((g * g).sum(axis=1) + g0 * g0)[:, None]
        assert targets == pytest.approx(expected, abs=1e-14)
        assert np.abs(targets).max() > 1e-4


def test_local_and_global_first_steps_shorten_the_contour():
    """dL = sum g . dx < 0 with the exact gradient, for a small step."""
    for mesh in (*BIBI.values(), *CLOSED.values()):
        for name in ("local", "global", "hybrid"):
            context = context_of(mesh(), h0=1e-4)
            moved = untangling.get(name).propose(context).displacements
            assert (context.intersections.gradient() * moved).sum() < 0, name


def test_rows_of_contours_join_in_any_order():
    """A global step does not depend on the order in which hits are stored."""
    context = context_of(meshes.many_sheets(5, 3, 2))
    moved = untangling.get("global").propose(context).displacements
    relabelled, new_id, _ = meshes.relabelled(meshes.many_sheets(5, 3, 2), 3)
    again = untangling.get("global").propose(context_of(relabelled)).displacements
    assert again[new_id] == pytest.approx(moved, abs=1e-10)


# ---------------------------------------------------------------------------------------------------------------
# schemes


@pytest.mark.parametrize("strategy", ["global", "hybrid"])
@pytest.mark.parametrize("name", [*CLOSED, *BIBI])
def test_closed_and_bibi_contours_vanish_within_ten_passes(name, strategy):
    mesh = (CLOSED | BIBI)[name]()
    kinds = {c.kind for c in cg.intersections(*mesh).contours}
    assert kinds == ({"Closed"} if name in CLOSED else {"BIBI"})
    result = cg.untangle(*mesh, strategy=strategy, passes=10)
    assert result.resolved
    assert result.stop_reason == "resolved"
    assert cg.intersections(result.vertices, mesh[1]).hit_count == 0


def test_global_needs_fewer_passes_than_local_on_a_long_contour():
    mesh = BIBI["X"]()
    passes = {name: cg.untangle(*mesh, strategy=name).passes for name in ("local", "global")}
    assert passes["global"] < 0.6 * passes["local"]


def test_inner_hits_of_flat_sheets_do_nothing_locally():
    hits = cg.intersections(*BIBI["X"]())
    sizes = np.linalg.norm(gradients(hits), axis=1)
    assert hits.hit_count > 10
    assert (sizes > 1e-9).sum() == 2, "only the two ends of the contour act"
    assert sizes.sum() == pytest.approx(2.0)


@pytest.mark.parametrize("name", RIBBON)
def test_a_ribbon_right_through_a_sheet_is_a_null_case(name):
    """BBII: the summed gradient vanishes, so the global scheme has no direction; the hybrid scheme knows the inside."""
    mesh = RIBBON[name]()
    hits = cg.intersections(*mesh)
    assert [c.kind for c in hits.contours] == ["BBII"]
    totals = np.zeros((1, 3))
    kernels.contour_gradients(hits.frames, hits.hit_contour, hits.hit_side, totals)
    sizes = np.linalg.norm(gradients(hits), axis=1).sum()
    assert sizes > 1.0
    assert np.linalg.norm(totals) <= 1e-12 * sizes
    plain = cg.untangle(*mesh, strategy="global", passes=10)
    assert not plain.resolved
    assert np.abs(plain.vertices - mesh[0]).max() < 1e-6
    hybrid = cg.untangle(*mesh, strategy="hybrid", passes=30)
    assert hybrid.resolved
    assert cg.intersections(hybrid.vertices, mesh[1]).hit_count == 0


def swapping_bands(columns: int = 12):
    """An X carried around a circle and turned by a quarter on the way: one band, whose two sheets change places along the
    contour, so that its sides cannot be told apart."""
    rows = np.array([-1.0, -0.37, 0.29, 1.0])
    vertices, faces = [], []
    for n in range(2 * columns):
        round_, turn = 2 * np.pi * n / columns, 0.5 * np.pi * n / columns
        out = np.array([np.cos(round_), 0.0, np.sin(round_)])
        vertices += [out + 0.3 * s * (np.cos(turn) * out + np.sin(turn) * np.array([0, 1.0, 0])) for s in rows]
    for n in range(2 * columns):
        this = [4 * n + k for k in range(4)]
        following = [4 * (n + 1) + k for k in range(4)] if n + 1 < 2 * columns else [3 - k for k in range(4)]
        for k in range(3):
            faces += [[this[k], this[k + 1], following[k]], [following[k], this[k + 1], following[k + 1]]]
    return meshes.jittered((np.array(vertices), np.array(faces)), 0.01, 3)


@pytest.mark.parametrize("strategy", ["global", "hybrid"])
def test_sides_that_cannot_be_told_apart_go_the_local_way(strategy):
    context = context_of(swapping_bands())
    hits = context.intersections
    assert hits.hit_count > 20
    assert not hits.contour_consistent.all()
    assert not all(c.consistent for c in hits.contours)
    broken = ~hits.contour_consistent[hits.hit_contour]
    wanted = untangling.base.local_targets(context)
    assert untangling.base.global_targets(context)[broken] == pytest.approx(wanted[broken])
    if broken.all():
        local = untangling.get("local").propose(context).displacements
        assert untangling.get(strategy).propose(context).displacements == pytest.approx(local)


@pytest.mark.parametrize("strategy", ["local", "global", "hybrid"])
def test_strategies_are_memoryless(strategy):
    chosen = untangling.get(strategy)
    one, two = context_of(meshes.crossing_sheets(5, 1)), context_of(meshes.crumple(8, 0))
    first = chosen.propose(one).displacements.copy()
    chosen.propose(two)
    again = chosen.propose(one).displacements
    other = untangling.get(strategy).propose(context_of(meshes.crossing_sheets(5, 1))).displacements
    assert (first == again).all() and (first == other).all()
    assert np.abs(first).max() > 0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", [*BIBI, "pyramid"])
def test_half_of_the_hits_ignored_still_resolves(name, seed):
    """[Volino 2006, 3.1.2]: a detector that misses every second hit costs passes, not the result."""

    class Forgetful:
        rng = np.random.default_rng(seed)
        ignored = 0

        def propose(self, context):
            kept = self.rng.uniform(size=context.intersections.hit_count) < 0.5
            self.ignored += int((~kept).sum())
            if not kept.any():
                return Corrections(np.zeros_like(context.intersections.vertices))
            seen = context.intersections.keeping(kept)
            return untangling.get("global").propose(
                Context(seen, context.inverse_masses, context.areas, context.h0, context.g0)
            )

    strategy = Forgetful()
    result = cg.untangle(*(BIBI | CLOSED)[name](), strategy=strategy, passes=60)
    assert result.resolved
    assert strategy.ignored > 2


def test_hybrid_marks_what_is_inside():
    vertices, faces = CLOSED["sphere"]()
    corrections = untangling.get("hybrid").propose(context_of((vertices, faces)))
    ball = len(vertices) - 64  # the sheet's 8 x 8 vertices come last
    inside = np.flatnonzero(corrections.apart)
    assert set(inside[inside < ball]) == set(np.flatnonzero(vertices[:ball, 1] < 0))


def test_ring_marking_counts_edges():
    mesh = cg.grid(1.0, 1.0, 8, 8)
    surface = cg.Surface(mesh.faces)
    start, neighbours, _ = surface.neighbourhood
    reached = {40}
    for rings in range(4):
        marked = np.zeros(81, np.bool_)
        kernels.mark_ring(start, neighbours, np.array([40, 40]), rings, marked, np.zeros(81, np.int64))
        assert set(np.flatnonzero(marked).tolist()) == reached
        reached = reached | {int(n) for v in reached for n in neighbours[start[v] : start[v + 1]]}


# ---------------------------------------------------------------------------------------------------------------
# clothgym.untangle


def test_fixed_vertices_stay_bit_equal():
    vertices, faces = BIBI["X"]()
    fixed = np.zeros(len(vertices), np.bool_)
    fixed[:36] = True  # the whole first square, and the far row of the second
    fixed[36:][vertices[36:, 0] > vertices[36:, 0].max() - 1e-6] = True
    assert 36 < fixed.sum() < 50
    result = cg.untangle(vertices, faces, fixed=fixed, passes=12)
    assert result.hits < result.hit_history[0]
    assert result.vertices[fixed].tobytes() == np.ascontiguousarray(vertices[fixed]).tobytes()
    assert not np.array_equal(result.vertices[~fixed], vertices[~fixed])


def test_histories_and_budget():
    vertices, faces = BIBI["X"]()
    given = vertices.copy()
    full = cg.untangle(vertices, faces, strategy="global")
    assert (vertices == given).all(), "the input was changed"
    assert full.passes == len(full.length_history) - 1 == len(full.hit_history) - 1 > 2
    assert full.length_history[0] == pytest.approx(cg.intersections(vertices, faces).length)
    assert full.hit_history[0] == cg.intersections(vertices, faces).hit_count
    assert (full.hits, full.length, full.length_history[-1], full.hit_history[-1]) == (0, 0.0, 0.0, 0)
    short = cg.untangle(vertices, faces, strategy="global", passes=2)
    assert (short.passes, short.stop_reason, short.resolved) == (2, "budget", False)
    assert short.length_history == full.length_history[:3]
    none = cg.untangle(vertices, faces, passes=0)
    assert (none.passes, none.stop_reason) == (0, "budget")
    assert (none.vertices == vertices).all()


def test_a_clean_mesh_is_returned_as_it_is():
    mesh = meshes.grid(3, 3)
    result = cg.untangle(*mesh)
    assert (result.stop_reason, result.passes, result.resolved) == ("resolved", 0, True)
    assert (result.vertices == mesh[0]).all()


@pytest.mark.parametrize("strategy", ["none", "still"])
def test_no_progress_is_a_stall(strategy):
    class Still:
        def propose(self, context):
            return Corrections(np.zeros_like(context.intersections.vertices))

    vertices, faces = BIBI["X"]()
    result = cg.untangle(vertices, faces, strategy=Still() if strategy == "still" else "none", passes=500)
    assert result.stop_reason == "stalled"
    assert result.passes < 100
    assert (result.vertices == vertices).all()


class Harmful:
    """Pushes everything a little and at random: mostly makes matters worse."""

    def __init__(self):
        self.rng = np.random.default_rng(0)

    def propose(self, context):
        return Corrections(self.rng.normal(0, 0.05, context.intersections.vertices.shape))


@pytest.mark.parametrize("strategy", ["local", "global", "hybrid", Harmful()])
@pytest.mark.parametrize("name", ["crumple", "spiky", "ribbon"])
def test_the_result_is_never_worse_than_what_was_given(name, strategy):
    mesh = {"crumple": meshes.crumple(8, 1), "spiky": meshes.spiky(6, 0), "ribbon": RIBBON["leaning"]()}[name]
    result = cg.untangle(*mesh, strategy=strategy, passes=12)
    hits = cg.intersections(result.vertices, mesh[1])
    assert (hits.hit_count, hits.length) == (result.hits, pytest.approx(result.length))
    assert (result.hits, result.length) == min(zip(result.hit_history, result.length_history, strict=True))
    assert result.resolved == (result.hits == 0)


class Explosive:
    def propose(self, context):
        return Corrections(np.full_like(context.intersections.vertices, self.value))


@pytest.mark.parametrize("value", [1e9, np.nan, np.inf])
def test_an_exploding_strategy_is_stopped(value):
    vertices, faces = BIBI["X"]()
    strategy = Explosive()
    strategy.value = value
    result = cg.untangle(vertices, faces, strategy=strategy)
    assert result.stop_reason == "explosion"
    assert (result.vertices == vertices).all()


def test_own_strategies_by_object_and_by_name(monkeypatch):
    class Own:
        contexts: list = []

        def propose(self, context):
            self.contexts.append(context)
            return untangling.get("global").propose(context)

    module = types.ModuleType("an_own_module")
    module.Own, module.made, module.other = Own, Own(), 3
    monkeypatch.setitem(sys.modules, "an_own_module", module)
    mesh = BIBI["X"]()
    expected = cg.untangle(*mesh, strategy="global")
    for strategy in (Own(), "an_own_module:Own", "an_own_module:made"):
        Own.contexts.clear()
        result = cg.untangle(*mesh, strategy=strategy)
        assert result.length_history == expected.length_history
        assert len(Own.contexts) == result.passes
    context = Own.contexts[0]
    assert (context.inverse_masses == 1.0).all()
    assert context.h0 > 0 and context.g0 == 1.0
    with pytest.raises(ValueError, match="propose"):
        cg.untangle(*mesh, strategy="an_own_module:other")
    with pytest.raises(ValueError, match="missing"):
        cg.untangle(*mesh, strategy="an_own_module:missing")


def test_a_trimesh_alone_a_surface_and_plain_arrays_agree():
    vertices, faces = BIBI["X"]()
    plain = cg.untangle(vertices, faces)
    alone = cg.untangle(trimesh.Trimesh(vertices, faces, process=False))
    surface = cg.untangle(vertices, cg.Surface(faces))
    assert (plain.vertices == alone.vertices).all()
    assert (plain.vertices == surface.vertices).all()


@pytest.mark.parametrize("as_surface", [False, True])
def test_vertices_that_no_face_uses_stay(as_surface):
    vertices, faces = BIBI["X"]()
    more = np.r_[vertices, [[9.0, 9.0, 9.0], [8.0, 7.0, 6.0]]]
    result = cg.untangle(more, cg.Surface(faces) if as_surface else faces)
    assert result.resolved
    assert (result.vertices[-2:] == more[-2:]).all()


def test_h0_and_g0_matter():
    mesh = BIBI["X"]()
    settings = ({}, {"h0": 0.1}, {"g0": 9.0})
    lengths = {tuple(cg.untangle(*mesh, strategy="local", passes=2, **k).length_history) for k in settings}
    assert len(lengths) == 3


@pytest.mark.parametrize(("change", "message"), [
    ({"passes": -1}, r"passes = -1: out of range \[0, 1e\+06\]"),
    ({"passes": 2.5}, "passes = 2.5"),
    ({"h0": 0.0}, "h0 = 0.0"),
    ({"g0": float("nan")}, "g0 = nan"),
    ({"strategy": "unheard"}, "strategy = 'unheard': expected one of none, local, global, exact, area, gia, hybrid,"),
    ({"strategy": "no_such_module:X"}, "no_such_module"),
    ({"strategy": 5}, "propose"),
    ({"fixed": [0, 1]}, "fixed: expected"),
    ({"fixed": np.zeros(3, np.bool_)}, "fixed: expected"),
])  # fmt: skip
def test_bad_arguments_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        cg.untangle(*meshes.grid(2, 2), **change)


@pytest.mark.parametrize(("vertices", "faces", "message"), [
    (np.zeros((3, 3)), [[0, 1, 3]], r"faces\[0, 2\] is 3"),
    (np.full((3, 3), np.nan), [[0, 1, 2]], r"vertices\[0, 0\] is nan"),
    (np.zeros((3, 2)), [[0, 1, 2]], "shape"),
    (np.zeros((3, 3)), [[0.0, 1.0, 2.0]], "integers"),
    (np.zeros((3, 3)), None, "faces: missing"),
])  # fmt: skip
def test_bad_meshes_are_named(vertices, faces, message):
    with pytest.raises(ValueError, match=message):
        cg.untangle(vertices, faces)


def test_an_empty_mesh_is_resolved():
    result = cg.untangle(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert result.resolved and result.length == 0.0


class WrongType:
    def propose(self, context):
        return 3


class WrongShape:
    def propose(self, context):
        return Corrections(np.zeros((2, 3)))


@pytest.mark.parametrize("strategy", [WrongType(), WrongShape()])
def test_a_strategy_that_answers_nonsense_is_named(strategy):
    """An extension point: what comes back is checked, with one clear line."""
    with pytest.raises(ValueError, match=r"strategy|displacements"):
        cg.untangle(*BIBI["X"](), strategy=strategy)
