"""The benchmark of known answers: the answers against independent numbers, what it measures, and the form of its rows."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

import clothgym as cg
from clothgym.benchmarks import frame, validation
from clothgym.benchmarks.report import json_ready
from clothgym.benchmarks.validation import (
    bending,
    contact,
    drape,
    families,
    flight,
    hanging,
    known,
    measure,
    oscillator,
    shown,
    waves,
)
from clothgym.benchmarks.validation import solvers as solving
from clothgym.fidelity import MEMBRANES
from clothgym.mesh import face_areas
from clothgym.model import ClothModel
from clothgym.scenes import validation as scenes

G = 9.81
SOLVERS = solving.solvers("springs")


def met(result: dict[str, Any]) -> None:
    """Every target of a case is met."""
    missed = [q for q in result["quantities"] if q["met"] is False and "predicted" not in q]
    assert result["quantities"] and not missed, missed


# ---------------------------------------------------------------------------------------------------------------
# known answers


@pytest.mark.parametrize(("angle", "ratio"), [(10, 1.00191), (30, 1.01741), (60, 1.07318), (90, 1.18034)])
def test_pendulum_ratio_is_the_table_and_the_swing(angle, ratio):
    assert known.pendulum_ratio(angle) == pytest.approx(ratio, abs=5e-6)

    def lowest(t, y):
        return y[0]

    lowest.terminal = True
    swing = solve_ivp(lambda t, y: [y[1], -math.sin(y[0])], (0, 10), [math.radians(angle), 0.0], events=lowest,
                      rtol=1e-10, atol=1e-12)  # fmt: skip
    assert 4.0 * swing.t_events[0][0] / (2.0 * math.pi) == pytest.approx(known.pendulum_ratio(angle), rel=1e-7)


def test_chain_frequencies_are_the_eigenvalues_and_tend_to_the_bessel_zeros():
    n = 7
    stiffness = np.zeros((n, n))  # m l w^2 u = K u: tension of the link above mass i is (n - i) m g
    for link in range(n):
        tension = n - link
        stiffness[link, link] += tension
        if link > 0:
            stiffness[link - 1, link - 1] += tension
            stiffness[link, link - 1] -= tension
            stiffness[link - 1, link] -= tension
    expected = np.sqrt(np.linalg.eigvalsh(stiffness) * G * n / 0.8)
    assert [known.chain_frequency(n, k + 1, 0.8, G) for k in range(n)] == pytest.approx(expected.tolist(), rel=1e-10)
    for mode, number in enumerate((1.2024, 2.7600, 4.3269, 5.8958), 1):
        assert known.hanging_chain_frequency(mode, 1.0, 1.0) == pytest.approx(number, abs=6e-5)
        assert known.chain_frequency(200, mode, 1.0, 1.0) == pytest.approx(number, rel=0.01)


@pytest.mark.parametrize(
    ("slack", "sag"), [(1.01, 0.0615), (1.05, 0.1393), (1.1, 0.2003), (1.25, 0.3318), (1.5, 0.5026), (2.0, 0.7964)]
)
def test_catenary_is_the_table_and_a_chain_of_that_length(slack, sag):
    assert known.catenary_sag(slack) == pytest.approx(sag, abs=6e-5)
    # a cosh(x / a) of that sag is as long as said
    a = brentq(lambda a: a * (math.cosh(0.5 / a) - 1.0) - known.catenary_sag(slack), 0.05, 10.0)
    length = quad(lambda x: math.sqrt(1.0 + math.sinh(x / a) ** 2), -0.5, 0.5)[0]
    assert length == pytest.approx(slack, rel=1e-9)


@pytest.mark.parametrize(
    ("load", "depth", "aspect"),
    [(1, 0.12347, 0.12456), (2, 0.23851, 0.24667), (5, 0.49591, 0.58572), (8, 0.64063, 0.88433), (10, 0.70020, 1.06680),
     (20, 0.82988, 1.86393), (50, 0.90792, 3.70556), (100, 0.93752, 5.88811)],
)  # fmt: skip
def test_elastica_is_the_table(load, depth, aspect):
    found = known.elastica(float(load))
    assert found[0] == pytest.approx(depth, abs=6e-6)
    assert found[0] / found[1] == pytest.approx(aspect, abs=2e-5)


def test_elastica_is_what_shooting_finds():
    def free_end(start: float) -> np.ndarray:
        return solve_ivp(
            lambda s, y: [y[1], -8.0 * (1.0 - s) * math.cos(y[0]), math.sin(y[0]), math.cos(y[0])],
            (0.0, 1.0), [0.0, start, 0.0, 0.0], rtol=1e-10, atol=1e-12,
        ).y[:, -1]  # fmt: skip

    end = free_end(brentq(lambda start: free_end(start)[1], 0.5, 6.0, xtol=1e-12))
    assert known.elastica(8.0) == pytest.approx((end[2], end[3]), abs=1e-7)
    assert known.elastica(1e-3)[0] == pytest.approx(1e-3 / 8.0, rel=1e-4)


def test_growth_factors_are_those_of_one_step():
    phase = 0.3
    matrix = np.array([[1.0 - phase**2, phase], [-phase, 1.0]])  # of (x, v / w): v' = v - w^2 dt x, x' = x + dt v'
    factors = np.linalg.eigvals(matrix)
    found = known.growth("symplectic_euler", phase)
    assert min(abs(factors - found)) < 1e-12 and abs(found) == pytest.approx(1.0)
    low, high = known.symplectic_energy_range(phase)
    state, energies = np.array([1.0, 0.0]), []
    for _ in range(3000):
        state = matrix @ state
        energies.append(state @ state)
    assert (min(energies), max(energies)) == pytest.approx((low, high), rel=1e-4)
    for method in ("xpbd", "implicit_euler", "implicit_euler:2", "runge_kutta"):
        p = known.order(method)
        errors = [abs(known.growth(method, h) - np.exp(1j * h)) for h in (0.02, 0.01)]
        assert math.log2(errors[0] / errors[1]) == pytest.approx(p + 1, abs=0.05)
    assert abs(known.growth("xpbd", phase)) ** 2 == pytest.approx(1.0 / (1.0 + phase**2))
    assert known.order("implicit_euler:2+continuum") == 2 and known.order("xpbd:float32") == 1


def test_lattice_modulus_is_the_energy_of_one_cell():
    k, kd, a = 3.0, 0.7, 0.2
    springs = [(k, (a, 0)), (k, (0, a)), (kd, (a, a)), (kd, (a, -a))]
    for angle in (0, 20, 45, 90):
        d = np.array([math.cos(math.radians(angle)), math.sin(math.radians(angle))])
        energy = sum(0.5 * c * ((np.array(r) @ d) ** 2 / np.hypot(*r)) ** 2 for c, r in springs)
        assert known.lattice_modulus(k, kd, angle) == pytest.approx(2.0 * energy / a**2, rel=1e-12)
    assert known.lattice_modulus(2.0, 1.0, 45) == known.lattice_modulus(2.0, 1.0, 0)
    assert known.orthotropic_modulus(4.0, 4.0, 2.0, 30) == pytest.approx(4.0)


def test_column_catenary_and_waves_agree_with_each_other():
    stretched = known.column_elongations(np.full(5, 0.2), 8.0, G)
    assert stretched == pytest.approx([0.2 * G / 8.0 * (5 - i) for i in range(5)])
    assert stretched.sum() == pytest.approx(0.2 * G * 5 * 6 / (2 * 8.0))
    # long waves: sqrt(k / m) a per second; a fine lattice is a membrane
    assert known.spring_wave(9.0, 4.0, 1e-3) == pytest.approx(1.5e-3, rel=1e-6)
    n, tension, density = 200, 3.0, 0.2
    fine = known.lattice_membrane_frequency(tension, density / n**2, (math.pi / n, 2.0 * math.pi / n))
    assert fine == pytest.approx(known.membrane_frequency(tension, density, (1, 2), (1.0, 1.0)), rel=1e-3)


def test_creep_and_slides():
    v, c, dt = 0.0, 0.9, 0.01
    for _ in range(400):
        v = c * (v + G * dt * math.sin(math.radians(10)))
    assert known.creep_speed(c, 10, dt, G) == pytest.approx(v, rel=1e-12)
    assert known.slide_distance(10, 0.3, 1.0, G) == 0.0
    assert known.slide_distance(90, 0.3, 2.0, G) == pytest.approx(2.0 * G)


def test_capstan_is_eulers_but_for_the_weight_on_the_cylinder():
    assert known.capstan_ratio(0.3, 1e-9, 0.3) == pytest.approx(math.exp(0.3 * math.pi), rel=1e-8)
    # T' - mu T = w R (mu cos - sin) has an exponential and one particular solution
    mu, radius, length = 0.4, 0.05, 0.2
    # particular: R (a cos + b sin)
    a, b = (1.0 - mu * mu) / (1.0 + mu * mu), 2.0 * mu / (1.0 + mu * mu)
    assert b - mu * a == pytest.approx(mu) and -a - mu * b == pytest.approx(-1.0)
    start = (length + radius * b) * math.exp(mu * math.pi)
    assert known.capstan_ratio(mu, radius, length) == pytest.approx((start + radius * b) / length, rel=1e-7)


# ---------------------------------------------------------------------------------------------------------------
# measuring


def test_measures():
    t = np.arange(0.0, 5.0, 0.01)
    assert measure.period(np.cos(2.0 * math.pi * t / 1.3), 0.01) == pytest.approx(1.3, rel=1e-5)
    assert measure.period(np.ones(10), 0.1) is None
    assert measure.order([1.0, 0.5, 0.25], [3.0, 0.75, 0.1875]) == pytest.approx(2.0)
    assert measure.order([1.0, 0.5], [0.0, 1.0]) is None
    assert measure.quantity("q", 1.02, 1.0, 0.01)["met"] is False
    assert measure.quantity("q", 1.02, 1.0, 0.03)["met"] is True
    assert measure.quantity("q", 1.02, 1.0)["met"] is None
    assert measure.quantity("q", None, 1.0, 0.5)["met"] is False
    assert measure.quantity("q", 0.02, 0.0, 0.01, absolute=True)["error"] == 0.02


@pytest.mark.parametrize("name", sorted(scenes.MAKERS))
def test_scenes_start_as_said(name):
    scene = cg.scenes.make(name)
    cloth = scene.cloths[0]
    edges = cg.Surface(cloth.mesh.faces).edges
    now, rest = (np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) for x in (cloth.mesh.vertices, cloth.rest))
    assert np.abs(now / rest - 1.0).max() < 2e-3
    for body in scene.bodies:
        assert not body.notes, "closed, and faces counter-clockwise from outside"
        distance = cg.Simulation(scene, "draft").body_mesh.signed_distance(scene.start)
        assert distance.min() == pytest.approx(scenes.CLEARANCE + (0.1 if name == "bounce" else 0.0), abs=2e-5)


@pytest.mark.parametrize("grain", ["0", "45", "90"])
def test_cantilevers_of_every_grain_are_the_same_strip(grain):
    cloth = cg.scenes.make("cantilever", rows=8, columns=2, grain=grain).cloths[0]
    row = 0.2 / 7.5
    across = 4 * row if grain == "45" else 2 * row  # of half diagonals, of sides
    assert np.ptp(cloth.mesh.vertices, axis=0) == pytest.approx([across, 0.0, 8 * row])
    surface = cg.Surface(cloth.mesh.faces)
    assert surface.edge_face_count.max() == 2 and len(np.unique(surface.components)) == 1
    areas = face_areas(cloth.rest, cloth.mesh.faces)
    assert areas.sum() == pytest.approx(np.prod(np.ptp(cloth.mesh.vertices, axis=0)[[0, 2]]))
    # edges lie along weft and warp of the rest shape, or halfway between
    edges = surface.edges
    sides = np.abs(cloth.rest[edges[:, 1]] - cloth.rest[edges[:, 0]])[:, [0, 2]]
    assert ((sides.min(axis=1) < 1e-9) | (np.abs(sides[:, 0] - sides[:, 1]) < 1e-9)).all()
    model = ClothModel(cg.scenes.make("cantilever", rows=8, columns=2, grain=grain))
    assert set(model.spring_ends.ravel().tolist()) == set(range(model.vertex_count)), "a vertex that no spring holds"


def test_shadow_and_nodes():
    mesh = cg.grid(0.2, 0.1, 3, 2)
    assert drape.shadow(mesh.vertices, mesh.faces) == pytest.approx(0.02, rel=0.02)
    folded = mesh.vertices.copy()
    folded[:, 0] = np.abs(folded[:, 0])  # both halves throw one shadow
    assert drape.shadow(folded, mesh.faces) < 0.0125
    turn = np.linspace(0.0, 2.0 * math.pi, 90, endpoint=False)
    radius = 0.12 + 0.01 * np.cos(7 * turn)
    ring = np.stack([radius * np.cos(turn), 0 * turn, radius * np.sin(turn)], axis=1)
    assert drape.nodes(ring, np.arange(90)) == 7


@pytest.mark.parametrize("solver", SOLVERS)
def test_small_cases_meet_their_targets(solver):
    met(oscillator.pendulum(solver, 60))
    met(oscillator.chain(solver, 1, 6))
    met(hanging.column(solver, 5))
    met(waves.wave(solver, 4))
    met(contact.incline(solver, "ground", 1))


def test_eq_12_creeps_and_bounces_as_predicted():
    crept = contact.creep("xpbd", 0.9)
    met(crept)
    assert [q["met"] for q in crept["quantities"] if "predicted" in q] == [False]
    met(contact.bounce("xpbd", 0.5))


def test_flexion_springs_have_no_bending_stiffness_when_flat():
    found = bending.moment("flexion", 24)
    met(found)
    assert found["quantities"][-1]["measured"] == pytest.approx(3.0, abs=0.01)


@pytest.mark.parametrize("kind", bending.STIFF)
def test_bending_rigidity_is_the_materials(kind):
    met(bending.moment(kind, 24))


def test_flying_sheet_keeps_what_symplectic_euler_keeps():
    found = flight.flight("symplectic_euler", 1)
    met(found)
    assert len(found["order"]["gaps"]) == len(found["order"]["steps"]) - 1
    met(flight.invariance("symplectic_euler", 1))
    for membrane in MEMBRANES:
        met(flight.stretch(membrane, 6))


def test_what_a_solver_does_not_do_is_told_not_faked():
    asked = {
        "family": "cantilever",
        "solver": "xpbd",
        "bending": "origami",
        "load": 1,
        "rows": 6,
        "columns": 1,
        "grain": "0",
    }
    found = families.run(asked)
    assert not found["available"] and found["quantities"] == []
    assert "origami" in found["reason"]


# ---------------------------------------------------------------------------------------------------------------
# the benchmark


@pytest.mark.parametrize("quick", [True, False])
def test_cases_ask_every_solver_and_family(quick):
    listed = validation.benchmark.cases(quick)
    assert len({case.key for case in listed}) == len(listed)
    asked = {(case.parameters["family"], case.parameters.get("solver")) for case in listed}
    for solver in solving.solvers():
        assert {("pendulum", solver), ("column", solver), ("catenary", solver), ("flight", solver)} <= asked
    for solver in solving.solvers("springs" if quick else None):
        assert {("incline", solver), ("creep", solver), ("bounce", solver), ("wave", solver)} <= asked
    assert {family for family, _ in asked} <= set(families.FAMILIES)
    if not quick:
        assert {case.parameters["load"] for case in listed if case.parameters["family"] == "cantilever"} >= {1, 10, 100}
        assert {case.parameters["angle"] for case in listed if case.parameters["family"] == "pendulum"} == {
            10,
            30,
            60,
            90,
        }
    json.dumps(json_ready([case.parameters for case in listed]), allow_nan=False)


def _few(quick: bool) -> list[frame.Case]:
    chosen = ("oscillator/", "pendulum/90", "catenary/1.25/", "moment/flexion", "stretch/springs", "creep/")
    listed = [case for case in families.cases(True) if case.key.startswith(chosen)]
    return [case for case in listed if case.parameters.get("solver", "xpbd") in ("xpbd", "symplectic_euler")]


def test_rows_tables_plots_and_page_come_out_of_the_frame(tmp_path: Path):
    small = dataclasses.replace(validation.benchmark, cases=_few, prepare=None)
    outcome = frame.run_benchmark(small, tmp_path, quick=True)
    assert outcome.error_count == 0 and len(outcome.rows) == len(_few(True))
    for row in outcome.rows:
        for q in row["result"]["quantities"]:
            assert set(q) - {"predicted"} == {"name", "measured", "known", "error", "target", "met"}
    titles = [table.title for table in outcome.tables]
    assert titles[:2] == ["Known answers, by solver", "Order of convergence in the time step"]
    assert any(title.startswith("V2") for title in titles)
    summary = {cells[0]: cells for cells in outcome.tables[0].rows}
    assert set(summary) == {"xpbd", "symplectic_euler", "flexion", "springs"}
    assert all(cells[1] == cells[2] > 0 for cells in summary.values()), "a target is missed"
    creep = next(table for table in outcome.tables if "eq. 12" in table.title)
    assert [cells[-1] for cells in creep.rows].count("fails as predicted") == 2
    page = outcome.page.read_text()
    assert page.count("<img") == 2 or "No plots" in page


def _row(family: str, measured: float, target: float, **parameters: Any) -> dict[str, Any]:
    settings = {"family": family, "solver": "xpbd", **parameters}
    key = "validation/quick/" + "/".join(str(v) for v in settings.values())
    quantities = [measure.quantity("H / L", measured, 1.0, target), measure.quantity("H / W", measured, 1.0, target)]
    result = {"available": True, "reason": "", "quantities": quantities}
    return {"key": key, "parameters": settings, "result": result}


def test_tables_tell_what_is_missed_and_what_is_lacking():
    cantilever = {"bending": "hinge", "load": 10}
    rows = [_row("cantilever", 1.0 + 0.3 / n, 0.01, rows=n, columns=2, grain="0", **cantilever) for n in (8, 16, 32)]
    turned = (("0", 1.0), ("45", 1.1), ("90", 1.2))
    rows += [_row("cantilever", h, 0.01, rows=32, columns=6, grain=grain, **cantilever) for grain, h in turned]
    lacking = _row("drape", 1.0, 0.1, bending="hinge")
    lacking["result"] = {"available": False, "reason": "bending = 'hinge': not with this", "quantities": []}
    found = {table.title: table for table in shown.tables([*rows, lacking])}
    summary = found["Known answers, by solver"].rows[0]
    assert summary[:3] == ("xpbd, hinge", 12, 4) and "H / L" in summary[4] and "more" in summary[4]
    assert found["Refinement"].rows[0][-1] == pytest.approx(1.0)
    assert found["Anisotropy"].rows[0][2:] == pytest.approx((1.0, 1.1, 1.2, 1.1))
    assert found["Not available"].rows == [("drape/xpbd/hinge", "bending = 'hinge': not with this")]
