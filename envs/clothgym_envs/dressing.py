"""What dressing tasks share: limbs, openings, how far on a garment is, and proof that nothing went on sideways.

A limb is a path with a radius, rooted far away at its start, free at its tip. An opening is a border loop of the garment.
The opening is *threaded* when the limb's path crosses its fan; +1 is the right way round (see `detection.openings`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from clothgym.arrays import FloatArray, IntArray, as_points, check_number, read_only
from clothgym.detection.openings import crossing_number

ROOTED = 10.0
"""[m] the path that threading is counted with goes on behind the root by this much: out of every garment's reach."""
CORE = 0.5
"""Share of a limb's radius. No border of cloth that stays on the skin comes that deep; see `passed_sideways`."""
UNSAFE_FORCE, FIRM_FORCE = 20.0, 10.0
"""[N] above the first, success is `success_unsafe`; above the second, force costs."""
MAX_STRAIN, MAX_PENETRATION, NEEDED_DEPTH = 0.15, 5e-3, 0.9
"""What success allows, and asks for."""
GRIPPER_RADIUS = 0.01
"""[m] grippers are spheres that cannot enter a limb."""


@dataclass(frozen=True, eq=False)
class LimbPath:
    """A limb as a polyline of capsules.

    Args:
        points: (N, 3) [m] from the root to the tip; the tip is the centre of the last cap.
        radius: of all capsules [m].

    Raises:
        ValueError: fewer than two points, a segment without length, a radius out of range.
    """

    points: FloatArray
    radius: float

    def __post_init__(self) -> None:
        points = as_points(self.points, "limb: points").copy()
        if len(points) < 2 or (np.linalg.norm(np.diff(points, axis=0), axis=1) < 1e-9).any():
            raise ValueError(f"limb: points: expected at least two, all apart, got {points.tolist()}")
        object.__setattr__(self, "points", read_only(points))
        object.__setattr__(self, "radius", check_number(self.radius, "limb: radius", 1e-6, 10.0))

    @property
    def tip(self) -> FloatArray:
        """(3,) [m]."""
        return self.points[-1]

    @cached_property
    def length(self) -> float:
        """From root to tip [m]."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    @cached_property
    def rooted(self) -> FloatArray:
        """(N, 3) the path with its root out of reach."""
        away = self.points[0] - self.points[1]
        return np.concatenate([self.points[:1] + ROOTED * away / np.linalg.norm(away), self.points[1:]])

    def closest(self, points: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Nearest places on the path (P, 3) [m], how far from the tip they are along it (P,) [m], and unit directions
        towards the root there (P, 3)."""
        x = np.atleast_2d(np.asarray(points, float))
        ends = self.points[1:]
        ways = self.points[:-1] - ends  # towards the root
        sizes = np.linalg.norm(ways, axis=1)
        share = np.clip(np.einsum("psc,sc->ps", x[:, None] - ends, ways) / sizes**2, 0.0, 1.0)
        places = ends + share[:, :, None] * ways
        best = np.linalg.norm(x[:, None] - places, axis=2).argmin(axis=1)
        rows = np.arange(len(x))
        before = np.append(np.cumsum(sizes[::-1])[::-1][1:], 0.0)  # from a segment's end to the tip
        along = before[best] + share[rows, best] * sizes[best]
        return places[rows, best], along, (ways / sizes[:, None])[best]

    def at(self, along: ArrayLike) -> FloatArray:
        """(P, 3) places so far from the tip [m]; negative lies in front of it."""
        s = np.atleast_1d(np.asarray(along, float))
        back = self.points[::-1]
        ways = np.diff(back, axis=0)
        sizes = np.linalg.norm(ways, axis=1)
        starts = np.concatenate([[0.0], np.cumsum(sizes)])[:-1]
        k = np.clip(np.searchsorted(starts, s, side="right") - 1, 0, len(sizes) - 1)
        return back[k] + ((s - starts[k]) / sizes[k])[:, None] * ways[k]

    def skin_distances(self, points: FloatArray) -> FloatArray:
        """(P,) signed distances of points (P, 3) from the skin [m], negative inside."""
        return path_distances(points, self.points) - self.radius

    def keep_out(self, point: ArrayLike, clearance: float = GRIPPER_RADIUS) -> FloatArray:
        """(3,) the nearest place to a point that is not nearer to the skin than the clearance."""
        p = np.asarray(point, float)
        for _ in range(len(self.points)):  # beside a bend, leaving one capsule may enter the next
            place = self.closest(p)[0][0]
            out = p - place
            distance = float(np.linalg.norm(out))
            if distance >= self.radius + clearance:
                break
            out = out / distance if distance > 1e-9 else np.array([0.0, 1.0, 0.0])
            p = place + (self.radius + clearance) * out
        return p

    def mesh(self, sections: int = 32) -> tuple[FloatArray, IntArray]:
        """Closed surface (vertices, faces) of a straight limb; its vertices lie on the capsule.

        Raises:
            ValueError: the path bends.
        """
        import trimesh

        if len(self.points) != 2:
            raise ValueError(f"limb: points: a capsule is straight, got a path of {len(self.points)} points")
        way = self.points[1] - self.points[0]
        solid = trimesh.creation.capsule(height=self.length, radius=self.radius, count=[sections, sections])
        solid.apply_translation([0.0, 0.0, 0.5 * self.length - solid.bounds.mean(axis=0)[2]])
        solid.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], way / self.length))
        return np.asarray(solid.vertices) + self.points[0], np.asarray(solid.faces, np.int32)


class Opening(NamedTuple):
    """Where an opening is."""

    centroid: FloatArray  # (3,) [m]
    normal: FloatArray  # (3,) right-hand rule around the loop; zero for a loop without area
    mean_radius: float  # [m] of its vertices from the centroid
    least_radius: float


def measure(loop: FloatArray) -> Opening:
    """Measures of a closed loop (N, 3) [m]."""
    centroid = loop.mean(axis=0)
    arms = loop - centroid
    following = np.concatenate([arms[1:], arms[:1]])
    area = np.array(
        [
            arms[:, 1] @ following[:, 2] - arms[:, 2] @ following[:, 1],
            arms[:, 2] @ following[:, 0] - arms[:, 0] @ following[:, 2],
            arms[:, 0] @ following[:, 1] - arms[:, 1] @ following[:, 0],
        ]
    )
    size = float(np.sqrt(area @ area))
    radii = np.sqrt(np.einsum("ij,ij->i", arms, arms))
    return Opening(centroid, area / size if size > 1e-12 else np.zeros(3), float(radii.mean()), float(radii.min()))


def threaded(loop: FloatArray, limb: LimbPath) -> int:
    """How often a limb goes through an opening; +1 = once, the way in which the loop's normal points to the tip."""
    return crossing_number(loop, limb.rooted)


def path_distances(points: FloatArray, path: FloatArray) -> FloatArray:
    """(P,) distances of points (P, 3) from a polyline (N, 3) [m]."""
    squared = np.full(len(points), np.inf)
    for k in range(len(path) - 1):
        way, r = path[k + 1] - path[k], points - path[k]
        share = np.minimum(np.maximum(r @ (way / (way @ way)), 0.0), 1.0)
        gap = r - share[:, None] * way
        squared = np.minimum(squared, np.einsum("ij,ij->i", gap, gap))
    return np.sqrt(squared)


def edge_distances(starts: FloatArray, ends: FloatArray, path: FloatArray) -> FloatArray:
    """(E,) least distance [m] of each segment (E, 3), (E, 3) from a polyline (N, 3)."""
    least = np.full(len(starts), np.inf)
    along = ends - starts
    a = np.einsum("ij,ij->i", along, along)
    for k in range(len(path) - 1):
        way = path[k + 1] - path[k]
        r = starts - path[k]
        e = float(way @ way)
        b, c, f = along @ way, np.einsum("ij,ij->i", along, r), r @ way
        spread = a * e - b * b
        # inner solution, then each of the four borders: the least of all is the distance
        s = np.divide(b * f - c * e, spread, out=np.zeros_like(a), where=spread > 1e-14 * a * e)
        candidates = [np.clip(s, 0.0, 1.0), np.zeros_like(a), np.ones_like(a)]
        for t in (0.0, 1.0):
            s = np.divide(t * b - c, a, out=np.zeros_like(a), where=a > 0.0)
            candidates.append(np.clip(s, 0.0, 1.0))
        for s in candidates:
            t = np.clip((f + s * b) / e, 0.0, 1.0)
            gap = r + s[:, None] * along - t[:, None] * way
            least = np.minimum(least, np.sqrt(np.einsum("ij,ij->i", gap, gap)))
    return least


def passed_sideways(before: FloatArray, after: FloatArray, limb: LimbPath) -> bool:
    """Whether a closed loop (N, 3) may have passed sideways through a limb between two states of a simulator step.

    True when an edge of the loop is inside the limb's core (the path with `CORE` of the radius) in either state, or
    when its two distances from the path do not add up to more than its way.

    What False proves, for vertices that move on straight lines: a point of an edge is never further from where it was
    than its share of the way, so its distance from the path is at least max(d0 - t m, d1 - (1 - t) m) > 0 when
    d0 + d1 > m. So the loop never touches the path, the crossing number with the fan can change only where an end of the
    path crosses the fan, and the root is out of reach: only the tip. Every simulator step is checked, so the number of an
    episode without True changed only by the tip. Steps are 1/60 s, a border moves some millimetres in one, and the core
    is centimetres thick: that the true ways bend within the step is covered as well.

    Rounding does not matter: the test is a margin of centimetres, and errs towards True.
    """
    core = CORE * limb.radius
    moved = np.sqrt(((after - before) ** 2).sum(axis=1).max())
    sides = np.sqrt(max(_longest(before), _longest(after)))
    # quick: vertices alone bound the distance of their edges, and the prolonged root bounds the path from below
    near = min(path_distances(before, limb.rooted).min(), path_distances(after, limb.rooted).min()) - 0.5 * sides
    if near >= core and 2.0 * near > moved:
        return False
    ways = np.sqrt(((after - before) ** 2).sum(axis=1))
    ways = np.maximum(ways, np.roll(ways, -1))
    first = edge_distances(before, np.roll(before, -1, axis=0), limb.rooted)
    second = edge_distances(after, np.roll(after, -1, axis=0), limb.rooted)
    return bool((np.minimum(first, second) < core).any() or (first + second <= ways).any())


def _longest(loop: FloatArray) -> float:
    """Square of the longest edge [m^2]."""
    sides = np.concatenate([loop[1:], loop[:1]]) - loop
    return float(np.einsum("ij,ij->i", sides, sides).max())


class Worn(NamedTuple):
    """An opening and its limb."""

    threaded: int  # crossing number, cut to -1, 0, 1; 0 when more than once
    depth: float  # of the centroid along the limb, over the wanted length; in [0, 1], 0 unless threaded the right way
    along: float  # the same length [m] without any condition; negative in front of the tip
    offset: float  # of the centroid from the limb's path (in front of the tip: from its prolongation) [m]


def worn(loop: FloatArray, opening: Opening, limb: LimbPath, wanted: float) -> Worn:
    """How an opening sits on its limb; `wanted` is the length along the limb that counts as all [m]."""
    number = threaded(loop, limb)
    number = number if abs(number) <= 1 else 0
    places, along, ahead = limb.closest(opening.centroid)
    way, distance = opening.centroid - places[0], float(along[0])
    if distance <= 0.0:
        distance = float(way @ ahead[0])
        way = way - distance * ahead[0]
    depth = min(max(distance / wanted, 0.0), 1.0) if number == 1 else 0.0
    return Worn(number, depth, distance, float(np.sqrt(way @ way)))


APPROACH, ENTRY, WRONG = 0.2, 0.25, -0.2
"""Potential in front of the tip at most; just threaded; threaded the wrong way or torn."""


def potential(worn: Worn, opening: Opening, limb: LimbPath, start: float, tunnelled: bool) -> float:
    """How good a state is, from `WRONG` to 1.

    Not threaded: up to `APPROACH`, falling linearly with the distance of the opening's centroid from the tip, to 0 at
    `start` metres; an opening that is not turned to the limb gets half. Threaded the right way: from `ENTRY` to 1 with the
    depth. It has its largest values only where the limb is in the sleeve: in front of the tip, or beside the limb, there
    is nothing to collect.
    """
    if tunnelled or worn.threaded < 0:
        return WRONG
    if worn.threaded == 1:
        return ENTRY + (1.0 - ENTRY) * worn.depth
    gap = opening.centroid - limb.tip
    near = max(0.0, 1.0 - float(np.sqrt(gap @ gap)) / start)
    facing = max(0.0, -float(opening.normal @ limb.closest(limb.tip)[2][0]))
    return APPROACH * near * 0.5 * (1.0 + facing)


def force_cost(force: float) -> float:
    """0 up to `FIRM_FORCE` newtons, rising to 1 at twice as much."""
    return min(max(force / FIRM_FORCE - 1.0, 0.0), 1.0)


def limb_force(body_forces: FloatArray) -> tuple[float, float]:
    """Sum of the sizes of all contact forces [N], and the largest; squeezing counts though it adds up to nothing."""
    if len(body_forces) == 0:
        return 0.0, 0.0
    sizes = np.sqrt(np.einsum("ij,ij->i", body_forces, body_forces))
    return float(sizes.sum()), float(sizes.max())


def check_variation(given: Any, known: tuple[str, ...]) -> dict[str, float]:
    """Variation as given to `reset(options={"variation": ...})`.

    Raises:
        ValueError: an unknown name, or a value outside [0, 1].
    """
    if not isinstance(given, dict):
        raise ValueError(f"options['variation'] = {given!r}: expected a dict of numbers from 0 to 1")
    for name in given:
        if name not in known:
            raise ValueError(f"options['variation'][{name!r}]: unknown; expected {', '.join(known)}")
    return {name: check_number(value, f"options['variation'][{name!r}]", 0.0, 1.0) for name, value in given.items()}
