"""Fabrics, kinds of energies, and shapes to put them in."""

from __future__ import annotations

import numpy as np

import clothgym as cg
from clothgym.model import ClothModel

G = 9.81
FABRIC = cg.Material(
    density=0.2, stretch=300.0, shear=120.0, flexion=30.0, weft=400.0, warp=250.0, coupling=50.0, shear_modulus=90.0,
    bending=0.3, bending_warp=0.1, damping=0.0,
)  # fmt: skip
KINDS = {
    "springs": {"membrane": "springs", "bending": "flexion"},
    "membrane": {"membrane": "continuum", "bending": "none"},
    "hinge": {"membrane": "continuum", "bending": "hinge"},
    "quadratic": {"membrane": "continuum", "bending": "quadratic"},
}


def built(mesh, kind: str, material=FABRIC, rest=None, pins=(), **cloth) -> ClothModel:
    scene = cg.Scene([cg.Cloth(mesh, material, pins, rest, **cloth)], self_collision=False)
    return ClothModel(scene, cg.Fidelity(**KINDS[kind]))


def shaken(mesh, amount: float = 0.05, seed: int = 0) -> np.ndarray:
    return mesh.vertices + np.random.default_rng(seed).normal(0.0, amount, mesh.vertices.shape)


def rolled(x, kappa: float, degrees: float) -> np.ndarray:
    """Points of the x-z plane on a cylinder of curvature kappa; `degrees` from x to where it bends."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    way, axis = np.array([c, 0.0, s]), np.array([-s, 0.0, c])
    turn = kappa * (x @ way)
    up = np.outer((1.0 - np.cos(turn)) / kappa, [0.0, 1.0, 0.0])
    return np.outer(np.sin(turn) / kappa, way) + np.outer(x @ axis, axis) + up


def rotation(seed: int = 3) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))
