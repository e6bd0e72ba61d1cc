"""Writes what a simulation does into a rerun file (.rrd), or into a live viewer on the loopback.

Layout of a file (everything is plain rerun data; any rerun viewer of the same age opens it):

    world/cloth/<name>        Mesh3D: faces and colour once (static), positions and vertex normals per step
    world/body/<name>         Mesh3D: faces once, vertices at the first step and whenever they moved
    world/bodies/<name>       Mesh3D of a body that never moves, once, with normals
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
import os
import uuid
import weakref
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.arrays import as_faces, as_points, check_number
from clothgym.recording.rerun_chunks import ChunkWriter, Rows, normals
from clothgym.recording.rerun_layout import blueprint, entity_part, ground_mesh
from clothgym.recording.rerun_read import FORMAT, FORMAT_VERSION
from clothgym.recording.rerun_viewer import import_rerun, start_viewer

_CLOTH_COLOURS = ((86, 150, 214), (226, 148, 76), (108, 182, 112), (190, 124, 200), (214, 202, 96), (112, 196, 200))
_BODY_COLOUR = (178, 164, 152)

_open_logs: weakref.WeakSet[RerunLog] = weakref.WeakSet()


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
        batch_steps = 1 if spawn else int(check_number(batch_steps, "batch_steps", 1, 4096, integer=True))
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
        self._writer = ChunkWriter(self._rerun, self._stream, batch_steps, forgiving=spawn)
        self.steps: list[int] = []
        _keep_until_exit(self)

    def open(
        self,
        cloths: Iterable[tuple[Any, ...]],
        bodies: Iterable[tuple[str, ArrayLike, ArrayLike]] = (),
        ground: float | None = None,
        bounds: tuple[ArrayLike, ArrayLike] | None = None,
        still_bodies: Iterable[tuple[str, ArrayLike, ArrayLike]] = (),
    ) -> None:
        """Starts the file: what never changes, and the blueprint.

        Args:
            cloths: (name, faces (F, 3), colour) in the order of the positions; colour is (r, g, b) or None. Faces use
                the cloth's own vertex ids from 0. A fourth item, a slice, tells which rows of the positions belong to
                it; without it the cloths lie one after the other and each has as many vertices as its faces name.
            bodies: (name, vertices (B, 3) [m], faces) of bodies that may move.
            ground: height of the ground [m], or None.
            bounds: lowest and highest corner of what should be in view [m].
            still_bodies: the same for bodies that never move; they are written once.

        Raises:
            ValueError: opened twice, two meshes of one name, bad faces or slices.
        """
        if self._opened or self._closed:
            raise ValueError("open() was called twice, or after close()")
        meshes = self._describe_cloths(cloths)
        solid = [_described_body(*body) for body in bodies]
        still = [_described_body(*body) for body in still_bodies]
        names = [name for name, _, _ in solid + still]
        if len(set(names)) != len(names):
            raise ValueError(f"bodies: names must differ, got {names}")
        self._start(bounds)
        self._opened = True
        rr = self._rerun
        self._writer.static("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP)
        for name, faces, rows, colour in meshes:
            entity = f"world/cloth/{entity_part(rr, name)}"
            self._writer.mesh(entity, faces, colour)
            self._cloths.append((entity, rows, faces))
        for name, vertices, faces in solid:
            entity = f"world/body/{entity_part(rr, name)}"
            self._writer.mesh(entity, faces, _BODY_COLOUR)
            self._bodies[name] = (entity, faces, None)
            self._first_bodies[name] = vertices
        for name, vertices, faces in still:
            self._writer.mesh(f"world/bodies/{entity_part(rr, name)}", faces, _BODY_COLOUR, vertices)
        if ground is not None:
            self._writer.static("world/ground", ground_mesh(float(ground), bounds))
        document = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "cloths": [{"name": n, "rows": [r.start, r.stop], "faces": len(f)} for n, f, r, _ in meshes],
            "bodies": [{"name": n, "vertices": len(v)} for n, v, _ in solid],
            "still_bodies": [{"name": n, "vertices": len(v)} for n, v, _ in still],
            "ground": None if ground is None else float(ground),
        }
        self.log_document("scene", document)

    def open_simulation(self, simulation: Any) -> None:
        """`open` with what a Simulation holds: its cloths, bodies and ground.

        The scene's bodies stand still or have a motion; a simulation that has `body_meshes` (name, vertices, faces) tells at
        each step where they are.
        """
        positions = np.asarray(simulation.positions)
        faces = np.asarray(simulation.faces)
        cloths = [
            (name, faces[face_rows] - rows.start, None, slice(rows.start, rows.stop))
            for name, rows, face_rows in simulation.cloth_ranges
        ]
        scene = getattr(simulation, "scene", None)
        ground = getattr(scene, "ground", None)
        moving, still = _bodies_now(simulation)
        everything = np.concatenate([positions, *(np.asarray(v) for _, v, _ in (*moving, *still))])
        low, high = everything.min(axis=0), everything.max(axis=0)
        low[1] = low[1] if ground is None else min(low[1], ground)
        self.open(cloths, moving, ground, (low, high), still)

    def log_document(self, name: str, document: Mapping[str, Any]) -> None:
        """A static JSON document at clothgym/<name>."""
        self._need_open()
        self._writer.document(f"clothgym/{name}", document)

    def log_action(self, step: int, sim_time: float, action: ArrayLike) -> None:
        """The action that will lead to the given step: on disk before the step is simulated."""
        self._need_open()
        values = np.asarray(action)
        if values.dtype.kind not in "biuf":
            raise ValueError(f"action: expected numbers, got {values.dtype}")
        if np.isnan(values).any():
            raise ValueError(f"action[{int(np.argmax(np.isnan(values)))}] is nan")
        kind = "int64" if values.dtype.kind in "biu" else "float32" if values.dtype == np.float32 else "float64"
        row = {f"clothgym:action_{kind}": values.astype(kind).ravel()}
        self._writer.send("episode/action", [(int(step), _nanoseconds(sim_time), row)])
        self._writer.flush()

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
            ValueError: not opened, closed, a step that does not grow, wrong shapes, positions that are not finite, unknown
                bodies.
        """
        self._need_open()
        if self.steps and step <= self.steps[-1]:
            raise ValueError(f"step = {step}: must be larger than the last one, {self.steps[-1]}")
        x = np.asarray(positions, dtype=np.float32)
        if x.shape != (self._vertex_count, 3):
            raise ValueError(f"positions: expected shape ({self._vertex_count}, 3), got {x.shape}")
        if not np.isfinite(x).all():
            row, column = (int(i) for i in np.argwhere(~np.isfinite(x))[0])
            raise ValueError(f"positions[{row}, {column}] is {x[row, column]}: every coordinate must be finite")
        rows: Rows = [
            (entity, {"positions": x[part], "normals": normals(x[part], faces)}) for entity, part, faces in self._cloths
        ]
        moved = self._moved_bodies(bodies or {})
        rows += [(self._bodies[n][0], {"positions": v, "normals": normals(v, self._bodies[n][1])}) for n, v in moved]
        if contours is not None:
            segments = np.asarray(contours[0], dtype=np.float32).reshape(-1, 2, 3)
            ids = np.asarray(contours[1], dtype=np.int64).ravel()
            if len(ids) != len(segments):
                raise ValueError(f"contours: {len(segments)} segments, but {len(ids)} contour ids")
            rows.append(("world/contours", {"segments": segments, "contour": ids}))
        if hits is not None:
            rows.append(("world/hits", {"points": _as_points(hits)}))
        for name, values in (points or {}).items():
            rows.append((f"world/points/{entity_part(self._rerun, name)}", {"points": _as_points(values)}))
        for name, value in (scalars or {}).items():
            entity = "/".join(entity_part(self._rerun, p) for p in ("metrics", *name.split("/")))
            rows.append((entity, {"scalar": np.array([value], dtype=np.float64)}))
        if outcome is not None:
            rows.append(("episode/outcome", _outcome_row(outcome)))
        self._writer.keep((int(step), _nanoseconds(sim_time)), rows)  # all or nothing: a refused step leaves no trace
        for name, vertices in moved:
            self._bodies[name] = (*self._bodies[name][:2], vertices.copy())
        self.steps.append(int(step))
        self._writer.write_when_due()

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
            bodies={name: vertices for name, vertices, _ in _bodies_now(simulation)[0]},
            outcome=outcome,
        )

    def write_pending(self) -> None:
        """Writes every finished step to disk."""
        self._writer.write_pending()

    def close(self, **facts: Any) -> None:
        """Writes the rest and the `end` document (with `facts` in it, JSON values). A second call does nothing."""
        if self._closed:
            return
        try:
            if self._opened:
                self.write_pending()
                self.log_document("end", {"steps": len(self.steps), **facts, "checksums": self._writer.checksums})
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

    # ---- parts of a step ----

    def _need_open(self) -> None:
        if self._closed or not self._opened:
            raise ValueError("the recording is closed" if self._opened else "call open() before logging")

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


def _described_body(
    name: str, vertices: ArrayLike, faces: ArrayLike
) -> tuple[str, NDArray[np.float32], NDArray[np.int32]]:
    """Checked name, vertices and faces."""
    points = as_points(vertices, f"vertices of body '{name}'").astype(np.float32)
    return str(name), points, as_faces(faces, len(points), f"faces of body '{name}'")


_Bodies = list[tuple[str, ArrayLike, ArrayLike]]


def _bodies_now(simulation: Any) -> tuple[_Bodies, _Bodies]:
    """(name, vertices, faces) of the bodies that move, where they are now, and of those that stand still; those of a scene
    that share a name are numbered."""
    if hasattr(simulation, "body_meshes"):
        return list(simulation.body_meshes), []
    moving: _Bodies = []
    still: _Bodies = []
    for body in getattr(getattr(simulation, "scene", None), "bodies", ()):
        name, count = str(body.name), 1
        while name in [n for n, _, _ in (*moving, *still)]:
            count += 1
            name = f"{body.name} {count}"
        motion = getattr(body, "motion", None)
        if motion is None:
            still.append((name, body.mesh.vertices, body.mesh.faces))
        else:
            moving.append((name, motion.at(simulation.time), body.mesh.faces))
    return moving, still


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
