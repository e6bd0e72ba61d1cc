"""Corrections in a simulation: as displacements, speeds and accelerations, beside contact and bodies."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from strategy_cases import NAMES, fidelity, mesh_of

import clothgym as cg
from clothgym.commands.untangle import untangle as untangle_command
from clothgym.scenes.canonical import draw

# ---------------------------------------------------------------------------------------------------------------
# channels


@pytest.fixture(scope="module")
def start():
    return draw("Closed", 2.0, 12, 3).scene


def after_one_step(scene, **settings) -> cg.Simulation:
    sim = cg.Simulation(scene, fidelity(untangling="hybrid", **settings))
    sim.step()
    return sim


def test_an_acceleration_brings_a_correction_about_by_the_end_of_the_step(start):
    """Free vertices, no springs in the way: x += share a T^2 / 2."""
    model_free = dataclasses.replace(start.cloths[0].material, stretch=1e-6, shear=1e-6, flexion=1e-6, damping=0.0)
    cloths = [dataclasses.replace(c, material=dataclasses.replace(model_free, thickness=1e-5)) for c in start.cloths]
    loose = dataclasses.replace(start, cloths=cloths)
    none = {"displacement_share": 0.0, "velocity_share": 0.0}
    still = after_one_step(loose, **none)
    assert np.abs(still.positions - loose.start).max() < 1e-6
    half, full = (
        after_one_step(loose, acceleration_share=share, **none).positions - loose.start for share in (0.5, 1.0)
    )
    at_once = after_one_step(loose, velocity_share=0.0, easing=0).positions - loose.start
    largest = np.abs(at_once).max()
    assert largest > 1e-3
    # substeps move by the speed at their ends: n + 1 instead of n of 2 n parts
    assert full == pytest.approx(at_once * (4 + 1) / 4, abs=0.02 * largest)
    assert half == pytest.approx(0.5 * full, abs=0.02 * largest)
    sim = cg.Simulation(loose, fidelity(untangling="hybrid", penalty_stiffness=3.0, **none))
    sim.step()
    pushed = 0.5 * (sim.positions - loose.start) + 0.0
    mass = sim.model.masses.mean()
    assert 2 * pushed == pytest.approx(at_once * (4 + 1) / 8 * 3.0 / mass * loose.step**2, abs=0.02 * largest)


@pytest.mark.parametrize("settings", [
    {"displacement_share": 0.0, "velocity_share": 1.0},
    {"displacement_share": 0.5, "velocity_share": 0.0, "acceleration_share": 0.5},
    {"displacement_share": 0.0, "velocity_share": 0.0, "penalty_stiffness": 20.0},
])  # fmt: skip
def test_every_channel_resolves_a_dent_and_keeps_momentum(start, settings):
    # the speed limit takes momentum where it acts
    sim = cg.Simulation(start, fidelity(untangling="hybrid", speed_limit=100.0, **settings))
    masses = sim.model.masses
    sim.step(12)
    assert sim.last_intersections.hit_count == 0
    impulse = (masses[:, None] * sim.velocities).sum(axis=0)
    assert np.abs(impulse).max() <= 1e-9 * (masses[:, None] * np.abs(sim.velocities)).sum() + 1e-12


def test_accelerations_end_with_the_tangle(start):
    sim = cg.Simulation(start, fidelity(untangling="hybrid", displacement_share=0.0, acceleration_share=1.0))
    sim.step()
    assert np.abs(sim._frame.external).max() > 0
    sim.step(12)
    assert not sim._frame.external.any()
    assert [s.name for s in sim.pipeline.stages if "external" in s.writes] == [
        "intersections [untangle hybrid x1, contact off_any]"
    ]
    windy = cg.Simulation(dataclasses.replace(start, wind=(0.3, 0.0, 0.0)), sim.fidelity)
    windy.step()
    both = windy._frame.external.copy()
    calm = cg.Simulation(start, sim.fidelity)
    calm.step()
    blown = cg.Simulation(windy.scene, dataclasses.replace(sim.fidelity, untangling="none"))
    blown.step()
    assert both == pytest.approx(calm._frame.external + blown._frame.external, abs=1e-9)


def test_without_displacement_there_is_one_pass_a_step(start):
    sim = cg.Simulation(start, fidelity(untangling_passes=4, displacement_share=0.0))
    sim.step()
    assert sim.metrics()["untangling_passes"] == 1
    assert "x1," in sim.pipeline.describe()


# ---------------------------------------------------------------------------------------------------------------
# contact beside hits, bodies, names


def test_limited_contact_keeps_the_distance_that_there_is():
    """Two sheets at less than their thickness, beside an intersection: full contact parts them, limited contact does not, and
    neither lets them come nearer."""
    thin = dataclasses.replace(draw("BIBI", 1.0, 12, 2).scene.cloths[0].material, thickness=0.01, flexion=0.0)
    flat = cg.grid(0.3, 0.3, 6, 6)
    pin = cg.grid(0.03, 0.3, 1, 6)
    through = pin.vertices[:, [0, 2, 1]] * [1.0, 0.3, 1.0] + np.array([0.011, 0.0, 0.013])
    above = flat.vertices + np.array([0.003, 0.004, 0.002])
    cloths = [
        cg.Cloth(flat, thin, name="below", pins=range(len(flat.vertices))),
        cg.Cloth((above, flat.faces), thin, name="above"),
        cg.Cloth((through, pin.faces), thin, name="through", pins=range(len(pin.vertices))),
    ]
    scene = cg.Scene(cloths, gravity=(0.0, -1.0, 0.0), step=0.01)
    count = len(flat.vertices)
    lift = {}
    for near in ("limited", "keep", "off_any"):
        sim = cg.Simulation(scene, fidelity(untangling="none", contacts_near_hits=near, rings=10))
        sim.step(6)
        lift[near] = float(np.median(sim.positions[count : 2 * count, 1])) - 0.004
    assert lift["keep"] > 0.003
    assert abs(lift["limited"]) < 0.0005
    assert lift["off_any"] < -0.001


def body_scene() -> cg.Scene:
    """A sheet that a thin upright plate, a body without a volume to speak of, goes through."""
    sheet = cg.grid(0.3, 0.3, 10, 10)
    rng = np.random.default_rng(3)
    sheet.vertices[:] += rng.uniform(-3e-4, 3e-4, sheet.vertices.shape)
    plate = trimesh.creation.box((0.004, 0.1, 0.12))
    plate.vertices += [0.0131, -0.04, 0.0071]
    return cg.Scene(
        [cg.Cloth(sheet)], bodies=[cg.Body(plate.subdivide().subdivide())], gravity=(0.0, 0.0, 0.0), step=0.01
    )


def test_cloth_is_untangled_from_a_body_and_the_body_stays():
    scene = body_scene()
    settings = {"untangling": "hybrid", "body_tolerance": 1e-4, "body_faces": 0, "map_size": 32}
    sim = cg.Simulation(scene, fidelity(untangle_bodies=True, **settings))
    plain = cg.Simulation(scene, fidelity(**settings))
    assert "bodies]" in sim.pipeline.describe()
    stage = sim.pipeline.stages[1]
    hits = stage._look(sim._frame)
    assert hits.hit_count > 10
    components = {c.components for c in hits.contours}
    assert all(len(joined) == 2 for joined in components), "the body's own faces are left out"
    for other in (sim, plain):
        for _ in range(40):
            other.step()
    assert stage._look(sim._frame).hit_count == 0
    assert stage._look(plain._frame).hit_count > 0
    assert plain.metrics()["untangling_passes"] == 0 < sim.metrics()["untangling_passes"]


def test_a_wrong_name_is_told_in_one_line():
    with pytest.raises(ValueError) as error:
        cg.untangle(*mesh_of("dent"), strategy="locale")
    text = str(error.value)
    assert "\n" not in text and all(name in text for name in (*NAMES, "none", "package.module:Name"))
    with pytest.raises(ValueError, match=r"strategy = 'locale': expected one of none, local"):
        cg.Simulation(cg.scenes.make("pile", count=2), cg.Fidelity(untangling="locale"))
    told = untangle_command.__annotations__["strategy"]
    import clothgym.commands.untangle as module

    assert "_STRATEGIES" in told
    assert all(name in module._STRATEGIES.replace(".", ",").split(", ") or name in module._STRATEGIES for name in NAMES)
