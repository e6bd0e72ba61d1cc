"""The command line: exit codes, one line for a user's mistake, pure JSON, and the commands of the simulator."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_cases import COMMANDS, FAKE, crossing, write_obj

import clothgym as cg
from clothgym import cli

ROOT = Path(__file__).resolve().parents[1]


# Exit codes


def test_mistakes_are_one_line_and_exit_2(say, commands: Path) -> None:
    (commands / "fidelity.json").write_text('{"sweeps": 0}')
    (commands / "broken.json").write_text("{")
    (commands / "empty.obj").write_text("hello\n")
    (commands / "nan.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (commands / "ids.txt").write_text("0, 3 # fine\n77\n")
    write_obj(commands / "ok.obj", *crossing())
    for words, complaint in (
        (["nope"], "command = 'nope': expected one of absent, bench, broken"),
        (["run"], "Missing argument 'SCENE'"),
        (["run", "nope"], "scene = 'nope': expected one of"),
        (["run", "squares", "--bogus"], "No such option: --bogus"),
        (["run", "squares", "--seed", "x"], "'--seed'"),
        (["run", "squares", "--seed", "-1"], "--seed = -1: out of range"),
        (["run", "squares", "--seconds", "-1"], "--seconds = -1.0: out of range"),
        (["run", "squares", "--seconds", "nan"], "--seconds = nan: out of range"),
        (["run", "squares", "--set", "count"], "--set 'count': expected NAME=VALUE"),
        (["run", "squares", "--set", "count=1", "--set", "count=2"], "count is set twice"),
        (["run", "squares", "--set", "count=many"], "squares.count = 'many'"),
        (["run", "squares", "--set", "colour=1"], "squares.colour: unknown parameter"),
        (["run", "squares", "--fidelity", "best"], "fidelity = 'best'"),
        (["run", "squares", "--fidelity", "fidelity.json"], "fidelity.json: fidelity.sweeps = 0: out of range"),
        (["run", "squares", "--fidelity", "broken.json"], "broken.json: "),
        (["run", "squares", "--fidelity", "none.json"], "none.json: no such file"),
        (["run", "broken.json"], "broken.json: not a scene"),
        (["run", "squares", "--set", "count=1", "--record", "a.txt"], "'a.txt': a recording's name must end in .rrd"),
        (["run", "squares", "--set", "count=1", "--frames", "ok.obj"], "--frames = 'ok.obj': not a folder"),
        (["scenes", "nope"], "scene = 'nope'"),
        (["untangle", "ok.obj"], "Missing argument 'OUT'"),
        (["untangle", "none.obj", "b.obj"], "none.obj: no such file"),
        (["untangle", "ok.docx", "b.obj"], "ok.docx: cannot read '.docx'"),
        (["untangle", "ok.obj", "b.docx"], "b.docx: cannot write '.docx'"),
        (["untangle", "empty.obj", "b.obj"], "empty.obj: "),
        (["untangle", "nan.obj", "b.obj"], "nan.obj: vertices[0, 2] is nan"),
        (["untangle", "ok.obj", "b.obj", "--passes", "0"], "--passes = 0: out of range"),
        (["untangle", "ok.obj", "b.obj", "--strategy", "magic"], "strategy = 'magic'"),
        (["untangle", "ok.obj", "b.obj", "--fixed", "ids.txt"], "ids.txt: entry 2 = 77: expected a vertex id"),
        (["fails", "lines"], "first line second line"),
        (["fails", "folder"], "/: is a directory"),
        (["extra"], 'pip install "clothgym[cluster]"'),
    ):
        said = say(*words)
        assert said.code == cli.BAD_INPUT, words
        assert said.out == ""
        assert "Traceback" not in said.err
        (line,) = said.err.splitlines()
        assert line.startswith("clothgym")
        assert complaint in line
    assert not (commands / "b.obj").exists()


def test_other_exit_codes(say) -> None:
    assert say("fails", "nothing").code == cli.DONE
    assert say("fails", "negative").code == cli.FAILED
    stopped = say("fails", "stop")
    assert (stopped.code, stopped.err) == (130, "clothgym fails: stopped\n")
    diverged = say("fails", "diverged")
    assert diverged.code == cli.FAILED
    assert diverged.err.startswith("clothgym fails: positions are no longer finite after stage solve at t = 0.5")
    assert len(diverged.err.splitlines()) == 1
    bug = say("fails", "bug")
    assert bug.code == cli.FAILED
    assert bug.err == "clothgym fails: KeyError: 'key' (a defect of this program: --debug shows where)\n"


def test_debug_shows_the_traceback(say, monkeypatch: pytest.MonkeyPatch) -> None:
    for words in (["--debug", "fails", "bug"], ["fails", "bug", "--debug"]):
        said = say(*words)
        assert said.code == cli.FAILED
        assert "Traceback (most recent call last)" in said.err
        assert "fake_commands_plugin.py" in said.err
    monkeypatch.setenv("CLOTHGYM_DEBUG", "1")
    assert "Traceback" in say("run", "nope").err
    monkeypatch.setenv("CLOTHGYM_DEBUG", "0")
    assert "Traceback" not in say("run", "nope").err


def test_help_lists_what_loads_and_says_what_does_not(say) -> None:
    said = say("--help")
    assert said.code == 0
    for name in (*COMMANDS, "fails"):
        assert re.search(rf"\b{name}\b", said.out)
    told = said.err.splitlines()
    assert len(told) == 3
    assert any(line.startswith("clothgym extra: not available: ray ") for line in told)
    assert any(line.startswith("clothgym absent: not available: ModuleNotFoundError") for line in told)
    assert any(line.startswith("clothgym broken: not available: KeyError") for line in told)
    assert say().out == said.out
    for name in COMMANDS:
        one = say(name, "--help")
        assert one.code == 0
        assert one.err == ""
        assert "--json" in one.out


def test_version(say) -> None:
    said = say("--version")
    assert said.code == 0
    assert re.fullmatch(r"clothgym \S.*\n", said.out)
    assert said.err == ""


def test_registered_commands_are_found_by_the_program_itself(tmp_path: Path) -> None:
    info = tmp_path / "fake_commands_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fake_commands_plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[clothgym.commands]\nzz_fails = fake_commands_plugin:fails\n")
    (tmp_path / "fake_commands_plugin.py").write_text(FAKE.replace('"fails"', '"zz_fails"'))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    said = subprocess.run(
        [sys.executable, "-m", "clothgym", "zz_fails", "hello"], env=environment, capture_output=True, text=True
    )
    assert (said.returncode, said.stdout, said.stderr) == (0, "hello\n", "")
    said = subprocess.run(
        [sys.executable, "-m", "clothgym", "zz_fails", "bug"], env=environment, capture_output=True, text=True
    )
    assert said.returncode == cli.FAILED
    assert len(said.stderr.splitlines()) == 1


def test_the_command_line_imports_no_command() -> None:
    code = "import sys, clothgym.cli; print([m for m in sys.modules if m.startswith('clothgym.commands')])"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


# The commands


def test_doctor_knows_what_is_here(say) -> None:
    said = say("doctor", "--json")
    document = said.document
    assert document["cache"]["writable"] is True
    assert document["machine"]["cores"] >= 1
    assert said.code == (0 if document["ready"] else 1)
    if document["packages"]:  # installed, if only as editable
        found = {package["name"]: package for package in document["packages"]}
        assert found["numpy"]["version"] == np.__version__
        assert found["numpy"]["fits"] is True
        extras = {extra["name"]: extra for extra in document["extras"]}
        assert "all" not in extras
        for extra in extras.values():
            wanted = f'pip install "clothgym[{extra["name"]}]"' if extra["missing"] else None
            assert extra["install"] == wanted
    assert say("doctor").out.splitlines()[-1] == document["verdict"]


@pytest.mark.parametrize(
    ("requirement", "fits"),
    [
        ("numpy>=1.0", True),
        ("numpy<2,>=1.0", False),
        ("numpy>=99.0", False),
        ("no-such-package-anywhere", False),
        ("rich[jupyter]>=13", True),
    ],
)
def test_doctor_judges_versions(requirement: str, fits: bool) -> None:
    from clothgym.commands.doctor import _package

    assert _package(requirement)["fits"] is fits


def test_doctor_says_what_is_wrong(say, monkeypatch: pytest.MonkeyPatch) -> None:
    from clothgym.commands import doctor

    lines = ["numpy>=99", "not-there>=1", 'also-missing>=2; extra == "video"', 'rich>=1; extra == "plot"']
    monkeypatch.setattr(doctor, "_requirements", lambda: lines)
    said = say("doctor", "--json")
    document = said.document
    assert said.code == 1
    assert document["ready"] is False
    assert any(p.startswith(f"numpy {np.__version__} is installed, wanted >=99") for p in document["problems"])
    assert any(p.startswith("not-there is missing, wanted >=1: pip install") for p in document["problems"])
    extras = {extra["name"]: extra["install"] for extra in document["extras"]}
    assert extras == {"video": 'pip install "clothgym[video]"', "plot": None}
    assert document["verdict"].startswith("not ready: ")


def test_warmup_reaches_every_kernel(say) -> None:
    document = say("warmup", "--json").document
    assert document["not_compiled"] == []
    assert document["compiled"] == document["kernels"] > 20


def test_scenes_tells_parameters_and_stages(say) -> None:
    document = say("scenes", "--json").document
    assert [scene["name"] for scene in document["scenes"]] == list(cg.scenes.names())
    one = say("scenes", "squares", "--set", "count=2", "--json").document
    count = next(p for p in one["parameters"] if p["name"] == "count")
    assert (count["default"], count["low"]) == (25, 1)
    simulation = cg.Simulation(cg.scenes.make("squares", count=2))
    assert one["stages"] == simulation.pipeline.describe()
    shown = say("scenes", "squares").out
    assert "number of squares" in shown
    assert "contact substeps" in shown


def test_run_is_the_simulation(say) -> None:
    words = ("run", "hanging_sheet", "--set", "resolution=6", "--fidelity", "draft", "--seconds", "0.1", "--json")
    document = say(*words).document
    simulation = cg.Simulation(cg.scenes.make("hanging_sheet", resolution=6), fidelity="draft")
    simulation.reset(seed=0)
    steps = round(0.1 / simulation.scene.step)
    simulation.step(steps)
    assert document["steps"] == steps > 3
    assert document["state_hash"] == simulation.state_hash()
    assert document["simulated"] == simulation.time
    assert document["metrics"]["max_strain"] == simulation.metrics()["max_strain"]
    assert set(document["profile"]) == set(simulation.profile) != set()
    assert "max strain" in say(*words[:-1]).out


def test_run_takes_files_and_writes_pictures(say, commands: Path) -> None:
    from PIL import Image

    vertices, faces = crossing()
    scene = cg.Scene(cloths=[cg.Cloth((vertices, faces))], ground=-0.3, duration=0.05)
    (commands / "scene.json").write_text(scene.to_json())
    (commands / "fast.json").write_text('{"substeps": 2, "untangling": "none"}')
    words = ("run", "scene.json", "--fidelity", "fast.json", "--frames", "out/pictures", "--json")
    document = say(*words).document
    assert document["steps"] == 3
    names = sorted(path.name for path in (commands / "out" / "pictures").iterdir())
    assert names == [f"frame_{step:05d}.png" for step in range(4)]
    first = np.asarray(Image.open(commands / "out" / "pictures" / names[0]))
    assert first.shape == (480, 640, 3)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 100
    last = np.asarray(Image.open(commands / "out" / "pictures" / names[-1]))
    assert (first != last).any(axis=2).sum() > 500  # the sheets fall


def test_run_records_and_keeps_the_recording_when_stopped(commands: Path) -> None:
    pytest.importorskip("rerun")
    from clothgym.recording.rerun_read import read_recording

    words = ["run", "hanging_sheet", "--set", "resolution=8", "--seconds", "600", "--record", "r.rrd", "--json"]
    starter = (
        "import sys; from importlib.metadata import EntryPoint; from clothgym import cli\n"
        "cli.entry_points = lambda: {'run': EntryPoint('run', 'clothgym.commands.run:register', '')}\n"
        "sys.exit(cli.main(sys.argv[1:]))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", starter, *words],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    path, deadline = commands / "r.rrd", time.monotonic() + 60
    while not (path.exists() and path.stat().st_size > 150_000):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, out) == (cli.STOPPED, "")
    assert re.fullmatch(r"clothgym run: stopped at t = [\d.]+ s of 600 s; kept what there is of r\.rrd\n", err)
    recording = read_recording(path)
    stopped_at = float(err.split()[6])
    assert len(recording.sim_time) >= 2
    assert abs(float(recording.sim_time[-1]) - stopped_at) < 0.05
