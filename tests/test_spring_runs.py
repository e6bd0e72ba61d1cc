"""Springs in runs: every spring once, none at the same vertex as its neighbours, and the bits of one sweep after the other."""

from __future__ import annotations

import dataclasses

import naive_mechanics as naive
import numpy as np
import pytest

import clothgym as cg
from clothgym import batches
from clothgym.kernels.integrate import Grips, Ground, Motion
from clothgym.model import ClothModel
from clothgym.stages.xpbd import Runs, spring_layout

STIFF = cg.Material(stretch=900.0, shear=300.0, flexion=40.0, damping=0.7)
PLAIN = dataclasses.replace(STIFF, flexion=0.0)


def sheet(columns: int, rows: int, material=STIFF, pins=(0,), name="cloth") -> cg.Cloth:
    return cg.Cloth(cg.grid(0.1 * columns, 0.1 * rows, columns, rows), material, pins, name=name)


def triangles(columns: int, rows: int, material=STIFF, name="triangles") -> cg.Cloth:
    mesh = cg.grid(0.1 * columns, 0.1 * rows, columns, rows)
    return cg.Cloth((mesh.vertices, mesh.faces), material, (1,), name=name)


CASES = {
    "parity 2": [sheet(40, 31, PLAIN, pins=(0, 40))],
    "parity 4": [sheet(60, 45)],
    "odd and even sides": [sheet(33, 32, PLAIN), sheet(32, 33, PLAIN, name="other")],
    "grid and triangles": [triangles(5, 4), sheet(30, 30, PLAIN)],
    "one cell": [sheet(1, 1, PLAIN)],
    "triangles": [triangles(6, 5)],
}


def model_of(name: str, **scene) -> ClothModel:
    return ClothModel(cg.Scene(CASES[name], **({"self_collision": False} | scene)))


def thrown(model: ClothModel, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = model.scene.start + rng.normal(0.0, 0.02, (model.vertex_count, 3))
    return x, np.where(model.inverse_masses[:, None] > 0, rng.normal(0.0, 1.0, x.shape), 0.0)


# ---------------------------------------------------------------------------------------------------------------
# the order


@pytest.mark.parametrize("name", CASES)
def test_springs_of_a_colour_share_no_vertex(name):
    ends = model_of(name).spring_ends
    colours = np.zeros(len(ends), int)
    seen: list[set[int]] = []
    for s, pair in enumerate(ends.tolist()):  # the colour that the order implies: a new one where a vertex comes again
        if not seen or seen[-1] & set(pair):
            seen.append(set())
        seen[-1] |= set(pair)
        colours[s] = len(seen) - 1
    most = np.bincount(ends.ravel()).max()
    assert len(seen) <= 2 * most - 1, "first fit needs no more"


def test_an_order_is_a_permutation_and_a_star_of_many_springs_is_no_trouble():
    star = np.stack([np.zeros(90, np.int32), np.arange(1, 91, dtype=np.int32)], axis=1)
    order = batches.by_colour(star, 91)
    assert sorted(order.tolist()) == list(range(90))
    assert batches.by_colour(np.zeros((0, 2), np.int32), 3).tolist() == []


@pytest.mark.parametrize("name", CASES)
def test_every_spring_stands_in_one_entry(name):
    model = model_of(name)
    layout = spring_layout(model)
    assert sorted(layout.entries[layout.entries >= 0].tolist()) == list(range(len(model.spring_ends)))
    assert len(np.unique(layout.slot)) == model.vertex_count
    assert layout.slot.max() < layout.slot_count
    # entries of runs and loose ones stand one after the other
    covered = np.concatenate([np.arange(first, first + n) for _, _, n, first in layout.runs.tolist()] or [[]])
    assert covered.tolist() == list(range(len(layout.entries) - layout.loose_count))


@pytest.mark.parametrize("name", CASES)
def test_springs_of_a_run_are_where_it_says_and_independent(name):
    model = model_of(name)
    layout = spring_layout(model)
    slots = layout.slot[model.spring_ends]
    for i0, j0, length, first in layout.runs.tolist():
        assert not set(range(i0, i0 + length)) & set(range(j0, j0 + length)), "a slot comes twice in a run"
        assert min(i0, j0) >= 0 and max(i0, j0) + length <= layout.slot_count
        for k in range(length):
            spring = layout.entries[first + k]
            if spring >= 0:
                assert {i0 + k, j0 + k} == set(slots[spring].tolist())
                assert (slots[spring, 0] == j0 + k) == layout.flipped[first + k]


def test_which_cloths_have_runs():
    loose = {name: spring_layout(model_of(name)).loose_count for name in CASES}
    springs = {name: len(model_of(name).spring_ends) for name in CASES}
    assert loose["parity 2"] == loose["parity 4"] == loose["odd and even sides"] == 0
    assert loose["grid and triangles"] == len(ClothModel(cg.Scene([triangles(5, 4)])).spring_ends) > 50
    assert loose["triangles"] == springs["triangles"]
    assert len(spring_layout(model_of("parity 4")).runs) < 60


def test_grids_are_known_by_their_quads():
    mesh = cg.grid(1.0, 2.0, 5, 3)
    assert batches.grid_columns(mesh) == 6
    assert batches.grid_columns(cg.grid(1.0, 1.0, 1, 1)) == 2
    assert batches.grid_columns(cg.Mesh(mesh.vertices, mesh.faces)) == 0
    assert batches.grid_columns(cg.Mesh(mesh.vertices, mesh.faces, mesh.quads[::-1].copy())) == 0
    assert batches.grid_columns(cg.Mesh(mesh.vertices, mesh.faces, mesh.quads[:-1])) == 0
    shuffled = np.random.default_rng(0).permutation(24).astype(np.int32)
    assert batches.grid_columns(cg.Mesh(mesh.vertices, shuffled[mesh.faces], shuffled[mesh.quads])) == 0


# ---------------------------------------------------------------------------------------------------------------
# the kernel


def grips_for(model: ClothModel, vertices=(7, 9)) -> Grips:
    held = np.array(vertices, np.int32)
    count = len(held)
    targets = model.scene.start[held] + [0.02, 0.05, -0.01]
    return Grips(held, targets, np.full((count, 3), 0.4), np.full(count, 60.0), np.full(count, 0.3),
                 np.zeros((count, 3)), np.zeros((count, 3)))  # fmt: skip


def steps(model, x, v, dtype="float64", substeps=5, sweeps=1, ground=-np.inf, external=False, count=2):
    """x, v after `count` steps of the kernel in runs, its layout and its grips."""
    layout = spring_layout(model)
    dt = model.scene.step / substeps
    runs = Runs(model, layout, dt, np.dtype(dtype))
    wind = np.random.default_rng(3).normal(0.0, 5.0, x.shape) if external else np.zeros((0, 3))
    motion = Motion(dt, sweeps, np.array([0.0, -9.81, 0.0]), model.damping, wind, -1.0, True)
    x, v, grips = x.copy(), v.copy(), grips_for(model)
    radii = 0.5 * model.thickness
    for _ in range(count):
        runs.step(x, v, radii, motion, Ground(ground, 0.3), grips, 0, substeps)
    return x, v, layout, motion, grips, runs


@pytest.mark.parametrize("sweeps", [1, 3])
@pytest.mark.parametrize("name", ["parity 2", "parity 4", "grid and triangles"])
def test_runs_have_the_bits_of_one_spring_after_the_other(name, sweeps):
    model = model_of(name)
    x, v = thrown(model, 1)
    xs, vs, layout, motion, grips, _ = steps(model, x, v, sweeps=sweeps, ground=-0.02, external=True, count=1)
    springs = layout.entries[layout.entries >= 0]
    turned = layout.flipped[layout.entries >= 0]
    ends = np.where(turned[:, None], model.spring_ends[springs][:, ::-1], model.spring_ends[springs])
    expected_grips = grips_for(model)
    expected = naive.xpbd(
        x, v, ends, model.spring_rest[springs], model.spring_stiffness[springs], model.inverse_masses, motion, 5,
        expected_grips, 0.5 * model.thickness, -0.02, 0.3,
    )  # fmt: skip
    assert np.abs(xs - x).max() > 0.01
    assert (xs[:, 1] <= -0.02 + 0.5 * model.thickness + 1e-15).any(), "nothing touches the ground"
    assert (xs == expected[0]).all()
    assert (vs == expected[1]).all()
    assert (grips.forces == expected_grips.forces).all() and np.abs(grips.forces).max() > 0.1


@pytest.mark.parametrize("name", ["parity 2", "parity 4", "grid and triangles"])
def test_single_precision_follows_double(name):
    """Rounding of the way of a substep is 6e-8 of it; a stiff sheet multiplies that a little in 40 substeps."""
    model = model_of(name)
    x, v = thrown(model, 2)
    double = steps(model, x, v, substeps=20, ground=-0.1)
    single = steps(model, x, v, "float32", substeps=20, ground=-0.1)
    assert single[0].dtype == single[1].dtype == np.float64
    assert single[0] == pytest.approx(double[0], abs=2e-6)
    assert single[1] == pytest.approx(double[1], abs=2e-3)
    assert (single[0] != double[0]).any()


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_arrays_have_the_precision_asked_for(dtype):
    model = model_of("parity 2")
    runs = Runs(model, spring_layout(model), 1e-3, np.dtype(dtype))
    exact = {"slot": np.int32, "runs": np.uint64, "loose": np.int32}
    for name, array in (runs.arrays._asdict() | runs.space._asdict()).items():
        assert array.dtype == exact.get(name, dtype), name


def test_single_precision_feels_gravity_in_tiny_substeps():
    """g dt^2 is 1e-10 m here: added to a position of 1 m in single precision it would be lost."""
    cloth = cg.Cloth(cg.grid(1, 1, 20, 20).transformed(translation=(3.0, 5.0, 2.0)), PLAIN)
    scene = cg.Scene([cloth], self_collision=False)
    sim = cg.Simulation(scene, cg.Fidelity(substeps=4000, sweeps=1, precision="float32"))
    assert sim.pipeline.stages[0].step.integrator.runs is not None
    sim.step(6)
    reference = cg.Simulation(scene, cg.Fidelity(substeps=4000, sweeps=1))
    reference.step(6)
    assert sim.positions == pytest.approx(reference.positions, abs=1e-6)
    assert (5.0 - sim.positions[:, 1]).min() > 0.04


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_no_memory_between_steps(dtype):
    model = model_of("parity 4")
    x, v = thrown(model, 5)
    first = steps(model, x, v, dtype, count=1)
    runs, motion = first[5], first[3]
    runs.step(np.random.default_rng(0).normal(size=x.shape), v.copy(), 0.5 * model.thickness, motion,
              Ground(-np.inf, 0.3), grips_for(model), 0, 5)  # fmt: skip
    again, velocities = x.copy(), v.copy()
    runs.step(again, velocities, 0.5 * model.thickness, motion, Ground(-np.inf, 0.3), grips_for(model), 0, 5)
    assert (again == first[0]).all() and (velocities == first[1]).all()


def test_springs_without_length_do_no_harm():
    model = model_of("parity 2")
    for dtype in ("float64", "float32"):
        x, v, *_ = steps(model, np.zeros((model.vertex_count, 3)), np.zeros((model.vertex_count, 3)), dtype)
        assert np.isfinite(x).all() and np.isfinite(v).all()


def test_pins_stay_to_the_bit():
    model = model_of("parity 2", wind=(0.0, 2.0, 1.0))
    for precision in ("float64", "float32"):
        sim = cg.Simulation(model.scene, cg.Fidelity(substeps=20, precision=precision))
        start = sim.positions[[0, 40]].copy()
        sim.set_velocities(np.full((model.vertex_count, 3), 0.3))
        sim.step(5)
        assert (sim.positions[[0, 40]] == start).all()
        assert (sim.velocities[[0, 40]] == 0.0).all()
