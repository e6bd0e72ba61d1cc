"""The order in which springs are worked on: colours of independent springs, and runs of them on regular grids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym.arrays import BoolArray, IntArray
from clothgym.kernels.colouring import colour_springs
from clothgym.mesh import Mesh, grid

Ids = NDArray[np.int64]

_PARITIES = (2, 4)
"""Vertices of a grid are sorted by the remainders of their row and column: by 2 for springs to the next vertex, by 4 for
those that skip one."""
_NS_LOOSE, _NS_ENTRY, _NS_RUN = 5.0, 1.4, 150.0
"""Measured [ns]: a spring by itself, an entry of a run, and what a run costs besides. They choose among layouts."""


def by_colour(ends: IntArray, vertex_count: int) -> Ids:
    """(S,) an order in which springs (S, 2) of one colour, which have no vertex in common, stand together.

    First come those for which 62 colours do not suffice: none, unless 32 springs or more meet at a vertex.
    """
    colours = np.zeros(len(ends), np.int64)
    colour_springs(np.ascontiguousarray(ends, np.int32), np.zeros(vertex_count, np.int64), colours)
    return np.argsort(colours, kind="stable")


class Layout(NamedTuple):
    """Where vertices and springs go.

    Attributes:
        slot: (V,) slot of each vertex; slot_count of them, some without a vertex.
        runs: (R, 4) int64: first slot of the one ends and of the others, length, first entry.
        entries: (N,) spring of each entry, -1 = gap; those past the last run belong to no run.
        flipped: (N,) whether the spring's second end stands in the first slots.
    """

    slot: IntArray
    slot_count: int
    runs: Ids
    entries: Ids
    flipped: BoolArray

    @property
    def loose_count(self) -> int:
        """How many springs are in no run."""
        return len(self.entries) - int(self.runs[:, 2].sum())


def grid_columns(mesh: Mesh) -> int:
    """Vertices in a row, if the mesh is numbered row by row as `mesh.grid` does; 0 otherwise."""
    quads, count = mesh.quads, len(mesh.vertices)
    if quads is None or len(quads) == 0:
        return 0
    wide = int(quads[0, 3] - quads[0, 0])
    if wide < 2 or count % wide or count < 2 * wide:
        return 0
    expected = grid(1.0, 1.0, wide - 1, count // wide - 1).quads
    return wide if expected is not None and np.array_equal(quads, expected) else 0


def plain(ends: IntArray, vertex_count: int) -> Layout:
    """Every spring by itself, in the order given."""
    count = len(ends)
    return Layout(
        np.arange(vertex_count, dtype=np.int32),
        vertex_count,
        np.zeros((0, 4), np.int64),
        np.arange(count, dtype=np.int64),
        np.zeros(count, np.bool_),
    )


def layout(ends: IntArray, vertex_count: int, grids: list[tuple[int, int, int]]) -> Layout:
    """The cheapest layout of springs (S, 2) on cloths (first vertex, count, columns); columns 0 = no grid."""
    choices = [plain(ends, vertex_count)]
    if any(columns for _, _, columns in grids):
        choices += [_parity_layout(ends, grids, parity) for parity in _PARITIES]
    return min(choices, key=_cost)


def _cost(choice: Layout) -> float:
    loose = choice.loose_count
    return _NS_LOOSE * loose + _NS_ENTRY * (len(choice.entries) - loose) + _NS_RUN * len(choice.runs)


def _parity_layout(ends: IntArray, grids: list[tuple[int, int, int]], parity: int) -> Layout:
    """Vertices of each grid in classes by (column, row) modulo parity, each a small grid of its own, rows first.

    Springs of one kind then join a class to another at a constant distance of slots.
    """
    slot, block, total = [], [], 0
    for first, count, columns in grids:
        numbers = np.arange(count)
        if columns == 0:
            slot.append(total + numbers)
            block.append(np.full(count, -1))
            total += count
            continue
        row, column = numbers // columns, numbers % columns
        wide, high = -(-columns // parity), -(-(count // columns) // parity)
        of_class = (column % parity) * parity + row % parity
        slot.append(total + of_class * (wide * high) + (row // parity) * wide + column // parity)
        # classes are told apart by number, those of a cloth after those of the cloths before
        block.append(first * parity * parity + of_class)
        total += parity * parity * wide * high
    slots, classes = np.concatenate(slot).astype(np.int64), np.concatenate(block).astype(np.int64)
    runs, entries, flipped = _runs(slots[ends], classes[ends])
    taken = np.zeros(len(ends), np.bool_)
    taken[entries[entries >= 0]] = True
    loose = np.flatnonzero(~taken)
    return Layout(
        slots.astype(np.int32),
        total,
        runs,
        np.concatenate([entries, loose]),
        np.concatenate([flipped, np.zeros(len(loose), np.bool_)]),
    )


def _runs(ends: Ids, classes: Ids) -> tuple[Ids, Ids, BoolArray]:
    """Runs (R, 4), and spring and flip of every entry, of springs between different classes; ends (S, 2) are slots.

    Runs of the same distance whose classes follow on each other are joined.
    """
    flip = classes[:, 0] > classes[:, 1]
    low = np.where(flip, ends[:, 1], ends[:, 0])
    high = np.where(flip, ends[:, 0], ends[:, 1])
    class_low, class_high = classes.min(axis=1), classes.max(axis=1)
    able = np.flatnonzero((class_low >= 0) & (class_low != class_high))
    distance = high - low
    order = able[np.lexsort((low[able], class_high[able], class_low[able], distance[able]))]
    if len(order) == 0:
        return np.zeros((0, 4), np.int64), np.zeros(0, np.int64), np.zeros(0, np.bool_)
    key = np.stack([distance[order], class_low[order], class_high[order]])
    starts = np.flatnonzero(np.r_[True, (key[:, 1:] != key[:, :-1]).any(axis=0)])
    stops = np.r_[starts[1:], len(order)]
    pieces: list[list[int]] = []  # [start, stop) of the order
    for start, stop in zip(starts.tolist(), stops.tolist()):
        first, last, far = int(low[order[start]]), int(low[order[stop - 1]]), int(distance[order[start]])
        if pieces:
            before = int(low[order[pieces[-1][0]]])
            joined = int(distance[order[pieces[-1][0]]]) == far and last - before < abs(far)
            # gaps must not outgrow the springs
            if joined and last - before + 1 < 1.5 * (stop - pieces[-1][0]) and first > before:
                pieces[-1][1] = stop
                continue
        pieces.append([start, stop])
    runs, entries, flipped, entry = [], [], [], 0
    for start, stop in pieces:
        members = order[start:stop]
        first, length = int(low[members[0]]), int(low[members[-1]] - low[members[0]]) + 1
        if len(np.unique(low[members])) != len(members) or length > 2 * len(members) + 16:
            continue  # springs that come twice, or hardly any: they stay by themselves
        held = np.full(length, -1, np.int64)
        held[low[members] - first] = members
        turned = np.zeros(length, np.bool_)
        turned[low[members] - first] = flip[members]
        runs.append((first, int(high[members[0]]), length, entry))
        entries.append(held)
        flipped.append(turned)
        entry += length
    return (
        np.array(runs, np.int64).reshape(-1, 4),
        np.concatenate([*entries, np.zeros(0, np.int64)]),
        np.concatenate([*flipped, np.zeros(0, np.bool_)]),
    )
