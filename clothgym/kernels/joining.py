"""Sets that are joined step by step (union-find): each member points to another of its set, up to the root of all."""

from __future__ import annotations

from clothgym._jit import bare


@bare
def root_of(parent, i):
    """Root of i, whose parent is itself; halves the way there."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i
