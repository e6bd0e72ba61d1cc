"""The frame of the benchmarks: rows survive kills, are never repeated or lost, and become tables and a page."""

from __future__ import annotations

import base64
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from clothgym import cli
from clothgym.benchmarks import Benchmark, Case, Page, Table, frame, machine, report

ROOT = Path(__file__).resolve().parents[1]

FAKE = '''
"""A benchmark that costs nothing; the environment slows it down or breaks it."""

import os
import sys
import time
from pathlib import Path

import numpy as np

from clothgym.benchmarks import Benchmark, Case, Table

prepared = []


def cases(quick):
    return [Case(f"n{n}", {"n": n, "seed": 100 + n}) for n in range(3 if quick else 6)]


def prepare():
    prepared.append(os.getpid())


def run(parameters):
    n = parameters["n"]
    sys.stdout.write("noise on standard output\\n")  # one write: two workers' lines cannot mix
    time.sleep(float(os.environ.get("FAKE_SLEEP", "0")))
    if os.environ.get("FAKE_FAIL") == str(n):
        raise ValueError(f"n = {n} cannot be\\nand a second line")
    if os.environ.get("FAKE_DIE") == str(n):
        os._exit(9)
    draw = np.random.default_rng(parameters["seed"]).random()
    return {"square": np.float64(n * n), "draw": draw, "deep": {"root": n ** 0.5}, "even": np.bool_(n % 2 == 0),
            "path": np.arange(2), "undefined": float("nan"), "threads": os.environ.get("NUMBA_NUM_THREADS"),
            "prepared": len(prepared)}


def tables(rows):
    cells = [(row["parameters"]["n"], row["result"]["square"]) for row in rows]
    return [Table("Squares of <n>", ("n", "square [m]"), cells, "a & b")]


def plots(rows, folder):
    from clothgym.benchmarks.machine import pyplot

    plt = pyplot()
    figure, axes = plt.subplots(figsize=(3, 2))
    axes.plot([row["parameters"]["n"] for row in rows], [row["result"]["square"] for row in rows])
    path = Path(folder) / "fake_squares.png"
    figure.savefig(path)
    plt.close(figure)
    return [path]


benchmark = Benchmark("fake", "Fake & <title>", cases, run, tables, plots, prepare, "The paper says <b>nothing</b>.")
other = Benchmark("other", "Another", cases, run, tables)
'''


@pytest.fixture(scope="module")
def plugin(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the module and its registered entry points, importable here and in child processes."""
    folder = tmp_path_factory.mktemp("plugin")
    (folder / "fake_bench_plugin.py").write_text(FAKE)
    info = folder / "fake_bench_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fake_bench_plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[clothgym.commands]\nbench = clothgym.commands.bench:register\n"
        "[clothgym.benchmarks]\nfake = fake_bench_plugin:benchmark\nother = fake_bench_plugin:other\n"
    )
    sys.path.insert(0, str(folder))
    yield folder
    sys.path.remove(str(folder))


@pytest.fixture
def fake(plugin: Path) -> Benchmark:
    return frame.load("fake")


def child(plugin: Path, *words: str, **environment: str) -> subprocess.Popen[str]:
    """`clothgym` in a process group of its own."""
    paths = os.pathsep.join([str(plugin), str(ROOT)])
    return subprocess.Popen(
        [sys.executable, "-m", "clothgym", *words],
        env={**os.environ, "PYTHONPATH": paths, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wait_for_rows(path: Path, count: int) -> None:
    """Until the file holds that many whole lines."""
    deadline = time.monotonic() + 60
    while not (path.exists() and path.read_bytes().count(b"\n") >= count):
        assert time.monotonic() < deadline, "no rows"
        time.sleep(0.01)


def lines_of(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def same_numbers(row: dict) -> tuple:
    """What must not depend on how a row was computed."""
    result = {k: v for k, v in row["result"].items() if k not in ("threads", "prepared")}
    return row["key"], json.dumps(row["parameters"]), row["seed"], json.dumps(result)


# Rows


def test_a_row_tells_where_it_comes_from(fake: Benchmark, tmp_path: Path) -> None:
    outcome = frame.run_benchmark(fake, tmp_path)
    rows = lines_of(tmp_path / "fake.jsonl")
    assert rows == outcome.rows
    assert outcome.error_count == 0
    assert [row["key"] for row in rows] == [f"fake/full/n{n}" for n in range(6)]
    row = rows[2]
    assert row["benchmark"] == "fake"
    assert row["parameters"] == {"n": 2, "seed": 102}
    assert row["seed"] == 102
    assert row["result"]["square"] == 4.0
    assert row["result"]["even"] is True
    assert row["result"]["path"] == [0, 1]
    assert row["result"]["undefined"] is None
    assert row["machine"]["cores"] >= 1
    assert row["machine"]["cpu"]
    assert row["versions"]["numpy"] == np.__version__
    assert row["versions"]["python"].startswith(f"{sys.version_info[0]}.{sys.version_info[1]}")
    assert "commit" in row
    assert row["started"] <= row["finished"]
    assert row["seconds"] >= 0.0
    assert "error" not in row


def test_prepare_runs_once_and_is_not_timed(tmp_path: Path) -> None:
    calls: list[str] = []

    def prepare() -> None:
        calls.append("prepare")
        time.sleep(0.5)

    def run(parameters: dict) -> dict:
        calls.append("run")
        return {}

    bench = Benchmark("slow", "t", lambda quick: [Case("a"), Case("b")], run, lambda rows: [], prepare=prepare)
    rows = frame.run_benchmark(bench, tmp_path).rows
    assert calls == ["prepare", "run", "run"]
    assert max(row["seconds"] for row in rows) < 0.4
    assert [row["seed"] for row in rows] == [0, 0]


def test_quick_and_full_rows_have_other_keys_and_never_mix(fake: Benchmark, tmp_path: Path) -> None:
    quick = frame.run_benchmark(fake, tmp_path, quick=True).rows
    assert {row["scale"] for row in quick} == {"quick"}
    assert not {row["key"] for row in quick} & {head["key"] for head in frame.plan(fake, quick=False)}
    before = (tmp_path / "fake.jsonl").read_bytes()
    with pytest.raises(ValueError, match=r"fake\.jsonl: key = 'fake/quick/n0' is a quick row: resume with --quick"):
        frame.run_benchmark(fake, tmp_path, resume=True)
    assert (tmp_path / "fake.jsonl").read_bytes() == before


def test_without_resume_the_old_file_is_moved_aside(fake: Benchmark, tmp_path: Path) -> None:
    for _ in range(3):
        frame.run_benchmark(fake, tmp_path, quick=True)
    files = sorted(tmp_path.glob("fake*.jsonl"))
    assert len(files) == 3
    assert all(re.fullmatch(r"fake(\.\d{8}-\d{6}(-\d+)?)?\.jsonl", file.name) for file in files)
    assert [len(lines_of(file)) for file in files] == [3, 3, 3]


def test_cases_with_the_same_key_are_refused(tmp_path: Path) -> None:
    bench = Benchmark("twice", "t", lambda quick: [Case("a"), Case("a")], dict, lambda rows: [])
    with pytest.raises(ValueError, match="twice: two cases have the key 'a'"):
        frame.run_benchmark(bench, tmp_path)
    with pytest.raises(ValueError, match="empty: no full cases"):
        frame.run_benchmark(Benchmark("empty", "t", lambda quick: [], dict, lambda rows: []), tmp_path)


# Kill, resume, repair


def test_resume_after_a_kill_repeats_and_loses_nothing(plugin: Path, tmp_path: Path) -> None:
    path = tmp_path / "fake.jsonl"
    process = child(plugin, "bench", "fake", "--out", str(tmp_path), FAKE_SLEEP="0.25")
    wait_for_rows(path, 2)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate(timeout=30)
    kept = path.read_text().splitlines()
    assert 2 <= len(kept) < 6
    with path.open("a") as file:  # and the disk took half of the next row
        file.write('{"key": "fake/full/n5", "benchm')

    outcome = frame.run_benchmark(frame.load("fake"), tmp_path, resume=True)
    assert path.read_text().splitlines()[: len(kept)] == kept
    assert sorted(row["key"] for row in lines_of(path)) == [f"fake/full/n{n}" for n in range(6)]
    assert [row["key"] for row in outcome.rows] == [f"fake/full/n{n}" for n in range(6)]
    assert len(list(tmp_path.glob("*.jsonl"))) == 1


def test_workers_end_when_their_parent_is_killed(plugin: Path, tmp_path: Path) -> None:
    process = child(plugin, "bench", "fake", "--jobs", "2", "--out", str(tmp_path), FAKE_SLEEP="0.2")
    wait_for_rows(tmp_path / "fake.jsonl", 2)
    os.kill(process.pid, signal.SIGKILL)
    process.wait(timeout=30)
    deadline = time.monotonic() + 20
    while group_is_alive(process.pid):
        assert time.monotonic() < deadline, "orphans are left"
        time.sleep(0.1)
    process.communicate()
    rows = lines_of(tmp_path / "fake.jsonl")
    assert len({row["key"] for row in rows}) == len(rows) >= 2


def group_is_alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_torn_last_line_is_dropped_and_a_missing_newline_added(fake: Benchmark, tmp_path: Path) -> None:
    path = tmp_path / "fake.jsonl"
    frame.run_benchmark(fake, tmp_path, quick=True)
    whole = path.read_bytes()
    for cut in (1, 2, 40, len(whole.splitlines()[-1])):
        path.write_bytes(whole[:-cut])
        rows, sound = frame.read_rows(path)
        assert len(rows) == (3 if cut == 1 else 2)
        assert sound <= len(whole) - cut
        assert len(frame.run_benchmark(fake, tmp_path, quick=True, resume=True).rows) == 3
        assert [row["key"] for row in lines_of(path)] == [f"fake/quick/n{n}" for n in range(3)]


def test_resume_with_everything_done_runs_nothing(
    fake: Benchmark, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame.run_benchmark(fake, tmp_path, quick=True)
    before = (tmp_path / "fake.jsonl").read_bytes()
    monkeypatch.setenv("FAKE_FAIL", "1")
    steps: list[tuple[int, int]] = []
    frame.run_benchmark(
        fake, tmp_path, quick=True, resume=True, progress=lambda done, total, row: steps.append((done, total))
    )
    assert steps == [(3, 3)]
    assert (tmp_path / "fake.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (lambda lines: [b"{oops", *lines], r"line 1 is no JSON"),
        (lambda lines: [*lines, lines[0]], r"line 4 repeats key = 'fake/quick/n0'"),
        (lambda lines: [b"[1]", *lines], r"line 1 is no benchmark row"),
        (lambda lines: [b'{"key": 3, "benchmark": "fake"}', *lines], r"line 1 is no benchmark row"),
        (lambda lines: [lines[0].replace(b'"n": 0', b'"n": 7'), *lines[1:]], r"'fake/quick/n0' has other parameters"),
    ],
)
def test_a_damaged_file_is_named_and_left_alone(
    fake: Benchmark, tmp_path: Path, damage: object, complaint: str
) -> None:
    path = tmp_path / "fake.jsonl"
    frame.run_benchmark(fake, tmp_path, quick=True)
    damaged = b"\n".join(damage(path.read_bytes().splitlines())) + b"\n"  # type: ignore[operator]
    path.write_bytes(damaged)
    with pytest.raises(ValueError, match=re.escape(str(path)) + ".*" + complaint):
        frame.run_benchmark(fake, tmp_path, quick=True, resume=True)
    assert path.read_bytes() == damaged


def test_two_runs_cannot_write_one_file(fake: Benchmark, tmp_path: Path) -> None:
    with (
        frame._locked(tmp_path / "fake.jsonl"),
        pytest.raises(ValueError, match=r"fake\.jsonl: another run is writing this file"),
    ):
        frame.run_benchmark(fake, tmp_path)
    assert len(frame.run_benchmark(fake, tmp_path, quick=True).rows) == 3


# Failing cases


def test_a_case_that_raises_becomes_a_row_and_is_tried_again(
    fake: Benchmark, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FAKE_FAIL", "1")
    outcome = frame.run_benchmark(fake, tmp_path, quick=True)
    assert outcome.error_count == 1
    assert len(outcome.rows) == 3
    failed = lines_of(tmp_path / "fake.jsonl")[1]
    assert failed["error"] == "ValueError: n = 1 cannot be"
    assert failed["result"] is None
    assert any("in run" in line for line in failed["traceback"])
    assert [list(row) for row in outcome.tables[-1].rows] == [["fake/quick/n1", "ValueError: n = 1 cannot be"]]
    assert "ValueError: n = 1 cannot be" in outcome.page.read_text()

    monkeypatch.delenv("FAKE_FAIL")
    again = frame.run_benchmark(fake, tmp_path, quick=True, resume=True)
    assert again.error_count == 0
    keys = [row["key"] for row in lines_of(tmp_path / "fake.jsonl")]
    assert sorted(keys) == [f"fake/quick/n{n}" for n in range(3)]
    (old,) = tmp_path.glob("fake.errors.*.jsonl")
    assert [row["key"] for row in lines_of(old)] == ["fake/quick/n1"]


@pytest.mark.parametrize("result", [3, {"a": object()}, {1: 2}])
def test_a_result_without_json_form_is_an_error_of_its_case(result: object, tmp_path: Path) -> None:
    bench = Benchmark("odd", "t", lambda quick: [Case("a")], lambda p: result, lambda rows: [])  # type: ignore[arg-type,return-value]
    (row,) = frame.run_benchmark(bench, tmp_path).rows
    assert row["error"].startswith("TypeError: ")


# Workers


def test_two_jobs_give_the_same_rows_as_one(fake: Benchmark, tmp_path: Path) -> None:
    one = frame.run_benchmark(fake, tmp_path / "one").rows
    two = frame.run_benchmark(fake, tmp_path / "two", jobs=2).rows
    assert [same_numbers(row) for row in one] == [same_numbers(row) for row in two]
    assert {row["result"]["threads"] for row in two} == {"1"}
    assert {row["result"]["prepared"] for row in two} == {1}


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_ctrl_c_keeps_finished_rows(plugin: Path, tmp_path: Path, jobs: str) -> None:
    process = child(plugin, "bench", "fake", "--jobs", jobs, "--out", str(tmp_path), "--json", FAKE_SLEEP="0.3")
    wait_for_rows(tmp_path / "fake.jsonl", 2)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert process.returncode == cli.STOPPED
    assert out == ""
    told = [line for line in err.splitlines() if "noise" not in line]
    assert told == [f"clothgym bench: stopped; finished rows are in {tmp_path}/fake.jsonl: go on with --resume"]
    rows = lines_of(tmp_path / "fake.jsonl")
    assert 2 <= len(rows) < 6
    assert not any("error" in row for row in rows)


def test_the_death_of_a_worker_is_one_line_and_resume_goes_on(plugin: Path, tmp_path: Path) -> None:
    words = ["bench", "fake", "--jobs", "2", "--out", str(tmp_path), "--json"]
    process = child(plugin, *words, FAKE_DIE="4", FAKE_SLEEP="0.1")
    out, err = process.communicate(timeout=60)
    assert process.returncode == cli.FAILED
    assert out == ""
    assert [line for line in err.splitlines() if "noise" not in line] == [
        f"clothgym bench: a worker process died; finished rows are in {tmp_path}/fake.jsonl: run again with --resume"
    ]
    assert len(frame.run_benchmark(frame.load("fake"), tmp_path, resume=True).rows) == 6


@pytest.mark.parametrize(
    ("options", "complaint"),
    [({"jobs": 0}, "jobs = 0"), ({"jobs": 1.5}, "jobs = 1.5"), ({"backend": "threads"}, "backend = 'threads'")],
)
def test_bad_options_are_refused_before_anything_is_touched(
    fake: Benchmark, tmp_path: Path, options: dict, complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        frame.run_benchmark(fake, tmp_path / "new", **options)
    assert not (tmp_path / "new").exists()


def missing_module(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Makes an import fail as if the package were not installed."""
    for loaded in [module for module in sys.modules if module.partition(".")[0] == name]:
        monkeypatch.delitem(sys.modules, loaded)

    class Absent:
        def find_spec(self, module: str, path: object = None, target: ModuleType | None = None) -> None:
            if module.partition(".")[0] == name:
                raise ModuleNotFoundError(f"No module named {module!r}", name=module)

    monkeypatch.setattr(sys, "meta_path", [Absent(), *sys.meta_path])


def test_ray_and_plots_name_their_extra(
    fake: Benchmark, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    missing_module(monkeypatch, "ray")
    missing_module(monkeypatch, "matplotlib")
    with pytest.raises(ImportError, match=r'ray .*pip install "clothgym\[cluster\]"'):
        frame.run_benchmark(fake, tmp_path, backend="ray")
    outcome = frame.run_benchmark(fake, tmp_path, quick=True)
    assert outcome.error_count == 0
    assert 'pip install "clothgym[plot]"' in capsys.readouterr().err
    assert "pip install &quot;clothgym[plot]&quot;" in outcome.page.read_text()


def test_the_extras_are_those_of_the_package() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    core = {"rich"}
    for extra, packages in extras.items():
        if extra in ("all", "dev"):
            continue
        for package in packages:
            module = re.match(r"[A-Za-z0-9_-]+", package).group().replace("-", "_").removesuffix("_sdk")  # type: ignore[union-attr]
            assert module in core or machine.MODULE_EXTRAS[module] == extra
    assert set(machine.MODULE_EXTRAS.values()) <= set(extras)


# Page and tables


def test_the_page_is_whole_and_escaped(fake: Benchmark, tmp_path: Path) -> None:
    outcome = frame.run_benchmark(fake, tmp_path, quick=True)
    text = outcome.page.read_text()
    assert outcome.page == tmp_path / "fake.html"
    assert "<title>Fake &amp; &lt;title&gt;</title>" in text
    assert "The paper says &lt;b&gt;nothing&lt;/b&gt;." in text
    assert "Squares of &lt;n&gt;" in text
    assert "<b>" not in text
    assert '<td class="number">4</td>' in text
    (picture,) = re.findall(r'<img alt="fake squares" src="data:image/png;base64,([^"]+)">', text)
    assert base64.b64decode(picture) == (tmp_path / "fake_squares.png").read_bytes()
    assert "prefers-color-scheme: dark" in text
    assert np.__version__ in text  # where the numbers come from
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!data:)|url\(|@import|<script|https?://""", text)


def test_page_takes_pictures_of_every_kind(tmp_path: Path) -> None:
    pixels = np.zeros((4, 6, 3), np.uint8)
    pixels[:, 3:] = 255
    page = Page("pictures").add_heading("a < b").add_image(pixels, "both <halves>")
    picture = base64.b64decode(re.findall(r'base64,([^"]+)"', page.to_html())[0])
    (tmp_path / "p.png").write_bytes(picture)
    page.add_image(tmp_path / "p.png").add_image(picture).add_gallery([(picture, "x"), (pixels, "y")])
    text = page.write(tmp_path / "deep" / "page.html").read_text()
    assert text.count("<img ") == 5
    assert "both &lt;halves&gt;" in text
    assert "<h2>a &lt; b</h2>" in text
    with pytest.raises(ValueError, match="not a PNG"):
        page.add_image(b"GIF89a")
    with pytest.raises(ValueError, match="expected uint8 pixels"):
        page.add_image(np.zeros((4, 4)))
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["page.html"]


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "page.html"
    target.write_text("old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        report.write_atomically(target, b"new")
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_tables_refuse_ragged_rows_and_values_read_well() -> None:
    with pytest.raises(ValueError, match="row 1 has 1 cells, expected 2"):
        Table("t", ("a", "b"), [(1, 2), (3,)])
    shown = [report.format_value(v) for v in (None, True, 3, 0.0, 1234.56, 0.0123456, 2e-7, 3e9, math.inf, [1, 2.5])]
    assert shown == ["-", "yes", "3", "0", "1235", "0.01235", "2.000e-07", "3.000e+09", "inf", "1, 2.5"]


def test_json_is_strict() -> None:
    assert json.loads(report.to_json_text({"a": [math.inf, -math.inf, math.nan, np.float32(0.5)]})) == {
        "a": [None, None, None, 0.5]
    }
    with pytest.raises(TypeError, match="set has no JSON form"):
        report.to_json_text({"a": {1}})


# The command


@pytest.fixture
def bench(plugin: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command line with `bench` alone, in this process, and the two fake benchmarks."""
    command = {"bench": EntryPoint("bench", "clothgym.commands.bench:register", cli.ENTRY_POINTS)}
    monkeypatch.setattr(cli, "entry_points", lambda: command)
    entries = {n: EntryPoint(n, f"fake_bench_plugin:{a}", "") for n, a in (("fake", "benchmark"), ("other", "other"))}
    monkeypatch.setattr(frame, "entry_points", lambda: entries)


def test_json_is_pure_even_with_noisy_workers(plugin: Path, tmp_path: Path) -> None:
    process = child(plugin, "bench", "fake", "--quick", "--jobs", "2", "--json", "--out", str(tmp_path))
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    document = json.loads(out)
    assert [row["key"] for row in document["rows"]] == [f"fake/quick/n{n}" for n in range(3)]
    assert document["errors"] == 0
    assert document["tables"][0]["rows"][2] == [2, 4.0]
    assert Path(document["page"]).exists()
    assert "noise" in err


@pytest.mark.usefixtures("bench")
def test_bench_prints_tables_and_exit_codes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert cli.main(["bench", "fake", "--quick", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "Squares of <n>" in out
    assert "square [m]" in out
    assert cli.main(["bench", "all", "--quick", "--json", "--out", str(tmp_path)]) == 0
    assert [d["benchmark"] for d in json.loads(capsys.readouterr().out)["benchmarks"]] == ["fake", "other"]
    monkeypatch.setenv("FAKE_FAIL", "2")
    assert cli.main(["bench", "other", "--quick", "--json", "--out", str(tmp_path)]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["errors"] == 1
    assert cli.main(["bench", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"benchmarks": {"fake": "Fake & <title>", "other": "Another"}}


@pytest.mark.usefixtures("bench")
def test_compare_pairs_keys_and_takes_medians(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = tmp_path / "a" / "fake.jsonl", tmp_path / "b" / "fake.jsonl"
    for path in (a, b):
        frame.run_benchmark(frame.load("fake"), path.parent)
    rows = lines_of(b)
    for row, factor in zip(rows, (1, 1, 2, 3, 4, 5)):
        row["result"]["square"] *= factor
    b.write_text("".join(json.dumps(row) + "\n" for row in rows[:5]))  # key n5 is missing in b
    assert cli.main(["bench", "compare", str(a), str(b), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    cells = {(cell["key"], cell["quantity"]): cell for cell in document["keys"]}
    third = cells["fake/full/n3", "square"]
    assert (third["a"], third["b"], third["ratio"]) == (9.0, 27.0, 3.0)
    assert cells["fake/full/n0", "square"]["ratio"] is None  # nothing to divide by
    assert cells["fake/full/n4", "deep.root"]["ratio"] == 1.0
    assert document["a"]["only"] == ["fake/full/n5"]
    medians = {cell["quantity"]: cell for cell in document["medians"]}
    assert medians["square"]["keys"] == 5
    assert medians["square"]["a"] == 4.0
    assert medians["square"]["b"] == 8.0
    assert medians["square"]["ratio"] == 2.5
    assert medians["case seconds"]["a"] > 0.0
    assert "path" not in medians
    assert cli.main(["bench", "compare", str(a), str(b)]) == 0
    assert "fake: median over keys" in capsys.readouterr().out


@pytest.mark.usefixtures("bench")
def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("fake", "other"):
        frame.run_benchmark(frame.load(name), tmp_path, quick=True)
    (tmp_path / "full").mkdir()
    frame.run_benchmark(frame.load("fake"), tmp_path / "full")
    (tmp_path / "text.jsonl").write_text("hello\nworld\n")
    (tmp_path / "empty.jsonl").write_text("")
    fake, other, full = (str(tmp_path / n) for n in ("fake.jsonl", "other.jsonl", "full/fake.jsonl"))
    out = ["--out", str(tmp_path)]
    for words, complaint in (
        (["bench", "nope"], "benchmark = 'nope': expected one of fake, other, all"),
        (["bench", "fake", "--jobs", "0", *out], "jobs = 0: out of range [1, 1024]"),
        (["bench", "fake", "--jobs", "many", *out], "Invalid value for '--jobs'"),
        (["bench", "fake", "--backend", "dask", *out], "backend = 'dask': expected one of loky, ray"),
        (["bench", "fake", "--resume", *out], f"{fake}: key = 'fake/quick/n0' is a quick row"),
        (["bench", "fake", "--out", fake], f"--out = '{fake}': not a folder"),
        (["bench", "compare", fake], "bench compare: expected two files of rows, got 1"),
        (["bench", "compare", fake, other], "different benchmarks"),
        (["bench", "compare", fake, full], "no key in common"),
        (["bench", "compare", fake, str(tmp_path / "no.jsonl")], f"{tmp_path}/no.jsonl: no such file"),
        (["bench", "compare", fake, str(tmp_path / "text.jsonl")], "text.jsonl: line 1 is no JSON"),
        (["bench", "compare", fake, str(tmp_path / "empty.jsonl")], "empty.jsonl: holds no finished row"),
    ):
        capsys.readouterr()
        assert cli.main(words) == cli.BAD_INPUT, words
        said = capsys.readouterr()
        assert said.out == ""
        (line,) = said.err.splitlines()
        assert line.startswith("clothgym bench: ")
        assert complaint in line
