"""Contact with bodies by colliders in object space: the alternatives to the maps, in the same step with the same answer.

They look once a substep, at where the cloth is heading before the sweeps; what they found holds for all of these.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.body import joined, part_numbers, vertices_at
from clothgym.detection.body_boxes import BodyBoxes
from clothgym.detection.body_mesh import BodyMesh
from clothgym.detection.dop_scene import DopScene
from clothgym.fidelity import Fidelity
from clothgym.kernels import body_planes
from clothgym.kernels.body_contact import BodyContact
from clothgym.kernels.body_planes import BodyPlanes
from clothgym.model import ClothModel
from clothgym.response.body import BodyResponse, face_points

if TYPE_CHECKING:
    from clothgym.stages.frame import Frame

_LEAST_REACH = 3e-3
"""[m] they look this much further than the tolerance, or as far as a vertex goes in the substep: further costs more, and what
lies deeper than that at the end of a substep is lost to them."""


def _room(vertex_count: int, points: int) -> BodyPlanes:
    """Nothing found yet, and room for so many points beside the vertices."""
    return BodyPlanes(
        np.zeros(vertex_count, np.bool_), np.zeros((vertex_count, 4)), np.zeros((vertex_count, 3)), np.zeros(1, np.int64),
        np.zeros((points, 3), np.int32), np.zeros((points, 3)), np.zeros((points, 4)), np.zeros((points, 3)),
    )  # fmt: skip


class SurfaceResponse(BodyResponse):
    """A collider that works on the bodies' true surface."""

    asked_in_sweeps = False
    _moves = ", moved in each substep"

    def _collider(self, model: ClothModel, fidelity: Fidelity) -> BodyPlanes:
        self.tolerance, self.faces = fidelity.body_tolerance, model.faces
        vertices, faces = joined(self.bodies)
        self.mesh = BodyMesh(vertices, faces)
        self.velocities: FloatArray = np.zeros_like(vertices)
        self.vertices = self._end = vertices
        self._prepare(model, fidelity, vertices)
        return _room(model.vertex_count, self._points)

    _points = 0

    @abstractmethod
    def _prepare(self, model: ClothModel, fidelity: Fidelity, vertices: FloatArray) -> None:
        """Builds what is searched, and gives the label."""

    @abstractmethod
    def _follow(self, vertices: FloatArray) -> None:
        """Takes new places of the bodies' vertices."""

    @abstractmethod
    def _find(self, p: FloatArray, way: float, found: BodyPlanes) -> BodyPlanes:
        """Planes for cloth at p (V, 3) whose vertices come there by at most `way` [m]; more room if it takes that."""

    def _move(self, frame: Frame) -> None:
        now = frame.state.time
        self._end = vertices_at(self.bodies, now + self.step)
        self.velocities = (self._end - vertices_at(self.bodies, now)) / self.step

    def look(self, frame: Frame, dt: float) -> BodyContact:
        """Where the bodies are at the end of the substep, and what of the cloth is near them there."""
        x, p = frame.state.positions, frame.predicted
        if self.moving:
            left = float(self._contact.clock[0]) - dt
            self.vertices = self._end - left * self.velocities
            self._follow(self.vertices)
        if not np.isfinite(p).all():  # the step will be found to have diverged
            return self._contact
        gone = p - x
        way = float(np.sqrt(np.einsum("ij,ij->i", gone, gone).max()))
        if self.moving:
            way += dt * float(np.sqrt(np.einsum("ij,ij->i", self.velocities, self.velocities).max()))
        assert self._contact.found is not None
        self._contact = self._contact._replace(found=self._find(p, way, self._contact.found))
        return self._contact


class BoxResponse(SurfaceResponse):
    """Trees of boxes, one for each part of a body: the paper's comparator [Vassilev 2001, Table 1].

    Vertices and points of faces look for the nearest face of the body.
    """

    def _prepare(self, model: ClothModel, fidelity: Fidelity, vertices: FloatArray) -> None:
        surface = self.mesh.surface
        _, parts = part_numbers(self.bodies)
        self.boxes = BodyBoxes(vertices, surface.faces, parts[surface.face_ids])
        self.weights = face_points(fidelity.body_faces)
        self._points = len(self.faces) * len(self.weights)
        self._near = np.zeros(self._points, np.bool_)
        self.label = f"body {len(np.unique(parts))} trees of boxes"

    def _follow(self, vertices: FloatArray) -> None:
        self.mesh.move(vertices)
        self.boxes.move(vertices)

    def _find(self, p: FloatArray, way: float, found: BodyPlanes) -> BodyPlanes:
        reach = self.tolerance + max(_LEAST_REACH, way)
        nearest = self.boxes.nearest(p, reach)
        closed = self.mesh.closed
        body_planes.planes_on_faces(p, closed, self.velocities, nearest, found.near, found.planes, found.flow)
        if self._points == 0:
            return found
        # faces of which no corner has come that near can be left out unless they are large
        corners = p[self.faces]
        longest = np.sqrt(((corners - corners.mean(axis=1, keepdims=True)) ** 2).sum(axis=2)).max()
        near_vertex = self.boxes.nearest(p, self.tolerance + longest) >= 0 if longest > reach else found.near
        chosen = np.flatnonzero(near_vertex[self.faces].any(axis=1))
        places = np.einsum("sk,fkc->fsc", self.weights, corners[chosen]).reshape(-1, 3)
        count = len(places)
        nearest = self.boxes.nearest(places, reach)
        body_planes.planes_on_faces(
            places, closed, self.velocities, nearest, self._near, found.point_planes, found.point_flow
        )
        kept = np.flatnonzero(self._near[:count])
        found.number[0] = len(kept)
        found.point_planes[: len(kept)] = found.point_planes[kept]
        found.point_flow[: len(kept)] = found.point_flow[kept]
        found.corners[: len(kept)] = self.faces[chosen][kept // len(self.weights)]
        found.weights[: len(kept)] = self.weights[kept % len(self.weights)]
        return found


class DopResponse(SurfaceResponse):
    """The k-DOP tree: vertices of the cloth against faces of the body, vertices of the body against faces of the cloth, and
    edges against edges."""

    def _prepare(self, model: ClothModel, fidelity: Fidelity, vertices: FloatArray) -> None:
        self.scene = DopScene(fidelity.k, fidelity.arity, inflation="unoriented", cones="none", self_collision=False)
        self.body = self.scene.add(vertices, self.mesh.surface.faces, cloth=False)
        self.cloth = self.scene.add(model.scene.start, model.faces)
        self._least = np.zeros(model.vertex_count)
        self._face: IntArray = np.zeros(model.vertex_count, np.int32)
        edges = self.mesh.surface.edges.astype(np.int64)
        self._edge_keys = edges[:, 0] * len(vertices) + edges[:, 1]
        self._points = 1024
        self.label = f"body {fidelity.k}-DOP tree"

    def _follow(self, vertices: FloatArray) -> None:
        self.mesh.move(vertices)
        self.scene.update(self.body, vertices)

    def _find(self, p: FloatArray, way: float, found: BodyPlanes) -> BodyPlanes:
        self.scene.update(self.cloth, p)
        near = self.scene.collide(self.tolerance + max(_LEAST_REACH, way))[self.body, self.cloth]
        if len(near) > len(found.corners):
            found = _room(len(p), int(1.3 * len(near)))
        closed = self.mesh.closed
        body_planes.nearest_of_pairs(near.quads, near.kinds, near.distances, near.polygons, self._least, self._face)
        body_planes.planes_on_faces(p, closed, self.velocities, self._face, found.near, found.planes, found.flow)
        keys = near.quads[:, 0].astype(np.int64) * len(self.velocities) + near.quads[:, 1]
        body_edges = np.searchsorted(self._edge_keys, keys)  # of other kinds it is never read
        body_planes.planes_of_pairs(
            p, self.vertices, closed, self.velocities, body_edges, near.quads, near.kinds, near.weights, found
        )
        return found


COLLIDERS: dict[str, type[SurfaceResponse]] = {"boxes": BoxResponse, "dop": DopResponse}
"""What `Fidelity.body_collider` names besides the maps."""
