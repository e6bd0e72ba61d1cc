"""Implicit integrators and the Runge-Kutta method against known answers, naive references, and each other."""

from __future__ import annotations

import copy
import dataclasses

import naive_mechanics as naive
import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
import trimesh
from ladders import UPRIGHT, ladder, lone, no_grips

import clothgym as cg
from clothgym.kernels import block_matrix, elastic, implicit, quasi_newton
from clothgym.model import ClothModel
from clothgym.stages.global_solver import constant_matrix
from clothgym.stages.implicit_euler import SECOND_ORDER, ImplicitEuler, block_pattern
from clothgym.stages.runge_kutta import safe_time_step

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


# ---------------------------------------------------------------------------------------------------------------
# one spring: known amplification


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


@pytest.mark.parametrize("share", [0.3, 1.4])
def test_runge_kutta_changes_energy_by_its_exact_factor(share):
    z = 1j * share
    factor = abs(sum(z**n / np.prod(np.arange(1, n + 1)) for n in range(5))) ** 2
    energies = spring_energies(dataclasses.replace(RUNGE_KUTTA, substeps=1), share)
    assert energies[1:] / energies[:-1] == pytest.approx(factor, rel=1e-9)


def test_runge_kutta_is_stable_up_to_the_root_of_eight(monkeypatch):
    model = ClothModel(lone(ladder(1)))
    assert safe_time_step(model) == pytest.approx(np.sqrt(2.0 / (50.0 * model.inverse_masses[2])))  # Gershgorin: 2 w
    monkeypatch.setattr(ClothModel, "safe_time_step", lambda self: np.inf)
    way = dataclasses.replace(RUNGE_KUTTA, substeps=1)
    for share, grows in ((2.82, False), (2.84, True)):
        energies = spring_energies(way, share, 300)
        assert (energies[-1] > energies[0]) == grows


@pytest.mark.parametrize("damping", [0.0, 3.0, 300.0, 3000.0])
def test_safe_step_of_runge_kutta_holds_with_damping(damping):
    """Every mode up to Gershgorin's frequency, at the safe step: |R| <= 1."""
    model = ClothModel(lone(ladder(5, damping=damping)))
    plain = ClothModel(lone(ladder(5, damping=0.0)))
    fastest = 2.0 / plain.safe_time_step()
    dt = safe_time_step(model)
    w = np.linspace(0.0, fastest, 4000)
    root = np.sqrt(damping**2 / 4 - w**2 + 0j)
    for z in (dt * (-damping / 2 + root), dt * (-damping / 2 - root)):
        growth = np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24)
        assert growth.max() <= 1.0 + 1e-9
    assert dt * max(fastest, damping) > 2.59, "the bound gives steps away"


def test_too_long_a_step_of_runge_kutta_is_refused_with_the_limit():
    scene = cg.scenes.make("hanging_sheet", resolution=6)
    limit = safe_time_step(ClothModel(scene))
    needed = int(np.ceil(scene.step / limit))
    with pytest.raises(ValueError, match="stability limit") as refused:
        cg.Simulation(scene, dataclasses.replace(RUNGE_KUTTA, substeps=needed - 1))
    for part in (f"fidelity.substeps = {needed - 1}", f"{limit:.3g}", f"at least {needed} substeps"):
        assert part in str(refused.value)
    cg.Simulation(scene, dataclasses.replace(RUNGE_KUTTA, substeps=needed)).step()
    chosen = cg.Simulation(scene, RUNGE_KUTTA).pipeline
    assert 0.8 * limit < chosen.dt < limit


# ---------------------------------------------------------------------------------------------------------------
# naive references


def test_runge_kutta_equals_naive():
    sim = thrown(sheet(), dataclasses.replace(RUNGE_KUTTA, substeps=2))
    x, v = sim.positions.copy(), sim.velocities.copy()
    sim.step()
    for _ in range(2):
        x, v = naive.runge_kutta(x, v, acceleration_of(sim.model), sim.pipeline.dt)
    assert sim.positions == pytest.approx(x, abs=1e-13)
    assert sim.velocities == pytest.approx(v, abs=1e-11)


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


# ---------------------------------------------------------------------------------------------------------------
# order in time, and the common limit


def ends(fidelity: cg.Fidelity, substeps: int) -> tuple[np.ndarray, np.ndarray]:
    sim = thrown(sheet(), dataclasses.replace(fidelity, substeps=substeps))
    sim.step(12)
    return sim.positions.copy(), sim.velocities.copy()


@pytest.fixture(scope="module")
def limit():
    return ends(RUNGE_KUTTA, 100)


@pytest.mark.parametrize(
    ("name", "order", "substeps", "most"),
    [("runge_kutta", 4, 4, 1e-5), ("order 1", 1, 160, 2e-2), ("order 2", 2, 8, 2e-3)],
)
def test_halved_steps_divide_the_error_by_the_order(name, order, substeps, most, limit):
    errors = []
    for n in (substeps, 2 * substeps, 4 * substeps):
        errors.append([np.abs(a - b).max() for a, b in zip(ends(WAYS[name], n), limit)])
    rates = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert rates[-1] == pytest.approx(order, abs=0.15 * order)
    assert errors[-1][0] < most


def test_symplectic_euler_meets_them_as_steps_shrink(limit):
    """`limit` is where the others go, see above."""
    coarse, fine = (
        np.abs(ends(cg.Fidelity(integrator="symplectic_euler"), n)[0] - limit[0]).max() for n in (200, 2000)
    )
    assert fine < 2e-3
    assert fine == pytest.approx(0.1 * coarse, rel=0.1)


@pytest.mark.parametrize("name", WAYS)
@pytest.mark.parametrize("damping", [2.0, 8.0])
def test_hanging_column_has_the_analytic_elongation_at_any_damping(name, damping):
    sim = cg.Simulation(lone(ladder(6, damping=damping)), WAYS[name])
    sim.step(600)
    assert sim.metrics()["max_speed"] < 1e-3
    elongation = -np.diff(sim.positions[::2, 1]) - 1.0 / 6
    expected = (6 - np.arange(6)) * sim.model.masses[0] * G / 50.0
    assert elongation == pytest.approx(expected, rel=1e-3)


def test_all_integrators_hang_a_sheet_alike():
    ways = [cg.Fidelity(integrator="symplectic_euler", substeps=0), *WAYS.values()]
    found = []
    for way in ways:
        sim = cg.Simulation(sheet(damping=6.0), dataclasses.replace(way, substeps=way.substeps and 4))
        sim.step(700)
        assert sim.metrics()["max_speed"] < 1e-4
        found.append(sim.positions.copy())
    for one in found[1:]:
        assert one == pytest.approx(found[0], abs=1e-4)


# ---------------------------------------------------------------------------------------------------------------
# the matrix and the solver


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


@pytest.mark.parametrize("energies", ENERGIES)
def test_integrators_agree_on_every_energy(energies):
    found = [thrown(sheet(), dataclasses.replace(way, substeps=40, **energies)) for way in (RUNGE_KUTTA, EXACT)]
    for sim in found:
        sim.step(10)
    assert found[0].positions == pytest.approx(found[1].positions, abs=2e-3)


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


def test_a_solve_that_ends_early_is_counted():
    scene = cg.scenes.make("hanging_sheet", resolution=6)
    hasty = cg.Simulation(scene, dataclasses.replace(EXACT, solver_steps=1, tolerance=1e-6))
    hasty.step(4)
    assert hasty.metrics()["work"]["unconverged"] >= 4
    done = cg.Simulation(scene, dataclasses.replace(EXACT, tolerance=0.05))
    done.step(4)
    assert done.metrics()["work"]["unconverged"] == 0


@pytest.mark.parametrize("name", WAYS)
def test_a_vertex_on_another_and_a_cloth_in_a_point_stay_finite(name):
    sim = cg.Simulation(sheet(), WAYS[name])
    x = sim.positions.copy()
    x[7] = x[8]
    sim.set_positions(x)
    sim.step(2)
    assert np.isfinite(sim.positions).all()
    free = cg.Simulation(sheet(pins=()), WAYS[name])
    free.set_positions(np.zeros_like(x))
    free.step(2)
    assert np.isfinite(free.positions).all()


# ---------------------------------------------------------------------------------------------------------------
# free flight, damping, pins, wind, ground


@pytest.mark.parametrize("name", WAYS)
def test_linear_momentum_in_free_flight_is_exact(name):
    sim = thrown(sheet(damping=0.0, pins=()), WAYS[name])
    m = sim.model.masses
    before = m @ sim.velocities
    centre = m @ sim.positions / m.sum()
    sim.step(12)
    n = 12 * sim.pipeline.substeps
    t = n * sim.pipeline.dt
    assert m @ sim.velocities == pytest.approx(before + m.sum() * t * np.array([0, -G, 0]), abs=1e-6)
    # the drop of implicit Euler is that of XPBD: -g t (t + dt) / 2
    late = t + (sim.pipeline.dt if name == "order 1" else 0.0)
    expected = centre + t * before / m.sum() + np.array([0.0, -0.5 * G * t * late, 0.0])
    assert m @ sim.positions / m.sum() == pytest.approx(expected, abs=1e-6)


def test_angular_momentum_is_lost_less_at_higher_order():
    lost = {}
    for name, way in WAYS.items():
        scene = lone(ladder(4, top=(), stretched=1.05), gravity=(0, 0, 0))
        sim = cg.Simulation(scene, dataclasses.replace(way, substeps=16))
        sim.set_velocities(np.cross([0.0, 0.0, 1.0], sim.positions) + np.array([0.3, -0.2, 0.1]))
        m = sim.model.masses

        def moment(sim=sim, m=m):
            return (m[:, None] * np.cross(sim.positions, sim.velocities)).sum(axis=0)

        before = moment()
        sim.step(30)
        lost[name] = np.abs(moment() - before).max() / np.abs(before).max()
    assert lost["runge_kutta"] < 1e-4
    assert lost["order 2"] < 2e-3
    assert lost["order 2"] < 0.2 * lost["order 1"]


@pytest.mark.parametrize("name", WAYS)
def test_damping_of_a_moving_cloth(name):
    scene = lone(ladder(2, top=(), damping=3.0), gravity=(0, 0, 0))
    sim = cg.Simulation(scene, dataclasses.replace(WAYS[name], substeps=20))
    sim.set_velocities(np.tile([1.0, 0.5, -2.0], (6, 1)))
    sim.step(6)
    z = -3.0 * sim.pipeline.dt
    factor = {
        "runge_kutta": 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24,
        "order 1": 1 / (1 - z),
        "order 2": (1 + (1 - 2 * SECOND_ORDER) * z) / (1 - SECOND_ORDER * z) ** 2,
        "global": (1 + (1 - 2 * SECOND_ORDER) * z) / (1 - SECOND_ORDER * z) ** 2,
    }[name] ** 120
    assert sim.velocities == pytest.approx(np.tile(np.array([1.0, 0.5, -2.0]) * factor, (6, 1)), rel=1e-6)
    assert factor == pytest.approx(np.exp(-0.3), rel=5e-3 if name == "order 1" else 1e-5)


@pytest.mark.parametrize("name", WAYS)
def test_pins_do_not_move_in_wind_or_when_pushed(name):
    scene = dataclasses.replace(cg.scenes.make("hanging_sheet", resolution=6), wind=(0.0, 3.0, 2.0))
    sim = cg.Simulation(scene, dataclasses.replace(WAYS[name], tolerance=1e-3))
    start = sim.positions[[0, 6]].copy()
    sim.set_velocities(np.full((49, 3), 0.3))
    sim.step(6)
    assert (sim.positions[[0, 6]] == start).all()
    assert (sim.velocities[[0, 6]] == 0.0).all()
    assert np.abs(sim.positions - scene.start).max() > 0.02


@pytest.mark.parametrize("name", WAYS)
def test_wind_across_a_sheet(name):
    mesh = cg.grid(1.0, 0.6, 4, 3)
    cloth = cg.Cloth(mesh, cg.Material(density=0.2, damping=0.0))
    scene = lone(cloth, gravity=(0, 0, 0), wind=(0.0, 4.0, 0.0), wind_drag=0.5, step=1e-3)
    sim = cg.Simulation(scene, WAYS[name])
    sim.step()
    assert sim.velocities == pytest.approx(np.tile([0.0, 1e-3 * 0.5 * 4.0 / 0.2, 0.0], (20, 1)), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("name", WAYS)
@pytest.mark.parametrize("self_collision", [False, True])
def test_a_sheet_comes_to_rest_on_the_ground_and_stays(name, self_collision):
    mesh = cg.grid(0.4, 0.4, 4, 4)
    material = cg.Material(thickness=4e-3, stretch=200.0, damping=2.0, friction=0.4)
    scene = cg.Scene([cg.Cloth(mesh.transformed(translation=(0, 0.53, 0)), material, rest=mesh.vertices)], ground=0.5,
                     self_collision=self_collision)  # fmt: skip
    way = WAYS[name]
    sim = cg.Simulation(scene, way if way.substeps == 0 else dataclasses.replace(way, substeps=4, tolerance=1e-4))
    sim.set_velocities(np.tile([0.2, 0.0, 0.1], (25, 1)))
    sim.step(90)
    assert sim.positions[:, 1] == pytest.approx(0.502, abs=2e-5)
    rested = sim.positions.copy()
    assert 0.005 < np.abs(rested - scene.start)[:, 0].max() < 0.2, "it slid a little, then friction stopped it"
    sim.step(30)
    assert np.abs(sim.positions - rested).max() < 1e-5
    assert sim.metrics()["max_speed"] < 1e-4


# ---------------------------------------------------------------------------------------------------------------
# grippers


def held_sheet(name: str, grip=None, **material) -> cg.Simulation:
    """A sheet hung upright, its top row held by one gripper."""
    mesh = cg.grid(0.4, 0.4, 4, 4)
    placed = mesh.transformed(rotation=UPRIGHT, translation=(0, 1.0, 0))
    values = {"damping": 4.0, "stretch": 500.0, "shear": 50.0} | material
    cloth = cg.Cloth(placed, cg.Material(**values), rest=mesh.vertices)
    way = WAYS[name]
    sim = cg.Simulation(
        lone(cloth, grips=[grip or cg.Grip(radius=0.3)]),
        way if way.substeps == 0 else dataclasses.replace(way, substeps=2, tolerance=1e-3),
    )
    sim.place_grip(0, placed.vertices[2])
    assert sim.grasp(0, [0, 1, 2, 3, 4]) == 5
    return sim


@pytest.mark.parametrize("name", WAYS)
def test_a_gripper_feels_the_weight(name):
    sim = held_sheet(name)
    sim.step(200)
    weight = sim.model.masses.sum() * G
    assert sim.grip_forces[0] == pytest.approx([0.0, weight, 0.0], rel=0.01, abs=0.01 * weight)
    sag = 1.2 - sim.positions[:5, 1].mean()
    assert sag == pytest.approx(weight / 500.0, rel=0.05), "the anchor's stiffness is that of the whole gripper"


@pytest.mark.parametrize("name", WAYS)
def test_above_its_force_the_cloth_slips_out(name):
    weight = 0.4 * 0.4 * 0.15 * G
    strong, weak = (held_sheet(name, cg.Grip(radius=0.3, slip_force=share * weight)) for share in (1.5, 0.5))
    for sim in (strong, weak):
        sim.step(200)
    assert len(strong.held(0)) == 5 and strong.positions[:, 1].min() > 0.7
    assert len(weak.held(0)) == 0 and weak.positions[:, 1].max() < 0.0


@pytest.mark.parametrize("name", WAYS)
def test_grip_force_never_exceeds_the_slip_force(name):
    sim = held_sheet(name, cg.Grip(radius=0.3, slip_force=0.6))
    sim.move_grip(0, (0.0, 20.0, 0.0))
    largest = 0.0
    for _ in range(5):
        sim.step()
        largest = max(largest, float(np.linalg.norm(sim.grip_forces[0])))
    assert 0.5 < largest <= 0.6 * (1 + 1e-9)


@pytest.mark.parametrize("name", IMPLICIT)
def test_a_held_sheet_follows_its_gripper(name):
    sim = held_sheet(name)
    sim.step(120)
    before = sim.positions.copy()
    sim.move_grip(0, (0.1, 0.05, -0.02))
    sim.step(60)
    sim.move_grip(0, (0.0, 0.0, 0.0))
    sim.step(120)
    assert sim.positions - before == pytest.approx(np.tile([0.1, 0.05, -0.02], (25, 1)), abs=2e-3)


# ---------------------------------------------------------------------------------------------------------------
# in the pipeline

QUICK = {"runge_kutta": RUNGE_KUTTA} | {
    name: dataclasses.replace(way, substeps=4, tolerance=0.1) for name, way in IMPLICIT.items()
}


@pytest.mark.parametrize("name", QUICK)
def test_a_crumpling_sheet_never_crosses_itself(name):
    sim = cg.Simulation(cg.scenes.make("drop", resolution=6), QUICK[name])
    for _ in range(12):
        sim.step(10)
        assert sim.metrics()["hits"] == 0
    assert np.ptp(sim.positions[:, 1]) < 0.8, "it has crumpled"


@pytest.mark.parametrize("name", [*QUICK, "xpbd"])
@pytest.mark.parametrize("self_collision", [False, True])
def test_a_sheet_on_a_ball(name, self_collision):
    """It hits, slides, hangs over; what the body books is what the momentum lacks."""
    ball = cg.Body(trimesh.creation.icosphere(subdivisions=2, radius=0.2))
    mesh = cg.grid(0.5, 0.5, 6, 6).transformed(translation=(0.02, 0.23, 0.01))
    material = cg.Material(stretch=500.0, damping=0.0)
    scene = cg.Scene([cg.Cloth(mesh, material)], bodies=[ball], self_collision=self_collision)
    way = QUICK[name] if name in QUICK else cg.Fidelity()
    sim = cg.Simulation(scene, dataclasses.replace(way, map_size=120))
    m, dt = sim.model.masses, scene.step
    weight = m.sum() * np.array([0.0, -G, 0.0])
    impulse = np.zeros(3)
    for _ in range(45):
        sim.step()
        impulse += dt * (sim.body_forces.sum(axis=0) + weight)
    assert sim.metrics()["hits"] == 0
    assert sim.penetration_depth() < 1e-3
    assert sim.positions[:, 1].max() > 0.18 and sim.positions[:, 1].min() < 0.15
    assert m @ sim.velocities == pytest.approx(impulse, abs=0.02 * 45 * dt * m.sum() * G)


def slide(name: str, tilt: float, friction: float, steps: int, on_body: bool = False) -> np.ndarray:
    """Velocity of a sheet along a ground under gravity tilted by `tilt`, that starts at 1 m/s."""
    mesh = cg.grid(0.4, 0.4, 2, 2)
    material = cg.Material(thickness=4e-3, damping=0.0, friction=friction, stretch=500.0)
    gravity = (G * np.sin(tilt), -G * np.cos(tilt), 0.0)
    placed = mesh.transformed(translation=(0, 0.002, 0))
    scene = lone(cg.Cloth(placed, material, rest=mesh.vertices), ground=0.0, gravity=gravity)
    sim = cg.Simulation(scene, QUICK[name] if name in QUICK else cg.Fidelity())
    sim.set_velocities(np.tile([1.0, 0.0, 0.0], (9, 1)))
    sim.step(steps)
    return m_mean(sim)


def m_mean(sim: cg.Simulation) -> np.ndarray:
    return sim.model.masses @ sim.velocities / sim.model.masses.sum()


@pytest.mark.parametrize("name", QUICK)
@pytest.mark.parametrize(("tilt", "friction"), [(0.0, 0.3), (0.3, 0.2), (0.5, 0.0), (0.2, 0.4)])
def test_friction_slows_a_sliding_sheet_by_coulombs_law(name, tilt, friction):
    steps = 12
    expected = 1.0 + steps / 60 * G * (np.sin(tilt) - friction * np.cos(tilt))
    v = slide(name, tilt, friction, steps)
    assert v[0] == pytest.approx(expected, abs=0.02)
    assert v[1] == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize("name", QUICK)
def test_a_sheet_sticks_on_a_slope_below_the_angle_of_friction(name):
    for tilt, sticks in ((np.arctan(0.3) - 0.02, True), (np.arctan(0.3) + 0.03, False)):
        v = slide(name, tilt, 0.3, 600)
        assert (abs(v[0]) < 1e-4) == sticks


@pytest.mark.parametrize("name", QUICK)
def test_same_calls_give_the_same_bits(name):
    scene = dataclasses.replace(cg.scenes.make("drop", resolution=5), wind=(1.0, 0.0, 0.0))
    sim = cg.Simulation(scene, QUICK[name])
    sim.step(5)
    kept, hashed = sim.snapshot(), []
    twin = copy.deepcopy(sim)
    for other in (sim, twin):
        other.step(5)
        hashed.append(other.state_hash())
    sim.restore(kept)
    sim.step(5)
    hashed.append(sim.state_hash())
    sim.reset()
    sim.step(10)
    hashed.append(sim.state_hash())
    assert len(set(hashed)) == 1


def test_stages_tell_the_integrator():
    scene = cg.scenes.make("hanging_sheet", resolution=4)
    for way, label in (
        (EXACT, "implicit_euler 1x1"), (dataclasses.replace(EXACT, substeps=0), "implicit_euler 2x1"),
        (dataclasses.replace(RUNGE_KUTTA, substeps=300), "runge_kutta 300x1"), (GLOBAL, "global 1x1"),
    ):  # fmt: skip
        assert [stage.name for stage in cg.Simulation(scene, way).pipeline.stages] == [f"integrate [{label}]"]


def test_bad_settings_are_named():
    for field, value in (("time_order", 3), ("tolerance", 0.0), ("solver_steps", -1)):
        with pytest.raises(ValueError, match=f"fidelity.{field}"):
            cg.Fidelity(**{field: value})
    with pytest.raises(ValueError, match="velocity_modification"):
        cg.Fidelity(integrator="implicit_euler", velocity_modification="relative")


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
