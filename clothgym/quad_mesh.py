"""Quad meshes of flat panels: the rectangular topology of [Vassilev 2001], whose patches are grids of columns and rows.

A panel gets four sides: the runs of its edges between four of its corners. Opposite sides have equally many pieces, so do
the two edges of a seam; the whole numbers of pieces that come nearest to a wanted length are an integer programme (scipy's
HiGHS). The inside is a Coons patch of the four sides, smoothed where lines of the grid would cross.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise

import numpy as np

from clothgym.arrays import FloatArray, check_number
from clothgym.panel_mesh import PanelMesh
from clothgym.pattern import Panel, Pattern

_ROUNDS, _PASSES = 16, 20
_TANGENT = 0.02
_LEAST_SHARPNESS = 0.05
_MOST_VERTICES = 40
"""Of a panel: all fours of them are looked at."""


def panel_sides(panel: Panel) -> tuple[tuple[int, ...], ...]:
    """The edges of the four sides of a panel, in the order of its loop; the first side lies lowest in the panel.

    The corners are the four vertices with the largest product of the area they enclose, the sines of the turns that the
    outline makes there, and how nearly opposite sides are equally long: a slight bend in a side is no corner, nor is a notch.

    A panel may name them itself, as patterns of the package do: `extra["grid_corners"]`, ids of four vertices.

    Raises:
        ValueError: a panel with fewer than four vertices, or too many; corners that are not four of its vertices.
    """
    count = len(panel.edges)
    if not 4 <= count <= _MOST_VERTICES:
        raise ValueError(f"panel {panel.name!r}: {count} edges: quads need 4 to {_MOST_VERTICES}; triangles mesh it")
    loop = panel.vertices[[edge.endpoints[0] for edge in panel.edges]]
    starts = [edge.endpoints[0] for edge in panel.edges]
    named = panel.extra.get("grid_corners")
    if named is None:
        corners = _best_corners(panel, loop)
    elif isinstance(named, list | tuple) and len(set(named)) == 4 and set(named) <= set(starts):
        corners = sorted(starts.index(vertex) for vertex in named)
    else:
        raise ValueError(f"panel {panel.name!r}: grid_corners = {named!r}: expected four of its vertices")
    runs = [
        tuple(k % count for k in range(start, end if end > start else end + count))
        for start, end in pairwise([*corners, corners[0]])
    ]
    lowest = int(np.argmin([loop[run[0]][1] + loop[(run[-1] + 1) % count][1] for run in runs]))
    return tuple(runs[(lowest + k) % 4] for k in range(4))


def _best_corners(panel: Panel, loop: FloatArray) -> list[int]:
    """Of the corners (N, 2) of a panel in the order of its loop, the four of its sides."""
    count = len(loop)
    fours = np.array(list(combinations(range(count), 4)))
    a, b, c, d = (loop[fours[:, k]] for k in range(4))
    one, two = c - a, d - b
    area = 0.5 * np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    way = np.concatenate([[0.0], np.cumsum([panel.length(k) for k in range(count)])])
    sides = [(way[fours[:, (k + 1) % 4]] - way[fours[:, k]]) % way[-1] for k in range(4)]
    balance = np.prod(
        [np.minimum(sides[k], sides[k + 2]) / np.maximum(sides[k], sides[k + 2]) for k in range(2)], axis=0
    )
    score = area * _sharpness(panel)[fours].prod(axis=1) * np.sqrt(balance)
    # the first of those that are best but for rounding
    return fours[int(np.argmax(score >= (1.0 - 1e-9) * score.max()))].tolist()


def _sharpness(panel: Panel) -> FloatArray:
    """(N,) sine of the turn at the start of each edge, small where the outline hardly turns or turns inwards."""
    ends = [panel.curve(k, np.array([0.0, _TANGENT, 1.0 - _TANGENT, 1.0])) for k in range(len(panel.edges))]
    leaving = np.array([p[1] - p[0] for p in ends])
    arriving = np.roll(np.array([p[3] - p[2] for p in ends]), 1, axis=0)
    turn = arriving[:, 0] * leaving[:, 1] - arriving[:, 1] * leaving[:, 0]
    size = np.linalg.norm(arriving, axis=1) * np.linalg.norm(leaving, axis=1)
    sign = 1.0 if panel.signed_area > 0.0 else -1.0
    return np.maximum(sign * turn / size, _LEAST_SHARPNESS)


def mesh_quads(pattern: Pattern, edge_length: float = 0.02, grid: tuple[int, int] | None = None) -> list[PanelMesh]:
    """Meshes all panels of a pattern with quads whose counts agree along seams.

    Args:
        pattern: the panels and their seams.
        edge_length: wanted length of the quads' sides [m].
        grid: (columns, rows) of vertices that every panel shall have, along its lowest side and up; default: as the
            length asks for.

    Raises:
        ValueError: names the panel that has no four sides or is too bent for a grid, or says that no numbers of pieces fit
            all seams.
    """
    check_number(edge_length, "edge_length", 1e-4, 10.0)
    if grid is not None:
        for value, name in zip(grid, ("columns", "rows"), strict=True):
            check_number(value, f"grid: {name}", 2, 1000, integer=True)
    sides = [panel_sides(panel) for panel in pattern.panels]
    counts = _pieces(pattern, sides, edge_length, grid)
    return [_patch(panel, side, count) for panel, side, count in zip(pattern.panels, sides, counts)]


def _pieces(
    pattern: Pattern, sides: Sequence[tuple[tuple[int, ...], ...]], h: float, grid: tuple[int, int] | None
) -> list[list[int]]:
    """For each panel the pieces of each edge: nearest to lengths over h, or to its share of a side of the grid, equal on
    opposite sides and along seams."""
    from scipy.optimize import Bounds, LinearConstraint, milp

    number = {panel.name: n for n, panel in enumerate(pattern.panels)}
    starts = np.cumsum([0, *(len(panel.edges) for panel in pattern.panels)])
    count = int(starts[-1])
    lengths = [np.array([panel.length(k) for k in range(len(panel.edges))]) for panel in pattern.panels]
    wanted = np.concatenate(lengths) / h
    rows: list[FloatArray] = []
    sums: list[float] = []

    def demand(plus: Sequence[int], minus: Sequence[int], total: float = 0.0) -> None:
        row = np.zeros(2 * count)
        row[list(plus)] += 1.0
        row[list(minus)] -= 1.0
        rows.append(row)
        sums.append(total)

    for n, four in enumerate(sides):
        ids = [[int(starts[n]) + k for k in side] for side in four]
        for k in range(2):
            demand(ids[k], ids[k + 2])
            if grid is not None:
                demand(ids[k], (), grid[k] - 1)
                for side in (four[k], four[k + 2]):
                    of_side = lengths[n][list(side)]
                    wanted[starts[n] + np.array(side)] = (grid[k] - 1) * of_side / of_side.sum()
    for seam in pattern.seams:
        a, b = starts[number[seam.panel_a]] + seam.edge_a, starts[number[seam.panel_b]] + seam.edge_b
        demand((int(a),), (int(b),))
    # the second half of the unknowns bounds how far the first is off
    eye = np.eye(count)
    equal = LinearConstraint(np.array(rows), sums, sums)
    above = LinearConstraint(np.hstack([eye, -eye]), -np.inf, wanted)
    below = LinearConstraint(np.hstack([eye, eye]), wanted, np.inf)
    bounds = Bounds(np.concatenate([np.ones(count), np.zeros(count)]), np.inf)
    whole = np.concatenate([np.ones(count), np.zeros(count)])
    # what is shorter may be off by fewer pieces
    cost = np.concatenate([np.zeros(count), 1.0 / np.maximum(wanted, 1.0)])
    found = milp(cost, constraints=[equal, above, below], bounds=bounds, integrality=whole)
    if found.x is None:
        size = f"grid = {grid}" if grid is not None else f"edge_length = {h:g}"
        raise ValueError(
            f"pattern {pattern.name!r}: no numbers of rows and columns fit all of its seams ({size}); triangles mesh it"
        )
    pieces = np.rint(found.x[:count]).astype(int)
    return [pieces[a:b].tolist() for a, b in pairwise(starts)]


def _patch(panel: Panel, sides: tuple[tuple[int, ...], ...], counts: Sequence[int]) -> PanelMesh:
    """The grid of one panel: border in the order of the loop first, then the inside."""
    border = np.concatenate([panel.sample(k, count)[:-1] for k, count in enumerate(counts)])
    starts = np.concatenate([[0], np.cumsum(counts)])
    total = len(border)
    edge_vertices = tuple((np.arange(a, b + 1) % total).astype(np.int32) for a, b in pairwise(starts))
    lines = [np.concatenate([edge_vertices[side[0]][:1], *(edge_vertices[k][1:] for k in side)]) for side in sides]
    bottom, right, top, left = lines[0], lines[1], lines[2][::-1], lines[3][::-1]
    columns, rows = len(bottom), len(right)
    ids = np.full((columns, rows), -1, np.int32)
    ids[:, 0], ids[-1], ids[:, -1], ids[0] = bottom, right, top, left
    inner = ids < 0
    ids[inner] = total + np.arange(int(inner.sum()))
    place = _coons(border[bottom], border[right], border[top], border[left])
    quads = np.stack([ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]], axis=-1).reshape(-1, 4)
    c, r = np.meshgrid(np.arange(columns - 1), np.arange(rows - 1), indexing="ij")
    even = (c + r) % 2 == 0
    # in its corners a diagonal from the corner: another one would cut it off, and lie on that of the panel sewn on there
    even[0, 0] = even[-1, -1] = True
    even[-1, 0] = even[0, -1] = False
    even = even.ravel()[:, None]
    first = np.where(even, quads[:, [0, 1, 2]], quads[:, [0, 1, 3]])
    second = np.where(even, quads[:, [0, 2, 3]], quads[:, [1, 2, 3]])
    faces = np.ascontiguousarray(np.stack([first, second], axis=1).reshape(-1, 3))
    sign = 1.0 if panel.signed_area > 0.0 else -1.0
    for _ in range(_ROUNDS):
        points = np.concatenate([border, place[inner]])
        u, w = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
        area = sign * (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0])
        if (area > 0.0).all():
            return PanelMesh(points, faces, edge_vertices, np.ascontiguousarray(quads))
        for _ in range(_PASSES):
            _smooth(place)
    raise ValueError(f"panel {panel.name!r}: too bent for a grid of {columns} x {rows} vertices; triangles mesh it")


def _smooth(place: FloatArray) -> None:
    """One pass towards a grid whose coordinates are harmonic in the panel, which does not fold [Winslow 1966]."""
    s = 0.5 * (place[2:, 1:-1] - place[:-2, 1:-1])
    t = 0.5 * (place[1:-1, 2:] - place[1:-1, :-2])
    a, b, c = (np.einsum("ijk,ijk->ij", u, w)[:, :, None] for u, w in ((t, t), (s, t), (s, s)))
    mixed = 0.25 * (place[2:, 2:] - place[2:, :-2] - place[:-2, 2:] + place[:-2, :-2])
    along, across = place[2:, 1:-1] + place[:-2, 1:-1], place[1:-1, 2:] + place[1:-1, :-2]
    place[1:-1, 1:-1] = (a * along + c * across - 2.0 * b * mixed) / np.maximum(2.0 * (a + c), 1e-300)


def _coons(bottom: FloatArray, right: FloatArray, top: FloatArray, left: FloatArray) -> FloatArray:
    """(columns, rows, 2) points between four sides [Coons 1967]."""
    s, t = (np.linspace(0.0, 1.0, len(line)) for line in (bottom, right))
    s, t = s[:, None, None], t[None, :, None]
    along = (1.0 - t) * bottom[:, None] + t * top[:, None]
    across = (1.0 - s) * left[None] + s * right[None]
    corners = (1.0 - s) * ((1.0 - t) * bottom[0] + t * top[0]) + s * ((1.0 - t) * bottom[-1] + t * top[-1])
    return np.asarray(along + across - corners)
