"""Exact orientation of four vertices: static filter, expansion arithmetic, and ties broken by vertex index.

[Shewchuk 1997] for the filter and the expansions; simulation of simplicity [Edelsbrunner and Muecke 1990] for zeros:
coordinate c of vertex i is thought of as x[i, c] + eps**(2**(3 i + c)) with eps -> 0+. So no orientation is ever zero,
neighbouring tests agree, and contours have no gaps on any input, lattice-aligned and duplicated meshes included.
"""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np

from clothgym._jit import device

_UNIT_ROUNDOFF = 2.0**-53
_FILTER = (7.0 + 56.0 * _UNIT_ROUNDOFF) * _UNIT_ROUNDOFF
_SPLITTER = 134217729.0  # 2**27 + 1


def _perturbation_terms():
    """Terms of the perturbed 4x4 determinant det[x y z 1], largest first, up to the first that is never zero.

    A term is (minor size, sign, rows of the minor, its coordinate columns), rows by rank of the vertex id.
    """
    terms = []
    for size in (1, 2, 3):
        for rows in combinations(range(4), size):
            for columns in permutations(range(3), size):
                order = sum(2 ** (3 * r + c) for r, c in zip(rows, columns))
                inversions = sum(columns[i] > columns[j] for i in range(size) for j in range(i + 1, size))
                sign = (-1) ** (inversions + sum(rows) + sum(columns))
                kept_rows = [r for r in range(4) if r not in rows]
                kept_columns = [c for c in range(3) if c not in columns]
                terms.append((order, 4 - size, sign, kept_rows, kept_columns))
    terms.sort()
    last = next(i for i, term in enumerate(terms) if term[1] == 1)
    table = np.zeros((last + 1, 7), np.int64)
    for i, (_, size, sign, rows, columns) in enumerate(terms[: last + 1]):
        table[i, :2] = size, sign
        table[i, 2 : 2 + len(rows)] = rows
        table[i, 5 : 5 + len(columns)] = columns
    return table


_TERMS = _perturbation_terms()


@device
def _two_sum(a, b):
    s = a + b
    bb = s - a
    return s, (a - (s - bb)) + (b - bb)


@device
def _two_product(a, b):
    p = a * b
    c = _SPLITTER * a
    ah = c - (c - a)
    al = a - ah
    c = _SPLITTER * b
    bh = c - (c - b)
    bl = b - bh
    return p, al * bl - (((p - ah * bh) - al * bh) - ah * bl)


@device
def _grow(expansion, count, value):
    """Adds a number to a non-overlapping expansion in place, dropping zeros; returns the new count."""
    q = value
    kept = 0
    for i in range(count):
        q, error = _two_sum(q, expansion[i])
        if error != 0.0:
            expansion[kept] = error
            kept += 1
    if q != 0.0:
        expansion[kept] = q
        kept += 1
    return kept


@device
def _grow_product3(expansion, count, a, b, c):
    p, pe = _two_product(a, b)
    q, qe = _two_product(p, c)
    r, re = _two_product(pe, c)
    count = _grow(expansion, count, re)
    count = _grow(expansion, count, r)
    count = _grow(expansion, count, qe)
    return _grow(expansion, count, q)


@device
def _grow_determinant3(expansion, count, m, r0, r1, r2, sign):
    """Adds sign times the 3x3 determinant of rows r0, r1, r2 of m."""
    for step in range(3):
        c0 = step
        c1 = (step + 1) % 3
        c2 = (step + 2) % 3
        count = _grow_product3(expansion, count, sign * m[r0, c0], m[r1, c1], m[r2, c2])
        count = _grow_product3(expansion, count, -sign * m[r0, c0], m[r1, c2], m[r2, c1])
    return count


@device
def _exact_orient3d(x, i, j, k, l):  # noqa: E741
    """The determinant, correctly rounded up to one unit in the last place, with the right sign and the right zero."""
    expansion = np.empty(128, np.float64)
    m = np.empty((4, 3), np.float64)
    exact_differences = True
    for c in range(3):
        d = x[l, c]
        for r in range(3):
            v = x[i if r == 0 else (j if r == 1 else k), c]
            s, error = _two_sum(v, -d)
            m[r, c] = s
            if error != 0.0:
                exact_differences = False
    count = 0
    if exact_differences:
        count = _grow_determinant3(expansion, count, m, 0, 1, 2, 1.0)
    else:
        for c in range(3):
            m[0, c] = x[i, c]
            m[1, c] = x[j, c]
            m[2, c] = x[k, c]
            m[3, c] = x[l, c]
        count = _grow_determinant3(expansion, count, m, 1, 2, 3, -1.0)
        count = _grow_determinant3(expansion, count, m, 0, 2, 3, 1.0)
        count = _grow_determinant3(expansion, count, m, 0, 1, 3, -1.0)
        count = _grow_determinant3(expansion, count, m, 0, 1, 2, 1.0)
    total = 0.0
    for n in range(count):
        total += expansion[n]
    return total


@device
def _exact_orient2d_sign(x, i, j, k, u, v):
    """Sign of det[[p_u, p_v, 1]] over the rows i, j, k."""
    expansion = np.empty(16, np.float64)
    count = 0
    for step in range(3):
        a = i if step == 0 else (j if step == 1 else k)
        b = j if step == 0 else (k if step == 1 else i)
        p, pe = _two_product(x[a, u], x[b, v])
        q, qe = _two_product(-x[a, v], x[b, u])
        count = _grow(expansion, count, pe)
        count = _grow(expansion, count, p)
        count = _grow(expansion, count, qe)
        count = _grow(expansion, count, q)
    if count == 0:
        return 0
    return 1 if expansion[count - 1] > 0.0 else -1


@device
def orient3d(x, i, j, k, l):  # noqa: E741
    """det[x_i - x_l; x_j - x_l; x_k - x_l] in m^3: a value whose sign and zero are exact."""
    ax = x[i, 0] - x[l, 0]
    ay = x[i, 1] - x[l, 1]
    az = x[i, 2] - x[l, 2]
    bx = x[j, 0] - x[l, 0]
    by = x[j, 1] - x[l, 1]
    bz = x[j, 2] - x[l, 2]
    cx = x[k, 0] - x[l, 0]
    cy = x[k, 1] - x[l, 1]
    cz = x[k, 2] - x[l, 2]
    p = bx * cy
    q = cx * by
    r = cx * ay
    s = ax * cy
    t = ax * by
    u = bx * ay
    value = az * (p - q) + bz * (r - s) + cz * (t - u)
    permanent = (abs(p) + abs(q)) * abs(az) + (abs(r) + abs(s)) * abs(bz) + (abs(t) + abs(u)) * abs(cz)
    if abs(value) > _FILTER * permanent:
        return value
    return _exact_orient3d(x, i, j, k, l)


@device
def _tie_sign(x, i, j, k, l):  # noqa: E741
    """Sign of an exactly zero orientation by simulation of simplicity."""
    a, b, c, d = i, j, k, l
    parity = 1
    if a > b:
        a, b = b, a
        parity = -parity
    if c > d:
        c, d = d, c
        parity = -parity
    if a > c:
        a, c = c, a
        parity = -parity
    if b > d:
        b, d = d, b
        parity = -parity
    if b > c:
        b, c = c, b
        parity = -parity
    ids = (a, b, c, d)
    for n in range(_TERMS.shape[0]):
        size = _TERMS[n, 0]
        sign = 0
        if size == 3:
            sign = _exact_orient2d_sign(
                x, ids[_TERMS[n, 2]], ids[_TERMS[n, 3]], ids[_TERMS[n, 4]], _TERMS[n, 5], _TERMS[n, 6]
            )
        elif size == 2:
            first = x[ids[_TERMS[n, 2]], _TERMS[n, 5]]
            second = x[ids[_TERMS[n, 3]], _TERMS[n, 5]]
            sign = 1 if first > second else (-1 if first < second else 0)
        else:
            sign = 1
        if sign != 0:
            return parity * sign * _TERMS[n, 1]
    return parity


@device
def orient3d_sign(x, i, j, k, l):  # noqa: E741
    """Sign (+1 or -1, never 0) of the orientation of four distinct vertices, and the value itself."""
    value = orient3d(x, i, j, k, l)
    if value > 0.0:
        return 1, value
    if value < 0.0:
        return -1, value
    return _tie_sign(x, i, j, k, l), 0.0
