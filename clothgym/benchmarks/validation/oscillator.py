"""V1, V2, V3: one mass on a spring, a pendulum on near-rigid rods, the small swings of a hanging chain."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks.frame import Case
from clothgym.benchmarks.validation import known, measure
from clothgym.benchmarks.validation.solvers import IMPLICIT, rounding, simulate, solvers, split
from clothgym.scenes import validation as scenes

FREQUENCY = 10.0
"""Of the oscillator [rad/s]."""
_TARGET = 0.005


def cases(quick: bool) -> list[Case]:
    """Oscillator, pendulum and chain with every solver."""
    angles = (90,) if quick else (10, 30, 60, 90)
    modes = (1,) if quick else (1, 2, 3, 4)
    links = 12 if quick else 40
    listed = []
    for solver in solvers():
        listed.append(Case(f"oscillator/{solver}", {"family": "oscillator", "solver": solver}))
        listed += [
            Case(f"pendulum/{angle}/{solver}", {"family": "pendulum", "solver": solver, "angle": angle})
            for angle in angles
        ]
        if quick and split(solver)[2] != "springs":
            continue  # both membranes make the same chain
        listed += [
            Case(f"chain/{mode}/{solver}", {"family": "chain", "solver": solver, "mode": mode, "links": links})
            for mode in modes
        ]
    return listed


def _oscillator() -> cg.Scene:
    """One square cell, held by its upper side, its lower side pulled down by 1e-3; no gravity."""
    mesh = cg.grid(1.0, 1.0, 1, 1)
    start = np.stack([mesh.vertices[:, 0], mesh.vertices[:, 2] - 0.5, 0.0 * mesh.vertices[:, 0]], axis=1)
    start[2:, 1] -= 1e-3
    material = scenes.fabric(2.0 * scenes.DENSITY / 4 * FREQUENCY**2, 1)
    cloth = cg.Cloth(cg.Mesh(start, mesh.faces, mesh.quads), material, (0, 1), mesh.vertices, equal_masses=True)
    return cg.Scene([cloth], gravity=(0.0, 0.0, 0.0), self_collision=False)


def _swing(solver: str, phase: float, steps: int) -> np.ndarray:
    """(steps + 1,) complex amplitude u + i v / w over that of the start, a step of w dt = phase each."""
    dt = phase / FREQUENCY
    simulation = simulate(_oscillator(), solver, dt, dt)
    seen = measure.record(simulation, steps, lambda s: (s.positions[2, 1] + 1.0, s.velocities[2, 1]))
    return (seen[:, 0] - 1j * seen[:, 1] / FREQUENCY) / seen[0, 0]


def oscillator(solver: str) -> dict[str, Any]:
    """Energy, frequency, and order of convergence of the end of five quarter periods."""
    phase = 0.1
    cycles = 5
    z = _swing(solver, phase, round(cycles * 2.0 * math.pi / phase))
    energy, growth = np.abs(z) ** 2, known.growth(solver, phase)
    found_period = measure.period(z.real, phase)
    frequency = None if found_period is None else 2.0 * math.pi / found_period
    found = [measure.quantity("frequency / w", frequency, float(np.angle(growth)) / phase, _TARGET)]
    if split(solver)[0] == "symplectic_euler":
        low, high = known.symplectic_energy_range(phase)
        found.append(measure.quantity("largest energy / start", float(energy.max()), high, 0.001))
        found.append(measure.quantity("least energy / start", float(energy.min()), low, 0.001))
        turn = round(2.0 * math.pi / phase)
        drift = float(energy[-turn:].mean() / energy[:turn].mean())
        found.append(measure.quantity("mean energy, last period / first", drift, 1.0, 0.001))
    else:
        factor = float((energy[-1] / energy[0]) ** (1.0 / (len(energy) - 1)))
        found.append(
            measure.quantity("energy factor of a step", factor, abs(growth) ** 2, max(1e-6, 0.1 * rounding(solver)))
        )
    phases = [0.05 / 2**n for n in range(4)]
    exact = 2.5 * math.pi
    errors = []
    for fine in phases:
        fine = exact / round(exact / fine)
        errors.append(float(abs(_swing(solver, fine, round(exact / fine))[-1] - np.exp(1j * exact))))
    p = measure.order(phases, errors)
    found.append(
        measure.quantity("order in the time step", p, known.order(solver), 0.1 if rounding(solver) < 1e-6 else None)
    )
    return {"quantities": found, "order": {"steps": phases, "errors": errors}}


def pendulum(solver: str, angle: float) -> dict[str, Any]:
    """Period over 2 pi sqrt(l / g)."""
    scene = scenes.pendulum(angle)
    slow = 2.0 * math.pi / math.sqrt(scenes.G)
    every = slow / 200
    simulation = simulate(scene, solver, 2e-4 if known.order(solver) == 1 else 1e-3, every)
    turned = measure.record(
        simulation,
        round(1.1 * known.pendulum_ratio(angle) * 200),
        lambda s: math.atan2(s.positions[2, 2], -s.positions[2, 1]),
    )
    found = measure.period(turned, every)
    ratio = None if found is None else found / slow
    return {"quantities": [measure.quantity("T / T0", ratio, known.pendulum_ratio(angle), _TARGET)]}


def chain(solver: str, mode: int, links: int) -> dict[str, Any]:
    """Frequency of a small swing, against that of the same equal masses and that of a continuous chain."""
    scene = scenes.chain(links, mode)
    exact = known.chain_frequency(links, mode, 1.0, scenes.G)
    every = 2.0 * math.pi / exact / 100
    shape = scene.start[:, 2]
    # implicit solvers need not resolve the stretch of the links
    dt = every / 8 if split(solver)[0] in IMPLICIT else 3e-4 * 16 / links
    simulation = simulate(scene, solver, dt, every)
    swing = measure.record(simulation, 130, lambda s: float(shape @ s.positions[:, 2]))
    found = measure.period(swing, every)
    frequency = None if found is None else 2.0 * math.pi / found
    continuous = known.hanging_chain_frequency(mode, 1.0, scenes.G)
    return {
        "quantities": [
            measure.quantity(f"frequency, {links} links [rad/s]", frequency, exact, _TARGET),
            # n equal masses swing nearly as a continuous chain of n + 1/2 links
            measure.quantity("frequency, continuous [rad/s]", frequency, continuous),
        ]
    }
