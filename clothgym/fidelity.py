"""Fidelity: how well a scene is modelled, apart from what is in it."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import Any

from clothgym.arrays import check_choice, check_number

INTEGRATORS = ("xpbd", "symplectic_euler", "runge_kutta", "implicit_euler", "global")
MEMBRANES = ("springs", "continuum")
BENDINGS = ("flexion", "hinge", "quadratic", "none")
VELOCITY_MODIFICATIONS = ("none", "literal", "relative")
DETECTIONS = ("hierarchy", "brute_force")
BODY_RESPONSES = ("coulomb", "velocity")
BODY_NORMALS = ("face", "interpolated")
CONTACTS_NEAR_HITS = ("keep", "off_any", "off_both", "yield")
DOPS = (6, 8, 14, 18, 26)
ARITIES = (2, 4, 8)

_RANGES = {
    "substeps": (0, 100_000, True),
    "sweeps": (1, 10_000, True),
    "time_order": (1, 2, True),
    "tolerance": (1e-9, 1e3, False),
    "solver_steps": (0, 10_000, True),
    "stretch_limit": (0.0, 10.0, False),
    "repair_rounds": (0, 1000, True),
    "untangling_passes": (1, 1000, True),
    "h0": (1e-6, 100.0, False),
    "g0": (1e-9, 1e9, False),
    "velocity_share": (0.0, 1.0, False),
    "speed_limit": (1e-3, 1e3, False),
    "yield_force": (1e-9, 1e9, False),
    "rings": (0, 10, True),
    "map_size": (8, 8192, True),
    "body_tolerance": (0.0, 1.0, False),
    "body_faces": (0, 16, True),
}


@dataclass(frozen=True)
class Fidelity:
    """How well a scene is modelled. Every field changes a stage or a constant of the pipeline of some scene.

    Attributes:
        integrator: "xpbd" (small substeps, stable at any step), "symplectic_euler" (springs as forces, as the paper),
            "runge_kutta" (the same, of order 4), "implicit_euler" (Newton's method, stable at any step),
            "global" (the same steps by quasi-Newton with a constant system that is factored once).
        membrane: what resists stretch and shear: "springs" as the paper, or a "continuum" of triangles with the moduli of the
            material along weft and warp, whose stiffness does not depend on the mesh.
        bending: "flexion" springs as the paper, which have no linear bending stiffness; "hinge" angles with the material's
            bending rigidity; "quadratic" in the positions, cheaper, for cloth that is flat at rest; or "none".
        substeps: parts of a step; 0 = as many as the safe time step of an explicit integrator asks for (XPBD: 8, implicit
            ones: 2).
        sweeps: Gauss-Seidel sweeps over springs and contacts a substep.
        time_order: of implicit integrators: 1 (implicit Euler, damps swings) or 2 (two stages a substep, damps little).
        tolerance: what an implicit integrator may leave unbalanced [m/s^2], the root of the mean over the mass.
        solver_steps: after this many steps of Newton or quasi-Newton a solve ends before its tolerance, counted as
            "unconverged"; 0 = 50 for Newton; 5 for "global", which hardly ever reaches a tolerance in so few.
        velocity_modification: against super-elasticity with symplectic Euler: "none", "literal" (the paper), "relative".
        stretch_limit: strain above which velocity modification acts (the paper: 0.01 to 0.15).
        detection: "hierarchy" (k-DOP tree) or "brute_force".
        k: half-spaces a box of the hierarchy: 6, 8, 14, 18, 26.
        arity: children a node: 2, 4, 8.
        repair_rounds: sweeps that push pairs apart before zones move as one (see `kernels.certificate.certify`).
        untangling: "none", "local", "global", "hybrid", or "package.module:Name" of a user's own strategy.
        untangling_passes: corrections a step.
        h0: largest correction of a pass, in mean edge lengths [Volino 2006, eq. 5].
        g0: gradient at which corrections saturate, dimensionless [Volino 2006, eq. 5].
        velocity_share: share of a correction that also goes into the velocity, 0 to 1.
        speed_limit: corrections speed up no vertex beyond this [m/s].
        contacts_near_hits: beside an intersection, contact locks the wrong side: "keep" it all the same, "off_any" = leave
            out pairs with a vertex there, "off_both" = leave out pairs with vertices there on both sides, "yield" = such a
            contact gives way above yield_force: weight does not pull layers through each other, a hand does.
        yield_force: [N] a contact, for "yield".
        rings: how many edges around a hit count as beside it.
        map_size: texels of the body's maps along its longer side; finer maps follow the body more closely.
        body_tolerance: distance that vertices keep from the body [m].
        body_faces: n: faces are tested against the body too, at half the tolerance, at the midpoints of the n^2 equal
            triangles in each; 0 = vertices only, 1 = as the paper, more where the body is sharper than the cloth is fine.
        body_normals: planes of the body from its "face"s, which join, so that cloth comes to rest on them, or with
            "interpolated" normals [Vassilev 2001, 5.2], which are smoother but jump by some 0.03 mm between texels.
        body_response: "coulomb" friction, at which cloth comes to rest, or "velocity" [Vassilev 2001, eq. 12], which creeps.
    """

    integrator: str = "xpbd"
    membrane: str = "springs"
    bending: str = "flexion"
    substeps: int = 8
    sweeps: int = 8
    time_order: int = 2
    tolerance: float = 0.05
    solver_steps: int = 0
    velocity_modification: str = "none"
    stretch_limit: float = 0.1
    detection: str = "hierarchy"
    k: int = 18
    arity: int = 4
    repair_rounds: int = 8
    untangling: str = "hybrid"
    untangling_passes: int = 3
    h0: float = 1.0
    g0: float = 1.0
    velocity_share: float = 1.0
    speed_limit: float = 2.0
    contacts_near_hits: str = "off_any"
    yield_force: float = 0.02
    rings: int = 1
    map_size: int = 360
    body_tolerance: float = 3e-3
    body_faces: int = 3
    body_normals: str = "face"
    body_response: str = "coulomb"

    def __post_init__(self) -> None:
        check_choice(self.integrator, "fidelity.integrator", INTEGRATORS)
        check_choice(self.membrane, "fidelity.membrane", MEMBRANES)
        check_choice(self.bending, "fidelity.bending", BENDINGS)
        check_choice(self.velocity_modification, "fidelity.velocity_modification", VELOCITY_MODIFICATIONS)
        check_choice(self.detection, "fidelity.detection", DETECTIONS)
        check_choice(self.contacts_near_hits, "fidelity.contacts_near_hits", CONTACTS_NEAR_HITS)
        check_choice(self.body_normals, "fidelity.body_normals", BODY_NORMALS)
        check_choice(self.body_response, "fidelity.body_response", BODY_RESPONSES)
        for field, (low, high, integer) in _RANGES.items():
            # stored as plain numbers, so that JSON and hashes do not depend on the caller's types
            object.__setattr__(self, field, check_number(getattr(self, field), f"fidelity.{field}", low, high, integer))
        for field, choices in (("k", DOPS), ("arity", ARITIES)):
            if getattr(self, field) not in choices:
                raise ValueError(
                    f"fidelity.{field} = {getattr(self, field)!r}: expected one of {', '.join(map(str, choices))}"
                )
            object.__setattr__(self, field, int(getattr(self, field)))
        if not isinstance(self.untangling, str) or not self.untangling:
            raise ValueError(f"fidelity.untangling = {self.untangling!r}: expected the name of a strategy")
        if self.velocity_modification != "none" and self.integrator != "symplectic_euler":
            raise ValueError(
                f"fidelity.velocity_modification = {self.velocity_modification!r}: works with integrator "
                "'symplectic_euler' only; XPBD limits strain by its constraints"
            )
        if self.velocity_modification != "none" and self.membrane != "springs":
            raise ValueError(
                f"fidelity.velocity_modification = {self.velocity_modification!r}: acts on springs; membrane = "
                f"{self.membrane!r} has none"
            )

    @staticmethod
    def preset(name: str) -> Fidelity:
        """ "draft", "balanced" or "accurate".

        Raises:
            ValueError: another name.
        """
        if name not in PRESETS:
            raise ValueError(f"fidelity = {name!r}: expected one of {', '.join(PRESETS)}, or a Fidelity")
        return PRESETS[name]

    def to_json(self) -> str:
        """One JSON object with every field."""
        return json.dumps(dataclasses.asdict(self))

    @staticmethod
    def from_json(text: str | dict[str, Any]) -> Fidelity:
        """Raises ValueError for unknown fields and values out of range, by name."""
        values = json.loads(text) if isinstance(text, str) else dict(text)
        known = [f.name for f in dataclasses.fields(Fidelity)]
        unknown = set(values) - set(known)
        if unknown:
            raise ValueError(f"fidelity.{min(unknown)}: unknown field; known: {', '.join(known)}")
        return Fidelity(**values)


PRESETS: dict[str, Fidelity] = {
    "draft": Fidelity(substeps=4, sweeps=4, body_faces=1),
    "balanced": Fidelity(),
    "accurate": Fidelity(substeps=16, sweeps=8, body_faces=4, map_size=720),
}


def get(fidelity: str | Fidelity) -> Fidelity:
    """A preset by name, or a Fidelity as it is."""
    return fidelity if isinstance(fidelity, Fidelity) else Fidelity.preset(fidelity)
