"""`record` and `replay` from the command line."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from clothgym_envs import commands
from clothgym_envs.recorder import read_episode
from tiny_env import ID, TinySimulation, registered  # noqa: F401  for every test here

from clothgym import cli
from clothgym.recording.rerun_log import RerunLog

pytest.importorskip("rerun")


class RandomPolicy:
    def reset(self, env: gym.Env[Any, Any]) -> None:
        self.rng = np.random.default_rng(3)

    def act(self, observation: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        return self.rng.uniform(-0.9, 0.9, 3).astype(np.float32)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs a command line as `clothgym` would: exit code, standard output, standard error."""

    entries = {
        "record": SimpleNamespace(load=lambda: commands.register_record),
        "replay": SimpleNamespace(load=lambda: commands.register_replay),
    }
    monkeypatch.setattr(cli, "entry_points", lambda: entries)

    def maker(env_id: str, name: str) -> Any:
        if name != "random":
            raise ValueError(f"policy = {name!r}: expected random")
        return RandomPolicy

    monkeypatch.setattr("clothgym_envs.evaluation.policy_maker", maker)

    def call(*words: Any) -> tuple[int, str, str]:
        code = cli.main([str(word) for word in words])
        out, err = capsys.readouterr()
        return code, out, err

    return call


def test_record_and_replay_from_the_command_line(tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "deep" / "ep.rrd"
    code, out, err = run("record", "TinyNet-v7", "--policy", "random", "--seed", 20_000, path, "--json")
    assert (code, err) == (0, "")
    document = json.loads(out)
    steps = document["steps"]
    assert (document["env_id"], document["ended"]) == (ID, "terminated")
    assert 15 < steps < 30
    assert document["episode_seed"] == 20_000
    code, out, err = run("replay", path, "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["actions"] == steps
    assert json.loads(out)["return"] == document["return"]
    code, out, _ = run("replay", path, "--verify", "--json")
    assert code == 0
    assert json.loads(out)["verify"] == {
        "equal": True,
        "first_difference": None,
        "steps": steps,
        "differing_versions": {},
        "fidelity_differs": False,
    }
    code, out, _ = run("replay", path, "--verify")
    assert code == 0
    assert "equal, bit for bit" in out
    monkeypatch.setattr(TinySimulation, "stiffness", 400.0001)
    code, out, _ = run("replay", path, "--verify", "--json")
    assert code == 1
    difference = json.loads(out)["verify"]["first_difference"]
    assert (difference["step"], difference["what"]) == (1, "state_hash")


def test_bad_input_is_one_line_and_exit_code_2(tmp_path: Path, run: Any) -> None:
    (tmp_path / "text.rrd").write_text("hello")
    with RerunLog(tmp_path / "scene.rrd") as log:
        log.open([("sheet", [[0, 1, 2]], None)])
        log.log_step(0, 0.0, np.eye(3))
    out = tmp_path / "o.rrd"
    for words, message in (
        (("replay", tmp_path / "none.rrd"), "no such file"),
        (("replay", tmp_path / "text.rrd", "--verify"), "not a rerun recording"),
        (("replay", tmp_path / "scene.rrd", "--verify"), "holds no episode"),
        (("record", "TinyNat-v7", out), "did you mean clothgym/TinyNet-v7"),
        (("record", ID, out, "--policy", "genius"), "policy = 'genius'"),
        (("record", ID, out, "--policy", "random", "--level", "nightmare"), "level = 'nightmare'"),
        (("record", ID, tmp_path / "o.mp4", "--policy", "random"), "must end in .rrd"),
        (("record", ID, tmp_path / "{episode}.rrd", "--policy", "random"), "braces"),
    ):
        code, stdout, stderr = run(*words)
        assert (code, stdout) == (2, ""), (words, stderr)
        assert message in stderr
        assert stderr.count("\n") == 1
        assert "Traceback" not in stderr
    assert run("replay", tmp_path / "scene.rrd")[0] == 0, "a recording without an episode can be looked at"


def test_ctrl_c_while_recording_keeps_the_finished_steps(
    tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    act = RandomPolicy.act

    def interrupted(self: RandomPolicy, observation: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        if info["reward/depth"] != 0.0:
            raise KeyboardInterrupt
        return act(self, observation, info)

    monkeypatch.setattr(RandomPolicy, "act", interrupted)
    code, out, err = run("record", ID, tmp_path / "a.rrd", "--policy", "random")
    assert (code, out) == (130, "")
    assert "1 steps are in" in err
    assert len(read_episode(tmp_path / "a.rrd")[0]) == 1


def test_viewing_needs_no_simulation_and_stays_on_the_loopback(
    tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("record", ID, tmp_path / "a.rrd", "--policy", "random", "--steps", 3)
    called: list[list[str]] = []

    def viewer(command: list[str], **_: Any) -> SimpleNamespace:
        called.append(command)
        return SimpleNamespace(returncode=0)

    real = subprocess.run
    monkeypatch.setattr(subprocess, "run", lambda c, **k: viewer(c) if "--bind" in c else real(c, **k))
    assert run("replay", tmp_path / "a.rrd", "--view")[0] == 0
    assert str(tmp_path / "a.rrd") in called[0]
    assert called[0][called[0].index("--bind") + 1] == "127.0.0.1"
