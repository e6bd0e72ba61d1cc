"""What a section of the tour leaves, and what sections share."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks.report import Table

Picture = tuple[np.ndarray, str]
"""(H, W, 3) uint8 and its caption."""


@dataclass
class Section:
    """A section of the page.

    Attributes:
        title: heading.
        text: what to look at.
        document: plain values for `--json`.
        tables: of the section.
        sheets: rows of pictures: (file name, caption, pictures); each becomes one PNG.
        history: values by name over the steps, for plots.
    """

    title: str
    text: str
    document: dict[str, Any]
    tables: list[Table]
    sheets: list[tuple[str, str, list[Picture]]]
    history: dict[str, list[float]] = field(default_factory=dict)


def fidelity(strategy: str) -> cg.Fidelity:
    """The balanced preset with an untangling strategy."""
    return dataclasses.replace(cg.Fidelity.preset("balanced"), untangling=strategy)


def recording(path: Path) -> Any:
    """A recording, or None where rerun is not installed."""
    try:
        from clothgym.recording.rerun_log import RerunLog

        return RerunLog(path)
    except cg.MissingExtraError:
        return None


def watch(
    simulation: cg.Simulation,
    steps: int,
    shown: tuple[int, ...],
    camera: Any,
    path: Path,
    measure: Callable[[cg.Simulation], dict[str, float]] | None = None,
) -> dict[str, Any]:
    """Runs a scene and keeps its history, pictures and, where rerun is installed, a recording."""
    from clothgym.recording import pictures

    log = recording(path)
    history: dict[str, list[float]] = {}
    images: list[tuple[np.ndarray, str]] = []
    seconds = 0.0
    if log is not None:
        log.open_simulation(simulation)
    try:
        for step in range(steps + 1):
            if step > 0:
                started = time.perf_counter()
                simulation.step()
                seconds += time.perf_counter() - started
            metrics = simulation.metrics()
            values = {k: float(metrics[k]) for k in ("hits", "contour_count", "contour_length", "max_strain")}
            if measure is not None:
                values |= measure(simulation)
            for key, value in values.items():
                history.setdefault(key, []).append(value)
            if log is not None:
                log.log_simulation(step, simulation, scalars=values)
            if step in shown:
                caption = f"step {step}: {metrics['hits']} hits, {metrics['contour_length']:.2f} m"
                images.append((pictures.draw(simulation, camera, 360, 330, antialias=2), caption))
    finally:
        if log is not None:
            log.close()
    clean = [n for n, hits in enumerate(history["hits"]) if hits == 0]
    return {
        "history": history,
        "pictures": images,
        "first_clean_step": clean[0] if clean else None,
        "ms_per_step": 1e3 * seconds / steps,
    }
