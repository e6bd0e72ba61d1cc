"""The front of cost against errors: what nothing else beats."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

CHEAPER = 0.9
"""A setting counts as cheaper from a tenth on: single timings are not better than that."""
CLOSER = 1.05
"""Errors within a twentieth count as equal."""


@dataclass(frozen=True)
class Point:
    """A setting by its cost [ms per simulated second] and errors, in the order of the subject's."""

    label: str
    cost: float
    errors: tuple[float, ...]


def clamped(points: Sequence[Point], floors: Sequence[float]) -> list[Point]:
    """The same with errors that are not below their floors, one each: there nothing can be told apart."""
    return [Point(point.label, point.cost, tuple(map(max, point.errors, floors))) for point in points]


def front(points: Sequence[Point], error: int) -> list[Point]:
    """The points that no other beats in both cost and one error, from the cheapest on."""
    kept: list[Point] = []
    best = math.inf
    for point in sorted(points, key=lambda point: (point.cost, point.errors[error])):
        if point.errors[error] < best:
            kept.append(point)
            best = point.errors[error]
    return kept


def beaten_by(point: Point, points: Sequence[Point], floors: Sequence[float]) -> Point | None:
    """The cheapest point that costs a tenth less and is no worse in any error, or None.

    Args:
        floors: errors below which the reference cannot tell one from another, one each.
    """
    better = [
        other
        for other in points
        if other.cost < CHEAPER * point.cost
        and all(e <= max(CLOSER * own, floor) for e, own, floor in zip(other.errors, point.errors, floors))
    ]
    return min(better, key=lambda other: other.cost, default=None)
