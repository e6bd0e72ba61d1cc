"""Single sheets: hanging, and dropped so that they crumple."""

from __future__ import annotations

import dataclasses

import numpy as np

from clothgym.materials import Material
from clothgym.mesh import Mesh, grid
from clothgym.scene import Cloth, Scene


def hanging_sheet(resolution: int = 32) -> Scene:
    """A sheet of 1 m x 1 m, 0.15 kg/m2, that starts horizontal with a kick out of plane of 1e-3 edges and hangs by the two
    corners of one side. Structural springs 1e4 N/m, both diagonals 5e3 N/m, no flexion, damping 0.5 1/s; 2 s."""
    mesh = grid(1.0, 1.0, resolution, resolution)
    rng = np.random.default_rng(0)
    vertices = mesh.vertices.copy()
    vertices[:, 1] += 1e-3 / resolution * rng.uniform(-1.0, 1.0, len(vertices))
    material = Material(density=0.15, stretch=1e4, shear=5e3, flexion=0.0, damping=0.5)
    cloth = Cloth(
        Mesh(vertices, mesh.faces, mesh.quads), material, (0, resolution), mesh.vertices, "sheet", equal_masses=True
    )
    return Scene((cloth,), self_collision=False, duration=2.0, name="hanging_sheet")


def drop(resolution: int = 16, height: float = 0.6) -> Scene:
    """A sheet of 1 m x 1 m, hung by one corner and let go, that crumples on the ground; kicked out of plane so that it
    cannot stay flat."""
    mesh = grid(1.0, 1.0, resolution, resolution)
    rng = np.random.default_rng(1)
    # corner up: the diagonal stands upright
    c, s = np.cos(np.pi / 4), np.sin(np.pi / 4)
    upright = np.stack(
        [
            c * mesh.vertices[:, 0] - s * mesh.vertices[:, 2],
            s * mesh.vertices[:, 0] + c * mesh.vertices[:, 2],
            np.zeros(len(mesh.vertices)),
        ],
        axis=1,
    )
    bulge = 0.05 * np.sin(5.0 * upright[:, 0]) * np.cos(4.0 * upright[:, 1])
    upright[:, 2] = bulge + 0.05 / resolution * rng.uniform(-1.0, 1.0, len(upright))
    upright[:, 1] += height + np.sqrt(0.5)
    material = Material(density=0.15, stretch=1e4, shear=1e3, flexion=1e-2, damping=0.5)
    material = dataclasses.replace(material, thickness=0.1 / resolution)
    cloth = Cloth(Mesh(upright, mesh.faces, mesh.quads), material, (), mesh.vertices, "sheet")
    return Scene((cloth,), ground=0.0, duration=3.0, name="drop")


MAKERS = {"hanging_sheet": hanging_sheet, "drop": drop}
_RESOLUTION = ("cells", 1, 512, "cells a side")
PARAMETERS = {
    "hanging_sheet": {"resolution": _RESOLUTION},
    "drop": {"resolution": _RESOLUTION, "height": ("m", 0.0, 10.0, "clearance of the lowest corner above the ground")},
}
