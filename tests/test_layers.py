"""Garments over each other, and how far from the body is what rests on it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym import body as bodies
from clothgym.detection.body_mesh import BodyMesh
from clothgym.dressing import layer
from clothgym.dressing.layers import LAYER
from clothgym.dressing.outcome import contact_gaps
from clothgym.mesh import grid


@pytest.fixture(scope="module")
def cuff() -> cg.Draped:
    return cg.drape("cuff", "female", edge_length=0.02)


def test_what_a_table_carries_lies_at_the_tolerance_and_floats_when_lifted():
    table = trimesh.creation.box((0.6, 0.2, 0.6)).apply_translation((0.0, -0.1, 0.0))
    sheet = grid(0.3, 0.3, 6, 6)
    lying = sheet.transformed(translation=(0.0, 3e-3, 0.0))
    scene = cg.Scene((cg.Cloth(lying),), bodies=(cg.Body((table.vertices, table.faces), "table"),))
    simulation = cg.Simulation(scene, "balanced")
    assert len(contact_gaps(simulation)) == 0, "no force before the first step"
    simulation.step(10)
    gaps = contact_gaps(simulation)
    assert len(gaps) == len(sheet.vertices)
    assert gaps == pytest.approx(3e-3, abs=2e-4)
    simulation.set_positions(simulation.positions + np.array([0.0, 0.01, 0.0]))
    assert contact_gaps(simulation) == pytest.approx(13e-3, abs=2e-4)


def test_the_report_tells_how_far_the_contact_floats(cuff):
    report = cuff.report
    gaps = contact_gaps(cuff.simulation)
    assert report["carried"] == len(gaps) > 0
    assert report["contact_gap_p99"] == pytest.approx(np.percentile(gaps, 99))
    assert -1e-3 < report["contact_gap_median"] < 3.5e-3


def test_a_second_cuff_starts_around_the_first_and_ends_without_hits(cuff):
    """Both were draped by themselves, so they coincide."""
    layered = layer([cuff, cuff], seconds=0.1)
    report = layered.report
    assert report["worn"] and report["hits"] == 0
    assert 0 <= report["passes"] < 10
    assert report["depth_max"] < 2e-3
    (_, inner, _), (_, outer, _) = layered.simulation.cloth_ranges
    start = layered.simulation.scene.start
    assert start[inner] == pytest.approx(cuff.positions)
    apart = BodyMesh(cuff.positions, cuff.faces).signed_distance(start[outer])
    assert apart.min() > 0.5 * LAYER, "all around, up to the borders"


def test_layers_need_one_body(cuff):
    with pytest.raises(ValueError, match="layer: garments: none given"):
        layer([])
    other = dataclasses.replace(cuff, body=bodies.load("male"))
    with pytest.raises(ValueError, match="layer: garments on different bodies: 'female' and 'male'"):
        layer([cuff, other])
