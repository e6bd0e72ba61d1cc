"""What became of a garment on a body, in numbers: strains, hits, depth below the body, distance of what rests on it."""

from __future__ import annotations

from typing import Any

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.detection.intersections import intersections
from clothgym.detection.openings import Threading
from clothgym.dressing.sewing import rest_of
from clothgym.dressing.worn import SLIDE_LIMIT
from clothgym.garment import Garment
from clothgym.simulation import Simulation

REST_MEAN, REST_P99 = 0.004, 0.02
"""[m/s] at rest: the mean and the 99th percentile of the speeds of all vertices are below these."""

CARRIED = 0.1
"""Share of its weight from which on a vertex counts as carried by a body."""
_PARTS = 4
"""Sides of faces are cut into so many for the distance of what is carried."""


def rests(mean: float, p99: float) -> bool:
    """Whether speeds [m/s] are those of a garment at rest."""
    return mean < REST_MEAN and p99 < REST_P99


def report(
    garment: Garment,
    simulation: Simulation,
    speeds: tuple[float, float],
    worn: list[Threading],
    moved: list[float],
) -> dict[str, Any]:
    """See `Draped.report`.

    Args:
        garment: what was sewn.
        simulation: in which it hangs.
        speeds: mean and 99th percentile at the end [m/s].
        worn, moved: what goes through each opening, and how far its middle moved [m].
    """
    x = np.array(simulation.positions)
    surface, rest = rest_of(garment)
    ends = surface.edges
    strain = np.linalg.norm(x[ends[:, 1]] - x[ends[:, 0]], axis=1) / rest - 1.0
    at_seam = np.isin(ends, garment.seam_vertices).any(axis=1)
    depths = simulation.body_mesh.penetration(x, garment.faces)
    gaps = contact_gaps(simulation)
    hits = simulation.last_intersections if simulation.scene.self_collision else intersections(x, surface)
    mean, p99 = speeds
    return {
        "worn": all(w.right for w in worn) and max(moved) <= SLIDE_LIMIT,
        "at_rest": rests(mean, p99),
        "hits": int(hits.hit_count),
        "contour_length": float(hits.length),
        "strain_p99": float(np.percentile(np.abs(strain), 99)),
        "strain_max": float(np.abs(strain).max()),
        "seam_strain_p99": float(np.percentile(np.abs(strain[at_seam]), 99)) if at_seam.any() else 0.0,
        "penetration_p999": float(np.percentile(depths, 99.9)),
        "penetration_max": float(depths.max()),
        "contact_gap_median": float(np.median(gaps)) if len(gaps) else 0.0,
        "contact_gap_p99": float(np.percentile(gaps, 99)) if len(gaps) else 0.0,
        "carried": len(gaps),
        "mean_speed": mean,
        "p99_speed": p99,
        "simulated_seconds": simulation.time,
        "vertices": len(x),
        "panel_vertices": sum(len(mesh.vertices) for mesh in garment.panel_meshes),
        "faces": len(garment.faces),
        "openings": [
            {"expected": w.expected, "through": list(w.through), "right": w.right, "slide": slide}
            for w, slide in zip(worn, moved)
        ],
    }


def contact_gaps(simulation: Simulation) -> FloatArray:
    """(N,) for each vertex that a body carries, how far the cloth around it is from the true body where it comes closest [m].

    Carried is who gets a tenth of its weight or more from the bodies. Coarse cloth rests on the middles of its faces, with
    its vertices off a round limb: so each vertex answers for its faces. Below the skin, distances are negative.
    """
    model, faces = simulation.model, simulation.faces
    weight = model.masses * float(np.linalg.norm(simulation.scene.gravity))
    carried = np.linalg.norm(simulation.body_forces, axis=1) > CARRIED * weight
    around = faces[carried[faces].any(axis=1)]
    if len(around) == 0:
        return np.zeros(0)
    steps = np.arange(_PARTS + 1) / _PARTS
    weights = np.array([(a, b, 1.0 - a - b) for a in steps for b in steps if a + b <= 1.0])
    points = np.einsum("pc,fcx->fpx", weights, np.asarray(simulation.positions)[around])
    distances = simulation.body_mesh.signed_distance(points.reshape(-1, 3)).reshape(len(around), -1).min(axis=1)
    least = np.full(model.vertex_count, np.inf)
    np.minimum.at(least, around.ravel(), np.repeat(distances, 3))
    return np.asarray(least[carried])
