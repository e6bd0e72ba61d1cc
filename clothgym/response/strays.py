"""Vertices that leave the way on which pairs were searched: a few have their pairs searched again, one by one."""

from __future__ import annotations

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.kernels import strays
from clothgym.kernels.near_pairs import Watched
from clothgym.mesh import Surface

_ONE_IN = 1024
"""Vertices that may stray; of more, all pairs are searched again, and always on small meshes: it costs no more there."""

_TIMES = 3
"""And after so many times: something happens that concerns many."""

_AGAIN, _FURTHER = 1.25, 4.0
"""Their slack, in ways that they have strayed: what has strayed early strays further, up to so many times."""


class Strays:
    """Searches of the pairs of vertices that strayed, of at most so many, and the space for them."""

    def __init__(self, surface: Surface, most: int | None = None) -> None:
        vertices, edges = surface.vertex_count, len(surface.edges)
        self.arrays, self.neighbourhood = surface.arrays, surface.neighbourhood[:2]
        self._ids = np.zeros(vertices // _ONE_IN if most is None else most, np.int64)
        self.ids = self._ids[:0]
        self.space = strays.Space(
            np.zeros(vertices, np.int32),
            np.zeros((vertices, 2), np.int64),
            np.zeros(vertices),
            np.zeros(max(len(surface.faces), edges), np.int64),
            np.zeros(edges, np.int64),
        )
        self.times = 0

    def begin(self) -> None:
        """All pairs have been searched."""
        self.times = 0

    def listed(self, x: FloatArray, share: float, ways: strays.Ways, leeway: float) -> bool:
        """Lists the vertices that strayed from their ways to x (V, 3), at a share of them; their slack grows, by `leeway` [m]
        beyond where they are. False if they are too many, or it was too often: nothing changes."""
        if self.times == _TIMES:
            return False
        more = _AGAIN * (min(1.0 / share, _FURTHER) if share > 0.0 else _FURTHER)
        found = strays.list_strays(x, ways.x, ways.u, share, ways.slack, more, leeway, self._ids)
        if found > len(self._ids):
            return False
        self.times += 1
        self.ids = self._ids[:found]
        return True

    def drop(self, watched: Watched, count: int) -> int:
        """Takes their pairs out of the first `count`; returns how many are left."""
        return int(strays.drop_pairs(self.ids, self.space.marks, watched, count))

    def search(self, ways: strays.Ways, watched: Watched, count: int) -> int:
        """Their pairs from place `count` on; returns how many pairs there are then, more than fit if the capacity does not
        suffice."""
        return int(strays.pairs_around(self.ids, ways, self.arrays, *self.neighbourhood, self.space, watched, count))
