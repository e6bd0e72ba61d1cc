"""Bodies of a scene: a surface that cloth lies on, from the package, from arrays or from any mesh file.

woman = body.load("female", pose="a_pose")
table = body.load("table.glb", unit="cm", up="z")
for note in table.notes: print(note)           # what was found and done while reading
"""

from __future__ import annotations

import io
import os
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from clothgym import motion as motions
from clothgym import rig
from clothgym.arrays import BoolArray, FloatArray, IntArray, as_faces, as_points, check_choice, check_number, read_only
from clothgym.mesh import Mesh, Surface, copied, face_areas
from clothgym.motion import Motion
from clothgym.rig import Limb

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Units of mesh files [m]."""

_NO_SURFACES = {"zip", "tar.gz", "tar.bz2", "bz2", "dxf", "xyz", "svg", "dict", "dict64", "json", "msgpack"}
"""What trimesh reads besides meshes: archives, drawings, clouds of points, its own dumps."""


@dataclass(frozen=True, eq=False)
class Body:
    """A surface that cloth lies on. Arrays are copied and read-only.

    Parts whose faces run clockwise seen from outside, or some of whose faces do, are turned; see `notes`.

    Args:
        mesh: a `Mesh`, a trimesh.Trimesh, a pair (vertices, faces) [m], or "female" or "male"; becomes a `Mesh`.
        name: shown in tables and recordings.
        friction: coefficient of Coulomb friction, 0 to 10.
        slide: C_fric of [Vassilev 2001] eq. 12, the share of the sliding speed that a contact leaves a substep, 0 to 1; acts
            where `Fidelity.body_response` is "velocity".
        rebound: C_refl of eq. 12, the share of the approaching speed that a contact gives back, 0 to 1.
        limbs: paths that tell whether a garment is worn; a body of the package has its own.
        notes: one line each: what was found and done while reading, added to by what is found here.
        parts: names of its parts, and the number (F,) of the part that each face belongs to; None: it is one. Forces are told
            part by part, and boxes in object space have a tree for each. A body of the package has five.
        motion: how it moves, see `clothgym.motion`; None: it stands. The mesh is what it moves from; limbs stay there.

    Raises:
        ValueError: names the body, the field and the value.
    """

    mesh: Any
    name: str = "body"
    friction: float = 0.3
    slide: float = 0.99
    rebound: float = 0.0
    limbs: tuple[Limb, ...] = ()
    notes: tuple[str, ...] = ()
    motion: Motion | None = None
    parts: Any = None

    def __post_init__(self) -> None:
        label = f"body {self.name!r}"
        given, limbs = self.mesh, tuple(self.limbs)
        if isinstance(given, str):
            if given not in rig.NAMES:
                raise ValueError(
                    f"{label}: mesh = {given!r}: expected one of {', '.join(rig.NAMES)}; files are read by body.load"
                )
            limbs = limbs or rig.load(given).limbs()
            given = rig.load(given)
            if self.parts is None:
                object.__setattr__(self, "parts", (rig.PARTS, given.face_parts()))
        points, triangles = copied(given, label)
        if len(triangles) < 4:
            raise ValueError(f"{label}: faces: {len(triangles)} given; a body needs at least four triangles")
        check_number(self.friction, f"{label}: friction", 0.0, 10.0)
        check_number(self.slide, f"{label}: slide", 0.0, 1.0)
        check_number(self.rebound, f"{label}: rebound", 0.0, 1.0)
        for number, limb in enumerate(limbs):
            if not isinstance(limb, Limb):
                raise ValueError(f"{label}: limbs[{number}] = {type(limb).__name__}: expected a Limb")
        if self.parts is not None:
            object.__setattr__(self, "parts", _parts(self.parts, len(triangles), label))
        triangles, found = _examined(points, triangles, label)
        notes = dict.fromkeys([*self.notes, *(f"{self.name}: {note}" for note in found)])
        object.__setattr__(self, "mesh", Mesh(read_only(points), read_only(triangles)))
        object.__setattr__(self, "limbs", limbs)
        object.__setattr__(self, "notes", tuple(notes))
        if self.motion is not None and np.shape(self.at(0.0)) != points.shape:
            raise ValueError(
                f"{label}: motion: its vertices have the shape {np.shape(self.at(0.0))}, not {points.shape}"
            )

    def at(self, time: float) -> FloatArray:
        """(V, 3) where the vertices are at a time [m]."""
        vertices: FloatArray = self.mesh.vertices
        return vertices if self.motion is None else _moved(self, time)

    def to_json(self) -> dict[str, Any]:
        """Plain values without the notes; floats survive exactly."""
        return {
            "name": self.name,
            "vertices": self.mesh.vertices.tolist(),
            "faces": self.mesh.faces.tolist(),
            "friction": self.friction,
            "slide": self.slide,
            "rebound": self.rebound,
            "limbs": [limb.to_json() for limb in self.limbs],
            **({} if self.motion is None else {"motion": self.motion.to_json()}),
            **({} if self.parts is None else {"parts": [list(self.parts[0]), self.parts[1].tolist()]}),
        }

    @staticmethod
    def from_json(values: dict[str, Any]) -> Body:
        """Raises ValueError for missing or unknown fields, by name."""
        known = {"name", "vertices", "faces", "friction", "slide", "rebound", "limbs"}
        if wrong := (set(values) - {"motion", "parts"}) ^ known:
            raise ValueError(f"body.{min(wrong)}: unknown or missing field; expected {', '.join(sorted(known))}")
        limbs = tuple(Limb.from_json(limb) for limb in values["limbs"])
        mesh = values["vertices"], values["faces"]
        motion = motions.from_json(values.get("motion"))
        answer = values["friction"], values["slide"], values["rebound"]
        return Body(mesh, values["name"], *answer, limbs, motion=motion, parts=values.get("parts"))


@lru_cache(maxsize=8)
def _moved(body: Body, time: float) -> FloatArray:
    """A body's vertices, read-only: where one step ends the next begins, and what looks at a step asks for that place again."""
    assert body.motion is not None
    return read_only(body.motion.vertices(body.mesh.vertices, time))


def named(bodies: Sequence[Body]) -> list[tuple[str, Body]]:
    """Bodies with names that differ: those that share one are numbered."""
    found: dict[str, Body] = {}
    for body in bodies:
        name, count = str(body.name), 1
        while name in found:
            count += 1
            name = f"{body.name} {count}"
        found[name] = body
    return list(found.items())


def part_numbers(bodies: Sequence[Body]) -> tuple[tuple[str, ...], IntArray]:
    """Names of the parts of all bodies, "body: part" where a body has several, and the part (F,) of each face of `joined`."""
    names: list[str] = []
    numbers = []
    for name, body in named(bodies):
        of_face = np.zeros(len(body.mesh.faces), np.int32) if body.parts is None else body.parts[1]
        numbers.append(of_face + np.int32(len(names)))
        names += [name] if body.parts is None else [f"{name}: {part}" for part in body.parts[0]]
    return tuple(names), np.concatenate(numbers)


def vertices_at(bodies: Sequence[Body], time: float) -> FloatArray:
    """(V, 3) [m] vertices of all bodies at a time."""
    return np.concatenate([body.at(time) for body in bodies])


def joined(bodies: Sequence[Body]) -> tuple[FloatArray, IntArray]:
    """Vertices (V, 3) [m] at the start and faces (F, 3) of all bodies together."""
    starts = np.cumsum([0, *(len(body.mesh.vertices) for body in bodies)])
    faces = [body.mesh.faces + np.int32(start) for body, start in zip(bodies, starts)]
    return vertices_at(bodies, 0.0), np.concatenate(faces)


def load(
    source: str | os.PathLike[str],
    pose: str = "rest",
    unit: str | None = None,
    up: str | None = None,
    name: str | None = None,
) -> Body:
    """A body of the package in a pose, or the body in a mesh file. It stays where it is: nothing is set on the ground.

    Of a file, all parts are taken as one surface and vertices at exactly the same place become one.

    Args:
        source: "female", "male", or a file of any mesh format that trimesh reads; a folder of such or an .npz is a body that
            moves, see `body_sequence.load`.
        pose: one of `rig.poses()`; a file has no skeleton and knows "rest" only.
        unit: unit of the file, one of `UNITS`; default: metres up to a height of 10, else centimetres, from 600 on
            millimetres, and a note.
        up: "y" or "z", the file's axis that points up; default: y, or z for what stands on z = 0 and is more than twice
            as tall along z as along y, and a note. z up becomes y up by a quarter turn about x.
        name: default: the source's name.

    Raises:
        ValueError: one line with the file, the field and the value.
    """
    if up is not None:
        check_choice(up, "up", ("y", "z"))
    if unit is not None:
        check_choice(unit, "unit", tuple(UNITS))
    if isinstance(source, str) and source in rig.NAMES:
        if unit not in (None, "m") or up not in (None, "y"):
            raise ValueError(
                f"body {source!r}: unit = {unit!r}, up = {up!r}: bodies of the package have metres and y up"
            )
        return _of_package(source, pose, name or source)
    path = Path(source)
    if pose != "rest":
        raise ValueError(f"{path}: pose = {pose!r}: a mesh file has no skeleton; expected rest")
    if path.is_dir() or path.suffix.lower() in (".npz", ".npy"):
        from clothgym import body_sequence

        return body_sequence.load(path, unit=unit, up=up, name=name)
    vertices, faces = merged(*read(path))
    unit, up, notes = decide(vertices, unit, up)
    try:
        return Body(
            (in_world(vertices, unit, up), faces),
            name or path.stem,
            notes=tuple(f"{path.name}: {note}" for note in notes),
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


@lru_cache(maxsize=8)
def _of_package(source: str, pose: str, name: str) -> Body:
    """Kept, so that its sizes, maps and exact surface are found once."""
    skinned = rig.load(source)
    parts = rig.PARTS, skinned.face_parts()
    return Body((skinned.posed(pose), skinned.faces), name, limbs=skinned.limbs(pose), parts=parts)


def formats() -> list[str]:
    """Endings of the meshes that can be read, without the dot."""
    import trimesh

    return sorted(set(trimesh.available_formats()) - _NO_SURFACES)


def read(path: Path) -> tuple[FloatArray, IntArray]:
    """Vertices and triangles of a file as they stand there; files beside it (materials, textures) are not opened."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file, and no body of the package ({', '.join(rig.NAMES)})")
    import trimesh

    ending = path.suffix.lstrip(".").lower()
    known = formats()
    if ending not in known:
        raise ValueError(f"{path}: cannot read {path.suffix or 'a file without ending'!r}: expected {', '.join(known)}")
    # texture seams must not multiply vertices: those of a sequence are told by their order in the file
    options: dict[str, Any] = {"skip_materials": True, "maintain_order": True} if ending == "obj" else {}
    try:
        mesh = trimesh.load_mesh(io.BytesIO(path.read_bytes()), file_type=ending, process=False, **options)
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    except Exception as error:  # readers of broken files fail in every way there is
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}: cannot be read as {ending}: {reason}") from error
    try:
        if vertices.ndim != 2 or len(faces) == 0:
            raise ValueError("faces: holds no triangle")
        points = as_points(vertices)
        return points, as_faces(faces, len(points))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def merged(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Vertices (V, K) at exactly the same place, or places, as one, faces that lose a corner by that and unused vertices left
    out; order of first use stays."""
    _, first, inverse = np.unique(vertices + 0.0, axis=0, return_index=True, return_inverse=True)
    joined = first[inverse.ravel()][faces]
    whole = (joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])
    used, renumbered = np.unique(joined[whole], return_inverse=True)
    return vertices[used], np.ascontiguousarray(renumbered.reshape(-1, 3), np.int32)


def decide(vertices: FloatArray, unit: str | None, up: str | None) -> tuple[str, str, list[str]]:
    """Unit and axis that points up of what a file holds, where they are not given, and what was decided."""
    notes: list[str] = []
    if len(vertices) == 0:
        return unit or "m", up or "y", notes  # `Body` says what is missing
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = high - low
    if up is None:
        up = "y"
        if size[2] > 2.0 * size[1]:
            stands = abs(low[2]) < 0.05 * size[2] and low[1] < -0.1 * size[1] and high[1] > 0.1 * size[1]
            up = "z" if stands else "y"
            reason = f"{size[2]:g} long along z, {size[1]:g} along y"
            notes.append(f"{reason}: read with {up} up (up='{'y' if stands else 'z'}' to override)")
    tall = float(size[2] if up == "z" else size[1])
    if unit is None:
        unit = "m" if tall <= 10.0 else ("cm" if tall < 600.0 else "mm")
        if unit != "m":
            words = {"cm": "centimetres", "mm": "millimetres"}
            notes.append(f"{tall:g} units high, read as {words[unit]} (unit='m' to override)")
        elif tall < 0.1:
            notes.append(f"{tall:g} units high, read as metres (unit=... to override)")
    return unit, up, notes


def in_world(vertices: FloatArray, unit: str, up: str) -> FloatArray:
    """Vertices (..., 3) [m] with y up."""
    if up == "z":
        vertices = np.ascontiguousarray(vertices[..., [0, 2, 1]] * (1.0, 1.0, -1.0))
    return vertices * UNITS[unit]


def _parts(given: Any, face_count: int, label: str) -> tuple[tuple[str, ...], IntArray]:
    """Names and numbers of the parts, checked."""
    if not isinstance(given, tuple | list) or len(given) != 2 or isinstance(given[0], str):
        raise ValueError(f"{label}: parts: expected (names, the number of the part of each face)")
    names, numbers = tuple(given[0]), np.array(given[1])
    if not names or not all(isinstance(name, str) and name for name in names) or len(set(names)) < len(names):
        raise ValueError(f"{label}: parts: names = {given[0]!r}: expected texts that differ")
    if numbers.shape != (face_count,) or numbers.dtype.kind not in "iu":
        raise ValueError(f"{label}: parts: expected ({face_count},) whole numbers, got {numbers.dtype} {numbers.shape}")
    if numbers.min() < 0 or numbers.max() >= len(names):
        wrong = int(numbers[(numbers < 0) | (numbers >= len(names))][0])
        raise ValueError(f"{label}: parts: number {wrong}: there are {len(names)} names")
    return names, read_only(numbers.astype(np.int32))


def _examined(points: FloatArray, faces: IntArray, label: str) -> tuple[IntArray, list[str]]:
    """Faces that run counter-clockwise seen from outside, and what was found."""
    notes = []
    areas = face_areas(points, faces)
    size = float(np.linalg.norm(np.ptp(points[faces].reshape(-1, 3), axis=0)))
    flat = int((areas <= 1e-12 * size * size).sum())
    if flat == len(faces):
        raise ValueError(f"{label}: faces: all {flat} triangles have no area")
    if flat:
        notes.append(f"{flat} of {len(faces)} triangles have no area")
    surface = Surface(faces, len(points))
    turned, part, twisted = _turned(points, surface, 1e-9 * size**3)
    faces = faces.copy()
    ids = surface.face_ids[turned]
    faces[ids] = faces[ids][:, [0, 2, 1]]
    parts = int(part.max()) + 1
    whole = np.bincount(part, turned) == np.bincount(part)
    if whole.any():
        notes.append(f"{int(whole.sum())} of {parts} parts faced inwards and were turned over")
    if mixed := int((turned & ~whole[part]).sum()):
        notes.append(f"{mixed} of {len(faces)} triangles ran against their neighbours and were turned over")
    if twisted:
        notes.append(f"{twisted} edges where the two sides cannot be told apart: distances there have no reliable sign")
    counts = surface.edge_face_count
    if opened := int((counts == 1).sum()):
        notes.append(f"not closed, {opened} open edges: distances near the holes have no reliable sign")
    if crowded := int((counts > 2).sum()):
        notes.append(f"{crowded} edges with more than two triangles: distances there have no reliable sign")
    return faces, notes


def _turned(points: FloatArray, surface: Surface, least_volume: float) -> tuple[BoolArray, IntArray, int]:
    """Which faces (F,) must be turned so that neighbours agree and every part holds a positive volume, the part (F,) of
    each face, and the number of edges whose faces cannot agree. Parts hang together by edges with two faces."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    faces = surface.faces
    count = len(faces)
    by_edge = np.argsort(surface.face_edges.ravel(), kind="stable")
    ascending = (faces < faces[:, [1, 2, 0]]).ravel()[by_edge]
    place = surface.edge_face_start[:-1][surface.edge_face_count == 2]
    pairs = np.stack([by_edge[place] // 3, by_edge[place + 1] // 3], axis=1)
    against = ascending[place] == ascending[place + 1]
    graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    part = connected_components(graph, directed=False)[1].astype(np.int32)
    turned = _agreeing(pairs[(hurt := np.isin(part[pairs[:, 0]], part[pairs[against, 0]]))], against[hurt], count)
    twisted = int((against ^ turned[pairs[:, 0]] ^ turned[pairs[:, 1]]).sum())

    corners = points[faces]
    sizes = np.bincount(part)
    centre = np.stack([np.bincount(part, corners[:, :, axis].mean(axis=1)) / sizes for axis in range(3)], axis=1)
    a, b, c = (corners[:, n] - centre[part] for n in range(3))
    volume = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6.0
    inward = np.bincount(part, np.where(turned, -volume, volume)) < -least_volume
    return turned ^ inward[part], part, twisted


def _agreeing(pairs: IntArray, against: BoolArray, count: int) -> BoolArray:
    """Which of `count` faces to turn so that neighbours (P, 2) agree where they do not, from the first face of each part."""
    turned = np.zeros(count, bool)
    neighbours: dict[int, list[tuple[int, bool]]] = {}
    for (f, g), differs in zip(pairs.tolist(), against.tolist()):
        neighbours.setdefault(f, []).append((g, differs))
        neighbours.setdefault(g, []).append((f, differs))
    seen: set[int] = set()
    for first in sorted(neighbours):
        if first in seen:
            continue
        seen.add(first)
        todo = deque([first])
        while todo:
            f = todo.popleft()
            for g, differs in neighbours[f]:
                if g not in seen:
                    seen.add(g)
                    turned[g] = turned[f] != differs
                    todo.append(g)
    return turned
