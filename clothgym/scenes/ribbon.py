"""A long ribbon that falls into a rotating, slowly tilting dish [Volino 2006, 3.1.3 and Fig. 8]."""

from __future__ import annotations

import math

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.materials import Material
from clothgym.mesh import Mesh, grid
from clothgym.motion import Turn, Turns
from clothgym.scene import Cloth, Scene

WIDTH, EDGE = 0.05, 0.0125
"""Of the ribbon [m]: 120 m are 76,800 triangles."""
_GAP = 0.02
"""Between neighbouring turns of the roll [m]."""
_FALL = 0.05
"""From the lower border of the ribbon to the dish [m]."""
_STEEPEST = math.radians(20.0)
"""At which the ribbon rolls, but not over the rim."""
_LEVEL = 0.5
"""How long the dish stays level [s]."""
_INNER = 0.05
"""Radius of the innermost turn [m]."""


def ribbon(length: float = 120.0, spin: float = 1.5, tilt: float = 0.3, seed: int = 0) -> Scene:
    """A ribbon, 5 cm wide, rolled up loosely on its edge, falls by its width into a dish that rotates and, from half a second
    on, tilts slowly by up to 20 degrees [Volino 2006, Fig. 8]. 120 m are 76,800 triangles. The dish is a cloth whose vertices
    are all pinned and move. Steps of 1/200 s."""
    rng = np.random.default_rng(seed)
    along, outer = _spiral(length)
    flat = grid(length, WIDTH, len(along) - 1, round(WIDTH / EDGE))
    rows = round(WIDTH / EDGE) + 1
    wave = 0.2 * _GAP * np.sin(40.0 * np.linspace(0.0, length, len(along)) + rng.uniform(0.0, 2.0 * math.pi))
    outwards = along / np.linalg.norm(along, axis=1)[:, None]
    lower = along + (wave + 0.3 * _GAP)[:, None] * outwards
    upper = along - (wave + 0.3 * _GAP)[:, None] * outwards
    share = np.linspace(0.0, 1.0, rows)[:, None, None]
    place = (1.0 - share) * lower + share * upper
    radius = 1.3 * outer
    depth = 0.4 * radius
    height = depth * (np.hypot(place[..., 0], place[..., 1]) / radius) ** 2 + _FALL + share[..., 0] * WIDTH
    vertices = np.stack([place[..., 0], height, place[..., 1]], axis=-1).reshape(-1, 3)
    vertices += 1e-3 * EDGE * rng.uniform(-1.0, 1.0, vertices.shape)
    material = Material(
        density=0.15, stretch=1e3, shear=2e2, flexion=0.05, damping=4.0, friction=0.2, thickness=0.15 * EDGE
    )
    strip = Cloth(Mesh(vertices, flat.faces, flat.quads), material, (), flat.vertices, "ribbon")
    bowl = _dish(radius, depth)
    centre, slow = (0.0, depth, 0.0), max(tilt, 1e-6)
    motion = Turns(
        (
            Turn((0.0, 1.0, 0.0), spin, centre),
            Turn((0.0, 0.0, 1.0), slow, centre, begin=_LEVEL, end=min(_LEVEL + _STEEPEST / slow, 1e6)),
        )
    )
    dish = Cloth(bowl, material, range(len(bowl.vertices)), None, "dish", motion=motion)
    return Scene((strip, dish), ground=-2.0 * outer, step=0.005, duration=4.0, name="ribbon")


def _spiral(length: float) -> tuple[FloatArray, float]:
    """(N, 2) points of a spiral [m], an edge apart along it, and the radius of its last turn."""
    pitch = _GAP / (2.0 * math.pi)
    points, turn = [], 0.0
    for _ in range(round(length / EDGE) + 1):
        radius = _INNER + pitch * turn
        points.append((radius * math.cos(turn), radius * math.sin(turn)))
        turn += EDGE / math.hypot(radius, pitch)
    return np.array(points), _INNER + pitch * turn


def _dish(radius: float, depth: float, rings: int = 12, sectors: int = 48) -> Mesh:
    """A paraboloid that opens upwards, its lowest point at the origin."""
    r, turn = np.linspace(0.0, radius, rings + 1)[1:], 2.0 * math.pi * np.arange(sectors) / sectors
    circles = np.stack(
        [np.outer(r, np.cos(turn)), np.repeat(depth * (r / radius) ** 2, sectors).reshape(rings, -1),
         np.outer(r, np.sin(turn))], axis=-1,
    ).reshape(-1, 3)  # fmt: skip
    here, on = np.arange(sectors), (np.arange(sectors) + 1) % sectors
    faces = [np.stack([here + 1, np.zeros(sectors, int), on + 1], axis=1)]
    for k in range(rings - 1):
        a, b = 1 + k * sectors, 1 + (k + 1) * sectors
        faces += [np.stack([a + here, a + on, b + here], axis=1), np.stack([a + on, b + on, b + here], axis=1)]
    return Mesh(np.concatenate([np.zeros((1, 3)), circles]), np.concatenate(faces).astype(np.int32))


MAKERS = {"ribbon": ribbon}
PARAMETERS = {
    "ribbon": {
        "length": ("m", 0.5, 1000.0, "of the ribbon"),
        "spin": ("rad/s", -20.0, 20.0, "rotation of the dish"),
        "tilt": ("rad/s", 0.0, 5.0, "tilting of the dish, from 0.5 s on"),
        "seed": ("", 0, 2**31 - 1, "seed of the unevenness"),
    }
}
