"""Fabrics in the terms of the mass-spring model [Vassilev 2001, section 3]."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from clothgym.arrays import check_number, shown

_RANGES = {
    "density": (1e-6, 1e3),
    "stretch": (1e-6, 1e9),
    "shear": (0.0, 1e9),
    "flexion": (0.0, 1e9),
    "damping": (0.0, 1e4),
    "friction": (0.0, 10.0),
    "thickness": (1e-7, 1.0),
}
_NONE_OR_MORE = ("shear", "flexion")
LEAST_STIFFNESS = 1e-12
"""[N/m] of a spring; the compliance 1 / (k dt^2) of a subnormal stiffness is infinite, and infinity times 0 is no number."""


@dataclass(frozen=True)
class Material:
    """A fabric.

    Attributes:
        density: mass per area [kg/m^2].
        stretch: stiffness of a structural spring [N/m].
        shear: stiffness of a diagonal spring of a quad [N/m]; 0 = no such springs.
        flexion: stiffness of a spring that skips one vertex, or joins the two vertices opposite an edge [N/m]; 0 = none.
        damping: viscous damping c of every velocity [1/s], C_vd = c m.
        friction: Coulomb coefficient against cloth and ground.
        thickness: distance that contact keeps between two layers [m].
    """

    density: float = 0.15
    stretch: float = 1e4
    shear: float = 2e2
    flexion: float = 2e-2
    damping: float = 0.5
    friction: float = 0.3
    thickness: float = 2e-3

    def __post_init__(self) -> None:
        for field, (low, high) in _RANGES.items():
            value = check_number(getattr(self, field), f"material.{field}", low, high)
            if field in _NONE_OR_MORE and 0.0 < value < LEAST_STIFFNESS:
                raise ValueError(f"material.{field} = {value:g}: expected 0, or from {LEAST_STIFFNESS:g} to {high:g}")
            # stored as plain numbers, so that JSON and hashes do not depend on the caller's types
            object.__setattr__(self, field, value)

    def to_json(self) -> dict[str, float]:
        """Plain values, see `from_json`."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(values: dict[str, Any]) -> Material:
        """Raises ValueError for an unknown field, by name."""
        unknown = set(values) - set(_RANGES)
        if unknown:
            raise ValueError(f"material.{min(unknown)}: unknown field; known: {', '.join(_RANGES)}")
        return Material(**values)


MATERIALS: dict[str, Material] = {
    "cotton": Material(),
    "silk": Material(density=0.06, stretch=5e3, shear=5e1, flexion=5e-3, friction=0.2, thickness=1e-3),
    "denim": Material(density=0.4, stretch=3e4, shear=1e3, flexion=2e-1, friction=0.4, thickness=3e-3),
}
"""Names for cloths of that kind: spring constants chosen to look right at cells of 1 to 5 cm, not measured fabrics."""


def get(material: str | Material) -> Material:
    """A material by name or as it is.

    Raises:
        ValueError: an unknown name.
    """
    if isinstance(material, Material):
        return material
    if not isinstance(material, str) or material not in MATERIALS:
        raise ValueError(f"material = {shown(material)}: expected one of {', '.join(MATERIALS)} or a Material")
    return MATERIALS[material]
