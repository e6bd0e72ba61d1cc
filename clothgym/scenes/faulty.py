"""Cloth over a body, while detection misses half of what it should find [Volino 2006, 3.1.2 and Fig. 7]."""

from __future__ import annotations

import math

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.body import Body
from clothgym.materials import Material
from clothgym.mesh import Mesh, grid
from clothgym.scene import Cloth, Scene

_SIDE, _RADIUS = 0.6, 0.16


def faulty_detection(ignored: float = 0.5, cells: int = 12, layers: int = 8, seed: int = 0) -> Scene:
    """A pile of eight sheets (2,304 triangles) falls over a ball and onto the ground, while 50 % of all contacts between cloths
    and of all intersections are ignored, others in every step of 1/100 s [Volino 2006, Fig. 7]. What lies on the ball and on
    the ground is always seen. Two finer sheets of as many triangles lie so lightly on each other that next to nothing goes
    through."""
    rng = np.random.default_rng(seed)
    edge = _SIDE / cells
    material = Material(
        density=0.15, stretch=1e4, shear=2e3, flexion=0.5, damping=2.0, friction=0.2, thickness=0.15 * edge
    )
    cloths = []
    for layer in range(layers):
        flat = grid(_SIDE, _SIDE, cells, cells)
        angle = rng.uniform(-0.3, 0.3)
        c, s = math.cos(angle), math.sin(angle)
        place = np.array(
            [rng.uniform(-0.03, 0.03), 2.0 * _RADIUS + 0.02 + 0.4 * edge * layer, rng.uniform(-0.03, 0.03)]
        )
        placed = flat.transformed([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], place)
        placed.vertices[:, 1] += 0.05 * edge * rng.uniform(-1.0, 1.0, len(placed.vertices))
        cloths.append(Cloth(placed, material, (), flat.vertices, f"layer {layer}"))
    ball = Body(_ball(_RADIUS, np.array([0.0, _RADIUS, 0.0])), "ball", friction=0.3)
    return Scene(tuple(cloths), (ball,), ground=0.0, step=0.01, duration=1.2, ignored=ignored, name="faulty_detection")


def _ball(radius: float, centre: FloatArray, rounds: int = 24) -> Mesh:
    """A sphere of circles of latitude."""
    polar = np.linspace(0.0, math.pi, rounds // 2 + 1)[1:-1]
    turn = np.linspace(0.0, 2.0 * math.pi, rounds, endpoint=False)
    rings = np.stack(
        [
            np.outer(np.sin(polar), np.cos(turn)).ravel(),
            np.repeat(np.cos(polar), rounds),
            np.outer(np.sin(polar), np.sin(turn)).ravel(),
        ],
        axis=1,
    )
    count = len(rings)
    faces: list[IntArray] = []
    here, on = np.arange(rounds), (np.arange(rounds) + 1) % rounds
    for k in range(len(polar) - 1):
        a, b = k * rounds, (k + 1) * rounds
        faces += [np.stack([a + here, a + on, b + here], 1), np.stack([a + on, b + on, b + here], 1)]
    faces += [
        np.stack([on, here, np.full(rounds, count)], 1),
        np.stack([count - rounds + here, count - rounds + on, np.full(rounds, count + 1)], 1),
    ]
    points = np.concatenate([rings, [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]])
    return Mesh(radius * points + centre, np.concatenate(faces).astype(np.int32))


MAKERS = {"faulty_detection": faulty_detection}
PARAMETERS = {
    "faulty_detection": {
        "ignored": ("", 0.0, 1.0, "share of contacts and intersections that detection misses"),
        "cells": ("cells", 4, 100, "a side of each sheet"),
        "layers": ("", 1, 8, "number of sheets"),
        "seed": ("", 0, 2**31 - 1, "seed of turns and places"),
    }
}
