"""Gymnasium environments on cloth; importing this package registers them.

`gymnasium.make("clothgym_envs:clothgym/UntangleLayers-v0")` works without the import.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym

ENVIRONMENTS: dict[str, str] = {
    "clothgym/DressRing-v0": "clothgym_envs.dress_ring:DressRingEnv",
    "clothgym/UntangleLayers-v0": "clothgym_envs.untangle_layers:UntangleLayersEnv",
}
"""Id -> entry point. What changes scores gets a new version."""

for _id, _entry_point in ENVIRONMENTS.items():
    if _id not in gym.registry:
        gym.register(id=_id, entry_point=_entry_point)


def __getattr__(name: str) -> Any:
    if name == "RerunRecorder":  # imported late: recordings are an extra
        from clothgym_envs.recorder import RerunRecorder

        return RerunRecorder
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = ["ENVIRONMENTS", "RerunRecorder"]
