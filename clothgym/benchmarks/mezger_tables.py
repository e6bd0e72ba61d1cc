"""The tables of `clothgym bench mezger`."""

from __future__ import annotations

from typing import Any

from clothgym.benchmarks.frame import Row
from clothgym.benchmarks.mezger_simulation import simulated_tables
from clothgym.benchmarks.report import Table

PAPER = {
    "accelerated": (56.0, 31.0, 88.0),
    "unoriented, 2 cm": (37.0, 136.0, 173.0),
    "AABB": (43.0, 50.0, 93.0),
    "binary": (64.0, 35.0, 99.0),
}
"""Seconds of hierarchy update, collision test and both, for 600 steps."""

TESTS = ("refits", "box_tests", "leaf_pairs", "cone_pruned", "primitive_tests")
"""What is counted a step."""


def tables(rows: list[Row]) -> list[Table]:
    """One table a kind of case."""
    found: list[Table] = []
    for row in rows:
        kind, result = row["parameters"]["what"], row["result"]
        if kind in ("table1", "sewn"):
            title = "the walk" if kind == "table1" else "the walk in sewn trousers"
            found += [_paper_table(title, result), _walk_table(title, row["parameters"]["every"], result)]
        elif kind == "k_arity":
            found.append(_measured_table("k x arity on the walk", result, "18 x 4"))
        elif kind == "heuristics":
            found.append(_measured_table(f"Heuristics on {row['parameters']['scene']}", result, "plain"))
        elif kind == "vertices":
            found.append(_seen_table(row))
        elif kind == "simulation":
            found += simulated_tables(row)
        elif kind == "curvature":
            found.append(_curvature_table(result))
    shares = [row for row in rows if row["parameters"]["what"] == "shares"]
    return [*found, _share_table(shares)] if shares else found


def _paper_table(title: str, result: dict[str, Any]) -> Table:
    base, own = result["rows"]["accelerated"], PAPER["accelerated"]
    cells = []
    for name, row in result["rows"].items():
        printed = PAPER.get(name)
        for n, key in enumerate(("hierarchy", "collision", "total")):
            cells.append((name, key, 1e3 * row[key], row[key] / base[key], printed[n] / own[n] if printed else None))
    columns = ("configuration", "part", "median a step [ms]", "ratio", "paper's ratio")
    return Table(
        f"Table 1: {title}, {result['steps']} steps", columns, cells, "Ratios to the accelerated configuration."
    )


def _walk_table(title: str, every: int, result: dict[str, Any]) -> Table:
    cells = [
        (name, *(row[key] for key in TESTS), row["self_share"], row["missed"], row["occurring"])
        for name, row in result["rows"].items()
    ]
    columns = ("configuration", *(f"{key} a step" for key in TESTS), "share of self-collision", "missed", "of")
    note = f"Misses in every {every}th step. Self: 'a fractional amount'."
    return Table(f"{title.capitalize()}: counts and misses", columns, cells, note)


def _measured_table(title: str, result: dict[str, Any], base: str) -> Table:
    unit = result["rows"][base]["total"]
    cells = [
        (
            name, 1e3 * row["hierarchy"], 1e3 * row["collision"], row["total"] / unit, *(row[key] for key in TESTS),
            row["missed"], row["occurring"],
        )
        for name, row in result["rows"].items()
    ]  # fmt: skip
    columns = ("configuration", "hierarchy [ms]", "collision [ms]", f"total / {base}", *TESTS, "missed", "of")
    return Table(title, columns, cells, "Medians a step, counts a step; misses within the step, in some of the steps.")


def _seen_table(row: Row) -> Table:
    cells = [
        (name, r["seen"], r["of"], r["seen"] / r["of"] if r["of"] else None, r["primitive_tests"], 1e3 * r["collision"])
        for name, r in row["result"]["rows"].items()
    ]
    columns = ("test", "face pairs seen", "of", "share", "distances a step", "collision [ms]")
    note = (
        "Pairs of faces within 4 mm; the paper: tests of particles alone penetrate at the rim, virtual ones cost more."
    )
    return Table(f"Vertices and virtual particles on {row['parameters']['scene']}", columns, cells, note)


def _curvature_table(result: dict[str, Any]) -> Table:
    cells = [
        (name, r["hits"], r["missed_hits"], r["near"], r["missed_near"], r["box_tests"])
        for name, r in result["rows"].items()
    ]
    columns = (
        "criterion, closeAngle, groups, tree over",
        "face pairs that intersect",
        "missed",
        "near",
        "missed",
        "box tests",
    )
    note = (
        "Crumpled sheets of 1,152 triangles. Near pairs of neighbours on sharp bends are not candidates for the paper."
    )
    return Table("False negatives of the curvature criterion", columns, cells, note)


def _share_table(rows: list[Row]) -> Table:
    cells = [(row["parameters"]["scene"], row["result"]["detection"], 88.0 / 147.0) for row in rows]
    note = (
        "The paper's walk: detection 88, response 24, solver 35 s. Here with this library's own pipeline, preset draft."
    )
    return Table("Share of detection in a step", ("scene", "share", "paper, walk"), cells, note)
