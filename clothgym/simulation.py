"""The simulation: reset, step, snapshot, restore."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clothgym import fidelity as fidelities
from clothgym import metrics
from clothgym.arrays import FARTHEST, FloatArray, IntArray, as_ids, as_points, check_number, read_only, shown
from clothgym.body import Body, named
from clothgym.errors import SimulationError
from clothgym.fidelity import Fidelity
from clothgym.model import ClothModel
from clothgym.pipeline import Pipeline, assemble
from clothgym.scene import Cloth, Scene
from clothgym.stages.frame import Frame
from clothgym.state import ClothState, Trace


class Simulation:
    """A scene at a fidelity, in time.

    Same scene, fidelity, seed and calls give the same bits on one machine and version.

    Args:
        scene: what exists.
        fidelity: "draft", "balanced", "accurate", or a `Fidelity`.

    Raises:
        ValueError: a setting that the scene cannot run with; the message names field, value and limit.
    """

    def __init__(self, scene: Scene, fidelity: str | Fidelity = "balanced") -> None:
        self.scene = scene
        self.fidelity = fidelities.get(fidelity)
        self.model = ClothModel(scene, self.fidelity)
        self.pipeline: Pipeline = assemble(self.model, self.fidelity)
        self.reset()

    def reset(self, seed: int | None = None) -> None:
        """Back to the start of the scene. Scenes are made from seeds of their own; nothing in a step is random.

        Raises:
            ValueError: a seed that is no integer.
        """
        if seed is not None:
            check_number(seed, "seed", -(2**63), 2**64, integer=True)
        grips = len(self.scene.grips)
        self._state = ClothState(
            self.scene.start.copy(),
            np.zeros((self.model.vertex_count, 3)),
            0.0,
            0,
            np.zeros((grips, 3)),
            np.zeros((grips, 3)),
            np.zeros(0, np.int32),
            np.zeros(0, np.int32),
            np.zeros((0, 3)),
            self.pipeline.memory,
        )
        self._frame = Frame(self.model, self._state)
        self._grip_forces: FloatArray = np.zeros((grips, 3))
        self._body_forces: FloatArray = np.zeros((self.model.vertex_count if self.scene.bodies else 0, 3))
        self._intersections: Any = None
        self._trace = Trace()
        self.pipeline.forget()
        for entry in self.pipeline.profile.values():
            entry[:] = [0, 0.0]

    def step(self, count: int = 1) -> None:
        """Advances by `count` steps of `scene.step` seconds.

        Raises:
            SimulationError: the run diverged; the last finite state is kept.
        """
        for _ in range(int(check_number(count, "count", 0, 2**31, integer=True))):
            before = self._state.copy()
            self._trace.begin(before, self._frame.untangling_passes)
            self._frame.set_grips()
            try:
                diverged = self.pipeline.run(self._frame)
            except BaseException:
                self._restore(before)  # a stage that raises leaves no half of a step behind
                raise
            if diverged is not None:
                self._restore(before)
                remedy = "take more substeps or softer springs; the last finite state is kept"
                raise SimulationError(*diverged, before.time, remedy)
            self._move_grips()
            self._body_forces = self._frame.body_forces / self.pipeline.substeps
            self._state.time += self.scene.step
            self._state.step += 1
            self._intersections = None

    def __getstate__(self) -> dict[str, Any]:
        """What a copy is made from: kernels, trees and buffers are made anew, so pickles and deep copies are exact."""
        return {
            "scene": self.scene,
            "fidelity": self.fidelity,
            "state": self._state.copy(),
            "forces": self.measured_forces(),
            "clamped": self._frame.clamped,
            "untangling_passes": self._frame.untangling_passes,
            "work": dict(self._frame.work),
            "unbalanced": self._frame.unbalanced,
            "trace": self._trace,
        }

    def __setstate__(self, values: dict[str, Any]) -> None:
        self.__init__(values["scene"], values["fidelity"])  # type: ignore[misc]
        self._restore(values["state"])
        self.set_measured_forces(values["forces"])
        self._frame.untangling_passes = values["untangling_passes"]
        self._frame.clamped = values["clamped"]
        self._frame.work = values["work"]
        self._frame.unbalanced = values["unbalanced"]
        self._trace = values["trace"]

    # --- what can be read -------------------------------------------------------------------------------------------

    @property
    def positions(self) -> FloatArray:
        """(V, 3) [m], read-only view."""
        return read_only(self._state.positions)

    @property
    def velocities(self) -> FloatArray:
        """(V, 3) [m/s], read-only view."""
        return read_only(self._state.velocities)

    @property
    def faces(self) -> IntArray:
        """(F, 3), read-only view."""
        return read_only(self.model.faces)

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._state.time

    @property
    def step_count(self) -> int:
        """Steps since reset."""
        return self._state.step

    @property
    def cloth_ranges(self) -> list[tuple[str, slice, slice]]:
        """(name, vertex slice, face slice) of each cloth."""
        return list(self.model.ranges)

    @property
    def body_forces(self) -> FloatArray:
        """(V, 3) [N] mean force of the bodies on each vertex over the last step; (0, 3) in a scene without bodies."""
        return read_only(self._body_forces)

    @property
    def body_parts(self) -> tuple[str, ...]:
        """Names (P,) of what `contact_force` tells apart: bodies, or "body: part"."""
        return self._body_parts()[0]

    def contact_force(self) -> FloatArray:
        """(P, 3) [N] mean force of each body part on the cloth over the last step; their sum is that of `body_forces`.

        A vertex was pushed by the part whose surface is nearest to it. Costs nothing unless it is called.
        """
        if not self.scene.bodies:
            return np.zeros((0, 3))
        names, part_of_face = self._body_parts()
        x = self._state.positions
        return metrics.contact_force(self._body_forces, x, self.body_mesh, part_of_face, len(names))

    def _body_parts(self) -> Any:
        if not hasattr(self, "_parts"):
            from clothgym.body import part_numbers

            self._parts = part_numbers(self.scene.bodies) if self.scene.bodies else ((), np.zeros(0, np.int32))
        return self._parts

    @property
    def body_mesh(self) -> Any:
        """The bodies' true surface now, a `detection.body_mesh.BodyMesh`: exact distances, for measuring.

        Raises:
            ValueError: the scene has no bodies.
        """
        if not self.scene.bodies:
            raise ValueError("body_mesh: the scene has no bodies")
        if not hasattr(self, "_body_mesh"):
            from clothgym.body import joined
            from clothgym.detection.body_mesh import BodyMesh, still

            bodies = tuple(self.scene.bodies)
            self._body_mesh = BodyMesh(*joined(bodies)) if self.scene.moving else still(bodies)
        if self.scene.moving:
            from clothgym.body import vertices_at

            self._body_mesh.move(vertices_at(self.scene.bodies, self._state.time))
        return self._body_mesh

    @property
    def body_meshes(self) -> list[tuple[str, FloatArray, IntArray]]:
        """(name, vertices (B, 3) [m] now, faces) of each body that moves; those that share a name are numbered."""
        bodies = [(name, body) for name, body in named(self.scene.bodies) if body.motion is not None]
        return [(name, body.at(self._state.time), body.mesh.faces) for name, body in bodies]

    def penetration_depth(self) -> float:
        """Depth [m] of the deepest vertex or midpoint of a face below the bodies' true surface; 0 without bodies."""
        if not self.scene.bodies:
            return 0.0
        x = self._state.positions
        points = np.concatenate([x, x[self.model.faces].mean(axis=1)])
        return float(max(0.0, -self.body_mesh.signed_distance(points).min()))

    @property
    def profile(self) -> dict[str, tuple[int, float]]:
        """Stage name -> (calls, wall seconds) since reset; stages of pairs are left out of steps in which nothing can touch."""
        return {name: (int(calls), seconds) for name, (calls, seconds) in self.pipeline.profile.items()}

    @property
    def untangling_passes(self) -> int:
        """Passes of untangling since reset."""
        return self._frame.untangling_passes

    @property
    def last_intersections(self) -> Any:
        """Intersections of the current state, found once per state."""
        if self._intersections is None:
            from clothgym.detection.intersections import Intersections

            tree = self._detector()
            x = self._state.positions.copy()
            tree.refit(x, x, 0.0)
            self._intersections = Intersections(x, self.model.surface, edge_face=tree.edges_against_faces())
        return self._intersections

    def _detector(self) -> Any:
        """A tree of its own for looking, so that looking never touches what the stages use."""
        if not hasattr(self, "_looking_tree"):
            from clothgym.detection.hierarchy import Hierarchy

            self._looking_tree = Hierarchy(self.model.surface, self.scene.start)
        return self._looking_tree

    def metrics(self) -> dict[str, Any]:
        """Numbers of the current state.

        contour_length [m], contour_count, hits, max_strain (largest edge length / rest length - 1), penetration_depth [m]
        (of vertices and midpoints of faces below the true surface of the bodies), kinetic_energy and potential_energy
        [J], max_speed [m/s], time [s], clamped (vertices that layers or body parts pressed from opposite sides, harder than
        they could give way, in the last step), tunnel_events (pairs that passed each other since reset, as far as
        `Fidelity.continuous` looks for them), untangling_passes (since reset), work (counters since reset), flags (see
        `flags`).
        """
        x, v = self._state.positions, self._state.velocities
        hits = self.last_intersections
        return {
            "time": self._state.time,
            "contour_length": hits.length,
            "contour_count": hits.contour_count,
            "hits": hits.hit_count,
            "max_strain": metrics.max_strain(self.model, x),
            "penetration_depth": self.penetration_depth(),
            "kinetic_energy": metrics.kinetic_energy(self.model, v),
            "potential_energy": metrics.potential_energy(self.model, x),
            "max_speed": float(np.sqrt((v * v).sum(axis=1).max())),
            "clamped": self._frame.clamped,
            "tunnel_events": self._frame.work.get("tunnel_events", 0),
            "untangling_passes": self._frame.untangling_passes,
            "work": dict(self._frame.work),
            "flags": self.flags(),
        }

    def flags(self) -> tuple[str, ...]:
        """What is wrong with the current state although the run goes on, one line each, empty when all is well.

        Each begins with its kind: stretch, compression, speed, rounding, zones, unproved, tunnelled, clamped,
        unbalanced or energy (see `metrics.flags`).
        """
        state, frame = self._state, self._frame
        found = metrics.flags(self.model, state.positions, state.velocities, self.pipeline.dt)
        found += metrics.work_flags(self.model, frame.work, self.pipeline.substeps, frame.clamped, frame.unbalanced)
        start = self._trace.untouched(len(state.held_vertices))
        if start is not None and self.scene.calm:
            own = frame.untangling_passes == self._trace.passes
            share = metrics.ENERGY if own else metrics.ENERGY_UNTANGLED
            found += metrics.energy_flags(self.model, start, state.positions, state.velocities, share)
        return found

    # --- what can be set --------------------------------------------------------------------------------------------

    def set_positions(self, positions: ArrayLike) -> None:
        """Copies (V, 3) [m]. Raises ValueError for a wrong shape or an entry that is not finite or beyond 1e9."""
        self._state.positions[:] = as_points(positions, "positions", self.model.vertex_count, FARTHEST)
        self.pipeline.forget()
        self._intersections, self._trace = None, Trace()

    def set_velocities(self, velocities: ArrayLike) -> None:
        """Copies (V, 3) [m/s]. Raises ValueError for a wrong shape or an entry that is not finite or beyond 1e9."""
        self._state.velocities[:] = as_points(velocities, "velocities", self.model.vertex_count, FARTHEST)
        self._trace = Trace()

    def snapshot(self) -> ClothState:
        """An independent copy of the state, for `restore`."""
        return self._state.copy()

    def measured_forces(self) -> tuple[FloatArray, FloatArray]:
        """Copies of `grip_forces` and `body_forces`: measurements of the last step, no part of the state; planners keep
        them beside a snapshot."""
        return self._grip_forces.copy(), self._body_forces.copy()

    def set_measured_forces(self, forces: tuple[ArrayLike, ArrayLike]) -> None:
        """What `grip_forces` and `body_forces` show until the next step, from `measured_forces`."""
        self._grip_forces[:] = as_points(forces[0], "grip forces", len(self._grip_forces))
        self._body_forces = as_points(forces[1], "body forces", len(self._body_forces)).copy()

    def restore(self, snapshot: ClothState) -> None:
        """Back to a snapshot of this simulation, bit for bit.

        Raises:
            ValueError: no snapshot, that of another scene, or one with numbers that are not finite.
        """
        if not isinstance(snapshot, ClothState):
            raise ValueError(f"snapshot = {shown(snapshot)}: expected what snapshot() gave")
        snapshot.check(self.model.vertex_count, len(self.scene.grips), len(self.pipeline.memory))
        self._restore(snapshot)

    def _restore(self, snapshot: ClothState) -> None:
        self._state = snapshot.copy()
        if len(self._state.memory) == 0:  # of a run whose strategy remembers nothing
            self._state.memory = self.pipeline.memory
        self._frame.state = self._state
        self.pipeline.forget()
        self._intersections, self._trace = None, Trace()

    def state_hash(self) -> str:
        """Digest of every bit of the state."""
        return self._state.hash()

    # --- what can come and go ---------------------------------------------------------------------------------------

    def add(self, thing: Cloth | Body) -> None:
        """Puts a cloth or a body into the scene while the simulation runs; everything else goes on as it was.

        A cloth starts where its mesh is, at rest. `scene` becomes a new scene, and `reset` goes back to its start.

        Raises:
            ValueError: neither cloth nor body, or something of that name is there already.
        """
        if not isinstance(thing, Cloth | Body):
            raise ValueError(f"add: expected a Cloth or a Body, got {type(thing).__name__}")
        if thing.name in self._names():
            raise ValueError(f"add: name = {thing.name!r}: the scene has something of that name already")
        if isinstance(thing, Cloth):
            self._become(dataclasses.replace(self.scene, cloths=(*self.scene.cloths, thing)))
        else:
            self._become(dataclasses.replace(self.scene, bodies=(*self.scene.bodies, thing)))

    def remove(self, name: str) -> None:
        """Takes a cloth or a body out of the scene while the simulation runs; grippers lose what they held of it.

        Raises:
            ValueError: nothing, or more than one thing, of that name; or the last cloth.
        """
        scene = self.scene
        found = self._names().count(name)
        if found != 1:
            raise ValueError(f"remove: name = {name!r}: the scene has {found} things of that name")
        cloths = tuple(cloth for cloth in scene.cloths if cloth.name != name)
        if not cloths:
            raise ValueError(f"remove: name = {name!r}: a scene needs at least one cloth")
        bodies = tuple(body for body in scene.bodies if body.name != name)
        self._become(dataclasses.replace(scene, cloths=cloths, bodies=bodies))

    def _names(self) -> list[str]:
        return [cloth.name for cloth in self.scene.cloths] + [body.name for body in self.scene.bodies]

    def _become(self, scene: Scene) -> None:
        """Goes on with another scene: what both have keeps its state."""
        old, old_scene, old_ranges = self._state, self.scene, self.model.ranges
        grip_forces, passes, work = self._grip_forces.copy(), self._frame.untangling_passes, dict(self._frame.work)
        slices = {id(cloth): vertices for cloth, (_, vertices, _) in zip(old_scene.cloths, old_ranges)}
        self.scene, self.model = scene, ClothModel(scene, self.fidelity)
        self.pipeline = assemble(self.model, self.fidelity)
        for kept in ("_looking_tree", "_body_mesh", "_parts"):  # made for the old scene
            self.__dict__.pop(kept, None)
        self.reset()
        new, number = self._state, np.full(len(old.positions), -1)
        for cloth, (_, vertices, _) in zip(scene.cloths, self.model.ranges):
            before = slices.get(id(cloth))
            if before is None:
                continue
            new.positions[vertices], new.velocities[vertices] = old.positions[before], old.velocities[before]
            number[before] = np.arange(vertices.start, vertices.stop)
        held = number[old.held_vertices]
        new.held_vertices = held[held >= 0].astype(np.int32)
        new.held_by, new.held_offsets = old.held_by[held >= 0].copy(), old.held_offsets[held >= 0].copy()
        new.grip_positions[:], new.grip_velocities[:] = old.grip_positions, old.grip_velocities
        new.time, new.step = old.time, old.step
        self._grip_forces, self._frame.untangling_passes, self._frame.work = grip_forces, passes, work

    # --- grippers ---------------------------------------------------------------------------------------------------

    @property
    def grip_positions(self) -> FloatArray:
        """(G, 3) [m], read-only view."""
        return read_only(self._state.grip_positions)

    @property
    def grip_forces(self) -> FloatArray:
        """(G, 3) [N] mean force of each gripper on the cloth over the last step."""
        return read_only(self._grip_forces)

    def held(self, grip: int) -> IntArray:
        """Ids of the vertices that a gripper holds."""
        return self._state.held_vertices[self._state.held_by == self._grip(grip)]

    def _grip(self, grip: int) -> int:
        known = isinstance(grip, int | np.integer) and not isinstance(grip, bool) and 0 <= grip < len(self.scene.grips)
        if not known:
            raise ValueError(f"grip = {shown(grip)}: the scene has {len(self.scene.grips)} grippers, numbered from 0")
        return int(grip)

    def place_grip(self, grip: int, position: ArrayLike) -> None:
        """Puts a gripper somewhere [m]; what it holds goes along at the next step, by its anchor."""
        self._state.grip_positions[self._grip(grip)] = as_points(np.atleast_2d(position), "position", 1, FARTHEST)[0]

    def move_grip(self, grip: int, velocity: ArrayLike) -> None:
        """Velocity [m/s] of a gripper from the next step on."""
        self._state.grip_velocities[self._grip(grip)] = as_points(np.atleast_2d(velocity), "velocity", 1, FARTHEST)[0]

    def grasp(self, grip: int, vertices: ArrayLike | None = None) -> int:
        """Closes a gripper on the given vertices, or on all within its radius; returns how many it holds now."""
        grip = self._grip(grip)
        centre = self._state.grip_positions[grip]
        if vertices is None:
            distance = np.linalg.norm(self._state.positions - centre, axis=1)
            chosen = np.flatnonzero(distance <= self.scene.grips[grip].radius)
        else:
            chosen = np.unique(as_ids(vertices, "vertices", self.model.vertex_count))
        chosen = chosen[~np.isin(chosen, self._state.held_vertices)]
        state = self._state
        state.held_vertices = np.concatenate([state.held_vertices, chosen]).astype(np.int32)
        state.held_by = np.concatenate([state.held_by, np.full(len(chosen), grip)]).astype(np.int32)
        state.held_offsets = np.concatenate([state.held_offsets, state.positions[chosen] - centre])
        return int((state.held_by == grip).sum())

    def release(self, grip: int) -> None:
        """Opens a gripper."""
        self._keep(self._state.held_by != self._grip(grip))

    def _keep(self, kept: Any) -> None:
        state = self._state
        state.held_vertices = state.held_vertices[kept]
        state.held_by = state.held_by[kept]
        state.held_offsets = state.held_offsets[kept]

    def _move_grips(self) -> None:
        """Grippers at the end of the step; vertices whose anchor reached its limit slip, and are lost beyond the reach."""
        state = self._state
        if len(self.scene.grips) == 0:
            return
        state.grip_positions += self.scene.step * state.grip_velocities
        self._grip_forces[:] = 0.0
        if len(state.held_vertices) == 0:
            return
        grips = self._frame.grips
        forces = grips.forces / self.pipeline.substeps
        np.add.at(self._grip_forces, state.held_by, forces)
        slipping = np.linalg.norm(forces, axis=1) >= 0.999 * grips.force_limit
        if slipping.any():
            offsets = state.positions[state.held_vertices] - state.grip_positions[state.held_by]
            state.held_offsets[slipping] = offsets[slipping]
            reach = np.array([self.scene.grips[g].radius for g in state.held_by])
            self._keep(~(slipping & (np.linalg.norm(offsets, axis=1) > reach)))
