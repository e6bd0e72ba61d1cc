"""`clothgym bench`: runs benchmarks and compares their rows."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Annotated, Any

import typer

from clothgym.benchmarks import frame
from clothgym.benchmarks.machine import missing_extra_line
from clothgym.benchmarks.report import Table
from clothgym.commands import JsonOption, Stopped, answer, progress_bar, reserved_stdout, say

_HELP = """Runs benchmarks: rows go to DIR/NAME.jsonl as they finish, the report to DIR/NAME.html.

`clothgym bench` lists the benchmarks, `clothgym bench NAME` runs one, `clothgym bench all` runs all,
`clothgym bench compare A.jsonl B.jsonl` compares two files of rows.

Exit code: 0 done, 1 some cases failed (their rows hold the error), 2 bad input, 130 stopped (finished rows are kept).
"""


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("bench", help=_HELP)(bench)


def bench(
    names: Annotated[
        list[str] | None, typer.Argument(help="Benchmark names, `all`, or `compare` and two files.", show_default=False)
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A small selection of cases.")] = False,
    jobs: Annotated[int, typer.Option("--jobs", help="Worker processes.")] = 1,
    backend: Annotated[str, typer.Option("--backend", help="loky (this machine) or ray (a cluster).")] = "loky",
    resume: Annotated[bool, typer.Option("--resume", help="Keep finished rows, run what is missing.")] = False,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of rows and reports.")] = Path("logs/bench"),
    strategy: Annotated[
        list[str] | None,
        typer.Option("--strategy", help="untangling: package.module:Name of an own one.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    if not names:
        _list(as_json)
    elif names[0] == "compare":
        if len(names) != 3:
            raise ValueError(f"bench compare: expected two files of rows, got {len(names) - 1}")
        _compare(Path(names[1]), Path(names[2]), as_json)
    else:
        if out.exists() and not out.is_dir():
            raise ValueError(f"--out = {str(out)!r}: not a folder")
        options = {"quick": quick, "jobs": jobs, "backend": backend, "resume": resume}
        if strategy and names != ["untangling"]:
            raise ValueError(
                f"--strategy = {', '.join(strategy)}: works with untangling alone, not with {', '.join(names)}"
            )
        if names == ["all"]:
            _run_all(out, options, as_json)
        else:
            benchmarks = [frame.load(name) for name in dict.fromkeys(names)]
            if strategy:
                benchmarks = [b.with_strategies(strategy) for b in benchmarks if b.with_strategies is not None]
            _run(benchmarks, out, options, as_json)


def _list(as_json: bool) -> None:
    """The registered benchmarks with their titles; one that cannot be loaded says why."""
    titles = {}
    for name, entry in frame.entry_points().items():
        try:
            titles[name] = entry.load().title
        except Exception as error:
            titles[name] = f"not available: {_reason(error)}"
    table = Table("Benchmarks", ("name", "title"), list(titles.items()), "run one: clothgym bench NAME --quick")
    answer({"benchmarks": titles}, [table], as_json)


def _reason(error: Exception) -> str:
    line = missing_extra_line(error) if isinstance(error, ImportError) else None
    return line or f"{type(error).__name__}: {' '.join(str(error).split())}"


def _run_all(out: Path, options: dict[str, Any], as_json: bool) -> None:
    """All benchmarks; one that cannot be loaded is reported and does not stop the others."""
    benchmarks, broken = [], 0
    for name, entry in frame.entry_points().items():
        try:
            benchmarks.append(entry.load())
        except Exception as error:
            broken += 1
            say(f"clothgym bench {name}: not available: {_reason(error)}")
    if not benchmarks:
        raise ValueError("bench all: no benchmark is registered (is the package installed?)")
    _run(benchmarks, out, options, as_json, broken, whole=True)


def _run(
    benchmarks: list[frame.Benchmark],
    out: Path,
    options: dict[str, Any],
    as_json: bool,
    broken: int = 0,
    whole: bool = False,
) -> None:
    documents, failed = [], broken
    for benchmark in benchmarks:
        with reserved_stdout(as_json):
            outcome = _run_one(benchmark, out, options)
        failed += outcome.error_count
        documents.append(_document(benchmark, outcome))
        if not as_json:
            answer({}, outcome.tables, False)
        say(f"{benchmark.name}: {len(outcome.rows)} rows in {outcome.path}, report in {outcome.page}")
        if outcome.error_count:
            say(f"{benchmark.name}: {outcome.error_count} cases failed; their rows hold the error")
    if as_json:
        single = len(documents) == 1 and not whole
        answer(documents[0] if single else {"benchmarks": documents}, [], True)
    if failed:
        raise typer.Exit(1)


def _run_one(benchmark: frame.Benchmark, out: Path, options: dict[str, Any]) -> frame.Outcome:
    """One benchmark behind a progress bar."""
    with progress_bar(benchmark.name, 0) as advance:

        def show(done: int, total: int, row: frame.Row | None) -> None:
            text = "" if row is None else row["key"].split("/", 2)[-1] + (" failed" if "error" in row else "")
            advance(done, text, total)

        try:
            return frame.run_benchmark(benchmark, out, progress=show, **options)
        except KeyboardInterrupt:
            path = out / f"{benchmark.name}.jsonl"
            raise Stopped(f"stopped; finished rows are in {path}: go on with --resume") from None


def _document(benchmark: frame.Benchmark, outcome: frame.Outcome) -> dict[str, Any]:
    return {
        "benchmark": benchmark.name,
        "title": benchmark.title,
        "file": str(outcome.path),
        "page": str(outcome.page),
        "errors": outcome.error_count,
        "tables": [table.to_json() for table in outcome.tables],
        "rows": outcome.rows,
    }


# Comparison


def _compare(path_a: Path, path_b: Path, as_json: bool) -> None:
    """Numbers of two files of the same benchmark: per key, and the median over the keys."""
    rows_a, rows_b = _good_rows(path_a), _good_rows(path_b)
    name_a, name_b = (next(iter(rows.values()))["benchmark"] for rows in (rows_a, rows_b))
    if name_a != name_b:
        raise ValueError(f"bench compare: different benchmarks: {path_a} holds {name_a!r}, {path_b} holds {name_b!r}")
    keys = [key for key in rows_a if key in rows_b]
    if not keys:
        raise ValueError(f"bench compare: {path_a} and {path_b} have no key in common (quick against full?)")
    changed = [key for key in keys if rows_a[key].get("parameters") != rows_b[key].get("parameters")]
    if changed:
        raise ValueError(f"bench compare: key = {changed[0]!r} has other parameters in {path_b} than in {path_a}")

    cells: list[dict[str, Any]] = []
    for key in keys:
        numbers_a, numbers_b = (_numbers(rows[key]) for rows in (rows_a, rows_b))
        for quantity in numbers_a:
            if quantity in numbers_b:
                a, b = numbers_a[quantity], numbers_b[quantity]
                cells.append({"key": key, "quantity": quantity, "a": a, "b": b, "ratio": b / a if a else None})
    medians = []
    for quantity in dict.fromkeys(cell["quantity"] for cell in cells):
        same = [cell for cell in cells if cell["quantity"] == quantity]
        columns = {name: [cell[name] for cell in same if cell[name] is not None] for name in ("a", "b", "ratio")}
        middle = {name: statistics.median(values) if values else None for name, values in columns.items()}
        medians.append({"quantity": quantity, "keys": len(same), **middle})

    only_a, only_b = ([key for key in one if key not in other] for one, other in ((rows_a, rows_b), (rows_b, rows_a)))
    note = f"a = {path_a}, b = {path_b}, ratio = b / a; keys only in a: {len(only_a)}, only in b: {len(only_b)}"
    document = {
        "benchmark": name_a,
        "a": {"file": str(path_a), "only": only_a, **_origin(rows_a, keys)},
        "b": {"file": str(path_b), "only": only_b, **_origin(rows_b, keys)},
        "medians": medians,
        "keys": cells,
    }
    per_key = Table(
        f"{name_a}: every key", ("key", "quantity", "a", "b", "ratio"), [tuple(cell.values()) for cell in cells]
    )
    median = Table(
        f"{name_a}: median over keys",
        ("quantity", "keys", "a", "b", "ratio"),
        [tuple(cell.values()) for cell in medians],
        note,
    )
    answer(document, [per_key, median], as_json)


def _good_rows(path: Path) -> dict[str, frame.Row]:
    """Rows that did not fail, by key.

    Raises:
        ValueError: there is none, or they belong to several benchmarks.
    """
    rows = [row for row in frame.read_rows(path)[0] if "error" not in row]
    if not rows:
        raise ValueError(f"{path}: holds no finished row")
    names = sorted({row["benchmark"] for row in rows})
    if len(names) > 1:
        raise ValueError(f"{path}: holds rows of different benchmarks: {', '.join(names)}")
    return {row["key"]: row for row in rows}


def _origin(rows: dict[str, frame.Row], keys: list[str]) -> dict[str, Any]:
    row = rows[keys[0]]
    return {name: row.get(name) for name in ("machine", "versions", "commit")}


def _numbers(row: frame.Row) -> dict[str, float]:
    """Every number of the result, nested ones by dotted name, and the seconds of the case."""
    found: dict[str, float] = {}

    def walk(value: Any, name: str) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(inner, f"{name}.{key}" if name else key)
        elif isinstance(value, int | float):
            found[name] = float(value)

    walk(row.get("result") or {}, "")
    if isinstance(row.get("seconds"), int | float):
        found["case seconds"] = float(row["seconds"])
    return found
