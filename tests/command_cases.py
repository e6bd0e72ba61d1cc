"""The command line with the real commands and some that fail, and meshes for it; its fixtures are in `conftest`."""

from __future__ import annotations

import json
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import clothgym as cg
from clothgym import cli

COMMANDS = ("bench", "doctor", "run", "scenes", "untangle", "warmup")

FAKE = '''
import signal
import sys

import typer

import clothgym as cg


def fails(app):
    @app.command("fails")
    def fails(how: str):
        """Fails [in] every way."""
        if how == "stop":
            signal.raise_signal(signal.SIGINT)
        if how == "bug":
            return {}["key"]
        if how == "diverged":
            raise cg.SimulationError("solve", "positions are no longer finite", 0.5, "take more substeps")
        if how == "lines":
            raise ValueError("first line\\\\n   second line")
        if how == "folder":
            open("/")
        if how == "pipe":
            raise BrokenPipeError
        if how == "negative":
            raise typer.Exit(1)
        print(how)


def lacks_extra(app):
    import ezdxf_is_called_otherwise
    raise AssertionError


def broken(app):
    raise KeyError("defect")
'''.replace("\\\\n", "\\n")


def entry(name: str, value: str) -> EntryPoint:
    return EntryPoint(name, value, cli.ENTRY_POINTS)


@pytest.fixture
def commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The real commands and some that fail, whatever is installed; works in an empty folder."""
    (tmp_path / "plugin").mkdir()
    text = FAKE.replace("ezdxf_is_called_otherwise", "ray.absent")
    (tmp_path / "plugin" / "fake_commands_plugin.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path / "plugin"))
    sys.modules.pop("fake_commands_plugin", None)
    found = {name: entry(name, f"clothgym.commands.{name}:register") for name in COMMANDS}
    found |= {n: entry(n, f"fake_commands_plugin:{a}") for n, a in (("fails", "fails"), ("broken", "broken"))}
    found["extra"] = entry("extra", "fake_commands_plugin:lacks_extra")
    found["absent"] = entry("absent", "no_such_module_anywhere:register")
    monkeypatch.setattr(cli, "entry_points", lambda: dict(sorted(found.items())))
    monkeypatch.delenv("CLOTHGYM_DEBUG", raising=False)
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    return work


class Spoken:
    """What a command line said, and its exit code."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err

    @property
    def document(self) -> dict:
        return json.loads(self.out)


@pytest.fixture
def say(commands: Path, capsys: pytest.CaptureFixture[str]) -> object:
    def say(*words: str) -> Spoken:
        capsys.readouterr()
        code = cli.main(words)
        captured = capsys.readouterr()
        return Spoken(code, captured.out, captured.err)

    return say


def crossing(shift: tuple[float, float, float] = (0.013, 0.007, 0.031)) -> tuple[np.ndarray, np.ndarray]:
    """Two sheets of 4 x 4 cells, one slanted through the other."""
    flat = cg.grid(0.4, 0.4, 4, 4)
    first = np.asarray(flat.vertices)
    other = first + np.array(shift)
    other[:, 1] += 0.4 * other[:, 0]
    faces = np.asarray(flat.faces)
    return np.concatenate([first, other]), np.concatenate([faces, faces + len(first)])


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    """An OBJ with everything that makes loaders split and reorder vertices."""
    lines = ["# a garment", "mtllib cloth.mtl", "o front"]
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += ["v 9.0 9.0 9.0", "vt 0 0", "vt 1 0", "vt 0.5 1", "vn 0 1 0", "usemtl cotton"]
    for number, triangle in enumerate(faces.tolist()):
        if number == 20:
            lines += ["g sleeve", "usemtl silk", "s off"]
        lines.append("f " + " ".join(f"{vertex + 1}/{(vertex + number) % 3 + 1}/1" for vertex in triangle))
    path.write_text("\n".join(lines) + "\n")
    return path
