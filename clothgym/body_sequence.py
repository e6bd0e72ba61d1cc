"""Bodies that move as the user's own data have it: a sequence of vertices, from arrays or a folder of meshes.

dancer = body_sequence.load("dance.npz")                       # vertices (T, V, 3), faces (F, 3), rate or times
dancer = body_sequence.load("frames/", rate=60.0)              # a folder of OBJ files, in the order of their names
dancer = body_sequence.load("dancer.obj", frames="dance.npy")  # (T, V, 3) of that mesh's vertices
"""

from __future__ import annotations

import os
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from clothgym import body as bodies
from clothgym import rig
from clothgym.arrays import FloatArray, IntArray, as_faces, check_choice, check_number
from clothgym.body import Body
from clothgym.motion import Keyframes

RATE = 30.0
"""[1/s] frames, unless told."""


def load(
    source: str | os.PathLike[str],
    frames: str | os.PathLike[str] | None = None,
    rate: float | None = None,
    unit: str | None = None,
    up: str | None = None,
    name: str | None = None,
) -> Body:
    """A body whose motion is a sequence of shapes with the same triangles; its mesh is the first of them.

    Unit and axis are told or decided from the first shape, as `body.load` does, and hold for all; the last shape stays.

    Args:
        source: an .npz with `vertices` (T, V, 3) and `faces` (F, 3), and `times` (T,) [s] or `rate` [1/s] if it likes; a folder
            of mesh files, in the order of the numbers in their names; or a mesh file, with frames.
        frames: .npy of (T, V, 3), an .npz with `vertices`, or a folder: what the vertices of the source do.
        rate: frames a second; default: what the file says, else 30.
        unit, up, name: as `body.load`.

    Raises:
        ValueError: one line with the file and what is wrong with it.
    """
    if source in rig.NAMES:
        raise ValueError(f"body {source!r}: frames and rate are for mesh files; bodies of the package have a motion")
    path = Path(source)
    if up is not None:
        check_choice(up, "up", ("y", "z"))
    if unit is not None:
        check_choice(unit, "unit", tuple(bodies.UNITS))
    if rate is not None:
        check_number(rate, "rate", 1e-3, 1e5)
    shapes, faces, times = _sequence(path, frames is None)
    if frames is not None:
        shapes, times = _frames_of(Path(frames), path, shapes, faces)
    if len(shapes) < 2:
        raise ValueError(f"{path}: one frame; a sequence needs two or more")
    if not np.isfinite(shapes).all():
        raise ValueError(
            f"{frames or path}: frame {int(np.argmin(np.isfinite(shapes).all(axis=(1, 2))))} is not finite"
        )
    if times is None or rate is not None:
        times = np.arange(len(shapes)) / (RATE if rate is None else rate)
    # what is one vertex must be one in every frame
    count, used = len(shapes), shapes.shape[1]
    places, faces = bodies.merged(shapes.transpose(1, 0, 2).reshape(used, -1), faces)
    shapes = places.reshape(-1, count, 3).transpose(1, 0, 2)
    unit, up, notes = bodies.decide(shapes[0], unit, up)
    shapes = bodies.in_world(shapes, unit, up)
    said = f"{count} frames in {float(times[-1] - times[0]):.3g} s"
    try:
        motion = Keyframes(times - times[0], shapes)
        notes = [f"{path.name}: {note}" for note in (*notes, said)]
        return Body((shapes[0], faces), name or path.stem, notes=tuple(notes), motion=motion)
    except ValueError as error:
        raise ValueError(f"{frames or path}: {error}") from error


def _sequence(path: Path, moving: bool) -> tuple[FloatArray, IntArray, FloatArray | None]:
    """Shapes (T, V, 3), faces and times, if known; one shape of a mesh file, which does not move by itself."""
    if path.is_dir():
        return (*_folder(path), None)
    if path.suffix.lower() == ".npz":
        held = _arrays(path)
        if "faces" not in held:
            raise ValueError(f"{path}: no array 'faces' (it has {', '.join(held) or 'none'})")
        shapes, times = _shapes(path, held)
        try:
            return shapes, as_faces(held["faces"], shapes.shape[1]), times
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    if path.suffix.lower() == ".npy":
        raise ValueError(f"{path}: holds vertices only; give the mesh as the body, and this file as its frames")
    if moving:
        raise ValueError(f"{path}: one mesh; a sequence needs frames, a folder or an .npz")
    vertices, faces = bodies.read(path)
    return vertices[None], faces, None


def _frames_of(frames: Path, mesh: Path, shape: FloatArray, faces: IntArray) -> tuple[FloatArray, FloatArray | None]:
    """Shapes and times of a sequence for the vertices of a mesh."""
    times: FloatArray | None = None
    if frames.is_dir():
        shapes, others = _folder(frames)
        if not np.array_equal(others, faces):
            raise ValueError(f"{frames}: its meshes have other triangles than {mesh}")
    elif frames.suffix.lower() in (".npy", ".npz"):
        shapes, times = _shapes(frames, _arrays(frames))
    else:
        raise ValueError(f"{frames}: expected frames as .npy, .npz or a folder of meshes")
    if shapes.shape[1] != shape.shape[1]:
        raise ValueError(f"{frames}: {shapes.shape[1]} vertices a frame, but {mesh} has {shape.shape[1]}")
    return shapes, times


def _arrays(path: Path) -> dict[str, Any]:
    """Arrays of an .npz by name; that of an .npy is called vertices."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        held = np.load(path, allow_pickle=False)
        return {name: held[name] for name in held.files} if hasattr(held, "files") else {"vertices": held}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: cannot be read as arrays: {' '.join(str(error).split())}") from error


def _shapes(path: Path, held: dict[str, Any]) -> tuple[FloatArray, FloatArray | None]:
    """(T, V, 3), and (T,) times if they are there."""
    if "vertices" not in held:
        raise ValueError(f"{path}: no array 'vertices' (it has {', '.join(held) or 'none'})")
    shapes = held["vertices"]
    if shapes.ndim != 3 or shapes.shape[2] != 3 or 0 in shapes.shape or shapes.dtype.kind not in "fiu":
        raise ValueError(f"{path}: vertices: expected (frames, vertices, 3) numbers, got {shapes.dtype} {shapes.shape}")
    times = None
    if "times" in held:
        times = np.asarray(held["times"], float)
        if times.shape != (len(shapes),):
            raise ValueError(f"{path}: times: expected ({len(shapes)},), got {times.shape}")
    elif "rate" in held and np.size(held["rate"]) == 1:
        times = np.arange(len(shapes)) / check_number(float(held["rate"]), f"{path}: rate", 1e-3, 1e5)
    return np.asarray(shapes, np.float64), times


def _folder(path: Path) -> tuple[FloatArray, IntArray]:
    """Shapes and faces of the meshes in a folder."""
    endings = {f".{ending}" for ending in bodies.formats()}
    names = sorted((p for p in path.iterdir() if p.suffix.lower() in endings and p.is_file()), key=_in_order)
    if len(names) < 2:
        raise ValueError(f"{path}: {len(names)} mesh files; a sequence needs two or more")
    first, faces = bodies.read(names[0])
    shapes = [first]
    for name in names[1:]:
        vertices, others = bodies.read(name)
        if vertices.shape != first.shape or not np.array_equal(others, faces):
            raise ValueError(
                f"{name}: not the vertices and triangles of {names[0].name}: every frame must have the same"
            )
        shapes.append(vertices)
    return np.stack(shapes), faces


def _in_order(path: Path) -> list[Any]:
    """Numbers in names count as numbers: frame_2 comes before frame_10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", path.name)]
