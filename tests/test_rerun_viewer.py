"""The viewer of Rerun: when it is imported, what it is started with, and live runs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clothgym.errors import MissingExtraError
from clothgym.recording import rerun_viewer
from clothgym.recording.rerun_log import RerunLog
from clothgym.recording.rerun_read import read_recording, viewer_command

pytest.importorskip("rerun")


def test_rerun_switched_off_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(ValueError, match="RERUN=off"):
        RerunLog(tmp_path / "a.rrd")


def test_rerun_is_imported_only_when_a_recording_starts() -> None:
    code = """
        import sys
        import clothgym.recording.rerun_log, clothgym.recording.rerun_read, clothgym.recording.episode
        assert "rerun" not in sys.modules and "pyarrow" not in sys.modules and "gymnasium" not in sys.modules
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True)


def test_a_missing_extra_is_named_with_its_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "a.rrd").write_bytes(b"RRF2")
    monkeypatch.setitem(sys.modules, "rerun", None)
    for call in (lambda: RerunLog(tmp_path / "b.rrd"), lambda: read_recording(tmp_path / "a.rrd")):
        with pytest.raises(MissingExtraError, match=r'pip install "clothgym\[rerun\]"'):
            call()


def test_the_viewer_listens_on_the_loopback_alone() -> None:
    command = viewer_command("file.rrd", port=4321)
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    assert command[command.index("--port") + 1] == "4321"


def free_port() -> int:
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_a_viewer_that_cannot_start_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_viewer, "viewer_command", lambda *_, port: [sys.executable, "-c", "raise SystemExit(3)"])
    with pytest.raises(ValueError, match=r"viewer ended at once \(exit code 3\)"):
        rerun_viewer.start_viewer(free_port())


def test_a_live_run_is_also_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """With a server that takes what the viewer would take: the same data goes to the viewer and to the file."""
    port = free_port()
    command = [sys.executable, "-m", "rerun_cli", "--serve-grpc", "--bind", "127.0.0.1", "--port", str(port)]
    monkeypatch.setattr(rerun_viewer, "viewer_command", lambda *_, port: command)
    started: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def remember(*args: Any, **kwargs: Any) -> subprocess.Popen[bytes]:
        started.append(start(*args, **kwargs))
        return started[-1]

    monkeypatch.setattr(rerun_viewer.subprocess, "Popen", remember)
    try:
        with RerunLog(tmp_path / "live.rrd", spawn=True, port=port) as log:
            log.open([("sheet", [[0, 1, 2]], None)])
            log.log_step(0, 0.0, np.eye(3))
    finally:
        for process in started:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait(timeout=20)
    monkeypatch.undo()
    assert read_recording(tmp_path / "live.rrd").steps.tolist() == [0]
