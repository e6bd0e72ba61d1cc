"""Outlines of panels with named edges, and a draft that places and sews them."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.pattern import Edge, Panel, Pattern, Seam

Point = tuple[float, float]


@dataclass(frozen=True)
class Outline:
    """A closed loop of edges: edge k runs from corner k to the next; counter-clockwise = the outside looks at the reader.

    Attributes:
        corners: [m].
        labels: the name of each edge, unique.
        controls: for each edge no, one or two control points of its Bezier curve [m].
        grid: ids of the four corners between the sides of the panel's grid, see `quad_mesh`; none = they are found.
    """

    corners: tuple[Point, ...]
    labels: tuple[str, ...]
    controls: tuple[tuple[Point, ...], ...]
    grid: tuple[int, ...] = ()

    @staticmethod
    def of(*parts: Any, grid: tuple[Point, ...] = ()) -> Outline:
        """From corners (x, y), each followed by the label of the edge that leaves it, or (label, control, ...); `grid`: the
        four corners of its grid."""
        corners, edges = parts[0::2], parts[1::2]
        named = [(edge,) if isinstance(edge, str) else tuple(edge) for edge in edges]
        return Outline(
            tuple(corners),
            tuple(edge[0] for edge in named),
            tuple(edge[1:] for edge in named),
            tuple(corners.index(point) for point in grid),
        )

    def turned_over(self) -> Outline:
        """The same piece with its other side out: a back for a front."""
        order = [0, *range(len(self.corners) - 1, 0, -1)]
        return Outline(
            tuple(self.corners[k] for k in order),
            self.labels[::-1],
            tuple(points[::-1] for points in self.controls[::-1]),
            tuple(order.index(k) for k in self.grid),
        )

    def mirrored(self) -> Outline:
        """The piece for the other side of the body: x -> -x, the same side out."""
        over = self.turned_over()
        return dataclasses.replace(
            over,
            corners=tuple((-x, y) for x, y in over.corners),
            controls=tuple(tuple((-x, y) for x, y in points) for points in over.controls),
        )

    def edges(self) -> tuple[Edge, ...]:
        """As a panel has them."""
        kinds = ("line", "quadratic", "cubic")
        made = []
        for k, (label, points) in enumerate(zip(self.labels, self.controls)):
            j = (k + 1) % len(self.corners)
            (ax, ay), (bx, by) = self.corners[k], self.corners[j]
            ex, ey = bx - ax, by - ay
            square = ex * ex + ey * ey
            params: list[float] = []
            for x, y in points:
                px, py = x - ax, y - ay
                params += [(px * ex + py * ey) / square, (py * ex - px * ey) / square]
            made.append(Edge((k, j), kinds[len(points)], tuple(params), label))
        return tuple(made)


class Draft:
    """A pattern in the making."""

    def __init__(self) -> None:
        self.panels: dict[str, Panel] = {}
        self.outlines: dict[str, Outline] = {}
        self.seams: list[Seam] = []

    def add(self, name: str, outline: Outline, place: FloatArray, turn: FloatArray | None = None) -> None:
        """Places a panel: its origin at a place (3,) [m], turned by a rotation matrix (3, 3)."""
        angles = (0.0, 0.0, 0.0) if turn is None else _degrees(turn)
        where = tuple(float(c) for c in place)
        self.outlines[name] = outline
        extra = {"grid_corners": list(outline.grid)} if outline.grid else {}
        self.panels[name] = Panel(name, np.array(outline.corners), outline.edges(), where, angles, extra=extra)  # type: ignore[arg-type]

    def sew(self, first: str, edge: str, second: str, other: str | None = None) -> None:
        """Joins two edges by their labels; the second has the same label unless told."""
        sides = [
            (name, self.outlines[name].labels.index(label)) for name, label in ((first, edge), (second, other or edge))
        ]
        self.seams.append(Seam(*sides[0], *sides[1]))

    def pattern(self, name: str) -> Pattern:
        return Pattern(name, tuple(self.panels.values()), tuple(self.seams))


def _degrees(turn: FloatArray) -> tuple[float, float, float]:
    """(rx, ry, rz) with Rz Ry Rx = turn."""
    rx = math.atan2(turn[2, 1], turn[2, 2])
    ry = -math.asin(min(1.0, max(-1.0, float(turn[2, 0]))))
    rz = math.atan2(turn[1, 0], turn[0, 0])
    return math.degrees(rx), math.degrees(ry), math.degrees(rz)
