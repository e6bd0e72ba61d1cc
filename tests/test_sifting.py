"""Primitives at rest are sifted by planes and lines in single precision: nothing that is near, or hits, may be lost."""

from __future__ import annotations

import meshes
import numpy as np
import pytest

import clothgym as cg
from clothgym.detection.hierarchy import Hierarchy
from clothgym.kernels import proximity


def soup(rng, count: int) -> tuple[np.ndarray, np.ndarray]:
    return rng.normal(size=(3 * count, 3)), np.arange(3 * count).reshape(-1, 3)


def lattice(rng) -> tuple[np.ndarray, np.ndarray]:
    return rng.integers(0, 5, size=(60, 3)).astype(float), rng.integers(0, 60, size=(90, 3))


def slivers(rng) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = soup(rng, 80)
    vertices[1::3] = vertices[0::3] + 1e-5 * rng.normal(size=(80, 3))
    return vertices, faces


def far_and_small(rng) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = soup(rng, 80)
    return 1e-3 * vertices + 1e2 * rng.normal(size=3), faces


def all_sizes(rng) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = soup(rng, 80)
    return vertices * 10.0 ** rng.uniform(-6, 0, size=80).repeat(3)[:, None], faces


def flat_twins(rng) -> tuple[np.ndarray, np.ndarray]:
    """Two flat sheets in one plane, and one that leans on them."""
    flat = cg.grid(1.0, 1.0, 6, 6)
    one = np.asarray(flat.vertices)
    leaning = one + np.array([0.01, 0.0, 0.02])
    leaning[:, 1] = 1e-3 * leaning[:, 0]
    sheets = [one, one + np.array([0.05, 0.0, 0.03]), leaning]
    return np.concatenate(sheets), np.concatenate([flat.faces + n * len(one) for n in range(3)])


SHAPES = {
    "soup": lambda rng: soup(rng, 60),
    "sheets": lambda rng: meshes.many_sheets(4, 3, int(rng.integers(100))),
    "lattice": lattice,
    "slivers": slivers,
    "far and small": far_and_small,
    "all sizes": all_sizes,
    "flat twins": flat_twins,
}


def found(tree, surface, x, other, distance) -> list[set]:
    """Near pairs and hits after the exact tests, from a search after a refit from x to `other`."""
    tree.refit(x, other, 0.5 * distance)
    tree.search(near=True, hits=True)
    counts = tree.counts.copy()
    gaps = np.empty(counts[0]), np.empty(counts[1])
    hits = cg.Intersections(x.copy(), surface, tree.edge_face[: counts[2]].copy())
    proximity.keep_near(x, surface.faces, surface.edges, distance, tree.vertex_face, tree.edge_edge, tree.counts, *gaps)
    kept = tree.vertex_face[: tree.counts[0]], tree.edge_edge[: tree.counts[1]], hits.edge_triangle
    return [set(map(tuple, pairs.tolist())) for pairs in kept], counts


@pytest.mark.parametrize("scale", [1.0, 1e-7, 1e8])
@pytest.mark.parametrize("shape", SHAPES)
def test_nothing_that_is_near_or_hits_is_sifted_away(shape, scale):
    rng = np.random.default_rng(len(shape))
    for share in (1e-4, 1e-2, 0.15):
        vertices, faces = SHAPES[shape](rng)
        x = np.ascontiguousarray(vertices * scale)
        surface = cg.Surface(faces, len(x))
        distance = share * float(np.ptp(x, axis=0).max())
        for k, arity in ((6, 16), (18, 4)):
            tree = Hierarchy(surface, x, k, arity)
            still, few = found(tree, surface, x, x, distance)
            moving, many = found(tree, surface, x, x.copy(), distance)
            assert still == moving
            assert (few[:3] <= many[:3]).all()


def test_sifting_leaves_little_between_layers():
    """Two flat layers: boxes overlap everywhere, planes do not."""
    flat = cg.grid(1.0, 1.0, 12, 12)
    one = np.asarray(flat.vertices)
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])  # boxes of slanted layers hold each other
    x = np.concatenate([one, one + np.array([0.0, 0.02, 0.0])]) @ turn.T
    surface = cg.Surface(np.concatenate([flat.faces, flat.faces + len(one)]), len(x))
    tree = Hierarchy(surface, x, 6, 16)
    (_, _, hits), few = found(tree, surface, x, x, 1e-3)
    _, many = found(tree, surface, x, x.copy(), 1e-3)
    assert hits == set()
    assert few[2] < 0.5 * many[2] and few[1] < 0.5 * many[1]


def test_both_in_one_search_are_what_each_finds():
    vertices, faces = meshes.many_sheets(4, 3, 5)
    surface = cg.Surface(faces, len(vertices))
    near, hits = cg.collisions(vertices, surface, 0.05)
    alone, alone_hits = cg.proximities(vertices, surface, 0.05), cg.intersections(vertices, surface)
    assert hits.hit_count > 0
    for name in ("vertex_triangle", "vertex_triangle_distance", "edge_edge", "edge_edge_distance"):
        np.testing.assert_array_equal(getattr(near, name), getattr(alone, name))
    for name in ("edge_triangle", "points", "pairs", "segments"):
        np.testing.assert_array_equal(getattr(hits, name), getattr(alone_hits, name))
    with pytest.raises(ValueError, match="distance"):
        cg.collisions(vertices, surface, -1.0)
