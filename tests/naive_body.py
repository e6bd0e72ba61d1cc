"""Slow and obvious versions of the body's maps: rays through all triangles, outlines by hulls, analytic solids."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import ConvexHull


class NaiveMaps:
    """The planes of every texel that is asked for, from rays along z; for convex bodies, whose outline is a hull."""

    def __init__(self, vertices, faces, grid, interpolated=False) -> None:
        """`grid` is (left, bottom, pixel, rows, columns): where the texels lie, and nothing else, is taken over."""
        self.interpolated = interpolated
        self.vertices, self.faces = np.asarray(vertices, float), np.asarray(faces)
        self.left, self.bottom, self.pixel, self.rows, self.columns = grid
        corners = self.vertices[self.faces]
        weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.face_normals = weighted / np.linalg.norm(weighted, axis=1)[:, None]
        self.normals = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(self.normals, self.faces[:, k], weighted)
        self.normals /= np.linalg.norm(self.normals, axis=1)[:, None]
        xy = self.vertices[:, :2]
        self.hull = xy[ConvexHull(xy).vertices]

    def centre(self, texel):
        row, column = texel
        return np.array([self.left + (column + 0.5) * self.pixel, self.bottom + (row + 0.5) * self.pixel])

    def texel(self, point):
        column, row = (math.floor((point[k] - (self.left, self.bottom)[k]) / self.pixel) for k in range(2))
        return (row, column) if 0 <= row < self.rows and 0 <= column < self.columns else None

    def ray(self, texel):
        """(place, normal) of the front and of the back where a ray along z meets the body, or None."""
        at = self.centre(texel)
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        with np.errstate(all="ignore"):
            wb = ((at[0] - a[:, 0]) * (c - a)[:, 1] - (at[1] - a[:, 1]) * (c - a)[:, 0]) / area
            wc = ((b - a)[:, 0] * (at[1] - a[:, 1]) - (b - a)[:, 1] * (at[0] - a[:, 0])) / area
        wb, wc = np.nan_to_num(wb, nan=-1.0, posinf=-1.0), np.nan_to_num(wc, nan=-1.0, posinf=-1.0)
        hit = np.flatnonzero((area != 0.0) & (wb >= 0.0) & (wc >= 0.0) & (wb + wc <= 1.0))
        if len(hit) == 0:
            return None
        weights = np.stack([1.0 - wb[hit] - wc[hit], wb[hit], wc[hit]], axis=1)
        places = np.einsum("nk,nkx->nx", weights, self.vertices[self.faces[hit]])
        found = []
        for outwards, which in ((1.0, np.argmax(places[:, 2])), (-1.0, np.argmin(places[:, 2]))):
            face = hit[which]
            normal = (
                weights[which] @ self.normals[self.faces[face]] if self.interpolated else self.face_normals[face].copy()
            )
            normal[2] = outwards * max(0.0, outwards * normal[2])
            found.append((places[which], normal / np.linalg.norm(normal)))
        return found

    def outline(self, point):
        """Signed distance of (x, y) from the outline of a convex body, and the direction outwards."""
        best, direction, inside = math.inf, None, True
        for p, q in zip(self.hull, np.roll(self.hull, -1, axis=0)):
            way = q - p
            out = np.array([way[1], -way[0]]) / np.linalg.norm(way)
            inside = inside and out @ (point - p) <= 0.0
            foot = p + np.clip((point - p) @ way / (way @ way), 0.0, 1.0) * way
            if np.linalg.norm(point - foot) < best:
                best = float(np.linalg.norm(point - foot))
                direction = point - foot
        return (-best, -direction / best) if inside else (best, direction / best)

    def query(self, point, tolerance, reach):
        """(distance, normal) of a point over a texel of the body; (inf, zero) outside; None over other texels.

        `reach`: texels around its middle that tell at what depths z there is body.
        """
        texel = self.texel(point)
        if texel is None or (here := self.ray(texel)) is None:
            return None
        row, column = texel
        last = math.ceil(reach)
        around = [[self.ray((row + i, column + j)) for j in range(-last, last + 1)] for i in range(-last, last + 1)]
        high, low = (
            sign * highest([highest([-math.inf if r is None else sign * r[side][0][2] for r in row], reach) for row in around],
                           reach)
            for side, sign in ((0, 1.0), (1, -1.0))
        )  # fmt: skip
        planes = [(float(normal @ (point - place)), normal) for place, normal in here]
        signed, out = self.outline(self.centre(texel))
        planes.append((signed + float(out @ (point[:2] - self.centre(texel))), np.array([*out, 0.0])))
        distance, normal = max(planes, key=lambda plane: plane[0])
        if distance >= tolerance or not low - tolerance <= point[2] <= high + tolerance:
            return math.inf, np.zeros(3)
        return distance, normal


def highest(heights, reach):
    """The highest place of a polygon through heights a step apart, within `reach` steps of the middle one; a height beside
    nothing (-inf) counts up to there."""
    last = len(heights) // 2
    inner, best = heights[1:-1], -math.inf
    for outer, before in ((heights[0], heights[1]), (heights[-1], heights[-2])):
        share = reach - (last - 1)
        best = max(best, outer if before == -math.inf else (1.0 - share) * before + share * outer)
    return max(best, *inner)


def sphere_distance(points, radius):
    return np.linalg.norm(points, axis=1) - radius


def capsule_distance(points, a, b, radius):
    way = b - a
    share = np.clip((points - a) @ way / (way @ way), 0.0, 1.0)
    return np.linalg.norm(points - a - share[:, None] * way, axis=1) - radius


def box_distance(points, size):
    gap = np.abs(points) - 0.5 * np.asarray(size)
    return np.linalg.norm(np.maximum(gap, 0.0), axis=1) + np.minimum(gap.max(axis=1), 0.0)


def ellipsoid_distance(points, radii, iterations: int = 60):
    """By bisection for the multiplier of the foot [Eberly, distance from a point to an ellipsoid]."""
    r = np.asarray(radii)
    p = np.abs(points)
    low = -(r.min() ** 2) + r.min() * p[:, r.argmin()]
    high = -(r.min() ** 2) + np.linalg.norm(r * p, axis=1)
    for _ in range(iterations):
        middle = 0.5 * (low + high)
        large = ((r * p / (middle[:, None] + r**2)) ** 2).sum(axis=1) > 1.0
        low, high = np.where(large, middle, low), np.where(large, high, middle)
    foot = r**2 * p / (high[:, None] + r**2)
    sign = np.where(((p / r) ** 2).sum(axis=1) > 1.0, 1.0, -1.0)
    return sign * np.linalg.norm(p - foot, axis=1)


def linking_number(loop, path, samples: int = 400) -> float:
    """Gauss' integral of two closed polygons, each side cut into equal pieces."""

    def cut(ring):
        share = (np.arange(samples) + 0.5)[:, None] / samples
        following = np.roll(ring, -1, axis=0)
        places = np.concatenate([a + share * (b - a) for a, b in zip(ring, following)])
        return places, np.repeat((following - ring) / samples, samples, axis=0)

    one, step_one = cut(np.asarray(loop, float))
    two, step_two = cut(np.asarray(path, float))
    total = 0.0
    for place, step in zip(one, step_one):
        gap = place - two
        total += float((np.cross(step, step_two) * gap).sum(axis=1) @ (np.linalg.norm(gap, axis=1) ** -3))
    return total / (4.0 * math.pi)
