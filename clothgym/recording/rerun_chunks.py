"""Rows of recorded entities on their way to a rerun stream: batches, arrow columns, checksums, what never changes."""

from __future__ import annotations

import json
import time
import warnings
import zlib
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.kernels import raster
from clothgym.recording.rerun_table import column_checksum

Rows = list[tuple[str, dict[str, NDArray[Any]]]]
"""Entity and its values at one step."""

_BATCH_BYTES = 4_000_000
_BATCH_SECONDS = 1.0
_CONTOUR_COLOURS = np.array(
    [(235, 52, 52), (255, 190, 30), (60, 220, 90), (70, 160, 255), (230, 90, 230), (40, 225, 225), (255, 120, 40)],
    dtype=np.uint8,
)


def normals(positions: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """(V, 3) vertex normals: the viewer draws a mesh without them flat and unshaded."""
    found = np.empty(positions.shape)
    raster.vertex_normals(positions.astype(np.float64), faces, found)
    return found.astype(np.float32)


class ChunkWriter:
    """Sends rows to a stream in batches, and keeps a checksum of every column.

    Args:
        rerun: the package.
        stream: a RecordingStream.
        batch_steps: at most this many steps wait in memory.
        forgiving: a stream that no longer takes anything (a closed live viewer) is a warning, no error.

    Attributes:
        checksums: "/entity|component" -> running checksums, as `column_checksum` makes them.
    """

    def __init__(self, rerun: ModuleType, stream: Any, batch_steps: int, forgiving: bool) -> None:
        self.checksums: dict[str, list[int]] = {}
        self._rerun = rerun
        self._stream = stream
        self._batch_steps = batch_steps
        self._forgiving = forgiving
        self._rows: dict[str, list[tuple[int, int, dict[str, NDArray[Any]]]]] = {}
        self._pending = 0
        self._pending_bytes = 0
        self._last_write = time.monotonic()
        self._styled: set[str] = set()
        self._lost_viewer = False

    # ---- what never changes ----

    def static(self, entity: str, archetype: Any) -> None:
        """Logs something once and for all."""
        self._stream.log(entity, archetype, static=True, strict=True)

    def document(self, entity: str, document: Mapping[str, Any]) -> None:
        """A JSON document, on disk at once."""
        text = json.dumps(document, allow_nan=False)
        self.static(entity, self._rerun.TextDocument(text, media_type="text/plain"))
        self.checksums[f"/{entity}|TextDocument:text"] = [zlib.crc32(text.encode())]
        self.flush()

    def mesh(
        self,
        entity: str,
        faces: NDArray[np.int32],
        colour: Sequence[int],
        vertices: NDArray[np.float32] | None = None,
    ) -> None:
        """Faces (F, 3) and colour (red, green, blue) of a mesh; its vertices (V, 3) [m] too when it never moves."""
        fields: dict[str, NDArray[Any]] = {"triangle_indices": faces.astype(np.uint32)}
        if vertices is not None:
            fields |= {"vertex_positions": vertices, "vertex_normals": normals(vertices, faces)}
        self.static(entity, self._rerun.Mesh3D.from_fields(**fields, albedo_factor=[*colour[:3], 255]))
        for name, values in fields.items():
            self.checksums[f"/{entity}|Mesh3D:{name}"] = [
                zlib.crc32(np.array([len(values)], dtype="<i8").tobytes()),
                zlib.crc32(values.tobytes()),
            ]

    # ---- steps ----

    def keep(self, at: tuple[int, int], rows: Rows) -> None:
        """Takes copies of one step's rows at (step, nanoseconds), to be written with the batch."""
        for entity, fields in rows:
            self._rows.setdefault(entity, []).append((*at, {name: values.copy() for name, values in fields.items()}))
            self._pending_bytes += sum(values.nbytes for values in fields.values())
        self._pending += 1

    def write_when_due(self) -> None:
        """Writes the batch when it is full or late."""
        late = time.monotonic() - self._last_write > _BATCH_SECONDS
        if self._pending >= self._batch_steps or self._pending_bytes >= _BATCH_BYTES or late:
            self.write_pending()

    def write_pending(self) -> None:
        """Writes every finished step to disk."""
        for entity, rows in self._rows.items():
            self.send(entity, rows)
        self._rows.clear()
        self._pending = self._pending_bytes = 0
        self._last_write = time.monotonic()
        self.flush()

    def send(self, entity: str, rows: list[tuple[int, int, dict[str, NDArray[Any]]]]) -> None:
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
            before = self.checksums.get(key, ())
            sums = column_checksum(column.as_arrow_array(), before[:-2])
            stamps = (steps.tobytes(), nanoseconds.tobytes())
            self.checksums[key] = sums + [zlib.crc32(d, c) for d, c in zip(stamps, before[-2:] or (0, 0))]
        if entity not in self._styled:
            self._styled.add(entity)
            self._style(entity, fields)
        self._stream.send_columns(entity, times, columns, strict=True)

    def _style(self, entity: str, fields: Mapping[str, Any]) -> None:
        """Sizes and colours that never change, once per entity."""
        rr = self._rerun
        if "segments" in fields:
            self.static(entity, rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(3.0)))
        elif entity == "world/hits":
            style = rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.0), colors=(255, 255, 255))
            self.static(entity, style)
        elif "points" in fields:
            self.static(entity, rr.Points3D.from_fields(radii=0.01, colors=(255, 220, 60)))

    def flush(self) -> None:
        """Waits until what was sent is on disk."""
        try:
            self._stream.flush(timeout_sec=10.0 if self._forgiving else 1e9)
        except Exception as error:
            if not self._forgiving:
                raise
            if not self._lost_viewer:
                warnings.warn(f"the live viewer no longer answers: {error}", RuntimeWarning, stacklevel=2)
            self._lost_viewer = True


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
