"""Pictures of the trade-off: cost against error with the front, and the ways against super-elasticity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from clothgym.benchmarks.frame import Row
from clothgym.benchmarks.machine import pyplot
from clothgym.benchmarks.tradeoff.front import Point, clamped, front
from clothgym.benchmarks.tradeoff.show import floors, of_kind, points, subjects_in
from clothgym.benchmarks.tradeoff.subjects import SUBJECTS

_COLOURS = {
    "xpbd": "#1f77b4",
    "xpbd continuum": "#17becf",
    "xpbd with bending": "#8c564b",
    "symplectic_euler": "#d62728",
    "runge_kutta": "#ff7f0e",
    "implicit_euler": "#2ca02c",
    "global": "#9467bd",
}
_FIELD_COLOUR = "#7f7f7f"
_PRESETS = {"draft": "#f2c14e", "balanced": "#e4572e", "accurate": "#a31621"}


def plots(rows: list[Row], folder: Path) -> list[Path]:
    """One picture a scene, and one of strain limiting."""
    folder.mkdir(parents=True, exist_ok=True)
    found = [_plot_front(rows, name, folder / f"tradeoff_{name}.png") for name in subjects_in(rows)]
    if of_kind(rows, "strain"):
        found.append(_plot_strain(of_kind(rows, "strain"), folder / "tradeoff_strain.png"))
    return found


def _solver(label: str, fields: dict[str, Any]) -> str:
    name = fields.get("integrator", "xpbd")
    if name == "xpbd" and fields.get("membrane") == "continuum":
        return "xpbd continuum"
    return "xpbd with bending" if fields.get("bending") else name


def _plot_front(rows: Sequence[Row], name: str, path: Path) -> Path:
    plt = pyplot()
    errors, own, limits = SUBJECTS[name].errors[:2], points(rows, name), floors(rows, name)
    by_label = {point.label: point for point in own}
    figure, panels = plt.subplots(1, 2, figsize=(13.5, 5.6), constrained_layout=True)
    for number, (axes, error) in enumerate(zip(panels, errors)):
        # what is right to rounding must not stretch the picture over fifteen powers of ten
        values = [max(point.errors[number], limits[number]) for point in own if point.errors[number] > 0.0]
        least = max(0.6 * min(values, default=1e-3), 1e-4 * max(values, default=1.0))
        named: list[tuple[float, float]] = []
        for row in of_kind(rows, "run", name):
            p = row["parameters"]
            if p["label"] in by_label:
                _draw(axes, p, by_label[p["label"]], number, least, named)
        _draw_front(axes, front(clamped(own, limits), number), number, least)
        if limits[number] > 0.7 * least:
            axes.axhspan(0.5 * least, limits[number], color="0.92", zorder=0)
            axes.text(
                0.99, limits[number], "below: the reference cannot tell", fontsize=7.5, color="0.4", ha="right",
                va="top", transform=axes.get_yaxis_transform(), clip_on=True,
            )  # fmt: skip
        _logarithmic(axes)
        axes.set_ylim(bottom=0.7 * least)
        left, right = axes.get_xlim()
        axes.set_xlim(0.45 * left, 1.7 * right)  # room for names
        axes.set_xlabel("cost [ms of one core per simulated second]   ← cheaper")
        axes.set_ylabel(f"{error.text} [{error.unit}]")
    _tell_missing(panels[1], of_kind(rows, "run", name), by_label)
    figure.suptitle(
        f"{name}: {SUBJECTS[name].text}\nlower left is better; the black line joins what nothing else beats; "
        "zero is drawn at the bottom",
        fontsize=11,
    )
    handles, labels = _legend(panels)
    figure.legend(handles, labels, loc="outside lower center", ncols=min(6, len(labels)), fontsize=8.5, frameon=False)
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path


def _logarithmic(axes: Any) -> None:
    """Both axes, with plain numbers at 1, 2 and 5 of every power of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0), numticks=40))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())
        axis.set_minor_formatter(NullFormatter())
    axes.tick_params(labelsize=8)
    axes.grid(True, which="major", color="0.92", lw=0.6)


def _tell_missing(axes: Any, rows: Sequence[Row], shown: dict[str, Point]) -> None:
    """Names what has no mark because it blew up or was refused."""
    missing = [row["parameters"]["label"] for row in rows if row["parameters"]["label"] not in shown]
    if missing:
        text = "blew up or refused:\n" + "\n".join(missing[:6]) + ("\n..." if len(missing) > 6 else "")
        axes.text(
            0.985, 0.985, text, fontsize=7.5, color="#a31621", ha="right", va="top", transform=axes.transAxes, zorder=8,
            bbox={"boxstyle": "round,pad=0.3", "fc": "white", "ec": "#a31621", "lw": 0.6, "alpha": 0.85},
        )  # fmt: skip


def _draw(
    axes: Any, parameters: dict[str, Any], point: Point, number: int, least: float, named: list[tuple[float, float]]
) -> None:
    """A setting as a mark: presets as stars with their names, promises as diamonds, solvers by colour, fields small.

    Places that have a name already are in `named`: a promise there gets none.
    """
    x, y = point.cost, max(point.errors[number], least)
    group, label = parameters["group"], parameters["label"]
    taken = any(abs(math.log(x / a)) < 0.15 and abs(math.log(y / b)) < 0.15 for a, b in named)
    if group in ("preset", "target"):
        named.append((x, y))
    if group == "preset":
        axes.plot(x, y, "*", ms=19, color=_PRESETS[label], mec="k", mew=0.9, zorder=6, label=f"preset {label}")
        axes.annotate(
            label, (x, y), (9, 8), textcoords="offset points", fontsize=9.5, weight="bold", zorder=7,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.75},
        )  # fmt: skip
    elif group == "target":
        axes.plot(x, y, "D", ms=6, color="white", mec="k", mew=1.1, zorder=5, label="promise of for_error")
        if not taken:
            axes.annotate(
                label, (x, y), (-7, -4), textcoords="offset points", fontsize=7.5, ha="right", va="top", zorder=7
            )
    elif group == "field":
        axes.plot(x, y, "x", ms=5, color=_FIELD_COLOUR, mew=1.2, zorder=3, label="a preset with one field changed")
    else:
        solver = _solver(label, parameters["fields"])
        axes.plot(x, y, "o", ms=6, color=_COLOURS[solver], mec="white", mew=0.5, zorder=4, label=solver)


def _draw_front(axes: Any, best: Sequence[Point], number: int, least: float) -> None:
    if not best:
        return
    xs: list[float] = []
    ys: list[float] = []
    for point in best:
        y = max(point.errors[number], least)
        if xs:
            xs.append(point.cost)
            ys.append(ys[-1])
        xs.append(point.cost)
        ys.append(y)
    axes.plot(xs, ys, "k-", lw=1.1, alpha=0.8, zorder=2, label="front")
    for point in _spread(best):
        if point.label not in _PRESETS and not point.label.startswith("within"):
            axes.annotate(
                point.label, (point.cost, max(point.errors[number], least)), (-4, -9), textcoords="offset points",
                fontsize=6.8, color="0.25", ha="right", zorder=7,
            )  # fmt: skip


def _spread(best: Sequence[Point], apart: float = 1.6) -> list[Point]:
    """Of neighbours on the front that cost almost the same, the first: names must not cover each other."""
    kept: list[Point] = []
    for point in best:
        if not kept or point.cost > apart * kept[-1].cost:
            kept.append(point)
    return kept


def _legend(panels: Sequence[Any]) -> tuple[list[Any], list[str]]:
    found: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels()):
            found.setdefault(label, handle)
    return list(found.values()), list(found)


def _plot_strain(rows: Sequence[Row], path: Path) -> Path:
    """Stretch at the end against cost, of every arm at its own step and at a quarter of it."""
    plt = pyplot()
    places = list(dict.fromkeys(row["parameters"]["place"] for row in rows))
    figure, panels = plt.subplots(
        1, len(places), figsize=(6.6 * len(places), 5.4), squeeze=False, constrained_layout=True
    )
    titles = {"corners": "held by two corners: stretch is local", "side": "held by a whole side: stretch is global"}
    for axes, place in zip(panels[0], places):
        for row in rows:
            if row["parameters"]["place"] == place:
                _draw_arm(axes, row["parameters"]["arm"], row["result"])
        axes.axhline(10.0, color="0.5", lw=0.9, ls="--")
        axes.text(0.99, 10.4, "limit", fontsize=7.5, color="0.4", ha="right", transform=axes.get_yaxis_transform())
        _logarithmic(axes)
        axes.set_xlim(right=axes.get_xlim()[1] * 1.8)
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, 5.0), max(high, 20.0))
        axes.set_xlabel("cost [ms of one core per simulated second]")
        axes.set_ylabel("largest stretch at the end [%]")
        axes.set_title(titles.get(place, place), fontsize=10)
    figure.suptitle(
        "Ways against super-elasticity: circle = own time step, square = a quarter of it; arms that blew up have no mark",
        fontsize=11,
    )
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path


def _draw_arm(axes: Any, arm: str, result: dict[str, Any]) -> None:
    colour, ends = _arm_colour(arm), []
    for kind, marker, size in (("own", "o", 7), ("finer", "s", 5)):
        run = result[kind]
        if run["blew_up_at"] is None:
            ends.append((run["ms_per_second"], 100 * run["end"]))
            axes.plot(*ends[-1], marker, color=colour, ms=size, mec="white", mew=0.5)
    if len(ends) == 2:
        axes.plot(*zip(*ends), "-", color=colour, lw=0.8, alpha=0.6)
    if ends:
        below = arm.startswith(("(b)", "xpbd")) or arm == "soft springs"
        lower = (-22 if "4 sweeps" in arm else -12) if below else 5
        axes.annotate(arm, ends[0], (4, lower), textcoords="offset points", fontsize=7.5, color=colour, zorder=5)


def _arm_colour(arm: str) -> str:
    for start, colour in (("(a)", "#d62728"), ("(b)", "#2ca02c"), ("(c)", "#9467bd"), ("xpbd", "#1f77b4")):
        if arm.startswith(start):
            return colour
    return "#000000"
