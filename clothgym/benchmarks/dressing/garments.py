"""Garments on a body: the tables and Fig. 8 of [Vassilev 2001], and what tolerance, maps, faces and strain limits buy."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks.frame import Case, Row
from clothgym.benchmarks.report import Table
from clothgym.dressing import drape

PAPER_TABLE_1 = {"shirt": (1800, 15.8, 30.8), "dress": (3840, 33.0, 52.0)}
"""Vertices, and ms a step with the collider in image space and in object space."""
PAPER_TABLE_2 = {"skirt": (336, 206.0), "trousers": (560, 334.0), "shirt": (544, 268.0), "dress": (1024, 784.0)}
"""Vertices, and ms until the garment hangs."""
BUDGET = {"skirt": 0.15, "trousers": 0.15, "shirt": 0.15, "dress": 0.4}
"""[s] without self-collision; three times that with it."""
GRIDS = {"skirt": (14, 12), "trousers": (7, 20), "shirt": (16, 17), "dress": (16, 32)}
"""(columns, rows) of the vertices of each panel: the paper's counts, in cells that are as nearly square as they allow."""
PATTERN = {"skirt": "skirt", "trousers": "trousers", "shirt": "sleeveless_shirt", "dress": "dress"}

COLLIDERS = ("maps", "boxes", "dop")
"""Of `Fidelity.body_collider`, as Table 1 shows them."""

_REPEATS, _DRAPES = 9, 3
_EXPLICIT = {"integrator": "symplectic_euler", "substeps": 0, "stretch_limit": 0.1}


def cases(quick: bool) -> list[Case]:
    """Table 2 with and without self-collision, Table 1, Fig. 8, and one setting at a time around them."""
    found = [
        Case(f"table2/{name}/{'self' if own else 'body'}", {"kind": "table2", "garment": name, "self_collision": own})
        for name in (("skirt",) if quick else GRIDS)
        for own in (False, True)
    ]
    found += [
        Case(f"table1/{name}", {"kind": "table1", "garment": name}) for name in (("shirt",) if quick else PAPER_TABLE_1)
    ]
    for grid in ((12, 5), (24, 8), (48, 16)) if quick else ((12, 5), (24, 8), (36, 12), (48, 16), (64, 24), (96, 32)):
        found.append(Case(f"fig8/{grid[0]}x{grid[1]}", {"kind": "fig8", "grid": list(grid)}))
    settings: list[tuple[str, dict[str, Any]]] = []
    if not quick:
        settings += [
            (f"{n} px, {1e3 * t:g} mm, {v}", {"map_size": n, "body_tolerance": t, "body_views": v})
            for n in (90, 180, 360, 720)
            for t in (0.001, 0.003, 0.005)
            for v in ("z", "zyx")
        ]
        settings += [(f"collider={c}", {"body_collider": c}) for c in ("maps", "boxes", "dop")]
        settings += [(f"normals={n}", {"body_normals": n}) for n in ("face", "interpolated", "bytes")]
        settings += [
            (f"modification={m}", {**_EXPLICIT, "velocity_modification": m}) for m in ("none", "literal", "relative")
        ]
    for label, fields in settings:
        found.append(
            Case(f"setting/{label}", {"kind": "setting", "label": label, "fields": fields, "edge_length": 0.025})
        )
    tests: dict[str, dict[str, Any]] = {str(parts): {"body_faces": parts} for parts in (0, 1, 2, 3)}
    tests["texels"] = {"body_texels": True}
    for parts, fields in tests.items() if not quick else ():
        for length in (0.05, 0.035, 0.025, 0.018):
            parameters = {"label": f"faces={parts} edge={1e3 * length:g}mm", "fields": fields}
            key = f"faces/{parts}/{1e3 * length:g}mm"
            found.append(Case(key, {"kind": "setting", "edge_length": length, "given_faces": True, **parameters}))
    return found


def prepare() -> None:
    """Compiles every kernel that a case uses."""
    for own in (False, True):
        drape("cuff", "female", edge_length=0.05, self_collision=own, seconds=0.05, fidelity="draft")


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One case of `cases`."""
    chosen: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
        "table1": _table_1, "table2": _table_2, "fig8": _figure_8, "setting": _setting,
    }  # fmt: skip
    return chosen[parameters["kind"]](parameters)


def _kept(report: dict[str, Any]) -> dict[str, Any]:
    """What of a drape's report the rows keep."""
    names = (
        "worn", "at_rest", "hits", "seam_strain_p99", "strain_p99", "strain_max", "penetration_p999", "penetration_max",
        "contact_gap_median", "contact_gap_p99", "vertices", "panel_vertices", "simulated_seconds", "seconds", "attempts",
    )  # fmt: skip
    phases = {name: value for name, value in report.items() if name.endswith("_seconds")}
    return {name: report[name] for name in names if name in report} | phases


def _table_2(parameters: dict[str, Any]) -> dict[str, Any]:
    """The paper's garments in quads, time and again: the first one measures the body and draws its maps, of the others the
    median is told, without the report, which takes as long as sewing."""
    name = parameters["garment"]
    settings: dict[str, Any] = {
        "mesher": "quads", "grid": GRIDS[name], "self_collision": parameters["self_collision"],
    }  # fmt: skip
    reports = [drape(PATTERN[name], "female", **settings).report for _ in range(1 + _DRAPES)]
    ready = statistics.median(report["seconds"] - report["measure_seconds"] for report in reports[1:])
    return _kept(reports[-1]) | {"ready_seconds": ready, "first_seconds": reports[0]["seconds"]}


def _table_1(parameters: dict[str, Any]) -> dict[str, Any]:
    """Substeps of a garment of the paper's size where it hangs, with each collider in turn: maps, the paper's boxes of five
    parts, the k-DOP tree; and the same without a body. One sweep and one point a face, as the paper.
    """
    name = parameters["garment"]
    wanted = PAPER_TABLE_1[name][0]
    fidelity = dataclasses.replace(cg.Fidelity.preset("balanced"), body_faces=1)
    length = 0.02
    for _ in range(2):  # vertices go with the square of the length
        draped = drape(PATTERN[name], "female", edge_length=length, self_collision=False, fidelity=fidelity)
        length *= float(np.sqrt(draped.report["vertices"] / wanted))
    draped = drape(PATTERN[name], "female", edge_length=length, self_collision=False, fidelity=fidelity)
    start = draped.simulation
    snapshot = start.snapshot()
    substeps = start.pipeline.substeps
    fixed = dataclasses.replace(start.fidelity, substeps=substeps, sweeps=1)
    running = {"none": cg.Simulation(dataclasses.replace(start.scene, bodies=()), fixed)}
    for collider in COLLIDERS:
        running[collider] = cg.Simulation(start.scene, dataclasses.replace(fixed, body_collider=collider))
    times: dict[str, list[float]] = {key: [] for key in running}
    for _ in range(_REPEATS):
        for key, simulation in running.items():
            simulation.restore(snapshot)  # without a body the garment would fall
            began = time.process_time()
            simulation.step()
            times[key].append(1e3 * (time.process_time() - began) / substeps)
    found: dict[str, Any] = {f"{key}_ms": statistics.median(values) for key, values in times.items()}
    for key in COLLIDERS:
        hanging = running[key]
        hanging.restore(snapshot)
        hanging.step(5)
        depths = hanging.body_mesh.penetration(hanging.positions, hanging.faces)
        weight = float(hanging.model.masses.sum()) * 9.81
        found[f"{key}_depth"] = float(depths.max())
        found[f"{key}_carried"] = float(hanging.contact_force().sum(axis=0)[1]) / weight
    return _kept(draped.report) | found | {"substeps": substeps}


def _figure_8(parameters: dict[str, Any]) -> dict[str, Any]:
    """Time of a substep of a skirt in quads, without self-collision."""
    draped = drape("skirt", "female", mesher="quads", grid=tuple(parameters["grid"]), self_collision=False, seconds=0.5)
    simulation = draped.simulation
    times = []
    for _ in range(_REPEATS):
        began = time.process_time()
        simulation.step()
        times.append(1e3 * (time.process_time() - began) / simulation.pipeline.substeps)
    return {"vertices": draped.report["vertices"], "ms": statistics.median(times)}


def _setting(parameters: dict[str, Any]) -> dict[str, Any]:
    """A skirt and a sleeveless shirt with one setting changed: worst of both."""
    fields = dict(parameters["fields"])
    fidelity = dataclasses.replace(cg.Fidelity.preset("balanced"), **fields)
    if parameters.get("given_faces"):
        # a fidelity with substeps of its own keeps its points of faces, too
        fidelity = dataclasses.replace(fidelity, substeps=32, sweeps=1)
    reports = []
    for name in ("skirt", "sleeveless_shirt"):
        try:
            settings: dict[str, Any] = {
                "fidelity": fidelity,
                "edge_length": parameters["edge_length"],
                "self_collision": False,
            }
            reports.append(_kept(drape(name, "female", **settings).report))
        except (cg.SimulationError, ValueError) as error:
            return {"failed": f"{name}: {error}"}
    worst = {
        key: max(r[key] for r in reports)
        for key in ("seconds", "strain_p99", "strain_max", "penetration_p999", "penetration_max", "vertices")
    }
    return worst | {"worn": all(r["worn"] for r in reports), "at_rest": all(r["at_rest"] for r in reports)}


def tables(rows: list[Row]) -> list[Table]:
    """Table 1, Table 2, Fig. 8, one setting at a time."""
    by_kind = {
        k: [r for r in rows if r["parameters"].get("kind") == k] for k in ("table1", "table2", "fig8", "setting")
    }
    found = []
    if by_kind["table2"]:
        found.append(_table_2_shown(by_kind["table2"]))
    if by_kind["table1"]:
        found.append(_table_1_shown(by_kind["table1"]))
    if by_kind["fig8"]:
        found.append(_figure_8_shown(by_kind["fig8"]))
    if by_kind["setting"]:
        found.append(_settings_shown(by_kind["setting"]))
    return found


def _table_2_shown(rows: list[Row]) -> Table:
    cells: list[tuple[Any, ...]] = []
    for row in rows:
        name, own, r = row["parameters"]["garment"], row["parameters"]["self_collision"], row["result"]
        vertices, paper = PAPER_TABLE_2[name]
        budget = BUDGET[name] * (3.0 if own else 1.0)
        cells.append(
            (name, "yes" if own else "no", r["panel_vertices"], vertices, r["ready_seconds"], budget, paper / 1e3,
             r["worn"], r["at_rest"], r["hits"], 100 * r["seam_strain_p99"], 1e3 * r["penetration_max"],
             1e3 * r["contact_gap_p99"])
        )  # fmt: skip
    columns = (
        "garment", "self-collision", "vertices", "paper's", "sewn and at rest [s]", "to reach [s]", "paper [s]", "worn",
        "at rest", "hits", "seam strain p99 [%]", "deepest [mm]", "off the body p99 [mm]",
    )  # fmt: skip
    note = "on a body that was dressed before, without the report; the paper's time leaves the set-up out"
    return Table("Table 2: quads, sewn and draped to rest", columns, cells, note)


def _table_1_shown(rows: list[Row]) -> Table:
    cells: list[tuple[Any, ...]] = []
    for row in rows:
        name, r = row["parameters"]["garment"], row["result"]
        vertices, image, objects = PAPER_TABLE_1[name]
        cells.append(
            (name, r["vertices"], vertices, r["none_ms"], *(r[f"{c}_ms"] for c in COLLIDERS), r["boxes_ms"] / r["maps_ms"],
             objects / image, *(1e3 * r[f"{c}_depth"] for c in COLLIDERS), *(r[f"{c}_carried"] for c in COLLIDERS))
        )  # fmt: skip
    columns = (
        "garment", "vertices", "paper's", "no body [ms]", "maps [ms]", "boxes of five parts [ms]", "k-DOP tree [ms]",
        "boxes / maps", "paper's", *(f"deepest, {c} [mm]" for c in COLLIDERS), *(f"weight carried, {c}" for c in COLLIDERS),
    )  # fmt: skip
    note = "whole substeps of one sweep, interleaved medians; what each carries of the weight after 5 steps"
    return Table("Table 1: the collider in image and in object space", columns, cells, note)


def _figure_8_shown(rows: list[Row]) -> Table:
    vertices = np.array([row["result"]["vertices"] for row in rows], float)
    ms = np.array([row["result"]["ms"] for row in rows])
    cells = [(int(n), t, 1e6 * t / n) for n, t in sorted(zip(vertices.tolist(), ms.tolist()))]
    note = "the paper: linear, 8,700 ns a vertex"
    if len(rows) > 2:
        slope, rest = np.polyfit(vertices, ms, 1)
        explained = 1.0 - float(((ms - slope * vertices - rest) ** 2).sum() / ((ms - ms.mean()) ** 2).sum())
        note += f"; here {1e6 * slope:.0f} ns a vertex and {1e3 * rest:.0f} us, which explains {100 * explained:.1f} % (R^2)"
        note += f"; ms grow with the power {np.polyfit(np.log(vertices), np.log(ms), 1)[0]:.2f} of the vertices"
    return Table("Fig. 8: a substep of a skirt", ("vertices", "ms", "ns a vertex"), cells, note)


def _settings_shown(rows: list[Row]) -> Table:
    cells: list[tuple[Any, ...]] = []
    for row in rows:
        r = row["result"]
        if "failed" in r:
            cells.append((row["parameters"]["label"], r["failed"], *[None] * 7))
            continue
        cells.append(
            (row["parameters"]["label"], "", r["vertices"], r["seconds"], r["worn"], r["at_rest"], 100 * r["strain_p99"],
             1e3 * r["penetration_p999"], 1e3 * r["penetration_max"])
        )  # fmt: skip
    columns = (
        "setting", "failed", "vertices", "seconds", "worn", "at rest", "strain p99 [%]", "penetration p99.9 [mm]",
        "deepest [mm]",
    )  # fmt: skip
    return Table("One setting at a time: skirt and shirt, the worse of both", columns, cells)
