"""V11: what free flight keeps, whether the answer knows directions, places or numbers, and the stiffness by direction."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.arrays import FloatArray
from clothgym.benchmarks.frame import Case
from clothgym.benchmarks.validation import bending as bends
from clothgym.benchmarks.validation import known, measure
from clothgym.benchmarks.validation.solvers import rounding, simulate, solvers, split
from clothgym.fidelity import MEMBRANES
from clothgym.scenes import validation as scenes

ANGLES = (0, 45, 90)
"""Directions in the sheet [degrees]."""
_CELLS, _SIDE, _SECONDS, _SAMPLES = 5, 0.5, 0.1024, 32


def cases(quick: bool) -> list[Case]:
    """Free flight and convergence with every solver; stiffness by direction of every energy."""
    listed = []
    for solver in solvers():
        listed.append(
            Case(f"flight/{solver}", {"family": "flight", "solver": solver, "seed": 1, "levels": 3 if quick else 4})
        )
        listed.append(Case(f"invariance/{solver}", {"family": "invariance", "solver": solver, "seed": 1}))
    for membrane in MEMBRANES:
        listed.append(Case(f"stretch/{membrane}", {"family": "stretch", "membrane": membrane, "cells": 12}))
    for kind in bends.STIFF:
        listed.append(Case(f"bend/{kind}", {"family": "bend", "bending": kind, "cells": 8 if quick else 16}))
    return listed


def _sheet(seed: int, gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> tuple[cg.Scene, FloatArray]:
    """A crumpled, strained sheet that flies and turns, and its velocities."""
    rng = np.random.default_rng(seed)
    mesh = cg.grid(_SIDE, _SIDE, _CELLS, _CELLS)
    start = mesh.vertices + rng.normal(0.0, 0.002, mesh.vertices.shape) + (0.0, 1.0, 0.0)
    material = scenes.fabric(2.0, _CELLS, 1.0)
    velocities = np.array([0.5, 1.0, -0.3]) + np.cross([2.0, -1.0, 3.0], start - start.mean(axis=0))
    velocities += rng.normal(0.0, 0.1, velocities.shape)
    cloth = cg.Cloth(cg.Mesh(start, mesh.faces, mesh.quads), material, (), mesh.vertices)
    return cg.Scene([cloth], gravity=gravity, self_collision=False), velocities


def _flown(scene: cg.Scene, velocities: FloatArray, solver: str, dt: float, samples: int = 1) -> cg.Simulation:
    simulation = simulate(scene, solver, dt, _SECONDS / samples)
    simulation.set_velocities(velocities)
    return simulation


def _state(simulation: cg.Simulation) -> FloatArray:
    """Momentum (3), angular momentum about the origin (3), energy."""
    m, x, v = simulation.model.masses[:, None], simulation.positions, simulation.velocities
    numbers = simulation.metrics()
    total = numbers["kinetic_energy"] + numbers["potential_energy"]
    return np.concatenate([(m * v).sum(axis=0), np.cross(x, m * v).sum(axis=0), [total]])


def flight(solver: str, seed: int, levels: int = 3) -> dict[str, Any]:
    """Drift of momentum, angular momentum and energy, the fall of the centre of mass, order of convergence in the step."""
    scene, velocities = _sheet(seed)
    order, exact = known.order(solver), rounding(solver)
    longest = {1: 2e-4, 2: 4e-4, 4: 1.6e-3}[order]
    steps = [longest / 2**n for n in range(levels)]
    ends, lost, spins, wobbles, drifts = [], [], [], [], []
    for dt in steps:
        simulation = _flown(scene, velocities, solver, dt, _SAMPLES)
        seen = measure.record(simulation, _SAMPLES, _state)
        m, v = simulation.model.masses[:, None], velocities
        size = float((m * np.abs(v)).sum())
        lost.append(float(np.abs(seen[-1, :3] - seen[0, :3]).max()) / size)
        spins.append(float(np.abs(seen[:, 3:6] - seen[0, 3:6]).max()) / size)
        wobbles.append(float(np.abs(seen[:, 6] / seen[0, 6] - 1.0).max()))
        drifts.append(float(seen[-6:, 6].mean() / seen[:6, 6].mean() - 1.0))
        ends.append(simulation.positions.copy())
    found = [measure.quantity("momentum lost / all", max(lost), 0.0, exact, absolute=True)]
    if split(solver)[0] == "symplectic_euler" or max(spins) < exact:
        found.append(measure.quantity("angular momentum lost / all [m]", max(spins), 0.0, exact, absolute=True))
    else:
        p = measure.order(steps, spins)
        found.append(measure.at_least("order at which angular momentum is kept", p or math.nan, order - 0.2))
    p = measure.order(steps, wobbles)
    found.append(measure.quantity("order of the change of energy", p, None))
    found.append(measure.quantity("mean energy, last fifth / first - 1", drifts[-1], 0.0, absolute=True))
    gaps = [float(np.abs(a - b).max()) for a, b in itertools.pairwise(ends)]
    found.append(
        measure.quantity(
            "order in the time step", measure.order(steps[:-1], gaps), order, 0.15 if exact < 1e-6 else None
        )
    )
    found.append(_fall(solver, seed))
    return {
        "quantities": found,
        "order": {"steps": steps, "gaps": gaps, "energy": wobbles, "angular": spins, "energy_drift": drifts},
    }


def _fall(solver: str, seed: int) -> dict[str, Any]:
    """Way of the centre of mass under gravity alone; one-step methods of first order are off by dt / t."""
    scene, velocities = _sheet(seed, (0.0, -scenes.G, 0.0))
    dt = 2.5e-4
    simulation = _flown(scene, velocities, solver, dt)
    m = simulation.model.masses / simulation.model.masses.sum()
    before = m @ simulation.positions[:, 1] + _SECONDS * (m @ velocities[:, 1])
    simulation.step()
    way = float(m @ simulation.positions[:, 1] - before)
    late = simulation.pipeline.dt / _SECONDS if known.order(solver) == 1 else 0.0
    precise = max(1e-6, rounding(solver))
    return measure.quantity(
        "fall of the centre of mass [m]", way, -0.5 * scenes.G * _SECONDS**2 * (1.0 + late), precise
    )


def invariance(solver: str, seed: int) -> dict[str, Any]:
    """Largest difference [m] of the end after turning, shifting or renumbering the start, turned back."""
    scene, velocities = _sheet(seed)
    cloth = scene.cloths[0]
    dt = 2.5e-4

    def end(start: FloatArray, rest: FloatArray, v: FloatArray, order: np.ndarray | None = None) -> FloatArray:
        faces, quads = cloth.mesh.faces, cloth.mesh.quads
        if order is not None:
            number = np.argsort(order).astype(np.int32)
            start, rest, v, faces, quads = start[order], rest[order], v[order], number[faces], number[quads]
        changed = cg.Cloth(cg.Mesh(start, faces, quads), cloth.material, (), rest)
        simulation = _flown(cg.Scene([changed], gravity=(0.0, 0.0, 0.0), self_collision=False), v, solver, dt)
        simulation.step()
        return simulation.positions.copy()

    x, rest = cloth.mesh.vertices, cloth.rest
    plain = end(x, rest, velocities)
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    turned = end(x @ turn.T, rest, velocities @ turn.T) @ turn
    shift = np.array([0.5, -2.0, 0.25])
    shifted = end(x + shift, rest, velocities) - shift
    order = rng.permutation(len(x))
    renumbered = end(x, rest, velocities, order)[np.argsort(order)]

    def gap(other: FloatArray) -> float:
        return float(np.abs(other - plain).max())

    exact = 0.1 * rounding(solver)
    # sweeps go through springs in their order: what they leave unsolved depends on it
    swept = split(solver)[0] in ("xpbd", "global", "implicit_euler")
    return {
        "quantities": [
            measure.quantity("turned [m]", gap(turned), 0.0, exact, absolute=True),
            measure.quantity("shifted [m]", gap(shifted), 0.0, exact, absolute=True),
            measure.quantity(
                "renumbered [m]", gap(renumbered), 0.0, max(exact, 1e-5) if swept else exact, absolute=True
            ),
        ]
    }


def stretch(membrane: str, cells: int) -> dict[str, Any]:
    """Modulus of a sheet against a stretch in a direction, nothing across, from its energy [N/m]."""
    modulus, shear, strain = 100.0, 25.0, 1e-4
    mesh = cg.grid(1.0, 1.0, cells, cells)
    material = scenes.fabric(modulus, cells, shear)
    scene = cg.Scene([cg.Cloth(mesh, material)], gravity=(0.0, 0.0, 0.0), self_collision=False)
    simulation = simulate(scene, "xpbd" if membrane == "springs" else f"xpbd+{membrane}", 1e-3, 1e-3)
    found, moduli = [], []
    for angle in ANGLES:
        d = np.array([math.cos(math.radians(angle)), 0.0, math.sin(math.radians(angle))])
        measured = bends.energy(simulation, mesh.vertices + strain * np.outer(mesh.vertices @ d, d)) / (0.5 * strain**2)
        if membrane == "springs":
            exact = known.lattice_modulus(material.stretch * (cells + 1) / cells, material.shear, angle)
        else:
            exact = known.orthotropic_modulus(modulus, modulus, shear, angle)
        moduli.append(measured)
        found.append(measure.quantity(f"modulus at {angle} degrees [N/m]", measured, exact, 1e-3))
    return {"quantities": found, "angles": list(ANGLES), "moduli": moduli}


def bend(bending: str, cells: int) -> dict[str, Any]:
    """Rigidity of a sheet laid on a wide cylinder, by the direction in which it bends, from its energy [N m].

    The border has less to bend over: it leaves the difference of a sheet and of two with half its side.
    """
    spacing, turn = 0.01, 0.02
    curvature = turn / spacing
    rigidities = []
    for angle in ANGLES:
        d = np.array([math.cos(math.radians(angle)), 0.0, math.sin(math.radians(angle))])
        taken = []
        for n in (cells, 2 * cells):
            simulation, mesh = bends.bent_strip(bending, n, n, spacing * n)
            along = mesh.vertices @ d
            placed = mesh.vertices - np.outer(along, d) + np.outer(np.sin(curvature * along) / curvature, d)
            placed[:, 1] += (1.0 - np.cos(curvature * along)) / curvature
            taken.append(bends.energy(simulation, placed))
        rigidities.append((taken[1] - 2.0 * taken[0]) / (curvature * spacing * cells) ** 2)
    found = [measure.quantity(f"B at {a} degrees [N m]", b, bends.RIGIDITY, 0.01) for a, b in zip(ANGLES, rigidities)]
    return {"quantities": found, "angles": list(ANGLES), "moduli": rigidities}
