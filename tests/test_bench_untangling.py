"""The benchmark of untangling: what it measures, and how it judges and shows it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import clothgym as cg
from clothgym.benchmarks import frame, untangling
from clothgym.benchmarks.report import json_ready

SMALL = {"scene": "squares", "seed": 3, "steps": 4, "count": 5, "box": 0.6, "cells": 5}


def _tiny(quick: bool) -> list[frame.Case]:
    squares = [
        frame.Case(f"squares/{strategy}", {**SMALL, "strategy": strategy}) for strategy in untangling.STRATEGIES[1:]
    ]
    return [*squares, frame.Case("pile", {"scene": "pile", "strategy": "none", "seed": 0, "steps": 2, "count": 2})]


@pytest.mark.parametrize("quick", [True, False])
def test_cases_are_every_strategy_at_every_seed_and_the_control(quick: bool) -> None:
    listed = untangling.cases(quick)
    assert len({case.key for case in listed}) == len(listed)
    squares = [case.parameters for case in listed if case.parameters["scene"] == "squares"]
    seeds = 2 if quick else 10
    assert {(p["strategy"], p["seed"]) for p in squares} == {
        (strategy, seed) for strategy in ("none", "local", "global", "hybrid") for seed in range(seeds)
    }
    lasting = {p["steps"] for p in squares if p["strategy"] in ("global", "hybrid")}
    assert lasting == {40 if quick else 330}  # until clean, and 300 steps on
    assert {p["steps"] for p in squares if p["strategy"] in ("none", "local")} == {40 if quick else 100}
    pile = [case.parameters for case in listed if case.parameters["scene"] == "pile"]
    assert pile
    assert all(p["strategy"] == "none" for p in pile)
    for case in listed:  # every parameter is one that the scene takes
        scene = {k: v for k, v in case.parameters.items() if k not in ("scene", "strategy", "steps")}
        known = {parameter.name for parameter in cg.scenes.describe(case.parameters["scene"]).parameters}
        assert set(scene) <= known
    if not quick:
        start = cg.Simulation(cg.scenes.make("squares", seed=0, count=squares[0]["count"]), cg.Fidelity()).metrics()
        assert start["contour_count"] > 100  # the paper: more than hundred contours, roughly 2000 hits
        assert start["hits"] > 2000


def test_a_case_measures_what_an_own_simulation_shows() -> None:
    result = untangling.run({**SMALL, "strategy": "global"})
    simulation = cg.Simulation(
        cg.scenes.make("squares", seed=3, count=5, box=0.6, cells=5), cg.Fidelity(untangling="global")
    )
    hits, lengths, strains = [], [], []
    for step in range(5):
        if step:
            simulation.step()
        found = cg.intersections(simulation.positions, simulation.faces)
        hits.append(found.hit_count)
        lengths.append(found.length)
        strains.append(simulation.metrics()["max_strain"])
    assert result["history"]["hits"] == hits
    assert result["history"]["length"] == pytest.approx(lengths, rel=1e-12)
    assert hits[0] > 20
    assert min(hits[1:]) < hits[0]  # the strategy did something
    assert result["start"] == {"hits": hits[0], "contours": found_contours(SMALL), "length": lengths[0]}
    assert result["end"]["hits"] == hits[-1]
    assert result["strain_until_clean"] <= max(strains)
    assert result["untangling_passes"] >= 1
    assert result["step_seconds"] > 0.0
    assert 0.0 < result["untangling_share"] < 1.0
    assert result["failure"] == ""
    again = untangling.run({**SMALL, "strategy": "global"})
    assert again["history"] == result["history"]
    json.dumps(json_ready(result), allow_nan=False)


def found_contours(parameters: dict[str, Any]) -> int:
    settings = {k: v for k, v in parameters.items() if k not in ("scene", "steps")}
    scene = cg.scenes.make("squares", **settings)
    return cg.Simulation(scene, "draft").last_intersections.contour_count


def test_judge_reads_histories() -> None:
    hits = [9, 4, 0, 0, 3, 5, 0] + [0] * 40
    lengths = [2.0, 1.0, 0.0, 0.0, 0.5, 0.6, 0.0] + [0.0] * 40
    strains = [0.0, 0.4, 0.2] + [0.1] * 29 + [0.03] * 15
    judged = untangling.judge(hits, lengths, strains)
    assert judged["first_clean_step"] == 2
    assert (judged["returns"], judged["returning_steps"]) == (5, 2)
    assert judged["length_ratio"] == {"5": 0.3, "10": 0.0, "15": 0.0, "30": 0.0}
    assert judged["strain_until_clean"] == 0.4
    assert judged["strain_later"] == 0.03  # from step 32 on

    never = untangling.judge([5, 4, 3], [1.0, 0.8, 0.6], [0.1, 0.2, 0.3])
    assert never["first_clean_step"] is None
    assert never["returns"] is None
    assert never["length_ratio"] == {"5": None, "10": None, "15": None, "30": None}
    assert never["strain_until_clean"] == 0.3
    assert never["strain_later"] is None

    clean = untangling.judge([0, 0, 7], [0.0, 0.0, 0.1], [0.0, 0.1, 0.2])
    assert clean["first_clean_step"] == 0
    assert clean["returns"] == 7


def test_quantiles_count_never_as_infinite() -> None:
    steps = [12, None, 10, 14, None, 11, 13, 15, 16, 17]
    assert untangling._quantile(steps, 0.5) == 14
    assert untangling._quantile(steps, 0.8) == 17
    assert untangling._quantile(steps, 0.9) is None
    assert untangling._quantile([None], 0.5) is None


def _row(strategy: str, seed: int, hits: list[int], failure: str = "", scene: str = "squares") -> dict[str, Any]:
    lengths = [0.1 * count for count in hits]
    history = {"hits": hits, "contours": [count // 4 for count in hits], "length": lengths}
    return {
        "seed": seed,
        "parameters": {"scene": scene, "strategy": strategy, "seed": seed, "steps": len(hits) - 1, "count": 25},
        "result": {
            "start": {key: values[0] for key, values in history.items()},
            "end": {key: values[-1] for key, values in history.items()},
            "history": history,
            **untangling.judge(hits, lengths, [0.02] * len(hits)),
            "failure": failure,
            "untangling_passes": 3,
            "work": {"box_pairs": 100},
            "step_seconds": 0.1,
            "untangling_share": 0.02,
        },
    }


def test_tables_say_who_got_clean_and_who_did_not(tmp_path: Path) -> None:
    rows = [
        _row("none", 0, [2000] * 41),
        _row("none", 1, [2400] * 41),
        _row("global", 0, [2000, 300] + [0] * 39),
        _row("global", 1, [2400, 900, 30] + [0] * 30 + [6] * 8),
        _row("hybrid", 0, [2000, 100], failure="xpbd: a speed passed the cap"),
        _row("none", 0, [0] * 300, scene="pile"),
    ]
    start, result, cost, control = untangling.tables(json.loads(json.dumps(json_ready(rows))))
    assert tuple(start.rows[0][1:4]) == (2000, 2200, 2400)
    by_name = {cells[0]: dict(zip(result.columns, cells)) for cells in result.rows}
    assert set(by_name) == {"none", "global", "hybrid"}
    assert by_name["none"]["share clean by 30"] == 0.0
    assert by_name["none"]["first clean step, median"] is None
    assert by_name["none"]["L/L0 at 10"] == 1.0
    assert "without any improvement" in by_name["none"]["paper"]
    assert by_name["global"]["share clean by 30"] == 1.0
    assert (by_name["global"]["first clean step, median"], by_name["global"]["p90"]) == (2, 3)
    assert by_name["global"]["seeds with returns"] == 1
    assert by_name["global"]["most hits after"] == 6
    assert by_name["hybrid"]["diverged"] == 1
    assert cost.rows[0][1] == 0.1
    assert control.rows[0][2:5] == (299, 0, 0)
    pytest.importorskip("matplotlib")
    for path in untangling.plots(rows, tmp_path):
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size > 10_000
    table = untangling._histories([row["result"] for row in rows[2:5]], "hits")
    assert table.shape == (3, 41)
    assert np.isnan(table[2, 2:]).all()  # nothing is drawn after a run diverged
    assert untangling.plots(rows[-1:], tmp_path) == []
    assert len(untangling.tables(rows[-1:])) == 1


def test_a_diverged_run_is_a_result_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    step = cg.Simulation.step

    def breaking(self: cg.Simulation, count: int = 1) -> None:
        if self.step_count == 2:
            raise cg.SimulationError("xpbd", "positions are no longer finite", self.time, "take more substeps")
        step(self, count)

    monkeypatch.setattr(cg.Simulation, "step", breaking)
    result = untangling.run({**SMALL, "strategy": "none"})
    assert len(result["history"]["hits"]) == 3
    assert "no longer finite" in result["failure"]


def test_rows_tables_plots_and_page_come_out_of_the_frame(tmp_path: Path) -> None:
    assert frame.load("untangling") is untangling.benchmark
    small = dataclasses.replace(untangling.benchmark, cases=_tiny, prepare=None)
    outcome = frame.run_benchmark(small, tmp_path, quick=True)
    assert outcome.error_count == 0
    assert [row["seed"] for row in outcome.rows] == [3, 3, 3, 0]
    assert [table.title.split(":")[0] for table in outcome.tables] == [
        "Start",
        "Untangling, by strategy",
        "Cost",
        "Control",
    ]
    assert outcome.rows[-1]["result"]["history"]["hits"] == [0, 0, 0]
    page = outcome.page.read_text()
    assert "roughly 2000" in page
    assert page.count("<img") == 2 or "No plots" in page
