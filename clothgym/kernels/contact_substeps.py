"""All substeps of XPBD in which cloth touches cloth, in one kernel, as long as the pairs found for the step are complete."""

from __future__ import annotations

from typing import NamedTuple

from numpy.typing import NDArray

from clothgym._jit import bare, kernel
from clothgym.kernels.certificate import prove_all
from clothgym.kernels.clamped import settle
from clothgym.kernels.contact import narrowed, sweep_all, take_rebound
from clothgym.kernels.integrate import accelerate, add_grip_forces, finish_substep
from clothgym.kernels.strays import strays

CONTACTS, MEASURED, REPAIRED, ZONED, UNPROVED = range(5)
"""Places in the counts of work."""


class Expected(NamedTuple):
    """For where pairs were searched: start + share travel, within slack."""

    start: NDArray  # (V, 3) [m]
    travel: NDArray  # (V, 3) [m]
    slack: NDArray  # (V,) [m]
    base: int  # substep that began at start
    horizon: int  # substeps that the travel takes


class Rules(NamedTuple):
    """How contact is answered."""

    friction: float
    both: bool  # pairs are beside an intersection if both sides are
    yield_force: (
        float  # [N] such a contact gives way above it; 0 = there is none; negative = it keeps the distance it has
    )
    rounds: int  # sweeps that push pairs apart before zones move as one
    thickness: NDArray  # (V,) [m]
    apart: NDArray  # (V,) bool: beside an intersection


@bare
def _strays(x, expected, substep):
    share = (substep - expected.base) / expected.horizon
    return strays(x, expected.start, expected.travel, share, expected.slack)


@bare
def _give_back(v, kept):
    for i in range(v.shape[0]):
        for c in range(3):
            v[i, c] = kept[i, c]


@kernel
def xpbd_substeps_in_contact(
    x,
    v,
    p,
    kept,
    cloth,
    radii,
    motion,
    ground,
    grips,
    multipliers,
    first,
    last,
    expected,
    watched,
    count,
    known,
    contacts,
    rules,
    push,
    clamped,
    work,
    runs,
):
    """Substeps `first` to `last` with contact: predict, contacts, sweeps with contact last, proof, new velocities.

    kept (V, 3) and push (V, 8) are scratch; `known` contacts are collected, negative = they are not. Ends before a substep for
    which pairs have to be found anew, or contacts do not fit: its state is as if it had not been tried. Returns that substep,
    how many contacts are known, and how many vertices were clamped in the last one.
    """
    w = cloth.inverse_masses
    leave = rules.yield_force == 0.0
    tight = 0
    for n in range(first, last):
        _give_back(kept, v)
        if n == first and _strays(x, expected, n):  # later ones begin where the one before was proved
            return n, known, tight
        accelerate(x, v, p, cloth, motion)
        if _strays(p, expected, n + 1):
            _give_back(v, kept)
            return n, known, tight
        known, live, measured = narrowed(
            x, p, watched, count, w, rules.apart, rules.both, rules.yield_force, known, contacts
        )
        work[MEASURED] += measured
        if known > contacts.rest.shape[0]:
            _give_back(v, kept)
            return n, -1, tight
        sweep_all(x, p, cloth, contacts, live, rules.friction, radii, motion, ground, grips, multipliers, n, True, runs)
        found = settle(p, contacts, live, push, clamped)
        if _strays(p, expected, n + 1):
            _give_back(v, kept)
            return n, known, tight
        measured, repaired, zoned, unproved = prove_all(
            x, p, w, rules.thickness, watched, count, rules.apart, rules.both, leave, rules.rounds
        )
        work[MEASURED] += measured
        if measured > 0:
            known = -1
        if repaired + zoned > 0 and _strays(p, expected, n + 1):
            _give_back(v, kept)
            return n, known, tight
        work[CONTACTS] += live
        work[REPAIRED] += repaired
        work[ZONED] += zoned
        work[UNPROVED] += unproved
        tight = found
        add_grip_forces(grips, motion.dt)
        finish_substep(x, v, p, motion.dt)
        take_rebound(v, w, contacts, live, motion.dt)
    return last, known, tight
