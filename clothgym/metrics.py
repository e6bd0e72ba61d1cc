"""What can be measured on a state; reads only."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.kernels.elastic import elastic_energy
from clothgym.model import ClothModel
from clothgym.state import ClothState

if TYPE_CHECKING:
    from clothgym.detection.body_mesh import BodyMesh

STRETCH = 0.5
"""A strain above this, or below minus this, is flagged."""
TRAVEL = 1.0
"""Mean edges that a vertex may move in a substep before its speed is flagged: springs and contact do not see such motion."""
ZONES = 0.01
"""Share of a step's vertices x substeps that contact may move as rigid zones (since reset) before it is flagged."""
ROUNDING = 0.01
"""Share of the thickness, or of what gravity moves in a substep, that neighbouring numbers may be apart."""
ENERGY = 0.1
"""Share of (weight x size + energy at the start) by which motion may exceed what was there before it is flagged."""
ENERGY_UNTANGLED = 1.0
"""The same where untangling has moved vertices: it works against springs, but should not throw cloth about."""
UNBALANCED = 0.9
"""Share of gravity, acting on the cloth as a whole, that an implicit solve may leave unbalanced in the last step: what
hangs in the air because its solve ended early leaves all of it."""
_STIR = 0.01
"""[m/s] of the whole cloth: motion that is never flagged."""


def edge_ratios(model: ClothModel, x: FloatArray) -> FloatArray:
    """Length / rest length of every edge that has one."""
    e = model.surface.edges
    proper = model.edge_rest > 0
    lengths = np.linalg.norm(x[e[:, 1]] - x[e[:, 0]], axis=1)
    return lengths[proper] / model.edge_rest[proper]


def max_strain(model: ClothModel, x: FloatArray) -> float:
    """Largest edge length / rest length - 1."""
    return float(edge_ratios(model, x).max() - 1.0)


def kinetic_energy(model: ClothModel, v: FloatArray) -> float:
    """[J], pinned vertices included only if they move."""
    return float(0.5 * (model.masses * (v * v).sum(axis=1)).sum())


def gravity_energy(model: ClothModel, x: FloatArray) -> float:
    """[J] of the vertices that can move; zero at the origin."""
    free = model.inverse_masses > 0
    return -float((model.masses[free] * (x[free] @ np.asarray(model.scene.gravity))).sum())


def contact_force(forces: FloatArray, x: FloatArray, body: BodyMesh, part_of_face: IntArray, parts: int) -> FloatArray:
    """(P, 3) [N] sum of the forces (V, 3) on cloth at x (V, 3), by the part of the body's surface nearest to each vertex."""
    total = np.zeros((parts, 3))
    touched = np.flatnonzero(forces.any(axis=1))
    if len(touched):
        np.add.at(total, part_of_face[body.closest(x[touched])[1]], forces[touched])
    return total


def potential_energy(model: ClothModel, x: FloatArray) -> float:
    """Gravity, springs, membrane and bending [J]; zero for the unstrained cloth at the origin."""
    return float(sum(elastic_energy(x, model.arrays))) + gravity_energy(model, x)


def flags(model: ClothModel, x: FloatArray, v: FloatArray, dt: float) -> tuple[str, ...]:
    """What is wrong with a state, one line each; the first word is the kind.

    stretch: an edge longer than 1.5 of its rest length; compression: shorter than half of it; speed: a vertex crosses
    more than a mean edge in a substep of dt [s]; rounding: coordinates so large, or substeps so short, that neighbouring
    floating-point numbers are further apart than 1 % of the thickness or of what gravity moves in a substep.
    """
    found = []
    ratios = edge_ratios(model, x)
    longest, shortest = float(ratios.max()) - 1.0, float(ratios.min()) - 1.0
    if longest > STRETCH:
        found.append(f"stretch {longest:.3g} above {STRETCH:g}")
    if shortest < -STRETCH:
        found.append(f"compression {shortest:.3g} below {-STRETCH:g}")
    travel = float(np.sqrt((v * v).sum(axis=1).max())) * dt / model.mean_edge
    if travel > TRAVEL:
        found.append(f"speed {travel:.3g} mean edges a substep, above {TRAVEL:g}")
    spacing = float(np.spacing(np.abs(x).max()))
    fall = float(np.linalg.norm(model.scene.gravity)) * dt * dt
    least = min(float(model.thickness.min()), fall) if fall > 0.0 else float(model.thickness.min())
    if spacing > ROUNDING * least:
        found.append(f"rounding {spacing:.3g} m between neighbouring coordinates, above {ROUNDING * least:.3g} m")
    return tuple(found)


def work_flags(
    model: ClothModel, work: Mapping[str, int], substeps: int, clamped: int = 0, unbalanced: float = 0.0
) -> tuple[str, ...]:
    """What contact could not do properly, from the counters since reset and of the last step.

    zones: vertices moved as rigid zones because their pairs could not be kept apart one by one, counted in substeps;
    unproved: substeps after which it is not proved that no pair went through another; tunnelled:
    pairs that did, as far as they were looked for; clamped: vertices pressed from both sides with less room than they need;
    unbalanced: an implicit solve that ended early has left the cloth as a whole accelerated by almost gravity or more.
    """
    found = []
    zoned, allowed = work.get("zoned", 0), ZONES * model.vertex_count * substeps
    if zoned > allowed:
        found.append(f"zones {zoned} vertices moved rigidly since reset, above {allowed:g}")
    if work.get("unproved", 0) > 0:
        found.append(f"unproved {work['unproved']} substeps of contact since reset")
    if work.get("tunnel_events", 0) > 0:
        found.append(f"tunnelled {work['tunnel_events']} pairs since reset")
    if clamped > 0:
        found.append(f"clamped {clamped} vertices in the last step")
    allowed = UNBALANCED * float(np.linalg.norm(model.scene.gravity)) or 1.0
    if unbalanced > allowed:
        found.append(f"unbalanced {unbalanced:.3g} m/s^2 on the whole cloth after a solve, above {allowed:.3g}")
    return tuple(found)


def energy_flags(
    model: ClothModel, start: ClothState, x: FloatArray, v: FloatArray, share: float = ENERGY
) -> tuple[str, ...]:
    """Whether a cloth moves faster or hangs higher than the energy at its start allows; for runs without outside work.

    Springs cannot hold less than nothing, so kinetic energy + height now is at most all energy at the start. Energy in
    over-stretched springs is no part of it: that is what "stretch" tells. `share`: `ENERGY` or `ENERGY_UNTANGLED`.
    """
    before = kinetic_energy(model, start.velocities) + potential_energy(model, start.positions)
    excess = kinetic_energy(model, v) + gravity_energy(model, x) - before
    free = float(model.masses[model.inverse_masses > 0].sum())
    weight = free * float(np.linalg.norm(model.scene.gravity))
    stored = before - gravity_energy(model, start.positions)
    allowed = share * (weight * float(np.ptp(start.positions, axis=0).max()) + stored)
    allowed += 0.5 * free * _STIR**2
    return (f"energy {excess:.3g} J out of nothing, above {allowed:.3g} J",) if excess > allowed else ()
