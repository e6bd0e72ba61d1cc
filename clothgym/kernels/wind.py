"""Wind as drag across each triangle [Provot 1995]: force = drag * area * ((w - v) . n) n."""

from __future__ import annotations

import numpy as np

from clothgym._jit import kernel
from clothgym.kernels.vec3 import dot, triangle_normal


@kernel
def wind_acceleration(x, v, faces, inverse_masses, wind, drag, dt, acceleration):
    """Acceleration (V, 3) [m/s^2] from air that moves with velocity `wind` (3,) [m/s]; drag [N s/m^3].

    It is held for dt [s]; where the drag would overshoot the wind in that time, it is cut to what reaches it.
    """
    acceleration[:] = 0.0
    areas = np.zeros(x.shape[0], np.float64)
    for f in range(faces.shape[0]):
        i = faces[f, 0]
        j = faces[f, 1]
        k = faces[f, 2]
        nx, ny, nz, twice_area = triangle_normal(x, i, j, k)
        speed = dot(
            nx,
            ny,
            nz,
            wind[0] - (v[i, 0] + v[j, 0] + v[k, 0]) / 3.0,
            wind[1] - (v[i, 1] + v[j, 1] + v[k, 1]) / 3.0,
            wind[2] - (v[i, 2] + v[j, 2] + v[k, 2]) / 3.0,
        )
        third = drag * 0.5 * twice_area * speed / 3.0
        for vertex in (i, j, k):
            areas[vertex] += twice_area / 6.0
            w = inverse_masses[vertex]
            acceleration[vertex, 0] += w * third * nx
            acceleration[vertex, 1] += w * third * ny
            acceleration[vertex, 2] += w * third * nz
    for vertex in range(x.shape[0]):
        keep = 1.0 / max(1.0, dt * drag * areas[vertex] * inverse_masses[vertex])
        for c in range(3):
            acceleration[vertex, c] *= keep
