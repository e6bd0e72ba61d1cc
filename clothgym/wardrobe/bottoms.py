"""Skirt, trousers and shorts."""

from __future__ import annotations

import math

import numpy as np

from clothgym.pattern import Pattern
from clothgym.sizes import Sizes
from clothgym.wardrobe.outline import Draft, Outline, Point

CLEARANCE = 0.04
"""[m] panels stand this far in front of the trunk and behind it."""
WAIST_EASE, HIP_EASE, THIGH_EASE = 1.02, 1.06, 1.12
_OFF_SKIN = 4e-3
"""[m] cloth lies this far from the skin."""
_FLARE = 1.32
"""Hem of a skirt over the hips."""
_MOST_RISE = 0.2
"""Of half a waistline."""
_CROTCH_DROP = 0.055
"""[m] trousers hang this far below the crotch before they are drawn up."""


def quarter(girth: float, ease: float) -> float:
    """A quarter of a tube around a girth [m]: half the width of a front."""
    return 0.25 * ease * (girth + 2.0 * math.pi * _OFF_SKIN)


def depths(s: Sizes) -> tuple[float, float, float]:
    """z of the seams' plane, of fronts and of backs [m]."""
    middle = 0.5 * (s.front + s.back)
    away = 0.5 * (s.front - s.back) + CLEARANCE
    return middle, middle + away, middle - away


def skirt(s: Sizes) -> Pattern:
    """Front and back, from the waist over the hips to the knees, flared."""
    waist, hip, hem = quarter(s.waist_girth, WAIST_EASE), quarter(s.hip_girth, HIP_EASE), quarter(s.hip_girth, _FLARE)
    top, middle, low = s.waist_height, s.hip_height + 0.03 * s.height, s.knee_height + 0.01 * s.height
    bulge = (hip + 0.004 * s.height, middle + 0.45 * (top - middle))
    rise = _rise(waist, top, bulge)
    front = Outline.of(
        (-hem, low), ("hem", (0.0, low - 0.025 * s.height)), (hem, low), "side_left", (hip, middle),
        ("hip_left", bulge), (waist, top + rise), ("waist", (0.0, top - rise)), (-waist, top + rise),
        ("hip_right", (-bulge[0], bulge[1])), (-hip, middle), "side_right",
    )  # fmt: skip
    return _front_and_back("skirt", front, s, ("side_left", "hip_left", "hip_right", "side_right"))


def _rise(waist: float, top: float, towards: Point) -> float:
    """How far above its middle a waistline, half of which is so long, ends in order to meet the side seam at a right angle [m]:
    two panels that meet at more leave a notch, which the weight of the seam pulls down."""
    return min(0.5 * waist * (towards[0] - waist) / (top - towards[1]), _MOST_RISE * waist)


def _front_and_back(name: str, front: Outline, s: Sizes, seams: tuple[str, ...]) -> Pattern:
    _, before, behind = depths(s)
    draft = Draft()
    draft.add("front", front, np.array([s.centre, 0.0, before]))
    draft.add("back", front.turned_over(), np.array([s.centre, 0.0, behind]))
    for seam in seams:
        draft.sew("front", seam, "back")
    return draft.pattern(name)


def _legs(name: str, s: Sizes, hem: float, hem_width: float) -> Pattern:
    """Four panels, a front and a back for each leg, down to a height; widths are those of one panel [m]."""
    waist, hip = quarter(s.waist_girth, WAIST_EASE + 0.04), quarter(s.hip_girth, HIP_EASE)
    thigh = 2.0 * quarter(s.thigh_girth, THIGH_EASE)
    top, level, crotch = s.waist_height, s.hip_height + 0.03 * s.height, s.crotch_height - _CROTCH_DROP
    reach = max(thigh - hip, 0.02 * s.height)  # from the middle of the body to the inseam
    # both legs move apart by it, or they would start in each other
    axis = np.interp(hem, s.leg_axis[::-1, 1], s.leg_axis[::-1, 0] - s.centre)
    apart = reach + 0.004 * s.height
    inner = max(axis - 0.5 * hem_width, apart - reach + 0.01 * s.height)
    outer = inner + hem_width
    bulge = (hip + apart, level + 0.55 * (top - level))
    rise = _rise(waist, top, (bulge[0] - apart, bulge[1]))
    front = Outline.of(
        (inner, hem), "hem", (outer, hem),
        ("outseam", (hip + apart, crotch - 0.3 * (crotch - hem))), (hip + apart, level),
        ("hip", bulge), (waist + apart, top + rise), ("waist", (apart + 0.5 * waist, top)),
        (apart, top), ("rise", (apart, crotch + 0.25 * (top - crotch)), (apart, crotch)),
        (apart - reach, crotch), ("inseam", (apart - reach + 0.3 * (inner - apart + reach), 0.5 * (crotch + hem))),
        grid=((inner, hem), (outer, hem), (waist + apart, top + rise), (apart, top)),
    )  # fmt: skip
    _, before, behind = depths(s)
    draft = Draft()
    for side, shape in (("left", front), ("right", front.mirrored())):
        draft.add(f"{side}_front", shape, np.array([s.centre, 0.0, before]))
        draft.add(f"{side}_back", shape.turned_over(), np.array([s.centre, 0.0, behind]))
        for seam in ("outseam", "hip", "inseam"):
            draft.sew(f"{side}_front", seam, f"{side}_back")
    for panel in ("front", "back"):
        draft.sew(f"left_{panel}", "rise", f"right_{panel}")
    return draft.pattern(name)


def trousers(s: Sizes) -> Pattern:
    """From the waist to the ankles."""
    return _legs("trousers", s, s.ankle_height + 0.02 * s.height, max(0.62 * s.ankle_girth, 0.46 * s.calf_girth))


def shorts(s: Sizes) -> Pattern:
    """From the waist to above the knees."""
    hem = s.knee_height + 0.3 * (s.crotch_height - s.knee_height)
    there = s.knee_girth + 0.3 * (s.thigh_girth - s.knee_girth)
    return _legs("shorts", s, hem, 2.0 * quarter(there, 1.25))


DRAFTS = {"skirt": skirt, "trousers": trousers, "shorts": shorts}
