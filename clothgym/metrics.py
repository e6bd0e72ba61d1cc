"""What can be measured on a state; reads only."""

from __future__ import annotations

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.kernels.elastic import elastic_energy
from clothgym.model import ClothModel


def max_strain(model: ClothModel, x: FloatArray) -> float:
    """Largest edge length / rest length - 1."""
    e = model.surface.edges
    proper = model.edge_rest > 0
    lengths = np.linalg.norm(x[e[:, 1]] - x[e[:, 0]], axis=1)
    return float((lengths[proper] / model.edge_rest[proper]).max() - 1.0)


def kinetic_energy(model: ClothModel, v: FloatArray) -> float:
    """[J], pinned vertices included only if they move."""
    return float(0.5 * (model.masses * (v * v).sum(axis=1)).sum())


def potential_energy(model: ClothModel, x: FloatArray) -> float:
    """Gravity, springs, membrane and bending [J]; zero for the unstrained cloth at the origin."""
    gravity = np.asarray(model.scene.gravity)
    free = model.inverse_masses > 0
    return float(sum(elastic_energy(x, model.arrays)) - (model.masses[free] * (x[free] @ gravity)).sum())
