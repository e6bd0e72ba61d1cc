"""Half of all contacts and intersections ignored [Volino 2006, 3.1.2 and Fig. 7]; what is measured misses nothing."""

from __future__ import annotations

import statistics
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks.untangling.measure import Histories, untangling_share, work_units
from clothgym.detection.tracking import ContourTracker

FIELDS: dict[str, Any] = {"substeps": 4, "sweeps": 8, "velocity_share": 0.0, "untangling_passes": 3, "easing": 0}
"""Small fresh tangles between layers that press on each other: positions only, some passes a step."""


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """The scene `faulty_detection`: `settings`, `strategy`, `fields`, `seed`, `steps`."""
    fidelity = cg.Fidelity(**(FIELDS | parameters["fields"] | {"untangling": parameters["strategy"]}))
    scene = cg.scenes.make("faulty_detection", **parameters["settings"], seed=parameters["seed"])
    simulation = cg.Simulation(scene, fidelity)
    tracker = ContourTracker()
    numbers = np.zeros(0, np.int64)

    def look() -> None:
        nonlocal numbers
        numbers = tracker.follow(simulation.last_intersections)

    histories = Histories(simulation).play(parameters["steps"], look)
    lengths = np.array(histories.length)
    edge = float(simulation.model.mean_edge)
    quarter = max(1, len(lengths) // 4)
    ages = [*tracker.lives().values(), *(1 + tracker.ages(numbers)).tolist()]  # those still there included
    return {
        "mean_length": float(lengths.mean()) / edge,
        "largest_length": float(lengths.max()) / edge,
        "third_quarter": float(lengths[-2 * quarter : -quarter].mean()) / edge,
        "last_quarter": float(lengths[-quarter:].mean()) / edge,
        "life": statistics.median(ages) if ages else None,
        "brief": sum(age <= 2 for age in ages) / len(ages) if ages else None,
        "contours": len(ages),
        "strain": max(histories.strains),
        "step_seconds": statistics.median(histories.seconds) if histories.seconds else None,
        "untangling_share": untangling_share(simulation),
        "work": work_units(simulation),
        "failure": histories.failure,
        "history": {"hits": histories.hits, "length": (lengths / edge).tolist()},
    }
