"""Baselines with stable-baselines3 (extra `rl`): `clothgym train`, and policies as files that are safe to load.

`train` runs a training and returns what it left behind, `save_policy` writes a stable-baselines3 model as a policy file,
`load_policy` reads one without running code out of it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from clothgym_baselines.policy_file import FilePolicy, load_policy, save_policy
    from clothgym_baselines.training import TrainingResult, train

_HOMES = {
    "FilePolicy": "policy_file",
    "TrainingResult": "training",
    "load_policy": "policy_file",
    "save_policy": "policy_file",
    "train": "training",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:  # imported late: torch takes seconds
        return getattr(importlib.import_module(f"clothgym_baselines.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = ["FilePolicy", "TrainingResult", "load_policy", "save_policy", "train"]
