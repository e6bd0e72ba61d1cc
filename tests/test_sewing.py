"""Closing the garments of the package around the bodies: closed, outside, untangled, and not twisted."""

from __future__ import annotations

import numpy as np
import pytest

from clothgym import body as bodies
from clothgym.detection.body_maps import BodyMaps
from clothgym.detection.body_mesh import BodyMesh
from clothgym.detection.hierarchy import Hierarchy
from clothgym.detection.intersections import Intersections
from clothgym.dressing.placement import fit
from clothgym.dressing.sewing import opening_lengths, rest_of, sew
from clothgym.garment import assemble
from clothgym.mesh import Surface
from clothgym.pattern import Pattern
from clothgym.response.body import REACH

TOLERANCE = 0.003


class Sewn:
    def __init__(self, name):
        self.body = bodies.load("female")
        self.garment = assemble(fit(Pattern.load(name), self.body)[0], 0.025)
        self.maps = BodyMaps([self.body], 360, TOLERANCE + REACH)
        self.told = []
        self.x, self.gap = sew(self.garment, self.maps, TOLERANCE, lambda done, total: self.told.append((done, total)))
        self.exact = BodyMesh(self.body.mesh.vertices, self.body.mesh.faces)


@pytest.fixture(scope="module", params=["skirt", "sleeveless_shirt"])
def sewn(request):
    return Sewn(request.param)


def test_it_is_closed(sewn):
    """Edges come down to their rest lengths, seams included: what welding had stretched over gaps of decimetres."""
    surface, rest = rest_of(sewn.garment)
    x, start = sewn.x, sewn.garment.vertices
    ends = surface.edges

    def strain(places):
        return np.linalg.norm(places[ends[:, 1]] - places[ends[:, 0]], axis=1) / rest - 1.0

    assert strain(start).max() > 3.0
    assert np.percentile(strain(x), 99) < 0.05
    assert strain(x).max() < 0.2
    at_seam = np.isin(ends, sewn.garment.seam_vertices).all(axis=1)
    length = np.linalg.norm(x[ends[:, 1]] - x[ends[:, 0]], axis=1)
    assert length[at_seam].max() < 0.06
    assert np.isfinite(x).all()


def test_no_vertex_lies_below_the_true_body(sewn):
    assert sewn.exact.depth(sewn.x).max() < 0.001


def test_nothing_crosses(sewn):
    surface = Surface(sewn.garment.faces, len(sewn.x))
    tree = Hierarchy(surface, sewn.x)
    tree.refit(sewn.x, sewn.x, 0.0)
    assert Intersections(sewn.x, surface, tree.edges_against_faces()).hit_count == 0


def test_it_is_not_twisted(sewn):
    """Left and right are mirror images, in z as well: planes that reach out of the outline once turned the skirt."""
    x, garment = sewn.x, sewn.garment
    lines = sorted({tuple(np.sign(x[e].mean(axis=0)[:1])) for e in garment.seam_edges})
    assert lines == [(-1.0,), (1.0,)]
    seam = np.unique(garment.seam_edges)
    hem = [min(seam[x[seam, 0] * side > 0.03], key=lambda v: (x[v, 1].round(3), v)) for side in (-1.0, 1.0)]
    left, right = x[hem[0]], x[hem[1]]
    assert left[2] == pytest.approx(right[2], abs=0.010)
    assert left[0] == pytest.approx(-right[0], abs=0.010)
    # each vertex against the mirrored cloth
    from scipy.spatial import cKDTree

    mirrored = x * [-1.0, 1.0, 1.0]
    surface = Surface(garment.faces, len(x))
    dense = np.concatenate([mirrored, mirrored[garment.faces].mean(axis=1), mirrored[surface.edges].mean(axis=1)])
    gaps = cKDTree(dense).query(x)[0]
    assert np.median(gaps) < 0.006, "the mesh itself is not mirrored: the nearest of its points is up to 6 mm off"
    assert gaps.max() < 0.02
    # twist: how far the side seams' z differ at each height
    for low in np.arange(x[:, 1].min() + 0.02, x[:, 1].max() - 0.1, 0.05):
        band = (x[:, 1] >= low) & (x[:, 1] < low + 0.05)
        if min((band & (x[:, 0] < 0)).sum(), (band & (x[:, 0] > 0)).sum()) < 12:
            continue
        seams = np.isin(np.arange(len(x)), seam) & band
        one, two = (x[seams & (np.sign(x[:, 0]) == side), 2] for side in (-1.0, 1.0))
        if len(one) and len(two):
            assert one.mean() == pytest.approx(two.mean(), abs=0.005)


def test_progress_runs_to_the_end(sewn):
    done = [d for d, _ in sewn.told]
    assert done == sorted(done)
    assert sewn.told[-1][0] == sewn.told[-1][1]
    assert len(done) > 5


def test_the_same_bits_again(sewn):
    again, gap = sew(sewn.garment, sewn.maps, TOLERANCE)
    assert again.tobytes() == sewn.x.tobytes() and gap == sewn.gap == 0.0


def test_openings_keep_their_lengths(sewn):
    for loop, rest in zip(sewn.garment.openings, opening_lengths(sewn.garment)):
        ring = sewn.x[loop]
        length = np.linalg.norm(ring - np.roll(ring, -1, axis=0), axis=1).sum()
        assert length == pytest.approx(rest, rel=0.12)


def test_seam_forces_close_a_skirt_too(sewn):
    """[Vassilev 2001]: panels start apart, forces along the seams draw them together; what is left is welded."""
    x, gap = sew(sewn.garment, sewn.maps, TOLERANCE, closing="forces")
    assert 0.0 < gap < 0.02 < sewn.garment.seam_gap
    surface, rest = rest_of(sewn.garment)
    length = np.linalg.norm(x[surface.edges[:, 1]] - x[surface.edges[:, 0]], axis=1)
    assert np.percentile(length / rest - 1.0, 99) < 0.15
    assert sewn.exact.depth(x).max() < 2e-3
    with pytest.raises(ValueError, match="closing = 'glue'"):
        sew(sewn.garment, sewn.maps, TOLERANCE, closing="glue")
