"""Policies as files: written by training, read by anyone, and reading one never runs code out of it.

A file is an ordinary stable-baselines3 zip (its own `load` reads it) with two members more: `clothgym.json`, plain JSON that
tells how to build the network, and `clothgym.weights`, its numbers as little-endian float32 one after the other. Only these
two are read here. What stable-baselines3 itself wrote is left alone: `data` holds pickles, and torch's restricted reading of
`policy.pth` had holes before (CVE-2025-32434, CVE-2026-24747).
"""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from clothgym.arrays import check_choice, check_number
from clothgym.benchmarks.machine import need, version_of, versions
from clothgym.benchmarks.report import to_json_text, write_atomically
from clothgym_baselines.network import (
    ALGORITHMS,
    MAX_SIZE,
    arguments_told,
    briefly,
    least_weights,
    network_arguments,
    network_class,
    space_made,
    space_told,
)

FORMAT = "clothgym policy 1"
ABOUT, WEIGHTS = "clothgym.json", "clothgym.weights"
MAX_ABOUT, MAX_WEIGHTS, MAX_FILE, MAX_MEMBERS = 1_000_000, 256_000_000, 1_000_000_000, 1000
"""Limits of what is read, in bytes, and of members."""
_SPACES = ("observation_space", "action_space")


class FilePolicy:
    """A policy from a file: deterministic, clipped actions, the same as `model.predict(..., deterministic=True)`.

    Attributes:
        name: of the file.
        about: what the file tells: algo, env_id, versions, and what its writer added.
    """

    def __init__(self, name: str, about: dict[str, Any], network: Any) -> None:
        self.name, self.about, self.network = name, about, network

    def reset(self, env: Any) -> None:
        """Looks whether the policy fits the environment.

        Raises:
            ValueError: names file, field, what it was made for and what the environment has.
        """
        for field in _SPACES:
            made, found = self.about[field], space_told(getattr(env, field), field)
            if made != found:
                raise ValueError(
                    f"{self.name}: {field}: made for {briefly(made)} of {self.about['env_id']}, "
                    f"this environment has {briefly(found)}"
                )

    def act(self, observation: Any, info: Mapping[str, Any] | None = None) -> Any:
        """The action for an observation; computed by one thread, so that it is the same everywhere."""
        import torch

        threads = torch.get_num_threads()
        if threads != 1:
            torch.set_num_threads(1)
        try:
            return self.network.predict(observation, deterministic=True)[0]
        finally:
            if threads != 1:
                torch.set_num_threads(threads)


# --- writing --------------------------------------------------------------------------------------------------------


def save_policy(model: Any, path: str | os.PathLike[str], env_id: str = "unknown", **about: Any) -> Path:
    """Writes a stable-baselines3 model (PPO, A2C, SAC, TD3 with MlpPolicy) as a policy file.

    Args:
        model: the model.
        path: of the file, replaced at once.
        env_id: what it was trained on.
        about: further JSON values to keep in the file.

    Raises:
        ValueError: a model that plain JSON cannot describe; names what.
    """
    return write_atomically(Path(path), to_bytes(model, env_id, **about))


def to_bytes(model: Any, env_id: str = "unknown", **about: Any) -> bytes:
    """The file that `save_policy` writes."""
    algo = check_choice(type(model).__name__.lower(), "model", ALGORITHMS)
    state = {name: tensor.detach().cpu().numpy() for name, tensor in model.policy.state_dict().items()}
    told = about | {
        "format": FORMAT,
        "algo": algo,
        "env_id": env_id,
        **{field: space_told(getattr(model, field), field) for field in _SPACES},
        "policy_kwargs": arguments_told(algo, model),
        "weights": {name: list(values.shape) for name, values in state.items()},
        "versions": versions() | {name: version_of(name) for name in ("stable-baselines3", "torch")},
    }
    buffer = io.BytesIO()
    model.save(buffer)
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr(ABOUT, to_json_text(told, indent=1))
        archive.writestr(WEIGHTS, b"".join(values.astype("<f4").tobytes() for values in state.values()))
    return buffer.getvalue()


# --- reading --------------------------------------------------------------------------------------------------------


def load_policy(path: str | os.PathLike[str]) -> FilePolicy:
    """A policy from a file of `clothgym train` or `save_policy`; runs no code out of it.

    Raises:
        ValueError: names the file, the field and what is wrong with it.
        FileNotFoundError: no such file.
        MissingExtraError: stable-baselines3 is not installed.
    """
    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(2, "no such policy file", str(file))
    if not file.is_file():  # neither folders nor pipes
        raise ValueError(f"{file}: is no file")
    if file.stat().st_size > MAX_FILE:
        raise ValueError(f"{file}: has {file.stat().st_size} bytes: no policy is larger than {MAX_FILE}")
    with file.open("rb") as source:
        return _read(source, str(file))


def from_bytes(data: bytes, name: str = "policy") -> FilePolicy:
    """A policy from what `to_bytes` gave."""
    return _read(io.BytesIO(data), name)


def _read(source: Any, name: str) -> FilePolicy:
    try:
        return FilePolicy(name, *_built(*_members(source)))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _members(source: Any) -> tuple[Any, bytes]:
    """The two members: the description as JSON values, and the weights."""
    try:
        with zipfile.ZipFile(source) as archive:
            if len(archive.infolist()) > MAX_MEMBERS:
                raise ValueError(f"has {len(archive.infolist())} members: no policy file")
            if ABOUT not in archive.namelist():
                raise ValueError(
                    f"{ABOUT} is missing: no policy file of clothgym; one is made out of a stable-baselines3 model by "
                    "clothgym_baselines.save_policy(model, path)"
                )
            text, weights = _member(archive, ABOUT, MAX_ABOUT), _member(archive, WEIGHTS, MAX_WEIGHTS)
    # what the reader raises on damaged or hostile archives: wrong sums, encryption, compressions it does not know
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, OSError) as error:
        raise ValueError(f"no zip file, or a damaged one: {error}") from None
    try:
        return json.loads(text.decode("utf-8")), weights
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{ABOUT}: no JSON: {error}") from None


def _member(archive: zipfile.ZipFile, member: str, limit: int) -> bytes:
    """A member, never more than the limit whatever its header says."""
    if member not in archive.namelist():
        raise ValueError(f"{member} is missing")
    if archive.getinfo(member).compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{member}: compressed in another way than by deflate")
    with archive.open(member) as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise ValueError(f"{member}: larger than {limit} bytes")
    return data


def _built(about: Any, weights: bytes) -> tuple[dict[str, Any], Any]:
    """The checked description and the network with its weights."""
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        found = about.get("format") if isinstance(about, dict) else type(about).__name__
        raise ValueError(f"format = {found!r}: expected {FORMAT!r}")
    algo = check_choice(about.get("algo"), "algo", ALGORITHMS)
    if not isinstance(about.get("env_id"), str):
        raise ValueError(f"env_id = {about.get('env_id')!r}: expected text")
    spaces = {field: space_made(about.get(field), field) for field in _SPACES}
    plain = {field: space_told(space, field) for field, space in spaces.items()}
    action = plain["action_space"]
    if algo in ("sac", "td3") and action["kind"] == "discrete":
        raise ValueError(f"action_space.kind = 'discrete': {algo} has none")
    shapes = _shapes(about.get("weights"), len(weights))
    arguments = network_arguments(algo, about.get("policy_kwargs"), "policy_kwargs")
    # a network with more weights than the file holds is not even built: it may be made to fill the memory
    size = action["n"] if action["kind"] == "discrete" else action["shape"][0]
    least = least_weights(arguments, plain["observation_space"]["shape"][0], size)
    if least > len(weights) // 4:
        raise ValueError(f"policy_kwargs.net_arch: needs {least} weights, {WEIGHTS} has {len(weights) // 4}")
    network = _network(algo, spaces, arguments)
    expected = {name: list(tensor.shape) for name, tensor in network.state_dict().items()}
    for name in sorted(set(expected) | set(shapes)):
        if expected.get(name) != shapes.get(name):
            raise ValueError(f"weights[{name!r}] = {shapes.get(name)}: the network has {expected.get(name)}")
    network.load_state_dict(_tensors(shapes, weights))
    return about | plain, network


def _network(algo: str, spaces: Mapping[str, Any], arguments: Mapping[str, Any]) -> Any:
    need("stable_baselines3")
    import torch

    with torch.random.fork_rng(devices=[]):  # it starts with drawn weights: no matter of the caller's
        return network_class(algo)(lr_schedule=lambda _: 0.0, **spaces, **arguments)


def _shapes(told: Any, size: int) -> dict[str, list[int]]:
    """Names and shapes of the weights, which must account for every byte."""
    if not isinstance(told, dict):
        raise ValueError(f"weights = {told!r}: expected name -> shape")
    shapes = {}
    for name, shape in told.items():
        field = f"weights[{name!r}]"
        if not isinstance(shape, list) or len(shape) > 2:
            raise ValueError(f"{field} = {shape!r}: expected up to two numbers")
        shapes[name] = [int(check_number(n, field, 1, MAX_SIZE, integer=True)) for n in shape]
    total = 4 * sum(math.prod(shape) for shape in shapes.values())
    if total != size:
        raise ValueError(f"{WEIGHTS}: has {size} bytes, weights tells of {total}")
    return shapes


def _tensors(shapes: Mapping[str, list[int]], weights: bytes) -> dict[str, Any]:
    import torch

    values = np.frombuffer(weights, "<f4").astype(np.float32)
    if not np.isfinite(values).all():
        raise ValueError(f"{WEIGHTS}: number {int(np.argmin(np.isfinite(values)))} is not finite")
    tensors, start = {}, 0
    for name, shape in shapes.items():
        end = start + math.prod(shape)
        tensors[name] = torch.from_numpy(values[start:end].reshape(shape))
        start = end
    return tensors
