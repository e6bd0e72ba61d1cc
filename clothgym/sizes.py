"""Sizes of a body as a tailor takes them, from the surface alone and, where it has them, the paths of its limbs.

Level sections of a standing body fall apart into parts: the trunk in the middle, the arms beside it, below the crotch the
legs. So the bust is measured without arms, and armpits and crotch are where parts join. Every body that stands upright with
its arms apart from the trunk has them: between an A pose and 20 degrees above level.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.body import Body
from clothgym.rig import heights_above, hull_of

_STEP = 0.006
"""Sections are this share of the height apart."""
_NECK = (0.835, 0.92)
_SHOULDER_SHARE = 0.1
"""Shoulder joints of a body without a skeleton are this share of its height beside the middle, and"""
_SHOULDER_LEVEL = 0.8
"""at this share of it."""
_WRIST_SHARE = 0.75
"""Of the way from a shoulder to the tips of the fingers."""


@dataclass(frozen=True)
class Arm:
    """One arm: its joints and girths [m]."""

    shoulder: FloatArray
    elbow: FloatArray
    wrist: FloatArray
    upper_girth: float
    elbow_girth: float
    wrist_girth: float

    @property
    def length(self) -> float:
        """From the shoulder to the wrist."""
        return float(np.linalg.norm(self.elbow - self.shoulder) + np.linalg.norm(self.wrist - self.elbow))

    @property
    def way(self) -> FloatArray:
        """(3,) direction from the shoulder to the wrist."""
        way = self.wrist - self.shoulder
        return np.asarray(way / np.linalg.norm(way))


@dataclass(frozen=True)
class Sizes:
    """Heights are those of places (y), girths are lengths of a tape around the hull of a section [m].

    Attributes:
        ground, height: lowest place, and how tall.
        centre: x of the middle of the trunk.
        front, back: greatest and least z of the trunk between crotch and armpits.
        ridge: z of the shoulders' ridge.
        neck_height, neck_half, neck_girth: where the neck ends, half of its width there, girth in its middle.
        shoulder_height, shoulder_half: top of the surface above the shoulder joints, and how far they are beside the middle.
        armpit_height, bust_*, waist_*, hip_*, crotch_height, knee_height, ankle_height.
        thigh_girth, knee_girth, calf_girth, ankle_girth: of the left leg.
        leg_axis: (3, 2) x and y of the middle of the left leg at crotch, knee and ankle.
        left_arm, right_arm.
    """

    ground: float
    height: float
    centre: float
    front: float
    back: float
    ridge: float
    neck_height: float
    neck_half: float
    neck_girth: float
    shoulder_height: float
    shoulder_half: float
    armpit_height: float
    bust_height: float
    bust_girth: float
    waist_height: float
    waist_girth: float
    hip_height: float
    hip_girth: float
    crotch_height: float
    knee_height: float
    ankle_height: float
    thigh_girth: float
    knee_girth: float
    calf_girth: float
    ankle_girth: float
    leg_axis: FloatArray
    left_arm: Arm
    right_arm: Arm

    @property
    def inseam(self) -> float:
        """From the crotch to the ankles [m]."""
        return self.crotch_height - self.ankle_height


class Section:
    """The parts of a level section of a surface: for each its points (N, 2) in x and z [m]."""

    def __init__(self, vertices: FloatArray, faces: IntArray, height: float) -> None:
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        above = vertices[:, 1] > height
        first, second, third = (above[faces[:, k]] for k in range(3))
        cut = faces[(first != second) | (second != third)]
        ends = np.sort(np.concatenate([cut[:, [0, 1]], cut[:, [1, 2]], cut[:, [2, 0]]]), axis=1)
        owner = np.tile(np.arange(len(cut)), 3)
        crossed = above[ends[:, 0]] != above[ends[:, 1]]
        ends, owner = ends[crossed], owner[crossed]
        keys, place = np.unique(ends[:, 0].astype(np.int64) * len(vertices) + ends[:, 1], return_inverse=True)
        # faces and the points on the edges between them as one graph
        total = len(keys) + len(cut)
        graph = coo_array((np.ones(len(owner), np.int8), (place, len(keys) + owner)), shape=(total, total))
        part = connected_components(graph, directed=False)[1][: len(keys)]
        a, b = vertices[keys // len(vertices)], vertices[keys % len(vertices)]
        share = ((height - a[:, 1]) / (b[:, 1] - a[:, 1]))[:, None]
        points = (a + share * (b - a))[:, [0, 2]]
        self.parts = [points[part == n] for n in np.unique(part)]

    def part_at(self, x: float, z: float | None = None) -> FloatArray | None:
        """The largest part that reaches over x, or the one whose middle is nearest to (x, z)."""
        if z is not None:
            middles = [_middle(part) for part in self.parts]
            return min(zip(self.parts, middles), key=lambda p: np.hypot(*(p[1] - (x, z))))[0] if middles else None
        over = [part for part in self.parts if part[:, 0].min() <= x <= part[:, 0].max()]
        return max(over, key=_girth) if over else None


def _middle(points: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (points.min(axis=0) + points.max(axis=0)))


def _girth(points: FloatArray) -> float:
    hull = hull_of(points)
    return float(np.linalg.norm(hull - np.roll(hull, 1, axis=0), axis=1).sum())


def _half(points: FloatArray) -> float:
    return 0.5 * float(np.ptp(points[:, 0]))


@lru_cache(maxsize=8)
def sizes(body: Body) -> Sizes:
    """Takes the sizes of a body.

    Raises:
        ValueError: a body that has no waist, crotch or armpits where a standing person has them.
    """
    return _Tape(body).sizes()


class _Tape:
    def __init__(self, body: Body) -> None:
        self.body = body
        self.v, self.f = body.mesh.vertices, body.mesh.faces
        self.low, high = float(self.v[:, 1].min()), float(self.v[:, 1].max())
        self.height = high - self.low
        self.limbs = {limb.name: limb for limb in body.limbs}
        feet = self.v[self.v[:, 1] < self.low + 0.55 * self.height]
        self.centre = float(_middle(feet)[0])
        self.trunk: dict[float, FloatArray] = {}

    def _at(self, share: float) -> float:
        return self.low + share * self.height

    def _part(self, y: float) -> FloatArray:
        """The trunk's part at a height; empty if nothing is in the middle."""
        key = round(y, 6)
        if key not in self.trunk:
            part = Section(self.v, self.f, y).part_at(self.centre)
            self.trunk[key] = np.zeros((0, 2)) if part is None else part
        return self.trunk[key]

    def _heights(self, low: float, high: float) -> list[float]:
        return np.arange(low, high, _STEP * self.height).tolist()

    def _missing(self, what: str) -> ValueError:
        return ValueError(
            f"body {self.body.name!r}: no {what} where a standing person of {self.height:.3g} m has it; patterns of the "
            "package are cut to people who stand with their arms apart from the trunk"
        )

    def sizes(self) -> Sizes:
        crotch = self._crotch()
        waists = self._heights(self._at(0.58), self._at(0.70))
        # the narrowest place, not the narrowest below the ribs of someone without a waist
        girths = [_girth(self._part(y)) for y in waists]
        waist = waists[int(np.argmin(girths))]
        hips = self._heights(crotch + 0.015 * self.height, waist - 0.03 * self.height)
        hip = max(hips, key=lambda y: _girth(self._part(y)))
        armpit = self._armpit(waist)
        busts = self._heights(waist + 0.03 * self.height, armpit - 0.02 * self.height)
        if not busts:
            raise self._missing("bust")
        bust = max(busts, key=lambda y: _girth(self._part(y)))
        neck, neck_half, neck_girth = self._neck()
        joints = {side: self._arm_points(side, armpit) for side in ("left", "right")}
        tops = [self._top(joints[side][0]) for side in joints]
        half = 0.5 * float(abs(joints["left"][0][0] - joints["right"][0][0]))
        between = [self._part(y) for y in (hip, waist, bust)]
        legs = self._leg(crotch)
        return Sizes(
            ground=self.low,
            height=self.height,
            centre=self.centre,
            front=max(float(p[:, 1].max()) for p in between),
            back=min(float(p[:, 1].min()) for p in between),
            ridge=float(np.mean([z for _, z in tops])),
            neck_height=neck,
            neck_half=neck_half,
            neck_girth=neck_girth,
            shoulder_height=float(np.mean([y for y, _ in tops])),
            shoulder_half=half,
            armpit_height=armpit,
            bust_height=bust,
            bust_girth=_girth(self._part(bust)),
            waist_height=waist,
            waist_girth=min(girths),
            hip_height=hip,
            hip_girth=_girth(self._part(hip)),
            crotch_height=crotch,
            left_arm=self._arm(joints["left"]),
            right_arm=self._arm(joints["right"]),
            **legs,
        )

    def _crotch(self) -> float:
        """The lowest height from which on the middle is filled."""
        found = None
        for y in reversed(self._heights(self._at(0.36), self._at(0.58))):
            if len(self._part(y)) == 0:
                break
            found = y
        if found is None:
            raise self._missing("crotch")
        return found

    def _armpit(self, waist: float) -> float:
        """Where the trunk's part suddenly gets wider: the arms join it."""
        before = _half(self._part(waist))
        for y in self._heights(waist, self._at(0.86)):
            half = _half(self._part(y))
            if half > before + 0.02 * self.height:
                return y
            before = half
        raise self._missing("armpits")

    def _neck(self) -> tuple[float, float, float]:
        heights = self._heights(*(self._at(share) for share in _NECK))
        halves = [_half(self._part(y)) for y in heights]
        at = int(np.argmin(halves))
        least = halves[at]
        base = at
        while base > 0 and halves[base - 1] < least + 0.012 * self.height:
            base -= 1
        return heights[base], halves[base], _girth(self._part(heights[at]))

    def _top(self, joint: FloatArray) -> tuple[float, float]:
        """Height and z of the ridge of the surface above a joint."""
        depths = joint[2] + np.arange(-0.05, 0.051, 0.01)
        sides = self.v[self.f, 0] > joint[0]
        near = self.f[(sides[:, 0] != sides[:, 1]) | (sides[:, 1] != sides[:, 2])]
        found = [(heights_above(self.v, near, joint[0], float(z)), float(z)) for z in depths]
        tops = [(float(h[-1]), z) for h, z in found if len(h)]
        return max(tops) if tops else (float(joint[1]), float(joint[2]))

    def _arm_points(self, side: str, armpit: float) -> FloatArray:
        """(3, 3) shoulder, elbow and wrist: joints of the limb's path, or the middle of what is beside the trunk."""
        limb = self.limbs.get(f"{side}_arm")
        if limb is not None and len(limb.points) >= limb.start + 4:
            return np.asarray(limb.points[limb.start : limb.start + 3])
        sign = 1.0 if side == "left" else -1.0
        shoulder = np.array([self.centre + sign * _SHOULDER_SHARE * self.height, self._at(_SHOULDER_LEVEL), 0.0])
        out = self.v[sign * (self.v[:, 0] - self.centre) > 1.2 * _SHOULDER_SHARE * self.height]
        out = out[out[:, 1] > self._at(0.35)]
        if len(out) == 0:
            raise self._missing(f"{side} arm")
        tip = out[np.argmax(np.linalg.norm(out - shoulder, axis=1))]
        shoulder[2] = _middle(self._part(armpit - _STEP * self.height))[1]
        wrist = shoulder + _WRIST_SHARE * (tip - shoulder)
        return np.array([shoulder, 0.5 * (shoulder + wrist), wrist])

    def _arm(self, joints: FloatArray) -> Arm:
        shoulder, elbow, wrist = joints
        fore = elbow + 0.98 * (wrist - elbow)
        upper = shoulder + 0.45 * (elbow - shoulder)
        girths = [
            self._girth_across(p, w)
            for p, w in ((upper, elbow - shoulder), (elbow, wrist - shoulder), (fore, wrist - elbow))
        ]
        return Arm(shoulder, elbow, wrist, *girths)

    def _girth_across(self, point: FloatArray, way: FloatArray) -> float:
        """Girth of what is around a point, across a direction."""
        y = way / np.linalg.norm(way)
        x = np.cross(y, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        turned = (self.v - point) @ np.stack([x, y, np.cross(x, y)], axis=1)
        near = np.abs(turned[self.f, 1]).min(axis=1) < 0.1 * self.height
        part = Section(turned, self.f[near], 0.0).part_at(0.0, 0.0)
        if part is None:
            raise self._missing("arm")
        return _girth(part)

    def _leg(self, crotch: float) -> dict[str, Any]:
        """Of the leg on the left, x > centre."""
        ankle, knee = self._at(0.045), self._at(0.27)

        def part(y: float) -> FloatArray:
            parts = [p for p in Section(self.v, self.f, y).parts if _middle(p)[0] > self.centre]
            near = [p for p in parts if abs(_middle(p)[0] - self.centre) < 0.2 * self.height]
            if not near:
                raise self._missing("left leg")
            return max(near, key=_girth)

        high = crotch - 0.01 * self.height
        levels = (high, knee, ankle)
        axis = np.array([(float(_middle(part(y))[0]), y) for y in levels])
        calves = self._heights(self._at(0.12), knee)
        return {
            "knee_height": knee,
            "ankle_height": ankle,
            "thigh_girth": _girth(part(high)),
            "knee_girth": _girth(part(knee)),
            "calf_girth": max(_girth(part(y)) for y in calves[::4]),
            "ankle_girth": _girth(part(ankle)),
            "leg_axis": axis,
        }
