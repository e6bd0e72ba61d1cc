"""The outline of a body in a view, the planes of it that texels hold, and what texels beside the body copy from it.

The plane of the outline is the tangent of the projected mesh at its point nearest to the texel, not that of a drawn image:
it is exact to less than a texel.
"""

from __future__ import annotations

import math

import numpy as np

from clothgym._jit import bare, kernel
from clothgym.kernels.body_map import DRIFT

NOTHING = -1
_SEED_PIXELS = 1.5
"""Texels of the body this near to a piece of its outline are told about it directly, those further in by their neighbours."""
_COPY_PIXELS = 2
"""The texel of the body that one beside it copies lies this near to the foot on the outline."""


@kernel
def outline_edges(vertices, faces, face_edges, edge_face_count, view, seen, chosen):
    """Edges where the body turns from front to back in a view, and borders of holes; returns how many.

    Args:
        vertices: (V, 3) [m].
        faces, face_edges: (F, 3).
        edge_face_count: (E,).
        view: (3,) world axes of a, b, c.
        seen: (E,) int32 scratch.
        chosen: (E,) int32, written.
    """
    a, b = view[0], view[1]
    seen[:] = 0
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ua = vertices[j, a] - vertices[i, a]
        ub = vertices[j, b] - vertices[i, b]
        va = vertices[k, a] - vertices[i, a]
        vb = vertices[k, b] - vertices[i, b]
        if ua * vb - ub * va > 0.0:
            for n in range(3):
                seen[face_edges[f, n]] += 1
    count = 0
    for e in range(seen.shape[0]):
        if (seen[e] > 0 and seen[e] < edge_face_count[e]) or edge_face_count[e] == 1:
            chosen[count] = e
            count += 1
    return count


@bare
def _foot(a, b, lines, segment):
    """Nearest point of a piece of the outline, its share along it, and the squared distance [texels]."""
    a0, b0 = lines[segment, 0], lines[segment, 1]
    da, db = lines[segment, 2], lines[segment, 3]
    share = min(1.0, max(0.0, ((a - a0) * da + (b - b0) * db) * lines[segment, 4]))
    fa = a0 + share * da
    fb = b0 + share * db
    return fa, fb, share, (a - fa) * (a - fa) + (b - fb) * (b - fb)


@bare
def _splat(lines, segment, filled, on_body, reach, nearest, owner):
    """Tells the texels on the body, or beside it, within `reach` texels of a piece about it."""
    rows, columns = filled.shape
    a0, b0 = lines[segment, 0], lines[segment, 1]
    a1, b1 = a0 + lines[segment, 2], b0 + lines[segment, 3]
    first_row = max(0, math.ceil(min(b0, b1) - reach - 0.5))
    last_row = min(rows - 1, math.floor(max(b0, b1) + reach - 0.5))
    first_column = max(0, math.ceil(min(a0, a1) - reach - 0.5))
    last_column = min(columns - 1, math.floor(max(a0, a1) + reach - 0.5))
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            if filled[row, column] != on_body:
                continue
            _, _, _, square = _foot(column + 0.5, row + 0.5, lines, segment)
            if square <= reach * reach and square < nearest[row, column]:
                nearest[row, column] = square
                owner[row, column] = segment


@bare
def _hear(row, column, segment, lines, nearest, owner):
    """A texel of the body hears of a piece of the outline that a neighbour knows."""
    if segment == NOTHING or segment == owner[row, column]:
        return
    _, _, _, square = _foot(column + 0.5, row + 0.5, lines, segment)
    if square < nearest[row, column]:
        nearest[row, column] = square
        owner[row, column] = segment


@kernel
def nearest_outline(vertices, edges, chosen, count, place, view, filled, reach, lines, shown, nearest, owner):
    """The piece of the outline nearest to each texel beside the body, within reach, and to each on it.

    What is nearest to a point beside the body is always a piece of its outline; edges that the body hides are told from it
    by that. On the body the nearest piece is passed on from texel to texel, which is off by less than a texel.

    Args:
        vertices: (V, 3) [m].
        edges: (E, 2); chosen: the first `count` ids of those that may be outline.
        place: (3,) left, lower border [m], size of a texel [m].
        view: (3,) world axes of a, b, c.
        filled: (rows, columns) whether a texel lies on the body.
        reach: texels.
        lines: (S, 5) float64, written: one end of each piece, the way to the other [texels], 1 / its squared length.
        shown: (S,) bool, written: pieces that something beside the body is nearest to.
        nearest, owner: (rows, columns) squared distance [texels^2] and number of the piece, -1 = none.
    """
    rows, columns = filled.shape
    nearest[:] = np.inf
    owner[:] = NOTHING
    for s in range(count):
        shown[s] = False
        i, j = edges[chosen[s], 0], edges[chosen[s], 1]
        lines[s, 0] = (vertices[i, view[0]] - place[0]) / place[2]
        lines[s, 1] = (vertices[i, view[1]] - place[1]) / place[2]
        lines[s, 2] = (vertices[j, view[0]] - vertices[i, view[0]]) / place[2]
        lines[s, 3] = (vertices[j, view[1]] - vertices[i, view[1]]) / place[2]
        length = lines[s, 2] * lines[s, 2] + lines[s, 3] * lines[s, 3]
        lines[s, 4] = 1.0 / length if length > 0.0 else 0.0
        _splat(lines, s, filled, False, reach, nearest, owner)
    for row in range(rows):
        for column in range(columns):
            if owner[row, column] != NOTHING:
                shown[owner[row, column]] = True
    for s in range(count):
        if shown[s]:
            _splat(lines, s, filled, True, _SEED_PIXELS, nearest, owner)
    # the body never touches the border of the map; texels beside it are heard too, they know of the nearest pieces
    for row in range(1, rows - 1):
        for column in range(1, columns - 1):
            if filled[row, column]:
                _hear(row, column, owner[row - 1, column - 1], lines, nearest, owner)
                _hear(row, column, owner[row - 1, column], lines, nearest, owner)
                _hear(row, column, owner[row - 1, column + 1], lines, nearest, owner)
                _hear(row, column, owner[row, column - 1], lines, nearest, owner)
        for column in range(columns - 2, 0, -1):
            if filled[row, column]:
                _hear(row, column, owner[row, column + 1], lines, nearest, owner)
    for row in range(rows - 2, 0, -1):
        for column in range(columns - 2, 0, -1):
            if filled[row, column]:
                _hear(row, column, owner[row + 1, column - 1], lines, nearest, owner)
                _hear(row, column, owner[row + 1, column], lines, nearest, owner)
                _hear(row, column, owner[row + 1, column + 1], lines, nearest, owner)
                _hear(row, column, owner[row, column + 1], lines, nearest, owner)
        for column in range(1, columns - 1):
            if filled[row, column]:
                _hear(row, column, owner[row, column - 1], lines, nearest, owner)


@bare
def _texel_to_copy(row, column, fa, fb, filled):
    """The texel of the body nearest to one beside it, of those around the foot on its outline; -1: none."""
    rows, columns = filled.shape
    middle_row, middle_column = np.int64(math.floor(fb)), np.int64(math.floor(fa))
    best, chosen = np.inf, -1
    for r in range(max(0, middle_row - _COPY_PIXELS), min(rows, middle_row + _COPY_PIXELS + 1)):
        for c in range(max(0, middle_column - _COPY_PIXELS), min(columns, middle_column + _COPY_PIXELS + 1)):
            if filled[r, c]:
                square = (r - row) * (r - row) + (c - column) * (c - column)
                if square < best:
                    best = square
                    chosen = r * columns + c
    return chosen


@kernel
def write_outline(vertices, velocities, edges, chosen, place, view, filled, lines, owner, frame, planes, bounds, flow):
    """Writes the outline's planes, and front, back and bounds of the texels beside the body.

    Args:
        velocities: (V, 3) [m/s], or (0, 3).
        frame: (3,) origin of the offsets [m].
        planes, bounds, flow: rows of this view, see `body_map.BodyMap`; bounds hold inf, -inf where no body is around.
        The others as in `nearest_outline`.
    """
    rows, columns = filled.shape
    a, b = view[0], view[1]
    pixel = place[2]
    for row in range(rows):
        for column in range(columns):
            texel = row * columns + column
            for c in range(3):
                planes[texel, 8 + c] = 0.0
            planes[texel, 11] = -np.inf
            planes[texel, DRIFT + 2] = 0.0
            if flow.shape[0] > 0:
                for c in range(6, 9):
                    flow[texel, c] = 0.0
            segment = owner[row, column]
            if segment == NOTHING:
                continue
            fa, fb, share, square = _foot(column + 0.5, row + 0.5, lines, segment)
            if not filled[row, column]:
                source = _texel_to_copy(row, column, fa, fb, filled)
                if source < 0:
                    continue
                for c in range(8):
                    planes[texel, c] = planes[source, c]
                for c in range(DRIFT, DRIFT + 2):
                    planes[texel, c] = planes[source, c]
                if flow.shape[0] > 0:
                    for c in range(6):
                        flow[texel, c] = flow[source, c]
                if bounds[texel, 0] > bounds[texel, 1]:
                    bounds[texel, 0] = bounds[source, 0]
                    bounds[texel, 1] = bounds[source, 1]
            size = math.sqrt(square)
            if size < 1e-6:  # on the outline itself front and back must do
                continue
            sign = -1.0 if filled[row, column] else 1.0
            na = sign * (column + 0.5 - fa) / size
            nb = sign * (row + 0.5 - fb) / size
            planes[texel, 8 + a] = np.float32(na)
            planes[texel, 8 + b] = np.float32(nb)
            wa = place[0] + pixel * fa - frame[a]
            wb = place[1] + pixel * fb - frame[b]
            planes[texel, 11] = np.float32(-(na * wa + nb * wb))
            if flow.shape[0] > 0:
                i, j = edges[chosen[segment], 0], edges[chosen[segment], 1]
                for c in range(3):
                    flow[texel, 6 + c] = np.float32((1.0 - share) * velocities[i, c] + share * velocities[j, c])
                planes[texel, DRIFT + 2] = np.float32(na * flow[texel, 6 + a] + nb * flow[texel, 6 + b])


@bare
def _look_at(best, nearer, there, share):
    """Raises best (N,) to what texels show that are some way off, or as far towards them from the ones before as `share` says.

    Between two texels the depth is between theirs, unless one of them shows nothing.
    """
    for n in range(best.shape[0]):
        before, here = nearer[n], there[n]
        if before > -np.inf:
            here = before + share * (here - before)
        if here > best[n]:
            best[n] = here


@kernel
def depth_bounds(depths, flow, along, dt, reach, rowwise, bounds):
    """Least and greatest depth of the body in the square of `reach` texels around the middle of each texel.

    Args:
        depths: (2, rows, columns) float32 of front and back, used up; -inf, inf = nothing.
        flow: (rows * columns, 9) or (0, 9): bounds then hold for all of a step of dt [s] before.
        along: world axis of the view.
        reach: texels, not negative; need not be whole.
        rowwise: (2, rows, columns) float32 scratch.
        bounds: (rows * columns, 2) float32, written; inf, -inf = nothing around.
    """
    _, rows, columns = depths.shape
    if flow.shape[0] > 0:
        for row in range(rows):
            for column in range(columns):
                texel = row * columns + column
                if depths[0, row, column] > -np.inf:
                    depths[0, row, column] += max(np.float32(0.0), np.float32(-dt) * flow[texel, along])
                    depths[1, row, column] += min(np.float32(0.0), np.float32(-dt) * flow[texel, 3 + along])
    last = np.int64(math.ceil(reach))
    one = np.float32(1.0)
    best = np.empty(columns, np.float32)
    for side in range(2):
        outwards = np.float32(1.0 - 2.0 * side)
        if side == 1:
            for row in range(rows):
                for column in range(columns):
                    depths[1, row, column] = -depths[1, row, column]
        for row in range(rows):
            seen, found = depths[side, row], rowwise[side, row]
            for column in range(columns):
                found[column] = seen[column]
            for n in range(1, min(last, columns - 1) + 1):
                share = np.float32(reach - (n - 1)) if n == last else one
                _look_at(found[n:], seen[1 : columns - n + 1], seen[: columns - n], share)
                _look_at(found[: columns - n], seen[n - 1 : columns - 1], seen[n:], share)
        for row in range(rows):
            for column in range(columns):
                best[column] = rowwise[side, row, column]
            for n in range(1, last + 1):
                share = np.float32(reach - (n - 1)) if n == last else one
                if row >= n:
                    _look_at(best, rowwise[side, row - n + 1], rowwise[side, row - n], share)
                if row + n < rows:
                    _look_at(best, rowwise[side, row + n - 1], rowwise[side, row + n], share)
            for column in range(columns):
                bounds[row * columns + column, 1 - side] = outwards * best[column]
