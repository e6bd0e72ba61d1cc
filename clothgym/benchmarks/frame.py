"""The frame of every benchmark: cases in, one JSON line per finished case out, safe against kill and repetition.

A row is written, flushed and synced by the parent as soon as its case ends, so a kill loses at most the cases that
were running. `--resume` repairs a line torn by a kill, keeps every finished row and runs only what is missing.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import json
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

from clothgym.arrays import check_choice, check_number
from clothgym.benchmarks.machine import SINGLE_THREAD, missing_extra_line, need, provenance
from clothgym.benchmarks.report import (
    Page,
    Table,
    error_table,
    json_ready,
    origin_table,
    to_json_text,
    write_atomically,
)

ENTRY_POINTS = "clothgym.benchmarks"
BACKENDS = ("loky", "ray")
_TRACEBACK_LINES = 12

Row = dict[str, Any]


def _no_plots(rows: list[Row], folder: Path) -> list[Path]:
    return []


@dataclass(frozen=True)
class Case:
    """One measurement of a benchmark.

    Attributes:
        key: Unique within the benchmark, the same in every run ("global/seed3").
        parameters: JSON values; all that `run` gets. `seed`, if there, is repeated in the row.
    """

    key: str
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Benchmark:
    """What a benchmark is. All functions are module-level, because workers import them.

    Attributes:
        name: File name of the rows and name on the command line.
        title: One line.
        cases: `cases(quick)` lists the cases; quick = a small selection for a first look.
        run: `run(parameters)` measures one case and returns a dict of JSON values. It may raise: that makes a row
            with `error` and the run goes on.
        tables: `tables(rows)` from the rows that did not fail, for terminal and page.
        plots: `plots(rows, folder)` writes PNG files and returns their paths. Get matplotlib from
            `clothgym.benchmarks.machine.pyplot()`, which names the extra when it is missing.
        prepare: Called once per process before the first case and never timed: compile kernels here.
        notes: What the paper says, what to read out of the numbers.
        with_strategies: Makes the benchmark anew with a user's untangling strategies in its tables; None = it has none.
    """

    name: str
    title: str
    cases: Callable[[bool], list[Case]]
    run: Callable[[dict[str, Any]], dict[str, Any]]
    tables: Callable[[list[Row]], list[Table]]
    plots: Callable[[list[Row], Path], list[Path]] = _no_plots
    prepare: Callable[[], None] | None = None
    notes: str = ""
    with_strategies: Callable[[Sequence[str]], Benchmark] | None = None


@dataclass(frozen=True)
class Outcome:
    """What a run left behind: all rows of the file (kept and new), how many failed, the file and the page."""

    rows: list[Row]
    error_count: int
    path: Path
    page: Path
    tables: list[Table]


def entry_points() -> dict[str, importlib.metadata.EntryPoint]:
    """Registered benchmarks by name, sorted; the first of two entries with the same name wins."""
    found: dict[str, importlib.metadata.EntryPoint] = {}
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        found.setdefault(entry.name, entry)
    return dict(sorted(found.items()))


def load(name: str) -> Benchmark:
    """The registered benchmark of that name.

    Raises:
        ValueError: no such benchmark; names the known ones.
    """
    known = entry_points()
    if name not in known:
        names = ", ".join([*known, "all"]) if known else "none is registered (is the package installed?)"
        raise ValueError(f"benchmark = {name!r}: expected one of {names}")
    return known[name].load()


# Rows on disk


def read_rows(path: Path) -> tuple[list[Row], int]:
    """Rows of a file, and how many of its bytes are sound: what follows is a last line torn by a kill.

    Raises:
        ValueError: names file and line of anything else that is no row, and of a repeated key.
        FileNotFoundError: no such file.
    """
    data = path.read_bytes()
    rows: list[Row] = []
    keys: set[str] = set()
    sound = 0
    for number, line in enumerate(data.split(b"\n"), 1):
        end = min(sound + len(line) + 1, len(data))
        if line.strip():
            try:
                row = json.loads(line)
            except ValueError as error:
                if end == len(data):
                    break
                raise ValueError(f"{path}: line {number} is no JSON: {error}") from None
            if not isinstance(row, dict) or not all(isinstance(row.get(name), str) for name in ("key", "benchmark")):
                raise ValueError(f"{path}: line {number} is no benchmark row: 'key' or 'benchmark' is missing")
            if row["key"] in keys:
                raise ValueError(f"{path}: line {number} repeats key = {row['key']!r}")
            keys.add(row["key"])
            rows.append(row)
        sound = end
    return rows, sound


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Holds the lock of a row file (on a hidden file beside it, since the rows themselves may be moved); the system
    lets go of it when the process dies.

    Raises:
        ValueError: another run is writing the file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_name(f".{path.stem}.lock").open("ab") as lock:
        try:
            import fcntl
        except ImportError:  # a system without file locks
            yield
            return
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ValueError(f"{path}: another run is writing this file") from None
        yield


def _append(file: BinaryIO, row: Row) -> None:
    """Writes one row to the disk; when this returns, a kill can no longer take it."""
    file.write(_lines([row]))
    file.flush()
    os.fsync(file.fileno())


def _aside(path: Path, mark: str = "") -> Path:
    """A free name `<name>.[mark.]<timestamp>.jsonl` beside the file."""
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    for count in range(1000):
        suffix = f".{mark}{stamp}" + (f"-{count}" if count else "")
        candidate = path.with_name(f"{path.stem}{suffix}{path.suffix}")
        if not candidate.exists():
            return candidate
    raise OSError(f"{path}: no free name to move it to")


def _kept_rows(path: Path, planned: dict[str, Row], scale: str) -> list[Row]:
    """Repairs the file of an earlier run and returns its finished rows; rows of failed cases make way for a new try
    (they stay in `<name>.errors.<timestamp>.jsonl`)."""
    rows, sound = read_rows(path)
    for row in rows:
        if row.get("scale") != scale:
            way = "with" if row.get("scale") == "quick" else "without"
            raise ValueError(f"{path}: key = {row['key']!r} is a {row.get('scale')} row: resume {way} --quick")
        plan = planned.get(row["key"])
        if plan is not None and plan["parameters"] != row.get("parameters"):
            raise ValueError(f"{path}: key = {row['key']!r} has other parameters now: start anew without --resume")
    finished = [row for row in rows if "error" not in row]
    if len(finished) < len(rows):
        failed = [row for row in rows if "error" in row]
        write_atomically(_aside(path, "errors."), _lines(failed))
        write_atomically(path, _lines(finished))
        return finished
    if sound < path.stat().st_size:
        with path.open("r+b") as file:
            file.truncate(sound)
            os.fsync(file.fileno())
        print(f"{path}: dropped the last line, torn by a kill", file=sys.stderr)
    elif sound and not path.read_bytes().endswith(b"\n"):
        with path.open("ab") as file:
            file.write(b"\n")
            os.fsync(file.fileno())
    return finished


def _lines(rows: Sequence[Row]) -> bytes:
    return b"".join(to_json_text(row).encode("utf-8") + b"\n" for row in rows)


# Running


def plan(benchmark: Benchmark, quick: bool) -> list[Row]:
    """The head of every row: key, benchmark, scale, parameters, seed (0 when the case draws no numbers).

    Raises:
        ValueError: two cases with the same key, or a benchmark without cases.
    """
    scale = "quick" if quick else "full"
    heads: dict[str, Row] = {}
    for case in benchmark.cases(quick):
        key = f"{benchmark.name}/{scale}/{case.key}"
        if key in heads:
            raise ValueError(f"benchmark {benchmark.name}: two cases have the key {case.key!r}")
        parameters = json_ready(case.parameters)
        heads[key] = {
            "key": key,
            "benchmark": benchmark.name,
            "scale": scale,
            "parameters": parameters,
            "seed": parameters.get("seed", 0),
        }
    if not heads:
        raise ValueError(f"benchmark {benchmark.name}: no {scale} cases")
    return list(heads.values())


_prepared: set[Any] = set()


def run_case(
    run: Callable[[dict[str, Any]], dict[str, Any]],
    prepare: Callable[[], None] | None,
    head: Row,
    parent: int | None = None,
) -> Row:
    """Measures one case and returns its whole row; an exception becomes `error` and `traceback` of the row.

    Args:
        run, prepare: Functions of the benchmark.
        head: Head of the row, by `plan`.
        parent: Process id of the parent when this may be a worker.
    """
    if parent not in (None, os.getpid()):
        _become_worker(parent)
    row = dict(head)
    started = datetime.now(UTC)
    clock = time.perf_counter()
    # Standard output belongs to the tables and the JSON document: whatever a case prints goes to standard error.
    with contextlib.redirect_stdout(sys.stderr):
        try:
            if prepare is not None and prepare not in _prepared:
                prepare()
                _prepared.add(prepare)
            started, clock = datetime.now(UTC), time.perf_counter()
            result = run(dict(head["parameters"]))
            seconds = time.perf_counter() - clock
            if not isinstance(result, dict):
                raise TypeError(f"run returned {type(result).__name__}, expected a dict")
            row["result"] = json_ready(result)
        except (Exception, SystemExit) as error:
            seconds = time.perf_counter() - clock
            first_line = (str(error).strip().splitlines() or [""])[0]
            row["result"] = None
            row["error"] = f"{type(error).__name__}: {first_line}"
            row["traceback"] = traceback.format_exc().strip().splitlines()[-_TRACEBACK_LINES:]
    row |= provenance()
    row["started"] = started.isoformat()
    row["finished"] = datetime.now(UTC).isoformat()
    row["seconds"] = seconds
    return row


@functools.cache
def _become_worker(parent: int) -> None:
    """Once per worker: leaves Ctrl-C, which reaches the whole group, to the parent; and ends when the parent was
    killed, since an orphan would go on for minutes."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    if os.getppid() != parent:  # a worker on another machine, or under a supervisor that looks after it
        return

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _rows_by_ray(benchmark: Benchmark, heads: list[Row], jobs: int) -> Generator[Row, None, None]:
    """Rows from ray, on this machine or on the cluster that RAY_ADDRESS names, with at most `jobs` cases at a time.

    Ray is asked directly: its joblib backend hands results over only when all are there, so a kill would lose them.
    """
    ray = need("ray")
    started_here = not ray.is_initialized()
    if started_here:
        own = {} if os.environ.get("RAY_ADDRESS") else {"num_cpus": jobs, "include_dashboard": False}
        ray.init(runtime_env={"env_vars": SINGLE_THREAD}, log_to_driver=False, logging_level="ERROR", **own)
    task = ray.remote(num_cpus=1, max_retries=0)(run_case)
    waiting = list(heads)
    running: list[Any] = []
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                running.append(task.remote(benchmark.run, benchmark.prepare, waiting.pop(0), os.getpid()))
            ended, running = ray.wait(running, num_returns=1)
            yield ray.get(ended[0])
    finally:
        for case in running:
            ray.cancel(case, force=True)
        if started_here:
            ray.shutdown()


def _finished_rows(benchmark: Benchmark, heads: list[Row], jobs: int, backend: str) -> Generator[Row, None, None]:
    """Rows in the order in which the cases end."""
    if jobs == 1 and backend == "loky":
        for head in heads:
            yield run_case(benchmark.run, benchmark.prepare, head)
        return
    if benchmark.prepare is not None:
        # Fills the kernel cache once, so that the workers do not all compile the same. A failure shows in every row.
        with contextlib.redirect_stdout(sys.stderr), contextlib.suppress(Exception):
            benchmark.prepare()
    if backend == "ray":
        yield from _rows_by_ray(benchmark, heads, jobs)
        return
    import joblib

    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=1)  # type: ignore[arg-type]
    calls = (joblib.delayed(run_case)(benchmark.run, benchmark.prepare, head, os.getpid()) for head in heads)
    # Ctrl-C has its own line; joblib would add two about the tasks that it cancelled, sometimes only while it is collected
    warnings.filterwarnings("ignore", message=".*tasks which were still being processed.*", category=UserWarning)
    yield from parallel(calls)  # type: ignore[misc]


def run_benchmark(
    benchmark: Benchmark,
    folder: str | Path,
    quick: bool = False,
    jobs: int = 1,
    backend: str = "loky",
    resume: bool = False,
    progress: Callable[[int, int, Row | None], None] | None = None,
) -> Outcome:
    """Runs the cases of a benchmark, keeps every row in `<folder>/<name>.jsonl`, writes `<folder>/<name>.html`.

    Args:
        folder: Where rows, plots and page go.
        quick: The small selection of cases.
        jobs: Worker processes; 1 runs in this process.
        backend: "loky" (this machine) or "ray" (a cluster).
        resume: Keep finished rows and run only what is missing or failed. Otherwise an existing file is moved to
            `<name>.<timestamp>.jsonl`.
        progress: Called with (done, all, row) after every case, and with row None before the first.

    Raises:
        ValueError: bad argument, a file that cannot be resumed, or a file in use.
        KeyboardInterrupt: Ctrl-C; finished rows are on disk.
        MissingExtraError: `backend="ray"` without the extra `cluster`.
        RuntimeError: a worker process died; finished rows are on disk.
    """
    jobs = int(check_number(jobs, "jobs", 1, 1024, integer=True))
    check_choice(backend, "backend", BACKENDS)
    heads = plan(benchmark, quick)
    planned = {head["key"]: head for head in heads}
    folder = Path(folder)
    path = folder / f"{benchmark.name}.jsonl"
    with _locked(path):
        kept: list[Row] = []
        if resume and path.exists():
            kept = _kept_rows(path, planned, "quick" if quick else "full")
        elif path.exists() and path.stat().st_size:
            path.rename(_aside(path))
        rows = list(kept)
        kept_keys = {row["key"] for row in kept}
        missing = [head for head in heads if head["key"] not in kept_keys]
        done = len(heads) - len(missing)
        if progress is not None:
            progress(done, len(heads), None)
        with path.open("ab") as file, contextlib.closing(_finished_rows(benchmark, missing, jobs, backend)) as new:
            for row in _alive(new, path):
                _append(file, row)
                rows.append(row)
                done += 1
                if progress is not None:
                    progress(done, len(heads), row)
    order = {key: position for position, key in enumerate(planned)}
    rows.sort(key=lambda row: order.get(row["key"], len(order)))
    tables, page = write_report(benchmark, rows, folder)
    return Outcome(rows, sum("error" in row for row in rows), path, page, tables)


def _alive(rows: Iterator[Row], path: Path) -> Iterator[Row]:
    """The rows; the death of a worker becomes a line that tells what to do."""
    try:
        yield from rows
    except Exception as error:
        name = type(error).__name__
        if not any(word in name for word in ("Terminated", "BrokenProcessPool", "WorkerCrashed")):
            raise
        raise RuntimeError(f"a worker process died; finished rows are in {path}: run again with --resume") from error


# Report


def write_report(benchmark: Benchmark, rows: list[Row], folder: Path) -> tuple[list[Table], Path]:
    """Tables of the rows, and the path of the page with tables, plots, notes and origin of the numbers."""
    good = [row for row in rows if "error" not in row]
    tables = list(benchmark.tables(good)) if good else []
    if len(good) < len(rows):
        tables.append(error_table(rows))
    page = Page(benchmark.title)
    page.add_text(benchmark.notes)
    for table in tables:
        page.add_table(table)
    try:
        for plot in benchmark.plots(good, folder) if good else []:
            page.add_image(plot, Path(plot).stem.replace("_", " "))
    except ImportError as error:
        line = missing_extra_line(error)
        if line is None:
            raise
        print(f"no plots: {line}", file=sys.stderr)
        page.add_text(f"No plots: {line}")
    page.add_table(origin_table(rows))
    return tables, page.write(folder / f"{benchmark.name}.html")
