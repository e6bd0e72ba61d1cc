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
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import config

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


def bare(function: Callable[..., Any]) -> Callable[..., Any]:
    """A `device` that allocates nothing and counts no references to the arrays in structures that it is given: counting
    takes longer than looking into a few of them."""
    options: dict[str, Any] = {**flags, "_nrt": False}
    return numba.njit(**options)(function)


def compiled_count() -> tuple[int, int]:
    """How many kernels have machine code in this process, and how many there are."""
    return sum(1 for k in kernels if k.signatures), len(kernels)
