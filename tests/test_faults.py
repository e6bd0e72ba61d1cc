"""Detection that ignores half of what it should find: one mask a step, honoured by contact and by untangling."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import clothgym as cg
from clothgym.detection.faults import Faults

DRAFT = dataclasses.replace(cg.Fidelity.preset("draft"), substeps=2)


def test_the_mask_is_a_hash_of_vertices_and_step():
    rng = np.random.default_rng(0)
    quads = rng.integers(0, 5000, (20_000, 4)).astype(np.int32)
    faults = Faults(0.5)
    faults.step = 7
    seen = faults.seen(quads)
    assert abs(seen.mean() - 0.5) < 0.02
    assert np.array_equal(seen, Faults_at(7).seen(quads))
    assert np.array_equal(seen, faults.seen(quads[:, ::-1].copy())), "the order of the vertices must not matter"
    other = Faults_at(8).seen(quads)
    assert abs((seen == other).mean() - 0.5) < 0.02, "another step ignores others, whatever it ignored before"
    assert abs(Faults_at(7, 0.1).seen(quads).mean() - 0.9) < 0.01
    assert Faults_at(7, 0.0).seen(quads).all()
    assert not Faults_at(7, 1.0).seen(quads).any()


def Faults_at(step: int, share: float = 0.5) -> Faults:
    faults = Faults(share)
    faults.step = step
    return faults


def test_a_scene_without_faults_has_no_stage_for_them():
    clean = cg.Simulation(cg.scenes.make("pile", count=2), DRAFT)
    assert not any(stage.name.startswith("ignore") for stage in clean.pipeline.stages)
    faulty = cg.Simulation(dataclasses.replace(cg.scenes.make("pile", count=2), ignored=0.5), DRAFT)
    assert faulty.pipeline.stages[0].name == "ignore [50 % of pairs]"
    with pytest.raises(ValueError, match=r"scene\.ignored = 1\.5"):
        dataclasses.replace(cg.scenes.make("pile", count=2), ignored=1.5)


def test_what_is_ignored_goes_through_and_is_measured_all_the_same():
    """All contacts ignored: the sheets fall through each other. The metrics see every hit."""
    scene = cg.scenes.make("pile", count=3, gap=0.005)
    blind = cg.Simulation(dataclasses.replace(scene, ignored=1.0), DRAFT)
    sound = cg.Simulation(scene, DRAFT)
    most = 0
    for _ in range(30):
        blind.step()
        sound.step()
        most = max(most, blind.last_intersections.hit_count)
        assert sound.last_intersections.hit_count == 0
    assert most > 20
    assert blind.metrics()["untangling_passes"] == 0, "ignored hits must not be answered"


def test_half_ignored_is_reproducible_and_differs_from_step_to_step():
    scene = cg.scenes.make("faulty_detection", cells=6, layers=3)
    assert scene.ignored == 0.5
    runs = []
    for _ in range(2):
        simulation = cg.Simulation(scene, DRAFT)
        simulation.step(12)
        runs.append(simulation.state_hash())
    assert runs[0] == runs[1]
    simulation.reset()
    simulation.step(12)
    assert simulation.state_hash() == runs[0]
    whole = cg.Simulation(dataclasses.replace(scene, ignored=0.0), DRAFT)
    whole.step(12)
    assert whole.state_hash() != runs[0]
    counts = [run.metrics()["work"]["primitive_pairs"] for run in (simulation, whole)]
    assert 0.4 < counts[0] / counts[1] < 0.6
