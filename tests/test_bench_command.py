"""The page and tables of benchmarks, and the command `bench`."""

from __future__ import annotations

import base64
import json
import math
import os
import re
from pathlib import Path

import numpy as np
import pytest
from fake_benchmark import child, lines_of

from clothgym import cli
from clothgym.benchmarks import Benchmark, Page, Table, frame, report

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
