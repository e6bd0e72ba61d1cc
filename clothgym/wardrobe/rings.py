"""What goes around one limb: cuff, sleeve and scarf."""

from __future__ import annotations

import math

import numpy as np

from clothgym.pattern import Pattern
from clothgym.sizes import Sizes
from clothgym.wardrobe.bottoms import CLEARANCE, quarter
from clothgym.wardrobe.outline import Draft, Outline
from clothgym.wardrobe.tops import place_sleeve


def _tube(first: float, last: float, top: float, bottom: float) -> Outline:
    """Half of a tube along a limb, from x = first to last, with the widths of the half there [m]."""
    return Outline.of(
        (first, -0.5 * top),
        "under",
        (last, -0.5 * bottom),
        "end",
        (last, 0.5 * bottom),
        "top",
        (first, 0.5 * top),
        "start",
    )


def _on_left_arm(name: str, s: Sizes, first: float, last: float, top: float, bottom: float) -> Pattern:
    draft = Draft()
    arm = s.left_arm
    place_sleeve(draft, "left", arm, _tube(first, last, top, bottom), 0.5 * arm.upper_girth / math.pi + CLEARANCE)
    return draft.pattern(name)


def cuff(s: Sizes) -> Pattern:
    """A band above the left wrist."""
    arm = s.left_arm
    reach = float(np.linalg.norm(arm.wrist - arm.shoulder))
    middle = 0.5 * (arm.elbow_girth + arm.wrist_girth)
    return _on_left_arm(
        "cuff",
        s,
        reach - 0.065 * s.height,
        reach - 0.01,
        2.0 * quarter(middle, 1.05),
        2.0 * quarter(arm.wrist_girth, 1.05),
    )


def sleeve(s: Sizes) -> Pattern:
    """From the left upper arm to the wrist, by itself."""
    arm = s.left_arm
    reach = float(np.linalg.norm(arm.wrist - arm.shoulder))
    # a straight taper must clear the elbow, which is wider than halfway between upper arm and wrist
    top, bottom = 2.0 * quarter(arm.upper_girth, 1.15), 2.0 * quarter(arm.wrist_girth, 1.45)
    return _on_left_arm("sleeve", s, 0.3 * reach, reach + 0.01 * s.height, top, bottom)


def scarf(s: Sizes) -> Pattern:
    """A closed scarf that lies on the shoulders around the neck."""
    top, bottom, low = quarter(s.neck_girth, 1.25), quarter(s.neck_girth, 1.9), s.neck_height - 0.012 * s.height
    high = low + 0.065 * s.height
    front = Outline.of(
        (-bottom, low), ("hem", (0.0, low - 0.02 * s.height)), (bottom, low), "side_left",
        (top, high), ("top", (0.0, high - 0.012 * s.height)), (-top, high), "side_right",
    )  # fmt: skip
    away = max(s.front - s.ridge, s.ridge - s.back) + CLEARANCE
    draft = Draft()
    draft.add("front", front, np.array([s.centre, 0.0, s.ridge + away]))
    draft.add("back", front.turned_over(), np.array([s.centre, 0.0, s.ridge - away]))
    for side in ("left", "right"):
        draft.sew("front", f"side_{side}", "back")
    return draft.pattern("scarf")


DRAFTS = {"cuff": cuff, "sleeve": sleeve, "scarf": scarf}
