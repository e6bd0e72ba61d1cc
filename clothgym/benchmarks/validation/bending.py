"""V7, V12: a cantilever under its own weight, and the moment that each bending energy answers a curvature with."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.arrays import FloatArray
from clothgym.benchmarks.frame import Case
from clothgym.benchmarks.validation import known, measure
from clothgym.benchmarks.validation.solvers import IMPLICIT, simulate, solvers, split
from clothgym.fidelity import MEMBRANES
from clothgym.scenes import validation as scenes

STIFF = ("hinge", "quadratic")
"""Bending energies that resist small curvature."""
RIGIDITY = 1e-4
"""[N m]"""
_TARGET = 0.01


def cases(quick: bool) -> list[Case]:
    """Cantilevers of several loads, and M(kappa) of every bending energy."""
    loads = (10,) if quick else (1, 2, 5, 8, 10, 20, 50, 100)
    rows = 12 if quick else 32
    listed = []
    for membrane in MEMBRANES:
        for number, solver in enumerate(solvers(membrane)):
            for bending in STIFF[:1] if quick and number else STIFF:
                key = f"{bending}/{solver}"
                shape = {"rows": rows, "columns": 2, "grain": "0"}
                settings = {"family": "cantilever", "solver": solver, "bending": bending, **shape}
                # other solvers have the same energy, and so the same rest: three loads show it
                asked = loads if number == 0 else [load for load in loads if load in (1, 10, 100)]
                listed += [Case(f"cantilever/{load}/{key}", {**settings, "load": load}) for load in asked]
                if quick or number:
                    continue
                listed += [Case(f"cantilever/10/{n} rows/{key}", {**settings, "load": 10, "rows": n}) for n in (8, 16)]
                listed += [
                    Case(f"cantilever/10/{grain} degrees/{key}", {**settings, "load": 10, "grain": grain, "columns": 6})
                    for grain in ("0", "45", "90")
                ]
    for bending in ("flexion", *STIFF):
        listed += [Case(f"moment/{bending}", {"family": "moment", "bending": bending, "rows": 24})]
    return listed


def cantilever(solver: str, bending: str, load: float, rows: int, columns: int, grain: str) -> dict[str, Any]:
    """Depth of the tip over the length, and over its reach."""
    scene = scenes.cantilever(float(load), rows, columns, 0.2, grain)
    # sweeps converge where a substep is short against the fastest bending; explicit solvers shorten it to what is stable
    dt = 8e-3 if split(solver)[0] in IMPLICIT else min(0.05 * math.sqrt(load) / rows**2, 3e-3 / rows)
    simulation = simulate(scene, solver, dt, 1.0 / 60.0, bending)
    start = scene.start
    clamp = float(start[simulation.model.inverse_masses == 0, 2].mean())
    left = measure.settle(simulation, scene.duration, 1e-5)
    tip = simulation.positions[start[:, 2] > start[:, 2].max() - 1e-9].mean(axis=0)
    length = float(start[:, 2].max()) - clamp
    depth, reach = -tip[1] / length, (tip[2] - clamp) / length
    exact = known.elastica(float(load))
    target = _TARGET if rows >= 12 else None  # few rows show how the error falls
    return {
        "quantities": [
            measure.quantity("H / L", float(depth), exact[0], target),
            measure.quantity("H / W", float(depth / reach), exact[0] / exact[1], target),
        ],
        "speed_left": left,
        "substeps": simulation.pipeline.substeps,
    }


def bent_strip(bending: str, rows: int, columns: int, length: float = 0.24) -> tuple[cg.Simulation, cg.Mesh]:
    """A flat strip without gravity, and its mesh; flexion springs of 1 N/m or the rigidity."""
    mesh = cg.grid(length * columns / rows, length, columns, rows)
    if bending == "flexion":
        material = scenes.fabric(1.0, columns, 0.5, flexion=1.0)
    else:
        material = scenes.fabric(1.0, columns, 0.5, RIGIDITY)
    scene = cg.Scene([cg.Cloth(mesh, material)], gravity=(0.0, 0.0, 0.0), self_collision=False)
    solver = "xpbd" if "continuum" not in MEMBRANES or bending == "flexion" else "xpbd+continuum"
    return simulate(scene, solver, 1e-3, 1e-3, bending), mesh


def energy(simulation: cg.Simulation, positions: FloatArray) -> float:
    """Potential energy of the cloth at these positions [J]."""
    simulation.set_positions(positions)
    return float(simulation.metrics()["potential_energy"])


def _polygon(mesh: cg.Mesh, rows: int, turn: float) -> FloatArray:
    """Positions where every row of the strip is turned against the next by an angle; no length changes."""
    row = np.rint((mesh.vertices[:, 2].max() - mesh.vertices[:, 2]) / np.ptp(mesh.vertices[:, 2]) * rows).astype(int)
    angles = turn * np.arange(rows)
    steps = np.ptp(mesh.vertices[:, 2]) / rows * np.stack([np.sin(angles), np.cos(angles)], axis=1)
    line = np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)])[row]
    return np.stack([mesh.vertices[:, 0], line[:, 0], line[:, 1]], axis=1)


def moment(bending: str, rows: int) -> dict[str, Any]:
    """Moment of a strip over its curvature, from the change of its energy; its power law at small curvature."""
    columns = 2
    simulation, mesh = bent_strip(bending, rows, columns)
    spacing = 0.24 / rows
    turns = (0.02, 0.05, 0.1, 0.2)
    found, moments = [], []
    for turn in turns:
        ends = [energy(simulation, _polygon(mesh, rows, turn + sign * 1e-3)) for sign in (1.0, -1.0)]
        measured = (ends[0] - ends[1]) / 2e-3 / (rows - 1)
        moments.append(measured)
        curvature = turn / spacing
        if bending == "flexion":
            exact = (columns + 1) * known.flexion_moment(1.0, spacing, curvature)
        else:
            exact = RIGIDITY * curvature * columns * spacing
        found.append(measure.quantity(f"M at {turn:g} rad a cell [N m]", measured, exact, _TARGET))
    power = measure.order(turns, moments)
    found.append(measure.quantity("power of the curvature", power, 3.0 if bending == "flexion" else 1.0, _TARGET))
    return {"quantities": found, "curvatures": [turn / spacing for turn in turns], "moments": moments}
