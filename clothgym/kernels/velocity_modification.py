"""Velocity modification against super-elasticity [Vassilev 2001, 4.3], literal and momentum-conserving."""

from __future__ import annotations

import math

from clothgym._jit import bare


@bare
def modify_velocities(x, v, cloth, threshold, relative):
    """Stops springs longer than (1 + threshold) l0 from stretching on; v (V, 3) is changed in place.

    literal (relative False): the components of both velocities along the spring are set to zero, as the paper says; this
    also stops an over-stretched cloth that falls freely. relative: only the elongation rate is removed, by equal and
    opposite impulses, so momentum is kept. Returns how many springs were too long.
    """
    ends = cloth.spring_ends
    w = cloth.inverse_masses
    count = 0
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        dx = x[j, 0] - x[i, 0]
        dy = x[j, 1] - x[i, 1]
        dz = x[j, 2] - x[i, 2]
        size = math.sqrt(dx * dx + dy * dy + dz * dz)
        if size <= (1.0 + threshold) * cloth.spring_rest[s] or size == 0.0:
            continue
        count += 1
        dx /= size
        dy /= size
        dz /= size
        vi = v[i, 0] * dx + v[i, 1] * dy + v[i, 2] * dz
        vj = v[j, 0] * dx + v[j, 1] * dy + v[j, 2] * dz
        if relative:
            rate = vj - vi
            total = w[i] + w[j]
            if rate <= 0.0 or total == 0.0:
                continue
            vi = -rate * w[i] / total
            vj = rate * w[j] / total
        v[i, 0] -= vi * dx
        v[i, 1] -= vi * dy
        v[i, 2] -= vi * dz
        v[j, 0] -= vj * dx
        v[j, 1] -= vj * dy
        v[j, 2] -= vj * dz
    return count
