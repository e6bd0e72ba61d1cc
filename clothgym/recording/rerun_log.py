"""Writes what a simulation does into a rerun file (.rrd), or into a live viewer on the loopback.

Layout of a file (everything is plain rerun data; any rerun viewer of the same age opens it):

    world/cloth/<name>        Mesh3D: faces and colour once (static), positions and vertex normals per step
    world/body/<name>         Mesh3D: faces once, vertices at the first step and whenever they moved
    world/ground              Mesh3D, once
    world/contours            LineStrips3D per step, one strip a segment, coloured by contour; `clothgym:contour` ids
    world/hits                Points3D: where an edge pierces a triangle
    world/points/<name>       Points3D, such as grippers
    metrics/<name>            Scalars
    episode/action            the action as numbers of its own type, written *before* the step that it starts
    episode/outcome           state hash, reward, terminated, truncated of each step
    clothgym/<name>           static JSON documents: `scene` first, `end` last (with a checksum of every column)

Timelines: `step` (sequence) and `sim_time` (duration). Step 0 is the state after a reset; the action at step k leads
to the state at step k.

Safe against a kill: actions go to disk at once, everything else in batches of at most `batch_steps` steps, 4 MB or
a second, whichever comes first. A file without its `end` document was cut short, and readers say so.
"""

from __future__ import annotations

import atexit
import json
import os
import time
import uuid
import warnings
import weakref
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.arrays import as_faces, check_number
from clothgym.kernels import raster
from clothgym.recording.rerun_read import FORMAT, FORMAT_VERSION, column_checksum, import_rerun, start_viewer

_BATCH_BYTES = 4_000_000
_BATCH_SECONDS = 1.0
_CLOTH_COLOURS = ((86, 150, 214), (226, 148, 76), (108, 182, 112), (190, 124, 200), (214, 202, 96), (112, 196, 200))
_CONTOUR_COLOURS = np.array(
    [(235, 52, 52), (255, 190, 30), (60, 220, 90), (70, 160, 255), (230, 90, 230), (40, 225, 225), (255, 120, 40)],
    dtype=np.uint8,
)
_Rows = list[tuple[str, dict[str, NDArray[Any]]]]
"""Entity and its values at one step."""

_open_logs: weakref.WeakSet[RerunLog] = weakref.WeakSet()


class _Column:
    """A finished arrow column under a component's name (what `send_columns` asks for)."""

    def __init__(self, descriptor: Any, array: Any) -> None:
        self.descriptor = descriptor
        self.array = array

    def component_descriptor(self) -> Any:
        return self.descriptor

    def as_arrow_array(self) -> Any:
        return self.array

    def partition(self, lengths: list[int]) -> _Column:
        """The column cut into one list per step."""
        import pyarrow as pa

        offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
        return _Column(self.descriptor, pa.ListArray.from_arrays(offsets, self.array))


def _normals(positions: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """(V, 3) vertex normals: the viewer draws a mesh without them flat and unshaded."""
    normals = np.empty(positions.shape)
    raster.vertex_normals(positions.astype(np.float64), faces, normals)
    return normals.astype(np.float32)


class RerunLog:
    """One recording: `open(...)`, then `log_step(...)` per step, then `close()`; or a `with` block.

    Args:
        path: the .rrd file (folders are made; an old file of that name is replaced), or None for a viewer alone.
        application: rerun's application id.
        recording_id: rerun's recording id; a new one by default.
        spawn: also show the run in a live viewer that listens on 127.0.0.1 only.
        batch_steps: at most this many steps wait in memory before they are written.
        port: the live viewer's port.

    Raises:
        ValueError: neither path nor viewer, a path that does not end in .rrd or cannot be written, RERUN=off.
        MissingExtraError: rerun-sdk is not installed.
    """

    def __init__(
        self,
        path: str | os.PathLike[str] | None = None,
        application: str = "clothgym",
        recording_id: str | None = None,
        spawn: bool = False,
        *,
        batch_steps: int = 16,
        port: int = 9876,
    ) -> None:
        self._closed = True
        if path is None and not spawn:
            raise ValueError("path = None: a recording needs a file, or spawn=True for a live viewer")
        self.path = None if path is None else Path(path)
        self.spawn = spawn
        self.port = int(check_number(port, "port", 1, 65535, integer=True))
        self._batch_steps = 1 if spawn else int(check_number(batch_steps, "batch_steps", 1, 4096, integer=True))
        if self.path is not None and self.path.suffix != ".rrd":
            raise ValueError(f"path = '{self.path}': a recording's name must end in .rrd")
        self._rerun = import_rerun()
        if self.path is not None:
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self.path.open("wb").close()
            except OSError as error:
                raise ValueError(f"path = '{self.path}': cannot be written ({error.strerror})") from error
        self._stream = self._rerun.RecordingStream(
            application, recording_id=recording_id or uuid.uuid4().hex, send_properties=False
        )
        if not self._rerun.is_enabled(self._stream):
            raise ValueError("RERUN=off stands in the environment: nothing would be recorded")
        self._opened = False
        self._closed = False
        self._cloths: list[tuple[str, slice, NDArray[np.int32]]] = []
        self._bodies: dict[str, tuple[str, NDArray[np.int32], NDArray[np.float32] | None]] = {}
        self._first_bodies: dict[str, NDArray[np.float32]] = {}
        self._vertex_count = 0
        self._rows: dict[str, list[tuple[int, int, dict[str, NDArray[Any]]]]] = {}
        self._pending = 0
        self._pending_bytes = 0
        self._last_write = time.monotonic()
        self._checksums: dict[str, list[int]] = {}
        self._styled: set[str] = set()
        self._lost_viewer = False
        self.steps: list[int] = []
        _keep_until_exit(self)

    def open(
        self,
        cloths: Iterable[tuple[Any, ...]],
        bodies: Iterable[tuple[str, ArrayLike, ArrayLike]] = (),
        ground: float | None = None,
        bounds: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> None:
        """Starts the file: what never changes, and the blueprint.

        Args:
            cloths: (name, faces (F, 3), colour) in the order of the positions; colour is (r, g, b) or None. Faces use
                the cloth's own vertex ids from 0. A fourth item, a slice, tells which rows of the positions belong to
                it; without it the cloths lie one after the other and each has as many vertices as its faces name.
            bodies: (name, vertices (B, 3) [m], faces).
            ground: height of the ground [m], or None.
            bounds: lowest and highest corner of what should be in view [m].

        Raises:
            ValueError: opened twice, two meshes of one name, bad faces or slices.
        """
        if self._opened or self._closed:
            raise ValueError("open() was called twice, or after close()")
        meshes = self._describe_cloths(cloths)
        solid = [(name, np.asarray(vertices, np.float32), vertices, faces) for name, vertices, faces in bodies]
        self._start(bounds)
        self._opened = True
        rr = self._rerun
        self._log_static("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP)
        for name, faces, rows, colour in meshes:
            entity = f"world/cloth/{_part(rr, name)}"
            self._log_mesh(entity, faces, colour)
            self._cloths.append((entity, rows, faces))
        for name, vertices, _, raw_faces in solid:
            faces = as_faces(raw_faces, len(vertices), f"faces of body '{name}'")
            entity = f"world/body/{_part(rr, name)}"
            self._log_mesh(entity, faces, (178, 164, 152))
            self._bodies[name] = (entity, faces, None)
        if ground is not None:
            self._log_ground(float(ground), bounds)
        document = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "cloths": [{"name": n, "rows": [r.start, r.stop], "faces": len(f)} for n, f, r, _ in meshes],
            "bodies": [{"name": n, "vertices": len(v)} for n, v, _, _ in solid],
            "ground": None if ground is None else float(ground),
        }
        self.log_document("scene", document)
        self._first_bodies = {name: vertices for name, vertices, _, _ in solid}

    def open_simulation(self, simulation: Any) -> None:
        """`open` with what a Simulation holds: its cloths, body meshes and ground."""
        positions = np.asarray(simulation.positions)
        faces = np.asarray(simulation.faces)
        cloths = [
            (name, faces[face_rows] - rows.start, None, slice(rows.start, rows.stop))
            for name, rows, face_rows in simulation.cloth_ranges
        ]
        bodies: list[tuple[str, ArrayLike, ArrayLike]] = list(getattr(simulation, "body_meshes", ()))
        ground = getattr(getattr(simulation, "scene", None), "ground", None)
        everything = np.concatenate([positions, *(np.asarray(v) for _, v, _ in bodies)])
        low, high = everything.min(axis=0), everything.max(axis=0)
        low[1] = low[1] if ground is None else min(low[1], ground)
        self.open(cloths, bodies, ground, (low, high))

    def log_document(self, name: str, document: Mapping[str, Any]) -> None:
        """A static JSON document at clothgym/<name>."""
        self._need_open()
        text = json.dumps(document, allow_nan=False)
        entity = f"clothgym/{name}"
        self._log_static(entity, self._rerun.TextDocument(text, media_type="text/plain"))
        self._checksums[f"/{entity}|TextDocument:text"] = [zlib.crc32(text.encode())]
        self._flush()

    def log_action(self, step: int, sim_time: float, action: ArrayLike) -> None:
        """The action that will lead to the given step: on disk before the step is simulated."""
        self._need_open()
        values = np.asarray(action)
        if values.dtype.kind not in "biuf":
            raise ValueError(f"action: expected numbers, got {values.dtype}")
        kind = "int64" if values.dtype.kind in "biu" else "float32" if values.dtype == np.float32 else "float64"
        row = {f"clothgym:action_{kind}": values.astype(kind).ravel()}
        self._send("episode/action", [(int(step), _nanoseconds(sim_time), row)])
        self._flush()

    def log_step(
        self,
        step: int,
        sim_time: float,
        positions: ArrayLike,
        *,
        contours: tuple[ArrayLike, ArrayLike] | None = None,
        hits: ArrayLike | None = None,
        scalars: Mapping[str, float] | None = None,
        points: Mapping[str, ArrayLike] | None = None,
        bodies: Mapping[str, ArrayLike] | None = None,
        outcome: Mapping[str, Any] | None = None,
    ) -> None:
        """The state after one step.

        Args:
            step: must grow from call to call.
            sim_time: simulated time [s].
            positions: (V, 3) of all cloths [m].
            contours: segments (S, 2, 3) [m] and the contour id of each (S,).
            hits: (H, 3) points where edges pierce triangles [m].
            scalars: name -> number, drawn as time series.
            points: name -> (N, 3) [m], such as grippers.
            bodies: name -> vertices (B, 3) [m] of bodies that may have moved.
            outcome: state_hash (str), reward (float), terminated, truncated (bool), for replay.

        Raises:
            ValueError: not opened, closed, a step that does not grow, wrong shapes, unknown bodies.
        """
        self._need_open()
        if self.steps and step <= self.steps[-1]:
            raise ValueError(f"step = {step}: must be larger than the last one, {self.steps[-1]}")
        x = np.asarray(positions, dtype=np.float32)
        if x.shape != (self._vertex_count, 3):
            raise ValueError(f"positions: expected shape ({self._vertex_count}, 3), got {x.shape}")
        rows: _Rows = [
            (entity, {"positions": x[part], "normals": _normals(x[part], faces)})
            for entity, part, faces in self._cloths
        ]
        moved = self._moved_bodies(bodies or {})
        rows += [(self._bodies[n][0], {"positions": v, "normals": _normals(v, self._bodies[n][1])}) for n, v in moved]
        if contours is not None:
            segments = np.asarray(contours[0], dtype=np.float32).reshape(-1, 2, 3)
            ids = np.asarray(contours[1], dtype=np.int64).ravel()
            if len(ids) != len(segments):
                raise ValueError(f"contours: {len(segments)} segments, but {len(ids)} contour ids")
            rows.append(("world/contours", {"segments": segments, "contour": ids}))
        if hits is not None:
            rows.append(("world/hits", {"points": _as_points(hits)}))
        for name, values in (points or {}).items():
            rows.append((f"world/points/{_part(self._rerun, name)}", {"points": _as_points(values)}))
        for name, value in (scalars or {}).items():
            entity = "/".join(_part(self._rerun, part) for part in ("metrics", *name.split("/")))
            rows.append((entity, {"scalar": np.array([value], dtype=np.float64)}))
        if outcome is not None:
            rows.append(("episode/outcome", _outcome_row(outcome)))
        self._keep_rows((int(step), _nanoseconds(sim_time)), rows)  # all or nothing: a refused step leaves no trace
        for name, vertices in moved:
            self._bodies[name] = (*self._bodies[name][:2], vertices.copy())
        self.steps.append(int(step))
        self._pending += 1
        late = time.monotonic() - self._last_write > _BATCH_SECONDS
        if self._pending >= self._batch_steps or self._pending_bytes >= _BATCH_BYTES or late:
            self.write_pending()

    def log_simulation(
        self,
        step: int,
        simulation: Any,
        scalars: Mapping[str, float] | None = None,
        points: Mapping[str, ArrayLike] | None = None,
        outcome: Mapping[str, Any] | None = None,
    ) -> None:
        """`log_step` with what a Simulation holds now; reads only."""
        hits = getattr(simulation, "last_intersections", None)
        self.log_step(
            step,
            simulation.time,
            simulation.positions,
            contours=None if hits is None else (hits.segments, hits.contour),
            hits=None if hits is None else hits.points,
            scalars=scalars,
            points=points,
            bodies={name: vertices for name, vertices, _ in getattr(simulation, "body_meshes", ())},
            outcome=outcome,
        )

    def write_pending(self) -> None:
        """Writes every finished step to disk."""
        for entity, rows in self._rows.items():
            self._send(entity, rows)
        self._rows.clear()
        self._pending = self._pending_bytes = 0
        self._last_write = time.monotonic()
        self._flush()

    def close(self, **facts: Any) -> None:
        """Writes the rest and the `end` document (with `facts` in it, JSON values). A second call does nothing."""
        if self._closed:
            return
        try:
            if self._opened:
                self.write_pending()
                self.log_document("end", {"steps": len(self.steps), **facts, "checksums": self._checksums})
        finally:
            self._closed = True
            _open_logs.discard(self)
            self._stream.disconnect()

    def __enter__(self) -> RerunLog:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> None:
        if error is None:
            self.close()
        else:
            self.close(failure=f"{type(error).__name__}: {error}")

    def __del__(self) -> None:
        if not getattr(self, "_closed", True):
            self.close()

    # ---- parts of open ----

    def _describe_cloths(self, cloths: Iterable[tuple[Any, ...]]) -> list[tuple[str, NDArray[np.int32], slice, Any]]:
        """Checked (name, faces, rows, colour) of each cloth; sets the number of vertices."""
        meshes: list[tuple[str, NDArray[np.int32], slice, Any]] = []
        start = 0
        for index, (name, raw_faces, colour, *rest) in enumerate(cloths):
            faces = as_faces(raw_faces, name=f"faces of cloth '{name}'")
            count = int(faces.max()) + 1 if len(faces) else 0
            rows = rest[0] if rest else slice(start, start + count)
            if rows.start != start or rows.stop < start + count:
                raise ValueError(f"rows of cloth '{name}' = {rows}: expected a slice from {start} of at least {count}")
            start = rows.stop
            meshes.append((str(name), faces, rows, colour or _CLOTH_COLOURS[index % len(_CLOTH_COLOURS)]))
        names = [m[0] for m in meshes]
        if len(set(names)) != len(names):
            raise ValueError(f"cloths: names must differ, got {names}")
        self._vertex_count = start
        return meshes

    def _start(self, bounds: tuple[ArrayLike, ArrayLike] | None) -> None:
        rr = self._rerun
        layout = blueprint(bounds)
        sinks: list[Any] = [] if self.path is None else [rr.FileSink(self.path)]
        if self.spawn:
            start_viewer(self.port)
            sinks.append(rr.GrpcSink(f"rerun+http://127.0.0.1:{self.port}/proxy"))
        self._stream.set_sinks(*sinks, default_blueprint=layout)

    def _log_mesh(self, entity: str, faces: NDArray[np.int32], colour: Sequence[int]) -> None:
        mesh = self._rerun.Mesh3D.from_fields(
            triangle_indices=faces.astype(np.uint32), albedo_factor=[*colour[:3], 255]
        )
        self._log_static(entity, mesh)
        self._checksums[f"/{entity}|Mesh3D:triangle_indices"] = [
            zlib.crc32(np.array([len(faces)], dtype="<i8").tobytes()),
            zlib.crc32(faces.astype(np.uint32).tobytes()),
        ]

    def _log_ground(self, height: float, bounds: tuple[ArrayLike, ArrayLike] | None) -> None:
        low, high = (np.zeros(3), np.ones(3)) if bounds is None else (np.asarray(b, float) for b in bounds)
        middle, half = (low + high) / 2, 0.75 * float(np.max(high - low)) + 0.25
        corners = [
            (middle[0] + a * half, height, middle[2] + b * half) for a, b in ((-1, -1), (-1, 1), (1, 1), (1, -1))
        ]
        mesh = self._rerun.Mesh3D(
            vertex_positions=corners,
            triangle_indices=[(0, 1, 2), (0, 2, 3)],
            vertex_normals=[(0, 1, 0)] * 4,
            albedo_factor=[96, 100, 106, 255],
        )
        self._log_static("world/ground", mesh)

    def _log_static(self, entity: str, archetype: Any) -> None:
        self._stream.log(entity, archetype, static=True, strict=True)

    # ---- parts of a step ----

    def _need_open(self) -> None:
        if self._closed or not self._opened:
            raise ValueError("the recording is closed" if self._opened else "call open() before logging")

    def _keep_rows(self, at: tuple[int, int], rows: _Rows) -> None:
        """Copies of one step's rows, to be written with the batch."""
        for entity, fields in rows:
            self._rows.setdefault(entity, []).append((*at, {name: values.copy() for name, values in fields.items()}))
            self._pending_bytes += sum(values.nbytes for values in fields.values())

    def _moved_bodies(self, bodies: Mapping[str, ArrayLike]) -> list[tuple[str, NDArray[np.float32]]]:
        """Name and vertices of the bodies that were never logged, or have moved since."""
        if unknown := set(bodies) - set(self._bodies):
            raise ValueError(f"bodies: no such body {sorted(unknown)}; open() named {sorted(self._bodies)}")
        moved = []
        for name, (_, _, last) in self._bodies.items():
            first = self._first_bodies[name]
            vertices = np.asarray(bodies.get(name, first if last is None else last), dtype=np.float32)
            if vertices.shape != first.shape:
                raise ValueError(f"body '{name}': vertices {vertices.shape}, was {first.shape}")
            if last is None or not np.array_equal(vertices, last):
                moved.append((name, vertices))
        return moved

    def _send(self, entity: str, rows: list[tuple[int, int, dict[str, NDArray[Any]]]]) -> None:
        """Sends rows of one entity as one chunk, and keeps the checksum of every column."""
        rr = self._rerun
        steps = np.array([row[0] for row in rows], dtype="<i8")
        nanoseconds = np.array([row[1] for row in rows], dtype="<i8")
        times = [
            rr.TimeColumn("step", sequence=steps),
            rr.TimeColumn("sim_time", duration=nanoseconds.astype("timedelta64[ns]")),
        ]
        fields = {name: [row[2][name] for row in rows] for name in rows[0][2]}
        lengths = [len(values) for values in next(iter(fields.values()))]
        columns = _columns(rr, {name: np.concatenate(values) for name, values in fields.items()}, lengths)
        for column in columns:
            key = f"/{entity}|{column.component_descriptor().component}"
            before = self._checksums.get(key, ())
            sums = column_checksum(column.as_arrow_array(), before[:-2])
            stamps = (steps.tobytes(), nanoseconds.tobytes())
            self._checksums[key] = sums + [zlib.crc32(d, c) for d, c in zip(stamps, before[-2:] or (0, 0))]
        if entity not in self._styled:
            self._styled.add(entity)
            self._log_style(entity, fields)
        self._stream.send_columns(entity, times, columns, strict=True)

    def _log_style(self, entity: str, fields: Mapping[str, Any]) -> None:
        """Sizes and colours that never change, once per entity."""
        rr = self._rerun
        if "segments" in fields:
            self._log_static(entity, rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(3.0)))
        elif entity == "world/hits":
            style = rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.0), colors=(255, 255, 255))
            self._log_static(entity, style)
        elif "points" in fields:
            self._log_static(entity, rr.Points3D.from_fields(radii=0.01, colors=(255, 220, 60)))

    def _flush(self) -> None:
        try:
            self._stream.flush(timeout_sec=10.0 if self.spawn else 1e9)
        except Exception as error:
            if not self.spawn:
                raise
            if not self._lost_viewer:
                warnings.warn(f"the live viewer no longer answers: {error}", RuntimeWarning, stacklevel=2)
            self._lost_viewer = True


def _as_points(values: ArrayLike) -> NDArray[np.float32]:
    return np.asarray(values, dtype=np.float32).reshape(-1, 3)


def _outcome_row(outcome: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Arrays of one entry each; what is not told is 0 or false."""
    return {
        "state_hash": np.array([str(outcome["state_hash"])]),
        "reward": np.array([outcome.get("reward", 0.0)], dtype=np.float64),
        "terminated": np.array([bool(outcome.get("terminated", False))]),
        "truncated": np.array([bool(outcome.get("truncated", False))]),
    }


def _columns(rr: ModuleType, fields: dict[str, NDArray[Any]], lengths: list[int]) -> list[_Column]:
    """Arrow columns of one entity from its concatenated values."""
    import pyarrow as pa

    if "positions" in fields:
        found = rr.Mesh3D.columns(vertex_positions=fields["positions"], vertex_normals=fields["normals"])
    elif "segments" in fields:
        colours = _CONTOUR_COLOURS[fields["contour"] % len(_CONTOUR_COLOURS)]
        found = rr.LineStrips3D.columns(strips=fields["segments"], colors=colours)
    elif "points" in fields:
        found = rr.Points3D.columns(positions=fields["points"])
    elif "scalar" in fields:
        found = rr.Scalars.columns(scalars=fields["scalar"])
    else:
        found = ()
    columns = [_Column(c.component_descriptor(), c.component_batch.as_arrow_array()).partition(lengths) for c in found]
    for name, values in fields.items():
        if name in ("positions", "normals", "segments", "points", "scalar"):
            continue
        label = rr.ComponentDescriptor(name if ":" in name else f"clothgym:{name}")
        array = pa.array(values.tolist(), pa.string()) if values.dtype.kind == "U" else pa.array(values)
        columns.append(_Column(label, array).partition(lengths))
    return columns


def blueprint(bounds: tuple[ArrayLike, ArrayLike] | None = None) -> Any:
    """The layout that is stored in each file: the scene beside time series of what matters."""
    import_rerun()
    import rerun.blueprint as rrb

    eye = None
    if bounds is not None:
        low, high = (np.asarray(b, dtype=float) for b in bounds)
        middle, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.1)
        eye = rrb.EyeControls3D(
            position=middle + size * np.array([0.55, 0.45, 1.0]), look_target=middle, eye_up=(0.0, 1.0, 0.0)
        )
    left, right = rrb.Corner2D.LeftTop, rrb.Corner2D.RightTop
    plots = [
        ("contour length [m]", right, ["metrics/contour_length"]),
        ("reward", left, ["metrics/reward", "metrics/reward/**"]),
        ("largest strain", right, ["metrics/max_strain"]),
        ("progress", left, ["metrics/progress", "metrics/is_success"]),
        ("everything", right, ["metrics/**"]),
        ("force [N]", right, ["metrics/force_max"]),
        ("penetration [m]", right, ["metrics/penetration_depth"]),
    ]
    series: list[Any] = [
        rrb.TimeSeriesView(name=name, origin="/", contents=paths, plot_legend=corner) for name, corner, paths in plots
    ]
    views, others = series[:4], series[4:]
    others.append(rrb.TextDocumentView(name="episode", origin="clothgym/episode"))
    scene = rrb.Spatial3DView(name="scene", origin="world", eye_controls=eye)
    side = rrb.Vertical(*views, rrb.Tabs(*others))
    return rrb.Blueprint(
        rrb.Horizontal(scene, side, column_shares=[2, 1]),
        rrb.TimePanel(state="collapsed", timeline="sim_time"),
        collapse_panels=True,
    )


def _part(rr: ModuleType, name: str) -> str:
    """One part of an entity path; what would separate parts is escaped."""
    if not str(name).isprintable() or not str(name) or "\\" in str(name):
        raise ValueError(f"name = {name!r}: a recorded thing needs a printable name without a backslash")
    return str(rr.escape_entity_path_part(str(name)))


def _nanoseconds(seconds: float) -> int:
    return round(float(seconds) * 1e9)


def _keep_until_exit(log: RerunLog) -> None:
    """Recordings that nobody closed are finished when the interpreter ends, before rerun shuts down."""
    if not _open_logs:
        atexit.unregister(_close_all)
        atexit.register(_close_all)  # after rerun's own handler, so it runs before that one
    _open_logs.add(log)


def _close_all() -> None:
    for log in list(_open_logs):
        log.close()
