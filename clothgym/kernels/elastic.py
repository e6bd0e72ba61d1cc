"""All energies of a cloth together: energy, forces for explicit integration, XPBD projection for the sweeps, and the
Hessian blocks of springs; those of the others are `membrane.membrane_hessian`, `bending.hinge_hessian` and
`bending.quadratic_hessian`.

An energy that a cloth does not have has None for `present`, and arrays of length 0: numba leaves out what stands behind
`if present is None: return`, so that a cloth of springs compiles springs only."""

from __future__ import annotations

import math

from clothgym._jit import device, kernel
from clothgym.kernels.bending import (
    add_hinge_forces,
    add_quadratic_forces,
    hinge_energy,
    project_hinges,
    project_quadratic,
    quadratic_energy,
)
from clothgym.kernels.membrane import add_membrane_forces, membrane_energy, project_membrane
from clothgym.kernels.springs import add_spring_forces, project_springs


@device
def _add_membrane_forces(x, cloth, present, f):
    if present is None:
        return
    add_membrane_forces(x, cloth.membrane, f)


@device
def _add_hinge_forces(x, cloth, present, f):
    if present is None:
        return
    add_hinge_forces(x, cloth.hinges, f)


@device
def _add_quadratic_forces(x, cloth, present, f):
    if present is None:
        return
    add_quadratic_forces(x, cloth.quadratic, f)


@device
def add_elastic_forces(x, cloth, f):
    """Adds the forces of all energies to f (V, 3) [N]."""
    add_spring_forces(x, cloth, f)
    _add_membrane_forces(x, cloth, cloth.has_membrane, f)
    _add_hinge_forces(x, cloth, cloth.has_hinges, f)
    _add_quadratic_forces(x, cloth, cloth.has_quadratic, f)


@device
def _project_membrane(p, cloth, present, dt, multipliers, first):
    if present is None:
        return
    project_membrane(p, cloth.membrane, cloth.inverse_masses, dt, multipliers, first)


@device
def _project_hinges(p, cloth, present, dt, multipliers, first):
    if present is None:
        return
    project_hinges(p, cloth.hinges, cloth.inverse_masses, dt, multipliers, first)


@device
def _project_quadratic(p, cloth, present, dt, multipliers, first):
    if present is None:
        return
    project_quadratic(p, cloth.quadratic, cloth.inverse_masses, dt, multipliers, first)


@device
def project_elastic(p, cloth, dt, multipliers):
    """One sweep of XPBD over all energies; multipliers (C,) of one substep: one a spring, then three a triangle of the
    membrane, three a patch of hinges, nine a patch of quadratic bending."""
    project_springs(p, cloth, dt, multipliers)
    first = cloth.spring_ends.shape[0]
    _project_membrane(p, cloth, cloth.has_membrane, dt, multipliers, first)
    first += 3 * cloth.membrane.faces.shape[0]
    _project_hinges(p, cloth, cloth.has_hinges, dt, multipliers, first)
    first += 3 * cloth.hinges.stencils.shape[0]
    _project_quadratic(p, cloth, cloth.has_quadratic, dt, multipliers, first)


@device
def _membrane_energy(x, cloth, present):
    if present is None:
        return 0.0
    return membrane_energy(x, cloth.membrane)


@device
def _hinge_energy(x, cloth, present):
    if present is None:
        return 0.0
    return hinge_energy(x, cloth.hinges)


@device
def _quadratic_energy(x, cloth, present):
    if present is None:
        return 0.0
    return quadratic_energy(x, cloth.quadratic)


@kernel
def elastic_energy(x, cloth):
    """Energies [J] of springs, membrane and bending at positions x (V, 3)."""
    springs = 0.0
    for s in range(cloth.spring_ends.shape[0]):
        i = cloth.spring_ends[s, 0]
        j = cloth.spring_ends[s, 1]
        dx = x[j, 0] - x[i, 0]
        dy = x[j, 1] - x[i, 1]
        dz = x[j, 2] - x[i, 2]
        longer = math.sqrt(dx * dx + dy * dy + dz * dz) - cloth.spring_rest[s]
        springs += 0.5 * cloth.spring_stiffness[s] * longer * longer
    membrane = _membrane_energy(x, cloth, cloth.has_membrane)
    bending = _hinge_energy(x, cloth, cloth.has_hinges) + _quadratic_energy(x, cloth, cloth.has_quadratic)
    return springs, membrane, bending


@kernel
def elastic_forces(x, cloth, f):
    """Writes the forces of all energies to f (V, 3) [N]."""
    f[:] = 0.0
    add_elastic_forces(x, cloth, f)


@kernel
def spring_hessian(x, cloth, blocks):
    """Second derivatives of the springs' energy without the compressive part, which makes them positive semi-definite.

    k n n^T + k max(0, 1 - l0 / l) (1 - n n^T) with the direction n and the length l of a spring; exact where l >= l0.

    Args:
        x: (V, 3) [m].
        cloth: `ClothArrays`; stencils are cloth.spring_ends (S, 2).
        blocks: (S, 2, 2, 3, 3) [N/m], written: blocks[s, i, j] = d^2 E / dx_i dx_j; zero for a spring without length.
    """
    for s in range(cloth.spring_ends.shape[0]):
        i = cloth.spring_ends[s, 0]
        j = cloth.spring_ends[s, 1]
        dx = x[j, 0] - x[i, 0]
        dy = x[j, 1] - x[i, 1]
        dz = x[j, 2] - x[i, 2]
        size = math.sqrt(dx * dx + dy * dy + dz * dz)
        if size == 0.0:
            blocks[s] = 0.0
            continue
        k = cloth.spring_stiffness[s]
        across = k * max(0.0, 1.0 - cloth.spring_rest[s] / size)
        along = (k - across) / (size * size)
        for r in range(3):
            dr = dx if r == 0 else (dy if r == 1 else dz)
            for q in range(3):
                dq = dx if q == 0 else (dy if q == 1 else dz)
                value = along * dr * dq
                if r == q:
                    value += across
                blocks[s, 0, 0, r, q] = value
                blocks[s, 1, 1, r, q] = value
                blocks[s, 0, 1, r, q] = -value
                blocks[s, 1, 0, r, q] = -value
