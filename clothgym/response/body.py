"""Contact with bodies within a step: the maps, and what the sweeps keep about each vertex."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from clothgym.arrays import BoolArray, FloatArray, IntArray
from clothgym.body import Body, vertices_at
from clothgym.detection.body_maps import BodyMaps
from clothgym.fidelity import Fidelity
from clothgym.kernels.body_contact import BodyContact
from clothgym.kernels.body_map import BodyMap
from clothgym.kernels.body_planes import BodyPlanes
from clothgym.kernels.clamped import between_bodies
from clothgym.model import ClothModel

if TYPE_CHECKING:
    from clothgym.stages.frame import Frame

REACH = 0.012
"""[m] a body is felt beside its outline by this much more than the tolerance: what a vertex may sink in a substep."""

_FACE_SHARE = 0.35
"""Points of faces keep this share of the tolerance: on a round limb they lie nearer than their corners."""

_FACE_PUSH = 2e-3
"""[m] a point of a face moves no further than this a sweep: a face across a limb must not throw its corners out."""

_SPARE, _FASTER = 0.02, 3.0
"""[m] and [m/s]: bodies that move are drawn this far around the cloth."""

_STRETCHED, _ACROSS = 2, 4
"""Room for points of faces: so many times what covers the cloth at rest, and so many more on each face."""

_CLAMPED = 0.1
"""Share of the tolerance by which bodies must push a vertex within a step before it can count as clamped."""


def face_points(parts: int) -> FloatArray:
    """(parts^2, 3) weights of the midpoints of the equal triangles that a face is cut into; 1: its own midpoint."""
    points = []
    for i in range(parts):
        for j in range(parts - i):
            points.append((i + 1 / 3, j + 1 / 3))
            if i + j < parts - 1:
                points.append((i + 2 / 3, j + 2 / 3))
    first_two = np.array(points).reshape(-1, 2) / max(parts, 1)
    return np.column_stack([first_two, 1.0 - first_two.sum(axis=1)])


def body_contact(
    near: BodyMap | BodyPlanes, faces: IntArray, vertex_count: int, tolerance: float, face_parts: int, **answer: Any
) -> BodyContact:
    """What sweeps need against a map, or against planes that were found; `answer` gives friction, slide, rebound and texel,
    without it 0, 1, 0 and None; with a texel, `room` is for so many of them."""
    points = face_points(face_parts)
    room = int(answer.get("room", len(faces) * len(points)))
    return BodyContact(
        map=near if isinstance(near, BodyMap) else None,
        found=near if isinstance(near, BodyPlanes) else None,
        tolerance=tolerance,
        face_tolerance=_FACE_SHARE * tolerance,
        face_push=_FACE_PUSH,
        friction=float(answer.get("friction", 0.0)),
        slide=float(answer.get("slide", 1.0)),
        rebound=float(answer.get("rebound", 0.0)),
        faces=np.ascontiguousarray(faces, np.int32),
        face_points=points,
        texel=answer.get("texel"),
        near_count=np.zeros(1, np.int64),
        near_corners=np.zeros((room, 3), np.int32),
        near_weights=np.zeros((room, 4)),
        clock=np.zeros(1),
        found_at=np.full((vertex_count, 3), np.inf),
        travel=np.zeros(vertex_count),
        side=np.zeros(vertex_count, np.int8),
        normal=np.zeros((vertex_count, 3)),
        pressed=np.zeros(vertex_count),
        dragged=np.zeros((vertex_count, 3)),
        moved=np.zeros((vertex_count, 3)),
        approach=np.zeros((vertex_count, 3)),
        carried=np.zeros((vertex_count, 3)),
        pushes=np.zeros((vertex_count, 7)),
        forces=np.zeros((vertex_count, 3)),
        squeeze=np.zeros((vertex_count, 4)),
    )


def _room(model: ClothModel, texel: float) -> int:
    """For points of all faces, one in each texel [m] that they cover: cloth seldom stretches to twice its area, but many of
    its faces may lie across texels of which they cover little."""
    return _STRETCHED * math.ceil(float(model.vertex_areas.sum()) / texel**2) + _ACROSS * len(model.faces)


def body_maps(bodies: tuple[Body, ...], fidelity: Fidelity) -> BodyMaps:
    """Maps of bodies as a fidelity has them. Those of bodies that stand still are drawn once and shared.

    Views by themselves: two see a person, around whom cloth hangs. On other things cloth lies, and views along z would see
    their tops edge-on: cloth trembled there and, on a ball, came to rest at 3 of 28 efforts only; with views along y, at all.
    """
    views = fidelity.body_views
    if views == "auto":
        views = "z" if all(body.limbs for body in bodies) else "zy"
    drawn = _drawn if any(body.motion is not None for body in bodies) else _shared
    return drawn(bodies, fidelity.map_size, fidelity.body_tolerance, fidelity.body_normals, views)


def _drawn(bodies: tuple[Body, ...], map_size: int, tolerance: float, normals: str, views: str) -> BodyMaps:
    return BodyMaps(bodies, map_size, tolerance + REACH, normals, views, tolerance)


_shared = lru_cache(maxsize=4)(_drawn)


class BodyResponse:
    """The maps of a scene's bodies and the buffers of contact with them; one friction for all bodies, their mean.

    The substep's answer: position correction to the tolerance, then Coulomb friction, or eq. 12 of [Vassilev 2001].

    Attributes:
        asked_in_sweeps: whether sweeps ask for themselves; else `look` does, before the sweeps of each substep.
    """

    asked_in_sweeps = True

    def __init__(self, model: ClothModel, fidelity: Fidelity) -> None:
        bodies = model.scene.bodies
        self.bodies, self.moving, self.step = bodies, model.scene.moving, model.scene.step
        near = self._collider(model, fidelity)
        # finer than what cloth keeps away nothing can poke through
        texel = max(self.maps.pixel, fidelity.body_tolerance) if fidelity.body_texels else None
        self.label += f", {fidelity.body_response}"
        self.label += self._moves if self.moving else ""
        if texel is not None:
            self.label += ", faces by texels"
        elif fidelity.body_faces and fidelity.body_collider != "dop":
            self.label += f", {fidelity.body_faces**2} points a face"
        coulomb = fidelity.body_response == "coulomb"
        self._contact = body_contact(
            near,
            model.faces,
            model.vertex_count,
            fidelity.body_tolerance,
            fidelity.body_faces if texel is None else 1,
            **({} if texel is None else {"texel": texel, "room": _room(model, texel)}),
            friction=float(np.mean([body.friction for body in bodies])) if coulomb else 0.0,
            slide=1.0 if coulomb else float(np.mean([body.slide for body in bodies])),
            rebound=float(np.mean([body.rebound for body in bodies])),
        )

    _moves = ", drawn anew each step"

    def _collider(self, model: ClothModel, fidelity: Fidelity) -> BodyMap | BodyPlanes:
        """Makes what knows where the bodies are, and the label's beginning; returns what sweeps read of it."""
        self.maps = body_maps(tuple(self.bodies), fidelity)
        self.label = f"body {fidelity.map_size} px along {self.maps.views}"
        return self.maps.map

    def begin(self, frame: Frame) -> BodyContact:
        """Ready for a step; its forces are the frame's `body_forces` from now on."""
        if self.moving:
            self._move(frame)
        self._contact.clock[0] = self.step
        self._contact.forces[:] = 0.0
        self._contact.squeeze[:] = 0.0
        self._contact.found_at[:] = np.inf  # a step does not depend on what was before it
        frame.body_forces = self._contact.forces
        return self._contact

    def _move(self, frame: Frame) -> None:
        """What moves is drawn where it is at the end of the step: from the state's time alone, so no drawing is kept."""
        now = frame.state.time
        soon, here = vertices_at(self.bodies, now + self.step), vertices_at(self.bodies, now)
        self.maps.render(soon, here, self.step, self._neighbourhood(frame))
        self._contact = self._contact._replace(map=self.maps.map)

    def look(self, frame: Frame, dt: float) -> BodyContact:
        """Before the sweeps of a substep of dt [s], whose predicted positions are in the frame."""
        return self._contact

    def _neighbourhood(self, frame: Frame) -> FloatArray:
        """(2, 3) box [m] that the cloth does not leave in a step, unless it gets faster by 3 m/s."""
        x, v = frame.state.positions, frame.state.velocities
        fastest = math.sqrt(float(np.einsum("ij,ij->i", v, v).max()))
        room = self.maps.margin + _SPARE + (fastest + _FASTER) * self.step
        return np.stack([x.min(axis=0) - room, x.max(axis=0) + room])

    def clamped(self, marks: BoolArray) -> int:
        """How many vertices the bodies have pressed from opposite sides in this step, of those not in marks (V,) yet."""
        return between_bodies(self._contact.squeeze, _CLAMPED * self._contact.tolerance, marks)
