"""The seven situations that intersection contours can be in, at any depth and resolution, from a known clean state.

Ends of a contour are B = on a border, I = in the inside of the other surface, L = at a vertex where the two surfaces hang
together. All are drawn in general position: turned, shifted and uneven at random.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import FloatArray
from clothgym.materials import Material
from clothgym.mesh import Mesh, grid
from clothgym.scene import Cloth, Scene
from clothgym.scenes.crossing import random_rotation, rotation
from clothgym.scenes.tangle import Beside, Tangle, shifted, tangle

SIDE = 0.4
"""Side of the large sheets [m]; they have `resolution` edges a side."""
_ROOM = 0.6
"""Distance of the surfaces in the clean state [edges]."""
_UNEVEN = 0.02
"""How uneven cloth is [edges]."""
_UNEVEN_FOLD = 0.005
"""The same for folds, whose layers come as near to each other as one likes."""

Placed = tuple[list[tuple[Mesh, FloatArray]], list[Beside]]
"""Meshes as they start with their clean vertices, and what belongs beside what (see `tangle`)."""


def draw(kind: str, depth: float, resolution: int, seed: int, uneven: bool = True) -> Tangle:
    """The tangle behind the scene `canonical`, with its clean state and sides.

    Args:
        kind: one of `KINDS`.
        depth: how far the misplaced part reaches through the other surface [edges].
        resolution: edges a side of the large sheets.
        seed: of turns, places and unevenness.
        uneven: False for surfaces as smooth as their formulas, to see what only such surfaces have.

    Raises:
        ValueError: cloth too coarse for so deep a tangle.
    """
    if resolution < 2.0 * depth + 4.0:
        raise ValueError(
            f"canonical.depth = {depth:g}: takes a resolution of at least {math.ceil(2.0 * depth + 4.0)}, got {resolution}"
        )
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    edge = SIDE / resolution
    placed, beside = KINDS[kind](depth, resolution, edge, rng)
    turn = random_rotation(rng)
    height = edge * (_UNEVEN_FOLD if kind in _FOLDS else _UNEVEN) * (1.0 if uneven else 0.0)
    material = Material(
        density=0.15, stretch=1e4, shear=2e3, flexion=2.0, damping=4.0, friction=0.1, thickness=0.1 * edge
    )
    cloths, clean = [], []
    for number, (mesh, free) in enumerate(placed):
        noise = height * rng.uniform(-1.0, 1.0, mesh.vertices.shape)
        start = Mesh((mesh.vertices + noise) @ turn.T, mesh.faces, mesh.quads)
        cloths.append(Cloth(start, material, (), start.vertices, f"cloth {number}"))
        clean.append((free + noise) @ turn.T)
    return tangle(cloths, np.concatenate(clean), edge, beside, "canonical")


def canonical(kind: str = "BBII", depth: float = 2.0, resolution: int = 16, seed: int = 0) -> Scene:
    """One of seven canonical intersections, in free space without gravity. BBII: a ribbon's end through a sheet; BIBI: two
    sheets that cross each other half; Closed: a dent; BLI: a fold whose flaps cross at its tip, beside a border; LL: a crease
    that is folded through itself; Cross: a sheet and two strips that all cross each other, so that their contours meet;
    Eight: a band twisted through itself, whose sides cannot be told apart. The shape at the start has no strain."""
    return draw(kind, depth, resolution, seed).scene


# Sheets and strips


def _closed(depth: float, resolution: int, edge: float, rng: np.random.Generator) -> Placed:
    """Two sheets, the upper one dented into the lower one."""
    lower = _waved(grid(SIDE, SIDE, resolution, resolution), 0.1 * edge, rng)
    upper = _waved(grid(SIDE, SIDE, resolution, resolution), 0.1 * edge, rng)
    x = upper.vertices
    middle = int(np.hypot(x[:, 0], x[:, 2]).argmin())
    radius = min((2.5 + depth) * edge, 0.45 * SIDE)
    way = np.hypot(x[:, 0] - x[middle, 0], x[:, 2] - x[middle, 2]) / radius
    dent = np.where(way < 1.0, (1.0 - way**2) ** 2, 0.0)
    x[:, 1] += _ROOM * edge - (depth + _ROOM) * edge * dent
    angle = rng.uniform(-0.25, 0.25)
    turn = rotation((0.0, 1.0, 0.0), angle)
    shift = np.array([*rng.uniform(-1.5, 1.5, 2), 0.0])[[0, 2, 1]] * edge
    upper = upper.transformed(turn, shift)
    free = upper.vertices + np.array([0.0, (depth + _ROOM) * edge, 0.0])
    return [(lower, lower.vertices), (upper, free)], _both_ways(lower, upper)


def _bbii(depth: float, resolution: int, edge: float, rng: np.random.Generator) -> Placed:
    """A sheet, and a ribbon of four cells across whose end goes through it."""
    sheet = grid(SIDE, SIDE, resolution, resolution)  # flat: what moves the ribbon along itself is unevenness alone
    length = max(8, math.ceil(2.5 * depth) + 3)  # what is through is the smaller part
    ribbon = _upright(grid(4 * edge, length * edge, 4, length), -depth * edge)
    turn = rotation((0.0, 1.0, 0.0), rng.uniform(0.0, math.pi)) @ rotation((1.0, 0.0, 0.0), rng.uniform(-0.35, 0.35))
    place = np.array([*rng.uniform(-0.15, 0.15, 2), 0.0])[[0, 2, 1]] * SIDE
    ribbon = ribbon.transformed(turn, place)
    free = ribbon.vertices + (depth + 2 * _ROOM) * edge * turn[:, 1]
    return [(sheet, sheet.vertices), (ribbon, free)], _both_ways(sheet, ribbon)[1:]


def _bibi(depth: float, resolution: int, edge: float, rng: np.random.Generator) -> Placed:
    """Two sheets across each other, whose contour begins at the border of one and ends at that of the other."""
    level = grid(SIDE, SIDE, resolution, resolution)
    upright = _upright(grid(SIDE, SIDE, resolution, resolution), -0.5 * SIDE)
    turn = rotation((0.0, 1.0, 0.0), rng.uniform(-0.15, 0.15)) @ rotation((1.0, 0.0, 0.0), rng.uniform(-0.35, 0.35))
    # turned about the end of the contour, so that its length stays
    end = np.array([0.5 * SIDE, *rng.uniform(-0.1, 0.1, 2) * SIDE])
    corner = np.array([-0.5 * SIDE, 0.0, 0.0])
    upright = Mesh((upright.vertices - corner) @ turn.T + end - [depth * edge, 0.0, 0.0], upright.faces, upright.quads)
    free = upright.vertices + np.array([(depth + _ROOM) * edge + 0.2 * SIDE, 0.0, 0.0])
    return [(level, level.vertices), (upright, free)], []


def _cross(depth: float, resolution: int, edge: float, rng: np.random.Generator) -> Placed:
    """A level sheet, and two upright strips whose lower ends go through it and which cross each other beside a border."""
    level = _waved(grid(SIDE, SIDE, resolution, resolution), 0.1 * edge, rng)
    width = min(max(6, math.ceil(2.2 * depth) + 2), resolution - 2)
    height = max(6, math.ceil(1.5 * depth) + 4)
    # the second is longer at both ends, so that the contour between them begins and ends at borders of the first
    low, high = 0.6 * depth, height + 2.37
    first = _upright(grid(width * edge, (height + low) * edge, width, round(height + low)), -low * edge)
    second = _upright(grid(width * edge, (high + depth) * edge, width, round(high + depth)), -depth * edge)
    corner = np.array([*rng.uniform(-0.1, 0.1, 2), 0.0])[[0, 2, 1]] * SIDE
    tilt = [rotation(rng.normal(size=3), rng.uniform(0.0, 0.02)) for _ in range(2)]
    quarter = rotation((0.0, 1.0, 0.0), 0.5 * math.pi)
    first = first.transformed(tilt[0], corner + np.array([(depth - 0.5 * width) * edge, 0.0, 0.0]))
    second = second.transformed(tilt[1] @ quarter, corner + np.array([0.0, 0.0, rng.uniform(-0.1, 0.1) * width * edge]))
    lean = 0.02 * (high + width) * edge  # what tilts may bring nearer
    free_first = first.vertices + np.array([-(depth + _ROOM) * edge - lean, (low + _ROOM) * edge + lean, 0.0])
    free_second = second.vertices + np.array([0.0, (depth + _ROOM) * edge + lean, 0.0])
    counts = np.cumsum([0, len(level.vertices), len(first.vertices), len(second.vertices)])
    ids = [np.arange(counts[k], counts[k + 1]) for k in range(3)]
    beside: list[Beside] = [
        (ids[1], level.faces),
        (ids[2], level.faces),
        (ids[1], shifted(second, int(counts[2]))),
    ]
    return [(level, level.vertices), (first, free_first), (second, free_second)], beside


# Folds


def _bli(depth: float, resolution: int, edge: float, rng: np.random.Generator) -> Placed:
    """A sheet folded over, whose flaps go through each other at the tip of the fold, where the crease meets a border."""
    return _through(depth, resolution, edge, 0.5 * SIDE + rng.uniform(-0.5, 0.0) * edge, rng)


def _ll(depth: float, resolution: int, edge: float, rng: np.random.Generator) -> Placed:
    """A sheet folded over, whose flaps go through each other beside the middle of the crease: both ends lie in it."""
    return _through(depth, resolution, edge, rng.uniform(-0.5, 0.5) * edge, rng)


def _through(depth: float, resolution: int, edge: float, centre: float, rng: np.random.Generator) -> Placed:
    """Flaps that go through each other within half of an ellipse around a place on the crease [m]."""
    sheet, flap, along, out = folded(resolution, edge)
    reach = min(max(2.6 * depth, 3.0) * edge, 0.75 * out[flap].max())
    width = rng.uniform(1.0, 1.2) * reach
    way = ((along - centre) / width) ** 2 + (out / reach) ** 2 - 1.0
    # out (1 - (out / reach)^2) is at most 2 / sqrt(27) reach
    slope = depth * edge / (2.0 / math.sqrt(27.0) * reach)
    return fold(sheet, flap, out * np.where(way < 0.0, slope * way, 0.5 * np.minimum(way, 1.0)), out)


def folded(resolution: int, edge: float) -> tuple[Mesh, NDArray[np.integer], FloatArray, FloatArray]:
    """A sheet, the vertices of its shorter flap, and where all lie along the crease and out from it [m]."""
    sheet = grid(SIDE, SIDE, resolution, resolution)
    crease = resolution // 2 - 1
    row = np.repeat(np.arange(resolution + 1), resolution + 1)
    # one flap is drawn in a little: nothing of it lies exactly above the other
    out = np.where(row < crease, 0.93, 1.0) * np.abs(row - crease) * edge
    return sheet, np.flatnonzero(row < crease), sheet.vertices[:, 0].copy(), out


def fold(sheet: Mesh, flap: NDArray[np.integer], height: FloatArray, out: FloatArray) -> Placed:
    """The sheet with its flap at a height above the other one; in the clean state at half of the distance from the crease."""
    on_flap = np.zeros(len(out), np.bool_)
    on_flap[flap] = True
    # the shorter flap tapers: its side borders lie above the other one, not above their like
    x = np.where(on_flap, 1.0 - 0.1 * out / SIDE, 1.0) * sheet.vertices[:, 0]
    start = np.stack([x, np.where(on_flap, height, 0.0), out], axis=1)
    free = np.stack([x, np.where(on_flap, 0.5 * out, 0.0), out], axis=1)
    other = sheet.faces[~on_flap[sheet.faces].any(axis=1)]
    return [(Mesh(start, sheet.faces, sheet.quads), free)], [(flap, other)]


def _eight(depth: float, resolution: int, edge: float, rng: np.random.Generator) -> Placed:
    """A band that goes round twice with half a twist, through itself all along its middle line.

    Where its second turn crosses the first one both have moved on by a quarter of a turn: the contour is closed, and after
    one round the one surface has become the other. Only one-sided surfaces can do so.
    """
    radius = max(resolution / (2.0 * math.pi), 2.5 * depth + 1.0) * edge
    around = 2 * round(2.0 * math.pi * radius / edge) + 1  # odd: the turns' vertices stand in each other's gaps
    across = 2 * math.floor(depth) + 1
    turn = 4.0 * math.pi * (np.arange(around) + rng.uniform()) / around
    place = depth * edge * np.linspace(-1.0, 1.0, across + 1)
    frame = np.stack([np.cos(turn), np.zeros(around), np.sin(turn)], axis=1)
    up = np.array([0.0, 1.0, 0.0])

    def band(apart: float) -> FloatArray:
        middle = radius * frame + apart * (np.cos(0.5 * turn)[:, None] * frame + np.sin(0.5 * turn)[:, None] * up)
        direction = np.cos(0.25 * turn)[:, None] * frame + np.sin(0.25 * turn)[:, None] * up
        return (middle[:, None] + place[None, :, None] * direction[:, None]).reshape(-1, 3)

    i, j = (n.ravel() for n in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    last = i == around - 1
    a, b = i * (across + 1) + j, i * (across + 1) + j + 1
    # after two turns the band has half a twist: its last row joins the first one the other way round
    c = np.where(last, across - j - 1, a + across + 2)
    d = np.where(last, across - j, a + across + 1)
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
    return [(Mesh(band(0.0), faces), band((0.75 * depth + _ROOM) * edge))], []


# Parts


def _both_ways(first: Mesh, second: Mesh) -> list[Beside]:
    """Each of two meshes beside the other."""
    count = len(first.vertices)
    ids = np.arange(count), np.arange(count, count + len(second.vertices))
    return [(ids[0], shifted(second, count)), (ids[1], first.faces)]


def _waved(flat: Mesh, height: float, rng: np.random.Generator) -> Mesh:
    """A sheet with two low waves of random phase."""
    x, z = flat.vertices[:, 0] / SIDE, flat.vertices[:, 2] / SIDE
    phase = rng.uniform(0.0, 2.0 * math.pi, 2)
    vertices = flat.vertices.copy()
    vertices[:, 1] = 0.5 * height * (np.sin(2 * math.pi * x + phase[0]) + np.sin(2 * math.pi * z + phase[1]))
    return Mesh(vertices, flat.faces, flat.quads)


def _upright(flat: Mesh, bottom: float) -> Mesh:
    """A sheet in the plane z = 0 that begins at a height [m]."""
    x = flat.vertices
    vertices = np.stack([x[:, 0], x[:, 2] - x[:, 2].min() + bottom, np.zeros(len(x))], axis=1)
    return Mesh(vertices, flat.faces, flat.quads)


KINDS: dict[str, Callable[[float, int, float, np.random.Generator], Placed]] = {
    "Closed": _closed,
    "BBII": _bbii,
    "BIBI": _bibi,
    "BLI": _bli,
    "LL": _ll,
    "Cross": _cross,
    "Eight": _eight,
}
_FOLDS = ("BLI", "LL")

MAKERS = {"canonical": canonical}
PARAMETERS = {
    "canonical": {
        "kind": ("", 0, 0, "situation", tuple(KINDS)),
        "depth": ("edges", 0.1, 40.0, "how far the misplaced part reaches through the other surface"),
        "resolution": ("edges", 5, 256, "a side of the large sheets; at least 2 depth + 4"),
        "seed": ("", 0, 2**31 - 1, "seed of turns, places and unevenness"),
    }
}
