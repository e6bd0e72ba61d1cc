"""Several objects and their k-DOP hierarchies, with every technique of [Mezger 2003] as a switch, counted.

scene = DopScene(inflation="conservative", cones="exact")
table = scene.add(table_vertices, table_faces, cloth=False)
cloth = scene.add(cloth_vertices, cloth_faces)
scene.update(cloth, positions, velocities, dt)
near = scene.collide(0.002)                      # {(table, cloth): ..., (cloth, cloth): ...}

This is the study of the paper beside the detection that the simulation uses (`detection.hierarchy`): it measures what pays.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import FloatArray, IntArray, check_choice, check_number
from clothgym.detection.descent import Descent
from clothgym.detection.dop_near import Near, empty_reports, filled, of_second, particles
from clothgym.detection.dop_object import DopObject
from clothgym.kernels import cones as cone_kernels
from clothgym.kernels import continuous, dop_primitives, dop_traversal, kdop, oriented
from clothgym.kernels.dop_primitives import Reports

_COUNTS = ("box_tests", "leaf_pairs", "cone_tests", "cone_pruned", "filtered", "reused", "stops", "outline_tests")
_LARGEST = 20_000_000


@dataclass
class _Link:
    """What is kept of two objects from one `collide` to the next."""

    descent: Descent
    stops: Any = None
    age: int = 0
    first_stops: int = 0
    kept: Near | None = None
    slack: Any = None
    reach: float = -1.0
    pair_count: int = 0
    out: Any = None


class DopScene:
    """Proximities of several objects.

    Args:
        k, arity: half-spaces of a box, children of a node.
        inflation: "unoriented" (eps / 2 on all sides: what is near now), "oriented" (eq. 1 as printed), "conservative" (with
            the half-angle of the cone) or "swept" (around both ends of every way): what comes near within the step.
        cones: pruning of self-collision: "none", "mezger" (the apex angle alone) or "exact" (with the outline).
        close_angle, leaf_angle: apex angle [rad] from which "mezger" looks for self-collision, and the least angle of two faces
            in the same or adjacent groups (0: all are tested, adjacent ones too).
        wide: half-angle [rad] from which a velocity cone has no direction.
        groups: level of the tree whose nodes are the face groups, also of lazy update and coherence.
        lazy: b [m]: what a vertex may be off before the boxes of its group are refitted; less than eps / 2. Pairs nearer than
            eps - 2 b are found for sure.
        coherence: keep the last pairs of groups whose relative ways since then stay below eps, with their barycentrics.
        separation_list: resume where the last descent stopped, and start anew every `list_period` times.
        build_space: "pose", or "pattern" for the cloths.
        self_collision: whether cloths are tested against themselves.
        vertex_only: the vertices of cloths against faces, no edges, nothing of bodies against cloth: what the paper rejects.
        virtual_particles: this many points more on each triangle of a cloth; edges are not tested then.

    Attributes:
        counters: sums since the start: seconds, refitted nodes, tests.

    Raises:
        ValueError: names the field, value and range.
    """

    def __init__(
        self,
        k: int = 18,
        arity: int = 4,
        inflation: str = "conservative",
        cones: str = "exact",
        *,
        close_angle: float = 0.5 * math.pi,
        leaf_angle: float = 0.0,
        wide: float = math.pi / 3.0,
        groups: int = 2,
        lazy: float = 0.0,
        coherence: bool = False,
        separation_list: bool = False,
        list_period: int = 16,
        build_space: str = "pose",
        self_collision: bool = True,
        vertex_only: bool = False,
        virtual_particles: int = 0,
    ) -> None:
        check_choice(str(k), "k", tuple(str(n) for n in kdop.AXES))
        check_choice(str(arity), "arity", ("2", "4", "8"))
        check_number(groups, "groups", 0, 8, integer=True)
        check_number(virtual_particles, "virtual_particles", 0, 66, integer=True)
        self.k, self.arity, self.depth = k, arity, int(groups)
        self._mode = oriented.INFLATIONS[check_choice(inflation, "inflation", tuple(oriented.INFLATIONS))]
        self._cones = dop_traversal.CONES[check_choice(cones, "cones", tuple(dop_traversal.CONES))]
        self._pattern = check_choice(build_space, "build_space", ("pose", "pattern")) == "pattern"
        self._close_angle = float(check_number(close_angle, "close_angle", 0.0, math.pi))
        self._leaf_angle = float(check_number(leaf_angle, "leaf_angle", 0.0, math.pi))
        self._wide = float(check_number(wide, "wide", 0.0, math.pi))
        self.lazy = float(check_number(lazy, "lazy", 0.0, 1.0))
        self._coherence, self._resume, self._period = coherence, separation_list, list_period
        self._self_collision = self_collision
        self._samples = particles(virtual_particles)
        self._partial = vertex_only or virtual_particles > 0
        if leaf_angle > 0.0 and cones == "exact":
            raise ValueError(f"leaf_angle = {leaf_angle!r}: skips pairs; expected 0 with cones = 'exact'")
        if coherence and (self._partial or lazy > 0.0):
            raise ValueError("coherence = True: expected lazy = 0, vertex_only = False and virtual_particles = 0")
        self._objects: dict[int, DopObject] = {}
        self._cloths: dict[int, bool] = {}
        self._links: dict[tuple[int, int], _Link] = {}
        self._next = 0
        self._last: dict[int, Any] = {}
        self._counts = np.zeros(8, np.int64)
        self.counters: dict[str, float] = {}
        self.reset_counters()

    def reset_counters(self) -> None:
        """All counters at zero."""
        names = (
            "hierarchy_seconds", "collision_seconds", "self_seconds", "refits", *_COUNTS, "primitive_tests", "reused_pairs",
        )  # fmt: skip
        self.counters = dict.fromkeys(names, 0)

    def add(self, vertices: ArrayLike, faces: ArrayLike, cloth: bool = True, pattern: ArrayLike | None = None) -> int:
        """A new object, at any time; the others keep all they hold. Returns its id.

        Args:
            vertices: (V, 3) [m].
            faces: (F, 3), or (F, 4): quads, which have one leaf and stand for two triangles.
            cloth: bodies are tested against cloths only.
            pattern: (V, 2) or (V, 3) places without strain for build_space = "pattern".

        Raises:
            ValueError: as `DopObject`, or the pattern of a cloth is missing.
        """
        if self._pattern and cloth and pattern is None:
            raise ValueError("pattern = None: build_space = 'pattern' needs one for every cloth")
        places = pattern if self._pattern and cloth else None
        regions = cloth and self._cones == dop_traversal.EXACT
        number, self._next = self._next, self._next + 1
        self._objects[number] = DopObject(vertices, faces, places, self.k, self.arity, self.depth, regions)
        self._cloths[number] = cloth
        return number

    def remove(self, number: int) -> None:
        """Takes an object out; the others keep all they hold."""
        self._object(number)
        del self._objects[number], self._cloths[number]
        self._last.pop(number, None)
        self._links = {key: link for key, link in self._links.items() if number not in key}

    def update(self, number: int, positions: ArrayLike, velocities: ArrayLike | None = None, dt: float = 0.0) -> None:
        """New positions (V, 3) [m] of an object, and the velocities (V, 3) [m/s] it is expected to have for dt [s].

        Raises:
            ValueError: no such object, wrong shapes, or numbers that are not finite.
        """
        check_number(dt, "dt", 0.0, 1e6)
        self._object(number).update(positions, velocities, dt)

    def _object(self, number: int) -> DopObject:
        if number not in self._objects:
            raise ValueError(f"object {number!r}: expected one of {sorted(self._objects)}")
        return self._objects[number]

    def object_pairs(self) -> list[tuple[int, int]]:
        """Which objects are tested: (i, j) with i < j if one is a cloth, (i, i) for cloths."""
        ids = sorted(self._objects)
        return [
            (i, j)
            for n, i in enumerate(ids)
            for j in ids[n:]
            if (i == j and self._cloths[i] and self._self_collision)
            or (i != j and (self._cloths[i] or self._cloths[j]))
        ]

    def collide(self, epsilon: float) -> dict[tuple[int, int], Near]:
        """All pairs of primitives nearer than epsilon [m] now or, unless unoriented, possibly within the step.

        Raises:
            ValueError: epsilon out of range, or not above 2 b of the lazy update.
        """
        check_number(epsilon, "epsilon", 0.0, 1e3)
        if epsilon < 2.0 * self.lazy:
            raise ValueError(f"epsilon = {epsilon!r}: expected at least 2 b = {2.0 * self.lazy:g} of the lazy update")
        margin = epsilon if self._coherence else 0.0
        started = time.perf_counter()
        tight = {dop_traversal.NO_CONES: -1, dop_traversal.PAPER: 0, dop_traversal.EXACT: 1}[self._cones]
        speeds = (self._cones == dop_traversal.EXACT and self._mode != oriented.UNORIENTED) or self._coherence
        for number, item in self._objects.items():
            cloth = self._cloths[number]
            wants_speeds = (speeds and cloth and item.moving) or self._coherence
            self.counters["refits"] += item.refit(
                epsilon + margin, self._mode, self._wide, self.lazy, tight if cloth else -1, wants_speeds
            )
        now = time.perf_counter()
        self.counters["hierarchy_seconds"] += now - started
        found = {}
        steps = self._steps() if self._coherence else {}
        for i, j in self.object_pairs():
            before = time.perf_counter()
            found[i, j] = self._between(i, j, epsilon, margin, steps)
            if i == j:
                self.counters["self_seconds"] += time.perf_counter() - before
        self.counters["collision_seconds"] += time.perf_counter() - now
        return found

    def candidates(self, key: tuple[int, int]) -> IntArray:
        """(C, 2) pairs of polygons that the last `collide` looked at; reused ones are not among them."""
        link = self._links[key]
        return link.descent.pairs[: link.pair_count]

    def _between(self, i: int, j: int, epsilon: float, margin: float, steps: dict[int, Any]) -> Near:
        a, b = self._objects[i], self._objects[j]
        link = self._links.setdefault((i, j), _Link(Descent(self._resume)))
        moving = self._mode != oriented.UNORIENTED
        skip = np.zeros((0, 0), np.uint8)
        kept = None
        if self._coherence:
            skip, kept = self._reusable(link, i, j, epsilon, steps)
        pairs = self._candidates(link, a, b, i == j, epsilon + margin, moving, skip)
        near = self._exact(link, a, b, i == j, epsilon, margin, pairs, self._wanted(i, j), moving)
        if not self._coherence:
            return near
        merged = near.taken(slice(None))
        if kept is not None:
            merged = Near(*(np.concatenate([getattr(kept, n), getattr(near, n)]) for n in near.__dataclass_fields__))
        link.kept = merged = Near(*(np.array(getattr(merged, n)) for n in near.__dataclass_fields__))
        within = np.empty(len(merged), np.uint8)
        slack = link.slack[a.polygon_group[merged.polygons[:, 0]], b.polygon_group[merged.polygons[:, 1]]]
        dop_primitives.refresh(
            a.shape(moving), b.shape(moving), epsilon, np.ascontiguousarray(slack),
            Reports(merged.quads, merged.kinds, merged.weights, merged.distances, merged.polygons), within,
        )  # fmt: skip
        return merged.taken(within.astype(np.bool_))

    def _steps(self) -> dict[int, Any]:
        """Trees of the objects with the cones of their ways since the last `collide`."""
        trees = {}
        for number, item in self._objects.items():
            nodes = len(item.tree.child_count)
            last = self._last.get(number, item.positions)
            tree = item.tree._replace(
                speed_axis=np.zeros((nodes, 3)), speed_half=np.zeros(nodes), speed_low=np.zeros(nodes),
                speed_high=np.zeros(nodes),
            )  # fmt: skip
            cone_kernels.velocity_cones(tree, item.positions - last, 0, np.ones(nodes, np.uint8))
            trees[number] = tree
            self._last[number] = item.positions.copy()
        return trees

    def _reusable(self, link: _Link, i: int, j: int, epsilon: float, steps: dict[int, Any]) -> tuple[Any, Near | None]:
        """Pairs of groups whose relative way since their last test, and in the coming step, is within the margin."""
        a, b = self._objects[i], self._objects[j]
        past = np.zeros((len(a.group_nodes), len(b.group_nodes)))
        cone_kernels.group_travel(steps[i], a.group_nodes, steps[j], b.group_nodes, past)
        future = np.zeros_like(past)
        if self._mode != oriented.UNORIENTED:
            cone_kernels.group_travel(a.tree, a.group_nodes, b.tree, b.group_nodes, future)
        if link.kept is None or link.reach != epsilon:
            link.slack, link.kept, link.reach = np.zeros_like(past), None, epsilon
            return np.zeros_like(past, np.uint8), None
        link.slack = link.slack + past
        skip = np.ascontiguousarray(link.slack + future <= epsilon, np.uint8)
        link.slack[skip == 0] = 0.0
        groups = a.polygon_group[link.kept.polygons[:, 0]], b.polygon_group[link.kept.polygons[:, 1]]
        kept = link.kept.taken(skip[groups] == 1)
        self.counters["reused_pairs"] += len(kept)
        return skip, kept

    def _candidates(
        self, link: _Link, a: DopObject, b: DopObject, same: bool, reach: float, moving: bool, skip: Any
    ) -> IntArray:
        """(C, 2) polygons whose boxes overlap."""
        rules = dop_traversal.Rules(
            self._cones if same else dop_traversal.NO_CONES, self._close_angle, self._leaf_angle,
            reach + 2.0 * self.lazy, 1.0 if moving and a.seen_ways.any() else 0.0,
        )  # fmt: skip
        start = np.zeros((1, 2), np.int64)
        if self._resume and link.stops is not None and link.age < self._period:
            start = link.stops
        found, stopped = link.descent.run(
            a.tree, b.tree, 1 if same else 0, a.seen, a.lengths, rules, skip, start, counts=self._counts
        )
        for name, count in zip(_COUNTS, self._counts.tolist()):
            self.counters[name] += count
        if self._resume:
            link.age = 1 if len(start) == 1 else link.age + 1
            link.stops = link.descent.stops[:stopped].copy()
        link.pair_count = found
        return link.descent.pairs[:found]

    def _wanted(self, i: int, j: int) -> int:
        """Kinds to look for, as bits."""
        if not self._partial:
            return 3 if i == j else 7
        vertices = (1 if self._cloths[i] else 0) | (4 if self._cloths[j] and i != j else 0)
        particles = (8 if self._cloths[i] else 0) | (16 if self._cloths[j] and i != j else 0)
        return vertices | (particles if len(self._samples) else 0)

    def _exact(
        self, link: _Link, a: DopObject, b: DopObject, same: bool, epsilon: float, margin: float, pairs: IntArray,
        wanted: int, moving: bool,
    ) -> Near:  # fmt: skip
        if link.out is None:
            link.out = empty_reports(1024)
        first, second = a.shape(moving), b.shape(moving)
        while True:
            found, total = 0, 0
            for kind in range(5):
                if kind == dop_primitives.EDGE_EDGE and wanted & 2:
                    found, tests = dop_primitives.find_edges(
                        first, second, int(same), epsilon, margin, pairs, found, link.out
                    )
                    total += tests
                elif kind != dop_primitives.EDGE_EDGE and wanted & 1 << kind:
                    swapped = kind in (dop_primitives.TRIANGLE_VERTEX, dop_primitives.TRIANGLE_PARTICLE)
                    for flip in (0, 1) if same else (int(swapped),):
                        found, tests = dop_primitives.find_vertices(
                            second if swapped else first, first if swapped else second, flip, int(same), epsilon, margin,
                            kind, self._samples, pairs, found, link.out,
                        )  # fmt: skip
                        total += tests
            if found <= len(link.out.kinds):
                break
            link.out = empty_reports(int(1.3 * found) + 64)
        self.counters["primitive_tests"] += total
        return filled(link.out, found)

    # What the techniques are judged by

    def brute_force(self, epsilon: float) -> dict[tuple[int, int], Near]:
        """What `collide` would answer without a hierarchy, from all pairs of polygons, with the ways of the step.

        Raises:
            ValueError: more than 20 million pairs.
        """
        found = {}
        for i, j in self.object_pairs():
            a, b = self._objects[i], self._objects[j]
            m, n = len(a.corners), len(b.corners)
            if m * n > _LARGEST:
                raise ValueError(f"brute force: {m} x {n} pairs of polygons; at most {_LARGEST}")
            rows, columns = np.triu_indices(m) if i == j else np.divmod(np.arange(m * n), n)
            pairs = np.ascontiguousarray(np.stack([rows, columns], axis=1), np.int32)
            spent = self.counters["primitive_tests"]
            found[i, j] = self._exact(
                _Link(Descent(False)), a, b, i == j, epsilon, 0.0, pairs, 3 if i == j else 7, True
            )
            self.counters["primitive_tests"] = spent
        return found

    def times(self, key: tuple[int, int], near: Near, epsilon: float) -> FloatArray:
        """First time (N,), as a share of the step, at which pairs come as near as epsilon [m]; inf = never. 0 = contact."""
        i, j = key
        a, b = self._object(i), self._object(j)
        shift = 0 if i == j else len(a.positions)
        x = a.positions if i == j else np.concatenate([a.positions, b.positions])
        ways = a.ways if i == j else np.concatenate([a.ways, b.ways])
        quads = near.quads + shift * of_second(near.kinds)
        times = np.empty(len(near))
        continuous.first_times(x, ways, quads.astype(np.int32), near.kinds, epsilon, times)
        return times

    def misses(
        self, answer: dict[tuple[int, int], Near], epsilon: float, reference: dict[tuple[int, int], Near] | None = None
    ) -> tuple[int, int]:
        """How many of the pairs that come within epsilon [m] in the step are not in an answer, and how many do come.

        Args:
            answer: of `collide`.
            epsilon: [m].
            reference: a list of pairs known to hold them all; None: `brute_force`.
        """
        missing = occurring = 0
        for key, near in (self.brute_force(epsilon) if reference is None else reference).items():
            true = near.taken(self.times(key, near, epsilon) <= 1.0).keys()
            occurring += len(true)
            missing += len(true - answer[key].keys())
        return missing, occurring
