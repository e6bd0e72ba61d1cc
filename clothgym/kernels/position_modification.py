"""Position modification against super-elasticity [Provot 1995], as [Vassilev 2001, 4.2] describes it."""

from __future__ import annotations

import math

from clothgym._jit import bare


@bare
def modify_positions(p, cloth, threshold, sweeps):
    """Shortens springs longer than (1 + threshold) l0 to that length, one after the other; p (V, 3) is changed in place.

    Ends move along the spring, each by its share of the inverse masses: both alike, or all of it where one is pinned. What
    shortens one spring may lengthen its neighbours, which is why there may be several sweeps. Returns how many springs
    were too long in the last one.
    """
    ends = cloth.spring_ends
    w = cloth.inverse_masses
    count = 0
    for _ in range(sweeps):
        count = 0
        for s in range(ends.shape[0]):
            i = ends[s, 0]
            j = ends[s, 1]
            total = w[i] + w[j]
            if total == 0.0:
                continue
            dx = p[j, 0] - p[i, 0]
            dy = p[j, 1] - p[i, 1]
            dz = p[j, 2] - p[i, 2]
            size = math.sqrt(dx * dx + dy * dy + dz * dz)
            longest = (1.0 + threshold) * cloth.spring_rest[s]
            if size <= longest or size == 0.0:
                continue
            count += 1
            share = (size - longest) / (size * total)
            p[i, 0] += share * w[i] * dx
            p[i, 1] += share * w[i] * dy
            p[i, 2] += share * w[i] * dz
            p[j, 0] -= share * w[j] * dx
            p[j, 1] -= share * w[j] * dy
            p[j, 2] -= share * w[j] * dz
        if count == 0:
            break
    return count
