"""The folder of a training run: its configuration, learning curve, policies and checkpoints; all survive a kill."""

from __future__ import annotations

import io
import json
import os
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from clothgym.benchmarks.machine import pyplot
from clothgym.benchmarks.report import to_json_text, write_atomically
from clothgym.errors import MissingExtraError

CONFIG, CURVE, LAST, BEST, CHECKPOINTS = "config.json", "curve.jsonl", "policy.zip", "best.zip", "checkpoints"
REPLAY, PICTURE = "replay.npz", "curve.png"
_REPLAY_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class RunFolder:
    """A folder with one training run.

    Attributes:
        path: of the folder.
        rows: the learning curve, a row per validation.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.rows: list[dict[str, Any]] = []

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    # --- configuration ----------------------------------------------------------------------------------------------

    def stored(self, resume: bool) -> dict[str, Any] | None:
        """The configuration of the run that the folder holds, None of an empty one.

        Raises:
            ValueError: holds a run that is not to be resumed, holds none that could be, or a damaged one.
        """
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"--out {self.path}: is a file")
        if not (self / CONFIG).exists():
            left = [name for name in (CURVE, LAST, BEST, CHECKPOINTS) if (self / name).exists()]
            if resume or left:
                what = f"{CONFIG} is missing" + (f" beside {left[0]}" if left else "")
                raise ValueError(
                    f"--out {self.path}: {what}: " + ("nothing to resume" if resume else "holds other files")
                )
            return None
        if not resume:
            raise ValueError(f"--out {self.path}: holds a run: continue it with --resume, or name another folder")
        try:
            config = json.loads((self / CONFIG).read_text("utf-8"))
            if not isinstance(config, dict) or not isinstance(config.get("run"), dict):
                raise ValueError("'run' is missing")
        except ValueError as error:
            raise ValueError(f"{self / CONFIG}: no configuration: {error}") from None
        return config

    def write_config(self, document: Mapping[str, Any]) -> None:
        """Replaces the configuration at once."""
        write_atomically(self / CONFIG, (to_json_text(document, indent=2) + "\n").encode())

    # --- learning curve ---------------------------------------------------------------------------------------------

    def append(self, row: dict[str, Any]) -> None:
        """Adds a row to the learning curve; when this returns, a kill can no longer take it."""
        self.rows.append(row)
        with (self / CURVE).open("ab") as file:
            file.write(to_json_text(row).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())

    def read_curve(self, until: int) -> None:
        """Takes up the rows of an earlier run up to a step; what is later, or torn by a kill, leaves the file."""
        kept = []
        if (self / CURVE).exists():
            for line in (self / CURVE).read_bytes().split(b"\n"):
                try:
                    row = json.loads(line)
                except ValueError:
                    continue
                if isinstance(row, dict) and isinstance(row.get("steps"), int) and row["steps"] <= until:
                    kept.append(row)
        self.rows = kept
        write_atomically(self / CURVE, b"".join(to_json_text(row).encode() + b"\n" for row in kept))

    @property
    def best(self) -> dict[str, Any] | None:
        """The row with the most success, among those the one with the highest return; the first of equals."""
        return max(self.rows, key=lambda row: (row["success"], row["return"]), default=None)

    def draw(self) -> Path | None:
        """The learning curve as a picture; None without matplotlib."""
        try:
            plt = pyplot()
        except MissingExtraError:
            return None
        figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
        steps = [row["steps"] for row in self.rows]
        for axis, name, title in zip(axes, ("success", "return"), ("success rate", "return"), strict=True):
            low, high = zip(*(row[f"{name}_interval"] for row in self.rows), strict=True)
            axis.fill_between(steps, low, high, alpha=0.2, linewidth=0)
            axis.plot(steps, [row[name] for row in self.rows], marker=".")
            axis.set(xlabel="environment steps", title=f"{title} on the validation seeds, 95 % interval")
            axis.title.set_fontsize("medium")
            axis.grid(alpha=0.3)
        axes[0].set_ylim(-0.03, 1.03)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=120)
        plt.close(figure)
        return write_atomically(self / PICTURE, buffer.getvalue())

    # --- policies and checkpoints -----------------------------------------------------------------------------------

    def checkpoints(self) -> list[tuple[int, Path]]:
        """(steps, file) of all checkpoints, oldest first."""
        found = [(re.fullmatch(r"step_(\d+)\.zip", p.name), p) for p in (self / CHECKPOINTS).glob("step_*.zip")]
        return sorted((int(match[1]), path) for match, path in found if match)

    def write_checkpoint(self, steps: int, policy: bytes, replay: Any) -> None:
        """Keeps the policy as checkpoint and as the last one; of a replay buffer only the newest state is kept."""
        if replay is not None:
            write_atomically(self / CHECKPOINTS / REPLAY, replay_bytes(replay))
        write_atomically(self / CHECKPOINTS / f"step_{steps:010d}.zip", policy)
        write_atomically(self / LAST, policy)


def replay_bytes(buffer: Any) -> bytes:
    """The filled part of a replay buffer of stable-baselines3, as plain arrays."""
    filled = buffer.buffer_size if buffer.full else buffer.pos
    arrays = {name: getattr(buffer, name)[:filled] for name in _REPLAY_ARRAYS}
    file = io.BytesIO()
    np.savez(file, position=np.array([buffer.pos, int(buffer.full)]), **arrays)
    return file.getvalue()


def fill_replay(buffer: Any, path: Path) -> None:
    """Puts back what `replay_bytes` kept.

    Raises:
        ValueError: the file is damaged, or of another buffer.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            position, full = (int(v) for v in arrays["position"])
            for name in _REPLAY_ARRAYS:
                into, kept = getattr(buffer, name), arrays[name]
                if kept.shape[1:] != into.shape[1:] or len(kept) != (len(into) if full else position):
                    raise ValueError(f"{name} has shape {kept.shape}, the buffer {into.shape}")
                into[: len(kept)] = kept
    except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: no replay buffer of this run: {error}") from None
    buffer.pos, buffer.full = position, bool(full)
