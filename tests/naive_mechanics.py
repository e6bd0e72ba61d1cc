"""Slow, obvious references for mechanics and contact: springs, strain limiting, distances, collisions on a path."""

from __future__ import annotations

import itertools

import numpy as np

# ---------------------------------------------------------------------------------------------------------------
# springs and time integration


def spring_forces(x, ends, rests, stiffness):
    """(V, 3) forces f = -k (d - l0 d / |d|) on both ends of every spring [Vassilev 2001, eq. 2]."""
    forces = np.zeros_like(x)
    for (i, j), rest, k in zip(ends, rests, stiffness, strict=True):
        d = x[j] - x[i]
        pull = k * (d - rest * d / np.linalg.norm(d))
        forces[i] += pull
        forces[j] -= pull
    return forces


def modify_velocities(x, v, ends, rests, inverse_masses, threshold, relative):
    """Velocities after velocity modification, spring by spring; pinned vertices stand still."""
    v = v.copy()
    for (i, j), rest in zip(ends, rests, strict=True):
        d = x[j] - x[i]
        if np.linalg.norm(d) <= (1.0 + threshold) * rest:
            continue
        n = d / np.linalg.norm(d)
        if not relative:
            v[i] -= (v[i] @ n) * n
            v[j] -= (v[j] @ n) * n
            continue
        rate = (v[j] - v[i]) @ n
        if rate > 0.0 and inverse_masses[i] + inverse_masses[j] > 0.0:
            impulse = rate / (inverse_masses[i] + inverse_masses[j])
            v[i] += inverse_masses[i] * impulse * n
            v[j] -= inverse_masses[j] * impulse * n
    v[inverse_masses == 0.0] = 0.0
    return v


def modify_positions(p, ends, rests, inverse_masses, threshold, sweeps):
    """Positions after position modification, spring by spring: what is too long gets its greatest length."""
    p = p.copy()
    for _ in range(sweeps):
        for (i, j), rest in zip(ends, rests, strict=True):
            d = p[j] - p[i]
            length, longest = np.linalg.norm(d), (1.0 + threshold) * rest
            weight = inverse_masses[i] + inverse_masses[j]
            if length > longest and weight > 0.0:
                p[i] += inverse_masses[i] / weight * (length - longest) * d / length
                p[j] -= inverse_masses[j] / weight * (length - longest) * d / length
    return p


def symplectic_euler(x, v, ends, rests, stiffness, inverse_masses, gravity, damping, dt):
    """One step: acceleration (eq. 1), new velocity, then position with the new velocity (eq. 3)."""
    acceleration = inverse_masses[:, None] * spring_forces(x, ends, rests, stiffness) + gravity - damping * v
    acceleration[inverse_masses == 0.0] = 0.0
    v = v + dt * acceleration
    return x + dt * v, v


# ---------------------------------------------------------------------------------------------------------------
# distances of many pairs at once


def _rows(a, b):
    return np.einsum("...i,...i->...", a, b)


def point_segment(p, a, b):
    """Distances of points (N, 3) and segments."""
    d = b - a
    t = np.clip(_rows(p - a, d) / np.maximum(_rows(d, d), 1e-300), 0.0, 1.0)
    return np.linalg.norm(p - a - t[..., None] * d, axis=-1)


def point_triangle(p, a, b, c):
    """Distances of points (N, 3) and triangles: the three sides, and the plane where the foot lies inside."""
    best = np.minimum(np.minimum(point_segment(p, a, b), point_segment(p, b, c)), point_segment(p, c, a))
    n = np.cross(b - a, c - a)
    size = np.linalg.norm(n, axis=-1)
    inside = size > 0.0
    for u, w in ((a, b), (b, c), (c, a)):
        inside &= _rows(np.cross(w - u, p - u), n) >= 0.0
    height = np.abs(_rows(p - a, n)) / np.where(size > 0.0, size, 1.0)
    return np.where(inside, np.minimum(best, height), best)


def segment_segment(p0, p1, q0, q1):
    """Distances of segments: the four ends, and the common perpendicular where it meets both insides."""
    best = np.minimum(point_segment(p0, q0, q1), point_segment(p1, q0, q1))
    best = np.minimum(best, np.minimum(point_segment(q0, p0, p1), point_segment(q1, p0, p1)))
    u, v, r = p1 - p0, q1 - q0, q0 - p0
    n = np.cross(u, v)
    square = _rows(n, n)
    safe = np.where(square > 0.0, square, 1.0)
    s = _rows(np.cross(r, v), n) / safe
    t = _rows(np.cross(r, u), n) / safe
    inside = (square > 0.0) & (s >= 0.0) & (s <= 1.0) & (t >= 0.0) & (t <= 1.0)
    return np.where(inside, np.minimum(best, np.abs(_rows(r, n)) / np.sqrt(safe)), best)


def all_quads(faces):
    """Every vertex-triangle (v, a, b, c) and edge-edge (a0, a1, b0, b1) pair without a common vertex: (N, 4), (M, 4)."""
    vertices = sorted({int(v) for face in faces for v in face})
    edges = sorted({tuple(sorted((int(f[i]), int(f[i - 1])))) for f in faces for i in range(3)})
    points = [(v, *(int(i) for i in face)) for v in vertices for face in faces if v not in face]
    lines = [(*a, *b) for a, b in itertools.combinations(edges, 2) if not set(a) & set(b)]
    return np.array(points, np.int32).reshape(-1, 4), np.array(lines, np.int32).reshape(-1, 4)


def quad_distances(x, points, lines):
    """Distances [m] of both kinds of pairs at positions x."""
    return (
        point_triangle(*(x[points[:, k]] for k in range(4))),
        segment_segment(*(x[lines[:, k]] for k in range(4))),
    )


# ---------------------------------------------------------------------------------------------------------------
# collisions while all vertices move on straight lines


def _cubic(x, d, quads):
    """(N, 4) coefficients, highest first, of the volume of four points that move from x along d."""
    base = [x[quads[:, k]] - x[quads[:, 0]] for k in (1, 2, 3)]
    rate = [d[quads[:, k]] - d[quads[:, 0]] for k in (1, 2, 3)]
    coefficients = np.zeros((len(quads), 4))
    for choice in itertools.product((0, 1), repeat=3):
        a, b, c = (rate[k] if choice[k] else base[k] for k in range(3))
        coefficients[:, 3 - sum(choice)] += _rows(a, np.cross(b, c))
    return coefficients


def collisions(x, p, faces, touching=1e-10, quads=None):
    """Pairs that meet while every vertex moves straight from x to p: (kind, four ids, time), found at the times when four
    points lie in one plane."""
    points, lines = all_quads(faces) if quads is None else quads
    d = p - x
    low, high = np.minimum(x, p), np.maximum(x, p)
    found = []
    for kind, candidates, split in (("vertex-triangle", points, 1), ("edge-edge", lines, 2)):
        if len(candidates) == 0:
            continue
        one, two = candidates[:, :split], candidates[:, split:]
        apart = (low[one].min(axis=1) > high[two].max(axis=1)) | (low[two].min(axis=1) > high[one].max(axis=1))
        near = candidates[~apart.any(axis=1)]
        if len(near) == 0:
            continue
        for quad, coefficients in zip(near, _cubic(x, d, near), strict=True):
            size = np.abs(coefficients).max()
            if size == 0.0:
                continue
            roots = np.roots(np.trim_zeros(coefficients / size, "f"))
            times = roots.real[(np.abs(roots.imag) < 1e-7) & (roots.real >= -1e-9) & (roots.real <= 1.0 + 1e-9)]
            for time in np.clip(times, 0.0, 1.0):
                corners = [(x[v] + time * d[v])[None] for v in quad]
                distance = (point_triangle if split == 1 else segment_segment)(*corners)[0]
                if distance <= touching:
                    found.append((kind, tuple(int(v) for v in quad), float(time)))
    return found


# ---------------------------------------------------------------------------------------------------------------
# XPBD, one spring after the other


def xpbd(x, v, ends, rests, stiffness, w, motion, substeps, grips, radii, ground, friction):
    """x, v after substeps of XPBD [Macklin 2016, eq. 18]: springs in the order given, then grips, then the ground."""
    dt = motion.dt
    kept = 1.0 / (1.0 + motion.damping * dt)
    fall = np.array([motion.gravity + (motion.external[i] if len(motion.external) else 0.0) for i in range(len(x))])
    fall = dt * fall * (w > 0)[:, None]
    p = x + np.where((w > 0)[:, None], dt * (kept * v + fall), 0.0)
    begin = x.copy()
    for n in range(substeps):
        if n > 0:
            way = dt * (kept * ((p - begin) * (1.0 / dt)) + fall)
            begin = p.copy()
            p = p + way
        multipliers = np.zeros(len(ends))
        grips.multipliers[:] = 0.0
        for _ in range(motion.sweeps):
            for s, (i, j) in enumerate(ends):
                if w[i] + w[j] == 0.0:
                    continue
                alpha = 1.0 / (stiffness[s] * dt * dt)
                d = p[j] - p[i]
                size = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
                change = (size - rests[s] - alpha * multipliers[s]) * (1.0 / (w[i] + w[j] + alpha))
                multipliers[s] += change
                pull = (change / size) * d
                p[i] += w[i] * pull
                p[j] -= w[j] * pull
            for a, i in enumerate(grips.vertices):
                if w[i] > 0.0:
                    alpha = 1.0 / (grips.stiffness[a] * dt * dt)
                    target = grips.targets[a] + ((n + 1) * dt) * grips.velocities[a]
                    change = (target - p[i] - alpha * grips.multipliers[a]) / (w[i] + alpha)
                    p[i] -= w[i] * grips.multipliers[a]
                    total = grips.multipliers[a] + change
                    size = np.sqrt(total[0] ** 2 + total[1] ** 2 + total[2] ** 2)
                    limit = grips.force_limit[a] * dt * dt
                    grips.multipliers[a] = total * (limit / size if size > limit else 1.0)
                    p[i] += w[i] * grips.multipliers[a]
            for i in range(len(p)):
                depth = ground + radii[i] - p[i, 1]
                if depth > 0.0 and w[i] > 0.0:
                    p[i, 1] += depth
                    slide = p[i] - begin[i]
                    far = np.sqrt(slide[0] * slide[0] + slide[2] * slide[2])
                    if far > 0.0:
                        keep = max(0.0, 1.0 - friction * depth / far)
                        p[i, 0] = begin[i, 0] + keep * slide[0]
                        p[i, 2] = begin[i, 2] + keep * slide[2]
        grips.forces[:] += grips.multipliers / (dt * dt)
    return p, (p - begin) * (1.0 / dt)


def runge_kutta(x, v, acceleration, dt):
    """One step of the classical method of order 4 for x' = v, v' = acceleration(x, v), from its table."""
    table = [[], [0.5], [0.0, 0.5], [0.0, 0.0, 1.0]]
    rates: list[tuple[np.ndarray, np.ndarray]] = []
    for row in table:
        xs = x + dt * sum((a * r[0] for a, r in zip(row, rates)), np.zeros_like(x))
        vs = v + dt * sum((a * r[1] for a, r in zip(row, rates)), np.zeros_like(x))
        rates.append((vs, acceleration(xs, vs)))
    weights = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
    return (
        x + dt * sum(w * r[0] for w, r in zip(weights, rates, strict=True)),
        v + dt * sum(w * r[1] for w, r in zip(weights, rates, strict=True)),
    )
