"""`clothgym bench papers`: every table and figure of the three papers beside their numbers and words.

What another benchmark measures already is taken from there: it keeps its own cases, runs and tables.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from clothgym.benchmarks import frame
from clothgym.benchmarks.frame import Benchmark, Case, Row
from clothgym.benchmarks.papers import volino
from clothgym.benchmarks.report import Table

_OTHERS = ("mezger", "dressing")
"""Benchmarks that are each about a paper as a whole: [Mezger 2003] and [Vassilev 2001]."""
_NOTES = (
    "Volino and Magnenat-Thalmann 2006, Mezger, Kimmerle and Etzmuss 2003, Vassilev, Spanlang and Chrysanthou 2001. Their "
    "machines are twenty years old and their scenes are not given in full: what can be compared are ratios, counts, and "
    "whether what they say happens."
)


def parts() -> dict[str, Any]:
    """Name -> what has `cases`, `run`, `tables` and `prepare`, as far as it is registered."""
    registered = frame.entry_points()
    return {"volino": volino} | {name: frame.load(name) for name in _OTHERS if name in registered}


def cases(quick: bool) -> list[Case]:
    """Those of all parts; a part's name comes first in their keys."""
    return [
        Case(f"{name}/{case.key}", {"paper": name, "seed": case.parameters.get("seed", 0), "case": case.parameters})
        for name, part in parts().items()
        for case in part.cases(quick)
    ]


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """A case of the part that it names."""
    return parts()[parameters["paper"]].run(parameters["case"])


def prepare() -> None:
    """Compiles what all parts use."""
    for part in parts().values():
        if part.prepare is not None:
            part.prepare()


def _rows_of(rows: list[Row], name: str) -> list[Row]:
    """Rows of a part as it would have written them itself."""
    return [
        row
        | {
            "parameters": row["parameters"]["case"],
            "key": f"{name}/{row['scale']}/" + row["key"].split(f"/{name}/", 1)[1],
        }
        for row in rows
        if row["parameters"]["paper"] == name
    ]


def tables(rows: list[Row]) -> list[Table]:
    """Those of all parts."""
    return [table for name, part in parts().items() if (own := _rows_of(rows, name)) for table in part.tables(own)]


def plots(rows: list[Row], folder: Path) -> list[Path]:
    """Those of all parts."""
    return [path for name, part in parts().items() if (own := _rows_of(rows, name)) for path in part.plots(own, folder)]


benchmark = Benchmark(
    name="papers",
    title="The three papers: what they report, and what comes out here",
    cases=cases,
    run=run,
    tables=tables,
    plots=plots,
    prepare=prepare,
    notes=_NOTES,
)
