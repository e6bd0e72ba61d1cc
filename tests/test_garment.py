"""Sewn garments: what is welded to what, where it stands, and that the package's own fit its body."""

from __future__ import annotations

from functools import cache
from importlib import resources

import garmentcode as gc
import numpy as np
import pytest

from clothgym import pattern as patterns
from clothgym.detection.sides import signed_sides
from clothgym.garment import Garment, assemble
from clothgym.mesh import Surface
from clothgym.pattern import Pattern


def read(panels, stitches) -> Pattern:
    return Pattern.from_json(gc.document(panels, stitches))


def tube(*more: str) -> Pattern:
    """One panel whose left and right edges are sewn to each other."""
    return read({"p": gc.rectangle(30, 10)}, [gc.stitch("p", 1, "p", 3, *more)])


def pillow() -> Pattern:
    """Two squares sewn all around: each corner is cut off by a triangle in both."""
    square, back = (
        gc.rectangle(20, 20, translation=[0, 0, 5]),
        gc.rectangle(20, 20, clockwise=True, translation=[0, 0, -5]),
    )
    sides = ((0, 0), (1, 3), (2, 2), (3, 1))
    return read({"a": square, "b": back}, [gc.stitch("a", i, "b", j) for i, j in sides])


def cone() -> Pattern:
    """A triangle, two sides of which meet in a convex corner and are sewn to each other."""
    return read({"p": gc.panel([[0, 0], [20, 0], [10, 18]])}, [gc.stitch("p", 1, "p", 2)])


def dart() -> Pattern:
    corners = [[-15, 0], [15, 0], [15, 30], [1.5, 30], [0, 15], [-1.5, 30], [-15, 30]]
    return read({"p": gc.panel(corners)}, [gc.stitch("p", 3, "p", 4)])


def patchwork() -> Pattern:
    """Four squares around one point, in which four seams meet."""
    names = ["a", "b", "c", "d"]
    panels = {
        n: gc.rectangle(10, 10, translation=[x, y, 0]) for n, (x, y) in zip(names, [(-6, -6), (6, -6), (6, 6), (-6, 6)])
    }
    return read(
        panels,
        [gc.stitch("a", 1, "b", 3), gc.stitch("b", 2, "c", 0), gc.stitch("c", 3, "d", 1), gc.stitch("d", 0, "a", 2)],
    )


def foreign(name: str) -> Pattern:
    return Pattern.load(gc.foreign(name))


SEWN = {
    **{name: lambda name=name: Pattern.load(name) for name in patterns.names()},
    "tube": tube, "pillow": pillow, "cone": cone, "dart": dart, "patchwork": patchwork,
    "shirt": lambda: foreign("shirt_mean"), "dress": lambda: foreign("dress_pencil"),
}  # fmt: skip


@pytest.fixture(scope="module")
def sewn():
    made: dict[str, tuple[Pattern, Garment]] = {}

    def get(name: str) -> tuple[Pattern, Garment]:
        if name not in made:
            pattern = SEWN[name]()
            made[name] = pattern, assemble(pattern, 0.03)
        return made[name]

    return get


def partition(pattern: Pattern, garment: Garment) -> list[frozenset[tuple[int, int]]]:
    """Which (panel, vertex) are sewn together, found by joining sets one by one."""
    number = {panel.name: n for n, panel in enumerate(pattern.panels)}
    group = {(n, v): {(n, v)} for n, mesh in enumerate(garment.panel_meshes) for v in range(len(mesh.vertices))}
    for seam in pattern.seams:
        a, b = number[seam.panel_a], number[seam.panel_b]
        first = garment.panel_meshes[a].edge_vertices[seam.edge_a].tolist()
        second = garment.panel_meshes[b].edge_vertices[seam.edge_b].tolist()
        assert len(first) == len(second)
        if not seam.right_wrong:
            second.reverse()
        for v, w in zip(first, second):
            joined = group[a, v] | group[b, w]
            for member in joined:
                group[member] = joined
    return list({frozenset(members) for members in group.values()})


@pytest.mark.parametrize("name", SEWN)
def test_vertices_are_welded_as_the_seams_say(sewn, name):
    pattern, garment = sewn(name)
    groups = partition(pattern, garment)
    assert len(groups) == len(garment.vertices)
    for members in groups:
        ids = {int(garment.welded[n][v]) for n, v in members}
        assert len(ids) == 1
        mean = np.mean([garment.panel_vertices[n][v] for n, v in members], axis=0)
        assert garment.vertices[ids.pop()] == pytest.approx(mean, abs=1e-12)
    assert {len(m) > 1 for m in groups} == {True, False}
    sewn_vertices = np.unique([garment.welded[n][v] for m in groups if len(m) > 1 for n, v in m])
    assert set(sewn_vertices) <= set(garment.seam_vertices.tolist())


@pytest.mark.parametrize("name", SEWN)
def test_faces_are_a_clean_surface_with_its_rest_shape(sewn, name):
    pattern, garment = sewn(name)
    surface = Surface(garment.faces, len(garment.vertices))
    assert surface.skipped_faces == 0
    assert surface.edge_face_count.max() == 2
    assert surface.components.max() == 0
    assert len(np.unique(np.sort(garment.faces, axis=1), axis=0)) == len(garment.faces)
    assert set(garment.faces.ravel().tolist()) == set(range(len(garment.vertices)))
    # seams lie inside the cloth: two faces at each of their edges
    lookup = {tuple(edge): int(n) for edge, n in zip(surface.edges.tolist(), surface.edge_face_count)}
    assert all(lookup[tuple(edge)] == 2 for edge in garment.seam_edges.tolist())
    assert garment.panel_names == tuple(panel.name for panel in pattern.panels)
    for n, (panel, mesh) in enumerate(zip(pattern.panels, garment.panel_meshes)):
        mine = garment.panel_of_face == n
        rest = garment.rest_corners[mine]
        assert (rest == mesh.vertices[mesh.faces]).all()
        assert (garment.welded[n][mesh.faces] == garment.faces[mine]).all()
        u, w = rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]
        area = 0.5 * (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0])
        assert (area * panel.signed_area > 0.0).all()
        assert panel.placed(rest.reshape(-1, 2)).reshape(-1, 3, 3) == pytest.approx(
            garment.panel_vertices[n][mesh.faces]
        )


@pytest.mark.parametrize("name", SEWN)
def test_openings_are_the_borders(sewn, name):
    _, garment = sewn(name)
    directed = {(int(f[i]), int(f[(i + 1) % 3])) for f in garment.faces for i in range(3)}
    border = {(a, b) for a, b in directed if (b, a) not in directed}
    loops = [set(zip(loop.tolist(), np.roll(loop, -1).tolist())) for loop in garment.openings]
    assert set().union(*loops) == border
    assert sum(map(len, loops)) == len(border)
    assert all(loop[0] == loop.min() and len(set(loop.tolist())) == len(loop) for loop in garment.openings)
    heights = [round(float(garment.vertices[loop, 1].mean()), 3) for loop in garment.openings]
    assert heights == sorted(heights, reverse=True)
    expected = {"skirt": 2, "sleeveless_shirt": 4, "cuff": 2, "tube": 2, "pillow": 0, "cone": 1, "dart": 1, "patchwork": 1,
                "shirt": 4, "dress": 4, "scarf": 2, "shorts": 3, "sleeve": 2, "t_shirt": 4, "trousers": 3, "vest": 4,
                }  # fmt: skip
    assert len(garment.openings) == expected[name]
    # Euler characteristic of a sphere with that many holes
    surface = Surface(garment.faces, len(garment.vertices))
    assert len(garment.vertices) - len(surface.edges) + len(garment.faces) == 2 - len(garment.openings)


def test_openings_come_from_top_to_bottom_and_from_left_to_right(sewn):
    _, garment = sewn("sleeveless_shirt")
    neck, left, right, hem = (garment.vertices[loop].mean(axis=0) for loop in garment.openings)
    assert neck[1] > left[1] > hem[1]
    assert left[0] > 0.1 and right[0] < -0.1
    assert left[1] == pytest.approx(right[1], abs=0.002)


@pytest.mark.parametrize("name", ["shirt", "dress", "sleeveless_shirt", "skirt", "cuff"])
def test_seams_do_not_cross_and_normals_point_out(sewn, name):
    """The rule of the format pairs what lies nearer, on every seam of real garments."""
    pattern, garment = sewn(name)
    number = {panel.name: n for n, panel in enumerate(pattern.panels)}
    gap, total = 0.0, np.zeros(2)
    for seam in pattern.seams:
        a, b = number[seam.panel_a], number[seam.panel_b]
        first = garment.panel_vertices[a][garment.panel_meshes[a].edge_vertices[seam.edge_a]]
        second = garment.panel_vertices[b][garment.panel_meshes[b].edge_vertices[seam.edge_b]]
        reversed_sum = np.linalg.norm(first - second[::-1], axis=1).sum()
        along_sum = np.linalg.norm(first - second, axis=1).sum()
        chosen, other = (along_sum, reversed_sum) if seam.right_wrong else (reversed_sum, along_sum)
        total += chosen, other
        assert (
            chosen < other or name == "dress"
        )  # one of its seams, two points half a metre apart, is as near both ways
        gap = max(gap, np.linalg.norm(first - second[::-1], axis=1).max())
    assert total[0] < 0.95 * total[1]
    assert garment.seam_gap == pytest.approx(gap)
    for n, panel in enumerate(pattern.panels):
        x = garment.panel_vertices[n][garment.panel_meshes[n].faces]
        normals = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        assert (np.sign(normals[:, 2]) == np.sign(panel.translation[2])).all()


def test_both_sides_of_a_seam_get_equal_counts_though_one_is_longer():
    panels = {"a": gc.rectangle(40, 20, translation=[0, 11, 0]), "b": gc.rectangle(49.2, 20, translation=[0, -11, 0])}
    garment = assemble(read(panels, [gc.stitch("a", 0, "b", 2)]), 0.02)
    upper, lower = garment.panel_meshes
    assert len(upper.edge_vertices[0]) == len(lower.edge_vertices[2]) == 23
    assert len(garment.seam_vertices) == 23 and len(garment.seam_edges) == 22
    assert set(garment.seam_of_edge.tolist()) == {0}
    gathered = garment.vertices[garment.seam_vertices]
    assert np.ptp(gathered[:, 0]) == pytest.approx(0.5 * (0.40 + 0.492))
    assert gathered[:, 1] == pytest.approx(0.0, abs=1e-15)
    assert garment.seam_gap == pytest.approx(np.hypot(0.046, 0.02))


def test_a_right_wrong_seam_runs_the_same_way():
    # a tube sewn so is a Moebius strip: one border, twice as long
    garment = assemble(tube("right_wrong"), 0.02)
    surface = Surface(garment.faces, len(garment.vertices))
    assert surface.edge_face_count.max() == 2
    assert len(garment.openings) == 1
    plain = assemble(tube(), 0.02)
    assert len(garment.openings[0]) == sum(len(loop) for loop in plain.openings)
    assert len(garment.vertices) - len(surface.edges) + len(garment.faces) == 0


def test_four_seams_meet_in_one_vertex(sewn):
    _, garment = sewn("patchwork")
    assert np.linalg.norm(garment.vertices, axis=1).min() < 1e-15
    copies = np.bincount(np.concatenate(garment.welded))
    assert copies.max() == 4 and (copies == 4).sum() == 1


def test_corners_cut_off_on_both_sides_get_a_vertex_of_their_own():
    """Without it the pillow would have four faces at an edge and the cone's tip two faces folded together."""
    for make in (pillow, cone):
        for edge_length in (0.01, 0.02, 0.035, 0.06):
            garment = assemble(make(), edge_length)
            assert Surface(garment.faces, len(garment.vertices)).edge_face_count.max() == 2
    assert len(assemble(pillow(), 0.02).openings) == 0


def test_a_border_that_touches_itself_makes_two_loops():
    # two strips, sewn to each other at both ends of one side but not in its middle, beside a third at one corner
    panels = {"a": gc.panel([[0, 0], [10, 0], [20, 0], [30, 0], [30, 10], [0, 10]]),
              "b": gc.panel([[0, -10], [30, -10], [30, 0], [20, 0], [10, 0], [0, 0]])}  # fmt: skip
    garment = assemble(read(panels, [gc.stitch("a", 0, "b", 4), gc.stitch("a", 2, "b", 2)]), 0.02)
    assert sorted(len(loop) for loop in garment.openings) == [10, 50]


def test_seams_that_would_fold_the_cloth_are_named():
    # the edge is sewn to its neighbour the wrong way round: its own two ends meet
    legs = [gc.stitch("p", 1, "p", 2, "right_wrong")]
    with pytest.raises(
        ValueError, match="stitch 0: sewing 'p' edge 1 to 'p' edge 2 joins both ends of an edge of the mesh"
    ):
        assemble(read({"p": gc.panel([[0, 0], [20, 0], [10, 18]])}, legs), 0.3)
    # two pairs, and the first of each lie on each other: four faces at the edges in which the pairs are sewn
    panels = {name: gc.panel([[0, 0], [10, 0], [5, 9]]) for name in "abcd"}
    pairs = [gc.stitch("a", 0, "b", 0), gc.stitch("c", 0, "d", 0)]
    onto = [gc.stitch("a", k, "c", k, "right_wrong") for k in (1, 2)]
    message = (
        r"stitch 0: sewing 'a' edge 0 to 'b' edge 0 brings more than two faces to one edge of the mesh \(edge_length"
    )
    with pytest.raises(ValueError, match=message):
        assemble(read(panels, pairs + onto), 0.3)
    with pytest.raises(ValueError, match=r"edge_length = 0\.3: too long for pattern 'pattern': sewing folds faces"):
        assemble(
            read({"a": panels["a"], "b": panels["b"]}, [gc.stitch("a", k, "b", k, "right_wrong") for k in range(3)]),
            0.3,
        )


def test_a_panel_without_seams_is_a_garment_too():
    garment = assemble(read({"flag": gc.rectangle(30, 20, translation=[0, 100, 0])}, []))
    assert garment.seam_edges.shape == (0, 2) and len(garment.seam_vertices) == 0 and garment.seam_gap == 0.0
    assert (garment.vertices == garment.panel_vertices[0]).all()
    assert [len(loop) for loop in garment.openings] == [50]


def test_bad_edge_lengths_are_named():
    with pytest.raises(ValueError, match=r"edge_length = 0\.0: out of range"):
        assemble(tube(), 0.0)


def test_assembling_twice_gives_the_same_and_cannot_be_written():
    first, second = (assemble(Pattern.load("cuff")) for _ in range(2))
    assert (first.vertices == second.vertices).all() and (first.faces == second.faces).all()
    assert first.vertices.dtype == np.float64 and first.faces.dtype == np.int32
    with pytest.raises(ValueError, match="read-only"):
        first.vertices[0, 0] = 1.0


# The garments of the package on the body they are cut for


@cache
def woman() -> tuple[np.ndarray, Surface]:
    """The body for which they are cut: 1.59 m, arms 45 degrees down."""
    with resources.files("clothgym").joinpath("assets", "female_rig.npz").open("rb") as file, np.load(file) as data:
        vertices, faces = data["vertices"].astype(np.float64), data["faces"]
    return vertices, Surface(faces, len(vertices))


def samples(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertices, middles of edges and centroids."""
    x = vertices[faces]
    return np.concatenate([vertices, x.mean(axis=1), *(0.5 * (x[:, k] + x[:, k - 1]) for k in range(3))])


@pytest.mark.parametrize(("name", "clear", "clear_sewn"), [("skirt", 0.07, 0.045), ("sleeveless_shirt", 0.055, 0.018)])
def test_panels_stand_clear_of_the_body(sewn, name, clear, clear_sewn):
    _, garment = sewn(name)
    points = [samples(v, mesh.faces) for v, mesh in zip(garment.panel_vertices, garment.panel_meshes)]
    signs, distances = signed_sides(np.concatenate(points), *woman())
    assert (signs > 0).all()
    assert clear < distances.min() < 0.15
    signs, distances = signed_sides(samples(garment.vertices, garment.faces), *woman())
    assert (signs > 0).all()
    assert distances.min() > clear_sewn


def girth(y: float, half_width: float) -> float:
    """Of the body's convex hull at a height, arms left out [m]."""
    from scipy.spatial import ConvexHull

    vertices, surface = woman()
    a, b = vertices[surface.edges[:, 0]], vertices[surface.edges[:, 1]]
    crossing = (a[:, 1] - y) * (b[:, 1] - y) < 0.0
    a, b = a[crossing], b[crossing]
    t = (y - a[:, 1]) / (b[:, 1] - a[:, 1])
    cut = (a + t[:, None] * (b - a))[:, [0, 2]]
    return float(ConvexHull(cut[np.abs(cut[:, 0]) < half_width]).area)


def rest_girth(garment: Garment, opening: int) -> float:
    """Length of an opening's edges in the flat panels [m]."""
    loop = garment.openings[opening].tolist()
    edges = set(map(frozenset, zip(loop, loop[1:] + loop[:1])))
    total = 0.0
    for face, rest in zip(garment.faces.tolist(), garment.rest_corners):
        total += sum(
            np.linalg.norm(rest[k] - rest[k - 1]) for k in range(3) if frozenset((face[k], face[k - 1])) in edges
        )
    return total


def test_the_skirt_hangs_on_the_hips(sewn):
    _, garment = sewn("skirt")
    waist, hip = girth(1.02, 0.2), max(girth(y, 0.25) for y in np.arange(0.74, 0.82, 0.01))
    assert waist + 0.008 < rest_girth(garment, 0) < waist + 0.025
    assert rest_girth(garment, 0) < hip - 0.2
    assert rest_girth(garment, 1) > hip + 0.2
    assert garment.vertices[garment.openings[1], 1].mean() == pytest.approx(0.45, abs=0.03)  # the knee


def test_the_shirt_goes_around_bust_and_hips_and_stays_on_the_shoulders(sewn):
    pattern, garment = sewn("sleeveless_shirt")
    front, back = pattern.panel("front"), pattern.panel("back")
    bust = girth(1.16, 0.16)
    width = {y: sum(np.ptp(p.vertices[np.isclose(p.vertices[:, 1], y), 0]) for p in (front, back)) for y in (0.0, 0.29)}
    assert bust + 0.06 < width[0.29] < bust + 0.10
    hips = girth(0.80 - 0.02, 0.25)  # it settles by about two centimetres
    assert hips + 0.06 < width[0.0] < hips + 0.10
    neck, shoulders = girth(1.36, 0.2), 0.31
    assert neck + 0.1 < rest_girth(garment, 0) < 2 * shoulders
    # the seams of the shoulders lie one to three centimetres above them
    shoulder_seams = garment.vertices[np.unique(garment.seam_edges[garment.seam_of_edge >= 2])]
    _, distances = signed_sides(shoulder_seams, *woman())
    assert distances.min() > 0.01 and distances.max() < 0.035


def test_the_cuff_is_a_tube_along_x(sewn):
    _, garment = sewn("cuff")
    right, left = (garment.vertices[loop] for loop in garment.openings)
    assert right[:, 0] == pytest.approx(0.06) and left[:, 0] == pytest.approx(-0.06)
    assert rest_girth(garment, 0) == pytest.approx(0.32) and rest_girth(garment, 1) == pytest.approx(0.32)
    assert garment.vertices.mean(axis=0) == pytest.approx(np.zeros(3), abs=0.002)
