"""Where a pattern's panels stand around a body before they are sewn.

Patterns bring a placement that was made for some body. Fitting moves it: a garment with shoulders to the shoulders of this
body, another one to where its top opening fits around the trunk. A pattern that is too tight at bust, waist or hips, or far
too wide at all of them, is scaled as a whole; then panels that would cross the body are pushed outwards.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.body import Body
from clothgym.detection.body_mesh import still
from clothgym.dressing.sewing import opening_lengths
from clothgym.garment import Garment, assemble
from clothgym.pattern import Pattern
from clothgym.rig import girth, heights_above, section_hull
from clothgym.sizes import sizes

_SHOULDER_CLEARANCE = 0.02
"""[m] shoulder seams stand this far above the shoulders: lower, they start inside the body."""
_PANEL_CLEARANCE = 0.02
_TIGHTEST, _SNUG = 0.96, 0.98
"""A pattern that is narrower than this share of a girth is made as wide as the second."""
_WIDEST, _LOOSE = 1.3, 1.15
"""The same for one that is wider everywhere."""
_ROUND = 2.0 * math.pi * 4e-3
"""[m] cloth lies 4 mm from the skin: so much longer it is than a girth."""
_HIPS = 0.05
"""Share of the height around the widest place of the hips."""
_COARSE = 0.03
"""[m] edges of the garment that the fit is found with."""
_PUSH_ROUNDS = 30
_WAIST_STEP = 0.005
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


def _factor(pattern: Pattern, body: Body) -> tuple[float, str]:
    """How much larger a placed pattern must be made, and why; 1 where it fits or the body cannot be measured."""
    try:
        s = sizes(body)
    except ValueError:
        return 1.0, ""
    reach = 1.5 * s.shoulder_half
    ratios = {}
    for name, heights, girth_there in (
        ("bust", np.linspace(s.waist_height, s.bust_height, 9), s.bust_girth),  # armholes reach below the bust
        ("waist", [s.waist_height], s.waist_girth),
    ):
        width = max(_flat_girth(pattern, float(y), s.centre, reach) for y in heights)
        if width > 0.0:
            ratios[name] = width / (girth_there + _ROUND)
    # seams across the hips, and panels that stand apart there, make the width jump: the tightest counts
    trunk = _trunk_faces(body)
    around = s.hip_height + _HIPS * s.height * np.linspace(-1.0, 1.0, 9)
    hips = [
        (_flat_girth(pattern, float(y), s.centre, reach), girth(body.mesh.vertices, trunk, float(y))) for y in around
    ]
    found = [width / (there + _ROUND) for width, there in hips if width > 0.0]
    if found:
        ratios["hips"] = min(found)
    if not ratios:
        return 1.0, ""
    tight = min(ratios, key=lambda name: ratios[name])
    ratio = ratios[tight]
    if ratio < _TIGHTEST:
        return _SNUG / ratio, f"{100 * ratio:.0f} % of the {tight} of {body.name}"
    if ratio > _WIDEST:
        return _LOOSE / ratio, f"{100 * ratio:.0f} % of the {tight} of {body.name}, where it is tightest"
    return 1.0, ""


def _flat_girth(pattern: Pattern, height: float, centre: float, reach: float) -> float:
    """Width of all panels together at a height [m], without those that are further out than the reach: sleeves."""
    total = 0.0
    for panel in pattern.panels:
        points = panel.placed(panel.outline(_COARSE))
        if abs(points[:, 0].mean() - centre) > reach:
            continue
        after = np.roll(points, -1, axis=0)
        cut = (points[:, 1] > height) != (after[:, 1] > height)
        share = (height - points[cut, 1]) / (after[cut, 1] - points[cut, 1])
        line = points[cut] + share[:, None] * (after[cut] - points[cut])
        line = line[np.argsort(line[:, 0])]
        total += float(np.linalg.norm(line[1::2] - line[0 : 2 * len(line[1::2]) : 2], axis=1).sum())
    return total


def _moved(pattern: Pattern, body: Body) -> tuple[Pattern, tuple[str, ...]]:
    """The pattern with its placement moved to a body."""
    garment = assemble(pattern, _COARSE)
    if not garment.openings:
        raise ValueError(f"pattern {pattern.name!r}: closed all over; a garment needs an opening")
    shoulders = shoulder_vertices(garment)
    if len(shoulders):
        move = _to_shoulders(garment, shoulders, body)
        what = "shoulders"
    else:
        move = _to_waist(garment, body)
        what = "waist"
    return pattern.moved(move), (f"fit: placement moved by {_mm(move)} mm to the {what} of {body.name}",)


def _mm(vector: FloatArray) -> str:
    return "(" + ", ".join(f"{1000 * c:+.0f}" for c in vector) + ")"


def shoulder_vertices(garment: Garment) -> np.ndarray:
    """Ids of the vertices of seams that run level from the neck opening outwards; empty for a garment without shoulders.

    A garment has shoulders if it has a neck and two arm openings beside the hem: four, the neck lying highest between
    two others at both sides. Shoulder seams join the neck to openings beside it.
    """
    if len(garment.openings) < 4:
        return np.zeros(0, np.int64)
    centres = np.array([garment.vertices[loop].mean(axis=0) for loop in garment.openings])
    # the neck lies in the middle and above the hem; arms are furthest out
    out = np.abs(centres[:, 0] - np.median(centres[:, 0]))
    middle = np.flatnonzero(out < 0.5 * out.max())
    neck = int(middle[np.argmax(centres[middle, 1])])
    at_neck = set(garment.openings[neck].tolist())
    # seams that start at the neck, up to the next opening or junction
    graph: dict[int, set[int]] = {}
    for a, b in garment.seam_edges.tolist():
        graph.setdefault(a, set()).add(b)
        graph.setdefault(b, set()).add(a)
    on_border = {int(v) for loop in garment.openings for v in loop}
    found: list[int] = []
    for start in sorted(at_neck & set(graph)):
        before, here = -1, start
        line = [start]
        while True:
            following = [v for v in sorted(graph[here]) if v != before]
            if (before >= 0 and here in on_border) or len(following) != 1:
                break
            before, here = here, following[0]
            line.append(here)
        run = np.abs(garment.vertices[line[-1]] - garment.vertices[line[0]])
        if run[0] > run[1]:  # not a seam down the middle of the front or the back
            found.extend(line[len(line) // 2 :])  # beside the neck a head may be above
    return np.array(found, np.int64)


def _to_shoulders(garment: Garment, shoulders: np.ndarray, body: Body) -> FloatArray:
    """Sideways to the middle of the body, to the ridge of its shoulders, and up to the clearance above them."""
    points = garment.vertices[shoulders]
    v = body.mesh.vertices
    low, high = v.min(axis=0), v.max(axis=0)
    middle = 0.5 * (low[0] + high[0])
    centre = 0.5 * (points[:, 0].min() + points[:, 0].max())
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


def _to_waist(garment: Garment, body: Body) -> FloatArray:
    """The top opening to the lowest height at which it still lies around the trunk without strain."""
    v = body.mesh.vertices
    top = int(np.argmax([garment.vertices[loop][:, 1].mean() for loop in garment.openings]))
    ring, opening = garment.vertices[garment.openings[top]], opening_lengths(garment)[top]
    low, high = v[:, 1].min(), v[:, 1].max()
    height = high - low
    trunk = _trunk_faces(body)
    heights = np.arange(low + 0.50 * height, low + 0.68 * height, _WAIST_STEP)
    girths = np.array([girth(v, trunk, float(h)) for h in heights])
    waist = int(girths.argmin())
    below = np.flatnonzero(girths[: waist + 1] >= opening)
    at = int(below.max()) if len(below) else 0 if opening > girths.max() else waist
    section = section_hull(v, trunk, float(heights[at]))
    target = 0.5 * (section.min(axis=0) + section.max(axis=0))
    centre = 0.5 * (ring.min(axis=0) + ring.max(axis=0))
    return np.array([target[0] - centre[0], heights[at] - ring[:, 1].mean(), target[1] - centre[2]])


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
