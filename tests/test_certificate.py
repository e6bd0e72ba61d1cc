"""The certificate of contact: no path that it lets through crosses."""

from __future__ import annotations

import dataclasses

import naive_mechanics as naive
import numpy as np
import pytest
from contact_cases import CONTACT_ONLY, every_quad, narrowed, stack

import clothgym as cg
from clothgym.detection.sides import Sides
from clothgym.kernels import certificate
from clothgym.model import ClothModel


@pytest.mark.parametrize("rounds", [0, 1, 8])
@pytest.mark.parametrize("seed", range(5))
def test_certified_paths_never_cross(seed, rounds):
    rng = np.random.default_rng(seed)
    scene = stack(3, 3, pinned=() if seed % 2 else (1,), thickness=[0.01, 1e-4, 0.03][seed % 3])
    model = ClothModel(scene)
    x = scene.start + rng.normal(0, 0.004, scene.start.shape)
    speed = [0.02, 0.3, 2.0][seed % 3]
    p = x + rng.normal(0, speed, x.shape)
    p[:, 1] += (rng.normal(0, 2 * speed, 3))[model.cloth_of_vertex]
    pinned = model.inverse_masses == 0
    p[pinned] = x[pinned]
    quads, kinds = every_quad(model.faces)
    both = naive.all_quads(model.faces)
    assert not cg.intersections(x, model.surface).hit_count
    assert naive.collisions(x, p, model.faces, quads=both), "nothing would cross: the test shows nothing"
    _, watched = narrowed(x, p, quads, kinds, model.thickness.min())
    before = p.copy()
    certificate.keep_apart(
        x, p, model.inverse_masses, model.thickness, quads, kinds, len(quads), watched.separation, rounds
    )
    assert naive.collisions(x, p, model.faces, quads=both) == []
    for time in np.linspace(0, 1, 21):
        assert cg.intersections(x + time * (p - x), model.surface).hit_count == 0
    assert (p[pinned] == x[pinned]).all()
    if not pinned.any():
        moved = model.masses @ (p - before)
        assert moved == pytest.approx(0.0, abs=1e-12 * speed)


def test_certify_leaves_safe_paths_alone():
    scene = stack(2, 3, gap=0.05)
    model = ClothModel(scene)
    p = scene.start + np.random.default_rng(0).normal(0, 0.002, scene.start.shape)
    quads, kinds = every_quad(model.faces)
    _, watched = narrowed(scene.start, p, quads, kinds, 0.01)
    before = p.copy()
    result = certificate.keep_apart(
        scene.start, p, model.inverse_masses, model.thickness, quads, kinds, len(quads), watched.separation, 8
    )
    assert tuple(result) == (0, 0)
    assert (p == before).all()


def test_certify_alone_stops_one_vertex_at_one_triangle():
    """The vertex keeps at least a tenth of the thickness from the moving triangle, and momentum is kept."""
    x = np.array([[0.2, 0.5, 0.2], [0, 0, 0], [1, 0, 0], [0, 0, 1.0]])
    p = x + np.array([[0, -2.0, 0], [0, 0.5, 0], [0, 0.5, 0], [0, 0.5, 0]])
    w = np.array([1.0, 0.5, 0.5, 0.25])
    quads, kinds = np.array([[0, 1, 2, 3]], np.int32), np.zeros(1, np.uint8)
    for rounds in (0, 20):
        q = p.copy()
        _, watched = narrowed(x, q, quads, kinds, 0.1)
        certificate.keep_apart(x, q, w, np.full(4, 0.1), quads, kinds, 1, watched.separation, rounds)
        assert q[0, 1] - q[1:, 1].max() >= 0.01 - 1e-12
        assert (q - p).T @ (1 / w) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_no_substep_of_a_violent_run_crosses(substeps, seed):
    """Vertices thrown about at up to several 100 m/s: every straight way of every substep is free of collisions."""
    rng = np.random.default_rng(seed)
    scene = stack(3, 3, pinned=(1,) if seed % 2 else (), friction=[0.0, 0.5][seed % 2],
                  thickness=[0.01, 3e-4][seed // 3], stretch=[1e4, 100.0, 1e5][seed % 3])  # fmt: skip
    sim = cg.Simulation(
        scene, dataclasses.replace(CONTACT_ONLY, substeps=[1, 2, 8][seed % 3], repair_rounds=[8, 0][seed % 2])
    )
    both = naive.all_quads(sim.model.faces)
    free = (sim.model.inverse_masses > 0)[:, None]
    for speed in (5.0, 100.0):
        thrown = rng.normal(0, speed, scene.start.shape) + (rng.normal(0, 50, (3, 3)))[sim.model.cloth_of_vertex]
        sim.set_velocities(np.where(free, thrown, 0.0))
        sim.step(2)
    assert len(substeps) == 4 * sim.pipeline.substeps
    for x, p in substeps:
        assert naive.collisions(x, p, sim.model.faces, quads=both) == []
    assert sim.metrics()["work"]["repaired"] + sim.metrics()["work"]["zoned"] > 0
    assert cg.intersections(sim.positions, sim.model.surface).hit_count == 0


@pytest.mark.parametrize("count", [1, 4])
def test_a_gripper_that_jumps_pulls_nothing_through(substeps, count):
    """A hand placed 40 cm further moves vertices that nobody expected to move; a sheet in between must hold."""
    scene = dataclasses.replace(stack(2, 3, gap=0.05, thickness=2e-3), grips=[cg.Grip(stiffness=1e6, slip_force=1e6)])
    sim = cg.Simulation(scene, dataclasses.replace(CONTACT_ONLY, substeps=count))
    sim.place_grip(0, sim.positions[5])
    assert sim.grasp(0, [5]) == 1
    for target in ((0.0, 0.45, 0.0), (0.1, -0.4, 0.1), (-0.1, 0.5, 0.0)):
        sim.place_grip(0, target)
        sim.step()
    assert sim.metrics()["work"]["rebuilds"] > 0
    both = naive.all_quads(sim.model.faces)
    for x, p in substeps:
        assert naive.collisions(x, p, sim.model.faces, quads=both) == []
    assert sim.last_intersections.hit_count == 0


@pytest.mark.parametrize("integrator", ["xpbd", "symplectic_euler"])
@pytest.mark.parametrize("pinned", [(), (0,)])
def test_a_sheet_shot_at_another_does_not_pass_through(substeps, integrator, pinned):
    """At 50 m/s the way of one step, 83 cm, is 400 thicknesses; the sheets are 10 cm apart."""
    scene = stack(2, 3, gap=0.1, pinned=pinned, stretch=100.0, shear=30.0, thickness=2e-3)
    fidelity = dataclasses.replace(CONTACT_ONLY, integrator=integrator, substeps=0 if integrator != "xpbd" else 2)
    sim = cg.Simulation(scene, fidelity)
    both = naive.all_quads(sim.model.faces)
    lower = sim.model.cloth_of_vertex == 0
    velocities = np.zeros_like(scene.start)
    velocities[~lower, 1] = -50.0
    sim.set_velocities(velocities)
    sides = Sides(sim.model.faces, *(vertices for _, vertices, _ in sim.model.ranges))
    required = sides.signs(scene.start)
    assert np.count_nonzero(required) > 4
    for number in range(3):
        sim.step()
        assert cg.intersections(sim.positions, sim.model.surface).hit_count == 0
        if not pinned and number == 0:  # later they are wrapped around each other and sides say nothing
            assert sides.error(sim.positions, required) == 0.0
    assert sim.metrics()["work"]["contacts"] > 0
    for x, p in substeps:  # no crossing on any straight way is the proof, at every substep
        assert naive.collisions(x, p, sim.model.faces, quads=both) == []
