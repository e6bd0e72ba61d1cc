"""Extreme and impossible inputs: refused in one line that names the field, or taken; never a NaN that gets through."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from light_scenes import HUGE, light

import clothgym as cg
from clothgym.benchmarks.stability import extremes, inputs
from clothgym.benchmarks.stability.watch import not_finite, shown_arrays, variants
from clothgym.fidelity import MOST_SUBSTEPS

LONGEST = 10**5000  # Python refuses to write it in decimal
STRANGE = [HUGE, LONGEST, 1j, "3", None, [1.0], np.array([1.0, 2.0]), {}, b"1", True, np.True_, 5e-324, -5e-324, 1e308]


# ---------------------------------------------------------------------------------------------------------------
# numbers that are none


@pytest.mark.parametrize("name", [*inputs.MADE, *inputs.GIVEN])
def test_numbers_that_are_none_are_refused_everywhere(name):
    for word in inputs.BAD:
        result = inputs.run(name, word)
        assert result["outcome"] == "refused", (name, word)
        assert result["unchanged"], (name, word)
        assert result["named"], result["error"]


def test_the_list_of_inputs_knows_every_field():
    asked = set(inputs.MADE)
    for prefix, kind in (("fidelity", cg.Fidelity), ("material", cg.Material), ("grip", cg.Grip)):
        assert {f"{prefix}.{field.name}" for field in dataclasses.fields(kind)} <= asked
    numbers = {f"scene.{f.name}" for f in dataclasses.fields(cg.Scene)} - {
        "scene.cloths",
        "scene.bodies",
        "scene.grips",
    }
    assert numbers - {"scene.name"} <= asked


# ---------------------------------------------------------------------------------------------------------------
# values of strange types


def _tried(kind, field, value):
    try:
        return kind(**{field: value}), ""
    except ValueError as error:
        return None, str(error)


@pytest.mark.parametrize("kind", [cg.Fidelity, cg.Material, cg.Grip])
def test_strange_values_are_refused_by_name_or_become_plain_numbers(kind):
    prefix = kind.__name__.lower()
    for field in dataclasses.fields(kind):
        for value in (*STRANGE, np.float32(0.25), np.int8(4), np.uint64(8), np.float64(1.0)):
            made, line = _tried(kind, field.name, value)
            if made is None:
                assert line.startswith(f"{prefix}.") and field.name in line
                assert len(line) < 400 and "\n" not in line
                continue
            stored = getattr(made, field.name)
            if value is None:
                assert stored is None and field.default is None
                continue
            assert type(stored) in (int, float, str, bool), (field.name, value)
            assert stored == value
            json.dumps(dataclasses.asdict(made), allow_nan=False)


@pytest.mark.parametrize(
    ("field", "bad"),
    [
        ("gravity", (0.0, HUGE, 0.0)), ("gravity", (1e7, 0.0, 0.0)), ("gravity", (0.0, 1j, 0.0)), ("gravity", "abc"),
        ("gravity", ("0", "1", "2")), ("gravity", None), ("gravity", (1.0, 2.0)), ("wind", ((0.0, 1.0, 2.0),)),
        ("ground", "0"), ("ground", True), ("step", np.array([0.01])), ("step", 5e-324),
        ("self_collision", 1), ("self_collision", math.nan), ("self_collision", "no"), ("name", 3), ("name", None),
        ("cloths", 3), ("cloths", None), ("cloths", np.array(1.0)), ("cloths", "cloth"), ("bodies", 1.5),
        ("grips", [1]), ("grips", "grip"), ("grips", math.nan),
    ],
)  # fmt: skip
def test_scenes_refuse_strange_values(field, bad):
    cloth = cg.Cloth(cg.grid(1.0, 1.0, 2, 2))
    with pytest.raises(ValueError, match=rf"^scene\.{field}[ \[:]") as error:
        cg.Scene(**({"cloths": (cloth,)} | {field: bad}))
    assert "\n" not in str(error.value) and len(str(error.value)) < 200


@pytest.mark.parametrize(
    ("field", "bad"),
    [
        ("pins", 3), ("pins", "0"), ("pins", [0.0]), ("pins", [HUGE]), ("pins", None), ("pins", [[0]]), ("pins", [True]),
        ("rest", "abc"), ("rest", 1j), ("rest", np.full((9, 3), "1")), ("rest", np.full((9, 3), 1e10)),
        ("rest", np.full((8, 3, 3), 1e10)), ("name", 1), ("equal_masses", "yes"), ("equal_masses", 1.0),
        ("material", ["cotton"]), ("material", 3), ("material", None),
    ],
)  # fmt: skip
def test_cloths_refuse_strange_values(field, bad):
    with pytest.raises(ValueError, match=field) as error:
        cg.Cloth(cg.grid(1.0, 1.0, 2, 2), **{field: bad})
    assert "\n" not in str(error.value)


def test_numpy_scalars_survive_json():
    material = cg.Material(density=np.float32(0.25), friction=np.int64(1))
    cloth = cg.Cloth(cg.grid(1, 1, 2, 2), material, np.array([1, 2], np.uint64), equal_masses=np.True_)
    grips = (cg.Grip(radius=np.float32(0.5)),)
    scene = cg.Scene((cloth,), ground=np.float32(-1.0), grips=grips, wind=np.zeros(3, np.float32))
    assert cg.Scene.from_json(scene.to_json()) == scene


def test_subnormal_stiffness_is_refused_and_none_is_allowed():
    for field in ("shear", "flexion"):
        with pytest.raises(ValueError, match=rf"material\.{field} = 4\.9.*e-324"):
            cg.Material(**{field: 5e-324})
        assert getattr(cg.Material(**{field: 0.0}), field) == 0.0
        least = cg.Material(**{"stretch": 1e-6, field: 1e-12})
        sim = cg.Simulation(cg.Scene((cg.Cloth(cg.grid(0.4, 0.4, 3, 3), least, (0,)),)), cg.Fidelity(substeps=2))
        sim.step(3)
        assert not not_finite(shown_arrays(sim))


# ---------------------------------------------------------------------------------------------------------------
# shapes at the limits


def test_cloth_too_small_or_too_far_is_refused():
    mesh = cg.grid(1.0, 1.0, 3, 3)
    for scale in (1e-10, 1e-80, 1e-200, 5e-324):
        cloth = cg.Cloth((mesh.vertices * scale, mesh.faces))
        with pytest.raises(ValueError, match="rest"):
            cg.Simulation(cg.Scene((cloth,)))
    for shift in (1.1e9, 1e200):
        with pytest.raises(ValueError, match=r"vertices\[0, 1\] = .*out of range \[-1e\+09, 1e\+09\]"):
            cg.Cloth((mesh.vertices + np.array([0.0, shift, 0.0]), mesh.faces))
    for kept in (1e-8, 1e8):
        sim = cg.Simulation(cg.Scene((cg.Cloth((mesh.vertices * kept, mesh.faces)),)), light())
        sim.step(2)
        assert not not_finite(sim.metrics())


def test_geometry_beyond_what_can_be_squared_is_refused():
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0.5, 0.5, -1], [0.5, 0.5, 1], [3, 3, 0.3]], float)
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    for scale in (1e-9, 1.0, 1e9, 1e140):
        hits = cg.intersections(vertices * scale, faces)
        assert hits.hit_count == 2
        assert math.isfinite(hits.length) and not not_finite([hits.points, hits.gradient(), hits.segments])
    for asked in (cg.intersections, cg.untangle, lambda v, f: cg.proximities(v, f, 0.1)):
        with pytest.raises(ValueError, match=r"vertices\[1, 0\] = 2e\+160: out of range"):
            asked(vertices * 1e160, faces)


@pytest.mark.parametrize("gap", [0.0, 5e-324, 1e-300, 1e-20, 1e-12])
def test_vertices_that_all_but_coincide_give_no_infinite_strain(gap):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, gap, 0], [1.5, 0, 1]], float)
    faces = np.array([[0, 2, 1], [1, 3, 2], [3, 4, 2]])
    for fields in variants().values():
        scene = cg.Scene((cg.Cloth((vertices, faces), pins=(0,)),))
        sim = cg.Simulation(scene, cg.Fidelity(**{"sweeps": 2, "substeps": 0, **fields}))
        sim.step(2)
        assert not not_finite(sim.metrics()) and not not_finite(shown_arrays(sim))


def test_symplectic_euler_does_not_choose_endless_substeps():
    scene = cg.Scene((extremes.sheet(8, stretch=1e9, density=1e-6),))
    with pytest.raises(ValueError, match=rf"fidelity\.substeps = 0: .* more than {MOST_SUBSTEPS}"):
        cg.Simulation(scene, cg.Fidelity(integrator="symplectic_euler", substeps=0))


@pytest.mark.parametrize("contact", [False, True])
def test_a_promise_that_takes_minutes_a_step_is_refused(contact):
    scene = cg.Scene((extremes.sheet(8),), gravity=(0.0, -1e6, 0.0), step=10.0, self_collision=contact)
    with pytest.raises(ValueError, match=r"fidelity\.stretch_error = 0\.03: takes .* substeps in this scene"):
        cg.Simulation(scene)
    assert cg.Simulation(scene, cg.Fidelity(substeps=4)).pipeline.substeps == 4


def test_snapshots_that_were_tampered_with_are_refused():
    sim = inputs.simulation()
    at = sim.state_hash()
    for field, value in (
        ("held_vertices", np.array([99], np.int32)), ("held_by", np.array([7], np.int32)), ("held_by", np.zeros(3, np.int32)),
        ("velocities", np.zeros((3, 3))), ("held_offsets", np.zeros((0, 3))), ("time", "now"), ("time", math.inf),
    ):  # fmt: skip
        state = sim.snapshot()
        setattr(state, field, value)
        with pytest.raises(ValueError, match=r"^snapshot: "):
            sim.restore(state)
        assert sim.state_hash() == at
    for nothing in (3, None, {"positions": 1}):
        with pytest.raises(ValueError, match=r"^snapshot = "):
            sim.restore(nothing)


@pytest.mark.parametrize("bad", [1.5, -1, True, "1", None, HUGE, 1j])
def test_counts_of_steps_are_whole_numbers(bad):
    sim = inputs.simulation()
    at = sim.state_hash()
    with pytest.raises(ValueError, match=r"^count = "):
        sim.step(bad)
    assert sim.state_hash() == at
    sim.step(np.int64(1))
    assert sim.step_count == 3
