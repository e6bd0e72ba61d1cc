"""Two layers of a garment around the torso of the female body, pushed through each other from a known clean state."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from clothgym import rig
from clothgym.arrays import FloatArray
from clothgym.materials import Material
from clothgym.mesh import Mesh, Surface
from clothgym.scene import Cloth, Scene
from clothgym.torso import torso

if TYPE_CHECKING:
    from clothgym.detection.sides import Sides

GAPS = (0.015, 0.030)
"""Distance of the inner and the outer shell from the torso [m]."""

_SMOOTHING = 10
_MATERIAL = Material(density=0.15, stretch=5e3, flexion=5.0, damping=4.0, friction=0.1, thickness=4e-3)
_PLACES = ((0.0, 0.62), (180.0, 0.60), (0.0, 0.0), (90.0, 0.35), (-90.0, 0.35))
"""Azimuth [degrees, 0 = front] and height [share of the torso's] of the bumps: chest, back, hip, flanks."""


def shells(push: float = 0.04, bumps: int = 3, seed: int = 0) -> Scene:
    """Two cloth shells around a torso, 1.5 cm and 3 cm from it and 1.5 cm from each other, without gravity, held at the
    neck. The inner one bulges out through the outer one: on the chest, on the back (closed contours), over the hem (an
    open one), then at the flanks. The bulges are cut into the cloth: its rest shape has them, so that no tension pulls
    them back. `side_error` tells how much is on the wrong side."""
    rng = np.random.default_rng(seed)
    inner, outer = clean_shells()
    normals = _torso()[2]
    bulged = inner.vertices + push * _bumps(inner.vertices, normals, bumps, rng)[:, None] * normals
    pins = neck_border(inner)
    return Scene(
        (
            Cloth(Mesh(bulged, inner.faces), _MATERIAL, pins, bulged, "inner shell"),
            Cloth(outer, _MATERIAL, pins, outer.vertices, "outer shell"),
        ),
        gravity=(0.0, 0.0, 0.0),
        step=0.01,
        duration=1.0,
        name="shells",
    )


def clean_shells() -> tuple[Mesh, Mesh]:
    """Inner and outer shell without any intersection: what `shells` starts from and should come back to."""
    mesh, places, normals = _torso()
    inner, outer = (Mesh(places + gap * normals, mesh.faces) for gap in GAPS)
    return inner, outer


def neck_border(shell: Mesh) -> tuple[int, ...]:
    """Vertices of the highest border."""
    surface = Surface(shell.faces, len(shell.vertices))
    edges = surface.edges[surface.edge_face_count == 1]
    border = {int(v) for v in edges.ravel()}
    loop = {max(border, key=lambda v: shell.vertices[v, 1])}
    while grown := {int(v) for edge in edges for v in edge if loop & set(edge.tolist())} - loop:
        loop |= grown
    return tuple(sorted(loop))


def side_error(positions: FloatArray) -> float:
    """Share of the vertices of both shells that are on the wrong side of the other one, against the clean state.

    Args:
        positions: (V, 3) [m] of the scene `shells` with any parameters.
    """
    sides, required = _clean_sides()
    return sides.error(positions, required)


def outside(positions: FloatArray) -> float:
    """Share of the inner shell's vertices that are outside of the outer shell.

    Args:
        positions: (V, 3) [m] of the scene `shells` with any parameters.
    """
    sides, required = _clean_sides()
    return float((sides.signs(positions)[: len(required) // 2] > 0.0).mean())


@lru_cache(maxsize=1)
def _clean_sides() -> tuple[Sides, FloatArray]:
    """Who is on which side of whom in the clean state."""
    from clothgym.detection.sides import Sides

    inner, outer = clean_shells()
    count = len(inner.vertices)
    sides = Sides(np.concatenate([inner.faces, outer.faces + count]), slice(0, count), slice(count, 2 * count))
    return sides, sides.signs(np.concatenate([inner.vertices, outer.vertices]))


@lru_cache(maxsize=1)
def _torso() -> tuple[Mesh, FloatArray, FloatArray]:
    """The torso, its vertices (V, 3) without small features and unit normals (V, 3) that vary slowly."""
    mesh = torso(rig.load("female"))
    surface = Surface(mesh.faces, len(mesh.vertices))
    start, neighbours, _ = surface.neighbourhood
    owner = np.repeat(np.arange(len(mesh.vertices)), np.diff(start))
    degree = np.diff(start)[:, None]
    inner = np.ones(len(mesh.vertices), np.bool_)
    inner[surface.edges[surface.edge_face_count == 1]] = False

    def average(field: FloatArray) -> FloatArray:
        sums = [np.bincount(owner, field[neighbours, c], minlength=len(field)) for c in range(3)]
        return np.stack(sums, axis=1) / degree

    places = mesh.vertices.copy()
    for _ in range(_SMOOTHING):
        places = np.where(inner[:, None], 0.5 * places + 0.5 * average(places), places)
    corners = places[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals: FloatArray = np.stack(
        [np.bincount(mesh.faces.ravel(), np.repeat(across[:, c], 3), minlength=len(places)) for c in range(3)], axis=1
    )
    for _ in range(_SMOOTHING):
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        normals = 0.5 * normals + 0.5 * average(normals)
    return mesh, places, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _bumps(vertices: FloatArray, normals: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """(V,) height of smooth bumps of different places and radii, at most 1."""
    low, high = vertices[:, 1].min(), vertices[:, 1].max()
    azimuth = np.degrees(np.arctan2(vertices[:, 0], vertices[:, 2]))
    height = np.zeros(len(vertices))
    for angle, level in _PLACES[:count]:
        angle += rng.uniform(-25.0, 25.0)
        level += rng.uniform(-0.05, 0.05) if level > 0.0 else 0.0
        radius = rng.uniform(0.07, 0.10)
        turn = (azimuth - angle + 180.0) % 360.0 - 180.0
        centre = int((np.abs(turn) / 90.0 + np.abs((vertices[:, 1] - low) / (high - low) - level)).argmin())
        distance = np.linalg.norm(vertices - vertices[centre], axis=1) / radius
        facing = normals @ normals[centre] > 0.0  # a bump never reaches through to the other side
        height = np.maximum(height, np.where(facing, np.maximum(1.0 - distance**2, 0.0) ** 2, 0.0))
    return height


MAKERS = {"shells": shells}
PARAMETERS = {
    "shells": {
        "push": ("m", 0.0, 0.1, "height of the bumps of the inner shell; below 0.015 m nothing intersects"),
        "bumps": ("", 1, len(_PLACES), "number of bumps: chest, back, hem, flanks"),
        "seed": ("", 0, 2**31 - 1, "seed of the bumps' places and sizes"),
    }
}
