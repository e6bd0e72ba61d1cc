"""Quad meshes of panels: counts, sides, orientation, springs across seams."""

from __future__ import annotations

import numpy as np
import pytest

import clothgym as cg
from clothgym import body as bodies
from clothgym import wardrobe
from clothgym.garment import assemble
from clothgym.mesh import Mesh
from clothgym.model import FLEXION, SHEAR, STRUCTURAL, ClothModel
from clothgym.pattern import Edge, Panel, Pattern, Seam
from clothgym.quad_mesh import mesh_quads, panel_sides

TABLE_2 = {
    "skirt": (12, 14, 336),
    "trousers": (10, 14, 560),
    "sleeveless_shirt": (16, 17, 544),
    "dress": (16, 32, 1024),
}
"""[Vassilev 2001, table 2]: columns, rows, vertices; the trousers' patches are 140 so that they make 560."""


def rectangle(name: str, width: float = 0.4, height: float = 0.3, back: bool = False) -> Panel:
    corners = [[0, 0], [width, 0], [width, height], [0, height]]
    if back:
        corners = [corners[k] for k in (0, 3, 2, 1)]
    edges = tuple(Edge((k, (k + 1) % 4)) for k in range(4))
    return Panel(name, np.array(corners), edges, (0.0, 0.0, -0.1 if back else 0.1))


def tube() -> Pattern:
    """Front and back sewn at both sides: edge 1 is the front's right side, edge 0 the back's left one."""
    return Pattern(
        "tube",
        (rectangle("front"), rectangle("back", back=True)),
        (Seam("front", 1, "back", 2), Seam("front", 3, "back", 0)),
    )


@pytest.mark.parametrize("name", TABLE_2)
@pytest.mark.parametrize("body", ["female", "male"])
def test_grids_of_the_paper(name, body):
    columns, rows, vertices = TABLE_2[name]
    pattern = wardrobe.tailored(name, bodies.load(body))
    garment = assemble(pattern, mesher="quads", grid=(columns, rows))
    assert sum(len(mesh.vertices) for mesh in garment.panel_meshes) == vertices
    for panel, mesh in zip(pattern.panels, garment.panel_meshes):
        assert len(mesh.quads) == (columns - 1) * (rows - 1)
        corners = mesh.vertices[mesh.faces]
        u, w = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = 0.5 * (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0])
        assert (np.sign(area) == np.sign(panel.signed_area)).all(), "all triangles look to the panel's outside"
        border = mesh.vertices[: mesh.border_count]
        x, y = border.T
        assert area.sum() == pytest.approx(0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum(), rel=1e-9)


def test_edges_of_a_side_get_pieces_by_their_shares():
    """The top of a dress, two shoulders and a neckline, is a side of the grid whatever its pieces' length."""
    pattern = wardrobe.tailored("dress", bodies.load("female"))
    for panel, mesh in zip(pattern.panels, mesh_quads(pattern, grid=(16, 32))):
        for side, pieces in zip(panel_sides(panel), (15, 31, 15, 31)):
            lengths = np.array([panel.length(k) for k in side])
            counts = np.array([len(mesh.edge_vertices[k]) - 1 for k in side])
            assert counts.sum() == pieces
            assert counts == pytest.approx(pieces * lengths / lengths.sum(), abs=1.5)


def test_border_is_that_of_the_panel_and_seams_have_equal_counts():
    pattern = wardrobe.tailored("dress", bodies.load("female"))
    meshes = dict(zip((p.name for p in pattern.panels), mesh_quads(pattern, 0.03)))
    for panel in pattern.panels:
        mesh = meshes[panel.name]
        for k, ids in enumerate(mesh.edge_vertices):
            assert mesh.vertices[ids] == pytest.approx(panel.sample(k, len(ids) - 1), abs=1e-12)
        sides = [sum(len(mesh.edge_vertices[k]) - 1 for k in side) for side in panel_sides(panel)]
        assert sides[0] == sides[2] and sides[1] == sides[3]
    for seam in pattern.seams:
        a = meshes[seam.panel_a].edge_vertices[seam.edge_a]
        b = meshes[seam.panel_b].edge_vertices[seam.edge_b]
        assert len(a) == len(b)


def test_springs_of_a_sewn_tube():
    """Structural springs are the sides of the quads, shear springs both diagonals, flexion springs skip one vertex, also
    across a seam; rest lengths are those of the flat panels."""
    garment = assemble(tube(), mesher="quads", grid=(5, 4))
    assert len(garment.vertices) == 2 * 20 - 8
    mesh = Mesh(np.array(garment.vertices), np.array(garment.faces), garment.quads)
    scene = cg.Scene((cg.Cloth(mesh, rest=garment.rest_corners),))
    model = ClothModel(scene, cg.Fidelity())
    kinds = {kind: model.spring_kinds == kind for kind in (STRUCTURAL, SHEAR, FLEXION)}
    around, up = 8, 3  # columns around the tube, rows of quads
    assert kinds[STRUCTURAL].sum() == around * (up + 1) + around * up
    assert kinds[SHEAR].sum() == 2 * around * up
    assert kinds[FLEXION].sum() == around * (up + 1) + around * (up - 1)
    width, height = 0.1, 0.1
    rest = {kind: np.unique(model.spring_rest[mask].round(9)) for kind, mask in kinds.items()}
    assert rest[STRUCTURAL] == pytest.approx([width])
    assert rest[SHEAR] == pytest.approx([np.hypot(width, height)])
    assert rest[FLEXION] == pytest.approx([2 * width])


def test_scene_with_quads_and_corners_survives_json():
    garment = assemble(tube(), mesher="quads", grid=(5, 4))
    mesh = Mesh(np.array(garment.vertices), np.array(garment.faces), garment.quads)
    scene = cg.Scene((cg.Cloth(mesh, rest=garment.rest_corners),))
    again = cg.Scene.from_json(scene.to_json())
    assert again == scene and np.array_equal(again.cloths[0].mesh.quads, garment.quads)


def test_corners_of_the_grid():
    pentagon = [[0, 0], [0.4, 0], [0.41, 0.2], [0.4, 0.4], [0, 0.4]]
    panel = Panel("p", np.array(pentagon), tuple(Edge((k, (k + 1) % 5)) for k in range(5)))
    assert panel_sides(panel) == ((0,), (1, 2), (3,), (4,)), "the slight bend is no corner"
    named = Panel("p", panel.vertices, panel.edges, extra={"grid_corners": [0, 2, 3, 4]})
    assert panel_sides(named) == ((0, 1), (2,), (3,), (4,))
    bad = Panel("p", panel.vertices, panel.edges, extra={"grid_corners": [0, 2, 9, 4]})
    with pytest.raises(ValueError, match=r"panel 'p': grid_corners = \[0, 2, 9, 4\]: expected four of its vertices"):
        panel_sides(bad)


def test_what_cannot_be_meshed_is_told():
    triangle = Panel("flag", np.array([[0, 0], [0.4, 0], [0, 0.3]]), tuple(Edge((k, (k + 1) % 3)) for k in range(3)))
    with pytest.raises(ValueError, match="panel 'flag': 3 edges: quads need 4 to 40"):
        mesh_quads(Pattern("p", (triangle,)))
    square = rectangle("p", 0.3, 0.3)
    turned = Pattern("p", (square, rectangle("q", 0.3, 0.3)), (Seam("p", 0, "q", 1),))
    with pytest.raises(ValueError, match=r"no numbers of rows and columns fit all of its seams \(grid = \(5, 4\)\)"):
        mesh_quads(turned, 0.05, (5, 4))
    assert len(mesh_quads(turned, 0.05)) == 2
    with pytest.raises(ValueError, match="grid: rows = 1"):
        mesh_quads(turned, 0.05, (5, 1))
    with pytest.raises(ValueError, match="mesher = 'hexagons'"):
        assemble(turned, mesher="hexagons")
    with pytest.raises(ValueError, match="works with mesher 'quads' only"):
        assemble(turned, grid=(4, 4))
