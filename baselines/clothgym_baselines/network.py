"""The networks of stable-baselines3, told in plain JSON and built from it: only what is known and within limits passes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from clothgym.arrays import check_choice, check_number
from clothgym.benchmarks.machine import need

ALGORITHMS = ("ppo", "sac", "td3", "a2c")
ACTIVATIONS = ("tanh", "relu", "elu", "silu")
MAX_LAYERS, MAX_WIDTH, MAX_SIZE = 8, 4096, 100_000
"""Hidden layers, their widths, and numbers in an observation or an action."""
_ARGUMENTS = {
    "ppo": ("net_arch", "activation_fn", "log_std_init", "ortho_init"),
    "a2c": ("net_arch", "activation_fn", "log_std_init", "ortho_init"),
    "sac": ("net_arch", "activation_fn", "log_std_init", "n_critics"),
    "td3": ("net_arch", "activation_fn", "n_critics"),
}


def network_class(algo: str) -> Any:
    """The class that "MlpPolicy" means.

    Raises:
        MissingExtraError: stable-baselines3 is not installed.
    """
    need("stable_baselines3")
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.sac.policies import SACPolicy
    from stable_baselines3.td3.policies import TD3Policy

    return {"ppo": ActorCriticPolicy, "a2c": ActorCriticPolicy, "sac": SACPolicy, "td3": TD3Policy}[algo]


def network_arguments(algo: str, told: Any, where: str) -> dict[str, Any]:
    """Arguments of the network's class out of plain JSON.

    Raises:
        ValueError: names what is unknown or out of its range.
    """
    if not isinstance(told, dict) or "net_arch" not in told:
        raise ValueError(f"{where} = {told!r}: expected values by name, net_arch among them")
    made: dict[str, Any] = {}
    for name, value in told.items():
        if name not in _ARGUMENTS[algo]:
            raise ValueError(f"{where}.{name}: expected one of {', '.join(_ARGUMENTS[algo])}")
        field = f"{where}.{name}"
        if name == "net_arch":
            made[name] = _architecture(value, field)
        elif name == "activation_fn":
            made[name] = _activation(check_choice(value, field, ACTIVATIONS))
        elif name == "log_std_init":
            made[name] = check_number(value, field, -20.0, 5.0)
        elif name == "n_critics":
            made[name] = check_number(value, field, 1, 10, integer=True)
        elif isinstance(value, bool):
            made[name] = value
        else:
            raise ValueError(f"{field} = {value!r}: expected true or false")
    return made


def arguments_told(algo: str, model: Any) -> dict[str, Any]:
    """Arguments of a model's network as plain JSON.

    Raises:
        ValueError: plain JSON cannot tell them; names what.
    """
    if type(model.policy) is not network_class(algo):
        raise ValueError(f"model: its policy is {type(model.policy).__name__}: expected MlpPolicy of {algo}")
    told: dict[str, Any] = {}
    for name, value in (model.policy_kwargs | {"net_arch": model.policy.net_arch}).items():
        if name.startswith("optimizer_") or (name == "use_sde" and not value):  # no part of what acts
            continue
        if name not in _ARGUMENTS[algo]:
            raise ValueError(f"model: policy_kwargs[{name!r}] cannot be told in a policy file")
        told[name] = value.__name__.lower() if name == "activation_fn" else value
    network_arguments(algo, told, "model.policy_kwargs")
    return told


def least_weights(arguments: Mapping[str, Any], observation_size: int, action_size: int) -> int:
    """Weights that a network with these arguments has at least, without building it."""
    layers = arguments["net_arch"]
    branches = layers if isinstance(layers, dict) else {"pi": layers}
    least = 0
    for name, hidden in branches.items():
        widths = [observation_size, *hidden, action_size if name == "pi" else 1]
        least += sum(a * b for a, b in itertools.pairwise(widths))
    return least


def checked_layers(value: Any, name: str) -> list[int]:
    """Widths of hidden layers.

    Raises:
        ValueError: no list of whole numbers, too many or too large ones.
    """
    if not isinstance(value, list) or len(value) > MAX_LAYERS:
        raise ValueError(f"{name} = {value!r}: expected up to {MAX_LAYERS} widths such as 64,64")
    return [int(check_number(width, name, 1, MAX_WIDTH, integer=True)) for width in value]


def _architecture(value: Any, field: str) -> Any:
    if not isinstance(value, dict):
        return checked_layers(value, field)
    if set(value) not in ({"pi", "vf"}, {"pi", "qf"}):
        raise ValueError(f"{field} = {value!r}: expected pi and vf, or pi and qf")
    return {name: checked_layers(layers, field) for name, layers in value.items()}


def _activation(name: str) -> Any:
    need("torch")
    from torch import nn

    return {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}[name]


# --- spaces ---------------------------------------------------------------------------------------------------------


def space_told(space: Any, field: str) -> dict[str, Any]:
    """A Box of one axis (for actions with its bounds) or a Discrete (for actions) as plain numbers.

    Raises:
        ValueError: another space; names the field.
    """
    from gymnasium import spaces

    if isinstance(space, spaces.Discrete) and field == "action_space" and space.start == 0:
        return {"kind": "discrete", "n": int(space.n)}
    if not isinstance(space, spaces.Box) or len(space.shape) != 1 or space.dtype != np.float32:
        allowed = "a Box of one axis in float32" + (" or a Discrete from 0" if field == "action_space" else "")
        raise ValueError(f"{field} = {space}: expected {allowed}")
    told: dict[str, Any] = {"kind": "box", "shape": [int(n) for n in space.shape]}
    if field == "action_space":
        told |= {"low": [float(v) for v in space.low], "high": [float(v) for v in space.high]}
    return told


def space_made(told: Any, field: str) -> Any:
    """The space that `space_told` told; the bounds of observations, which no network needs, are infinite.

    Raises:
        ValueError: names the field that is wrong.
    """
    from gymnasium import spaces

    if not isinstance(told, dict):
        raise ValueError(f"{field} = {told!r}: expected a description")
    kinds = ("box", "discrete") if field == "action_space" else ("box",)
    if check_choice(told.get("kind"), f"{field}.kind", kinds) == "discrete":
        return spaces.Discrete(int(check_number(told.get("n"), f"{field}.n", 1, MAX_SIZE, integer=True)))
    shape = told.get("shape")
    if not isinstance(shape, list) or len(shape) != 1:
        raise ValueError(f"{field}.shape = {shape!r}: expected one number")
    size = int(check_number(shape[0], f"{field}.shape", 1, MAX_SIZE, integer=True))
    if field == "observation_space":
        return spaces.Box(-np.inf, np.inf, (size,), np.float32)
    bounds = []
    for name in ("low", "high"):
        values = told.get(name)
        if not isinstance(values, list) or len(values) != size:
            raise ValueError(f"{field}.{name}: expected {size} numbers")
        bounds.append(np.array([check_number(v, f"{field}.{name}", -1e6, 1e6) for v in values], np.float32))
    if not (bounds[0] < bounds[1]).all():
        raise ValueError(f"{field}.low: not below high")
    return spaces.Box(bounds[0], bounds[1], (size,), np.float32)


def briefly(told: Mapping[str, Any]) -> str:
    """A space in a few words."""
    if told["kind"] == "discrete":
        return f"{told['n']} choices"
    bounds = f" within [{min(told['low']):g}, {max(told['high']):g}]" if "low" in told else ""
    return f"shape ({told['shape'][0]},){bounds}"
