"""A simulation as a picture: cloths in their colours, contours, grippers, ground."""

from __future__ import annotations

from typing import Any

import numpy as np

from clothgym.recording.frames import Camera, Drawable, Lines, palette, render, render_depth

CONTOUR_COLOUR = (0.1, 0.15, 1.0)
GRIP_COLOUR = (0.15, 0.15, 0.18)
_OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
_OCTAHEDRON_FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], np.int32
)


def drawables(simulation: Any) -> list[Drawable]:
    """One per cloth, and one per gripper."""
    x, faces = np.array(simulation.positions), np.array(simulation.faces)
    ranges = simulation.cloth_ranges
    colours = palette(len(ranges))
    shapes = [
        Drawable(x[vertices], faces[triangles] - vertices.start, colour=colours[number])
        for number, (_, vertices, triangles) in enumerate(ranges)
    ]
    for centre in simulation.grip_positions:
        shapes.append(Drawable(0.012 * _OCTAHEDRON + centre, _OCTAHEDRON_FACES, colour=GRIP_COLOUR, smooth=False))
    return shapes


def draw(
    simulation: Any,
    camera: Camera | None = None,
    width: int = 480,
    height: int = 480,
    depth: bool = False,
    contours: bool = True,
    antialias: int = 1,
) -> np.ndarray:
    """(height, width, 3) uint8 picture of the current state, or (height, width, 1) uint8 depth."""
    if camera is None:
        camera = Camera.framing(simulation.positions, direction=(0.5, 0.4, 1.0), aspect=width / height)
    ground = simulation.scene.ground
    if depth:
        return render_depth(drawables(simulation), camera, width, height, ground=ground)
    lines = []
    if contours:
        segments = simulation.last_intersections.segments
        if len(segments):
            lines.append(Lines(segments, CONTOUR_COLOUR, 2.0, on_top=True))
    return render(drawables(simulation), camera, width, height, lines=lines, ground=ground, antialias=antialias)
