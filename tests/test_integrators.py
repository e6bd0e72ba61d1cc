"""What all integrators share: order in time, the common limit, flight, pins, wind, ground, grippers, contact."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
import trimesh
from ladders import UPRIGHT, ladder, lone, rests_on_the_ground
from ways import ENERGIES, EXACT, GLOBAL, IMPLICIT, RUNGE_KUTTA, WAYS, G, sheet, thrown

import clothgym as cg
from clothgym.stages.implicit_euler import SECOND_ORDER

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
# every energy, every state


@pytest.mark.parametrize("energies", ENERGIES)
def test_integrators_agree_on_every_energy(energies):
    found = [thrown(sheet(), dataclasses.replace(way, substeps=40, **energies)) for way in (RUNGE_KUTTA, EXACT)]
    for sim in found:
        sim.step(10)
    assert found[0].positions == pytest.approx(found[1].positions, abs=2e-3)


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
    way = WAYS[name]
    fidelity = way if way.substeps == 0 else dataclasses.replace(way, substeps=4, tolerance=1e-4)
    rests_on_the_ground(fidelity, self_collision, steps=(90, 30), slowest=1e-4)


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
