"""Fabrics: springs of the mass-spring model [Vassilev 2001, section 3], moduli of a continuum, bending rigidity."""

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
    "weft": (1e-6, 1e9),
    "warp": (1e-6, 1e9),
    "coupling": (0.0, 1e9),
    "shear_modulus": (0.0, 1e9),
    "bending": (0.0, 1e6),
    "bending_warp": (0.0, 1e6),
    "damping": (0.0, 1e4),
    "friction": (0.0, 10.0),
    "thickness": (1e-7, 1.0),
}
_OPTIONAL = ("weft", "warp", "coupling", "shear_modulus", "bending_warp")
_NONE_OR_MORE = ("shear", "flexion", "coupling", "shear_modulus", "bending", "bending_warp")
LEAST_STIFFNESS = 1e-12
"""[N/m or N m] of what is there; the compliance 1 / (k dt^2) of a subnormal stiffness is infinite, and infinity times 0 is
no number."""


@dataclass(frozen=True)
class Material:
    """A fabric.

    Attributes:
        density: mass per area [kg/m^2].
        stretch: stiffness of a structural spring [N/m].
        shear: stiffness of a diagonal spring of a quad [N/m]; 0 = no such springs.
        flexion: stiffness of a spring that skips one vertex, or joins the two vertices opposite an edge [N/m]; 0 = none.
        weft, warp: moduli C11, C22 of the continuum membrane along the first and second axis of the rest shape [N/m];
            coupling: C12; shear_modulus: C33 [N/m]. What is None is the equivalent of the springs, see `moduli`.
        bending: bending rigidity B [N m] of `Fidelity.bending` "hinge" and "quadratic": a cylinder of curvature k holds
            B k^2 / 2 per area. It bends the weft; bending_warp: the warp, None = the same.
        damping: viscous damping c of every velocity [1/s], C_vd = c m.
        friction: Coulomb coefficient against cloth and ground.
        thickness: distance that contact keeps between two layers [m].
    """

    density: float = 0.15
    stretch: float = 1e4
    shear: float = 2e2
    flexion: float = 2e-2
    weft: float | None = None
    warp: float | None = None
    coupling: float | None = None
    shear_modulus: float | None = None
    bending: float = 1e-5
    bending_warp: float | None = None
    damping: float = 0.5
    friction: float = 0.3
    thickness: float = 2e-3

    def __post_init__(self) -> None:
        for field, (low, high) in _RANGES.items():
            value = getattr(self, field)
            if value is None and field in _OPTIONAL:
                continue
            value = check_number(value, f"material.{field}", low, high)
            if field in _NONE_OR_MORE and 0.0 < value < LEAST_STIFFNESS:
                raise ValueError(f"material.{field} = {value:g}: expected 0, or from {LEAST_STIFFNESS:g} to {high:g}")
            # stored as plain numbers, so that JSON and hashes do not depend on the caller's types
            object.__setattr__(self, field, value)
        c11, c12, c22, _ = self.moduli
        if c12 * c12 >= c11 * c22:
            raise ValueError(
                f"material.coupling = {c12:g}: its square must lie below weft * warp = {c11:g} * {c22:g} [N/m], or the "
                "cloth would gain energy by straining"
            )
        if (self.bending == 0.0) != (self.bending_along_warp == 0.0):
            raise ValueError(
                f"material.bending_warp = {self.bending_along_warp:g}: zero must go with bending, and only so"
            )

    @property
    def moduli(self) -> tuple[float, float, float, float]:
        """C11, C12, C22, C33 [N/m] of the membrane.

        What is not given is the equivalent of the springs. A square grid with structural springs k and diagonals s in
        every cell of side a holds, per area, for the strains e_u, e_v and g: k (e_u^2 + e_v^2) / 2 from the sides, and
        2 s a^2 ((e_u + e_v + g)^2 + (e_u + e_v - g)^2) / 8 / a^2 from the diagonals; so C11 = C22 = k + s, C12 = C33 = s.
        """
        both, shear = self.stretch + self.shear, self.shear
        given = ((self.weft, both), (self.coupling, shear), (self.warp, both), (self.shear_modulus, shear))
        c11, c12, c22, c33 = (float(other if value is None else value) for value, other in given)
        return c11, c12, c22, c33

    @property
    def bending_along_warp(self) -> float:
        """Bending rigidity of the warp [N m]."""
        return self.bending if self.bending_warp is None else self.bending_warp

    def with_equivalent_springs(self) -> Material:
        """The same with those springs of a square grid that come nearest to the moduli.

        Two constants cannot show four moduli: shear is kept, and the mean of both stretches; springs have C12 = C33 and
        know no difference between weft and warp.

        Raises:
            ValueError: the shear modulus is not below the mean of weft and warp, which no springs of a grid can show.
        """
        c11, _, c22, c33 = self.moduli
        stretch = 0.5 * (c11 + c22) - c33
        if stretch <= 0.0:
            raise ValueError(
                f"material.shear_modulus = {c33:g}: springs need it below (weft + warp) / 2 = {0.5 * (c11 + c22):g}"
            )
        return dataclasses.replace(self, stretch=stretch, shear=c33)

    def to_json(self) -> dict[str, float | None]:
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
    "silk": Material(density=0.06, stretch=5e3, shear=5e1, flexion=5e-3, bending=3e-6, friction=0.2, thickness=1e-3),
    "denim": Material(
        density=0.4, stretch=3e4, shear=1e3, flexion=2e-1, weft=8.89e3, warp=8.89e3, coupling=0.0, shear_modulus=122.5,
        bending=1.69e-5, friction=0.4, thickness=3e-3,
    ),
    "wool": Material(
        density=0.168, stretch=1.88e3, shear=26.17, weft=1671.0, warp=2133.0, coupling=0.0, shear_modulus=26.17,
        bending=5.02e-6, bending_warp=5.56e-6,
    ),
    "twill": Material(
        density=0.22, stretch=1973.6, shear=52.4, weft=2017.0, warp=2035.0, coupling=9.17, shear_modulus=52.4,
        bending=3.14e-5,
    ),
}  # fmt: skip
"""Named fabrics; docs/materials.md says of each value whether it was measured, and by whom, or chosen.

Spring constants of cotton, silk and denim are chosen to look right at cells of 1 to 5 cm; those of wool and twill are the
equivalents of their moduli."""


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
