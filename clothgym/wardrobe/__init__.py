"""Patterns of the package: drafted to the sizes of a body, and placed around it.

    pattern = wardrobe.tailored("trousers", body.load("male"))
    pattern.save("trousers.json")              # GarmentCode's format, as any pattern

Lengths and widths follow the body, with the ease of each garment; so does the placement.
"""

from __future__ import annotations

from clothgym.arrays import check_choice
from clothgym.body import Body
from clothgym.pattern import Pattern
from clothgym.sizes import sizes
from clothgym.wardrobe import bottoms, rings, tops

DRAFTS = {**bottoms.DRAFTS, **tops.DRAFTS, **rings.DRAFTS}
NAMES = tuple(sorted(DRAFTS))


def tailored(name: str, body: Body) -> Pattern:
    """A pattern of the package, cut to a body and placed around it.

    Args:
        name: one of `NAMES`.
        body: who stands upright, arms apart from the trunk.

    Raises:
        ValueError: another name, or a body that cannot be measured.
    """
    check_choice(name, "pattern", NAMES)
    return DRAFTS[name](sizes(body))


__all__ = ["DRAFTS", "NAMES", "tailored"]
