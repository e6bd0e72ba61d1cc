"""Garments: a pattern's panels meshed, placed in space and welded along their seams.

    garment = assemble(Pattern.load("skirt"), edge_length=0.02)
    garment.vertices, garment.faces      # the start of sewing: seams closed, cloth beside them stretched
    garment.rest_corners                 # what each triangle is when it is flat

Welding comes before sewing: every vertex of a seam stands in the middle of its places in the panels.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from clothgym.arrays import FloatArray, IntArray, check_choice, check_number, read_only
from clothgym.panel_mesh import PanelMesh, edge_counts, split_edges, triangulate
from clothgym.pattern import Pattern, Seam
from clothgym.quad_mesh import mesh_quads

MESHERS = ("triangles", "quads")

_HALVINGS = 6
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Garment:
    """The sewn mesh of a pattern. All arrays are read-only.

    Attributes:
        name: of the pattern.
        vertices: (V, 3) the placed panels, seam vertices at the mean of their places [m].
        faces: (F, 3) counter-clockwise seen from the outside of their panel.
        rest_corners: (F, 3, 2) corners of each face in its own panel's coordinates [m], in the order of the face. In a
            panel whose loop runs clockwise (a back) they run clockwise too.
        panel_of_face: (F,) number of the panel.
        panel_names: names of the panels.
        seam_edges: (S, 2) edges of the mesh on seams.
        seam_of_edge: (S,) number of the pattern's seam.
        seam_vertices: ids of the vertices on seams, sorted.
        openings: border loops (vertex ids, the way the faces there run), from top to bottom, then from +x to -x.
        panel_meshes: the flat meshes.
        panel_vertices: for each panel the (N, 3) placed vertices before welding [m].
        welded: for each panel the (N,) vertices of the garment that its vertices became.
        seam_gap: largest distance that welding closed [m].
        quads: (Q, 4) of a garment meshed with quads, else None.
    """

    name: str
    vertices: FloatArray
    faces: IntArray
    rest_corners: FloatArray
    panel_of_face: IntArray
    panel_names: tuple[str, ...]
    seam_edges: IntArray
    seam_of_edge: IntArray
    seam_vertices: IntArray
    openings: tuple[IntArray, ...]
    panel_meshes: tuple[PanelMesh, ...]
    panel_vertices: tuple[FloatArray, ...]
    welded: tuple[IntArray, ...]
    seam_gap: float
    quads: IntArray | None = None

    def moved(self, shift: tuple[float, float, float]) -> Garment:
        """The same garment placed elsewhere [m]."""
        way = np.asarray(shift, float)
        return dataclasses.replace(
            self,
            vertices=read_only(self.vertices + way),
            panel_vertices=tuple(read_only(place + way) for place in self.panel_vertices),
        )


def assemble(
    pattern: Pattern, edge_length: float = 0.02, mesher: str = "triangles", grid: tuple[int, int] | None = None
) -> Garment:
    """Meshes all panels, places them and welds their seams.

    Both edges of a seam get the same number of vertices, whatever their lengths. Corners where seams meet become one
    vertex, through any number of seams.

    Args:
        pattern: what to sew.
        edge_length: wanted length of the edges [m].
        mesher: "triangles", or "quads": a grid in each panel, as [Vassilev 2001] has it.
        grid: (columns, rows) of vertices of every panel, with quads only; default: as the length asks for.

    Raises:
        ValueError: an edge length out of range, an unknown mesher; names the panel that cannot be meshed, or the seam that
            would fold a triangle onto an edge or join three panels along one.
    """
    check_number(edge_length, "edge_length", 1e-4, 10.0)
    check_choice(mesher, "mesher", MESHERS)
    if grid is not None and mesher != "quads":
        raise ValueError(f"grid = {grid}: works with mesher 'quads' only")
    meshes = _meshes(pattern, edge_length) if mesher == "triangles" else mesh_quads(pattern, edge_length, grid)
    welded, count = _weld(pattern, meshes)
    for _ in range(_ROUNDS if mesher == "triangles" else 0):
        clashes = _clashes(meshes, welded, count)
        if not clashes:
            break
        meshes = [split_edges(mesh, clashes[n]) if n in clashes else mesh for n, mesh in enumerate(meshes)]
        welded, count = _weld(pattern, meshes)
    faces = np.concatenate([ids[mesh.faces] for mesh, ids in zip(meshes, welded)])
    seam_edges, seam_of_edge = _seam_edges(pattern, meshes, welded)
    _check_welded(pattern, edge_length, faces, count, seam_edges, seam_of_edge)
    places = [panel.placed(mesh.vertices) for panel, mesh in zip(pattern.panels, meshes)]
    ids, stacked = np.concatenate(welded), np.concatenate(places)
    copies = np.bincount(ids, minlength=count)
    vertices = np.column_stack([np.bincount(ids, stacked[:, k], minlength=count) for k in range(3)]) / copies[:, None]
    gap = 0.0
    for seam in pattern.seams:
        (na, a), (nb, b) = _sides(pattern, meshes, seam)
        gap = max(gap, float(np.linalg.norm(places[na][a] - places[nb][b], axis=1).max()))
    return Garment(
        name=pattern.name,
        vertices=read_only(vertices),
        faces=read_only(np.ascontiguousarray(faces, np.int32)),
        rest_corners=read_only(np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])),
        panel_of_face=read_only(np.repeat(np.arange(len(meshes)), [len(m.faces) for m in meshes]).astype(np.int32)),
        panel_names=tuple(panel.name for panel in pattern.panels),
        seam_edges=read_only(seam_edges),
        seam_of_edge=read_only(seam_of_edge),
        seam_vertices=read_only(np.unique(seam_edges).astype(np.int32)),
        openings=_openings(faces, vertices),
        panel_meshes=tuple(meshes),
        panel_vertices=tuple(read_only(place) for place in places),
        welded=tuple(read_only(ids) for ids in welded),
        seam_gap=gap,
        quads=_welded_quads(meshes, welded),
    )


def _welded_quads(meshes: Sequence[PanelMesh], welded: Sequence[IntArray]) -> IntArray | None:
    quads = [ids[mesh.quads] for mesh, ids in zip(meshes, welded) if mesh.quads is not None]
    return read_only(np.ascontiguousarray(np.concatenate(quads), np.int32)) if quads else None


def _numbers(pattern: Pattern) -> dict[str, int]:
    return {panel.name: n for n, panel in enumerate(pattern.panels)}


def _meshes(pattern: Pattern, h: float) -> list[PanelMesh]:
    """Meshes whose seams have equal counts on both sides; what a panel needs finer its partner gets finer too."""
    number = _numbers(pattern)
    counts = [edge_counts(panel, h) for panel in pattern.panels]
    partner: dict[tuple[int, int], tuple[int, int]] = {}
    for seam in pattern.seams:
        a, b = (number[seam.panel_a], seam.edge_a), (number[seam.panel_b], seam.edge_b)
        mean = 0.5 * (pattern.panels[a[0]].length(a[1]) + pattern.panels[b[0]].length(b[1]))
        counts[a[0]][a[1]] = counts[b[0]][b[1]] = max(1, round(mean / h))
        partner[a], partner[b] = b, a
    meshes: list[PanelMesh | None] = [None] * len(counts)
    for _ in range(_HALVINGS):
        wanted: set[tuple[int, int]] = set()
        for n, panel in enumerate(pattern.panels):
            if meshes[n] is None:
                meshes[n], lost = triangulate(panel, counts[n], h)
                wanted |= {(n, k) for k in lost}
        wanted |= {partner[key] for key in wanted if key in partner}
        for n, k in sorted(wanted):
            counts[n][k] *= 2
            meshes[n] = None
        done = [mesh for mesh in meshes if mesh is not None]
        if len(done) == len(meshes):
            return done
    n, k = min(wanted)
    raise ValueError(f"panel {pattern.panels[n].name!r}: edge {k} cannot be meshed with edges of {h:g} m")


def _sides(pattern: Pattern, meshes: Sequence[PanelMesh], seam: Seam) -> tuple[tuple[int, IntArray], ...]:
    """Panel number and vertex ids of both sides of a seam, paired."""
    number = _numbers(pattern)
    a, b = number[seam.panel_a], number[seam.panel_b]
    second = meshes[b].edge_vertices[seam.edge_b]
    return (a, meshes[a].edge_vertices[seam.edge_a]), (b, second if seam.right_wrong else second[::-1])


def _weld(pattern: Pattern, meshes: Sequence[PanelMesh]) -> tuple[list[IntArray], int]:
    """For each panel the ids (N,) of its vertices in the garment, and how many there are."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    first, second = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for seam in pattern.seams:
        (na, a), (nb, b) = _sides(pattern, meshes, seam)
        first.append(a + offsets[na])
        second.append(b + offsets[nb])
    rows, columns = np.concatenate(first), np.concatenate(second)
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(offsets[-1], offsets[-1]))
    count, component = connected_components(graph, directed=False)
    _, appears = np.unique(component, return_index=True)
    rank = np.empty(count, np.int32)
    rank[component[np.sort(appears)]] = np.arange(count, dtype=np.int32)  # numbered as they first appear
    ids = rank[component]
    return [ids[a:b] for a, b in pairwise(offsets)], int(count)


def _edge_keys(pairs: IntArray, count: int) -> IntArray:
    wide = np.asarray(pairs, np.int64)
    return wide.min(axis=-1) * count + wide.max(axis=-1)


def _clashes(
    meshes: Sequence[PanelMesh], welded: Sequence[IntArray], count: int
) -> dict[int, dict[tuple[int, int], int]]:
    """For each panel the inner edges that welding would lay onto another edge or close to a loop, and how many vertices
    on each prevent it.

    Most are chords that cut off a corner: its sides are sewn to each other, or both to a panel with such a chord too.
    """
    edges = [np.unique(np.sort(m.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0) for m in meshes]
    border = []
    for mesh, pairs in zip(meshes, edges):
        n = mesh.border_count
        step = pairs[:, 1] - pairs[:, 0]
        border.append((pairs[:, 1] < n) & ((step == 1) | ((pairs[:, 0] == 0) & (pairs[:, 1] == n - 1))))
    ends = [ids[pairs] for ids, pairs in zip(welded, edges)]
    keys = [_edge_keys(pair, count) for pair in ends]
    inner = np.concatenate([k[~on] for k, on in zip(keys, border)])
    outer = np.unique(np.concatenate([k[on] for k, on in zip(keys, border)]))  # both copies of a seam's edge are one
    unique, times = np.unique(np.concatenate([inner, outer]), return_counts=True)
    found = {}
    for n, (pairs, on, pair, key) in enumerate(zip(edges, border, ends, keys)):
        loop = pair[:, 0] == pair[:, 1]
        clash = ~on & (np.isin(key, unique[times > 1]) | loop)
        if clash.any():
            found[n] = {(int(a), int(b)): 2 if closed else 1 for (a, b), closed in zip(pairs[clash], loop[clash])}
    return found


def _seam_edges(pattern: Pattern, meshes: Sequence[PanelMesh], welded: Sequence[IntArray]) -> tuple[IntArray, IntArray]:
    """(S, 2) edges on seams and (S,) the number of the seam."""
    pairs, owner = [np.zeros((0, 2), np.int32)], [np.zeros(0, np.int32)]
    for number, seam in enumerate(pattern.seams):
        (panel, ids), _ = _sides(pattern, meshes, seam)
        line = welded[panel][ids]
        pairs.append(np.sort(np.column_stack([line[:-1], line[1:]]), axis=1).astype(np.int32))
        owner.append(np.full(len(line) - 1, number, np.int32))
    return np.concatenate(pairs), np.concatenate(owner)


def _check_welded(
    pattern: Pattern, h: float, faces: IntArray, count: int, seam_edges: IntArray, seam_of_edge: IntArray
) -> None:
    """No edge of the welded mesh has lost its length or has three faces, no two faces are the same."""
    closed = seam_edges[:, 0] == seam_edges[:, 1]
    keys, times = np.unique(_edge_keys(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), count), return_counts=True)
    crowded = np.isin(_edge_keys(seam_edges, count), keys[times > 2])
    for wrong, what in ((closed, "joins both ends of an edge"), (crowded, "brings more than two faces to one edge")):
        if wrong.any():
            seam = int(seam_of_edge[np.argmax(wrong)])
            raise ValueError(f"stitch {seam}: sewing {pattern.seams[seam]} {what} of the mesh (edge_length = {h:g})")
    corners = np.sort(faces, axis=1)
    flat = (corners[:, 1:] == corners[:, :-1]).any(axis=1)
    if flat.any() or (times > 2).any() or len(np.unique(corners, axis=0)) < len(corners):
        raise ValueError(
            f"edge_length = {h:g}: too long for pattern {pattern.name!r}: sewing folds faces onto each other"
        )


def _openings(faces: IntArray, vertices: FloatArray) -> tuple[IntArray, ...]:
    """Border loops. Where two borders touch in a vertex, each goes on along its own fan of faces."""
    at_edge: dict[tuple[int, int], list[int]] = {}
    for f, (a, b, c) in enumerate(faces.tolist()):
        for u, v in ((a, b), (b, c), (c, a)):
            at_edge.setdefault((min(u, v), max(u, v)), []).append(f)
    open_edges = {key for key, around in at_edge.items() if len(around) == 1}
    corners = faces.tolist()
    loops = []
    while open_edges:
        key = min(open_edges)
        face = corners[at_edge[key][0]]
        a, b = key if face[(face.index(key[0]) + 1) % 3] == key[1] else key[::-1]
        loop = []
        while (min(a, b), max(a, b)) in open_edges:
            open_edges.discard((min(a, b), max(a, b)))
            loop.append(a)
            f, previous = at_edge[min(a, b), max(a, b)][0], a
            while True:  # around b, from face to face, to the next edge of the border
                (other,) = set(corners[f]) - {previous, b}
                around = at_edge[min(b, other), max(b, other)]
                if len(around) == 1:
                    break
                f, previous = around[1] if around[0] == f else around[0], other
            a, b = b, other
        start = loop.index(min(loop))
        loops.append(np.array(loop[start:] + loop[:start], np.int32))
    centres = [np.round(vertices[loop].mean(axis=0), 3) + 0.0 for loop in loops]
    order = sorted(range(len(loops)), key=lambda n: (-centres[n][1], -centres[n][0], int(loops[n][0])))
    return tuple(read_only(loops[n]) for n in order)
