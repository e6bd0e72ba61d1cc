"""Measuring simulations: frequencies, rest, orders of convergence; and the form of what every case returns."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.arrays import FloatArray


def quantity(
    name: str, measured: float | None, known: float | None, target: float | None = None, absolute: bool = False
) -> dict[str, Any]:
    """One line of a case: measured value, known answer, error (relative unless `absolute`), target of its size, met or not.

    Args:
        target: largest error allowed; None = only reported.
    """
    error = None
    if measured is not None and known is not None:
        error = measured - known if absolute else measured / known - 1.0
    met = None if target is None else bool(error is not None and abs(error) <= target)
    return {"name": name, "measured": measured, "known": known, "error": error, "target": target, "met": met}


def at_least(name: str, measured: float, bound: float) -> dict[str, Any]:
    """A line that is met from a bound on."""
    return {"name": name, "measured": measured, "known": bound, "error": None, "target": None, "met": measured >= bound}


def record(simulation: cg.Simulation, steps: int, look: Callable[[cg.Simulation], Any]) -> FloatArray:
    """(steps + 1, ...) of what `look` sees at the start and after every step."""
    seen = [look(simulation)]
    for _ in range(steps):
        simulation.step()
        seen.append(look(simulation))
    return np.asarray(seen, float)


def crossings(signal: FloatArray, every: float) -> FloatArray:
    """Times [s] at which a sampled signal changes its sign, on straight lines between samples."""
    here, on = signal[:-1], signal[1:]
    at = np.flatnonzero((here != 0.0) & (np.sign(here) != np.sign(on)))
    return every * (at + here[at] / (here[at] - on[at]))


def period(signal: FloatArray, every: float) -> float | None:
    """Period [s] of a signal around zero: twice the mean distance of its crossings; None with fewer than two."""
    times = crossings(signal, every)
    return float(2.0 * (times[-1] - times[0]) / (len(times) - 1)) if len(times) > 1 else None


def settle(simulation: cg.Simulation, seconds: float, speed: float) -> float:
    """Steps until no vertex is faster than `speed` [m/s] any more, at most for `seconds`; returns the last top speed."""
    fastest = math.inf
    for _ in range(max(1, round(seconds / simulation.scene.step))):
        simulation.step()
        fastest = float(np.sqrt((simulation.velocities**2).sum(axis=1).max()))
        if fastest < speed and simulation.time > 0.05 * seconds:
            break
    return fastest


def order(sizes: Sequence[float], errors: Sequence[float]) -> float | None:
    """Exponent p of error ~ size^p by least squares; None where an error is zero or missing."""
    if len(sizes) < 2 or any(error is None or not error > 0.0 for error in errors):
        return None
    return float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])
