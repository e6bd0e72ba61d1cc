"""How often a path crosses the fan of a closed loop: what an opening is threaded by."""

from __future__ import annotations

from clothgym._jit import kernel
from clothgym.kernels.predicates import orient3d_sign


@kernel
def crossing_number(points, loop_count):
    """Signed crossings of a path with the fan of a loop; exact, ties broken by index, so no crossing counts twice.

    A crossing is +1 where the path runs along the fan's normal (right-hand rule around the loop).

    Args:
        points: (N, 3) float64: the loop, its apex, then the path.
        loop_count: vertices of the loop.
    """
    apex = loop_count
    number = 0
    for s in range(loop_count + 1, points.shape[0] - 1):
        e = s + 1
        for a in range(loop_count):
            b = a + 1 if a + 1 < loop_count else 0
            below, _ = orient3d_sign(points, apex, a, b, s)
            above, _ = orient3d_sign(points, apex, a, b, e)
            if below == above:
                continue
            first, _ = orient3d_sign(points, s, e, apex, a)
            second, _ = orient3d_sign(points, s, e, a, b)
            if first != second:
                continue
            third, _ = orient3d_sign(points, s, e, b, apex)
            if first == third:
                number += below
    return number
