"""A tangle whose clean state is known: right and wrong are told by sides, whatever the contours say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import BoolArray, FloatArray, IntArray
from clothgym.detection.sides import signed_sides
from clothgym.mesh import Mesh, Surface
from clothgym.scene import Cloth, Scene

_SLACK = 0.01
"""Share of the vertices that started right and may count as wrong: closest points jump where cloth bends around a border."""


Beside = tuple[NDArray[np.integer], NDArray[np.integer]]
"""Vertex ids (P,) and faces (F, 3), with the ids of the whole scene."""


@dataclass(frozen=True, eq=False)
class SideRule:
    """Vertices that belong on one side of a surface.

    Attributes:
        vertices: (P,) ids.
        surface: of the faces that they belong beside, with the scene's ids.
        signs: (P,) +1 or -1 as `detection.sides.signed_sides` tells in the clean state; 0 asks for nothing.
        misplaced: (P,) of those, the ones on the other side at the start.
    """

    vertices: NDArray[np.integer]
    surface: Surface
    signs: FloatArray
    misplaced: BoolArray

    def wrong(self, positions: FloatArray) -> BoolArray:
        """(P,) which are on the other side."""
        return self.signs * signed_sides(positions[self.vertices], positions, self.surface)[0] < 0.0


@dataclass(frozen=True, eq=False)
class Tangle:
    """A scene that starts tangled, and what it came from.

    Attributes:
        scene: starts tangled.
        clean: (V, 3) [m] the same cloths without any intersection.
        edge: length of an edge [m], the unit of depths.
        rules: who belongs where; none where no side is wrong (two sheets that cross each other half).
    """

    scene: Scene
    clean: FloatArray
    edge: float
    rules: tuple[SideRule, ...] = field(default=())

    def side_error(self, positions: FloatArray) -> float:
        """Share of the vertices with a side that are on the other one; 0 without any."""
        asked = sum(int(np.count_nonzero(rule.signs)) for rule in self.rules)
        wrong = sum(int(rule.wrong(positions).sum()) for rule in self.rules)
        return wrong / asked if asked else 0.0

    def right(self, positions: FloatArray) -> bool:
        """Whether everything that was misplaced is back, and at most 1 % of all others count as wrong."""
        for rule in self.rules:
            wrong = rule.wrong(positions)
            others = int(np.count_nonzero(rule.signs)) - int(rule.misplaced.sum())
            if (wrong & rule.misplaced).any() or (wrong & ~rule.misplaced).sum() > _SLACK * others:
                return False
        return True


def tangle(cloths: Sequence[Cloth], clean: FloatArray, edge: float, beside: Sequence[Beside], name: str) -> Tangle:
    """A tangle in free space, without gravity.

    Args:
        cloths: as they start.
        clean: (V, 3) [m] of all of them.
        edge: [m].
        beside: in the clean state these vertices are on the side of these faces where they belong.
        name: of the scene.
    """
    scene = Scene(tuple(cloths), gravity=(0.0, 0.0, 0.0), step=0.01, duration=0.6, name=name)
    rules = []
    for vertices, faces in beside:
        surface = Surface(faces, len(clean))
        signs = signed_sides(clean[vertices], clean, surface)[0]
        start = signed_sides(scene.start[vertices], scene.start, surface)[0]
        rules.append(SideRule(np.asarray(vertices), surface, signs, signs * start < 0.0))
    return Tangle(scene, clean, edge, tuple(rules))


def shifted(mesh: Mesh, count: int) -> IntArray:
    """Faces of a mesh that follows `count` vertices of others."""
    return mesh.faces + np.int32(count)
