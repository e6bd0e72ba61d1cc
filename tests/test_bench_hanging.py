"""The bench of the hanging sheet: its cases, what a case measures, and what counts as reached."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import clothgym as cg
from clothgym import metrics
from clothgym.benchmarks import hanging
from clothgym.fidelity import INTEGRATORS, PRESETS


@pytest.mark.parametrize("quick", [True, False])
def test_cases_are_all_integrators_and_presets(quick: bool) -> None:
    listed = hanging.cases(quick)
    assert len({case.key for case in listed}) == len(listed)
    sizes = {case.parameters["cells"] for case in listed}
    assert sizes == ({16, 32} if quick else {16, 32, 64, 128})
    for n in sizes:
        own = [c.parameters for c in listed if c.parameters["cells"] == n]
        assert sum(p["preset"] == "converged" for p in own) == 1
        assert {(p["preset"], p["precision"]) for p in own if p["integrator"] == "xpbd" and "precision" in p} == {
            (preset, precision) for preset in PRESETS for precision in ("float64", "float32")
        }
    assert {c.parameters["integrator"] for c in listed} == set(INTEGRATORS)


def test_a_case_measures_the_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hanging, "_SECONDS", 0.9)
    parameters = {"cells": 16, "integrator": "xpbd", "preset": "draft", "precision": "float32"}
    result = hanging.run(parameters)
    sim = hanging.simulation(parameters)
    assert sim.fidelity.precision == "float32" and sim.scene == cg.scenes.make("hanging_sheet", resolution=16)
    peak, heights = 0.0, []
    for _ in range(54):
        sim.step()
        peak = max(peak, metrics.max_strain(sim.model, sim.positions))
        heights.append(sim.scene.start[:, 1].mean() - sim.positions[:, 1].mean())
    # edges of the mesh are the structural springs and one diagonal of each quad
    assert 0.5 * peak < result["peak"] <= peak
    assert result["heights"] == pytest.approx([heights[round(60 * t) - 1] for t in hanging.HEIGHTS])
    assert result["springs"] == len(sim.model.spring_ends)
    assert result["sweeps"] == result["substeps"] == sim.pipeline.substeps
    assert result["ns_per_spring"] == pytest.approx(1e6 * result["ms"] / (result["sweeps"] * result["springs"]))
    assert result["heights"][4] == pytest.approx(hanging.HEIGHTS[0.5], abs=0.05)


def row(n: int, preset: str, peak: float, shift: float = 0.0, ms: float = 0.1) -> dict[str, Any]:
    parameters = {"cells": n, "integrator": "xpbd", "preset": preset, "precision": "float64"}
    heights = [h + shift for h in hanging.HEIGHTS.values()]
    return {"parameters": parameters, "result": {
        "vertices": (n + 1) ** 2, "springs": 100, "substeps": 9, "sweeps": 9, "peak": peak, "end": 0.0,
        "heights": heights, "ms": ms, "ns_per_spring": 2.0,
    }}  # fmt: skip


@pytest.mark.parametrize(
    ("peak", "shift", "ms", "reached"),
    [(0.032, 0.0, 0.1, "yes"), (0.034, 0.0, 0.1, "no"), (0.02, 0.031, 0.1, "no"), (0.02, -0.031, 0.1, "no"),
     (0.02, 0.029, 0.29, "yes"), (0.02, 0.0, 0.31, "no")],
)  # fmt: skip
def test_what_counts_as_reached(peak: float, shift: float, ms: float, reached: str) -> None:
    found = {table.title: table for table in hanging.tables([row(16, "balanced", peak, shift, ms)])}
    assert found["Promises"].rows[0][-1] == reached
    assert len(found["Promises"].rows[0]) == len(found["Promises"].columns)


def test_a_converged_run_takes_the_place_of_the_known_figures() -> None:
    rows = [row(16, "converged", 0.010), row(16, "balanced", 0.036), row(32, "draft", 0.1)]
    promises = next(table for table in hanging.tables(rows) if table.title == "Promises").rows
    assert promises[0][6] == pytest.approx(2.6) and promises[0][-1] == "yes"
    assert promises[1][6] == pytest.approx(100 * (0.1 - hanging.CONVERGED[32]))
    assert hanging.tables([]) == []


def test_cost_is_told_by_vertex_and_frame() -> None:
    rows = [row(n, "balanced", 0.01, ms=1e-3 * (n + 1) ** 2) for n in (16, 64)]
    cost = next(table for table in hanging.tables(rows) if table.title.startswith("Cost")).rows
    assert cost == [("xpbd", "balanced", "float64", pytest.approx(1000.0), None, pytest.approx(1000.0), None, 2.0)]
    assert np.isfinite(cost[0][3])
