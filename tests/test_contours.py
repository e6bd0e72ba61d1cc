"""Contours: kinds, regions, crossings and depth, against the definitions and on meshes made by hand for each kind."""

from __future__ import annotations

from collections import Counter

import meshes
import naive
import naive_contours
import networkx as nx
import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym.detection.contours import KINDS, Enclosed
from clothgym.detection.tracking import ContourTracker
from clothgym.kernels import regions as kernels
from clothgym.mesh import vertex_areas
from clothgym.scenes.canonical import draw

SMALL = [name for name in meshes.GENERAL if name != "poked_sphere"]


def crease_through_itself(cells: int = 9) -> meshes.Mesh:
    """A fold whose flaps change places beside the middle of the crease and back again: LL."""
    vertices, faces = meshes.grid(2 * cells, 2 * cells, 2.0, 2.0, alternate=True)
    vertices = meshes.jittered((vertices - [1.0, 0.0, 1.0], faces), 0.1 / cells, 2)[0]
    x, z = vertices[:, 0].copy(), vertices[:, 2]
    way = (x / 0.7) ** 2 + (z / 0.6) ** 2 - 1.0
    angle = np.where(x > 0, 0.3 * np.clip(way, -1, 1), 0.0)
    flat = np.abs(x)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle) - 0.02 * (x > 0) * x * x, z], axis=1), faces


def twisted_band(around: int = 25, across: int = 3) -> meshes.Mesh:
    """A band that goes round twice with half a twist, through itself all along its middle line: Eight."""
    turn = 4.0 * np.pi * np.arange(around) / around
    frame = np.stack([np.cos(turn), np.zeros(around), np.sin(turn)], axis=1)
    direction = np.cos(0.25 * turn)[:, None] * frame + np.sin(0.25 * turn)[:, None] * np.array([0, 1.0, 0])
    place = np.linspace(-0.4, 0.4, across + 1)
    vertices = (2.0 * frame[:, None] + place[None, :, None] * direction[:, None]).reshape(-1, 3)
    faces = []
    for i in range(around):
        for j in range(across):
            a, b = i * (across + 1) + j, i * (across + 1) + j + 1
            c, d = (across - j - 1, across - j) if i == around - 1 else (b + across + 1, a + across + 1)
            faces += [[a, b, c], [a, c, d]]
    return meshes.jittered((vertices, np.array(faces)), 0.004, 1)


def three_sheets() -> meshes.Mesh:
    """Three squares in general position that meet in one point: Cross."""
    turns = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    flat = meshes.jittered(meshes.moved(meshes.grid(5, 5), None, (-0.5, 0, -0.5)), 0.01, 1)
    parts = [flat] + [meshes.moved(flat, t, (0.03 * n, 0.05, 0.02)) for n, t in enumerate(turns)]
    return meshes.merged(*parts)


KIND = {
    "Closed": lambda: meshes.pyramid_poke(0.23),
    "BBII": lambda: meshes.strip_through_plane(0.3, 0.35),
    "BIBI": lambda: meshes.crossed_squares(0.3123),
    "BLI": lambda: meshes.overfolded_sheet(5, 0),
    "LL": crease_through_itself,
    "Cross": three_sheets,
    "Eight": twisted_band,
    "branched": lambda: meshes.seam_of_three(4, 0),
}


@pytest.mark.parametrize("kind", KIND)
def test_a_mesh_of_every_kind(kind):
    contours = cg.intersections(*KIND[kind]()).contours
    assert {contour.kind for contour in contours} == {kind}
    assert len(contours) == (3 if kind == "Cross" else len(contours) if kind == "branched" else 1)
    first = contours[0]
    ends = {"Closed": "", "Eight": "", "LL": "LL", "BLI": "BIL", "branched": first.ends}
    assert first.ends == ends.get(kind, "BBII")
    assert first.closed == (first.ends == "")
    assert first.consistent == (kind != "Eight")
    assert first.self_contour == (kind in ("BLI", "LL", "Eight"))
    assert (first.branches > 0) == (kind == "branched")
    assert first.crossings == (2 if kind == "Cross" else 0)
    assert set(KIND) <= set(KINDS)


def test_a_missing_hit_leaves_an_open_contour():
    hits = cg.intersections(*meshes.pyramid_poke(0.23))
    kept = np.ones(hits.hit_count, np.bool_)
    kept[2] = False
    (contour,) = hits.keeping(kept).contours
    assert (contour.kind, contour.closed, contour.ends) == ("Open", False, "??")
    assert contour.hit_count == hits.hit_count - 1
    assert hits.contours[0].kind == "Closed"


@pytest.mark.parametrize("name", [*SMALL, *KIND])
def test_contours_equal_their_definitions(name):
    vertices, faces = (KIND | meshes.GENERAL)[name]()
    exact = naive.exact_intersections(vertices, faces)
    hits = cg.intersections(vertices, faces)
    areas = vertex_areas(vertices, faces)
    crossings = naive_contours.crossings(exact)
    assert [c.crossings for c in hits.contours] == crossings
    for contour, members, crossed in zip(hits.contours, naive_contours.members(exact), crossings, strict=True):
        assert contour.kind == naive_contours.kind(exact, members, crossed)
        colour = naive_contours.sides(exact, members)
        assert contour.consistent == (colour is not None)
        if colour is not None:
            factor = hits.hit_side[members[0]]
            assert hits.hit_side[members].tolist() == [factor * colour[h] for h in members]
            expected = {(int(factor * s), part) for s, part in naive_contours.regions(exact, members, areas)}
        else:
            expected = set()
        if contour.kind == "BLI":
            folded_corner(exact, members, contour.regions)
        elif contour.ends != "BIL":  # one that crosses itself cuts off several parts beside the corner
            assert {(r.side, frozenset(r.vertices.tolist())) for r in contour.regions} == expected
        for region in contour.regions:
            assert len(set(region.vertices.tolist())) == len(region.vertices)
            assert region.area == pytest.approx(areas[region.vertices].sum(), rel=1e-9)
            assert 0.0 < region.share < 1.0
            assert region.share <= 0.5 + 1e-9 or len(contour.regions) == 2
            assert region.doubtful == (region.share > 0.4)


def folded_corner(exact: naive.Exact, members, regions) -> None:
    """One part, not more than half, that reaches a border, in which every edge that the contour crosses has one end; another
    shortest way to the border may make it larger or smaller by what lies beyond the contour's end."""
    ends = set(naive_contours.loops(exact, members))
    crossed = [exact.hits[h][:2] for h in members]
    cut = [edge for edge in set(crossed) if crossed.count(edge) % 2 and not ends & set(edge)]
    for region in regions:
        assert region.side == 0 and region.share <= 0.5 + 1e-9 and not ends & set(region.vertices.tolist())
    if len(regions) != 1:  # the way to the border runs along the contour or across other parts of it
        return
    (region,) = regions
    inside = set(region.vertices.tolist())
    assert sum(len(inside & set(edge)) == 1 for edge in cut) == len(cut)
    border = {v for edge, faces in exact.incident.items() if len(faces) == 1 for v in edge}
    assert inside & border
    graph = nx.Graph(edge for edge in exact.incident if set(edge) <= inside)
    graph.add_nodes_from(inside)
    assert nx.number_connected_components(graph) == 1


def test_a_corner_that_is_folded_through_is_inside():
    tangle = draw("BLI", 3.0, 16, 0)
    hits = cg.intersections(tangle.scene.start, tangle.scene.cloths[0].mesh.faces)
    (contour,) = hits.contours
    (region,) = contour.regions
    (rule,) = tangle.rules
    wrong = set(rule.vertices[rule.misplaced].tolist())
    assert contour.kind == "BLI" and len(wrong) > 10
    assert wrong - set(hits.loop_vertex.tolist()) <= set(region.vertices.tolist())
    assert region.share < 0.3


def test_the_meshes_above_have_regions_of_every_sort():
    found = Counter(
        (c.kind, r.side == 0) for name in (*SMALL, *KIND) for c in cg.intersections(*(KIND | meshes.GENERAL)[name]()).contours
        for r in c.regions
    )  # fmt: skip
    assert found["Closed", False] > 0 and found["BBII", False] > 0
    assert found["LL", True] > 0


@pytest.mark.parametrize("depth", [0.05, 0.12])
def test_depth_of_a_pyramid_and_of_a_strip(depth):
    (contour,) = cg.intersections(*meshes.pyramid_poke(depth)).contours
    assert contour.depth == pytest.approx(depth, rel=1e-9)
    vertices, faces = meshes.strip_through_plane(0.3, 0.0)
    strip, sheet = vertices[: 5 * 21], vertices[5 * 21 :]
    (contour,) = cg.intersections(vertices, faces).contours
    (region,) = contour.regions
    below = np.abs(strip[region.vertices, 1] - sheet[0, 1])
    assert np.ptp(sheet[:, 1]) == 0.0
    assert region.depth == pytest.approx(below.max(), rel=1e-6)


def test_small_contours_on_large_meshes_are_cheap():
    """The flood ends when one region is left: what it visits does not grow with the sheet."""
    tip = (np.array([[0.5, -0.01, 0.51], [0.49, 0.2, 0.52], [0.52, 0.2, 0.48]]), np.array([[0, 1, 2]]))
    found = []
    for cells in (20, 60):
        hits = cg.intersections(*meshes.merged(meshes.jittered(meshes.grid(cells, cells), 1e-3, 0), tip))
        areas = np.ones(len(hits.vertices))
        enclosed = Enclosed(hits, areas)
        found.append((len(enclosed), len(enclosed.inside)))
    assert found[0] == found[1]
    assert found[0][1] == 1


def slit_tube_through_sheet(width: float) -> meshes.Mesh:
    """A tube that is open along a slit goes through a sheet: its contour ends twice in the inside of the sheet."""
    around = np.linspace(0.5 * width, 2.0 * np.pi - 0.5 * width, 30) + 0.1
    rings = [np.stack([0.3 * np.cos(around), np.full(30, y), 0.3 * np.sin(around)], axis=1) for y in (-0.21, 0.24)]
    low = np.arange(29)
    faces = np.concatenate(
        [np.stack([low, low + 1, low + 30], axis=1), np.stack([low + 1, low + 31, low + 30], axis=1)]
    )
    sheet = meshes.moved(meshes.grid(8, 8), None, (-0.513, 0.0, -0.492))
    return meshes.merged(sheet, (np.concatenate(rings), faces))


def test_a_side_has_regions_exactly_where_its_cut_edges_separate():
    """Crumpled sheets through each other: most contours end inside a sheet. So do those of tubes with a slit, but they cut off
    the inner vertices all the same where both ends lie in one face."""
    count = Counter()
    crumples = [meshes.moved(meshes.crumple(9, n, 0.2), meshes.rotation(7 * (n // 4) + n % 4)) for n in range(24)]
    tangles = [meshes.merged(*crumples[n : n + 4]) for n in range(0, 24, 4)]
    for number, mesh in enumerate([*tangles, slit_tube_through_sheet(0.02), slit_tube_through_sheet(1.0)]):
        hits = cg.intersections(*mesh)
        found = Enclosed(hits, np.ones(len(hits.vertices)))
        edges = [tuple(edge) for edge in hits.surface.edges.tolist()]
        loops = set(hits.contour[hits.loop_vertex >= 0].tolist())
        for c in set(range(hits.contour_count)) - loops:
            for side in (1.0, -1.0):
                crossed = hits.hit_edge[(hits.hit_contour == c) & (hits.hit_side == side)].tolist()
                cut = {edges[e] for e, times in Counter(crossed).items() if times % 2}
                graph = nx.Graph(edge for edge in edges if edge not in cut)
                graph.add_nodes_from(range(len(hits.vertices)))
                label = {v: n for n, part in enumerate(nx.connected_components(graph)) for v in part}
                separates = bool(hits.contour_consistent[c]) and any(label[a] != label[b] for a, b in cut)
                assert separates == (side in found.side[found.of_contour[c]])
                count[separates] += 1
                if number >= len(tangles):
                    tube = edges[crossed[0]][0] >= 81
                    assert separates == (tube or number == len(tangles))
    assert count[True] > 10 and count[False] > 30


@pytest.mark.parametrize("name", ["Closed", "BBII", "BLI", "LL", "crumple-1", "sheets"])
def test_ways_back_are_the_shortest_to_what_a_region_lies_behind(name):
    mesh = (KIND | meshes.GENERAL | {"sheets": lambda: meshes.many_sheets(6, 6, 1)})[name]()
    hits = cg.intersections(*mesh)
    found = Enclosed(hits, vertex_areas(hits.vertices, hits.surface.faces))
    faces = hits.surface.faces
    assert len(found) > 0
    for region in range(len(found)):
        c, side, own = found.contour[region], found.side[region], set(found.vertices(region).tolist())
        across = {v for r in found.of_contour[c] if found.side[r] != side for v in found.vertices(r).tolist()}
        here = (hits.hit_contour == c) & ((side == 0.0) | (hits.hit_side == side))
        patch = {f for f, corners in enumerate(faces.tolist()) if across & set(corners)}
        patch |= set(hits.hit_face[here].tolist())
        enough = any if side == 0.0 else all
        patch = sorted(f for f in patch if not enough(v in own for v in faces[f].tolist()))
        vertices, nearest, weights, distance = found.nearest(region)
        if not patch:
            assert len(vertices) == 0
            continue
        assert vertices.tolist() == found.vertices(region).tolist()
        assert set(nearest.tolist()) <= set(patch)
        corners = hits.vertices[faces]
        reached = np.einsum("nk,nkc->nc", weights, corners[nearest])
        assert np.linalg.norm(reached - hits.vertices[vertices], axis=1) == pytest.approx(distance, abs=1e-12)
        for v, gap in zip(vertices, distance, strict=True):
            points = trimesh.triangles.closest_point(corners[patch], np.tile(hits.vertices[v], (len(patch), 1)))
            assert gap == pytest.approx(np.linalg.norm(points - hits.vertices[v], axis=1).min(), rel=1e-9, abs=1e-12)


def test_faces_around_every_vertex():
    surface = cg.Surface(meshes.seam_of_three(3, 0)[1], 60)
    start, ids = surface.faces_around
    for v in range(60):
        expected = [f for f, corners in enumerate(surface.faces.tolist()) if v in corners]
        assert ids[start[v] : start[v + 1]].tolist() == expected


@pytest.mark.parametrize("seed", range(4))
def test_the_other_surface_tells_when_more_than_half_went_through(seed):
    """A dent so deep that on its own, stretched, surface what went through is the larger part."""
    tangle = draw("Closed", 5.0, 16, seed)
    faces = np.concatenate([c.mesh.faces + n * len(tangle.clean) // 2 for n, c in enumerate(tangle.scene.cloths)])
    hits = cg.intersections(tangle.scene.start, faces)
    (contour,) = hits.contours
    shares = sorted(region.share for region in contour.regions)
    assert shares[0] < 0.45 and 0.48 < shares[1] < 0.52
    for rule in tangle.rules:
        wrong = set(rule.vertices[rule.misplaced].tolist())
        assert any(set(region.vertices.tolist()) == wrong for region in contour.regions)


def test_a_part_of_about_half_is_doubtful():
    vertices, faces = meshes.strip_through_plane(0.3, 0.0)
    (contour,) = cg.intersections(vertices, faces).contours
    (region,) = contour.regions
    assert region.doubtful == (region.share > 0.4)
    assert region.share > 0.4


@pytest.mark.parametrize("name", ["crossing_sheets-1", "crumple-2", "seam_of_three-1", "tangle-2"])
def test_contours_follow_relabelling_and_rigid_motion(name):
    mesh = meshes.GENERAL[name]()
    other, new_id, _ = meshes.relabelled(meshes.moved(mesh, meshes.rotation(3), (0.3, -0.2, 0.1)), 6)

    def told(given, ids):
        return Counter(
            (c.kind, c.ends, c.hit_count, c.crossings, round(c.length, 9), round(c.depth, 9),
             frozenset(frozenset(ids[r.vertices].tolist()) for r in c.regions))
            for c in cg.intersections(*given).contours
        )  # fmt: skip

    old_id = np.empty_like(new_id)
    old_id[new_id] = np.arange(len(new_id))
    assert told(mesh, np.arange(len(new_id))) == told(other, old_id)


def test_segments_that_meet_do_not_cross():
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    segments = np.array(
        [[[0.1, 0.1, 0], [0.4, 0.4, 0]], [[0.1, 0.4, 0], [0.4, 0.1, 0]], [[0.4, 0.4, 0], [0.5, 0.1, 0]]]
    )
    start, ids = np.array([0, 3]), np.arange(3)
    counts = np.zeros(3, np.int64)
    first, second = np.array([0, 2, 1]), np.array([1, 3, 4])
    kernels.count_crossings(x, np.array([[0, 1, 2]], np.int32), start, ids, segments, first, second, ids, counts)
    assert counts.tolist() == [1, 1, 0]


# ---------------------------------------------------------------------------------------------------------------
# identity in time


def test_contours_keep_their_number_while_they_move():
    """Two dents that move across a sheet, one of which goes away and comes again."""
    flat, faces = meshes.jittered(meshes.grid(24, 24), 1e-3, 0)
    tip = np.array([[0.0, -0.08, 0.0], [0.15, 0.3, 0.0], [-0.1, 0.3, 0.14], [-0.1, 0.3, -0.14]])
    tetrahedron = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    tracker, surface = ContourTracker(), None
    seen = []
    for step in range(12):
        here = np.array([0.25 + 0.011 * step, 0.0, 0.31]), np.array([0.7, 0.2 * (step in (5, 6)), 0.72 - 0.012 * step])
        mesh = meshes.merged((flat, faces), *((tip + place, tetrahedron) for place in here))
        surface = surface or cg.Surface(mesh[1])
        hits = cg.intersections(mesh[0], surface)
        assert [c.kind for c in hits.contours] == ["Closed"] * hits.contour_count
        numbers = tracker.follow(hits)
        assert len(numbers) == hits.contour_count == (1 if step in (5, 6) else 2)
        near = [int(np.argmin([np.linalg.norm(hits.points[hits.hit_contour == c].mean(axis=0) - p) for p in here]))
                for c in range(hits.contour_count)]  # fmt: skip
        seen.append({which: number for which, number in zip(near, numbers, strict=True)})
        assert tracker.ages(numbers).tolist() == [
            step if n == seen[0][0] else (step if step < 5 else step - 7) for n in numbers
        ]
    assert {s[0] for s in seen} == {seen[0][0]}
    assert len({s[1] for s in seen if 1 in s}) == 2
    assert tracker.lives() == {seen[0][1]: 5}


def test_a_tracker_starts_anew_for_another_surface():
    tracker = ContourTracker()
    one = tracker.follow(cg.intersections(*meshes.pyramid_poke(0.2)))
    two = tracker.follow(cg.intersections(*meshes.crossed_squares(0.3)))
    assert one.tolist() == [0] and two.tolist() == [1]
