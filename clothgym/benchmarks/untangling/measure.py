"""What every part of the benchmark measures on a run, and how it counts."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

import clothgym as cg
from clothgym import metrics
from clothgym.benchmarks.frame import Row

EXPLOSION = 5.0
"""Strain at which a run counts as exploded: edges six times as long as they should be."""


class Histories:
    """Hits, contours, length and strain of a run, at the start and after every step, and the process time of steps [s]."""

    def __init__(self, simulation: cg.Simulation) -> None:
        self.simulation = simulation
        self.hits: list[int] = []
        self.contours: list[int] = []
        self.length: list[float] = []
        self.strains: list[float] = []
        self.seconds: list[float] = []
        self.failure = ""
        self._record()

    def step(self) -> bool:
        """One step; False when it diverged."""
        started = time.process_time()
        try:
            self.simulation.step()
        except cg.SimulationError as error:
            self.failure = str(error)
            return False
        self.seconds.append(time.process_time() - started)
        self._record()
        return True

    def play(self, steps: int, seen: Callable[[], None] | None = None) -> Histories:
        """Steps until it diverges; `seen` is called after each."""
        for _ in range(steps):
            if not self.step():
                break
            if seen:
                seen()
        return self

    @property
    def clean(self) -> bool:
        return self.hits[-1] == 0

    def _record(self) -> None:
        found = self.simulation.last_intersections
        self.hits.append(found.hit_count)
        self.contours.append(found.contour_count)
        self.length.append(found.length)
        self.strains.append(metrics.max_strain(self.simulation.model, self.simulation.positions))


def control(simulation: cg.Simulation, snapshot: Any, steps: int) -> int:
    """Most hits in steps from a snapshot on without untangling: what contact alone lets through."""
    fidelity = dataclasses.replace(simulation.fidelity, untangling="none")
    alone = cg.Simulation(simulation.scene, fidelity)
    alone.restore(dataclasses.replace(snapshot, memory=np.zeros(0)))  # nothing remembers what "stall" does
    return max(Histories(alone).play(steps).hits)


def work_units(simulation: cg.Simulation) -> int:
    """Deterministic cost of untangling so far: edge-triangle tests and gradients."""
    work = simulation.metrics()["work"]
    return int(work.get("edge_triangle_tests", 0) + work.get("hits", 0))


def untangling_share(simulation: cg.Simulation) -> float | None:
    """Share of finding and resolving intersections in the time of all stages."""
    profile = simulation.profile
    stages = {stage.name: profile[stage.name][1] for stage in simulation.pipeline.stages}
    total = sum(stages.values())
    return sum(t for name, t in stages.items() if name.startswith("intersections")) / total if total > 0.0 else None


def quantile(values: Iterable[float | None], share: float) -> float | None:
    """Smallest value that at least this share of all lies at or below; None counts as infinite, and so may be the answer."""
    ordered = sorted(math.inf if value is None else value for value in values)
    value = ordered[max(math.ceil(share * len(ordered)) - 1, 0)]
    return value if math.isfinite(value) else None


def known(values: Iterable[float | None]) -> list[float]:
    """Those that are there."""
    return [value for value in values if value is not None]


def median(values: Iterable[float | None]) -> float | None:
    """Of those that are there."""
    there = known(values)
    return statistics.median(there) if there else None


def of_part(rows: list[Row], part: str) -> list[Row]:
    """Rows of one part of the benchmark."""
    return [row for row in rows if row["parameters"]["part"] == part]
