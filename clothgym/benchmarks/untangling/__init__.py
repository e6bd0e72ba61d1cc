"""`clothgym bench untangling`: every strategy against every tangle, judged by sides and not only by vanishing contours."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import clothgym as cg
from clothgym.benchmarks.frame import Benchmark, Case
from clothgym.benchmarks.untangling import dish, faults, instances, overhead, show, squares
from clothgym.response import untangling as strategies
from clothgym.scenes.canonical import KINDS

_NOTES = (
    "Volino and Magnenat-Thalmann 2006. A run is resolved when no exact hit is left; correctly, when everything is also back "
    "on the side where the clean state has it: length alone can be collected by pinching, and a contour also ends when the "
    "wrong part is pulled through. Small tangles are drawn in general position, without gravity, with the shape at the start "
    f"as the one without strain; {instances.FIELDS['untangling_passes']} pass a step, h0 = {instances.FIELDS['h0']:g} edges, "
    f"velocity share {instances.FIELDS['velocity_share']:g} unless said. Passes: how many until there was no hit; - = not "
    "reached by that share. The squares' sizes, poses, thickness, time step and material are not given in the paper; the "
    "clean pile is the control: hits there come from contact, not from untangling. Quick runs take fewer of everything."
)
_OTHERS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("figure_two", {"row": "top"}),
    ("figure_two", {"row": "middle"}),
    ("figure_two", {"row": "bottom"}),
    ("garment_layers", {"layers": 2}),
    ("garment_layers", {"layers": 3}),
    ("folds", {}),
    ("fold_corner", {}),
    ("strip_through_sheet", {}),
    ("strip_through_sheet", {"uneven": 0.02}),
    ("waist", {}),
    ("crumple", {}),
)
BEST = "flatten"
"""The strategy whose table of many instances is asked for."""
_SHARES, _SIZES = (0.0, 0.25, 0.5, 0.75, 1.0), (0.1, 0.25, 0.5, 1.0, 2.0)
_DEPTHS = (0.5, 1.0, 2.0, 3.0, 5.0, 10.0)
_LASTING = ("global", "hybrid", "flatten")
"""Strategies whose squares are watched for 300 steps after they came apart: the paper's, the default, and the best on folds."""


def cases(quick: bool, more: Sequence[str] = ()) -> list[Case]:
    """All parts; `more`: strategies beyond those of the package."""
    compared = [*dict.fromkeys([*strategies.names(), *more])]
    found: list[Case] = []
    found += _squares(quick, compared)
    found += _canonical(quick, [name for name in compared if name != "none"])
    found += _regions(quick)
    found += _settings(quick)
    found += _others(quick, [name for name in compared if name != "none"])
    found += _faults(quick, more)
    found += _dish(quick)
    found += _overhead(quick, [name for name in compared if name != "none"])
    return found


def _squares(quick: bool, compared: Sequence[str]) -> list[Case]:
    settings: dict[str, Any] = {"count": 12, "box": 0.95} if quick else {"count": 25}  # the same density
    listed = []
    for strategy in dict.fromkeys(["global", "hybrid", "none", "local", *compared]):
        lasting = strategy in _LASTING
        seeds = (2 if lasting else 1) if quick else (10 if lasting else 3)
        for seed in range(seeds):
            # what stays tangled shows all there is to see in the first second
            steps = 40 if quick else (330 if lasting else 100)
            alone = 300 if not quick and lasting and seed < 2 else 0
            parameters: dict[str, Any] = {
                "part": "squares",
                "scene": "squares",
                "settings": settings,
                "strategy": strategy,
            }
            parameters |= {"seed": seed, "steps": steps, "control": alone}
            listed.append(Case(f"squares/{strategy}/seed{seed}", parameters))
    for seed in range(1 if quick else 3):
        parameters = {"part": "pile", "scene": "pile", "settings": {"count": settings["count"]}, "strategy": "none"}
        parameters |= {"seed": seed, "steps": 40 if quick else 300, "control": 0}
        listed.append(Case(f"pile/seed{seed}", parameters))
    return listed


def _instances(part: str, key: str, tangle: str, settings: dict[str, Any], strategy: str, **other: Any) -> Case:
    parameters = {"part": part, "tangle": tangle, "settings": settings, "strategy": strategy, "fields": {}, "seed": 0}
    return Case(f"{part}/{key}/{strategy}", parameters | {"budget": 60, "later": 0, "followed": 0} | other)


def _canonical(quick: bool, compared: Sequence[str]) -> list[Case]:
    listed = []
    for kind in KINDS:
        for depth in (1.0, 3.0) if quick else _DEPTHS:
            settings: dict[str, Any] = {"kind": kind, "depth": depth, "resolution": instances.resolution_for(depth)}
            for strategy in compared:
                count = 3 if quick else (12 if depth < 5.0 else 6 if depth < 10.0 else 3)
                later: dict[str, Any] = {} if quick or depth != 3.0 else {"later": 300, "followed": 2}
                listed.append(
                    _instances("canonical", f"{kind}/{depth:g}", "canonical", settings, strategy, count=count, **later)
                )
        if not quick:
            settings = {"kind": kind, "depth": 3.0}
            listed.append(
                _instances(
                    "canonical", f"{kind}/3", "canonical", settings | {"resolution": 16}, "none", count=4, budget=30
                )
            )
            for resolution in (12, 24, 40):
                for strategy in ("global", BEST):
                    key, own = f"{kind}/{resolution}", settings | {"resolution": resolution}
                    listed.append(_instances("resolution", key, "canonical", own, strategy, count=10))
            for depth in (1.0, 2.0, 3.0, 5.0):
                settings = {"kind": kind, "depth": depth, "resolution": instances.resolution_for(depth)}
                listed.append(
                    _instances("many", f"{kind}/{depth:g}", "canonical", settings, BEST, count=200, seed=1000)
                )
    return listed


def _regions(quick: bool) -> list[Case]:
    """A straight contour with borders on one side, by positions alone and with velocity: what has no region has no way out."""
    listed = []
    for depth in (3.0,) if quick else (3.0, 5.0):
        settings = {"kind": "BBII", "depth": depth, "resolution": instances.resolution_for(depth)}
        for strategy in ("local", "global", BEST):
            for share in (0.0, 1.0):
                key, fields = f"{depth:g}/v={share:g}", {"velocity_share": share}
                count = 5 if quick else 200 if share and depth == 3.0 else 60
                listed.append(_instances("regions", key, "canonical", settings, strategy, fields=fields, count=count))
    return listed


def _settings(quick: bool) -> list[Case]:
    """h0 against the velocity share, and all passes at once against one a step."""
    listed = []
    places = (("BBII", "hybrid"),) if quick else (("BBII", "hybrid"), ("BIBI", "global"), ("Closed", "global"))
    for kind, strategy in places:
        settings = {"kind": kind, "depth": 3.0, "resolution": 16}
        for h0 in (0.25, 1.0) if quick else _SIZES:
            for share in (0.0, 1.0) if quick else _SHARES:
                key, fields = f"{kind}/h0={h0:g},v={share:g}", {"h0": h0, "velocity_share": share}
                count = 2 if quick else 5
                listed.append(_instances("map", key, "canonical", settings, strategy, fields=fields, count=count))
    ways: dict[str, dict[str, Any]] = {
        "a pass a step, with velocity": {},
        "a pass a step, positions only": {"velocity_share": 0.0},
        "3 passes a step, positions only": {"untangling_passes": 3, "velocity_share": 0.0},
        "60 passes at once": {"untangling_passes": 60, "velocity_share": 0.0},
    }
    tangles: tuple[tuple[str, dict[str, Any]], ...] = (
        ("canonical", {"kind": "BIBI", "depth": 3.0, "resolution": 16}),
        ("canonical", {"kind": "BBII", "depth": 3.0, "resolution": 16}),
        ("canonical", {"kind": "Closed", "depth": 3.0, "resolution": 16}),
        ("garment_layers", {"layers": 2}),
    )
    for tangle, settings in tangles:
        for strategy in ("global", "hybrid"):
            for way, fields in ways.items():
                key = f"{settings.get('kind', tangle)}/{way}"
                count = 2 if quick else 5
                listed.append(_instances("progress", key, tangle, settings, strategy, fields=fields, count=count))
    return listed


def _others(quick: bool, compared: Sequence[str]) -> list[Case]:
    listed = []
    for tangle, settings in _OTHERS:
        key = "/".join(
            [tangle, *(f"{value:g}" if not isinstance(value, str) else value for value in settings.values())]
        )
        for strategy in compared if not quick else [s for s in compared if s in ("local", "global", "hybrid")]:
            listed.append(_instances("others", key, tangle, settings, strategy, count=1 if quick else 5))
        parameters = {"part": "null", "tangle": tangle, "settings": settings, "seed": 0}
        listed.append(Case(f"null/{key}", parameters))
    for kind in KINDS:
        settings = {"kind": kind, "depth": 3.0, "resolution": 16}
        listed.append(Case(f"null/{kind}", {"part": "null", "tangle": "canonical", "settings": settings, "seed": 0}))
    return listed


def _faults(quick: bool, more: Sequence[str]) -> list[Case]:
    listed = []
    for strategy in dict.fromkeys(["none", "local", "global", "hybrid", *more]):
        for seed in range(1 if quick else 3):
            parameters = {"part": "faults", "settings": {}, "strategy": strategy, "fields": {}, "seed": seed}
            listed.append(Case(f"faults/{strategy}/seed{seed}", parameters | {"steps": 60 if quick else 120}))
    return listed


def _dish(quick: bool) -> list[Case]:
    short = {"part": "dish", "settings": {"length": 6.0}, "fields": {}, "seed": 0, "steps": 80 if quick else 600}
    listed = [Case(f"dish/6m/{strategy}", short | {"strategy": strategy}) for strategy in ("local", "none")]
    if not quick:
        whole = {"part": "dish", "settings": {"length": 120.0}, "strategy": "local", "fields": {}, "seed": 0}
        listed.append(Case("dish/120m/local", whole | {"steps": 600}))
    return listed


def _overhead(quick: bool, compared: Sequence[str]) -> list[Case]:
    size: dict[str, Any] = {"count": 12, "box": 0.95} if quick else {"count": 25}
    base = {"part": "overhead", "seed": 0, "repeats": 3 if quick else 7}
    tangled, clean = (
        base | {"scene": "squares", "settings": size, "steps": 0},
        base | {"scene": "pile", "settings": {"count": size["count"]}, "steps": 40},
    )
    listed = [Case(f"overhead/tangled/{strategy}", tangled | {"strategy": strategy}) for strategy in compared]
    return [*listed, Case("overhead/clean/global", clean | {"strategy": "global"})]


def prepare() -> None:
    """Compiles every kernel that a case uses."""
    scene = cg.scenes.make("squares", count=4, box=0.5, cells=4)
    for strategy in strategies.names():
        simulation = cg.Simulation(scene, cg.Fidelity(untangling=strategy))
        simulation.step(2)
        simulation.metrics()
    cg.Simulation(cg.scenes.make("faulty_detection", cells=4), cg.Fidelity(untangling="local")).step()
    cg.Simulation(cg.scenes.make("ribbon", length=0.5), cg.Fidelity(untangling="local")).step()
    settings = {"kind": "Closed", "depth": 0.5, "resolution": 6}
    instances.null({"tangle": "canonical", "settings": settings, "seed": 0})
    instances.run({"tangle": "canonical", "settings": settings, "strategy": "hybrid", "fields": {}, "seed": 0, "count": 1,
                   "budget": 3, "later": 0, "followed": 0})  # fmt: skip


_RUNS = {
    "squares": squares.run,
    "pile": squares.run,
    "canonical": instances.run,
    "resolution": instances.run,
    "many": instances.run,
    "regions": instances.run,
    "map": instances.run,
    "progress": instances.run,
    "others": instances.run,
    "null": instances.null,
    "faults": faults.run,
    "dish": dish.run,
    "overhead": overhead.run,
}


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One case of the part that it names."""
    return _RUNS[parameters["part"]](parameters)


def with_strategies(names: Sequence[str]) -> Benchmark:
    """The benchmark with strategies beyond those of the package, as "package.module:Name".

    Raises:
        ValueError: a strategy that cannot be had.
    """
    for name in names:
        strategies.get(name)
    return dataclasses.replace(benchmark, cases=functools.partial(cases, more=tuple(names)))


benchmark = Benchmark(
    name="untangling",
    title="Untangling: every strategy against every tangle [Volino 2006]",
    cases=cases,
    run=run,
    tables=show.tables,
    plots=show.plots,
    prepare=prepare,
    notes=_NOTES,
    with_strategies=with_strategies,
)
