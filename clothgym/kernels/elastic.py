"""All energies of a cloth together: forces for explicit integration, XPBD projection for the sweeps."""

from __future__ import annotations

from clothgym._jit import device
from clothgym.kernels.springs import add_spring_forces, project_springs


@device
def add_elastic_forces(x, cloth, f):
    """Adds the forces of all energies to f (V, 3) [N]."""
    add_spring_forces(x, cloth, f)


@device
def project_elastic(p, cloth, dt, multipliers):
    """One sweep of XPBD over all energies; multipliers (C,) [N s^2] of one substep."""
    project_springs(p, cloth, dt, multipliers)
