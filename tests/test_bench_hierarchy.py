"""The benchmark of the hierarchy: its scene, what it measures, and how it shows it."""

from __future__ import annotations

import sys
from typing import Any

import naive
import numpy as np
import pytest

import clothgym as cg
from clothgym.benchmarks import frame, hierarchy

SMALL = {"part": "scaling", "triangles": 200, "seed": 1, "repeats": 1}


@pytest.mark.parametrize("quick", [True, False])
def test_cases_are_every_size_in_both_states(quick: bool) -> None:
    listed = hierarchy.cases(quick)
    assert len({case.key for case in listed}) == len(listed)
    flat = [case.parameters["cells"] for case in listed if case.parameters["part"] == "flat"]
    assert flat == ([16, 32, 64] if quick else [16, 32, 64, 128])
    listed = [case for case in listed if case.parameters["part"] == "scaling"]
    sizes = {case.parameters["triangles"] for case in listed}
    assert max(sizes) == (20_000 if quick else 320_000)
    assert {800, 5_000, 20_000} <= sizes
    assert {(c.parameters["triangles"], c.parameters["state"]) for c in listed} == {
        (size, state) for size in sizes for state in ("clear", "tangled")
    }


@pytest.mark.parametrize("triangles", [200, 1_800])
def test_states_are_what_they_are_called(triangles: int) -> None:
    """Clear has near pairs but no hit, tangled has hits; the density of pairs hardly depends on the size."""
    for state in ("clear", "tangled"):
        vertices, faces = hierarchy.folded_layers(triangles, state, 0)
        assert len(faces) == pytest.approx(triangles, rel=0.1)
        assert len(np.unique(faces)) == len(vertices)
        assert bool(cg.intersections(vertices, faces).hit_count) == (state == "tangled")
        near = cg.proximities(vertices, faces, hierarchy.DISTANCE)
        assert 0.2 < (len(near.vertex_triangle) + len(near.edge_edge)) / len(faces) < 10.0
    ends = vertices[cg.Surface(faces).edges]
    lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    assert 0.4 * hierarchy.EDGE < lengths.min() < lengths.max() < 3.0 * hierarchy.EDGE


def test_the_same_scene_again_is_the_same() -> None:
    for one, two in zip(
        hierarchy.folded_layers(300, "clear", 4), hierarchy.folded_layers(300, "clear", 4), strict=True
    ):
        assert np.array_equal(one, two)
    assert not np.array_equal(*(hierarchy.folded_layers(300, "clear", seed)[0] for seed in (4, 5)))


@pytest.mark.parametrize("state", ["clear", "tangled"])
def test_counts_of_a_case_are_those_of_brute_force(state: str) -> None:
    result = hierarchy.run({**SMALL, "state": state})
    vertices, faces = hierarchy.folded_layers(200, state, 1)
    expected = naive.proximities(vertices, faces, hierarchy.DISTANCE)
    assert result["triangles"] == len(faces)
    assert result["vertex_triangle"] == len(expected.vertex_triangle)
    assert result["edge_edge"] == len(expected.edge_edge)
    assert result["hits"] == len(naive.exact_intersections(vertices, faces).hits)
    assert result["ms"]["near"] > 0.0 < result["ms"]["hits"]


@pytest.mark.parametrize("state", ["clear", "tangled"])
def test_ipctk_finds_the_same_pairs(state: str) -> None:
    ipctk = pytest.importorskip("ipctk")
    before = ipctk.get_num_threads()
    result = hierarchy.run({**SMALL, "state": state})
    assert ipctk.get_num_threads() == before
    assert result["peer"] == f"ipctk {ipctk.__version__}"
    assert (result["missing"], result["extra"]) == (0, 0)
    assert result["peer_has_hits"] == (result["hits"] > 0)
    assert {"peer_near", "peer_hits"} <= set(result["ms"])


def test_missing_and_extra_pairs_are_counted() -> None:
    ipctk = pytest.importorskip("ipctk")
    vertices, faces = hierarchy.folded_layers(200, "tangled", 1)
    surface = cg.Surface(faces, len(vertices))
    points = np.asfortranarray(vertices)
    mesh = ipctk.CollisionMesh(points, np.asfortranarray(surface.edges), np.asfortranarray(surface.faces))
    fewer = cg.proximities(vertices, surface, 0.6 * hierarchy.DISTANCE)
    more = cg.proximities(vertices, surface, 1.5 * hierarchy.DISTANCE)
    same = cg.proximities(vertices, surface, hierarchy.DISTANCE)
    numbers = [len(p.vertex_triangle) + len(p.edge_edge) for p in (fewer, same, more)]
    compared = [hierarchy._compared(ipctk, mesh, points, surface, near) for near in (fewer, same, more)]
    assert compared == [
        {"missing": numbers[1] - numbers[0], "extra": 0},
        {"missing": 0, "extra": 0},
        {"missing": 0, "extra": numbers[2] - numbers[1]},
    ]


def test_without_ipctk_ours_is_measured_and_the_reason_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ipctk", None)
    result = hierarchy.run({**SMALL, "state": "clear"})
    assert result["peer"] is None
    assert "ipctk is not installed" in result["peer_skipped"]
    assert set(result["ms"]) == {"near", "hits", "both"}
    table = hierarchy.tables([{"parameters": {**SMALL, "state": "clear"}, "result": result}])[0]
    assert "ipctk is not installed" in table.note
    assert table.rows[0][4:] == (None, None, None, None)


def test_growth_is_the_exponent() -> None:
    sizes = [5_000, 20_000, 80_000]
    assert hierarchy.growth(sizes, [3.0 * n**1.25 for n in sizes]) == pytest.approx(1.25)
    assert hierarchy.growth([5_000], [1.0]) is None


def test_rows_and_tables_of_a_whole_run(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = [
        frame.Case(f"scaling/{state}/{size}", {**SMALL, "triangles": size, "state": state})
        for size in (200, 5_000)
        for state in ("clear", "tangled")
    ]
    benchmark = frame.Benchmark(
        "hierarchy",
        hierarchy.benchmark.title,
        lambda quick: tiny,
        hierarchy.run,
        hierarchy.tables,
        prepare=hierarchy.prepare,
    )
    monkeypatch.setattr(hierarchy, "_COMPARED_LARGEST", 500)
    outcome = frame.run_benchmark(benchmark, tmp_path, quick=True)
    assert outcome.error_count == 0
    near, hits, growth = outcome.tables
    assert [row[0] for row in near.rows] == sorted(row["result"]["triangles"] for row in outcome.rows)
    assert all(row[1] in ("clear", "tangled") for row in hits.rows)
    assert [row[2] > 0 for row in hits.rows] == [row[1] == "tangled" for row in hits.rows]
    assert [row[0] for row in growth.rows] == ["clear", "tangled"]
    again = frame.run_benchmark(benchmark, tmp_path, quick=True, resume=True)
    assert [row["finished"] for row in again.rows] == [row["finished"] for row in outcome.rows]


def test_a_flat_sheet_is_decided_and_runs_as_with_a_search() -> None:
    parameters = {"part": "flat", "cells": 6, "steps": 3, "searched": 2, "sheets": 2, "repeats": 2}
    result = hierarchy.run(parameters)
    assert (result["triangles"], result["decided"], result["equal"]) == (72, 3, True)
    assert result["share"] < 1.0 and result["share_of_all"] < 1.0 and min(result["ms"].values()) > 0.0
    assert len(result["shares"]) == 2 and min(result["shares"]) <= result["share"] <= max(result["shares"])
    (table,) = hierarchy.tables([{"parameters": parameters, "result": result}])
    assert table.rows[0][:3] == (6, 72, "3 of 3")
    assert table.rows[0][6] == result["share"]
