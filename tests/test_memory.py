"""Once warm, detection and contact allocate nothing that grows with the scene."""

from __future__ import annotations

import gc
import tracemalloc

import meshes
import numpy as np

import clothgym as cg
from clothgym.detection.hierarchy import Hierarchy
from clothgym.model import ClothModel
from clothgym.response.contact import Candidates, ContactBuffers
from clothgym.response.strays import Strays

SMALL = 16_384
"""Bytes for Python's own numbers and views; one array with a number for every vertex has more than this."""


def peak(call, times: int = 5) -> tuple[int, int]:
    """Most bytes that some calls held at once, and that they left behind, after calls that warm up."""
    tracemalloc.start()
    try:
        for _ in range(10):
            call()
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        for _ in range(times):
            call()
        now, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return most - before, now - before


def test_a_search_allocates_nothing_once_its_buffers_have_grown():
    vertices, faces = meshes.many_sheets(6, 20, 1)
    assert 8 * len(vertices) > SMALL
    tree = Hierarchy(cg.Surface(faces, len(vertices)), vertices)

    def search() -> None:
        tree.refit(vertices, vertices, 0.02)
        tree.search(near=True, hits=True)

    most, left = peak(search)
    assert most < SMALL and left < SMALL
    assert tree.counts[:3].min() > 0


def test_candidates_and_contacts_allocate_nothing_once_their_buffers_have_grown():
    vertices, faces = meshes.many_sheets(6, 20, 1)
    model = ClothModel(cg.Scene([cg.Cloth((vertices, faces))]))
    found = Candidates(model, Hierarchy(model.surface, vertices))
    found.strays = Strays(model.surface, 1)
    contacts = ContactBuffers(16)
    travel = np.random.default_rng(0).normal(0.0, 0.01, vertices.shape)
    moved, apart = vertices + travel, np.zeros(len(vertices), np.bool_)

    def look() -> None:
        found.expect(vertices, travel)
        found.gather()
        contacts.narrow(vertices, moved, found, apart, False, 0.0)
        assert not found.outdated(moved, 1.0)
        away = moved[7] + 1.5 * found.slack[7]
        moved[7], kept = away, moved[7].copy()
        assert found.outdated(moved, 1.0) and found.widen(moved, 1.0)
        moved[7] = kept

    most, left = peak(look)
    assert most < SMALL and left < SMALL
    assert found.count > 0 and contacts.active > 0


def test_steps_leave_nothing_behind():
    """A pile that slides and touches: the safety copy of the state is all that a step holds beside its buffers."""
    sheet = cg.grid(0.4, 0.4, 16, 16)
    rng = np.random.default_rng(3)
    cloths = []
    for n in range(3):
        start = sheet.vertices + np.array([0.0, 0.02 + 0.006 * n, 0.0]) + rng.normal(0.0, 2e-4, sheet.vertices.shape)
        cloths.append(cg.Cloth(cg.Mesh(start, sheet.faces, sheet.quads), rest=sheet.vertices, name=f"{n}"))
    sim = cg.Simulation(cg.Scene(cloths, ground=0.0), "draft")
    sim.step(20)
    size = sim.positions.nbytes
    most, left = peak(sim.step, 20)
    assert sim.metrics()["work"]["contacts"] > 1000
    # numba's own records of arrays come and go, some 57 bytes each; a number for every vertex and step would be more
    assert left < 16 * 8 * len(sim.positions)
    assert most < 10 * size
