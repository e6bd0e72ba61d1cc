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
from clothgym.benchmarks import papers as papers_bench
from clothgym.benchmarks.report import json_ready
from clothgym.benchmarks.untangling import instances, overhead, show, squares
from clothgym.benchmarks.untangling.measure import quantile
from clothgym.response.untangling import Corrections, names
from clothgym.scenes.canonical import KINDS, draw

SETTINGS = {"count": 5, "box": 0.6, "cells": 5}
SMALL = {"part": "squares", "scene": "squares", "settings": SETTINGS, "seed": 3, "steps": 4, "control": 0}
DENT = {"kind": "Closed", "depth": 1.0, "resolution": 10}
FEW = {"part": "canonical", "tangle": "canonical", "settings": DENT, "strategy": "hybrid", "fields": {}, "seed": 0, "count": 2,
       "budget": 20, "later": 0, "followed": 0}  # fmt: skip


class Still:
    """A strategy of a user's own, that does nothing."""

    def propose(self, context: Any) -> Corrections:
        return Corrections(np.zeros_like(context.intersections.vertices))


def _tiny(quick: bool) -> list[frame.Case]:
    pile = {
        "part": "pile",
        "scene": "pile",
        "settings": {"count": 2},
        "strategy": "none",
        "seed": 0,
        "steps": 2,
        "control": 0,
    }
    cost = {"part": "overhead", "scene": "squares", "settings": SETTINGS, "strategy": "global", "seed": 0, "steps": 0}
    ribbon = {"part": "dish", "settings": {"length": 0.7}, "strategy": "local", "fields": {}, "seed": 0, "steps": 2}
    faulty = {"part": "faults", "settings": {"cells": 4, "layers": 2}, "fields": {}, "seed": 0, "steps": 3}
    null = {"part": "null", "tangle": "canonical", "settings": DENT, "seed": 0}
    return [
        *(frame.Case(f"squares/{strategy}", {**SMALL, "strategy": strategy}) for strategy in ("local", "global")),
        frame.Case("pile", pile),
        frame.Case("canonical/Closed/1/hybrid", FEW),
        frame.Case("many/Closed/1/hybrid", {**FEW, "part": "many"}),
        frame.Case(
            "regions/1/v=0/local", {**FEW, "part": "regions", "strategy": "local", "fields": {"velocity_share": 0.0}}
        ),
        frame.Case("resolution/Closed/10/hybrid", {**FEW, "part": "resolution"}),
        frame.Case("others/dent/hybrid", {**FEW, "part": "others"}),
        frame.Case("map/a/hybrid", {**FEW, "part": "map", "fields": {"h0": 0.5, "velocity_share": 1.0}, "count": 1}),
        frame.Case("progress/Closed/at once/hybrid", {**FEW, "part": "progress", "fields": {"untangling_passes": 20}}),
        frame.Case("null/Closed", null),
        *(frame.Case(f"faults/{s}", {**faulty, "strategy": s}) for s in ("none", "local")),
        frame.Case("dish/local", ribbon),
        frame.Case("overhead/tangled", {**cost, "repeats": 1}),
    ]


@pytest.mark.parametrize("quick", [True, False])
def test_cases_name_every_strategy_every_kind_and_the_control(quick: bool) -> None:
    listed = untangling.cases(quick, ["test_bench_untangling:Still"])
    assert len({case.key for case in listed}) == len(listed)
    by_part: dict[str, list[dict[str, Any]]] = {}
    for case in listed:
        by_part.setdefault(case.parameters["part"], []).append(case.parameters)
    compared = {*names(), "test_bench_untangling:Still"}
    assert {p["strategy"] for p in by_part["squares"]} == compared
    lasting = [p for p in by_part["squares"] if p["strategy"] in ("global", "hybrid")]
    assert {p["seed"] for p in lasting} == set(range(2 if quick else 10))
    assert {p["steps"] for p in lasting} == {40 if quick else 330}  # until clean, and 300 steps on
    assert all(p["strategy"] == "none" for p in by_part["pile"])
    for kind in KINDS:
        own = [p for p in by_part["canonical"] if p["settings"]["kind"] == kind]
        assert {p["strategy"] for p in own} >= compared - {"none"}
        assert {p["settings"]["depth"] for p in own} >= {1.0, 3.0}
        for p in own:  # every one of them can be drawn
            assert p["settings"]["resolution"] >= 2.0 * p["settings"]["depth"] + 4.0
    if not quick:
        assert {p["count"] for p in by_part["many"]} == {200}
        assert {p["settings"]["depth"] for p in by_part["many"]} == {1.0, 2.0, 3.0, 5.0}
        assert any(p["settings"]["length"] == 120.0 for p in by_part["dish"])
    assert "test_bench_untangling:Still" in {p["strategy"] for p in by_part["faults"]}


def test_a_fall_measures_what_an_own_simulation_shows() -> None:
    result = untangling.run({**SMALL, "strategy": "global"})
    simulation = cg.Simulation(
        cg.scenes.make("squares", seed=3, **SETTINGS), cg.Fidelity(**squares.FIELDS, untangling="global")
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
    assert result["start"]["length"] == lengths[0]
    assert result["end"]["hits"] == hits[-1]
    assert result["strain_until_clean"] <= max(strains)
    assert result["untangling_passes"] >= 1
    assert result["step_seconds"] > 0.0
    assert 0.0 < result["untangling_share"] < 1.0
    assert result["failure"] == ""
    again = untangling.run({**SMALL, "strategy": "global"})
    assert again["history"] == result["history"]
    json.dumps(json_ready(result), allow_nan=False)


@pytest.mark.parametrize("strategy", ["hybrid", "stall"])  # which remembers something
def test_an_instance_is_resolved_and_followed(strategy: str) -> None:
    drawn = draw("Closed", 1.0, 10, 0)
    fidelity = cg.Fidelity(**(instances.FIELDS | {"untangling": strategy}))
    found = instances.resolve(drawn, fidelity, 20, later=5)
    assert (found["reason"], found["right"]) == ("resolved", True)
    assert 1 <= found["passes"] <= 20
    assert (found["returns"], found["control"]) == (0, 0)
    assert found["length_left"] == 0.0
    assert 0.0 < found["area"] <= 2.0 * found["passes"]
    assert found["work"] > 0
    assert found["displacement"] > 0.0

    never = instances.resolve(drawn, dataclasses.replace(fidelity, untangling="none"), 20)
    assert (never["reason"], never["right"], never["passes"], never["returns"]) == ("budget", False, None, None)
    assert never["length_left"] == pytest.approx(1.0, rel=0.05)
    idle = instances.resolve(drawn, dataclasses.replace(fidelity, untangling="test_bench_untangling:Still"), 60)
    assert idle["reason"] == "stalled"


def test_at_once_makes_its_passes_before_the_first_step() -> None:
    fields = {"untangling_passes": 20, "velocity_share": 0.0}
    once = instances.run({**FEW, "fields": fields})
    step_by_step = instances.run(FEW)
    assert set(once) == set(step_by_step)
    assert all(passes is not None for passes in once["passes"] + step_by_step["passes"])
    assert once["passes"] != step_by_step["passes"]


def test_judge_reads_histories() -> None:
    hits = [9, 4, 0, 0, 3, 5, 0] + [0] * 40
    lengths = [2.0, 1.0, 0.0, 0.0, 0.5, 0.6, 0.0] + [0.0] * 40
    strains = [0.0, 0.4, 0.2] + [0.1] * 29 + [0.03] * 15
    judged = squares.judge(hits, lengths, strains)
    assert judged["first_clean_step"] == 2
    assert (judged["returns"], judged["returning_steps"]) == (5, 2)
    assert judged["length_ratio"] == {"5": 0.3, "10": 0.0, "15": 0.0, "30": 0.0}
    assert judged["strain_until_clean"] == 0.4
    assert judged["strain_later"] == 0.03  # from step 32 on

    never = squares.judge([5, 4, 3], [1.0, 0.8, 0.6], [0.1, 0.2, 0.3])
    assert never["first_clean_step"] is None
    assert never["returns"] is None
    assert never["length_ratio"] == {"5": None, "10": None, "15": None, "30": None}
    assert never["strain_until_clean"] == 0.3
    assert never["strain_later"] is None

    clean = squares.judge([0, 0, 7], [0.0, 0.0, 0.1], [0.0, 0.1, 0.2])
    assert clean["first_clean_step"] == 0
    assert clean["returns"] == 7


def test_quantiles_count_never_as_infinite() -> None:
    steps = [12, None, 10, 14, None, 11, 13, 15, 16, 17]
    assert quantile(steps, 0.5) == 14
    assert quantile(steps, 0.8) == 17
    assert quantile(steps, 0.9) is None
    assert quantile([None], 0.5) is None


def _row(strategy: str, seed: int, hits: list[int], failure: str = "", scene: str = "squares") -> dict[str, Any]:
    lengths = [0.1 * count for count in hits]
    history = {"hits": hits, "contours": [count // 4 for count in hits], "length": lengths}
    parameters = {"part": scene, "scene": scene, "settings": {"count": 25}, "strategy": strategy, "seed": seed}
    return {
        "seed": seed,
        "parameters": parameters | {"steps": len(hits) - 1, "control": 0},
        "result": {
            "start": {key: values[0] for key, values in history.items()},
            "end": {key: values[-1] for key, values in history.items()},
            "history": history,
            **squares.judge(hits, lengths, [0.02] * len(hits)),
            "control": None,
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
    start, result, cost, control = show.tables(json.loads(json.dumps(json_ready(rows))))
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
    for path in squares.plots(rows, tmp_path):
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size > 10_000
    table = squares._histories([row["result"] for row in rows[2:5]], "hits")
    assert table.shape == (3, 41)
    assert np.isnan(table[2, 2:]).all()  # nothing is drawn after a run diverged
    assert squares.plots(rows[-1:], tmp_path) == []
    assert len(show.tables(rows[-1:])) == 1


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


def test_summary_counts_what_was_never_resolved_as_infinite() -> None:
    one = {"passes": [3, None, 5], "right": [True, False, False], "reason": ["resolved", "stalled", "resolved"]}
    numbers = {key: [1.0, 2.0, 3.0] for key in ("area", "work", "milliseconds", "strain", "displacement")}
    found = show.summary([one | numbers | {"returns": [0, None, 4], "control": [None, None, None]}])
    assert (found["instances"], found["passes"], found["p90"]) == (3, 5, None)
    assert found["resolved"] == pytest.approx(2 / 3)
    assert found["right"] == pytest.approx(1 / 3)
    assert found["others"] == {"stalled": 1}
    assert (found["returns"], found["control"], found["work"]) == (4, None, 2.0)


def test_a_ribbon_that_drifts_out_late_is_not_out_in_time() -> None:
    parameters = {
        "part": "regions",
        "settings": {"depth": 3.0},
        "strategy": "global",
        "fields": {"velocity_share": 1.0},
    }
    result = {"passes": [9, 40, 12, None], "right": [True, True, False, False]}
    (table,) = show.tables([{"parameters": parameters, "result": result}])
    found = dict(zip(table.columns, table.rows[0]))
    assert (found["correctly in 15"], found["correctly in 30"], found["correctly in 60"]) == (0.25, 0.25, 0.5)
    assert found["so it is"] is False  # the scheme was expected to fail
    (table,) = show.tables([{"parameters": parameters | {"strategy": "local"}, "result": result}])
    assert table.rows[0][-1] is True


def test_overhead_names_its_parts() -> None:
    found = overhead.run(
        {"scene": "squares", "settings": SETTINGS, "strategy": "hybrid", "seed": 0, "steps": 0, "repeats": 1}
    )
    assert found["hits"] > 20
    assert set(found["seconds"]) == {"candidates", "tests", "contours", "response", "regions", "step"}
    assert all(seconds > 0.0 for seconds in found["seconds"].values())
    found = overhead.run(
        {"scene": "squares", "settings": SETTINGS, "strategy": "global", "seed": 0, "steps": 0, "repeats": 1}
    )
    assert found["seconds"]["regions"] == 0.0 < found["seconds"]["response"], "length needs no regions"
    with pytest.raises(ValueError, match="costs nothing"):
        overhead.run(
            {"scene": "squares", "settings": SETTINGS, "strategy": "none", "seed": 0, "steps": 0, "repeats": 1}
        )


def test_own_strategies_join_the_table() -> None:
    own = frame.load("untangling").with_strategies
    assert own is not None
    joined = own(["test_bench_untangling:Still"])
    assert any(case.parameters.get("strategy") == "test_bench_untangling:Still" for case in joined.cases(True))
    with pytest.raises(ValueError, match="no_such_module"):
        own(["no_such_module:Mine"])


def test_rows_tables_plots_and_page_come_out_of_the_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert frame.load("untangling") is untangling.benchmark
    from clothgym.benchmarks.untangling import figures

    blank = np.full((40, 40, 3), 255, np.uint8)
    for show_ in ("_kinds", "_hard", "_fault_pictures", "_dish_pictures"):  # they simulate for seconds
        monkeypatch.setattr(figures, show_, lambda: blank)
    small = dataclasses.replace(untangling.benchmark, cases=_tiny, prepare=None)
    outcome = frame.run_benchmark(small, tmp_path, quick=True)
    assert outcome.error_count == 0, [row.get("error") for row in outcome.rows]
    titles = [table.title for table in outcome.tables]
    assert [title.split(":")[0].split(" [")[0] for title in titles] == [
        "Start",
        "Untangling, by strategy",
        "Cost",
        "Control",
        "Many instances of the canonical kinds",
        "Why regions matter",
        "Canonical kinds, by depth",
        "Canonical kinds at depth 3, by resolution",
        "Largest correction and velocity share, depth 3",
        "Progressively along the simulation, or at once",
        "Other tangles, by strategy",
        "What the gradients say at the start",
        "Half of all contacts and intersections ignored",
        "The ribbon in the dish",
        "Cost of a pass beside a step",
    ]
    page = outcome.page.read_text()
    assert "roughly 2000" in page
    assert page.count("<img") >= 5 or "No plots" in page


def test_papers_take_the_rows_of_the_other_benches() -> None:
    papers = papers_bench.benchmark
    listed = papers.cases(True)
    assert len({case.key for case in listed}) == len(listed)
    assert {case.parameters["paper"] for case in listed} >= {"volino", "mezger"}
    case = next(c for c in listed if c.key.startswith("volino/Fig. 2 top/"))
    small = case.parameters | {"case": case.parameters["case"] | {"count": 1, "budget": 3}}
    key = f"papers/quick/{case.key}"
    row = {"key": key, "scale": "quick", "seed": 0, "parameters": small, "result": papers.run(small)}
    (table,) = papers.tables([row])
    assert table.columns[-2:] == ("here", "paper")
    assert table.rows[0][0] == "Fig. 2 top"
    assert "local is efficient" in table.rows[0][-1]
