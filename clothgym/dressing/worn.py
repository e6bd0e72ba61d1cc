"""Whether a garment is worn: its own limb through each opening, and none that slid off."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from clothgym.arrays import FloatArray, as_points
from clothgym.body import Body
from clothgym.detection.body_maps import BodyMaps
from clothgym.detection.openings import LEGS, Threading, expectation, expected_limb, members, threading
from clothgym.dressing.cut import read
from clothgym.garment import Garment
from clothgym.rig import Limb

SLIDE_LIMIT = 0.2
"""[m] an opening whose middle moves further than this after sewing slid off: a skirt around the ankles is not worn."""

_AROUND, _MOST_AROUND = 0.01, 200
"""Share of a body's vertices, and their greatest number, that carry a point of a limb's path along."""


_NOSE = 0.2
"""Share of the way from the base of the skull to the crown; hoods cover the brow."""


def expected_limbs(garment: Garment, body: Body) -> list[str]:
    """What belongs through each opening: the limb that it is placed around; "body" for a body without a skeleton.

    Where that would leave a limb without its own way out, or give it two, the cut of the garment tells.
    """
    if not body.limbs:
        return ["body"] * len(garment.openings)
    nearest = [expected_limb(garment.vertices[loop], body.limbs) for loop in garment.openings]
    if len(set(nearest)) == 1 and (nearest[0] != LEGS or len(nearest) == 2):
        return nearest  # a cuff, a scarf, a skirt
    through = [name for opening in nearest for name in members(opening)]
    if sorted(through) == sorted(limb.name for limb in body.limbs):
        return nearest
    told = read(garment).limbs()
    return nearest if told is None else [expectation(limbs) for limbs in told]


def carried_limbs(body: Body, vertices: ArrayLike) -> tuple[Limb, ...]:
    """The limbs of a body whose vertices have moved to (V, 3) [m], by whatever motion.

    Each point goes along with the vertices nearest to it where the limbs were told, as a rigid body [Kabsch 1976]; the last
    one, beyond the tip, with the one before it.
    """
    start, now = body.mesh.vertices, as_points(vertices, "vertices", len(body.mesh.vertices))
    count = min(len(start), max(4, min(round(_AROUND * len(start)), _MOST_AROUND)))
    tree = cKDTree(start)
    limbs = []
    for limb in body.limbs:
        points = np.array(limb.points)
        for n, point in enumerate(limb.points):
            if n < len(points) - 1:
                _, near = tree.query(point, count)
                before, after = start[near].mean(axis=0), now[near].mean(axis=0)
                u, _, v = np.linalg.svd((start[near] - before).T @ (now[near] - after))
                u[:, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(v))
                turn = u @ v
            points[n] = after + (point - before) @ turn
        limbs.append(Limb(limb.name, points, limb.start))
    return tuple(limbs)


def threadings(garment: Garment, x: FloatArray, body: Body, maps: BodyMaps, expected: list[str]) -> list[Threading]:
    """What goes through each opening at x (V, 3); for a body without a skeleton, whether any part of it does."""
    if body.limbs:
        limbs = paths(garment, expected, body.limbs)
        return [threading(x[loop], limbs, name) for loop, name in zip(garment.openings, expected)]
    found = []
    for loop in garment.openings:
        ring = x[loop]
        centre = ring.mean(axis=0)
        fan = centre + np.linspace(0.0, 0.9, 10)[:, None, None] * (ring - centre)
        distances, _ = maps.query(fan.reshape(-1, 3), 0.0)
        found.append(Threading("body", {"body": int(np.isfinite(distances).any())}))
    return found


def paths(garment: Garment, expected: Sequence[str], limbs: Sequence[Limb]) -> tuple[Limb, ...]:
    """The limbs as a garment is asked about them: under a hood, whose border reaches above the chin, the head looks out in
    front."""
    tops = [float(garment.vertices[loop, 1].max()) for loop, name in zip(garment.openings, expected) if _for_head(name)]
    highest = max(tops, default=-np.inf)

    def hidden(limb: Limb) -> bool:
        return limb.name == "head" and len(limb.points) > 2 and highest > limb.points[-3][1]

    return tuple(_looking_out(limb) if hidden(limb) else limb for limb in limbs)


def _for_head(expected: str) -> bool:
    return "head" in members(expected)


def _looking_out(head: Limb) -> Limb:
    """A head's path that leaves it through the face instead of the crown."""
    points = np.array(head.points[:-1])
    points[-1] = points[-2] + _NOSE * (points[-1] - points[-2])
    return Limb(head.name, np.vstack([points, points[-1] + (0.0, 0.0, 1.0)]), head.start)


def slides(garment: Garment, sewn: FloatArray, x: FloatArray) -> list[float]:
    """How far the middle of each opening moved since the seams were closed [m]."""
    return [float(np.linalg.norm((x[loop] - sewn[loop]).mean(axis=0))) for loop in garment.openings]


def what_is_wrong(worn: list[Threading], moved: list[float] | None = None) -> str:
    """In words, which openings are not worn; empty if all are."""
    parts = [
        f"opening for {w.expected} has {', '.join(w.through) or 'nothing'} through it" for w in worn if not w.right
    ]
    for w, slide in zip(worn, moved or []):
        if slide > SLIDE_LIMIT:
            parts.append(f"opening for {w.expected} slid by {1000 * slide:.0f} mm")
    return "; ".join(parts)
