"""Whether a garment is worn: its own limb through each opening, and none that slid off."""

from __future__ import annotations

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.body import Body
from clothgym.detection.body_maps import BodyMaps
from clothgym.detection.openings import Threading, expected_limb, threading
from clothgym.garment import Garment

SLIDE_LIMIT = 0.2
"""[m] an opening whose middle moves further than this after sewing slid off: a skirt around the ankles is not worn."""


def expected_limbs(garment: Garment, body: Body) -> list[str]:
    """The limb that each opening is placed around; "body" for a body without a skeleton."""
    if not body.limbs:
        return ["body"] * len(garment.openings)
    return [expected_limb(garment.vertices[loop], body.limbs) for loop in garment.openings]


def threadings(garment: Garment, x: FloatArray, body: Body, maps: BodyMaps, expected: list[str]) -> list[Threading]:
    """What goes through each opening at x (V, 3); for a body without a skeleton, whether any part of it does."""
    if body.limbs:
        return [threading(x[loop], body.limbs, name) for loop, name in zip(garment.openings, expected)]
    found = []
    for loop in garment.openings:
        ring = x[loop]
        centre = ring.mean(axis=0)
        fan = centre + np.linspace(0.0, 0.9, 10)[:, None, None] * (ring - centre)
        distances, _ = maps.query(fan.reshape(-1, 3), 0.0)
        found.append(Threading("body", {"body": int(np.isfinite(distances).any())}))
    return found


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
