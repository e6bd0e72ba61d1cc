"""The scenes of [Mezger 2003, 7]: a table cloth, sheets on objects, a long tape, and trousers around a walking body."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from clothgym import rig
from clothgym.arrays import BoolArray, FloatArray, IntArray, check_number
from clothgym.body import Body
from clothgym.materials import Material
from clothgym.mesh import Mesh, Surface, grid
from clothgym.rig import section_hull
from clothgym.scene import Cloth, Scene

_LINEN = Material(density=0.2, stretch=5e3, shear=5e2, flexion=1e-2, damping=1.0, friction=0.4, thickness=4e-3)


def _revolved(profile: FloatArray, sections: int) -> Mesh:
    """Closed surface of revolution about y; the profile (N, 2) of radius and height runs from top to bottom pole."""
    angles = np.linspace(0.0, 2.0 * np.pi, sections, endpoint=False)
    inner = profile[1:-1]
    rings = np.stack(
        [
            np.outer(inner[:, 0], np.sin(angles)),
            np.repeat(inner[:, 1:], sections, axis=1),
            np.outer(inner[:, 0], np.cos(angles)),
        ],
        axis=2,
    ).reshape(-1, 3)
    vertices = np.concatenate([[[0.0, profile[0, 1], 0.0]], rings, [[0.0, profile[-1, 1], 0.0]]])
    here = np.arange(sections)
    on = (here + 1) % sections
    last = 1 + (len(inner) - 1) * sections
    faces = [np.stack([np.zeros_like(here), 1 + here, 1 + on], axis=1)]
    for ring in range(len(inner) - 1):
        a, b = 1 + ring * sections, 1 + (ring + 1) * sections
        faces.append(np.stack([a + here, b + here, b + on], axis=1))
        faces.append(np.stack([a + here, b + on, a + on], axis=1))
    faces.append(np.stack([np.full_like(here, len(vertices) - 1), last + on, last + here], axis=1))
    return Mesh(vertices, np.concatenate(faces).astype(np.int32))


def _ellipsoid(radii: tuple[float, float, float], centre: tuple[float, float, float], rings: int = 24) -> Mesh:
    polar = np.linspace(0.0, np.pi, rings + 1)
    ball = _revolved(np.stack([np.sin(polar), np.cos(polar)], axis=1), 2 * rings)
    return Mesh(ball.vertices * np.asarray(radii) + np.asarray(centre), ball.faces)


def _box(size: tuple[float, float, float], centre: tuple[float, float, float]) -> Mesh:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = np.array([[s[0], s[n], s[n + 1]] for s in sides for n in (1, 2)], np.int32)
    return Mesh(corners * np.asarray(size) + np.asarray(centre), faces)


def round_table(radius: float = 0.35, height: float = 0.7, thickness: float = 0.03) -> Mesh:
    """A round table top around the y axis, its upper side at `height`."""
    across = np.array([0.0, 0.5 * radius, radius, radius, 0.5 * radius, 0.0])
    up = np.array([height, height, height, height - thickness, height - thickness, height - thickness])
    return _revolved(np.stack([across, up], axis=1), 48)


def table_cloth(side: float = 1.0, radius: float = 0.35, resolution: int = 6) -> Scene:
    """A coarse square cloth of 49 vertices and 72 triangles falls on a round table top [Mezger 2003, Fig. 8]: edges of the
    cloth reach over the rim between its vertices, so that a test of vertices alone lets the rim through."""
    mesh = grid(side, side, resolution, resolution)
    height = 0.7
    lifted = mesh.transformed(translation=(0.0, height + 0.03, 0.0))
    cloth = Cloth(lifted, _LINEN, (), mesh.vertices, "table cloth")
    table = Body(round_table(radius, height), "table", friction=0.6)
    return Scene((cloth,), ground=0.0, bodies=(table,), step=0.01, duration=2.0, name="table_cloth")


def sheets_on_objects(sheets: int = 2, side: float = 0.9) -> Scene:
    """Sheets of 441 vertices each fall, one on the other, on a ball and a box [Mezger 2003, Fig. 10]."""
    mesh = grid(side, side, 20, 20)
    rng = np.random.default_rng(3)
    cloths = []
    for n in range(sheets):
        vertices = mesh.transformed(translation=(0.02 * n, 0.47 + 0.03 * n, 0.03 * n)).vertices
        vertices[:, 1] += 1e-3 * rng.uniform(-1.0, 1.0, len(vertices))
        cloths.append(Cloth(Mesh(vertices, mesh.faces, mesh.quads), _LINEN, (), mesh.vertices, f"sheet {n}"))
    bodies = (
        Body(_ellipsoid((0.2, 0.2, 0.2), (-0.24, 0.22, 0.0)), "ball", friction=0.4),
        Body(_box((0.3, 0.3, 0.3), (0.24, 0.15, 0.0)), "box", friction=0.4),
    )
    return Scene(tuple(cloths), ground=0.0, bodies=bodies, step=0.01, duration=2.0, name="sheets_on_objects")


def tape(length: float = 2.06, width: float = 0.06) -> Scene:
    """A tape of 1,449 vertices, 7 across and 207 along, drops upright on a curved surface and folds [Mezger 2003, Fig. 11]."""
    mesh = grid(length, width, 206, 6)
    along = mesh.vertices[:, 0] - mesh.vertices[:, 0].min()
    order, place = np.unique(along, return_inverse=True)
    middle = 0.5 * (order[1:] + order[:-1])
    bend = 0.5 * np.sin(2.0 * np.pi * middle / 0.23) + 0.2 * np.sin(2.0 * np.pi * middle / 0.61)
    steps = np.diff(order)[:, None] * np.stack([np.sin(bend), np.cos(bend)], axis=1)
    line = np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)])
    line[:, 0] -= line[:, 0].mean()
    vertices = np.stack([line[place, 0], 0.66 + line[place, 1], mesh.vertices[:, 2]], axis=1)
    material = Material(density=0.2, stretch=2e3, shear=5e2, flexion=1e-3, damping=1.0, friction=0.3, thickness=2e-3)
    cloth = Cloth(Mesh(vertices, mesh.faces, mesh.quads), material, (), mesh.vertices, "tape")
    hill = Body(_ellipsoid((0.5, 0.3, 0.4), (0.0, 0.31, 0.0)), "hill", friction=0.3)
    return Scene((cloth,), ground=0.0, bodies=(hill,), step=0.01, duration=2.0, name="tape")


# Trousers on a walking body: motion without simulation, for benchmarks of detection

AROUND, BRIDGE, HIP_ROWS, LEG_ROWS = 22, 2, 10, 22
"""Vertices around the hip, between the legs, rows of the hip, rows of each leg: 838 vertices and 1,628 triangles."""

_EASE = 0.015
_CLEARANCE = 0.004
_STRIDE = 1.2


class WalkFrame(NamedTuple):
    """One step of `walk`: positions [m] at its start and the constant velocities [m/s] that lead to the next."""

    body: FloatArray
    trousers: FloatArray
    body_velocities: FloatArray
    trouser_velocities: FloatArray


def _around(hull: FloatArray, centre: FloatArray, angles: FloatArray) -> FloatArray:
    """(N, 2) places (x, z) on a convex outline, in directions counted from z towards x, moved outwards by the ease."""
    places = np.empty((len(angles), 2))
    ends = np.roll(hull, -1, axis=0)
    for n, angle in enumerate(angles):
        way = np.array([np.sin(angle), np.cos(angle)])
        side = ends - hull
        denominator = way[0] * side[:, 1] - way[1] * side[:, 0]
        offset = hull - centre
        with np.errstate(divide="ignore", invalid="ignore"):
            far = (offset[:, 0] * side[:, 1] - offset[:, 1] * side[:, 0]) / denominator
            share = (offset[:, 0] * way[1] - offset[:, 1] * way[0]) / denominator
        hit = (share >= 0.0) & (share <= 1.0) & (far > 0.0)
        places[n] = centre + (far[hit].max() + _EASE) * way
    return places


def _below_the_arms(skin: rig.Rig) -> BoolArray:
    """(V,) skin that the arms do not carry."""
    arms = [n for n, name in enumerate(skin.bones) if name.startswith(rig.ARM_BONES)]
    return np.asarray(skin.weights)[:, arms].sum(axis=1) < 0.1


@lru_cache(maxsize=2)
def trousers(body: str = "female") -> Mesh:
    """Two open tubes joined at the hip around a body of the package at rest: 838 vertices, 1,628 triangles, no seam.

    The paper's have 833 and 1,626.
    """
    skin = rig.load(body)
    points, faces = np.asarray(skin.vertices), np.asarray(skin.faces)
    heads, _ = skin.posed_bones("rest")
    faces = faces[_below_the_arms(skin)[faces].all(axis=1)]
    knee = heads[skin.bone("calf_l"), 1]
    top = skin.measures("rest").waist_height - 0.01
    middle = np.abs(points[:, 0]) < 0.008
    crotch = points[middle & (points[:, 1] > knee + 0.1), 1].min() - 0.015
    vertices: list[FloatArray] = []
    angles = 2.0 * np.pi * np.arange(AROUND) / AROUND
    for height in np.linspace(top, crotch, HIP_ROWS):
        hull = section_hull(points, faces, float(max(height, crotch + 0.03)))
        ring = _around(hull, 0.5 * (hull.min(axis=0) + hull.max(axis=0)), angles)
        vertices.append(np.stack([ring[:, 0], np.full(AROUND, height), ring[:, 1]], axis=1))
    front, back = vertices[-1][0], vertices[-1][AROUND // 2]
    shares = (np.arange(BRIDGE) + 1.0)[:, None] / (BRIDGE + 1.0)
    vertices.append(back + shares * (front - back) - (0.0, 0.005, 0.0))
    low = heads[skin.bone("foot_l"), 1] + 0.04
    size = AROUND // 2 + 1 + BRIDGE
    inner = 1.5 * np.pi
    directions = inner + (np.arange(size) - (size - 1 - 0.5 * (BRIDGE - 1))) * 2.0 * np.pi / size
    legs: list[list[FloatArray]] = []
    for side in (1.0, -1.0):
        own = faces[(side * points[faces, 0]).min(axis=1) > 0.0]
        rows = []
        for height in np.linspace(crotch, low, LEG_ROWS + 1)[1:]:
            hull = section_hull(points, own, float(height))
            ring = _around(hull, 0.5 * (hull.min(axis=0) + hull.max(axis=0)), side * directions)
            ring[:, 0] = side * np.maximum(side * ring[:, 0], 0.003)
            rows.append(np.stack([ring[:, 0], np.full(size, height), ring[:, 1]], axis=1))
        legs.append(rows)
        vertices.extend(rows)
    return Mesh(np.concatenate(vertices), _trouser_faces(size))


def _trouser_faces(size: int) -> IntArray:
    strips: list[tuple[IntArray, IntArray, bool]] = []
    for row in range(HIP_ROWS - 1):
        upper = np.arange(AROUND, dtype=np.int32) + row * AROUND
        strips.append((upper, upper + AROUND, False))
    last = (HIP_ROWS - 1) * AROUND
    bridge = HIP_ROWS * AROUND + np.arange(BRIDGE, dtype=np.int32)
    half = np.arange(AROUND // 2 + 1, dtype=np.int32)
    for leg, outer in enumerate((last + half, last + (AROUND - half) % AROUND)):
        upper = np.concatenate([outer, bridge])
        for row in range(LEG_ROWS):
            begin = HIP_ROWS * AROUND + BRIDGE + (leg * LEG_ROWS + row) * size
            lower = np.arange(begin, begin + size, dtype=np.int32)
            strips.append((upper, lower, leg == 1))
            upper = lower
    faces = []
    for a, b, mirrored in strips:
        c, d = np.roll(b, -1), np.roll(a, -1)
        two = np.stack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)], axis=1).reshape(-1, 3)
        faces.append(two[:, ::-1] if mirrored else two)
    return np.ascontiguousarray(np.concatenate(faces), np.int32)


@lru_cache(maxsize=2)
def _carriers(body: str) -> tuple[IntArray, FloatArray]:
    """The six nearest skin vertices (V, 6) of every trouser vertex, and their shares; of the same leg below the hip."""
    from scipy.spatial import cKDTree

    skin = rig.load(body)
    points, mesh = np.asarray(skin.vertices), trousers(body)
    trunk = _below_the_arms(skin)
    ids, shares = np.empty((len(mesh.vertices), 6), np.int32), np.empty((len(mesh.vertices), 6))
    begin = HIP_ROWS * AROUND + BRIDGE
    half = (len(mesh.vertices) - begin) // 2
    parts = (
        (np.arange(begin), trunk),
        (np.arange(begin, begin + half), trunk & (points[:, 0] > 0.0)),
        (np.arange(begin + half, len(mesh.vertices)), trunk & (points[:, 0] < 0.0)),
    )
    for rows, allowed in parts:
        known = np.flatnonzero(allowed)
        distance, near = cKDTree(points[known]).query(mesh.vertices[rows], k=6)
        share = 1.0 / (distance + 0.01)
        ids[rows], shares[rows] = known[near], share / share.sum(axis=1, keepdims=True)
    return ids, shares


def walk(steps: int = 600, dt: float = 0.01, body: str = "female") -> Iterator[WalkFrame]:
    """Trousers that follow a body walking on the spot, a stride in 1.2 s: positions and velocities of each step.

    Every vertex of the trousers moves with the skin near it and is pushed out of the body, along the exact distance, to at
    least 4 mm. Between the ends of a step all vertices move straight.

    Raises:
        ValueError: a number out of range.
    """
    from clothgym.detection.body_mesh import BodyMesh

    count = int(check_number(steps, "steps", 1, 1_000_000, integer=True))
    dt = float(check_number(dt, "dt", 1e-6, 1.0))
    skin, mesh = rig.load(body), trousers(body)
    ids, shares = _carriers(body)
    closed = BodyMesh(skin.vertices, skin.faces)
    start, neighbours, _ = Surface(mesh.faces, len(mesh.vertices)).neighbourhood
    owner = np.repeat(np.arange(len(mesh.vertices)), np.diff(start))

    def at(step: int) -> tuple[FloatArray, FloatArray]:
        pose = f"walk:{(step * dt / _STRIDE) % 1.0!r}"
        points = skin.posed(pose)
        carried = mesh.vertices + np.einsum("vn,vnc->vc", shares, (points - skin.vertices)[ids])
        around = np.stack([np.bincount(owner, carried[neighbours, c]) for c in range(3)], axis=1)
        carried = 0.5 * carried + 0.5 * around / np.diff(start)[:, None]
        closed.move(points)
        for _ in range(3):
            depth = closed.signed_distance(carried)
            near = depth < _CLEARANCE
            if not near.any():
                break
            away = (carried[near] - closed.closest(carried[near])[0]) * np.sign(depth[near])[:, None]
            size = np.linalg.norm(away, axis=1, keepdims=True)
            carried[near] += (_CLEARANCE * 1.05 - depth[near])[:, None] * away / np.maximum(size, 1e-12)
        return points, carried

    here = at(0)
    for step in range(1, count + 1):
        there = at(step)
        yield WalkFrame(*here, (there[0] - here[0]) / dt, (there[1] - here[1]) / dt)
        here = there


MAKERS = {"table_cloth": table_cloth, "sheets_on_objects": sheets_on_objects, "tape": tape}
PARAMETERS = {
    "table_cloth": {
        "side": ("m", 0.3, 3.0, "side of the cloth"),
        "radius": ("m", 0.1, 1.0, "of the table top"),
        "resolution": ("cells", 2, 128, "cells a side; 6 as in the paper"),
    },
    "sheets_on_objects": {
        "sheets": ("", 1, 8, "number of sheets"),
        "side": ("m", 0.3, 3.0, "side of a sheet"),
    },
    "tape": {
        "length": ("m", 0.5, 10.0, "length of the tape"),
        "width": ("m", 0.01, 0.3, "width of the tape"),
    },
}
