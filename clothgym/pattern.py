"""Sewing patterns: flat panels, the seams between their edges and where the panels stand in space.

    pattern = Pattern.load("skirt")                 # of the package, or any file in GarmentCode's JSON format
    pattern.panel("front").outline(0.01)            # (N, 2) points along the border [m]
    pattern.scaled(1.05).save("larger.json")

The format [Korosteleva 2023] lists panels (vertices, edges with an optional curvature, a placement) and stitches of two
edges each. Here lengths are metres, in a file whatever `units_in_meter` says. The loop of a panel's edges tells its
outside: from there it runs counter-clockwise. It is never turned round.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray, IntArray, read_only

CURVES = {"line": 0, "quadratic": 2, "cubic": 4, "circle": 3}
"""Kinds of edges and how many parameters each has."""

_SAMPLES = 32
"""Chords that stand for a curved edge where crossings and areas are looked for."""
_FINE = 256
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(64)


@dataclass(frozen=True)
class Edge:
    """One side of a panel.

    Attributes:
        endpoints: ids of the panel's vertices where it starts and ends.
        kind: "line"; "quadratic" and "cubic" (Bezier curves); "circle" (an arc).
        params: quadratic (u, v) and cubic (u, v, u, v): control points start + u e + v perp, where e runs from start to
            end and perp is e turned left; circle (radius [m], large, right): `large` = 1 takes the longer arc, `right` = 1
            the one that bulges to the right of e.
        label: free text.
        extra: what else the file says of this edge.

    Raises:
        ValueError: names the field and the value.
    """

    endpoints: tuple[int, int]
    kind: str = "line"
    params: tuple[float, ...] = ()
    label: str = ""
    extra: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.kind not in CURVES:
            raise ValueError(f"curvature type {self.kind!r}: expected {', '.join(k for k in CURVES if k != 'line')}")
        if len(self.params) != CURVES[self.kind]:
            raise ValueError(f"{self.kind} params: expected {CURVES[self.kind]} numbers, got {len(self.params)}")
        if self.kind == "circle" and not (self.params[0] > 0.0 and set(self.params[1:]) <= {0, 1}):
            raise ValueError(f"circle params {self.params}: expected (radius > 0, large 0 or 1, right 0 or 1)")


@dataclass(frozen=True, eq=False)
class Panel:
    """A flat piece of cloth.

    Attributes:
        name: unique in its pattern.
        vertices: (N, 2) corners [m].
        edges: one closed loop, in the order in which it is run through.
        translation: [m] and
        rotation: (rx, ry, rz) [degree]: a point (x, y) stands at Rz Ry Rx (x, y, 0) + translation.
        label: free text.
        extra: what else the file says of this panel.

    Raises:
        ValueError: names panel, edge and value: an open or crossing outline, an edge without length, ...
    """

    name: str
    vertices: FloatArray
    edges: tuple[Edge, ...]
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    label: str = ""
    extra: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        where = f"panel {self.name!r}"
        vertices = np.array([numbers(v, 2, f"{where}: vertex {n}") for n, v in enumerate(self.vertices)]).reshape(-1, 2)
        object.__setattr__(self, "vertices", read_only(vertices))
        object.__setattr__(self, "edges", tuple(self.edges))
        for name in ("translation", "rotation"):
            object.__setattr__(self, name, numbers(getattr(self, name), 3, f"{where}: {name}"))
        _check_loop(self, where)
        _check_crossings(self, where)

    @property
    def rotation_matrix(self) -> FloatArray:
        """(3, 3) Rz Ry Rx."""
        (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians(self.rotation)), np.sin(np.radians(self.rotation))
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
        about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
        about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
        return about_z @ about_y @ about_x

    def placed(self, points: FloatArray) -> FloatArray:
        """(N, 2) points of the panel in space, (N, 3) [m]."""
        return points @ self.rotation_matrix[:, :2].T + np.asarray(self.translation)

    def curve(self, edge: int, t: FloatArray) -> FloatArray:
        """(T, 2) points of an edge at parameters t in [0, 1]; 0 and 1 give its ends exactly."""
        this = self.edges[edge]
        start, end = self.vertices[this.endpoints[0]], self.vertices[this.endpoints[1]]
        s = np.asarray(t, np.float64)[:, None]
        if this.kind == "circle":
            centre, radius, first, turn = self._arc(edge)
            angle = first + s * turn
            points = centre + radius * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
            points = np.where(s <= 0.0, start, np.where(s >= 1.0, end, points))
        else:
            control = [start, *self._controls(edge), end]
            while len(control) > 1:  # de Casteljau
                control = [(1.0 - s) * p + s * q for p, q in pairwise(control)]
            points = control[0]
        return points

    def length(self, edge: int) -> float:
        """Length of an edge [m]."""
        kind = self.edges[edge].kind
        if kind == "circle":
            _, radius, _, turn = self._arc(edge)
            return radius * abs(turn)
        start, end = (self.vertices[i] for i in self.edges[edge].endpoints)
        if kind == "line":
            return math.dist(start, end)
        control = np.array([start, *self._controls(edge), end])
        legs = list(np.diff(control, axis=0) * (len(control) - 1))
        s = 0.5 * (_GAUSS_NODES[:, None] + 1.0)
        while len(legs) > 1:
            legs = [(1.0 - s) * p + s * q for p, q in pairwise(legs)]
        return float(0.5 * _GAUSS_WEIGHTS @ np.linalg.norm(legs[0], axis=1))

    def sample(self, edge: int, count: int) -> FloatArray:
        """(count + 1, 2) points that cut an edge into `count` pieces of equal length, both ends included."""
        even = np.linspace(0.0, 1.0, count + 1)
        if self.edges[edge].kind in ("quadratic", "cubic"):
            t = np.linspace(0.0, 1.0, max(_FINE, 8 * count) + 1)
            reached = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.curve(edge, t), axis=0), axis=1))])
            even = np.interp(even * reached[-1], reached, t)
            even[-1] = 1.0
        return self.curve(edge, even)

    def outline(self, spacing: float) -> FloatArray:
        """(N, 2) points along the closed border, at most `spacing` [m] apart along it, in the order of the loop.

        Raises:
            ValueError: a spacing that is not positive.
        """
        if not spacing > 0.0:
            raise ValueError(f"spacing = {spacing!r}: expected a positive length in metres")
        counts = [max(1, math.ceil(self.length(k) / spacing - 1e-9)) for k in range(len(self.edges))]
        return np.concatenate([self.sample(k, count)[:-1] for k, count in enumerate(counts)])

    @cached_property
    def signed_area(self) -> float:
        """Area within the sampled outline [m^2], negative if the loop runs clockwise."""
        p = self._polyline()[0]
        q = np.roll(p, -1, axis=0)
        return float(0.5 * np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]))

    def _controls(self, edge: int) -> list[FloatArray]:
        this = self.edges[edge]
        start, end = self.vertices[this.endpoints[0]], self.vertices[this.endpoints[1]]
        e = end - start
        perp = np.array([-e[1], e[0]])
        return [start + u * e + v * perp for u, v in zip(this.params[0::2], this.params[1::2])]

    def _arc(self, edge: int) -> tuple[FloatArray, float, float, float]:
        """Centre, radius, angle of the start, angle turned through (positive = counter-clockwise)."""
        radius, large, right = self.edges[edge].params
        start, end = (self.vertices[i] for i in self.edges[edge].endpoints)
        e = end - start
        half = 0.5 * math.hypot(*e)
        radius = max(radius, half)  # rounded files
        left = np.array([-e[1], e[0]]) / (2.0 * half)
        side = 1.0 if bool(large) != bool(right) else -1.0
        centre = 0.5 * (start + end) + side * math.sqrt(max(radius * radius - half * half, 0.0)) * left
        turn = 2.0 * math.asin(min(1.0, half / radius))
        if large:
            turn = 2.0 * math.pi - turn
        first = math.atan2(start[1] - centre[1], start[0] - centre[0])
        return centre, radius, first, turn if right else -turn

    def _polyline(self) -> tuple[FloatArray, FloatArray]:
        """Points of the sampled outline, and the edge to which the chord from each belongs."""
        pieces, owner = [], []
        for k, edge in enumerate(self.edges):
            chords = 1 if edge.kind == "line" else _SAMPLES
            pieces.append(self.curve(k, np.linspace(0.0, 1.0, chords + 1))[:-1])
            owner += [k] * chords
        return np.concatenate(pieces), np.array(owner)


@dataclass(frozen=True)
class Seam:
    """Two edges that are sewn together.

    By default the second runs against the first, as the borders of two pieces with the same side out do. `right_wrong`:
    both run the same way, so that the outside of one meets the inside of the other.
    """

    panel_a: str
    edge_a: int
    panel_b: str
    edge_b: int
    right_wrong: bool = False

    def __str__(self) -> str:
        return f"{self.panel_a!r} edge {self.edge_a} to {self.panel_b!r} edge {self.edge_b}"


@dataclass(frozen=True, eq=False)
class Pattern:
    """Panels and seams of a garment.

    Attributes:
        name: of the garment.
        panels: in the order of the file's `panel_order`.
        seams: between edges of the panels.
        units_in_meter: unit of the file: 100 = centimetres; used when it is written.
        extra: what else the file says: {"document": ..., "pattern": ..., "properties": ...}.

    Raises:
        ValueError: names the seam: a panel or an edge that does not exist, an edge sewn twice or to itself.
    """

    name: str
    panels: tuple[Panel, ...]
    seams: tuple[Seam, ...] = ()
    units_in_meter: float = 100.0
    extra: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "panels", tuple(self.panels))
        object.__setattr__(self, "seams", tuple(self.seams))
        if not self.panels:
            raise ValueError("a pattern needs at least one panel")
        if not (math.isfinite(self.units_in_meter) and self.units_in_meter > 0.0):
            raise ValueError(f"units_in_meter = {self.units_in_meter!r}: expected a positive number")
        known = {panel.name: panel for panel in self.panels}
        if len(known) != len(self.panels):
            raise ValueError(f"panel names are not unique: {', '.join(panel.name for panel in self.panels)}")
        sewn: dict[tuple[str, int], int] = {}
        for n, seam in enumerate(self.seams):
            sides = ((seam.panel_a, seam.edge_a), (seam.panel_b, seam.edge_b))
            for name, edge in sides:
                if name not in known:
                    raise ValueError(f"stitch {n}: no panel {name!r}; there are {', '.join(known)}")
                if not 0 <= edge < len(known[name].edges):
                    raise ValueError(
                        f"stitch {n}: panel {name!r} has no edge {edge}, only 0 to {len(known[name].edges) - 1}"
                    )
            if sides[0] == sides[1]:
                raise ValueError(f"stitch {n}: panel {seam.panel_a!r}: edge {seam.edge_a} is sewn to itself")
            for name, edge in sides:
                if (name, edge) in sewn:
                    raise ValueError(
                        f"stitch {n}: panel {name!r}: edge {edge} is sewn already by stitch {sewn[name, edge]}"
                    )
                sewn[name, edge] = n

    def panel(self, name: str) -> Panel:
        """Raises ValueError: no such panel."""
        for panel in self.panels:
            if panel.name == name:
                return panel
        raise ValueError(f"panel = {name!r}: expected one of {', '.join(panel.name for panel in self.panels)}")

    def scaled(self, factor: float, placement: bool = True) -> Pattern:
        """Larger or smaller panels; with `placement` they also move away from the origin by the same factor.

        Raises:
            ValueError: a factor that is not positive.
        """
        if not (math.isfinite(factor) and factor > 0.0):
            raise ValueError(f"factor = {factor!r}: expected a positive number")
        return dataclasses.replace(
            self, panels=tuple(_scaled(p, factor, factor if placement else 1.0) for p in self.panels)
        )

    def moved(self, translation: Any) -> Pattern:
        """All panels moved by (x, y, z) [m].

        Raises:
            ValueError: not three finite numbers.
        """
        shift = numbers(translation, 3, "translation")
        panels = [
            dataclasses.replace(p, translation=tuple(a + b for a, b in zip(p.translation, shift))) for p in self.panels
        ]
        return dataclasses.replace(self, panels=tuple(panels))

    @staticmethod
    def load(source: str | os.PathLike[str]) -> Pattern:
        """A pattern of the package by its name (see `names`), or a file. Those that the package drafts have the female's
        sizes; `wardrobe.tailored` cuts them to any body.

        Raises:
            FileNotFoundError: neither.
            ValueError: names file, panel, edge and value.
        """
        if isinstance(source, str) and source in names() and source not in _files():
            from clothgym import body, wardrobe

            return wardrobe.tailored(source, body.load("female"))
        if isinstance(source, str) and source in _files():
            text = resources.files("clothgym").joinpath("assets", "patterns", f"{source}.json").read_text("utf-8")
            return Pattern.from_json(text, source)
        path = Path(source)
        if not path.exists():
            raise FileNotFoundError(2, f"no such pattern file, and none of {', '.join(names())}", str(path))
        try:
            text = path.read_text("utf-8")
        except UnicodeDecodeError:
            raise ValueError(f"{path}: not valid JSON: not a text file") from None
        return Pattern.from_json(text, path.stem.removesuffix("_specification"), str(path))

    @staticmethod
    def from_json(values: str | Mapping[str, Any], name: str = "pattern", source: str | None = None) -> Pattern:
        """Reads GarmentCode's JSON, as text or as the values it holds.

        Args:
            values: the document.
            name: of the pattern.
            source: what errors name, for example the file; default: the name.

        Raises:
            ValueError: names source, panel, edge and value.
        """
        from clothgym import garmentcode

        label = source or name
        if isinstance(values, str):
            try:
                values = json.loads(values)
            except ValueError as error:
                raise ValueError(f"{label}: not valid JSON: {error}") from None
        try:
            return garmentcode.read(values, name)
        except ValueError as error:
            raise ValueError(f"{label}: {error}") from None

    def to_json(self) -> dict[str, Any]:
        """The document in GarmentCode's format, in `units_in_meter`."""
        from clothgym import garmentcode

        return garmentcode.write(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the document."""
        Path(path).write_text(json.dumps(self.to_json(), indent=1) + "\n", "utf-8")


def names() -> tuple[str, ...]:
    """Patterns of the package."""
    from clothgym import wardrobe

    return tuple(sorted({*_files(), *wardrobe.NAMES}))


def _files() -> tuple[str, ...]:
    """Patterns that lie in the package as files."""
    folder = resources.files("clothgym").joinpath("assets", "patterns")
    return tuple(f.name.removesuffix(".json") for f in folder.iterdir() if f.name.endswith(".json"))


# Checks


def numbers(values: Any, count: int, where: str) -> tuple[Any, ...]:
    """So many finite numbers."""
    if not isinstance(values, list | tuple | np.ndarray) or len(values) != count:
        raise ValueError(f"{where}: expected {count} numbers, got {values!r}")
    for value in values:
        number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
        if not number or not math.isfinite(value):
            raise ValueError(f"{where}: {value!r} is no finite number")
    return tuple(float(value) for value in values)


def _check_loop(panel: Panel, where: str) -> None:
    """The edges run from vertex to vertex once around and each has a length."""
    if len(panel.edges) < 2:
        raise ValueError(f"{where}: {len(panel.edges)} edges do not enclose an area")
    visited: dict[int, int] = {}
    for k, edge in enumerate(panel.edges):
        for end in edge.endpoints:
            if not 0 <= end < len(panel.vertices):
                raise ValueError(f"{where}: edge {k}: no vertex {end}, only 0 to {len(panel.vertices) - 1}")
        after = (k + 1) % len(panel.edges)
        if edge.endpoints[1] != panel.edges[after].endpoints[0]:
            raise ValueError(
                f"{where}: the outline is open: edge {k} ends at vertex {edge.endpoints[1]}, "
                f"edge {after} starts at vertex {panel.edges[after].endpoints[0]}"
            )
        if edge.endpoints[0] in visited:
            first = visited[edge.endpoints[0]]
            raise ValueError(f"{where}: edges {first} and {k} both start at vertex {edge.endpoints[0]}")
        visited[edge.endpoints[0]] = k
        start, end = (panel.vertices[i] for i in edge.endpoints)
        chord = math.dist(start, end)
        if chord < 1e-9:
            raise ValueError(f"{where}: edge {k} has no length: it starts and ends at {start.tolist()}")
        if edge.kind == "circle" and edge.params[0] < 0.4995 * chord:
            raise ValueError(
                f"{where}: edge {k}: no circle of radius {edge.params[0]:g} m joins points {chord:g} m apart"
            )


def crossings(points: FloatArray) -> tuple[IntArray, IntArray]:
    """Pairs i < j of segments of a closed polygon (N, 2) that cross or touch; segment i runs from point i to the next,
    neighbours are left out."""
    p, q, count = points, np.roll(points, -1, axis=0), len(points)
    low, high = np.minimum(p, q), np.maximum(p, q)
    near = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2)
    i, j = np.nonzero(np.triu(near, 2))
    apart = (i > 0) | (j < count - 1)
    i, j = i[apart], j[apart]

    def side(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
        return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])

    meet = side(p[i], q[i], p[j]) * side(p[i], q[i], q[j]) <= 0.0
    meet &= side(p[j], q[j], p[i]) * side(p[j], q[j], q[i]) <= 0.0
    return i[meet].astype(np.int32), j[meet].astype(np.int32)


def _check_crossings(panel: Panel, where: str) -> None:
    """The sampled outline neither crosses nor touches itself, nor runs straight back."""
    points, owner = panel._polyline()
    along = np.roll(points, -1, axis=0) - points
    onwards = np.roll(along, -1, axis=0)
    turn = along[:, 0] * onwards[:, 1] - along[:, 1] * onwards[:, 0]
    size = np.linalg.norm(along, axis=1) * np.linalg.norm(onwards, axis=1)
    back = (np.abs(turn) <= 1e-9 * size) & ((along * onwards).sum(axis=1) < 0.0)
    if back.any():
        n = int(np.argmax(back))
        raise ValueError(
            f"{where}: the outline runs back on itself at edges {owner[n]} and {owner[(n + 1) % len(owner)]}"
        )
    i, j = crossings(points)
    if len(i):
        a, b = int(owner[i[0]]), int(owner[j[0]])
        pair = f"edge {a} crosses itself" if a == b else f"edges {a} and {b} cross"
        raise ValueError(f"{where}: the outline crosses itself: {pair}")


def _scaled(panel: Panel, factor: float, placement: float) -> Panel:
    edges = [
        dataclasses.replace(e, params=(e.params[0] * factor, *e.params[1:])) if e.kind == "circle" else e
        for e in panel.edges
    ]
    x, y, z = (t * placement for t in panel.translation)
    return dataclasses.replace(panel, vertices=panel.vertices * factor, edges=tuple(edges), translation=(x, y, z))
