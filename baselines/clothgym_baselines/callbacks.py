"""What happens while stable-baselines3 learns: validation, checkpoints, progress, and Ctrl-C between two steps."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from clothgym_envs.evaluation import bootstrap_interval, wilson_interval
from stable_baselines3.common.callbacks import BaseCallback

from clothgym.benchmarks.report import json_ready, write_atomically
from clothgym_baselines.policy_file import to_bytes
from clothgym_baselines.run_folder import BEST, RunFolder
from clothgym_baselines.workers import play_episodes

_REDRAW = 0.2
"""Seconds between two updates of the progress bar."""


@dataclass
class Listener:
    """Who wants to know, and who may stop the run.

    Attributes:
        advance: called with (steps, text) now and then.
        validated: called with the row of each validation.
        may_stop: called after every step; may raise KeyboardInterrupt.
    """

    advance: Callable[[int, str], None] = field(default=lambda steps, text: None)
    validated: Callable[[dict[str, Any]], None] = field(default=lambda row: None)
    may_stop: Callable[[], None] = field(default=lambda: None)


class Watch(BaseCallback):
    """Validates and keeps a checkpoint whenever a multiple of `every` steps is passed, at the first moment between a rollout
    and the next one: there policy, optimiser and counters belong together.

    Args:
        folder: where all goes.
        about: what the policy files tell about the run.
        every: steps between two validations.
        seeds: of the validation episodes.
        seconds: that earlier parts of the run took.
        listener: who wants to know.
    """

    def __init__(
        self,
        folder: RunFolder,
        about: dict[str, Any],
        every: int,
        seeds: Sequence[int],
        seconds: float,
        listener: Listener,
    ) -> None:
        super().__init__()
        self.folder, self.about, self.every, self.seeds = folder, about, every, seeds
        self.listener = listener
        self.boundary = 0
        self._seconds, self._started = seconds, time.perf_counter()
        self._drawn, self._text = 0.0, ""

    @property
    def seconds(self) -> float:
        """Wall time of the run so far, earlier parts included."""
        return self._seconds + time.perf_counter() - self._started

    def _on_rollout_start(self) -> None:
        self.boundary = self.num_timesteps = int(self.model.num_timesteps)
        validated = self.folder.rows[-1]["steps"] if self.folder.rows else None
        if validated is None or self.boundary // self.every > validated // self.every:
            self.look()

    def _on_step(self) -> bool:
        self.listener.may_stop()
        now = time.perf_counter()
        if now - self._drawn > _REDRAW:
            self._drawn = now
            self.listener.advance(self.num_timesteps, self._text)
        return True

    def look(self) -> None:
        """A checkpoint, then a validation; the best policy so far is kept apart."""
        policy = self.checkpoint()
        self.listener.advance(self.boundary, f"validating {self._text}".strip())
        environments = self.model.get_env()
        told = validation_row(play_episodes(environments, policy, self.seeds, self.listener.may_stop))
        row = json_ready({"steps": self.boundary, "seconds": round(self.seconds, 3), **told})
        best = self.folder.best
        if best is None or (row["success"], row["return"]) > (best["success"], best["return"]):
            write_atomically(self.folder / BEST, to_bytes(self.model, **self._told(), validation=row))
        self.folder.append(row)
        self._text = f"success {row['success']:.2f} return {row['return']:.2f}"
        self.listener.validated(row)

    def checkpoint(self) -> bytes:
        """Keeps the policy as it was at the end of the last rollout; returns the file."""
        policy = to_bytes(self.model, **self._told())
        self.folder.write_checkpoint(self.boundary, policy, getattr(self.model, "replay_buffer", None))
        return policy

    def _told(self) -> dict[str, Any]:
        counters = {"steps": self.boundary, "updates": int(self.model._n_updates), "seconds": round(self.seconds, 3)}
        return self.about | counters


def validation_row(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A row of the learning curve from episodes: rates and means with their 95 % intervals."""
    successes = sum(bool(row.get("is_success", False)) for row in rows)
    returns = [float(row["return"]) for row in rows]
    told: dict[str, Any] = {
        "episodes": len(rows),
        "success": successes / len(rows),
        "success_interval": wilson_interval(successes, len(rows)),
        "return": float(np.mean(returns)),
        "return_interval": bootstrap_interval(returns),
        "episode_steps": float(np.mean([row["steps"] for row in rows])),
        "failures": sum(bool(row.get("failure", 0)) for row in rows),
    }
    if all("progress" in row for row in rows):
        told["progress"] = float(np.mean([1.0 if row.get("is_success") else float(row["progress"]) for row in rows]))
    return told
