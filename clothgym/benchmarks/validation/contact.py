"""V9, V13: a sheet on a slope, and one that bounces."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks.frame import Case
from clothgym.benchmarks.validation import known, measure
from clothgym.benchmarks.validation.solvers import simulate, solvers
from clothgym.scenes import validation as scenes

FRICTION = 0.3
_TARGET = 0.02
_DT = 1.0 / 480.0


def cases(quick: bool) -> list[Case]:
    """Slope as ground and as body with Coulomb friction, eq. 12 on the body, and bounces, with every solver."""
    listed = []
    for solver in solvers("springs" if quick else None):
        for plane in ("ground", "body"):
            settings = {"family": "incline", "solver": solver, "plane": plane, "rounds": 1 if quick else 4}
            listed.append(Case(f"incline/{plane}/{solver}", settings))
        listed.append(Case(f"creep/{solver}", {"family": "creep", "solver": solver, "slide": 0.98}))
        if not quick:
            listed.append(Case(f"capstan/{solver}", {"family": "capstan", "solver": solver, "rounds": 7}))
        for rebound in (0.5,) if quick else (0.0, 0.3, 0.5, 0.7, 0.9):
            listed.append(
                Case(f"bounce/{rebound}/{solver}", {"family": "bounce", "solver": solver, "rebound": rebound})
            )
    return listed


def _down(simulation: cg.Simulation, direction: np.ndarray, start: np.ndarray) -> float:
    return float((simulation.positions - start).mean(axis=0) @ direction)


def _slope(angle: float, plane: str, **settings: float) -> tuple[cg.Scene, np.ndarray]:
    """The scene, and the direction down the slope."""
    a = math.radians(angle)
    direction = (0.0, 0.0, 1.0) if plane == "ground" else (0.0, -math.sin(a), math.cos(a))
    return scenes.incline(angle, FRICTION, plane, **settings), np.array(direction)


def _way(share: float, plane: str, solver: str, seconds: float) -> float:
    """Way [m] down a slope whose tangent is that share of the coefficient of friction."""
    angle = math.degrees(math.atan(share * FRICTION))
    scene, direction = _slope(angle, plane)
    faces: dict[str, Any] = (
        {"body_faces": 1} if plane == "body" else {}
    )  # a flat sheet touches a flat slab with its vertices
    simulation = simulate(scene, solver, _DT, seconds / 10, **faces)
    simulation.step(10)
    return _down(simulation, direction, scene.start)


def _threshold(plane: str, solver: str, rounds: int) -> float:
    """Share of the coefficient of friction from which on a sheet slides, within the bracket that `rounds` halvings leave."""

    def slides(share: float) -> bool:
        return _way(share, plane, solver, 1.0) > 2e-3  # that far in a second: 0.04 % above the threshold

    low, high = 0.98, 1.02
    if slides(low) or not slides(high):
        low, high, rounds = 0.0, 4.0, rounds + 7
    for _ in range(rounds):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if slides(middle) else (middle, high)
    return 0.5 * (low + high)


def incline(solver: str, plane: str, rounds: int) -> dict[str, Any]:
    """Tangent of the angle at which a sheet begins to slide, and how far it slides at 1.5 times that."""
    steep = math.degrees(math.atan(1.5 * FRICTION))
    return {
        "quantities": [
            measure.quantity(
                "tan(angle) where it slides", _threshold(plane, solver, rounds) * FRICTION, FRICTION, _TARGET
            ),
            measure.quantity("way at 0.9 of it in 1 s [m]", _way(0.9, plane, solver, 1.0), 0.0, 1e-4, absolute=True),
            measure.quantity(
                "way at 1.5 of it in 0.5 s [m]",
                _way(1.5, plane, solver, 0.5),
                known.slide_distance(steep, FRICTION, 0.5, scenes.G),
                _TARGET,
            ),
        ]
    }


def capstan(solver: str, rounds: int) -> dict[str, Any]:
    """Ratio of the hanging ends at which a strip over a cylinder begins to slide."""
    short = 0.3
    exact = known.capstan_ratio(FRICTION, 0.05 + scenes.CLEARANCE, short)

    def slides(ratio: float) -> bool:
        scene = scenes.capstan(ratio, FRICTION, short)
        simulation = simulate(scene, solver, _DT / 4, 0.05, body_faces=0)
        simulation.step(10)
        settled = simulation.positions[:2, 2].mean()
        simulation.step(10)
        # 0.5 mm in the second half second: the strip has come to its strain by then
        return float(simulation.positions[:2, 2].mean() - settled) > 5e-4

    low, high = 0.5 * exact, 1.5 * exact
    for _ in range(rounds):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if slides(middle) else (middle, high)
    return {"quantities": [measure.quantity("ratio where it slides", 0.5 * (low + high), exact)]}


def creep(solver: str, slide: float) -> dict[str, Any]:
    """Speed down a slope of half the angle of friction under [Vassilev 2001] eq. 12: its formula, where Coulomb stands."""
    angle = math.degrees(math.atan(0.5 * FRICTION))
    scene, direction = _slope(angle, "body", slide=slide)
    simulation = simulate(scene, solver, _DT, 0.01, body_response="velocity")
    dt = simulation.pipeline.dt
    lasting = -math.log(1e-4) / -math.log(slide) * dt
    simulation.step(math.ceil(lasting / 0.01))
    speed = float(simulation.velocities.mean(axis=0) @ direction)
    there, before = _down(simulation, direction, scene.start), simulation.time
    simulation.step(10)
    way = (_down(simulation, direction, scene.start) - there) / (simulation.time - before)
    late = 1.0 if known.order(solver) == 1 else 0.5
    exact = known.creep_speed(slide, angle, dt, scenes.G)
    return {
        "quantities": [
            measure.quantity("creep by eq. 12 [m/s]", speed, exact, _TARGET),
            # a substep of first order moves by the speed before contact, others by the mean of the substep
            measure.quantity("way of the creep in 1 s [m]", way, exact * (late / slide + 1.0 - late), _TARGET),
            measure.quantity("stands, as Coulomb would [m/s]", speed, 0.0, 1e-4, absolute=True)
            | {"predicted": "fails"},
        ],
        "dt": dt,
    }


def bounce(solver: str, rebound: float) -> dict[str, Any]:
    """Height after the first bounce over that of the fall."""
    height = 0.1
    scene = scenes.bounce(height, rebound)
    every = 2e-3
    simulation = simulate(scene, solver, every / 8, every, body_response="velocity")
    heights = measure.record(
        simulation, round(scene.duration / every), lambda s: float(s.positions[:, 1].mean()) - scenes.CLEARANCE
    )
    low = int(np.argmin(heights[: round(1.5 * math.sqrt(2.0 * height / scenes.G) / every)]))
    top = float(heights[low:].max()) / height
    return {
        "quantities": [measure.quantity("height again / height", top, rebound**2, _TARGET, absolute=rebound == 0.0)]
    }
