"""Array aliases and the checks at the public border: shape, type, finiteness, each with one clear line."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]
BoolArray = NDArray[np.bool_]


def as_points(values: ArrayLike, name: str = "vertices", count: int | None = None) -> FloatArray:
    """Finite (N, 3) float64 array, C-contiguous; copies only when it must.

    Raises:
        ValueError: wrong shape, or the first entry that is not finite, by index.
    """
    points = np.ascontiguousarray(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name}: expected shape (N, 3), got {points.shape}")
    if count is not None and len(points) != count:
        raise ValueError(f"{name}: expected {count} rows, got {len(points)}")
    finite = np.isfinite(points)
    if not finite.all():
        row, column = (int(i) for i in np.argwhere(~finite)[0])
        raise ValueError(f"{name}[{row}, {column}] is {points[row, column]}: every coordinate must be finite")
    return points


def as_faces(values: ArrayLike, vertex_count: int | None = None, name: str = "faces") -> IntArray:
    """(F, 3) int32 array of vertex ids, C-contiguous.

    Raises:
        ValueError: wrong shape, ids that are no integers, or the first id out of range, by index.
    """
    raw = np.asarray(values)
    if raw.size == 0:
        raw = raw.reshape(0, 3).astype(np.int32)
    if raw.ndim != 2 or raw.shape[1] != 3:
        raise ValueError(f"{name}: expected shape (F, 3), got {raw.shape}")
    if not np.issubdtype(raw.dtype, np.integer):
        raise ValueError(f"{name}: vertex ids must be integers, got {raw.dtype}")
    bad = raw < 0 if vertex_count is None else (raw < 0) | (raw >= vertex_count)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        limit = "" if vertex_count is None else f" of {vertex_count} vertices"
        raise ValueError(f"{name}[{row}, {column}] is {int(raw[row, column])}: no such vertex id{limit}")
    return np.ascontiguousarray(raw, dtype=np.int32)


def check_number(value: Any, name: str, low: float, high: float, integer: bool = False) -> float | int:
    """A finite number within [low, high].

    Raises:
        ValueError: names the field, the value and the range.
    """
    kind = "an integer" if integer else "a number"
    is_number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not is_number or (integer and not (np.isfinite(value) and int(value) == value)):
        raise ValueError(f"{name} = {value!r}: expected {kind} in [{low:g}, {high:g}]")
    if not low <= value <= high:
        raise ValueError(f"{name} = {value!r}: out of range [{low:g}, {high:g}]")
    return int(value) if integer else float(value)


def check_choice(value: Any, name: str, choices: tuple[str, ...]) -> str:
    """One of the given names.

    Raises:
        ValueError: names the field, the value and the choices.
    """
    if value not in choices:
        raise ValueError(f"{name} = {value!r}: expected one of {', '.join(choices)}")
    return str(value)


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """A view that cannot be written."""
    view = array.view()
    view.flags.writeable = False
    return view
