"""Two layers around a torso, the inner one pushed out through the outer one, untangled."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import clothgym as cg
from clothgym.benchmarks.report import Table
from clothgym.scenes import shells
from clothgym_envs.tour.section import Section, fidelity, watch

STEPS, SHOWN = 60, (0, 4, 12, 60)


def run(out: Path) -> Section:
    """The shells under the hybrid scheme."""
    from clothgym.recording.frames import Camera

    simulation = cg.Simulation(cg.scenes.make("shells"), fidelity("hybrid"))
    camera = Camera.framing(simulation.positions, direction=(0.5, 0.15, 1.0), aspect=360 / 330)

    def side(sim: cg.Simulation) -> dict[str, float]:
        return {"side_error": shells.side_error(np.array(sim.positions))}

    result = watch(simulation, STEPS, SHOWN, camera, out / "shells_hybrid.rrd", side)
    h = result["history"]
    rows = [
        ("hits at start", int(h["hits"][0])),
        ("hits at the end", int(h["hits"][-1])),
        ("first clean step", result["first_clean_step"]),
        ("wrong side at start", h["side_error"][0]),
        ("wrong side at the end", h["side_error"][-1]),
        ("max strain", max(h["max_strain"])),
        ("ms a step", result["ms_per_step"]),
    ]
    text = (
        "Two layers of cloth around the torso of the CC0 body, the inner one pushed out through the outer one. Untangled "
        "is not enough: every vertex must come back to its own side."
    )
    table = Table("Two shells on a torso, untangled (hybrid)", ("what", "value"), rows)
    pictures = result.pop("pictures")
    return Section("Two shells on a torso", text, result, [table], [("shells.png", "hybrid scheme", pictures)], h)
