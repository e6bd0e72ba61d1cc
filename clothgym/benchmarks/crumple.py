"""`clothgym bench crumple`: a sheet that falls on a corner and crumples, at all resolutions and presets."""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks.frame import Benchmark, Case, Row
from clothgym.benchmarks.report import Table
from clothgym.fidelity import PRESETS
from clothgym.model import STRUCTURAL

BUDGET = {16: 2.0}
"""[ms] a frame of 1/60 s at balanced, median."""
OTHERS = (("MuJoCo 4.0, four ways", "44 to 115", "0 to 80"), ("Newton VBD 10 x 10", "481", "0"))
"""16 cells a side, as measured for `spec/peers.md`: ms a frame, hits left at the end."""

_SECONDS = 3.0
_FINEST = 4  # substeps of the converged run over those of "balanced", of two sweeps each
_NOTES = (
    "A sheet of 1 m x 1 m, kicked out of plane, starts hung by a corner, is let go and crumples on the ground (scene `drop`); "
    "self-collision on, 3 s. Hits are looked for after every frame. Stretch is that of structural springs over all frames; "
    "excess is over the peak of the converged run (four times the substeps of 'balanced', two sweeps each), which crumples "
    "otherwise in detail. Times are process time a frame on one core; frames in the fall, in the crumple and at rest differ by "
    "ten times, so median, 90th percentile and maximum are shown."
)


def cases(quick: bool) -> list[Case]:
    """Sizes x (converged, presets)."""
    sizes = (16,) if quick else (16, 32, 64)
    return [
        Case(f"crumple/{n}/{preset}", {"cells": n, "preset": preset, "seconds": _SECONDS})
        for n in sizes
        for preset in ("converged", *PRESETS)
        if not (quick and preset == "accurate")
    ]


def prepare() -> None:
    """Compiles every kernel that a case uses."""
    for preset in ("converged", *PRESETS):
        sim = simulation(8, preset)
        sim.step(40)
        sim.metrics()


def simulation(cells: int, preset: str) -> cg.Simulation:
    """The scene at a preset, or converged."""
    scene = cg.scenes.make("drop", resolution=cells)
    if preset == "converged":
        chosen = cg.Simulation(scene, "balanced").pipeline.substeps
        return cg.Simulation(scene, cg.Fidelity(substeps=_FINEST * chosen, sweeps=2))
    return cg.Simulation(scene, preset)


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One sheet: time of every frame [ms], stretch and hits after each, work."""
    sim = simulation(parameters["cells"], parameters["preset"])
    model = sim.model
    structural = model.spring_kinds == STRUCTURAL
    ends, rest = model.spring_ends[structural], model.spring_rest[structural]
    times, stretch, hits = [], [], []
    for _ in range(round(parameters["seconds"] / sim.scene.step)):
        began = time.process_time()
        sim.step()
        times.append(1e3 * (time.process_time() - began))
        lengths = np.linalg.norm(sim.positions[ends[:, 1]] - sim.positions[ends[:, 0]], axis=1)
        stretch.append(float((lengths / rest).max() - 1.0))
        hits.append(int(sim.last_intersections.hit_count))
    work, substeps = sim.metrics()["work"], sim.pipeline.substeps
    step: Any = sim.pipeline.stages[-1]
    frames = len(times)
    return {
        "vertices": model.vertex_count,
        "stage": step.name,
        "substeps": substeps,
        "sweeps": substeps * step.step.sweeps,
        "median": statistics.median(times),
        "p90": float(np.percentile(times, 90)),
        "max": max(times),
        "peak": max(stretch),
        "end": stretch[-1],
        "hits": sum(hits),
        "frames_with_hits": int(np.count_nonzero(hits)),
        "top": float(sim.positions[:, 1].max()),
        "pairs": work.get("primitive_pairs", 0) / frames,
        "contacts": work.get("contacts", 0) / (frames * substeps),
        "measured": work.get("measured", 0) / frames,
        "rebuilds": work.get("rebuilds", 0) / frames,
        "unproved": work.get("unproved", 0),
    }


def tables(rows: list[Row]) -> list[Table]:
    """Time, stretch and hits of every case; the same elsewhere."""
    if not rows:
        return []
    converged = {
        row["parameters"]["cells"]: row["result"]["peak"] for row in rows if row["parameters"]["preset"] == "converged"
    }
    cells = []
    for row in rows:
        parameters, r = row["parameters"], row["result"]
        n, preset = parameters["cells"], parameters["preset"]
        known = n in converged and preset != "converged"
        cells.append(
            (
                n,
                preset,
                f"{r['substeps']} / {r['sweeps']}",
                r["median"],
                r["p90"],
                r["max"],
                BUDGET.get(n) if preset == "balanced" else None,
                100 * r["peak"],
                100 * (r["peak"] - converged[n]) if known else None,
                100 * PRESETS[preset].stretch_error if preset in PRESETS else None,
                100 * r["end"],
                r["hits"],
                r["contacts"],
                r["pairs"],
                100 * r["top"],
            )
        )
    columns = (
        "cells", "preset", "substeps / sweeps", "median [ms]", "p90 [ms]", "max [ms]", "budget [ms]", "peak stretch [%]",
        "excess [%]", "promised [%]", "at the end [%]", "hits in all frames", "contacts a substep", "pairs a frame",
        "height at the end [cm]",
    )  # fmt: skip
    others = Table("Elsewhere, 16 cells", ("engine", "ms a frame", "hits left"), list(OTHERS), "from spec/peers.md")
    return [Table("A sheet that crumples", columns, cells), others]


benchmark = Benchmark(
    name="crumple",
    title="A sheet that falls and crumples: time, stretch and hits at every frame",
    cases=cases,
    run=run,
    tables=tables,
    prepare=prepare,
    notes=_NOTES,
)
