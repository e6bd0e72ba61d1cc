"""Easing: what corrections stretch is spread over the vertices around, and springs need not turn it into speed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import clothgym as cg
from clothgym.kernels.untangling import ease
from clothgym.mesh import Surface


def eased(mesh, moves, near, inverse_masses, sweeps):
    """(V, 3) after corrections `moves` of a mesh at rest, and its edges (E, 2)."""
    edges = Surface(mesh.faces, len(mesh.vertices)).edges
    x = mesh.vertices + moves
    chosen, lengths = np.zeros(len(edges), np.int64), np.zeros(len(edges))
    ease(x, mesh.vertices, edges, near, inverse_masses, sweeps, chosen, lengths)
    return x, edges


def lengths_of(x, edges):
    return np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)


MESH = cg.grid(1.0, 1.0, 10, 10)
EVERYONE = np.ones(len(MESH.vertices), np.bool_)


def correction(seed: int) -> np.ndarray:
    """(V, 3) a few vertices are pulled by up to half an edge."""
    rng = np.random.default_rng(seed)
    moves = np.zeros_like(MESH.vertices)
    moves[rng.choice(len(moves), 6, replace=False)] = rng.normal(0.0, 0.03, (6, 3))
    return moves


@pytest.mark.parametrize("seed", range(4))
def test_the_middle_of_mass_stays(seed):
    moves, masses = correction(seed), np.random.default_rng(seed).uniform(0.5, 2.0, len(MESH.vertices))
    x, _ = eased(MESH, moves, EVERYONE, 1.0 / masses, 8)
    start = MESH.vertices + moves
    assert np.abs(x - start).max() > 0.005
    assert (masses[:, None] * (x - start)).sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-14)


def test_one_sweep_turns_nothing():
    """Each edge pulls along itself, so the moment of what it does about any point is zero."""
    moves = correction(0)
    edges = Surface(MESH.faces, len(MESH.vertices)).edges
    start = MESH.vertices + moves
    chosen, lengths = np.zeros(1, np.int64), np.zeros(1)
    for edge in edges[:: len(edges) // 20]:
        x = start.copy()
        ease(x, MESH.vertices, edge[None], EVERYONE, np.ones(len(x)), 1, chosen, lengths)
        assert np.cross(start, x - start).sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-15)


def test_edges_get_their_lengths_back():
    moves = correction(1)
    strains = []
    for sweeps in (0, 8, 200):
        x, edges = eased(MESH, moves, EVERYONE, np.ones(len(MESH.vertices)), sweeps)
        strains.append(np.abs(lengths_of(x, edges) / lengths_of(MESH.vertices, edges) - 1.0).max())
    assert strains[0] > 0.2 and strains[1] < 0.4 * strains[0] and strains[2] < 0.05 * strains[0]


def test_who_is_far_or_pinned_stays():
    moves, near, weights = correction(2), EVERYONE.copy(), np.ones(len(MESH.vertices))
    near[60:] = False
    weights[:11] = 0.0
    moves[:11] = 0.0
    moves[60:] = 0.0
    x, _ = eased(MESH, moves, near, weights, 8)
    assert (x[60:] == MESH.vertices[60:]).all() and (x[:11] == MESH.vertices[:11]).all()
    assert (x[11:60] != (MESH.vertices + moves)[11:60]).any()


def test_coincident_vertices_do_no_harm():
    x, _ = eased(MESH, -MESH.vertices, EVERYONE, np.ones(len(MESH.vertices)), 3)
    assert np.isfinite(x).all()


def test_squares_do_not_fly_apart():
    """Layers that intersect, at balanced with the many short substeps of its promise: corrections bring in far less energy."""
    energy, hits = {}, {}
    for easing in (0, 8):
        fidelity = dataclasses.replace(cg.Fidelity.preset("balanced"), easing=easing)
        sim = cg.Simulation(cg.scenes.make("squares", count=12, seed=0), fidelity)
        masses, found = sim.model.masses, []
        for _ in range(10):
            sim.step()
            found.append(0.5 * float((masses[:, None] * sim.velocities**2).sum()))
        energy[easing], hits[easing] = max(found), sim.last_intersections.hit_count
    assert energy[8] < 0.5 * energy[0]
    assert hits[8] == 0 < hits[0]
