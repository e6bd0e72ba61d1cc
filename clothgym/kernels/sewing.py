"""Closing a garment: welded at the midpoints of its seams, its over-long edges are shortened on a ramp."""

from __future__ import annotations

import math

from clothgym._jit import kernel
from clothgym.kernels.body_contact import begin_contact, keep_off_body


@kernel
def close_seams(x, before, p, inverse_masses, ends, rest, start, first, count, total, keep, sweeps, contact):
    """Iterations `first` to `first + count - 1` of `total`; changes x.

    Positions move on with a share of their last step; then edges longer than their target are shortened, shorter ones
    than rest are lengthened, and the body has the last word. There is no gravity and no friction.

    Args:
        x, before, p: (V, 3) positions, those of the iteration before, and scratch [m].
        ends, rest, start: (E, 2), (E,) rest lengths and (E,) lengths at the start [m]; targets run from the longer of
            both to rest while iterations run from 0 to total.
        keep: share of the last step that goes on, 0 to 1.
        contact: BodyContact without friction.
    """
    vertices = x.shape[0]
    for n in range(first, first + count):
        share = min(1.0, (n + 1) / total)
        for i in range(vertices):
            for c in range(3):
                p[i, c] = x[i, c] + keep * (x[i, c] - before[i, c])
        begin_contact(x, p, contact, 0.0)
        for _ in range(sweeps):
            for e in range(ends.shape[0]):
                i = ends[e, 0]
                j = ends[e, 1]
                dx = p[j, 0] - p[i, 0]
                dy = p[j, 1] - p[i, 1]
                dz = p[j, 2] - p[i, 2]
                size = math.sqrt(dx * dx + dy * dy + dz * dz)
                target = rest[e]
                if start[e] > target:
                    target += (1.0 - share) * (start[e] - target)
                if size > target:
                    excess = size - target
                elif size < rest[e] and size > 0.0:
                    excess = size - rest[e]
                else:
                    continue
                total_weight = inverse_masses[i] + inverse_masses[j]
                if total_weight == 0.0:
                    continue
                g = excess / (size * total_weight)
                wi = inverse_masses[i] * g
                wj = inverse_masses[j] * g
                p[i, 0] += wi * dx
                p[i, 1] += wi * dy
                p[i, 2] += wi * dz
                p[j, 0] -= wj * dx
                p[j, 1] -= wj * dy
                p[j, 2] -= wj * dz
            keep_off_body(x, p, inverse_masses, contact, 0.0)
        for i in range(vertices):
            for c in range(3):
                before[i, c] = x[i, c]
                x[i, c] = p[i, c]
