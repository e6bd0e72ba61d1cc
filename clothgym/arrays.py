"""Array aliases and the checks at the public border: shape, type, finiteness, each with one clear line."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]
BoolArray = NDArray[np.bool_]

FARTHEST = 1e9
"""Coordinates of a scene end here [m]: beyond, neighbouring float64 are further apart than the least thickness."""
SQUARABLE = 1e150
"""Coordinates of meshes that are only looked at end here: squares of larger ones overflow."""
LEAST_EDGE = 1e-9
"""Cloth with a smaller mean edge [m] is refused; from here to `FARTHEST` no square of a strain overflows."""


def shown(value: Any) -> str:
    """A value as an error line shows it: short, whatever it is."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # Python writes no integer of more than 4300 digits
        return f"an integer of {value.bit_length()} bits" if isinstance(value, int) else type(value).__name__
    return text if len(text) <= 60 else f"{text[:57]}..."


def as_floats(values: Any, name: str) -> FloatArray:
    """Real numbers as float64, C-contiguous; text, complex numbers, None and ragged lists are refused."""
    try:
        raw = np.asarray(values)
        if raw.dtype.kind == "O":  # integers beyond 64 bits among others
            return np.ascontiguousarray(raw, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raw = np.empty(0, np.str_)
    if raw.dtype.kind not in "biuf":
        raise ValueError(f"{name} = {shown(values)}: expected numbers")
    return np.ascontiguousarray(raw, dtype=np.float64)


def as_points(values: ArrayLike, name: str = "vertices", count: int | None = None, limit: float = np.inf) -> FloatArray:
    """Finite (N, 3) float64 array, C-contiguous; copies only when it must.

    Raises:
        ValueError: no numbers, wrong shape, or the first entry that is not finite or beyond +-limit, by index.
    """
    points = as_floats(values, name)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name}: expected shape (N, 3), got {points.shape}")
    if count is not None and len(points) != count:
        raise ValueError(f"{name}: expected {count} rows, got {len(points)}")
    finite = np.isfinite(points)
    if not finite.all():
        row, column = (int(i) for i in np.argwhere(~finite)[0])
        raise ValueError(f"{name}[{row}, {column}] is {points[row, column]}: every coordinate must be finite")
    if limit < np.inf and (np.abs(points) > limit).any():
        row, column = (int(i) for i in np.argwhere(np.abs(points) > limit)[0])
        raise ValueError(f"{name}[{row}, {column}] = {points[row, column]:g}: out of range [{-limit:g}, {limit:g}]")
    return points


def as_vector(values: ArrayLike, name: str, limit: float = np.inf) -> FloatArray:
    """Three finite numbers within +-limit, (3,) float64; refuses the rest as `as_points` does."""
    vector = as_floats(values, name)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} = {shown(values)}: expected three finite numbers")
    if (np.abs(vector) > limit).any():
        raise ValueError(f"{name} = {shown(values)}: out of range [{-limit:g}, {limit:g}]")
    return vector


def as_ids(values: ArrayLike, name: str, count: int) -> IntArray:
    """Vertex ids below `count` as (N,) int32.

    Raises:
        ValueError: no integers, or the first id out of range, by index.
    """
    try:
        raw = np.atleast_1d(np.asarray(values))
    except ValueError:  # ragged
        raw = np.empty(1, object)
    if raw.size == 0:
        return np.zeros(0, np.int32)
    if raw.ndim != 1 or raw.dtype.kind not in "iu":
        raise ValueError(f"{name} = {shown(values)}: expected a list of vertex ids")
    wrong = np.flatnonzero((raw < 0) | (raw >= count))
    if len(wrong):
        raise ValueError(f"{name}[{wrong[0]}] is {raw[wrong[0]]}: ids must be below {count}")
    return np.ascontiguousarray(raw, np.int32)


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
    whole = not integer or not isinstance(value, float | np.floating) or float(value).is_integer()
    if not is_number or not whole:
        raise ValueError(f"{name} = {shown(value)}: expected {kind} in [{low:g}, {high:g}]")
    if not low <= value <= high:
        raise ValueError(f"{name} = {shown(value)}: out of range [{low:g}, {high:g}]")
    return int(value) if integer else float(value)


def check_flag(value: Any, name: str) -> bool:
    """True or False.

    Raises:
        ValueError: names the field and the value.
    """
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} = {shown(value)}: expected True or False")
    return bool(value)


def check_text(value: Any, name: str) -> str:
    """A string.

    Raises:
        ValueError: names the field and the value.
    """
    if not isinstance(value, str):
        raise ValueError(f"{name} = {shown(value)}: expected text")
    return str(value)


def check_each(values: Any, name: str, kind: type) -> tuple[Any, ...]:
    """A sequence whose members are all of one type, as a tuple.

    Raises:
        ValueError: names the field, the index and what is there.
    """
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise ValueError(f"{name} = {shown(values)}: expected a list of {kind.__name__}")
    try:
        members = tuple(values)
    except TypeError:  # an array without dimensions says that it can be walked
        raise ValueError(f"{name} = {shown(values)}: expected a list of {kind.__name__}") from None
    for number, member in enumerate(members):
        if not isinstance(member, kind):
            raise ValueError(f"{name}[{number}] = {type(member).__name__}: expected a {kind.__name__}")
    return members


def check_choice(value: Any, name: str, choices: tuple[str, ...]) -> str:
    """One of the given names.

    Raises:
        ValueError: names the field, the value and the choices.
    """
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} = {shown(value)}: expected one of {', '.join(choices)}")
    return str(value)


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """A view that cannot be written."""
    view = array.view()
    view.flags.writeable = False
    return view
