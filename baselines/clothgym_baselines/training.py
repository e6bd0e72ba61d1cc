"""A training run with stable-baselines3: the same seed gives the same policy, a kill loses little, and it can go on."""

from __future__ import annotations

import contextlib
import hashlib
import io
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from clothgym_envs.base import TRAIN_SEEDS, VALIDATION_SEEDS

from clothgym.benchmarks.machine import need
from clothgym.commands import Stopped, ctrl_c_between_steps
from clothgym_baselines.configuration import document, settled
from clothgym_baselines.hyperparameters import model_arguments
from clothgym_baselines.network import space_told
from clothgym_baselines.run_folder import CHECKPOINTS, CONFIG, LAST, REPLAY, RunFolder, fill_replay
from clothgym_baselines.workers import close, make_environment, vectorised


@dataclass(frozen=True)
class TrainingResult:
    """What a run left behind.

    Attributes:
        folder: with `policy.zip` (last), `best.zip` (best on the validation seeds), `checkpoints/`, `config.json`,
            `curve.jsonl`, `curve.png` (with matplotlib).
        steps: environment steps taken, all parts of the run together.
        seconds: wall time, all parts together.
        curve: a row per validation: steps, seconds, success, success_interval, return, return_interval, ...
        best: the best of these rows.
        digest: SHA-256 of the last policy's weights.
        picture: of the learning curve, None without matplotlib.
    """

    folder: Path
    steps: int
    seconds: float
    curve: list[dict[str, Any]]
    best: dict[str, Any]
    digest: str
    picture: Path | None


def train(
    env_id: str,
    *,
    out: str | Path,
    algo: str | None = None,
    steps: int | None = None,
    seed: int | None = None,
    level: str | None = None,
    fidelity: str | None = None,
    envs: int | None = None,
    every: int | None = None,
    episodes: int | None = None,
    overrides: Mapping[str, Any] | None = None,
    processes: bool | None = None,
    resume: bool = False,
    advance: Callable[[int, str], None] = lambda steps, text: None,
    started: Callable[[dict[str, Any]], None] = lambda run: None,
    validated: Callable[[dict[str, Any]], None] = lambda row: None,
) -> TrainingResult:
    """Trains a policy with stable-baselines3; with the same arguments, on the same machine, the same policy.

    Ctrl-C stops it between two steps and keeps all that was learnt.

    Args:
        env_id: `clothgym/<Task>-v0`, or another environment as `module:Name-v0`.
        out: folder of the run.
        algo: ppo (default), sac, td3 or a2c.
        steps: of all environments together (default 100,000), rounded up to whole rollouts.
        seed: of everything that is drawn (default 0); environment i starts with seed + i, within the training seeds.
        level, fidelity: of the environment (easy, draft).
        envs: environments side by side (default 2); part of what decides the result.
        every: steps between two validations, each with a checkpoint (default a twentieth of steps, at least 1000).
        episodes: of a validation (default 20), of the validation seeds.
        overrides: hyperparameters that differ from `clothgym_baselines.hyperparameters`.
        processes: one process per environment (default with more than one), or all in this one.
        resume: continue the run in `out` from its newest checkpoint; arguments that are not given are that run's.
        advance: called with (steps, text) now and then.
        started: called with the configuration before the first step.
        validated: called with the row of each validation.

    Raises:
        ValueError: a bad argument, an environment that cannot be learnt this way, a folder that holds another run.
        MissingExtraError: stable-baselines3 is not installed.
        RuntimeError: a process died.
        clothgym.commands.Stopped: Ctrl-C (a KeyboardInterrupt); the line tells what was kept.
    """
    need("stable_baselines3")
    folder = RunFolder(out)
    stored = folder.stored(resume)
    given = {
        "env_id": env_id.removeprefix("clothgym_envs:"), "algo": algo, "steps": steps, "seed": seed, "level": level,
        "fidelity": fidelity, "envs": envs, "every": every, "episodes": episodes,
    }  # fmt: skip
    run = settled(given, overrides, None if stored is None else stored["run"], str(folder / CONFIG))
    checkpoint = folder.checkpoints()[-1] if folder.checkpoints() else None
    spread = run["envs"] > 1 if processes is None else processes
    kwargs = {name: run[name] for name in ("level", "fidelity") if run[name] is not None}
    probe = make_environment(run["env_id"], kwargs)  # what is wrong with it is told here, not by a process
    for field in ("observation_space", "action_space"):
        space_told(getattr(probe, field), field)
    probe.close()
    folder.write_config(document(run, stored, 0 if checkpoint is None else checkpoint[0]))
    started(run)

    from clothgym_baselines.callbacks import Listener

    with contextlib.ExitStack() as stack:
        may_stop = stack.enter_context(ctrl_c_between_steps())
        stack.enter_context(one_thread())
        stack.enter_context(_deaths_told(folder))
        environments = vectorised(run["env_id"], kwargs, run["envs"], spread)
        stack.callback(close, environments)
        return _learn(run, folder, environments, checkpoint, Listener(advance, validated, may_stop))


def _learn(run: dict[str, Any], folder: RunFolder, environments: Any, checkpoint: Any, listener: Any) -> TrainingResult:
    from clothgym_baselines.callbacks import Watch

    done = 0 if checkpoint is None else checkpoint[0]
    folder.read_curve(done)
    model = build_model(run, environments, done)
    seconds = 0.0 if checkpoint is None else _restore(model, folder, checkpoint)
    about = {name: run[name] for name in ("env_id", "level", "fidelity", "seed", "hyperparameters")}
    seeds = VALIDATION_SEEDS[: run["episodes"]]
    watch = Watch(folder, about, run["every"], seeds, seconds, listener)
    watch.init_callback(model)
    watch.boundary = done
    try:
        if done < run["steps"]:
            model.learn(run["steps"] - done, callback=watch, reset_num_timesteps=checkpoint is None)
            watch.boundary = int(model.num_timesteps)
        if not folder.rows or folder.rows[-1]["steps"] < watch.boundary:
            watch.look()
    except KeyboardInterrupt:
        watch.checkpoint()
        raise Stopped(
            f"stopped after {watch.boundary} of {run['steps']} steps; {folder / LAST} is kept, --resume goes on"
        ) from None
    best = folder.best
    assert best is not None
    return TrainingResult(
        folder.path, watch.boundary, watch.seconds, folder.rows, best, weights_digest(model), folder.draw()
    )


# --- the model ------------------------------------------------------------------------------------------------------


def build_model(run: Mapping[str, Any], environments: Any, done: int = 0) -> Any:
    """A stable-baselines3 model of a configuration; a resumed one draws other numbers than from its start."""
    import stable_baselines3 as sb3
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.noise import NormalActionNoise

    seed, values = run["seed"], run["hyperparameters"]
    if done:  # or it would train on the episodes of its start again
        seed = int(np.random.default_rng([seed, done]).integers(len(TRAIN_SEEDS) - run["envs"]))
    arguments = model_arguments(run["algo"], values)
    if values.get("action_noise"):
        size = environments.action_space.shape
        arguments["action_noise"] = NormalActionNoise(np.zeros(size), np.full(size, values["action_noise"]))
    kind = getattr(sb3, run["algo"].upper())
    model = kind("MlpPolicy", environments, seed=seed, device="cpu", **arguments)
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def _restore(model: Any, folder: RunFolder, checkpoint: tuple[int, Path]) -> float:
    """Weights, optimisers, counters and replay buffer of a checkpoint of this very run; returns the seconds that it took to get
    there. Optimisers are read by torch (tensors only): unlike a policy file, a run folder is taken for one's own."""
    import torch

    from clothgym_baselines.policy_file import load_policy

    steps, path = checkpoint
    about = load_policy(path).about
    states: dict[str, Any] = {}
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            if name.endswith(".pth"):
                content = io.BytesIO(archive.read(name))
                states[name.removesuffix(".pth")] = torch.load(content, map_location="cpu", weights_only=True)
    for name, tensor in (states.pop("pytorch_variables", None) or {}).items():
        getattr(model, name).data = tensor.data
    model.set_parameters(states, exact_match=True, device="cpu")
    model.num_timesteps, model._n_updates = steps, int(about["updates"])
    if getattr(model, "replay_buffer", None) is not None:
        fill_replay(model.replay_buffer, folder / CHECKPOINTS / REPLAY)
    return float(about["seconds"])


def weights_digest(model: Any) -> str:
    """SHA-256 of a policy's weights."""
    told = hashlib.sha256()
    for name, tensor in sorted(model.policy.state_dict().items()):
        told.update(name.encode() + tensor.detach().cpu().numpy().astype("<f4").tobytes())
    return told.hexdigest()


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """torch computes with one thread: networks are small, and sums do not depend on the machine's cores."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def _deaths_told(folder: RunFolder) -> Iterator[None]:
    """A process that has died (mostly for want of memory) shows as a broken pipe: says so."""
    try:
        yield
    except (EOFError, BrokenPipeError, ConnectionResetError):
        raise RuntimeError(
            f"a process with an environment died (out of memory, or a script without `if __name__ == '__main__':`); "
            f"--resume goes on from the last checkpoint in {folder.path}"
        ) from None
