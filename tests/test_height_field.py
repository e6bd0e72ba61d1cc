"""Sheets that are height fields: "cannot touch" is never said in error, and it is said of plain sheets."""

from __future__ import annotations

import meshes
import numpy as np
import pytest
from naive_separation import Pairs

import clothgym as cg
from clothgym.detection.height_field import HeightFields
from clothgym.kernels import height_field as kernels

REACH = 0.02


# ---------------------------------------------------------------------------------------------------------------
# shapes: (vertices (V, 3), faces (F, 3)) over u, v, all laid around the x-z plane with normals up


def lattice(columns: int, rows: int, keep=None, around: bool = False):
    """u, v in [0, 1] and faces of a grid; keep(i, j) leaves cells out, `around` joins the last column to the first."""
    wide = columns if around else columns + 1
    faces = []
    for i in range(columns):
        for j in range(rows):
            if keep is not None and not keep(i, j):
                continue
            a, b = i * (rows + 1) + j, ((i + 1) % wide) * (rows + 1) + j
            first = (i + j) % 2
            faces += [[a, a + 1, b + 1], [a, b + 1, b]] if first else [[a, a + 1, b], [a + 1, b + 1, b]]
    u, v = np.meshgrid(np.arange(wide) / columns, np.arange(rows + 1) / rows, indexing="ij")
    used, renumbered = np.unique(np.array(faces), return_inverse=True)
    return u.ravel()[used], v.ravel()[used], renumbered.reshape(-1, 3)


def plane(columns=6, rows=5, keep=None):
    u, v, faces = lattice(columns, rows, keep)
    return np.stack([u, 0 * u, v], axis=1), faces


def wavy(rng):
    x, faces = plane(7, 6)
    for _ in range(3):
        wave, phase = rng.normal(0, 4, 2), rng.uniform(0, 6)
        x[:, 1] += rng.choice([0.1, 0.6]) * np.sin(x[:, 0] * wave[0] + x[:, 2] * wave[1] + phase)
    return x, faces


def jittered(rng):
    x, faces = plane()
    return x + rng.uniform(-1, 1, x.shape) * rng.uniform(0, 0.12), faces


def l_shape(rng):
    x, faces = plane(6, 6, lambda i, j: i < 3 or j < 3)
    return x + rng.uniform(-1, 1, x.shape) * rng.uniform(0, 0.12), faces


def comb(rng):
    """Teeth that lean towards each other."""
    x, faces = plane(7, 5, lambda i, j: j == 0 or i % 2 == 0)
    x[:, 0] += rng.uniform(-0.25, 0.25) * x[:, 2] * np.sin(9 * x[:, 0])
    return x, faces


def frame(rng):
    """A sheet with a hole, or with two."""
    x, faces = plane(8, 6, (lambda i, j: not (i in (2, 5) and 1 < j < 4)) if rng.uniform() < 0.5 else
                     lambda i, j: not (1 < i < 6 and 1 < j < 4))  # fmt: skip
    x[:, 1] += rng.uniform(0, 0.2) * np.sin(5 * x[:, 0])
    return x + rng.uniform(-0.02, 0.02, x.shape), faces


def ring(rng):
    """An annulus, sometimes with its inner loop pushed over the outer one."""
    u, v, faces = lattice(14, 2, around=True)
    angle, radius = -2 * np.pi * u, 0.3 + 0.3 * v
    x = np.stack([radius * np.cos(angle), 0.1 * rng.normal() * np.cos(2 * angle), radius * np.sin(angle)], axis=1)
    x[:, 0] += rng.uniform(0, 0.5) * (1 - v)
    return x, faces


def ramp(rng):
    """Up to two turns of a spiral ramp: every triangle faces up."""
    turns, pitch, drift = rng.uniform(0.5, 2.0), rng.uniform(-0.2, 0.3), rng.uniform(-0.1, 0.6)
    u, v, faces = lattice(int(12 * turns) + 3, 2)
    angle, radius = -2 * np.pi * turns * u, 0.3 + 0.3 * v + drift * u
    return np.stack([radius * np.cos(angle), pitch * turns * u, radius * np.sin(angle)], axis=1), faces


def c_shape(rng):
    """Most of a turn: the ends may touch, or nearly."""
    u, v, faces = lattice(16, 1)
    angle, radius = -2 * np.pi * rng.uniform(0.9, 1.02) * u, 0.4 + 0.25 * v
    return np.stack([radius * np.cos(angle), 0 * u, radius * np.sin(angle)], axis=1), faces


def rolled(rng):
    """Bent around an axis by up to one and a half turns."""
    x, faces = plane(9, 3)
    bend = rng.uniform(0.1, 9.0)
    return np.stack([np.sin(bend * x[:, 0]) / bend, (1 - np.cos(bend * x[:, 0])) / bend, x[:, 2]], axis=1), faces


def overhang(rng):
    x, faces = plane(8, 3)
    lean = rng.uniform(0, 0.35)
    x[:, 1] = 0.1 * np.sin(6.28 * x[:, 0])
    x[:, 0] += lean * np.sin(6.28 * x[:, 0])
    return x, faces


def steep(rng):
    """Nearly upright cells along one line."""
    x, faces = plane(6, 4)
    x[:, 1] += rng.uniform(0, 2.0) * np.abs(x[:, 0] - 0.5)
    return x, faces


def wound(rng):
    """A disc whose inner vertex lies within two turns of triangles."""
    count = 16
    angle = -4 * np.pi * np.arange(count) / count
    radius = 0.5 + rng.uniform(0, 0.2) * np.cos(0.5 * angle + 1)
    rim = np.stack([radius * np.cos(angle), 0.2 * np.cos(0.5 * angle), radius * np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((1, 3)), rim]), np.array([[0, 1 + i, 1 + (i + 1) % count] for i in range(count)])


def two_sheets(rng):
    x, faces = plane(3, 3)
    other = x + rng.uniform(-1, 1, 3) * [1.3, 0.3, 1.3]
    return np.concatenate([x, other]), np.concatenate([faces, faces + len(x)])


SHAPES = (wavy, jittered, l_shape, comb, frame, ring, ramp, c_shape, rolled, overhang, steep, wound, two_sheets)


def motion(x, rng):
    """(V, 3) [m] common travel, a turn and a stretch about the middle, and ripples."""
    gentle = rng.choice([0.0, 0.05, 0.5])
    turn = np.eye(3) + gentle * rng.normal(0, 0.3, (3, 3))
    ripple = gentle * 0.1 * rng.normal(size=(1, 3)) * np.sin(x @ rng.normal(0, 4, 3))[:, None]
    return rng.normal(0, 1, 3) + (x - x.mean(axis=0)) @ (turn - np.eye(3)).T + ripple


def strays(fields: HeightFields, x, rng, towards=None):
    """(V, 3) [m] as far from the expected places as the tube allows, and anything along the normal.

    towards: (vertices of one primitive, those of the other, direction): they go to each other.
    """
    moves = np.zeros_like(x)
    sheets, tube = fields.sheets, fields.tube
    for c in range(len(sheets.reach)):
        own = sheets.members[sheets.member_start[c] : sheets.member_start[c + 1]]
        plane_axes = tube.axes[c, 1:]
        angle = rng.uniform(0, 0.5 * np.pi)
        corner = tube.slack[c] * np.array([np.cos(angle), np.sin(angle)])
        flat = rng.choice([-1.0, 1.0], (len(x), 2)) * corner
        if towards is not None:
            one, two, way = towards
            way = plane_axes @ way
            way *= tube.slack[c] / max(np.linalg.norm(way), 1e-300)
            flat = rng.choice([-1.0, 1.0], (len(x), 2)) * np.abs(way)
            flat[one], flat[two] = way, -way
        common = rng.normal(0, 0.3, 3) if len(sheets.reach) == 1 else np.zeros(3)
        normal = np.cross(plane_axes[0], plane_axes[1])
        heights = rng.normal(0, 0.2, (len(x), 1)) * rng.choice([0.0, 1.0]) * (len(sheets.reach) == 1)
        moves[own] = (1.0 - 1e-9) * (flat @ plane_axes)[own] + common + (heights * normal)[own]
    return moves


def nearest(pairs: Pairs, x, rng):
    """One of the nearest edge-edge pairs, and the way from the first to the second."""
    one, two = x[pairs.lines[:, :2]].mean(axis=1), x[pairs.lines[:, 2:]].mean(axis=1)
    chosen = rng.choice(np.argsort(np.linalg.norm(one - two, axis=1))[:40])
    return pairs.lines[chosen, :2], pairs.lines[chosen, 2:], (two - one)[chosen]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.__name__)
def test_what_is_decided_never_touches(shape):
    """Random shapes on random motions: wherever vertices go within the tube, no pair comes within reach."""
    rng = np.random.default_rng(SHAPES.index(shape))
    decided = 0
    for _ in range(30):
        x, faces = shape(rng)
        x = x @ meshes.rotation(int(rng.integers(1000))).T + rng.normal(0, 3, 3)
        fields = HeightFields(cg.Surface(faces, len(x)), np.full(len(x), REACH * rng.choice([0.2, 1.0])))
        travel = motion(x, rng)
        if not fields.decide(x, travel):
            continue
        decided += 1
        pairs = Pairs(faces, len(x))
        assert pairs.distance(x) >= fields.sheets.reach.max()
        for share in (0.0, *rng.uniform(0, 1, 2), 1.0):
            expected = x + share * travel
            for towards in (None, nearest(pairs, expected, rng)):
                somewhere = expected + strays(fields, x, rng, towards)
                if fields.stays(somewhere, share):  # several sheets may come too near to each other
                    assert pairs.distance(somewhere) >= fields.sheets.reach.max() * (1 - 1e-9)
                else:
                    assert len(fields.sheets.reach) > 1
    assert decided >= (0 if shape is wound else 3), "nothing was tested"
    assert decided <= (0 if shape is wound else 29)


def test_the_tube_is_as_wide_as_it_can_be():
    """On a flat grid two vertices across a cell really come within reach when they go to each other."""
    x, faces = plane(6, 6)
    fields = HeightFields(cg.Surface(faces, len(x)), np.full(len(x), REACH))
    assert fields.decide(x, np.zeros_like(x))
    rng = np.random.default_rng(0)
    pairs = Pairs(faces, len(x))
    least = min(pairs.distance(x + strays(fields, x, rng, nearest(pairs, x, rng))) for _ in range(150))
    assert REACH * (1 - 1e-9) <= least < 2.0 * REACH
    wide = np.sqrt(0.5) / 6
    assert fields.slack[0] == pytest.approx(0.5 * wide - 0.5 * REACH)


SHEET = plane(8, 6)


def stated(x, faces, travel=None, reach=REACH) -> bool:
    surface = cg.Surface(faces, len(x))
    return HeightFields(surface, np.full(len(x), reach)).decide(x, np.zeros_like(x) if travel is None else travel)


@pytest.mark.parametrize("seed", range(20))
def test_plain_sheets_are_decided(seed):
    """Flat, gently wavy, sheared, with holes, anywhere in space, and while they fly and turn."""
    rng = np.random.default_rng(seed)
    x, faces = SHEET
    shear, wave = x.copy(), x.copy()
    shear[:, 0] += 0.4 * x[:, 2]
    wave[:, 1] += 0.05 * np.sin(6 * x[:, 0] + rng.uniform(0, 6))
    hole = plane(8, 6, lambda i, j: not (2 < i < 6 and j in (2, 3)))
    corner = plane(6, 6, lambda i, j: i < 3 or j < 3)
    turn = meshes.rotation(seed)
    for points, cells in (SHEET, (shear, faces), (wave, faces), hole, corner):
        points = points @ turn.T + rng.normal(0, 10, 3)
        spin = np.cross(points - points.mean(axis=0), rng.normal(0, 0.1, 3))
        assert stated(points, cells)
        assert stated(points, cells, rng.normal(0, 5, 3) + 0 * points)
        assert stated(points, cells, rng.normal(0, 1, 3) + spin)
        assert stated(points, cells[:, ::-1])  # wound the other way
        assert stated(points[::-1], len(points) - 1 - cells)  # other numbers


def test_what_may_touch_is_not_decided():
    x, faces = SHEET
    assert stated(x, faces)
    closing = np.zeros_like(x)
    closing[:, 0] = -0.99 * x[:, 0]
    assert not stated(x, faces, closing)  # every triangle gets too narrow
    assert not stated(x, faces, 2.0 * closing)  # and turns over
    folding = np.where(x[:, :1] > 0.5, 2.0 * (0.5 - x) * [1, 0, 0], 0.0)
    assert not stated(x, faces, folding)
    passing = np.zeros_like(x)
    passing[np.argmin(np.linalg.norm(x - [0.5, 0, 0.5], axis=1))] = [0.3, 0, 0]
    assert not stated(x, faces, passing)
    assert stated(x, faces, reach=0.08) and not stated(x, faces, reach=0.1)  # which is the altitude of the triangles
    two = np.concatenate([x, x + np.array([0, 0.03, 0])])
    both = np.concatenate([faces, faces + len(x)])
    assert stated(two, both)
    assert not stated(np.concatenate([x, x + np.array([0, 0.015, 0])]), both)
    falling = np.concatenate([0 * x, 0 * x + [0, -1.0, 0]])
    assert stated(two, both, -falling) and not stated(two, both, falling)


def test_the_gap_of_an_outline_counts_outside_too():
    """The ends of a slit ring are apart by less than reach, though no triangle knows."""
    u, v, faces = lattice(40, 1)
    for gap, expected in ((0.05, True), (0.03, True), (0.015, False), (0.0, False), (-0.05, False)):
        angle, radius = -(2 * np.pi - gap / 0.5) * u, 0.5 + 0.2 * v
        x = np.stack([radius * np.cos(angle), 0 * u, radius * np.sin(angle)], axis=1)
        assert stated(x, faces, reach=0.02) == expected, gap


def test_two_loops_that_run_the_same_way_are_two_layers():
    """A sheet and a smaller one on it, cut open along a line and sewn crosswise: all faces up, both outlines simple."""
    big, small = lattice(8, 8), lattice(4, 4)
    points = {}
    faces = []
    for layer, (u, v, cells) in enumerate((big, small)):
        size, corner = (8, 0) if layer == 0 else (4, 2)
        column, row = np.round(u * size).astype(int) + corner, np.round(v * size).astype(int) + corner
        for face in cells:
            above = row[face].mean() > 4
            for i in face:
                at, copied = (int(column[i]), int(row[i])), layer
                if at in ((3, 4), (5, 4)):
                    copied = 0  # both ends of the cut belong to both
                elif at == (4, 4):
                    copied = layer if above else 1 - layer
                faces.append(points.setdefault((at, copied), len(points)))
    faces = np.array(faces).reshape(-1, 3)
    x = np.array([[at[0] / 8, 0.0, at[1] / 8] for at, _ in points])
    fields = HeightFields(cg.Surface(faces, len(x)), np.full(len(x), REACH))
    assert fields.possible and len(np.unique(fields.shapes.loop)) == 2
    assert Pairs(faces, len(x)).distance(x) == 0.0
    assert not fields.decide(x, np.zeros_like(x))


def test_the_least_width_holds_at_all_times():
    """Triangles on straight ways, some of which turn over and back: sampled altitudes are never below what was found."""
    rng = np.random.default_rng(0)
    x = np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0]])
    shapes = HeightFields(cg.Surface([[0, 1, 2]], 3), np.full(3, REACH)).shapes
    between = positive = 0
    for _ in range(400):
        ways = np.concatenate(
            [x[:, [2, 0]] + rng.normal(0, 0.3, (3, 2)), rng.normal(0, rng.choice([0, 0.3, 1]), (3, 2))], 1
        )
        found = kernels._least_width(shapes, 0, ways)
        widths = []
        for share in np.linspace(0, 1, 41):
            a, b, c = ways[:, :2] + share * ways[:, 2:]
            area = (b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]
            widths.append(area / max(np.linalg.norm(b - a), np.linalg.norm(c - b), np.linalg.norm(a - c)))
        assert found <= max(0.0, min(widths) * (1 + 1e-12) + 1e-15)
        positive += found > 0
        between += min(widths) < 0.8 * min(widths[0], widths[-1])
        if not ways[:, 2:].any():
            assert found == pytest.approx(max(0.0, widths[0]))
    assert positive > 100 and between > 20


def test_a_loop_of_three_edges_cannot_fold_onto_itself():
    triangle = np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0]])
    assert stated(triangle, np.array([[0, 1, 2]]))
    assert not stated(triangle * [1, 1, 0.01], np.array([[0, 1, 2]]))


def mobius():
    u, v, faces = lattice(12, 1)
    angle, out = 2 * np.pi * u, v - 0.5
    x = np.stack([(1 + out * np.cos(angle / 2)) * np.cos(angle), out * np.sin(angle / 2),
                  (1 + out * np.cos(angle / 2)) * np.sin(angle)], axis=1)  # fmt: skip
    last = {24: 1, 25: 0}
    return x[:24], np.array([[last.get(i, i) for i in face] for face in faces.tolist()])


def bow_tie():
    x, faces = plane(2, 2, lambda i, j: i == j)
    return x, faces


def flipped_face():
    x, faces = plane(3, 3)
    faces = faces.copy()
    faces[4] = faces[4, ::-1]
    return x, faces


def many():
    x, faces = plane(1, 1)
    return (
        np.concatenate([x + 2.0 * k for k in range(65)]),
        np.concatenate([faces + 4 * k for k in range(65)]),
    )


def beside_a_ball():
    return meshes.merged(SHEET, meshes.moved(meshes.icosphere(1), offset=(9, 9, 9)))


@pytest.mark.parametrize(
    "make",
    [mobius, bow_tie, flipped_face, many, beside_a_ball, lambda: meshes.icosphere(1),
     lambda: meshes.seam_of_three(3, 0), lambda: (np.zeros((4, 3)), np.zeros((0, 3), int)),
     lambda: meshes.repeated_faces(3, 0)],
    ids=["mobius", "bow_tie", "flipped", "many", "beside_a_ball", "ball", "seam", "empty", "repeated"],
)  # fmt: skip
def test_other_topologies_cost_nothing(make):
    x, faces = make()
    fields = HeightFields(cg.Surface(faces, len(x)), np.full(len(x), 1e-3))
    assert not fields.possible and not fields.decide(x, np.zeros_like(x))


def test_unused_vertices_and_faces_without_area_change_nothing():
    x, faces = SHEET
    assert stated(np.concatenate([x[:1] * np.nan, x]), faces + 1)
    flat = x.copy()
    flat[faces[7, 2]] = 0.5 * (flat[faces[7, 0]] + flat[faces[7, 1]])
    assert not stated(flat, faces)
    assert not stated(0.0 * x, faces)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_numbers_out_of_bounds_are_not_decided(bad):
    x, faces = SHEET
    for where in (0, 20, len(x) - 1):
        for given in range(2):
            arrays = [x.copy(), np.zeros_like(x)]
            arrays[given][where, 1] = bad
            assert not stated(arrays[0], faces, arrays[1])
    fields = HeightFields(cg.Surface(faces, len(x)), np.full(len(x), REACH))
    assert fields.decide(x, 0 * x) and fields.stays(x, 0.0)
    moved = x.copy()
    moved[20, 1] = bad
    assert not fields.stays(moved, 0.0) or bad == 1e300  # along the normal anything goes
    assert not stated(x + 1e13, faces)  # nothing is left of the cells


def test_a_long_outline_stays_near_linear():
    """A comb of many long teeth beside each other is given up after a bounded number of pairs, or decided."""
    x, faces = plane(301, 12, lambda i, j: j == 0 or i % 2 == 0)
    x *= [30.0, 1, 1]
    assert stated(x, faces, reach=1e-3)
