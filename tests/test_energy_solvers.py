"""Energies in simulations: rest and momentum; the model, materials and fidelity."""

from __future__ import annotations

import dataclasses
import json

import naive_energies as naive
import numpy as np
import pytest
from energy_cases import FABRIC, KINDS, G, built, rolled

import clothgym as cg
from clothgym import materials, metrics
from clothgym.model import ClothModel

# ---------------------------------------------------------------------------------------------------------------
# solvers


@pytest.mark.parametrize("kind", ["membrane", "hinge", "quadratic"])
@pytest.mark.parametrize("integrator", ["xpbd", "symplectic_euler"])
def test_a_cloth_comes_to_rest_where_its_energy_is_least(kind, integrator):
    """All forces balance there, whatever way led there; pins carry the weight."""
    mesh = naive.irregular(0.4, 0.3, 4, 3)
    fabric = dataclasses.replace(FABRIC, weft=60.0, warp=40.0, coupling=8.0, shear_modulus=15.0, bending=0.01,
                                 bending_warp=0.005, damping=6.0)  # fmt: skip
    pins = np.flatnonzero(mesh.vertices[:, 0] < -0.199).tolist()
    upright = mesh.vertices[:, [2, 0, 1]] * [1.0, -1.0, 1.0] if kind == "membrane" else mesh.vertices
    cloth = cg.Cloth(cg.Mesh(upright, mesh.faces), fabric, pins, mesh.vertices)
    fidelity = cg.Fidelity(integrator=integrator, substeps=8 if integrator == "xpbd" else 0, **KINDS[kind])
    sim = cg.Simulation(cg.Scene([cg.Cloth(cloth.mesh, fabric, pins, mesh.vertices)], self_collision=False), fidelity)
    sim.step(500)
    weight = np.zeros_like(mesh.vertices)
    weight[:, 1] = -G * sim.model.masses
    assert sim.metrics()["max_speed"] < 1e-5
    assert np.abs(sim.positions - cloth.mesh.vertices).max() > 2e-3
    free = sim.model.inverse_masses > 0.0
    left = naive.forces(sim.model, sim.positions.copy()) + weight
    assert np.abs(left[free]).max() < 2e-3 * np.abs(weight).max()
    expected = naive.at_rest(sim.model, sim.positions.copy(), weight, 1e-10)
    assert sim.positions == pytest.approx(expected, abs=2e-5)
    assert (sim.positions[pins] == cloth.mesh.vertices[pins]).all()


@pytest.mark.parametrize("kind", ["hinge", "quadratic"])
def test_xpbd_keeps_momentum(kind):
    mesh = naive.irregular(1.0, 0.8, 4, 3)
    x = rolled(mesh.vertices, 1.5, 20.0) * 1.03
    scene = cg.Scene(
        [cg.Cloth(cg.Mesh(x, mesh.faces), FABRIC, (), mesh.vertices)], gravity=(0, 0, 0), self_collision=False
    )
    drift = []
    for substeps in (10, 100):
        sim = cg.Simulation(scene, cg.Fidelity(substeps=substeps, sweeps=2, **KINDS[kind]))
        sim.set_velocities(np.cross([0.0, 0.5, 1.0], x) + np.array([0.3, -0.2, 0.1]))
        m, moment = sim.model.masses, []
        momentum = m @ sim.velocities
        for _ in range(2):
            moment.append((m[:, None] * np.cross(sim.positions, sim.velocities)).sum(axis=0))
            sim.step(5)
        assert m @ sim.velocities == pytest.approx(momentum, abs=1e-12)
        assert np.abs(sim.positions - x).max() > 0.05
        drift.append(np.abs(moment[1] - moment[0]).max() / np.abs(moment[0]).max())
    assert drift[1] < 1e-2
    assert drift[1] < 0.3 * drift[0]


def test_hanging_sheet_moves_alike_with_springs_and_as_a_continuum():
    scene = cg.scenes.make("hanging_sheet", resolution=8)
    paths = {}
    for kind in ("springs", "membrane"):
        sim = cg.Simulation(scene, cg.Fidelity(substeps=24, **KINDS[kind]))
        path = []
        for _ in range(4):
            sim.step(8)
            path.append(sim.positions.copy())
        paths[kind] = np.array(path)
    assert np.ptp(paths["springs"][-1][:, 1]) > 0.5
    apart = np.linalg.norm(paths["springs"] - paths["membrane"], axis=2)
    assert np.sqrt((apart**2).mean(axis=1)).max() < 0.01
    assert apart.max() < 0.03


# ---------------------------------------------------------------------------------------------------------------
# the model, materials and fidelity


def test_what_is_absent_has_no_arrays():
    mesh = cg.grid(1.0, 1.0, 3, 3)
    lengths = {}
    for kind, fidelity in KINDS.items():
        model = ClothModel(cg.Scene([cg.Cloth(mesh, FABRIC)]), cg.Fidelity(**fidelity))
        a = model.arrays
        lengths[kind] = [len(a.spring_ends), len(a.membrane.faces), len(a.hinges.stencils), len(a.quadratic.stencils)]
        there = [a.has_membrane, a.has_hinges, a.has_quadratic]
        assert there == [True if length else None for length in lengths[kind][1:]], "kernels are compiled by these"
        assert model.constraint_count == np.dot(lengths[kind], [1, 3, 3, 9])
        assert model.mean_edge == pytest.approx(1 / 3)
    assert lengths == {
        "springs": [24 + 18 + 16, 0, 0, 0], "membrane": [0, 18, 0, 0], "hinge": [0, 18, 18, 0], "quadratic": [0, 18, 0, 18]
    }  # fmt: skip
    limp = built(mesh, "hinge", dataclasses.replace(FABRIC, bending=0.0, bending_warp=0.0))
    assert len(limp.arrays.hinges.vertices) == 0
    springs = ClothModel(cg.Scene([cg.Cloth(mesh, FABRIC)]), cg.Fidelity(bending="hinge"))
    assert set(springs.spring_kinds.tolist()) == {0, 1} and len(springs.arrays.hinges.stencils) == 18


def test_two_cloths_hold_the_energies_of_each():
    one, two = cg.grid(1.0, 1.0, 3, 2), naive.irregular(0.6, 0.8, 4, 3)
    cloths = [cg.Cloth(one, FABRIC), cg.Cloth(two, dataclasses.replace(FABRIC, bending=0.7))]
    for kind in KINDS:
        fidelity = cg.Fidelity(**KINDS[kind])
        both = ClothModel(cg.Scene(cloths), fidelity)
        parts = [ClothModel(cg.Scene([cloth]), fidelity) for cloth in cloths]
        places = [rolled(cloth.mesh.vertices, 1.0, 30.0) * 1.1 for cloth in cloths]
        x = np.concatenate(places)
        expected = sum(naive.energies(part, place) for part, place in zip(parts, places, strict=True))
        assert naive.energies(both, x) == pytest.approx(expected, rel=1e-12)
        apart = np.concatenate([naive.forces(part, place) for part, place in zip(parts, places, strict=True)])
        assert naive.forces(both, x) == pytest.approx(apart, abs=1e-12 * np.abs(apart).max())
        weight = (both.masses * x[:, 1]).sum() * G
        assert metrics.potential_energy(both, x) == pytest.approx(expected.sum() + weight, rel=1e-12)


def test_materials_survive_json():
    for material in (*materials.MATERIALS.values(), FABRIC, cg.Material(weft=3e3)):
        assert cg.Material.from_json(json.loads(json.dumps(material.to_json()))) == material
    assert cg.Material.from_json({"stretch": 5.0}).moduli[0] == 5.0 + cg.Material().shear
    with pytest.raises(ValueError, match=r"material\.wefty"):
        cg.Material.from_json({"wefty": 1.0})


@pytest.mark.parametrize(("values", "message"), [
    ({"weft": 0.0}, "material.weft = 0"),
    ({"bending": -1.0}, "material.bending = -1"),
    ({"bending": None}, "material.bending = None"),
    ({"weft": 10.0, "warp": 10.0, "coupling": 10.0}, "material.coupling = 10"),
    ({"bending": 0.0, "bending_warp": 1.0}, "material.bending_warp = 1"),
])  # fmt: skip
def test_bad_materials_are_named(values, message):
    with pytest.raises(ValueError, match=message):
        cg.Material(**values)


def test_bad_fidelity_is_named():
    for values, message in (
        ({"membrane": "rubber"}, "fidelity.membrane = 'rubber'"),
        ({"bending": "soft"}, "fidelity.bending = 'soft'"),
        ({"integrator": "symplectic_euler", "velocity_modification": "literal", "membrane": "continuum"},
         "fidelity.velocity_modification"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            cg.Fidelity(**values)


def test_named_fabrics_are_what_their_sources_say():
    """Numbers of docs/materials.md, from the units of the sources."""
    wool, denim = materials.get("wool"), materials.get("denim")
    # FAST: extension at 98.1 N/m, bending rigidity in micro N m, shear rigidity in N/m
    assert (wool.weft, wool.warp) == pytest.approx((98.1 / 0.0587, 98.1 / 0.046), rel=1e-3)
    assert (wool.bending, wool.bending_warp, wool.shear_modulus) == (5.02e-6, 5.56e-6, 26.17)
    # KES: gf/cm = 0.980665 N/m; extension at 500 gf/cm, shear per degree, bending in gf cm^2/cm
    force = 9.80665e-3 / 1e-2
    assert denim.weft == pytest.approx(500.0 * force / 0.05515, rel=1e-3)
    assert denim.shear_modulus == pytest.approx(2.180 * force / np.radians(1.0), rel=1e-3)
    assert denim.bending == pytest.approx(0.172 * force * 1e-4, rel=5e-3)
    assert (denim.stretch, denim.shear, denim.flexion) == (3e4, 1e3, 2e-1), "springs of old scenes stay"
