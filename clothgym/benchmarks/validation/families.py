"""All families together: what cases there are and who runs them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from clothgym.benchmarks.frame import Case
from clothgym.benchmarks.validation import bending, contact, drape, flight, hanging, oscillator, waves
from clothgym.benchmarks.validation.solvers import NotAvailable

_MODULES = (oscillator, hanging, waves, bending, contact, drape, flight)
FAMILIES: dict[str, Callable[..., dict[str, Any]]] = {
    "oscillator": oscillator.oscillator,
    "pendulum": oscillator.pendulum,
    "chain": oscillator.chain,
    "column": hanging.column,
    "catenary": hanging.catenary,
    "wave": waves.wave,
    "membrane": waves.membrane,
    "cantilever": bending.cantilever,
    "moment": bending.moment,
    "incline": contact.incline,
    "capstan": contact.capstan,
    "creep": contact.creep,
    "bounce": contact.bounce,
    "drape": drape.drape,
    "buckling": drape.buckling,
    "flight": flight.flight,
    "invariance": flight.invariance,
    "stretch": flight.stretch,
    "bend": flight.bend,
}
"""Name -> function that measures one case, in the order of the tables."""


def cases(quick: bool) -> list[Case]:
    """Every family with every solver."""
    return [case for module in _MODULES for case in module.cases(quick)]


def prepare() -> None:
    """Compiles every kernel that a case uses, with one small case of each family and solver."""
    seen = set()
    for case in cases(True):
        kind = tuple(case.parameters.get(name) for name in ("family", "solver", "bending", "plane"))
        if kind[0] in ("column", "incline", "stretch", "cantilever") and kind not in seen:
            seen.add(kind)
            run({**case.parameters, **({"rounds": 1} if kind[0] == "incline" else {})})


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One case: its quantities; where this version lacks what it needs, none, and the reason."""
    settings = dict(parameters)
    measure = FAMILIES[settings.pop("family")]
    try:
        return {"available": True, "reason": "", **measure(**settings)}
    except NotAvailable as reason:
        return {"available": False, "reason": str(reason), "quantities": []}
