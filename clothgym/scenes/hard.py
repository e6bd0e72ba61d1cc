"""Tangles that length alone does not resolve, and other known ones: strip, waist, crumple, folds, and the rows of Fig. 2."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.materials import Material
from clothgym.mesh import Mesh, grid
from clothgym.scene import Cloth, Scene
from clothgym.scenes import canonical
from clothgym.scenes.canonical import SIDE
from clothgym.scenes.crossing import random_rotation, rotation
from clothgym.scenes.tangle import Tangle, shifted, tangle

ROWS = ("top", "middle", "bottom")


def _cloth(start: FloatArray, mesh: Mesh, edge: float, name: str, rest: FloatArray | None = None) -> Cloth:
    material = Material(
        density=0.15, stretch=1e4, shear=2e3, flexion=2.0, damping=4.0, friction=0.1, thickness=0.1 * edge
    )
    return Cloth(Mesh(start, mesh.faces, mesh.quads), material, (), start if rest is None else rest, name)


def draw_strip(resolution: int = 16, uneven: float = 0.0, seed: int = 0) -> Tangle:
    """See `strip`."""
    rng = np.random.default_rng([seed, 11])
    edge = SIDE / resolution
    sheet, band = grid(SIDE, SIDE, resolution, resolution), grid(4 * edge, 2 * resolution * edge, 4, 2 * resolution)
    x = band.vertices
    # not in the middle of cells, and at a slant: nothing of it lies on an edge of the sheet
    upright = np.stack([x[:, 0], x[:, 2], np.zeros(len(x))], axis=1)
    place = np.array([rng.uniform(0.2, 0.4), 0.17, rng.uniform(0.2, 0.4)])
    upright = upright @ rotation((0.3, 1.0, 0.1), rng.uniform(0.3, 0.5)).T + place * edge
    free = upright + np.array([0.0, 1.2 * resolution * edge, 0.0])
    noise = [uneven * edge * rng.uniform(-1.0, 1.0, part.shape) for part in (sheet.vertices, upright)]
    start = [sheet.vertices + noise[0], upright + noise[1]]
    cloths = [_cloth(start[0], sheet, edge, "sheet"), _cloth(start[1], band, edge, "strip")]
    clean = np.concatenate([start[0], free + noise[1]])
    ids = np.arange(len(sheet.vertices), len(clean))
    return tangle(cloths, clean, edge, [(ids, sheet.faces)], "strip_through_sheet")


def strip_through_sheet(resolution: int = 16, uneven: float = 0.0, seed: int = 0) -> Scene:
    """A strip half of which has gone through a sheet. Moved along itself, its contour stays as long as it is: without
    unevenness the summed gradient is nothing, and no scheme that goes by length alone moves it."""
    return draw_strip(resolution, uneven, seed).scene


def draw_waist(resolution: int = 16, seed: int = 0) -> Tangle:
    """See `waist`."""
    rng = np.random.default_rng([seed, 12])
    edge = SIDE / resolution
    around, rows = 2 * (resolution // 2), resolution
    # the waist is not in the middle: the shorter part is the one that went through
    height = np.linspace(-0.4 * SIDE, 0.6 * SIDE, rows + 1)
    radius = 0.16 * SIDE * (1.0 + 2.0 * (height / (0.5 * SIDE)) ** 2)
    turn = 2.0 * math.pi * (np.arange(around) + 0.5 * (np.arange(rows + 1) % 2)[:, None]) / around
    tube = np.stack(
        [radius[:, None] * np.cos(turn), np.repeat(height, around).reshape(turn.shape), radius[:, None] * np.sin(turn)],
        axis=-1,
    ).reshape(-1, 3)
    faces = tube_faces(around, rows)
    sheet = grid(1.6 * SIDE, 1.6 * SIDE, round(1.6 * resolution), round(1.6 * resolution))
    level = sheet.vertices + np.array([0.13, 0.0, 0.17]) * edge
    place = 0.02 * edge * rng.uniform(-1.0, 1.0, tube.shape)
    start, free = tube + place, tube + place + np.array([0.0, 0.4 * SIDE + 0.6 * edge, 0.0])
    mesh = Mesh(tube, faces)
    cloths = [_cloth(level, sheet, edge, "sheet"), _cloth(start, mesh, edge, "tube")]
    ids = np.arange(len(level), len(level) + len(tube))
    return tangle(cloths, np.concatenate([level, free]), edge, [(ids, sheet.faces)], "waist")


def waist(resolution: int = 16, seed: int = 0) -> Scene:
    """A tube with a narrow waist, right through a sheet at the waist, where the contour is shortest: shortening it keeps the
    tube there. Its shorter end is the one that went through."""
    return draw_waist(resolution, seed).scene


def draw_crumple(resolution: int = 16, amount: float = 1.3, seed: int = 0) -> Tangle:
    """See `crumple`."""
    rng = np.random.default_rng([seed, 13])
    edge = SIDE / resolution
    flat = grid(SIDE, SIDE, resolution, resolution)
    x, z = flat.vertices[:, 0] / SIDE, flat.vertices[:, 2] / SIDE
    shift = np.zeros_like(flat.vertices)
    for _ in range(6):
        wave = rng.uniform(1.5, 3.0, 2) * rng.choice([-1.0, 1.0], 2)
        phase = 2.0 * math.pi * (wave[0] * x + wave[1] * z + rng.uniform())
        shift += np.sin(phase)[:, None] * rng.normal(size=3) / math.sqrt(6.0)
    fade = np.clip(4.0 * (0.5 - np.maximum(np.abs(x), np.abs(z))), 0.0, 1.0)  # the border stays
    noise = 0.02 * edge * rng.uniform(-1.0, 1.0, shift.shape)
    turn = random_rotation(rng).T
    start = (flat.vertices + amount * edge * fade[:, None] * shift + noise) @ turn
    return tangle([_cloth(start, flat, edge, "sheet")], (flat.vertices + noise) @ turn, edge, [], "crumple")


def crumple(resolution: int = 16, amount: float = 1.3, seed: int = 0) -> Scene:
    """A sheet crumpled into itself, with contours that end in creases ("dead ends", [Volino 2006, 3.2]). Like
    that it has no strain: nothing pulls it flat."""
    return draw_crumple(resolution, amount, seed).scene


def draw_corner(depth: float = 3.0, resolution: int = 16, seed: int = 0) -> Tangle:
    """See `fold_corner`."""
    rng = np.random.default_rng([seed, 17])
    edge = SIDE / resolution
    sheet, flap, along, out = canonical.folded(resolution, edge)
    begins = along.max() - (max(depth, 2.0) + rng.uniform(0.3, 0.7)) * edge
    slope = depth * edge / out[flap].max()
    t = (along - begins) / (2.0 * edge)
    height = out * np.where(t > 0.0, -slope * np.minimum(t, 1.0), 0.5 * np.minimum(-t, 1.0))
    placed, beside = canonical.fold(sheet, flap, height, out)
    mesh, free = placed[0]
    turn = random_rotation(rng).T
    noise = 0.005 * edge * rng.uniform(-1.0, 1.0, free.shape)
    start = (mesh.vertices + noise) @ turn
    return tangle([_cloth(start, mesh, edge, "sheet")], (free + noise) @ turn, edge, beside, "fold_corner")


def fold_corner(depth: float = 3.0, resolution: int = 16, seed: int = 0) -> Scene:
    """A sheet folded over, whose shorter flap goes through the longer one at a corner: a straight contour from the crease to
    the far border, on the one side of which everything is wrong."""
    return draw_corner(depth, resolution, seed).scene


def draw_folds(layers: int = 4, depth: float = 2.0, resolution: int = 12, seed: int = 0) -> Tangle:
    """See `folds`."""
    rng = np.random.default_rng([seed, 14])
    edge = SIDE / resolution
    mesh = grid(SIDE, layers * SIDE, resolution, layers * resolution)
    row = np.repeat(np.arange(layers * resolution + 1), resolution + 1)
    layer = np.minimum(row // resolution, layers - 1)
    along = (row - layer * resolution) / resolution  # 0 to 1 in each layer
    out = np.where(layer % 2 == 0, along, 1.0 - along)
    gap = 0.8 * edge
    # layers lean from crease to crease, and keep apart by less than a triangle beside them
    free = np.stack([mesh.vertices[:, 0], gap * (layer + along), (out - 0.5) * SIDE * 0.99**layer], axis=1)
    centre = rng.uniform(-0.15, 0.15, 2) * SIDE
    radius = (2.5 + depth) * edge
    way = np.hypot(free[:, 0] - centre[0], free[:, 2] - centre[1]) / radius
    dent = np.where((layer == layers - 1) & (way < 1.0), (1.0 - np.minimum(way, 1.0) ** 2) ** 2, 0.0)
    start = free - (depth * edge + gap) * dent[:, None] * np.array([0.0, 1.0, 0.0])
    noise = 0.01 * edge * rng.uniform(-1.0, 1.0, start.shape)
    start, free = start + noise, free + noise
    beside = []
    of_face = layer[mesh.faces].min(axis=1)
    own = layer[mesh.faces].min(axis=1) == layer[mesh.faces].max(axis=1)
    inner = (along > 0.15) & (along < 0.85)
    for k in range(layers - 1):
        beside.append((np.flatnonzero((layer == k + 1) & inner), mesh.faces[own & (of_face == k)]))
    return tangle([_cloth(start, mesh, edge, "sheet")], free, edge, beside, "folds")


def folds(layers: int = 4, depth: float = 2.0, resolution: int = 12, seed: int = 0) -> Scene:
    """A long sheet folded to and fro, whose uppermost layer is dented through those below."""
    return draw_folds(layers, depth, resolution, seed).scene


def draw_row(row: str = "middle", resolution: int = 16, seed: int = 0) -> Tangle:
    """See `figure_two`."""
    if row != "middle":
        kind, depth = ("Closed", 1.0) if row == "top" else ("BIBI", 4.0)
        return canonical.draw(kind, depth, resolution, seed)
    rng = np.random.default_rng([seed, 15])
    edge = SIDE / resolution
    lower, upper = (grid(SIDE, SIDE, resolution, resolution) for _ in range(2))
    x, z = upper.vertices[:, 0] / SIDE, upper.vertices[:, 2] / SIDE
    phase = 2.0 * math.pi * rng.uniform(size=2)
    wave = np.sin(4.0 * math.pi * x + phase[0]) + np.sin(4.0 * math.pi * z + phase[1])
    waved = upper.vertices + edge * wave[:, None] * np.array([0.0, 1.0, 0.0])
    turn = rotation((0.2, 1.0, 0.1), 0.2)
    start = waved @ turn.T + np.array([0.37, 0.8, 0.29]) * edge
    free = start + np.array([0.0, 6.0 * edge, 0.0])
    noise = [0.02 * edge * rng.uniform(-1.0, 1.0, start.shape) for _ in range(2)]
    start, free, level = start + noise[0], free + noise[0], lower.vertices + noise[1]
    cloths = [_cloth(level, lower, edge, "lower"), _cloth(start, upper, edge, "upper")]
    count = len(level)
    beside = [(np.arange(count, 2 * count), lower.faces), (np.arange(count), shifted(upper, count))]
    return tangle(cloths, np.concatenate([level, free]), edge, beside, "figure_two")


def figure_two(row: str = "middle", resolution: int = 16, seed: int = 0) -> Scene:
    """The rows of [Volino 2006, Fig. 2]: "top", a small closed contour between sheets that are almost parallel; "middle", long
    winding contours; "bottom", a straight open one, of which only the ends act in the local scheme."""
    scene = draw_row(row, resolution, seed).scene
    return Scene(scene.cloths, gravity=scene.gravity, step=scene.step, duration=scene.duration, name="figure_two")


def draw_garment(layers: int = 2, resolution: int = 16, push: float = 2.0, seed: int = 0) -> Tangle:
    """See `garment_layers`."""
    rng = np.random.default_rng([seed, 16])
    edge = SIDE / resolution
    around = 2 * resolution
    radius = around * edge / (2.0 * math.pi)
    cloths: list[Cloth] = []
    clean: list[FloatArray] = []
    ids: list[Any] = []
    faces: list[Any] = []
    count = 0
    for k in range(layers):
        rows = resolution - 2 * k  # outer layers are shorter, as a shirt over a skirt
        own = radius + 1.2 * edge * k
        turn = 2.0 * math.pi * (np.arange(around) + rng.uniform()) / around
        height = edge * np.arange(rows + 1) + 0.37 * edge * k
        noise = 0.02 * edge * rng.uniform(-1.0, 1.0, ((rows + 1) * around, 3))
        lobes = np.zeros(around) if k == 0 else 0.5 * (1.0 + np.cos(2.0 * (turn - rng.uniform(0.0, math.pi))))
        # the upper hem sits where it should; below it outer layers sink in on two sides
        sink = (push + 1.2 * k) * edge * lobes * np.clip(height[:, None] / height.max() * -1.4 + 1.2, 0.0, 1.0)
        fit, worn = (_ring(r, turn, height) for r in (own, own - sink))
        mesh = Mesh(fit, tube_faces(around, rows))
        cloths.append(_cloth(worn + noise, mesh, edge, f"layer {k}", fit))
        clean.append(fit + noise)
        ids.append(np.arange(count, count + len(fit)))
        faces.append(mesh.faces + np.int32(count))
        count += len(fit)
    beside = [pair for k in range(layers - 1) for pair in ((ids[k + 1], faces[k]), (ids[k], faces[k + 1]))]
    return tangle(cloths, np.concatenate(clean), edge, beside, "garment_layers")


def garment_layers(layers: int = 2, resolution: int = 16, push: float = 2.0, seed: int = 0) -> Scene:
    """Tubes of cloth around each other, put on so carelessly that the outer ones lie inside the inner ones on two sides, down
    to the hem [Volino 2006, Fig. 1]; in free space, with the shapes that fit as those without strain."""
    return draw_garment(layers, resolution, push, seed).scene


def tube_faces(around: int, rows: int) -> np.ndarray:
    """(F, 3) of an open tube of rings of `around` vertices."""
    here, on = np.arange(around), (np.arange(around) + 1) % around
    faces = []
    for k in range(rows):
        a, b = k * around, (k + 1) * around
        faces += [np.stack([a + here, b + here, a + on], axis=1), np.stack([a + on, b + here, b + on], axis=1)]
    return np.concatenate(faces).astype(np.int32)


def _ring(radius: Any, turn: FloatArray, height: Any) -> FloatArray:
    """(rows * around, 3) rings at some heights."""
    r = np.broadcast_to(radius, (len(height), len(turn)))
    y = np.broadcast_to(height[:, None], r.shape)
    return np.stack([r * np.cos(turn), y, r * np.sin(turn)], axis=-1).reshape(-1, 3)


MAKERS = {
    "strip_through_sheet": strip_through_sheet,
    "waist": waist,
    "crumple": crumple,
    "fold_corner": fold_corner,
    "folds": folds,
    "figure_two": figure_two,
    "garment_layers": garment_layers,
}
DRAWN: dict[str, Callable[..., Tangle]] = {
    "canonical": canonical.draw,
    "strip_through_sheet": draw_strip,
    "waist": draw_waist,
    "crumple": draw_crumple,
    "fold_corner": draw_corner,
    "folds": draw_folds,
    "figure_two": draw_row,
    "garment_layers": draw_garment,
}
"""The tangles behind scenes, with their clean states and sides; same parameters, all of `canonical.draw` must be given."""

_RESOLUTION = ("edges", 6, 128, "a side of the sheets")
_SEED = ("", 0, 2**31 - 1, "seed of places and unevenness")
PARAMETERS = {
    "strip_through_sheet": {
        "resolution": _RESOLUTION,
        "uneven": ("edges", 0.0, 0.2, "how uneven the cloth is"),
        "seed": _SEED,
    },
    "waist": {"resolution": _RESOLUTION, "seed": _SEED},
    "crumple": {
        "resolution": _RESOLUTION,
        "amount": ("edges", 0.0, 10.0, "how far vertices are displaced"),
        "seed": _SEED,
    },
    "fold_corner": {
        "depth": ("edges", 0.1, 6.0, "how far the corner reaches through"),
        "resolution": _RESOLUTION,
        "seed": _SEED,
    },
    "folds": {
        "layers": ("", 2, 20, "of the folded sheet"),
        "depth": ("edges", 0.1, 20.0, "how far the uppermost layer reaches through the next"),
        "resolution": _RESOLUTION,
        "seed": _SEED,
    },
    "figure_two": {"row": ("", 0, 0, "of the figure", ROWS), "resolution": _RESOLUTION, "seed": _SEED},
    "garment_layers": {
        "layers": ("", 2, 6, "number of tubes"),
        "resolution": _RESOLUTION,
        "push": ("edges", 0.0, 6.0, "how far a layer sinks into the one that it should lie around"),
        "seed": _SEED,
    },
}
