"""Untangling of a mesh by itself, without mechanics: `clothgym.untangle`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import FloatArray, check_number
from clothgym.detection.hierarchy import Hierarchy
from clothgym.detection.intersections import Intersections
from clothgym.mesh import Surface, as_surface, vertex_areas
from clothgym.response import untangling
from clothgym.response.untangling.base import Context

_STALL_PASSES = 30
_EXPLOSION = 100.0


@dataclass(frozen=True)
class UntangleResult:
    """What `untangle` did.

    Attributes:
        vertices: (V, 3) [m]; the best state met: fewest hits, then least length.
        length: contour length of that state [m]; length_history: before every pass, and at the end unless it exploded.
        hits: number of hits of that state; hit_history likewise.
        resolved: no hit is left.
        passes: corrections made.
        stop_reason: "resolved", "budget" (passes used up), "stalled" (no better state for 30 passes), or "explosion" (a
            vertex went further than 100 times the mesh's extent).
        skipped_faces: faces with a repeated vertex id, left out.
    """

    vertices: FloatArray
    length: float
    length_history: list[float]
    hits: int
    hit_history: list[int]
    resolved: bool
    passes: int
    stop_reason: str
    skipped_faces: int


def untangle(
    vertices: Any,
    faces: Any = None,
    strategy: Any = "hybrid",
    passes: int = 100,
    fixed: ArrayLike | None = None,
    h0: float = 0.5,
    g0: float = 1.0,
) -> UntangleResult:
    """Moves vertices until a surface no longer intersects itself; geometry only, every vertex weighs the same.

    Between the passes the moved neighbourhood is relaxed: vertices around the corrected ones share the displacement, so
    that the surface bends instead of tearing (mechanics does this in a simulation).

    Args:
        vertices: (V, 3) [m], or a trimesh as the only argument.
        faces: (F, 3) or a `Surface`.
        strategy: a name of `clothgym.response.untangling.names()`, "package.module:Name", or an object with `propose`.
        passes: budget.
        fixed: (V,) bool, vertices that must not move.
        h0: largest correction of a pass in mean edge lengths.
        g0: gradient at which corrections saturate.

    Raises:
        ValueError: names the offending field, index and value.
    """
    x, surface = as_surface(vertices, faces)
    x = x.copy()
    if surface.vertex_count != len(x):
        surface = Surface(surface.given_faces, len(x))
    check_number(passes, "passes", 0, 1_000_000, integer=True)
    check_number(h0, "h0", 1e-6, 100.0)
    check_number(g0, "g0", 1e-9, 1e9)
    chosen = untangling.get(strategy) if isinstance(strategy, str) else strategy
    if chosen is not None and not callable(getattr(chosen, "propose", None)):
        raise ValueError(f"strategy = {strategy!r}: has no method propose(context)")
    inverse_masses = np.ones(len(x))
    if fixed is not None:
        mask = np.asarray(fixed)
        if mask.dtype != np.bool_ or mask.shape != (len(x),):
            raise ValueError(f"fixed: expected {len(x)} booleans, got shape {mask.shape} of {mask.dtype}")
        inverse_masses[mask] = 0.0
    areas = vertex_areas(x, surface.faces)
    edges = surface.edges
    mean_edge = float(np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1).mean()) if len(edges) else 1.0
    extent = float(np.ptp(x, axis=0).max()) if len(x) else 0.0
    relax = _Relaxation(surface, inverse_masses)
    memory = untangling.memory(chosen)
    tree = Hierarchy(surface, x)
    lengths: list[float] = []
    counts: list[int] = []
    best = (np.inf, np.inf)
    best_x, best_pass, done, reason = x.copy(), 0, 0, "budget"
    while True:
        tree.refit(x, x, 0.0)
        hits = Intersections(x, surface, edge_face=tree.edges_against_faces())
        lengths.append(hits.length)
        counts.append(hits.hit_count)
        if (hits.hit_count, hits.length) < best:
            best, best_x, best_pass = (hits.hit_count, hits.length), x.copy(), done
        if hits.hit_count == 0:
            reason = "resolved"
            break
        if done >= passes:
            break
        if chosen is None or done - best_pass >= _STALL_PASSES:
            reason = "stalled"
            break
        moved, _ = untangling.answer(chosen, Context(hits, inverse_masses, areas, h0 * mean_edge, g0, memory))
        x = x + relax(moved)
        done += 1
        if not np.isfinite(x).all() or float(np.abs(x - best_x).max()) > _EXPLOSION * max(extent, mean_edge):
            reason = "explosion"
            break
    return UntangleResult(
        best_x, float(best[1]), lengths, int(best[0]), counts, best[0] == 0, done, reason, surface.skipped_faces
    )


class _Relaxation:
    """Spreads a displacement over the neighbourhood of the vertices that were moved."""

    def __init__(self, surface: Any, inverse_masses: FloatArray, sweeps: int = 4) -> None:
        self.start, self.neighbours, _ = surface.neighbourhood
        self.degree = np.maximum(np.diff(self.start), 1)
        self.owner = np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))
        self.free = inverse_masses > 0
        self.sweeps = sweeps

    def __call__(self, moved: FloatArray) -> FloatArray:
        given = (moved != 0).any(axis=1)
        field = moved.copy()
        for _ in range(self.sweeps):
            mean = np.stack(
                [np.bincount(self.owner, field[self.neighbours, c], minlength=len(field)) for c in range(3)], axis=1
            )
            mean = mean / self.degree[: len(field), None]
            field = np.where(given[:, None], moved, mean)
            field[~self.free] = 0.0
        return field
