"""`clothgym bench dressing`: the image-space collider and the alternatives, garments beside the tables of [Vassilev 2001]."""

from __future__ import annotations

from typing import Any

from clothgym.benchmarks.dressing import collider, garments, wearing
from clothgym.benchmarks.frame import Benchmark, Case, Row
from clothgym.benchmarks.report import Table

_NOTES = (
    "Vassilev, Spanlang, Chrysanthou 2001, on an SGI R12000: image-space against object-space collision a step: shirt of 1,800 "
    "vertices 15.8 and 30.8 ms, dress of 3,840 vertices 33.0 and 52.0 ms (Table 1); skirt 336, trousers 560, shirt 544, "
    "dress 1,024 vertices: 206, 334, 268, 784 ms in 66, 69, 55, 88 steps (Table 2), 8.7 us a vertex and step, linear "
    "(Fig. 8). Material, step, stop rule and body are not given there."
)


def cases(quick: bool) -> list[Case]:
    """Garments, what is worn, then the collider by itself."""
    return garments.cases(quick) + wearing.cases(quick) + collider.cases(quick)


def prepare() -> None:
    """Compiles every kernel that a case uses."""
    garments.prepare()
    collider.prepare()


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One case of `cases`."""
    kind = parameters["kind"]
    part = collider if kind in collider.KINDS else wearing if kind in wearing.KINDS else garments
    return part.run(parameters)


def tables(rows: list[Row]) -> list[Table]:
    """All tables that the rows are enough for."""
    return garments.tables(rows) + wearing.tables(rows) + collider.tables(rows)


benchmark = Benchmark(
    name="dressing",
    title="Dressing: the collider and the garments beside Vassilev 2001",
    cases=cases,
    run=run,
    tables=tables,
    plots=wearing.plots,
    prepare=prepare,
    notes=_NOTES,
)
