"""Sleeveless shirt, vest, dress, T-shirt and shirt with sleeves."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.pattern import Pattern
from clothgym.sizes import Arm, Sizes
from clothgym.wardrobe.bottoms import CLEARANCE, HIP_EASE, quarter
from clothgym.wardrobe.outline import Draft, Outline, Point

_ABOVE_SHOULDERS = 0.02
"""[m] shoulder seams start this far above the shoulders."""
_BESIDE_ARM = 0.012
"""[m] armpits start this far below the arms."""
_CAP = 0.6
"""Height of a sleeve's cap, over that which would be as long as the armhole. The armpit comes to lie beside the trunk, inwards
of where it is drawn: a sleeve with the whole cap would begin above the shoulder and stand up there with its end."""
_DROPPED = 1.2
"""Shoulders of a garment with such sleeves end this much further out than the body's,"""
_RAISED = 0.1
"""and fall less by this slope: as steep as the body's they are held up by its arms, and the neck stands up."""


@dataclass(frozen=True)
class _Cut:
    """What tells one top from another; shares are of the body's height, eases of its girths."""

    hem: float  # height [m]
    hem_half: float  # [m]
    tip: float  # of the shoulder, over that of the body
    neck: float  # half of the neck opening beside the neck [m]
    front_drop: float  # of the neckline [m]
    back_drop: float
    bust_ease: float = 1.07
    fitted: bool = False
    raised: float = 0.0  # slope by which shoulders fall less than the body's


def arm_normal(arm: Arm) -> FloatArray:
    """(3,) across an arm: up and outwards, in the plane x, y."""
    x, y, _ = arm.way
    normal = np.array([-y, x, 0.0]) / math.hypot(x, y)
    return normal if normal[1] > 0.0 or (normal[1] == 0.0 and normal[0] * x > 0.0) else -normal


def _armpit(s: Sizes, half: float) -> float:
    """The height of a garment's armpit half so far from the middle: clear of the arm, below the body's own."""
    arm = s.left_arm
    normal = arm_normal(arm)
    clear = arm.upper_girth / (2.0 * math.pi) + _BESIDE_ARM
    # (P - shoulder) . normal = -clear, for P = (centre + half, y)
    beside = s.centre + half - arm.shoulder[0]
    below = arm.shoulder[1] - (clear + beside * normal[0]) / max(float(normal[1]), 0.2)
    return min(s.armpit_height - 0.02 * s.height, below)


def _shoulder_line(s: Sizes, x: float, raised: float) -> float:
    beside = x - s.neck_half
    fall = (s.shoulder_height - s.neck_height) / (s.shoulder_half - s.neck_half)
    return s.neck_height + (fall + raised) * beside + _ABOVE_SHOULDERS


def _neckline(x: float, y: float, drop: float) -> tuple[Point, Point]:
    return (0.92 * x, y - 4.0 / 3.0 * drop), (-0.92 * x, y - 4.0 / 3.0 * drop)


def _body(s: Sizes, cut: _Cut, back: bool) -> Outline:
    """Front of a top, or its back seen from the front."""
    half = quarter(s.bust_girth, cut.bust_ease)
    armpit = _armpit(s, half)
    tip_x, neck_x = cut.tip * s.shoulder_half, s.neck_half + cut.neck
    tip, neck = ((x, _shoulder_line(s, x, cut.raised)) for x in (tip_x, neck_x))
    # the front's armhole is hollowed out more
    hollow = (0.94 if back else 0.86) * tip_x
    depth = tip[1] - armpit
    arm = ((hollow + 0.3 * (half - hollow), armpit + 0.02 * depth), (hollow, armpit + 0.35 * depth))
    drop = cut.back_drop if back else cut.front_drop
    right: list[object] = []
    corners: list[Point] = [(cut.hem_half, cut.hem)]
    labels: list[object] = []
    if cut.fitted:
        hip, waist = quarter(s.hip_girth, HIP_EASE), quarter(s.waist_girth, 1.15)
        level = s.hip_height + 0.03 * s.height
        corners += [(hip, level), (waist, s.waist_height)]
        labels += ["skirt", ("hip", (hip, level + 0.55 * (s.waist_height - level))), "side"]
    else:
        labels += ["side"]
    corners += [(half, armpit), tip, neck]
    labels += [("armhole", *arm), "shoulder"]
    for corner, label in zip(corners, labels):
        right += [corner, _named(label, "left")]
    right += [neck, ("neck", *_neckline(*neck, drop))]
    left: list[object] = []
    for k in range(len(corners) - 1, 0, -1):
        left += [(-corners[k][0], corners[k][1]), _named(labels[k - 1], "right", mirrored=True)]
    start = (-cut.hem_half, cut.hem)
    grid = (start, (cut.hem_half, cut.hem), tip, (-tip[0], tip[1]))
    return Outline.of(start, ("hem", (0.0, cut.hem - 0.01 * s.height)), *right, *left, grid=grid)


def _named(label: object, side: str, mirrored: bool = False) -> object:
    """The label of one side of the body; a mirrored edge runs the other way."""
    if isinstance(label, str):
        return f"{label}_{side}"
    assert isinstance(label, tuple)
    name, *points = label
    return (f"{name}_{side}", *((-x, y) for x, y in points[::-1])) if mirrored else (f"{name}_{side}", *points)


def _sewn_body(s: Sizes, cut: _Cut) -> Draft:
    draft = Draft()
    away = max(s.front - s.ridge, s.ridge - s.back) + CLEARANCE
    draft.add("front", _body(s, cut, False), np.array([s.centre, 0.0, s.ridge + away]))
    draft.add("back", _body(s, cut, True).turned_over(), np.array([s.centre, 0.0, s.ridge - away]))
    for side in ("left", "right"):
        for edge in (*(("skirt", "hip") if cut.fitted else ()), "side", "shoulder"):
            draft.sew("front", f"{edge}_{side}", "back")
    return draft


def sleeve_halves(arm: Arm, start: float, top: float, bottom: float, length: float) -> Outline:
    """Half of a sleeve, laid along its arm: x runs from the shoulder to the wrist, y across it.

    Args:
        arm: whose.
        start: x at which the under seam starts [m].
        top, bottom: widths of the half at both ends [m].
        length: x at which it ends [m].
    """
    return Outline.of(
        (start, -0.5 * top), "under", (length, -0.5 * bottom), "cuff", (length, 0.5 * bottom), "top",
        (0.0, 0.5 * top), ("cap", (0.3 * start, 0.5 * top), (0.55 * start, -0.5 * top)),
    )  # fmt: skip


def place_sleeve(draft: Draft, side: str, arm: Arm, half: Outline, away: float) -> None:
    """Puts both halves of a sleeve in front of an arm and behind it, and sews them to each other."""
    along, normal = arm.way, arm_normal(arm)
    sign = 1.0 if along[0] >= 0.0 else -1.0
    across = sign * np.cross(along, normal)  # to the front
    shape = half if sign > 0.0 else half.mirrored()
    turn = np.stack([sign * along, normal, across], axis=1)
    draft.add(f"{side}_sleeve_front", shape, arm.shoulder + away * across, turn)
    draft.add(f"{side}_sleeve_back", shape.turned_over(), arm.shoulder - away * across, turn)
    for seam in ("top", "under"):
        draft.sew(f"{side}_sleeve_front", seam, f"{side}_sleeve_back")


def _with_sleeves(name: str, s: Sizes, cut: _Cut, share: float, cuff_ease: float) -> Pattern:
    """Sleeves down to a share of the arms' length."""
    draft = _sewn_body(s, cut)
    for side, arm in (("left", s.left_arm), ("right", s.right_arm)):
        width = 2.0 * quarter(arm.upper_girth, 1.4)
        edge = draft.outlines["front"].labels.index(f"armhole_{side}")
        hole = draft.panels["front"].length(edge)
        start = _CAP * math.sqrt(max(hole**2 / 1.07 - width**2, (0.3 * width) ** 2))
        at = max(share * arm.length, start + 0.04 * s.height)
        girths = np.interp(share, (0.0, 0.5, 1.0), (arm.upper_girth, arm.elbow_girth, arm.wrist_girth))
        half = sleeve_halves(arm, start, width, 2.0 * quarter(float(girths), cuff_ease), at)
        place_sleeve(draft, side, arm, half, 0.5 * arm.upper_girth / math.pi + CLEARANCE)
        for panel in ("front", "back"):
            draft.sew(panel, f"armhole_{side}", f"{side}_sleeve_{panel}", "cap")
    return draft.pattern(name)


def sleeveless_shirt(s: Sizes) -> Pattern:
    """To the hips, with wide armholes."""
    cut = _Cut(
        s.hip_height + 0.02 * s.height, quarter(s.hip_girth, 1.05), 1.0, 0.022, 0.06 * s.height, 0.015 * s.height
    )
    return _sewn_body(s, cut).pattern("sleeveless_shirt")


def vest(s: Sizes) -> Pattern:
    """To the hips, with narrow straps and a deep neckline."""
    cut = _Cut(
        s.hip_height + 0.02 * s.height, quarter(s.hip_girth, 1.04), 0.84, 0.018, 0.095 * s.height, 0.05 * s.height, 1.05
    )
    return _sewn_body(s, cut).pattern("vest")


def dress(s: Sizes) -> Pattern:
    """To the knees, taken in at the waist."""
    cut = _Cut(
        s.knee_height + 0.01 * s.height,
        quarter(s.hip_girth, 1.36),
        0.98,
        0.022,
        0.065 * s.height,
        0.02 * s.height,
        1.02,
        fitted=True,
    )
    return _sewn_body(s, cut).pattern("dress")


def t_shirt(s: Sizes) -> Pattern:
    """To the hips, sleeves to the elbows."""
    cut = _Cut(
        s.hip_height + 0.02 * s.height, quarter(s.hip_girth, 1.08), _DROPPED, 0.02, 0.055 * s.height, 0.012 * s.height,
        raised=_RAISED,
    )  # fmt: skip
    return _with_sleeves("t_shirt", s, cut, 0.42, 1.45)


def shirt(s: Sizes) -> Pattern:
    """To the hips, sleeves to the wrists."""
    cut = _Cut(
        s.hip_height, quarter(s.hip_girth, 1.08), _DROPPED, 0.02, 0.065 * s.height, 0.02 * s.height, raised=_RAISED
    )
    return _with_sleeves("shirt", s, cut, 0.88, 1.7)


DRAFTS = {"sleeveless_shirt": sleeveless_shirt, "vest": vest, "dress": dress, "t_shirt": t_shirt, "shirt": shirt}
