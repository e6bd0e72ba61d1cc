"""Fidelity: how well a scene is modelled, apart from what is in it."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from clothgym.arrays import check_choice, check_flag, check_number, shown

INTEGRATORS = ("xpbd", "symplectic_euler", "runge_kutta", "implicit_euler", "global")
MEMBRANES = ("springs", "continuum")
BENDINGS = ("flexion", "hinge", "quadratic", "none")
VELOCITY_MODIFICATIONS = ("none", "literal", "relative")
DETECTIONS = ("hierarchy", "brute_force", "mezger")
INFLATIONS = ("unoriented", "oriented", "conservative", "swept")
CONES = ("none", "mezger", "exact")
BUILD_SPACES = ("pose", "pattern")
BODY_COLLIDERS = ("maps", "boxes", "dop")
BODY_VIEWS = ("auto", "z", "y", "x", "zy", "zx", "yx", "zyx")
BODY_RESPONSES = ("coulomb", "velocity")
BODY_NORMALS = ("face", "interpolated", "bytes")
CONTACTS_NEAR_HITS = ("keep", "off_any", "off_both", "yield", "limited")
DOPS = (6, 8, 14, 18, 26)
ARITIES = (2, 4, 8)
PRECISIONS = ("float64", "float32")

MOST_SUBSTEPS = 100_000
"""Substeps of a step, asked for or chosen."""
MOST_SWEEPS = 10_000
"""Sweeps of a substep, asked for or chosen."""

_RANGES = {
    "substeps": (0, MOST_SUBSTEPS, True),
    "sweeps": (1, MOST_SWEEPS, True),
    "contact_substeps": (1, 100_000, True),
    "stretch_error": (1e-5, 10.0, False),
    "time_order": (1, 2, True),
    "tolerance": (1e-9, 1e3, False),
    "solver_steps": (0, 10_000, True),
    "position_modification": (0, 1000, True),
    "stretch_limit": (0.0, 10.0, False),
    "close_angle": (0.0, math.pi, False),
    "leaf_angle": (0.0, math.pi, False),
    "wide_angle": (0.0, math.pi, False),
    "face_groups": (0, 6, True),
    "lazy": (0.0, 1.0, False),
    "coherence": (0.0, 1.0, False),
    "separation_list": (0, 1000, True),
    "rebuild_growth": (0.0, 1e6, False),
    "repair_rounds": (0, 1000, True),
    "untangling_passes": (1, 1000, True),
    "h0": (1e-6, 100.0, False),
    "g0": (1e-9, 1e9, False),
    "displacement_share": (0.0, 1.0, False),
    "velocity_share": (0.0, 1.0, False),
    "acceleration_share": (0.0, 1.0, False),
    "penalty_stiffness": (0.0, 1e9, False),
    "easing": (0, 1000, True),
    "speed_limit": (1e-3, 1e3, False),
    "yield_force": (1e-9, 1e9, False),
    "rings": (0, 10, True),
    "map_size": (8, 8192, True),
    "body_tolerance": (0.0, 1.0, False),
    "body_faces": (0, 16, True),
}

_WORKS_WITH = {
    **dict.fromkeys(("inflation", "cones", "face_groups", "lazy"), ("detection", ("mezger",))),
    **dict.fromkeys(("coherence", "separation_list", "build_space"), ("detection", ("mezger",))),
    "rebuild_growth": ("detection", ("hierarchy", "mezger")),
    "close_angle": ("cones", ("mezger",)),
    "leaf_angle": ("cones", ("mezger",)),
    "wide_angle": ("inflation", ("oriented", "conservative")),
    **dict.fromkeys(("map_size", "body_texels", "body_normals", "body_views"), ("body_collider", ("maps",))),
}
"""Fields that would do nothing but with these values of another."""


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
        substeps: parts of a step; 0 = as many as the safe time step of an explicit integrator, or the promise of XPBD,
            asks for; implicit integrators: 2.
        sweeps: Gauss-Seidel sweeps over springs and contacts a substep. With substeps = 0 XPBD takes substeps of one sweep,
            in contact at least as many as hold stretch as well as contact_substeps of so many sweeps.
        stretch_error: the promise of XPBD, where substeps = 0: no spring between neighbours gets longer than in the
            converged solution of the same material by more than this share of its length (see `promise`).
        contact_substeps: the least of XPBD in scenes with contact, where substeps = 0; see sweeps.
        precision: "float64", or "float32" for XPBD of springs on grids without contact: a tenth faster with thousands of
            vertices, slower with hundreds; stretch and mean heights are the same, single vertices of a fine sheet part by
            millimetres in a second, as after any rounding. Between steps positions and velocities stay float64.
        time_order: of implicit integrators: 1 (implicit Euler, damps swings) or 2 (two stages a substep, damps little).
        tolerance: what an implicit integrator may leave unbalanced [m/s^2], the root of the mean over the mass.
        solver_steps: after this many steps of Newton or quasi-Newton a solve ends before its tolerance, counted as
            "unconverged"; 0 = 50 for Newton; 5 for "global", which hardly ever reaches a tolerance in so few.
        velocity_modification: against super-elasticity with symplectic Euler: "none", "literal" (the paper), "relative".
        position_modification: the older way against super-elasticity [Provot 1995], likewise with symplectic Euler: after
            every substep, that many sweeps shorten springs that are too long; 0 = none. What the three ways cost and
            reach, see `clothgym bench tradeoff`.
        stretch_limit: strain above which velocity or position modification acts (the paper: 0.01 to 0.15).
        detection: "hierarchy" (k-DOP tree of clusters, the fastest), "brute_force" (every pair), or "mezger": the tree of
            [Mezger 2003] with one face a leaf and the techniques below. What they are, see `docs/papers.md`; what they cost and
            miss, `clothgym bench mezger`; what they do, `metrics()["work"]`.
        k: half-spaces a box of the hierarchy: 6, 8, 14, 18, 26.
        arity: children a node: 2, 4, 8.
        flat_check: with the hierarchy, sheets that are height fields over a plane, and far from each other, are recognised
            without a search for pairs.
        inflation: boxes of "mezger" hold the way of a step "swept" around both its ends, or "conservative": eq. 1 with the
            half-angle of the velocity cone; both miss nothing. "oriented": eq. 1 as printed, which misses what leaves the axis
            of its cone; "unoriented": places without ways, the least box tests, misses what is fast.
        cones: self-collision of regions is left out by "none", by "mezger"'s curvature criterion, which misses regions whose
            outlines fold over themselves and sharp bends, or "exact", with the outline, which misses nothing.
        close_angle: apex angle [rad] from which "mezger" cones look for self-collision; smaller misses less, tests more.
        leaf_angle: with "mezger" cones, least angle [rad] of two faces in the same or adjacent groups; two with a common vertex
            are left out too. 0 = all are tested; larger is faster and misses more.
        wide_angle: half-angle [rad] from which a velocity cone has no direction, for "oriented" and "conservative".
        face_groups: level of the tree whose nodes are the face groups: 0 = one group, each level has `arity` times as many.
            "mezger" cones prune only what lies in groups that all touch; lazy update and coherence go group by group.
        lazy: b [m]: boxes are b wider, and those of a group are refitted when a vertex is more than b from where they saw
            it: proximities of eps + 2 b are looked for, so that those of eps are found. 0 = always. Misses nothing.
        coherence: relative way [m] of two groups within which their last pairs are used again, with the barycentrics of
            their closest points; boxes are half of it wider. 0 = never. Misses nothing.
        separation_list: searches that resume where the last descent stopped, before one begins at the root again; 0 = all
            begin there. Misses nothing.
        build_space: "mezger" splits faces by where they are at the start ("pose") or in the "pattern": the rest shape.
        rebuild_growth: a tree is made anew when the surface of its boxes has grown by this factor (a flat sheet's more than
            doubles when it crumples); 0 = never. Costs sorted pairs with "hierarchy", may save box tests. Misses nothing.
        repair_rounds: sweeps that push pairs apart before zones move as one (see `kernels.certificate.keep_apart`).
        continuous: test pairs that the certificate of contact does not cover continuously, and count those that pass each
            other as `tunnel_events`; nothing else changes. Took 8 % more for tangled squares, nothing measurable
            without intersections.
        untangling: "none", a strategy of `clothgym.response.untangling.STRATEGIES`, or "package.module:Name" of your own.
        untangle_bodies: intersections of cloth with the bodies' true surfaces are looked for and resolved too, by moving the
            cloth; the bodies' maps know inside from outside and need no help where a body has a volume.
        untangling_passes: corrections a step.
        h0: largest correction of a pass, in mean edge lengths [Volino 2006, eq. 5].
        g0: gradient at which corrections saturate, dimensionless [Volino 2006, eq. 5].
        displacement_share: share of a correction that moves vertices at once, 0 to 1; without any there is one pass a step.
        velocity_share: share of a correction that also goes into the velocity, 0 to 1.
        acceleration_share: share of a correction that an acceleration adds by the end of the step, 0 to 1.
        penalty_stiffness: [N/m] of a force along the correction for the step, on a vertex of mean mass; on others in
            proportion to theirs.
        easing: sweeps after the corrections of a step that bring edges around them back to their lengths, so that springs need
            not, which would turn strain into speed: 40 to 80 m/s where 25 squares intersect; 0 = none.
        speed_limit: corrections speed up no vertex beyond this [m/s].
        contacts_near_hits: beside an intersection, contact locks the wrong side: "keep" it all the same, "off_any" = leave
            out pairs with a vertex there, "off_both" = leave out pairs with vertices there on both sides, "yield" = such a
            contact gives way above yield_force: weight does not pull layers through each other, a hand does; "limited" = it
            keeps the distance that there is, without regaining the thickness.
        yield_force: [N] a contact, for "yield".
        rings: how many edges around a hit count as beside it.
        body_collider: what tells cloth where bodies are: "maps" in image space, asked in every sweep; or what stands for the
            alternatives, asked before the sweeps of a substep: "boxes" in object space, as [Vassilev 2001] compares (body_faces
            as with maps), or "dop": the k-DOP tree, with vertices against faces both ways and edges against edges.
        map_size: texels of the body's maps along its longer side; finer maps follow the body more closely.
        body_tolerance: distance that vertices keep from the body [m].
        body_faces: n: faces are tested against the body too, at .35 of the tolerance, at the midpoints of the n^2 equal
            triangles in each; 0 = vertices only, 1 = as the paper, more where the body is sharper than the cloth is fine.
        body_texels: faces are drawn into the maps instead, and tested at every texel that they cover: nothing that the maps
            show pokes through a face, however coarse the cloth is [Vassilev 2001, future work].
        body_normals: planes of the body from its "face"s, which join, so that cloth comes to rest on them, or with
            "interpolated" normals [Vassilev 2001, 5.2], which are smoother but jump by some 0.03 mm between texels, or these
            as "bytes" of a colour [Vassilev 2001, eq. 6 and 7], off by up to 0.4 of a degree.
        body_views: axes along which the body is looked at, from both sides each: "z" as the paper; "zx", "zyx" and so on see
            more of what lies behind something else and cost a look each; a point is inside where all say so. "auto": "z" for
            bodies with limbs, which the front and the back show, else "zy", since cloth lies on their tops.
        body_response: "coulomb" friction, at which cloth comes to rest, or "velocity" [Vassilev 2001, eq. 12], which creeps.
    """

    integrator: str = "xpbd"
    membrane: str = "springs"
    bending: str = "flexion"
    substeps: int = 0
    sweeps: int = 8
    stretch_error: float = 0.03
    contact_substeps: int = 8
    precision: str = "float64"
    time_order: int = 2
    tolerance: float = 0.05
    solver_steps: int = 0
    velocity_modification: str = "none"
    position_modification: int = 0
    stretch_limit: float = 0.1
    detection: str = "hierarchy"
    k: int = 18
    arity: int = 4
    flat_check: bool = True
    inflation: str = "swept"
    cones: str = "exact"
    close_angle: float = 0.5 * math.pi
    leaf_angle: float = 0.0
    wide_angle: float = math.pi / 3.0
    face_groups: int = 2
    lazy: float = 0.0
    coherence: float = 0.0
    separation_list: int = 0
    build_space: str = "pose"
    rebuild_growth: float = 0.0
    repair_rounds: int = 8
    continuous: bool = False
    untangling: str = "hybrid"
    untangle_bodies: bool = False
    untangling_passes: int = 3
    h0: float = 1.0
    g0: float = 1.0
    displacement_share: float = 1.0
    velocity_share: float = 1.0
    acceleration_share: float = 0.0
    penalty_stiffness: float = 0.0
    easing: int = 8
    speed_limit: float = 2.0
    contacts_near_hits: str = "off_any"
    yield_force: float = 0.02
    rings: int = 1
    body_collider: str = "maps"
    map_size: int = 360
    body_tolerance: float = 3e-3
    body_faces: int = 3
    body_texels: bool = False
    body_normals: str = "face"
    body_views: str = "auto"
    body_response: str = "coulomb"

    def __post_init__(self) -> None:
        check_choice(self.integrator, "fidelity.integrator", INTEGRATORS)
        check_choice(self.membrane, "fidelity.membrane", MEMBRANES)
        check_choice(self.bending, "fidelity.bending", BENDINGS)
        check_choice(self.precision, "fidelity.precision", PRECISIONS)
        check_choice(self.velocity_modification, "fidelity.velocity_modification", VELOCITY_MODIFICATIONS)
        check_choice(self.detection, "fidelity.detection", DETECTIONS)
        check_choice(self.inflation, "fidelity.inflation", INFLATIONS)
        check_choice(self.cones, "fidelity.cones", CONES)
        check_choice(self.build_space, "fidelity.build_space", BUILD_SPACES)
        check_choice(self.contacts_near_hits, "fidelity.contacts_near_hits", CONTACTS_NEAR_HITS)
        check_choice(self.body_collider, "fidelity.body_collider", BODY_COLLIDERS)
        check_choice(self.body_normals, "fidelity.body_normals", BODY_NORMALS)
        check_choice(self.body_views, "fidelity.body_views", BODY_VIEWS)
        check_choice(self.body_response, "fidelity.body_response", BODY_RESPONSES)
        for field, (low, high, integer) in _RANGES.items():
            # stored as plain numbers, so that JSON and hashes do not depend on the caller's types
            object.__setattr__(self, field, check_number(getattr(self, field), f"fidelity.{field}", low, high, integer))
        for field, choices in (("k", DOPS), ("arity", ARITIES)):
            value = getattr(self, field)
            if not isinstance(value, int | float | np.number) or isinstance(value, bool) or value not in choices:
                raise ValueError(f"fidelity.{field} = {shown(value)}: expected one of {', '.join(map(str, choices))}")
            object.__setattr__(self, field, int(getattr(self, field)))
        for field in ("flat_check", "continuous", "untangle_bodies", "body_texels"):
            object.__setattr__(self, field, check_flag(getattr(self, field), f"fidelity.{field}"))
        if not isinstance(self.untangling, str) or not self.untangling:
            raise ValueError(f"fidelity.untangling = {shown(self.untangling)}: expected the name of a strategy")
        for field in ("velocity_modification", "position_modification"):
            if getattr(self, field) == getattr(Fidelity, field):
                continue
            given = f"fidelity.{field} = {getattr(self, field)!r}"
            if self.integrator != "symplectic_euler":
                raise ValueError(
                    f"{given}: works with integrator 'symplectic_euler' only; XPBD limits strain by its constraints"
                )
            if self.membrane != "springs":
                raise ValueError(f"{given}: acts on springs; membrane = {self.membrane!r} has none")
        if self.velocity_modification != "none" and self.position_modification > 0:
            raise ValueError(
                f"fidelity.position_modification = {self.position_modification}: not together with velocity_modification = "
                f"{self.velocity_modification!r}; they are two ways to the same end"
            )
        for field, (other, values) in _WORKS_WITH.items():
            if getattr(self, field) != getattr(Fidelity, field) and getattr(self, other) not in values:
                raise ValueError(
                    f"fidelity.{field} = {getattr(self, field)!r}: works with {other} {' or '.join(map(repr, values))} only"
                )

    @staticmethod
    def preset(name: str) -> Fidelity:
        """ "draft", "balanced" or "accurate".

        Raises:
            ValueError: another name.
        """
        if not isinstance(name, str) or name not in PRESETS:
            raise ValueError(f"fidelity = {shown(name)}: expected one of {', '.join(PRESETS)}, or a Fidelity")
        return PRESETS[name]

    @staticmethod
    def for_error(scene: Any, stretch: float) -> Fidelity:
        """The cheapest preset for a scene, with a promise of its own: how much longer than in the converged solution of the
        same material any spring between neighbours may get.

        How much work that takes is chosen when the scene is assembled; `Simulation.pipeline.describe()` tells.

        Args:
            scene: a `Scene`.
            stretch: share of the length, 1e-5 to 10; the presets promise 0.1, 0.03 and 0.005.

        Raises:
            ValueError: no scene, or a stretch out of range.
        """
        if not hasattr(scene, "cloths"):
            raise ValueError(f"for_error: scene = {scene!r:.80}: expected a Scene")
        low, high, _ = _RANGES["stretch_error"]
        stretch = check_number(stretch, "for_error: stretch", low, high)
        able = [p for p in PRESETS.values() if p.stretch_error <= stretch]
        base = max(able, key=lambda p: p.stretch_error) if able else PRESETS["accurate"]
        return dataclasses.replace(base, stretch_error=stretch)

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
    "draft": Fidelity(stretch_error=0.1, contact_substeps=4, sweeps=4, body_faces=1),
    "balanced": Fidelity(),
    "accurate": Fidelity(stretch_error=0.005, contact_substeps=16, body_faces=4, map_size=720, continuous=True),
}


def get(fidelity: str | Fidelity) -> Fidelity:
    """A preset by name, or a Fidelity as it is."""
    return fidelity if isinstance(fidelity, Fidelity) else Fidelity.preset(fidelity)
