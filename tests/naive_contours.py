"""What contours are, spelled out: regions by face flood fill, crossings by points where three faces meet, sides by trying all.

Reads the exact intersections of `naive.exact_intersections`; nothing here imports the library.
"""

from __future__ import annotations

from itertools import combinations

import naive
import networkx as nx
import numpy as np


def members(exact: naive.Exact) -> list[list[int]]:
    """Hits of each contour, in order of their first hit."""
    label = naive.exact_contours(exact)
    return [[h for h, c in enumerate(label) if c == contour] for contour in range(max(label, default=-1) + 1)]


def sides(exact: naive.Exact, contour: list[int]) -> dict[int, int] | None:
    """+1 or -1 for each hit of a contour, +1 for the first; None where the sides contradict each other.

    Colours the graph whose nodes are hits: two hits of a pair whose edges belong to the same face are alike, else different.
    """
    relation: dict[int, list[tuple[int, int]]] = {h: [] for h in contour}
    for hits in exact.pairs.values():
        if len(hits) == 2 and hits[0] in relation:
            same = exact.hits[hits[0]][2] == exact.hits[hits[1]][2]
            relation[hits[0]].append((hits[1], 1 if same else -1))
            relation[hits[1]].append((hits[0], 1 if same else -1))
    colour = {contour[0]: 1}
    todo = [contour[0]]
    while todo:
        here = todo.pop()
        for other, factor in relation[here]:
            if other not in colour:
                colour[other] = factor * colour[here]
                todo.append(other)
            elif colour[other] != factor * colour[here]:
                return None
    return colour


def loops(exact: naive.Exact, contour: list[int]) -> list[int]:
    """Loop vertices at which a contour ends."""
    found = []
    for pair, hits in exact.pairs.items():
        if len(hits) == 1 and hits[0] in contour:
            found += naive.shared_vertices(exact, pair)
    return found


def kind(exact: naive.Exact, contour: list[int], crossings: int) -> str:
    """The name of a contour by its definition."""
    degree = {h: len(exact.incident[exact.hits[h][:2]]) for h in contour}
    if max(degree.values()) > 2:
        return "branched"
    colour = sides(exact, contour)
    if colour is None:
        return "Eight"
    if crossings:
        return "Cross"
    borders = [h for h in contour if degree[h] == 1]
    ends = (len(borders), len(loops(exact, contour)))
    if ends == (2, 0):
        return "BBII" if colour[borders[0]] == colour[borders[1]] else "BIBI"
    return {(0, 0): "Closed", (0, 2): "LL", (1, 1): "BLI"}.get(ends, "Open")


def regions(exact: naive.Exact, contour: list[int], areas: np.ndarray) -> set[tuple[int, frozenset[int]]]:
    """(side, vertices) of what a contour cuts off: parts of the graph of edges that it crosses an even number of times.

    Side by side, or both together (0) without the loop vertices that the contour ends at; of two parts that an edge of the
    contour joins, the one of smaller area.
    """
    colour = sides(exact, contour)
    if colour is None:
        return set()
    ends = set(loops(exact, contour))
    found, parted = set(), {}
    for side in (0,) if ends else (1, -1):
        here = [h for h in contour if side == 0 or colour[h] == side]
        crossed = [exact.hits[h][:2] for h in here]
        cut = {edge for edge in crossed if crossed.count(edge) % 2}
        graph = nx.Graph(edge for edge in exact.incident if edge not in cut)
        graph.add_nodes_from({v for edge in exact.incident for v in edge})
        graph.remove_nodes_from(ends)
        for edge in cut:
            if ends & set(edge):
                continue
            parts = [frozenset(nx.node_connected_component(graph, v)) for v in edge]
            if parts[0] != parts[1]:
                found.add((side, min(parts, key=lambda part: areas[list(part)].sum())))
                parted[side] = parts
    if {side for side, _ in found} == {1, -1} and len(found) == 2:
        return _agreeing(exact, contour, colour, found, parted, areas)
    return found


def _agreeing(exact: naive.Exact, contour, colour, found, parted, areas) -> set[tuple[int, frozenset[int]]]:
    """Both regions of a contour, or, where they push their surfaces the same way instead of apart, the one of smaller share and
    the other part of the surface of the other."""
    push = np.zeros(3), np.zeros(3)
    share = {}
    for side, part in found:
        whole = set().union(*parted[side])
        share[side] = areas[list(part)].sum() / areas[list(whole)].sum()
        for h in contour:
            e0, e1, face = exact.hits[h]
            if colour[h] == side and (e0 in part) != (e1 in part):
                a, b, c = exact.vertices[exact.faces[face]]
                normal = np.cross(b - a, c - a)
                way = (exact.vertices[e1] - exact.vertices[e0]) * (1 if e0 in part else -1)
                push[side > 0][:] += side * np.sign(normal @ way) * normal / np.linalg.norm(normal)
    if push[0] @ push[1] >= 0:
        return found
    wrong = max(share, key=lambda side: share[side])
    other = {s: next(p for p in parted[s] if (s, p) not in found) for s in (wrong,)}
    return {(side, other.get(side, part)) for side, part in found}


def triple_points(exact: naive.Exact) -> list[tuple[int, int, int]]:
    """Triples of faces, each two of which intersect, whose planes meet in one point inside all three."""
    graph = nx.Graph(list(exact.pairs))
    found = []
    for a, b in exact.pairs:
        for c in sorted(set(graph[a]) & set(graph[b])):
            if c <= b:
                continue
            corners = [exact.vertices[exact.faces[f]] for f in (a, b, c)]
            normals = np.array([np.cross(x[1] - x[0], x[2] - x[0]) for x in corners])
            if abs(np.linalg.det(normals)) < 1e-12:
                continue
            point = np.linalg.solve(normals, [n @ x[0] for n, x in zip(normals, corners)])
            if all(_inside(point, x) for x in corners):
                found.append((a, b, c))
    return found


def _inside(point: np.ndarray, corners: np.ndarray) -> bool:
    """Whether a point of a triangle's plane lies inside it, by its weights."""
    weights = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), np.r_[point, 1.0], rcond=None)[0]
    return bool((weights > 1e-9).all())


def crossings(exact: naive.Exact) -> list[int]:
    """How often contours cross each contour, counted on every surface: at a triple point each two of its three segments cross,
    on the face that they share."""
    label = naive.exact_contours(exact)
    counts = [0] * (max(label, default=-1) + 1)
    for triple in triple_points(exact):
        of_pair = {pair: label[exact.pairs[pair][0]] for pair in combinations(triple, 2)}
        for one, two in combinations(of_pair, 2):
            for contour in {of_pair[one], of_pair[two]}:
                counts[contour] += 1
    return counts
