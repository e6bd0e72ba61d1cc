"""What is simulated: scenes, how long, which converged run they are compared with, and which errors count."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh

import clothgym as cg
from clothgym.scene import Scene


@dataclass(frozen=True)
class Error:
    """One way to be wrong: its name in the rows, what a reader sees, unit and factor from the row to the unit."""

    name: str
    text: str
    unit: str
    factor: float


STRETCH = Error("stretch_error", "error of the peak stretch", "%", 100.0)
STRETCH_99 = Error("stretch_p99_error", "error of the peak of the 99th percentile of stretch", "%", 100.0)
DISTANCE = Error("rms_distance", "distance to the converged run (rms)", "mm", 1e3)
HEIGHT = Error("height_error", "largest error of the mean height over time", "mm", 1e3)
PENETRATION = Error("penetration", "deepest point of the cloth below the body", "mm", 1e3)
CONTOUR = Error("contour_share", "contour length, mean over time, of the start's", "%", 100.0)
MOST_STRETCH = Error("stretch_p99", "peak of the 99th percentile of stretch", "%", 100.0)


@dataclass(frozen=True)
class Subject:
    """A scene of the benchmark.

    Attributes:
        text: one line for readers.
        make: the scene.
        seconds: simulated time.
        errors: what a setting is judged by, the first two in the pictures.
        reference: fields of the converged run; None = there is none, and errors are absolute.
        horizon: time [s] until which positions, heights and energies are compared: later two converged runs part as well,
            because buckling cloth is chaotic. Stretch is compared over all of the time.
        check: fields of another run at high effort, whose distance to the reference says how far that can be trusted.
    """

    text: str
    make: Callable[[], Scene]
    seconds: float
    errors: tuple[Error, ...]
    horizon: float = 0.0
    reference: dict[str, Any] | None = None
    check: dict[str, Any] | None = None


def sheet_on_ball(cells: int = 24) -> Scene:
    """A sheet of 0.8 m that falls on a ball of 0.25 m radius from 2 cm above it; cloth does not touch cloth."""
    mesh = cg.grid(0.8, 0.8, cells, cells).transformed(translation=(0.0, 0.27, 0.0))
    vertices = mesh.vertices.copy()
    vertices[:, 1] += 1e-3 / cells * np.random.default_rng(0).uniform(-1.0, 1.0, len(vertices))
    material = cg.Material(density=0.15, stretch=1e4, shear=5e3, flexion=1e-2, thickness=4e-3)
    cloth = cg.Cloth(cg.Mesh(vertices, mesh.faces, mesh.quads), material, (), mesh.vertices, "sheet")
    ball = cg.Body(trimesh.creation.icosphere(subdivisions=4, radius=0.25), name="ball")
    return cg.Scene([cloth], bodies=[ball], self_collision=False, duration=1.0, name="sheet_on_ball")


def _hanging(cells: int) -> Subject:
    return Subject(
        f"a sheet of 1 m, {cells} x {cells} cells, falls from level and hangs by two corners, 2 s",
        functools.partial(cg.scenes.make, "hanging_sheet", resolution=cells),
        2.0,
        (STRETCH, DISTANCE, HEIGHT),
        0.6,
        {"integrator": "runge_kutta", "finer": 1 if cells > 32 else 2},
        {"substeps": 24 * cells, "sweeps": 1},
    )


def _close(substeps: int) -> dict[str, Any]:
    return {"base": "accurate", "map_size": 360, "continuous": False, "substeps": substeps, "sweeps": 16}


SUBJECTS: dict[str, Subject] = {
    "sheet_16": _hanging(16),
    "sheet_32": _hanging(32),
    "sheet_64": _hanging(64),
    "ball": Subject(
        "a sheet of 0.8 m falls on a ball of 0.25 m radius, 1 s",
        sheet_on_ball,
        1.0,
        (DISTANCE, STRETCH, PENETRATION, HEIGHT),
        1.0,
        _close(128),
        _close(64),
    ),
    "table": Subject(
        "a coarse table cloth, 6 x 6 cells, falls on a round table with a sharp rim, 1.5 s",
        functools.partial(cg.scenes.make, "table_cloth"),
        1.5,
        (PENETRATION, DISTANCE, HEIGHT),
        1.5,
        {**_close(64), "body_faces": 8},
        {**_close(48), "body_faces": 8},
    ),
    "drop": Subject(
        "a sheet of 1 m, 16 x 16 cells, falls on the ground by a corner and crumples, 1.5 s",
        functools.partial(cg.scenes.make, "drop", resolution=16),
        1.5,
        (STRETCH_99, HEIGHT, STRETCH),
        0.35,
        _close(64),
        _close(48),
    ),
    "squares": Subject(
        "9 squares of 0.6 m, thrown through each other, fall on the ground and untangle, 1 s",
        functools.partial(cg.scenes.make, "squares", count=9),
        1.0,
        (CONTOUR, MOST_STRETCH),
    ),
    "skirt": Subject(
        "a skirt, sewn from its pattern, falls into its drape on a body, 0.5 s",
        functools.partial(cg.scenes.make, "draped", pattern="skirt"),
        0.5,
        (DISTANCE, STRETCH_99, PENETRATION, HEIGHT),
        0.5,
        _close(64),
        _close(48),
    ),
}
"""By name; sheets of the same cloth at three resolutions, a smooth and a sharp body, a crumple, a tangle, a garment."""


@functools.lru_cache(maxsize=2)
def scene_of(name: str) -> Scene:
    """The scene of a subject, made once: sewing a garment takes a second."""
    return SUBJECTS[name].make()
