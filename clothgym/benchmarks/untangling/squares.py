"""25 intersecting squares fall on the ground, with every strategy [Volino 2006, 3.1.1, Fig. 6]; and a clean pile as control."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks.frame import Row
from clothgym.benchmarks.machine import pyplot
from clothgym.benchmarks.report import Table
from clothgym.benchmarks.untangling.measure import (
    Histories,
    control,
    known,
    median,
    of_part,
    quantile,
    untangling_share,
)
from clothgym.response.untangling import names

FIELDS: dict[str, Any] = {"speed_limit": 5.0}
"""Beside the default fidelity: corrections go into the velocity as a whole, for h0 a step is 5 m/s."""
MARKS = (5, 10, 15, 30)
"""Steps at which the contour length is compared with that of the start; the last one is the bound of "clean in time"."""
SETTLING = 30
"""Steps after the first clean one from which strain counts as lasting."""

PAPER = {
    "none": "falls like a clump without any improvement",
    "local": "works poorly, because of the extent of the contours",
    "global": "a large amount resolved in the first 10 iterations; quickly totally intersection-free",
    "hybrid": "not measured; 3.2 advises to identify regions whenever possible",
}


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One fall: `scene` with its `settings`, `strategy`, `seed`, `steps`; `control`: steps that a copy goes on without
    untangling from where the run is first clean."""
    fidelity = cg.Fidelity(**(FIELDS | parameters.get("fields", {}) | {"untangling": parameters["strategy"]}))
    scene = cg.scenes.make(parameters["scene"], **parameters["settings"], seed=parameters["seed"])
    simulation = cg.Simulation(scene, fidelity)
    histories = Histories(simulation)
    first_clean: list[Any] = []

    def look() -> None:
        if histories.clean and not first_clean:
            first_clean.append(simulation.snapshot())

    histories.play(parameters["steps"], look)
    share, measured = untangling_share(simulation), simulation.metrics()
    history: dict[str, list[Any]] = {"hits": histories.hits, "contours": histories.contours, "length": histories.length}
    alone = None
    if first_clean and parameters["control"]:
        alone = control(simulation, first_clean[0], parameters["control"])
    return {
        "start": {key: values[0] for key, values in history.items()},
        "end": {key: values[-1] for key, values in history.items()},
        "history": history,
        **judge(histories.hits, histories.length, histories.strains),
        "control": alone,
        "failure": histories.failure,
        "untangling_passes": measured["untangling_passes"],
        "work": measured["work"],
        "step_seconds": statistics.median(histories.seconds) if histories.seconds else None,
        "untangling_share": share,
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


# Tables


def tables(rows: list[Row]) -> list[Table]:
    """Start, result and cost per strategy, and the control."""
    squares, pile = (of_part(rows, part) for part in ("squares", "pile"))
    found = [_start_table(squares), _strategy_table(squares), _cost_table(squares)] if squares else []
    return found + ([_control_table(pile)] if pile else [])


def _by_strategy(rows: list[Row]) -> list[tuple[str, list[dict[str, Any]]]]:
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(row["parameters"]["strategy"], []).append(row["result"])
    return list(groups.items())


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
    count = rows[0]["parameters"]["settings"]["count"]
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
                quantile(firsts, 0.5),
                quantile(firsts, 0.9),
                *(median(r["length_ratio"][str(mark)] for r in results) for mark in MARKS),
                sum((r["returns"] or 0) > 0 for r in results),
                max(known(r["returns"] for r in results), default=None),
                max(known(r["control"] for r in results), default=None),
                max(r["end"]["hits"] for r in results),
                max(r["strain_until_clean"] for r in results),
                max(known(r["strain_later"] for r in results), default=None),
                sum(bool(r["failure"]) for r in results),
                PAPER.get(strategy),
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
        "the same without untangling",
        "most hits at the end",
        "strain until clean",
        "strain later",
        "diverged",
        "paper",
    )
    note = (
        "First clean step: - = not reached by that share of the seeds. Returns: hits in any step after the first clean one; "
        "without untangling: the most hits of a copy that goes on without it from there, where that was asked for. "
        f"L/L0: median over seeds. Strain: largest over seeds, until the first clean step (or the end) and from {SETTLING} "
        "steps after it."
    )
    return Table("Untangling, by strategy", columns, cells, note)


def _cost_table(rows: list[Row]) -> Table:
    cells = [
        (
            strategy,
            median(r["step_seconds"] for r in results),
            median(r["untangling_share"] for r in results),
            median(r["untangling_passes"] for r in results),
            median(r["work"].get("edge_triangle_tests") for r in results),
            median(r["work"].get("box_pairs") for r in results),
            median(r["work"].get("contacts") for r in results),
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
                row["parameters"]["settings"]["count"],
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
    squares = of_part(rows, "squares")
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
    plt, colours = pyplot(), strategy_colours(list(curves))
    figure, axes = plt.subplots(figsize=(8.0, 4.5), constrained_layout=True)
    threshold, kind = scale
    axes.set_yscale(kind, linthresh=threshold)
    for strategy, table in curves.items():
        steps = np.arange(table.shape[1])
        colour = colours[strategy]
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


def strategy_colours(strategies: list[str]) -> dict[str, Any]:
    """A colour for each strategy, the same in every plot for those that the package has."""
    palette = pyplot().get_cmap("tab10").colors
    ordered = dict.fromkeys([name for name in names() if name != "none"] + [s for s in strategies if s != "none"])
    return {"none": "0.45"} | {name: palette[n % 10] for n, name in enumerate(ordered)}
