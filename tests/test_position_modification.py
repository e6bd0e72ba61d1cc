"""Position modification [Provot 1995]: against a naive reference, what it keeps, and what it refuses."""

from __future__ import annotations

import dataclasses

import naive_mechanics as naive
import numpy as np
import pytest
from ladders import ladder, lone

import clothgym as cg
from clothgym.kernels import integrate
from clothgym.kernels.integrate import Motion
from clothgym.model import STRUCTURAL, ClothModel

G = 9.81
EULER = cg.Fidelity(integrator="symplectic_euler", substeps=0)
MODIFIED = dataclasses.replace(EULER, position_modification=4, stretch_limit=0.1)


@pytest.mark.parametrize("sweeps", [1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_equals_naive(seed, sweeps):
    rng = np.random.default_rng(seed)
    mesh = cg.grid(1.0, 0.8, 4, 3)
    model = ClothModel(lone(cg.Cloth(mesh, cg.Material(stretch=300.0, shear=120.0, flexion=30.0), (0, 5))))
    x, v = mesh.vertices + rng.normal(0, 0.1, mesh.vertices.shape), rng.normal(0, 1.0, mesh.vertices.shape)
    v[[0, 5]] = 0.0
    gravity, springs = np.array([0.0, -G, 0.0]), (model.spring_ends, model.spring_rest)
    free, fast = naive.symplectic_euler(
        x, v, *springs, model.spring_stiffness, model.inverse_masses, gravity, model.damping, 1e-3
    )
    expected = naive.modify_positions(free, *springs, model.inverse_masses, 0.05, sweeps)
    motion = Motion(1e-3, 1, gravity, model.damping, np.zeros((0, 3)), 0.05, False, sweeps)
    found, w, p = x.copy(), v.copy(), np.zeros_like(x)
    integrate.euler_predict(found, w, p, np.zeros_like(x), model.arrays, motion)
    assert np.abs(expected - free).max() > 0.01
    assert p == pytest.approx(expected, abs=1e-12)
    assert w == pytest.approx(fast, abs=1e-10), "velocities follow from positions at the end of the substep only"


def longest(sim: cg.Simulation) -> float:
    model = sim.model
    chosen = model.spring_kinds == STRUCTURAL
    ends, rest = model.spring_ends[chosen], model.spring_rest[chosen]
    return float((np.linalg.norm(sim.positions[ends[:, 1]] - sim.positions[ends[:, 0]], axis=1) / rest).max() - 1.0)


def test_a_soft_column_keeps_to_the_limit_with_enough_sweeps():
    """A hanging ladder so soft that its weight alone stretches it by 0.6: each sweep passes the excess on to the next."""
    found = {}
    for sweeps in (0, 1, 64):
        sim = cg.Simulation(
            lone(ladder(8, stretch=1.2, damping=8.0)), dataclasses.replace(MODIFIED, position_modification=sweeps)
        )
        sim.step(240)
        found[sweeps] = longest(sim)
    assert found[0] > 0.5
    assert found[64] < 0.101
    assert 0.2 < found[1] < 0.6 * found[0], "one sweep should help and not be enough"


def test_an_over_stretched_cloth_falls_freely():
    """Ends move by shares of their inverse masses: the centre of mass does not know of it."""
    sim = cg.Simulation(lone(ladder(4, top=(), stretched=1.3, stretch=5.0)), MODIFIED)
    masses = sim.model.masses
    start = masses @ sim.positions / masses.sum()
    before = longest(sim)
    sim.step(6)
    n, dt = 6 * sim.pipeline.substeps, sim.pipeline.dt
    fallen = (start - masses @ sim.positions / masses.sum())[1]
    assert fallen == pytest.approx(0.5 * G * dt * dt * n * (n + 1), rel=1e-9)
    assert before > 0.29 and longest(sim) < 0.12


def test_the_stage_tells_it():
    sim = cg.Simulation(lone(ladder(2)), MODIFIED)
    assert sim.pipeline.stages[0].name.endswith("position modification x4 above 0.1]")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"integrator": "xpbd"}, "works with integrator 'symplectic_euler' only"),
        ({"integrator": "symplectic_euler", "membrane": "continuum"}, "acts on springs"),
        ({"integrator": "symplectic_euler", "velocity_modification": "relative"}, "not together"),
    ],
)
def test_what_it_does_not_go_with(settings, words):
    with pytest.raises(ValueError, match=f"fidelity.position_modification = 2.*{words}"):
        cg.Fidelity(position_modification=2, **settings)
