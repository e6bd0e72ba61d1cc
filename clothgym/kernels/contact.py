"""Contact between cloths: closest points, projection with friction, and what is taken back of its recovery.

Pairs are "quads" of four vertex ids; kind 0 is (v, a, b, c), kind 1 is (a0, a1, b0, b1).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.elastic import project_elastic
from clothgym.kernels.integrate import hold_grips, keep_above_ground
from clothgym.kernels.primitives import closest_on_edges, closest_on_triangle

ACTIVE = 1.25
"""Pairs predicted to come nearer than this many thicknesses are projected; the certificate watches over the others."""


class Contacts(NamedTuple):
    """Active contacts of a substep; capacity K."""

    quads: NDArray  # (K, 4) int32 vertex ids
    weights: NDArray  # (K, 4) signed barycentric weights, sum 0
    normals: NDArray  # (K, 3) from the second side to the first, frozen for the substep
    rest: NDArray  # (K,) thickness [m]
    limit: NDArray  # (K,) largest normal force [N]; inf except beside an intersection
    approach: NDArray  # (K,) predicted change of distance along the normal [m]
    pressed: NDArray  # (K,) accumulated normal multiplier
    dragged: NDArray  # (K, 3) accumulated friction multiplier


NO_CONTACTS = Contacts(
    np.zeros((0, 4), np.int32),
    np.zeros((0, 4)),
    np.zeros((0, 3)),
    np.zeros(0),
    np.zeros(0),
    np.zeros(0),
    np.zeros(0),
    np.zeros((0, 3)),
)
"""Of a scene in which cloth touches no cloth."""


@device
def _weights(x, quads, n, kind):
    if kind == 0:
        wa, wb, wc = closest_on_triangle(x, quads[n, 0], quads[n, 1], quads[n, 2], quads[n, 3])
        return 1.0, -wa, -wb, -wc
    s, t = closest_on_edges(x, quads[n, 0], quads[n, 1], quads[n, 2], quads[n, 3])
    return 1.0 - s, s, -(1.0 - t), -t


@device
def _combine(x, quads, n, w0, w1, w2, w3, c):
    return w0 * x[quads[n, 0], c] + w1 * x[quads[n, 1], c] + w2 * x[quads[n, 2], c] + w3 * x[quads[n, 3], c]


@device
def _left_apart(apart, quads, n, kind, both):
    """Whether contact leaves this pair alone because it lies beside an intersection."""
    if kind == 0:
        one = apart[quads[n, 0]]
        two = apart[quads[n, 1]] or apart[quads[n, 2]] or apart[quads[n, 3]]
    else:
        one = apart[quads[n, 0]] or apart[quads[n, 1]]
        two = apart[quads[n, 2]] or apart[quads[n, 3]]
    return (one and two) if both else (one or two)


@kernel
def narrow(x, p, quads, kinds, count, thickness, apart, both, yield_force, limited, separation, contacts):
    """Closest points at the start of a substep: separation (C, 4) = normal and distance, -1 where nothing is certified.

    Pairs beside an intersection (apart (V,)) are left out if yield_force [N] is 0, and may press no harder than it otherwise;
    or, if `limited`, keep the distance that they have where it is less than the thickness.
    Pairs that would be nearer than 1.25 thicknesses at the predicted positions p become active contacts. Returns how
    many are active; as many as fit are written to `contacts`.
    """
    active = 0
    capacity = contacts.quads.shape[0]
    for n in range(count):
        separation[n, 3] = -1.0
        beside = _left_apart(apart, quads, n, kinds[n], both)
        if beside and yield_force == 0.0 and not limited:
            continue
        w0, w1, w2, w3 = _weights(x, quads, n, kinds[n])
        nx = _combine(x, quads, n, w0, w1, w2, w3, 0)
        ny = _combine(x, quads, n, w0, w1, w2, w3, 1)
        nz = _combine(x, quads, n, w0, w1, w2, w3, 2)
        distance = math.sqrt(nx * nx + ny * ny + nz * nz)
        if distance < 1e-12:  # touching: no side to keep
            continue
        nx /= distance
        ny /= distance
        nz /= distance
        separation[n, 0] = nx
        separation[n, 1] = ny
        separation[n, 2] = nz
        if not beside:
            separation[n, 3] = distance
        h = min(thickness[quads[n, 0]], thickness[quads[n, 1]], thickness[quads[n, 2]], thickness[quads[n, 3]])
        predicted = nx * _combine(p, quads, n, w0, w1, w2, w3, 0)
        predicted += ny * _combine(p, quads, n, w0, w1, w2, w3, 1)
        predicted += nz * _combine(p, quads, n, w0, w1, w2, w3, 2)
        if predicted > ACTIVE * h:
            continue
        if active < capacity:
            for k in range(4):
                contacts.quads[active, k] = quads[n, k]
            contacts.weights[active, 0] = w0
            contacts.weights[active, 1] = w1
            contacts.weights[active, 2] = w2
            contacts.weights[active, 3] = w3
            contacts.normals[active, 0] = nx
            contacts.normals[active, 1] = ny
            contacts.normals[active, 2] = nz
            contacts.rest[active] = min(h, distance) if beside and limited else h
            contacts.limit[active] = yield_force if beside and not limited else math.inf
            contacts.approach[active] = predicted - distance
            contacts.pressed[active] = 0.0
            contacts.dragged[active, 0] = 0.0
            contacts.dragged[active, 1] = 0.0
            contacts.dragged[active, 2] = 0.0
        active += 1
    return active


@device
def project_contacts(x, p, inverse_masses, contacts, count, friction, dt):
    """One Gauss-Seidel sweep: keep the thickness along the normal, Coulomb friction across it; momentum is kept."""
    for n in range(count):
        q = contacts.quads[n]
        w = contacts.weights[n]
        normal = contacts.normals[n]
        mobility = 0.0
        gap = -contacts.rest[n]
        for k in range(4):
            mobility += w[k] * w[k] * inverse_masses[q[k]]
            gap += w[k] * (normal[0] * p[q[k], 0] + normal[1] * p[q[k], 1] + normal[2] * p[q[k], 2])
        if mobility == 0.0:
            continue
        before = contacts.pressed[n]
        after = min(max(0.0, before - gap / mobility), contacts.limit[n] * dt * dt)
        contacts.pressed[n] = after
        push = after - before
        if push != 0.0:
            for k in range(4):
                g = push * w[k] * inverse_masses[q[k]]
                p[q[k], 0] += g * normal[0]
                p[q[k], 1] += g * normal[1]
                p[q[k], 2] += g * normal[2]
        if friction == 0.0 or (after == 0.0 and before == 0.0):
            continue
        tx = 0.0
        ty = 0.0
        tz = 0.0
        for k in range(4):
            tx += w[k] * (p[q[k], 0] - x[q[k], 0])
            ty += w[k] * (p[q[k], 1] - x[q[k], 1])
            tz += w[k] * (p[q[k], 2] - x[q[k], 2])
        along = tx * normal[0] + ty * normal[1] + tz * normal[2]
        nx = contacts.dragged[n, 0] - (tx - along * normal[0]) / mobility
        ny = contacts.dragged[n, 1] - (ty - along * normal[1]) / mobility
        nz = contacts.dragged[n, 2] - (tz - along * normal[2]) / mobility
        size = math.sqrt(nx * nx + ny * ny + nz * nz)
        limit = friction * after
        if size > limit:
            nx *= limit / size
            ny *= limit / size
            nz *= limit / size
        tx = nx - contacts.dragged[n, 0]
        ty = ny - contacts.dragged[n, 1]
        tz = nz - contacts.dragged[n, 2]
        contacts.dragged[n, 0] = nx
        contacts.dragged[n, 1] = ny
        contacts.dragged[n, 2] = nz
        for k in range(4):
            g = w[k] * inverse_masses[q[k]]
            p[q[k], 0] += g * tx
            p[q[k], 1] += g * ty
            p[q[k], 2] += g * tz


@kernel
def solve(x, p, cloth, contacts, count, friction, radii, motion, ground, grips, multipliers, substep, with_springs):
    """Sweeps over springs, grips, contacts and ground, contact last; `with_springs` is off for explicit integration."""
    multipliers[:] = 0.0
    grips.multipliers[:] = 0.0
    for _ in range(motion.sweeps):
        if with_springs:
            project_elastic(p, cloth, motion.dt, multipliers)
        hold_grips(p, cloth.inverse_masses, grips, motion.dt, (substep + 1) * motion.dt)
        project_contacts(x, p, cloth.inverse_masses, contacts, count, friction, motion.dt)
        keep_above_ground(x, p, cloth.inverse_masses, radii, ground)
    for a in range(grips.vertices.shape[0]):
        for c in range(3):
            grips.forces[a, c] += grips.multipliers[a, c] / (motion.dt * motion.dt)


@kernel
def stop_rebound(v, inverse_masses, contacts, count, dt):
    """Takes away separating speed that the recovery of thickness gave to pressed contacts (restitution 0)."""
    for n in range(count):
        if contacts.pressed[n] <= 0.0:
            continue
        q = contacts.quads[n]
        w = contacts.weights[n]
        normal = contacts.normals[n]
        speed = 0.0
        mobility = 0.0
        for k in range(4):
            mobility += w[k] * w[k] * inverse_masses[q[k]]
            speed += w[k] * (normal[0] * v[q[k], 0] + normal[1] * v[q[k], 1] + normal[2] * v[q[k], 2])
        allowed = max(0.0, contacts.approach[n] / dt)
        if speed <= allowed or mobility == 0.0:
            continue
        impulse = (allowed - speed) / mobility
        for k in range(4):
            g = impulse * w[k] * inverse_masses[q[k]]
            v[q[k], 0] += g * normal[0]
            v[q[k], 1] += g * normal[1]
            v[q[k], 2] += g * normal[2]
