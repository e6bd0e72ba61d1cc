"""Intersections at the start of a step, and what a strategy does against them."""

from __future__ import annotations

from typing import Any

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.fidelity import Fidelity
from clothgym.model import ClothModel
from clothgym.stages.frame import Frame
from clothgym.stages.pairs import FacePairs


class Untangle:
    """Hits, the passes of a strategy against them, and the vertices that contact leaves alone.

    Memoryless: everything follows from the current positions.
    """

    reads: tuple[str, ...] = ("positions", "velocities", "face_pairs")
    writes: tuple[str, ...] = ("positions", "velocities", "face_pairs", "apart")

    def __init__(self, candidates: Any, model: ClothModel, fidelity: Fidelity, pairs: FacePairs, apart: Any) -> None:
        from clothgym.detection.intersections import Intersections
        from clothgym.kernels.untangling import mark_ring
        from clothgym.response import untangling

        self.answer = untangling.answer
        self.strategy = untangling.get(fidelity.untangling)
        self.passes = fidelity.untangling_passes if self.strategy is not None else 0
        self.name = (
            f"intersections [untangle {fidelity.untangling} x{self.passes}, contact {fidelity.contacts_near_hits}]"
        )
        if self.strategy is None:
            self.writes = ("apart",)
        self.candidates, self.fidelity, self.pairs, self.apart = candidates, fidelity, pairs, apart
        self.find, self.mark_ring = Intersections, mark_ring
        self.context = untangling.Context
        self.h0 = fidelity.h0 * model.mean_edge
        self.stack = np.zeros(model.vertex_count, np.int64)

    def run(self, frame: Frame) -> None:
        state, model, fidelity = frame.state, frame.model, self.fidelity
        self.apart[:] = False
        if self.candidates.flat:  # decided for where everything is now, too
            frame.count("hits", 0)
            return
        tree = self.candidates.tree
        moved = False
        for _ in range(max(1, self.passes)):
            # boxes of the positions alone: those of the whole step hold many times as much
            tree.refit(state.positions, state.positions, 0.0)
            hits = self.find(state.positions.copy(), model.surface, edge_face=tree.edges_against_faces())
            frame.count("edge_triangle_tests", hits.edge_triangle_tests)
            frame.count("hits", hits.hit_count)
            self.apart[:] = False
            if hits.hit_count == 0:
                break
            inside = None
            if self.strategy is not None:
                frame.untangling_passes += 1
                context = self.context(hits, model.inverse_masses, model.vertex_areas, self.h0, fidelity.g0)
                moves, inside = self.answer(self.strategy, context)
                self._apply(frame, moves)
                moved = True
            if fidelity.contacts_near_hits != "keep":
                self._mark(model, hits, inside)
        if moved:
            # what is tangled soon goes elsewhere than expected
            self.pairs.look(frame, self.pairs.short)

    def _mark(self, model: ClothModel, hits: Any, inside: Any) -> None:
        """Vertices around the hits, and inside enclosed regions: contact there would lock the wrong side."""
        edges, faces = model.surface.edges[hits.hit_edge], model.surface.faces[hits.hit_face]
        seeds = np.unique(np.concatenate([edges.ravel(), faces.ravel()])).astype(np.int64)
        start, neighbours, _ = model.surface.neighbourhood
        self.mark_ring(start, neighbours, seeds, self.fidelity.rings, self.apart, self.stack)
        if inside is not None:
            self.apart |= inside

    def _apply(self, frame: Frame, moved: FloatArray) -> None:
        """Moves vertices; a share of the displacement per step also becomes velocity, up to the speed limit."""
        state, fidelity = frame.state, self.fidelity
        state.positions += moved
        if fidelity.velocity_share == 0.0:
            return
        before = np.sqrt(np.einsum("ij,ij->i", state.velocities, state.velocities))
        state.velocities += (fidelity.velocity_share / frame.model.scene.step) * moved
        after = np.sqrt(np.einsum("ij,ij->i", state.velocities, state.velocities))
        allowed = np.maximum(before, fidelity.speed_limit)
        fast = after > allowed
        state.velocities[fast] *= (allowed[fast] / after[fast])[:, None]
