"""Sheets that are height fields over a plane: decided in one look over the faces, before any pair is searched."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import FloatArray, IntArray
from clothgym.kernels import height_field
from clothgym.kernels.height_field import Shapes, Sheets, Tube
from clothgym.kernels.spring_runs import Course
from clothgym.mesh import Surface

Ids = NDArray[np.int64]

_COMPONENTS = 64
"""More are not decided: each is compared with each."""


class HeightFields:
    """Decides that a surface cannot touch itself within a motion (`kernels.height_field` has the proof).

    Args:
        surface: topology.
        reach: (V,) [m] primitives nearer than this would be in contact.

    Attributes:
        possible: whether the topology allows any decision: every component is a consistently oriented manifold with a border,
            and there are no more than 64.
        slack: (C,) [m] how far a vertex of each component may stray, in its plane, from where it is expected.
    """

    def __init__(self, surface: Surface, reach: FloatArray) -> None:
        self._course: Course | None = None
        known = _components(surface, reach)
        self.possible = known is not None
        if known is None:
            return
        self.sheets, self.shapes = known
        count = len(self.sheets.reach)
        self.tube = Tube(
            np.zeros((len(reach), 4)), np.zeros((count, 3, 3)), np.zeros(count), np.zeros((count, 6)), np.zeros(3)
        )

    def course(self, slot: IntArray, slot_count: int) -> Course | None:
        """What is decided from now on, in slots; None if there are several components.

        Args:
            slot: (V,) int32 slot of each vertex.
            slot_count: of them, a multiple of `spring_runs.LANES`.
        """
        if not self.possible or len(self.sheets.reach) > 1:
            return None
        ways = np.zeros((5, slot_count))
        ways[4] = np.inf
        ways[4, slot[self.sheets.members]] = 0.0
        self._slot = slot
        self._course = Course(ways, np.zeros((2, 3)), np.zeros(3), np.zeros((3, slot_count)))
        return self._course

    @property
    def slack(self) -> FloatArray:
        return self.tube.slack

    def decide(self, x: FloatArray, travel: FloatArray) -> bool:
        """Whether no primitives without a common vertex come within reach of each other on the way from x along travel (V, 3)
        [m], as long as `stays` confirms it. No proves nothing."""
        decided = self.possible and bool(height_field.decide(x, travel, self.sheets, self.shapes, self.tube))
        if decided and self._course is not None:
            height_field.chart(self.tube, self._slot, self.sheets.members, self._course)
        return decided

    def stays(self, x: FloatArray, share: float) -> bool:
        """Whether x (V, 3) [m], `share` of the way, is near enough to what was expected for the decision to hold."""
        return bool(height_field.stays(x, share, self.sheets, self.tube))


def _components(surface: Surface, reach: FloatArray) -> tuple[Sheets, Shapes] | None:
    """Topology of the components, or None if one of them can never be decided."""
    faces, vertices = surface.faces, surface.vertex_count
    if len(faces) == 0 or (surface.edge_face_count > 2).any():
        return None
    component = surface.components
    used = np.unique(component[faces[:, 0]])
    if len(used) > _COMPONENTS:
        return None
    number = np.full(int(component.max()) + 1, -1, np.int64)
    number[used] = np.arange(len(used))
    border = _border(faces, vertices)
    if border is None or not _manifold(surface):
        return None
    whole = number[component[border[:, 0]]]
    if len(np.unique(whole)) < len(used):
        return None  # a closed component is no height field
    members, member_start = _grouped(np.where(surface.vertex_owner >= 0, number[component], -1), len(used))
    by_face, face_start = _grouped(number[component[faces[:, 0]]], len(used))
    by_border, border_start = _grouped(whole, len(used))
    border = border[by_border]
    largest = np.zeros(len(used))
    np.maximum.at(largest, number[component[members]], reach[members])
    count = len(border)
    return Sheets(members.astype(np.int32), member_start, largest), Shapes(
        np.ascontiguousarray(faces[by_face]),
        face_start,
        np.ascontiguousarray(border, np.int32),
        border_start,
        _loops(border, border_start, vertices),
        np.zeros(count),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
        np.zeros(count),
    )


def _grouped(group: Ids, count: int) -> tuple[Ids, Ids]:
    """Ids sorted by group, and where each group starts (count + 1,); those of group -1 are left out."""
    order = np.argsort(group, kind="stable")
    start = np.searchsorted(group[order], np.arange(count + 1)).astype(np.int64)
    return order[start[0] :], start - start[0]


def _border(faces: IntArray, vertices: int) -> IntArray | None:
    """(B, 2) edges with one face, along it; None if two faces run along the same edge: they are not oriented alike."""
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    along, back = ends[:, 0] * vertices + ends[:, 1], ends[:, 1] * vertices + ends[:, 0]
    if len(np.unique(along)) < len(along):
        return None
    return ends[~np.isin(along, back)].astype(np.int32)


def _manifold(surface: Surface) -> bool:
    """Whether the faces around every vertex form one fan, open or closed."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    # corners of faces, joined across the edges that end in them
    count = len(surface.faces)
    corner = np.arange(3 * count).reshape(count, 3)
    edge = surface.face_edges[:, [2, 0, 0, 1, 1, 2]].ravel()  # both edges at each corner
    keys = edge.astype(np.int64) * surface.vertex_count + np.repeat(surface.faces.ravel(), 2)
    corners = np.repeat(corner.ravel(), 2)
    order = np.argsort(keys, kind="stable")
    keys, corners = keys[order], corners[order]
    same = np.flatnonzero(keys[1:] == keys[:-1])
    graph = coo_array((np.ones(len(same), np.int8), (corners[same], corners[same + 1])), shape=(3 * count,) * 2)
    fans = connected_components(graph, directed=False)[0]
    return bool(fans == len(np.unique(surface.faces)))


def _loops(border: IntArray, border_start: Ids, vertices: int) -> IntArray:
    """(B,) loop of each edge of an outline, numbered from 0 in its component."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(border), np.int8), (border[:, 0], border[:, 1])), shape=(vertices,) * 2)
    label = connected_components(graph, directed=False)[1][border[:, 0]]
    loop = np.empty(len(border), np.int32)
    for first, last in pairwise(border_start):
        loop[first:last] = np.unique(label[first:last], return_inverse=True)[1]
    return loop
