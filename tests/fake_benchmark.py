"""A benchmark that costs nothing, installed like any other; its fixtures are in `conftest`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from joblib.externals.loky import get_reusable_executor

from clothgym import cli
from clothgym.benchmarks import Benchmark, frame

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
    get_reusable_executor().shutdown(wait=True)  # its processes have the path of whatever file started them
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


def lines_of(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.fixture
def bench(plugin: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command line with `bench` alone, in this process, and the two fake benchmarks."""
    command = {"bench": EntryPoint("bench", "clothgym.commands.bench:register", cli.ENTRY_POINTS)}
    monkeypatch.setattr(cli, "entry_points", lambda: command)
    entries = {n: EntryPoint(n, f"fake_bench_plugin:{a}", "") for n, a in (("fake", "benchmark"), ("other", "other"))}
    monkeypatch.setattr(frame, "entry_points", lambda: entries)
