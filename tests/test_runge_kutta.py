"""The Runge-Kutta method: its exact factors, its limit, a naive reference."""

from __future__ import annotations

import dataclasses

import naive_mechanics as naive
import numpy as np
import pytest
from ladders import ladder, lone
from ways import RUNGE_KUTTA, acceleration_of, sheet, spring_energies, thrown

import clothgym as cg
from clothgym.model import ClothModel
from clothgym.stages.runge_kutta import safe_time_step


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


def test_runge_kutta_equals_naive():
    sim = thrown(sheet(), dataclasses.replace(RUNGE_KUTTA, substeps=2))
    x, v = sim.positions.copy(), sim.velocities.copy()
    sim.step()
    for _ in range(2):
        x, v = naive.runge_kutta(x, v, acceleration_of(sim.model), sim.pipeline.dt)
    assert sim.positions == pytest.approx(x, abs=1e-13)
    assert sim.velocities == pytest.approx(v, abs=1e-11)
