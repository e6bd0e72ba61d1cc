"""The part of `clothgym bench mezger` that runs real simulations, one technique switched at a time: counts, times, misses."""

from __future__ import annotations

import dataclasses
import statistics
import time
from typing import Any

import clothgym as cg
from clothgym.benchmarks.frame import Row
from clothgym.benchmarks.report import Table
from clothgym.detection.judge import Judge, Truth

_MEZGER = {"detection": "mezger"}
_PLAIN = {**_MEZGER, "cones": "none"}
TECHNIQUES: dict[str, dict[str, Any]] = {
    "clusters of 16": {},
    "clusters of 16, sorted": {"rebuild_growth": 1e6},
    "clusters of 16, rebuilt at 1.5": {"rebuild_growth": 1.5},
    "plain": _PLAIN,
    "k = 6": {**_PLAIN, "k": 6},
    "binary": {**_PLAIN, "arity": 2},
    "octree": {**_PLAIN, "arity": 8},
    "conservative": {**_PLAIN, "inflation": "conservative"},
    "oriented": {**_PLAIN, "inflation": "oriented"},
    "unoriented": {**_PLAIN, "inflation": "unoriented"},
    "cones exact": _MEZGER,
    "cones mezger": {**_MEZGER, "cones": "mezger"},
    "cones mezger, leaf angle 0.5": {**_MEZGER, "cones": "mezger", "leaf_angle": 0.5},
    "lazy 0.5 mm": {**_PLAIN, "lazy": 5e-4},
    "coherence 1 mm": {**_PLAIN, "coherence": 1e-3},
    "separation list": {**_PLAIN, "separation_list": 16},
    "pattern": {**_PLAIN, "build_space": "pattern"},
    "rebuilt at 1.5": {**_PLAIN, "rebuild_growth": 1.5},
}
"""Fields of `Fidelity` beside those of "draft", without the check for height fields, which would spare some of them the search;
"plain": swept boxes of the paper's tree, k = 18, quadtree, nothing pruned."""

COMPLETE = tuple(name for name in TECHNIQUES if name not in ("oriented", "unoriented") and "cones mezger" not in name)
"""Those that promise to miss nothing."""

_COUNTS = ("refits", "box_tests", "leaf_pairs", "cone_pruned", "box_pairs", "primitive_tests", "trees_built")


def simulated(scene: str, steps: int, every: int) -> dict[str, Any]:
    """All techniques in simulations of their own, side by side; misses in every n-th step, which is not timed.

    Returns rows of medians and means a step, in processor time, which other programs hardly disturb: `update` of the hierarchy
    and collision `test`, both together `detection`, and `step` [s]; counts, pairs missed (`missed` of `near`, `missed_hits` of
    `hits`), and whether the last state is that of "plain" to the last bit (those that miss nothing, clusters sorted).
    """
    made = cg.scenes.make(scene)
    simulations = {name: cg.Simulation(made, _fidelity(settings)) for name, settings in TECHNIQUES.items()}
    model = simulations["plain"].model
    # trying all pairs takes longest, and most techniques share their states
    truth = Truth(model.surface, model.vertex_count, keep=True)
    runs = {name: _Run(simulation, truth) for name, simulation in simulations.items()}
    names = list(runs)
    for number in range(steps):
        turn = number % len(names)  # no configuration always comes after the same other
        for name in names[turn:] + names[:turn]:
            runs[name].step(judged=number % every == 0)
        truth.forget()
    rows = {}
    last = runs["plain"].simulation.state_hash()
    for name, run in runs.items():
        work = run.simulation.metrics()["work"]
        rows[name] = {
            **run.medians(),
            **{key: work.get(key, 0) / steps for key in _COUNTS},
            "same_bits": run.simulation.state_hash() == last,
            "complete": name in COMPLETE,
            "missed": run.judge.missed,
            "near": run.judge.near,
            "missed_hits": run.judge.missed_hits,
            "hits": run.judge.hits,
        }
    return {"steps": steps, "faces": len(runs["plain"].simulation.faces), "rows": rows}


class _Timed:
    """A detector whose calls are timed."""

    def __init__(self, tree: Any) -> None:
        self.tree = tree
        self.update = self.test = 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.__dict__["tree"], name)

    def refit(self, *places: Any) -> None:
        started = time.process_time()
        self.tree.refit(*places)
        self.update += time.process_time() - started

    def renew(self, x: Any) -> None:
        started = time.process_time()
        self.tree.renew(x)
        self.update += time.process_time() - started

    def search(self, near: bool, hits: bool) -> None:
        started = time.process_time()
        self.tree.search(near, hits)
        self.test += time.process_time() - started

    def edges_against_faces(self) -> Any:
        self.search(near=False, hits=True)
        return self.tree.edge_face[: self.tree.counts[2]]


class _Run:
    """A simulation whose steps are timed or judged."""

    def __init__(self, simulation: cg.Simulation, truth: Truth) -> None:
        self.simulation = simulation
        self._candidates = simulation.pipeline.stages[-1].candidates  # type: ignore[attr-defined]
        self.tree = _Timed(self._candidates.tree)
        self.judge = Judge(self.tree, truth)
        self.seconds: list[tuple[float, float, float]] = []
        self._judged: list[tuple[float, float, float]] = []

    def step(self, judged: bool) -> None:
        self._candidates.tree = self.judge if judged else self.tree
        update, test, started = self.tree.update, self.tree.test, time.process_time()
        self.simulation.step()
        times = self.tree.update - update, self.tree.test - test, time.process_time() - started
        (self._judged if judged else self.seconds).append(times)

    def medians(self) -> dict[str, float]:
        seconds = self.seconds or self._judged
        update, test, step = (statistics.median(column) for column in zip(*seconds))
        return {
            "update": update, "test": test, "detection": statistics.median(s[0] + s[1] for s in seconds), "step": step,
        }  # fmt: skip


def _fidelity(settings: dict[str, Any]) -> cg.Fidelity:
    return dataclasses.replace(cg.Fidelity.preset("draft"), flat_check=False, **settings)


def simulated_tables(row: Row) -> list[Table]:
    """Times and misses of one scene, and its counts."""
    result = row["result"]
    rows, unit = result["rows"].items(), result["rows"]["plain"]["detection"]
    title = f"In the simulation: {row['parameters']['scene']}, {result['faces']} faces, {result['steps']} steps"
    times = [
        (
            name, *(1e3 * r[key] for key in ("update", "test", "step")), r["detection"] / unit,
            r["missed"], r["near"], r["missed_hits"], r["hits"], "yes" if r["same_bits"] else "no",
        )
        for name, r in rows
    ]  # fmt: skip
    columns = (
        "configuration", "update [ms]", "test [ms]", "step [ms]", "both / plain",
        "missed", "of near", "missed hits", "of hits", "bits of plain",
    )  # fmt: skip
    note = (
        "Medians of processor time a step. Misses against all pairs on the same states. What misses nothing ends in the same "
        "bits; unsorted clusters differ by the order of pairs alone."
    )
    counts = [(name, *(r[key] for key in _COUNTS)) for name, r in rows]
    counted = "Means a step; box tests of clusters are those against 16 at once."
    return [
        Table(title, columns, times, note),
        Table(f"{title}: counts", ("configuration", *_COUNTS), counts, counted),
    ]
