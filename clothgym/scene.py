"""Scenes: what exists. How well it is modelled is `Fidelity`'s matter."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from clothgym import materials
from clothgym import motion as motions
from clothgym.arrays import (
    FARTHEST,
    FloatArray,
    as_points,
    as_vector,
    check_each,
    check_flag,
    check_number,
    check_text,
    shown,
)
from clothgym.body import Body
from clothgym.materials import Material
from clothgym.mesh import Mesh, copied
from clothgym.motion import Motion

_STRONGEST = 1e6
"""Largest component of gravity [m/s^2] and wind [m/s]."""
_RANGES = (
    ("wind_drag", 0.0, 1e6),
    ("step", 1e-7, 10.0),
    ("duration", 0.0, 1e6),
    ("ground", -1e6, 1e6),
    ("ignored", 0.0, 1.0),
)


@dataclass(frozen=True, eq=False)
class Cloth:
    """A piece of cloth.

    Args:
        mesh: a `Mesh`, a trimesh.Trimesh, or a pair (vertices, faces): where the cloth starts [m].
        material: a name of `clothgym.materials.MATERIALS` or a `Material`.
        pins: ids of vertices that do not move, or move as `motion` says.
        rest: the shape without strain; default: the mesh as it starts. (V, 3), or (F, 3, 2) or (F, 3, 3): the corners of
            each face in a plane of its own, as a sewn garment has it, whose seam vertices lie in several panels.
        name: shown in tables and recordings.
        equal_masses: every vertex weighs the same, as in the papers; otherwise a third of the faces around it.
        motion: of the pinned vertices, see `clothgym.motion`; None = they stay. A cloth whose vertices are all pinned is a
            body of any shape, thin and hollow ones too, that touches cloth as cloth does.

    Raises:
        ValueError: names the cloth, the field and the value.
    """

    mesh: Any
    material: str | Material = "cotton"
    pins: Sequence[int] = ()
    rest: Any = None
    name: str = "cloth"
    equal_masses: bool = False
    motion: Motion | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", check_text(self.name, "cloth.name"))
        object.__setattr__(self, "equal_masses", check_flag(self.equal_masses, f"cloth {self.name!r}: equal_masses"))
        given = self.mesh
        quads = getattr(given, "quads", None) if isinstance(given, Mesh) else None
        points, triangles = copied(given, f"cloth {self.name!r}")
        if len(triangles) == 0:
            raise ValueError(f"cloth {self.name!r}: faces: a cloth needs at least one triangle")
        object.__setattr__(self, "mesh", Mesh(points, triangles, quads))
        object.__setattr__(self, "rest", _rest(self.rest, points, len(triangles), self.name))
        object.__setattr__(self, "material", materials.get(self.material))
        object.__setattr__(self, "pins", _pins(self.pins, len(points), self.name))
        if self.motion is not None and np.shape(self.motion.vertices(points, 0.0)) != points.shape:
            raise ValueError(f"cloth {self.name!r}: motion: moves another number of vertices than {len(points)}")
        if self.motion is not None and not self.pins:
            raise ValueError(f"cloth {self.name!r}: motion: moves the pinned vertices, and there are none")

    def to_json(self) -> dict[str, Any]:
        """Plain values; floats survive exactly."""
        quads = self.mesh.quads
        return {
            "name": self.name,
            "vertices": self.mesh.vertices.tolist(),
            "faces": self.mesh.faces.tolist(),
            "quads": None if quads is None else quads.tolist(),
            "rest": self.rest.tolist(),
            "material": materials.get(self.material).to_json(),
            "pins": list(self.pins),
            "equal_masses": self.equal_masses,
            "motion": None if self.motion is None else self.motion.to_json(),
        }

    @staticmethod
    def from_json(values: dict[str, Any]) -> Cloth:
        """Raises ValueError for missing or unknown fields, by name."""
        known = {"name", "vertices", "faces", "quads", "rest", "material", "pins", "equal_masses"}
        unknown = (set(values) - {"motion"}) ^ known  # scenes of before there was motion have none
        if unknown:
            raise ValueError(f"cloth.{min(unknown)}: unknown or missing field; expected {', '.join(sorted(known))}")
        quads = None if values["quads"] is None else np.asarray(values["quads"], np.int32)
        mesh = Mesh(np.asarray(values["vertices"], float), np.asarray(values["faces"], np.int32), quads)
        return Cloth(
            mesh,
            Material.from_json(values["material"]),
            values["pins"],
            values["rest"],
            values["name"],
            values["equal_masses"],
            motions.from_json(values.get("motion")),
        )


def _rest(given: Any, points: FloatArray, face_count: int, name: str) -> FloatArray:
    """(V, 3) or (F, 3, 3) rest shape."""
    if given is None:
        return points
    if np.ndim(given) != 3:
        return as_points(given, f"cloth {name!r}: rest", len(points), FARTHEST).copy()
    values = np.asarray(given, np.float64)
    if values.shape[:2] != (face_count, 3) or values.shape[2] not in (2, 3):
        raise ValueError(f"cloth {name!r}: rest: expected the corners of {face_count} faces, got shape {values.shape}")
    if values.shape[2] == 2:
        values = np.concatenate([values, np.zeros((face_count, 3, 1))], axis=2)
    as_points(values.reshape(-1, 3), f"cloth {name!r}: rest corners", limit=FARTHEST)
    return values.copy()


def _pins(given: Any, count: int, name: str) -> tuple[int, ...]:
    """Vertex ids from a list of ids or a mask (V,) of booleans."""
    if isinstance(given, str) or not np.iterable(given):
        raise ValueError(f"cloth {name!r}: pins = {shown(given)}: expected a list of vertex ids")
    values = np.asarray(given)
    if values.size == 0:
        return ()
    if values.dtype == np.bool_:
        if values.shape != (count,):
            raise ValueError(f"cloth {name!r}: pins: a mask needs {count} booleans, got shape {values.shape}")
        return tuple(int(i) for i in np.flatnonzero(values))
    pins = []
    for value in given:
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            raise ValueError(f"cloth {name!r}: pins: {shown(value)} is no vertex id")
        if not 0 <= value < count:
            raise ValueError(f"cloth {name!r}: pins: no vertex {shown(value)}, there are {count}")
        pins.append(int(value))
    return tuple(pins)


@dataclass(frozen=True)
class Grip:
    """A gripper: a moving point that holds vertices by a soft anchor.

    Attributes:
        radius: reach of a grasp [m].
        stiffness: of the whole anchor, shared by the vertices it holds [N/m].
        slip_force: above this the cloth slips through [N].
    """

    radius: float = 0.03
    stiffness: float = 500.0
    slip_force: float = 50.0

    def __post_init__(self) -> None:
        for field, low, high in (("radius", 1e-6, 10.0), ("stiffness", 1e-3, 1e9), ("slip_force", 1e-6, 1e9)):
            object.__setattr__(self, field, check_number(getattr(self, field), f"grip.{field}", low, high))


@dataclass(frozen=True, eq=False)
class Scene:
    """What exists: cloths, bodies, ground, wind, grippers, and whether cloth can touch cloth at all.

    Attributes:
        cloths: at least one.
        bodies: what the cloth lies on; they stand, or move as they are told (`Body.motion`).
        ground: height of a horizontal plane [m], None = none.
        gravity: [m/s^2].
        wind: velocity of the air [m/s]; wind_drag: force per area and speed across the cloth [N s/m^3].
        grips: grippers; they hold nothing until told so.
        self_collision: whether cloth can touch cloth; a scene that says no pays for no detection.
        step: length of a step (a frame) [s].
        duration: how long the scene is meant to run [s].
        ignored: share of all contacts between cloths and of all intersections that detection misses, drawn anew for every step:
            a test of robustness [Volino 2006, 3.1.2]. What is measured misses nothing.
        name: shown in tables and recordings.
    """

    cloths: Sequence[Cloth]
    bodies: Sequence[Body] = ()
    ground: float | None = None
    gravity: tuple[float, float, float] = (0.0, -9.81, 0.0)
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wind_drag: float = 0.5
    grips: Sequence[Grip] = ()
    self_collision: bool = True
    step: float = 1.0 / 60.0
    duration: float = 2.0
    ignored: float = 0.0
    name: str = "scene"

    def __post_init__(self) -> None:
        for field, kind in (("cloths", Cloth), ("bodies", Body), ("grips", Grip)):
            object.__setattr__(self, field, check_each(getattr(self, field), f"scene.{field}", kind))
        if not self.cloths:
            raise ValueError("scene.cloths: empty; a scene needs at least one cloth")
        for name in ("gravity", "wind"):
            vector = as_vector(getattr(self, name), f"scene.{name}", _STRONGEST)
            object.__setattr__(self, name, tuple(float(c) for c in vector))
        for field, low, high in _RANGES:
            if field != "ground" or self.ground is not None:
                # stored as plain numbers, so that JSON and hashes do not depend on the caller's types
                object.__setattr__(self, field, check_number(getattr(self, field), f"scene.{field}", low, high))
        object.__setattr__(self, "self_collision", check_flag(self.self_collision, "scene.self_collision"))
        for cloth in self.cloths:
            if cloth.motion is not None and not self.self_collision:
                raise ValueError(
                    f"cloth {cloth.name!r}: motion: needs scene.self_collision, without it nothing touches it"
                )
        object.__setattr__(self, "name", check_text(self.name, "scene.name"))

    @cached_property
    def digest(self) -> str:
        """Digest of everything in the scene; what equality and hash go by."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Scene) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def calm(self) -> bool:
        """Whether nothing does work on the cloth: no wind blows, no body moves."""
        return not self.moving and (self.wind_drag == 0.0 or not any(self.wind))

    @property
    def moving(self) -> bool:
        """Whether a body moves."""
        return any(body.motion is not None for body in self.bodies)

    @property
    def start(self) -> FloatArray:
        """(V, 3) where all cloths start, one after the other [m]."""
        return np.concatenate([cloth.mesh.vertices for cloth in self.cloths])

    def to_json(self) -> str:
        """One JSON object; floats survive exactly."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.init}
        values["cloths"] = [cloth.to_json() for cloth in self.cloths]
        values["bodies"] = [body.to_json() for body in self.bodies]
        values["grips"] = [dataclasses.asdict(grip) for grip in self.grips]
        return json.dumps(values)

    @staticmethod
    def from_json(text: str) -> Scene:
        """Raises ValueError for unknown fields and values out of range, by name."""
        values = json.loads(text)
        known = [f.name for f in dataclasses.fields(Scene) if f.init]
        unknown = set(values) - set(known)
        if unknown:
            raise ValueError(f"scene.{min(unknown)}: unknown field; known: {', '.join(known)}")
        if "cloths" not in values:
            raise ValueError("scene.cloths: missing")
        values["cloths"] = [Cloth.from_json(c) for c in values["cloths"]]
        values["bodies"] = [Body.from_json(b) for b in values.get("bodies", [])]
        grip_fields = {f.name for f in dataclasses.fields(Grip)}
        for grip in values.get("grips", []):
            if set(grip) - grip_fields:
                raise ValueError(
                    f"grip.{min(set(grip) - grip_fields)}: unknown field; known: {', '.join(sorted(grip_fields))}"
                )
        values["grips"] = [Grip(**g) for g in values.get("grips", [])]
        return Scene(**values)
