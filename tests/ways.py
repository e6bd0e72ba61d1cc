"""Integrators under test by name, and the sheets, springs and steps that their tests share."""

from __future__ import annotations

import dataclasses

import naive_mechanics as naive
import numpy as np
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
from ladders import ladder, lone, no_grips

import clothgym as cg
from clothgym.kernels import implicit
from clothgym.model import ClothModel
from clothgym.stages.implicit_euler import ImplicitEuler

G = 9.81

EXACT = cg.Fidelity(integrator="implicit_euler", substeps=1, tolerance=1e-8)

FIRST = dataclasses.replace(EXACT, time_order=1)

RUNGE_KUTTA = cg.Fidelity(integrator="runge_kutta", substeps=0)

GLOBAL = dataclasses.replace(EXACT, integrator="global", solver_steps=5000)

WAYS = {"runge_kutta": RUNGE_KUTTA, "order 1": FIRST, "order 2": EXACT, "global": GLOBAL}

IMPLICIT = {name: fidelity for name, fidelity in WAYS.items() if name != "runge_kutta"}


def sheet(damping: float = 0.7, pins=(0, 4), **scene) -> cg.Scene:
    """A soft sheet of 4 x 3 cells, bent and thrown about at random."""
    mesh = cg.grid(1.0, 0.8, 4, 3)
    rng = np.random.default_rng(5)
    start = mesh.vertices + rng.normal(0, 0.03, mesh.vertices.shape)
    material = cg.Material(density=0.3, stretch=60.0, shear=20.0, flexion=5.0, damping=damping)
    return lone(cg.Cloth(cg.Mesh(start, mesh.faces, mesh.quads), material, pins, mesh.vertices), **scene)


def solver(sim: cg.Simulation) -> ImplicitEuler:
    return sim.pipeline.stages[0].step.integrator  # type: ignore[attr-defined]


def acceleration_of(model: ClothModel):
    """What the naive references integrate: springs, gravity and viscous damping."""
    springs = model.spring_ends, model.spring_rest, model.spring_stiffness
    gravity = np.asarray(model.scene.gravity)

    def acceleration(x, v):
        a = model.inverse_masses[:, None] * naive.spring_forces(x, *springs) + gravity - model.damping * v
        a[model.inverse_masses == 0.0] = 0.0
        return a

    return acceleration


ENERGIES = ({}, {"membrane": "continuum", "bending": "hinge"}, {"membrane": "continuum", "bending": "quadratic"})


def thrown(scene: cg.Scene, fidelity: cg.Fidelity) -> cg.Simulation:
    sim = cg.Simulation(scene, fidelity)
    v = np.random.default_rng(2).normal(0, 0.5, sim.positions.shape)
    v[sim.model.inverse_masses == 0.0] = 0.0
    sim.set_velocities(v)
    return sim


def spring_energies(fidelity: cg.Fidelity, share: float, steps: int = 30) -> np.ndarray:
    """Energies [J/kg] of one spring under a fixed end, without gravity, at w dt = share."""
    cloth = ladder(1)
    w = np.sqrt(50.0 * ClothModel(lone(cloth)).inverse_masses[2])
    sim = cg.Simulation(lone(cloth, gravity=(0, 0, 0), step=share / w), fidelity)
    x = sim.positions.copy()
    x[2:, 1] -= 0.05
    sim.set_positions(x)
    energies = []
    for _ in range(steps + 1):
        y, rate = sim.positions[0, 1] - sim.positions[2, 1] - 1.0, sim.velocities[2, 1]
        energies.append(0.5 * rate**2 + 0.5 * (w * y) ** 2)
        sim.step()
    return np.array(energies)


def solved(model, base, rate, h, damping):
    """End of an implicit stage by a root finder on naive forces: V = rate + h (f / m + g - damping V), X = base + h V."""
    free = model.inverse_masses > 0.0
    springs = model.spring_ends, model.spring_rest, model.spring_stiffness
    gravity = np.asarray(model.scene.gravity)

    def lacking(packed):
        x = base.copy()
        x[free] += packed.reshape(-1, 3)
        v = (x - base) / h
        a = model.inverse_masses[:, None] * naive.spring_forces(x, *springs) + gravity
        return ((1.0 + damping * h) * v - rate - h * a)[free].ravel()

    found = scipy.optimize.root(lacking, (h * rate)[free].ravel(), tol=1e-13)
    x = base.copy()
    x[free] += found.x.reshape(-1, 3)
    return x, (x - base) / h


def assembled(stretch: float = 2.5, **options):
    """A simulation whose springs are stretched, and its matrix at the positions after one search of one step."""
    sim = cg.Simulation(sheet(), dataclasses.replace(FIRST, solver_steps=1, **options))
    x = sim.positions.copy()
    x[:] = stretch * x
    sim.set_positions(x)
    own = solver(sim)
    own.targets[:] = x
    p = x.copy()
    grips = no_grips()
    implicit.newton(p, own.targets, own.weights, sim.model.arrays, grips, 0.0, own.matrix, own.search, 1e-9, 1, 5000)
    return sim, own, x, p
