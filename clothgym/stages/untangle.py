"""Intersections at the start of a step, and what a strategy does against them."""

from __future__ import annotations

from typing import Any

import numpy as np

from clothgym.arrays import FloatArray, IntArray
from clothgym.fidelity import Fidelity
from clothgym.model import ClothModel
from clothgym.stages.frame import Frame
from clothgym.stages.pairs import FacePairs


class Untangle:
    """Hits, the passes of a strategy against them, and the vertices that contact leaves alone.

    Everything follows from the current positions, but for strategies with a memory, which is part of the state.
    """

    of_pairs = True
    reads: tuple[str, ...] = ("positions", "velocities", "face_pairs")
    writes: tuple[str, ...] = ("positions", "velocities", "face_pairs", "apart")

    def __init__(
        self, candidates: Any, model: ClothModel, fidelity: Fidelity, pairs: FacePairs, apart: Any, windy: bool
    ) -> None:
        from clothgym.detection.intersections import Intersections
        from clothgym.kernels.untangling import mark_ring
        from clothgym.response import untangling

        self.answer = untangling.answer
        self.strategy = untangling.get(fidelity.untangling)
        self.memory_size = len(untangling.memory(self.strategy))
        self.passes = fidelity.untangling_passes if self.strategy is not None else 0
        if fidelity.displacement_share == 0.0:
            self.passes = min(self.passes, 1)  # nothing moves from pass to pass
        self.name = (
            f"intersections [untangle {fidelity.untangling} x{self.passes}, contact {fidelity.contacts_near_hits}]"
        )
        self.channel = Channels(model, fidelity, windy)
        if self.strategy is None:
            self.writes = ("apart",)
        elif self.channel.push > 0.0:
            self.writes = (*self.writes, "external")
            self.reads = (*self.reads, "external") if windy else self.reads
        self.candidates, self.fidelity, self.pairs, self.apart = candidates, fidelity, pairs, apart
        self.find, self.mark_ring = Intersections, mark_ring
        self.ease = Ease(model, fidelity.easing) if fidelity.easing and self.strategy else None
        self.context = untangling.Context
        self.surface = model.surface
        self.inverse_masses, self.areas = model.inverse_masses, model.vertex_areas
        self.h0 = fidelity.h0 * model.mean_edge
        self.stack = np.zeros(model.vertex_count, np.int64)

    def run(self, frame: Frame) -> None:
        state, model, fidelity = frame.state, frame.model, self.fidelity
        self.apart[:] = False
        self.channel.begin(frame)
        if self._untouched(frame):
            return
        moved = False
        for _ in range(max(1, self.passes)):
            hits = self._look(frame)
            frame.count("edge_triangle_tests", hits.edge_triangle_tests)
            frame.count("hits", hits.hit_count)
            self.apart[:] = False
            if hits.hit_count == 0:
                state.memory[:] = 0.0
                break
            inside = None
            if self.strategy is not None:
                frame.untangling_passes += 1
                context = self.context(hits, self.inverse_masses, self.areas, self.h0, fidelity.g0, state.memory)
                moves, inside = self.answer(self.strategy, context)
                if self.ease and not moved:
                    self.ease.begin(state.positions)
                self.channel.apply(frame, moves[: model.vertex_count])
                moved = True
            if fidelity.contacts_near_hits != "keep":
                self._mark(model, hits, inside)
        if moved:
            if self.ease:
                self.ease.run(state.positions)
            # what is tangled soon goes elsewhere than expected
            self.pairs.look(frame, self.pairs.short)

    def _untouched(self, frame: Frame) -> bool:
        """Whether it is known without looking that nothing intersects."""
        if self.candidates.flat:  # decided for where everything is now, too
            frame.count("hits", 0)
            frame.state.memory[:] = 0.0
            return True
        return False

    def _look(self, frame: Frame) -> Any:
        """Intersections where everything is now."""
        x, tree = frame.state.positions, self.candidates.tree
        # boxes of the positions alone: those of the whole step hold many times as much
        tree.refit(x, x, 0.0)
        return self.find(x.copy(), self.surface, edge_face=self._seen(tree.edges_against_faces()))

    def _seen(self, edge_face: IntArray) -> IntArray:
        """(C, 2) what faulty detection does not ignore of the pairs that may intersect."""
        faults, surface = self.candidates.faults, self.surface
        if faults is None:
            return edge_face
        vertices = np.concatenate([surface.edges[edge_face[:, 0]], surface.faces[edge_face[:, 1]]], axis=1)
        return np.ascontiguousarray(edge_face[faults.seen(vertices)])

    def _mark(self, model: ClothModel, hits: Any, inside: Any) -> None:
        """Vertices around the hits, and inside enclosed regions: contact there would lock the wrong side."""
        edges, faces = self.surface.edges[hits.hit_edge], self.surface.faces[hits.hit_face]
        seeds = np.unique(np.concatenate([edges.ravel(), faces.ravel()])).astype(np.int64)
        start, neighbours, _ = model.surface.neighbourhood
        seeds = seeds[seeds < model.vertex_count]
        self.mark_ring(start, neighbours, seeds, self.fidelity.rings, self.apart, self.stack)
        if inside is not None:
            self.apart |= inside[: model.vertex_count]


class Ease:
    """Spreads what corrections have moved over the vertices around, until edges have the lengths that they had.

    Springs would do it too, in the first substeps, and keep it as speed: a centimetre in a third of a millisecond is 30 m/s.
    """

    RINGS = 4
    """Edges around what was moved that take part: a correction is no longer than some edges."""

    def __init__(self, model: ClothModel, sweeps: int) -> None:
        from clothgym.kernels.untangling import ease, mark_ring

        self.kernel, self.mark_ring, self.sweeps = ease, mark_ring, sweeps
        self.edges, self.inverse_masses = model.surface.edges, model.inverse_masses
        self.start, self.neighbours, _ = model.surface.neighbourhood
        self.before = np.zeros((model.vertex_count, 3))
        self.near = np.zeros(model.vertex_count, np.bool_)
        self.stack = np.zeros(model.vertex_count, np.int64)
        self.chosen, self.lengths = np.zeros(len(self.edges), np.int64), np.zeros(len(self.edges))

    def begin(self, x: FloatArray) -> None:
        """Positions (V, 3) [m] that corrections will move."""
        self.before[:] = x

    def run(self, x: FloatArray) -> None:
        """x (V, 3) [m] after the corrections is changed."""
        moved = np.flatnonzero((x != self.before).any(axis=1))
        self.near[:] = False
        self.mark_ring(self.start, self.neighbours, moved, self.RINGS, self.near, self.stack)
        self.kernel(
            x, self.before, self.edges, self.near, self.inverse_masses, self.sweeps, self.chosen, self.lengths
        )  # fmt: skip


class UntangleOnBody(Untangle):
    """The same with the bodies' true surfaces beside the cloth: infinitely heavy, and not against each other."""

    def __init__(self, candidates: Any, model: ClothModel, *others: Any) -> None:
        super().__init__(candidates, model, *others)
        from clothgym.body import joined, vertices_at
        from clothgym.detection.hierarchy import Hierarchy
        from clothgym.mesh import Surface, vertex_areas

        self.bodies, self.vertices_at = model.scene.bodies, vertices_at
        body, faces = joined(self.bodies)
        count = model.vertex_count
        self.surface = Surface(np.concatenate([model.faces, faces + count]), count + len(body))
        self.inverse_masses = np.concatenate([self.inverse_masses, np.zeros(len(body))])
        self.areas = np.concatenate([self.areas, vertex_areas(body, faces)])
        self.tree = Hierarchy(self.surface, np.concatenate([model.scene.start, body]))
        self.of_cloth = self.surface.edges[:, 0] < count, self.surface.faces[:, 0] < count
        self.name = f"{self.name[:-1]}, bodies]"

    def _untouched(self, frame: Frame) -> bool:
        return False

    def _look(self, frame: Frame) -> Any:
        x = np.concatenate([frame.state.positions, self.vertices_at(self.bodies, frame.state.time)])
        self.tree.refit(x, x, 0.0)
        edge_face = self._seen(self.tree.edges_against_faces())
        edges, faces = self.of_cloth
        chosen = edges[edge_face[:, 0]] | faces[edge_face[:, 1]]
        return self.find(x, self.surface, edge_face=np.ascontiguousarray(edge_face[chosen]))


class Channels:
    """What a correction changes [Volino 2006, 2.2]: positions, velocities, accelerations, or forces."""

    def __init__(self, model: ClothModel, fidelity: Fidelity, windy: bool) -> None:
        self.fidelity, self.windy, self.step = fidelity, windy, model.scene.step
        free = model.inverse_masses > 0.0
        mass = float(model.masses[free].mean()) if free.any() else 1.0
        self.push = 2.0 * fidelity.acceleration_share / self.step**2 + fidelity.penalty_stiffness / mass
        """[1/s^2] acceleration per correction. A force in proportion to each vertex's mass keeps momentum as the correction
        does, which moves light vertices further."""

    def begin(self, frame: Frame) -> None:
        """Of the last step's accelerations nothing is left; the wind's are new."""
        if self.push == 0.0:
            return
        if len(frame.external) == 0:
            frame.external = np.zeros((frame.model.vertex_count, 3))
        elif not self.windy:
            frame.external[:] = 0.0

    def apply(self, frame: Frame, moved: FloatArray) -> None:
        """Distributes a correction (V, 3) [m]; the speed that it gives a vertex ends at the speed limit."""
        state, fidelity = frame.state, self.fidelity
        state.positions += fidelity.displacement_share * moved
        if self.push > 0.0:
            frame.external += self.push * moved
        if fidelity.velocity_share == 0.0:
            return
        before = np.sqrt(np.einsum("ij,ij->i", state.velocities, state.velocities))
        state.velocities += (fidelity.velocity_share / self.step) * moved
        after = np.sqrt(np.einsum("ij,ij->i", state.velocities, state.velocities))
        allowed = np.maximum(before, fidelity.speed_limit)
        fast = after > allowed
        state.velocities[fast] *= (allowed[fast] / after[fast])[:, None]
