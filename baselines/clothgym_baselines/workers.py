"""Environments for training: seeded, in processes of one thread each, and the same processes play the validation episodes."""

from __future__ import annotations

import contextlib
import functools
import signal
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
from clothgym_envs.evaluation import run_episode, single_threads

from clothgym_baselines.policy_file import from_bytes


def make_environment(env_id: str, kwargs: dict[str, Any]) -> gym.Env[Any, Any]:
    """An environment of this package, or any other one as `module:Name-v0`.

    Raises:
        ValueError: no such environment, or one that does not know an argument.
    """
    name = f"clothgym_envs:{env_id}" if env_id.startswith("clothgym/") else env_id
    try:
        return gym.make(name, disable_env_checker=True, **kwargs)
    except (gym.error.Error, ImportError, TypeError) as error:
        if isinstance(error, ImportError) and "clothgym[" in str(error):
            raise
        raise ValueError(f"ENV = {env_id!r}: {' '.join(str(error).split())}") from None


class TrainingEnvironment(gym.Wrapper[Any, Any, Any, Any]):
    """One of the environments that are trained on; plays validation episodes in an environment of its own, so that training
    does not notice.

    Args:
        make: makes the environment.
        index: of this one among all of them.
    """

    def __init__(self, make: Callable[[], gym.Env[Any, Any]], index: int) -> None:
        super().__init__(make())
        self._make, self._index = make, index
        self._other: gym.Env[Any, Any] | None = None
        self._policy: Any = None

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """A step; of info only what stable-baselines3 reads, since it is sent between processes."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        kept = {"is_success": bool(info["is_success"])} if "is_success" in info else {}
        return observation, float(reward), terminated, truncated, kept

    def take_policy(self, data: bytes) -> None:
        """Keeps a policy for `play`."""
        self._policy = from_bytes(data)

    def play(self, seeds: Sequence[int]) -> dict[str, Any] | None:
        """The validation episode of the seed at this one's index, as `clothgym_envs.evaluation.run_episode` tells it."""
        if self._index >= len(seeds):
            return None
        if self._other is None:
            self._other = self._make()
        return run_episode(self._other, self._policy, seeds[self._index])

    def close(self) -> None:
        """Closes both environments."""
        if self._other is not None:
            self._other.close()
        super().close()


def _in_worker(make: Callable[[], gym.Env[Any, Any]], index: int) -> TrainingEnvironment:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: it is the parent's to handle
    return TrainingEnvironment(make, index)


def vectorised(env_id: str, kwargs: dict[str, Any], count: int, processes: bool) -> Any:
    """A VecEnv of stable-baselines3: of processes, or all in this one. Their answers are the same.

    Processes are spawned (fork would copy threads), so a script that trains needs `if __name__ == "__main__":`.
    """
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    make = functools.partial(make_environment, env_id, kwargs)
    kind = _in_worker if processes else TrainingEnvironment
    makers: list[Any] = [functools.partial(kind, make, index) for index in range(count)]
    if not processes:
        return DummyVecEnv(makers)
    with single_threads():
        return SubprocVecEnv(makers, start_method="spawn")


def play_episodes(
    environments: Any, policy: bytes, seeds: Sequence[int], after_each: Callable[[], None]
) -> list[dict[str, Any]]:
    """Rows of one episode per seed, in the order of the seeds; as many at a time as there are environments."""
    environments.env_method("take_policy", policy)
    rows: list[dict[str, Any]] = []
    for start in range(0, len(seeds), environments.num_envs):
        after_each()
        found = environments.env_method("play", list(seeds[start : start + environments.num_envs]))
        rows += [row for row in found if row is not None]
    return rows


def close(environments: Any) -> None:
    """Ends the processes, also when one of them has died or is in the middle of an episode."""
    processes = getattr(environments, "processes", [])
    for process in processes:
        process.terminate()
    if not processes:
        environments.close()
        return
    for process in processes:
        process.join(10.0)
    with contextlib.suppress(OSError):
        for remote in environments.remotes:
            remote.close()
    environments.closed = True
