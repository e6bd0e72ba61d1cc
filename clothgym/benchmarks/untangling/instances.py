"""Small tangles with known clean states, many of each: how many does a strategy resolve, and the right way round?

Each step of the simulation makes its passes and then moves the cloth on. "At once" makes all passes before the first step.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks.untangling.measure import EXPLOSION, Histories, control, work_units
from clothgym.scenes.hard import DRAWN
from clothgym.scenes.tangle import Tangle

FIELDS: dict[str, Any] = {"substeps": 2, "sweeps": 4, "untangling_passes": 1, "h0": 1.0, "velocity_share": 1.0}
"""Of the fidelity, unless a case says otherwise."""
_STALL = 30
"""Passes without fewer hits, or less length with as many, after which a run counts as stalled."""


def resolution_for(depth: float) -> int:
    """Edges a side at which the misplaced part stays the smaller one."""
    return max(16, 8 * math.ceil((2.0 * depth + 4.0) / 8.0) + (8 if depth > 3.0 else 0))


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """`count` instances of a tangle from `seed` on, each until it is clean, stalls, or has used `budget` passes.

    Args:
        parameters: `tangle` (a name in `scenes.hard.DRAWN`) with its own `settings`; `strategy`; `fields` of the fidelity;
            `count`, `seed`, `budget`; `later`: steps that the first `followed` instances go on.
    """
    fidelity = cg.Fidelity(**(FIELDS | parameters["fields"] | {"untangling": parameters["strategy"]}))
    found = []
    for number in range(parameters["count"]):
        drawn = DRAWN[parameters["tangle"]](**parameters["settings"], seed=parameters["seed"] + number)
        later = parameters["later"] if number < parameters["followed"] else 0
        found.append(resolve(drawn, fidelity, parameters["budget"], later))
    return {key: [one[key] for one in found] for key in found[0]}


def resolve(tangle: Tangle, fidelity: cg.Fidelity, budget: int, later: int = 0) -> dict[str, Any]:
    """One tangle, until it is clean or is given up.

    Returns:
        passes until there were no hits, None = never; right: clean, and everything on its side; reason: "resolved", "stalled",
        "budget", "explosion" or "failure"; area under L / L0 over the passes; work units; milliseconds of all steps; strain:
        the largest on the way; displacement: root mean square [edges]; returns: most hits in `later` steps on, control: the
        same without untangling, None = not asked.
    """
    simulation = cg.Simulation(tangle.scene, fidelity)
    start = simulation.positions.copy()
    histories = Histories(simulation)
    best, best_pass, passes, area = (histories.hits[0], histories.length[0]), 0, 0, 0.0
    started = time.process_time()
    while True:
        stepped = histories.step()
        done = simulation.metrics()["untangling_passes"]
        # a pass at a clean state is none: the last step that found nothing ends the run
        area += (done - passes) * histories.length[-2 if stepped else -1] / histories.length[0]
        passes = done
        if not stepped:
            reason = "failure"
        elif histories.clean:
            reason = "resolved"
        elif histories.strains[-1] > EXPLOSION:
            reason = "explosion"
        elif passes >= budget or len(histories.seconds) >= budget:
            reason = "budget"
        else:
            now = (histories.hits[-1], histories.length[-1])
            if now < best:
                best, best_pass = now, max(passes, len(histories.seconds))
            if max(passes, len(histories.seconds)) - best_pass < _STALL:
                continue
            reason = "stalled"
        break
    clean = reason == "resolved"
    result = {
        "passes": passes if clean else None,
        "right": clean and tangle.right(simulation.positions),
        "reason": reason,
        "area": area,
        "work": work_units(simulation),
        "milliseconds": 1e3 * (time.process_time() - started),
        "strain": max(histories.strains) - histories.strains[0],
        "displacement": float(np.sqrt(((simulation.positions - start) ** 2).sum(axis=1).mean())) / tangle.edge,
        "length_left": histories.length[-1] / histories.length[0],
        "returns": None,
        "control": None,
    }
    if clean and later:
        snapshot = simulation.snapshot()
        result["returns"] = max(Histories(simulation).play(later).hits)
        result["control"] = control(simulation, snapshot, later)
    return result


def null(parameters: dict[str, Any]) -> dict[str, Any]:
    """Of a tangle's start: |sum s G| / sum |G| of every contour, G of [Volino 2006] eq. 4, and how many hits have next to no
    gradient of their own.

    Args:
        parameters: `tangle`, `settings`, `seed`.
    """
    drawn = DRAWN[parameters["tangle"]](**parameters["settings"], seed=parameters["seed"])
    hits = cg.Simulation(drawn.scene, cg.Fidelity()).last_intersections
    frames = hits.frames
    gradients = frames[:, :3] - 2.0 * frames[:, 7:8] * frames[:, 3:6]
    signed = hits.hit_side[:, None] * gradients
    sums = np.stack([np.bincount(hits.hit_contour, signed[:, c]) for c in range(3)], axis=1)
    sizes = np.bincount(hits.hit_contour, np.linalg.norm(gradients, axis=1))
    return {
        "coherence": (np.linalg.norm(sums, axis=1) / np.maximum(sizes, 1e-300)).tolist(),
        "silent": float((np.linalg.norm(gradients, axis=1) < 0.05).mean()),
        "hits": hits.hit_count,
        "kinds": [contour.kind for contour in hits.contours],
    }
