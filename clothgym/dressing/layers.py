"""Garments over each other on one body: draped one by one, so that they begin inside each other, then untangled."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray, IntArray, check_number
from clothgym.body import Body
from clothgym.detection.body_mesh import BodyMesh
from clothgym.detection.openings import Threading, threading
from clothgym.dressing.draping import Draped
from clothgym.dressing.worn import expected_limbs, paths
from clothgym.mesh import Mesh
from clothgym.rig import Limb
from clothgym.scene import Cloth, Scene
from clothgym.simulation import Simulation

LAYER = 8e-3
"""[m] a garment starts at least this far outside of what it lies on."""
_DEEP = 0.08
"""[m] what is deeper inside of a garment is on the other side of the body."""
_SAME = 1e-4
"""[m] nearer than this two places are the same: no direction tells on which side one lies."""
_ROUNDS, _SMOOTHING = 8, 3


@dataclass(frozen=True, eq=False)
class Layered:
    """Garments over each other.

    Attributes:
        report: hits_start and hits (at the end), passes (of untangling until the first state without hits, -1 = there was
            none), steps (until then), hits_after (most hits in a step after that), worn (every opening, at the end),
            depth_max [m] below the true body, simulated_seconds, seconds (wall).
    """

    simulation: Simulation
    report: dict[str, Any]


def layer(garments: Sequence[Draped], seconds: float = 0.5) -> Layered:
    """Lets garments that were draped one by one hang over each other on the body that stands.

    Args:
        garments: on the same body, the inner ones first.
        seconds: how long [s].

    Raises:
        ValueError: no garments, or on different bodies.
        SimulationError: the simulation diverged.
    """
    check_number(seconds, "layer: seconds", 0.0, 1e4)
    started = time.perf_counter()
    scene = scene_of(garments, "layer")
    simulation = Simulation(scene, effort_of(garments))
    start = int(simulation.last_intersections.hit_count)
    passes, steps, after = (0, 0, 0) if start == 0 else (-1, -1, 0)
    for step in range(1, round(seconds / scene.step) + 1):
        simulation.step()
        hits = int(simulation.last_intersections.hit_count)
        if steps < 0 and hits == 0:
            passes, steps = simulation.untangling_passes, step
        elif steps >= 0:
            after = max(after, hits)
    found = openings(garments, simulation, scene.bodies[0].limbs)
    report = {
        "worn": all(opening.right for opening in found),
        "hits_start": start,
        "hits": int(simulation.last_intersections.hit_count),
        "passes": passes,
        "steps": steps,
        "hits_after": after,
        "depth_max": float(simulation.body_mesh.penetration(simulation.positions, simulation.faces).max()),
        "simulated_seconds": simulation.time,
        "seconds": time.perf_counter() - started,
    }
    return Layered(simulation, report)


def scene_of(garments: Sequence[Draped], what: str, damping: float | None = None) -> Scene:
    """The scene of the first garment with the cloths of all, where they hang.

    Args:
        garments: the inner ones first.
        what: begins the messages.
        damping: of all cloths [1/s]; default: as they were draped.

    Raises:
        ValueError: none, or on different bodies.
    """
    if not garments:
        raise ValueError(f"{what}: garments: none given")
    body = garments[0].body
    for other in garments[1:]:
        if not _same(other.body, body):
            raise ValueError(f"{what}: garments on different bodies: {body.name!r} and {other.body.name!r}")
    cloths: list[Cloth] = []
    below = [_surface(body.mesh)]
    for garment in garments:
        (cloth,) = garment.simulation.scene.cloths
        material: Any = cloth.material
        if damping is not None:
            material = dataclasses.replace(material, damping=damping)
        x = garment.positions if not cloths else _outside(garment.positions, garment.faces, below)
        mesh = Mesh(x, garment.faces, garment.garment.quads)
        below.append(_surface(mesh))
        cloths.append(dataclasses.replace(cloth, mesh=mesh, material=material))
    names = " and ".join(garment.garment.name for garment in garments)
    first = garments[0].simulation.scene
    return dataclasses.replace(
        first, cloths=tuple(cloths), bodies=(body,), self_collision=True, name=f"{names} on {body.name}"
    )


def _outside(x: FloatArray, faces: IntArray, below: Sequence[tuple[BodyMesh, FloatArray]]) -> FloatArray:
    """Vertices (V, 3) of a garment with these faces, brought out of the body and of the garments below it.

    All go away from the body, whose directions turn slowly from place to place, and take their neighbours along: a vertex that
    went where the garment below is nearest would fold the cloth. Beyond the border of a garment nothing is inside.
    """
    (body, _), *_ = below
    corners = np.bincount(faces.ravel(), minlength=len(x))
    for _ in range(_ROUNDS):
        way = x - body.closest(x)[0]
        way /= np.maximum(np.linalg.norm(way, axis=1), _SAME)[:, None]
        missing = np.zeros(len(x))
        for surface, normals in below:
            places, nearest = surface.closest(x)
            normal, off = normals[nearest], x - places
            height = np.einsum("vc,vc->v", off, normal)
            facing = np.linalg.norm(off - height[:, None] * normal, axis=1) <= np.maximum(np.abs(height), _SAME)
            low = facing & (height < LAYER) & (height > -_DEEP)
            missing = np.maximum(missing, np.where(low, LAYER - height, 0.0))
        if not missing.any():
            break
        for _ in range(_SMOOTHING):
            around = np.repeat(missing[faces].mean(axis=1), 3)
            missing = np.maximum(missing, np.bincount(faces.ravel(), around, minlength=len(x)) / np.maximum(corners, 1))
        x = x + missing[:, None] * way
    return x


def _surface(mesh: Mesh) -> tuple[BodyMesh, FloatArray]:
    """A mesh to ask for nearest places, and the normals of its faces (F, 3)."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-30)[:, None]
    return BodyMesh(mesh.vertices, mesh.faces), normals


def effort_of(garments: Sequence[Draped], parts: int = 1) -> Any:
    """The fidelity of the first garment with the most substeps that any of them hung with, over `parts` steps."""
    substeps = max(garment.simulation.pipeline.substeps for garment in garments)
    return dataclasses.replace(garments[0].simulation.fidelity, substeps=max(8, -(-substeps // parts)))


def openings(garments: Sequence[Draped], simulation: Simulation, limbs: Sequence[Limb]) -> list[Threading]:
    """What goes through every opening of the garments now, with the limbs where they are now."""
    x, found = np.array(simulation.positions), []
    for garment, (_, vertices, _) in zip(garments, simulation.cloth_ranges):
        expected = expected_limbs(garment.garment, garment.body)
        own = paths(garment.garment, expected, limbs)
        found += [threading(x[vertices][loop], own, name) for loop, name in zip(garment.garment.openings, expected)]
    return found


def _same(one: Body, other: Body) -> bool:
    return one is other or (one.name == other.name and np.array_equal(one.mesh.vertices, other.mesh.vertices))
