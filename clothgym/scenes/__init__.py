"""Ready scenes by name, one file a family: `make(name, **parameters)`, `names()`, `describe(name)`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from clothgym.arrays import check_choice, check_number
from clothgym.scene import Scene
from clothgym.scenes import canonical as canonical_tangles
from clothgym.scenes import crossing, faulty, garments, hard, layers, mezger, ribbon, sheets, shells, validation


@dataclass(frozen=True)
class Parameter:
    """A parameter of a scene: its default, unit, range or choices, and meaning."""

    name: str
    default: Any
    unit: str
    low: float
    high: float
    meaning: str
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class Description:
    """What a scene is and which parameters it takes."""

    name: str
    text: str
    parameters: tuple[Parameter, ...]


_FAMILIES = (sheets, crossing, canonical_tangles, hard, faulty, ribbon, layers, shells, garments, mezger, validation)
_MAKERS: dict[str, Callable[..., Scene]] = {}
_PARAMETERS: dict[str, dict[str, tuple[Any, ...]]] = {}
for _family in _FAMILIES:
    _MAKERS.update(_family.MAKERS)
    _PARAMETERS.update(_family.PARAMETERS)


def names() -> tuple[str, ...]:
    """All scenes."""
    return tuple(sorted(_MAKERS))


def describe(name: str) -> Description:
    """Text and parameters of a scene.

    Raises:
        ValueError: no such scene.
    """
    maker = _maker(name)
    text = inspect.getdoc(maker) or ""
    defaults = {key: p.default for key, p in inspect.signature(maker).parameters.items()}
    parameters = tuple(
        Parameter(key, defaults[key], *_PARAMETERS[name][key]) for key in defaults if key in _PARAMETERS[name]
    )
    return Description(name, text, parameters)


def make(name: str, **parameters: Any) -> Scene:
    """A scene by name.

    Raises:
        ValueError: no such scene or parameter, or a value out of range; names the field, value and range.
    """
    maker = _maker(name)
    known = {p.name: p for p in describe(name).parameters}
    checked: dict[str, Any] = {}
    for key, value in parameters.items():
        if key not in known:
            raise ValueError(f"{name}.{key}: unknown parameter; known: {', '.join(known)}")
        parameter = known[key]
        if parameter.choices:
            checked[key] = check_choice(value, f"{name}.{key}", parameter.choices)
        else:
            integer = isinstance(parameter.default, int)
            checked[key] = check_number(value, f"{name}.{key}", parameter.low, parameter.high, integer)
    return maker(**checked)


def _maker(name: str) -> Callable[..., Scene]:
    if name not in _MAKERS:
        raise ValueError(f"scene = {name!r}: expected one of {', '.join(names())}")
    return _MAKERS[name]
