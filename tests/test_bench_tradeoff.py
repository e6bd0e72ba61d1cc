"""The benchmark of the trade-off: its front, its settings, what it measures, and its page."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym.benchmarks import features, frame, tradeoff
from clothgym.benchmarks.tradeoff import measure, pictures, show, strain
from clothgym.benchmarks.tradeoff.front import Point, beaten_by, front
from clothgym.benchmarks.tradeoff.settings import settings
from clothgym.benchmarks.tradeoff.subjects import SUBJECTS
from clothgym.fidelity import PRESETS

# Front


def naive_front(points: list[Point], error: int) -> set[str]:
    return {
        p.label
        for p in points
        if not any(
            q.cost <= p.cost
            and q.errors[error] <= p.errors[error]
            and (q.cost, q.errors[error]) != (p.cost, p.errors[error])
            for q in points
        )
    }


def test_front_equals_naive() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        points = [
            Point(str(n), *rng.integers(1, 12, 1).astype(float), (float(rng.integers(1, 12)),)) for n in range(15)
        ]
        distinct = list({(p.cost, p.errors): p for p in points}.values())
        assert {p.label for p in front(distinct, 0)} == naive_front(distinct, 0)


def test_a_point_is_beaten_in_all_errors_or_not_at_all() -> None:
    own = Point("own", 10.0, (1.0, 5.0))
    assert beaten_by(own, [own, Point("dear", 9.5, (0.5, 1.0))], (0.0, 0.0)) is None, "a tenth cheaper at least"
    assert beaten_by(own, [Point("one", 5.0, (0.5, 6.0))], (0.0, 0.0)) is None
    assert beaten_by(own, [Point("one", 5.0, (0.5, 6.0))], (0.0, 7.0)).label == "one", "the floor hides the difference"
    both = [Point("a", 5.0, (1.0, 5.0)), Point("b", 4.0, (1.04, 5.0))]
    assert beaten_by(own, both, (0.0, 0.0)).label == "b"


# Settings


@pytest.mark.parametrize("subject", SUBJECTS)
def test_settings_are_what_fidelity_accepts_and_have_names_of_their_own(subject: str) -> None:
    for quick in (True, False):
        chosen = settings(subject, quick)
        labels = [label for _, label, _ in chosen]
        assert len(set(labels)) == len(labels)
        assert labels[:3] == list(PRESETS)
        made = [
            dataclasses.replace(
                cg.Fidelity.preset(fields.get("base", "balanced")),
                **{key: value for key, value in fields.items() if key not in ("base", "finer")},
            )
            for _, _, fields in chosen
        ]
        assert [m for (group, _, _), m in zip(chosen, made) if group == "preset"] == list(PRESETS.values())
        for (group, label, _), fidelity in zip(chosen, made):
            if group == "field":
                assert fidelity not in PRESETS.values(), f"{label} changes nothing"


def test_targets_are_those_of_for_error() -> None:
    scene = cg.scenes.make("hanging_sheet", resolution=4)
    for group, label, fields in settings("sheet_16", False):
        if group == "target":
            expected = cg.Fidelity.for_error(scene, fields["stretch_error"])
            assert measure.fidelity_of(fields, scene) == expected, label


def test_finer_takes_so_many_times_the_substeps() -> None:
    scene = cg.scenes.make("hanging_sheet", resolution=4)
    own = cg.Simulation(scene, measure.fidelity_of({"integrator": "symplectic_euler"}, scene)).pipeline.substeps
    finer = measure.fidelity_of({"integrator": "symplectic_euler", "finer": 4}, scene)
    assert cg.Simulation(scene, finer).pipeline.substeps == 4 * own


# What is measured


def test_a_run_is_followed_by_formulas_of_its_own() -> None:
    scene = cg.scenes.make("hanging_sheet", resolution=4)
    found = measure.follow(cg.Simulation(scene), 0.2)
    sim = cg.Simulation(scene)
    heights, stretches = [], []
    edges = [(e, r) for e, r in zip(sim.model.surface.edges, sim.model.edge_rest) if r < 0.26]
    for _ in range(12):
        sim.step()
        x = sim.positions
        heights.append(sum(x[:, 1]) / len(x))
        stretches.append(max(np.linalg.norm(x[i] - x[j]) / r - 1.0 for (i, j), r in edges))
    assert found.heights == pytest.approx(heights, abs=1e-12)
    assert found.stretch == pytest.approx(stretches, abs=1e-12)
    assert found.ended is None and found.milliseconds > 0.0
    assert np.array_equal(found.positions[-1], sim.positions)


def test_distances_are_those_between_two_runs() -> None:
    found = measure.follow(cg.Simulation(cg.scenes.make("hanging_sheet", resolution=4)), 0.2)
    assert set(measure.distances(found, found, 12).values()) == {0.0}
    moved = found.positions.copy()
    moved[3:, :, 0] += 0.03
    moved[3:, :, 1] += 0.04
    other = dataclasses.replace(found, positions=moved, heights=found.heights + 0.04, stretch=found.stretch + 0.2)
    apart = measure.distances(other, found, 6)
    assert apart["rms_distance"] == pytest.approx(0.05 / np.sqrt(2.0))
    assert apart["max_distance"] == pytest.approx(0.05)
    assert apart["height_error"] == pytest.approx(0.04)
    assert apart["stretch_error"] == pytest.approx(0.2)
    assert measure.distances(other, found, 3)["rms_distance"] == 0.0, "nothing counts beyond the horizon"


def test_what_blows_up_says_when_and_has_no_distance() -> None:
    scene = cg.scenes.make("hanging_sheet", resolution=4)
    cloth = dataclasses.replace(scene.cloths[0], material=cg.Material(stretch=0.05, shear=0.05))
    found = measure.follow(cg.Simulation(dataclasses.replace(scene, cloths=(cloth,)), cg.Fidelity(substeps=8)), 2.0)
    assert found.ended is not None
    assert 0.1 < found.ended[0] < 2.0 and "as long as at rest" in found.ended[1]
    assert len(found.heights) == round(60 * found.ended[0])
    sound = measure.follow(cg.Simulation(scene), 0.2)
    assert set(measure.distances(found, sound, 12).values()) == {None}


def test_the_deepest_point_is_looked_for_inside_faces_too() -> None:
    """A triangle over a ball: its corners and its middle are outside, a point of its inner side is not."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    corners = np.array([[-0.4, 0.09, 0.0], [0.4, 0.09, 0.0], [0.0, 0.09, 2.0]])
    scene = cg.Scene([cg.Cloth((corners, np.array([[0, 1, 2]])))], bodies=[cg.Body(ball)], self_collision=False)
    sim = cg.Simulation(scene, cg.Fidelity(substeps=1))
    assert sim.penetration_depth() == 0.0
    deepest = measure.deepest_point(sim)
    # the points of the cut nearest to the axis lie 1/12 of the height from the side: at most 0.01 m deep
    assert deepest == 0.0 or deepest < 0.01
    near = corners * [0.2, 1.0, 0.05]
    sim.set_positions(near)
    assert measure.deepest_point(sim) == pytest.approx(0.01, abs=2e-3)
    assert measure.deepest_point(cg.Simulation(cg.scenes.make("hanging_sheet", resolution=2))) == 0.0


def test_memory_grows_with_the_sheet() -> None:
    small, large = (
        measure.memory(cg.scenes.make("hanging_sheet", resolution=n), cg.Fidelity(substeps=1)) for n in (8, 32)
    )
    assert 0.01 < small < 0.2 * large < 2.0


# Strain limiting


def test_an_arm_is_run_as_the_library_would() -> None:
    scene, chosen = strain.scene("side", 16.0), strain.fidelity("(a) springs x 16")
    sim = cg.Simulation(scene, chosen)
    found = strain.hang(scene, chosen, sim.pipeline.substeps, 0.5)
    start = sim.positions[:, 1].mean()
    sim.step(30)
    assert found["drop"] == pytest.approx(start - sim.positions[:, 1].mean(), abs=1e-15)
    # Hooke: the cloth's weight over the stiffness of both kinds of springs, at the side that holds it
    assert found["end"] == pytest.approx(0.15 * 9.81 / (16.0 * strain.SOFT * 1.5), rel=0.7)


def test_the_largest_step_lies_about_the_known_bound() -> None:
    scene, chosen = strain.scene("side", 16.0), strain.fidelity("(a) springs x 16")
    limit = cg.Simulation(scene, chosen).model.safe_time_step()
    fine = strain.hang(scene, chosen, 64, 1.0)
    assert 0.95 * limit < strain.largest_step(scene, chosen, limit, fine) < 1.6 * limit


def test_what_the_paper_says_of_its_arms_in_numbers() -> None:
    """Position modification holds the limit where the stretch is global, velocity modification only nearly."""
    ends = {}
    for arm in ("soft springs", "(b) position, 4 sweeps", "(c) velocity, relative"):
        scene, chosen = strain.scene("side"), strain.fidelity(arm)
        ends[arm] = strain.hang(scene, chosen, cg.Simulation(scene, chosen).pipeline.substeps, 3.0)["end"]
    assert ends["soft springs"] > 0.15
    assert ends["(b) position, 4 sweeps"] == pytest.approx(strain.LIMIT, abs=1e-3)
    assert strain.LIMIT < ends["(c) velocity, relative"] < 0.2


# Features


@pytest.mark.parametrize("base", features.BASES)
def test_every_feature_changes_the_scene_or_how_it_is_modelled(base: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(features, "CELLS", 4)
    for name, (beside, _) in features.BASES[base].items():
        (scene, fidelity), (other, modelled) = features.setting(base, beside), features.setting(base, name)
        assert fidelity != modelled or scene.to_json() != other.to_json(), name


def test_cost_of_a_feature(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(features, "CELLS", 4)
    monkeypatch.setattr(features, "FRAMES", 4)
    result = features.run({"kind": "feature", "base": "hanging", "name": "wind"})
    assert result["new_stages"] == ["wind"] and result["times"] > 0.0
    scene = features.run({"kind": "scene", "name": "pile"})
    assert scene["stages"][0] == "face pairs" and scene["ms"] > 0.0
    rows = [
        {"parameters": {"kind": "feature", "base": "hanging", "name": "wind"}, "result": result},
        {"parameters": {"kind": "scene", "name": "pile"}, "result": scene},
    ]
    assert [table.title.split(",")[0] for table in features.tables(rows)] == [
        "Scenes and what they are assembled from", "Cost of each feature",
    ]  # fmt: skip


def test_cases_have_keys_of_their_own() -> None:
    for benchmark in (tradeoff.benchmark, features.benchmark):
        for quick in (True, False):
            heads = frame.plan(benchmark, quick)
            assert len({head["key"] for head in heads}) == len(heads)


# Page


def test_tables_and_pictures_of_a_small_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = dataclasses.replace(
        SUBJECTS["sheet_16"],
        make=lambda: cg.scenes.make("hanging_sheet", resolution=4),
        seconds=0.3,
        horizon=0.2,
        check={"substeps": 64, "sweeps": 1},
    )
    monkeypatch.setitem(SUBJECTS, "sheet_16", small)
    for cached in (measure.scene_of, measure._converged):
        cached.cache_clear()

    def few(quick: bool) -> list[frame.Case]:
        wanted = (
            "draft",
            "balanced",
            "accurate",
            "symplectic_euler",
            "runge_kutta",
            "implicit_euler 1, 1",
            "global, 1 x 5",
        )
        found = [case for case in tradeoff.cases(True) if case.parameters.get("subject") == "sheet_16"]
        runs = [case for case in found if case.parameters.get("label", "draft") in wanted]
        runs = [case for case in runs if case.parameters.get("membrane", "springs") == "springs"]
        runs = [case for case in runs if case.parameters.get("bending", "flexion") == "flexion"]
        runs = [
            frame.Case(c.key, {**c.parameters, "checked": True}) if c.parameters["kind"] == "reference" else c
            for c in runs
        ]
        exploding = {"kind": "run", "subject": "sheet_16", "group": "solver", "label": "refused"}
        exploding["fields"] = {"integrator": "symplectic_euler", "substeps": 1}
        arms = [case for case in tradeoff.cases(True) if "(b) position, 1 sweep" in case.key]
        return [*runs, frame.Case("run/refused", exploding), *arms]

    benchmark = frame.Benchmark("tradeoff", "t", few, tradeoff.run, show.tables, pictures.plots)
    try:
        outcome = frame.run_benchmark(benchmark, tmp_path, quick=True)
    finally:
        for cached in (measure.scene_of, measure._converged):
            cached.cache_clear()
    assert outcome.error_count == 0, [row.get("error") for row in outcome.rows]
    titles = [table.title for table in outcome.tables]
    assert titles[0] == "Presets and targets"
    assert {"Front: sheet_16", "References", "Runge-Kutta beside symplectic Euler", "Every run: sheet_16"} <= set(
        titles
    )
    uncertain = next(table for table in outcome.tables if table.title == "References").rows[0][6:]
    assert all(0.0 < value < 50.0 for value in uncertain), "another method must be near, and cannot be the same"
    explicit = next(table for table in outcome.tables if table.title.startswith("Runge-Kutta"))
    per_substep = {row[1]: row[5] for row in explicit.rows}
    assert per_substep["symplectic_euler"] == 1.0 and per_substep["runge_kutta"] > 1.0
    every = next(table for table in outcome.tables if table.title == "Every run: sheet_16")
    assert "exceeds the stability limit" in next(row for row in every.rows if row[1] == "refused")[-1]
    for picture in ("tradeoff_sheet_16.png", "tradeoff_strain.png"):
        assert (tmp_path / picture).stat().st_size > 20_000
