"""The simulation as a whole: determinism, snapshots, looking, errors, JSON, and knobs that do something."""

from __future__ import annotations

import copy
import dataclasses
import json
import pickle
import sys
import types

import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym.response.untangling import Corrections

SOFT = cg.Material(stretch=1e3, shear=2e2, flexion=0.5, damping=2.0, friction=0.2, thickness=4e-3)


def pile(count: int = 3, **scene) -> cg.Scene:
    """Small sheets a little above each other and the ground: in contact after a few steps."""
    rng = np.random.default_rng(0)
    mesh = cg.grid(0.3, 0.3, 4, 4)
    cloths = []
    for k in range(count):
        place = np.array([0.02 * k, 0.01 + 0.012 * k, 0.013 * k])
        vertices = mesh.vertices + place + rng.uniform(-2e-3, 2e-3, mesh.vertices.shape)
        cloths.append(cg.Cloth(cg.Mesh(vertices, mesh.faces, mesh.quads), SOFT, (), mesh.vertices, f"sheet {k}"))
    return cg.Scene(cloths, **({"ground": 0.0, "step": 0.01, "name": "small pile"} | scene))


def tangle() -> cg.Scene:
    """Two sheets through each other and a third below: contact and untangling at work."""
    mesh = cg.grid(0.3, 0.3, 5, 5)
    c, s = np.cos(0.5), np.sin(0.5)
    turned = mesh.transformed([[c, -s, 0], [s, c, 0], [0, 0, 1]], (0.06, 0.101, 0.017))
    flat = [mesh.transformed(translation=(0, 0.1, 0)), mesh.transformed(translation=(0.03, 0.092, 0.01))]
    material = dataclasses.replace(SOFT, thickness=6e-3)
    cloths = [cg.Cloth(m, material, (), mesh.vertices) for m in (flat[0], turned, flat[1])]
    return cg.Scene(cloths, ground=0.0, step=0.01)


CONTACT = cg.Fidelity(substeps=4, untangling="none")


def in_contact() -> cg.Simulation:
    sim = cg.Simulation(pile(), CONTACT)
    sim.step(6)
    assert sim.metrics()["work"]["contacts"] > 100
    return sim


# ---------------------------------------------------------------------------------------------------------------
# determinism, reset, snapshots, copies


@pytest.mark.parametrize("make", [pile, tangle, lambda: cg.scenes.make("hanging_sheet", resolution=6)])
def test_same_calls_give_the_same_bits(make):
    hashes = []
    for _ in range(2):
        sim = cg.Simulation(make(), cg.Fidelity(substeps=4))
        sim.reset(seed=3)
        sim.step(8)
        hashes.append(sim.state_hash())
    assert hashes[0] == hashes[1]
    sim.step()
    assert sim.state_hash() != hashes[0]


def test_the_hash_sees_every_part_of_the_state():
    sim = cg.Simulation(pile(grips=[cg.Grip()]), CONTACT)
    changes = [
        lambda s: s.positions.__setitem__((0, 0), np.nextafter(s.positions[0, 0], 9.0)),
        lambda s: s.velocities.__setitem__((3, 2), 1e-300),
        lambda s: setattr(s, "time", 1e-9), lambda s: setattr(s, "step", 1),
        lambda s: s.grip_positions.__setitem__((0, 0), 1e-9), lambda s: s.grip_velocities.__setitem__((0, 1), 1e-9),
        lambda s: (setattr(s, "held_vertices", np.array([4], np.int32)), setattr(s, "held_by", np.zeros(1, np.int32)),
                   setattr(s, "held_offsets", np.zeros((1, 3)))),
    ]  # fmt: skip
    hashes = {sim.state_hash()}
    for change in changes:
        state = sim.snapshot()
        change(state)
        hashes.add(state.hash())
    assert len(hashes) == len(changes) + 1
    held = []
    for offset in (0.0, 1e-9):
        state = sim.snapshot()
        state.held_vertices, state.held_by = np.array([4], np.int32), np.zeros(1, np.int32)
        state.held_offsets = np.full((1, 3), offset)
        held.append(state.hash())
    assert held[0] != held[1]


def test_twenty_resets_are_one_reset():
    sim = cg.Simulation(tangle(), cg.Fidelity(substeps=4))
    fresh = sim.state_hash()
    sim.step(5)
    after = sim.state_hash()
    work = sim.metrics()["work"]
    for number in range(20):
        sim.reset(seed=number)
        assert sim.state_hash() == fresh
        assert sim.metrics()["work"] == {} and sim.metrics()["untangling_passes"] == 0
        assert all(calls == 0 and seconds == 0.0 for calls, seconds in sim.profile.values())
    sim.step(5)
    assert sim.state_hash() == after
    assert sim.metrics()["work"] == work


@pytest.mark.parametrize("grips", [0, 1])
def test_snapshot_and_restore_in_the_middle_of_contact(grips):
    sim = cg.Simulation(pile(grips=[cg.Grip()] * grips), CONTACT)
    if grips:
        sim.place_grip(0, sim.positions[60])
        assert sim.grasp(0, [60, 61]) == 2
        sim.move_grip(0, (0.0, 0.2, 0.1))
    sim.step(6)
    snapshot, at = sim.snapshot(), sim.state_hash()
    sim.step(6)
    after = sim.state_hash()
    assert snapshot.hash() == at, "the snapshot moved along"
    sim.restore(snapshot)
    assert (sim.state_hash(), sim.step_count) == (at, 6)
    sim.step(6)
    assert sim.state_hash() == after
    other = cg.Simulation(sim.scene, sim.fidelity)
    other.step(2)
    other.restore(snapshot)
    other.step(6)
    assert other.state_hash() == after, "something outside the state takes part in a step"
    assert snapshot.hash() == at


def test_snapshots_of_other_scenes_are_refused():
    sim = cg.Simulation(pile(), CONTACT)
    with pytest.raises(ValueError, match="snapshot"):
        sim.restore(cg.Simulation(pile(2), CONTACT).snapshot())
    with pytest.raises(ValueError, match="snapshot"):
        cg.Simulation(pile(grips=[cg.Grip()]), CONTACT).restore(sim.snapshot())


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))])
def test_copies_go_on_alike_and_apart(copied):
    sim = in_contact()
    twin = copied(sim)
    assert twin.state_hash() == sim.state_hash()
    assert twin.metrics() == sim.metrics()
    before = sim.state_hash()
    twin.step(4)
    assert sim.state_hash() == before
    sim.step(4)
    assert sim.state_hash() == twin.state_hash()


def test_looking_changes_nothing():
    blind, seen = cg.Simulation(tangle(), cg.Fidelity(substeps=4)), cg.Simulation(tangle(), cg.Fidelity(substeps=4))
    for _ in range(6):
        blind.step()
        seen.step()
        seen.metrics()
        _ = seen.last_intersections.gradient(), seen.last_intersections.contours, seen.profile, seen.pipeline.describe()
        seen.snapshot()
    assert blind.state_hash() == seen.state_hash()
    assert blind.metrics() == seen.metrics()


def test_last_intersections_follow_the_state():
    sim = cg.Simulation(tangle(), cg.Fidelity(substeps=4))
    start = sim.snapshot()
    length = sim.metrics()["contour_length"]
    assert length == pytest.approx(cg.intersections(sim.positions, sim.faces).length)
    assert length > 0.1
    sim.set_positions(sim.positions + np.linspace(0, 9, 3).repeat(36)[:, None] * [0, 1, 0])
    assert sim.metrics()["contour_length"] == 0.0
    sim.restore(start)
    assert sim.metrics()["contour_length"] == length
    sim.step(3)
    assert sim.metrics()["contour_length"] == pytest.approx(cg.intersections(sim.positions, sim.faces).length)


# ---------------------------------------------------------------------------------------------------------------
# what can be read and set


def test_metrics_of_a_known_state():
    mesh = cg.grid(0.4, 0.4, 2, 2)
    scene = cg.Scene([cg.Cloth(mesh, cg.Material(density=0.5, stretch=100.0, shear=0.0, flexion=0.0))], name="one")
    sim = cg.Simulation(scene, CONTACT)
    sim.set_positions(mesh.vertices * [1.1, 1, 1] + [0, 2.0, 0])
    sim.set_velocities(np.tile([0.0, 3.0, 4.0], (9, 1)))
    found = sim.metrics()
    assert found["max_strain"] == pytest.approx(0.1)
    assert found["kinetic_energy"] == pytest.approx(0.5 * 0.08 * 25.0)
    assert found["potential_energy"] == pytest.approx(0.08 * 9.81 * 2.0 + 6 * 0.5 * 100.0 * 0.02**2)
    assert found["max_speed"] == pytest.approx(5.0)
    assert (found["time"], found["contour_length"], found["hits"], found["penetration_depth"]) == (0.0, 0.0, 0, 0.0)
    for name in ("contour_count", "untangling_passes", "work"):
        assert name in found
    json.dumps(found)


def test_energy_of_an_undamped_swing_is_kept():
    scene = cg.scenes.make("hanging_sheet", resolution=6)
    cloth = dataclasses.replace(
        scene.cloths[0], material=cg.Material(stretch=200.0, shear=50.0, flexion=0.0, damping=0.0)
    )
    sim = cg.Simulation(
        dataclasses.replace(scene, cloths=[cloth]), cg.Fidelity(integrator="symplectic_euler", substeps=400)
    )

    def energy():
        found = sim.metrics()
        return found["kinetic_energy"] + found["potential_energy"]

    start = energy()
    sim.step(25)
    assert sim.metrics()["kinetic_energy"] > 0.1
    assert energy() == pytest.approx(start, abs=0.01 * sim.metrics()["kinetic_energy"])


def test_views_cannot_be_written():
    sim = cg.Simulation(pile(grips=[cg.Grip()]), CONTACT)
    for view in (sim.positions, sim.velocities, sim.faces, sim.grip_positions, sim.grip_forces):
        with pytest.raises(ValueError, match="read-only"):
            view[0] = 1.0
    assert sim.positions.shape == sim.velocities.shape == (75, 3)


def test_set_positions_copies_and_checks():
    sim = cg.Simulation(pile(), CONTACT)
    wanted = sim.positions + 0.5
    sim.set_positions(wanted)
    assert (sim.positions == wanted).all()
    wanted[0] = 9.0
    assert sim.positions[0, 0] != 9.0
    bad = np.zeros((75, 3))
    bad[7, 2] = np.inf
    for setter, name in ((sim.set_positions, "positions"), (sim.set_velocities, "velocities")):
        before = sim.state_hash()
        for values, message in (
            (np.zeros((74, 3)), f"{name}: expected 75 rows, got 74"),
            (np.zeros((75, 2)), f"{name}: expected shape"),
            (bad, rf"{name}\[7, 2\] is inf"),
        ):
            with pytest.raises(ValueError, match=message):
                setter(values)
        assert sim.state_hash() == before
    sim.set_positions(np.asarray(sim.positions, np.float32).tolist())
    assert sim.positions.dtype == np.float64


def test_time_steps_and_profile():
    sim = in_contact()
    assert (sim.step_count, sim.time) == (6, pytest.approx(0.06))
    names = [stage.name for stage in sim.pipeline.stages]
    assert set(names) <= set(sim.profile)
    calm = 0
    for stage in sim.pipeline.stages:
        calls, seconds = sim.profile[stage.name]
        if getattr(stage, "of_pairs", False):
            calm = calm or 6 - calls
            calls += calm
        assert calls == 6 and seconds > 0
    assert 0 < calm < sim.metrics()["work"]["decided_flat"]  # the first decided step runs all stages
    parts = [key for key in sim.profile if key not in names]
    assert len(parts) >= 5
    assert sum(sim.profile[part][1] for part in parts) <= 1.01 * sim.profile[names[-1]][1]
    sim.step(0)
    assert sim.step_count == 6


# ---------------------------------------------------------------------------------------------------------------
# divergence and strategies that misbehave


def test_divergence_keeps_the_last_finite_state():
    sim = in_contact()
    before = sim.snapshot()
    sim.set_velocities(np.full((75, 3), 1e8))
    set_to = sim.state_hash()
    with pytest.raises(cg.SimulationError, match="speed") as error:
        sim.step()
    assert isinstance(error.value, RuntimeError)
    assert error.value.time == pytest.approx(0.06)
    for part in (error.value.stage, error.value.quantity, "substeps"):
        assert part in str(error.value)
    assert sim.state_hash() == set_to and sim.step_count == 6
    sim.restore(before)
    sim.step(2)
    again = cg.Simulation(sim.scene, sim.fidelity)
    again.restore(before)
    again.step(2)
    assert sim.state_hash() == again.state_hash(), "a diverged step left something behind"


@pytest.fixture
def own(monkeypatch):
    """A module with strategies as a user may write them."""

    class Broken:
        def propose(self, context):
            return Corrections(np.full_like(context.intersections.vertices, np.nan))

    class Careless:
        def propose(self, context):
            return Corrections(np.full_like(context.intersections.vertices, 1e-3))

    class Nonsense:
        def propose(self, context):
            return Corrections(np.zeros((2, 3)))

    module = types.ModuleType("strategies_of_a_user")
    module.Broken, module.Careless, module.Nonsense = Broken, Careless, Nonsense
    monkeypatch.setitem(sys.modules, "strategies_of_a_user", module)
    return "strategies_of_a_user:"


def test_nan_from_a_strategy_is_an_error_that_names_the_stage(own):
    sim = cg.Simulation(tangle(), cg.Fidelity(untangling=own + "Broken"))
    start = sim.state_hash()
    with pytest.raises(cg.SimulationError, match="finite") as error:
        sim.step()
    assert sim.state_hash() == start
    assert "untangle" in error.value.stage


def test_no_strategy_moves_a_pin(own):
    scene = tangle()
    scene = dataclasses.replace(scene, cloths=[dataclasses.replace(c, pins=(0,)) for c in scene.cloths])
    sim = cg.Simulation(scene, cg.Fidelity(untangling=own + "Careless"))
    start = sim.positions[[0, 36, 72]].copy()
    sim.step(2)
    assert (sim.positions[[0, 36, 72]] == start).all()


def test_nonsense_from_a_strategy_is_named(own):
    sim = cg.Simulation(tangle(), cg.Fidelity(untangling=own + "Nonsense"))
    with pytest.raises(ValueError, match=r"strategy|displacements"):
        sim.step()


def test_untangling_in_a_simulation_resolves_and_counts():
    sim = cg.Simulation(tangle(), cg.Fidelity(untangling="global"))
    assert sim.metrics()["hits"] > 10
    for _ in range(60):
        sim.step()
        if sim.last_intersections.hit_count == 0:
            break
    passes = sim.metrics()["untangling_passes"]
    assert sim.last_intersections.hit_count == 0
    assert 0 < passes <= sim.step_count * sim.fidelity.untangling_passes
    for _ in range(10):
        clean, before = sim.last_intersections.hit_count == 0, sim.metrics()["untangling_passes"]
        sim.step()
        assert not clean or sim.metrics()["untangling_passes"] == before, "a pass without intersections"
    assert sim.last_intersections.hit_count == 0


def test_corrections_speed_no_vertex_up_beyond_the_limit():
    """Slow vertices reach the limit at most; vertices that are faster already keep their speed and gain none."""
    for before, limit in ((0.0, 0.3), (0.2, 0.3), (0.9, 0.3)):
        sim = cg.Simulation(tangle(), dataclasses.replace(GLOBAL, speed_limit=limit, h0=1.0))
        sim.set_velocities(np.tile([before, 0.0, 0.0], (len(sim.positions), 1)))
        for stage in sim.pipeline.stages[:2]:
            stage.run(sim._frame)
        assert "intersections" in stage.name
        speed = np.linalg.norm(sim.velocities, axis=1)
        assert (sim.positions != sim.scene.start).any()
        assert speed.max() <= max(before, limit) * (1 + 1e-12)
        assert speed.max() == pytest.approx(max(before, limit)), "the limit is never reached: the test shows nothing"


# ---------------------------------------------------------------------------------------------------------------
# JSON and bad values


def test_fidelity_round_trip():
    own = cg.Fidelity(k=26, arity=2, h0=0.3, integrator="symplectic_euler", velocity_modification="literal")
    for fidelity in (cg.Fidelity.preset("draft"), cg.Fidelity.preset("accurate"), own):
        assert cg.Fidelity.from_json(fidelity.to_json()) == fidelity
        assert hash(cg.Fidelity.from_json(json.loads(fidelity.to_json()))) == hash(fidelity)
    assert len({cg.Fidelity.preset(name) for name in ("draft", "balanced", "accurate")}) == 3


@pytest.mark.parametrize(("field", "value", "said"), [
    ("integrator", "magic", "xpbd, symplectic_euler"), ("velocity_modification", "both", "literal"),
    ("detection", "none", "brute_force"), ("contacts_near_hits", "off", "off_any"),
    ("substeps", -1, "[0, 100000]"), ("substeps", 2.5, "an integer"), ("sweeps", 0, "[1, 10000]"),
    ("substeps", float("nan"), "an integer"), ("substeps", float("inf"), "an integer"), ("sweeps", True, "an integer"),
    ("stretch_limit", -0.1, "[0, 10]"), ("k", 12, "6, 8, 14, 18, 26"), ("arity", 3, "2, 4, 8"),
    ("repair_rounds", -1, "[0, 1000]"), ("untangling", "", "strategy"), ("untangling", None, "strategy"),
    ("untangling_passes", 0, "[1, 1000]"), ("h0", 0.0, "[1e-06, 100]"), ("g0", float("nan"), "[1e-09, 1e+09]"),
    ("velocity_share", 1.1, "[0, 1]"), ("speed_limit", 0.0, "[0.001, 1000]"), ("rings", 11, "[0, 10]"),
    ("h0", "big", "a number"),
])  # fmt: skip
def test_bad_fidelity_names_field_value_and_range(field, value, said):
    with pytest.raises(ValueError) as error:
        cg.Fidelity(**{field: value})
    assert f"fidelity.{field} = {value!r}" in str(error.value)
    assert said in str(error.value)


@pytest.mark.parametrize("value", [4.0, np.int64(4), np.float64(4.0)])
def test_whole_numbers_of_any_type_are_plain_integers(value):
    """JSON written elsewhere says 4.0; NumPy says int64(4): both mean 4 in the step, in JSON and in comparisons."""
    fidelity = cg.Fidelity(substeps=value, sweeps=value)
    assert type(fidelity.substeps) is int
    assert fidelity == cg.Fidelity(substeps=4, sweeps=4)
    assert fidelity.to_json() == cg.Fidelity(substeps=4, sweeps=4).to_json()
    cg.Simulation(pile(2), fidelity).step()


def test_unknown_fields_and_presets_are_named():
    with pytest.raises(ValueError, match=r"fidelity.sweep: unknown field; known: integrator"):
        cg.Fidelity.from_json('{"sweep": 3}')
    with pytest.raises(ValueError, match="'best': expected one of draft, balanced, accurate"):
        cg.Simulation(pile(), "best")
    with pytest.raises(ValueError, match="'nonsense': expected one of none, local"):
        cg.Simulation(pile(), cg.Fidelity(untangling="nonsense"))
    with pytest.raises(ValueError, match="works with integrator"):
        cg.Fidelity(velocity_modification="relative")


def test_scene_round_trip_is_exact():
    scene = pile(wind=(0.1, 0.2, 0.3), grips=[cg.Grip(radius=0.1)], duration=1.5)
    again = cg.Scene.from_json(scene.to_json())
    assert again == scene and hash(again) == hash(scene)
    assert again.to_json() == scene.to_json()
    assert (again.start == scene.start).all()
    one, two = cg.Simulation(scene, CONTACT), cg.Simulation(again, CONTACT)
    one.step(5)
    two.step(5)
    assert one.state_hash() == two.state_hash()
    for change in (
        {"ground": 0.1},
        {"wind_drag": 0.2},
        {"grips": ()},
        {"cloths": scene.cloths[:2]},
        {"self_collision": False},
    ):
        assert dataclasses.replace(scene, **change) != scene


def changed_json(change) -> str:
    values = json.loads(pile(grips=[cg.Grip()]).to_json())
    change(values)
    return json.dumps(values)


@pytest.mark.parametrize(("change", "message"), [
    (lambda v: v.update(bogus=1), "scene.bogus"),
    (lambda v: v.pop("cloths"), "scene.cloths"),
    (lambda v: v.update(step=0.0), r"scene.step = 0.0: out of range"),
    (lambda v: v.update(gravity=[0, 1]), "scene.gravity"),
    (lambda v: v["cloths"][0].update(bogus=1), "cloth.bogus"),
    (lambda v: v["cloths"][0].pop("pins"), "cloth.pins"),
    (lambda v: v["cloths"][0]["material"].update(density=-1), r"material.density = -1: out of range"),
    (lambda v: v["cloths"][0]["material"].update(colour=1), "material.colour"),
    (lambda v: v["cloths"][0].update(pins=[999]), "no vertex 999"),
    (lambda v: v["grips"][0].update(bogus=1), "grip.bogus"),
    (lambda v: v["grips"][0].update(radius=-1), r"grip.radius = -1"),
])  # fmt: skip
def test_bad_scene_json_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        cg.Scene.from_json(changed_json(change))


@pytest.mark.parametrize(("make", "message"), [
    (lambda m: cg.Scene([]), "scene.cloths"),
    (lambda m: cg.Scene([m]), r"scene.cloths\[0\]"),
    (lambda m: cg.Scene([cg.Cloth(m)], ground=np.nan), "scene.ground"),
    (lambda m: cg.Scene([cg.Cloth(m)], wind=(0, np.inf, 0)), "scene.wind"),
    (lambda m: cg.Cloth(m, material="silkk"), "material = 'silkk': expected one of cotton"),
    (lambda m: cg.Cloth(m, pins=[9]), "no vertex 9"),
    (lambda m: cg.Cloth(m, rest=np.zeros((3, 3))), "rest: expected 9 rows"),
    (lambda m: cg.Cloth((m.vertices, np.zeros((0, 3), int))), "at least one triangle"),
    (lambda m: cg.Cloth(5), "mesh: expected"),
    (lambda m: cg.Cloth((m.vertices, [[0, 1, 99]])), r"faces\[0, 2\] is 99"),
    (lambda m: cg.Simulation(cg.Scene([cg.Cloth((np.zeros((3, 3)), [[0, 1, 2]]))])), "zero area"),
    (lambda m: cg.Material(stretch=0.0), "material.stretch = 0.0"),
    (lambda m: cg.Grip(slip_force=np.inf), "grip.slip_force"),
])  # fmt: skip
def test_bad_scenes_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make(cg.grid(1, 1, 2, 2))


def test_a_mask_of_pins_is_a_mask_or_refused():
    """`untangle` takes fixed vertices as booleans; as pins they must not silently become the ids 0 and 1."""
    mask = np.zeros(9, np.bool_)
    mask[[4, 7]] = True
    refused = None
    try:
        pins = cg.Cloth(cg.grid(1, 1, 2, 2), pins=mask).pins
    except ValueError as error:
        refused = str(error)
    assert (pins == (4, 7)) if refused is None else ("pins" in refused)


def test_pins_that_are_no_integers_are_named():
    for pins in ([1.7], ["a"]):
        with pytest.raises(ValueError, match="pins"):
            cg.Cloth(cg.grid(1, 1, 2, 2), pins=pins)


# ---------------------------------------------------------------------------------------------------------------
# no dead knobs


def outcome(make, fidelity, speed: float = 0.0):
    """Everything that a knob can change: stage names, step, work counters, box tests, and the state."""
    sim = cg.Simulation(make(), fidelity)
    if speed:
        rng = np.random.default_rng(1)
        sim.set_velocities(rng.normal(0, speed, sim.positions.shape))
    sim.step(4)
    tree = getattr(getattr(sim.pipeline.stages[0], "candidates", None), "tree", None)
    return sim.pipeline.describe(), sim.state_hash(), getattr(tree, "box_tests", None), sim.metrics()["work"]


def lone_sheet():
    return dataclasses.replace(cg.scenes.make("hanging_sheet", resolution=4), self_collision=True)


def on_ball():
    """A sheet that lies on a ball finer than its own cells."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    mesh = cg.grid(0.3, 0.3, 6, 6).transformed(translation=(0.02, 0.2005, 0.01))
    return cg.Scene([cg.Cloth(mesh)], bodies=[cg.Body(ball, slide=0.5)], step=0.01, self_collision=False)


def through_ball() -> cg.Scene:
    """A sheet with its middle inside a ball."""
    return dataclasses.replace(
        on_ball(),
        cloths=[cg.Cloth(cg.grid(0.6, 0.6, 6, 6).transformed(translation=(0.02, 0.1505, 0.01)))],
        self_collision=True,
    )


def bent() -> cg.Scene:
    """A strip that lies bent: where it is and its pattern differ."""
    flat = cg.grid(0.6, 0.2, 12, 4)
    x, _, z = flat.vertices.T
    start = np.stack([0.15 * np.sin(x / 0.15), 0.3 - 0.15 * np.cos(x / 0.15), z], axis=1)
    return cg.Scene([cg.Cloth(cg.Mesh(start, flat.faces, flat.quads), SOFT, rest=flat.vertices)], step=0.01)


def hanging():
    return cg.scenes.make("hanging_sheet", resolution=16)


EULER = cg.Fidelity(integrator="symplectic_euler", substeps=0)
SEARCH = dataclasses.replace(CONTACT, flat_check=False)
GLOBAL = cg.Fidelity(untangling="global", untangling_passes=1, substeps=4)
STEEP = dataclasses.replace(EULER, velocity_modification="relative", stretch_limit=0.0)
MEZGER = dataclasses.replace(CONTACT, detection="mezger")
CURVATURE = dataclasses.replace(MEZGER, cones="mezger")
CHOSEN = cg.Fidelity()
IMPLICIT = cg.Fidelity(integrator="implicit_euler", substeps=2)
KNOBS = {
    "integrator": (pile, CONTACT, "symplectic_euler", 0, "state"),
    "membrane": (pile, CONTACT, "continuum", 0, "state"),
    "bending": (pile, CONTACT, "hinge", 0, "state"),
    "substeps": (pile, CONTACT, 6, 0, "state"),
    "sweeps": (pile, CONTACT, 6, 0, "state"),
    "contact_substeps": (pile, dataclasses.replace(CONTACT, substeps=0), 6, 0, "state"),
    "stretch_error": (hanging, CHOSEN, 0.05, 0, "state"),
    "precision": (hanging, CHOSEN, "float32", 0, "state"),
    "time_order": (pile, IMPLICIT, 1, 0, "state"),
    "tolerance": (pile, IMPLICIT, 1e-4, 2, "state"),
    "solver_steps": (pile, IMPLICIT, 1, 2, "state"),
    "velocity_modification": (pile, STEEP, "literal", 2, "state"),
    "position_modification": (pile, dataclasses.replace(EULER, stretch_limit=0.0), 2, 2, "state"),
    "stretch_limit": (pile, STEEP, 0.2, 2, "state"),
    "detection": (pile, CONTACT, "brute_force", 0, "work"),
    "k": (pile, SEARCH, 26, 0, "boxes"),
    "arity": (pile, SEARCH, 2, 0, "boxes"),
    "flat_check": (lone_sheet, CONTACT, False, 0, "work"),
    "inflation": (pile, MEZGER, "unoriented", 1, "work"),
    "cones": (pile, MEZGER, "none", 0, "work"),
    "close_angle": (pile, CURVATURE, 0.01, 0, "work"),
    "leaf_angle": (pile, CURVATURE, 0.5, 0, "work"),
    "wide_angle": (pile, dataclasses.replace(MEZGER, inflation="conservative"), 0.0, 1, "boxes"),
    "face_groups": (pile, CURVATURE, 4, 0, "work"),
    "lazy": (pile, MEZGER, 1e-4, 0, "work"),
    "coherence": (pile, MEZGER, 1e-3, 0, "work"),
    "separation_list": (pile, MEZGER, 4, 0, "boxes"),
    "build_space": (bent, MEZGER, "pattern", 0, "boxes"),
    "rebuild_growth": (pile, SEARCH, 1.01, 2, "work"),
    "repair_rounds": (pile, CONTACT, 0, 20, "state"),
    "continuous": (tangle, dataclasses.replace(GLOBAL, untangling="none", rings=4), True, 1, "work"),
    "untangling": (tangle, GLOBAL, "local", 0, "state"),
    "untangling_passes": (tangle, GLOBAL, 3, 0, "state"),
    "h0": (tangle, GLOBAL, 0.3, 0, "state"),
    "g0": (tangle, GLOBAL, 5.0, 0, "state"),
    "displacement_share": (tangle, GLOBAL, 0.5, 0, "state"),
    "velocity_share": (tangle, GLOBAL, 0.5, 0, "state"),
    "acceleration_share": (tangle, GLOBAL, 0.5, 0, "state"),
    "penalty_stiffness": (tangle, GLOBAL, 10.0, 0, "state"),
    "untangle_bodies": (through_ball, GLOBAL, True, 0, "state"),
    "easing": (tangle, GLOBAL, 0, 0, "state"),
    "speed_limit": (tangle, GLOBAL, 0.1, 0, "state"),
    "contacts_near_hits": (tangle, GLOBAL, "keep", 0, "state"),
    "rings": (tangle, GLOBAL, 0, 0, "state"),
    "yield_force": (tangle, dataclasses.replace(GLOBAL, contacts_near_hits="yield"), 5.0, 0, "state"),
    "map_size": (on_ball, CONTACT, 60, 0, "state"),
    "body_tolerance": (on_ball, CONTACT, 5e-3, 0, "state"),
    "body_faces": (on_ball, CONTACT, 0, 0, "state"),
    "body_texels": (on_ball, CONTACT, True, 0, "state"),
    "body_collider": (on_ball, CONTACT, "dop", 0, "state"),
    "body_normals": (on_ball, CONTACT, "interpolated", 0, "state"),
    "body_views": (on_ball, CONTACT, "z", 0, "state"),
    "body_response": (on_ball, CONTACT, "velocity", 0, "state"),
}
"""Field: scene, base, other value, initial speed, and what must change."""


def test_every_field_of_fidelity_has_a_knob_test():
    assert set(KNOBS) == {field.name for field in dataclasses.fields(cg.Fidelity)}


@pytest.mark.parametrize("field", KNOBS)
def test_no_dead_knobs(field):
    make, base, value, speed, what = KNOBS[field]
    changed = {field: value} | ({"substeps": 0} if field == "integrator" else {})
    one = outcome(make, base, speed)
    assert outcome(make, base, speed) == one, "the comparison is not deterministic"
    two = outcome(make, dataclasses.replace(base, **changed), speed)
    part = {"state": 1, "boxes": 2, "work": 3}[what]
    assert one[part] != two[part]


def test_every_way_with_contacts_near_hits_is_its_own():
    ways = ("off_any", "off_both", "yield", "limited", "keep")
    assert len({outcome(tangle, dataclasses.replace(GLOBAL, contacts_near_hits=way))[1] for way in ways}) == 5


def test_brute_force_and_hierarchy_give_the_same_physics():
    """Pairs come in another order, so bits may differ; what is found may not."""
    found = []
    for detection in ("hierarchy", "brute_force"):
        sim = cg.Simulation(tangle(), dataclasses.replace(GLOBAL, detection=detection))
        hits = sim.last_intersections.hit_count
        sim.step()
        found.append((hits, sim.metrics()["work"]["hits"], sim.positions.copy()))
    assert found[0][:2] == found[1][:2]
    assert found[0][1] > 10
    assert found[0][2] == pytest.approx(found[1][2], abs=1e-4)
