"""Implicit Euler: its exact factors, its matrix, conjugate gradients, Newton's method."""

from __future__ import annotations

import dataclasses

import naive_mechanics as naive
import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
from ladders import ladder, lone, no_grips
from ways import ENERGIES, EXACT, FIRST, GLOBAL, IMPLICIT, assembled, sheet, solved, solver, spring_energies, thrown

import clothgym as cg
from clothgym.kernels import block_matrix, elastic, implicit
from clothgym.stages.implicit_euler import SECOND_ORDER, block_pattern


@pytest.mark.parametrize("share", [0.05, 0.7, 4.0])
def test_implicit_euler_loses_energy_by_its_exact_factor(share):
    energies = spring_energies(FIRST, share, 8)
    assert energies[1:] / energies[:-1] == pytest.approx(1.0 / (1.0 + share**2), rel=1e-6)


@pytest.mark.parametrize("share", [0.05, 0.7, 4.0])
@pytest.mark.parametrize("way", [EXACT, GLOBAL], ids=["newton", "global"])
def test_order_2_loses_energy_by_its_exact_factor(share, way):
    """|R(i w dt)|^2 with R(z) = (1 + (1 - 2 g) z) / (1 - g z)^2; z -> infinity gives 0: what is not resolved dies out."""
    z = 1j * share
    factor = abs((1 + (1 - 2 * SECOND_ORDER) * z) / (1 - SECOND_ORDER * z) ** 2) ** 2
    energies = spring_energies(way, share, 8)
    assert energies[1:] / energies[:-1] == pytest.approx(factor, rel=1e-6)
    assert factor > 1.0 / (1.0 + share**2)


def test_a_step_of_order_1_equals_naive():
    sim = thrown(sheet(), FIRST)
    x, v, dt = sim.positions.copy(), sim.velocities.copy(), sim.pipeline.dt
    sim.step()
    # damping acts on the old velocity, as in XPBD
    p, w = solved(sim.model, x, v / (1.0 + 0.7 * dt), dt, 0.0)
    assert sim.positions == pytest.approx(p, abs=1e-10)
    assert sim.velocities == pytest.approx(w, abs=1e-8)


@pytest.mark.parametrize("way", [EXACT, GLOBAL], ids=["newton", "global"])
def test_a_step_of_order_2_equals_naive(way):
    sim = thrown(sheet(), way)
    x, v, dt = sim.positions.copy(), sim.velocities.copy(), sim.pipeline.dt
    sim.step()
    h = SECOND_ORDER * dt
    _, v1 = solved(sim.model, x, v, h, 0.7)
    p, w = solved(sim.model, x + (dt - h) * v1, v + (dt - h) * (v1 - v) / h, h, 0.7)
    assert sim.positions == pytest.approx(p, abs=1e-10)
    assert sim.velocities == pytest.approx(w, abs=1e-8)


def test_xpbd_swept_to_the_end_solves_the_same_step():
    """Along a line, where directions do not turn; elsewhere XPBD's sweeps end a little beside the least objective."""
    scene = lone(ladder(6, stretched=1.05, damping=0.6))
    one, two = cg.Simulation(scene, FIRST), cg.Simulation(scene, cg.Fidelity(substeps=1, sweeps=3000))
    one.step(3)
    two.step(3)
    assert np.abs(one.velocities).max() > 0.3
    assert one.positions == pytest.approx(two.positions, abs=1e-9)


def dense(matrix, pinned) -> np.ndarray:
    """(3 V, 3 V) from the blocks; identity rows for pins."""
    count = len(matrix.diagonal)
    full = np.zeros((count, 3, count, 3))
    for i in range(count):
        full[i, :, i] = matrix.diagonal[i]
        for n in range(matrix.rows[i], matrix.rows[i + 1]):
            full[i, :, matrix.columns[n]] = matrix.blocks[n]
            full[matrix.columns[n], :, i] = matrix.blocks[n].T
    return full.reshape(3 * count, 3 * count)


def test_matrix_is_the_derivative_of_the_forces():
    sim, own, x, _ = assembled()
    model = sim.model
    springs = model.spring_ends, model.spring_rest, model.spring_stiffness
    lengths = np.linalg.norm(x[model.spring_ends[:, 1]] - x[model.spring_ends[:, 0]], axis=1)
    assert (lengths > model.spring_rest).all()
    eps, count = 1e-6, len(x)
    expected = np.zeros((3 * count, 3 * count))
    for k in range(3 * count):
        ahead, back = x.copy(), x.copy()
        ahead.flat[k] += eps
        back.flat[k] -= eps
        expected[:, k] = (naive.spring_forces(back, *springs) - naive.spring_forces(ahead, *springs)).ravel() / (
            2 * eps
        )
    expected += np.diag(np.repeat(own.weights, 3))
    fixed = np.repeat(model.inverse_masses == 0.0, 3)
    expected[fixed] = 0.0
    expected[:, fixed] = 0.0
    expected[fixed, fixed] = 1.0
    full = dense(own.matrix, fixed)
    assert full == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("energies", ENERGIES[1:])
def test_matrix_of_membrane_and_bending_is_the_derivative_of_their_forces(energies):
    """In a flat sheet under tension their second derivatives are exact."""
    scene = sheet()
    mesh = cg.grid(1.0, 0.8, 4, 3)
    scene = dataclasses.replace(scene, cloths=[dataclasses.replace(scene.cloths[0], mesh=mesh)])
    sim = cg.Simulation(scene, dataclasses.replace(FIRST, **energies))
    model, own = sim.model, solver(sim)
    x = 1.2 * mesh.vertices
    block_matrix.assemble(x, own.weights, model.arrays, no_grips(), 0.0, own.matrix)
    eps, count = 1e-6, len(x)
    expected = np.zeros((3 * count, 3 * count))
    force = np.zeros_like(x)
    for k in range(3 * count):
        for sign in (1.0, -1.0):
            moved = x.copy()
            moved.flat[k] += sign * eps
            elastic.elastic_forces(moved, model.arrays, force)
            expected[:, k] -= sign * force.ravel() / (2 * eps)
    expected += np.diag(np.repeat(own.weights, 3))
    fixed = np.repeat(model.inverse_masses == 0.0, 3)
    expected[fixed] = 0.0
    expected[:, fixed] = 0.0
    expected[fixed, fixed] = 1.0
    assert dense(own.matrix, fixed) == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("energies", ENERGIES)
def test_matrix_of_a_crushed_sheet_is_positive_definite(energies):
    _, own, _, _ = assembled(stretch=0.3, **energies)
    full = dense(own.matrix, None)
    assert np.abs(full - full.T).max() <= 1e-12 * np.abs(full).max()
    least = own.weights[own.weights > 0.0].min()
    assert np.linalg.eigvalsh(full).min() >= min(1.0, least) * (1 - 1e-6)


def test_conjugate_gradients_equal_a_direct_solver():
    sim, own, x, _ = assembled()
    full = scipy.sparse.csc_array(dense(own.matrix, None))
    springs = sim.model.spring_ends, sim.model.spring_rest, sim.model.spring_stiffness
    force = naive.spring_forces(x, *springs)
    force[sim.model.inverse_masses == 0.0] = 0.0
    exact = scipy.sparse.linalg.spsolve(full, force.ravel()).reshape(-1, 3)
    # the search ended at a tenth of the residual: the step is close in the norm of the energy, not exact
    step = own.search.step
    error = (step - exact).ravel()
    assert error @ (full @ error) < 0.1 * (exact.ravel() @ (full @ exact.ravel()))
    own.search.gradient[:] = -force
    implicit.solve_linear(own.matrix, sim.model.inverse_masses, own.search, 1e-12, 5000)
    assert own.search.step == pytest.approx(exact, abs=1e-10 * np.abs(exact).max())
    assert (own.search.step[sim.model.inverse_masses == 0.0] == 0.0).all()


def test_pattern_of_blocks_holds_any_elements():
    """Triangles and pairs together: random blocks, added by slots, give the dense sum of all elements."""
    rng = np.random.default_rng(0)
    pinned = np.zeros(9, np.bool_)
    pinned[[2, 7]] = True
    stencils = [
        np.array([[0, 3], [5, 1], [7, 8]]),
        np.array([[0, 3, 5], [8, 1, 0], [2, 4, 5]]),
        np.array([[4, 6, 8, 1]]),
    ]
    rows, columns, slots = block_pattern(stencils, pinned)
    diagonal, blocks = np.zeros((9, 3, 3)), np.zeros((len(columns), 3, 3))
    expected = np.zeros((9, 3, 9, 3))
    for stencil, places in zip(stencils, slots):
        size = stencil.shape[1]
        for element, place in zip(stencil, places):
            block = rng.normal(size=(size, 3, size, 3))
            block += block.transpose(2, 3, 0, 1)
            for a in range(size):
                for b in range(size):
                    if min(element[a], element[b]) >= 0 and not (pinned[element[a]] or pinned[element[b]]):
                        expected[element[a], :, element[b]] += block[a, :, b]
                    if place[a, b] != -1:
                        where = (blocks, place[a, b]) if place[a, b] >= 0 else (diagonal, -2 - place[a, b])
                        where[0][where[1]] += block[a, :, b]
    found = np.zeros_like(expected)
    for i in range(9):
        found[i, :, i] = diagonal[i]
        for n in range(rows[i], rows[i + 1]):
            assert columns[n] > i
            found[i, :, columns[n]] = blocks[n]
            found[columns[n], :, i] = blocks[n].T
    assert found == pytest.approx(expected, abs=1e-12)


def far(sim: cg.Simulation, size: float) -> None:
    rng = np.random.default_rng(3)
    x = sim.positions + rng.normal(0, size, sim.positions.shape)
    x[sim.model.inverse_masses == 0.0] = sim.positions[sim.model.inverse_masses == 0.0]
    sim.set_positions(x)


@pytest.mark.parametrize("name", IMPLICIT)
@pytest.mark.parametrize("size", [0.1, 1.0, 5.0])
def test_solvers_reach_the_tolerance_from_far(name, size):
    sim = cg.Simulation(sheet(), dataclasses.replace(IMPLICIT[name], tolerance=1e-6, solver_steps=1000))
    far(sim, size)
    sim.step(2)
    assert sim.metrics()["work"]["unconverged"] == 0
    assert sim.metrics()["work"]["solver_steps"] < (1200 if name == "global" else 120)


def test_newton_ends_quadratically():
    """From a state near the end every step squares the error: 1e-2 -> 1e-11 in few steps."""
    _, own, x, _ = assembled()
    sim = cg.Simulation(sheet(), FIRST)
    left = []
    for steps in range(1, 8):
        p = x.copy()
        _, _, rest = implicit.newton(
            p, x, own.weights, sim.model.arrays, no_grips(), 0.0, own.matrix, own.search, 1e-11, steps, 5000
        )
        left.append(rest)
    assert left[-1] < 1e-9 * left[0]
    small = [n for n, rest in enumerate(left) if rest < 1e-2 * left[0]]
    assert left[min(small[0] + 3, 6)] < 1e-8 * left[0]


@pytest.mark.parametrize("name", IMPLICIT)
@pytest.mark.parametrize(("step", "stretch"), [(10.0, 60.0), (1.0 / 60, 1e8), (1.0, 1e6)])
def test_huge_steps_and_stiffness_stay_finite(name, step, stretch):
    scene = sheet(step=step)
    material = dataclasses.replace(scene.cloths[0].material, stretch=stretch)
    scene = dataclasses.replace(scene, cloths=[dataclasses.replace(scene.cloths[0], material=material)])
    sim = cg.Simulation(scene, dataclasses.replace(IMPLICIT[name], tolerance=0.01))
    sim.step(5)
    assert np.isfinite(sim.positions).all()
    assert np.abs(sim.positions).max() < 5.0, "held by two corners, it cannot go far"


def test_a_solve_that_ends_early_is_counted():
    scene = cg.scenes.make("hanging_sheet", resolution=6)
    hasty = cg.Simulation(scene, dataclasses.replace(EXACT, solver_steps=1, tolerance=1e-6))
    hasty.step(4)
    assert hasty.metrics()["work"]["unconverged"] >= 4
    done = cg.Simulation(scene, dataclasses.replace(EXACT, tolerance=0.05))
    done.step(4)
    assert done.metrics()["work"]["unconverged"] == 0
