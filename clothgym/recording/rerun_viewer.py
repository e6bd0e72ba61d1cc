"""Rerun's own program: its import as an extra, its command line, its viewer on the loopback."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from types import ModuleType

from clothgym.errors import MissingExtraError

# `python -m rerun_cli` drops the exit code (measured on 0.41), so its main function is called instead.
RERUN_CLI = (sys.executable, "-c", "import sys; from rerun_cli.__main__ import main; sys.exit(main())")


def import_rerun() -> ModuleType:
    """The rerun package, or MissingExtraError with the command that installs it."""
    try:
        import rerun
    except ImportError as error:
        raise MissingExtraError("rerun-sdk", "rerun") from error
    return rerun


def viewer_command(*arguments: str, port: int = 9876) -> list[str]:
    """Command line of a rerun viewer that listens on the loopback alone (its own default is every interface)."""
    return [*RERUN_CLI, *arguments, "--bind", "127.0.0.1", "--port", str(port)]


def start_viewer(port: int = 9876, *arguments: str, seconds: float = 20.0) -> subprocess.Popen[bytes] | None:
    """Starts a live viewer and waits until it listens; None when one listens there already.

    Raises:
        ValueError: the viewer ended or did not listen in time (no display, no graphics driver).
    """
    if _listens(port):
        return None
    import_rerun()
    process = subprocess.Popen(
        viewer_command(*arguments, "--hide-welcome-screen", port=port),
        env={**os.environ, "RERUN_APP_ONLY": "true"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and process.poll() is None:
        if _listens(port):
            time.sleep(0.5)  # a viewer without a display listens for a moment before it gives up
            if process.poll() is None:
                return process
            break
        time.sleep(0.05)
    code = process.poll()
    if code is None and hasattr(os, "killpg"):
        os.killpg(process.pid, signal.SIGTERM)  # the viewer is a child of that process
    state = "did not start in time" if code is None else f"ended at once (exit code {code})"
    raise ValueError(f"spawn = True: the rerun viewer {state}; it needs a display and a graphics driver")


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex(("127.0.0.1", port)) == 0
