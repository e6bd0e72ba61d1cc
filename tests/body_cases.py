"""Sheets above boxes, balls and poles, for the tests of contact with bodies."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym import materials

TOLERANCE = cg.Fidelity().body_tolerance
FREE = dataclasses.replace(materials.get("cotton"), damping=0.0, stretch=1000.0)
XPBD, EULER = cg.Fidelity(), cg.Fidelity(integrator="symplectic_euler", substeps=0)
BOTH = pytest.mark.parametrize("fidelity", [XPBD, EULER], ids=["xpbd", "symplectic_euler"])


def box(size=(0.5, 0.1, 0.3), matrix=None):
    mesh = trimesh.creation.box(size)
    for _ in range(4):
        mesh = mesh.subdivide()
    return mesh.vertices if matrix is None else mesh.vertices @ matrix.T, mesh.faces


def ball(radius=0.1, cuts=4):
    mesh = trimesh.creation.icosphere(cuts, radius)
    return mesh.vertices, mesh.faces


def pole(radius=0.02, length=0.4, axis=(0, 1, 0)):
    """A thin capsule in the middle of the world."""
    mesh = trimesh.creation.capsule(length, radius, count=[32, 32])
    vertices = mesh.vertices - mesh.bounds.mean(axis=0)
    return vertices @ trimesh.geometry.align_vectors([0, 0, 1], axis)[:3, :3].T, mesh.faces


def sheet(size=0.1, cells=4, height=0.0, matrix=None):
    """Level, its middle at `height` above the origin, then turned about the origin."""
    mesh = cg.grid(size, size, cells, cells)
    vertices = mesh.vertices - mesh.vertices.mean(axis=0)
    if np.ptp(vertices[:, 1]) > 0.5 * size:  # upright grids are laid down
        vertices = vertices[:, [0, 2, 1]] * [1, 1, -1]
    vertices = vertices + np.array([0.0, height, 0.0])
    return (vertices if matrix is None else vertices @ matrix.T), mesh.faces


def simulation(cloth, body, fidelity=XPBD, material=FREE, self_collision=False, step=0.01, pins=(), grips=(), **answer):
    bodies = body if isinstance(body, list) else [cg.Body(body, **answer)]
    piece = cg.Cloth(cloth, material, pins=pins)
    return cg.Simulation(
        cg.Scene([piece], bodies=bodies, self_collision=self_collision, step=step, grips=grips), fidelity
    )
