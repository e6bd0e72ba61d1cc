"""Where a number came from: machine, versions, commit; and which extra brings a module that is missing."""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from types import ModuleType
from typing import Any

from clothgym.errors import MissingExtraError

MODULE_EXTRAS = {
    "stable_baselines3": "rl",
    "torch": "rl",
    "tensorboard": "rl",
    "tqdm": "rl",
    "rerun": "rerun",
    "moviepy": "video",
    "pygame": "human",
    "ray": "cluster",
    "ezdxf": "dxf",
    "matplotlib": "plot",
}
"""Module that a user may lack -> extra of the package that brings it."""

SINGLE_THREAD = {
    name: "1"
    for name in (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "BLIS_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "NUMBA_NUM_THREADS",
    )
}
"""Environment of a worker: parallelism is over cases, never inside one."""


def install_command(extra: str) -> str:
    """The command that installs an extra, quoted for a shell."""
    return f'pip install "clothgym[{extra}]"'


def missing_extra_line(error: ImportError) -> str | None:
    """One line that names the extra and its command when the import failed for want of one, else None."""
    if "clothgym[" in str(error):
        return str(error)
    module = (error.name or "").partition(".")[0]
    extra = MODULE_EXTRAS.get(module) if isinstance(error, ModuleNotFoundError) else None
    return None if extra is None else str(MissingExtraError(module, extra))


def need(module: str) -> ModuleType:
    """Imports a module of an extra.

    Raises:
        MissingExtraError: it is not installed; names the command that installs the extra.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in MODULE_EXTRAS:
            raise
        raise MissingExtraError(missing, MODULE_EXTRAS[missing]) from error


def pyplot() -> ModuleType:
    """matplotlib.pyplot with the file backend, for the plots of a benchmark.

    Raises:
        MissingExtraError: the extra `plot` is not installed.
    """
    need("matplotlib").use("Agg")
    return importlib.import_module("matplotlib.pyplot")


def version_of(distribution: str) -> str | None:
    """Installed version of a distribution, or None."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, value = line.partition(":")
            if name.strip() in ("model name", "Hardware", "cpu model"):
                return value.strip()
    except OSError:
        pass
    if platform.system() == "Darwin":
        return _output(["sysctl", "-n", "machdep.cpu.brand_string"]) or platform.machine()
    return platform.processor() or platform.machine() or "unknown"


def _memory_gb() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _output(command: list[str]) -> str | None:
    """Standard output of a command, stripped; None when it fails or does not exist."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


@functools.cache
def machine() -> dict[str, Any]:
    """CPU model, cores (usable by this process, and all), memory [GB] and operating system."""
    return {
        "cpu": _cpu_model(),
        "cores": usable_cores(),
        "cores_total": os.cpu_count() or 1,
        "ram_gb": _memory_gb(),
        "os": f"{platform.system()} {platform.release()} {platform.machine()}",
    }


@functools.cache
def versions() -> dict[str, Any]:
    """Versions that decide a number; None for what is not installed as a distribution."""
    names = ("clothgym", "numpy", "numba", "scipy", "trimesh", "gymnasium")
    return {"python": platform.python_version()} | {name: version_of(name) for name in names}


@functools.cache
def commit() -> str | None:
    """Commit of the checkout that this code runs from (`-dirty` when edited); None for an installed copy.

    An installed copy may lie inside somebody else's repository (a virtual environment in a project folder), so the
    answer counts only when git tracks this very file.
    """
    here = Path(__file__)
    git = ["git", "--no-optional-locks", "-C", str(here.parent)]
    if _output([*git, "ls-files", "--error-unmatch", here.name]) is None:
        return None
    return _output([*git, "describe", "--always", "--dirty", "--abbrev=40", "--exclude", "*"])


def provenance() -> dict[str, Any]:
    """The fields `machine`, `versions` and `commit` of a row."""
    return {"machine": dict(machine()), "versions": dict(versions()), "commit": commit()}
