"""Small scenes with their exact hits, and rows of arrays as tuples."""

from __future__ import annotations

from functools import cache

import meshes
import naive
import numpy as np


@cache
def exact_scene(name: str) -> naive.Exact:
    """The exact intersections of a named scene, computed once."""
    return naive.exact_intersections(*meshes.EVERY[name]())


def rows(array) -> list[tuple]:
    """Array rows as plain tuples."""
    return [tuple(row) for row in np.asarray(array).tolist()]
