"""The ribbon in the dish [Volino 2006, 3.1.3 and Fig. 8]."""

from __future__ import annotations

import statistics
from typing import Any

import clothgym as cg
from clothgym.benchmarks.untangling.measure import Histories, quantile, untangling_share, work_units

FIELDS: dict[str, Any] = {"substeps": 1, "sweeps": 8, "velocity_share": 0.0, "untangling_passes": 2}


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """The scene `ribbon`: `settings`, `strategy`, `fields`, `seed`, `steps`."""
    fidelity = cg.Fidelity(**(FIELDS | parameters["fields"] | {"untangling": parameters["strategy"]}))
    scene = cg.scenes.make("ribbon", **parameters["settings"], seed=parameters["seed"])
    simulation = cg.Simulation(scene, fidelity)
    heights = [float(simulation.positions[simulation.cloth_ranges[0][1], 1].mean())]

    def look() -> None:
        heights.append(float(simulation.positions[simulation.cloth_ranges[0][1], 1].mean()))

    histories = Histories(simulation).play(parameters["steps"], look)
    work = simulation.metrics()["work"]
    tangled = [step for step, count in enumerate(histories.hits) if count > 0]
    return {
        "triangles": len(scene.cloths[0].mesh.faces),
        "substeps": simulation.pipeline.substeps,
        "sweeps": simulation.pipeline.stages[-1].step.sweeps,  # type: ignore[attr-defined]
        "time": simulation.time,
        "fell": heights[0] - heights[-1],
        "start_hits": histories.hits[0],
        "most_hits": max(histories.hits),
        "tangled_steps": len(tangled),
        "last_tangled": tangled[-1] if tangled else None,
        "end_hits": histories.hits[-1],
        "strain": max(histories.strains),
        "step_seconds": statistics.median(histories.seconds) if histories.seconds else None,
        "step_seconds_p90": quantile(histories.seconds, 0.9) if histories.seconds else None,
        "contacts": int(work.get("contacts", 0)) // max(1, len(histories.seconds) * simulation.pipeline.substeps),
        "untangling_share": untangling_share(simulation),
        "work": work_units(simulation),
        "failure": histories.failure,
        "history": {"hits": histories.hits, "length": histories.length},
    }
