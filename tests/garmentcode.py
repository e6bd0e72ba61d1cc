"""Pattern files in GarmentCode's JSON format, as other programs write them."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

FOREIGN = Path(os.environ.get("CLOTHGYM_FOREIGN_PATTERNS", Path(__file__).parents[2] / "shared" / "data" / "patterns"))
"""Patterns of the GarmentCode project; they are not part of this one."""


def foreign(name: str) -> Path:
    """A pattern file of the GarmentCode project; the test is skipped where there is none."""
    path = FOREIGN / f"{name}_specification.json"
    if not path.exists():
        pytest.skip(f"{path} is not here; set CLOTHGYM_FOREIGN_PATTERNS")
    return path


def panel(vertices: list[list[float]], curvature: dict[int, Any] | None = None, **fields: Any) -> dict[str, Any]:
    """A panel whose edges join the vertices in turn; some of them curved."""
    count = len(vertices)
    edges: list[dict[str, Any]] = [{"endpoints": [k, (k + 1) % count]} for k in range(count)]
    for k, value in (curvature or {}).items():
        edges[k]["curvature"] = value
    return {"translation": [0, 0, 0], "rotation": [0, 0, 0], "vertices": vertices, "edges": edges, **fields}


def rectangle(width: float, height: float, clockwise: bool = False, **fields: Any) -> dict[str, Any]:
    """Edges: 0 bottom, 1 right, 2 top, 3 left; clockwise: 0 bottom, 1 left, 2 top, 3 right."""
    w, h = 0.5 * width, 0.5 * height
    corners = [[-w, -h], [w, -h], [w, h], [-w, h]]
    return panel([[-x, y] for x, y in corners] if clockwise else corners, **fields)


def stitch(a: str, i: int, b: str, j: int, *more: str) -> list[Any]:
    return [{"panel": a, "edge": i}, {"panel": b, "edge": j}, *more]


def document(panels: dict[str, Any], stitches: list[Any] | None = None, **properties: Any) -> dict[str, Any]:
    """A whole file, in centimetres unless told otherwise; properties set to None are left out."""
    given = {"curvature_coords": "relative", "units_in_meter": 100, **properties}
    return {
        "pattern": {"panels": panels, "stitches": stitches or []},
        "parameters": {},
        "parameter_order": [],
        "properties": {key: value for key, value in given.items() if value is not None},
    }


def write(path: Path, values: dict[str, Any]) -> Path:
    path.write_text(json.dumps(values, indent=2))
    return path
