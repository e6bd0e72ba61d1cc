"""`clothgym doctor`: what is installed, what is missing and the command that brings it, cache and threads."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import typer

from clothgym.benchmarks.machine import SINGLE_THREAD, install_command, machine, version_of
from clothgym.benchmarks.report import Table
from clothgym.commands import JsonOption, answer


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("doctor", help=_HELP)(doctor)


_HELP = """Reports versions, extras, kernel cache and threads, and what is missing with the command that installs it.

Exit code: 0 ready, 1 something needed is missing or cannot be written.
"""

_REQUIREMENT = re.compile(r"^\s*([A-Za-z0-9][A-Za-z0-9._-]*)")
_LOWER_BOUND = re.compile(r">=\s*([0-9][0-9.]*)")
_UPPER_BOUND = re.compile(r"<\s*([0-9][0-9.]*)")
_EXTRA = re.compile(r"""extra\s*==\s*['"]([^'"]+)['"]""")


def doctor(as_json: JsonOption = False) -> None:
    requirements = _requirements()
    packages = [_package(text) for text in requirements if _EXTRA.search(text) is None]
    extras = _extras(requirements)
    cache = _cache()
    problems = _problems(packages, cache)
    where = machine()
    threads = {name: os.environ[name] for name in SINGLE_THREAD if name in os.environ}
    python = {
        "python": platform.python_version(),
        "executable": sys.executable,
        "clothgym": version_of("clothgym"),
        "installed_from": str(Path(__file__).resolve().parents[1]),
    }
    verdict = f"not ready: {problems[0]}" if problems else _ready(extras, cache)
    document = {
        "ready": not problems,
        "verdict": verdict,
        "problems": problems,
        "python": python,
        "machine": where,
        "threads": {"cores": where["cores"], "environment": threads},
        "packages": packages,
        "extras": extras,
        "cache": cache,
    }
    answer(document, _tables(document), as_json)
    if not as_json:
        print(verdict)
    if problems:
        raise typer.Exit(1)


def _requirements() -> list[str]:
    """Requirement lines of the installed package; empty when it is not installed."""
    try:
        return importlib.metadata.requires("clothgym") or []
    except importlib.metadata.PackageNotFoundError:
        return []


def _numbers(version: str) -> tuple[int, ...]:
    """Leading release numbers of a version ("2.13.0+cpu" -> 2, 13, 0), without trailing zeros."""
    release = re.match(r"[0-9]+(?:\.[0-9]+)*", version)
    numbers = [int(part) for part in release.group().split(".")] if release else []
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)


def _package(requirement: str) -> dict[str, Any]:
    """Name, installed version, what is asked for, and whether they agree."""
    head = requirement.partition(";")[0]
    match = _REQUIREMENT.match(head)
    name = match.group(1) if match else head.strip()
    wanted = re.sub(r"\[[^\]]*\]", "", head[len(name) :]).strip(" ()")
    found = version_of(name)
    low, high = _LOWER_BOUND.search(wanted), _UPPER_BOUND.search(wanted)
    fits = found is not None
    if found is not None and low is not None:
        fits = fits and _numbers(found) >= _numbers(low.group(1))
    if found is not None and high is not None:
        fits = fits and _numbers(found) < _numbers(high.group(1))
    return {"name": name, "version": found, "wanted": wanted, "fits": fits}


def _extras(requirements: list[str]) -> list[dict[str, Any]]:
    """Every extra with its packages; `all`, which gathers the others, is left out."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for text in requirements:
        extra = _EXTRA.search(text)
        package = _package(text)
        if extra is not None and extra.group(1) != "all" and package["name"] != "clothgym":
            groups.setdefault(extra.group(1), []).append(package)
    found = []
    for name, packages in groups.items():
        missing = [package["name"] for package in packages if not package["fits"]]
        install = install_command(name) if missing else None
        found.append({"name": name, "packages": packages, "missing": missing, "install": install})
    return found


def _cache() -> dict[str, Any]:
    """Folder of the compiled kernels, its size [MB], how many kernels it holds, and whether it can be written."""
    from clothgym import _jit

    folder = _jit.cache_folder
    files = [path for path in folder.rglob("*") if path.is_file()]
    try:
        with tempfile.TemporaryFile(dir=folder):
            writable = True
    except OSError:
        writable = False
    return {
        "folder": str(folder),
        "size_mb": round(sum(path.stat().st_size for path in files) / 1e6, 2),
        "kernels": sum(path.suffix == ".nbi" for path in files),
        "writable": writable,
        "lasting": not folder.is_relative_to(tempfile.gettempdir()) or bool(os.environ.get("CLOTHGYM_CACHE_DIR")),
        "bounds_check": _jit.bounds_check,
    }


def _problems(packages: list[dict[str, Any]], cache: dict[str, Any]) -> list[str]:
    """What stands in the way of work, one line each with the cure."""
    problems = []
    if version_of("clothgym") is None:
        problems.append("clothgym is not installed: 'pip install -e .' in the checkout")
    for package in packages:
        if not package["fits"]:
            state = f"{package['version']} is installed" if package["version"] else "is missing"
            name, wanted = package["name"], package["wanted"]
            problems.append(f"{name} {state}, wanted {wanted or 'any'}: pip install '{name}{wanted}'")
    if not cache["writable"]:
        problems.append(f"the kernel cache {cache['folder']} cannot be written: set CLOTHGYM_CACHE_DIR")
    return problems


def _ready(extras: list[dict[str, Any]], cache: dict[str, Any]) -> str:
    missing = [extra["name"] for extra in extras if extra["missing"] and extra["name"] != "dev"]
    hints = []
    if missing:
        hints.append(f"for more: {install_command(','.join(missing))}")
    if cache["kernels"] == 0:
        hints.append("compile the kernels now: clothgym warmup")
    if not cache["lasting"]:
        hints.append("the kernel cache is in the temporary folder: set CLOTHGYM_CACHE_DIR")
    return "; ".join(["ready", *hints])


def _tables(document: dict[str, Any]) -> list[Table]:
    where, cache = document["machine"], document["cache"]
    threads = ", ".join(f"{name}={value}" for name, value in document["threads"]["environment"].items())
    facts = [
        ("clothgym", document["python"]["clothgym"]),
        ("python", f"{document['python']['python']} ({document['python']['executable']})"),
        ("package folder", document["python"]["installed_from"]),
        ("machine", f"{where['cpu']}, {where['ram_gb']} GB, {where['os']}"),
        ("cores", f"{where['cores']} of {where['cores_total']} usable" + (f"; {threads}" if threads else "")),
        ("kernel cache", f"{cache['folder']}{'' if cache['writable'] else ' (cannot be written)'}"),
        ("kernels in it", f"{cache['kernels']}, {cache['size_mb']} MB"),
    ]
    packages = [(p["name"], p["version"], p["wanted"], p["fits"]) for p in document["packages"]]
    extras = [
        (
            extra["name"],
            ", ".join(f"{p['name']} {p['version']}" for p in extra["packages"] if p["fits"]),
            ", ".join(extra["missing"]),
            extra["install"],
        )
        for extra in document["extras"]
    ]
    return [
        Table("clothgym", ("what", "value"), facts),
        Table("Needed packages", ("package", "installed", "wanted", "fits"), packages),
        Table("Extras", ("extra", "installed", "missing", "install with"), extras),
    ]
