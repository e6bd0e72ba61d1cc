"""clothgym: cloth simulation for learning and graphics, on any laptop.

Public names are imported when they are first used: what a program does not touch, it does not load.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from clothgym import metrics, scenes
    from clothgym.body import Body
    from clothgym.detection.intersections import (
        Contour,
        Intersections,
        Proximities,
        collisions,
        intersections,
        proximities,
    )
    from clothgym.dressing import Draped, drape
    from clothgym.errors import MissingExtraError, SimulationError
    from clothgym.fidelity import Fidelity
    from clothgym.materials import Material
    from clothgym.mesh import Mesh, Surface, grid
    from clothgym.pattern import Pattern
    from clothgym.response.untangling.run import UntangleResult, untangle
    from clothgym.scene import Cloth, Grip, Scene
    from clothgym.simulation import Simulation

__version__ = "0.1.0"

_HOMES = {
    "Body": "body",
    "Contour": "detection.intersections",
    "Intersections": "detection.intersections",
    "Proximities": "detection.intersections",
    "collisions": "detection.intersections",
    "intersections": "detection.intersections",
    "proximities": "detection.intersections",
    "Draped": "dressing",
    "drape": "dressing",
    "MissingExtraError": "errors",
    "SimulationError": "errors",
    "Fidelity": "fidelity",
    "Material": "materials",
    "Mesh": "mesh",
    "Surface": "mesh",
    "grid": "mesh",
    "Pattern": "pattern",
    "UntangleResult": "response.untangling.run",
    "untangle": "response.untangling.run",
    "Cloth": "scene",
    "Grip": "scene",
    "Scene": "scene",
    "Simulation": "simulation",
}


def __getattr__(name: str) -> Any:
    if name in ("scenes", "metrics"):
        return importlib.import_module(f"clothgym.{name}")
    if name in _HOMES:
        value = getattr(importlib.import_module(f"clothgym.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'clothgym' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES, "scenes", "metrics"])


__all__ = [
    "Body",
    "Cloth",
    "Contour",
    "Draped",
    "Fidelity",
    "Grip",
    "Intersections",
    "Material",
    "Mesh",
    "MissingExtraError",
    "Pattern",
    "Proximities",
    "Scene",
    "Simulation",
    "SimulationError",
    "Surface",
    "UntangleResult",
    "__version__",
    "collisions",
    "drape",
    "grid",
    "intersections",
    "metrics",
    "proximities",
    "scenes",
    "untangle",
]
