"""Small cloths whose motion is known, without self-collision."""

from __future__ import annotations

import numpy as np

import clothgym as cg
from clothgym.kernels.integrate import Grips

G = 9.81
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""(x, y, z) -> (x, z, -y): the sheet's z becomes height."""


def no_grips() -> Grips:
    return Grips(np.zeros(0, np.int32), *(np.zeros((0, 3)) for _ in range(2)), np.zeros(0), np.zeros(0),
                 np.zeros((0, 3)), np.zeros((0, 3)))  # fmt: skip


def ladder(rungs: int, length: float = 1.0, top=(0, 1), stretched: float = 1.0, **material) -> cg.Cloth:
    """Two upright columns of `rungs` springs, joined by level springs; row 0 is the top. No shear, no flexion."""
    mesh = cg.grid(0.1, length, 1, rungs)
    placed = (mesh.vertices @ UPRIGHT.T) * [1.0, stretched, 1.0]
    values = {"density": 0.2, "stretch": 50.0, "shear": 0.0, "flexion": 0.0, "damping": 0.0} | material
    return cg.Cloth(
        cg.Mesh(placed, mesh.faces, mesh.quads), cg.Material(**values), top, mesh.vertices, equal_masses=True
    )


def lone(cloth: cg.Cloth, **scene) -> cg.Scene:
    return cg.Scene([cloth], **({"self_collision": False} | scene))
