"""Garments sewn from patterns around a body: when their seams are closed and gravity begins, and when their wearer walks."""

from __future__ import annotations

import dataclasses

from clothgym.rig import NAMES
from clothgym.scene import Scene
from clothgym.wardrobe import NAMES as _PATTERNS


def draped(pattern: str = "skirt", body: str = "female", edge_length: float = 0.025) -> Scene:
    """A garment of the package, sewn around a body of the package, that falls into its drape [Vassilev 2001, fig. 6]."""
    from clothgym.dressing.draping import hung

    return dataclasses.replace(hung(pattern, body, edge_length), name="draped")


def walking_trousers(pattern: str = "trousers", body: str = "female", edge_length: float = 0.03) -> Scene:
    """Trousers, or another garment of the package, hang at rest on a body that begins to walk on the spot [Mezger 2003, 7]:
    the garment is draped when the scene is made."""
    from clothgym.dressing import drape
    from clothgym.dressing.walking import walking_scene

    worn = drape(pattern, body, fidelity="draft", edge_length=edge_length)
    return dataclasses.replace(walking_scene([worn]), name="walking_trousers")


MAKERS = {"draped": draped, "walking_trousers": walking_trousers}
_COMMON = {
    "pattern": ("", 0, 0, "pattern of the package", _PATTERNS),
    "body": ("", 0, 0, "body of the package", NAMES),
    "edge_length": ("m", 0.008, 0.1, "of the garment's triangles"),
}
PARAMETERS = {"draped": _COMMON, "walking_trousers": _COMMON}
