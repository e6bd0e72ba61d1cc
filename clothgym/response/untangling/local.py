"""The local scheme: every hit follows its own gradient [Volino 2006, 2.2]."""

from __future__ import annotations

from clothgym.response.untangling.base import Context, Corrections, displacements, local_targets


class Local:
    """Enough for small fresh intersections; on long contours only their ends act, inner hits of flat sheets do nothing."""

    def propose(self, context: Context) -> Corrections:
        return Corrections(displacements(context, local_targets(context)))
