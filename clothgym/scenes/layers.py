"""Stacks of sheets on the ground, pushed through each other from a known clean state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.materials import Material
from clothgym.mesh import Mesh, Surface, grid
from clothgym.scene import Cloth, Grip, Scene

SIDE = 0.4
GAP = 0.012
_ATTEMPTS = 50


@dataclass(frozen=True)
class LayerStack:
    """A tangled stack.

    Attributes:
        clean: (V, 3) [m] without intersections: sheet k + 1 lies on sheet k.
        start: (V, 3) [m] the same sheets pushed through each other.
        length: contour length of the start [m].
    """

    clean: FloatArray
    start: FloatArray
    length: float


def stack_scene(sheets: int = 2, vertices: int = 15, grips: int = 0) -> Scene:
    """A clean stack, aligned with the axes; the lowest sheet is pinned at two corners."""
    mesh = grid(SIDE, SIDE, vertices - 1, vertices - 1)
    edge = SIDE / (vertices - 1)
    material = Material(
        density=0.15, stretch=2e3, shear=2e2, flexion=1.0, damping=4.0, friction=0.3, thickness=0.1 * edge
    )
    cloths = []
    for k in range(sheets):
        placed = mesh.transformed(translation=(0.0, 0.5 * GAP + k * GAP, 0.0))
        pins = (0, vertices - 1) if k == 0 else ()
        cloths.append(Cloth(placed, material, pins, mesh.vertices, f"sheet {k}"))
    return Scene(
        tuple(cloths), ground=0.0, grips=(Grip(radius=0.04, stiffness=200.0, slip_force=5.0),) * grips, name="layers"
    )


def draw_stack(scene: Scene, rng: np.random.Generator) -> LayerStack:
    """Turns and shifts the sheets, then pushes neighbours through each other: a corner, a side, or a dent.

    Every draw starts clean (checked), intersects with a contour longer than two edges, and has no more structure than the
    generator gave it: same generator state, same stack.

    Raises:
        RuntimeError: no such draw in 50 attempts.
    """
    from clothgym.detection.intersections import intersections

    count = len(scene.cloths)
    size = len(scene.cloths[0].mesh.vertices)
    faces = np.concatenate([cloth.mesh.faces + k * size for k, cloth in enumerate(scene.cloths)])
    surface = Surface(faces, count * size)
    flat = np.asarray(scene.cloths[0].rest)
    edge = SIDE / (round(np.sqrt(size)) - 1)
    for _ in range(_ATTEMPTS):
        clean = scene.start.copy().reshape(count, size, 3)
        for k in range(1, count):
            angle = rng.uniform(-0.25, 0.25)
            c, s = np.cos(angle), np.sin(angle)
            shift = rng.uniform(-0.06, 0.06, 2)
            clean[k, :, 0] = c * flat[:, 0] + s * flat[:, 2] + shift[0]
            clean[k, :, 2] = -s * flat[:, 0] + c * flat[:, 2] + shift[1]
        # real cloth is never exactly flat: unevenness well below the gap
        clean[:, :, 1] += rng.uniform(-0.03, 0.03, (count, size)) * GAP
        start = clean.copy()
        for k in range(count - 1):
            weight = _push(rng, clean[k + 1])
            start[k, :, 1] += rng.uniform(0.7, 1.1) * GAP * _weight_at(clean[k], clean[k + 1], weight)
            start[k + 1, :, 1] -= rng.uniform(0.6, 0.9) * GAP * weight
        start[:, :, 1] = np.maximum(start[:, :, 1], 0.1 * GAP)
        tangled = intersections(start.reshape(-1, 3), surface)
        if tangled.length > 2.0 * edge and intersections(clean.reshape(-1, 3), surface).hit_count == 0:
            return LayerStack(clean.reshape(-1, 3), start.reshape(-1, 3), tangled.length)
    raise RuntimeError(f"no tangled stack of {count} sheets in {_ATTEMPTS} draws")


def _push(rng: np.random.Generator, sheet: FloatArray) -> FloatArray:
    """(V,) how far each vertex of the upper sheet goes through, 0 to 1: beyond a line (corner, side) or in a round dent."""
    x, z = sheet[:, 0], sheet[:, 2]
    if rng.uniform() < 0.7:  # what lies beyond a line across a corner or a side
        angle = rng.uniform(0.0, 2.0 * np.pi)
        distance = rng.uniform(0.08, 0.14)
        across = np.cos(angle) * x + np.sin(angle) * z - distance
        return 0.5 + 0.5 * np.tanh(across / 0.02)
    centre = rng.uniform(-0.1, 0.1, 2)
    radius = rng.uniform(0.06, 0.1)
    return 0.5 + 0.5 * np.tanh((radius - np.hypot(x - centre[0], z - centre[1])) / 0.02)


def _weight_at(lower: FloatArray, upper: FloatArray, weight: FloatArray) -> FloatArray:
    """(V,) weight of the upper sheet's nearest vertex above each vertex of the lower one, fading beyond its border."""
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(upper[:, [0, 2]]).query(lower[:, [0, 2]], k=3)
    shares = 1.0 / (distance + 1e-4)
    mean = (weight[nearest] * shares).sum(axis=1) / shares.sum(axis=1)
    return mean * np.exp(-((distance[:, 0] / 0.03) ** 2))


def layers(sheets: int = 2, vertices: int = 15, seed: int = 0) -> Scene:
    """Sheets of 40 cm on the ground, each pushed through the next at a corner, a side or a dent; the lowest is pinned at two
    corners. The scene of the environment UntangleLayers."""
    scene = stack_scene(sheets, vertices)
    stack = draw_stack(scene, np.random.default_rng(seed))
    size = vertices * vertices
    cloths = tuple(
        Cloth(
            Mesh(stack.start[k * size : (k + 1) * size], c.mesh.faces, c.mesh.quads), c.material, c.pins, c.rest, c.name
        )
        for k, c in enumerate(scene.cloths)
    )
    return Scene(cloths, ground=0.0, duration=3.0, name="layers")


MAKERS = {"layers": layers}
PARAMETERS = {
    "layers": {
        "sheets": ("", 2, 8, "number of sheets"),
        "vertices": ("", 5, 81, "vertices a side of each sheet"),
        "seed": ("", 0, 2**31 - 1, "seed of the places and of the tangle"),
    }
}
