"""Scenes that start tangled."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import FloatArray
from clothgym.materials import Material
from clothgym.mesh import Mesh, grid
from clothgym.scene import Cloth, Scene

_CELLS, _SIDE = 12, 0.6


def squares(count: int = 25, seed: int = 0, box: float = 1.25, cells: int = _CELLS) -> Scene:
    """Squares of cloth (60 cm, 288 triangles each by default) thrown into a box at random so that they intersect, falling on
    the ground [Volino 2006, 3.1.1 and Fig. 6]. 25 of them make more than 100 contours and 2,000 hits at most seeds."""
    rng = np.random.default_rng(seed)
    flat = grid(_SIDE, _SIDE, cells, cells)
    edge = _SIDE / cells
    material = _material(edge)
    cloths = []
    lowest = 0.0
    for number in range(count):
        rotation = random_rotation(rng)
        place = rng.uniform(-0.5, 0.5, 3) * box * _SIDE
        vertices = _wavy(flat, 0.5 * edge, rng).vertices @ rotation.T + place
        lowest = min(lowest, float(vertices[:, 1].min()))
        cloths.append((number, vertices))
    lift = np.array([0.0, 0.15 - lowest, 0.0])
    return Scene(
        tuple(
            Cloth(Mesh(v + lift, flat.faces, flat.quads), material, (), flat.vertices, f"square {n}") for n, v in cloths
        ),
        ground=0.0,
        step=0.01,
        duration=3.3,
        name="squares",
    )


def pile(count: int = 25, seed: int = 0, gap: float = 0.02) -> Scene:
    """The same squares, stacked without any intersection and turned at random about the vertical, falling on the ground: a
    test of contact alone."""
    rng = np.random.default_rng(seed)
    flat = grid(_SIDE, _SIDE, _CELLS, _CELLS)
    material = _material(_SIDE / _CELLS)
    cloths = []
    for number in range(count):
        angle = rng.uniform(0.0, 2.0 * np.pi)
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        place = np.array([*rng.uniform(-0.05, 0.05, 2), 0.0])[[0, 2, 1]] + [0.0, 0.15 + gap * number, 0.0]
        vertices = _wavy(flat, 0.4 * gap, rng).vertices @ turn.T + place
        cloths.append(Cloth(Mesh(vertices, flat.faces, flat.quads), material, (), flat.vertices, f"square {number}"))
    return Scene(tuple(cloths), ground=0.0, step=0.01, duration=3.0, name="pile")


def _material(edge: float) -> Material:
    """Light cotton; damping stands for the drag of the air (terminal speed 2.5 m/s)."""
    return Material(density=0.15, stretch=1e4, shear=2e3, flexion=2.0, damping=4.0, friction=0.1, thickness=0.1 * edge)


def rotation(axis: ArrayLike, angle: float) -> FloatArray:
    """(3, 3) rotation about an axis of any length but 0 [Rodrigues]."""
    direction = np.asarray(axis, float)
    x, y, z = direction / np.linalg.norm(direction)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def random_rotation(rng: np.random.Generator) -> FloatArray:
    """A rotation drawn uniformly (Shoemake 1992)."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _wavy(flat: Mesh, height: float, rng: np.random.Generator) -> Mesh:
    """A sheet with two low waves of random phase; at most `height` out of plane [m]."""
    x, z = flat.vertices[:, 0] / _SIDE, flat.vertices[:, 2] / _SIDE
    phases = rng.uniform(0.0, 2.0 * np.pi, 2)
    vertices = flat.vertices.copy()
    vertices[:, 1] = 0.5 * height * (np.sin(2 * np.pi * x + phases[0]) + np.sin(2 * np.pi * z + phases[1]))
    return Mesh(vertices, flat.faces, flat.quads)


MAKERS = {"squares": squares, "pile": pile}
_SEED = ("", 0, 2**31 - 1, "seed of the places")
PARAMETERS = {
    "squares": {
        "count": ("", 1, 400, "number of squares"),
        "seed": _SEED,
        "box": ("squares", 0.1, 100.0, "side of the box of centres, in sides of a square"),
        "cells": ("cells", 2, 100, "cells a side of each square"),
    },
    "pile": {
        "count": ("", 1, 400, "number of squares"),
        "seed": _SEED,
        "gap": ("m", 1e-4, 1.0, "vertical distance of the squares"),
    },
}
