"""Cloth clamped between layers or body parts: finite and flagged; and pairs that pass each other: counted."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

import clothgym as cg

THICK = 4e-3
CLOTH = cg.Material(thickness=THICK, stretch=1e3, shear=1e2, flexion=1e-2)


def sheet(height: float, name: str, pinned: bool, cells: int = 6, material: cg.Material = CLOTH) -> cg.Cloth:
    mesh = cg.grid(0.3, 0.3, cells, cells)
    vertices = mesh.vertices + np.array([0.0, height, 0.0])
    if not pinned:
        vertices[:, [0, 2]] *= 0.8
    pins = range(len(vertices)) if pinned else ()
    return cg.Cloth(cg.Mesh(vertices, mesh.faces, mesh.quads), material, pins, name=name)


def sandwich(gap: float) -> cg.Simulation:
    """A sheet between two that do not move, `gap` [m] apart."""
    cloths = [sheet(0.0, "below", True), sheet(0.5 * gap, "between", False), sheet(gap, "above", True)]
    sim = cg.Simulation(cg.Scene(cloths, name="sandwich"))
    sim.reset()
    return sim


def test_a_sheet_between_two_that_leave_no_room_is_flagged_and_stays_finite():
    sim = sandwich(0.8 * THICK)
    middle = sim.cloth_ranges[1][1]
    for _ in range(20):
        sim.step()
        assert np.isfinite(sim.positions).all()
        heights = sim.positions[middle, 1]
        assert heights.min() > 0.0 and heights.max() < 0.8 * THICK, "it left its side"
    values = sim.metrics()
    assert values["clamped"] > 0.5 * (middle.stop - middle.start)
    assert values["hits"] == 0 and values["max_strain"] < 1.0


def test_a_sheet_with_room_is_not_flagged():
    sim = sandwich(3.0 * THICK)
    for _ in range(20):
        sim.step()
        assert sim.metrics()["clamped"] == 0


def test_a_pile_at_rest_is_not_flagged():
    cloths = [sheet(0.003 + 1.1 * n * THICK, f"layer {n}", False) for n in range(4)]
    sim = cg.Simulation(cg.Scene(cloths, ground=0.0, name="pile"))
    sim.reset()
    for _ in range(40):
        sim.step()
    assert sim.metrics()["work"]["contacts"] > 0, "nothing touches"
    assert sim.metrics()["clamped"] == 0


def wedge(gap: float, self_collision: bool) -> cg.Simulation:
    """An upright sheet that falls between two blocks beside each other, `gap` [m] apart."""
    blocks = []
    for sign in (-1.0, 1.0):
        block = trimesh.creation.box((0.2, 0.4, 0.6))
        block.apply_translation((sign * (0.1 + 0.5 * gap), 0.0, 0.0))
        blocks.append(cg.Body(block, name=f"block {sign:+.0f}"))
    mesh = cg.grid(0.3, 0.3, 8, 8)
    upright = np.stack([0.0 * mesh.vertices[:, 1], mesh.vertices[:, 0], mesh.vertices[:, 2]], axis=1)
    cloth = cg.Cloth(cg.Mesh(upright, mesh.faces, mesh.quads), "cotton")
    fidelity = dataclasses.replace(cg.Fidelity(), body_tolerance=3e-3)
    scene = cg.Scene([cloth], bodies=blocks, self_collision=self_collision, name="wedge")
    sim = cg.Simulation(scene, fidelity)
    sim.reset()
    return sim


@pytest.mark.parametrize("self_collision", [False, True])
def test_cloth_between_two_blocks_is_flagged_where_they_leave_no_room(self_collision):
    narrow, wide = wedge(4e-3, self_collision), wedge(20e-3, self_collision)
    for _ in range(10):
        narrow.step()
        wide.step()
        assert np.isfinite(narrow.positions).all()
        assert np.abs(narrow.velocities).max() < 5.0
    between = np.abs(narrow.positions[:, 1]) < 0.19
    assert between.sum() > 20
    assert narrow.metrics()["clamped"] > 0.5 * between.sum()
    assert wide.metrics()["clamped"] == 0
    narrow.reset()
    assert narrow.metrics()["clamped"] == 0


def crossing(continuous: bool) -> cg.Simulation:
    """A sheet thrown through another one that it already cuts: contact leaves the pairs there alone."""
    flat, other = sheet(0.0, "held", True), sheet(0.0, "thrown", False)
    moved = other.mesh.vertices.copy()
    moved[:, 1] = 0.15 * moved[:, 0]
    moved[:, 2] += 0.013
    other = dataclasses.replace(other, mesh=cg.Mesh(moved, other.mesh.faces, other.mesh.quads), rest=None)
    fidelity = dataclasses.replace(
        cg.Fidelity(), untangling="none", contacts_near_hits="off_any", rings=10, continuous=continuous
    )
    sim = cg.Simulation(cg.Scene([flat, other], name="crossing"), fidelity)
    sim.reset()
    velocities = sim.velocities.copy()
    velocities[sim.cloth_ranges[1][1], 1] = -1.0
    sim.set_velocities(velocities)
    return sim


def test_pairs_that_pass_each_other_are_counted():
    watched, blind = crossing(True), crossing(False)
    for _ in range(3):
        watched.step()
        blind.step()
    assert watched.metrics()["tunnel_events"] > 10
    assert blind.metrics()["tunnel_events"] == 0
    assert watched.state_hash() == blind.state_hash(), "looking changed what happens"


def test_nothing_passes_where_contact_holds():
    fidelity = dataclasses.replace(cg.Fidelity(), continuous=True)
    cloths = [sheet(0.02 * n, f"layer {n}", False) for n in range(3)]
    sim = cg.Simulation(cg.Scene(cloths, ground=0.0, name="fall"), fidelity)
    sim.reset()
    sim.set_velocities(np.where(np.arange(len(sim.positions))[:, None] >= 98, -3.0, 0.0) * np.array([0.0, 1.0, 0.0]))
    for _ in range(15):
        sim.step()
    assert sim.metrics()["work"]["contacts"] > 0
    assert sim.metrics()["tunnel_events"] == 0 and sim.metrics()["hits"] == 0


def test_continuous_is_a_yes_or_no():
    with pytest.raises(ValueError, match=r"fidelity.continuous = 1: expected True or False"):
        cg.Fidelity(continuous=1)  # type: ignore[arg-type]
