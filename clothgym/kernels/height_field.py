"""Whether sheets are height fields over a plane and stay so: then no sheet can touch itself, and pairs need no search.

Along an axis n a component is projected to the plane across it. Let every vertex be anywhere within a radius r of where it is
expected. The projection is one to one for all of these positions if, where the vertices are expected,

1. every triangle has positive area and is wider than 2 r: the width of a triangle is its least altitude, and three points
   that become collinear lie within r of one line, so no triangle can turn over;
2. no two edges of the outline cross, and every vertex of the outline is further than 2 r from every edge of it that does
   not end there: on the way to other positions, a vertex would have to touch an edge before two edges cross, or two at a
   corner fold onto each other; so all loops of the outline stay simple and apart;
3. exactly one of the loops runs counter-clockwise.

Proof: the number of points of the sheet above a point of the plane is the sum of the winding numbers of the outline around
it, since all triangles count +1. One simple loop adds at most 1, the clockwise ones nothing. So no two triangles overlap in
the plane, and no other points coincide: near two of them there would be overlapping triangles. This holds for a disc and
for a sheet with holes.

Distance: let r = slack + reach / 2. Two primitives without a common vertex are at least `reach` apart as long as no vertex is
further than `slack` from where it is expected: if they were closer, in the plane or in space, moving the vertices of one by
less than reach / 2 towards the other, and those of the other as much, would make them meet in the plane, within r of where
all are expected. Only deviations in the plane count, and what all vertices have in common does not.

The criterion of normals and outline is that of [Volino and Magnenat-Thalmann 1994]; what is new is the tube around a motion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import bare, kernel
from clothgym.kernels.contact import NO_CONTACTS, sweep_all
from clothgym.kernels.integrate import accelerate, add_grip_forces, finish_substep
from clothgym.kernels.outline import clearance

_LEAST = 0.1
"""Slack that is worth a decision, in reaches: less would be used up at once."""


class Sheets(NamedTuple):
    """C components, all oriented manifolds with a border; rows of a component follow each other."""

    members: NDArray  # (M,) int32 vertices
    member_start: NDArray  # (C + 1,) int64
    reach: NDArray  # (C,) [m] primitives nearer than this would be in contact


class Shapes(NamedTuple):
    """Faces and outlines of the components, which a decision looks at, and its scratch."""

    faces: NDArray  # (F, 3) int32 vertices
    face_start: NDArray  # (C + 1,) int64
    border: NDArray  # (B, 2) int32 edges of the outlines, along their face
    border_start: NDArray  # (C + 1,) int64
    loop: NDArray  # (B,) int32 loop of each of them, counted from 0 in its component
    lows: NDArray  # (B,) [m] scratch: lower end of an edge of an outline along the first axis
    order: NDArray  # (B,) int64 scratch: edges of an outline by their lower end
    spare: NDArray  # (B,) int64 scratch
    turns: NDArray  # (B,) scratch: area within each loop of an outline [m^2]


class Tube(NamedTuple):
    """What was decided: where vertices are expected in the plane, and how far they may be from there."""

    ways: NDArray  # (V, 4) [m] both coordinates in the plane at the start, and how far each goes against the mean
    axes: NDArray  # (C, 3, 3) origin, and both unit axes of the plane
    slack: NDArray  # (C,) [m]
    boxes: NDArray  # (C, 6) [m] everywhere each component was since, against the drift: lows, then highs
    drift: NDArray  # (3,) [m] how far all go on average


@bare
def _plane(x, u, sheets, shapes, c, axes):
    """Origin and axes of the plane across the mean normal halfway; whether there is one.

    The area vector of a sheet follows from its outline alone: half the sum of p x q over its edges (Stokes).
    """
    first = sheets.members[sheets.member_start[c]]
    ox = x[first, 0]
    oy = x[first, 1]
    oz = x[first, 2]
    nx = 0.0
    ny = 0.0
    nz = 0.0
    for n in range(shapes.border_start[c], shapes.border_start[c + 1]):
        i = shapes.border[n, 0]
        j = shapes.border[n, 1]
        px = x[i, 0] + 0.5 * u[i, 0] - ox
        py = x[i, 1] + 0.5 * u[i, 1] - oy
        pz = x[i, 2] + 0.5 * u[i, 2] - oz
        qx = x[j, 0] + 0.5 * u[j, 0] - ox
        qy = x[j, 1] + 0.5 * u[j, 1] - oy
        qz = x[j, 2] + 0.5 * u[j, 2] - oz
        nx += py * qz - pz * qy
        ny += pz * qx - px * qz
        nz += px * qy - py * qx
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    if not size > 0.0:
        return False
    nx /= size
    ny /= size
    nz /= size
    # the first axis leans against the lines of a mesh along the main axes, so that few edges of an outline share an interval
    hx = 0.36
    hy = 0.48
    hz = 0.8
    along = hx * nx + hy * ny + hz * nz
    if abs(along) > 0.95:
        hy = -hy
        along = hx * nx + hy * ny + hz * nz
    hx -= along * nx
    hy -= along * ny
    hz -= along * nz
    size = math.sqrt(hx * hx + hy * hy + hz * hz)
    hx /= size
    hy /= size
    hz /= size
    axes[c, 0, 0] = ox
    axes[c, 0, 1] = oy
    axes[c, 0, 2] = oz
    axes[c, 1, 0] = hx
    axes[c, 1, 1] = hy
    axes[c, 1, 2] = hz
    axes[c, 2, 0] = ny * hz - nz * hy
    axes[c, 2, 1] = nz * hx - nx * hz
    axes[c, 2, 2] = nx * hy - ny * hx
    return True


@bare
def _project(x, u, sheets, c, axes, ways):
    """Fills the ways of a component, less what all go on average; returns a size [m] that no coordinate or way exceeds.

    NaN if a coordinate is not finite.
    """
    ox = axes[c, 0, 0]
    oy = axes[c, 0, 1]
    oz = axes[c, 0, 2]
    ax = axes[c, 1, 0]
    ay = axes[c, 1, 1]
    az = axes[c, 1, 2]
    bx = axes[c, 2, 0]
    by = axes[c, 2, 1]
    bz = axes[c, 2, 2]
    size = 0.0
    total = 0.0
    mean_a = 0.0
    mean_b = 0.0
    for m in range(sheets.member_start[c], sheets.member_start[c + 1]):
        i = sheets.members[m]
        px = x[i, 0] - ox
        py = x[i, 1] - oy
        pz = x[i, 2] - oz
        ways[i, 0] = ax * px + ay * py + az * pz
        ways[i, 1] = bx * px + by * py + bz * pz
        ways[i, 2] = ax * u[i, 0] + ay * u[i, 1] + az * u[i, 2]
        ways[i, 3] = bx * u[i, 0] + by * u[i, 1] + bz * u[i, 2]
        here = abs(px) + abs(py) + abs(pz) + abs(u[i, 0]) + abs(u[i, 1]) + abs(u[i, 2])
        size = max(size, here)
        total += here
        mean_a += ways[i, 2]
        mean_b += ways[i, 3]
    mean_a /= sheets.member_start[c + 1] - sheets.member_start[c]
    mean_b /= sheets.member_start[c + 1] - sheets.member_start[c]
    for m in range(sheets.member_start[c], sheets.member_start[c + 1]):
        ways[sheets.members[m], 2] -= mean_a
        ways[sheets.members[m], 3] -= mean_b
    return size + abs(ox) + abs(oy) + abs(oz) + (total - total)


@bare
def _least_width(shapes, c, ways):
    """Least altitude [m] of the projected triangles at any time of the motion; 0 if one does not have positive area.

    Twice the area is a polynomial of degree 2 in time, at least the least of its three Bernstein coefficients; a side is
    never longer than at its start or its end.
    """
    area = math.inf
    side = 1.0
    for f in range(shapes.face_start[c], shapes.face_start[c + 1]):
        i = shapes.faces[f, 0]
        j = shapes.faces[f, 1]
        k = shapes.faces[f, 2]
        ax = ways[j, 0] - ways[i, 0]
        ay = ways[j, 1] - ways[i, 1]
        bx = ways[k, 0] - ways[i, 0]
        by = ways[k, 1] - ways[i, 1]
        au = ax + (ways[j, 2] - ways[i, 2])
        av = ay + (ways[j, 3] - ways[i, 3])
        bu = bx + (ways[k, 2] - ways[i, 2])
        bv = by + (ways[k, 3] - ways[i, 3])
        least = min(ax * by - ay * bx, au * bv - av * bu, 0.5 * (ax * bv - ay * bu + au * by - av * bx))
        if not least > 0.0:
            return 0.0
        longest = max(ax * ax + ay * ay, au * au + av * av, bx * bx + by * by)
        longest = max(longest, bu * bu + bv * bv)
        longest = max(longest, (bx - ax) * (bx - ax) + (by - ay) * (by - ay))
        longest = max(longest, (bu - au) * (bu - au) + (bv - av) * (bv - av))
        if least * least * side < area * longest:
            area = least * least
            side = longest
    return math.sqrt(area / side)


@bare
def _apart(boxes, reach):
    """Whether all boxes are further apart than the larger reach of both."""
    for c in range(boxes.shape[0]):
        for d in range(c):
            far = max(reach[c], reach[d])
            apart = boxes[c, 0] > boxes[d, 3] + far or boxes[d, 0] > boxes[c, 3] + far
            apart = apart or boxes[c, 1] > boxes[d, 4] + far or boxes[d, 1] > boxes[c, 4] + far
            apart = apart or boxes[c, 2] > boxes[d, 5] + far or boxes[d, 2] > boxes[c, 5] + far
            if not apart:
                return False
    return True


@bare
def _open(boxes):
    """Boxes of nothing."""
    for c in range(boxes.shape[0]):
        for k in range(3):
            boxes[c, k] = math.inf
            boxes[c, 3 + k] = -math.inf


@bare
def _widen(x, u, share, drifted, sheets, tube):
    """Widens the box of every component by x + share u - drifted * drift."""
    boxes = tube.boxes
    for c in range(boxes.shape[0]):
        for m in range(sheets.member_start[c], sheets.member_start[c + 1]):
            i = sheets.members[m]
            for k in range(3):
                here = x[i, k] + share * u[i, k] - drifted * tube.drift[k]
                boxes[c, k] = min(boxes[c, k], here)
                boxes[c, 3 + k] = max(boxes[c, 3 + k], here)


@kernel
def chart(tube, slot, members, course):
    """What was decided for the only component into slots: fills a `spring_runs.Course`."""
    course.limits[0] = tube.slack[0]
    for k in range(2):
        for c in range(3):
            course.plane[k, c] = tube.axes[0, 1 + k, c]
    for k in range(4):
        low = math.inf
        high = -math.inf
        for m in range(members.shape[0]):
            i = np.uint64(members[m])
            way = tube.ways[i, k]
            course.ways[k, np.uint64(slot[i])] = way
            low = min(low, way)
            high = max(high, way)
        if k > 1:
            course.limits[k - 1] = high - low


@kernel
def decide(x, u, sheets, shapes, tube):
    """Whether no primitives without a common vertex can come within reach while vertices go from x by u (V, 3) [m].

    Fills the tube: how far vertices may stray from there (`stays`). No is no proof of anything. Time is linear in the
    number of faces, near to linear in the length of the outlines, and quadratic in the number of components.
    """
    count = sheets.reach.shape[0]
    for c in range(count):
        if not _plane(x, u, sheets, shapes, c, tube.axes):
            return False
        size = _project(x, u, sheets, c, tube.axes, tube.ways)
        # what rounding can do to a coordinate counts as if the vertex were elsewhere
        lost = 1e-12 * size
        least = 0.5 * sheets.reach[c] + _LEAST * sheets.reach[c] + lost
        radius = 0.5 * (1.0 - 1e-9) * _least_width(shapes, c, tube.ways)
        if not radius > least:
            return False
        radius = 0.5 * (1.0 - 1e-9) * clearance(shapes, c, tube.ways, radius)
        if not radius > least:
            return False
        tube.slack[c] = radius - 0.5 * sheets.reach[c] - lost
    if count > 1:
        for k in range(3):
            tube.drift[k] = 0.0
            for m in range(sheets.members.shape[0]):
                tube.drift[k] += u[sheets.members[m], k] / sheets.members.shape[0]
        _open(tube.boxes)
        _widen(x, u, 1.0, 1.0, sheets, tube)
        _widen(x, u, 0.0, 0.0, sheets, tube)
        if not _apart(tube.boxes, sheets.reach):
            return False
        # from here on they hold what really happens
        _open(tube.boxes)
        _widen(x, u, 0.0, 0.0, sheets, tube)
    return True


@bare
def _stays(x, share, sheets, tube):
    ways = tube.ways
    for c in range(sheets.reach.shape[0]):
        ax = tube.axes[c, 1, 0]
        ay = tube.axes[c, 1, 1]
        az = tube.axes[c, 1, 2]
        bx = tube.axes[c, 2, 0]
        by = tube.axes[c, 2, 1]
        bz = tube.axes[c, 2, 2]
        low_a = math.inf
        low_b = math.inf
        high_a = -math.inf
        high_b = -math.inf
        total = 0.0
        for m in range(sheets.member_start[c], sheets.member_start[c + 1]):
            i = np.uint64(sheets.members[m])
            # the origin is left out: all deviations have it in common
            a = ax * x[i, 0] + ay * x[i, 1] + az * x[i, 2] - (ways[i, 0] + share * ways[i, 2])
            b = bx * x[i, 0] + by * x[i, 1] + bz * x[i, 2] - (ways[i, 1] + share * ways[i, 3])
            low_a = a if a < low_a else low_a
            low_b = b if b < low_b else low_b
            high_a = a if a > high_a else high_a
            high_b = b if b > high_b else high_b
            total += a + b
        # relative to the middle of all deviations: what they have in common moves no primitive against another
        wide = high_a - low_a
        deep = high_b - low_b
        if not 0.5 * math.sqrt(wide * wide + deep * deep) + (total - total) <= tube.slack[c]:
            return False
    if sheets.reach.shape[0] > 1:
        _widen(x, x, 0.0, share, sheets, tube)
        return _apart(tube.boxes, sheets.reach)
    return True


@kernel
def stays(x, share, sheets, tube):
    """Whether x (V, 3) [m], `share` of the way, keeps to what was decided; so does the straight way from the last such x."""
    return _stays(x, share, sheets, tube)


@kernel
def xpbd_substeps(
    x, v, p, kept, cloth, radii, motion, ground, grips, multipliers, first, last, base, horizon, sheets, tube, runs
):
    """`integrate.xpbd_substeps` from substep `first` up to `last`, as long as the sheets stay height fields.

    The motion decided upon began at substep `base` and takes `horizon` of them; kept (V, 3) is scratch. Returns the substep
    that was not made: its state is as if it had not been tried.
    """
    for n in range(first, last):
        for i in range(x.shape[0]):
            for c in range(3):
                kept[i, c] = v[i, c]
        accelerate(x, v, p, cloth, motion)
        sweep_all(x, p, cloth, NO_CONTACTS, 0, 0.0, radii, motion, ground, grips, multipliers, n, True, runs)
        if not _stays(p, (n + 1 - base) / horizon, sheets, tube):
            for i in range(x.shape[0]):
                for c in range(3):
                    v[i, c] = kept[i, c]
            return n
        add_grip_forces(grips, motion.dt)
        finish_substep(x, v, p, motion.dt)
    return last
