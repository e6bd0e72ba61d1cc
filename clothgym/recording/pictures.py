"""A simulation as a picture: cloths in their colours, bodies, contours, grippers, ground."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.recording.frames import Camera, Colour, Drawable, Image, Lines, palette, render, render_depth

CONTOUR_COLOUR = (0.1, 0.15, 1.0)
GRIP_COLOUR = (0.15, 0.15, 0.18)
BODY_COLOUR = (0.79, 0.75, 0.71)
"""A pale grey with a little warmth, which no cloth has."""
BACK_TONE = 0.62
"""How bright the back side of cloth is against its front: what is turned over or looked into shows."""
VIEWS = {"front": (0.0, 0.06, 1.0), "back": (0.0, 0.06, -1.0), "side": (1.0, 0.06, 0.0)}
"""Directions from a dressed body, which looks to the front (z), towards the camera."""
_OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
_OCTAHEDRON_FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], np.int32
)

_bodies_drawn: weakref.WeakKeyDictionary[Any, Drawable] = weakref.WeakKeyDictionary()


def body_drawable(body: Any) -> Drawable:
    """A body's surface, checked and shaded once: it does not move."""
    if body not in _bodies_drawn:
        _bodies_drawn[body] = Drawable(body.mesh.vertices, body.mesh.faces, colour=BODY_COLOUR)
    return _bodies_drawn[body]


def _moved_drawable(body: Any, time: float) -> Drawable:
    return Drawable(body.motion.at(time), body.mesh.faces, colour=BODY_COLOUR)


def cloth_drawable(vertices: Any, faces: Any, colour: Colour) -> Drawable:
    """A cloth's surface (V, 3) [m], (F, 3), with a darker back side."""
    return Drawable(vertices, faces, colour=colour, back_colour=tuple(BACK_TONE * c for c in colour))


def drawables(simulation: Any) -> list[Drawable]:
    """One per cloth, one per body, and one per gripper."""
    x, faces = np.array(simulation.positions), np.array(simulation.faces)
    ranges = simulation.cloth_ranges
    colours = palette(len(ranges))
    shapes = [
        cloth_drawable(x[vertices], faces[triangles] - vertices.start, colours[number])
        for number, (_, vertices, triangles) in enumerate(ranges)
    ]
    for body in simulation.scene.bodies:
        moved = body.motion is not None
        shapes.append(_moved_drawable(body, simulation.time) if moved else body_drawable(body))
    for centre in simulation.grip_positions:
        shapes.append(Drawable(0.012 * _OCTAHEDRON + centre, _OCTAHEDRON_FACES, colour=GRIP_COLOUR, smooth=False))
    return shapes


def everything(simulation: Any) -> FloatArray:
    """(N, 3) all vertices of cloths and bodies now [m]: what a camera should hold."""
    return np.concatenate([simulation.positions, *(body.mesh.vertices for body in simulation.scene.bodies)])


def draw(
    simulation: Any,
    camera: Camera | None = None,
    width: int = 480,
    height: int = 480,
    depth: bool = False,
    contours: bool = True,
    antialias: int = 1,
    ground: float | None = None,
) -> Image:
    """(height, width, 3) uint8 picture of the current state, or (height, width, 1) uint8 depth.

    Args:
        simulation: read only.
        camera: None: one that holds cloths and bodies.
        width, height: [pixel].
        depth: distance instead of colour.
        contours: whether to draw where cloth passes through cloth.
        antialias: 2 takes four samples per pixel.
        ground: height of a floor to draw where the scene has none [m].
    """
    if camera is None:
        camera = Camera.framing(everything(simulation), direction=(0.5, 0.4, 1.0), aspect=width / height)
    if simulation.scene.ground is not None:
        ground = simulation.scene.ground
    if depth:
        return render_depth(drawables(simulation), camera, width, height, ground=ground)
    lines = []
    if contours:
        segments = simulation.last_intersections.segments
        if len(segments):
            lines.append(Lines(segments, CONTOUR_COLOUR, 2.0, on_top=True))
    return render(drawables(simulation), camera, width, height, lines=lines, ground=ground, antialias=antialias)


def draw_views(
    simulation: Any, views: Sequence[str] = tuple(VIEWS), width: int = 600, height: int = 900
) -> dict[str, Image]:
    """A dressed body from several sides, all at the same scale: name -> (height, width, 3) uint8.

    Args:
        simulation: read only.
        views: names in `VIEWS`.
        width, height: of each picture [pixel].
    """
    points = everything(simulation)
    low, high = points.min(axis=0), points.max(axis=0)
    # One distance for all: the box is turned with the view, so that every side sees it from as far away.
    half = 0.5 * float(max(high[0] - low[0], high[2] - low[2]))
    centre = 0.5 * (low + high)
    pillar = np.array([(x, y, z) for x in (-half, half) for y in (low[1], high[1]) for z in (-half, half)])
    pillar += (centre[0], 0.0, centre[2])
    floor = float(low[1]) if simulation.scene.bodies else None
    return {
        name: draw(
            simulation,
            Camera.framing(pillar, VIEWS[name], margin=1.04, vertical_fov=25.0, aspect=width / height),
            width,
            height,
            antialias=2,
            ground=floor,
        )
        for name in views
    }
