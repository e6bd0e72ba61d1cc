"""Scenes at the extremes: each drives one quantity from the usual to the absurd."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.mesh import Mesh

CELLS = 8
STRETCH = 1e3
"""Structural stiffness [N/m] that the map multiplies."""
SUBSTEP = 1.0 / 480.0
"""Time step [s] that the map multiplies: that of XPBD at the usual fidelity."""
_MATERIAL = cg.Material(density=0.15, stretch=1e4, shear=1e3, flexion=1e-2, damping=0.5, thickness=2e-3)


def kicked(mesh: Mesh, seed: int = 0) -> Mesh:
    """A flat mesh with every vertex out of plane by up to 1e-3 of an edge, so that nothing stays flat by symmetry."""
    edge = float(np.linalg.norm(mesh.vertices[mesh.faces[0, 1]] - mesh.vertices[mesh.faces[0, 0]]))
    kick = 1e-3 * edge * np.random.default_rng(seed).uniform(-1.0, 1.0, len(mesh.vertices))
    return Mesh(mesh.vertices + kick[:, None] * np.array([0.0, 1.0, 0.0]), mesh.faces, mesh.quads)


def sheet(cells: int = CELLS, **changes: float) -> cg.Cloth:
    """A sheet of 1 m x 1 m that hangs by two corners; material fields may be changed."""
    mesh = cg.grid(1.0, 1.0, cells, cells)
    material = dataclasses.replace(_MATERIAL, **changes)
    return cg.Cloth(kicked(mesh), material, (0, cells), mesh.vertices)


def map_scene(dt: float, stiffness: float) -> cg.Scene:
    """A sheet without contact whose step is one substep of `dt` times the usual, `stiffness` times as stiff."""
    k = STRETCH * stiffness
    cloth = sheet(stretch=k, shear=0.5 * k, flexion=0.0)
    cloth = dataclasses.replace(cloth, equal_masses=True)
    return cg.Scene((cloth,), self_collision=False, step=dt * SUBSTEP, name="map")


def _changed(field: str) -> Callable[[float], cg.Scene]:
    made: Any = sheet
    return lambda value: cg.Scene((made(**{field: value}),))


def _mass_ratio(value: float) -> cg.Scene:
    """A heavy sheet falls on a light one that hangs by its four corners."""
    mesh = cg.grid(1.0, 1.0, CELLS, CELLS)
    light = dataclasses.replace(_MATERIAL, density=0.02)
    heavy = dataclasses.replace(_MATERIAL, density=0.02 * value)
    n = CELLS + 1
    below = cg.Cloth(kicked(mesh), light, (0, CELLS, n * CELLS, n * n - 1), mesh.vertices, "light")
    small = cg.grid(0.5, 0.5, 5, 5)
    above = cg.Cloth(kicked(small.transformed(translation=(0.01, 0.03, 0.02))), heavy, (), small.vertices, "heavy")
    return cg.Scene((below, above))


def _graded(value: float) -> cg.Scene:
    """Neighbouring vertices whose masses differ: cells shrink along both sides, the largest area over the least = value."""
    mesh = cg.grid(1.0, 1.0, CELLS, CELLS)
    sizes = np.sqrt(value) ** (-np.arange(CELLS) / (CELLS - 1))
    places = np.concatenate([[0.0], np.cumsum(sizes)]) / sizes.sum() - 0.5
    z, x = np.meshgrid(-places, places, indexing="ij")
    vertices = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    graded = Mesh(vertices, mesh.faces, mesh.quads)
    return cg.Scene((cg.Cloth(kicked(graded), _MATERIAL, (0, CELLS), vertices),))


def _slivers(value: float) -> cg.Scene:
    """Triangles `value` times as long as high, in a strip that is taut between its two ends."""
    mesh = cg.grid(1.0, 1.0 / value, CELLS, CELLS)
    bare = Mesh(mesh.vertices, mesh.faces)
    return cg.Scene((cg.Cloth(bare, _MATERIAL, (0, CELLS)),))


def _without_area(value: float) -> cg.Scene:
    """Faces without area, `value` in percent of the usual ones: an edge is halved on one of its sides only, and a face on
    one line joins it to its halves; as many faces again name a vertex twice."""
    mesh = cg.grid(1.0, 1.0, CELLS, CELLS)
    vertices, faces = list(mesh.vertices), [tuple(face) for face in mesh.faces.tolist()]
    sides = {(face[k], face[(k + 1) % 3]): number for number, face in enumerate(faces) for k in range(3)}
    inner = [(a, b) for a, b in sides if a < b and (b, a) in sides]
    used: set[int] = set()
    wanted = int(len(faces) * value / 100.0)
    for a, b in inner[:: max(1, len(inner) // max(1, 2 * wanted))]:
        number = sides[b, a]
        if number in used or len(used) >= wanted:
            continue
        used.add(number)
        d = next(v for v in faces[number] if v not in (a, b))
        middle = len(vertices)
        vertices.append(0.5 * (vertices[a] + vertices[b]))
        faces[number] = (b, middle, d)
        faces += [(middle, a, d), (b, a, middle), (a, a, d)]
    return cg.Scene((cg.Cloth((np.array(vertices), np.array(faces)), _MATERIAL, (0, CELLS)),))


def _duplicates(value: float) -> cg.Scene:
    """Every face `value` times, the copies turned over in between."""
    mesh = cg.grid(1.0, 1.0, CELLS, CELLS)
    copies = [mesh.faces if k % 2 == 0 else mesh.faces[:, [0, 2, 1]] for k in range(int(value))]
    return cg.Scene((cg.Cloth((kicked(mesh).vertices, np.concatenate(copies)), _MATERIAL, (0, CELLS)),))


def _coincident(value: float) -> cg.Scene:
    """So many layers in exactly the same place."""
    mesh = cg.grid(1.0, 1.0, 5, 5)
    return cg.Scene([cg.Cloth(mesh, _MATERIAL, (0, 5), name=f"layer {k}") for k in range(int(value))])


def _offset(value: float) -> cg.Scene:
    cloth = sheet()
    moved = cloth.mesh.transformed(translation=(value, value, -value))
    return cg.Scene((cg.Cloth(moved, cloth.material, cloth.pins, moved.vertices),))


def _scaled(value: float) -> cg.Scene:
    """A sheet so wide; stiffness goes with its mass, so that the time step need not."""
    k = min(max(1e4 * value * value, 1e-6), 1e9)
    cloth = sheet(stretch=k, shear=0.1 * k, flexion=0.0)
    small = Mesh(cloth.mesh.vertices * value, cloth.mesh.faces, cloth.mesh.quads)
    return cg.Scene((cg.Cloth(small, cloth.material, cloth.pins),))


def _held(value: float) -> cg.Scene:
    return cg.Scene((dataclasses.replace(sheet(), pins=()),), grips=(cg.Grip(),))


def _pull(simulation: cg.Simulation, value: float) -> None:
    simulation.place_grip(0, simulation.positions[0])
    simulation.grasp(0, [0, 1, CELLS + 1])
    simulation.move_grip(0, np.array([0.6, 0.8, 0.0]) * value)


def _thrown_scene(value: float) -> cg.Scene:
    mesh = cg.grid(1.0, 1.0, CELLS, CELLS)
    start = kicked(mesh).transformed(translation=(0.0, 0.5, 0.0))
    return cg.Scene((cg.Cloth(start, _MATERIAL, (), mesh.vertices),), ground=0.0)


def _throw(simulation: cg.Simulation, value: float) -> None:
    simulation.set_velocities(np.tile([0.3 * value, -value, 0.0], (simulation.model.vertex_count, 1)))


def _body_scene(value: float) -> cg.Scene:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.25)
    mesh = cg.grid(1.0, 1.0, CELLS, CELLS)
    start = kicked(mesh).transformed(translation=(0.0, 0.3, 0.0))
    return cg.Scene((cg.Cloth(start, _MATERIAL, (), mesh.vertices),), bodies=(cg.Body(ball),))


@dataclass(frozen=True)
class Extreme:
    """A quantity and its values, the first of them usual.

    Attributes:
        unit: of the values.
        values: a quick run takes the last.
        act: what happens before the first step.
        worked: forces from outside act.
        falls: gravity must move the cloth.
    """

    unit: str
    values: tuple[float, ...]
    build: Callable[[float], cg.Scene]
    act: Callable[[cg.Simulation, float], None] | None = None
    worked: bool = False
    falls: bool = True

    def chosen(self, quick: bool) -> tuple[float, ...]:
        """The values of a quick or a full run."""
        return self.values[-1:] if quick else self.values


EXTREMES: dict[str, Extreme] = {
    "mass ratio of layers": Extreme("", (1.0, 1e2, 1e4), _mass_ratio),
    "mass ratio of neighbours": Extreme("", (1.0, 1e2, 1e4), _graded),
    "damping": Extreme("1/s", (0.0, 1.0, 1e2, 1e4), _changed("damping")),
    "resolution": Extreme("cells", (8, 2, 32, 16), lambda value: cg.Scene((sheet(int(value)),))),
    "stiffness": Extreme("N/m", (1e4, 1.0, 1e6, 1e9), _changed("stretch")),
    "thickness": Extreme("m", (2e-3, 1e-7, 1.0), _changed("thickness")),
    "gripper speed": Extreme("m/s", (0.25, 1.0, 10.0, 100.0), _held, _pull, worked=True, falls=False),
    "thrown at the ground": Extreme("m/s", (1.0, 10.0, 100.0), _thrown_scene, _throw, falls=False),
    "thrown at a ball": Extreme("m/s", (1.0, 10.0, 100.0), _body_scene, _throw, falls=False),
    "gravity": Extreme("g", (1.0, 10.0, 100.0), lambda value: cg.Scene((sheet(),), gravity=(0.0, -9.81 * value, 0.0))),
    "wind": Extreme(
        "m/s", (1.0, 1e2, 1e4), lambda value: cg.Scene((sheet(),), wind=(0.0, 0.0, value)), worked=True, falls=False
    ),
    "slivers": Extreme("aspect", (1.0, 30.0, 1e3), _slivers, falls=False),
    "faces without area": Extreme("%", (0.0, 10.0, 30.0), _without_area),
    "faces given several times": Extreme("copies", (1, 2, 3), _duplicates),
    "coincident layers": Extreme("layers", (1, 4, 2), _coincident),
    "distance from the origin": Extreme("m", (0.0, 1e3, 1e6, 1e8), _offset),
    "size": Extreme("m", (1.0, 1e-3, 1e3, 1e-6), _scaled),
}
