"""Contact between cloths: which near pairs press, projection with friction, and what is taken back of its recovery."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.elastic import project_elastic
from clothgym.kernels.integrate import add_grip_forces, hold_grips, keep_above_ground
from clothgym.kernels.near_pairs import LOOK, NEAR, look, spread

_LEEWAY = 0.05
"""Thicknesses that sweeps are taken to move a vertex: contacts that are open by more than that and the expected motion rest."""
CROSSING = 0.9
"""Thicknesses that crossing edges keep."""


class Contacts(NamedTuple):
    """Contacts of near pairs; capacity K."""

    quads: NDArray  # (K, 4) int32 vertex ids, those with weight first
    ends: NDArray  # (K,) int64 how many have weight
    weights: NDArray  # (K, 4) signed barycentric weights, sum 0
    normals: NDArray  # (K, 3) from the second side to the first
    mobility: NDArray  # (K,) of the gap [1/kg]
    rest: NDArray  # (K,) thickness [m]
    clear: NDArray  # (K,) relative motion since the last look before which it cannot press [m]
    limit: NDArray  # (K,) largest normal force [N]; inf except beside an intersection
    approach: NDArray  # (K,) predicted change of distance along the normal [m]
    pressed: NDArray  # (K,) accumulated normal multiplier
    dragged: NDArray  # (K, 3) accumulated friction multiplier
    live: NDArray  # (K,) int64 rows that may press within the substep


NO_CONTACTS = Contacts(
    np.zeros((0, 4), np.int32),
    np.zeros(0, np.int64),
    np.zeros((0, 4)),
    np.zeros((0, 3)),
    np.zeros(0),
    np.zeros(0),
    np.zeros(0),
    np.zeros(0),
    np.zeros(0),
    np.zeros(0),
    np.zeros((0, 3)),
    np.zeros(0, np.int64),
)
"""Of a scene in which cloth touches no cloth."""


@device
def _link(watched, count):
    """Lists of the near pairs of each vertex with a triangle."""
    watched.heads[:] = -1
    for n in range(count):
        if watched.states[n] == NEAR and watched.kinds[n] == 0:
            v = watched.quads[n, 0]
            watched.links[n] = watched.heads[v]
            watched.heads[v] = n


@device
def _is_nearest(n, watched):
    """Whether no triangle around the closest point of pair n is nearer to its vertex.

    The vertex then is nearest there to the whole surface; of triangles that share this point, the first one counts.
    """
    quads = watched.quads
    m = watched.heads[quads[n, 0]]
    while m >= 0:
        nearer = watched.gaps[m] < watched.gaps[n] or (watched.gaps[m] == watched.gaps[n] and m < n)
        if nearer:
            around = True
            for k in range(1, 4):
                v = quads[n, k]
                here = v == quads[m, 1] or v == quads[m, 2] or v == quads[m, 3]
                around = around and (here or watched.weights[n, k] == 0.0)
            if around:
                return False
        m = watched.links[m]
    return True


@device
def _collect(watched, count, inverse_masses, yield_force, contacts):
    """Contacts of the near pairs; returns how many, more than fit if the capacity does not suffice.

    Vertices press on the surface where it is nearest. Edges press where they cross, and keep a little less than the thickness:
    between layers that lie flat, vertices alone keep them apart. Edges that meet at an end leave it to the vertex there.
    """
    found = 0
    capacity = contacts.rest.shape[0]
    _link(watched, count)
    for n in range(count):
        if watched.states[n] != NEAR:
            continue
        ends = 0
        for k in range(4):
            ends += watched.weights[n, k] != 0.0
        crossing = watched.kinds[n] == 1
        if ends < 4 and (crossing or not _is_nearest(n, watched)):
            continue
        if found >= capacity:
            found += 1
            continue
        ends = 0
        mobility = 0.0
        for k in range(4):
            w = watched.weights[n, k]
            if w != 0.0:
                contacts.quads[found, ends] = watched.quads[n, k]
                contacts.weights[found, ends] = w
                mobility += w * w * inverse_masses[watched.quads[n, k]]
                ends += 1
        for k in range(ends, 4):
            contacts.quads[found, k] = contacts.quads[found, 0]
            contacts.weights[found, k] = 0.0
        for c in range(3):
            contacts.normals[found, c] = watched.separation[n, c]
        rest = CROSSING * watched.rest[n] if crossing else watched.rest[n]
        contacts.ends[found] = ends
        contacts.mobility[found] = mobility
        contacts.rest[found] = rest
        contacts.clear[found] = watched.gaps[n] - watched.ways[n] - rest
        contacts.limit[found] = yield_force if watched.separation[n, 3] < 0.0 else math.inf
        found += 1
    return found


@device
def _start(x, p, contacts, count, reach):
    """Those of `count` contacts that may press on the way from x to p, with multipliers of zero; `reach` is the relative motion
    since the last look. Returns how many."""
    live = 0
    for n in range(count):
        contacts.pressed[n] = 0.0
        if contacts.clear[n] > reach + _LEEWAY * contacts.rest[n] or contacts.mobility[n] == 0.0:
            continue
        contacts.live[live] = n
        live += 1
        for c in range(3):
            contacts.dragged[n, c] = 0.0
        approach = 0.0
        for k in range(contacts.ends[n]):
            v = contacts.quads[n, k]
            along = 0.0
            for c in range(3):
                along += contacts.normals[n, c] * (p[v, c] - x[v, c])
            approach += contacts.weights[n, k] * along
        contacts.approach[n] = approach
    return live


@device
def narrowed(x, p, watched, count, inverse_masses, apart, both, yield_force, known, contacts):
    """See `narrow`."""
    motion = spread(p, watched)
    measured = 0
    if known < 0 or not motion <= watched.least[LOOK]:
        measured = look(x, p, watched, count, apart, both, yield_force == 0.0)
        motion = spread(p, watched)
        known = _collect(watched, count, inverse_masses, yield_force, contacts)
        if known > contacts.rest.shape[0]:
            return known, 0, measured
    return known, _start(x, p, contacts, known, motion), measured


@kernel
def narrow(x, p, watched, count, inverse_masses, apart, both, yield_force, known, contacts):
    """Contacts on the way from x to p (V, 3); `known` of them were collected at the last look, negative = none is up to date.

    Pairs beside an intersection (apart (V,)) are left out if yield_force [N] is 0, and may press no harder than it otherwise.
    Returns how many contacts there are, more than fit if the capacity does not suffice, how many of them are live, and how
    many pairs were measured.
    """
    return narrowed(x, p, watched, count, inverse_masses, apart, both, yield_force, known, contacts)


@device
def project_contacts(x, p, inverse_masses, contacts, count, friction, dt):
    """One Gauss-Seidel sweep over `count` live contacts: keep the thickness along the normal, Coulomb friction across it;
    momentum is kept."""
    for m in range(count):
        n = contacts.live[m]
        ends = contacts.ends[n]
        q = contacts.quads[n]
        w = contacts.weights[n]
        normal = contacts.normals[n]
        mobility = contacts.mobility[n]
        gap = -contacts.rest[n]
        for k in range(ends):
            gap += w[k] * (normal[0] * p[q[k], 0] + normal[1] * p[q[k], 1] + normal[2] * p[q[k], 2])
        before = contacts.pressed[n]
        after = min(max(0.0, before - gap / mobility), contacts.limit[n] * dt * dt)
        if before == 0.0 and after == 0.0:
            continue
        contacts.pressed[n] = after
        push = after - before
        if push != 0.0:
            for k in range(ends):
                g = push * w[k] * inverse_masses[q[k]]
                p[q[k], 0] += g * normal[0]
                p[q[k], 1] += g * normal[1]
                p[q[k], 2] += g * normal[2]
        if friction == 0.0:
            continue
        tx = 0.0
        ty = 0.0
        tz = 0.0
        for k in range(ends):
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
        for k in range(ends):
            g = w[k] * inverse_masses[q[k]]
            p[q[k], 0] += g * tx
            p[q[k], 1] += g * ty
            p[q[k], 2] += g * tz


@device
def sweep_all(x, p, cloth, contacts, count, friction, radii, motion, ground, grips, multipliers, substep, with_springs):
    """See `solve`."""
    multipliers[:] = 0.0
    grips.multipliers[:] = 0.0
    for _ in range(motion.sweeps):
        if with_springs:
            project_elastic(p, cloth, motion.dt, multipliers)
        hold_grips(p, cloth.inverse_masses, grips, motion.dt, (substep + 1) * motion.dt)
        project_contacts(x, p, cloth.inverse_masses, contacts, count, friction, motion.dt)
        keep_above_ground(x, p, cloth.inverse_masses, radii, ground)


@kernel
def solve(x, p, cloth, contacts, count, friction, radii, motion, ground, grips, multipliers, substep, with_springs):
    """Sweeps over springs, grips, contacts and ground, contact last; `with_springs` is off for explicit integration."""
    sweep_all(
        x, p, cloth, contacts, count, friction, radii, motion, ground, grips, multipliers, substep, with_springs
    )
    add_grip_forces(grips, motion.dt)


@device
def take_rebound(v, inverse_masses, contacts, count, dt):
    """See `stop_rebound`."""
    for m in range(count):
        n = contacts.live[m]
        if contacts.pressed[n] <= 0.0:
            continue
        ends = contacts.ends[n]
        q = contacts.quads[n]
        w = contacts.weights[n]
        normal = contacts.normals[n]
        speed = 0.0
        for k in range(ends):
            speed += w[k] * (normal[0] * v[q[k], 0] + normal[1] * v[q[k], 1] + normal[2] * v[q[k], 2])
        allowed = max(0.0, contacts.approach[n] / dt)
        if speed <= allowed:
            continue
        impulse = (allowed - speed) / contacts.mobility[n]
        for k in range(ends):
            g = impulse * w[k] * inverse_masses[q[k]]
            v[q[k], 0] += g * normal[0]
            v[q[k], 1] += g * normal[1]
            v[q[k], 2] += g * normal[2]


@kernel
def stop_rebound(v, inverse_masses, contacts, count, dt):
    """Takes away separating speed that the recovery of thickness gave to pressed contacts (restitution 0)."""
    take_rebound(v, inverse_masses, contacts, count, dt)
