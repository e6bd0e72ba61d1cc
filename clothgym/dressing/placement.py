"""Where a pattern's panels stand around a body before they are sewn.

Patterns bring a placement that was made for some body. Fitting moves it: a garment with shoulders to the shoulders of this
body, another one to where its top opening fits around the trunk. A pattern that is too tight at bust, waist or hips, or far
too wide at all of them, is scaled as a whole; then panels that would cross the body are pushed outwards.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.body import Body
from clothgym.detection.body_mesh import still
from clothgym.detection.openings import nearest_on
from clothgym.dressing import sleeves
from clothgym.dressing.cut import Cut, read
from clothgym.dressing.sewing import opening_lengths, rest_of
from clothgym.garment import Garment, assemble
from clothgym.pattern import Pattern
from clothgym.rig import Limb, girth, heights_above, section_hull
from clothgym.sizes import Arm, Sizes, sizes

_SHOULDER_CLEARANCE = 0.02
"""[m] shoulder seams stand this far above the shoulders: lower, they start inside the body."""
_PANEL_CLEARANCE = 0.02
_TIGHTEST, _SNUG = 0.96, 0.98
"""A pattern that is narrower than this share of a girth is made as wide as the second."""
_WIDEST, _LOOSE = 1.6, 1.15
"""The same for one that is wider everywhere."""
_LARGER = 1.25
"""What hangs from the shoulders is made larger by no more than this: a waist that comes to lie at the hips rides up."""
_NOT_THERE = 0.6
"""Share of a girth below which it says nothing."""
_HELD, _HOLDS = 0.97, 0.94
"""The same for a top opening that nothing but its girth holds, against the girth that it would slide over."""
_TRUNK_EASE = 1.04
"""Cloth from shoulder to crotch is so much longer than the way straight down."""
_ARMHOLE, _COLLAR = 1.75, 1.05
"""Armholes go so many times around an upper arm, necks around the narrowest place of a neck: shoulders are in between."""
_ROUND = 2.0 * math.pi * 4e-3
"""[m] cloth lies 4 mm from the skin: so much longer it is than a girth."""
_HIPS = 0.05
"""Share of the height around the widest place of the hips."""
_COARSE = 0.03
"""[m] edges of the garment that the fit is found with."""
_PUSH_ROUNDS = 30
_WAIST_STEP = 0.005
_WAY_ROUNDS = 20
_ALONG_ARM, _SLICE, _AROUND_ARM = (0.6, 1.0), 0.01, 0.08
"""Shares of the way to the wrist where an arm is cut, and shares of the height: half of such a cut, and how far around it."""
_BELOW_CROTCH, _BELOW_ARMPITS = 0.015, 0.01
"""[m] crotch of trousers below that of the body, and top of a bodice without straps below the armpits."""
_BODICE, _SHORTEST_BODICE, _NARROWER, _RISE = 0.45, 0.05, 0.94, 0.01
"""[m], [m]: the waist of such a bodice is looked for to this depth, and is that far below its top at least; its share of the
width at the top is less than the third, where widths that rise by the fourth end the search."""
_NECK, _LOW = 0.85, 0.25
"""A tube with an opening smaller than the first share of the waist, and lower than the second of its hem, is for the neck."""
_BESIDE_SHOULDERS = 0.02
_TRUNK_SHARE = 0.125
"""Half the width of a person's trunk is less than this share of the height."""


def fit(pattern: Pattern, body: Body) -> tuple[Pattern, tuple[str, ...]]:
    """The pattern scaled by girths where it needs that, its placement moved to a body, and what was done, a line each.

    Raises:
        ValueError: the pattern has no opening.
    """
    pattern, notes = _moved(pattern, body)
    factor, why = _factor(pattern, body)
    if factor != 1.0:
        pattern, again = _moved(pattern.scaled(factor), body)
        notes = (f"fit: scaled by {factor:.3f}: {why}", *again)
    pushed, shifts = clear(pattern, body)
    return pushed, (*notes, *shifts)


def _sizes(body: Body) -> Sizes | None:
    """None for a body that has no waist, crotch or armpits where a standing person has them."""
    try:
        return sizes(body)
    except ValueError:
        return None


# Scaling


def _factor(pattern: Pattern, body: Body) -> tuple[float, str]:
    """How much larger a placed pattern must be made, and why; 1 where it fits or the body cannot be measured."""
    s = _sizes(body)
    if s is None:
        return 1.0, ""
    garment = assemble(pattern, _COARSE)
    cut = read(garment)
    if not cut.around or _own_limb(garment, cut, body) is not None:
        return 1.0, ""  # a sleeve, a scarf
    hangs, held = len(cut.shoulders) == 0, 0.0
    ratios = _ratios(_Girths(pattern, garment, cut), body, s, *_whole(garment, cut))
    if hangs:
        trunk = _trunk_faces(body)
        top = float(garment.vertices[garment.openings[cut.around[0]], 1].mean())
        length, there = opening_lengths(garment)[cut.around[0]], girth(body.mesh.vertices, trunk, top)
        if there > 0.0:
            ratios["girth at its top"] = length / there
        held = length / _widest(body, s, trunk, top)
    else:
        ratios |= _upper_ratios(pattern, garment, cut, s)
    # nobody is so much larger: what is narrower there is not cut to lie there
    ratios = {name: ratio for name, ratio in ratios.items() if ratio > _NOT_THERE}
    if not ratios:
        return 1.0, ""
    tight = min(ratios, key=lambda name: ratios[name])
    ratio = ratios[tight]
    if ratio < _TIGHTEST:
        return min(_SNUG / ratio, math.inf if hangs else _LARGER), f"{100 * ratio:.0f} % of the {tight} of {body.name}"
    if held > _HELD:
        return _HOLDS / held, f"its top is {100 * held:.0f} % of the girth that holds it on {body.name}"
    if cut.legs and (short := max(_leg_room(garment, cut, s), _SNUG / ratio)) < _TIGHTEST:
        return short, f"its legs reach below the feet of {body.name}"
    if ratio > _WIDEST and len(cut.shoulders):
        # a poncho is wide, and its shoulders are where those of the body are
        out = float(np.abs(garment.vertices[cut.shoulders, 0] - s.centre).max())
        factor = max(_LOOSE / ratio, s.shoulder_half / out)
        if factor < 1.0:
            return factor, f"{100 * ratio:.0f} % of the {tight} of {body.name}, where it is tightest"
    return 1.0, ""


def _leg_room(garment: Garment, cut: Cut, s: Sizes) -> float:
    """The way from the top of a garment down to half of the ankles through its length to the hems of its legs."""
    y = garment.vertices[:, 1]
    top = float(y[cut.shoulders].mean() if len(cut.shoulders) else y[garment.openings[cut.around[0]]].mean())
    hem = min(float(y[garment.openings[n]].mean()) for n in cut.legs.values())
    return (top - 0.5 * (s.ground + s.ankle_height)) / (top - hem)


def _upper_ratios(pattern: Pattern, garment: Garment, cut: Cut, s: Sizes) -> dict[str, float]:
    """The same for what a garment with shoulders has above the bust: armholes, a neck, and the way to its crotch."""
    surface, rest = rest_of(garment)
    holes = [sleeves.armhole(garment, sleeves.members(pattern, garment, cut, side), n) for side, n in cut.arms.items()]
    armhole = min(float(rest[np.isin(surface.edges, ids).all(axis=1)].sum()) for ids in holes)
    ratios = {"armholes": armhole / (_ARMHOLE * max(s.left_arm.upper_girth, s.right_arm.upper_girth))}
    if len(cut.arms) == 2:
        ratios["neck"] = opening_lengths(garment)[cut.around[0]] / (_COLLAR * s.neck_girth)
    if cut.crotch is not None:
        trunk = s.shoulder_height + _SHOULDER_CLEARANCE - s.crotch_height
        rise = float(garment.vertices[cut.shoulders, 1].mean() - cut.crotch[1])
        ratios["length of the trunk"] = rise / (_TRUNK_EASE * trunk)
    return ratios


def _ratios(cloth: _Girths, body: Body, s: Sizes, low: float, top: float) -> dict[str, float]:
    """Girth of the garment through that of the body at bust, waist and hips, between the heights where it is whole [m]."""
    ratios = {}
    bust = min(s.bust_height, cloth.below_arms)  # armholes reach below the bust
    levels: list[tuple[str, list[float], float]] = [
        ("bust", np.linspace(s.waist_height, max(s.waist_height, bust), 9).tolist(), s.bust_girth),
        ("waist", [s.waist_height], s.waist_girth),
    ]
    for name, heights, girth_there in levels:
        whole = heights[-1] <= top
        width = max((cloth.at(y) for y in heights if whole and y >= low), default=0.0)
        if width > 0.0:
            ratios[name] = width / (girth_there + _ROUND)
    # seams across the hips, and panels that stand apart there, make the width jump: the tightest counts
    trunk = _trunk_faces(body)
    around = s.hip_height + _HIPS * s.height * np.linspace(-1.0, 1.0, 9)
    found = [cloth.at(y) / (girth(body.mesh.vertices, trunk, y) + _ROUND) for y in around.tolist() if low <= y <= top]
    if found := [ratio for ratio in found if ratio > 0.0]:
        ratios["hips"] = min(found)
    return ratios


def _whole(garment: Garment, cut: Cut) -> tuple[float, float]:
    """Heights between which a garment goes all around the trunk [m]: above its hem, and below its top if that is not at the
    neck."""
    rings = [garment.vertices[garment.openings[n]][:, 1] for n in cut.around]
    low = float(rings[-1].max()) if len(rings) > 1 else float(garment.vertices[:, 1].min()) + _COARSE
    return low, math.inf if len(cut.shoulders) else float(rings[0].min())


def _widest(body: Body, s: Sizes, trunk: np.ndarray, top: float) -> float:
    """The greatest girth [m] that a garment with its top at a height would have to slide over: of the hips, or of what is
    below the bust for one that is held there."""
    low = min(s.crotch_height, top)
    return max(girth(body.mesh.vertices, trunk, y) for y in np.linspace(low, top, 9).tolist())


class _Girths:
    """Girths of a placed garment without its sleeves: lengths, in the flat cloth, of lines that are level as it is placed.
    `below_arms` is where the armholes have ended [m].

    Its seams are closed, so such a line goes all around, across panels that stand apart and inserts that stand beside.
    """

    def __init__(self, pattern: Pattern, garment: Garment, cut: Cut) -> None:
        arms = {side: sleeves.members(pattern, garment, cut, side) for side in cut.arms}
        trunk = ~np.isin(garment.panel_of_face, [n for panels in arms.values() for n in panels])
        holes = [sleeves.armhole(garment, panels, cut.arms[side]) for side, panels in arms.items()]
        lowest = [float(garment.vertices[ids, 1].min()) for ids in holes]
        self.below_arms = min(lowest) - _COARSE if lowest else math.inf
        self.flat = garment.rest_corners[trunk]
        self.heights = garment.vertices[garment.faces[trunk], 1]

    def at(self, height: float) -> float:
        """Girth at a height, 0 where there is nothing [m]."""
        above = self.heights > height
        cut = above.any(axis=1) & ~above.all(axis=1)
        y, flat, above = self.heights[cut], self.flat[cut], above[cut]
        ends = []
        for i, j in ((0, 1), (1, 2), (2, 0)):
            crossed = above[:, i] != above[:, j]
            share = (height - y[:, i]) / np.where(crossed, y[:, j] - y[:, i], 1.0)
            points = flat[:, i] + share[:, None] * (flat[:, j] - flat[:, i])
            ends.append(np.where(crossed[:, None], points, np.nan))
        stacked = np.stack(ends)  # two of three sides are crossed
        return float(np.linalg.norm(np.nanmax(stacked, axis=0) - np.nanmin(stacked, axis=0), axis=1).sum())


# Moving


def _moved(pattern: Pattern, body: Body) -> tuple[Pattern, tuple[str, ...]]:
    """The pattern with its placement moved to a body."""
    garment = assemble(pattern, _COARSE)
    if not garment.openings:
        raise ValueError(f"pattern {pattern.name!r}: closed all over; a garment needs an opening")
    cut = read(garment)
    limb = _own_limb(garment, cut, body)
    if limb is not None:
        move, what = _onto(garment, limb), limb.name.replace("_", " ")
    elif len(cut.shoulders):
        move, what = _to_shoulders(garment, cut, body), "shoulders"
    else:
        move, what = _to_waist(pattern, garment, cut, body), "waist"
    moved, notes = pattern.moved(move), (f"fit: placement moved by {_mm(move)} mm to the {what} of {body.name}",)
    if limb is not None or not cut.arms:
        return moved, notes
    there = garment.moved((float(move[0]), float(move[1]), float(move[2])))
    turned, said = sleeves.turned(moved, there, read(there), _arms(body))
    return turned, (*notes, *said)


def _mm(vector: FloatArray) -> str:
    return "(" + ", ".join(f"{1000 * c:+.0f}" for c in vector) + ")"


def _own_limb(garment: Garment, cut: Cut, body: Body) -> Limb | None:
    """The limb of a tube for one arm, one leg or the neck: the one that its openings are nearest to."""
    limbs = {limb.name: limb for limb in body.limbs}
    if not cut.around:
        arms = list(_arms(body).values())
        return _nearest_limb(garment, [limb for limb in body.limbs if limb.name.endswith("leg")] + arms)
    s = _sizes(body)
    if s is None or "head" not in limbs or not len(cut.around) == len(garment.openings) == 2:
        return None
    lengths = opening_lengths(garment)
    tall = abs(float(np.diff([garment.vertices[loop][:, 1].mean() for loop in garment.openings])[0]))
    return limbs["head"] if min(lengths) < _NECK * s.waist_girth and tall < _LOW * max(lengths) else None


def _arms(body: Body) -> dict[str, Limb]:
    """Paths of the arms by side: of the body's limbs, or from its sizes; none of a body that has neither."""
    limbs = {limb.name: limb for limb in body.limbs}
    if "left_arm" in limbs and "right_arm" in limbs:
        return {side: limbs[f"{side}_arm"] for side in ("left", "right")}
    s = _sizes(body)
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


def _nearest_limb(garment: Garment, limbs: Sequence[Limb]) -> Limb | None:
    """The limb that the openings together are nearest to."""
    rings = np.array([garment.vertices[loop].mean(axis=0) for loop in garment.openings])

    def distance(limb: Limb) -> float:
        return float(np.linalg.norm(nearest_on(rings, limb.points[limb.start :]) - rings, axis=1).sum())

    return min(limbs, key=distance) if limbs else None


def _onto(garment: Garment, limb: Limb) -> FloatArray:
    """The shortest way that puts the middles of the openings onto the path of a limb."""
    rings = np.array([garment.vertices[loop].mean(axis=0) for loop in garment.openings])
    move = np.zeros(3)
    for _ in range(_WAY_ROUNDS):
        move = move + (nearest_on(rings + move, limb.points[limb.start :]) - rings - move).mean(axis=0)
    return move


def _to_shoulders(garment: Garment, cut: Cut, body: Body) -> FloatArray:
    """Sideways to the middle of the body, to the ridge of its shoulders, and up to the clearance above them."""
    points = garment.vertices[cut.shoulders]
    v = body.mesh.vertices
    low, high = v.min(axis=0), v.max(axis=0)
    middle = 0.5 * (low[0] + high[0])
    centre = 0.5 * (points[:, 0].min() + points[:, 0].max()) if len(cut.arms) == 2 else cut.middle
    depths = np.linspace(low[2], high[2], 81)
    # columns that meet nothing stay out: sleeves may reach over the end of an arm
    tops = np.full((len(points), len(depths)), -np.inf)
    across = v[body.mesh.faces][:, :, 0]
    first, last = across.min(axis=1), across.max(axis=1)
    for n, point in enumerate(points):
        x = float(point[0] - centre + middle)
        near = body.mesh.faces[(first <= x) & (x <= last)]
        for m, z in enumerate(depths):
            heights = heights_above(v, near, x, float(z))
            if len(heights):
                tops[n, m] = heights[-1]
    on_body = np.isfinite(tops.max(axis=1))
    if not on_body.any():
        return np.array([middle - centre, high[1] - points[:, 1].max(), 0.5 * (low[2] + high[2]) - points[:, 2].mean()])
    best = tops.max(axis=1, keepdims=True)
    ridge = [depths[row >= top - 0.004].mean() for row, top in zip(tops[on_body], best[on_body, 0])]
    lift = (best[on_body, 0] + _SHOULDER_CLEARANCE - points[on_body, 1]).max()
    return np.array([middle - centre, lift, float(np.mean(ridge)) - points[on_body, 2].mean()])


def _to_waist(pattern: Pattern, garment: Garment, cut: Cut, body: Body) -> FloatArray:
    """The top opening to the lowest height at which it still lies around the trunk without strain. Trousers go as high as
    their crotch may, and no higher than the waist; what has a waist of its own below its top goes with that to the body's.
    """
    v = body.mesh.vertices
    top = cut.around[0] if cut.around else 0
    ring, opening = garment.vertices[garment.openings[top]], opening_lengths(garment)[top]
    low, high = v[:, 1].min(), v[:, 1].max()
    height = high - low
    trunk = _trunk_faces(body)
    heights = np.arange(low + 0.50 * height, low + 0.68 * height, _WAIST_STEP)
    girths = np.array([girth(v, trunk, float(h)) for h in heights])
    waist = int(girths.argmin())
    below = np.flatnonzero(girths[: waist + 1] >= opening)
    at = int(below.max()) if len(below) else 0 if opening > girths.max() else waist
    rim, s = float(ring[:, 1].mean()), _sizes(body)
    lift = heights[at] - rim
    own_waist = _own_waist(pattern, garment, cut, float(ring[:, 1].min()))
    if own_waist is not None and s is not None:
        lift = min(s.waist_height - own_waist, s.armpit_height - _BELOW_ARMPITS - float(ring[:, 1].max()))
    elif cut.crotch is not None and s is not None:
        lift = heights[waist] - rim
    if cut.crotch is not None and s is not None:
        lift = min(lift, s.crotch_height - _BELOW_CROTCH - float(cut.crotch[1]))
    section = section_hull(v, trunk, float(np.clip(rim + lift, low, high)))
    if len(section) == 0:
        section = section_hull(v, trunk, float(heights[at]))
    target = 0.5 * (section.min(axis=0) + section.max(axis=0))
    centre = 0.5 * (ring.min(axis=0) + ring.max(axis=0))
    return np.array([target[0] - centre[0], lift, target[1] - centre[2]])


def _own_waist(pattern: Pattern, garment: Garment, cut: Cut, rim: float) -> float | None:
    """Height at which a garment without shoulders is narrowest below its top, if it gets narrower there before it gets
    wider: a bodice without straps."""
    heights = rim - np.arange(_WAIST_STEP, _BODICE, _WAIST_STEP)
    cloth = _Girths(pattern, garment, cut)
    widths = np.array([cloth.at(float(y)) for y in heights])
    rises = np.flatnonzero(widths > (1.0 + _RISE) * np.minimum.accumulate(widths))
    end = int(rises[0]) if len(rises) else len(widths)
    least = int(widths[:end].argmin())
    if heights[0] - heights[least] < _SHORTEST_BODICE or widths[least] > _NARROWER * widths[0]:
        return None
    return float(heights[least])


def _trunk_faces(body: Body) -> np.ndarray:
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


def clear(pattern: Pattern, body: Body) -> tuple[Pattern, tuple[str, ...]]:
    """Panels pushed outwards along their normals until none is nearer to the body than the clearance; a line for each."""
    surface = still((body,))
    panels, notes = [], []
    for panel in pattern.panels:
        outline = panel.outline(_COARSE)
        inner = outline.mean(axis=0) + np.linspace(0.0, 1.0, 8)[:, None, None] * (outline - outline.mean(axis=0))
        flat = inner.reshape(-1, 2)
        points = panel.placed(flat)
        normal = panel.rotation_matrix @ np.array([0.0, 0.0, 1.0])
        normal *= 1.0 if panel.signed_area > 0 else -1.0
        moved = 0.0
        for _ in range(_PUSH_ROUNDS):
            near = float(surface.signed_distance(points + moved * normal).min())
            if near >= _PANEL_CLEARANCE:
                break
            moved += max(0.005, 0.5 * (_PANEL_CLEARANCE - near))
        if moved > 0.0:
            notes.append(f"fit: panel {panel.name} moved {_mm(moved * normal)} mm out of the body")
        panels.append(dataclasses.replace(panel, translation=tuple(np.asarray(panel.translation) + moved * normal)))
    return dataclasses.replace(pattern, panels=tuple(panels)), tuple(notes)
