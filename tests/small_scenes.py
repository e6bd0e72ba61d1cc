"""Small scenes in contact and in a tangle, for the tests of the simulation as a whole."""

from __future__ import annotations

import dataclasses

import numpy as np

import clothgym as cg

SOFT = cg.Material(stretch=1e3, shear=2e2, flexion=0.5, damping=2.0, friction=0.2, thickness=4e-3)


def pile(count: int = 3, **scene) -> cg.Scene:
    """Small sheets a little above each other and the ground: in contact after a few steps."""
    rng = np.random.default_rng(0)
    mesh = cg.grid(0.3, 0.3, 4, 4)
    cloths = []
    for k in range(count):
        place = np.array([0.02 * k, 0.01 + 0.012 * k, 0.013 * k])
        vertices = mesh.vertices + place + rng.uniform(-2e-3, 2e-3, mesh.vertices.shape)
        cloths.append(cg.Cloth(cg.Mesh(vertices, mesh.faces, mesh.quads), SOFT, (), mesh.vertices, f"sheet {k}"))
    return cg.Scene(cloths, **({"ground": 0.0, "step": 0.01, "name": "small pile"} | scene))


def tangle() -> cg.Scene:
    """Two sheets through each other and a third below: contact and untangling at work."""
    mesh = cg.grid(0.3, 0.3, 5, 5)
    c, s = np.cos(0.5), np.sin(0.5)
    turned = mesh.transformed([[c, -s, 0], [s, c, 0], [0, 0, 1]], (0.06, 0.101, 0.017))
    flat = [mesh.transformed(translation=(0, 0.1, 0)), mesh.transformed(translation=(0.03, 0.092, 0.01))]
    material = dataclasses.replace(SOFT, thickness=6e-3)
    cloths = [cg.Cloth(m, material, (), mesh.vertices) for m in (flat[0], turned, flat[1])]
    return cg.Scene(cloths, ground=0.0, step=0.01)


CONTACT = cg.Fidelity(substeps=4, untangling="none")
GLOBAL = cg.Fidelity(untangling="global", untangling_passes=1, substeps=4)
