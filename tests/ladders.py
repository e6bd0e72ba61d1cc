"""Small cloths whose motion is known, most without self-collision."""

from __future__ import annotations

import numpy as np
import pytest

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


def rests_on_the_ground(fidelity: cg.Fidelity, self_collision: bool, steps: tuple[int, int], slowest: float) -> None:
    """A sheet thrown along the ground 3 cm above it lies on it after the first steps, and stays through the second ones."""
    mesh = cg.grid(0.4, 0.4, 4, 4)
    material = cg.Material(thickness=4e-3, stretch=200.0, damping=2.0, friction=0.4)
    scene = cg.Scene([cg.Cloth(mesh.transformed(translation=(0, 0.53, 0)), material, rest=mesh.vertices)], ground=0.5,
                     self_collision=self_collision)  # fmt: skip
    sim = cg.Simulation(scene, fidelity)
    sim.set_velocities(np.tile([0.2, 0.0, 0.1], (25, 1)))
    sim.step(steps[0])
    assert sim.positions[:, 1] == pytest.approx(0.502, abs=2e-5)
    rested = sim.positions.copy()
    assert 0.005 < np.abs(rested - scene.start)[:, 0].max() < 0.2, "it slid a little, then friction stopped it"
    sim.step(steps[1])
    assert np.abs(sim.positions - rested).max() < 1e-5
    assert sim.metrics()["max_speed"] < slowest
