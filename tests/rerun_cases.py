"""A sheet, and a Rerun recording with everything in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from clothgym.recording.rerun_log import RerunLog

STEPS = 40


def sheet(n: int, height: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    vertices = np.stack([u.ravel(), np.full(n * n, height), v.ravel()], axis=1)
    i = np.arange(n * n).reshape(n, n)
    lower = np.stack([i[:-1, :-1], i[:-1, 1:], i[1:, 1:]], axis=-1).reshape(-1, 3)
    upper = np.stack([i[:-1, :-1], i[1:, 1:], i[1:, :-1]], axis=-1).reshape(-1, 3)
    return vertices, np.concatenate([lower, upper])


def write(path: Path, steps: int = STEPS, n: int = 6) -> list[dict[str, Any]]:
    """A recording with everything in it, and what was logged at each step."""
    rng = np.random.default_rng(3)
    (a, faces_a), (b, faces_b) = sheet(n), sheet(n + 1, 0.3)
    logged = []
    with RerunLog(path) as log:
        cloths = [("lower sheet", faces_a, None), ("up/per (2)", faces_b, (10, 200, 30))]
        log.open(cloths, [("still", a * 0.2, faces_a), ("moving", b * 0.1, faces_b)], ground=-0.5)
        log.log_document("episode", {"note": "größer", "numbers": [1, 2.5, None]})
        for k in range(steps):
            count = int(rng.integers(0, 5)) if k else 3
            row = {
                "time": k / 60,
                "positions": np.concatenate([a, b]) + rng.normal(scale=0.01, size=(len(a) + len(b), 3)),
                "segments": rng.normal(size=(count, 2, 3)),
                "contour": rng.integers(0, 100_000, count),
                "hits": rng.normal(size=(count, 3)),
                "scalars": {"reward/depth": rng.normal(), "contour_length": k * 0.1},
                "grippers": rng.normal(size=(2, 3)),
                "moving": b * 0.1 + k // 4,
                "hash": f"hash-{k}",
                "reward": rng.normal(),
                "action": rng.normal(size=4).astype(np.float32),
            }
            if k % 2:
                row["scalars"]["only sometimes"] = float(k)
            if k:
                log.log_action(k, row["time"], row["action"])
            log.log_step(
                k,
                row["time"],
                row["positions"],
                contours=(row["segments"], row["contour"]),
                hits=row["hits"],
                scalars=row["scalars"],
                points={"grippers": row["grippers"]},
                bodies={"moving": row["moving"]},
                outcome={"state_hash": row["hash"], "reward": row["reward"], "truncated": k == steps - 1},
            )
            logged.append(row)
    return logged
