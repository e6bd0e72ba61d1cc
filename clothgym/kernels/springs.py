"""Springs [Vassilev 2001, section 3]: forces (eq. 2) for explicit integration, XPBD projection of the same energy."""

from __future__ import annotations

import math
from typing import NamedTuple

from numpy.typing import NDArray

from clothgym._jit import bare
from clothgym.kernels.bending import NO_HINGES, NO_QUADRATIC, HingeArrays, QuadraticArrays
from clothgym.kernels.membrane import NO_MEMBRANE, MembraneArrays


class ClothArrays(NamedTuple):
    """What the integrators read of a model; constant while a simulation lives.

    An absent energy has arrays of length 0, and None for its `has_`: another type, for which kernels are compiled without it.
    """

    inverse_masses: NDArray  # (V,) [1/kg], 0 = pinned
    spring_ends: NDArray  # (S, 2) int32
    spring_rest: NDArray  # (S,) [m]
    spring_stiffness: NDArray  # (S,) [N/m]
    membrane: MembraneArrays = NO_MEMBRANE
    hinges: HingeArrays = NO_HINGES
    quadratic: QuadraticArrays = NO_QUADRATIC
    has_membrane: bool | None = None  # True or None
    has_hinges: bool | None = None
    has_quadratic: bool | None = None


@bare
def add_spring_forces(x, cloth, f):
    """Adds -k (d - l0 d/|d|) to both ends [Vassilev 2001, eq. 2]; f (V, 3) [N]."""
    ends = cloth.spring_ends
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        dx = x[j, 0] - x[i, 0]
        dy = x[j, 1] - x[i, 1]
        dz = x[j, 2] - x[i, 2]
        size = math.sqrt(dx * dx + dy * dy + dz * dz)
        if size == 0.0:
            continue
        g = cloth.spring_stiffness[s] * (1.0 - cloth.spring_rest[s] / size)
        f[i, 0] += g * dx
        f[i, 1] += g * dy
        f[i, 2] += g * dz
        f[j, 0] -= g * dx
        f[j, 1] -= g * dy
        f[j, 2] -= g * dz


@bare
def project_springs(p, cloth, dt, multipliers):
    """One Gauss-Seidel sweep of XPBD [Macklin 2016, eq. 18] with compliance 1/k; multipliers (S,) [N s^2]."""
    ends = cloth.spring_ends
    w = cloth.inverse_masses
    for s in range(ends.shape[0]):
        i = ends[s, 0]
        j = ends[s, 1]
        wi = w[i]
        wj = w[j]
        if wi + wj == 0.0:
            continue
        dx = p[j, 0] - p[i, 0]
        dy = p[j, 1] - p[i, 1]
        dz = p[j, 2] - p[i, 2]
        size = math.sqrt(dx * dx + dy * dy + dz * dz)
        if size == 0.0:
            continue
        alpha = 1.0 / (cloth.spring_stiffness[s] * dt * dt)
        change = (size - cloth.spring_rest[s] - alpha * multipliers[s]) / (wi + wj + alpha)
        multipliers[s] += change
        g = change / size
        p[i, 0] += wi * g * dx
        p[i, 1] += wi * g * dy
        p[i, 2] += wi * g * dz
        p[j, 0] -= wj * g * dx
        p[j, 1] -= wj * g * dy
        p[j, 2] -= wj * g * dz
