"""What a garment is cut for, read off its openings and seams as they are placed: arms, legs, shoulders, a crotch.

Files name their panels as they like and put the origin where they like; what they share is that a garment stands upright
around a body that faces z, and is about as wide to the left of its middle as to the right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.garment import Garment

_BESIDE = 0.15
"""An opening whose middle is further beside that of the garment than this share of its width is for one arm or one leg."""
_CENTRAL = 1.0 / 3.0
"""A garment stands around x = 0 unless that is further beside the middle of its panels than this share of their width."""
_AT_MIDDLE = 0.03
"""[m] cloth this near to the middle counts as being there: an edge of the mesh that cuts are read from."""
_NEAR_MIDDLE = 0.06
"""[m] the same for a crotch: panels whose crotches overlap put it beside the middle."""


_LEVEL = 0.3
"""A shoulder seam runs outwards by more than this share of how far it falls; side seams fall."""


@dataclass(frozen=True, eq=False)
class Cut:
    """What a garment has.

    Attributes:
        middle: x of the plane between left and right [m].
        arms, legs: numbers of the openings by side, "left" (+x) or "right".
        around: the other openings, from top to bottom.
        crotch: (3,) where the legs part [m]; None without legs.
        shoulders: ids of the vertices of the outer halves of the shoulder seams; empty without arms.
    """

    middle: float
    arms: dict[str, int]
    legs: dict[str, int]
    around: tuple[int, ...]
    crotch: FloatArray | None
    shoulders: IntArray

    def limbs(self) -> list[tuple[str, ...]] | None:
        """For each opening the names of the limbs that belong through it: each limb has one way out of a garment.

        The only opening left, like the border of an open jacket, is for all limbs that have no other; of two, the upper one
        is for the head and arms, the lower one for legs. None: neither.
        """
        names: dict[int, tuple[str, ...]] = {n: (f"{side}_arm",) for side, n in self.arms.items()}
        names |= {n: (f"{side}_leg",) for side, n in self.legs.items()}
        taken = {name for group in names.values() for name in group}
        up = tuple(name for name in ("head", "left_arm", "right_arm") if name not in taken)
        down = tuple(name for name in ("left_leg", "right_leg") if name not in taken)
        if len(self.around) == 1:
            names[self.around[0]] = (*up, *down)
        elif len(self.around) == 2 and down:
            names[self.around[0]], names[self.around[1]] = up, down
        else:
            return None
        return [names[n] for n in range(len(names))]


def read(garment: Garment) -> Cut:
    """What a placed garment, before it is sewn, has."""
    x = garment.vertices
    low, high = float(x[:, 0].min()), float(x[:, 0].max())
    middle = 0.5 * (low + high)
    if abs(middle) < _CENTRAL * (high - low):
        middle = 0.0
    rings = [x[loop] for loop in garment.openings]
    beside = [float(ring[:, 0].mean()) - middle for ring in rings]
    lateral = [n for n, ring in enumerate(rings) if abs(beside[n]) > _BESIDE * float(np.ptp(ring[:, 0]))]
    around = tuple(n for n in range(len(rings)) if n not in lateral)
    sides = {side: [n for n in lateral if (beside[n] > 0.0) == (side == "left")] for side in ("left", "right")}
    legs: dict[str, int] = {}
    crotch = None
    if len(around) == 1 and all(sides.values()) and not _reaches_down(garment, middle, lateral, around[0]):
        legs = {side: numbers[-1] for side, numbers in sides.items()}
        crotch = _crotch(garment, middle, [rings[n] for n in legs.values()])
    arms = {side: rest[0] for side, numbers in sides.items() if (rest := [n for n in numbers if n != legs.get(side)])}
    others = tuple(n for n in lateral if n not in {*arms.values(), *legs.values()})
    shoulders = [_shoulder(garment, middle, side, garment.openings[n]) for side, n in arms.items() if around]
    joined = np.concatenate([np.zeros(0, np.int32), *shoulders])
    return Cut(middle, arms, legs, tuple(sorted((*around, *others))), crotch, joined)


def _reaches_down(garment: Garment, middle: float, lateral: list[int], opening: int) -> bool:
    """Whether an opening is where the cloth in the middle ends below, as a hem does; above a crotch it goes on."""
    x = garment.vertices
    near = np.abs(x[:, 0] - middle) <= _AT_MIDDLE
    for n in lateral:  # wide legs reach to the middle and over it
        near[garment.openings[n]] = False
    if not near.any():
        return True
    lowest = float(x[near, 1].min())
    return bool(x[garment.openings[opening], 1].min() <= lowest + _AT_MIDDLE)


def _crotch(garment: Garment, middle: float, hems: list[FloatArray]) -> FloatArray:
    """The lowest place above both hems where seams meet in the middle, or else where left and right meet."""
    x, seams = garment.vertices, _neighbours(garment)
    on_border = {int(v) for loop in garment.openings for v in loop}
    floor = max(float(ring[:, 1].mean()) for ring in hems)
    near = [v for v in seams if abs(x[v, 0] - middle) <= _NEAR_MIDDLE and x[v, 1] > floor and v not in on_border]
    meets = [v for v in near if len(seams[v]) > 2] or near
    if not meets:
        inner = np.flatnonzero((np.abs(x[:, 0] - middle) <= _AT_MIDDLE) & (x[:, 1] > floor))
        meets = inner.tolist() or [int(np.argmin(np.abs(x[:, 0] - middle)))]
    return np.array(x[min(meets, key=lambda v: x[v, 1])])


def _neighbours(garment: Garment) -> dict[int, set[int]]:
    """Vertices beside each vertex along seams."""
    graph: dict[int, set[int]] = {}
    for a, b in garment.seam_edges.tolist():
        graph.setdefault(a, set()).add(b)
        graph.setdefault(b, set()).add(a)
    return graph


def _shoulder(garment: Garment, middle: float, side: str, armhole: IntArray) -> IntArray:
    """The outer half of the highest seam that runs level and outwards on a side without beginning in the middle: where a
    head is beside the neck. Hoods and collars, whose seams lie around the neck, do not hide it. Straps without such a seam
    are over the shoulder where their opening for the arm is highest."""
    x, sign = garment.vertices, 1.0 if side == "left" else -1.0
    lines = []
    for line in _lines(garment):
        out = sign * (x[line, 0] - middle)
        if out[0] > out[-1]:
            line, out = line[::-1], out[::-1]
        run = np.abs(x[line[-1]] - x[line[0]])
        if out.min() > 0.5 * _AT_MIDDLE and run[0] > _LEVEL * run[1]:
            lines.append(line)
    if not lines:
        return np.array([armhole[np.argmax(x[armhole, 1])]], np.int32)
    best = max(lines, key=lambda line: float(x[line, 1].mean()))
    return np.array(best[len(best) // 2 :], np.int32)


def _lines(garment: Garment) -> list[list[int]]:
    """Seams as lines of vertices, each from a border or a meeting of seams to the next."""
    graph = _neighbours(garment)
    on_border = {int(v) for loop in garment.openings for v in loop}
    ends = {v for v in graph if len(graph[v]) != 2 or v in on_border}
    lines = []
    for start in sorted(ends):
        for first in sorted(graph[start]):
            line = [start, first]
            while line[-1] not in ends:
                (following,) = graph[line[-1]] - {line[-2]}
                line.append(following)
            if start <= line[-1]:
                lines.append(line)
    return lines
