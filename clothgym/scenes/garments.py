"""Garments sewn from patterns around a body, at the moment when their seams are closed and gravity begins."""

from __future__ import annotations

import dataclasses

from clothgym.rig import NAMES
from clothgym.scene import Scene

_PATTERNS = ("skirt", "sleeveless_shirt")


def draped(pattern: str = "skirt", body: str = "female", edge_length: float = 0.025) -> Scene:
    """A garment of the package, sewn around a body of the package, that falls into its drape [Vassilev 2001, fig. 6]."""
    from clothgym.dressing.draping import hung

    return dataclasses.replace(hung(pattern, body, edge_length), name="draped")


MAKERS = {"draped": draped}
PARAMETERS = {
    "draped": {
        "pattern": ("", 0, 0, "pattern of the package", _PATTERNS),
        "body": ("", 0, 0, "body of the package", NAMES),
        "edge_length": ("m", 0.008, 0.1, "of the garment's triangles"),
    }
}
