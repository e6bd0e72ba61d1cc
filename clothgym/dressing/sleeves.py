"""Sleeves turned to the arms of a body: files place them for arms that are level, or lower, or further back."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.detection.openings import nearest_on
from clothgym.dressing.cut import Cut
from clothgym.garment import Garment
from clothgym.pattern import Panel, Pattern
from clothgym.rig import Limb

_MIDDLE = 0.5
"""A sleeve whose end is further from the arm than this share of its radius is turned."""
_INNER = 0.6
"""Panels of a sleeve begin at this share of the way from the middle to the end of the shoulder."""


def turned(pattern: Pattern, garment: Garment, cut: Cut, arms: Mapping[str, Limb]) -> tuple[Pattern, tuple[str, ...]]:
    """The pattern with each sleeve whose end is beside the arm turned about its armhole until the arm is in its middle; a line
    for each.

    Args:
        pattern: placed at the body's shoulders.
        garment, cut: of it.
        arms: paths by side, "left" and "right".
    """
    panels, notes = list(pattern.panels), []
    for side, opening in cut.arms.items():
        panel_numbers = members(pattern, garment, cut, side)
        if not panel_numbers or side not in arms:
            continue
        loop = garment.openings[opening]
        end, path = garment.vertices[loop].mean(axis=0), arms[side].points[arms[side].start :]
        ring = garment.vertices[loop]
        radius = float(np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).sum()) / (2.0 * math.pi)
        if np.linalg.norm(nearest_on(end[None], path)[0] - end) <= _MIDDLE * radius:
            continue
        root = garment.vertices[armhole(garment, panel_numbers, opening)].mean(axis=0)
        way = end - root
        foot = nearest_on(root[None], path)[0]
        target = _along(path, foot, float(np.linalg.norm(way))) - foot
        turn = _arc(way, target)
        angle = math.degrees(math.acos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0)))
        for n in panel_numbers:
            panels[n] = _onto(_turned(panels[n], turn, root, foot), foot + 0.5 * target)
        notes.append(f"fit: {side} sleeve turned by {angle:.0f} degrees to the arm")
    return dataclasses.replace(pattern, panels=tuple(panels)), tuple(notes)


def members(pattern: Pattern, garment: Garment, cut: Cut, side: str) -> list[int]:
    """Numbers of the panels of a sleeve: all beside the shoulder, and sewn to each other up to the opening for the arm."""
    if len(cut.shoulders) == 0:
        return []
    sign, opening = 1.0 if side == "left" else -1.0, cut.arms[side]
    shoulder = sign * (garment.vertices[cut.shoulders, 0] - cut.middle)
    beyond = _INNER * float(shoulder.max())
    beside = {
        n for n, place in enumerate(garment.panel_vertices) if (sign * (place[:, 0] - cut.middle)).min() >= beyond
    }
    numbers = {panel.name: n for n, panel in enumerate(pattern.panels)}
    at_end = set(garment.openings[opening].tolist())
    found = {n for n in beside if at_end & set(garment.welded[n].tolist())}
    while True:
        more = set()
        for seam in pattern.seams:
            pair = {numbers[seam.panel_a], numbers[seam.panel_b]}
            if pair & found:
                more |= pair & beside - found
        if not more:
            return sorted(found)
        found |= more


def armhole(garment: Garment, sleeve: Sequence[int], opening: int) -> IntArray:
    """Ids of the vertices where a sleeve is sewn to the rest, or of the opening where there is none."""
    if not sleeve:
        return garment.openings[opening]
    inside = np.concatenate([garment.welded[n] for n in sleeve])
    outside = np.concatenate([ids for n, ids in enumerate(garment.welded) if n not in sleeve])
    return np.intersect1d(inside, outside)


def _along(path: FloatArray, start: FloatArray, length: float) -> FloatArray:
    """The place on a path so far [m] from a place on it, towards its end."""
    pieces = np.diff(path, axis=0)
    sizes = np.linalg.norm(pieces, axis=1)
    begins = np.concatenate([[0.0], np.cumsum(sizes)])
    at = min(
        (begins[n] + float((start - path[n]) @ piece) / size for n, (piece, size) in enumerate(zip(pieces, sizes))),
        key=lambda s: float(np.linalg.norm(_at(path, begins, s) - start)),
    )
    return _at(path, begins, at + length)


def _at(path: FloatArray, begins: FloatArray, s: float) -> FloatArray:
    return np.array([np.interp(s, begins, path[:, k]) for k in range(3)])


def _arc(start: FloatArray, end: FloatArray) -> FloatArray:
    """The least rotation (3, 3) from one direction to another [Rodrigues]."""
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    x, y, z = np.cross(a, b)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + k + k @ k / max(1.0 + float(a @ b), 1e-9))


def _onto(panel: Panel, place: FloatArray) -> Panel:
    """A panel moved across itself until its plane goes through a place: from far away a sleeve is drawn through a bent arm.
    What then crosses the arm is pushed out on its own side."""
    normal = panel.rotation_matrix[:, 2]
    way = float((place - np.asarray(panel.translation)) @ normal) * normal
    return dataclasses.replace(panel, translation=tuple((np.asarray(panel.translation) + way).tolist()))


def _turned(panel: Panel, turn: FloatArray, pivot: FloatArray, foot: FloatArray) -> Panel:
    """A panel turned about a place that goes to another, its rotation again as Rz Ry Rx."""
    r = turn @ panel.rotation_matrix
    rotation = (
        math.atan2(r[2, 1], r[2, 2]),
        math.asin(float(np.clip(-r[2, 0], -1.0, 1.0))),
        math.atan2(r[1, 0], r[0, 0]),
    )
    place = turn @ (np.asarray(panel.translation) - pivot) + foot
    return dataclasses.replace(panel, translation=tuple(place.tolist()), rotation=tuple(np.degrees(rotation).tolist()))
