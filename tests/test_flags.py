"""Flags of states that cannot be trusted, and runs into divergence that never show a NaN."""

from __future__ import annotations

import dataclasses
import math
import pickle

import numpy as np
import pytest
from light_scenes import light, sheet_scene

import clothgym as cg
from clothgym import metrics
from clothgym.benchmarks.stability import extremes, inputs
from clothgym.benchmarks.stability.watch import not_finite, shown_arrays
from clothgym.model import ClothModel

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
