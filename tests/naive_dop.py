"""Slow, obvious versions of what a hierarchy with all its prunings promises. Nothing here imports the library."""

from __future__ import annotations

import naive
import numpy as np


def keys(vertices, faces, distance: float) -> set[tuple[int, ...]]:
    """(0, vertex, sorted corners) and (1, edge, edge) of every pair nearer than the distance."""
    near = naive.proximities(vertices, faces, distance)
    corners = np.sort(np.asarray(faces), axis=1)
    found = {(0, int(v), *corners[f].tolist()) for v, f in near.vertex_triangle}
    return found | {(1, *row) for row in near.edge_edge.tolist()}


def keys_within(vertices, ways, faces, distance: float, samples: int = 9) -> set[tuple[int, ...]]:
    """What comes within the distance at one of some times of a step with straight ways: at least these must be found."""
    return set().union(*(keys(vertices + t * ways, faces, distance) for t in np.linspace(0.0, 1.0, samples)))


def between(found: set[tuple[int, ...]], count: int) -> dict[str, set[tuple[int, ...]]]:
    """Pairs of two meshes that were put after each other, `count` vertices in the first: of the first, of both, of the second.

    Pairs of both are numbered as each mesh does: (0, vertex of the first, corners of the second), (1, edge, edge),
    (2, vertex of the second, corners of the first).
    """
    split: dict[str, set[tuple[int, ...]]] = {"first": set(), "both": set(), "second": set()}
    for kind, *ids in found:
        parts = [ids[:1], ids[1:]] if kind == 0 else [ids[:2], ids[2:]]
        later = [part[0] >= count for part in parts]
        if not any(later):
            split["first"].add((kind, *ids))
        elif all(later):
            split["second"].add((kind, *(i - count for i in ids)))
        elif later[0] and kind == 0:
            split["both"].add((2, ids[0] - count, *ids[1:]))
        else:
            if later[0]:
                parts = parts[::-1]
            split["both"].add((kind, *parts[0], *(i - count for i in parts[1])))
    return split


def distance(points, kind: int) -> float:
    """Of vertex and triangle (kind 0) or two edges (kind 1), points (4, 3)."""
    rows = [np.asarray(p)[None] for p in points]
    return float((naive.segment_segment_distance if kind else naive.point_triangle_distance)(*rows)[0])


def least_distance(points, ways, kind: int, samples: int = 401) -> float:
    """The least distance at some times of the step."""
    places = [p + np.linspace(0.0, 1.0, samples)[:, None] * w for p, w in zip(points, ways)]
    return float((naive.segment_segment_distance if kind else naive.point_triangle_distance)(*places).min())


def largest_angle(axis, vectors) -> float:
    """Between an axis and any of the vectors that are not zero [rad]."""
    rows = vectors[np.linalg.norm(vectors, axis=1) > 0]
    if len(rows) == 0:
        return 0.0
    crossed = np.linalg.norm(np.cross(rows, axis), axis=1)
    return float(np.arctan2(crossed, rows @ axis).max())


def normals(vertices, faces) -> np.ndarray:
    """(F, 3) unit normals."""
    across = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    return across / np.linalg.norm(across, axis=1, keepdims=True)
