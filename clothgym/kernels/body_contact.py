"""Contact of cloth with the body's map [Vassilev 2001, section 6]: position correction, friction, the paper's eq. 12.

The same substeps as in `integrate` and `contact`, with the body last in every sweep. What is near the body, and which plane it
has to keep to, is asked of the maps in every sweep, or was found before the sweeps by a collider in object space; the answer is
the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import bare, kernel
from clothgym.kernels.body_map import BodyMap, find_plane, sides_of, view_point
from clothgym.kernels.body_planes import BodyPlanes, distance_to
from clothgym.kernels.contact import project_contacts
from clothgym.kernels.elastic import project_elastic
from clothgym.kernels.integrate import (
    accelerate,
    add_grip_forces,
    euler_positions,
    finish_substep,
    hold_grips,
    keep_above_ground,
)

_LEEWAY = 6e-3
"""[m] points of faces that are further from the body than this are left alone until a vertex has moved half as far: less, and
one vertex that jumps to and fro makes all of them be looked at again and again."""
_CLOSE = 1e-3
"""[m] points that are further from it than this wait until a corner of their face has moved half as far as what is more."""


class BodyContact(NamedTuple):
    """The body as the sweeps see it, and what they keep about each vertex during a substep."""

    map: BodyMap | None
    found: BodyPlanes | None
    """One of the two: what is asked in every sweep, or was found before. None leaves out the other when this is compiled."""
    tolerance: float  # distance that vertices keep [m]
    face_tolerance: float  # distance that points of faces keep [m]
    face_push: float  # largest correction for a face in a sweep [m]
    friction: float  # Coulomb; 0 = slide freely
    slide: float  # C_fric of eq. 12: share of the tangential velocity that is kept a substep; 1 = leave it
    rebound: float  # C_refl of eq. 12
    faces: NDArray  # (F, 3) int32
    face_points: NDArray  # (P, 3) weights of the points of each face that are tested
    texel: float | None  # [m] faces are tested at every texel of this size that they cover; None = at these points
    near_count: NDArray  # (1,) int64: how many points of faces are near the body
    near_corners: NDArray  # (N, 3) int32 corners of the faces on which they lie
    near_weights: NDArray  # (N, 4) their weights of these; the squared way of one of these [m^2] for which they wait
    found_at: NDArray  # (V, 3) where the vertices were when these were found [m]; inf = to be found
    travel: NDArray  # (V,) how far they are from there, squared [m^2]
    clock: NDArray  # (1,) time [s] from the end of the substep to the moment that the map shows: the end of the step
    side: NDArray  # (V,) int8 sides of the body at the start of the substep, see `body_map.sides_of`
    normal: NDArray  # (V, 3) normal of the last contact
    pressed: NDArray  # (V,) sum of corrections along the normal [m], 0 = no contact
    dragged: NDArray  # (V, 3) sum of corrections by friction [m]
    moved: NDArray  # (V, 3) sum of all corrections [m]
    approach: NDArray  # (V, 3) way of the substep before contact [m]
    carried: NDArray  # (V, 3) way of the body's surface at the last contact, in this substep [m]
    pushes: (
        NDArray  # (V, 7) sums of what faces ask for, see `_push`: corrections, their weights, the surface's velocities
    )
    forces: NDArray  # (V, 3) force of the body on each vertex, summed over the substeps of a step [N]
    squeeze: NDArray  # (V, 4) corrections along normals and their lengths, summed over the substeps of a step [m]


@bare
def begin_contact(x, p, contact, dt):
    """Forgets the last substep; notes the side of the body on which each vertex is, and where it is heading."""
    before = contact.clock[0]
    contact.clock[0] = before - dt
    furthest = 0.0
    found_at = contact.found_at
    for i in range(x.shape[0]):
        contact.pressed[i] = 0.0
        for c in range(3):
            contact.dragged[i, c] = 0.0
            contact.moved[i, c] = 0.0
            contact.carried[i, c] = 0.0
            contact.approach[i, c] = p[i, c] - x[i, c]
        dx, dy, dz = p[i, 0] - found_at[i, 0], p[i, 1] - found_at[i, 1], p[i, 2] - found_at[i, 2]
        contact.travel[i] = dx * dx + dy * dy + dz * dz
        furthest = max(furthest, contact.travel[i])
    _look_around(x, p, contact, contact.map, before, furthest)


@bare
def _look_around(x, p, contact, body, before, travel):
    if body is not None:
        for i in range(x.shape[0]):
            contact.side[i] = sides_of(x[i, 0], x[i, 1], x[i, 2], body, before)
        if travel > (0.5 * _LEEWAY) ** 2 or body.flow.shape[0] > 0:
            _find_near_points(p, contact, body, contact.texel)
            for i in range(x.shape[0]):
                contact.travel[i] = 0.0
                for c in range(3):
                    contact.found_at[i, c] = p[i, c]


@bare
def _cover(p, a, b, c, size, most):
    """Texels that a face (a, b, c) may cover: how many, the axis along which they are seen, the first column and row, the
    columns, and their size [m]."""
    ux, uy, uz = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
    vx, vy, vz = p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2]
    nx, ny, nz = abs(uy * vz - uz * vy), abs(uz * vx - ux * vz), abs(ux * vy - uy * vx)
    # edge-on, a face covers few texels: it is seen along the axis that it faces most
    axis = 2 if nz >= nx and nz >= ny else (1 if ny >= nx else 0)
    ua, va, _ = view_point(p[a, 0], p[a, 1], p[a, 2], axis)
    ub, vb, _ = view_point(p[b, 0], p[b, 1], p[b, 2], axis)
    uc, vc, _ = view_point(p[c, 0], p[c, 1], p[c, 2], axis)
    wide = max(ua, ub, uc) - min(ua, ub, uc)
    high = max(va, vb, vc) - min(va, vb, vc)
    if not wide * high <= most * size * size:
        size = math.sqrt(wide * high / most)
    column = math.ceil(min(ua, ub, uc) / size - 0.5)
    row = math.ceil(min(va, vb, vc) / size - 0.5)
    columns = math.floor(max(ua, ub, uc) / size - 0.5) - column + 1.0
    rows = math.floor(max(va, vb, vc) / size - 0.5) - row + 1.0
    if not (columns > 0.0 and rows > 0.0):
        return 0, axis, 0, 0, 0, size
    return np.int64(columns * rows), axis, np.int64(column), np.int64(row), np.int64(columns), size


@bare
def _weights_at(n, p, a, b, c, axis, column, row, columns, size):
    """Barycentric weights of the middle of the n-th of these texels; the first is negative if it lies beside the face."""
    u = (column + n % columns + 0.5) * size
    v = (row + n // columns + 0.5) * size
    ua, va, _ = view_point(p[a, 0], p[a, 1], p[a, 2], axis)
    ub, vb, _ = view_point(p[b, 0], p[b, 1], p[b, 2], axis)
    uc, vc, _ = view_point(p[c, 0], p[c, 1], p[c, 2], axis)
    area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
    if area == 0.0:
        return -1.0, 0.0, 0.0
    wb = ((u - ua) * (vc - va) - (uc - ua) * (v - va)) / area
    wc = ((ub - ua) * (v - va) - (u - ua) * (vb - va)) / area
    wa = 1.0 - wb - wc
    return (-1.0 if wb < 0.0 or wc < 0.0 else wa), wb, wc


@bare
def _find_near_points(p, contact, body, texel_size):
    """Points of faces near the body at p: most of a garment hangs free, and its sweeps need not look."""
    if texel_size is None:
        _choose_near_points(p, contact, body, None)
        return
    size = texel_size
    # only torn cloth covers more texels than there is room for
    while not _choose_near_points(p, contact, body, size):
        size *= 2.0


@bare
def _choose_near_points(p, contact, body, texel_size):
    """Whether there was room for all of them."""
    points = contact.face_points
    age = contact.clock[0]
    close = contact.face_tolerance + _CLOSE
    count = 0
    most = contact.near_weights.shape[0]
    places = points.shape[0]
    for f in range(contact.faces.shape[0] if places > 0 else 0):
        a = np.uint64(contact.faces[f, 0])
        b = np.uint64(contact.faces[f, 1])
        c = np.uint64(contact.faces[f, 2])
        if texel_size is not None:
            places, axis, column, row, columns, size = _cover(p, a, b, c, texel_size, most)
        for n in range(places):
            if texel_size is not None:
                wa, wb, wc = _weights_at(n, p, a, b, c, axis, column, row, columns, size)
                if wa < 0.0:
                    continue
            else:
                wa, wb, wc = points[n, 0], points[n, 1], points[n, 2]
            x = wa * p[a, 0] + wb * p[b, 0] + wc * p[c, 0]
            y = wa * p[a, 1] + wb * p[b, 1] + wc * p[c, 1]
            z = wa * p[a, 2] + wb * p[b, 2] + wc * p[c, 2]
            texel, _, distance = find_plane(x, y, z, x, y, z, 0, body, contact.face_tolerance + _LEEWAY, age)
            if texel < 0:
                continue
            if count == most:
                return False
            for k in range(3):
                contact.near_corners[count, k] = contact.faces[f, k]
            contact.near_weights[count, 0] = wa
            contact.near_weights[count, 1] = wb
            contact.near_weights[count, 2] = wc
            contact.near_weights[count, 3] = 0.25 * max(distance - close, 0.0) ** 2
            count += 1
    contact.near_count[0] = count
    return True


@bare
def _shift(p, contact, i, nx, ny, nz, amount):
    p[i, 0] += amount * nx
    p[i, 1] += amount * ny
    p[i, 2] += amount * nz
    contact.moved[i, 0] += amount * nx
    contact.moved[i, 1] += amount * ny
    contact.moved[i, 2] += amount * nz
    contact.normal[i, 0] = nx
    contact.normal[i, 1] = ny
    contact.normal[i, 2] = nz
    contact.pressed[i] += amount


@bare
def _hold_back(x, p, contact, i):
    """Coulomb friction at position level: undoes the way along the surface since the start of the substep, as far as
    the surface has not come along, up to friction times what the body pressed."""
    nx = contact.normal[i, 0]
    ny = contact.normal[i, 1]
    nz = contact.normal[i, 2]
    tx = p[i, 0] - x[i, 0] - contact.carried[i, 0]
    ty = p[i, 1] - x[i, 1] - contact.carried[i, 1]
    tz = p[i, 2] - x[i, 2] - contact.carried[i, 2]
    along = tx * nx + ty * ny + tz * nz
    gx = contact.dragged[i, 0] - (tx - along * nx)
    gy = contact.dragged[i, 1] - (ty - along * ny)
    gz = contact.dragged[i, 2] - (tz - along * nz)
    size = math.sqrt(gx * gx + gy * gy + gz * gz)
    limit = contact.friction * contact.pressed[i]
    scale = limit / size if size > limit else 1.0
    gx = scale * gx - contact.dragged[i, 0]
    gy = scale * gy - contact.dragged[i, 1]
    gz = scale * gz - contact.dragged[i, 2]
    p[i, 0] += gx
    p[i, 1] += gy
    p[i, 2] += gz
    contact.dragged[i, 0] += gx
    contact.dragged[i, 1] += gy
    contact.dragged[i, 2] += gz
    contact.moved[i, 0] += gx
    contact.moved[i, 1] += gy
    contact.moved[i, 2] += gz


@bare
def _push(pushes, v, weight, amount, nx, ny, nz, ux, uy, uz):
    """What a point of the cloth asks of one of its vertices; the surface there moves with u.

    Several answers are averaged, each with its own size for its weight: among many points that only just touch, the one that
    a tip of the body has pierced would else ask in vain.
    """
    share = weight * amount
    pushes[v, 0] += share * share * nx
    pushes[v, 1] += share * share * ny
    pushes[v, 2] += share * share * nz
    pushes[v, 3] += share
    pushes[v, 4] += share * ux
    pushes[v, 5] += share * uy
    pushes[v, 6] += share * uz


@bare
def _give_pushes(p, inverse_masses, contact, dt):
    """Moves each vertex by the mean of what is asked of it."""
    pushes = contact.pushes
    for i in range(p.shape[0]):
        if pushes[i, 3] == 0.0 or inverse_masses[i] == 0.0:
            continue
        x = pushes[i, 0] / pushes[i, 3]
        y = pushes[i, 1] / pushes[i, 3]
        z = pushes[i, 2] / pushes[i, 3]
        size = math.sqrt(x * x + y * y + z * z)
        if size > 0.0:
            _shift(p, contact, i, x / size, y / size, z / size, size)
            for axis in range(3):
                contact.carried[i, axis] = dt * pushes[i, 4 + axis] / pushes[i, 3]


@bare
def _test_faces(starts, p, inverse_masses, contact, body, dt):
    """Points of faces inside the body push the corners by their weights."""
    pushes = contact.pushes
    pushes[:] = 0.0
    found = False
    age = contact.clock[0]
    planes = body.planes
    flow = body.flow
    corners = contact.near_corners
    weights = contact.near_weights
    for n in range(contact.near_count[0]):
        # signed ones are asked at each access whether they count from the end
        a = np.uint64(corners[n, 0])
        b = np.uint64(corners[n, 1])
        c = np.uint64(corners[n, 2])
        if max(contact.travel[a], contact.travel[b], contact.travel[c]) < weights[n, 3]:
            continue
        wa, wb, wc = weights[n, 0], weights[n, 1], weights[n, 2]
        # of each view, what all corners have in common: bits of front and back cancel
        from_side = contact.side[a]
        from_side &= contact.side[b] & contact.side[c]
        x = wa * p[a, 0] + wb * p[b, 0] + wc * p[c, 0]
        y = wa * p[a, 1] + wb * p[b, 1] + wc * p[c, 1]
        z = wa * p[a, 2] + wb * p[b, 2] + wc * p[c, 2]
        sx = wa * starts[a, 0] + wb * starts[b, 0] + wc * starts[c, 0]
        sy = wa * starts[a, 1] + wb * starts[b, 1] + wc * starts[c, 1]
        sz = wa * starts[a, 2] + wb * starts[b, 2] + wc * starts[c, 2]
        texel, side, distance = find_plane(x, y, z, sx, sy, sz, from_side, body, contact.face_tolerance, age)
        if texel < 0:
            continue
        found = True
        # the point itself moves by this much
        amount = min(contact.face_tolerance - distance, contact.face_push) / (wa * wa + wb * wb + wc * wc)
        at = 4 * side
        nx, ny, nz = planes[texel, at], planes[texel, at + 1], planes[texel, at + 2]
        ux, uy, uz = 0.0, 0.0, 0.0
        if flow.shape[0] > 0:
            at = 3 * side
            ux, uy, uz = (
                np.float64(flow[texel, at]),
                np.float64(flow[texel, at + 1]),
                np.float64(flow[texel, at + 2]),
            )
        _push(pushes, a, wa, amount, nx, ny, nz, ux, uy, uz)
        _push(pushes, b, wb, amount, nx, ny, nz, ux, uy, uz)
        _push(pushes, c, wc, amount, nx, ny, nz, ux, uy, uz)
    if found:
        _give_pushes(p, inverse_masses, contact, dt)


@bare
def keep_off_body(x, p, inverse_masses, contact, dt):
    """One sweep: points of faces, then vertices (which have the last word), then friction."""
    _keep_off(x, p, inverse_masses, contact, contact.map, contact.found, dt)


@bare
def _keep_off(x, p, inverse_masses, contact, body, found, dt):
    if body is not None:
        _keep_off_maps(x, p, inverse_masses, contact, body, dt)
    if found is not None:
        _keep_off_planes(x, p, inverse_masses, contact, found, dt)


@bare
def _keep_off_maps(x, p, inverse_masses, contact, body, dt):
    if contact.near_count[0] > 0:
        _test_faces(x, p, inverse_masses, contact, body, dt)
    age = contact.clock[0]
    planes = body.planes
    flow = body.flow
    for i in range(p.shape[0]):
        if inverse_masses[i] == 0.0:
            continue
        texel, side, distance = find_plane(
            p[i, 0], p[i, 1], p[i, 2], x[i, 0], x[i, 1], x[i, 2], contact.side[i], body, contact.tolerance, age
        )
        if texel >= 0:
            at = 4 * side
            _shift(p, contact, i, planes[texel, at], planes[texel, at + 1], planes[texel, at + 2],
                   contact.tolerance - distance)  # fmt: skip
            if flow.shape[0] > 0:
                for c in range(3):
                    contact.carried[i, c] = dt * flow[texel, 3 * side + c]
        if contact.pressed[i] > 0.0 and contact.friction > 0.0:
            _hold_back(x, p, contact, i)


@bare
def _keep_off_planes(x, p, inverse_masses, contact, found, dt):
    """The same against what a collider in object space has found."""
    pushes = contact.pushes
    pushes[:] = 0.0
    corners = found.corners
    weights = found.weights
    planes = found.point_planes
    flow = found.point_flow
    for n in range(found.number[0]):
        a, b, c = corners[n, 0], corners[n, 1], corners[n, 2]
        wa, wb, wc = weights[n, 0], weights[n, 1], weights[n, 2]
        distance = distance_to(
            wa * p[a, 0] + wb * p[b, 0] + wc * p[c, 0],
            wa * p[a, 1] + wb * p[b, 1] + wc * p[c, 1],
            wa * p[a, 2] + wb * p[b, 2] + wc * p[c, 2],
            planes,
            n,
        )
        if distance >= contact.face_tolerance:
            continue
        amount = min(contact.face_tolerance - distance, contact.face_push) / (wa * wa + wb * wb + wc * wc)
        nx, ny, nz = planes[n, 0], planes[n, 1], planes[n, 2]
        _push(pushes, a, wa, amount, nx, ny, nz, flow[n, 0], flow[n, 1], flow[n, 2])
        _push(pushes, b, wb, amount, nx, ny, nz, flow[n, 0], flow[n, 1], flow[n, 2])
        _push(pushes, c, wc, amount, nx, ny, nz, flow[n, 0], flow[n, 1], flow[n, 2])
    if found.number[0] > 0:
        _give_pushes(p, inverse_masses, contact, dt)
    for i in range(p.shape[0]):
        if inverse_masses[i] == 0.0:
            continue
        if found.near[i]:
            distance = distance_to(p[i, 0], p[i, 1], p[i, 2], found.planes, i)
            if distance < contact.tolerance:
                _shift(p, contact, i, found.planes[i, 0], found.planes[i, 1], found.planes[i, 2],
                       contact.tolerance - distance)  # fmt: skip
                for k in range(3):
                    contact.carried[i, k] = dt * found.flow[i, k]
        if contact.pressed[i] > 0.0 and contact.friction > 0.0:
            _hold_back(x, p, contact, i)


@bare
def answer_velocities(v, inverse_masses, contact, dt):
    """Velocities of touching vertices: v_res = C_fric v_t - C_refl v_n [Vassilev 2001, eq. 12], for approaching ones.

    Velocities are those past the body's surface. v_n is the speed before the contact; speed that only the position
    correction gave is taken away. Books the forces: all the momentum that the body gives, by corrections and here.
    """
    for i in range(v.shape[0]):
        if contact.pressed[i] == 0.0:
            continue
        nx = contact.normal[i, 0]
        ny = contact.normal[i, 1]
        nz = contact.normal[i, 2]
        # of the body's surface along the normal
        rising = (contact.carried[i, 0] * nx + contact.carried[i, 1] * ny + contact.carried[i, 2] * nz) / dt
        speed = v[i, 0] * nx + v[i, 1] * ny + v[i, 2] * nz - rising
        came = (contact.approach[i, 0] * nx + contact.approach[i, 1] * ny + contact.approach[i, 2] * nz) / dt - rising
        # came < 0: approached, and leaves with C_refl of it; otherwise it was leaving by itself, and keeps that
        leaving = -contact.rebound * came if came < 0.0 else min(max(speed, 0.0), came)
        slide = contact.slide if came < 0.0 else 1.0
        mass = 1.0 / inverse_masses[i]
        for c in range(3):
            before = v[i, c]
            surface = contact.carried[i, c] / dt
            normal = contact.normal[i, c]
            v[i, c] = surface + slide * (before - surface - speed * normal) + leaving * normal
            contact.forces[i, c] += mass * (contact.moved[i, c] / dt + v[i, c] - before) / dt
            contact.squeeze[i, c] += contact.moved[i, c] - contact.dragged[i, c]
        contact.squeeze[i, 3] += contact.pressed[i]


@kernel
def xpbd_substeps_on_body(x, v, p, cloth, radii, motion, ground, grips, multipliers, contact, count):
    """`integrate.xpbd_substeps` with a body."""
    w = cloth.inverse_masses
    for n in range(count):
        accelerate(x, v, p, cloth, motion)
        begin_contact(x, p, contact, motion.dt)
        multipliers[:] = 0.0
        grips.multipliers[:] = 0.0
        for _ in range(motion.sweeps):
            project_elastic(p, cloth, motion.dt, multipliers)
            hold_grips(p, w, grips, motion.dt, (n + 1) * motion.dt)
            keep_above_ground(x, p, w, radii, ground)
            keep_off_body(x, p, w, contact, motion.dt)
        add_grip_forces(grips, motion.dt)
        finish_substep(x, v, p, motion.dt)
        answer_velocities(v, w, contact, motion.dt)


@kernel
def euler_substeps_on_body(x, v, p, f, cloth, radii, motion, ground, grips, contact, count):
    """`integrate.euler_substeps` with a body."""
    w = cloth.inverse_masses
    for n in range(count):
        euler_positions(x, v, p, f, cloth, motion)
        begin_contact(x, p, contact, motion.dt)
        grips.multipliers[:] = 0.0
        hold_grips(p, w, grips, motion.dt, (n + 1) * motion.dt)
        keep_above_ground(x, p, w, radii, ground)
        keep_off_body(x, p, w, contact, motion.dt)
        add_grip_forces(grips, motion.dt)
        finish_substep(x, v, p, motion.dt)
        answer_velocities(v, w, contact, motion.dt)


@kernel
def solve_on_body(
    x, p, cloth, contacts, count, friction, radii, motion, ground, grips, multipliers, substep, with_springs, contact
):
    """`contact.solve` with a body, which has the last word in every sweep."""
    w = cloth.inverse_masses
    begin_contact(x, p, contact, motion.dt)
    multipliers[:] = 0.0
    grips.multipliers[:] = 0.0
    for _ in range(motion.sweeps):
        if with_springs:
            project_elastic(p, cloth, motion.dt, multipliers)
        hold_grips(p, w, grips, motion.dt, (substep + 1) * motion.dt)
        project_contacts(x, p, w, contacts, count, friction, motion.dt)
        keep_above_ground(x, p, w, radii, ground)
        keep_off_body(x, p, w, contact, motion.dt)
    add_grip_forces(grips, motion.dt)


@kernel
def answer_body(v, inverse_masses, contact, dt):
    """Velocities after a substep, see `answer_velocities`."""
    answer_velocities(v, inverse_masses, contact, dt)
