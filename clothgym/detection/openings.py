"""Openings of a garment and the limbs through them: whether a garment is worn.

An opening is a closed loop of vertices; its fan is the disc of triangles from its centroid. The signed crossing number
of a limb's path with the fan tells whether the limb goes through it, and in which sense.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import FloatArray, as_points
from clothgym.kernels import crossing
from clothgym.rig import Limb

LEGS = "legs"
"""Name of what goes through a hem or a waist: both legs."""

AND = " + "
"""Between the names of limbs that go through one opening together."""


def crossing_number(loop: ArrayLike, path: ArrayLike) -> int:
    """Signed crossings of a path (M, 3) with the fan of a closed loop (N, 3): +1 along the loop's right-hand normal.

    For a path whose ends are far from the loop, this is how often the loop winds around it.

    Raises:
        ValueError: fewer than three points in the loop, or two in the path.
    """
    ring, way = as_points(loop, "loop"), as_points(path, "path")
    if len(ring) < 3 or len(way) < 2:
        raise ValueError(f"loop, path: expected at least 3 and 2 points, got {len(ring)} and {len(way)}")
    return int(crossing.crossing_number(np.concatenate([ring, ring.mean(axis=0)[None], way]), len(ring)))


@dataclass(frozen=True)
class Threading:
    """What goes through an opening.

    Attributes:
        expected: the limb that belongs through it.
        crossings: limb name -> signed crossing number.
        through: names of the limbs that go through it.
    """

    expected: str
    crossings: dict[str, int]

    @property
    def through(self) -> tuple[str, ...]:
        return tuple(name for name, number in self.crossings.items() if number != 0)

    @property
    def right(self) -> bool:
        """Exactly what is expected goes through, once, several limbs all in the same sense.

        All limbs begin at one place, inside the chest. An opening around the trunk above it, a strapless top, has head and
        arms through it instead of the legs: the same, seen from the other side.
        """
        wanted = members(self.expected)
        inside = {self.crossings.get(name, 0) for name in wanted}
        outside = {number for name, number in self.crossings.items() if name not in wanted} or {0}
        if len(inside) != 1 or len(outside) != 1:
            return False
        (through,), (beside,) = inside, outside
        return abs(through - beside) == 1 and (beside == 0 or len(wanted) > 1)


def members(expected: str) -> tuple[str, ...]:
    """Names of the limbs that an expectation names."""
    return ("left_leg", "right_leg") if expected == LEGS else tuple(expected.split(AND))


def expectation(limbs: Sequence[str]) -> str:
    """The name of what goes through an opening: one limb, `LEGS`, or several; what is around the trunk, with head and arms
    above it, is called `LEGS` too."""
    if set(limbs) in ({"head", "left_arm", "right_arm"}, {"left_leg", "right_leg"}):
        return LEGS
    return AND.join(limbs)


def expected_limb(loop: ArrayLike, limbs: Sequence[Limb]) -> str:
    """The limb that an opening is placed nearest to; `LEGS` for one around the trunk or around both legs.

    Raises:
        ValueError: no limbs.
    """
    if not limbs:
        raise ValueError("limbs: none; the body has no skeleton")
    centre = as_points(loop, "loop").mean(axis=0)
    paths = {limb.name: limb.points[limb.start :] for limb in limbs}
    by_name = {limb.name: limb for limb in limbs}
    if {"left_leg", "right_leg"} <= set(by_name):
        left, right = by_name["left_leg"], by_name["right_leg"]
        trunk = left.points[: left.start]
        count = min(len(left.points) - left.start, len(right.points) - right.start)
        between = 0.5 * (left.points[left.start :][:count] + right.points[right.start :][:count])
        paths[LEGS] = np.concatenate([trunk, between])
    return min(paths, key=lambda name: _distance(centre, paths[name]))


def _distance(point: FloatArray, path: FloatArray) -> float:
    """From a point to a polyline [m]."""
    return float(np.linalg.norm(_feet(point, path) - point, axis=1).min())


def nearest_on(points: FloatArray, path: FloatArray) -> FloatArray:
    """(N, 3) nearest places on a polyline (M, 3) [m]."""
    feet = [_feet(point, path) for point in points]
    return np.array([foot[np.linalg.norm(foot - point, axis=1).argmin()] for point, foot in zip(points, feet)])


def _feet(point: FloatArray, path: FloatArray) -> FloatArray:
    """Nearest places to a point on each piece of a polyline."""
    start, way = path[:-1], np.diff(path, axis=0)
    squared = np.maximum(np.einsum("ij,ij->i", way, way), 1e-300)
    share = np.clip(np.einsum("ij,ij->i", point - start, way) / squared, 0.0, 1.0)
    return np.asarray(start + share[:, None] * way)


def threading(loop: ArrayLike, limbs: Sequence[Limb], expected: str) -> Threading:
    """What goes through an opening (N, 3) now."""
    return Threading(expected, {limb.name: crossing_number(loop, limb.points) for limb in limbs})
