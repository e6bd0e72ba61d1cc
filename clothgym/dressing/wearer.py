"""What fitting asks of a body: its sizes, its trunk, its arms, and which limb a tube is for; with a skeleton or without."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.body import Body
from clothgym.detection.openings import nearest_on
from clothgym.dressing.cut import Cut
from clothgym.dressing.sewing import opening_lengths
from clothgym.garment import Garment
from clothgym.rig import Limb
from clothgym.sizes import Arm, Sizes, sizes

_ALONG_ARM, _SLICE, _AROUND_ARM = (0.6, 1.0), 0.01, 0.08
"""Shares of the way to the wrist where an arm is cut, and shares of the height: half of such a cut, and how far around it."""
_BESIDE_SHOULDERS = 0.02
_TRUNK_SHARE = 0.125
"""Half the width of a person's trunk is less than this share of the height."""
_NECK, _LOW = 0.85, 0.25
"""A tube with an opening smaller than the first share of the waist, and lower than the second of its hem, is for the neck."""


def known_sizes(body: Body) -> Sizes | None:
    """None for a body that has no waist, crotch or armpits where a standing person has them."""
    try:
        return sizes(body)
    except ValueError:
        return None


def arms(body: Body) -> dict[str, Limb]:
    """Paths of the arms by side: of the body's limbs, or from its sizes; none of a body that has neither."""
    limbs = {limb.name: limb for limb in body.limbs}
    if "left_arm" in limbs and "right_arm" in limbs:
        return {side: limbs[f"{side}_arm"] for side in ("left", "right")}
    s = known_sizes(body)
    if s is None:
        return {}
    pairs = (("left", s.left_arm), ("right", s.right_arm))
    return {side: Limb(f"{side}_arm", _arm_path(body, arm, s.height), 0) for side, arm in pairs}


def _arm_path(body: Body, arm: Arm, height: float) -> FloatArray:
    """Shoulder, below the elbow and wrist, each in the middle of what is around the straight way there: arms are bent."""
    v, path = body.mesh.vertices, [arm.shoulder]
    for share in _ALONG_ARM:
        place = arm.shoulder + share * (arm.wrist - arm.shoulder)
        off = v - place
        near = (np.abs(off @ arm.way) < _SLICE * height) & (np.linalg.norm(off, axis=1) < _AROUND_ARM * height)
        path.append(0.5 * (v[near].min(axis=0) + v[near].max(axis=0)) if near.any() else place)
    return np.stack(path)


def trunk_faces(body: Body) -> np.ndarray:
    """Faces without those of the arms: by the shoulders where the limbs are known, else by a person's proportions."""
    vertices, faces = body.mesh.vertices, body.mesh.faces
    shoulders = np.array([limb.points[limb.start] for limb in body.limbs if limb.name.endswith("arm")])
    if len(shoulders):
        middle, half = float(shoulders[:, 0].mean()), 0.5 * float(np.ptp(shoulders[:, 0])) + _BESIDE_SHOULDERS
    else:
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        middle, half = 0.5 * float(low[0] + high[0]), _TRUNK_SHARE * float(high[1] - low[1])
    centres = vertices[faces].mean(axis=1)
    return faces[np.abs(centres[:, 0] - middle) <= half]


def own_limb(garment: Garment, cut: Cut, body: Body) -> Limb | None:
    """The limb of a tube for one arm, one leg or the neck: the one that its openings are nearest to."""
    limbs = {limb.name: limb for limb in body.limbs}
    if not cut.around:
        legs = [limb for limb in body.limbs if limb.name.endswith("leg")]
        return _nearest_limb(garment, [*legs, *arms(body).values()])
    s = known_sizes(body)
    if s is None or "head" not in limbs or not len(cut.around) == len(garment.openings) == 2:
        return None
    lengths = opening_lengths(garment)
    tall = abs(float(np.diff([garment.vertices[loop][:, 1].mean() for loop in garment.openings])[0]))
    return limbs["head"] if min(lengths) < _NECK * s.waist_girth and tall < _LOW * max(lengths) else None


def _nearest_limb(garment: Garment, limbs: Sequence[Limb]) -> Limb | None:
    """The limb that the openings together are nearest to."""
    rings = np.array([garment.vertices[loop].mean(axis=0) for loop in garment.openings])

    def distance(limb: Limb) -> float:
        return float(np.linalg.norm(nearest_on(rings, limb.points[limb.start :]) - rings, axis=1).sum())

    return min(limbs, key=distance) if limbs else None
