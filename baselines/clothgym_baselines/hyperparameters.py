"""Hyperparameters of every algorithm in one table, with the limits that an override is checked against.

Made for tasks with a potential as reward, about 60 to 250 steps, and 3 to 10 numbers as action.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from clothgym.arrays import check_choice, check_number
from clothgym_baselines.network import ACTIVATIONS, ALGORITHMS, checked_layers, network_arguments

_ON_POLICY = {"ent_coef": 0.0, "vf_coef": 0.5, "max_grad_norm": 0.5, "gae_lambda": 0.95}
_GAUSSIAN = {"net_arch": [64, 64], "activation_fn": "tanh", "log_std_init": -0.5, "ortho_init": True}
_OFF_POLICY = {
    "buffer_size": 200_000,
    "learning_starts": 1_000,
    "batch_size": 256,
    "tau": 0.005,
    "gamma": 0.98,
    "train_freq": 1,
    "gradient_steps": -1,
    "net_arch": [256, 256],
    "activation_fn": "relu",
}

DEFAULTS: dict[str, dict[str, Any]] = {
    "ppo": {
        "learning_rate": 3e-4,
        "n_steps": 256,
        "batch_size": 256,
        "n_epochs": 10,
        "gamma": 0.98,
        "clip_range": 0.2,
        **_ON_POLICY,
        **_GAUSSIAN,
    },
    "a2c": {"learning_rate": 7e-4, "n_steps": 16, "gamma": 0.98, **_ON_POLICY, **_GAUSSIAN},
    "sac": {"learning_rate": 3e-4, "ent_coef": "auto", **_OFF_POLICY},
    "td3": {"learning_rate": 1e-3, "action_noise": 0.1, "policy_delay": 2, **_OFF_POLICY},
}
"""Algorithm -> name -> value. Steps of a rollout are per environment; gradient_steps = -1 is one per step taken."""

BY_TASK: dict[str, dict[str, dict[str, Any]]] = {"clothgym/DressRing-v0": {"ppo": {"learning_rate": 1e-3}}}
"""Environment -> algorithm -> what differs there."""

_INTEGERS = {
    "n_steps": (1, 1_000_000),
    "batch_size": (2, 1_000_000),
    "n_epochs": (1, 1000),
    "buffer_size": (1, 100_000_000),
    "learning_starts": (0, 100_000_000),
    "train_freq": (1, 1_000_000),
    "gradient_steps": (-1, 1_000_000),
    "policy_delay": (1, 1000),
}
_NUMBERS = {
    "learning_rate": (1e-8, 1.0),
    "gamma": (0.0, 1.0),
    "gae_lambda": (0.0, 1.0),
    "clip_range": (1e-4, 10.0),
    "ent_coef": (0.0, 100.0),
    "vf_coef": (0.0, 100.0),
    "max_grad_norm": (1e-6, 1e6),
    "tau": (1e-6, 1.0),
    "action_noise": (0.0, 10.0),
    "log_std_init": (-20.0, 5.0),
}
_OF_POLICY = ("net_arch", "activation_fn", "log_std_init", "ortho_init")


def hyperparameters(algo: str, env_id: str, overrides: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The table's values for a task, with overrides.

    Raises:
        ValueError: no such algorithm or name, a value out of its range.
    """
    check_choice(algo, "algo", ALGORITHMS)
    values = DEFAULTS[algo] | BY_TASK.get(env_id.removeprefix("clothgym_envs:"), {}).get(algo, {})
    for name, value in (overrides or {}).items():
        if name not in values:
            raise ValueError(
                f"{name} = {value!r}: {algo} has no such hyperparameter; expected one of {', '.join(values)}"
            )
        values[name] = _checked(name, value, algo)
    return values


def parse_override(text: str) -> tuple[str, Any]:
    """Name and value of "name=value"; several numbers are separated by commas.

    Raises:
        ValueError: no such form.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ValueError(f"--set {text!r}: expected name=value")
    name, value = name.strip(), value.strip()
    if name == "net_arch" and not value.startswith("["):
        value = f"[{value}]"
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


def model_arguments(algo: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of the stable-baselines3 class; the exploration noise of TD3 is not among them."""
    about_policy = {name: values[name] for name in _OF_POLICY if name in values}
    rest = {name: value for name, value in values.items() if name not in about_policy and name != "action_noise"}
    return rest | {"policy_kwargs": network_arguments(algo, about_policy, "hyperparameters")}


def check_rollout(algo: str, values: Mapping[str, Any], envs: int) -> None:
    """Refuses minibatches that do not divide a rollout.

    Raises:
        ValueError: names batch_size.
    """
    if algo == "ppo" and (values["n_steps"] * envs) % values["batch_size"]:
        raise ValueError(
            f"batch_size = {values['batch_size']}: must divide n_steps x envs = {values['n_steps']} x {envs}"
        )


def _checked(name: str, value: Any, algo: str) -> Any:
    if name in _INTEGERS:
        return check_number(value, name, *_INTEGERS[name], integer=True)
    if name == "ent_coef" and algo == "sac" and value == "auto":
        return value
    if name in _NUMBERS:
        return check_number(value, name, *_NUMBERS[name])
    if name == "activation_fn":
        return check_choice(value, name, ACTIVATIONS)
    if name == "ortho_init":
        if not isinstance(value, bool):
            raise ValueError(f"{name} = {value!r}: expected true or false")
        return value
    return checked_layers(value, name)
