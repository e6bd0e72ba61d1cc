"""Garments sewn from their patterns onto the female body [Vassilev 2001, Fig. 6]."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import clothgym as cg
from clothgym.benchmarks.report import Table
from clothgym_envs.tour.section import Section, recording

PATTERNS = ("sleeveless_shirt", "skirt")
TITLE = "A body is dressed"
COLUMNS = (
    "pattern", "vertices", "worn", "at rest", "hits", "seam strain p99", "depth p99.9 [mm]", "deepest [mm]", "seconds",
)  # fmt: skip


def run(out: Path, pattern: str, edge_length: float = 0.025) -> Section:
    """One garment: placed, sewn, draped; `joined` makes one section of all."""
    from clothgym.recording import pictures

    log = recording(out / f"drape_{pattern}.rrd")
    start: list[Any] = []
    step = 0

    def watch(simulation: cg.Simulation) -> None:
        nonlocal step
        if not start:
            start.append(pictures.draw_views(simulation, ("front",), 300, 450)["front"])
            step = 0
            if log is not None:
                log.open_simulation(simulation)
        if log is not None:
            log.log_simulation(step, simulation)
        step += 1

    try:
        draped = cg.drape(pattern, "female", edge_length=edge_length, on_step=watch)
    finally:
        if log is not None:
            log.close()
    r = draped.report
    row = (
        pattern, r["vertices"], r["worn"], r["at_rest"], r["hits"], r["seam_strain_p99"], 1e3 * r["penetration_p999"],
        1e3 * r["penetration_max"], r["seconds"],
    )  # fmt: skip
    views = pictures.draw_views(draped.simulation, width=300, height=450)
    shown = [(start[0], "sewn"), *((image, f"draped, {name}") for name, image in views.items())]
    sheets = [(f"drape_{pattern}.png", pattern.replace("_", " "), shown)]
    return Section(TITLE, "", {"pattern": pattern} | r, [Table("", COLUMNS, [row])], sheets)


def joined(sections: list[Section]) -> Section:
    """All garments in one table."""
    text = (
        "Flat panels are placed around the CC0 body, welded at the midpoints of their seams, drawn in, and left to gravity "
        "until they rest. The collider is a map of planes: front, back, outline. Depth is measured against the true body, at "
        "45 points of every triangle. Worn: each opening has its own limb through it."
    )
    table = Table("From pattern to garment [Vassilev 2001]", COLUMNS, [s.tables[0].rows[0] for s in sections])
    document = {"garments": [s.document for s in sections]}
    return Section(TITLE, text, document, [table], [sheet for s in sections for sheet in s.sheets])
