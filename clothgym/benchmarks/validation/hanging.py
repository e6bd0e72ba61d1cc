"""V4, V5: a column that stretches under its own weight, a catenary; both at rest."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from clothgym import materials
from clothgym.benchmarks.frame import Case
from clothgym.benchmarks.validation import known, measure
from clothgym.benchmarks.validation.solvers import IMPLICIT, simulate, solvers, split
from clothgym.scenes import validation as scenes

_TARGET = 0.005


def cases(quick: bool) -> list[Case]:
    """Columns of several rows, catenaries of several lengths, with every solver."""
    rows = (10,) if quick else (10, 20, 40)
    slacks = (1.25,) if quick else (1.01, 1.05, 1.1, 1.25, 1.5, 2.0)
    links = 20 if quick else 40
    listed = []
    for solver in solvers():
        listed += [Case(f"column/{n}/{solver}", {"family": "column", "solver": solver, "rows": n}) for n in rows]
        listed += [
            Case(f"catenary/{slack}/{solver}", {"family": "catenary", "solver": solver, "slack": slack, "links": links})
            for slack in slacks
        ]
        if not quick:  # how the sag converges with the number of links
            listed += [
                Case(
                    f"catenary/1.25/{n} links/{solver}",
                    {"family": "catenary", "solver": solver, "slack": 1.25, "links": n},
                )
                for n in (10, 20)
            ]
    return listed


def column(solver: str, rows: int) -> dict[str, Any]:
    """Elongation of every spring, of all together, and against the continuum."""
    strain = 1e-3
    scene = scenes.column(rows, strain)
    dt = (1e-3 if split(solver)[0] in IMPLICIT else 2e-4) * 20 / rows
    simulation = simulate(scene, solver, dt, 0.01)
    left = measure.settle(simulation, scene.duration, 1e-9)
    height = simulation.positions[:, 1].reshape(-1, 2).mean(axis=1)
    stretched = -np.diff(height) - 1.0 / rows
    stiffness = 2.0 * materials.get(scene.cloths[0].material).stretch
    masses = simulation.model.masses.reshape(-1, 2).sum(axis=1)[1:]
    exact = known.column_elongations(masses, stiffness, scenes.G)
    found = [
        measure.quantity(f"elongation, {rows} rows [m]", float(stretched.sum()), float(exact.sum()), _TARGET),
        measure.quantity("spring that is furthest off", *_worst(stretched, exact), _TARGET),
        # rho g L^2 / (2 Y): equal masses of which one is held hang as the continuum does
        measure.quantity(
            "elongation, continuum [m]", float(stretched.sum()), scenes.DENSITY * scenes.G / (2.0 * stiffness), _TARGET
        ),
    ]
    return {"quantities": found, "speed_left": left}


def _worst(measured: np.ndarray, exact: np.ndarray) -> tuple[float, float]:
    at = int(np.argmax(np.abs(measured / exact - 1.0)))
    return float(measured[at]), float(exact[at])


def catenary(solver: str, slack: float, links: int) -> dict[str, Any]:
    """Sag over span."""
    scene = scenes.catenary(slack, links)
    # the links' stretch is stiffer, the less of it is allowed
    dt = 4e-3 if split(solver)[0] in IMPLICIT else 1e-2 / links * math.sqrt(min(slack - 1.0, 0.1))
    simulation = simulate(scene, solver, dt, 1.0 / 60.0)
    left = measure.settle(simulation, scene.duration, 1e-7)
    sag = float(-simulation.positions[:, 1].min())
    target = _TARGET if links >= 20 else None  # few links show how the error falls
    found = [measure.quantity(f"sag / span, {links} links", sag, known.catenary_sag(slack), target)]
    return {"quantities": found, "speed_left": left, "cells": links}
