"""Strategies against intersections: one file each, behind one interface that users extend.

A strategy is any object with `propose(context) -> Corrections`. `strategy="package.module:Name"` names a user's own class
(it is made without arguments).
"""

from __future__ import annotations

import importlib
from typing import Protocol

from clothgym.response.untangling.base import Context, Corrections, displacements
from clothgym.response.untangling.global_scheme import Global
from clothgym.response.untangling.hybrid import Hybrid
from clothgym.response.untangling.local import Local

__all__ = ["STRATEGIES", "Context", "Corrections", "Strategy", "displacements", "get", "names"]


class Strategy(Protocol):
    """Moves vertices so that intersections go away. Memoryless: a proposal depends on the context alone."""

    def propose(self, context: Context) -> Corrections:
        """Displacements for one pass."""
        ...


STRATEGIES: dict[str, type] = {"local": Local, "global": Global, "hybrid": Hybrid}


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
