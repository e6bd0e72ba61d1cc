"""Extreme and impossible inputs: refused in one line that names the field, or taken; never a NaN that gets through."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import pickle

import clothgym_envs  # noqa: F401  registers the environments
import gymnasium as gym
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

import clothgym as cg
from clothgym import metrics
from clothgym.benchmarks.stability import extremes, inputs
from clothgym.benchmarks.stability.watch import not_finite, shown_arrays, variants
from clothgym.fidelity import INTEGRATORS, MOST_SUBSTEPS
from clothgym.model import ClothModel

PROPERTY = settings(
    max_examples=20, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)
HUGE = 10**400
LONGEST = 10**5000  # Python refuses to write it in decimal
STRANGE = [HUGE, LONGEST, 1j, "3", None, [1.0], np.array([1.0, 2.0]), {}, b"1", True, np.True_, 5e-324, -5e-324, 1e308]


def sheet_scene(**changes) -> cg.Scene:
    mesh = cg.grid(0.4, 0.4, 3, 3)
    return cg.Scene((cg.Cloth(mesh, pins=(0, 3)),), **({"grips": (cg.Grip(),)} | changes))


def light(integrator: str = "xpbd") -> cg.Fidelity:
    return cg.Fidelity(integrator=integrator, substeps=4 if integrator == "xpbd" else 0, sweeps=2)


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


# ---------------------------------------------------------------------------------------------------------------
# flags


def kinds(sim: cg.Simulation) -> list[str]:
    assert sim.metrics()["flags"] == sim.flags()
    return [flag.split()[0] for flag in sim.flags()]


def test_a_healthy_cloth_raises_no_flag():
    for name in ("hanging_sheet", "table_cloth"):
        sim = cg.Simulation(cg.scenes.make(name, resolution=8), "balanced")
        for _ in range(6):
            sim.step(5)
            assert sim.flags() == ()


def test_stretch_and_compression_are_flagged_at_half():
    sim = cg.Simulation(sheet_scene(), light())
    for factor, expected in ((1.49, []), (1.51, ["stretch"]), (0.51, []), (0.49, ["compression"]), (4.0, ["stretch"])):
        sim.set_positions(sim.scene.start * factor)
        assert kinds(sim) == expected
    assert sim.flags() == ("stretch 3 above 0.5",)


def test_speed_is_flagged_where_a_substep_crosses_an_edge():
    sim = cg.Simulation(sheet_scene(), light())
    crossing = sim.model.mean_edge / sim.pipeline.dt
    for share, expected in ((0.99, []), (1.01, ["speed"])):
        sim.set_velocities(np.tile([0.0, 0.0, share * crossing], (16, 1)))
        assert kinds(sim) == expected


def test_rounding_is_flagged_far_from_the_origin_and_for_tiny_steps():
    mesh = cg.grid(0.4, 0.4, 3, 3)

    def far(shift: float, step: float) -> list[str]:
        scene = cg.Scene((cg.Cloth((mesh.vertices + shift, mesh.faces)),), step=step)
        return kinds(cg.Simulation(scene, light()))

    assert far(0.0, 1 / 60) == far(1e6, 1 / 60) == []
    assert far(0.0, 1e-3) == []
    assert far(3e8, 1e-3) == ["rounding"]
    # gravity moves a vertex by g dt^2 = 6e-15 m in a substep, and coordinates of 0.5 m are 1e-16 m apart
    assert far(0.4, 1e-7) == ["rounding"]
    assert far(0.4, 1e-5) == []


def test_cloth_that_rounding_holds_in_the_air_is_flagged():
    """The reason for the flag: far out, gravity is lost between neighbouring numbers, and nothing else would tell."""
    mesh = cg.grid(0.4, 0.4, 3, 3)
    fallen = []
    for shift in (0.0, 9e8):
        scene = cg.Scene((cg.Cloth((mesh.vertices + shift, mesh.faces)),), self_collision=False, step=1e-5)
        sim = cg.Simulation(scene, cg.Fidelity(substeps=10))
        sim.step(20)
        fallen.append(float((scene.start - sim.positions)[:, 1].mean()))
    assert fallen[0] == pytest.approx(0.5 * 9.81 * 2e-4**2, rel=0.02)
    assert fallen[1] == 0.0
    assert kinds(sim) == ["rounding"]


def test_zones_that_hold_a_cloth_still_are_flagged():
    """Gravity so strong that contact can only keep layers apart by moving them as one."""
    sim = cg.Simulation(sheet_scene(gravity=(0.0, 1e6, 0.0)), light())
    sim.step(2)
    assert "zones" in kinds(sim)
    assert sim.metrics()["work"]["zoned"] > 0


def test_unproved_contact_is_flagged():
    sim = cg.Simulation(sheet_scene(), light())
    assert metrics.work_flags(sim.model, {"unproved": 2}, 4) == ("unproved 2 substeps of contact since reset",)
    share = int(metrics.ZONES * 16 * 100)
    assert metrics.work_flags(sim.model, {"zoned": share, "unproved": 0}, 100) == ()
    assert metrics.work_flags(sim.model, {"zoned": share + 1}, 100)[0].startswith("zones")


def test_a_solve_that_ends_so_early_that_cloth_hangs_in_the_air_is_flagged():
    scene = extremes.map_scene(1.0, 1e6)
    sim = cg.Simulation(scene, cg.Fidelity(integrator="implicit_euler", substeps=1))
    sim.step(10)
    fallen = float((scene.start - sim.positions)[:, 1].mean())
    assert fallen > 1e-3 and sim.flags() == ()
    sim = cg.Simulation(scene, cg.Fidelity(integrator="global", substeps=1))
    sim.step(10)
    assert abs((scene.start - sim.positions)[:, 1].mean()) < 0.05 * fallen
    assert "unbalanced" in kinds(sim)


def test_energy_out_of_nothing_is_flagged_and_given_energy_is_not():
    def moving(push, **changes) -> list[str]:
        sim = cg.Simulation(sheet_scene(**({"gravity": (0.0, 0.0, 0.0)} | changes)), light())
        sim.step()
        push(sim)
        assert pickle.loads(pickle.dumps(sim)).flags() == sim.flags()
        return kinds(sim)

    velocities = np.tile([0.0, 0.0, 0.5], (16, 1))

    def conjured(sim):  # what an unstable integrator would do
        sim._state.velocities[:] = velocities

    def held(sim):
        sim.grasp(0, [15])
        sim.step()
        conjured(sim)

    assert moving(conjured) == ["energy"]
    assert moving(lambda sim: sim.set_velocities(velocities)) == []
    assert moving(held) == []
    assert moving(conjured, wind=(0.0, 0.0, 1.0)) == []
    assert moving(lambda sim: sim.restore(sim.snapshot())) == []


def test_energy_flag_against_a_calculation_by_hand():
    scene = cg.Scene((cg.Cloth(cg.grid(0.4, 0.4, 3, 3)),), gravity=(0.0, -10.0, 0.0))
    sim = cg.Simulation(scene, light())
    model, start, x, v = sim.model, sim.snapshot(), scene.start, np.zeros((16, 3))
    mass = 0.15 * 0.16
    allowed = metrics.ENERGY * mass * 10.0 * 0.4 + 0.5 * mass * 0.01**2
    for share, raised in ((0.99, False), (1.01, True)):
        lift = np.array([0.0, share * allowed / (mass * 10.0), 0.0])
        assert bool(metrics.energy_flags(model, start, x + lift, v)) is raised
        speed = math.sqrt(2.0 * share * allowed / mass)
        assert bool(metrics.energy_flags(model, start, x, np.full((16, 3), speed / math.sqrt(3.0)))) is raised
    # falling turns height into motion: no flag
    fall = np.full(16, 20.0)[:, None] * np.array([0.0, -1.0, 0.0])
    assert metrics.energy_flags(model, start, x + fall, np.tile([0.0, -math.sqrt(2 * 10.0 * 20.0), 0.0], (16, 1))) == ()


# ---------------------------------------------------------------------------------------------------------------
# divergence


def test_forces_that_are_no_numbers_stop_the_run(monkeypatch):
    sim = inputs.simulation()
    before = sim.state_hash()
    run = sim.pipeline.run

    def broken(frame):
        result = run(frame)
        frame.grips.forces[0, 0] = math.nan
        return result or ("grips", frame.diverged())

    monkeypatch.setattr(sim.pipeline, "run", broken)
    with pytest.raises(cg.SimulationError, match="forces are no longer finite"):
        sim.step()
    assert sim.state_hash() == before
    assert not not_finite(shown_arrays(sim))


def test_no_run_into_divergence_shows_a_nan(tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    from clothgym.recording.rerun_log import RerunLog
    from clothgym.recording.rerun_read import read_recording

    # substeps too long for the springs: it blows up after a while
    scene = dataclasses.replace(inputs.simulation().scene, self_collision=False)
    limit = ClothModel(scene).safe_time_step()
    monkeypatch.setattr(ClothModel, "safe_time_step", lambda self: np.inf)
    few = int(scene.step / (2.5 * limit))
    sim = cg.Simulation(scene, cg.Fidelity(integrator="symplectic_euler", substeps=few, velocity_modification="none"))
    sim.set_velocities(np.random.default_rng(0).normal(0.0, 1.0, (16, 3)))
    with RerunLog(tmp_path / "run.rrd") as log:
        log.open_simulation(sim)
        log.log_simulation(0, sim, {k: v for k, v in sim.metrics().items() if isinstance(v, float)})
        with pytest.raises(cg.SimulationError):
            sim.step(100)
        assert not not_finite(sim.metrics())
        log.log_simulation(1000, sim)
        for bad in (math.nan, 1e39):  # float32 knows no 1e39
            with pytest.raises(ValueError, match=r"positions\[8, 1\] is"), np.errstate(over="ignore"):
                log.log_step(1001, 0.0, inputs._with(sim.positions, bad))
        with pytest.raises(ValueError, match=r"action\[1\] is nan"):
            log.log_action(1, 0.0, [0.0, math.nan])
    recording = read_recording(tmp_path / "run.rrd")
    for step in recording.steps:
        assert np.isfinite(recording.positions(int(step))).all()


@pytest.mark.parametrize("cells", [1, 2])
def test_a_membrane_torn_far_apart_comes_back(cells):
    """Shear is a product of two fibres: projected without a bound, one quad torn to five times its size diverged within
    the sweeps of a single substep."""
    side = 0.125 * cells
    mesh = cg.grid(side, side, cells, cells)
    cloth = cg.Cloth(mesh, cg.Material(stretch=1e3, shear=500.0, flexion=0.0))
    scene = cg.Scene((cloth,), self_collision=False, gravity=(0.0, 0.0, 0.0))
    sim = cg.Simulation(scene, cg.Fidelity(substeps=1, sweeps=32, membrane="continuum", bending="none"))
    for seed in range(12):
        sim.reset()
        sim.set_positions(scene.start + np.random.default_rng(seed).normal(0.0, 0.25, scene.start.shape))
        torn = sim.metrics()["max_strain"]
        sim.step()
        assert sim.metrics()["max_strain"] < 0.1 * torn


# ---------------------------------------------------------------------------------------------------------------
# environments


@pytest.fixture(scope="module", params=["clothgym/UntangleLayers-v0", "clothgym/DressRing-v0"])
def env(request):
    made = gym.make(request.param).unwrapped
    yield made
    made.close()


def test_actions_that_are_no_numbers_change_nothing(env):
    env.reset(seed=3)
    at, steps = env.simulation.state_hash(), env.steps
    shape = env.action_space.shape
    for bad in (
        np.full(shape, math.nan), np.where(np.arange(shape[0]) == 1, math.nan, 0.0), np.full(shape, "1"), np.full(shape, 1j),
        [None] * shape[0], "abc", None, math.nan, np.zeros(shape[0] + 1), [[0.0], [0.0, 1.0]], [HUGE] * shape[0],
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"^action") as error:
            env.step(bad)
        assert "\n" not in str(error.value)
        assert (env.simulation.state_hash(), env.steps) == (at, steps)
    _, reward, terminated, _, info = env.step(np.zeros(shape))
    assert math.isfinite(reward) and not terminated and info["degraded"] == 0


def test_actions_beyond_the_bounds_are_clipped_even_infinite_ones(env):
    signs = np.where(np.arange(env.action_space.shape[0]) % 2, 1.0, -1.0)
    hashes = set()
    for action in (signs, 1e300 * signs, math.inf * signs):
        env.reset(seed=3)
        observation, reward, *_, info = env.step(action)
        assert np.isfinite(observation).all() and math.isfinite(reward)
        assert not not_finite(info)
        hashes.add(env.simulation.state_hash())
    assert len(hashes) == 1


@pytest.mark.parametrize("where", ["values", "reward", "state"])
def test_a_nan_inside_an_environment_ends_the_episode_with_finite_numbers(env, monkeypatch, where):
    env.reset(seed=4)
    env.step(np.zeros(env.action_space.shape))
    before = env.simulation.state_hash()
    with monkeypatch.context() as patch:
        if where == "values":
            values, calls = env._values, []

            def broken():
                calls.append(1)
                out = values()
                return out | {"max_strain": math.nan} if len(calls) == 1 else out

            patch.setattr(env, "_values", broken)
        elif where == "reward":
            patch.setattr(env, "_judge", lambda action: ({"length": math.nan}, False))
        else:
            patch.setattr(env, "_act", lambda action: env.simulation._state.velocities.__setitem__((3, 1), math.nan))
        observation, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
    assert (terminated, truncated) == (True, False)
    assert info["failure"] in (1, 2)
    assert reward < -15.0 and math.isfinite(reward)
    assert env.observation_space.contains(observation)
    assert not not_finite(info)
    assert env.simulation.state_hash() == before


def test_environments_count_flags(env):
    env.reset(seed=5)
    *_, info = env.step(np.zeros(env.action_space.shape))
    assert info["degraded"] == 0 and type(info["degraded"]) is int
    env.simulation.set_velocities(np.tile([0.0, 400.0, 0.0], (env.simulation.model.vertex_count, 1)))
    assert env._info(False)["degraded"] == len(env.simulation.flags()) == 1


# ---------------------------------------------------------------------------------------------------------------
# random searches for a state that breaks an invariant

_NUMBER = st.floats(-5.0, 5.0) | st.sampled_from([1e-300, 5e-324, 1e6, -1e9])
_BAD = st.sampled_from([math.nan, math.inf, -math.inf, 1e10, "x", None])


class AnySequenceOfCalls(RuleBasedStateMachine):
    """Any calls in any order: the state stays finite, pins stay, refused calls change nothing, replays are exact."""

    @initialize(integrator=st.sampled_from(INTEGRATORS), seed=st.integers(0, 3))
    def begin(self, integrator, seed):
        self.make = lambda: cg.Simulation(sheet_scene(ground=-0.3), light(integrator))
        self.sim = self.make()
        self.pinned = self.sim.positions[[0, 3]].copy()
        self.calls: list = []
        self.kept = None

    def call(self, name, *args):
        self.calls.append((name, args))
        with contextlib.suppress(cg.SimulationError):
            getattr(self.sim, name)(*args)

    @rule(count=st.integers(1, 3))
    def step(self, count):
        self.call("step", count)

    @rule(seed=st.integers(0, 99), size=st.sampled_from([1e-9, 1e-3, 0.05, 1.0]))
    def push(self, seed, size):
        moved = self.sim.positions + np.random.default_rng(seed).normal(0.0, size, (16, 3))
        moved[[0, 3]] = self.pinned
        self.call("set_positions", moved)

    @rule(seed=st.integers(0, 99), size=st.sampled_from([1e-3, 1.0, 100.0, 1e5]))
    def throw(self, seed, size):
        self.call("set_velocities", np.random.default_rng(seed).normal(0.0, size, (16, 3)))

    @rule(place=st.tuples(_NUMBER, _NUMBER, _NUMBER))
    def place(self, place):
        self.call("place_grip", 0, place)

    @rule(velocity=st.tuples(_NUMBER, _NUMBER, _NUMBER))
    def move(self, velocity):
        self.call("move_grip", 0, velocity)

    @rule(vertices=st.lists(st.integers(0, 15), max_size=4))
    def grasp(self, vertices):
        self.call("grasp", 0, vertices)

    @rule()
    def release(self):
        self.call("release", 0)

    @rule()
    def keep(self):
        self.kept = (self.sim.snapshot(), self.sim.state_hash())

    @precondition(lambda self: self.kept is not None)
    @rule()
    def restore(self):
        self.call("restore", self.kept[0])
        assert self.sim.state_hash() == self.kept[1], "restore is not exact"

    @rule(
        bad=_BAD, name=st.sampled_from(["set_positions", "set_velocities", "place_grip", "move_grip", "grasp", "step"])
    )
    def refused(self, bad, name):
        at = self.sim.state_hash()
        given_ = {
            "set_positions": ([[bad] * 3] * 16,), "set_velocities": ([[bad] * 3] * 16,), "place_grip": (0, [bad] * 3),
            "move_grip": (0, [0.0, bad, 0.0]), "grasp": (0, [bad]), "step": (bad,),
        }[name]  # fmt: skip
        with pytest.raises(ValueError, match=r"^[a-z]+.*( is | = |expected)"):
            getattr(self.sim, name)(*given_)
        assert self.sim.state_hash() == at

    @invariant()
    def everything_shown_is_finite(self):
        if hasattr(self, "sim"):
            assert not not_finite(shown_arrays(self.sim))

    @invariant()
    def pins_stay(self):
        if hasattr(self, "sim"):
            assert (self.sim.positions[[0, 3]] == self.pinned).all()

    def teardown(self):
        if not hasattr(self, "sim"):
            return
        assert not not_finite(self.sim.metrics())
        again = self.make()
        for name, args in self.calls:
            with contextlib.suppress(cg.SimulationError):
                getattr(again, name)(*args)
        assert again.state_hash() == self.sim.state_hash(), "the same calls gave other bits"


def test_any_sequence_of_calls_keeps_the_invariants():
    run_state_machine_as_test(
        AnySequenceOfCalls,
        settings=settings(PROPERTY, max_examples=25, stateful_step_count=12),
    )


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_free_cloth_keeps_its_momentum(integrator):
    mesh = cg.grid(0.4, 0.4, 3, 3)
    material = cg.Material(stretch=1e3, shear=1e2, damping=0.0)
    scene = cg.Scene((cg.Cloth(mesh, material),), gravity=(0.0, 0.0, 0.0), self_collision=False)

    @PROPERTY
    @given(seed=st.integers(0, 10**6), size=st.floats(1e-6, 0.1), speed=st.floats(1e-3, 50.0))
    def keeps(seed, size, speed):
        rng = np.random.default_rng(seed)
        sim = cg.Simulation(scene, light(integrator))
        sim.set_positions(scene.start + rng.normal(0.0, size, (16, 3)))
        sim.set_velocities(rng.normal(0.0, speed, (16, 3)) + rng.normal(0.0, speed, 3))
        m, scale = sim.model.masses[:, None], float(sim.model.masses.sum() * speed)
        before = (m * sim.velocities).sum(axis=0)
        unsolved = 0.0
        try:
            for _ in range(3):
                sim.step()
                unsolved += sim._frame.unbalanced * scene.step * m.sum()
        except cg.SimulationError:
            return
        # an iterative solve that ends at its tolerance, or at its last iteration, leaves what it says
        iterative = integrator in ("implicit_euler", "global")
        assert iterative or unsolved == 0.0
        if iterative and sim.metrics()["work"].get("unconverged", 0) == 0:
            assert unsolved < sim.fidelity.tolerance * sim.time * m.sum()
        assert np.abs((m * sim.velocities).sum(axis=0) - before).max() < 1e-9 * max(scale, 1.0) + 1.001 * unsolved

    keeps()


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_restore_continues_with_the_same_bits(integrator):
    @settings(PROPERTY, max_examples=8)
    @given(seed=st.integers(0, 10**6), size=st.floats(1e-4, 0.1), before=st.integers(0, 3), after=st.integers(1, 3))
    def continues(seed, size, before, after):
        sim = cg.Simulation(sheet_scene(ground=-0.1), light(integrator))
        moved = sim.scene.start + np.random.default_rng(seed).normal(0.0, size, (16, 3))
        sim.set_positions(moved)
        sim.place_grip(0, moved[9])
        sim.grasp(0, [9, 10])
        sim.move_grip(0, (0.1, 0.5, -0.2))
        hashes = []
        try:
            sim.step(before)
            snapshot = sim.snapshot()
            for _ in range(2):
                sim.restore(snapshot)
                sim.step(after)
                hashes.append(sim.state_hash())
        except cg.SimulationError:
            return
        assert hashes[0] == hashes[1]

    continues()
