"""`clothgym bench crumple`: cases, a short run, tables."""

from __future__ import annotations

import numpy as np

import clothgym as cg
from clothgym.benchmarks import crumple


def test_cases_name_every_preset_at_every_size():
    keys = [case.key for case in crumple.cases(quick=False)]
    assert len(set(keys)) == len(keys) == 3 * 4
    assert {case.key for case in crumple.cases(quick=True)} == {
        "crumple/16/converged", "crumple/16/draft", "crumple/16/balanced",
    }  # fmt: skip


def test_the_converged_run_takes_more_substeps():
    assert (
        crumple.simulation(4, "converged").pipeline.substeps == 4 * crumple.simulation(4, "balanced").pipeline.substeps
    )


def test_a_short_run_is_measured_at_every_frame():
    parameters = {"cells": 8, "preset": "draft", "seconds": 1.0}
    result = crumple.run(parameters)
    assert result["hits"] == result["frames_with_hits"] == 0
    assert result["contacts"] > 0 and result["pairs"] > 0 and result["measured"] > 0
    assert 0.0 < result["median"] <= result["p90"] <= result["max"]
    sim = cg.Simulation(cg.scenes.make("drop", resolution=8), "draft")
    sim.step(60)
    assert result["top"] == np.max(sim.positions[:, 1])
    assert result["peak"] >= result["end"] > -1.0


def test_tables_set_the_excess_against_the_converged_run():
    base = {
        "substeps": 10, "sweeps": 10, "median": 1.0, "p90": 2.0, "max": 3.0, "end": 0.0, "hits": 0, "contacts": 4.0,
        "pairs": 50.0, "top": 0.1,
    }  # fmt: skip
    rows = [
        {"parameters": {"cells": 16, "preset": preset}, "result": {**base, "peak": peak}}
        for preset, peak in (("converged", 0.01), ("balanced", 0.035), ("draft", 0.2))
    ]
    table, others = crumple.tables(rows)
    excess, budget = table.columns.index("excess [%]"), table.columns.index("budget [ms]")
    assert table.rows[0][excess] is None
    assert np.allclose([row[excess] for row in table.rows[1:]], [2.5, 19.0])
    assert [row[budget] for row in table.rows] == [None, 2.0, None]
    assert len(others.rows) == 2
    assert crumple.tables([]) == []
