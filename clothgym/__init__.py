"""clothgym: cloth simulation for learning and graphics, on any laptop."""

from __future__ import annotations

from clothgym import metrics, scenes
from clothgym.detection.intersections import Contour, Intersections, Proximities, intersections, proximities
from clothgym.errors import MissingExtraError, SimulationError
from clothgym.fidelity import Fidelity
from clothgym.materials import Material
from clothgym.mesh import Mesh, Surface, grid
from clothgym.response.untangling.run import UntangleResult, untangle
from clothgym.scene import Cloth, Grip, Scene
from clothgym.simulation import Simulation

__version__ = "0.1.0"

__all__ = [
    "Cloth",
    "Contour",
    "Fidelity",
    "Grip",
    "Intersections",
    "Material",
    "Mesh",
    "MissingExtraError",
    "Proximities",
    "Scene",
    "Simulation",
    "SimulationError",
    "Surface",
    "UntangleResult",
    "__version__",
    "grid",
    "intersections",
    "metrics",
    "proximities",
    "scenes",
    "untangle",
]
