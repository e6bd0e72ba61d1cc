"""The global scheme: all hits of a contour move together along its summed gradient [Volino 2006, 2.3]."""

from __future__ import annotations

from clothgym.response.untangling.base import Context, Corrections, displacements, global_targets


class Global:
    """Resolves large intersections; a contour whose sides cannot be told apart is left to the local scheme."""

    def propose(self, context: Context) -> Corrections:
        return Corrections(displacements(context, global_targets(context)))
