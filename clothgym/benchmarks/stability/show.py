"""Tables and pictures of the stability benchmark."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from clothgym.benchmarks.frame import Row
from clothgym.benchmarks.machine import pyplot
from clothgym.benchmarks.report import Table
from clothgym.benchmarks.stability.watch import OUTCOMES

_COLOURS = {"stable": "#4c9f70", "degraded": "#f2c14e", "stopped": "#d1495b", "refused": "#9aa5b1"}


def tables(rows: list[Row]) -> list[Table]:
    """Outcomes per variant, extremes, limits, inputs."""
    runs = _of(rows, "map") + _of(rows, "extreme")
    found = [_summary(runs)] if runs else []
    for kind, table in (
        ("map", _map_table),
        ("extreme", _extreme_table),
        ("limit", _limit_table),
        ("input", _input_table),
    ):
        chosen = _of(rows, kind)
        if chosen:
            found.append(table(chosen))
    return found


def _of(rows: list[Row], kind: str) -> list[Row]:
    return [row for row in rows if row["parameters"]["kind"] == kind]


def _by(rows: Iterable[Row], *names: str) -> dict[tuple[Any, ...], list[Row]]:
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row["parameters"][name] for name in names), []).append(row)
    return groups


def _summary(rows: list[Row]) -> Table:
    cells = []
    for (kind, variant), group in _by(rows, "kind", "variant").items():
        results = [row["result"] for row in group]
        counts = Counter(result["outcome"] for result in results)
        cells.append(
            (
                kind,
                variant,
                *(counts[outcome] for outcome in OUTCOMES),
                sum(bool(result["silent"]) for result in results),
                sum(bool(result["not_finite"]) for result in results),
            )
        )
    note = (
        "Silent: wrong by the benchmark's criteria without a flag. Not finite: a number that is none reached the user."
    )
    return Table("Outcomes", ("cases", "variant", *OUTCOMES, "silent", "not finite"), cells, note)


def _map_table(rows: list[Row]) -> Table:
    """Largest time step of each outcome, per variant and stiffness, beside the prediction."""
    cells = []
    for (variant, factor), group in _by(rows, "variant", "stiffness").items():
        results = [row["result"] for row in group]

        def largest(outcome: str, results: list[dict[str, Any]] = results) -> float | None:
            return max((r["dt"] for r in results if r["outcome"] == outcome), default=None)

        peaks = [r["peaks"]["stretch"] for r in results if "peaks" in r and r["peaks"]["stretch"] is not None]
        cells.append(
            (
                variant,
                factor,
                largest("stable"),
                largest("degraded"),
                min((r["dt"] for r in results if r["outcome"] == "stopped"), default=None),
                min((r["dt"] for r in results if r["outcome"] == "refused"), default=None),
                results[0]["limit"],
                max(peaks, default=None),
            )
        )
    columns = (
        "variant",
        "stiffness x",
        "largest stable dt [s]",
        "largest degraded dt [s]",
        "least stopped dt [s]",
        "least refused dt [s]",
        "bound of symplectic Euler [s]",
        "peak stretch",
    )
    note = (
        "One substep a step, no contact; structural springs of 1e3 N/m x the factor. Bound: Gershgorin, with damping."
    )
    return Table("Time step x stiffness", columns, cells, note)


def _extreme_table(rows: list[Row]) -> Table:
    cells = []
    for row in rows:
        result, parameters = row["result"], row["parameters"]
        peaks = result.get("peaks", {})
        cells.append(
            (
                parameters["variant"],
                parameters["name"],
                parameters["value"],
                result["outcome"],
                ", ".join(result["flags"]) or None,
                ", ".join(result["silent"] + result["not_finite"]) or None,
                peaks.get("stretch"),
                peaks.get("compression"),
                peaks.get("speed"),
                peaks.get("energy"),
                result.get("substeps"),
                _short(result["error"]),
            )
        )
    columns = (
        "variant", "quantity", "value", "outcome", "flags", "silent", "peak stretch", "peak compression",
        "peak speed [m/s]", "peak energy", "substeps", "error",
    )  # fmt: skip
    note = "Energy: motion and height beyond the start's energy, in weight x size + elastic energy at the start."
    return Table("Extremes", columns, cells, note)


def _short(error: str) -> str | None:
    return (error if len(error) <= 100 else f"{error[:97]}...") or None


def _limit_table(rows: list[Row]) -> Table:
    cells = []
    for row in rows:
        p, r = row["parameters"], row["result"]
        cells.append(
            (
                p["grid"], p["amplitude"], p["modification"], p["damping"], r["quiet"], r["bounded"], r["gershgorin"],
                r["exact"], r["endless"], r["paper"], r["paper"] / r["quiet"],
                "diverged" if r["long_strain"] is None else r["long_strain"],
            )
        )  # fmt: skip
    columns = (
        "ks, kd, kf", "amplitude [edges]", "modification", "damping", "quiet dt", "bounded dt", "Gershgorin", "exact",
        "endless grid", "Vassilev eq. 4", "eq. 4 / quiet", "long strain",
    )  # fmt: skip
    note = (
        "Symplectic Euler; times in sqrt(m / K), damping in sqrt(K / m). Measured by bisection: quiet = energy stays below "
        "100 x the start's in 600 substeps, bounded = strain stays below 100. Exact: dense eigenvalues of this grid; endless: "
        "lambda_max of an endless grid. Long strain: peak over 6000 substeps at a tenth of the exact limit."
    )
    return Table("Largest stable time step of symplectic Euler, measured and predicted", columns, cells, note)


def _input_table(rows: list[Row]) -> Table:
    cells = []
    for row in rows:
        results = row["result"]
        cells.append(
            (
                row["parameters"]["name"],
                *(results[word]["outcome"] for word in results),
                all(r["unchanged"] for r in results.values()),
                all(r["named"] for r in results.values()),
                _short(results["nan"]["error"]),
            )
        )
    columns = ("input", "nan", "inf", "-inf", "state unchanged", "value named", "line")
    return Table("Numbers that are none, in every input", columns, cells, "Every input must be refused.")


# Plots


def plots(rows: list[Row], folder: Path) -> list[Path]:
    """Outcome over time step and stiffness, per variant; limits beside their predictions."""
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    mapped, limits = _of(rows, "map"), _of(rows, "limit")
    if mapped:
        found.append(_plot_map(mapped, folder / "stability_map.png"))
    if limits:
        found.append(_plot_limits(limits, folder / "stability_limits.png"))
    return found


def _plot_map(rows: list[Row], path: Path) -> Path:
    plt = pyplot()
    groups = _by(rows, "variant")
    columns = min(3, len(groups))
    lines = math.ceil(len(groups) / columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(4.6 * columns, 3.9 * lines + 0.7), squeeze=False, constrained_layout=True
    )
    for place in axes.flat[len(groups) :]:
        place.set_visible(False)
    for place, ((variant,), group) in zip(axes.flat, groups.items()):
        _draw_map(place, variant, group)
    handles = [plt.Rectangle((0, 0), 1, 1, color=_COLOURS[outcome]) for outcome in OUTCOMES]
    handles.append(plt.Line2D([], [], color="k", ls="--"))
    labels = [*OUTCOMES, "Gershgorin bound of symplectic Euler"]
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=9, frameon=False)
    figure.suptitle("Outcome over time step and stiffness; number = peak stretch of the run", fontsize=11)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _draw_map(axes: Any, variant: str, rows: list[Row]) -> None:
    steps = sorted({row["parameters"]["step"] for row in rows})
    factors = sorted({row["parameters"]["stiffness"] for row in rows})
    for row in rows:
        result, parameters = row["result"], row["parameters"]
        column, line = steps.index(parameters["step"]), factors.index(parameters["stiffness"])
        axes.fill_between((column - 0.5, column + 0.5), line - 0.5, line + 0.5, color=_COLOURS[result["outcome"]], lw=0)
        stretch = result.get("peaks", {}).get("stretch")
        if stretch is not None:
            text = f"{stretch:.2g}" if stretch < 100 else f"{stretch:.0e}"
            axes.text(column, line, text, ha="center", va="center", fontsize=6)
        if result["silent"] or result["not_finite"]:
            axes.text(column, line - 0.32, "silent", ha="center", va="center", fontsize=5, color="darkred")
    # the bound, in the coordinates of the cells: both axes are logarithmic
    base = min(row["result"]["dt"] / row["parameters"]["step"] for row in rows)
    bound = [next(r["result"]["limit"] for r in rows if r["parameters"]["stiffness"] == f) for f in factors]
    places = np.interp(
        np.log(np.array(bound) / base), np.log(steps), np.arange(len(steps)), left=-1.0, right=len(steps)
    )
    axes.plot(places, np.arange(len(factors)), "k--", lw=1.0)
    axes.set_xlim(-0.5, len(steps) - 0.5)
    axes.set_ylim(-0.5, len(factors) - 0.5)
    axes.set_xticks(range(len(steps)), [f"{step:g}" for step in steps], fontsize=7)
    axes.set_yticks(range(len(factors)), [f"{factor:g}" for factor in factors], fontsize=7)
    axes.set_xlabel(f"time step / {base:.3g} s", fontsize=8)
    axes.set_ylabel("stiffness / (1e3 N/m)", fontsize=8)
    axes.set_title(variant, fontsize=9)


def _plot_limits(rows: list[Row], path: Path) -> Path:
    plt = pyplot()
    free = [row for row in rows if row["parameters"]["damping"] == 0.0]
    groups = _by(free, "grid")
    figure, axes = plt.subplots(figsize=(9.0, 4.6), constrained_layout=True)
    styles = {
        ("none", False): ("o", "tab:blue"), ("none", True): ("o", "tab:cyan"),
        ("literal", False): ("s", "tab:red"), ("literal", True): ("s", "tab:orange"),
        ("relative", False): ("^", "tab:green"), ("relative", True): ("^", "tab:olive"),
    }  # fmt: skip
    for column, group in enumerate(groups.values()):
        first = group[0]["result"]
        for value, style, label in (
            (first["gershgorin"], "k-", "Gershgorin bound (library)"),
            (first["exact"], "k:", "exact, flat state"),
            (first["paper"], "r--", "0.4 pi [Vassilev 2001, eq. 4]"),
        ):
            axes.plot([column - 0.4, column + 0.4], [value, value], style, label=label if column == 0 else None)
        for row in group:
            p = row["parameters"]
            large = p["amplitude"] > 1e-3
            marker, colour = styles[p["modification"], large]
            offset = 0.12 * (list(styles).index((p["modification"], large)) - 2.5)
            name = f"{p['modification']}, {p['amplitude']:g} edges" if column == 0 else None
            axes.plot(column + offset, row["result"]["quiet"], marker, color=colour, label=name)
    axes.set_xticks(range(len(groups)), [grid for (grid,) in groups])
    axes.set_xlabel("structural, diagonal, skipping springs (K)")
    axes.set_ylabel("largest quiet time step / sqrt(m / K)")
    axes.set_ylim(bottom=0.0)
    axes.set_title("Symplectic Euler: measured (marks, 600 substeps) and predicted (lines)", fontsize=10)
    axes.legend(fontsize=8, ncols=1, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path
