"""A recording's file as a table of arrow columns; whole or partial, verified, checksums compared.

A recording may come from anyone, so nothing in it is trusted: rerun's own verifier looks at the file first, in a process
of its own (measured on rerun 0.41: a flipped bit in a length can end the reading process, and flipped payload bits are
read without a word; checksums of every column in the `end` document catch the latter).
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.recording.rerun_viewer import RERUN_CLI


@contextmanager
def whole_messages(file: Path, partial: bool) -> Iterator[Path]:
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


def verify(readable: Path, file: Path, partial: bool) -> None:
    """Runs rerun's verifier in a child process, which a malformed file may well bring down."""
    command = [*RERUN_CLI, "rrd", "verify", str(readable.resolve())]
    command += ["--check-footers=false"] if partial else []
    environment = {**os.environ, "RERUN_APP_ONLY": "true"}
    ended = subprocess.run(command, capture_output=True, text=True, errors="replace", env=environment, check=False)
    if ended.returncode:
        lines = [line for line in ended.stderr.splitlines() if line.strip() and line[0] != " "]
        footer = any("footer" in line for line in lines)
        reason = "cut short (it has no footer)" if footer and not partial else "corrupted (rerun cannot verify it)"
        raise ValueError(f"{file}: {reason}")


class Column(NamedTuple):
    """One component of one entity: an arrow list column with one list a row, sorted by step."""

    static: bool
    steps: NDArray[np.int64]
    nanoseconds: NDArray[np.int64]
    lists: Any


Table = dict[str, dict[str, Column]]
"""Entity -> component -> column."""


def read_chunks(file: Path) -> tuple[str, bool, Table]:
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
        pieces: dict[tuple[str, str], list[Column]] = {}
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
                    piece = Column(chunk.is_static, steps, times, lists)
                    pieces.setdefault((str(chunk.entity_path), name), []).append(piece)
    table: Table = {}
    for (entity, name), parts in pieces.items():
        table.setdefault(entity, {})[name] = _join(entity, parts)
    return str(stores[0].application_id), has_blueprint, table


def _join(entity: str, parts: list[Column]) -> Column:
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
    return Column(False, steps, times, lists)


def check_sums(table: Table, end: dict[str, Any]) -> None:
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


def flat(column: Any, width: int) -> NDArray[Any]:
    """The values of a list column as numpy: (n,) for width 1, else (n, width)."""
    import pyarrow as pa

    values = column
    while pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type):
        values = values.flatten()
    array = values.to_numpy(zero_copy_only=False)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"corrupted: numbers expected, found {array.dtype}")
    return array if width == 1 else array.reshape(-1, width)
