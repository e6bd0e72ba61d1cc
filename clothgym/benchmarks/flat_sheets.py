"""What self-collision costs a sheet that cannot touch itself: a part of `clothgym bench hierarchy`."""

from __future__ import annotations

import dataclasses
import time
from typing import Any, NamedTuple

import numpy as np

import clothgym as cg
from clothgym.arrays import FloatArray
from clothgym.benchmarks.frame import Case, Row
from clothgym.benchmarks.report import Table

STEPS = 10
"""First steps of the scene: at every size the sheet is still a height field."""


def cases(quick: bool) -> list[Case]:
    """Sheets of so many cells a side; the search of a whole hierarchy is timed for fewer steps where it takes seconds."""
    sizes = (16, 32, 64) if quick else (16, 32, 64, 128)
    return [
        Case(
            f"flat/{cells}",
            {
                "part": "flat",
                "cells": cells,
                "steps": STEPS,
                "searched": 5,
                "sheets": 5 if cells < 128 else 3,
                "repeats": max(2, 320 // cells),
            },
        )
        for cells in sizes
    ]


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """Processor time of a step [ms] of the same sheet with the check, with a search instead, and with self-collision ruled out.

    `share` is what the check adds to a step: 1 - (time without self-collision) / (time with the check), median over all
    decided steps, where the step without takes the same substeps and sweeps, all in one loop over vertices in the order of the
    runs. By itself, "alone", it takes those of its own promise. A decision is made in one step and holds for others, and a
    median does not see what few steps pay: `share_of_all` is that of all decided steps together, each at the median of its
    repeats.

    Measured so that the machine does not show:

    - The runs go step by step in turns, so that a busy moment meets all of them.
    - Where in memory the slots and springs lie makes a step up to 5 % slower or faster, for as long as a simulation lives. So
      both sheets work in the same arrays, and all is measured with several pairs of sheets made anew: `share` is the median of
      all of them, `shares` has that of each pair.

    `share` then varies by half a point between runs on a machine that others use too, at 16 and 32 cells by one; `share_of_all`
    by one, at 16 cells by one and a half: its first step decides with empty caches. Below zero means that the loop with the
    check happens to be compiled to quicker code than the one without, by up to 2 % in the same arrays.
    """
    sheets = [_one_sheet(parameters, searched=n == 0) for n in range(parameters["sheets"])]
    decided, equal, faces = sheets[0].decided, sheets[0].equal, sheets[0].faces
    steps = [n for n in range(parameters["steps"]) if decided[n]]
    spent = {
        name: np.concatenate([sheet.times[name] for sheet in sheets])[:, steps] for name in ("check", "none", "alone")
    }
    times = {name: 1e3 * float(np.median(values)) if steps else None for name, values in spent.items()}
    search = sheets[0].times["search"][:, [n for n in steps if n < parameters["searched"]]]
    times["search"] = 1e3 * float(np.median(search)) if search.size else None
    shares = [_share(sheet.times["none"][:, steps], sheet.times["check"][:, steps]) for sheet in sheets]
    together = {name: float(np.median(values, axis=0).sum()) for name, values in spent.items()}
    return {
        "triangles": faces,
        "decided": sum(decided),
        "share": _share(spent["none"], spent["check"]),
        "shares": shares,
        "share_of_all": 1.0 - together["none"] / together["check"] if steps else None,
        "equal": equal,
        "ms": times,
    }


class _Sheet(NamedTuple):
    """One measurement of all runs with simulations of their own."""

    times: dict[str, FloatArray]  # (repeats, steps) [s] processor time
    decided: list[bool]  # of each step
    equal: bool  # whether all that take the same substeps leave the same state
    faces: int


def _one_sheet(parameters: dict[str, Any], searched: bool) -> _Sheet:
    plain = cg.scenes.make("hanging_sheet", resolution=parameters["cells"])
    scene = dataclasses.replace(plain, self_collision=True)
    balanced = cg.Fidelity.preset("balanced")
    check = cg.Simulation(scene, balanced)
    runs = {"check": check, "none": _without(plain, check), "alone": cg.Simulation(plain, balanced)}
    if searched:
        runs["search"] = cg.Simulation(scene, dataclasses.replace(balanced, flat_check=False))
    decided, equal = _looked_at(runs, parameters)
    steps, repeats = parameters["steps"], parameters["repeats"]
    rounds = {name: 1 if name == "search" else repeats for name in runs}
    times = {name: np.zeros((rounds[name], parameters["searched"] if name == "search" else steps)) for name in runs}
    for repeat in range(repeats):
        for simulation in runs.values():
            simulation.reset()
        for step in range(steps):
            for name in ("check", "none", "alone") if (repeat + step) % 2 else ("none", "check", "alone"):
                times[name][repeat, step] = _timed_step(runs[name])
            if searched and repeat == 0 and step < parameters["searched"]:
                times["search"][0, step] = _timed_step(runs["search"])
    return _Sheet(times, decided, equal, len(check.faces))


def _share(without: FloatArray, check: FloatArray) -> float | None:
    """Median of what the check adds to a step, as a share of it; times (repeats, steps) [s] of steps beside each other."""
    return float(np.median(1.0 - without / check)) if check.size else None


def _looked_at(runs: dict[str, cg.Simulation], parameters: dict[str, Any]) -> tuple[list[bool], bool]:
    """Which steps are decided, and whether all of the same effort leave the same state; nothing is timed, all is compiled."""
    equal = True
    decided: list[bool] = []
    for step in range(parameters["steps"]):
        before = sum(decided)
        for name in ("none", "alone", "check"):
            runs[name].step()
        decided.append(runs["check"].metrics()["work"].get("decided_flat", 0) > before)
        equal &= runs["none"].state_hash() == runs["check"].state_hash()
        if "search" in runs and step < parameters["searched"]:
            runs["search"].step()
            equal &= runs["search"].state_hash() == runs["check"].state_hash()
    return decided, equal


def _timed_step(simulation: cg.Simulation) -> float:
    """Processor time of one step [s]: shares of a few percent drown in what else a machine does."""
    started = time.process_time()
    simulation.step()
    return time.process_time() - started


def _without(scene: cg.Scene, check: cg.Simulation) -> cg.Simulation:
    """The sheet without self-collision, with the substeps and sweeps of a simulation with it, and in its arrays."""
    step: Any = check.pipeline.stages[-1].step  # type: ignore[attr-defined]
    without = cg.Simulation(scene, dataclasses.replace(check.fidelity, substeps=step.substeps, sweeps=step.sweeps))
    integrator: Any = without.pipeline.stages[-1].step.integrator  # type: ignore[attr-defined]
    if step.integrator.runs is not None:
        integrator.runs.arrays, integrator.runs.space = step.integrator.runs.arrays, step.integrator.runs.space
    return without


def table(rows: list[Row]) -> Table:
    """One row a size."""
    cells = [
        (
            row["parameters"]["cells"],
            row["result"]["triangles"],
            f"{row['result']['decided']} of {row['parameters']['steps']}",
            row["result"]["ms"]["alone"],
            row["result"]["ms"]["none"],
            row["result"]["ms"]["check"],
            row["result"]["share"],
            row["result"]["share_of_all"],
            row["result"]["ms"]["search"],
            row["result"]["equal"],
        )
        for row in sorted(rows, key=lambda row: row["parameters"]["cells"])
    ]
    columns = (
        "cells a side",
        "triangles",
        "steps decided",
        "no self-collision [ms]",
        "the same effort [ms]",
        "with the check [ms]",
        "share of the check",
        "of all steps together",
        "with a search [ms]",
        "same state",
    )
    note = (
        "processor time of a step of hanging_sheet at balanced; the check decides that the sheet is a height field and stays "
        "one; its share is over the same substeps and sweeps without self-collision, as a median over steps and of all steps "
        "together, those that decide included; the search is the same run with flat_check off; states are compared bit by bit"
    )
    return Table("A flat sheet that cannot touch itself", columns, cells, note)
