"""Runs of sheets with the check for height fields and without: not a bit may differ."""

from __future__ import annotations

import copy
import dataclasses

import naive_mechanics
import numpy as np
import pytest
import trimesh

import clothgym as cg


def sheet(**changes):
    scene = cg.scenes.make("hanging_sheet", resolution=10)
    cloth = scene.cloths[0]
    material = dataclasses.replace(cloth.material, **changes)
    return dataclasses.replace(scene, cloths=(dataclasses.replace(cloth, material=material),), self_collision=True)


def wide(**changes):
    """Enough cells for the springs to stand in runs."""
    scene = cg.scenes.make("hanging_sheet", resolution=16)
    return dataclasses.replace(scene, self_collision=True, **changes)


def thrown():
    """A wide sheet that falls on the ground and crumples there."""
    return cg.scenes.make("drop", resolution=16, height=0.1)


def held():
    return dataclasses.replace(sheet(), grips=(cg.Grip(radius=0.15),), wind=(3.0, 1.0, 2.0))


def above_ball():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    mesh = cg.grid(0.5, 0.5, 8, 8).transformed(translation=(0.02, 0.23, 0.01))
    return cg.Scene([cg.Cloth(mesh)], bodies=[cg.Body(ball)], ground=-0.3)


def two_apart():
    mesh = cg.grid(0.3, 0.3, 4, 4)
    return cg.Scene(
        [cg.Cloth(mesh), cg.Cloth(mesh.transformed(translation=(0.05, 0.2, 0.02)), name="other")], ground=-0.05
    )


EULER = dataclasses.replace(cg.Fidelity(), integrator="symplectic_euler", substeps=0, map_size=60)
XPBD = cg.Fidelity(map_size=60)
RUNS = {
    "sheet": (sheet, XPBD, 30, 30),
    "wide": (wide, XPBD, 30, 30),
    "wide, wind and grippers": (lambda: wide(grips=(cg.Grip(radius=0.15),), wind=(3.0, 1.0, 2.0)), XPBD, 25, 20),
    "wide, thrown": (thrown, XPBD, 25, 3),
    "wide, three sweeps": (wide, dataclasses.replace(XPBD, substeps=12, sweeps=3), 20, 15),
    "limp": (lambda: sheet(stretch=100.0, shear=10.0, thickness=0.02), XPBD, 30, 20),
    "long steps": (lambda: dataclasses.replace(sheet(stretch=300.0), step=0.05), XPBD, 15, 10),
    "euler": (sheet, EULER, 6, 6),
    "wind and grippers": (held, XPBD, 15, 10),
    "ball": (above_ball, XPBD, 12, 3),
    "ball, euler": (above_ball, dataclasses.replace(EULER, untangling="none"), 3, 3),
    "two": (two_apart, XPBD, 20, 3),
    "drop": (lambda: cg.scenes.make("drop", resolution=8, height=0.1), XPBD, 30, 5),
    "layers": (lambda: cg.scenes.make("layers", vertices=7), XPBD, 4, 0),
    "squares": (lambda: cg.scenes.make("squares", count=3), XPBD, 6, 0),
    "no stage for hits": (sheet, dataclasses.replace(XPBD, untangling="none", contacts_near_hits="keep"), 10, 10),
}
"""Scene, fidelity, steps, and how many of them at least are decided."""


@pytest.mark.parametrize("name", RUNS)
def test_the_check_changes_no_bit(name):
    """Where nothing can touch, the search finds no contact: state hashes are equal after every step."""
    make, fidelity, steps, least = RUNS[name]
    one, two = (cg.Simulation(make(), dataclasses.replace(fidelity, flat_check=flag)) for flag in (True, False))
    for sim in (one, two):
        if "grippers" in name:
            sim.place_grip(0, sim.positions[-1])
            sim.grasp(0)
            sim.move_grip(0, (0.1, 0.3, -0.2))
    decided = 0
    for step in range(steps):
        one.step()
        two.step()
        assert one.state_hash() == two.state_hash(), f"after step {step}, {decided} decided"
        decided = one.metrics()["work"].get("decided_flat", 0)
    assert decided >= least
    assert "decided_flat" not in two.metrics()["work"]


@pytest.mark.parametrize("name", ["wide", "wide, wind and grippers", "wide, three sweeps"])
def test_a_sheet_that_cannot_touch_itself_moves_like_one_that_may_not(name):
    make, fidelity, steps, _ = RUNS[name]
    one = cg.Simulation(make(), fidelity)
    effort = {"substeps": one.pipeline.substeps, "sweeps": one.pipeline.stages[-1].step.sweeps}
    two = cg.Simulation(dataclasses.replace(make(), self_collision=False), dataclasses.replace(fidelity, **effort))
    for sim in (one, two):
        if "grippers" in name:
            sim.place_grip(0, sim.positions[-1])
            sim.grasp(0)
            sim.move_grip(0, (0.1, 0.3, -0.2))
    for _ in range(steps):
        decided = one.metrics()["work"].get("decided_flat", 0)
        one.step()
        two.step()
        if one.metrics()["work"].get("decided_flat", 0) == decided:
            break
        assert (one.positions == two.positions).all() and (one.velocities == two.velocities).all()
        assert (one.grip_forces == two.grip_forces).all()
    assert one.step_count > 10


def _both_ways(sim, start, velocities, first, **changes):
    """Substeps from `first` on, in slots and with a look at every substep: the one that is left must be the same, and all
    bits before it; returns how many were made, and whether the slots could take the last one back."""
    from clothgym.kernels import height_field, spring_runs

    stage, frame = sim.pipeline.stages[-1], sim._frame
    step, found, runs = stage.step, stage.candidates, stage.step.integrator.runs
    motion, count, results = step.motion(frame)._replace(**changes), step.substeps, []
    for way in range(3):
        x, v = start.copy(), velocities.copy()
        frame.set_grips()
        if way == 0:
            _, known = spring_runs._along(
                x, v, runs.space, runs.arrays, step.radii, motion, step.ground, frame.grips, first, count, stage.course,
                first, count,
            )  # fmt: skip
            continue
        if way == 1:
            done = runs.step_along(
                x, v, step.radii, motion, step.ground, frame.grips, first, count, stage.course, first, count
            )
        else:
            done = height_field.xpbd_substeps(
                x, v, frame.predicted, stage.kept, sim.model.arrays, step.radii, motion, step.ground, frame.grips,
                step.integrator.multipliers, first, count, first, count, found.sheets.sheets, found.sheets.tube,
                step.integrator.spring_runs,
            )  # fmt: skip
        results.append((done, x, v, frame.grips.forces.copy()))
    (done, x, v, forces), (expected, *others) = results
    assert done == expected
    # a substep that was made leaves pinned vertices without speed
    assert (x == others[0]).all() and (v == others[1]).all() and (forces == others[2]).all()
    return done - first, known


@pytest.mark.parametrize("seed", range(6))
def test_slots_are_left_where_a_look_at_every_substep_leaves_them(seed):
    """Which substep is the first to leave the course, and the state before it, do not depend on how rarely one looks."""
    rng = np.random.default_rng(seed)
    sim = cg.Simulation(wide(grips=(cg.Grip(radius=0.15),), ground=-0.01), XPBD)
    sim.place_grip(0, sim.positions[40])
    sim.grasp(0)
    sim.move_grip(0, (0.1, 0.3, -0.2))
    step, found = sim.pipeline.stages[-1].step, sim.pipeline.stages[-1].candidates
    count = step.substeps
    start = sim.positions + np.array([0.0, 0.005, 0.0])
    ended = []
    for wild in np.geomspace(0.01, 30.0, 24):
        velocities = rng.normal(0.0, wild, start.shape) + rng.normal(0.0, 3.0, 3)
        first = int(rng.integers(0, count // 2))
        if not found.settle(start, step.dt * count * velocities * rng.uniform(0.0, 1.0), count):
            continue
        made, taken_back = _both_ways(sim, start, velocities, first)
        assert taken_back or made == 0
        ended.append(made / (count - first))
    assert min(ended) < 0.2 and max(ended) == 1.0 and any(0.2 < share < 1.0 for share in ended)


@pytest.mark.parametrize("seed", range(4))
def test_a_substep_that_leaves_the_course_out_of_the_blue_is_not_made(seed):
    """Damping below zero makes every move many times the last one: no positions were kept, what is left is made once more."""
    rng = np.random.default_rng(seed)
    sim = cg.Simulation(wide(grips=(cg.Grip(radius=0.15),)), XPBD)
    sim.place_grip(0, sim.positions[40])
    sim.grasp(0)
    step, found = sim.pipeline.stages[-1].step, sim.pipeline.stages[-1].candidates
    made_again = 0
    for first in range(6):
        velocities = rng.normal(0.0, 1e-9 * 10.0**first, sim.positions.shape)
        assert found.settle(sim.positions, 0.0 * velocities, step.substeps)
        made, taken_back = _both_ways(sim, sim.positions, velocities, first, damping=-0.98 / step.dt)
        assert made < step.substeps - first
        made_again += made > 0 and not taken_back
    assert made_again > 2


def test_a_vertex_that_is_nowhere_ends_the_course():
    sim = cg.Simulation(wide(), XPBD)
    stage, frame = sim.pipeline.stages[-1], sim._frame
    step, found = stage.step, stage.candidates
    x, v = sim.positions.copy(), sim.velocities.copy()
    assert found.settle(x, v, step.substeps)
    for bad in (np.nan, np.inf, -np.inf):
        for where in (20, 100, len(x) - 1):
            x, v = sim.positions.copy(), sim.velocities.copy()
            v[where, 0] = bad
            done = step.integrator.runs.step_along(
                x, v, step.radii, step.motion(frame), step.ground, frame.grips, 0, step.substeps, stage.course, 0,
                step.substeps,
            )  # fmt: skip
            assert done < step.substeps


@pytest.mark.parametrize("name", ["drop", "wide, thrown"])
def test_runs_meet_every_way_out(name):
    """Contacts after a decided step, a tube that is left within a step, and a step that is decided as a whole."""
    sim = cg.Simulation(RUNS[name][0](), XPBD)
    left = whole = searched = 0
    for _ in range(25):
        before = dict(sim.metrics()["work"])
        sim.step()
        after = sim.metrics()["work"]
        gained = {name: after[name] - before.get(name, 0) for name in after}
        flat, again = gained.get("decided_flat", 0) > 0, gained.get("rebuilds", 0) > 0
        whole += flat and not again
        left += flat and again
        searched += not flat
    assert whole and left and searched


@pytest.mark.parametrize("seed", range(4))
def test_no_step_of_a_violent_run_crosses(seed):
    """Sheets thrown about and wrung, one substep a step: the straight way of every decided one is free of collisions."""
    rng = np.random.default_rng(seed)
    mesh = cg.grid(0.3, 0.3, 4, 3)
    material = cg.Material(stretch=100.0, shear=5.0, damping=0.0)
    cloths = [cg.Cloth(mesh.transformed(translation=(0, 0.1 * k, 0)), material, name=f"sheet {k}") for k in range(2)]
    sim = cg.Simulation(cg.Scene(cloths, step=0.005), dataclasses.replace(XPBD, substeps=1, untangling="none"))
    quads = naive_mechanics.all_quads(sim.model.faces)
    decided = 0
    for round_ in range(12):
        common = np.repeat(rng.normal(0, 5, (2, 3)), len(mesh.vertices), axis=0)
        sim.reset()
        sim.set_velocities(common + rng.normal(0, [0.5, 2.0, 6.0][round_ % 3], sim.positions.shape))
        for _ in range(5):
            x, before = sim.positions.copy(), sim.metrics()["work"].get("rebuilds", 0)
            flat = sim.metrics()["work"].get("decided_flat", 0)
            sim.step()
            work = sim.metrics()["work"]
            if work.get("decided_flat", 0) > flat and work.get("rebuilds", 0) == before:
                decided += 1
                assert naive_mechanics.collisions(x, sim.positions, sim.model.faces, quads=quads) == []
    assert 5 < decided < 60


def test_a_decided_step_searches_nothing():
    sim = cg.Simulation(sheet(), XPBD)
    tree = sim.pipeline.stages[0].candidates.tree
    sim.step(3)
    assert tree.box_tests == 0
    work = sim.metrics()["work"]
    assert (
        work["decided_flat"] == 3
        and work["box_pairs"] == work["primitive_pairs"] == work["hits"] == work["contacts"] == 0
    )


def test_a_decision_lasts_for_several_steps_and_ends_with_a_jump(monkeypatch):
    """Every substep keeps to what was decided, so no step looks again; the first after a jump must not trust it."""
    sim = cg.Simulation(sheet(), XPBD)
    other = cg.Simulation(sheet(), dataclasses.replace(XPBD, flat_check=False))
    sheets = sim.pipeline.stages[0].candidates.sheets
    decisions, decide = [], sheets.decide
    monkeypatch.setattr(sheets, "decide", lambda *args: decisions.append(sim.step_count) or decide(*args))
    for run in (sim, other):
        run.step(12)
    assert sim.metrics()["work"]["decided_flat"] == 12 and 0 < len(decisions) <= 4
    assert sim.state_hash() == other.state_hash()
    flat = sim.positions.copy()
    folded = np.where(flat[:, 2:] > flat[:, 2].mean(), 2 * flat.mean(axis=0) - flat + [0, 0.03, 0], flat)
    for run in (sim, other):
        run.set_positions(folded)
        run.step()
    assert sim.metrics()["work"]["decided_flat"] == 12 and decisions[-1] == 12
    assert sim.state_hash() == other.state_hash()


def _sheet_that_moves():
    """A wide sheet some steps on: what was decided for it lasts for more of them."""
    sim = cg.Simulation(wide(grips=(cg.Grip(radius=0.15),)), XPBD)
    sim.step(4)
    return sim


def _shifted(sim):
    sim.set_positions(sim.positions + np.array([0.0, 0.001, 0.0]))


def _put_back(sim):
    early = sim.snapshot()
    sim.step()
    sim.restore(early)


def _failed(sim):
    """A stage raises in the middle of a step."""
    stage = sim.pipeline.stages[-1]
    stage.step.motion, motion = None, stage.step.motion
    with pytest.raises(TypeError):
        sim.step()
    stage.step.motion = motion


def _diverged(sim):
    """A step comes to nothing, and the state is that before it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("clothgym.stages.frame.SPEED_CAP", 1e-3)
        with pytest.raises(cg.SimulationError):
            sim.step()


MOVES = {
    "set_positions": _shifted,
    "reset": lambda sim: sim.reset(),
    "restore": _put_back,
    "a step that fails": _failed,
    "a step that diverges": _diverged,
    "add and remove": lambda sim: (
        sim.add(cg.Cloth(cg.grid(0.2, 0.2, 2, 2).transformed(translation=(0.0, 5.0, 0.0)), name="far")),
        sim.remove("far"),
    ),
}
"""All that can move vertices between two steps, or take back where they went; a copy is made anew as a whole."""


@pytest.mark.parametrize("name", MOVES)
def test_all_that_moves_vertices_between_steps_is_noticed(name):
    """A step does not look where it begins: whoever moves vertices has to say so, and the next step decides anew."""
    sim = _sheet_that_moves()
    found = sim.pipeline.stages[-1].candidates
    assert found.lasts(sim.pipeline.substeps)
    MOVES[name](sim)
    found = sim.pipeline.stages[-1].candidates
    assert not found.lasts(sim.pipeline.substeps) and not found.flat
    # from here on like one that began with this state, and like one that never decides
    others = [cg.Simulation(sim.scene, dataclasses.replace(XPBD, flat_check=flag)) for flag in (True, False)]
    for other in others:
        other.restore(sim.snapshot())
    for _ in range(3):
        for run in (sim, *others):
            run.step()
        assert {run.state_hash() for run in (sim, *others)} == {sim.state_hash()}


def test_grippers_and_speeds_leave_a_decision_as_it_is():
    """They move nothing between steps; where they take vertices is looked at in the substeps."""
    sim = _sheet_that_moves()
    other = cg.Simulation(sim.scene, dataclasses.replace(XPBD, flat_check=False))
    other.restore(sim.snapshot())
    for run in (sim, other):
        run.place_grip(0, run.positions[-1])
        run.grasp(0)
        run.move_grip(0, (-1.5, 0.5, -1.0))
        run.set_velocities(1.5 * run.velocities)
    assert sim.pipeline.stages[-1].candidates.lasts(sim.pipeline.substeps)
    for _ in range(12):
        for run in (sim, other):
            run.step()
        assert sim.state_hash() == other.state_hash()
    work = sim.metrics()["work"]
    assert work.get("rebuilds", 0) > 0 or work["decided_flat"] < 16, "the gripper led nothing astray"


def test_only_steps_that_begin_calm_leave_out_the_stages_of_pairs():
    """Called: in the first decided step after one that was not, and whenever pairs are searched."""
    sim = cg.Simulation(thrown(), XPBD)
    passed = sim.pipeline.stages[1:-1]
    assert all(stage.of_pairs for stage in passed) and len(passed) == 2
    left_out = kept = 0
    before_was_whole = False
    for _ in range(25):
        calls = [sim.profile[stage.name][0] for stage in passed]
        work = dict(sim.metrics()["work"])
        sim.step()
        gained = [sim.profile[stage.name][0] - n for stage, n in zip(passed, calls, strict=True)]
        decided = sim.metrics()["work"].get("decided_flat", 0) > work.get("decided_flat", 0)
        expected = 0 if decided and before_was_whole else 1
        assert gained == [expected] * 2
        left_out, kept = left_out + (expected == 0), kept + (expected == 1)
        before_was_whole = decided and sim.pipeline.stages[-1].candidates.flat
    assert left_out > 2 and kept > 2


@pytest.mark.parametrize("substeps", [1, 24])
def test_a_decision_after_corrections_does_not_leave_out_what_they_marked(substeps, monkeypatch):
    """What is untangled may be a height field for the rest of the step: its marks are cleared in the next one all the same."""
    sim = cg.Simulation(wide(), dataclasses.replace(XPBD, substeps=substeps))
    pairs, untangle = sim.pipeline.stages[:2]
    found, settle, run = pairs.candidates, pairs.candidates.settle, untangle.run
    seen = []

    def untangled(frame):
        """As if it had corrected something, and marked where."""
        run(frame)
        if not found.flat:
            untangle.apart[:] = True
            monkeypatch.setattr(found, "settle", settle)
            pairs.look(frame, pairs.short)
        seen.append((sim.step_count, found.flat, bool(untangle.apart.any())))

    monkeypatch.setattr(found, "settle", lambda *args: False)
    monkeypatch.setattr(untangle, "run", untangled)
    sim.step(4)
    assert seen[:2] == [(0, True, True), (1, True, False)] and sim.metrics()["work"]["decided_flat"] >= 4
    assert [step for step, _, _ in seen] == [0, 1], "left out while nothing can touch"


def test_no_decision_survives():
    """After reset, restore, a copy and a jump of the positions, everything is decided anew."""
    sim = cg.Simulation(RUNS["long steps"][0](), XPBD)
    fresh = cg.Simulation(RUNS["long steps"][0](), XPBD)
    sim.step(7)
    early = sim.snapshot()
    sim.step(5)
    late = sim.state_hash()
    sim.restore(early)
    twin = copy.deepcopy(sim)
    sim.step(5)
    twin.step(5)
    assert sim.state_hash() == twin.state_hash() == late
    sim.reset()
    sim.step(12)
    fresh.step(12)
    assert sim.state_hash() == fresh.state_hash() == late
    flat = sim.scene.start
    folded = np.where(flat[:, 2:] > 0, flat * [1, 1, -1] + [0, 0.05, 0], flat)
    other = cg.Simulation(sim.scene, dataclasses.replace(XPBD, flat_check=False))
    for run in (sim, other):
        run.reset()
        run.set_positions(folded)
        run.step(3)
    assert sim.state_hash() == other.state_hash()
    assert "decided_flat" not in sim.metrics()["work"]


def test_the_switch():
    assert cg.Fidelity().flat_check and not cg.Fidelity.from_json(cg.Fidelity(flat_check=False).to_json()).flat_check
    with pytest.raises(ValueError, match=r"fidelity\.flat_check = 1: expected True or False"):
        cg.Fidelity(flat_check=1)
    for fidelity in (cg.Fidelity(flat_check=False), cg.Fidelity(detection="brute_force")):
        assert cg.Simulation(sheet(), fidelity).pipeline.stages[0].candidates.sheets is None
