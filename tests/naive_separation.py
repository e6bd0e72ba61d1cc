"""How far the primitives of a small mesh without a common vertex are apart: every pair, in plain numpy."""

from __future__ import annotations

import numpy as np


class Pairs:
    """All vertex-face, edge-edge and edge-face pairs of a mesh without a common vertex."""

    def __init__(self, faces, vertex_count: int) -> None:
        faces = np.asarray(faces, np.int64)
        ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        edges = np.unique(ends, axis=0)
        used = np.unique(faces)
        v, f = (a.ravel() for a in np.meshgrid(used, np.arange(len(faces)), indexing="ij"))
        keep = (faces[f] != v[:, None]).all(axis=1)
        self.points = np.column_stack([v[keep], faces[f[keep]]])
        e, g = np.triu_indices(len(edges), 1)
        keep = (edges[e][:, :, None] != edges[g][:, None, :]).all(axis=(1, 2))
        self.lines = np.column_stack([edges[e[keep]], edges[g[keep]]])
        e, f = (a.ravel() for a in np.meshgrid(np.arange(len(edges)), np.arange(len(faces)), indexing="ij"))
        keep = (edges[e][:, :, None] != faces[f][:, None, :]).all(axis=(1, 2))
        self.pierce = np.column_stack([edges[e[keep]], faces[f[keep]]])

    def distance(self, x) -> float:
        """Least distance [m] of all pairs at vertices (V, 3); 0 where an edge goes through a face."""
        lines = _edge_edge(*(x[self.lines[:, k]] for k in range(4)))
        points = _point_triangle(*(x[self.points[:, k]] for k in range(4)))
        a, b, p, q, r = (x[self.pierce[:, k]] for k in range(5))
        # what is nearly in one plane and meets has edges that meet, so only clear signs count here
        small = 1e-12 * np.ptp(x[self.points], axis=(0, 1)).max() ** 3
        ends = np.stack([_volume(a, p, q, r), -_volume(b, p, q, r)])
        turns = np.stack([_volume(a, b, p, q), _volume(a, b, q, r), _volume(a, b, r, p)])
        through = (ends > small).all(axis=0) | (ends < -small).all(axis=0)
        through &= (turns > small).all(axis=0) | (turns < -small).all(axis=0)
        return float(min(lines.min(initial=np.inf), points.min(initial=np.inf), 0.0 if through.any() else np.inf))


def _dot(a, b):
    return (a * b).sum(axis=-1)


def _volume(a, b, c, d):
    return _dot(np.cross(b - a, c - a), d - a)


def _point_segment(p, a, b):
    way = b - a
    share = np.clip(_dot(p - a, way) / np.maximum(_dot(way, way), 1e-300), 0.0, 1.0)
    return np.linalg.norm(p - a - share[:, None] * way, axis=1)


def _edge_edge(a, b, c, d):
    """The lines' nearest points where both lie inside, or else an end and the other edge."""
    least = np.minimum(
        np.minimum(_point_segment(a, c, d), _point_segment(b, c, d)),
        np.minimum(_point_segment(c, a, b), _point_segment(d, a, b)),
    )
    u, v, r = b - a, d - c, a - c
    uu, vv, uv = _dot(u, u), _dot(v, v), _dot(u, v)
    det = uu * vv - uv * uv
    with np.errstate(all="ignore"):
        s = (uv * _dot(v, r) - vv * _dot(u, r)) / det
        t = (uu * _dot(v, r) - uv * _dot(u, r)) / det
    inside = (det > 1e-12 * uu * vv) & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    gap = np.linalg.norm(r + np.where(inside, s, 0.0)[:, None] * u - np.where(inside, t, 0.0)[:, None] * v, axis=1)
    return np.where(inside, np.minimum(gap, least), least)


def _point_triangle(p, a, b, c):
    least = np.minimum(np.minimum(_point_segment(p, a, b), _point_segment(p, b, c)), _point_segment(p, c, a))
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    signs = np.stack([_dot(np.cross(s - r, p - r), normal) for r, s in ((a, b), (b, c), (c, a))])
    with np.errstate(all="ignore"):
        height = np.abs(_dot(p - a, normal)) / size
    above = (size > 0) & (signs >= 0).all(axis=0)
    return np.where(above, np.minimum(height, least), least)
