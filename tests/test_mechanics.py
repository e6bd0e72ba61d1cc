"""Mechanics: the model, spring forces, integrators, velocity modification, damping and pins."""

from __future__ import annotations

import dataclasses

import naive_mechanics as naive
import numpy as np
import pytest
from ladders import G, ladder, lone, no_grips

import clothgym as cg
from clothgym.kernels import integrate
from clothgym.kernels.integrate import Ground, Motion
from clothgym.model import FLEXION, SHEAR, STRUCTURAL, ClothModel

NO_GROUND = Ground(-np.inf, 0.0)
EULER = cg.Fidelity(integrator="symplectic_euler", substeps=0)


def random_model(seed: int, pins=(0, 5), **material) -> tuple[ClothModel, np.ndarray, np.ndarray]:
    """A quad sheet with all kinds of springs, thrown about at random."""
    rng = np.random.default_rng(seed)
    values = {"stretch": 300.0, "shear": 120.0, "flexion": 30.0, "damping": 0.7} | material
    mesh = cg.grid(1.0, 0.8, 4, 3)
    model = ClothModel(lone(cg.Cloth(mesh, cg.Material(**values), pins)))
    x = mesh.vertices + rng.normal(0, 0.1, mesh.vertices.shape)
    v = rng.normal(0, 1.0, x.shape)
    v[list(pins)] = 0.0
    return model, x, v


def motion(model: ClothModel, dt: float, gravity=(0.0, -G, 0.0), limit: float = -1.0, relative: bool = True) -> Motion:
    return Motion(dt, 1, np.asarray(gravity, float), model.damping, np.zeros((0, 3)), limit, relative)


def euler_kernel(model: ClothModel, x, v, **settings):
    """x, v and predicted p after one prediction of the compiled kernel."""
    x, v, p, f = x.copy(), v.copy(), np.zeros_like(x), np.zeros_like(x)
    integrate.euler_predict(x, v, p, f, model.arrays, motion(model, **settings))
    return p, v, f


# ---------------------------------------------------------------------------------------------------------------
# the model


def test_masses_are_area_times_density():
    mesh = cg.grid(0.7, 1.3, 5, 4)
    for equal in (False, True):
        model = ClothModel(lone(cg.Cloth(mesh, cg.Material(density=0.23), equal_masses=equal)))
        assert model.masses.sum() == pytest.approx(0.7 * 1.3 * 0.23, rel=1e-12)
        assert np.allclose(model.masses, model.masses[0], rtol=1e-12) == equal
        assert model.inverse_masses == pytest.approx(1.0 / model.masses)


def test_masses_follow_the_rest_shape_not_the_start():
    mesh = cg.grid(1.0, 1.0, 3, 3)
    stretched = cg.Mesh(2.0 * mesh.vertices, mesh.faces, mesh.quads)
    model = ClothModel(lone(cg.Cloth(stretched, cg.Material(density=0.5), rest=mesh.vertices)))
    assert model.masses.sum() == pytest.approx(0.5, rel=1e-12)
    assert model.spring_rest.min() == pytest.approx(1 / 3)


@pytest.mark.parametrize(("columns", "rows"), [(1, 1), (4, 3), (2, 6)])
def test_spring_counts_of_a_grid(columns, rows):
    mesh = cg.grid(columns * 0.1, rows * 0.1, columns, rows)
    model = ClothModel(lone(cg.Cloth(mesh, cg.Material(stretch=3.0, shear=2.0, flexion=1.0))))
    expected = {
        STRUCTURAL: (columns * (rows + 1) + rows * (columns + 1), 3.0, {0.1}),
        SHEAR: (2 * columns * rows, 2.0, {round(0.1 * 2**0.5, 12)}),
        FLEXION: ((columns - 1) * (rows + 1) + (rows - 1) * (columns + 1), 1.0, {0.2}),
    }
    for kind, (count, stiffness, rests) in expected.items():
        of_kind = model.spring_kinds == kind
        assert of_kind.sum() == count
        assert (model.spring_stiffness[of_kind] == stiffness).all()
        assert set(np.round(model.spring_rest[of_kind], 12).tolist()) == (rests if count else set())
    ends = np.sort(model.spring_ends, axis=1)
    assert len(np.unique(ends, axis=0)) == len(ends), "a spring comes twice"


def test_flexion_springs_lie_on_grid_lines():
    columns, rows = 4, 3
    model = ClothModel(lone(cg.Cloth(cg.grid(1, 1, columns, rows), cg.Material(flexion=1.0))))
    pairs = {tuple(sorted(e)) for e in model.spring_ends[model.spring_kinds == FLEXION].tolist()}
    wide = columns + 1
    across = {(r * wide + c, r * wide + c + 2) for r in range(rows + 1) for c in range(columns - 1)}
    along = {(r * wide + c, (r + 2) * wide + c) for r in range(rows - 1) for c in range(columns + 1)}
    assert pairs == across | along


def test_springs_of_a_triangle_mesh():
    mesh = cg.grid(1.0, 1.0, 3, 2)
    model = ClothModel(lone(cg.Cloth((mesh.vertices, mesh.faces), cg.Material(flexion=0.4, shear=7.0))))
    edges = cg.Surface(mesh.faces).edges
    structural = model.spring_kinds == STRUCTURAL
    assert {tuple(e) for e in model.spring_ends[structural].tolist()} == {tuple(e) for e in edges.tolist()}
    assert not (model.spring_kinds == SHEAR).any(), "a triangle mesh has no diagonals of its own"
    sides: dict[tuple, list[int]] = {}
    for face in mesh.faces.tolist():
        for k in range(3):
            sides.setdefault(tuple(sorted((face[k], face[k - 1]))), []).append(face[k - 2])
    opposite = {tuple(sorted(ends)) for ends in sides.values() if len(ends) == 2}
    flexion = model.spring_ends[model.spring_kinds == FLEXION].tolist()
    assert {tuple(sorted(e)) for e in flexion} == opposite
    assert len(flexion) == len(opposite)


def test_springs_of_absent_kinds_do_not_exist():
    model = ClothModel(lone(cg.Cloth(cg.grid(1, 1, 3, 3), cg.Material(shear=0.0, flexion=0.0))))
    assert set(model.spring_kinds.tolist()) == {STRUCTURAL}


def test_contact_thickness_never_exceeds_half_an_altitude():
    mesh = cg.grid(0.3, 0.1, 3, 3)
    model = ClothModel(cg.Scene([cg.Cloth(mesh, cg.Material(thickness=1.0))]))
    a, b = 0.1, 0.1 / 3
    assert model.thickness == pytest.approx(0.5 * a * b / np.hypot(a, b))


def test_two_cloths_keep_their_places():
    one, two = (
        cg.Cloth(cg.grid(1, 1, 2, 2), pins=(1,), name="one"),
        cg.Cloth(cg.grid(1, 1, 1, 3), pins=(0, 7), name="two"),
    )
    model = ClothModel(cg.Scene([one, two]))
    assert [r[0] for r in model.ranges] == ["one", "two"]
    assert np.flatnonzero(model.inverse_masses == 0).tolist() == [1, 9, 16]
    assert model.cloth_of_vertex.tolist() == [0] * 9 + [1] * 8
    assert (model.faces[model.ranges[1][2]] >= 9).all()
    assert model.faces[model.ranges[0][2]].max() == 8
    assert (model.cloth_of_vertex[model.spring_ends[:, 0]] == model.cloth_of_vertex[model.spring_ends[:, 1]]).all()


# ---------------------------------------------------------------------------------------------------------------
# spring forces and symplectic Euler


@pytest.mark.parametrize("seed", range(3))
def test_kernel_equals_naive_forces_and_step(seed):
    model, x, v = random_model(seed)
    springs = model.spring_ends, model.spring_rest, model.spring_stiffness
    p, w, f = euler_kernel(model, x, v, dt=3e-3)
    assert f == pytest.approx(naive.spring_forces(x, *springs), abs=1e-11)
    gravity = np.array([0.0, -G, 0.0])
    expected = naive.symplectic_euler(x, v, *springs, model.inverse_masses, gravity, 0.7, 3e-3)
    assert p == pytest.approx(expected[0], abs=1e-13)
    assert w == pytest.approx(expected[1], abs=1e-11)
    assert (p[[0, 5]] == x[[0, 5]]).all(), "pins move"


def test_spring_forces_have_no_sum_and_no_moment():
    model, x, v = random_model(4)
    _, _, f = euler_kernel(model, x, v, dt=1e-3)
    assert np.abs(f).max() > 1.0
    assert f.sum(axis=0) == pytest.approx(0.0, abs=1e-12)
    assert np.cross(x, f).sum(axis=0) == pytest.approx(0.0, abs=1e-12)


def test_a_spring_at_rest_or_of_no_length_gives_no_force():
    cloth = ladder(2)
    model = ClothModel(lone(cloth))
    _, _, f = euler_kernel(model, cloth.mesh.vertices, np.zeros((6, 3)), dt=1e-3)
    assert f == pytest.approx(0.0, abs=1e-12)
    collapsed = np.zeros((6, 3))
    p, w, f = euler_kernel(model, collapsed, np.zeros((6, 3)), dt=1e-3)
    assert (f == 0.0).all() and np.isfinite(p).all() and np.isfinite(w).all()


def oscillator(dt_share: float, steps: int) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Elongation and its rate of one spring under a fixed end, w dt = dt_share; the pair (1, 3) swings alike."""
    cloth = ladder(1)
    model = ClothModel(lone(cloth, gravity=(0, 0, 0)))
    w = np.sqrt(50.0 * model.inverse_masses[2])
    dt = dt_share / w
    x = cloth.mesh.vertices.copy()
    x[2:, 1] -= 0.05
    v, p, f = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    out = np.zeros((steps, 2))
    for n in range(steps):
        integrate.euler_substeps(
            x, v, p, f, model.arrays, np.zeros(4), motion(model, dt, (0, 0, 0)), NO_GROUND, no_grips(), 0, 1
        )
        out[n] = x[0, 1] - x[2, 1] - 1.0, -v[2, 1]
    return out[:, 0], out[:, 1], w, dt


@pytest.mark.parametrize("share", [0.1, 0.8])
def test_oscillator_frequency_and_bounded_energy(share):
    y, rate, w, dt = oscillator(share, 4000)
    energy = 0.5 * rate**2 + 0.5 * (w * y) ** 2
    assert energy.max() / energy.min() <= (1 + share / 2) / (1 - share / 2) * (1 + 1e-9)
    assert energy.max() / energy.min() > 1 + share / 2, "symplectic Euler's energy does oscillate"
    kept = energy - 0.5 * w * w * dt * y * rate
    assert np.ptp(kept) < 1e-9 * kept.mean(), "the energy that symplectic Euler keeps exactly drifts"
    turns = np.flatnonzero((y[:-1] < 0) & (y[1:] >= 0))
    exact = turns + y[turns] / (y[turns] - y[turns + 1])
    measured = 2 * np.pi * (len(turns) - 1) / ((exact[-1] - exact[0]) * dt)
    assert measured == pytest.approx(2.0 / dt * np.arcsin(0.5 * w * dt), rel=2e-4)


def test_hanging_column_has_the_analytic_elongation():
    rungs = 6
    cloth = ladder(rungs, damping=8.0)
    sim = cg.Simulation(lone(cloth), dataclasses.replace(EULER, substeps=0))
    sim.step(240)
    m = sim.model.masses[0]
    height = sim.positions[::2, 1]
    elongation = -np.diff(height) - 1.0 / rungs
    expected = (rungs - np.arange(rungs)) * m * G / 50.0
    assert elongation == pytest.approx(expected, rel=1e-6)
    assert elongation.sum() == pytest.approx(m * G * rungs * (rungs + 1) / (2 * 50.0), rel=1e-6)


def test_xpbd_column_approaches_the_same_elongation():
    errors = []
    for substeps in (8, 64):
        sim = cg.Simulation(lone(ladder(6, damping=4.0)), cg.Fidelity(substeps=substeps, sweeps=4))
        sim.step(300)
        expected = (6 - np.arange(6)) * sim.model.masses[0] * G / 50.0
        elongation = -np.diff(sim.positions[::2, 1]) - 1.0 / 6
        errors.append(np.abs(elongation / expected - 1.0).max())
    assert errors[1] < 2e-3
    assert errors[1] < errors[0] < 2e-2


@pytest.mark.parametrize(
    ("structural", "shear", "flexion", "limit"),
    [(1, 0, 0, 1.0), (1, 1, 0, 0.707), (1, 1, 1, 0.629), (1, 0.5, 0.5, 0.8)],
)
def test_stability_limit_of_grids(structural, shear, flexion, limit):
    """Table 4.1: the true limits in units of sqrt(m/K); the safe step lies below, the paper's bound far above."""
    k, cells = 100.0, 12
    mesh = cg.grid(1.0, 1.0, cells, cells)
    material = cg.Material(stretch=k * structural, shear=k * shear, flexion=k * flexion, damping=0.0)
    model = ClothModel(lone(cg.Cloth(mesh, material, equal_masses=True), gravity=(0, 0, 0)))
    unit = np.sqrt(model.masses[0] / k)
    assert 0.5 * limit * unit < model.safe_time_step() <= limit * unit
    growth = {}
    for share in (0.95, 1.06, 1.3):
        rng = np.random.default_rng(0)
        x = mesh.vertices + 1e-7 * rng.normal(size=mesh.vertices.shape) * [1, 0, 1]
        v, p, f = (np.zeros_like(x) for _ in range(3))
        settings = motion(model, share * limit * unit, (0, 0, 0))
        integrate.euler_substeps(x, v, p, f, model.arrays, np.zeros(len(x)), settings, NO_GROUND, no_grips(), 0, 400)
        growth[share] = np.abs(x - mesh.vertices).max()
    assert growth[0.95] < 1e-5
    assert not growth[1.06] < 1e-3
    assert not growth[1.3] < 1e-3
    assert 0.4 * np.pi > limit, "[Vassilev 2001, eq. 4] would allow an unstable step"


def test_damping_lowers_the_safe_step_as_derived():
    def model(c):
        return ClothModel(lone(ladder(3, damping=c)))

    plain, damped = model(0.0).safe_time_step(), model(200.0).safe_time_step()
    square = 4.0 / plain**2
    assert damped < plain
    assert square * damped**2 == pytest.approx(4.0 - 2.0 * 200.0 * damped, rel=1e-9)


def test_too_long_a_step_is_refused_with_the_limit():
    scene = cg.scenes.make("hanging_sheet", resolution=8)
    limit = ClothModel(scene).safe_time_step()
    with pytest.raises(ValueError, match="stability limit") as refused:
        cg.Simulation(scene, dataclasses.replace(EULER, substeps=3))
    needed = int(np.ceil(scene.step / limit))
    for part in ("fidelity.substeps = 3", f"{limit:.3g}", f"at least {needed} substeps"):
        assert part in str(refused.value)
    cg.Simulation(scene, dataclasses.replace(EULER, substeps=needed))
    with pytest.raises(ValueError, match=f"substeps = {needed - 1}"):
        cg.Simulation(scene, dataclasses.replace(EULER, substeps=needed - 1))
    chosen = cg.Simulation(scene, EULER).pipeline
    assert chosen.substeps * chosen.dt == pytest.approx(scene.step)
    assert 0.8 * limit < chosen.dt < limit


def test_above_the_limit_a_run_diverges_with_an_error(monkeypatch):
    scene = cg.scenes.make("hanging_sheet", resolution=8)
    limit = ClothModel(scene).safe_time_step()
    monkeypatch.setattr(ClothModel, "safe_time_step", lambda self: np.inf)
    sim = cg.Simulation(scene, dataclasses.replace(EULER, substeps=int(scene.step / (2.5 * limit))))
    with pytest.raises(cg.SimulationError, match="substeps"):
        sim.step(120)
    assert np.isfinite(sim.positions).all() and np.isfinite(sim.velocities).all()


# ---------------------------------------------------------------------------------------------------------------
# velocity modification


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_velocity_modification_equals_naive(relative, seed):
    model, x, v = random_model(seed + 10)
    p, w, _ = euler_kernel(model, x, v, dt=1e-3, limit=0.05, relative=relative)
    springs = model.spring_ends, model.spring_rest
    gravity = np.array([0.0, -G, 0.0])
    _, free = naive.symplectic_euler(x, v, *springs, model.spring_stiffness, model.inverse_masses, gravity, 0.7, 1e-3)
    expected = naive.modify_velocities(x, free, *springs, model.inverse_masses, 0.05, relative)
    assert np.abs(expected - free).max() > 0.1
    assert w == pytest.approx(expected, abs=1e-11)
    assert p == pytest.approx(x + 1e-3 * expected, abs=1e-13)


def test_relative_modification_keeps_momentum_and_literal_does_not():
    change = {}
    for relative in (False, True):
        model, x, v = random_model(3, pins=(), damping=0.0)
        settings = {"dt": 1e-6, "gravity": (0, 0, 0), "relative": relative}
        _, free, _ = euler_kernel(model, x, v, **settings)
        _, after, _ = euler_kernel(model, x, v, limit=0.02, **settings)
        momentum = model.masses @ (after - free)
        moment = (model.masses[:, None] * np.cross(x, after - free)).sum(axis=0)
        energy = model.masses @ (after**2 - free**2).sum(axis=1)
        assert energy < 0.0, "a modification took no energy: it did nothing"
        change[relative] = np.abs(np.r_[momentum, moment]).max()
    assert change[True] < 1e-14
    assert change[False] > 1e-3


def stretched_fall(variant: str, **scene) -> cg.Simulation:
    cloth = ladder(4, top=(), stretched=1.3, stretch=5.0)
    return cg.Simulation(lone(cloth, **scene), dataclasses.replace(EULER, velocity_modification=variant))


def test_an_over_stretched_cloth_falls_freely_with_relative_modification_only():
    drop = {}
    for variant in ("none", "relative", "literal"):
        sim = stretched_fall(variant)
        start = sim.model.masses @ sim.positions / sim.model.masses.sum()
        sim.step(6)
        centre = sim.model.masses @ sim.positions / sim.model.masses.sum()
        n, dt = 6 * sim.pipeline.substeps, sim.pipeline.dt
        drop[variant] = (start - centre)[1] / (0.5 * G * dt * dt * n * (n + 1))
    assert drop["none"] == pytest.approx(1.0, abs=1e-10)
    assert drop["relative"] == pytest.approx(1.0, abs=1e-10)
    assert drop["literal"] < 0.5


def test_a_common_velocity_survives_relative_modification_only():
    for variant, kept in (("relative", 1.0), ("literal", 0.0)):
        sim = stretched_fall(variant, gravity=(0, 0, 0))
        sim.set_velocities(np.tile([0.0, 2.0, 0.0], (10, 1)))
        sim.step()
        mean = sim.model.masses @ sim.velocities / sim.model.masses.sum()
        assert mean == pytest.approx([0.0, 2.0 * kept, 0.0], abs=1e-9)


def test_modification_acts_above_its_threshold_only():
    for threshold, acts in ((0.29, True), (0.31, False)):
        sims = [stretched_fall("none"), stretched_fall("literal")]
        sims[1] = cg.Simulation(sims[1].scene, dataclasses.replace(sims[1].fidelity, stretch_limit=threshold))
        for sim in sims:
            sim.step()
        assert (sims[0].state_hash() != sims[1].state_hash()) == acts


# ---------------------------------------------------------------------------------------------------------------
# XPBD against symplectic Euler


def test_xpbd_converges_to_the_explicit_result():
    scene = cg.scenes.make("hanging_sheet", resolution=8)
    soft = dataclasses.replace(scene.cloths[0].material, stretch=400.0, shear=200.0)
    scene = dataclasses.replace(scene, cloths=[dataclasses.replace(scene.cloths[0], material=soft)])
    reference = cg.Simulation(scene, dataclasses.replace(EULER, substeps=1000))
    reference.step(15)
    errors = []
    for substeps in (16, 64, 256):
        sim = cg.Simulation(scene, cg.Fidelity(substeps=substeps, sweeps=8))
        sim.step(15)
        errors.append(float(np.abs(sim.positions[:, 1] - reference.positions[:, 1]).max()))
    assert np.ptp(reference.positions[:, 1]) > 0.2
    assert errors[2] < 2e-3
    assert errors[2] < 0.5 * errors[1] < 0.25 * errors[0] * 1.5


def test_xpbd_moves_a_free_cloth_without_strain_exactly():
    sim = cg.Simulation(lone(ladder(3, top=())), cg.Fidelity(substeps=5))
    start = sim.positions.copy()
    sim.step(4)
    n, dt = 20, sim.pipeline.dt
    assert sim.positions - start == pytest.approx(
        np.tile([0.0, -0.5 * G * dt * dt * n * (n + 1), 0.0], (len(start), 1)), abs=1e-12
    )


def test_xpbd_keeps_linear_momentum_and_angular_momentum_in_the_limit():
    drift = []
    for substeps in (10, 100):
        scene = lone(ladder(4, top=(), stretched=1.05), gravity=(0, 0, 0))
        sim = cg.Simulation(scene, cg.Fidelity(substeps=substeps, sweeps=4))
        spin = np.cross([0.0, 0.0, 1.0], sim.positions)
        sim.set_velocities(spin + np.array([0.3, -0.2, 0.1]))
        m = sim.model.masses

        def moment(sim=sim, m=m):
            return (m[:, None] * np.cross(sim.positions, sim.velocities)).sum(axis=0)

        momentum, before = m @ sim.velocities, moment()
        sim.step(5)
        assert m @ sim.velocities == pytest.approx(momentum, abs=1e-13)
        drift.append(np.abs(moment() - before).max() / np.abs(before).max())
    assert drift[1] < 1e-2
    assert drift[1] < 0.2 * drift[0]


@pytest.mark.parametrize("damping", [0.5, 8.0])
def test_static_forces_do_not_depend_on_damping(damping):
    """Damping acts on velocities; a cloth at rest must carry its full weight, at any substep."""
    sim = cg.Simulation(lone(ladder(3, damping=damping)), cg.Fidelity(substeps=4, sweeps=16))
    sim.step(700)
    assert sim.metrics()["max_speed"] < 1e-4
    elongation = -np.diff(sim.positions[::2, 1]) - 1.0 / 3
    assert elongation == pytest.approx((3 - np.arange(3)) * sim.model.masses[0] * G / 50.0, rel=3e-3)


# ---------------------------------------------------------------------------------------------------------------
# damping and pins


@pytest.mark.parametrize("integrator", ["xpbd", "symplectic_euler"])
def test_damping_of_a_moving_cloth(integrator):
    scene = lone(ladder(2, top=(), damping=3.0), gravity=(0, 0, 0))
    sim = cg.Simulation(scene, cg.Fidelity(integrator=integrator, substeps=20))
    sim.set_velocities(np.tile([1.0, 0.5, -2.0], (6, 1)))
    sim.step(6)
    factor = 1.0 / (1.0 + 3.0 * sim.pipeline.dt) if integrator == "xpbd" else 1.0 - 3.0 * sim.pipeline.dt
    assert sim.velocities == pytest.approx(np.tile(np.array([1.0, 0.5, -2.0]) * factor**120, (6, 1)), rel=1e-9)
    assert factor**120 == pytest.approx(np.exp(-0.3), rel=5e-3)


@pytest.mark.parametrize(
    "fidelity", [cg.Fidelity(), EULER, dataclasses.replace(EULER, velocity_modification="literal")]
)
def test_pins_do_not_move(fidelity):
    scene = cg.scenes.make("hanging_sheet", resolution=6)
    scene = dataclasses.replace(scene, wind=(0.0, 3.0, 2.0))
    sim = cg.Simulation(scene, fidelity)
    start = sim.positions[[0, 6]].copy()
    sim.step(10)
    assert (sim.positions[[0, 6]] == start).all()
    assert (sim.velocities[[0, 6]] == 0.0).all()
    assert np.abs(sim.positions - scene.start).max() > 0.02


@pytest.mark.parametrize(
    "fidelity", [cg.Fidelity(), EULER, dataclasses.replace(EULER, velocity_modification="relative")]
)
def test_pins_do_not_move_after_all_velocities_were_set(fidelity):
    sim = cg.Simulation(cg.scenes.make("hanging_sheet", resolution=6), fidelity)
    start = sim.positions[[0, 6]].copy()
    sim.set_velocities(np.full((49, 3), 0.3))
    sim.step(3)
    assert (sim.positions[[0, 6]] == start).all()
