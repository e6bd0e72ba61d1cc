"""What untangling costs beside a step of the simulation, part by part, on the same state."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import clothgym as cg
from clothgym.detection.intersections import Intersections
from clothgym.response import untangling


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """A scene of squares: `scene`, `settings`, `seed`, `strategy`, `repeats`; after `steps` steps.

    Returns:
        hits; seconds, the least of the repeats: step, of a step with one pass; candidates: boxes and pairs of an edge and a
        face; tests: exact tests; contours: grouping, sides, segments; response: gradients and their distribution, and regions:
        the part of it that finds what contours cut off, 0 for strategies that do not ask.
    """
    strategy = untangling.get(parameters["strategy"])
    if strategy is None:
        raise ValueError(f"overhead: strategy = {parameters['strategy']!r}: costs nothing")
    scene = cg.scenes.make(parameters["scene"], **parameters["settings"], seed=parameters["seed"])
    fidelity = cg.Fidelity(untangling=parameters["strategy"], untangling_passes=1)
    simulation = cg.Simulation(scene, fidelity)
    simulation.step(parameters["steps"])
    snapshot = simulation.snapshot()
    model, x = simulation.model, simulation.positions.copy()
    stage = next(s for s in simulation.pipeline.stages if hasattr(s, "candidates"))
    tree = stage.candidates.tree  # type: ignore[attr-defined]
    repeats = parameters["repeats"]

    def search() -> Any:
        tree.refit(x, x, 0.0)
        return tree.edges_against_faces()

    def found() -> Intersections:
        return Intersections(x, model.surface, edge_face=search().copy())

    seconds: dict[str, float] = {}
    seconds["candidates"] = _least(repeats, search)
    pairs = search().copy()
    seconds["tests"] = _least(
        repeats, lambda given: Intersections(x, model.surface, edge_face=given), lambda: (pairs.copy(),)
    )
    seconds["contours"] = _least(repeats, lambda hits: hits.hit_contour, lambda: (found(),))
    hits = found()
    count = hits.hit_count
    if count:

        def context() -> tuple[untangling.Context]:
            fresh = found()
            _ = fresh.hit_contour
            given = (fresh, model.inverse_masses, model.vertex_areas, fidelity.h0 * model.mean_edge, fidelity.g0)
            return (untangling.Context(*given, untangling.memory(strategy)),)

        seconds["response"] = _least(repeats, lambda given: untangling.answer(strategy, given), context)
        (given,) = context()
        untangling.answer(strategy, given)
        asked = "enclosed" in given.__dict__
        seconds["regions"] = _least(repeats, lambda given: given.enclosed, context) if asked else 0.0
    else:
        seconds |= dict.fromkeys(("contours", "response", "regions"), 0.0)  # nothing asks for them

    def restored() -> tuple[()]:
        simulation.restore(snapshot)
        return ()

    seconds["step"] = _least(repeats, simulation.step, restored)
    return {"hits": count, "seconds": seconds}


def _least(repeats: int, action: Callable[..., Any], before: Callable[[], tuple[Any, ...]] = tuple) -> float:
    """Least process time of an action [s]; what it is given is made outside of it."""
    times = []
    for _ in range(repeats):
        given = before()
        started = time.process_time()
        action(*given)
        times.append(time.process_time() - started)
    return min(times)
