"""All that decides a training run, checked and complete: what is given, else what the resumed run has, else the defaults."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from clothgym_envs.base import LEVELS, TRAIN_SEEDS, VALIDATION_SEEDS

from clothgym.arrays import check_choice, check_number
from clothgym.benchmarks.machine import provenance, version_of
from clothgym.benchmarks.report import json_ready
from clothgym_baselines.hyperparameters import check_rollout, hyperparameters
from clothgym_baselines.network import ALGORITHMS

FIDELITIES = ("draft", "balanced", "accurate")
FIELDS = ("env_id", "algo", "steps", "seed", "level", "fidelity", "envs", "every", "episodes", "hyperparameters")
DEFAULTS = {"algo": "ppo", "steps": 100_000, "seed": 0, "envs": 2, "episodes": 20}
MAX_ENVS = 256


def settled(
    given: Mapping[str, Any], overrides: Mapping[str, Any] | None, stored: Mapping[str, Any] | None, where: str
) -> dict[str, Any]:
    """The run's fields by name.

    Args:
        given: fields that were asked for; None = not.
        overrides: hyperparameters that were asked for.
        stored: fields of the run that is to be resumed; all but its steps, which may grow, have to stay.
        where: the file of the stored ones.

    Raises:
        ValueError: a bad value, or one that differs from the stored run's; names the field.
    """
    chosen = {name: value for name, value in given.items() if value is not None}
    if stored is None:
        ours = chosen["env_id"].startswith("clothgym/")
        run: dict[str, Any] = (
            DEFAULTS | {"level": "easy" if ours else None, "fidelity": "draft" if ours else None} | chosen
        )
    else:
        run = _continued(chosen, stored, where)
    check_choice(run["algo"], "algo", ALGORITHMS)
    run["steps"] = check_number(run["steps"], "steps", 1, 1e12, integer=True)
    run["envs"] = check_number(run["envs"], "envs", 1, MAX_ENVS, integer=True)
    run["seed"] = check_number(run["seed"], "seed", 0, len(TRAIN_SEEDS) - run["envs"], integer=True)
    run["every"] = check_number(run.get("every", max(run["steps"] // 20, 1000)), "every", 1, 1e12, integer=True)
    run["episodes"] = check_number(run["episodes"], "episodes", 1, len(VALIDATION_SEEDS), integer=True)
    for name, choices in (("level", LEVELS), ("fidelity", FIDELITIES)):
        if run[name] is not None:
            check_choice(run[name], name, choices)
    if stored is None:
        run["hyperparameters"] = json_ready(hyperparameters(run["algo"], run["env_id"], overrides))
    else:
        _same_hyperparameters(run, overrides or {}, where)
    check_rollout(run["algo"], run["hyperparameters"], run["envs"])
    return run


def _continued(chosen: Mapping[str, Any], stored: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The stored run, with as many steps as asked for."""
    missing = [name for name in FIELDS if name not in stored]
    if missing:
        raise ValueError(f"{where}: run.{missing[0]} is missing")
    for name, value in chosen.items():
        if name == "steps" and value < stored[name]:
            raise ValueError(f"steps = {value!r}: the run in {where} has {stored[name]}, which can only grow")
        if name != "steps" and value != stored[name]:
            raise ValueError(f"{name} = {value!r}: the run in {where} has {stored[name]!r}")
    return dict(stored) | {"steps": chosen.get("steps", stored["steps"])}


def _same_hyperparameters(run: Mapping[str, Any], overrides: Mapping[str, Any], where: str) -> None:
    asked = json_ready(hyperparameters(run["algo"], run["env_id"], overrides))
    for name in overrides:
        if asked[name] != run["hyperparameters"].get(name):
            raise ValueError(f"{name} = {asked[name]!r}: the run in {where} has {run['hyperparameters'].get(name)!r}")


def document(run: Mapping[str, Any], stored: Mapping[str, Any] | None, done: int) -> dict[str, Any]:
    """What `config.json` holds: the run, where it was begun (machine, versions, commit), and where each later part was."""
    origin = provenance()
    origin["versions"] |= {name: version_of(name) for name in ("stable-baselines3", "torch")}
    if stored is None:
        return {"run": run, **origin, "resumed": []}
    return {**stored, "run": run, "resumed": [*stored.get("resumed", []), {"from_step": done, **origin}]}
