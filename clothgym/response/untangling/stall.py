"""The stall scheme: local as long as the contours get shorter, then global, then hybrid."""

from __future__ import annotations

from clothgym.response.untangling.base import Context, Corrections, displacements, global_targets, local_targets
from clothgym.response.untangling.hybrid import Hybrid

_PATIENCE = 5
"""Passes without a shorter total length after which the next scheme takes over."""

_PROGRESS = 0.98
"""Share of the least length so far below which a pass counts as progress."""

_AGAIN = 2.0
"""A total length of so many times the least one so far is a new tangle: the first scheme takes over again."""


class Stall:
    """The only scheme that remembers: the least length so far, passes since, and whose turn it is (`Context.memory`)."""

    memory_size = 3

    def propose(self, context: Context) -> Corrections:
        length, memory = context.intersections.length, context.memory
        least, waited, turn = memory
        if least == 0.0 or length > _AGAIN * least:
            least, waited, turn = length, 0.0, 0.0
        elif length < _PROGRESS * least:
            least, waited = length, 0.0
        else:
            waited += 1.0
            if waited > _PATIENCE and turn < 2.0:
                waited, turn = 0.0, turn + 1.0
        memory[:] = least, waited, turn
        if turn == 2.0:
            return Hybrid().propose(context)
        targets = local_targets(context) if turn == 0.0 else global_targets(context)
        return Corrections(displacements(context, targets))
