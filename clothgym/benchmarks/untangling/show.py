"""Tables of the untangling benchmark."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from clothgym.benchmarks.frame import Row
from clothgym.benchmarks.report import Table
from clothgym.benchmarks.untangling import figures, squares
from clothgym.benchmarks.untangling.measure import known, median, of_part, quantile

_SOON = 20
"""Passes within which what is correctly resolved counts as soon: what drifts out by chance takes longer."""
_TARGETS = {1.0: (0.99, 10, 15), 2.0: (0.99, 10, 15), 3.0: (0.99, 10, 15), 5.0: (0.95, 20, None)}
"""Of many instances, by depth: share correctly resolved, median and p90 of the passes."""
_BUDGETS = (15, 30, 60)
"""Passes within which a ribbon is asked to be out; the first is what the best strategy is allowed at p90."""
_NULLS = {"global": 0.05, "local": 0.5}
"""Largest share that schemes without regions should resolve in the first of these."""


def tables(rows: list[Row]) -> list[Table]:
    """Everything that the rows hold, part by part."""
    makers: tuple[Callable[[list[Row]], Table], ...] = (
        _many, _regions, _canonical, _resolution, _map, _progress, _others, _null, _faults, _dish, _overhead,
    )  # fmt: skip
    parts = (
        "many",
        "regions",
        "canonical",
        "resolution",
        "map",
        "progress",
        "others",
        "null",
        "faults",
        "dish",
        "overhead",
    )
    found = squares.tables(rows)
    for part, make in zip(parts, makers):
        own = of_part(rows, part)
        if own:
            found.append(make(own))
    return found


def plots(rows: list[Row], folder: Path) -> list[Path]:
    """Curves, maps and pictures of what the rows hold."""
    return squares.plots(rows, folder) + figures.plots(rows, folder)


def summary(results: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """What all instances of some rows were worth together: shares, passes, and medians."""
    of: dict[str, list[Any]] = {}
    for result in results:
        for key, values in result.items():
            of.setdefault(key, []).extend(values)
    count = len(of["passes"])
    reasons = Counter(of["reason"])
    return {
        "instances": count,
        "resolved": reasons["resolved"] / count,
        "right": sum(of["right"]) / count,
        "soon": sum(right and passes <= _SOON for right, passes in zip(of["right"], of["passes"])) / count,
        "passes": quantile(of["passes"], 0.5),
        "p90": quantile(of["passes"], 0.9),
        "area": median(of["area"]),
        "work": median(of["work"]),
        "ms": median(of["milliseconds"]),
        "strain": median(of["strain"]),
        "displacement": median(of["displacement"]),
        "others": {reason: n for reason, n in sorted(reasons.items()) if reason != "resolved"} or None,
        "returns": max(known(of["returns"]), default=None),
        "control": max(known(of["control"]), default=None),
    }


_COLUMNS = (
    *(
        "instances",
        "resolved",
        "correctly",
        f"in {_SOON}",
        "passes",
        "p90",
        "area under L/L0",
        "work units",
        "ms",
        "strain added",
    ),
    *("displacement [edges]", "not resolved", "most hits in 300 steps on", "the same without untangling"),
)
_NOTE = (
    f"Shares of all instances; in {_SOON}: correctly within as many passes; passes: median and p90, - = not reached by that "
    "share; other numbers are medians. Work units: edge-triangle tests and gradients. Not resolved: stalled = nothing better "
    "for 30 passes, budget = 60 passes, explosion = strain above 5, failure = the simulation stopped."
)


def _groups(rows: list[Row], *fields: str) -> dict[tuple[Any, ...], list[dict[str, Any]]]:
    """Results by some of the settings and the strategy, in the order of the rows."""
    found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        given = row["parameters"]["settings"] | row["parameters"]
        found.setdefault(tuple(given.get(field) for field in fields), []).append(row["result"])
    return found


def _table(title: str, rows: list[Row], fields: tuple[str, ...], note: str = _NOTE) -> Table:
    cells = [(*key, *summary(results).values()) for key, results in _groups(rows, *fields).items()]
    return Table(title, (*fields, *_COLUMNS), cells, note)


def _many(rows: list[Row]) -> Table:
    cells = []
    for (kind, depth, resolution, strategy), results in _groups(
        rows, "kind", "depth", "resolution", "strategy"
    ).items():
        found = summary(results)
        right, middle, late = _TARGETS[depth]
        within = found["passes"] is not None and found["passes"] <= middle
        if late is not None:
            within = within and found["p90"] is not None and found["p90"] <= late
        reached = found["right"] >= right and within
        cells.append(
            (kind, depth, resolution, strategy, found["instances"], found["resolved"], found["right"], found["passes"],
             found["p90"], f"{100 * right:g} % in {middle}{'' if late is None else f', p90 {late}'}", reached)
        )  # fmt: skip
    columns = ("kind", "depth [edges]", "resolution", "strategy", "instances", "resolved", "correctly", "passes", "p90")
    return Table("Many instances of the canonical kinds", (*columns, "target", "reached"), cells)


def _regions(rows: list[Row]) -> Table:
    cells: list[tuple[Any, ...]] = []
    for row in rows:
        given, found = row["parameters"], row["result"]
        passes = [p if right else None for p, right in zip(found["passes"], found["right"])]
        within = [sum(p is not None and p <= budget for p in passes) / len(passes) for budget in _BUDGETS]
        most = _NULLS.get(given["strategy"])
        cells.append(
            (given["settings"]["depth"], given["strategy"], given["fields"]["velocity_share"], len(passes), *within,
             None if most is None else f"at most {100 * most:g} %", None if most is None else within[0] <= most)
        )  # fmt: skip
    columns = (
        *("depth [edges]", "strategy", "velocity share", "instances"),
        *(f"correctly in {budget}" for budget in _BUDGETS),
        *(f"expected in {_BUDGETS[0]}", "so it is"),
    )
    note = (
        f"BBII with the unevenness of cloth; {_BUDGETS[0]} passes are what the best strategy is allowed for nine of ten. A "
        "straight contour has next to no gradient along itself: positions alone do not move it. The rest of a gradient that "
        "unevenness leaves is the same in every pass, so with velocity it adds up, and some drift out after many passes."
    )
    return Table("Why regions matter: a ribbon through a sheet", columns, cells, note)


def _canonical(rows: list[Row]) -> Table:
    return _table("Canonical kinds, by depth [edges] and strategy", rows, ("kind", "depth", "resolution", "strategy"))


def _resolution(rows: list[Row]) -> Table:
    return _table("Canonical kinds at depth 3, by resolution", rows, ("kind", "resolution", "strategy"))


def _map(rows: list[Row]) -> Table:
    cells = []
    for row in rows:
        given, found = row["parameters"], summary([row["result"]])
        fields = given["fields"]
        keys = ("resolved", "right", "passes", "p90", "strain")
        cells.append(
            (given["settings"]["kind"], given["strategy"], fields["h0"], fields["velocity_share"],
             *(found[key] for key in keys))
        )  # fmt: skip
    columns = ("kind", "strategy", "h0 [edges]", "velocity share", "resolved", "correctly", "passes", "p90", "strain")
    return Table("Largest correction and velocity share, depth 3", columns, cells)


def _progress(rows: list[Row]) -> Table:
    cells = []
    for row in rows:
        given, found = row["parameters"], summary([row["result"]])
        way = row["key"].split("/")[-2]
        name = given["settings"].get("kind", given["tangle"])
        keys = ("resolved", "right", "passes", "p90", "area", "strain", "displacement")
        cells.append((name, given["strategy"], way, *(found[key] for key in keys)))
    columns = (
        *("tangle", "strategy", "way", "resolved", "correctly", "passes", "p90", "area under L/L0", "strain added"),
        "displacement [edges]",
    )
    note = (
        'Paper, 3.2: "much more efficient to resolve intersections progressively along the simulation (with a very limited '
        "number of resolution iterations between each mechanical iteration) than attempting to completely correct all "
        'intersections before next simulation step". At once: 60 passes before the first mechanical step.'
    )
    return Table("Progressively along the simulation, or at once", columns, cells, note)


def _others(rows: list[Row]) -> Table:
    named = [_named(row) for row in rows]
    return _table("Other tangles, by strategy", named, ("tangle", "strategy"))


def _named(row: Row) -> Row:
    """The row with its settings in the tangle's name."""
    parts = row["key"].split("/")
    name = " ".join(parts[parts.index("others") + 1 : -1])
    return row | {"parameters": row["parameters"] | {"tangle": name}}


def _null(rows: list[Row]) -> Table:
    cells = []
    for row in rows:
        given, found = row["parameters"], row["result"]
        coherence = sorted(found["coherence"])
        name = " ".join([given["tangle"], *map(str, given["settings"].values())])
        kinds = ", ".join(f"{n} {kind}" for kind, n in Counter(found["kinds"]).items())
        cells.append((name, kinds, found["hits"], coherence[0], coherence[-1], found["silent"]))
    columns = ("tangle", "contours", "hits", "|sum sG| / sum |G|, least", "most", "hits with |G| < 0.05")
    note = (
        "How much of the gradients is left when they are added along a contour: 1 = all point one way, 0 = the global scheme "
        "has no direction at all. Hits with next to no gradient of their own do nothing in the local scheme."
    )
    return Table("What the gradients say at the start", columns, cells, note)


def _faults(rows: list[Row]) -> Table:
    cells = []
    groups = _groups(rows, "strategy")
    alone = median(r["mean_length"] for r in groups.get(("none",), []))
    for (strategy,), results in groups.items():
        mean = median(r["mean_length"] for r in results)
        keys = ("last_quarter", "life", "brief", "contours", "strain", "step_seconds", "untangling_share")
        middle = {key: median(r[key] for r in results) for key in keys}
        cells.append(
            (strategy, len(results), mean, mean / alone if alone and mean is not None else None,
             max(r["largest_length"] for r in results), median(r["third_quarter"] for r in results),
             *middle.values(), sum(bool(r["failure"]) for r in results))
        )  # fmt: skip
    columns = (
        *("strategy", "seeds", "mean length [edges]", "of none", "largest", "third quarter", "last quarter"),
        *("life of a contour, median [steps]", "share that lives 1-2 steps", "contours", "strain", "step [s]"),
        *("share of untangling", "diverged"),
    )
    note = (
        "True contour length, not what the faulty detection sees; medians over seeds. Paper, 3.1.2: without, intersections "
        '"quickly expand, breaking the simulation"; with, "most intersections are resolved in only 1 or 2 frames"; about 2400 '
        "polygons at 12 iterations per second. A contour lives on as the one that shares most vertices with it a step "
        "later."
    )
    return Table("Half of all contacts and intersections ignored [Fig. 7]", columns, cells, note)


def _dish(rows: list[Row]) -> Table:
    keys = (
        *("triangles", "substeps", "sweeps", "time", "fell", "most_hits", "tangled_steps", "last_tangled", "end_hits"),
        *("strain", "contacts", "step_seconds", "step_seconds_p90", "untangling_share"),
    )
    cells = [
        (row["parameters"]["settings"]["length"], row["parameters"]["strategy"], *(row["result"][key] for key in keys),
         row["result"]["failure"] or None)
        for row in rows
    ]  # fmt: skip
    columns = (
        *("ribbon [m]", "strategy", "triangles", "substeps", "sweeps", "time [s]", "fell [m]", "most hits"),
        *("steps with hits", "last of them", "hits at the end", "strain", "contacts", "step [s]", "p90 [s]"),
        *("share of untangling", "failure"),
    )
    note = "Paper, 3.1.3: 120 m, about 80,000 polygons, local scheme, 3 to 30 s an iteration on a 3 GHz Pentium 4."
    return Table("The ribbon in the dish [Fig. 8]", columns, cells, note)


def _overhead(rows: list[Row]) -> Table:
    cells = []
    for row in rows:
        found = row["result"]
        times = found["seconds"]
        step = times["step"]
        response = (times["contours"] + times["response"]) / step
        # boxes and pairs are those of contact anyway where candidates are shared
        cells.append(
            ("clean" if found["hits"] == 0 else "tangled", row["parameters"]["strategy"], found["hits"], 1e3 * step,
             *(1e3 * times[key] for key in ("candidates", "tests", "contours", "response")),
             1e3 * times["regions"] if "regions" in times else None, response,
             response + times["tests"] / step, response + (times["tests"] + times["candidates"]) / step)
        )  # fmt: skip
    columns = (
        *("state", "strategy", "hits", "step [ms]", "candidates [ms]", "tests [ms]", "contours [ms]", "gradients [ms]"),
        *("of it regions [ms]", "contours and gradients, share", "with tests", "with candidates"),
    )
    note = (
        "Of one pass, least of the repeats, process time; the step makes one pass. Candidates: boxes of the positions alone "
        "and their pairs of edges and faces; a step looks for contact in boxes of its own, which hold many times as much. "
        "Gradients: with their distribution over the vertices, and with the flood that finds regions where a strategy asks "
        "for them, which stands beside."
    )
    return Table("Cost of a pass beside a step", columns, cells, note)
