"""What contours do on the surface: the regions that they cut off, and the points where they cross each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.joining import root_of
from clothgym.kernels.vec3 import triangle_normal


class Cuts(NamedTuple):
    """Where contours cut the edges of a surface, as `Intersections` has it; H hits, S segments, C contours."""

    order: NDArray  # (H,) hits, contour by contour
    bounds: NDArray  # (C + 1,) of each contour in `order`
    edge: NDArray  # (H,) edge of each hit
    face: NDArray  # (H,) face of each hit
    side: NDArray  # (H,) +1 or -1
    consistent: NDArray  # (C,) bool: the sides of a contour can be told apart
    contour: NDArray  # (S,)
    hits_per_pair: NDArray  # (S,) two, but where a segment ends otherwise than at a second hit
    loop_vertex: NDArray  # (S,) at which it does, -1 = none


class Graph(NamedTuple):
    """Vertices and edges of a surface."""

    start: NDArray  # (V + 1,)
    neighbours: NDArray
    neighbour_edges: NDArray
    edges: NDArray  # (E, 2)
    face_edges: NDArray  # (F, 3)
    edge_face_start: NDArray  # (E + 1,)
    edge_face_ids: NDArray
    areas: NDArray  # (V,) [m^2]
    component: NDArray  # (V,)
    component_areas: NDArray  # [m^2]


class Enclosed(NamedTuple):
    """What a flood found; R regions of at most 2 H."""

    inside_end: (
        NDArray  # (H,) int8 which end of the hit's edge lies in the smaller region; -1 = the contour cuts nothing off
    )
    region: NDArray  # (H,) the smaller region at the hit, -1 = none
    contour: NDArray  # (R,)
    side: NDArray  # (R,) +1 or -1; 0 where both sides together cut it off
    area: NDArray  # (R,) [m^2]
    share: NDArray  # (R,) of its component's area
    start: NDArray  # (R + 1,)


class Ends(NamedTuple):
    """How contours end."""

    wall_start: NDArray  # (C + 1,)
    walls: NDArray  # loop vertices of each contour, through which no flood passes
    borders: NDArray  # (C,) how many of its hits lie on a border
    border_hits: NDArray  # (C, 2) the first of them
    simple: NDArray  # (C,) bool: a line from border to border that meets no seam and misses no hit


@device
def _ends(cuts, graph):
    """How contours end."""
    contours = cuts.bounds.shape[0] - 1
    borders = np.zeros(contours, np.int64)
    border_hits = np.empty((contours, 2), np.int64)
    simple = np.ones(contours, np.bool_)
    for c in range(contours):
        for n in range(cuts.bounds[c], cuts.bounds[c + 1]):
            e = cuts.edge[cuts.order[n]]
            degree = graph.edge_face_start[e + 1] - graph.edge_face_start[e]
            if degree == 2:
                continue
            if degree > 2:
                simple[c] = False
                continue
            if borders[c] < 2:
                border_hits[c, borders[c]] = cuts.order[n]
            borders[c] += 1
    wall_start = np.zeros(contours + 1, np.int64)
    for s in range(cuts.contour.shape[0]):
        if cuts.hits_per_pair[s] == 2:
            continue
        c = cuts.contour[s]
        simple[c] = False
        wall_start[c + 1] += cuts.loop_vertex[s] >= 0
    for c in range(contours):
        simple[c] &= borders[c] == 2
        wall_start[c + 1] += wall_start[c]
    walls = np.empty(wall_start[contours], np.int64)
    if len(walls) > 0:
        filled = wall_start.copy()
        for s in range(cuts.contour.shape[0]):
            if cuts.loop_vertex[s] >= 0:
                c = cuts.contour[s]
                walls[filled[c]] = cuts.loop_vertex[s]
                filled[c] += 1
    return Ends(wall_start, walls, borders, border_hits, simple)


@device
def _leaks(cuts, graph, ends, c, side, cut):
    """Whether a simple contour that cuts no edge of this side twice is known to cut nothing off there.

    It ends inside the surface of this side where a border of the other pierces it. A face that it ends in joins both ends of
    the one edge that is cut there by way of its third corner, and a face that it passes joins those of its two cut edges that
    lie on the same side of it: together, all ends of all cut edges.
    """
    free = 0
    for n in range(2):
        h = ends.border_hits[c, n]
        if cuts.side[h] == side:
            continue
        f = cuts.face[h]
        if np.int64(cut[graph.face_edges[f, 0]]) + cut[graph.face_edges[f, 1]] + cut[graph.face_edges[f, 2]] != 1:
            return False
        free += 1
    return free > 0


@device
def _reach_border(face, graph, cut, stamp, seen, way, came, extra):
    """Edges between a face and the nearest border, the border's own included, that the contour does not cut; 0 if there are
    none. Scratch over faces: seen, holding the stamps of earlier searches, way and came; returns how many edges."""
    head = 0
    tail = 1
    way[0] = face
    seen[face] = stamp
    came[face] = -1
    while head < tail:
        f = way[head]
        head += 1
        for k in range(3):
            e = graph.face_edges[f, k]
            if cut[e]:
                continue
            if graph.edge_face_start[e + 1] - graph.edge_face_start[e] == 1:
                count = 0
                while True:
                    extra[count] = e
                    count += 1
                    e = came[f]
                    if e < 0:
                        return count
                    # back to the face that this one was reached from: the one of the edge that was seen first
                    for n in range(graph.edge_face_start[e], graph.edge_face_start[e + 1]):
                        other = graph.edge_face_ids[n]
                        if other != f and seen[other] == stamp and came[other] != e:
                            f = other
                            break
            for n in range(graph.edge_face_start[e], graph.edge_face_start[e + 1]):
                other = graph.edge_face_ids[n]
                if seen[other] != stamp:
                    seen[other] = stamp
                    came[other] = e
                    way[tail] = other
                    tail += 1
    return 0


@kernel
def flood(cuts, graph, found, members):
    """Regions that contours cut off: vertices that cannot be reached without crossing the contour an odd number of times.

    All regions of a contour grow at the same pace, and the flood ends when only one still grows: that one has what is left of
    the component, so that small contours on large meshes are cheap. At every hit the region of smaller area is the inside one.
    Writes `found` and the vertices of inside regions to members (M,) as far as they fit; returns (regions, members).
    """
    vertices = graph.start.shape[0] - 1
    hits = cuts.order.shape[0]
    cut = np.zeros(graph.edges.shape[0], np.bool_)
    label = np.full(vertices, -1, np.int32)
    queue = np.empty(vertices, np.int32)
    mine = np.empty(hits, np.int64)
    parent = np.empty(2 * hits, np.int32)
    growing = np.empty(2 * hits, np.int64)
    area = np.empty(2 * hits, np.float64)
    number = np.empty(2 * hits, np.int64)
    root_at = np.empty(2 * hits, np.int64)
    sizes = np.empty(2 * hits, np.int64)
    ends = _ends(cuts, graph)
    # a contour with one loop vertex and one border goes on from where that border pierces a face to the nearest border
    extending = False
    for c in range(ends.borders.shape[0]):
        extending |= ends.borders[c] == 1 and ends.wall_start[c + 1] - ends.wall_start[c] == 1
    faces = graph.face_edges.shape[0] if extending else 0
    seen = np.full(faces, -1, np.int32)
    way = np.empty(faces, np.int32)
    came = np.empty(faces, np.int32)
    extra = np.empty(faces + 1, np.int32)
    regions = 0
    used = 0
    for h in range(hits):
        found.inside_end[h] = -1
        found.region[h] = -1
    for c in range(cuts.bounds.shape[0] - 1):
        if not cuts.consistent[c]:
            continue
        walls = ends.wall_start[c + 1] - ends.wall_start[c]
        for w in range(ends.wall_start[c], ends.wall_start[c + 1]):
            label[ends.walls[w]] = -2
        # each side is flooded for itself, but where they meet at a loop vertex all cuts work together
        for group in range(2 if walls == 0 else 1):
            side = 0.0 if walls > 0 else (1.0 if group == 0 else -1.0)
            count = 0
            for n in range(cuts.bounds[c], cuts.bounds[c + 1]):
                mine[count] = cuts.order[n]
                count += side == 0.0 or cuts.side[cuts.order[n]] == side
            twice = False
            for n in range(count):
                e = cuts.edge[mine[n]]
                twice |= cut[e]
                cut[e] = not cut[e]
            if ends.simple[c] and not twice and _leaks(cuts, graph, ends, c, side, cut):
                for n in range(count):
                    cut[cuts.edge[mine[n]]] = False
                continue
            extended = 0
            if walls == 1 and ends.borders[c] == 1:
                extended = _reach_border(cuts.face[ends.border_hits[c, 0]], graph, cut, c, seen, way, came, extra)
            for n in range(extended):
                cut[extra[n]] = True
            seeds = 0
            tail = 0
            for n in range(count):
                h = mine[n]
                if not cut[cuts.edge[h]]:
                    continue
                for end in range(2):
                    v = graph.edges[cuts.edge[h], end]
                    if label[v] == -1:
                        label[v] = seeds
                        parent[seeds] = seeds
                        growing[seeds] = 1
                        area[seeds] = graph.areas[v]
                        queue[tail] = v
                        tail += 1
                        seeds += 1
            before = regions
            head = 0
            alive = seeds
            whole = False
            while True:
                while head < tail and (alive > 1 or whole):
                    v = queue[head]
                    head += 1
                    root = root_of(parent, label[v])
                    for k in range(graph.start[v], graph.start[v + 1]):
                        other = np.uint64(graph.neighbours[k])
                        known = label[other]
                        if known == root or known == -2 or cut[np.uint64(graph.neighbour_edges[k])]:
                            continue
                        if known == -1:
                            label[other] = root
                            area[root] += graph.areas[other]
                            growing[root] += 1
                            queue[tail] = other
                            tail += 1
                            continue
                        met = root_of(parent, known)
                        if met != root:
                            parent[met] = root
                            area[root] += area[met]
                            growing[root] += growing[met]
                            alive -= 1
                    growing[root] -= 1
                    if growing[root] == 0:
                        alive -= 1
                if whole or seeds == 0:
                    break
                # the one that still grows has what the others leave
                unfinished = -1
                closed = 0.0
                for r in range(seeds):
                    if parent[r] == r:
                        number[r] = -1
                        sizes[r] = 0
                        if growing[r] > 0:
                            unfinished = r
                        else:
                            closed += area[r]
                if unfinished >= 0:
                    total = graph.component_areas[graph.component[queue[0]]]
                    area[unfinished] = max(total - closed, 0.0)
                for n in range(count):
                    h = mine[n]
                    e = cuts.edge[h]
                    if not cut[e]:
                        continue
                    if label[graph.edges[e, 0]] < 0 or label[graph.edges[e, 1]] < 0:
                        continue
                    first = root_of(parent, label[graph.edges[e, 0]])
                    second = root_of(parent, label[graph.edges[e, 1]])
                    if first == second:
                        continue
                    found.inside_end[h] = 0 if area[first] < area[second] else 1
                    inside = first if area[first] < area[second] else second
                    if number[inside] < 0:
                        number[inside] = regions
                        root_at[regions] = inside
                        found.contour[regions] = c
                        found.side[regions] = side
                        found.area[regions] = area[inside]
                        found.share[regions] = area[inside] / graph.component_areas[graph.component[queue[0]]]
                        regions += 1
                    found.region[h] = number[inside]
                if unfinished < 0 or number[unfinished] < 0:
                    break
                whole = True  # what still grows is the inside after all: its vertices are wanted
            for n in range(tail):
                root = root_of(parent, label[queue[n]])
                if number[root] >= 0:
                    sizes[root] += 1
            for region in range(before, regions):
                r = root_at[region]
                found.start[region] = used
                used += sizes[r]
                found.start[region + 1] = used
                sizes[r] = found.start[region]
            for n in range(tail):
                root = root_of(parent, label[queue[n]])
                if number[root] >= 0:
                    if sizes[root] < members.shape[0]:
                        members[sizes[root]] = queue[n]
                    sizes[root] += 1
            for n in range(tail):
                label[queue[n]] = -1
            for n in range(count):
                cut[cuts.edge[mine[n]]] = False
            for n in range(extended):
                cut[extra[n]] = False
        for w in range(ends.wall_start[c], ends.wall_start[c + 1]):
            label[ends.walls[w]] = -1
    return regions, used


@device
def _turn(p, q, r, u, w):
    """Twice the area of the triangle p, q, r in the coordinates u, w."""
    return (q[u] - p[u]) * (r[w] - p[w]) - (q[w] - p[w]) * (r[u] - p[u])


@kernel
def count_crossings(x, faces, face_start, segments_of_face, segments, first_hit, second_hit, contour, crossings):
    """Adds to crossings (C,) the points of faces where segments of contours cross, each once for every contour there.

    Segments (S, 2, 3) of each face follow each other in segments_of_face, from face_start (F + 1,) on; those that join at a
    hit or a loop vertex do not cross.
    """
    for f in range(face_start.shape[0] - 1):
        if face_start[f + 1] - face_start[f] < 2:
            continue
        nx, ny, nz, _ = triangle_normal(x, faces[f, 0], faces[f, 1], faces[f, 2])
        u, w = 0, 1
        if abs(nx) >= abs(ny) and abs(nx) >= abs(nz):
            u, w = 1, 2
        elif abs(ny) >= abs(nz):
            u, w = 0, 2
        for m in range(face_start[f], face_start[f + 1]):
            a = segments_of_face[m]
            for n in range(m + 1, face_start[f + 1]):
                b = segments_of_face[n]
                if first_hit[a] == first_hit[b] or first_hit[a] == second_hit[b]:
                    continue
                if second_hit[a] >= 0 and (second_hit[a] == second_hit[b] or second_hit[a] == first_hit[b]):
                    continue
                p, q, r, s = segments[a, 0], segments[a, 1], segments[b, 0], segments[b, 1]
                if (
                    _turn(p, q, r, u, w) * _turn(p, q, s, u, w) < 0.0
                    and _turn(r, s, p, u, w) * _turn(r, s, q, u, w) < 0.0
                ):
                    crossings[contour[a]] += 1
                    if contour[b] != contour[a]:
                        crossings[contour[b]] += 1
