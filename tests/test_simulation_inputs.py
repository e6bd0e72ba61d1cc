"""What a simulation is given: strategies of a user, fidelities and scenes, as JSON and with bad values."""

from __future__ import annotations

import dataclasses
import json
import sys
import types

import numpy as np
import pytest
from small_scenes import CONTACT, GLOBAL, pile, tangle

import clothgym as cg
from clothgym.response.untangling import Corrections

# ---------------------------------------------------------------------------------------------------------------
# strategies of a user


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
