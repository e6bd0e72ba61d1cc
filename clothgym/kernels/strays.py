"""Vertices that leave the way on which pairs were searched: found, and their pairs searched again without a tree."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import bare, inlined, kernel
from clothgym.kernels.proximity import edge_pair, face_pair, travel


@inlined
def _deviation(x, start, u, share, i):
    """Square of how far vertex i is from where it was expected."""
    dx = x[i, 0] - start[i, 0] - share * u[i, 0]
    dy = x[i, 1] - start[i, 1] - share * u[i, 1]
    dz = x[i, 2] - start[i, 2] - share * u[i, 2]
    return dx * dx + dy * dy + dz * dz


@bare
def strays(x, start, u, share, slack):
    """See `strays_from`."""
    away = False
    for i in range(x.shape[0]):
        away |= not _deviation(x, start, u, share, i) <= slack[i] * slack[i]
    return away


@kernel
def strays_from(x, start, u, share, slack):
    """Whether some vertex is further than its slack (V,) [m] from where it was expected, start + share u (V, 3)."""
    return strays(x, start, u, share, slack)


@kernel
def list_strays(x, start, u, share, slack, more, least, ids):
    """Into ids (N,) the vertices that strayed, and for each a slack of `more` times how far, plus `least` [m].

    Returns how many strayed; if that is more than N, or one is nowhere, N + 1, and no slack is changed.
    """
    count = 0
    most = ids.shape[0]
    for i in range(x.shape[0]):
        square = _deviation(x, start, u, share, i)
        if square <= slack[i] * slack[i]:
            continue
        if count == most or not math.isfinite(square):
            return most + 1
        ids[count] = i
        count += 1
    for n in range(count):
        i = ids[n]
        slack[i] = more * math.sqrt(_deviation(x, start, u, share, i)) + least
    return count


@kernel
def drop_pairs(ids, marks, watched, count):
    """Takes the pairs of these vertices out of `watched`, the last ones in their places; returns how many are left.

    marks (V,) int32: afterwards 1, 2, ... at ids (N,), zero elsewhere.
    """
    marks[:] = 0
    for n in range(ids.shape[0]):
        marks[ids[n]] = n + 1
    quads = watched.quads
    n = 0
    while n < count:
        a, b = np.uint64(quads[n, 0]), np.uint64(quads[n, 1])
        c, d = np.uint64(quads[n, 2]), np.uint64(quads[n, 3])
        if marks[a] | marks[b] | marks[c] | marks[d] == 0:
            n += 1
            continue
        count -= 1
        for k in range(4):
            quads[n, k] = quads[count, k]
            watched.weights[n, k] = watched.weights[count, k]
            watched.separation[n, k] = watched.separation[count, k]
        watched.kinds[n] = watched.kinds[count]
        watched.rest[n] = watched.rest[count]
        watched.gaps[n] = watched.gaps[count]
        watched.ways[n] = watched.ways[count]
        watched.states[n] = watched.states[count]
    return count


@bare
def _measure_edges(x, edges, longest):
    """Into longest (V,) the length of the longest edge at each vertex [m]."""
    for i in range(x.shape[0]):
        longest[i] = 0.0
    for n in range(edges.shape[0]):
        a, b = edges[n, 0], edges[n, 1]
        length = travel(x, a, b)
        longest[a] = max(longest[a], length)
        longest[b] = max(longest[b], length)


class Space(NamedTuple):
    """Scratch of a surface with V vertices, F faces and E edges."""

    marks: NDArray  # (V,) int32: 1, 2, ... at the vertices whose pairs are searched
    near: NDArray  # (V, 2) int64: a list of vertices, and whose list a vertex was in last
    longest: NDArray  # (V,) longest edge at each vertex [m]
    own: NDArray  # (max(F, E),) int64
    others: NDArray  # (E,) int64


class Ways(NamedTuple):
    """Where vertices are expected: x + share u, within slack; V vertices."""

    x: NDArray  # (V, 3) [m]
    u: NDArray  # (V, 3) [m]
    slack: NDArray  # (V,) [m]
    thickness: NDArray  # (V,) [m]


@bare
def _list_near(s, ways, owners, longest, own, near, stamp):
    """Lists in near[:, 0] vertices, one of which each primitive has that may come near one of vertex s, and stamps near[:, 1].

    own (K,): the vertices that share an edge with s. A primitive's closest point is within the longest edge of each of its
    vertices, and the gap within the reach of `gather_quads`, by way of the vertex that moves most against s.
    """
    x, u, slack = ways.x, ways.u, ways.slack
    size = 0.0
    moves = slack[s]
    for n in range(own.shape[0]):
        size = max(size, travel(x, own[n], s))
        moves = max(moves, travel(u, own[n], s) + slack[own[n]])
    around = (size + moves + ways.thickness[s]) * (1.0 + 1e-9)
    found = 0
    for j in range(x.shape[0]):
        if owners[j] >= 0 and travel(x, j, s) <= around + longest[j] + travel(u, j, s) + slack[j]:
            near[found, 0] = j
            near[j, 1] = stamp
            found += 1
    return found


@inlined
def _earlier(marks, stamp, i):
    """Whether the pairs of vertex i were listed with one before."""
    return 0 < marks[i] < stamp


@kernel
def pairs_around(ids, ways, surface, starts, neighbours, space, watched, count):
    """Pairs of vertices ids (N,) as `gather_quads` finds them, without a tree, from place `count` on; each once.

    space: its marks as `drop_pairs` leaves them; surface: its arrays; starts (V + 1,), neighbours: vertices across edges.
    Returns how many pairs there are then; as many as fit are written.
    """
    marks, near, longest, own, reached = space.marks, space.near, space.longest, space.own, space.others
    faces, edges, owners = surface.faces, surface.edges, surface.vertex_owner
    x, u, slack, thickness = ways.x, ways.u, ways.slack, ways.thickness
    quads, kinds, rest, gaps, weights = watched.quads, watched.kinds, watched.rest, watched.gaps, watched.weights
    _measure_edges(x, edges, longest)
    near[:, 1] = 0
    found = count
    for n in range(ids.shape[0]):
        s = ids[n]
        if owners[s] < 0:
            continue  # of no face
        stamp = n + 1
        listed = _list_near(s, ways, owners, longest, neighbours[starts[s] : starts[s + 1]], near, stamp)
        # the vertex with faces, and its own faces with vertices
        mine = 0
        for f in range(faces.shape[0]):
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            if near[a, 1] != stamp and near[b, 1] != stamp and near[c, 1] != stamp:
                continue
            if _earlier(marks, stamp, a) or _earlier(marks, stamp, b) or _earlier(marks, stamp, c):
                continue
            if a == s or b == s or c == s:
                own[mine] = f
                mine += 1
            else:
                found = face_pair(x, u, thickness, slack, s, a, b, c, found, quads, kinds, rest, gaps, weights)
        for m in range(mine):
            a, b, c = faces[own[m], 0], faces[own[m], 1], faces[own[m], 2]
            for k in range(listed):
                v = near[k, 0]
                if v != a and v != b and v != c and not _earlier(marks, stamp, v):
                    found = face_pair(x, u, thickness, slack, v, a, b, c, found, quads, kinds, rest, gaps, weights)
        # its own edges with edges
        mine = 0
        far = 0
        for e in range(edges.shape[0]):
            a, b = edges[e, 0], edges[e, 1]
            if near[a, 1] != stamp and near[b, 1] != stamp:
                continue
            if _earlier(marks, stamp, a) or _earlier(marks, stamp, b):
                continue
            if a == s or b == s:
                own[mine] = e
                mine += 1
            else:
                reached[far] = e
                far += 1
        for m in range(mine):
            for k in range(far):
                e = min(own[m], reached[k])
                f = max(own[m], reached[k])
                a, b, c, d = edges[e, 0], edges[e, 1], edges[f, 0], edges[f, 1]
                if a != c and a != d and b != c and b != d:
                    found = edge_pair(x, u, thickness, slack, a, b, c, d, found, quads, kinds, rest, gaps, weights)
    return found
