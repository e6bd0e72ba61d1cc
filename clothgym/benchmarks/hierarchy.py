"""`clothgym bench hierarchy`: proximities and hits of folded layers, and how they grow with the size [Mezger 2003, 7]."""

from __future__ import annotations

import importlib
import math
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks import flat_sheets
from clothgym.benchmarks.frame import Benchmark, Case, Row
from clothgym.benchmarks.report import Table

DISTANCE = 0.002
"""Pairs closer than this count [m]."""
EDGE = 0.01
"""Edge length of the sheets [m]: density is the same at every size."""
LAYERS = 4
PEER_THREADS = 2

_PEER_LARGEST = 80_000
_COMPARED_LARGEST = 80_000
_NOTES = (
    f"{LAYERS} sheets of {1e3 * EDGE:.0f} mm edges on each other, folded to and fro, at the same density at every size; "
    "'clear' has no intersection, 'tangled' has. Both surfaces are prepared (topology, tree); times hold refit, search and "
    f"exact tests, medians of interleaved repeats. ipctk (LBVH) runs on {PEER_THREADS} threads and answers whether there is "
    "an intersection, where ours, on one thread, lists all of them. ipctk counts its collision set after merging what lies "
    f"at corners; pairs are compared before that, up to {_COMPARED_LARGEST} triangles."
)


def cases(quick: bool) -> list[Case]:
    """Sizes x states, where ipctk is asked up to 80,000 triangles, and flat sheets."""
    sizes = (800, 5_000, 20_000) if quick else (800, 5_000, 20_000, 80_000, 320_000)
    scaling = [
        Case(
            f"scaling/{state}/{size}",
            {"part": "scaling", "triangles": size, "state": state, "seed": 0, "repeats": 9 if size <= 20_000 else 5},
        )
        for size in sizes
        for state in ("clear", "tangled")
    ]
    return scaling + flat_sheets.cases(quick)


def prepare() -> None:
    """Compiles every kernel that a case uses."""
    run({"part": "scaling", "triangles": 64, "state": "tangled", "seed": 0, "repeats": 1})
    run({"part": "flat", "cells": 4, "steps": 1, "searched": 1, "sheets": 1, "repeats": 1})


def folded_layers(triangles: int, state: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and faces (F, 3) of about that many triangles: four square sheets, parallel but for ripples.

    They follow a curve that winds to and fro (its angle is a cosine of its length), under a smooth distortion of space that
    folds nothing. Ripples of each sheet's own bring them closer, and through each other when tangled.
    """
    rng = np.random.default_rng(seed)
    cells = max(2, round(math.sqrt(triangles / (2 * LAYERS))))
    mesh = cg.grid(cells * EDGE, cells * EDGE, cells, cells)
    x, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    steepest, period = 1.8, 0.25
    s = np.linspace(x[:, 0].min() - EDGE, x[:, 0].max() + EDGE, 40 * cells)
    angle = steepest * np.cos(2.0 * np.pi * s / period)
    along, up = (np.cumsum(f(angle)) * (s[1] - s[0]) for f in (np.cos, np.sin))
    waves = [(rng.normal(0.0, 12.0, 3), rng.uniform(0.0, 6.28), rng.normal(0.0, 0.006, 3)) for _ in range(5)]
    ripple = 0.0012 if state == "tangled" else 0.00035
    sheets = []
    for layer in range(LAYERS):
        flat = x.copy()
        flat[:, [0, 2]] += rng.uniform(-0.15 * EDGE, 0.15 * EDGE, (len(x), 2))
        height = np.full(len(x), (layer - 0.5 * (LAYERS - 1)) * 0.0026)
        for _ in range(3):
            wave, phase = rng.normal(0.0, 150.0, 2), rng.uniform(0.0, 6.28)
            height += ripple * np.sin(flat[:, 0] * wave[0] + flat[:, 2] * wave[1] + phase)
        turn = np.interp(flat[:, 0], s, angle)
        sheet = np.stack(
            [
                np.interp(flat[:, 0], s, along) - height * np.sin(turn),
                np.interp(flat[:, 0], s, up) + height * np.cos(turn),
                flat[:, 2],
            ],
            axis=1,
        )
        sheets.append(sheet + sum(np.sin(sheet @ wave + phase)[:, None] * size for wave, phase, size in waves))
    return np.concatenate(sheets), np.concatenate([faces + layer * len(x) for layer in range(LAYERS)])


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One size in one state: counts, and medians [ms] of ours and of ipctk's; or one flat sheet."""
    if parameters["part"] == "flat":
        return flat_sheets.run(parameters)
    vertices, faces = folded_layers(parameters["triangles"], parameters["state"], parameters["seed"])
    surface = cg.Surface(faces, len(vertices))
    started = time.perf_counter()
    near = cg.proximities(vertices, surface, DISTANCE)
    first = time.perf_counter() - started
    hits = cg.intersections(vertices, surface)
    calls: dict[str, Callable[[], Any]] = {
        "near": lambda: cg.proximities(vertices, surface, DISTANCE),
        "hits": lambda: cg.intersections(vertices, surface),
        "both": lambda: cg.collisions(vertices, surface, DISTANCE),
    }
    result: dict[str, Any] = {
        "triangles": len(faces),
        "vertex_triangle": len(near.vertex_triangle),
        "edge_edge": len(near.edge_edge),
        "hits": hits.hit_count,
        "first_call_ms": 1e3 * first,
        "peer": None,
    }
    peer, reason = _peer(len(faces))
    if peer is None:
        result["peer_skipped"] = reason
    else:
        points = np.asfortranarray(vertices)
        mesh = peer.CollisionMesh(points, np.asfortranarray(surface.edges), np.asfortranarray(surface.faces))
        calls["peer_near"] = lambda: peer.NormalCollisions().build(mesh, points, DISTANCE, 0.0, peer.LBVH())
        calls["peer_hits"] = lambda: peer.has_intersections(mesh, points, peer.LBVH())
        result["peer"] = f"ipctk {peer.__version__}"
        result["peer_has_hits"] = bool(calls["peer_hits"]())
        if len(faces) <= _COMPARED_LARGEST:
            result |= _compared(peer, mesh, points, surface, near)
    threads = peer.get_num_threads() if peer is not None else 0
    try:
        if peer is not None:
            peer.set_num_threads(PEER_THREADS)
        result["ms"] = _interleaved(calls, parameters["repeats"])
    finally:
        if peer is not None:
            peer.set_num_threads(threads)
    return result


def _peer(triangles: int) -> tuple[Any, str]:
    """ipctk, or None and why not."""
    if triangles > 1.1 * _PEER_LARGEST:
        return None, f"ipctk is asked up to {_PEER_LARGEST} triangles"
    try:
        return importlib.import_module("ipctk"), ""
    except ModuleNotFoundError:
        return None, 'ipctk is not installed: pip install "clothgym[dev]"'


def _interleaved(calls: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Median time of each call [ms]; in turns, so that a busy moment of the machine meets all of them."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats + 1):
        for name, call in calls.items():
            started = time.perf_counter()
            call()
            times[name].append(1e3 * (time.perf_counter() - started))
    return {name: statistics.median(values[1:]) for name, values in times.items()}


def _compared(peer: Any, mesh: Any, points: np.ndarray, surface: cg.Surface, near: cg.Proximities) -> dict[str, int]:
    """How many pairs of ipctk's ours lack, and how many ours has beyond them."""
    candidates = peer.Candidates()
    candidates.build(mesh, points, 0.5 * DISTANCE, peer.LBVH())
    corners, ends = surface.faces, surface.edges
    theirs = [
        (c.vertex_id, c.face_id)
        for c in candidates.fv_candidates
        if peer.point_triangle_distance(points[c.vertex_id], *points[corners[c.face_id]]) < DISTANCE**2
    ]
    lines = []
    for c in candidates.ee_candidates:
        first, second = sorted((c.edge0_id, c.edge1_id))
        if peer.edge_edge_distance(*points[ends[first]], *points[ends[second]]) < DISTANCE**2:
            lines.append((*ends[first].tolist(), *ends[second].tolist()))
    missing = extra = 0
    for one, other in ((theirs, near.vertex_triangle), (lines, near.edge_edge)):
        wanted, found = set(one), set(map(tuple, other.tolist()))
        missing, extra = missing + len(wanted - found), extra + len(found - wanted)
    return {"missing": missing, "extra": extra}


# Tables


def growth(sizes: list[int], times: list[float]) -> float | None:
    """Exponent of the power of the size that fits the times best; None with fewer than two sizes."""
    if len(sizes) < 2:
        return None
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def tables(rows: list[Row]) -> list[Table]:
    """Pairs, hits, the growth of both, and flat sheets."""
    scaling = sorted(
        (row for row in rows if row["parameters"]["part"] == "scaling"),
        key=lambda row: (row["parameters"]["triangles"], row["parameters"]["state"]),
    )
    flat = [row for row in rows if row["parameters"]["part"] == "flat"]
    found = [_near_table(scaling), _hits_table(scaling), _growth_table(scaling)] if scaling else []
    return found + ([flat_sheets.table(flat)] if flat else [])


def _ratio(row: Row, kind: str) -> float | None:
    times = row["result"]["ms"]
    return times[kind] / times[f"peer_{kind}"] if f"peer_{kind}" in times else None


def _near_table(rows: list[Row]) -> Table:
    cells = [
        (
            row["result"]["triangles"],
            row["parameters"]["state"],
            row["result"]["vertex_triangle"] + row["result"]["edge_edge"],
            row["result"]["ms"]["near"],
            row["result"]["ms"].get("peer_near"),
            _ratio(row, "near"),
            row["result"].get("missing"),
            row["result"].get("extra"),
        )
        for row in rows
    ]
    columns = ("triangles", "state", "pairs", "ours [ms]", "ipctk [ms]", "ours / ipctk", "missing", "extra")
    skipped = sorted({row["result"]["peer_skipped"] for row in rows if "peer_skipped" in row["result"]})
    return Table(f"Pairs within {1e3 * DISTANCE:g} mm", columns, cells, "; ".join(skipped))


def _hits_table(rows: list[Row]) -> Table:
    cells = []
    for row in rows:
        result, times = row["result"], row["result"]["ms"]
        cells.append(
            (
                result["triangles"],
                row["parameters"]["state"],
                result["hits"],
                times["hits"],
                times.get("peer_hits"),
                _ratio(row, "hits"),
                times["both"] / times["near"] - 1.0,
                times["both"],
            )
        )
    columns = (
        "triangles",
        "state",
        "hits",
        "ours [ms]",
        "ipctk yes/no [ms]",
        "ours / ipctk",
        "extra beside pairs",
        "both [ms]",
    )
    return Table("All hits", columns, cells, "ipctk may stop at the first hit when tangled")


def _growth_table(rows: list[Row]) -> Table:
    cells = []
    for state in ("clear", "tangled"):
        results = [
            r["result"] for r in rows if r["parameters"]["state"] == state and r["parameters"]["triangles"] >= 5_000
        ]
        cells.append(
            (
                state,
                *(
                    growth([r["triangles"] for r in known], [r["ms"][kind] for r in known])
                    for kind in ("near", "hits", "peer_near", "peer_hits")
                    for known in [[r for r in results if kind in r["ms"]]]
                ),
            )
        )
    columns = ("state", "pairs", "hits", "ipctk pairs", "ipctk yes/no")
    return Table("Growth exponent from 5,000 triangles on", columns, cells)


benchmark = Benchmark(
    name="hierarchy",
    title="Proximities and hits against the size, beside ipctk",
    cases=cases,
    run=run,
    tables=tables,
    prepare=prepare,
    notes=_NOTES,
)
