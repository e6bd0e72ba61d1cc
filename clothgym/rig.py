"""The bodies that come with the package: surface, skeleton, skinning weights, poses and measures.

    female = rig.load("female")
    vertices = female.posed("walk:0.25")          # or female.posed({"lowerarm_l": (0.0, 0.0, 0.5)})
    limbs, measures = female.limbs("a_pose"), female.measures("a_pose")

Both bodies are CC0 (`assets/LICENSE-CC0-bodies.md`). Left is the body's own left: bones "..._l" lie at x > 0, because the
body looks along z.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from clothgym.arrays import FloatArray, IntArray, as_points, check_choice, read_only

NAMES = ("female", "male")
ARM_BONES = ("upperarm", "lowerarm", "hand", "thumb", "index", "middle", "ring", "pinky")
"""How the names of the bones of an arm begin."""
LEG_BONES = ("thigh", "calf", "foot", "ball")
"""The same of a leg."""
PARTS = ("trunk", "left_arm", "right_arm", "left_leg", "right_leg")
"""What `Rig.face_parts` numbers; the head belongs to the trunk."""

_KEPT_WEIGHTS = 4
_BEYOND = 1.0
"""Length [m] by which a limb's path leaves the body."""
_LOWERED = {"arms_down": 0.6, "walk": 0.3}
"""Angle [rad] of the upper arms below the A pose. Up to 0.3 the skin passes nowhere through itself; at 0.6 it does at the
armpits, and the female's hands touch the thighs."""


class Measures(NamedTuple):
    """Lengths and places of a posed body [m]; girths are what a tape shows: the hull of the trunk's level section."""

    height: float
    shoulder_height: float  # top of the surface above the shoulder joints, mean of both sides
    chest_centre: tuple[float, float, float]  # of the trunk's section at the bust
    bust_height: float
    bust_girth: float
    waist_height: float
    waist_girth: float
    hip_height: float
    hip_girth: float


@dataclass(frozen=True, eq=False)
class Limb:
    """The path of a limb: from the chest inside the body to the tip and 1 m beyond.

    Attributes:
        name: "head", "left_arm", "right_arm", "left_leg" or "right_leg".
        points: (N, 3) [m].
        start: index of the first point of the limb proper: shoulder joint, hip joint, base of the neck.

    Raises:
        ValueError: names the limb, the field and the value.
    """

    name: str
    points: FloatArray
    start: int

    def __post_init__(self) -> None:
        points = as_points(self.points, f"limb {self.name!r}: points").copy()
        if len(points) < 2:
            raise ValueError(f"limb {self.name!r}: points: {len(points)} given; a path needs at least two")
        if isinstance(self.start, bool) or not isinstance(self.start, int) or not 0 <= self.start < len(points):
            raise ValueError(f"limb {self.name!r}: start = {self.start!r}: expected an index in [0, {len(points) - 1}]")
        object.__setattr__(self, "points", read_only(points))

    def to_json(self) -> dict[str, Any]:
        """Plain values; floats survive exactly."""
        return {"name": self.name, "points": self.points.tolist(), "start": self.start}

    @staticmethod
    def from_json(values: dict[str, Any]) -> Limb:
        """Raises ValueError for missing or unknown fields, by name."""
        known = {"name", "points", "start"}
        if wrong := set(values) ^ known:
            raise ValueError(f"limb.{min(wrong)}: unknown or missing field; expected {', '.join(sorted(known))}")
        return Limb(values["name"], values["points"], values["start"])


@dataclass(frozen=True, eq=False)
class Rig:
    """A body at rest: arms about 45 degrees down, feet at y = 0, y up, z to the front. All arrays are read-only.

    Attributes:
        name: "female" or "male".
        vertices: (V, 3) [m].
        faces: (F, 3), closed, counter-clockwise seen from outside.
        bones: names of the B bones, parents before children.
        parent: (B,) parent bone, -1 for the root.
        head, tail: (B, 3) ends of each bone [m].
        weights: (V, B) share of each bone in each vertex; rows sum to 1.
    """

    name: str
    vertices: FloatArray
    faces: IntArray
    bones: tuple[str, ...]
    parent: IntArray
    head: FloatArray
    tail: FloatArray
    weights: FloatArray

    def bone(self, name: str) -> int:
        """Number of a bone.

        Raises:
            ValueError: no such bone.
        """
        return self.bones.index(check_choice(name, "bone", self.bones))

    @cached_property
    def _strongest(self) -> tuple[IntArray, FloatArray]:
        """(V, 4) bones with the largest weights and their shares, which sum to 1."""
        ids = np.argsort(-self.weights, axis=1, kind="stable")[:, :_KEPT_WEIGHTS].astype(np.int32)
        shares = np.take_along_axis(self.weights, ids, axis=1)
        return ids, shares / shares.sum(axis=1, keepdims=True)

    def rotations(self, pose: str) -> dict[str, FloatArray]:
        """The rotations of a named pose (`poses()`), as `posed` takes them: unit quaternions (w, x, y, z) by bone.

        Raises:
            ValueError: no such pose.
        """
        kind, phase = _parsed(pose)
        local: dict[str, FloatArray] = {}
        if kind == "rest":
            return local
        for side, out in (("l", 1.0), ("r", -1.0)):
            for bone, end in ((f"upperarm_{side}", None), (f"lowerarm_{side}", None), (f"hand_{side}", "middle_01")):
                b = self.bone(bone)
                far = self.tail[b] if end is None else self.head[self.bone(f"{end}_{side}")]
                along = far - self.head[b]
                target = np.array([out, 0.0, 0.0]) if kind == "t_pose" else along * (1.0, 1.0, 0.0)
                current = _rotated(self._orientation(local, b), along)
                self._turn(local, bone, _shortest_arc(current, target))
            if kind in _LOWERED:
                self._turn(local, f"upperarm_{side}", _quaternion((0.0, 0.0, -out * _LOWERED[kind])))
            if kind == "walk":
                swing = out * math.sin(2.0 * math.pi * phase)  # > 0: this leg is in front, this arm behind
                lift = max(0.0, out * math.cos(2.0 * math.pi * phase))  # this leg swings forward
                self._turn(local, f"thigh_{side}", _quaternion((-0.42 * swing, 0.0, 0.0)))
                self._turn(local, f"calf_{side}", _quaternion((0.15 + 0.55 * lift, 0.0, 0.0)))
                self._turn(local, f"upperarm_{side}", _quaternion((0.35 * swing, 0.0, 0.0)))
                self._turn(local, f"lowerarm_{side}", _quaternion((-0.25, 0.0, 0.0)))
        return local

    def _orientation(self, local: Mapping[str, FloatArray], bone: int) -> FloatArray:
        """Quaternion that takes a bone from rest to its pose."""
        total = np.array([1.0, 0.0, 0.0, 0.0])
        while bone >= 0:
            if self.bones[bone] in local:
                total = _product(local[self.bones[bone]], total)
            bone = int(self.parent[bone])
        return total

    def _turn(self, local: dict[str, FloatArray], bone: str, turn: FloatArray) -> None:
        """Turns a posed bone with its children about its head, by a quaternion in the axes of the world."""
        carried = self._orientation(local, int(self.parent[self.bone(bone)]))
        inside = _product(_product(carried * (1.0, -1.0, -1.0, -1.0), turn), carried)
        local[bone] = _product(inside, local[bone]) if bone in local else inside

    def _transforms(self, pose: str | Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
        """Rotation matrices (B, 3, 3) and translations (B, 3) that take points from rest to the pose."""
        given = self.rotations(pose) if isinstance(pose, str) else pose
        own = {self.bone(name): _matrix(_quaternion(value, name)) for name, value in given.items()}
        turns = np.empty((len(self.bones), 3, 3))
        heads = np.empty((len(self.bones), 3))
        for b, parent in enumerate(self.parent.tolist()):
            if parent < 0:
                turns[b], heads[b] = np.eye(3), self.head[b]
            else:
                turns[b] = turns[parent]
                heads[b] = heads[parent] + turns[parent] @ (self.head[b] - self.head[parent])
            if b in own:
                turns[b] = turns[b] @ own[b]
        return turns, heads - np.einsum("bij,bj->bi", turns, self.head)

    def posed(self, pose: str | Mapping[str, Any]) -> FloatArray:
        """Vertices (V, 3) [m] of the posed body, by linear blend skinning with the four strongest bones of each vertex.

        Args:
            pose: one of `poses()`, or rotations by bone name: each about the bone's head, as axis times angle (3,) [rad]
                or as a quaternion (4,) (w, x, y, z). Axes are those of the world at rest; a rotated parent takes them
                and the bone along.

        Raises:
            ValueError: names the pose, the bone or the value.
        """
        turns, shifts = self._transforms(pose)
        ids, shares = self._strongest
        table = np.concatenate([turns, shifts[:, :, None]], axis=2).reshape(-1, 12)
        blended = shares[:, :1] * table[ids[:, 0]]
        for n in range(1, _KEPT_WEIGHTS):
            blended += shares[:, n : n + 1] * table[ids[:, n]]
        blended = blended.reshape(-1, 3, 4)
        return np.einsum("vij,vj->vi", blended[:, :, :3], self.vertices) + blended[:, :, 3]

    def posed_bones(self, pose: str | Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
        """Heads and tails (B, 3) [m] of the posed bones.

        Raises:
            ValueError: as `posed`.
        """
        turns, shifts = self._transforms(pose)
        return (
            np.einsum("bij,bj->bi", turns, self.head) + shifts,
            np.einsum("bij,bj->bi", turns, self.tail) + shifts,
        )

    def face_parts(self) -> IntArray:
        """(F,) which of `PARTS` each face belongs to: the five of [Vassilev 2001, 6]."""
        of_bone = np.zeros(len(self.bones), np.int32)
        for number, name in enumerate(self.bones):
            right = name.endswith("_r")
            if name.startswith(ARM_BONES):
                of_bone[number] = 2 if right else 1
            elif name.startswith(LEG_BONES):
                of_bone[number] = 4 if right else 3
        owner = of_bone[np.asarray(self.weights).argmax(axis=1)]
        corners = owner[self.faces]
        found: IntArray = np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0]).astype(np.int32)
        return found

    def limbs(self, pose: str | Mapping[str, Any] = "rest") -> tuple[Limb, ...]:
        """Paths of head, left arm, right arm, left leg and right leg from the chest outwards, along the posed bones.

        Raises:
            ValueError: as `posed`.
        """
        heads, tails = self.posed_bones(pose)

        def head(name: str) -> FloatArray:
            return heads[self.bone(name)]

        def tail(name: str) -> FloatArray:
            return tails[self.bone(name)]

        chest = 0.5 * (head("spine_03") + tail("spine_03"))
        limbs = [_limb("head", [chest, head("neck_01"), head("head"), tail("head")], 1)]
        for name, s in (("left_arm", "l"), ("right_arm", "r")):
            joints = [head(f"{bone}_{s}") for bone in ("clavicle", "upperarm", "lowerarm", "hand")]
            tip = tail(f"middle_03_{s}")
            limbs.append(_limb(name, [chest, *joints, tip], 2, tip - joints[2]))  # fingers curl: on along the forearm
        spine = [head("spine_03"), head("spine_02"), head("spine_01"), head("pelvis")]
        for name, s in (("left_leg", "l"), ("right_leg", "r")):
            joints = [head(f"{bone}_{s}") for bone in ("thigh", "calf", "foot")]
            limbs.append(
                _limb(name, [chest, *spine, *joints], 5, joints[2] - joints[1])
            )  # feet turn: on along the calf
        return tuple(limbs)

    def measures(self, pose: str | Mapping[str, Any] = "rest") -> Measures:
        """Heights and girths of the posed body, upright poses only.

        Raises:
            ValueError: as `posed`.
        """
        vertices = self.posed(pose)
        heads, tails = self.posed_bones(pose)
        height = float(np.ptp(vertices[:, 1]))
        arms = self.weights[:, [n for n, name in enumerate(self.bones) if name.startswith(ARM_BONES)]].sum(axis=1)
        trunk = self.faces[arms[self.faces].mean(axis=1) < 0.5]

        def level(bone: str) -> float:
            return float(heads[self.bone(bone), 1])

        chest = float(tails[self.bone("spine_03"), 1])
        waist = _extreme(
            vertices, trunk, level("spine_01") - 0.01 * height, level("spine_03") + 0.02 * height, least=True
        )
        bust = _extreme(vertices, trunk, level("spine_03"), chest - 0.01 * height)
        hip = _extreme(vertices, trunk, level("thigh_l") - 0.03 * height, level("spine_01"))
        section = section_hull(vertices, trunk, bust[0])
        centre = 0.5 * (section.min(axis=0) + section.max(axis=0))
        shoulders = [_top_above(vertices, self.faces, heads[self.bone(f"upperarm_{side}")]) for side in ("l", "r")]
        return Measures(
            height, float(np.mean(shoulders)), (float(centre[0]), bust[0], float(centre[1])), *bust, *waist, *hip
        )


def blended(start: Mapping[str, FloatArray], end: Mapping[str, FloatArray], share: float) -> dict[str, FloatArray]:
    """Rotations between two poses: the shorter way from bone to bone, straight through the quaternions and made unit."""
    still = np.array([1.0, 0.0, 0.0, 0.0])
    found = {}
    for bone in sorted({*start, *end}):
        one, two = start.get(bone, still), end.get(bone, still)
        mixed = (1.0 - share) * one + share * math.copysign(1.0, float(one @ two)) * two
        found[bone] = mixed / np.linalg.norm(mixed)
    return found


@lru_cache(maxsize=len(NAMES))
def load(name: str) -> Rig:
    """One of the bodies of the package: "female" (1.59 m) or "male" (1.73 m). Each is read once.

    Raises:
        ValueError: another name.
    """
    check_choice(name, "body", NAMES)
    with (
        resources.files("clothgym").joinpath("assets", f"{name}_rig.npz").open("rb") as file,
        np.load(file, allow_pickle=False) as data,
    ):
        weights = data["weights"].astype(np.float64)
        arrays = {
            "vertices": data["vertices"].astype(np.float64),
            "faces": data["faces"].astype(np.int32),
            "parent": data["parent"].astype(np.int32),
            "head": data["head"].astype(np.float64),
            "tail": data["tail"].astype(np.float64),
            "weights": weights / weights.sum(axis=1, keepdims=True),  # stored in half precision
        }
        bones = tuple(str(bone) for bone in data["bones"])
    return Rig(name=name, bones=bones, **{key: read_only(array) for key, array in arrays.items()})


def poses() -> tuple[str, ...]:
    """Names of the poses; the phase of "walk:<phase>" is a number in [0, 1).

    "rest": as stored, forearms reach forward. "a_pose": arms as steep, straightened into the plane x, y. "t_pose": arms
    level. "arms_down": upper arms 0.6 rad below the A pose. "walk:<phase>": a stride on the spot, the
    left leg in front at 0.25 and the right one at 0.75; the pelvis keeps its place, upper arms 0.3 rad below the A pose.
    """
    return "rest", "a_pose", "t_pose", "arms_down", "walk:<phase>"


def _parsed(pose: str) -> tuple[str, float]:
    """Kind and phase of a named pose."""
    kind, colon, number = pose.partition(":")
    if kind == "walk" and colon:
        try:
            phase = float(number)
        except ValueError:
            phase = math.nan
        if 0.0 <= phase < 1.0:
            return kind, phase
        raise ValueError(f"pose = {pose!r}: expected a phase in [0, 1), as in walk:0.25")
    if kind == "walk" or colon or kind not in poses():
        raise ValueError(f"pose = {pose!r}: expected one of {', '.join(poses())}")
    return kind, 0.0


def _quaternion(value: Any, bone: str = "") -> FloatArray:
    """Unit quaternion (w, x, y, z) from axis times angle (3,) or a quaternion (4,) of any length."""
    numbers = np.asarray(value, np.float64)
    if numbers.shape not in ((3,), (4,)) or not np.isfinite(numbers).all():
        raise ValueError(
            f"rotation of {bone!r} = {value!r}: expected axis times angle (3,) or a quaternion (w, x, y, z)"
        )
    size = math.sqrt(float(numbers @ numbers))
    if len(numbers) == 4:
        if size < 1e-9:
            raise ValueError(f"rotation of {bone!r} = {value!r}: a quaternion must not be zero")
        return numbers / size
    scale = 0.5 if size < 1e-12 else math.sin(0.5 * size) / size
    return np.concatenate([[math.cos(0.5 * size)], scale * numbers])


def _product(p: FloatArray, q: FloatArray) -> FloatArray:
    """First q, then p."""
    a, b, c, d = p
    e, f, g, h = q
    return np.array(
        [a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g,
         a * g - b * h + c * e + d * f, a * h + b * g - c * f + d * e]
    )  # fmt: skip


def _matrix(q: FloatArray) -> FloatArray:
    w, x, y, z = q
    return np.array(
        [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
         [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
         [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    )  # fmt: skip


def _rotated(q: FloatArray, vector: FloatArray) -> FloatArray:
    return _matrix(q) @ vector


def _shortest_arc(start: FloatArray, end: FloatArray) -> FloatArray:
    """Quaternion that turns one direction to another; the two are not opposite."""
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    q = np.concatenate([[1.0 + a @ b], np.cross(a, b)])
    return q / np.linalg.norm(q)


def _limb(name: str, points: list[FloatArray], start: int, along: FloatArray | None = None) -> Limb:
    """A path with a last point beyond its tip, straight on unless a direction is given."""
    if along is None:
        along = points[-1] - points[-2]
    return Limb(name, np.array([*points, points[-1] + _BEYOND * along / np.linalg.norm(along)]), start)


def section_hull(vertices: FloatArray, faces: IntArray, height: float) -> FloatArray:
    """(N, 2) convex hull [m], counter-clockwise in (x, z), of the section of a surface with the plane y = height.

    Empty where the plane misses the surface.
    """
    above = vertices[:, 1] > height
    count = above[faces].sum(axis=1)
    cut = faces[(count == 1) | (count == 2)]
    ends = np.concatenate([cut[:, [0, 1]], cut[:, [1, 2]], cut[:, [2, 0]]])
    ends = ends[above[ends[:, 0]] != above[ends[:, 1]]]
    a, b = vertices[ends[:, 0]], vertices[ends[:, 1]]
    share = (height - a[:, 1]) / (b[:, 1] - a[:, 1])
    return hull_of((a + share[:, None] * (b - a))[:, [0, 2]])


def hull_of(points: FloatArray) -> FloatArray:
    """(N, 2) convex hull, counter-clockwise, of points (M, 2); fewer than three different ones as they are."""
    points = np.unique(points, axis=0)
    if len(points) < 3:
        return points
    rows = points.tolist()

    def chain(ordered: list[list[float]]) -> list[list[float]]:
        hull: list[list[float]] = []
        for p in ordered:
            while len(hull) > 1 and _turn_left(hull[-2], hull[-1], p) <= 0.0:
                hull.pop()
            hull.append(p)
        return hull[:-1]

    return np.array(chain(rows) + chain(rows[::-1]))


def _turn_left(a: list[float], b: list[float], c: list[float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def girth(vertices: FloatArray, faces: IntArray, height: float) -> float:
    """Length [m] of a tape around the section of a surface at a height: the perimeter of its convex hull; 0 = no section."""
    hull = section_hull(vertices, faces, height)
    return float(np.linalg.norm(hull - np.roll(hull, 1, axis=0), axis=1).sum())


def _extreme(
    vertices: FloatArray, faces: IntArray, low: float, high: float, least: bool = False
) -> tuple[float, float]:
    """Height and girth of the largest (or least) girth in a range, to 5 mm."""
    heights = np.linspace(low, high, max(int((high - low) / 0.005), 1) + 1)
    girths = np.array([girth(vertices, faces, float(h)) for h in heights])
    chosen = int(girths.argmin() if least else girths.argmax())
    return float(heights[chosen]), float(girths[chosen])


def heights_above(vertices: FloatArray, faces: IntArray, x: float, z: float) -> FloatArray:
    """(N,) heights [m] at which the vertical line through (x, z) meets a surface, sorted."""
    a, b, c = (vertices[faces[:, n]][:, [0, 2]] - (x, z) for n in range(3))
    weights = np.stack([p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((b, c), (c, a), (a, b))], axis=1)
    total = weights.sum(axis=1)
    hit = ((weights >= 0).all(axis=1) | (weights <= 0).all(axis=1)) & (total != 0.0)
    return np.sort(((weights[hit] / total[hit, None]) * vertices[faces[hit], 1]).sum(axis=1))


def _top_above(vertices: FloatArray, faces: IntArray, point: FloatArray) -> float:
    """Height of the highest place of a surface on the vertical line through a point; the point's own if there is none."""
    heights = heights_above(vertices, faces, point[0], point[2])
    return float(heights[-1]) if len(heights) else float(point[1])
