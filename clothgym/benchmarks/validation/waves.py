"""V6: waves along a row of springs, and of a stretched membrane."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks.frame import Case
from clothgym.benchmarks.validation import known, measure
from clothgym.benchmarks.validation.solvers import simulate, solvers
from clothgym.scenes import validation as scenes

MODULUS = 100.0
"""[N/m]"""
_STILL = (0.0, 0.0, 0.0)
_TARGET = 0.005


def cases(quick: bool) -> list[Case]:
    """Waves of several lengths, modes of a membrane, with every solver."""
    waves = (4,) if quick else (1, 4, 8, 12, 15)
    modes = ((1, 1),) if quick else ((1, 1), (2, 1), (2, 2), (3, 1))
    cells = 8 if quick else 16
    listed = []
    asked = "springs" if quick else None
    listed = [
        Case(f"wave/{n}/{solver}", {"family": "wave", "solver": solver, "number": n})
        for solver in solvers(asked)
        for n in waves
    ]
    listed += [
        Case(f"membrane/{m}{n}/{solver}", {"family": "membrane", "solver": solver, "modes": [m, n], "cells": cells})
        for solver in solvers(asked, reduced=not quick)
        for m, n in modes
    ]
    return listed


def wave(solver: str, number: int) -> dict[str, Any]:
    """Frequency of a standing wave along a strip of 16 cells, held at both ends: `number` half waves."""
    cells = 16
    phase = math.pi * number / cells
    mesh = cg.grid(1.0 / cells, 1.0, 1, cells)
    shape = np.sin(phase * np.rint((0.5 - mesh.vertices[:, 2]) * cells))
    start = mesh.vertices + 1e-4 / cells * np.outer(shape, (0.0, 0.0, -1.0))
    pins = (0, 1, 2 * cells, 2 * cells + 1)
    cloth = cg.Cloth(
        cg.Mesh(start, mesh.faces, mesh.quads), scenes.fabric(MODULUS, 1), pins, mesh.vertices, equal_masses=True
    )
    scene = cg.Scene([cloth], gravity=_STILL, self_collision=False)
    exact = known.spring_wave(MODULUS, scenes.DENSITY / cells / (cells + 1), phase)
    every = 2.0 * math.pi / exact / 100
    simulation = simulate(scene, solver, 0.02 / exact, every)
    rest = mesh.vertices[:, 2]
    swing = measure.record(simulation, 120, lambda s: float(shape @ (s.positions[:, 2] - rest)))
    found = measure.period(swing, every)
    frequency = None if found is None else 2.0 * math.pi / found
    return {"quantities": [measure.quantity("frequency [rad/s]", frequency, exact, _TARGET)], "phase": phase}


def membrane(solver: str, modes: list[int], cells: int) -> dict[str, Any]:
    """Frequency of a square membrane, held around its border and stretched by 1e-3, against that of the same lattice and
    that of a continuous one."""
    stretch = 1e-3
    mesh = cg.grid(1.0, 1.0, cells, cells)
    flat = mesh.vertices * (1.0 + stretch)
    place = np.rint((mesh.vertices[:, [0, 2]] + 0.5) * cells)
    shape = np.sin(math.pi * modes[0] * place[:, 0] / cells) * np.sin(math.pi * modes[1] * place[:, 1] / cells)
    border = ((place == 0) | (place == cells)).any(axis=1)
    shape[border] = 0.0
    # inside a sheet springs are as stiff as the modulus, and its border is held
    material = scenes.fabric(MODULUS, cells, stretch=MODULUS)
    start = flat + 3e-5 * np.outer(shape, (0.0, 1.0, 0.0))
    cloth = cg.Cloth(
        cg.Mesh(start, mesh.faces, mesh.quads),
        material,
        np.flatnonzero(border).tolist(),
        mesh.vertices,
        equal_masses=True,
    )
    scene = cg.Scene([cloth], gravity=_STILL, self_collision=False)
    mass, spacing = scenes.DENSITY / (cells + 1) ** 2, (1.0 + stretch) / cells
    pull = MODULUS * stretch / (1.0 + stretch)
    phases = (math.pi * modes[0] / cells, math.pi * modes[1] / cells)
    exact = known.lattice_membrane_frequency(pull, mass, phases)
    continuous = known.membrane_frequency(pull, mass / spacing**2, (modes[0], modes[1]), (spacing * cells,) * 2)
    every = 1.0 / exact / 100
    simulation = simulate(scene, solver, 0.005 / exact / 2.0 / math.pi, every)
    swing = measure.record(simulation, 120, lambda s: float(shape @ s.positions[:, 1]))
    found = measure.period(swing, every)
    frequency = None if found is None else 1.0 / found
    return {
        "quantities": [
            measure.quantity(f"frequency, {cells} cells [1/s]", frequency, exact, _TARGET),
            measure.quantity("frequency, continuous [1/s]", frequency, continuous),
        ]
    }
