"""How much larger or smaller a placed pattern must be made for a body: by the girths of both, and a few lengths."""

from __future__ import annotations

import math

import numpy as np

from clothgym.body import Body
from clothgym.dressing import sleeves
from clothgym.dressing.cut import Cut, read
from clothgym.dressing.sewing import opening_lengths, rest_of
from clothgym.dressing.wearer import known_sizes, own_limb, trunk_faces
from clothgym.garment import Garment, assemble
from clothgym.pattern import Pattern
from clothgym.rig import girth
from clothgym.sizes import Sizes

COARSE = 0.03
"""[m] edges of the garment that the fit is found with."""
SHOULDER_CLEARANCE = 0.02
"""[m] shoulder seams stand this far above the shoulders: lower, they start inside the body."""
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


def factor(pattern: Pattern, body: Body) -> tuple[float, str]:
    """How much larger a placed pattern must be made, and why; 1 where it fits or the body cannot be measured."""
    s = known_sizes(body)
    if s is None:
        return 1.0, ""
    garment = assemble(pattern, COARSE)
    cut = read(garment)
    if not cut.around or own_limb(garment, cut, body) is not None:
        return 1.0, ""  # a sleeve, a scarf
    hangs, held = len(cut.shoulders) == 0, 0.0
    ratios = _ratios(Girths(pattern, garment, cut), body, s, *whole(garment, cut))
    if hangs:
        trunk = trunk_faces(body)
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
        # what is tight and too wide at its top is held by the stretch
        most = max(_HOLDS / held, 1.0) if hangs else _LARGER
        return min(_SNUG / ratio, most), f"{100 * ratio:.0f} % of the {tight} of {body.name}"
    if held > _HELD:
        return _HOLDS / held, f"its top is {100 * held:.0f} % of the girth that holds it on {body.name}"
    if cut.legs and (short := max(_leg_room(garment, cut, s), _SNUG / ratio)) < _TIGHTEST:
        return short, f"its legs reach below the feet of {body.name}"
    if ratio > _WIDEST and len(cut.shoulders):
        # a poncho is wide, and its shoulders are where those of the body are
        out = float(np.abs(garment.vertices[cut.shoulders, 0] - s.centre).max())
        smaller = max(_LOOSE / ratio, s.shoulder_half / out)
        if smaller < 1.0:
            return smaller, f"{100 * ratio:.0f} % of the {tight} of {body.name}, where it is tightest"
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
        trunk = s.shoulder_height + SHOULDER_CLEARANCE - s.crotch_height
        rise = float(garment.vertices[cut.shoulders, 1].mean() - cut.crotch[1])
        ratios["length of the trunk"] = rise / (_TRUNK_EASE * trunk)
    return ratios


def _ratios(cloth: Girths, body: Body, s: Sizes, low: float, top: float) -> dict[str, float]:
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
    trunk = trunk_faces(body)
    around = s.hip_height + _HIPS * s.height * np.linspace(-1.0, 1.0, 9)
    found = [cloth.at(y) / (girth(body.mesh.vertices, trunk, y) + _ROUND) for y in around.tolist() if low <= y <= top]
    if found := [ratio for ratio in found if ratio > 0.0]:
        ratios["hips"] = min(found)
    return ratios


def whole(garment: Garment, cut: Cut) -> tuple[float, float]:
    """Heights between which a garment goes all around the trunk [m]: above its hem, and below its top if that is not at the
    neck."""
    rings = [garment.vertices[garment.openings[n]][:, 1] for n in cut.around]
    low = float(rings[-1].max()) if len(rings) > 1 else float(garment.vertices[:, 1].min()) + COARSE
    return low, math.inf if len(cut.shoulders) else float(rings[0].min())


def _widest(body: Body, s: Sizes, trunk: np.ndarray, top: float) -> float:
    """The greatest girth [m] that a garment with its top at a height would have to slide over: of the hips, or of what is
    below the bust for one that is held there."""
    low = min(s.crotch_height, top)
    return max(girth(body.mesh.vertices, trunk, y) for y in np.linspace(low, top, 9).tolist())


class Girths:
    """Girths of a placed garment without its sleeves: lengths, in the flat cloth, of lines that are level as it is placed.
    `below_arms` is where the armholes have ended [m].

    Its seams are closed, so such a line goes all around, across panels that stand apart and inserts that stand beside.
    """

    def __init__(self, pattern: Pattern, garment: Garment, cut: Cut) -> None:
        arms = {side: sleeves.members(pattern, garment, cut, side) for side in cut.arms}
        trunk = ~np.isin(garment.panel_of_face, [n for panels in arms.values() for n in panels])
        holes = [sleeves.armhole(garment, panels, cut.arms[side]) for side, panels in arms.items()]
        lowest = [float(garment.vertices[ids, 1].min()) for ids in holes]
        self.below_arms = min(lowest) - COARSE if lowest else math.inf
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
