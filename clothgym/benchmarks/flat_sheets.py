"""What self-collision costs a sheet that cannot touch itself: a part of `clothgym bench hierarchy`."""

from __future__ import annotations

import dataclasses
import statistics
import time
from typing import Any

import clothgym as cg
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
            {"part": "flat", "cells": cells, "steps": STEPS, "searched": 5, "repeats": max(4, 320 // cells)},
        )
        for cells in sizes
    ]


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """Processor time of a step [ms] of the same sheet with the check, with a search instead, and with self-collision ruled out.

    The runs go step by step in turns, so that a busy moment of the machine meets all of them. `share` is what the check
    adds to a step: 1 - (time without self-collision) / (time with the check), median over all decided steps, where the step
    without takes the same substeps and sweeps, all in one loop over vertices in the order of the runs. By itself, "alone", it
    takes those of its own promise.
    """
    plain = cg.scenes.make("hanging_sheet", resolution=parameters["cells"])
    scene = dataclasses.replace(plain, self_collision=True)
    balanced = cg.Fidelity.preset("balanced")
    check = cg.Simulation(scene, balanced)
    runs: dict[str, cg.Simulation] = {
        "check": check,
        "none": _without(plain, check),
        "alone": cg.Simulation(plain, balanced),
        "search": cg.Simulation(scene, dataclasses.replace(balanced, flat_check=False)),
    }
    decided, equal = _looked_at(runs, parameters)
    times: dict[str, list[float]] = {name: [] for name in runs}
    shares = []
    for repeat in range(parameters["repeats"]):
        for simulation in runs.values():
            simulation.reset()
        for step in range(parameters["steps"]):
            spent = {}
            for name in ("check", "none") if step % 2 else ("none", "check"):
                spent[name] = _timed_step(runs[name])
            spent["alone"] = _timed_step(runs["alone"])
            if repeat == 0 and step < parameters["searched"]:
                spent["search"] = _timed_step(runs["search"])
            if decided[step]:
                shares.append(1.0 - spent["none"] / spent["check"])
                for name, value in spent.items():
                    times[name].append(value)
    return {
        "triangles": len(runs["check"].faces),
        "decided": sum(decided),
        "share": statistics.median(shares) if shares else None,
        "equal": equal,
        "ms": {name: statistics.median(values) if values else None for name, values in times.items()},
    }


def _looked_at(runs: dict[str, cg.Simulation], parameters: dict[str, Any]) -> tuple[list[bool], bool]:
    """Which steps are decided, and whether check and search leave the same state; nothing is timed, all is compiled."""
    equal = True
    decided: list[bool] = []
    for step in range(parameters["steps"]):
        before = sum(decided)
        runs["none"].step()
        runs["alone"].step()
        runs["check"].step()
        decided.append(runs["check"].metrics()["work"].get("decided_flat", 0) > before)
        if step < parameters["searched"]:
            runs["search"].step()
            equal &= runs["search"].state_hash() == runs["check"].state_hash()
    return decided, equal


def _timed_step(simulation: cg.Simulation) -> float:
    """Processor time of one step [ms]: shares of a few percent drown in what else a machine does."""
    started = time.process_time()
    simulation.step()
    return 1e3 * (time.process_time() - started)


def _without(scene: cg.Scene, check: cg.Simulation) -> cg.Simulation:
    """The sheet without self-collision, with the substeps and sweeps of a simulation with it."""
    pipeline: Any = check.pipeline
    effort = {"substeps": pipeline.substeps, "sweeps": pipeline.stages[-1].step.sweeps}
    return cg.Simulation(scene, dataclasses.replace(check.fidelity, **effort))


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
        "with a search [ms]",
        "same state",
    )
    note = (
        "processor time of a step of hanging_sheet at balanced; the check decides that the sheet is a height field and stays "
        "one; its share is over the same substeps and sweeps without self-collision; the search is the same run with "
        "flat_check off; states are compared bit by bit"
    )
    return Table("A flat sheet that cannot touch itself", columns, cells, note)
