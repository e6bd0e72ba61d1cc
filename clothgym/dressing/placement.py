"""Where a pattern's panels stand around a body before they are sewn.

Patterns bring a placement that was made for some body. Fitting moves it: a garment with shoulders to the shoulders of this
body, a tube for one limb onto it, another one to where its top opening fits around the trunk, as high as its crotch may. What
does not fit is scaled as a whole (`scaling`); then panels that would cross the body are pushed outwards.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.body import Body
from clothgym.detection.body_mesh import still
from clothgym.detection.openings import nearest_on
from clothgym.dressing import sleeves
from clothgym.dressing.cut import Cut, read
from clothgym.dressing.scaling import COARSE, SHOULDER_CLEARANCE, Girths, factor, whole
from clothgym.dressing.sewing import opening_lengths
from clothgym.dressing.wearer import arms, known_sizes, own_limb, trunk_faces
from clothgym.garment import Garment, assemble
from clothgym.pattern import Pattern
from clothgym.rig import Limb, girth, heights_above, section_hull

_PANEL_CLEARANCE = 0.02
_PUSH_ROUNDS = 30
_WAIST_STEP = 0.005
_WAY_ROUNDS = 20
_BELOW_CROTCH, _BELOW_ARMPITS = 0.015, 0.01
"""[m] crotch of trousers below that of the body, and top of a bodice without straps below the armpits."""
_BODICE, _SHORTEST_BODICE, _NARROWER, _RISE = 0.45, 0.05, 0.94, 0.01
"""[m], [m]: the waist of such a bodice is looked for to this depth, and is that far below its top at least; its share of the
width at the top is less than the third, where widths that rise by the fourth end the search."""


def fit(pattern: Pattern, body: Body) -> tuple[Pattern, tuple[str, ...]]:
    """The pattern scaled by girths where it needs that, its placement moved to a body, and what was done, a line each.

    Raises:
        ValueError: the pattern has no opening.
    """
    pattern, notes = _moved(pattern, body)
    size, why = factor(pattern, body)
    if size != 1.0:
        pattern, again = _moved(pattern.scaled(size), body)
        notes = (f"fit: scaled by {size:.3f}: {why}", *again)
    pushed, shifts = clear(pattern, body)
    return pushed, (*notes, *shifts)


def _moved(pattern: Pattern, body: Body) -> tuple[Pattern, tuple[str, ...]]:
    """The pattern with its placement moved to a body."""
    garment = assemble(pattern, COARSE)
    if not garment.openings:
        raise ValueError(f"pattern {pattern.name!r}: closed all over; a garment needs an opening")
    cut = read(garment)
    limb = own_limb(garment, cut, body)
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
    turned, said = sleeves.turned(moved, there, read(there), arms(body))
    return turned, (*notes, *said)


def _mm(vector: FloatArray) -> str:
    return "(" + ", ".join(f"{1000 * c:+.0f}" for c in vector) + ")"


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
    lift = (best[on_body, 0] + SHOULDER_CLEARANCE - points[on_body, 1]).max()
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
    trunk = trunk_faces(body)
    heights = np.arange(low + 0.50 * height, low + 0.68 * height, _WAIST_STEP)
    girths = np.array([girth(v, trunk, float(h)) for h in heights])
    waist = int(girths.argmin())
    below = np.flatnonzero(girths[: waist + 1] >= opening)
    at = int(below.max()) if len(below) else 0 if opening > girths.max() else waist
    rim, s = float(ring[:, 1].mean()), known_sizes(body)
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
    heights = heights[heights > whole(garment, cut)[0]]
    if len(heights) == 0:
        return None
    cloth = Girths(pattern, garment, cut)
    widths = np.array([cloth.at(float(y)) for y in heights])
    rises = np.flatnonzero(widths > (1.0 + _RISE) * np.minimum.accumulate(widths))
    end = int(rises[0]) if len(rises) else len(widths)
    least = int(widths[:end].argmin())
    if heights[0] - heights[least] < _SHORTEST_BODICE or widths[least] > _NARROWER * widths[0]:
        return None
    return float(heights[least])


def clear(pattern: Pattern, body: Body) -> tuple[Pattern, tuple[str, ...]]:
    """Panels pushed outwards along their normals until none is nearer to the body than the clearance; a line for each."""
    surface = still((body,))
    panels, notes = [], []
    for panel in pattern.panels:
        outline = panel.outline(COARSE)
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
