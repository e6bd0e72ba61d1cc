"""The benchmark of Mezger 2003: its cases, what a small one measures, and its tables."""

from __future__ import annotations

import json

import numpy as np
import pytest

from clothgym.benchmarks import mezger, mezger_simulation, mezger_tables
from clothgym.benchmarks.report import json_ready


def sheets(steps: int, apart: float = 0.03):
    """Two wavy sheets, of which the upper one falls fast."""
    x, faces, flat = mezger.crumpled(8, 0, 0.05)
    up = np.array([0.0, 1.0, 0.0])
    objects = [(x, faces, True, flat), (x + apart * up, faces, True, flat)]
    fall = np.tile(-3.0 * up, (len(x), 1))
    frames = (([x, x + (apart - 0.002 * n) * up], [np.zeros_like(x), fall], 0.01) for n in range(steps))
    return objects, frames


@pytest.mark.parametrize("quick", [True, False])
def test_cases_name_what_can_be_run(quick):
    listed = mezger.cases(quick)
    assert len({case.key for case in listed}) == len(listed)
    assert {case.parameters["what"] for case in listed} == set(mezger._KINDS)
    table1 = next(case.parameters for case in listed if case.parameters["what"] == "table1")
    assert table1["steps"] == (60 if quick else 600), "the paper's walk has 600 steps"
    assert set(mezger_tables.PAPER) < set(mezger.TABLE_1)
    assert mezger.TABLE_1["unoriented, 2 cm"][0] == 0.02


def test_misses_are_those_of_the_step():
    objects, frames = sheets(4)
    rows = mezger._compare(mezger.TABLE_1, objects, frames, 2)
    occurring = {row["occurring"] for row in rows.values()}
    assert len(occurring) == 1 and occurring.pop() > 50
    assert rows["swept"]["missed"] == rows["conservative"]["missed"] == rows["accelerated"]["missed"] == 0
    assert rows["unoriented, same eps"]["missed"] > 0
    assert rows["unoriented, 2 cm"]["box_tests"] > rows["unoriented, same eps"]["box_tests"]
    assert rows["binary"]["refits"] > rows["accelerated"]["refits"]
    assert rows["AABB"]["leaf_pairs"] >= rows["accelerated"]["leaf_pairs"]
    assert all(row["total"] > 0.0 for row in rows.values())


def test_what_a_body_does_is_shown_with_its_speed():
    """Sewn trousers on a walking body: frames hold both where they are, and the body's way of a step."""
    objects, frames, simulation = mezger._falling("walking_trousers", 4)
    (body, faces, cloth, _), trousers = objects
    assert not cloth and trousers[2] and 700 < len(trousers[0]) < 950
    assert len(faces) == 26_756
    shown = list(frames)
    for n, (positions, velocities, dt) in enumerate(shown):
        assert positions[0] == pytest.approx(simulation.scene.bodies[0].at(n * dt), abs=1e-12)
        if n + 1 < len(shown):
            assert positions[0] + dt * velocities[0] == pytest.approx(shown[n + 1][0][0], abs=1e-12)
    assert np.abs(shown[-1][0][0] - body).max() > 1e-4, "nobody walks"


def test_tables_of_every_kind_and_json(monkeypatch):
    def walk(configurations, steps, every):
        objects, frames = sheets(3)
        return mezger._compare(configurations, objects, frames, every)

    monkeypatch.setattr(mezger, "_walk", walk)
    rows = []
    for what in ("table1", "k_arity"):
        parameters = {"what": what, "steps": 3, "every": 3}
        rows.append({"parameters": parameters, "result": mezger.run(parameters)})
    for what in ("vertices", "shares"):
        parameters = {"what": what, "scene": "table_cloth", "steps": 3}
        rows.append({"parameters": parameters, "result": mezger.run(parameters)})
    json.dumps(json_ready(rows))
    titles = [table.title for table in mezger.tables(rows)]
    assert len(titles) == 5 and titles[0].startswith("Table 1")
    first = mezger.tables(rows)[0]
    ratios = {(row[0], row[1]): row[4] for row in first.rows}
    assert ratios["unoriented, 2 cm", "total"] == pytest.approx(1.97, abs=0.005)
    assert ratios["AABB", "total"] == pytest.approx(1.06, abs=0.005)
    assert ratios["binary", "total"] == pytest.approx(1.125, abs=0.0005)
    shares = mezger.tables(rows)[-1].rows
    assert 0.0 <= shares[0][1] < 1.0


def test_crumpled_sheets_pass_through_themselves():
    import clothgym as cg

    vertices, faces, flat = mezger.crumpled(16, 0)
    assert cg.intersections(vertices, faces).hit_count > 20
    assert vertices.shape == flat.shape


def test_techniques_in_the_simulation(monkeypatch):
    import clothgym as cg

    make = cg.scenes.make
    monkeypatch.setattr(cg.scenes, "make", lambda name: make(name, vertices=7))
    result = mezger.run({"what": "simulation", "scene": "layers", "steps": 4, "every": 2})
    rows = result["rows"]
    assert set(rows) == set(mezger_simulation.TECHNIQUES)
    for name, row in rows.items():
        if row["complete"]:
            assert row["missed"] == row["missed_hits"] == 0, name
            assert row["same_bits"] or name == "clusters of 16"
        assert row["near"] > 100 and row["hits"] > 10 and 0.0 < row["detection"] < row["step"]
    assert rows["unoriented"]["missed"] > 0
    assert rows["plain"]["box_tests"] > rows["cones exact"]["box_tests"] > 0
    times, counts = mezger.tables([{"parameters": {"what": "simulation", "scene": "layers"}, "result": result}])
    for table in (times, counts):
        assert [cells[0] for cells in table.rows] == list(rows)
        assert {len(cells) for cells in table.rows} == {len(table.columns)}
    json.dumps(json_ready(result))
