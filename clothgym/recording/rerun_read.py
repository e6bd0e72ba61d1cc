"""Reads recordings (.rrd) back into numpy, and opens them in a viewer.

A recording may come from anyone, so nothing in it is trusted: it holds numbers and JSON only, every size and type is
checked, and rerun's own verifier looks at the file first, in a process of its own (measured on rerun 0.41: a flipped
bit in a length can end the reading process, and flipped payload bits are read without a word; checksums of every
column in the `end` document catch the latter).
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.errors import MissingExtraError

FORMAT = "clothgym-recording"
FORMAT_VERSION = 1
ACTION_TYPES = ("float32", "float64", "int64")
# `python -m rerun_cli` drops the exit code (measured on 0.41), so its main function is called instead.
_RERUN_CLI = (sys.executable, "-c", "import sys; from rerun_cli.__main__ import main; sys.exit(main())")


def import_rerun() -> ModuleType:
    """The rerun package, or MissingExtraError with the command that installs it."""
    try:
        import rerun
    except ImportError as error:
        raise MissingExtraError("rerun-sdk", "rerun") from error
    return rerun


@dataclass(frozen=True)
class MeshTrack:
    """A mesh over time: faces (F, 3), steps (n,), positions and normals (n, V, 3) float32 [m]."""

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
    with _whole_messages(file, partial) as readable:
        _verify(readable, file, partial)
        try:
            application, has_blueprint, table = _read_chunks(readable)
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


# ---- the file ----


@contextmanager
def _whole_messages(file: Path, partial: bool) -> Iterator[Path]:
    """The file itself, or, for a partial one that ends within a message, a copy that ends before it."""
    end, size = _last_whole_message(file), file.stat().st_size
    if end == size:
        yield file
    elif not partial:
        raise ValueError(f"{file}: cut short: byte {size} lies within a message (partial=True reads what is whole)")
    else:
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / "partial.rrd"
            with file.open("rb") as source, copy.open("wb") as target:
                while end > 0 and (block := source.read(min(end, 1 << 20))):
                    target.write(block)
                    end -= len(block)
            yield copy


def _last_whole_message(file: Path) -> int:
    """Offset behind the last whole message.

    A stream is a header of 12 bytes that starts with RRF2, then messages of kind, length (8 bytes each, little
    endian) and payload; kind 0 ends it, and its payload and the footer, which ends in RRF2FOOT and 4 bytes, follow.
    """
    size = file.stat().st_size
    with file.open("rb") as stream:
        if stream.read(4) != b"RRF2" or size < 12:
            raise ValueError(f"{file}: not a rerun recording (it does not start with RRF2)")
        offset = 12
        while offset < size:
            stream.seek(offset)
            head = stream.read(16)
            if len(head) < 16:
                return offset
            kind, length = (int.from_bytes(part, "little") for part in (head[:8], head[8:]))
            if kind == 0:
                stream.seek(max(offset, size - 12))
                return size if stream.read(8) == b"RRF2FOOT" else offset
            if kind > 3:
                raise ValueError(f"{file}: corrupted: unknown kind of message {kind} at byte {offset}")
            if offset + 16 + length > size:
                return offset
            offset += 16 + length
    return offset


def _verify(readable: Path, file: Path, partial: bool) -> None:
    """Runs rerun's verifier in a child process, which a malformed file may well bring down."""
    command = [*_RERUN_CLI, "rrd", "verify", str(readable.resolve())]
    command += ["--check-footers=false"] if partial else []
    environment = {**os.environ, "RERUN_APP_ONLY": "true"}
    ended = subprocess.run(command, capture_output=True, text=True, errors="replace", env=environment, check=False)
    if ended.returncode:
        lines = [line for line in ended.stderr.splitlines() if line.strip() and line[0] != " "]
        footer = any("footer" in line for line in lines)
        reason = "cut short (it has no footer)" if footer and not partial else "corrupted (rerun cannot verify it)"
        raise ValueError(f"{file}: {reason}")


class _Column(NamedTuple):
    """One component of one entity: an arrow list column with one list a row, sorted by step."""

    static: bool
    steps: NDArray[np.int64]
    nanoseconds: NDArray[np.int64]
    lists: Any


_Table = dict[str, dict[str, _Column]]
"""Entity -> component -> column."""


def _read_chunks(file: Path) -> tuple[str, bool, _Table]:
    """All columns of the recording in a file, each in one piece."""
    import pyarrow as pa
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a file without a footer is announced there; `complete` tells it here
        reader = RrdReader(file)
        stores = reader.recordings()
        if len(stores) != 1:
            raise ValueError(f"holds {len(stores)} recordings, expected one")
        has_blueprint = bool(reader.blueprints())
        pieces: dict[tuple[str, str], list[_Column]] = {}
        nothing = np.empty(0, np.int64)
        for chunk in reader.stream(store=stores[0]):
            batch = chunk.to_record_batch()
            names = batch.schema.names
            if not chunk.is_static and not {"step", "sim_time"} <= set(names):
                continue
            steps = nothing if chunk.is_static else batch.column("step").to_numpy().astype(np.int64)
            times = nothing if chunk.is_static else batch.column("sim_time").to_numpy().astype(np.int64)
            for name in names:
                lists = batch.column(name)
                if ":" in name and pa.types.is_list(lists.type):
                    piece = _Column(chunk.is_static, steps, times, lists)
                    pieces.setdefault((str(chunk.entity_path), name), []).append(piece)
    table: _Table = {}
    for (entity, name), parts in pieces.items():
        table.setdefault(entity, {})[name] = _join(entity, parts)
    return str(stores[0].application_id), has_blueprint, table


def _join(entity: str, parts: list[_Column]) -> _Column:
    """The pieces of one column, sorted by step."""
    import pyarrow as pa

    if any(p.static for p in parts):
        if len(parts) != 1 or len(parts[0].lists) != 1:
            raise ValueError(f"corrupted: {entity} was written more than once")
        return parts[0]
    steps = np.concatenate([p.steps for p in parts])
    times = np.concatenate([p.nanoseconds for p in parts])
    lists = pa.concat_arrays([p.lists for p in parts])
    if lists.null_count:
        raise ValueError(f"corrupted: {entity} has empty rows")
    if np.any(np.diff(steps) <= 0):
        order = np.argsort(steps, kind="stable")
        steps, times, lists = steps[order], times[order], lists.take(pa.array(order))
        if np.any(np.diff(steps) == 0):
            raise ValueError(f"corrupted: {entity} has two rows for one step")
    return _Column(False, steps, times, lists)


# ---- what is in it ----


def _assemble(file: Path, application: str, has_blueprint: bool, table: _Table, partial: bool) -> Recording:
    documents = {e.removeprefix("/clothgym/"): _document(e, c) for e, c in table.items() if e.startswith("/clothgym/")}
    scene = documents.get("scene", {})
    if scene.get("format") != FORMAT:
        raise ValueError("not a clothgym recording (no clothgym/scene document)")
    if scene.get("format_version") != FORMAT_VERSION:
        raise ValueError(f"format_version = {scene.get('format_version')!r}: this version reads {FORMAT_VERSION}")
    complete = "end" in documents
    if complete:
        _check_sums(table, documents["end"])
    elif not partial:
        raise ValueError("cut short: its closing document is missing (partial=True reads what is whole)")
    cloths = _meshes(table, scene, "cloth")
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
        bodies=_meshes(table, scene, "body"),
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


def _check_sums(table: _Table, end: dict[str, Any]) -> None:
    """Compares every column with the checksum that its writer kept."""
    expected = end.get("checksums")
    if not isinstance(expected, dict):
        raise ValueError("corrupted: no checksums in its closing document")
    for key, sums in expected.items():
        entity, _, name = key.partition("|")
        column = table.get(entity, {}).get(name)
        if column is None:
            raise ValueError(f"corrupted: {entity} {name} is missing")
        if name == "TextDocument:text":
            found = [zlib.crc32(column.lists.flatten().to_pylist()[0].encode())]
        else:
            found = column_checksum(column.lists)
            if not column.static:
                found += [zlib.crc32(stamps.tobytes()) for stamps in (column.steps, column.nanoseconds)]
        if found != sums:
            raise ValueError(f"corrupted: wrong checksum of {entity} {name}")


def column_checksum(column: Any, previous: Sequence[int] = ()) -> list[int]:
    """Running CRC-32 of an arrow list column: one number for each level of list lengths, and one for the values."""
    import pyarrow as pa

    buffers: list[bytes] = []
    values = column
    while pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type):
        if pa.types.is_list(values.type):
            buffers.append(values.value_lengths().to_numpy(zero_copy_only=False).astype("<i8").tobytes())
        values = values.flatten()
    if pa.types.is_string(values.type):
        buffers.append("".join(f"{text}\0" for text in values.to_pylist()).encode())
    else:
        buffers.append(values.to_numpy(zero_copy_only=False).tobytes())
    start = previous or [0] * len(buffers)
    return [zlib.crc32(data, crc) for data, crc in zip(buffers, start, strict=True)]


def _flat(column: Any, width: int) -> NDArray[Any]:
    """The values of a list column as numpy: (n,) for width 1, else (n, width)."""
    import pyarrow as pa

    values = column
    while pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type):
        values = values.flatten()
    array = values.to_numpy(zero_copy_only=False)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"corrupted: numbers expected, found {array.dtype}")
    return array if width == 1 else array.reshape(-1, width)


def _meshes(table: _Table, scene: dict[str, Any], kind: str) -> dict[str, MeshTrack]:
    """The meshes that the scene document names, each with equal vertex counts at every step."""
    described = scene.get("cloths" if kind == "cloth" else "bodies")
    if not isinstance(described, list) or not all(isinstance(d, dict) for d in described):
        raise ValueError(f"corrupted: the scene document lists no {kind}")
    by_name = {_unescape(e.removeprefix(f"/world/{kind}/")): c for e, c in table.items() if f"/world/{kind}/" in e}
    tracks: dict[str, MeshTrack] = {}
    for item in described:
        name = str(item.get("name"))
        columns = by_name.get(name, {})
        try:
            faces = _flat(columns["Mesh3D:triangle_indices"].lists, 3).astype(np.int32)
            static, steps, _, positions = columns["Mesh3D:vertex_positions"]
            normals = columns["Mesh3D:vertex_normals"].lists
        except KeyError as error:
            raise ValueError(f"{kind} '{name}' has no {str(error).strip(chr(39))}") from None
        if static:
            raise ValueError(f"corrupted: {kind} '{name}' has no steps")
        lengths = positions.value_lengths().to_numpy()
        count = int(lengths[0])
        x, n = _flat(positions, 3), _flat(normals, 3)
        if np.any(lengths != count) or x.shape != n.shape or len(x) != count * len(steps):
            raise ValueError(f"corrupted: {kind} '{name}' changes its number of vertices")
        if faces.size and (faces.min() < 0 or faces.max() >= count):
            raise ValueError(f"corrupted: {kind} '{name}' has faces beyond its {count} vertices")
        tracks[name] = MeshTrack(faces, steps, x.reshape(-1, count, 3), n.reshape(-1, count, 3))
    return tracks


def _step_axis(
    table: _Table, cloths: dict[str, MeshTrack], partial: bool
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


def _series(column: _Column) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    values = _flat(column.lists, 1)
    if len(values) != len(column.steps):
        raise ValueError("corrupted: a time series has not one value a step")
    return column.steps, values


def _contours(columns: dict[str, Any]) -> dict[int, tuple[NDArray[np.float32], NDArray[np.int64]]]:
    if "LineStrips3D:strips" not in columns:
        return {}
    _, steps, _, strips = columns["LineStrips3D:strips"]
    segments = _flat(strips, 3).reshape(-1, 2, 3)
    ids = _flat(columns["clothgym:contour"].lists, 1)
    return {int(k): (segments[s], ids[s]) for k, s in zip(steps, _slices(strips))}


def _points(columns: dict[str, Any]) -> dict[int, NDArray[np.float32]]:
    if "Points3D:positions" not in columns:
        return {}
    _, steps, _, lists = columns["Points3D:positions"]
    positions = _flat(lists, 3)
    return {int(k): positions[s] for k, s in zip(steps, _slices(lists))}


def _actions(columns: dict[str, Any]) -> tuple[NDArray[np.int64], NDArray[Any]]:
    """Steps and actions (T, A), in the order of steps; actions of several types become the widest of them."""
    found: list[tuple[int, NDArray[Any]]] = []
    for kind in ACTION_TYPES:
        if f"clothgym:action_{kind}" in columns:
            _, steps, _, lists = columns[f"clothgym:action_{kind}"]
            values = _flat(lists, 1)
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


# ---- the viewer ----


def viewer_command(*arguments: str, port: int = 9876) -> list[str]:
    """Command line of a rerun viewer that listens on the loopback alone (its own default is every interface)."""
    return [*_RERUN_CLI, *arguments, "--bind", "127.0.0.1", "--port", str(port)]


def start_viewer(port: int = 9876, *arguments: str, seconds: float = 20.0) -> subprocess.Popen[bytes] | None:
    """Starts a live viewer and waits until it listens; None when one listens there already.

    Raises:
        ValueError: the viewer ended or did not listen in time (no display, no graphics driver).
    """
    if _listens(port):
        return None
    import_rerun()
    process = subprocess.Popen(
        viewer_command(*arguments, "--hide-welcome-screen", port=port),
        env={**os.environ, "RERUN_APP_ONLY": "true"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and process.poll() is None:
        if _listens(port):
            time.sleep(0.5)  # a viewer without a display listens for a moment before it gives up
            if process.poll() is None:
                return process
            break
        time.sleep(0.05)
    code = process.poll()
    if code is None and hasattr(os, "killpg"):
        os.killpg(process.pid, signal.SIGTERM)  # the viewer is a child of that process
    state = "did not start in time" if code is None else f"ended at once (exit code {code})"
    raise ValueError(f"spawn = True: the rerun viewer {state}; it needs a display and a graphics driver")


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex(("127.0.0.1", port)) == 0
