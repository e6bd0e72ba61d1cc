"""Episodes: recorded without changing them, simulated again from the file alone, compared bit for bit."""

from __future__ import annotations

import json
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from clothgym_envs import recorder
from clothgym_envs.recorder import RerunRecorder, read_episode, replay
from tiny_env import ID, TinyEnv, TinySimulation, registered  # noqa: F401  for every test here

from clothgym.errors import SimulationError
from clothgym.fidelity import Fidelity
from clothgym.recording.episode import Episode, as_json, decode_array, encode_array, engine_digest, from_json_values
from clothgym.recording.rerun_read import read_recording

pytest.importorskip("rerun")


def play(env: gym.Env[Any, Any], steps: int = 12, seed: int | None = 5, options: Any = None) -> list[Any]:
    """What a user sees of an episode with fixed actions."""
    rng = np.random.default_rng(1)
    seen: list[Any] = [env.reset(seed=seed, options=options)]
    seen[0] = (seen[0][0].tobytes(), seen[0][1])
    for _ in range(steps):
        discrete = isinstance(env.action_space, gym.spaces.Discrete)
        action = int(rng.integers(5)) if discrete else rng.uniform(-0.9, 0.9, 3).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        state = env.unwrapped.simulation.state_hash()
        seen.append((observation.tobytes(), reward, terminated, truncated, info, state))
        if terminated or truncated:
            break
    return seen


def verify(path: Path) -> dict[str, Any]:
    episode, recording = read_episode(path)
    return replay(episode, recording.positions(len(episode)))


def test_a_recorder_changes_nothing(tmp_path: Path) -> None:
    plain = play(gym.make(ID))
    recorded = RerunRecorder(gym.make(ID), tmp_path / "ep_{episode:02d}.rrd")
    assert play(recorded) == plain
    assert play(recorded) == plain, "the second episode too"
    recorded.close()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ep_00.rrd", "ep_01.rrd"]


def test_what_the_file_holds(tmp_path: Path) -> None:
    env = RerunRecorder(gym.make(ID, level="hard"), tmp_path / "a.rrd")
    seen = play(env, steps=7)
    final = env.unwrapped.simulation.positions.astype(np.float32)
    env.close()
    episode, recording = read_episode(tmp_path / "a.rrd")
    assert episode.env_id == ID
    assert episode.kwargs == {"level": "hard"}
    assert (episode.seed, episode.episode_seed, episode.options) == (5, 5, None)
    assert episode.actions.dtype == np.float32
    assert episode.actions.shape == (7, 3)
    assert [h for *_, h in seen[1:]] == list(episode.hashes[1:])
    assert episode.rewards.tolist() == [row[1] for row in seen[1:]]
    assert episode.max_episode_steps == 30
    assert episode.fidelity == json.loads(Fidelity.preset("draft").to_json())
    assert episode.versions["engine"] == engine_digest()
    assert {"numpy", "numba", "python", "platform", "processor"} <= set(episode.versions)
    assert recording.complete
    assert recording.has_blueprint
    assert np.array_equal(recording.positions(7), final)
    assert recording.scalars["reward/depth"][1].tolist() == [0.0, *(row[4]["reward/depth"] for row in seen[1:])]
    assert recording.points["grippers"].keys() == set(range(8))
    assert len(recording.bodies["ball"].steps) == 8
    assert recording.documents["end"]["reason"] == "closed"


@pytest.mark.parametrize(
    ("kwargs", "seed", "options"),
    [
        ({}, 5, None),
        ({}, None, None),
        ({"discrete": True}, 6, None),
        ({"fidelity": Fidelity.preset("accurate")}, 7, None),
        ({"level": "hard"}, 8, {"variation": {"mass": np.float32(0.1)}}),
    ],
)
def test_an_episode_is_simulated_again_to_the_bit(
    tmp_path: Path, kwargs: dict[str, Any], seed: int | None, options: Any
) -> None:
    env = RerunRecorder(gym.make(ID, **kwargs), tmp_path / "a.rrd")
    play(env, seed=seed, options=options)
    env.close()
    result = verify(tmp_path / "a.rrd")
    assert result["first_difference"] is None
    assert result["equal"]
    assert result["steps"] == 12
    assert result["differing_versions"] == {}
    assert not result["fidelity_differs"]


def test_float64_actions_are_kept_in_full(tmp_path: Path) -> None:
    env = RerunRecorder(gym.make(ID), tmp_path / "a.rrd")
    env.reset(seed=1)
    given = np.random.default_rng(2).uniform(-1, 1, (6, 3))
    for index, action in enumerate(given):
        env.step(action.tolist() if index % 2 else action)
    env.close()
    episode, _ = read_episode(tmp_path / "a.rrd")
    assert episode.actions.tobytes() == given.tobytes()
    assert verify(tmp_path / "a.rrd")["equal"]


def test_truncation_and_termination_are_part_of_it(tmp_path: Path) -> None:
    env = RerunRecorder(gym.make(ID, max_episode_steps=9), tmp_path / "ep{episode}.rrd")
    assert play(env, steps=20)[-1][3]
    env.close()
    assert (tmp_path / "ep0.rrd").exists()
    episode, recording = read_episode(tmp_path / "ep0.rrd")
    assert (len(episode), episode.truncated, episode.terminated) == (9, True, False)
    assert recording.documents["end"]["reason"] == "truncated"
    assert verify(tmp_path / "ep0.rrd")["equal"]


def test_the_first_step_that_differs_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = RerunRecorder(gym.make(ID), tmp_path / "a.rrd")
    play(env)
    env.close()
    step = TinySimulation.step

    def one_bit_off(self: TinySimulation, push: np.ndarray) -> None:
        step(self, push)
        if round(self.time / 0.02) == 4:
            self._x[7, 1] = np.nextafter(self._x[7, 1], 1.0)

    monkeypatch.setattr(TinySimulation, "step", one_bit_off)
    result = verify(tmp_path / "a.rrd")
    assert not result["equal"]
    assert (result["first_difference"]["step"], result["first_difference"]["what"]) == (4, "state_hash")
    assert result["first_difference"]["recorded"] != result["first_difference"]["now"]
    monkeypatch.undo()
    monkeypatch.setattr(TinyEnv, "_observe", lambda self: self.simulation.positions[0].astype(np.float32))
    assert verify(tmp_path / "a.rrd")["equal"], "observations are not compared, the simulation is"


def test_a_difference_after_reset_and_in_rewards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = RerunRecorder(gym.make(ID), tmp_path / "a.rrd")
    play(env)
    env.close()
    episode, recording = read_episode(tmp_path / "a.rrd")
    changed = Episode(**{**vars(episode), "rewards": episode.rewards + 1e-12 * (np.arange(12) == 2)})
    assert replay(changed)["first_difference"]["what"] == "reward"
    assert replay(changed)["first_difference"]["step"] == 3
    moved = recording.positions(12).copy()
    moved[0, 0] += 1
    assert replay(episode, moved)["first_difference"]["what"] == "positions"
    other = Episode(**{**vars(episode), "episode_seed": 6})
    assert replay(other)["first_difference"]["step"] == 0
    now = recorder.environment_versions()
    monkeypatch.setattr(recorder, "environment_versions", lambda: {**now, "numpy": "1.0", "engine": "other"})
    assert replay(episode)["differing_versions"] == {
        "numpy": [now["numpy"], "1.0"],
        "engine": [now["engine"], "other"],
    }


def test_a_failing_step_leaves_the_actions_that_led_to_it(tmp_path: Path) -> None:
    env = RerunRecorder(gym.make(ID), tmp_path / "a.rrd")
    play(env, steps=4)
    with pytest.raises(SimulationError, match="speed"):
        env.step(np.ones(3, np.float32))
    episode, recording = read_episode(tmp_path / "a.rrd")
    assert len(episode) == 4
    assert episode.failed_action.tolist() == [1, 1, 1]
    assert episode.failure.startswith("SimulationError: speed")
    assert recording.documents["end"]["reason"] == "error"
    assert verify(tmp_path / "a.rrd")["equal"], "the same failure comes again"
    without = Episode(**{**vars(episode), "failed_action": np.zeros(3, np.float32)})
    difference = replay(without)["first_difference"]
    assert (difference["step"], difference["what"], difference["now"]) == (5, "failure", "none")


@pytest.mark.parametrize("action", [np.full(3, np.nan, np.float32), np.zeros(5, np.float32), "up"])
def test_a_bad_action_is_the_environments_matter(tmp_path: Path, action: Any) -> None:
    with pytest.raises(ValueError) as plain:
        play_one(gym.make(ID, disable_env_checker=True), action)
    env = RerunRecorder(gym.make(ID, disable_env_checker=True), tmp_path / "a.rrd")
    with pytest.raises(ValueError) as recorded:
        play_one(env, action)
    assert str(recorded.value) == str(plain.value)
    episode, _ = read_episode(tmp_path / "a.rrd")
    assert len(episode) == 1
    assert episode.failure.startswith("ValueError")


def play_one(env: gym.Env[Any, Any], action: Any) -> None:
    env.reset(seed=1)
    env.step(np.zeros(3, np.float32))
    env.step(action)


def test_an_episode_that_is_left_in_the_middle_is_kept(tmp_path: Path) -> None:
    env = RerunRecorder(gym.make(ID), tmp_path / "ep{episode}.rrd")
    play(env, steps=3)
    play(env, steps=5)
    env.close()
    env.close()
    lengths = [len(read_episode(tmp_path / f"ep{k}.rrd")[0]) for k in (0, 1)]
    assert lengths == [3, 5]
    assert read_recording(tmp_path / "ep0.rrd").documents["end"]["reason"] == "reset"


def test_ctrl_c_is_no_failure_of_the_episode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = RerunRecorder(gym.make(ID), tmp_path / "a.rrd")
    play(env, steps=2)

    def interrupted(self: TinySimulation, push: np.ndarray) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(TinySimulation, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        env.step(np.zeros(3, np.float32))
    monkeypatch.undo()
    episode, recording = read_episode(tmp_path / "a.rrd")
    assert (episode.failure, recording.documents["end"]["reason"]) == ("", "interrupted")
    assert verify(tmp_path / "a.rrd")["equal"]


def test_bad_recorders_are_refused(tmp_path: Path) -> None:
    for template in ("a_{step}.rrd", "a.mp4", "{episode:zz}.rrd"):
        with pytest.raises(ValueError, match="path_template"):
            RerunRecorder(gym.make(ID), template)
    scaled = gym.wrappers.RescaleAction(gym.make(ID), np.float32(-2), np.float32(2))
    with pytest.raises(ValueError, match="RescaleAction changes actions"):
        RerunRecorder(scaled, tmp_path / "a.rrd")
    env = RerunRecorder(gym.make(ID), tmp_path / "a.rrd")
    play(env, steps=1)
    with pytest.raises(ValueError, match="would replace"):
        env.reset()
    assert len(read_episode(tmp_path / "a.rrd")[0]) == 1, "the first episode is still there"
    pole = RerunRecorder(gym.make("CartPole-v1"), tmp_path / "b.rrd")
    with pytest.raises(ValueError, match="no clothgym simulation"):
        pole.reset()
    named = RerunRecorder(gym.make(ID), tmp_path / "c.rrd", spawn=False)
    assert named.spec.additional_wrappers[-1].kwargs == {"path_template": str(tmp_path / "c.rrd"), "spawn": False}


def test_what_a_file_cannot_hold_is_said_when_it_matters(tmp_path: Path) -> None:
    env = RerunRecorder(gym.make(ID, hook=lambda: None), tmp_path / "a.rrd")
    play(env, options={"variation": {}, "callback": print})
    env.close()
    episode, _ = read_episode(tmp_path / "a.rrd")
    assert len(episode.obstacles) == 2
    with pytest.raises(ValueError, match=r"cannot be replayed: kwargs\['hook'\]: a function cannot be recorded"):
        replay(episode)


EVIL = "import pathlib; pathlib.Path({marker!r}).touch()"


@pytest.mark.parametrize(
    "env_id",
    ["evil_module:clothgym/TinyNet-v7", "CartPole-v1", "evil_module:CartPole-v1", "clothgym/None-v0", "clothgym/../x"],
)
def test_a_file_cannot_name_what_is_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, env_id: str) -> None:
    marker = tmp_path / "was imported"
    (tmp_path / "evil_module.py").write_text(EVIL.format(marker=str(marker)))
    monkeypatch.syspath_prepend(tmp_path)
    env = RerunRecorder(gym.make(ID), tmp_path / "a.rrd")
    play(env, steps=2)
    env.close()
    episode, _ = read_episode(tmp_path / "a.rrd")
    with pytest.raises(ValueError, match="env_id"):
        replay(Episode(**{**vars(episode), "env_id": env_id}))
    assert not marker.exists()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"level": "nightmare"}, "nightmare"),
        ({"unknown": 1}, "unknown"),
        ({"id": "CartPole-v1"}, "id"),
        ({"fidelity": {"__json__": "Popen", "value": "ls"}}, "Popen"),
        ({"fidelity": {"__json__": "Fidelity", "value": '{"substeps": -1}'}}, "substeps"),
    ],
)
def test_keyword_arguments_of_a_file_are_checked(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replay(tiny_episode(kwargs=kwargs))


def tiny_episode(**changes: Any) -> Episode:
    values: dict[str, Any] = {
        "env_id": ID,
        "kwargs": {},
        "seed": 1,
        "episode_seed": 1,
        "options": None,
        "actions": np.array([[0.1, -0.0, 5e-324], [np.nextafter(1, 2), np.inf, np.nan]]),
        "hashes": ("a", "b", "c"),
        "rewards": np.array([0.1 + 0.2, -0.0]),
    }
    return Episode(**{**values, **changes})


@pytest.mark.parametrize("dtype", ["float32", "float64", "int64"])
def test_json_keeps_every_bit(dtype: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    actions = rng.integers(0, 256, (5, 2 * np.dtype(dtype).itemsize), dtype=np.uint8).view(dtype)
    episode = tiny_episode(
        actions=actions,
        hashes=tuple("abcdef"),
        rewards=rng.normal(size=5),
        failed_action=actions[0],
        fidelity={"substeps": 4},
        options={"variation": {"mass": 0.1}},
        versions={"numpy": "2"},
        truncated=True,
    )
    (tmp_path / "a.json").write_text(episode.to_json())
    again = Episode.load(tmp_path / "a.json")
    for name, value in vars(episode).items():
        found = getattr(again, name)
        if isinstance(value, np.ndarray):
            assert (found.dtype, found.tobytes(), found.shape) == (value.dtype, value.tobytes(), value.shape)
        else:
            assert found == value, name
    assert again.to_json() == episode.to_json()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(format="zip"), "format"),
        (lambda d: d.update(format_version=2), "format_version"),
        (lambda d: d.pop("actions"), "actions"),
        (lambda d: d.update(surprise=1), "surprise"),
        (lambda d: d.update(env_id=5), "env_id"),
        (lambda d: d.update(seed=-1), "seed"),
        (lambda d: d.update(episode_seed=True), "episode_seed"),
        (lambda d: d.update(kwargs=[1]), "kwargs"),
        (lambda d: d.update(hashes=["a"]), "hashes"),
        (lambda d: d.update(hashes="abc"), "hashes"),
        (lambda d: d.update(hashes=[1, 2, 3]), "hashes"),
        (lambda d: d.update(terminated=1), "terminated"),
        (lambda d: d["actions"].update(dtype="object"), "dtype"),
        (lambda d: d["actions"].update(shape=[10**9, 10**9]), "bytes do not fill"),
        (lambda d: d["actions"].update(shape=[-2, -3]), "shape"),
        (lambda d: d["actions"].update(base64="!!"), "base64"),
        (lambda d: d["rewards"].update(dtype="float32"), "rewards"),
        (lambda d: d.update(action_shape=[7]), "action_shape"),
        (lambda d: d.update(versions={"numpy": 2}), "versions"),
    ],
)
def test_damaged_json_is_refused_by_field(change: Callable[[dict[str, Any]], Any], message: str) -> None:
    document = json.loads(tiny_episode().to_json())
    change(document)
    with pytest.raises(ValueError, match=message):
        Episode.from_json(json.dumps(document))


def test_text_that_is_no_json_is_refused(tmp_path: Path) -> None:
    for text in ("", "[]", "{", "[" * 100_000, "null"):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(ValueError, match=r"a\.json: episode"):
            Episode.load(tmp_path / "a.json")


def test_values_that_json_can_hold() -> None:
    given = {"a": (np.float32(0.5), np.int64(3), np.array([1.5, 2.0])), "b": None, "c": Fidelity.preset("draft")}
    found = as_json(given, "options")
    again = from_json_values(json.loads(json.dumps(found)), "options", {"Fidelity": Fidelity.from_json})
    assert [type(v) for v in again["a"]] == [np.float32, np.int64, np.ndarray]
    assert (again["a"][:2], again["a"][2].tolist(), again["b"]) == ([0.5, 3], [1.5, 2.0], None)
    assert again["c"] == given["c"]
    assert found["c"] == {"__json__": "Fidelity", "value": Fidelity.preset("draft").to_json()}
    for bad in ({"x": float("nan")}, {"x": object()}, {1: 2}, {"x": {3}}):
        with pytest.raises(ValueError, match="options"):
            as_json(bad, "options")
    array = np.array([[1.5, -0.0]], np.float32)
    assert decode_array(encode_array(array)).tobytes() == array.tobytes()


def test_the_recorder_module_imports_no_rerun() -> None:
    code = """
        import sys
        import clothgym_envs.recorder, clothgym_envs.commands
        assert "rerun" not in sys.modules
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True)
