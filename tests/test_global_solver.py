"""The global solver: its constant system, its factor, and where it ends."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
from ways import ENERGIES, EXACT, GLOBAL, sheet, solver, thrown

import clothgym as cg
from clothgym.kernels import quasi_newton
from clothgym.stages.global_solver import constant_matrix


@pytest.mark.parametrize("energies", ENERGIES)
def test_global_solver_ends_where_newton_does(energies):
    found = [thrown(sheet(), dataclasses.replace(way, **energies)) for way in (EXACT, GLOBAL)]
    for _ in range(4):
        for sim in found:
            sim.step()
        assert found[1].positions == pytest.approx(found[0].positions, abs=1e-8)
        assert found[1].velocities == pytest.approx(found[0].velocities, abs=1e-6)


def test_factor_solves_the_constant_system():
    sim = cg.Simulation(cg.scenes.make("hanging_sheet", resolution=9), GLOBAL)
    own = solver(sim)
    free = np.flatnonzero(sim.model.inverse_masses > 0.0)
    matrix = constant_matrix(sim.model, own.weights)
    assert np.abs(matrix - matrix.T).max() == 0.0
    b = np.random.default_rng(0).normal(size=sim.positions.shape)
    z, expected = np.full_like(b, 7.0), np.full_like(b, 7.0)
    quasi_newton.solve_factored(own.factor, b, z, own.memory.sorted)
    expected[free] = scipy.sparse.linalg.spsolve(matrix[free][:, free].tocsc(), b[free])
    assert z == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_constant_matrix_of_springs_is_that_of_projective_dynamics():
    sim = cg.Simulation(sheet(), GLOBAL)
    model, own = sim.model, solver(sim)
    expected = np.diag(own.weights)
    for (i, j), k in zip(model.spring_ends, model.spring_stiffness):
        expected[np.ix_([i, j], [i, j])] += 0.25 * k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    assert constant_matrix(model, own.weights).toarray() == pytest.approx(expected)


def test_a_few_steps_of_the_global_solver_hold_a_stiff_sheet():
    """The default of 5 steps a solve: the fall within 3 cm, strain within 1.5 points of the converged 0.3 %."""
    sim = cg.Simulation(cg.scenes.make("hanging_sheet", resolution=16), cg.Fidelity(integrator="global", substeps=0))
    strain = 0.0
    for frame, fallen in ((6, 0.045), (12, 0.16), (18, 0.31), (24, 0.44), (30, 0.495), (36, 0.45), (48, 0.25)):
        while sim.step_count < frame:
            sim.step()
            strain = max(strain, sim.metrics()["max_strain"])
        assert -sim.positions[:, 1].mean() == pytest.approx(fallen, abs=0.03)
    assert strain < 0.018


@pytest.mark.parametrize("bending", ["flexion", "hinge", "quadratic"])
@pytest.mark.parametrize("membrane", ["springs", "continuum"])
def test_the_constant_matrix_is_symmetric_and_no_energy_resists_a_shift(membrane, bending):
    mesh = cg.grid(0.4, 0.3, 4, 3)
    scene = cg.Scene([cg.Cloth(mesh, cg.Material(bending=1e-3, flexion=1.0))], self_collision=False)
    model = cg.Simulation(scene, cg.Fidelity(integrator="global", membrane=membrane, bending=bending)).model
    weights = np.linspace(1.0, 2.0, model.vertex_count)
    matrix = constant_matrix(model, weights).toarray()
    assert matrix == pytest.approx(matrix.T, rel=1e-12)
    assert matrix.sum(axis=1) == pytest.approx(weights, abs=1e-9 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(matrix).min() > 0.9  # weights from 1 on, and energies of no negative stiffness
    assert np.diag(matrix).max() > 10.0 * weights.max(), "the energies are in it"
