"""The file format of patterns: GarmentCode's JSON [Korosteleva 2023], read and written.

`pattern.panels` by name (vertices, edges with an optional curvature, translation, rotation), `pattern.stitches` of two
edges each, `properties` with units. What else a file says is kept and written again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from clothgym.pattern import CURVES, Edge, Panel, Pattern, Seam, numbers


def _mapping(values: Any, where: str, *required: str) -> dict[str, Any]:
    if not isinstance(values, Mapping):
        raise ValueError(f"{where}: expected an object, got {type(values).__name__}")
    for name in required:
        if name not in values:
            raise ValueError(f"{where}: {name} is missing")
    return dict(values)


def _listed(values: Any, where: str) -> list[Any]:
    if not isinstance(values, list | tuple):
        raise ValueError(f"{where}: expected a list, got {type(values).__name__}")
    return list(values)


def _index(value: Any, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{where}: {value!r} is no index")
    return value


def read(values: Any, name: str) -> Pattern:
    """A pattern from a document.

    Raises:
        ValueError: names panel, edge and value.
    """
    document = _mapping(values, "not a pattern", "pattern", "properties")
    pattern = _mapping(document.pop("pattern"), "pattern", "panels")
    properties = _mapping(document.pop("properties"), "properties", "units_in_meter")
    units = numbers([properties.pop("units_in_meter")], 1, "properties: units_in_meter")[0]
    if units <= 0.0:
        raise ValueError(f"properties: units_in_meter = {units:g}: expected a positive number")
    coordinates = properties.pop("curvature_coords", "relative")
    if coordinates not in ("relative", "absolute"):
        raise ValueError(f"properties: curvature_coords = {coordinates!r}: expected relative, absolute")
    given = _mapping(pattern.pop("panels"), "panels")
    order = _listed(pattern.pop("panel_order", []), "panel_order")
    for panel in order:
        if panel not in given:
            raise ValueError(f"panel_order: no panel {panel!r}; there are {', '.join(given)}")
    ordered = list(dict.fromkeys([*order, *given]))
    panels = [_read_panel(panel, given[panel], units, coordinates == "absolute") for panel in ordered]
    seams = [_read_stitch(n, s) for n, s in enumerate(_listed(pattern.pop("stitches", []), "stitches"))]
    extra = {"document": document, "pattern": pattern, "properties": properties}
    return Pattern(name, tuple(panels), tuple(seams), units, extra)


def _read_panel(name: str, values: Any, units: float, absolute: bool) -> Panel:
    where = f"panel {name!r}"
    rest = _mapping(values, where, "vertices", "edges", "translation", "rotation")
    corners = [numbers(v, 2, f"{where}: vertex {n}") for n, v in enumerate(_listed(rest.pop("vertices"), where))]
    translation = numbers(rest.pop("translation"), 3, f"{where}: translation")
    edges = []
    for k, edge in enumerate(_listed(rest.pop("edges"), where)):
        try:
            edges.append(_read_edge(edge, corners, units, absolute))
        except ValueError as error:
            raise ValueError(f"{where}: edge {k}: {error}") from None
    place = tuple(t / units for t in translation)
    vertices = np.array(corners, np.float64).reshape(-1, 2) / units
    rotation = numbers(rest.pop("rotation"), 3, f"{where}: rotation")
    return Panel(name, vertices, tuple(edges), place, rotation, str(rest.pop("label", "")), rest)


def _read_edge(values: Any, corners: list[tuple[float, ...]], units: float, absolute: bool) -> Edge:
    rest = _mapping(values, "not an edge", "endpoints")
    ends = _listed(rest.pop("endpoints"), "endpoints")
    if len(ends) != 2:
        raise ValueError(f"endpoints: expected 2 vertex ids, got {ends!r}")
    i, j = (_index(end, "endpoints") for end in ends)
    label = str(rest.pop("label", ""))
    curvature = rest.pop("curvature", None)
    if curvature is None:
        return Edge((i, j), label=label, extra=rest)
    if isinstance(curvature, list | tuple):
        kind, given = "quadratic", [curvature]  # patterns of 2021
    else:
        curvature = _mapping(curvature, "curvature", "type", "params")
        kind, given = curvature["type"], _listed(curvature["params"], "curvature params")
    if kind == "circle":
        given = [int(v) if isinstance(v, bool) else v for v in given]
        radius, large, right = numbers(given, 3, "circle params")
        return Edge((i, j), "circle", (radius / units, large, right), label, rest)
    points = [numbers(point, 2, f"{kind} params") for point in given] if kind in CURVES else []
    if absolute and 0 <= i < len(corners) and 0 <= j < len(corners):
        points = [_relative(point, corners[i], corners[j]) for point in points]
    return Edge((i, j), str(kind), tuple(value for point in points for value in point), label, rest)


def _relative(point: tuple[float, ...], start: tuple[float, ...], end: tuple[float, ...]) -> tuple[float, float]:
    """A control point in the frame of its edge."""
    ex, ey, px, py = end[0] - start[0], end[1] - start[1], point[0] - start[0], point[1] - start[1]
    square = ex * ex + ey * ey or 1.0  # an edge without length is reported by the panel
    return (px * ex + py * ey) / square, (py * ex - px * ey) / square


def _read_stitch(n: int, values: Any) -> Seam:
    where = f"stitch {n}"
    parts = _listed(values, where)
    if len(parts) not in (2, 3):
        raise ValueError(f"{where}: expected two edges, got {len(parts)} entries")
    if len(parts) == 3 and parts[2] != "right_wrong":
        raise ValueError(f"{where}: {parts[2]!r}: expected right_wrong")
    sides = [_mapping(part, where, "panel", "edge") for part in parts[:2]]
    (panel_a, edge_a), (panel_b, edge_b) = ((str(s["panel"]), _index(s["edge"], f"{where}: edge")) for s in sides)
    return Seam(panel_a, edge_a, panel_b, edge_b, len(parts) == 3)


def write(garment: Pattern) -> dict[str, Any]:
    """The document of a pattern, in its `units_in_meter`."""
    extra = {key: dict(garment.extra.get(key, {})) for key in ("document", "pattern", "properties")}
    stitches: list[list[Any]] = []
    for seam in garment.seams:
        sides = [{"panel": seam.panel_a, "edge": seam.edge_a}, {"panel": seam.panel_b, "edge": seam.edge_b}]
        stitches.append([*sides, "right_wrong"] if seam.right_wrong else list(sides))
    pattern = {
        "panels": {panel.name: _panel(panel, garment.units_in_meter) for panel in garment.panels},
        "stitches": stitches,
        "panel_order": [panel.name for panel in garment.panels],
    }
    defaults = {"normalize_panel_translation": False, "normalized_edge_loops": True}
    properties = {**defaults, "curvature_coords": "relative", "units_in_meter": garment.units_in_meter}
    return {
        "pattern": {**pattern, **extra["pattern"]},
        "parameters": {},
        "parameter_order": [],
        **extra["document"],
        "properties": {**properties, **extra["properties"]},
    }


def _panel(panel: Panel, units: float) -> dict[str, Any]:
    def in_units(values: Any) -> list[float]:
        return [float(f"{value * units:.13g}") for value in values]  # 0.1 cm stays 0.1

    edges = []
    for edge in panel.edges:
        values: dict[str, Any] = {"endpoints": list(edge.endpoints)}
        if edge.kind == "circle":
            params: list[Any] = [in_units(edge.params[:1])[0], *(int(flag) for flag in edge.params[1:])]
            values["curvature"] = {"type": "circle", "params": params}
        elif edge.kind != "line":
            pairs = [list(pair) for pair in zip(edge.params[0::2], edge.params[1::2])]
            values["curvature"] = {"type": edge.kind, "params": pairs}
        edges.append({**values, **({"label": edge.label} if edge.label else {}), **edge.extra})
    return {
        "translation": in_units(panel.translation),
        "rotation": list(panel.rotation),
        "vertices": [in_units(vertex) for vertex in panel.vertices],
        "edges": edges,
        **({"label": panel.label} if panel.label else {}),
        **panel.extra,
    }
