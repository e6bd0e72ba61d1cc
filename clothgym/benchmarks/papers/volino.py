"""The scenes of [Volino 2006]: Figs. 1 and 2 (layers, kinds of contours), 6 (squares), 7 (faults), 8 (ribbon), 9 (failures)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from clothgym.benchmarks.frame import Case, Row
from clothgym.benchmarks.report import Table
from clothgym.benchmarks.untangling import prepare as prepare
from clothgym.benchmarks.untangling import run as run
from clothgym.benchmarks.untangling.measure import median, of_part, quantile
from clothgym.benchmarks.untangling.show import summary

_FIGURES: tuple[tuple[str, str, dict[str, Any], str], ...] = (
    ("Fig. 1", "garment_layers", {"layers": 3}, "resolved in less than ten iterations, global scheme"),
    ("Fig. 2 top", "figure_two", {"row": "top"}, "small or closed contours: local is efficient"),
    ("Fig. 2 middle", "figure_two", {"row": "middle"}, "longer, complex contours: local takes significantly more"),
    ("Fig. 2 bottom", "figure_two", {"row": "bottom"}, "straight and open: locally only the two ends act"),
    ("Fig. 9", "waist", {}, "shapes not in the text: cannot be resolved by length"),
    ("Fig. 9", "strip_through_sheet", {}, "shapes not in the text: cannot be resolved by length"),
    ("3.2", "crumple", {}, "often fails for several mangled self-intersecting shapes with dead ends"),
)


def cases(quick: bool) -> list[Case]:
    """All of its scenes, with the schemes that it compares."""
    listed = []
    for figure, tangle, settings, _ in _FIGURES:
        for strategy in ("local", "global"):
            parameters: dict[str, Any] = {
                "part": "others",
                "tangle": tangle,
                "settings": settings,
                "strategy": strategy,
                "fields": {},
            }
            parameters |= {"count": 2 if quick else 10, "seed": 0, "budget": 60, "later": 0, "followed": 0}
            listed.append(Case(f"{figure}/{tangle}/{strategy}", parameters))
    squares: dict[str, Any] = {"count": 12, "box": 0.95} if quick else {"count": 25}
    for strategy in ("none", "local", "global"):
        for seed in range(1 if quick else 3):
            fall: dict[str, Any] = {
                "part": "squares",
                "scene": "squares",
                "settings": squares,
                "strategy": strategy,
                "seed": seed,
            }
            listed.append(Case(f"Fig. 6/{strategy}/seed{seed}", fall | {"steps": 40 if quick else 60, "control": 0}))
        faults = {"part": "faults", "settings": {}, "strategy": strategy, "fields": {}, "seed": 0}
        listed.append(Case(f"Fig. 7/{strategy}", faults | {"steps": 60 if quick else 120}))
    length, steps = (6.0, 100) if quick else (120.0, 600)
    dish = {"part": "dish", "settings": {"length": length}, "strategy": "local", "fields": {}, "seed": 0}
    listed.append(Case("Fig. 8/local", dish | {"steps": steps}))
    return listed


def tables(rows: list[Row]) -> list[Table]:
    """What happens here, beside what the paper says."""
    makers: tuple[Callable[[list[Row]], list[tuple[Any, ...]]], ...] = (_kinds, _squares, _faults, _dish)
    cells = [line for make in makers for line in make(rows)]
    columns = ("figure", "scene", "strategy", "quantity", "here", "paper")
    note = (
        "One iteration of the paper is a step with its passes. Its machine: 3 GHz Pentium 4. Its extra cost of untangling was "
        '"not measurable"; here it is the share of a step in `clothgym bench untangling`.'
    )
    return [Table("[Volino 2006], figure by figure", columns, cells, note)]


def plots(rows: list[Row], folder: Path) -> list[Path]:
    """None: `clothgym bench untangling` draws them."""
    return []


def _kinds(rows: list[Row]) -> list[tuple[Any, ...]]:
    words = {(tangle, *settings.values()): (figure, text) for figure, tangle, settings, text in _FIGURES}
    lines = []
    for row in of_part(rows, "others"):
        given, found = row["parameters"], summary([row["result"]])
        figure, text = words[(given["tangle"], *given["settings"].values())]
        passes = "-" if found["passes"] is None else f"{found['passes']:.0f}"
        here = f"{100 * found['right']:.0f} % in {passes}"
        name = " ".join([given["tangle"], *map(str, given["settings"].values())])
        lines.append((figure, name, given["strategy"], "correctly resolved, passes (median)", here, text))
    return lines


def _squares(rows: list[Row]) -> list[tuple[Any, ...]]:
    own = of_part(rows, "squares")
    if not own:
        return []
    starts = [row["result"]["start"] for row in own]
    count = f"{own[0]['parameters']['settings']['count']} squares"
    lines: list[tuple[Any, ...]] = [
        ("Fig. 6", count, "-", "hits at the start", median(s["hits"] for s in starts), "roughly 2000, of 25"),
        ("Fig. 6", count, "-", "contours at the start", median(s["contours"] for s in starts), "more than hundred"),
    ]
    words = {
        "none": "falls like a clump without any improvement",
        "local": "works poorly, because of the extent of the contours",
        "global": "a large amount resolved in the first 10 iterations",
    }
    for strategy, text in words.items():
        results = [row["result"] for row in own if row["parameters"]["strategy"] == strategy]
        if not results:
            continue
        left = median(r["length_ratio"]["10"] for r in results)
        lines.append(("Fig. 6", count, strategy, "length left after 10 steps, of the start", left, text))
        clean = quantile((r["first_clean_step"] for r in results), 0.5)
        text = "quickly leading to a totally intersection-free configuration" if strategy == "global" else "-"
        lines.append(("Fig. 6", count, strategy, "first step without hits", clean, text))
        seconds = median(r["step_seconds"] for r in results)
        lines.append(("Fig. 6", count, strategy, "a step [s]", seconds, "0.2 to 0.4"))
    return lines


def _faults(rows: list[Row]) -> list[tuple[Any, ...]]:
    words = {
        "none": "they quickly expand, breaking the simulation",
        "local": "fairly efficient as long as regions do not expand too much",
        "global": "better robustness in more difficult cases",
    }
    lines: list[tuple[Any, ...]] = []
    for row in of_part(rows, "faults"):
        strategy, found = row["parameters"]["strategy"], row["result"]
        where = ("Fig. 7", "faulty_detection", strategy)
        lines.append((*where, "true length, mean [edges]", found["mean_length"], words.get(strategy, "-")))
        lines.append((*where, "true length, last quarter [edges]", found["last_quarter"], "-"))
        resolved = "most are resolved in only 1 or 2 frames" if strategy != "none" else "-"
        lines.append((*where, "life of a contour, median [steps]", found["life"], resolved))
        rate = 1.0 / found["step_seconds"] if found["step_seconds"] else None
        lines.append((*where, "steps a second, 2,304 triangles", rate, "about 12, of about 2400 polygons"))
    return lines


def _dish(rows: list[Row]) -> list[tuple[Any, ...]]:
    lines: list[tuple[Any, ...]] = []
    for row in of_part(rows, "dish"):
        found = row["result"]
        name = f"ribbon of {row['parameters']['settings']['length']:g} m, {found['triangles']} triangles"
        where = ("Fig. 8", name, row["parameters"]["strategy"])
        lines.append((*where, "hits at the end", found["end_hits"], "correct untangling at the end of the simulation"))
        lines.append((*where, "a step [s]", found["step_seconds"], "3 to 30, of about 80000 polygons"))
        lines.append((*where, "contacts a substep", found["contacts"], "several tens of thousands"))
    return lines
