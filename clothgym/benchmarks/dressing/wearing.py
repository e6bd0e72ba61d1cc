"""What is worn: every pattern of the package on both bodies, walks, layers over each other, and pictures of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from clothgym import rig, wardrobe
from clothgym.benchmarks.frame import Case, Row
from clothgym.benchmarks.report import Table
from clothgym.dressing import drape, layer, walk

KINDS = ("worn", "walk", "layers")
WALKS = (("trousers",), ("skirt", "shirt"))
"""The inner garments first, here and below: a shirt in trousers, a jacket over a shirt."""
LAYERS = (("shirt", "trousers"), ("skirt", "sleeveless_shirt"), ("sleeveless_shirt", "shirt"), ("vest", "t_shirt"))
FLOATING = 3e-3
"""[m] what rests on the body may be so much further from it than the tolerance."""

_KEPT = (
    "worn", "at_rest", "hits", "strain_p99", "seam_strain_p99", "penetration_p999", "penetration_max", "contact_gap_median",
    "contact_gap_p99", "carried", "vertices", "attempts", "seconds", "measure_seconds",
)  # fmt: skip
_PICTURE_WALK = 2.4
"""[s] of the walk that is drawn, and"""
_PICTURE_EVERY = 0.3
"""how far its frames are apart."""
_SIZE = (300, 450)
"""[pixel] of each picture of a sheet."""


def cases(quick: bool) -> list[Case]:
    """Patterns on bodies, walks, layers."""
    found = [
        Case(f"worn/{name}/{body}", {"kind": "worn", "pattern": name, "body": body})
        for body in (("female",) if quick else rig.NAMES)
        for name in (("skirt", "trousers") if quick else wardrobe.NAMES)
    ]
    for names in (("shorts",),) if quick else WALKS:
        seconds = 1.0 if quick else 6.0
        found.append(Case(f"walk/{'+'.join(names)}", {"kind": "walk", "patterns": list(names), "seconds": seconds}))
    for names in LAYERS[:1] if quick else LAYERS:
        found.append(Case(f"layers/{'+'.join(names)}", {"kind": "layers", "patterns": list(names)}))
    return found


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One case of `cases`."""
    if parameters["kind"] == "worn":
        report = drape(parameters["pattern"], parameters["body"]).report
        return {name: report[name] for name in _KEPT}
    garments = [drape(name, "female") for name in parameters["patterns"]]
    if parameters["kind"] == "walk":
        found = walk(garments, parameters["seconds"]).report
    else:
        found = layer(garments).report
    return {name: value for name, value in found.items() if name != "openings"} | {
        "vertices": sum(garment.report["vertices"] for garment in garments)
    }


def tables(rows: list[Row]) -> list[Table]:
    """One of each kind."""
    by_kind = {kind: [row for row in rows if row["parameters"].get("kind") == kind] for kind in KINDS}
    shown = {"worn": _worn_shown, "walk": _walks_shown, "layers": _layers_shown}
    return [shown[kind](found) for kind, found in by_kind.items() if found]


def _worn_shown(rows: list[Row]) -> Table:
    cells: list[tuple[Any, ...]] = []
    for row in rows:
        p, r = row["parameters"], row["result"]
        cells.append(
            (p["pattern"], p["body"], r["vertices"], r["seconds"], r["worn"], r["at_rest"], r["hits"],
             100 * r["seam_strain_p99"], 1e3 * r["penetration_p999"], 1e3 * r["penetration_max"],
             1e3 * r["contact_gap_median"], 1e3 * r["contact_gap_p99"])
        )  # fmt: skip
    columns = (
        "pattern", "body", "vertices", "seconds", "worn", "at rest", "hits", "seam strain p99 [%]", "depth p99.9 [mm]",
        "deepest [mm]", "off the body, median [mm]", "p99 [mm]",
    )  # fmt: skip
    note = "off the body: cloth that it carries; at a tolerance of 3 mm, no more than 6 are wanted"
    return Table("Patterns of the package, triangles of 2 cm, with self-collision", columns, cells, note)


def _walks_shown(rows: list[Row]) -> Table:
    cells: list[tuple[Any, ...]] = []
    for row in rows:
        p, r = row["parameters"], row["result"]
        cells.append(
            (" under ".join(p["patterns"]), r["walk_seconds"], r["vertices"], r["worn"], r["hits_max"], r["hits_longest"],
             r["hits_end"], 1e3 * r["depth_p99_max"], 1e3 * r["depth_max"], r["seconds"])
        )  # fmt: skip
    columns = (
        "garments", "walked [s]", "vertices", "worn", "most hits", "frames until none, at most", "hits at the end",
        "depth p99, worst frame [mm]", "deepest [mm]", "seconds",
    )  # fmt: skip
    return Table("Walks", columns, cells, "frames of 1/60 s")


def _layers_shown(rows: list[Row]) -> Table:
    cells: list[tuple[Any, ...]] = []
    for row in rows:
        p, r = row["parameters"], row["result"]
        passes = r["passes"] if r["passes"] >= 0 else None
        cells.append(
            (" under ".join(p["patterns"]), r["vertices"], r["hits_start"], passes, r["hits_after"], r["hits"], r["worn"],
             1e3 * r["depth_max"], r["seconds"])
        )  # fmt: skip
    columns = (
        "garments", "vertices", "hits at the start", "passes until none", "most hits after that", "hits at the end", "worn",
        "deepest [mm]", "seconds",
    )  # fmt: skip
    note = "draped one by one, then put over each other; Volino 2006, 3.1.4: layers take less than ten passes"
    return Table("Layers", columns, cells, note)


def plots(rows: list[Row], folder: Path) -> list[Path]:
    """Sheets of what the rows tell of, draped anew: garments from the front, the back and the side; frames of the first
    walk of each kind."""
    from clothgym.recording.frames import save_png, tile
    from clothgym.recording.pictures import draw_views

    made = []
    width, height = _SIZE
    for body in rig.NAMES:
        images, labels = [], []
        for row in rows:
            p = row["parameters"]
            if p.get("kind") == "worn" and p["body"] == body:
                views = draw_views(drape(p["pattern"], body).simulation, width=width, height=height)
                images += list(views.values())
                labels += [f"{p['pattern']}, {view}" for view in views]
        if images:
            columns = 3 * min(3, len(images) // 3)
            made.append(save_png(folder / f"dressing_{body}.png", tile(images, labels, columns=columns)))
    walks = [row["parameters"] for row in rows if row["parameters"].get("kind") == "walk"]
    images, labels = [], []
    for p in walks:
        for time, image in _frames(p["patterns"], min(_PICTURE_WALK, p["seconds"])):
            images.append(image)
            labels.append(f"{' under '.join(p['patterns'])}, {time:.1f} s")
    if images:
        columns = len(images) // len(walks)
        made.append(save_png(folder / "dressing_walk.png", tile(images, labels, columns=columns)))
    return made


def _frames(patterns: list[str], seconds: float) -> list[tuple[float, Any]]:
    """Times [s] and pictures of a walk."""
    from clothgym.recording.pictures import draw_views

    width, height = _SIZE
    kept: list[tuple[float, Any]] = []

    def on_frame(simulation: Any) -> None:
        if simulation.time >= len(kept) * _PICTURE_EVERY - 1e-6:
            kept.append((simulation.time, draw_views(simulation, ("front",), width, height)["front"]))

    walk([drape(name, "female") for name in patterns], float(np.floor(seconds / _PICTURE_EVERY) * _PICTURE_EVERY),
         on_frame=on_frame)  # fmt: skip
    return kept
