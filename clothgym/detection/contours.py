"""Contours: their kinds, what they cut off the surface, and where they cross."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import BoolArray, FloatArray, IntArray
from clothgym.kernels import pushes
from clothgym.kernels import regions as kernels
from clothgym.mesh import vertex_areas

if TYPE_CHECKING:
    from clothgym.detection.intersections import Intersections

KINDS = ("Closed", "BBII", "BIBI", "BLI", "LL", "Cross", "Eight", "branched", "Open")
"""Every kind of contour; the first seven are the canonical ones."""

DOUBTFUL = 0.4
"""A region with more than this share of its component may as well be the one that is right."""


@dataclass(frozen=True)
class Region:
    """A part of a surface that a contour cuts off: of two parts that meet along it, the one of smaller area, or the larger one
    where only that agrees with the other surface.

    Attributes:
        side: +1 or -1, the side of the contour (see `Intersections.hit_side`) whose surface it is part of; 0 where both sides
            cut it off together, between loop vertices.
        area: [m^2], of its vertices.
        share: of the area of its connected component; which part went through is a guess where that is near a half, and more
            than half of the surface has gone through where it exceeds it.
        vertices: ids.
        depth: of its deepest vertex below the other surface [m]: distance to the faces that the contour pierces and to the
            region on the other side.
    """

    side: int
    area: float
    share: float
    vertices: IntArray
    depth: float

    @property
    def doubtful(self) -> bool:
        """Whether the region is so large that the other part may be the one that went through."""
        return self.share > DOUBTFUL


@dataclass(frozen=True)
class Contour:
    """One intersection contour.

    Attributes:
        length: [m], each segment once.
        hit_count: number of hits.
        closed: every hit's segments all continue at another hit.
        ends: how an open contour ends, sorted letters: B = at a border edge, I = in the inside of a face that a border
            edge pierces (the same point seen from the other surface), L = at a loop vertex, "?" = the next hit is missing.
        kind: the first that holds of "branched" (a seam of three or more faces on the way), "Eight" (its two sides cannot be
            told apart), "Cross" (another contour, or itself, crosses it on the surface: three sheets meet there), "Closed",
            "LL", "BLI" (one loop vertex, one border), "BBII" (both borders on one side), "BIBI" (one on each side), "Open".
        self_contour: both sides lie on one connected component.
        consistent: its two sides can be told apart.
        components: ids of the connected components that it joins.
        branches: hits where it meets a seam.
        crossings: how often contours cross it, counted on every surface.
        regions: what it cuts off; none where its kind is "Eight".
        depth: the largest of the regions' depths [m]; 0 without regions.
    """

    length: float
    hit_count: int
    closed: bool
    ends: str
    kind: str
    self_contour: bool
    consistent: bool
    components: tuple[int, ...]
    branches: int
    crossings: int
    regions: tuple[Region, ...]

    @property
    def depth(self) -> float:
        return max((region.depth for region in self.regions), default=0.0)

    @property
    def area(self) -> float:
        """Area of all regions [m^2]."""
        return sum(region.area for region in self.regions)


def grouped(group: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Members in the order of their groups (N,), and where each of `count` groups begins and ends in it (count + 1,)."""
    bounds = np.zeros(count + 1, np.int64)
    np.cumsum(np.bincount(group, minlength=count), out=bounds[1:])
    # 16 bits are sorted by counting, which takes a tenth
    return np.argsort(group.astype(np.uint16) if count <= 1 << 16 else group, kind="stable"), bounds


class WayBack(NamedTuple):
    """Where the M vertices of R regions would go back through: the nearest point of what their region lies behind.

    That is the faces that the contour pierces on the region's side, and those of the regions on its other side, without the
    region's own.
    """

    behind: BoolArray  # (R,) whether there is any such face
    face: IntArray  # (M,)
    weights: FloatArray  # (M, 3)
    distance: FloatArray  # (M,) [m]


class Enclosed:
    """Regions that the contours of an intersection cut off, found by flood fill [Baraff 2003].

    Each side of a contour is flooded for itself. Where a contour ends at loop vertices, both sides meet there and cut off a
    region together; if it has one such end and one at a border, a corner is folded through, and what is missing between the
    contour and the border of the other surface is the shortest way there. Contours whose sides cannot be told apart cut off
    nothing.

    Of two parts the smaller one is inside. Where that makes the two surfaces push each other the same way, it is the larger
    part on that surface where it is the closer call.

    Args:
        hits: intersections.
        areas: (V,) of the vertices [m^2], which decide what is smaller; of the rest shape, so that no stretch changes the mind.

    Attributes:
        inside_end: (H,) which end of a hit's edge lies in the region, 0 or 1; -1 = none.
        region: (H,) that region, -1 = none.
        contour, side, area, share: (R,) as in `Region`; start: (R + 1,) where the vertices of each begin and end in `inside`.
    """

    def __init__(self, hits: Intersections, areas: FloatArray) -> None:
        self.hits = hits
        count = hits.hit_count
        cuts = kernels.Cuts(
            *hits.by_contour,
            hits.hit_edge,
            hits.hit_face,
            hits.hit_side,
            hits.contour_consistent,
            hits.contour,
            hits.hits_per_pair,
            hits.loop_vertex,
        )
        surface = hits.surface
        component = surface.components
        weights = np.ascontiguousarray(areas[: len(component)])
        graph = kernels.Graph(
            *surface.neighbourhood,
            surface.edges,
            surface.face_edges,
            surface.edge_face_start,
            surface.edge_face_ids,
            weights,
            component,
            np.bincount(component, weights, minlength=1),
        )
        found = kernels.Enclosed(
            np.empty(count, np.int8),
            np.empty(count, np.int64),
            np.empty(2 * count, np.int64),
            np.empty(2 * count),
            np.empty(2 * count),
            np.empty(2 * count),
            np.zeros(2 * count + 1, np.int64),
        )
        members = np.empty(max(256, count), np.int32)
        while True:
            regions, used = kernels.flood(cuts, graph, found, members)
            if used <= len(members):
                break
            members = np.empty(used, np.int32)
        self.inside_end, self.region = found.inside_end, found.region
        self.contour, self.side = found.contour[:regions], found.side[:regions]
        self.area, self.share = found.area[:regions], found.share[:regions]
        self.start, self._members = found.start[: regions + 1], members[:used]
        for region in self._contradictions():
            self._turn(region)

    def _contradictions(self) -> list[int]:
        """Regions that push the other way than the region on the other side of their contour, and are the larger share of
        their surface: the part that went through exceeds half of it, and the rest was taken for it."""
        if not (self.contour[1:] == self.contour[:-1]).any():
            return []
        both = [
            pair
            for pair in self.of_contour
            if len(pair) == 2 and self.side[pair].all() and self.side[pair].sum() == 0.0
        ]
        if not both:
            return []
        hits = self.hits
        chosen = np.flatnonzero(self.inside_end >= 0)
        turned = hits.hit_side[chosen, None] * self.outward()[chosen]
        region = self.region[chosen]
        push = np.stack([np.bincount(region, turned[:, axis], minlength=len(self)) for axis in range(3)], axis=1)
        return [max(pair, key=lambda r: self.share[r]) for pair in both if push[pair[0]] @ push[pair[1]] < 0.0]

    def _turn(self, region: int) -> None:
        """Takes the other part of the surface for the region."""
        members = self.vertices(region)
        component = self.hits.surface.components
        others = np.setdiff1d(np.flatnonzero(component == component[members[0]]), members).astype(np.int32)
        parts = [others if r == region else self.vertices(r) for r in range(len(self))]
        self._members = np.concatenate(parts)
        self.start = np.cumsum([0, *(len(part) for part in parts)])
        at = (self.region == region) & (self.inside_end >= 0)
        self.inside_end[at] = 1 - self.inside_end[at]
        self.area[region] *= (1.0 - self.share[region]) / self.share[region]
        self.share[region] = 1.0 - self.share[region]

    def __len__(self) -> int:
        return len(self.contour)

    def vertices(self, region: int) -> IntArray:
        """Ids of a region's vertices."""
        return self._members[self.start[region] : self.start[region + 1]]

    @property
    def inside(self) -> IntArray:
        """Vertices of all regions, one after the other; those in several stand there as often."""
        return self._members

    @cached_property
    def of_contour(self) -> list[list[int]]:
        """The regions of each contour."""
        listed: list[list[int]] = [[] for _ in range(self.hits.contour_count)]
        for region, contour in enumerate(self.contour.tolist()):
            listed[contour].append(region)
        return listed

    @property
    def regions(self) -> pushes.Regions:
        """All of them, as kernels read them."""
        return pushes.Regions(self.contour, self.side, self.start, self._members)

    def outward(self) -> FloatArray:
        """(H, 3) unit normal of each hit's face, towards the outer end of its edge; 0 where nothing is cut off."""
        hits = self.hits
        normals = np.empty((hits.hit_count, 3))
        pushes.outward_normals(hits.vertices, hits.surface.edges, hits.hit_edge, hits.frames, self.inside_end, normals)
        return normals

    @cached_property
    def way_back(self) -> WayBack:
        """Where the vertices of all regions would go back through."""
        hits, count = self.hits, len(self._members)
        found = WayBack(np.empty(len(self), np.bool_), np.zeros(count, np.int32), np.zeros((count, 3)), np.zeros(count))
        around = pushes.Around(*hits.by_contour, hits.hit_face, hits.hit_side, *hits.surface.faces_around)
        pushes.nearest_behind(hits.vertices, hits.surface.faces, around, self.regions, *found)
        return found

    def nearest(self, region: int) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
        """Where a region's vertices would go back through.

        Returns:
            Its vertices (N,), for each the nearest face (N,) of what they lie behind, the weights (N, 3) of the nearest point
            and its distance (N,) [m]; empty where they lie behind nothing.
        """
        behind, face, weights, distance = self.way_back
        at = slice(self.start[region], self.start[region + 1] if behind[region] else self.start[region])
        return self._members[at], face[at], weights[at], distance[at]


def described(hits: Intersections) -> list[Contour]:
    """Every contour of an intersection with its kind and regions, in order of its smallest hit."""
    s = hits.surface
    count = hits.contour_count
    degree = s.edge_face_count[hits.hit_edge]
    on_edge = s.components[s.edges[hits.hit_edge, 0]]
    on_face = s.components[s.faces[hits.hit_face, 0]]
    loops = np.bincount(hits.contour[hits.loop_vertex >= 0], minlength=count)
    holes = np.bincount(hits.contour[(hits.second_hit < 0) & (hits.loop_vertex < 0)], minlength=count)
    order, bounds = hits.by_contour
    found = Enclosed(hits, vertex_areas(hits.vertices, s.faces))
    crossings = _crossings(hits)
    result = []
    for c in range(count):
        members = order[bounds[c] : bounds[c + 1]]
        borders = members[degree[members] == 1]
        joined = tuple(int(i) for i in np.unique(np.r_[on_edge[members], on_face[members]]))
        result.append(
            Contour(
                length=float(hits.contour_lengths[c]),
                hit_count=len(members),
                closed=bool(len(borders) == 0 and loops[c] == 0 and holes[c] == 0),
                ends="B" * len(borders) + "I" * len(borders) + "L" * int(loops[c]) + "?" * int(holes[c]),
                kind=_kind(hits, c, members, borders, int(loops[c]), int(holes[c]), int(crossings[c])),
                self_contour=len(joined) == 1,
                consistent=bool(hits.contour_consistent[c]),
                components=joined,
                branches=int((degree[members] > 2).sum()),
                crossings=int(crossings[c]),
                regions=tuple(_region(found, r) for r in found.of_contour[c]),
            )
        )
    return result


def _kind(
    hits: Intersections,
    c: int,
    members: NDArray[np.int64],
    borders: NDArray[np.int64],
    loops: int,
    holes: int,
    crossings: int,
) -> str:
    if (hits.surface.edge_face_count[hits.hit_edge[members]] > 2).any():
        return "branched"
    if not hits.contour_consistent[c]:
        return "Eight"
    if crossings > 0:
        return "Cross"
    if holes > 0:
        return "Open"
    if len(borders) == 2 and loops == 0:
        return "BBII" if hits.hit_side[borders[0]] == hits.hit_side[borders[1]] else "BIBI"
    return {(0, 0): "Closed", (0, 2): "LL", (1, 1): "BLI"}.get((len(borders), loops), "Open")


def _region(found: Enclosed, region: int) -> Region:
    distance = found.nearest(region)[3]
    return Region(
        int(found.side[region]),
        float(found.area[region]),
        float(found.share[region]),
        found.vertices(region),
        float(distance.max(initial=0.0)),
    )


def _crossings(hits: Intersections) -> NDArray[np.int64]:
    """(C,) how often contours cross each contour on the surface."""
    crossings = np.zeros(hits.contour_count, np.int64)
    pair_faces = hits.pair_faces.ravel().astype(np.int64)
    order, bounds = grouped(pair_faces, len(hits.surface.faces))
    kernels.count_crossings(
        hits.vertices,
        hits.surface.faces,
        bounds,
        order // 2,
        hits.segments,
        hits.first_hit,
        hits.second_hit,
        hits.contour,
        crossings,
    )
    return crossings
