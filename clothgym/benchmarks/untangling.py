"""`clothgym bench untangling`: 25 intersecting squares fall on the ground, with every strategy [Volino 2006, 3.1.1, Fig. 6]."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks.frame import Benchmark, Case, Row
from clothgym.benchmarks.machine import pyplot
from clothgym.benchmarks.report import Table

STRATEGIES = ("none", "local", "global", "hybrid")
MARKS = (5, 10, 15, 30)
"""Steps at which the contour length is compared with that of the start; the last one is the bound of "clean in time"."""
SETTLING = 30
"""Steps after the first clean one from which strain counts as lasting."""

_PAPER = {
    "none": "falls like a clump without any improvement",
    "local": "works poorly, because of the extent of the contours",
    "global": "a large amount resolved in the first 10 iterations; quickly totally intersection-free",
    "hybrid": "not measured; 3.2 advises to identify regions whenever possible",
}
_STAGES = ("intersections", "untangle")
_COLOURS = {"none": "0.45", "local": "tab:orange", "global": "tab:blue", "hybrid": "tab:green"}
_NOTES = (
    "Volino and Magnenat-Thalmann 2006, 3.1.1: 25 squares of about 300 polygons, more than hundred contours, roughly 2000 "
    "edge-polygon intersections, global scheme, 0.2 to 0.4 s per iteration on a 3 GHz Pentium 4, extra cost not measurable. "
    "Sizes, poses, thickness, time step and material are not given there. A run is clean when no exact hit is left; "
    "a short contour alone can be collected by pinching, which shows in the strain. The clean pile is the control: "
    "hits there come from contact, not from untangling. Quick runs take fewer squares and steps."
)


def cases(quick: bool) -> list[Case]:
    """Strategies x seeds, and the clean pile without untangling."""
    seeds, steps, pile_seeds, pile_steps = (2, 40, 1, 40) if quick else (10, 330, 3, 300)
    squares: dict[str, Any] = {"count": 12, "box": 0.95} if quick else {"count": 25}  # the same density
    pile: dict[str, Any] = {"count": squares["count"]}
    listed = [
        Case(
            f"squares/{strategy}/seed{seed}",
            {
                "scene": "squares",
                "strategy": strategy,
                "seed": seed,
                # what stays tangled shows all there is to see in the first second
                "steps": steps if strategy in ("global", "hybrid") else min(steps, 100),
                **squares,
            },
        )
        for strategy in ("global", "none", "hybrid", "local")  # a run that is cut short has the paper's question first
        for seed in range(seeds)
    ]
    return listed + [
        Case(f"pile/seed{seed}", {"scene": "pile", "strategy": "none", "seed": seed, "steps": pile_steps, **pile})
        for seed in range(pile_seeds)
    ]


def prepare() -> None:
    """Compiles every kernel that a case uses."""
    scene = cg.scenes.make("squares", count=4, box=0.5, cells=4)
    for strategy in STRATEGIES:
        simulation = cg.Simulation(scene, cg.Fidelity(untangling=strategy))
        simulation.step(2)
        simulation.metrics()


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One fall: `scene`, `strategy`, `seed`, `steps`; all others are parameters of the scene."""
    settings = dict(parameters)
    name, strategy, steps = settings.pop("scene"), settings.pop("strategy"), int(settings.pop("steps"))
    simulation = cg.Simulation(cg.scenes.make(name, **settings), cg.Fidelity(untangling=strategy))
    measured = [simulation.metrics()]
    seconds: list[float] = []
    failure = ""
    for _ in range(steps):
        started = time.perf_counter()
        try:
            simulation.step()
        except cg.SimulationError as error:
            failure = str(error)
            break
        seconds.append(time.perf_counter() - started)
        measured.append(simulation.metrics())
    hits = [int(m["hits"]) for m in measured]
    strains = [m["max_strain"] for m in measured]
    history = {
        "hits": hits,
        "contours": [int(m["contour_count"]) for m in measured],
        "length": [m["contour_length"] for m in measured],
    }
    return {
        "start": {key: values[0] for key, values in history.items()},
        "end": {key: values[-1] for key, values in history.items()},
        "history": history,
        **judge(hits, history["length"], strains),
        "failure": failure,
        "untangling_passes": measured[-1]["untangling_passes"],
        "work": measured[-1]["work"],
        "step_seconds": statistics.median(seconds) if seconds else None,
        "untangling_share": _untangling_share(simulation),
    }


def judge(hits: list[int], length: list[float], strains: list[float]) -> dict[str, Any]:
    """What a fall was worth, from its histories (start and every step).

    Returns:
        first_clean_step: first step without hits, None = never; returns: most hits in any later step, returning_steps how
        many steps had some; length_ratio: contour length over that of the start at the steps of `MARKS`;
        strain_until_clean: largest up to the first clean step (or the end); strain_later: largest from 30 steps after it.
    """
    first = next((step for step, count in enumerate(hits) if count == 0), None)
    later = [] if first is None else hits[first + 1 :]
    settled = [] if first is None else strains[first + SETTLING :]
    start = length[0]
    ratios = {str(mark): length[mark] / start if mark < len(length) and start > 0.0 else None for mark in MARKS}
    return {
        "first_clean_step": first,
        "returns": max(later, default=0) if first is not None else None,
        "returning_steps": sum(count > 0 for count in later) if first is not None else None,
        "length_ratio": ratios,
        "strain_until_clean": max(strains if first is None else strains[: first + 1]),
        "strain_later": max(settled, default=None),
    }


def _untangling_share(simulation: cg.Simulation) -> float | None:
    """Share of finding and resolving intersections in the time of all stages."""
    profile = simulation.profile
    stages = {stage.name: profile[stage.name][1] for stage in simulation.pipeline.stages}
    total = sum(stages.values())
    return sum(t for name, t in stages.items() if name.startswith(_STAGES)) / total if total > 0.0 else None


# Tables


def tables(rows: list[Row]) -> list[Table]:
    """Start, result and cost per strategy, and the control."""
    squares, pile = (_of(rows, scene) for scene in ("squares", "pile"))
    found = [_start_table(squares), _strategy_table(squares), _cost_table(squares)] if squares else []
    return found + ([_control_table(pile)] if pile else [])


def _of(rows: list[Row], scene: str, strategy: str | None = None) -> list[Row]:
    return [
        row for row in rows if row["parameters"]["scene"] == scene and strategy in (None, row["parameters"]["strategy"])
    ]


def _by_strategy(rows: list[Row]) -> list[tuple[str, list[dict[str, Any]]]]:
    groups = ((s, [row["result"] for row in _of(rows, "squares", s)]) for s in STRATEGIES)
    return [(strategy, results) for strategy, results in groups if results]


def _quantile(values: Iterable[float | None], share: float) -> float | None:
    """Smallest value that at least this share of all lies at or below; None counts as infinite, and so may be the answer."""
    ordered = sorted(math.inf if value is None else value for value in values)
    value = ordered[max(math.ceil(share * len(ordered)) - 1, 0)]
    return value if math.isfinite(value) else None


def _known(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]


def _median(values: Iterable[float | None]) -> float | None:
    known = _known(values)
    return statistics.median(known) if known else None


def _start_table(rows: list[Row]) -> Table:
    starts = {row["seed"]: row["result"]["start"] for row in rows}
    quantities = (
        ("hits (edge against polygon)", "hits", "roughly 2000"),
        ("contours", "contours", "more than hundred"),
        ("contour length [m]", "length", None),
    )
    cells = []
    for title, key, paper in quantities:
        values = [start[key] for start in starts.values()]
        cells.append((title, min(values), statistics.median(values), max(values), paper))
    count = rows[0]["parameters"]["count"]
    return Table(
        f"Start: {count} squares, {len(starts)} seeds",
        ("quantity", "least", "median", "most", "paper, 25 squares"),
        cells,
    )


def _strategy_table(rows: list[Row]) -> Table:
    cells = []
    bound = MARKS[-1]
    for strategy, results in _by_strategy(rows):
        firsts = [r["first_clean_step"] for r in results]
        cells.append(
            (
                strategy,
                len(results),
                sum(first is not None and first <= bound for first in firsts) / len(results),
                _quantile(firsts, 0.5),
                _quantile(firsts, 0.9),
                *(_median(r["length_ratio"][str(mark)] for r in results) for mark in MARKS),
                sum((r["returns"] or 0) > 0 for r in results),
                max(_known(r["returns"] for r in results), default=None),
                max(r["end"]["hits"] for r in results),
                max(r["strain_until_clean"] for r in results),
                max(_known(r["strain_later"] for r in results), default=None),
                sum(bool(r["failure"]) for r in results),
                _PAPER[strategy],
            )
        )
    columns = (
        "strategy",
        "seeds",
        f"share clean by {bound}",
        "first clean step, median",
        "p90",
        *(f"L/L0 at {mark}" for mark in MARKS),
        "seeds with returns",
        "most hits after",
        "most hits at the end",
        "strain until clean",
        "strain later",
        "diverged",
        "paper",
    )
    note = (
        "First clean step: - = not reached by that share of the seeds. Returns: hits in any step after the first clean one. "
        f"L/L0: median over seeds. Strain: largest over seeds, until the first clean step (or the end) and from {SETTLING} "
        "steps after it."
    )
    return Table("Untangling, by strategy", columns, cells, note)


def _cost_table(rows: list[Row]) -> Table:
    cells = [
        (
            strategy,
            _median(r["step_seconds"] for r in results),
            _median(r["untangling_share"] for r in results),
            _median(r["untangling_passes"] for r in results),
            _median(r["work"].get("edge_triangle_tests") for r in results),
            _median(r["work"].get("box_pairs") for r in results),
            _median(r["work"].get("contacts") for r in results),
        )
        for strategy, results in _by_strategy(rows)
    ]
    columns = (
        "strategy",
        "step [s]",
        "share of untangling",
        "passes",
        "edge-triangle tests",
        "face pairs",
        "contacts",
    )
    note = (
        "Medians over seeds; counters over the whole run. Paper: 0.2 to 0.4 s, extra cost of untangling not measurable."
    )
    return Table("Cost", columns, cells, note)


def _control_table(rows: list[Row]) -> Table:
    cells = []
    for row in rows:
        hits = row["result"]["history"]["hits"]
        cells.append(
            (
                row["parameters"]["count"],
                row["seed"],
                len(hits) - 1,
                sum(count > 0 for count in hits),
                max(hits),
                max(row["result"]["strain_until_clean"], row["result"]["strain_later"] or 0.0),
                row["result"]["step_seconds"],
                row["result"]["failure"] or None,
            )
        )
    columns = ("squares", "seed", "steps", "steps with hits", "most hits", "strain", "step [s]", "failure")
    note = "Stacked without intersections, dropped, untangling none: contact alone must keep every step at zero hits."
    return Table("Control: clean pile", columns, cells, note)


# Plots


def plots(rows: list[Row], folder: Path) -> list[Path]:
    """L/L0 and hits over the steps: median and range over the seeds of each strategy."""
    squares = _of(rows, "squares")
    if not squares:
        return []
    lengths = {s: _histories(results, "length", relative=True) for s, results in _by_strategy(squares)}
    hits = {s: _histories(results, "hits") for s, results in _by_strategy(squares)}
    folder.mkdir(parents=True, exist_ok=True)
    return [
        _plot(lengths, "contour length / start", (1e-3, "symlog"), folder / "untangling_length.png"),
        _plot(hits, "hits", (10.0, "symlog"), folder / "untangling_hits.png"),
    ]


def _histories(results: list[dict[str, Any]], key: str, relative: bool = False) -> np.ndarray:
    """(seeds, steps + 1), NaN after a run that diverged."""
    histories = [result["history"][key] for result in results]
    table = np.full((len(histories), max(map(len, histories))), np.nan)
    for row, history in zip(table, histories):
        row[: len(history)] = np.asarray(history, float) / (history[0] if relative and history[0] else 1.0)
    return table


def _plot(curves: dict[str, np.ndarray], label: str, scale: tuple[float, str], path: Path) -> Path:
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(8.0, 4.5), constrained_layout=True)
    threshold, kind = scale
    axes.set_yscale(kind, linthresh=threshold)
    for strategy, table in curves.items():
        steps = np.arange(table.shape[1])
        colour = _COLOURS[strategy]
        seen = ~np.isnan(table).all(axis=0)
        axes.fill_between(
            steps[seen],
            np.nanmin(table[:, seen], axis=0),
            np.nanmax(table[:, seen], axis=0),
            color=colour,
            alpha=0.15,
            lw=0,
        )
        axes.plot(
            steps[seen], np.nanmedian(table[:, seen], axis=0), color=colour, label=f"{strategy} ({len(table)} seeds)"
        )
    for mark in (10, MARKS[-1]):
        axes.axvline(mark, color="0.7", lw=0.8, ls=":")
    axes.set_ylim(bottom=0.0)
    axes.set_xlim(left=0)
    axes.set_xlabel("step")
    axes.set_ylabel(label)
    axes.set_title(
        f"Falling squares [Volino 2006, Fig. 6]: {label}; line = median, band = range over seeds", fontsize=10
    )
    axes.legend(fontsize=9)
    figure.savefig(path, dpi=130)
    plt.close(figure)
    return path


benchmark = Benchmark(
    name="untangling",
    title="Untangling of falling squares, by strategy [Volino 2006, Fig. 6]",
    cases=cases,
    run=run,
    tables=tables,
    plots=plots,
    prepare=prepare,
    notes=_NOTES,
)
