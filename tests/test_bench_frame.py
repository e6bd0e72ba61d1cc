"""The frame of the benchmarks: rows survive kills and are never repeated or lost, and failures become rows."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import time
import tomllib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from fake_benchmark import ROOT, child, lines_of

from clothgym import cli
from clothgym.benchmarks import Benchmark, Case, frame, machine


def wait_for_rows(path: Path, count: int) -> None:
    """Until the file holds that many whole lines."""
    deadline = time.monotonic() + 60
    while not (path.exists() and path.read_bytes().count(b"\n") >= count):
        assert time.monotonic() < deadline, "no rows"
        time.sleep(0.01)


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
