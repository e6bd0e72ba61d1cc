"""Strategies against intersections: one file each, behind one interface that users extend.

A strategy is any object with `propose(context) -> Corrections`. `strategy="package.module:Name"` names a user's own class
(it is made without arguments).
"""

from __future__ import annotations

import importlib
from typing import Protocol

import numpy as np

from clothgym.arrays import BoolArray, FloatArray, check_number
from clothgym.response.untangling.annealed import Annealed
from clothgym.response.untangling.area import Area
from clothgym.response.untangling.base import Context, Corrections, displacements
from clothgym.response.untangling.coherence import Coherence
from clothgym.response.untangling.exact import Exact
from clothgym.response.untangling.flatten import Flatten
from clothgym.response.untangling.gia import GlobalIntersectionAnalysis
from clothgym.response.untangling.global_scheme import Global
from clothgym.response.untangling.hybrid import Hybrid
from clothgym.response.untangling.local import Local
from clothgym.response.untangling.stall import Stall

__all__ = ["STRATEGIES", "Context", "Corrections", "Strategy", "answer", "displacements", "get", "memory", "names"]


class Strategy(Protocol):
    """Moves vertices so that intersections go away.

    Memoryless: a proposal depends on the context alone. A strategy that must remember has an attribute `memory_size` and keeps
    so many numbers in `Context.memory`, which snapshots and resets include, and nothing in itself.
    """

    def propose(self, context: Context) -> Corrections:
        """Displacements for one pass."""
        ...


STRATEGIES: dict[str, type] = {
    "local": Local,
    "global": Global,
    "exact": Exact,
    "area": Area,
    "gia": GlobalIntersectionAnalysis,
    "hybrid": Hybrid,
    "coherence": Coherence,
    "stall": Stall,
    "annealed": Annealed,
    "flatten": Flatten,
}


def memory(strategy: Strategy | None) -> FloatArray:
    """What a strategy remembers when a tangle begins: zeros, as many as its `memory_size` says.

    Raises:
        ValueError: a `memory_size` that is no number of numbers.
    """
    size = check_number(getattr(strategy, "memory_size", 0), "strategy: memory_size", 0, 1_000_000, integer=True)
    return np.zeros(int(size))


def answer(strategy: Strategy, context: Context) -> tuple[FloatArray, BoolArray | None]:
    """A strategy's displacements (V, 3) and vertices to leave apart (V,), checked; fixed vertices do not move.

    Numbers that are not finite pass: a run that they blow up reports it as it does any divergence.

    Raises:
        ValueError: names the strategy and what is wrong with its answer.
    """
    speaker = f"strategy {type(strategy).__name__}"
    count = len(context.inverse_masses)
    corrections = strategy.propose(context)
    moves = getattr(corrections, "displacements", None)
    if moves is None:
        raise ValueError(f"{speaker}: propose must return Corrections, got {type(corrections).__name__}")
    try:
        displacements = np.array(moves, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{speaker}: displacements: {error}") from error
    if displacements.shape != (count, 3):
        raise ValueError(f"{speaker}: displacements: expected shape ({count}, 3), got {displacements.shape}")
    displacements[context.inverse_masses == 0.0] = 0.0
    apart = getattr(corrections, "apart", None)
    if apart is not None:
        apart = np.asarray(apart)
        if apart.shape != (count,) or apart.dtype != np.bool_:
            raise ValueError(f"{speaker}: apart: expected {count} booleans, got shape {apart.shape} of {apart.dtype}")
    return displacements, apart


def names() -> tuple[str, ...]:
    """Names of the built-in strategies; "none" leaves everything as it is."""
    return ("none", *STRATEGIES)


def get(name: str) -> Strategy | None:
    """A strategy by name, or a user's own as "package.module:Name"; None for "none".

    Raises:
        ValueError: unknown name, or what it names cannot be imported or has no `propose`.
    """
    if name == "none":
        return None
    if name in STRATEGIES:
        return STRATEGIES[name]()
    module_name, colon, attribute = name.partition(":")
    if not colon:
        raise ValueError(f"strategy = {name!r}: expected one of {', '.join(names())}, or package.module:Name")
    try:
        made = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"strategy = {name!r}: {error}") from error
    strategy = made() if isinstance(made, type) else made
    if not callable(getattr(strategy, "propose", None)):
        raise ValueError(f"strategy = {name!r}: has no method propose(context)")
    return strategy
