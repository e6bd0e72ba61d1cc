"""Normal cones and velocity cones of a hierarchy, and the tests of self-collision that they allow [Mezger 2003, 5].

A cone is an axis and a half-angle, at most pi. The paper's curvature criterion is half < closeAngle / 2 [Provot 1997]. It
says nothing about the outline: a surface whose outline crosses itself when seen along the axis may pass through itself
(Fig. 5). `region_is_clear` is exact, for proximities too. Seen along an axis with which all normals make less than a right
angle, every triangle keeps its orientation. Then the triangles over a point are as many as the outline winds around it:
one at most, if the outline is a single loop that does not cross itself. So nothing in the region is nearer to a vertex than the
far side of its own star, which is a projected altitude away, or what lies beyond the outline, which the outline itself
shows. If neither is within reach, the region holds no pair within reach.
"""

from __future__ import annotations

import math

from clothgym._jit import device, kernel
from clothgym.kernels.vec3 import dot, triangle_normal, unit


@device
def merged_cone(ax, ay, az, ha, bx, by, bz, hb, tight):
    """Axis and half-angle of a cone around two.

    tight = 0: axis along the sum, half = beta / 2 + max(ha, hb) [Provot 1997]. 1: the smallest cone around both.
    """
    if ha >= math.pi or hb >= math.pi:
        return ax, ay, az, math.pi
    beta = math.acos(min(max(dot(ax, ay, az, bx, by, bz), -1.0), 1.0))
    if tight == 0:
        sx, sy, sz, n = unit(ax + bx, ay + by, az + bz)
        half = 0.5 * beta + max(ha, hb)
        if n < 1e-9 or half >= math.pi:
            return ax, ay, az, math.pi
        return sx, sy, sz, half
    if beta + hb <= ha:
        return ax, ay, az, ha
    if beta + ha <= hb:
        return bx, by, bz, hb
    half = 0.5 * (ha + hb + beta)
    across = math.sin(beta)
    if half >= math.pi or across < 1e-9:  # nearly the same or opposite axes: no plane to turn in
        if beta < 1e-6:
            return ax, ay, az, max(ha, hb) + beta
        return ax, ay, az, math.pi
    turn = half - ha
    wa = math.sin(beta - turn) / across
    wb = math.sin(turn) / across
    sx, sy, sz, _ = unit(wa * ax + wb * bx, wa * ay + wb * by, wa * az + wb * bz)
    return sx, sy, sz, half


@kernel
def normal_cones(tree, x, triangles, triangle_start, tight, stale):
    """Cones of the normals and least altitudes [m] of all nodes, children before parents.

    x (V, 3); triangles (T, 3) and triangle_start (P + 1,): those of each polygon; stale (N,) uint8: nodes to compute. Writes
    normal_axis (N, 3), normal_half (N,), altitude (N,) of `tree`. A triangle without area makes the half-angle pi.
    """
    for node in range(len(tree.child_count) - 1, -1, -1):
        if stale[node] == 0:
            continue
        low = math.inf
        if tree.child_count[node] == 0:
            polygon = tree.node_face[node]
            first = triangle_start[polygon]
            last = triangle_start[polygon + 1]
        else:
            first = tree.child_start[node]
            last = first + tree.child_count[node]
        cx = cy = cz = 0.0
        half = math.pi
        for n in range(first, last):
            if tree.child_count[node] == 0:
                a, b, c = triangles[n, 0], triangles[n, 1], triangles[n, 2]
                nx, ny, nz, area = triangle_normal(x, a, b, c)
                longest = 0.0
                for axis in range(3):
                    side = triangles[n, axis]
                    other = triangles[n, (axis + 1) % 3]
                    dx = x[other, 0] - x[side, 0]
                    dy = x[other, 1] - x[side, 1]
                    dz = x[other, 2] - x[side, 2]
                    longest = max(longest, dx * dx + dy * dy + dz * dz)
                own = math.pi if area <= 1e-12 * longest else 0.0
                low = min(low, area / math.sqrt(longest) if longest > 0.0 else 0.0)
            else:
                nx = tree.normal_axis[n, 0]
                ny = tree.normal_axis[n, 1]
                nz = tree.normal_axis[n, 2]
                own = tree.normal_half[n]
                low = min(low, tree.altitude[n])
            if n == first:
                cx, cy, cz, half = nx, ny, nz, own
            else:
                cx, cy, cz, half = merged_cone(cx, cy, cz, half, nx, ny, nz, own, tight)
        tree.normal_axis[node, 0] = cx
        tree.normal_axis[node, 1] = cy
        tree.normal_axis[node, 2] = cz
        tree.normal_half[node] = half
        tree.altitude[node] = low


@kernel
def velocity_cones(tree, v, leaves_only, stale):
    """Cones of the velocities v (V, 3) of all nodes: axis, half-angle, least and largest speed [m/s] [Mezger 2003, 5.2].

    A leaf's axis is the mean of its corners' velocities. Corners at rest do not widen a cone. Parents are left alone where
    `leaves_only` is set. Writes speed_axis (N, 3), speed_half, speed_low, speed_high (N,) of `tree`.
    """
    for node in range(len(tree.child_count) - 1, -1, -1):
        if stale[node] == 0:
            continue
        if tree.child_count[node] > 0:
            if leaves_only == 0:
                _merge_speeds(tree, node)
            continue
        polygon = tree.node_face[node]
        sx = sy = sz = 0.0
        low = math.inf
        high = 0.0
        count = 3 if tree.corners[polygon, 2] == tree.corners[polygon, 3] else 4
        for k in range(count):
            i = tree.corners[polygon, k]
            sx += v[i, 0]
            sy += v[i, 1]
            sz += v[i, 2]
            speed = dot(v[i, 0], v[i, 1], v[i, 2], v[i, 0], v[i, 1], v[i, 2])
            low = min(low, speed)
            high = max(high, speed)
        high = math.sqrt(high)
        ax, ay, az, n = unit(sx, sy, sz)
        half = 0.0
        if high > 0.0 and n <= 1e-9 * high:
            half = math.pi
        else:
            least = 1.0
            for k in range(count):
                i = tree.corners[polygon, k]
                ux, uy, uz, speed = unit(v[i, 0], v[i, 1], v[i, 2])
                if speed > 0.0:
                    least = min(least, dot(ax, ay, az, ux, uy, uz))
            half = min(math.acos(max(least, -1.0)) + 1e-9, math.pi) if least < 1.0 - 1e-14 else 2e-7
        tree.speed_axis[node, 0] = ax
        tree.speed_axis[node, 1] = ay
        tree.speed_axis[node, 2] = az
        tree.speed_half[node] = half
        tree.speed_low[node] = math.sqrt(low)
        tree.speed_high[node] = high


@device
def _merge_speeds(tree, node):
    first = tree.child_start[node]
    cx = cy = cz = 0.0
    half = 0.0
    low = math.inf
    high = 0.0
    for n in range(first, first + tree.child_count[node]):
        low = min(low, tree.speed_low[n])
        if tree.speed_high[n] > 0.0:
            nx, ny, nz = tree.speed_axis[n, 0], tree.speed_axis[n, 1], tree.speed_axis[n, 2]
            if high == 0.0:
                cx, cy, cz, half = nx, ny, nz, tree.speed_half[n]
            else:
                cx, cy, cz, half = merged_cone(cx, cy, cz, half, nx, ny, nz, tree.speed_half[n], 1)
            high = max(high, tree.speed_high[n])
    tree.speed_axis[node, 0] = cx
    tree.speed_axis[node, 1] = cy
    tree.speed_axis[node, 2] = cz
    tree.speed_half[node] = half
    tree.speed_low[node] = low
    tree.speed_high[node] = high


@device
def speed_ball(tree, node):
    """Centre (3 numbers) and radius [m/s] of a ball around all velocities of a node, from its cone."""
    half = tree.speed_half[node]
    high = tree.speed_high[node]
    low = tree.speed_low[node]
    if half >= 0.5 * math.pi:
        return 0.0, 0.0, 0.0, high
    c = math.cos(half)
    s = math.sin(half)
    middle = 0.5 * (low * c + high)
    far = math.sqrt(high * high * s * s + (high * c - middle) ** 2)
    near = math.sqrt(low * low * s * s + (low * c - middle) ** 2)
    radius = max(far, near, high - middle)
    axis = tree.speed_axis
    return middle * axis[node, 0], middle * axis[node, 1], middle * axis[node, 2], radius * (1.0 + 1e-9)


@device
def relative_speed(a, i, b, j):
    """Upper bound [m/s] of the relative speed of any two points of node i of tree a and node j of tree b."""
    ax, ay, az, ra = speed_ball(a, i)
    bx, by, bz, rb = speed_ball(b, j)
    gap = math.sqrt((ax - bx) ** 2 + (ay - by) ** 2 + (az - bz) ** 2)
    return gap + ra + rb


@device
def _near_segment(plane, v, e, f, reach2):
    """Whether point v of the plane is nearer than the reach to the segment (e, f)."""
    ex = plane[f, 0] - plane[e, 0]
    ey = plane[f, 1] - plane[e, 1]
    px = plane[v, 0] - plane[e, 0]
    py = plane[v, 1] - plane[e, 1]
    ee = ex * ex + ey * ey
    t = min(max((ex * px + ey * py) / ee, 0.0), 1.0) if ee > 0.0 else 0.0
    gx = px - t * ex
    gy = py - t * ey
    return gx * gx + gy * gy <= reach2


@device
def _turn(plane, a, b, c):
    return (plane[b, 0] - plane[a, 0]) * (plane[c, 1] - plane[a, 1]) - (plane[b, 1] - plane[a, 1]) * (
        plane[c, 0] - plane[a, 0]
    )


@device
def outline_is_clear(loop, axis, node, x, reach, plane):
    """Whether the outline of a region, seen along the axis of its cone, keeps more than `reach` from itself.

    loop: vertices around the region; axis (N, 3): normal axes; x (V, 3) positions; plane (B, 2) scratch.
    Compared is every outline vertex with every outline edge that it is no end
    of, and every two edges for a crossing.
    """
    count = len(loop)
    if count < 3:
        return False
    nx, ny, nz = axis[node, 0], axis[node, 1], axis[node, 2]
    # a plane's axes: what is least along the normal, made perpendicular to it
    if abs(nx) <= abs(ny) and abs(nx) <= abs(nz):
        ux, uy, uz, _ = unit(0.0, nz, -ny)
    elif abs(ny) <= abs(nz):
        ux, uy, uz, _ = unit(-nz, 0.0, nx)
    else:
        ux, uy, uz, _ = unit(ny, -nx, 0.0)
    wx, wy, wz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
    for n in range(count):
        i = loop[n]
        plane[n, 0] = dot(ux, uy, uz, x[i, 0], x[i, 1], x[i, 2])
        plane[n, 1] = dot(wx, wy, wz, x[i, 0], x[i, 1], x[i, 2])
    reach2 = reach * reach
    for i in range(count):
        i1 = i + 1 if i + 1 < count else 0
        left = min(plane[i, 0], plane[i1, 0]) - reach
        right = max(plane[i, 0], plane[i1, 0]) + reach
        for j in range(i + 1, count):
            j1 = j + 1 if j + 1 < count else 0
            if min(plane[j, 0], plane[j1, 0]) > right or max(plane[j, 0], plane[j1, 0]) < left:
                continue
            for n in range(4):  # the ends of each side against the other side
                v = i if n == 0 else (i1 if n == 1 else (j if n == 2 else j1))
                e = j if n < 2 else i
                f = j1 if n < 2 else i1
                if v != e and v != f and _near_segment(plane, v, e, f, reach2):
                    return False
            turned = 0
            for n in range(4):  # two sides cross if each has an end of the other on either hand
                e = i if n < 2 else j
                f = i1 if n < 2 else j1
                v = j if n == 0 else (j1 if n == 1 else (i if n == 2 else i1))
                if v != e and v != f and _turn(plane, e, f, v) > 0.0:
                    turned += 1 << n
            if j != i1 and j1 != i and turned in (5, 6, 9, 10):
                return False
    return True


@device
def region_is_clear(tree, node, x, reach, plane):
    """Whether no vertex and triangle, and no two edges, of a node's region come as near as `reach` [m]; never wrongly yes."""
    half = tree.normal_half[node] + 1e-6
    if half >= 0.5 * math.pi or tree.altitude[node] * math.cos(half) * (1.0 - 1e-9) <= reach:
        return False
    loop = tree.border[tree.border_start[node] : tree.border_start[node + 1]]
    return outline_is_clear(loop, tree.normal_axis, node, x, reach * (1.0 + 1e-9), plane)


@kernel
def group_travel(a, nodes_a, b, nodes_b, travel):
    """Bound of the relative speed (or way) of every two groups, from the cones of their nodes: travel (G_a, G_b)."""
    for i in range(len(nodes_a)):
        for j in range(len(nodes_b)):
            travel[i, j] = relative_speed(a, nodes_a[i], b, nodes_b[j])
