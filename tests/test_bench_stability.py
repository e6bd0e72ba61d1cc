"""The benchmark of stability: what it watches, how it judges, what it predicts, and that nothing gets past it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import clothgym as cg
from clothgym import fidelity
from clothgym.benchmarks import frame, stability
from clothgym.benchmarks.report import json_ready
from clothgym.benchmarks.stability import extremes, inputs, limits, show, watch
from clothgym.model import ClothModel

XPBD = {"integrator": "xpbd"}


@pytest.mark.parametrize("quick", [True, False])
def test_cases_cover_every_integrator_and_quantity(quick: bool) -> None:
    listed = stability.cases(quick)
    assert len({case.key for case in listed}) == len(listed)
    kinds = {
        kind: [c.parameters for c in listed if c.parameters["kind"] == kind] for kind in ("map", "extreme", "limit")
    }
    for integrator in fidelity.INTEGRATORS:
        mapped = [p for p in kinds["map"] if p["variant"] == integrator]
        assert {p["step"] for p in mapped} >= {1.0, 64.0}
        assert {p["stiffness"] for p in mapped} >= {1e-3, 1.0, 1e6}
        asked = {(p["name"], p["value"]) for p in kinds["extreme"] if p["variant"] == integrator}
        assert {name for name, _ in asked} == set(extremes.EXTREMES)
        for name, least in (
            ("gripper speed", 100.0),
            ("mass ratio of layers", 1e4),
            ("gravity", 100.0),
            ("slivers", 1e3),
        ):
            assert (name, least) in asked
        if not quick:
            assert {value for name, value in asked if name == "size"} >= {1e-6}
            assert {value for name, value in asked if name == "distance from the origin"} >= {1e6}
    assert {p["modification"] for p in kinds["limit"]} == {"none", "literal", "relative"}
    assert {p["grid"] for p in kinds["limit"]} >= {"1, 0, 0", "1, 1, 1"}
    assert {c.key for c in listed if c.key.startswith("input/")} == {
        f"input/{n}" for n in (*inputs.MADE, *inputs.GIVEN)
    }


def test_variants_follow_the_choices_of_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    found = watch.variants()
    assert set(found) >= {*fidelity.INTEGRATORS, "symplectic_euler literal", "symplectic_euler relative"}
    for fields in found.values():
        assert fields == {k: v for k, v in json.loads(fidelity.Fidelity(**fields).to_json()).items() if k in fields}
    monkeypatch.setattr(fidelity, "INTEGRATORS", ("xpbd",))
    assert all(fields["integrator"] == "xpbd" for fields in watch.variants().values())


# Runs


def test_a_run_is_judged_by_its_peaks_and_says_what_the_library_said() -> None:
    calm = stability.run({"kind": "map", "fields": XPBD, "step": 1.0, "stiffness": 10.0, "steps": 30})
    assert (calm["outcome"], calm["flags"], calm["wrong"], calm["silent"], calm["not_finite"]) == (
        "stable",
        [],
        [],
        [],
        [],
    )
    assert calm["fell"] > 0.5
    assert calm["dt"] == pytest.approx(1.0 / 480.0)
    torn = stability.run({"kind": "map", "fields": XPBD, "step": 64.0, "stiffness": 1e6, "steps": 10})
    assert torn["outcome"] == "degraded"
    assert "stretch" in torn["flags"] and "stretch" in torn["wrong"] and torn["silent"] == []
    assert torn["peaks"]["stretch"] > 0.5
    refused = stability.run(
        {"kind": "map", "fields": {"integrator": "symplectic_euler"}, "step": 64.0, "stiffness": 1e6, "steps": 2}
    )
    assert refused["outcome"] == "refused"
    assert "stability limit" in refused["error"]
    assert refused["limit"] < refused["dt"]
    json.dumps(json_ready([calm, torn, refused]), allow_nan=False)


def test_peaks_are_those_of_the_whole_run_not_of_its_end() -> None:
    scene = cg.Scene((extremes.sheet(4, stretch=100.0, damping=20.0),), gravity=(0.0, 0.0, 0.0))

    def stretched(simulation: cg.Simulation) -> None:
        simulation.set_positions(simulation.scene.start * np.array([1.0, 1.0, 1.8]))

    kept = []

    def make() -> cg.Simulation:
        kept.append(cg.Simulation(scene, cg.Fidelity(substeps=4)))
        return kept[0]

    result = watch.run(make, 60, stretched, worked=True)
    assert result["peaks"]["stretch"] >= 0.8
    assert kept[0].metrics()["max_strain"] < 0.5
    assert kept[0].flags() == ()
    assert result["outcome"] == "degraded" and "stretch" in result["flags"]


def test_a_run_that_diverges_is_stopped_and_keeps_its_last_state() -> None:
    scene = cg.Scene((extremes.sheet(4),), self_collision=False)

    def shot(simulation: cg.Simulation) -> None:
        simulation.set_velocities(np.full((25, 3), 1e5))

    result = watch.run(lambda: cg.Simulation(scene, cg.Fidelity(substeps=2)), 5, shot)
    assert result["outcome"] == "stopped"
    assert result["error"].startswith("SimulationError: a speed of")
    assert (result["not_finite"], result["steps"]) == ([], 0)


def test_what_the_library_does_not_say_is_called_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cg.Simulation, "flags", lambda self: ())
    torn = stability.run({"kind": "map", "fields": XPBD, "step": 64.0, "stiffness": 1e6, "steps": 10})
    assert (torn["outcome"], torn["flags"]) == ("degraded", [])
    assert "stretch" in torn["silent"]


def test_a_cloth_that_does_not_fall_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = extremes.map_scene(1.0, 1.0)
    run = cg.Simulation.step

    def frozen(self: cg.Simulation, count: int = 1) -> None:
        run(self, count)
        self._state.positions[:] = scene.start

    monkeypatch.setattr(cg.Simulation, "step", frozen)
    result = watch.run(lambda: cg.Simulation(scene, cg.Fidelity(substeps=1)), 30, falls=True)
    assert result["silent"] == ["frozen"]


def test_a_nan_that_gets_through_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    metrics = cg.Simulation.metrics
    monkeypatch.setattr(
        cg.Simulation, "metrics", lambda self: metrics(self) | {"work": {"a": 1}, "kinetic_energy": math.nan}
    )
    result = stability.run({"kind": "map", "fields": XPBD, "step": 1.0, "stiffness": 1.0, "steps": 2})
    assert result["not_finite"] == ["kinetic_energy"]
    assert watch.not_finite({"a": [1.0, (math.inf, 2)], "b": np.array([np.nan]), "c": "x", "d": np.float32("nan")}) == [
        "a[1][0]",
        "b",
        "d",
    ]


@pytest.mark.parametrize("name", list(extremes.EXTREMES))
def test_every_extreme_ends_without_a_nan_and_without_silence(name: str) -> None:
    extreme = extremes.EXTREMES[name]
    for value in (extreme.values[0], extreme.values[-1]):
        result = stability.run(
            {"kind": "extreme", "fields": XPBD, "name": name, "value": value, "steps": 3, "budget": 100}
        )
        assert result["outcome"] in watch.OUTCOMES
        assert (result["not_finite"], result["silent"]) == ([], []), (value, result)


def test_extremes_are_as_extreme_as_they_say() -> None:
    def model(name: str, value: float) -> ClothModel:
        return ClothModel(extremes.EXTREMES[name].build(value))

    masses = model("mass ratio of layers", 1e4).masses
    assert masses.max() / masses.min() > 5e3
    graded = extremes.EXTREMES["mass ratio of neighbours"].build(1e4).cloths[0].mesh
    area = cg.mesh.face_areas(graded.vertices, graded.faces)
    assert area.max() / area.min() == pytest.approx(1e4, rel=0.01)
    sliver = extremes.EXTREMES["slivers"].build(1e3).cloths[0].mesh
    sides = np.ptp(sliver.vertices[sliver.faces], axis=1)
    assert (sides[:, 0] / sides[:, 2]).min() == pytest.approx(1e3)
    flat = extremes.EXTREMES["faces without area"].build(30.0).cloths[0].mesh
    area = cg.mesh.face_areas(flat.vertices, flat.faces)
    assert (area == 0.0).sum() >= 0.3 * 128
    assert area.sum() == pytest.approx(1.0)
    assert cg.intersections(flat.vertices, flat.faces).hit_count == 0
    layers = extremes.EXTREMES["coincident layers"].build(4).cloths
    assert len(layers) == 4 and all((c.mesh.vertices == layers[0].mesh.vertices).all() for c in layers)
    assert len(model("faces given several times", 3).faces) == 3 * 128


# Limits


@pytest.mark.parametrize("grid", list(limits.GRIDS))
def test_the_table_of_endless_grids_follows_from_a_large_grid(grid: str) -> None:
    """Rayleigh quotient of the wave with the highest frequency the table has, on a grid with periodic sides."""
    (structural, shear, flexion), table = limits.GRIDS[grid]
    largest = 0.0
    waves = np.linspace(0.0, math.pi, 181)
    for p in waves:
        q = waves
        # in-plane block of the dynamical matrix of a square lattice with nearest, diagonal and skip-one springs
        d11 = (
            2 * structural * (1 - np.cos(p))
            + 2 * flexion * (1 - np.cos(2 * p))
            + 2 * shear * (1 - np.cos(p) * np.cos(q))
        )
        d22 = (
            2 * structural * (1 - np.cos(q))
            + 2 * flexion * (1 - np.cos(2 * q))
            + 2 * shear * (1 - np.cos(p) * np.cos(q))
        )
        d12 = 2 * shear * np.sin(p) * np.sin(q)
        half = 0.5 * (d11 + d22) + np.sqrt(0.25 * (d11 - d22) ** 2 + d12**2)
        largest = max(largest, float(half.max()))
    assert largest == pytest.approx(table, rel=2e-3)


@pytest.mark.parametrize("damping", [0.0, 0.7])
def test_measured_limit_is_the_exact_one_and_damping_lowers_it(damping: float) -> None:
    result = limits.run("1, 1, 1", 1e-6, "none", damping, "symplectic_euler")
    assert result["quiet"] == pytest.approx(result["exact"], rel=0.01)
    assert result["gershgorin"] < result["exact"] < result["paper"]
    assert result["exact"] == pytest.approx(result["endless"], rel=0.03)
    if damping:
        assert result["exact"] < 0.95 * limits.run("1, 1, 1", 1e-6, "none", 0.0, "symplectic_euler")["exact"]


def test_the_papers_bound_lies_beyond_the_limit_with_every_modification() -> None:
    for modification in ("none", "literal", "relative"):
        result = limits.run("1, 1, 1", 0.2, modification, 0.0, "symplectic_euler")
        assert result["quiet"] < 0.6 * limits.PAPER


def test_literal_modification_has_no_safe_step_at_large_amplitude_and_relative_has() -> None:
    """A spring that may neither stretch nor shrink along itself still lengthens when its ends move across it: what is
    over-stretched creeps on. The relative variant lets it shrink again."""
    strains = {
        m: limits.run("1, 0, 0", 0.2, m, 0.0, "symplectic_euler")["long_strain"] for m in ("literal", "relative")
    }
    assert strains["literal"] is None or strains["literal"] > 3.0
    assert strains["relative"] < 0.7


# Page


def test_tables_and_plots_of_a_small_run(tmp_path: Path) -> None:
    def few(quick: bool) -> list[frame.Case]:
        chosen: tuple[str, ...] = (
            "map/xpbd/dt1/k1",
            "map/xpbd/dt64/k1",
            "map/symplectic_euler/dt8/k1",
            "extreme/xpbd/size",
            "input/step",
        )
        return [case for case in stability.cases(True) if case.key.startswith(chosen)] + [
            frame.Case(
                f"limit/{m}",
                {"kind": "limit", "integrator": "symplectic_euler", "damping": 0.0, "grid": "1, 0, 0"}
                | {"amplitude": 0.2, "modification": m},
            )
            for m in ("none", "literal")
        ]

    small = frame.Benchmark("stability", "t", few, stability.run, show.tables, show.plots)
    outcome = frame.run_benchmark(small, tmp_path, quick=True)
    assert outcome.error_count == 0
    titles = [table.title for table in outcome.tables]
    assert len(titles) == 5 and titles[0] == "Outcomes"
    totals = {(row[0], row[1]): row[2:6] for row in outcome.tables[0].rows}
    assert tuple(totals["map", "xpbd"]) == (3, 3, 0, 0)  # k1, k1000 and k1e+06 at either step
    assert totals["map", "symplectic_euler"][3] == 3
    for picture in ("stability_map.png", "stability_limits.png"):
        assert (tmp_path / picture).stat().st_size > 10_000
    assert "stability_map" in outcome.page.read_text() or "data:image/png" in outcome.page.read_text()
