"""Contact between cloths: which near pairs press, projection with friction, and what is taken back of its recovery."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import bare, device, kernel
from clothgym.kernels.bulk import roots
from clothgym.kernels.elastic import project_elastic
from clothgym.kernels.integrate import add_grip_forces, hold_grips, keep_above_ground
from clothgym.kernels.near_pairs import NEAR, TURN, look, stir
from clothgym.kernels.spring_runs import project_in_runs

_LEEWAY = 0.05
"""Thicknesses that sweeps are taken to move a vertex, beside what the fastest one moves: contacts that are open by more than
that and their expected motion rest."""
_MEASURED = 1.5
"""Thicknesses, beside what it is open, by which the closest points of a near pair are no longer opposite each other at most."""
_NO_WEIGHT = 1e-12
"""Less is what rounding leaves of a vertex that takes no part."""
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


@bare
def _link(watched, count):
    """Lists of the near pairs of each vertex with a triangle."""
    heads = watched.heads
    links = watched.links
    states = watched.states
    kinds = watched.kinds
    quads = watched.quads
    heads[:] = -1
    for n in range(count):
        if states[n] == NEAR and kinds[n] == 0:
            v = quads[n, 0]
            links[n] = heads[v]
            heads[v] = n


@bare
def _is_nearest(n, quads, weights, gaps, links, first):
    """Whether no triangle around the closest point of pair n is nearer to its vertex, among those listed from `first` on.

    The vertex then is nearest there to the whole surface; of triangles that share this point, the first one counts.
    """
    m = first
    while m >= 0:
        if gaps[m] < gaps[n] or (gaps[m] == gaps[n] and m < n):
            around = True
            for k in range(1, 4):
                v = quads[n, k]
                here = v == quads[m, 1] or v == quads[m, 2] or v == quads[m, 3]
                around = around and (here or abs(weights[n, k]) < _NO_WEIGHT)
            if around:
                return False
        m = links[m]
    return True


@bare
def _collect(watched, count, inverse_masses, yield_force, contacts):
    """Contacts of the near pairs; returns how many, more than fit if the capacity does not suffice.

    Vertices press on the surface where it is nearest. Edges press where they cross, and keep a little less than the thickness:
    between layers that lie flat, vertices alone keep them apart. Edges that meet at an end leave it to the vertex there.
    """
    found = 0
    capacity = contacts.rest.shape[0]
    _link(watched, count)
    states = watched.states
    kinds = watched.kinds
    quads = watched.quads
    weights = watched.weights
    gaps = watched.gaps
    ways = watched.ways
    rests = watched.rest
    separation = watched.separation
    heads = watched.heads
    links = watched.links
    for n in range(count):
        if states[n] != NEAR:
            continue
        ends = 0
        for k in range(4):
            ends += abs(weights[n, k]) >= _NO_WEIGHT
        crossing = kinds[n] == 1
        if ends < 4 and (crossing or not _is_nearest(n, quads, weights, gaps, links, heads[quads[n, 0]])):
            continue
        if found >= capacity:
            found += 1
            continue
        ends = 0
        mobility = 0.0
        for k in range(4):
            w = weights[n, k]
            if abs(w) >= _NO_WEIGHT:
                contacts.quads[found, ends] = quads[n, k]
                contacts.weights[found, ends] = w
                mobility += w * w * inverse_masses[quads[n, k]]
                ends += 1
        for k in range(ends, 4):
            contacts.quads[found, k] = quads[n, 0]
            contacts.weights[found, k] = 0.0
        for c in range(3):
            contacts.normals[found, c] = separation[n, c]
        rest = CROSSING * rests[n] if crossing else rests[n]
        limit = math.inf
        if separation[n, 3] < 0.0:  # beside an intersection
            limit = yield_force if yield_force > 0.0 else math.inf
            rest = min(rest, max(0.0, gaps[n] - ways[n])) if yield_force < 0.0 else rest
        contacts.ends[found] = ends
        contacts.mobility[found] = mobility
        contacts.rest[found] = rest
        contacts.clear[found] = gaps[n] - ways[n] - rest
        contacts.limit[found] = limit
        found += 1
    return found


@bare
def _longest(x, p):
    """Longest way from x to p [m]."""
    most = 0.0
    for i in range(x.shape[0]):
        dx = p[i, 0] - x[i, 0]
        dy = p[i, 1] - x[i, 1]
        dz = p[i, 2] - x[i, 2]
        square = dx * dx + dy * dy + dz * dz
        most = square if square > most else most
    return math.sqrt(most)


@bare
def _start(x, p, contacts, count, sizes, turn):
    """Those of `count` contacts that may press on the way from x to p, with multipliers of zero; sizes (V,): squares of
    how far vertices have moved since the last look, less what all have, and `turn` how far those have turned [rad]; afterwards
    their roots. Returns how many."""
    most = 2.0 * roots(sizes)
    leeway = _longest(x, p)
    live = 0
    quads = contacts.quads
    weights = contacts.weights
    normals = contacts.normals
    clear = contacts.clear
    rest = contacts.rest
    pressed = contacts.pressed
    mobility = contacts.mobility
    rows = contacts.live
    dragged = contacts.dragged
    ends = contacts.ends
    for n in range(count):
        pressed[n] = 0.0
        room = clear[n] - leeway - _LEEWAY * rest[n] - turn * (clear[n] + _MEASURED * rest[n])
        if room > most or mobility[n] == 0.0:
            continue
        reach = 0.0
        for k in range(4):  # those without weight too: no branch
            reach += abs(weights[n, k]) * sizes[np.uint64(quads[n, k])]
        if room > reach:
            continue
        rows[live] = n
        live += 1
        for c in range(3):
            dragged[n, c] = 0.0
        approach = 0.0
        for k in range(ends[n]):
            v = quads[n, k]
            along = 0.0
            for c in range(3):
                along += normals[n, c] * (p[v, c] - x[v, c])
            approach += weights[n, k] * along
        contacts.approach[n] = approach
    return live


@bare
def narrowed(x, p, watched, count, inverse_masses, apart, both, yield_force, known, contacts):
    """See `narrow`."""
    near, far, _ = stir(p, watched)
    measured = 0
    if known < 0 or near or far:
        measured = look(x, p, watched, count, apart, both, yield_force == 0.0)
        stir(p, watched)
        known = _collect(watched, count, inverse_masses, yield_force, contacts)
        if known > contacts.rest.shape[0]:
            return known, 0, measured
    return known, _start(x, p, contacts, known, watched.sizes, watched.bulk[TURN]), measured


@kernel
def narrow(x, p, watched, count, inverse_masses, apart, both, yield_force, known, contacts):
    """Contacts on the way from x to p (V, 3); `known` of them were collected at the last look, negative = none up to date.

    Pairs beside an intersection (apart (V,)) are left out if yield_force [N] is 0, and may press no harder than it otherwise;
    if it is negative, they keep the distance that they have where it is less than the thickness.
    Returns how many contacts there are, more than fit if the capacity does not suffice, how many of them are live, and how
    many pairs were measured.
    """
    return narrowed(x, p, watched, count, inverse_masses, apart, both, yield_force, known, contacts)


@bare
def project_contacts(x, p, inverse_masses, contacts, count, friction, dt):
    """One Gauss-Seidel sweep over `count` live contacts: keep the thickness along the normal, Coulomb friction across it;
    momentum is kept."""
    quads = contacts.quads
    weights = contacts.weights
    normals = contacts.normals
    ends_of = contacts.ends
    mobilities = contacts.mobility
    rests = contacts.rest
    pressed = contacts.pressed
    dragged = contacts.dragged
    limits = contacts.limit
    live = contacts.live
    for m in range(count):
        n = np.uint64(live[m])
        ends = ends_of[n]
        ux = normals[n, 0]
        uy = normals[n, 1]
        uz = normals[n, 2]
        mobility = mobilities[n]
        gap = -rests[n]
        for k in range(ends):
            v = np.uint64(quads[n, k])
            gap += weights[n, k] * (ux * p[v, 0] + uy * p[v, 1] + uz * p[v, 2])
        before = pressed[n]
        after = min(max(0.0, before - gap / mobility), limits[n] * dt * dt)
        if before == 0.0 and after == 0.0:
            continue
        pressed[n] = after
        push = after - before
        if push != 0.0:
            for k in range(ends):
                v = np.uint64(quads[n, k])
                g = push * weights[n, k] * inverse_masses[v]
                p[v, 0] += g * ux
                p[v, 1] += g * uy
                p[v, 2] += g * uz
        if friction == 0.0:
            continue
        tx = 0.0
        ty = 0.0
        tz = 0.0
        for k in range(ends):
            v = np.uint64(quads[n, k])
            w = weights[n, k]
            tx += w * (p[v, 0] - x[v, 0])
            ty += w * (p[v, 1] - x[v, 1])
            tz += w * (p[v, 2] - x[v, 2])
        along = tx * ux + ty * uy + tz * uz
        nx = dragged[n, 0] - (tx - along * ux) / mobility
        ny = dragged[n, 1] - (ty - along * uy) / mobility
        nz = dragged[n, 2] - (tz - along * uz) / mobility
        size = math.sqrt(nx * nx + ny * ny + nz * nz)
        limit = friction * after
        if size > limit:
            nx *= limit / size
            ny *= limit / size
            nz *= limit / size
        tx = nx - dragged[n, 0]
        ty = ny - dragged[n, 1]
        tz = nz - dragged[n, 2]
        dragged[n, 0] = nx
        dragged[n, 1] = ny
        dragged[n, 2] = nz
        for k in range(ends):
            v = np.uint64(quads[n, k])
            g = weights[n, k] * inverse_masses[v]
            p[v, 0] += g * tx
            p[v, 1] += g * ty
            p[v, 2] += g * tz


@device
def project_cloth(p, cloth, dt, multipliers, runs, once):
    """One sweep over the cloth's own energies; runs: its springs and the space for them, or None."""
    if runs is None:
        project_elastic(p, cloth, dt, multipliers)
    else:
        project_in_runs(p, runs[0], runs[1], once)


@bare
def forget_multipliers(multipliers, runs, once):
    """Those of a new substep are zero; a single sweep over runs has none."""
    if runs is None:
        multipliers[:] = 0.0
    elif not once:
        runs[1].multipliers[:] = 0.0


@device
def sweep_all(
    x, p, cloth, contacts, count, friction, radii, motion, ground, grips, multipliers, substep, with_springs, runs
):
    """See `solve`."""
    forget_multipliers(multipliers, runs, motion.sweeps == 1)
    grips.multipliers[:] = 0.0
    for _ in range(motion.sweeps):
        if with_springs:
            project_cloth(p, cloth, motion.dt, multipliers, runs, motion.sweeps == 1)
        hold_grips(p, cloth.inverse_masses, grips, motion.dt, (substep + 1) * motion.dt)
        project_contacts(x, p, cloth.inverse_masses, contacts, count, friction, motion.dt)
        keep_above_ground(x, p, cloth.inverse_masses, radii, ground)


@kernel
def solve(
    x, p, cloth, contacts, count, friction, radii, motion, ground, grips, multipliers, substep, with_springs, runs
):
    """Sweeps over springs, grips, contacts and ground, contact last; `with_springs` is off for explicit integration.

    runs: `spring_runs.SpringRuns` and `RunSpace`, if all energies are springs that stand in runs, or None.
    """
    sweep_all(
        x, p, cloth, contacts, count, friction, radii, motion, ground, grips, multipliers, substep, with_springs, runs
    )
    add_grip_forces(grips, motion.dt)


@bare
def take_rebound(v, inverse_masses, contacts, count, dt):
    """See `stop_rebound`."""
    quads = contacts.quads
    weights = contacts.weights
    normals = contacts.normals
    pressed = contacts.pressed
    live = contacts.live
    for m in range(count):
        n = live[m]
        if pressed[n] <= 0.0:
            continue
        ends = contacts.ends[n]
        ux = normals[n, 0]
        uy = normals[n, 1]
        uz = normals[n, 2]
        speed = 0.0
        for k in range(ends):
            i = quads[n, k]
            speed += weights[n, k] * (ux * v[i, 0] + uy * v[i, 1] + uz * v[i, 2])
        allowed = max(0.0, contacts.approach[n] / dt)
        if speed <= allowed:
            continue
        impulse = (allowed - speed) / contacts.mobility[n]
        for k in range(ends):
            i = quads[n, k]
            g = impulse * weights[n, k] * inverse_masses[i]
            v[i, 0] += g * ux
            v[i, 1] += g * uy
            v[i, 2] += g * uz


@kernel
def stop_rebound(v, inverse_masses, contacts, count, dt):
    """Takes away separating speed that the recovery of thickness gave to pressed contacts (restitution 0)."""
    take_rebound(v, inverse_masses, contacts, count, dt)
