"""The only door to numba: compiled kernels with a cache that cannot go stale.

Measured on numba 0.68: `cache=True` keeps serving the old machine code of a caller after only the file of its
callee was edited, and it ignores `boundscheck` when the cache is warm. Both are cured here by one rule: the cache
lives in a folder that is named by a digest of *all* kernel sources and flags, so any edit starts a new folder.

Environment variables
    CLOTHGYM_CACHE_DIR    where compiled kernels are kept (default: the user's cache folder)
    CLOTHGYM_BOUNDSCHECK  1 = compile with bounds checks (slow, for debugging)
"""

from __future__ import annotations

import hashlib
import operator
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.extending import intrinsic, models, overload, register_model

_numba_config: Any = config

_KEPT_DIGESTS = 8
_KEPT_DAYS = 14
"""Caches of this many source versions are kept, and all younger ones: other checkouts share the folder."""

bounds_check = os.environ.get("CLOTHGYM_BOUNDSCHECK", "0") == "1"
flags: dict[str, Any] = {"error_model": "numpy", "boundscheck": bounds_check, "nogil": True}


def _cache_root() -> Path:
    """Folder that holds the caches of all digests; falls back to the temporary folder when it cannot be written."""
    named = os.environ.get("CLOTHGYM_CACHE_DIR")
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    wanted = Path(named) if named else base / "clothgym" / "kernels"
    try:
        wanted.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=wanted):
            pass
    except OSError:
        wanted = Path(tempfile.gettempdir()) / f"clothgym-kernels-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
        wanted.mkdir(parents=True, exist_ok=True)
    return wanted


def _digest() -> str:
    """Digest of every kernel source, this file, the flags and the versions that decide the machine code."""
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for source in [Path(__file__), *sorted((package / "kernels").glob("*.py"))]:
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    digest.update(repr((sorted(flags.items()), numba.__version__, sys.version_info[:3], str(package))).encode())
    return digest.hexdigest()[:16]


def _prune(root: Path, current: str) -> None:
    """Removes the caches of old source versions, oldest first."""
    folders = [f for f in root.iterdir() if f.is_dir() and len(f.name) == 16 and f.name != current]
    folders.sort(key=lambda f: f.stat().st_mtime, reverse=True)
    for folder in folders[_KEPT_DIGESTS - 1 :]:
        if time.time() - folder.stat().st_mtime > _KEPT_DAYS * 86_400:
            shutil.rmtree(folder, ignore_errors=True)


cache_root = _cache_root()
digest = _digest()
cache_folder = cache_root / digest
if not cache_folder.exists():
    cache_folder.mkdir(parents=True, exist_ok=True)
    _prune(cache_root, digest)

kernels: list[Any] = []
"""Every kernel of the library, in order of definition (for `clothgym warmup` and `doctor`)."""


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles a function on bare arrays at its first call and keeps the machine code on disk."""
    previous = _numba_config.CACHE_DIR
    _numba_config.CACHE_DIR = str(cache_folder)  # read by numba when the decorator runs
    try:
        compiled = numba.njit(cache=True, **flags)(function)
    finally:
        _numba_config.CACHE_DIR = previous
    kernels.append(compiled)
    return compiled


def device(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles a small function that only kernels call: part of its callers' machine code, never cached on its own."""
    return numba.njit(**flags)(function)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same for what is called in the innermost loops: put into its callers before they are compiled.

    A call counts references to every array that it hands over, or that is in a tuple that it hands over: some 5 ns each.
    """
    return numba.njit(inline="always", **flags)(function)


def bare(function: Callable[..., Any]) -> Callable[..., Any]:
    """A `device` that allocates nothing and counts no references to the arrays in structures that it is given: counting
    takes longer than looking into a few of them."""
    options: dict[str, Any] = {**flags, "_nrt": False}
    return numba.njit(**options)(function)


def spread(function: Callable[..., Any]) -> Callable[..., Any]:
    """A `bare` that is put into every caller: what it is given in structures is handed over number by number, which takes
    longer than a short function does."""
    options: dict[str, Any] = {**flags, "_nrt": False, "forceinline": True}
    return numba.njit(**options)(function)


def compiled_count() -> tuple[int, int]:
    """How many kernels have machine code in this process, and how many there are."""
    return sum(1 for k in kernels if k.signatures), len(kernels)


# Sixteen numbers at once


class _Lanes(types.Type):
    """Sixteen float32, float64, int32 or truth values that a kernel holds in vector registers.

    A loop over 16 numbers becomes vector instructions too, but not the bit mask of its outcomes, and no vector stays in its
    register from one such loop to the next. Arithmetic is that of the loop, to the last bit.
    """

    def __init__(self, number: types.Type) -> None:
        self.number = number
        super().__init__(name=f"Lanes({number})")


_LANES = 16
_FLOATS, _DOUBLES, _INTS = _Lanes(types.float32), _Lanes(types.float64), _Lanes(types.int32)
_TRUTHS = _Lanes(types.boolean)
_KIND = {types.float32: _FLOATS, types.float64: _DOUBLES, types.int32: _INTS}
_VECTOR = {
    _FLOATS: ir.VectorType(ir.FloatType(), _LANES),
    _DOUBLES: ir.VectorType(ir.DoubleType(), _LANES),
    _INTS: ir.VectorType(ir.IntType(32), _LANES),
    _TRUTHS: ir.VectorType(ir.IntType(1), _LANES),
}


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR[fe_type])


def _first_lane(context: Any, builder: Any, array: Any, value: Any, ids: list[Any]) -> Any:
    """Pointer to 16 numbers of an array that begin at these ids."""
    view = context.make_array(array)(context, builder, value)
    first = cgutils.get_item_pointer(context, builder, array, view, ids, wraparound=False)
    return builder.bitcast(first, _VECTOR[_KIND[array.dtype]].as_pointer())


@intrinsic
def lanes(typingctx: Any, array: Any, block: Any, row: Any) -> Any:
    """The 16 numbers array[block, row, :] of a C-contiguous array of float32, float64 or int32; ids must not be negative."""
    kind = _KIND[array.dtype]

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        ids = [context.cast(builder, v, t, types.intp) for v, t in zip(values[1:], signature.args[1:], strict=True)]
        ids.append(context.get_constant(types.intp, 0))
        loaded = builder.load(_first_lane(context, builder, signature.args[0], values[0], ids))
        loaded.align = 4
        return loaded

    return kind(array, block, row), generate


@intrinsic
def lanes_from(typingctx: Any, array: Any, first: Any) -> Any:
    """The 16 numbers array[first : first + 16] of a contiguous row."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        at = [context.cast(builder, values[1], signature.args[1], types.intp)]
        loaded = builder.load(_first_lane(context, builder, signature.args[0], values[0], at))
        loaded.align = 4
        return loaded

    return _KIND[array.dtype](array, first), generate


@intrinsic
def put_lanes(typingctx: Any, array: Any, first: Any, vector: Any) -> Any:
    """array[first : first + 16] = vector, in a contiguous row of numbers of its kind."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        at = [context.cast(builder, values[1], signature.args[1], types.intp)]
        builder.store(values[2], _first_lane(context, builder, signature.args[0], values[0], at), align=4)
        return context.get_dummy_value()

    return types.void(array, first, vector), generate


def _of_two(instruction: Callable[..., Any], answer: _Lanes | None = None) -> Callable[..., Any]:
    """A function of two vectors, or of a vector and a number that stands in all lanes."""

    @intrinsic
    def function(typingctx: Any, a: Any, b: Any) -> Any:
        kind = a if isinstance(a, _Lanes) else b

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            both = []
            for value, given in zip(values, signature.args, strict=True):
                if not isinstance(given, _Lanes):
                    nothing = ir.Constant(_VECTOR[kind], ir.Undefined)
                    one = builder.insert_element(
                        nothing, context.cast(builder, value, given, kind.number), ir.Constant(ir.IntType(32), 0)
                    )
                    zeros = ir.Constant(ir.VectorType(ir.IntType(32), _LANES), [0] * _LANES)
                    value = builder.shuffle_vector(one, nothing, zeros)
                both.append(value)
            return instruction(builder, kind, *both)

        return (answer or kind)(a, b), generate

    return function


def _compared(sign: str) -> Callable[..., Any]:
    def instruction(builder: Any, kind: Any, a: Any, b: Any) -> Any:
        return (builder.icmp_signed if kind is _INTS else builder.fcmp_ordered)(sign, a, b)

    return instruction


def _chosen(sign: str) -> Callable[..., Any]:
    return lambda builder, kind, a, b: builder.select(builder.fcmp_ordered(sign, a, b), a, b)


lower = _of_two(_chosen("<"))
"""The lower of two in each lane."""
upper = _of_two(_chosen(">"))
"""The higher of two in each lane."""

_OPERATORS = {
    operator.add: _of_two(lambda builder, kind, a, b: builder.fadd(a, b)),
    operator.sub: _of_two(lambda builder, kind, a, b: builder.fsub(a, b)),
    operator.mul: _of_two(lambda builder, kind, a, b: builder.fmul(a, b)),
    operator.and_: _of_two(lambda builder, kind, a, b: builder.and_(a, b)),
    operator.or_: _of_two(lambda builder, kind, a, b: builder.or_(a, b)),
    operator.gt: _of_two(_compared(">"), _TRUTHS),
    operator.ge: _of_two(_compared(">="), _TRUTHS),
    operator.le: _of_two(_compared("<="), _TRUTHS),
    operator.ne: _of_two(_compared("!="), _TRUTHS),  # of whole numbers
}


def _teach(symbol: Callable[..., Any], function: Callable[..., Any]) -> None:
    @overload(symbol)
    def choose(a, b):  # type: ignore[no-untyped-def]  # numba compares the signatures
        if isinstance(a, _Lanes) or isinstance(b, _Lanes):
            return lambda a, b: function(a, b)
        return None


for _symbol, _function in _OPERATORS.items():
    _teach(_symbol, _function)


def _folded(instruction: Callable[..., Any]) -> Callable[..., Any]:
    """A number from a vector, whose halves are put together again and again."""

    @intrinsic
    def function(typingctx: Any, vector: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            found, count = values[0], _LANES
            while count > 1:
                count //= 2
                nothing = ir.Constant(found.type, ir.Undefined)
                halves = [
                    builder.shuffle_vector(
                        found, nothing, ir.Constant(ir.VectorType(ir.IntType(32), count), list(range(at, at + count)))
                    )
                    for at in (0, count)
                ]
                found = instruction(builder, signature.args[0], *halves)
            return builder.extract_element(found, ir.Constant(ir.IntType(32), 0))

        return vector.number(vector), generate

    return function


lowest = _folded(_chosen("<"))
"""The lowest of all lanes."""
highest = _folded(_chosen(">"))
"""The highest of all lanes."""
total = _folded(lambda builder, kind, a, b: builder.fadd(a, b))
"""The sum of all lanes."""


@intrinsic
def bits(typingctx: Any, truths: Any) -> Any:
    """The mask of those lanes that are true: bit n stands for lane n."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.zext(builder.bitcast(values[0], ir.IntType(_LANES)), ir.IntType(64))

    return types.uint64(truths), generate


@intrinsic
def lowest_bit(typingctx: Any, mask: Any) -> Any:
    """Position of the lowest set bit of a uint64 that is not 0."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.cttz(values[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), generate
