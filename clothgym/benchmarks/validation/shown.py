"""What the benchmark shows: a summary by solver, every quantity by family, orders of convergence, anisotropy, drape."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from clothgym.benchmarks.frame import Row
from clothgym.benchmarks.machine import pyplot
from clothgym.benchmarks.report import Table, format_value
from clothgym.benchmarks.validation import known, measure
from clothgym.benchmarks.validation.families import FAMILIES

_TITLES = {
    "oscillator": "V1 oscillator: one mass on a spring, w dt = 0.1",
    "pendulum": "V2 pendulum on near-rigid rods",
    "chain": "V3 small swings of a hanging chain",
    "column": "V4 column stretched by its own weight",
    "catenary": "V5 catenary",
    "wave": "V6 waves along a row of cells",
    "membrane": "V6 stretched membrane",
    "cantilever": "V7 cantilever under its own weight, against the elastica",
    "buckling": "V8 strip on edge under its own weight",
    "incline": "V9 slope, Coulomb friction",
    "capstan": "V9 strip over a cylinder, Coulomb friction",
    "creep": "V9 slope, response of [Vassilev 2001] eq. 12",
    "drape": "V10 Cusick drape",
    "flight": "V11 free flight",
    "invariance": "V11 turned, shifted, renumbered",
    "stretch": "V11 resistance to a stretch, by direction",
    "bend": "V11 resistance to bending, by direction",
    "moment": "V12 moment of bending energies",
    "bounce": "V13 rebound",
}
_MARKS = ("o", "s", "^", "D", "v", "P", "x", "+", "*")
_COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown", "tab:pink", "tab:cyan")


def tables(rows: list[Row]) -> list[Table]:
    """Summary, orders, anisotropy, drape, then every quantity, and what this version lacks."""
    there = [row for row in rows if row["result"]["available"]]
    found = [_summary(there)] if there else []
    found += [table for table in (_orders(there), _refinement(there), _directions(there), _drapes(there)) if table.rows]
    found += [_family(name, _of(there, name)) for name in _TITLES if _of(there, name)]
    missing = [row for row in rows if not row["result"]["available"]]
    if missing:
        cells = [(_label(row), row["result"]["reason"]) for row in missing]
        found.append(Table("Not available", ("case", "reason"), cells))
    return found


def _of(rows: Iterable[Row], family: str) -> list[Row]:
    return [row for row in rows if row["parameters"]["family"] == family]


def _label(row: Row) -> str:
    """Key of the case without benchmark and scale."""
    return row["key"].split("/", 2)[-1]


def _solver(row: Row) -> str:
    """What answers: the solver, with its bending energy where the family has one."""
    p = row["parameters"]
    names = [p.get("solver"), p.get("membrane"), p.get("bending")]
    return ", ".join(name for name in names if name)


def judged(rows: Iterable[Row]) -> list[tuple[Row, dict[str, Any]]]:
    """Every quantity with a verdict that theory does not predict to fail."""
    return [(r, q) for r in rows for q in r["result"]["quantities"] if q["met"] is not None and "predicted" not in q]


def _summary(rows: list[Row]) -> Table:
    solvers = list(dict.fromkeys(_solver(row) for row in rows))
    cells = []
    for solver in solvers:
        own = judged(row for row in rows if _solver(row) == solver)
        failed = [(r, q) for r, q in own if not q["met"]]
        worst = max(
            (abs(q["error"]) for _, q in own if q["error"] is not None and q["known"] not in (0.0, None)), default=None
        )
        said = "; ".join(f"{_label(r)}: {q['name']} {format_value(q['measured'])}" for r, q in failed[:4])
        said += f"; and {len(failed) - 4} more" if len(failed) > 4 else ""
        cells.append((solver, len(own), len(own) - len(failed), worst, said or None))
    columns = ("solver", "targets", "met", "largest relative error", "missed")
    return Table("Known answers, by solver", columns, cells)


def _family(name: str, rows: list[Row]) -> Table:
    cells = []
    for row in rows:
        for q in row["result"]["quantities"]:
            note = f"{q['predicted']} as predicted" if "predicted" in q and q["met"] is False else None
            cells.append((_label(row), q["name"], q["measured"], q["known"], q["error"], q["target"], q["met"], note))
    columns = ("case", "quantity", "measured", "known", "error", "target", "met", "note")
    return Table(_TITLES[name], columns, cells)


# Orders


def _orders(rows: list[Row]) -> Table:
    cells = []
    for row in [*_of(rows, "oscillator"), *_of(rows, "flight")]:
        result = row["result"]
        order, steps = result["order"], result["order"]["steps"]
        errors = order.get("errors") or order["gaps"]
        expected = known.order(row["parameters"]["solver"])
        kind = "oscillator" if "errors" in order else "flying sheet"
        cells.append((kind, _solver(row), measure.order(steps[: len(errors)], errors), expected, errors[0], errors[-1]))
    columns = ("scene", "solver", "order", "theory", "error, longest step", "error, shortest step")
    note = (
        "Oscillator: distance from the exact amplitude after 1.25 periods, over that of the start, w dt = 0.05 to 0.00625. "
        "Flying sheet: largest change [m] of a vertex when the step of 0.2 ms is halved, again and again."
    )
    return Table("Order of convergence in the time step", columns, cells, note)


def _first_error(row: Row) -> float | None:
    return row["result"]["quantities"][0]["error"]


def _refinement(rows: list[Row]) -> Table:
    """Error over the number of cells where a family has the same case at several."""
    groups: dict[tuple[str, str], dict[int, float | None]] = {}
    for row in rows:
        p = row["parameters"]
        if p["family"] == "catenary" and p["slack"] == 1.25:
            groups.setdefault(("sag of a catenary", _solver(row)), {})[p["links"]] = _first_error(row)
        if p["family"] == "cantilever" and p["load"] == 10 and p["columns"] == 2:
            groups.setdefault(("H / L of a cantilever at load 10", _solver(row)), {})[p["rows"]] = _first_error(row)
    cells = []
    for (what, solver), errors in groups.items():
        if len(errors) < 2:
            continue
        sizes = sorted(errors)
        values = [errors[n] for n in sizes]
        p = measure.order([1.0 / n for n in sizes], [abs(v) if v is not None else None for v in values])  # type: ignore[misc]
        cells.append((what, solver, sizes, values, p))
    return Table("Refinement", ("quantity", "solver", "cells", "relative error", "order in the cell"), cells)


def _directions(rows: list[Row]) -> Table:
    cells = []
    for name, what in (("stretch", "modulus [N/m]"), ("bend", "rigidity [N m]")):
        for row in _of(rows, name):
            values = row["result"]["moduli"]
            cells.append((what, _solver(row), *values, values[1] / values[0]))
    grains: dict[str, dict[str, Row]] = {}
    for row in _of(rows, "cantilever"):
        if row["parameters"]["columns"] == 6:
            grains.setdefault(_solver(row), {})[row["parameters"]["grain"]] = row
    for solver, found in grains.items():
        if len(found) == 3:
            values = [found[grain]["result"]["quantities"][0]["measured"] for grain in ("0", "45", "90")]
            cells.append(("H / L of a cantilever at load 10", solver, *values, values[1] / values[0]))
    columns = ("quantity", "of", "0 degrees", "45 degrees", "90 degrees", "45 over 0")
    note = (
        "By the angle between the direction and the sides of the cells; 1 in the last column = no direction stands out."
    )
    return Table("Anisotropy", columns, cells, note)


def _drapes(rows: list[Row]) -> Table:
    groups: dict[str, list[Row]] = {}
    for row in _of(rows, "drape"):
        groups.setdefault(_solver(row), []).append(row)
    cells = []
    for solver, own in groups.items():
        own = sorted(own, key=lambda row: row["parameters"]["bending_length"])
        coefficients = [row["result"]["coefficient"] for row in own]
        cells.append(
            (
                solver,
                [1e3 * row["parameters"]["bending_length"] for row in own],
                coefficients,
                [row["result"]["quantities"][1]["measured"] for row in own],
                all(a < b for a, b in itertools.pairwise(coefficients)),
            )
        )
    columns = ("solver", "bending length [mm]", "drape coefficient [%]", "nodes", "grows with stiffness")
    return Table("V10 Cusick drape: trend", columns, cells, "0 % = hangs straight down, 100 % = stays flat")


# Plots


def plots(rows: list[Row], folder: Path) -> list[Path]:
    """Convergence, cantilevers beside the elastica, moments over curvature, drape coefficients."""
    there = [row for row in rows if row["result"]["available"]]
    folder.mkdir(parents=True, exist_ok=True)
    drawn = (_plot_orders(there, folder), _plot_cantilever(there, folder), _plot_moment(there, folder))
    return [path for path in (*drawn, _plot_drape(there, folder)) if path is not None]


def _curves(
    path: Path, curves: list[tuple[str, Any, Any, str]], labels: tuple[str, str, str], log: str = "xy"
) -> Path | None:
    """Draws named (x, y) curves: style ":" known, "-" measured, "" measured in points; None when there are none."""
    if not curves:
        return None
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(8.0, 4.8), constrained_layout=True)
    for number, (name, x, y, style) in enumerate(curves):
        if style == ":":
            axes.plot(x, y, style, color="0.5", label=name, lw=1.2, zorder=1)
            continue
        # curves lie on each other: hollow marks of several shapes and sizes show all of them
        mark, size = _MARKS[number % len(_MARKS)], 5.0 + 1.2 * (number % 6)
        colour = _COLOURS[number % len(_COLOURS)]
        axes.plot(x, y, ls=style or "none", marker=mark, color=colour, label=name, markersize=size, mfc="none", lw=0.9)
    if "x" in log:
        axes.set_xscale("log")
    if "y" in log:
        axes.set_yscale("log")
    axes.set_title(labels[0], fontsize=10)
    axes.set_xlabel(labels[1])
    axes.set_ylabel(labels[2])
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=130)
    plt.close(figure)
    return path


def _columns(points: list[tuple[float, float]]) -> tuple[list[float], list[float]]:
    """x and y of points, each once, from left to right."""
    ordered = sorted(set(points))
    return [x for x, _ in ordered], [y for _, y in ordered]


def _plot_orders(rows: list[Row], folder: Path) -> Path | None:
    curves = [
        (_solver(row), row["result"]["order"]["steps"], row["result"]["order"]["errors"], "-")
        for row in _of(rows, "oscillator")
    ]
    labels = ("Oscillator: error after 1.25 periods", "w dt", "error over amplitude")
    return _curves(folder / "validation_orders.png", curves, labels)


def _plot_cantilever(rows: list[Row], folder: Path) -> Path | None:
    groups: dict[str, list[tuple[float, float]]] = {}
    for row in _of(rows, "cantilever"):
        p = row["parameters"]
        if p["columns"] == 2 and p["rows"] in (12, 32):
            groups.setdefault(_solver(row), []).append((p["load"], row["result"]["quantities"][1]["measured"]))
    if not groups:
        return None
    loads = np.geomspace(1.0, 100.0, 40)
    master = [depth / reach for depth, reach in map(known.elastica, loads.tolist())]
    curves: list[tuple[str, Any, Any, str]] = [("elastica", loads, master, ":")]
    curves += [(solver, *_columns(points), "") for solver, points in groups.items()]
    labels = ("Cantilever under its own weight", "w L^3 / B", "depth over reach of the tip")
    return _curves(folder / "validation_cantilever.png", curves, labels)


def _plot_moment(rows: list[Row], folder: Path) -> Path | None:
    curves: list[tuple[str, Any, Any, str]] = []
    for row in _of(rows, "moment"):
        result = row["result"]
        curves.append((_solver(row), result["curvatures"], result["moments"], ""))
        exact = [q["known"] for q in result["quantities"][: len(result["moments"])]]
        curves.append((f"{_solver(row)}, known", result["curvatures"], exact, ":"))
    labels = ("Moment of a strip, 2 cells of 1 cm across", "curvature [1/m]", "moment [N m]")
    return _curves(folder / "validation_moment.png", curves, labels)


def _plot_drape(rows: list[Row], folder: Path) -> Path | None:
    groups: dict[str, list[tuple[float, float]]] = {}
    for row in _of(rows, "drape"):
        point = (1e3 * row["parameters"]["bending_length"], row["result"]["coefficient"])
        groups.setdefault(_solver(row), []).append(point)
    curves = [(solver, *_columns(points), "-") for solver, points in groups.items()]
    labels = ("Cusick drape, 30 cm specimen on an 18 cm disc", "bending length [mm]", "drape coefficient [%]")
    return _curves(folder / "validation_drape.png", curves, labels, log="")


assert set(_TITLES) == set(FAMILIES)
