"""Records episodes as rerun files that hold all it takes to simulate them again, and replays them bit for bit."""

from __future__ import annotations

import importlib
import json
import math
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from clothgym.fidelity import Fidelity
from clothgym.recording.episode import (
    Episode,
    as_json,
    differing_versions,
    environment_versions,
    episode_from,
    from_json_values,
)
from clothgym.recording.rerun_log import RerunLog
from clothgym.recording.rerun_read import Recording, read_recording

REPLAYABLE_ID = re.compile(r"clothgym/[A-Za-z0-9_]+-v[0-9]+")
"""Only these are made again from a file: another id could name a module to import."""

_CHANGES_ACTIONS = ("StickyAction", "DelayAction", "RepeatAction", "Autoreset")
_SETUP = ("env_id", "kwargs", "seed", "episode_seed", "options", "max_episode_steps", "fidelity", "wrappers")


class RerunRecorder(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Writes every episode into a rerun file of its own; reads the simulation, never changes it.

    A file starts at `reset`, gets every step, and is finished when the episode ends, when the next one starts, at
    `close`, or when a step raises; the actions are on disk before they are simulated, so that even a crash leaves
    them. `clothgym replay FILE --verify` simulates it again. Put it directly around what `gymnasium.make` returns:
    what stands between recorder and environment is not in the file.

    Args:
        env: a clothgym environment (`env.unwrapped.simulation` is a Simulation).
        path_template: file of an episode; `{episode}` is its number, from 0. An old file of that name is replaced.
        spawn: also show the episodes in a live viewer on the loopback.

    Raises:
        ValueError: a template that is no file name, a wrapper inside that changes actions; at the first reset: no
            clothgym environment, a file that cannot be written.
        MissingExtraError: rerun-sdk is not installed.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        path_template: str | os.PathLike[str] = "logs/ep_{episode:05d}.rrd",
        spawn: bool = False,
    ) -> None:
        template = os.fspath(path_template)
        gym.utils.RecordConstructorArgs.__init__(self, path_template=template, spawn=spawn)
        gym.Wrapper.__init__(self, env)
        self._template = template
        self._spawn = bool(spawn)
        self._path_of(0)
        inner = _wrapper_names(env)
        for name, layer in inner:
            if isinstance(layer, gym.ActionWrapper) or name in _CHANGES_ACTIONS:
                raise ValueError(f"env: {name} changes actions: put RerunRecorder directly around gymnasium.make(...)")
        self._wrappers = tuple(name for name, _ in inner)
        self.episode = -1
        self.path: Path | None = None
        self._log: RerunLog | None = None
        self._step = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Finishes the last recording and starts the next one."""
        self._finish(reason="reset")
        observation, info = self.env.reset(seed=seed, options=options)
        simulation = getattr(self.env.unwrapped, "simulation", None)
        if simulation is None:
            raise ValueError(f"env: {type(self.env.unwrapped).__name__} has no clothgym simulation to record")
        self.episode += 1
        path = self._path_of(self.episode)
        if path == self.path:
            raise ValueError(f"path_template = '{self._template}': needs {{episode}}, or this episode would replace it")
        self.path, self._step = path, 0
        log = RerunLog(path, spawn=self._spawn, recording_id=None)
        log.open_simulation(simulation)
        log.log_document("episode", self._setup(seed, options))
        self._log = log
        self._log_state(info, 0.0, False, False)
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step; its action is on disk before it is simulated."""
        if self._log is not None and np.shape(action) == self.action_space.shape and not _holds_nan(action):
            self._log.log_action(self._step + 1, self._simulation.time, action)
        try:
            observation, reward, terminated, truncated, info = self.env.step(action)
        except Exception as error:
            self._finish(reason="error", failure=f"{type(error).__name__}: {error}"[:2000])
            raise
        except BaseException:  # Ctrl-C: not a failure of the episode
            self._finish(reason="interrupted")
            raise
        if self._log is not None:
            self._step += 1
            self._log_state(info, float(reward), bool(terminated), bool(truncated))
            if terminated or truncated:
                self._finish(reason="terminated" if terminated else "truncated")
        return observation, float(reward), terminated, truncated, info

    def close(self) -> None:
        """Finishes the recording and closes the environment."""
        self._finish(reason="closed")
        super().close()

    @property
    def _simulation(self) -> Any:
        return self.env.unwrapped.simulation  # type: ignore[attr-defined]

    def _path_of(self, episode: int) -> Path:
        try:
            path = Path(self._template.format(episode=episode))
        except (KeyError, IndexError, ValueError, AttributeError) as error:
            raise ValueError(
                f"path_template = '{self._template}': only {{episode}} may stand in it ({error})"
            ) from None
        if path.suffix != ".rrd":
            raise ValueError(f"path_template = '{self._template}': must end in .rrd")
        return path

    def _setup(self, seed: int | None, options: dict[str, Any] | None) -> dict[str, Any]:
        """The document that a replay starts from."""
        base, spec = self.env.unwrapped, self.env.spec
        obstacles: list[str] = []
        kwargs = _json_or_note(dict(spec.kwargs) if spec is not None else {}, "kwargs", obstacles)
        if spec is None:
            obstacles.append("the environment was not made by gymnasium.make")
        episode_seed = getattr(base, "episode_seed", None)
        if episode_seed is None:
            obstacles.append("the environment reports no episode_seed")
        return {
            "env_id": spec.id if spec is not None else type(base).__name__,
            "kwargs": kwargs,
            "max_episode_steps": spec.max_episode_steps if spec is not None else None,
            "wrappers": list(self._wrappers),
            "level": str(kwargs.get("level", getattr(base, "level", ""))),
            "fidelity": _fidelity_of(self.env),
            "seed": None if seed is None else int(seed),
            "episode_seed": 0 if episode_seed is None else int(episode_seed),
            "options": None if options is None else _json_or_note(dict(options), "options", obstacles),
            "action_shape": list(self.action_space.shape or ()),
            "obstacles": obstacles,
            "versions": environment_versions(),
        }

    def _log_state(self, info: Mapping[str, Any], reward: float, terminated: bool, truncated: bool) -> None:
        assert self._log is not None
        simulation = self._simulation
        grippers = getattr(self.env.unwrapped, "gripper_positions", None)
        self._log.log_simulation(
            self._step,
            simulation,
            scalars={"reward": reward, **_numbers(info)},
            points=None if grippers is None else {"grippers": grippers},
            outcome={
                "state_hash": simulation.state_hash(),
                "reward": reward,
                "terminated": terminated,
                "truncated": truncated,
            },
        )

    def _finish(self, reason: str, failure: str = "") -> None:
        log, self._log = self._log, None
        if log is not None:
            log.close(reason=reason, failure=failure)


def _wrapper_names(env: gym.Env[Any, Any]) -> list[tuple[str, gym.Env[Any, Any]]]:
    """The wrappers from the outermost to the environment itself (exclusive)."""
    found: list[tuple[str, gym.Env[Any, Any]]] = []
    while isinstance(env, gym.Wrapper):
        found.append((type(env).__name__, env))
        env = env.env
    return found


def _fidelity_of(env: gym.Env[Any, Any]) -> dict[str, Any] | None:
    """The environment's fidelity in full, or None when it tells none."""
    fidelity = getattr(env.unwrapped, "fidelity", None)
    return json.loads(fidelity.to_json()) if isinstance(fidelity, Fidelity) else None


def _numbers(info: Mapping[str, Any]) -> dict[str, float]:
    """The entries of an info that are single numbers."""
    kinds = (bool, int, float, np.bool_, np.integer, np.floating)
    return {name: float(value) for name, value in info.items() if isinstance(value, kinds)}


def _holds_nan(action: Any) -> bool:
    """Whether an action is the environment's to refuse: no file holds NaN."""
    values = np.asarray(action)
    return values.dtype.kind == "f" and bool(np.isnan(values).any())


def _json_or_note(values: dict[str, Any], name: str, obstacles: list[str]) -> dict[str, Any]:
    """JSON values; what JSON cannot hold is left out and noted as an obstacle to a replay."""
    kept = {}
    for key, value in values.items():
        try:
            kept[str(key)] = as_json(value, f"{name}[{key!r}]")
        except ValueError as error:
            obstacles.append(str(error))
    return kept


# ---- replay ----


def read_episode(source: str | os.PathLike[str] | Recording, partial: bool = False) -> tuple[Episode, Recording]:
    """The episode that a recording holds, and the recording; reads the file unless it was read already.

    Raises:
        ValueError: one line naming the file: no recording, damaged, cut short (unless `partial`), or without episode.
    """
    recording = source if isinstance(source, Recording) else read_recording(source, partial=partial)
    path = recording.path
    setup = recording.documents.get("episode")
    if setup is None:
        raise ValueError(f"{path}: holds no episode (it was not written by RerunRecorder)")
    outcomes, steps = recording.outcomes, [int(k) for k in recording.steps]
    hashes = outcomes.get("state_hash", [])
    count = len(hashes) - 1
    if count < 0 or steps != list(range(count + 1)) or len(outcomes.get("reward", [])) != count + 1:
        raise ValueError(f"{path}: corrupted: its steps are not 0 to {max(count, 0)}")
    if [int(k) for k in recording.action_steps[: count + 1]] != list(range(1, len(recording.actions) + 1))[: count + 1]:
        raise ValueError(f"{path}: corrupted: its actions are not numbered from 1")
    if len(recording.actions) < count:
        raise ValueError(f"{path}: corrupted: {len(recording.actions)} actions for {count} steps")
    end = recording.documents.get("end", {})
    values = {name: setup[name] for name in (*_SETUP, "action_shape", "obstacles", "versions") if name in setup}
    failed = bool(end.get("failure")) and len(recording.actions) == count + 1
    values |= {
        "actions": recording.actions[:count] if count else np.empty((0, recording.actions.shape[1]), np.float32),
        "failed_action": recording.actions[count] if failed else None,
        "hashes": hashes,
        "rewards": np.array(outcomes["reward"][1:], dtype=np.float64),
        "terminated": bool(outcomes["terminated"][-1]),
        "truncated": bool(outcomes["truncated"][-1]),
        "failure": end.get("failure", ""),
    }
    try:
        return episode_from(values), recording
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def make_again(episode: Episode) -> gym.Env[Any, Any]:
    """The environment of an episode. Nothing that a file names is imported: only clothgym's own ids are made.

    Raises:
        ValueError: another id, an unknown one, or something that the recording could not keep.
    """
    if not REPLAYABLE_ID.fullmatch(episode.env_id):
        raise ValueError(f"env_id = {episode.env_id!r}: only environments of clothgym can be replayed from a file")
    if episode.obstacles:
        raise ValueError(f"cannot be replayed: {episode.obstacles[0]}")
    importlib.import_module("clothgym_envs")
    if episode.env_id not in gym.registry:
        raise ValueError(f"env_id = {episode.env_id!r}: this version of clothgym has no such environment")
    kwargs = from_json_values(episode.kwargs, "kwargs", {"Fidelity": Fidelity.from_json})
    kwargs.pop("render_mode", None)  # pictures are no part of an episode
    foreign = {"id", "max_episode_steps", "vectorization_mode", "disable_env_checker"} & set(kwargs)
    if foreign:
        raise ValueError(f"kwargs: {sorted(foreign)[0]!r} does not belong to the environment")
    try:
        return gym.make(episode.env_id, max_episode_steps=episode.max_episode_steps, disable_env_checker=True, **kwargs)
    except Exception as error:  # what a file asks for may be anything
        raise ValueError(f"{episode.env_id} with {episode.kwargs} cannot be made: {error}") from None


def replay(
    episode: Episode,
    positions: ArrayLike | None = None,
    advance: Callable[[int], None] | None = None,
) -> dict[str, Any]:
    """Simulates an episode again and compares every step, bit for bit, up to the first difference.

    Args:
        episode: what `read_episode` gave.
        positions: (V, 3) float32 at the last step, to be compared as well.
        advance: called with the number of steps done.

    Returns:
        equal: whether everything was equal; first_difference: None, or {step, what, recorded, now} of the first step
        that differs (step 0 is the state after reset); steps: how many were compared; differing_versions: name ->
        [recorded, now]; fidelity_differs: the environment's fidelity is another one now.

    Raises:
        ValueError: the environment cannot be made from what the file holds.
    """
    env = make_again(episode)
    try:
        difference, done = _compare(env, episode, positions, advance or (lambda _: None))
        fidelity = _fidelity_of(env)
    finally:
        env.close()
    versions = differing_versions(episode.versions, environment_versions())
    return {
        "equal": difference is None,
        "first_difference": difference,
        "steps": done,
        "differing_versions": {name: list(pair) for name, pair in versions.items()},
        "fidelity_differs": fidelity != episode.fidelity,
    }


def _compare(
    env: gym.Env[Any, Any], episode: Episode, positions: ArrayLike | None, advance: Callable[[int], None]
) -> tuple[dict[str, Any] | None, int]:
    """First difference and the number of steps that were simulated."""
    simulation = _reset_again(env, episode)
    found = simulation.state_hash()
    if found != episode.hashes[0]:
        return _difference(0, "state_hash", episode.hashes[0], found), 0
    for index in range(len(episode)):
        try:
            _, reward, terminated, truncated, _ = env.step(episode.action(index))
        except Exception as error:
            return _difference(index + 1, "error", "none", f"{type(error).__name__}: {error}"), index
        advance(index + 1)
        last = index + 1 == len(episode)
        pairs = [
            ("state_hash", episode.hashes[index + 1], env.unwrapped.simulation.state_hash()),  # type: ignore[attr-defined]
            ("reward", float(episode.rewards[index]), float(reward)),
            ("terminated", last and episode.terminated, bool(terminated)),
            ("truncated", last and episode.truncated, bool(truncated)),
        ]
        for what, recorded, now in pairs:
            if not _same(recorded, now):
                return _difference(index + 1, what, recorded, now), index + 1
    if episode.failed_action is not None:
        try:
            env.step(np.reshape(episode.failed_action, episode.action_shape or ()))
        except Exception as error:
            now = f"{type(error).__name__}: {error}"
            if now[:2000] != episode.failure:
                return _difference(len(episode) + 1, "failure", episode.failure, now), len(episode)
        else:
            return _difference(len(episode) + 1, "failure", episode.failure, "none"), len(episode)
    elif positions is not None:
        recorded, now = np.asarray(positions), np.asarray(simulation.positions, dtype=np.float32)
        if recorded.shape != now.shape or recorded.tobytes() != now.tobytes():
            far = float(np.abs(recorded - now).max()) if recorded.shape == now.shape else math.inf
            return _difference(len(episode), "positions", "0 m", f"{far:g} m away"), len(episode)
    return None, len(episode)


def _reset_again(env: gym.Env[Any, Any], episode: Episode) -> Any:
    env.reset(seed=episode.episode_seed, options=from_json_values(episode.options, "options", {}))
    return env.unwrapped.simulation  # type: ignore[attr-defined]


def _same(recorded: Any, now: Any) -> bool:
    if isinstance(recorded, float):
        return np.float64(recorded).tobytes() == np.float64(now).tobytes()
    return bool(recorded == now)


def _difference(step: int, what: str, recorded: Any, now: Any) -> dict[str, Any]:
    return {"step": step, "what": what, "recorded": recorded, "now": now}
