"""Reads recordings (.rrd) back into numpy.

A recording may come from anyone, so nothing in it is trusted: it holds numbers and JSON only, every size and type is
checked, and `rerun_table` verifies the file before anything else looks at it.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.recording.rerun_table import (
    Column,
    Table,
    check_sums,
    column_checksum,
    flat,
    read_chunks,
    verify,
    whole_messages,
)
from clothgym.recording.rerun_viewer import import_rerun, start_viewer, viewer_command

__all__ = [
    "ACTION_TYPES",
    "FORMAT",
    "FORMAT_VERSION",
    "MeshTrack",
    "Recording",
    "column_checksum",
    "import_rerun",
    "read_recording",
    "start_viewer",
    "viewer_command",
]

FORMAT = "clothgym-recording"
FORMAT_VERSION = 1
ACTION_TYPES = ("float32", "float64", "int64")


@dataclass(frozen=True)
class MeshTrack:
    """A mesh over time: faces (F, 3), steps (n,), positions and normals (n, V, 3) float32 [m].

    What never moves has one entry, at step 0.
    """

    faces: NDArray[np.int32]
    steps: NDArray[np.int64]
    positions: NDArray[np.float32]
    normals: NDArray[np.float32]

    def at(self, step: int) -> NDArray[np.float32]:
        """Positions that hold at a step: those of the last logged step that is not later."""
        index = int(np.searchsorted(self.steps, step, side="right")) - 1
        if index < 0:
            raise ValueError(f"step = {step}: the mesh starts at step {int(self.steps[0])}")
        return self.positions[index]


@dataclass(frozen=True)
class Recording:
    """What a file holds. Everything per step is a list or array in the order of `steps`, unless it has own steps.

    Attributes:
        complete: the file ends with its closing document, and every checksum was right.
        steps, sim_time: (n,) step numbers and simulated time [s].
        cloths, bodies: name -> MeshTrack.
        contours: step -> (segments (S, 2, 3) [m], contour ids (S,)); hits: step -> (H, 3) [m].
        scalars: name -> (steps, values); points: name -> {step: (N, 3)}.
        action_steps, actions: (T,) and (T, A) in the type they were given in.
        outcomes: state_hash, reward, terminated, truncated, one entry a step.
        documents: name -> JSON object.
    """

    path: Path
    application: str
    complete: bool
    has_blueprint: bool
    steps: NDArray[np.int64]
    sim_time: NDArray[np.float64]
    cloths: dict[str, MeshTrack]
    bodies: dict[str, MeshTrack]
    ground: float | None
    contours: dict[int, tuple[NDArray[np.float32], NDArray[np.int64]]]
    hits: dict[int, NDArray[np.float32]]
    scalars: dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]
    points: dict[str, dict[int, NDArray[np.float32]]]
    action_steps: NDArray[np.int64]
    actions: NDArray[Any]
    outcomes: dict[str, list[Any]]
    documents: dict[str, dict[str, Any]] = field(repr=False)

    def positions(self, step: int) -> NDArray[np.float32]:
        """(V, 3) of all cloths at a logged step [m]."""
        if step not in self.steps:
            raise ValueError(f"step = {step}: {self.path} has no such step")
        rows = [track.positions[np.searchsorted(track.steps, step)] for track in self.cloths.values()]
        return np.concatenate(rows) if rows else np.empty((0, 3), np.float32)


def read_recording(path: str | os.PathLike[str], partial: bool = False) -> Recording:
    """Reads a recording.

    Args:
        path: the .rrd file.
        partial: also accept a file that was cut short (its run was killed): its whole messages are read.

    Raises:
        ValueError: one line naming the file: missing, cut, corrupted, foreign, or of another format version.
        MissingExtraError: rerun-sdk is not installed.
    """
    file = Path(path)
    if not file.is_file():
        raise ValueError(f"{file}: no such file")
    import_rerun()
    with whole_messages(file, partial) as readable:
        verify(readable, file, partial)
        try:
            application, has_blueprint, table = read_chunks(readable)
            return _assemble(file, application, has_blueprint, table, partial)
        except ValueError as error:
            raise ValueError(_one_line(file, error)) from None
        except (KeyboardInterrupt, SystemExit, MemoryError):
            raise
        except BaseException as error:  # rerun's panics are no Exception
            raise ValueError(_one_line(file, error)) from None


def _one_line(file: Path, error: BaseException) -> str:
    text = " ".join(str(error).split())[:300]
    return text if text.startswith(f"{file}:") else f"{file}: {text or type(error).__name__}"


# ---- what is in it ----


def _assemble(file: Path, application: str, has_blueprint: bool, table: Table, partial: bool) -> Recording:
    documents = {e.removeprefix("/clothgym/"): _document(e, c) for e, c in table.items() if e.startswith("/clothgym/")}
    scene = documents.get("scene", {})
    if scene.get("format") != FORMAT:
        raise ValueError("not a clothgym recording (no clothgym/scene document)")
    if scene.get("format_version") != FORMAT_VERSION:
        raise ValueError(f"format_version = {scene.get('format_version')!r}: this version reads {FORMAT_VERSION}")
    complete = "end" in documents
    if complete:
        check_sums(table, documents["end"])
    elif not partial:
        raise ValueError("cut short: its closing document is missing (partial=True reads what is whole)")
    cloths = _meshes(table, scene.get("cloths"), "cloth")
    bodies = _meshes(table, scene.get("bodies"), "body")
    still = _meshes(table, scene.get("still_bodies", []), "bodies")
    if both := set(bodies) & set(still):
        raise ValueError(f"corrupted: body '{min(both)}' is there twice")
    steps, sim_time, outcomes = _step_axis(table, cloths, partial and not complete)
    if complete and documents["end"].get("steps") != len(steps):
        raise ValueError(f"corrupted: {len(steps)} steps, its closing document counts {documents['end'].get('steps')}")
    action_steps, actions = _actions(table.get("/episode/action", {}))
    return Recording(
        path=file,
        application=application,
        complete=complete,
        has_blueprint=has_blueprint,
        steps=steps,
        sim_time=sim_time,
        cloths=cloths,
        bodies=bodies | still,
        ground=scene.get("ground"),
        contours=_contours(table.get("/world/contours", {})),
        hits=_points(table.get("/world/hits", {})),
        scalars={
            _unescape(e.removeprefix("/metrics/")): _series(c["Scalars:scalars"])
            for e, c in table.items()
            if e.startswith("/metrics/") and "Scalars:scalars" in c
        },
        points={
            _unescape(e.removeprefix("/world/points/")): _points(c)
            for e, c in table.items()
            if e.startswith("/world/points/")
        },
        action_steps=action_steps,
        actions=actions,
        outcomes=outcomes,
        documents=documents,
    )


def _document(entity: str, columns: dict[str, Any]) -> dict[str, Any]:
    texts = columns["TextDocument:text"].lists.flatten().to_pylist() if "TextDocument:text" in columns else []
    try:
        document = json.loads(texts[0]) if len(texts) == 1 else None
    except (ValueError, RecursionError):
        document = None
    if not isinstance(document, dict):
        raise ValueError(f"corrupted: {entity} is no JSON object")
    return document


def _meshes(table: Table, described: Any, folder: str) -> dict[str, MeshTrack]:
    """The meshes that the scene document names, each with equal vertex counts at every step.

    Args:
        table: the file.
        described: the document's list of them.
        folder: "cloth", "body", or "bodies" for bodies that never move, which are written once and for all.
    """
    kind, still = ("cloth" if folder == "cloth" else "body"), folder == "bodies"
    if not isinstance(described, list) or not all(isinstance(d, dict) for d in described):
        raise ValueError(f"corrupted: the scene document lists no {kind}")
    by_name = {_unescape(e.removeprefix(f"/world/{folder}/")): c for e, c in table.items() if f"/world/{folder}/" in e}
    tracks: dict[str, MeshTrack] = {}
    for item in described:
        name = str(item.get("name"))
        columns = by_name.get(name, {})
        try:
            faces = flat(columns["Mesh3D:triangle_indices"].lists, 3).astype(np.int32)
            static, steps, _, positions = columns["Mesh3D:vertex_positions"]
            normals = columns["Mesh3D:vertex_normals"].lists
        except KeyError as error:
            raise ValueError(f"{kind} '{name}' has no {str(error).strip(chr(39))}") from None
        if static != still:
            raise ValueError(f"corrupted: {kind} '{name}' has {'steps' if still else 'no steps'}")
        if still:
            steps = np.zeros(1, np.int64)
        lengths = positions.value_lengths().to_numpy()
        count = int(lengths[0])
        x, n = flat(positions, 3), flat(normals, 3)
        if np.any(lengths != count) or x.shape != n.shape or len(x) != count * len(steps):
            raise ValueError(f"corrupted: {kind} '{name}' changes its number of vertices")
        if faces.size and (faces.min() < 0 or faces.max() >= count):
            raise ValueError(f"corrupted: {kind} '{name}' has faces beyond its {count} vertices")
        tracks[name] = MeshTrack(faces, steps, x.reshape(-1, count, 3), n.reshape(-1, count, 3))
    return tracks


def _step_axis(
    table: Table, cloths: dict[str, MeshTrack], partial: bool
) -> tuple[NDArray[np.int64], NDArray[np.float64], dict[str, list[Any]]]:
    """Steps that every cloth (and the outcome, if there is one) has, their times, and their outcomes.

    In a whole file they agree; one that was cut may lack the last batch of some.
    """
    outcome = table.get("/episode/outcome", {})
    axes = [track.steps for track in cloths.values()] + [column.steps for column in outcome.values()]
    steps = axes[0] if axes else np.empty(0, np.int64)
    for axis in axes[1:]:
        if not np.array_equal(axis, steps):
            if not partial:
                raise ValueError("corrupted: its cloths and outcomes have different steps")
            steps = np.intersect1d(steps, axis)
    times = {}
    for entity, columns in table.items():
        if entity.startswith("/world/cloth/") and "Mesh3D:vertex_positions" in columns:
            column = columns["Mesh3D:vertex_positions"]
            times = dict(zip(column.steps.tolist(), (column.nanoseconds / 1e9).tolist()))
    kept = {}
    for name, column in outcome.items():
        values = column.lists.flatten().to_pylist()
        if len(values) != len(column.steps):
            raise ValueError(f"corrupted: {name} has not one value a step")
        kept[name.removeprefix("clothgym:")] = [v for v, k in zip(values, column.steps) if k in steps]
    return steps, np.array([times[int(k)] for k in steps], dtype=np.float64), kept


def _slices(column: Any) -> list[slice]:
    stops = np.cumsum(column.value_lengths().to_numpy())
    return [slice(int(a), int(b)) for a, b in zip(np.concatenate([[0], stops[:-1]]), stops)]


def _series(column: Column) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    values = flat(column.lists, 1)
    if len(values) != len(column.steps):
        raise ValueError("corrupted: a time series has not one value a step")
    return column.steps, values


def _contours(columns: dict[str, Any]) -> dict[int, tuple[NDArray[np.float32], NDArray[np.int64]]]:
    if "LineStrips3D:strips" not in columns:
        return {}
    _, steps, _, strips = columns["LineStrips3D:strips"]
    segments = flat(strips, 3).reshape(-1, 2, 3)
    ids = flat(columns["clothgym:contour"].lists, 1)
    return {int(k): (segments[s], ids[s]) for k, s in zip(steps, _slices(strips))}


def _points(columns: dict[str, Any]) -> dict[int, NDArray[np.float32]]:
    if "Points3D:positions" not in columns:
        return {}
    _, steps, _, lists = columns["Points3D:positions"]
    positions = flat(lists, 3)
    return {int(k): positions[s] for k, s in zip(steps, _slices(lists))}


def _actions(columns: dict[str, Any]) -> tuple[NDArray[np.int64], NDArray[Any]]:
    """Steps and actions (T, A), in the order of steps; actions of several types become the widest of them."""
    found: list[tuple[int, NDArray[Any]]] = []
    for kind in ACTION_TYPES:
        if f"clothgym:action_{kind}" in columns:
            _, steps, _, lists = columns[f"clothgym:action_{kind}"]
            values = flat(lists, 1)
            found += [(int(k), values[s]) for k, s in zip(steps, _slices(lists))]
    found.sort(key=lambda row: row[0])
    if not found:
        return np.empty(0, np.int64), np.empty((0, 0), np.float32)
    if len({len(a) for _, a in found}) != 1 or len({k for k, _ in found}) != len(found):
        raise ValueError("corrupted: actions of different sizes, or two for one step")
    return np.array([k for k, _ in found], dtype=np.int64), np.stack([a for _, a in found])


def _unescape(path: str) -> str:
    """A name from its entity path (rerun escapes with a backslash)."""
    return path.replace("\\", "")
