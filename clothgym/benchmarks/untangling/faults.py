"""Half of all contacts and intersections ignored [Volino 2006, 3.1.2 and Fig. 7]; what is measured misses nothing."""

from __future__ import annotations

import statistics
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks.untangling.measure import Histories, untangling_share, work_units

FIELDS: dict[str, Any] = {"substeps": 4, "sweeps": 8, "velocity_share": 0.0, "untangling_passes": 3}
"""Small fresh tangles between layers that press on each other: positions only, some passes a step."""


class Lives:
    """How long contours live: one goes on from a step to the next if it joins the same pieces of cloth beside a common vertex.

    For watching only: no strategy sees it. A contour that splits counts as both, one that joins others as the oldest.
    """

    def __init__(self, simulation: cg.Simulation) -> None:
        self.simulation = simulation
        self.alive: list[tuple[tuple[int, ...], set[int], int]] = []
        self.ended: list[int] = []

    def look(self) -> None:
        """After every step."""
        hits = self.simulation.last_intersections
        surface = hits.surface
        now = []
        kept: set[int] = set()
        order = np.argsort(hits.hit_contour, kind="stable")
        bounds = np.cumsum(np.r_[0, np.bincount(hits.hit_contour, minlength=hits.contour_count)])
        for c in range(hits.contour_count):
            own = order[bounds[c] : bounds[c + 1]]
            near = np.concatenate(
                [surface.edges[hits.hit_edge[own]].ravel(), surface.faces[hits.hit_face[own]].ravel()]
            )
            vertices = set(near.tolist())
            pieces = tuple(np.unique(surface.components[near]).tolist())
            before = [n for n, (p, v, _) in enumerate(self.alive) if p == pieces and not v.isdisjoint(vertices)]
            kept.update(before)
            now.append((pieces, vertices, 1 + max((self.alive[n][2] for n in before), default=0)))
        self.ended += [age for n, (_, _, age) in enumerate(self.alive) if n not in kept]
        self.alive = now

    def all(self) -> list[int]:
        """Steps that each contour lived, those still there included."""
        return self.ended + [age for _, _, age in self.alive]


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """The scene `faulty_detection`: `settings`, `strategy`, `fields`, `seed`, `steps`."""
    fidelity = cg.Fidelity(**(FIELDS | parameters["fields"] | {"untangling": parameters["strategy"]}))
    scene = cg.scenes.make("faulty_detection", **parameters["settings"], seed=parameters["seed"])
    simulation = cg.Simulation(scene, fidelity)
    lives = Lives(simulation)
    histories = Histories(simulation).play(parameters["steps"], lives.look)
    lengths = np.array(histories.length)
    edge = float(simulation.model.mean_edge)
    quarter = max(1, len(lengths) // 4)
    ages = lives.all()
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
