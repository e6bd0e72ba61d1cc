"""Which settings are run: presets and targets, solvers at several efforts, and one field at a time around a preset.

No full product: a setting is a preset with a few fields changed, and has a label that a reader understands.
"""

from __future__ import annotations

from typing import Any

from clothgym.fidelity import PRESETS

Setting = tuple[str, str, dict[str, Any]]
"""Group ("preset", "target", "solver", "field"), label, fields of `measure.fidelity_of`."""

TARGETS = (0.05, 0.01, 0.002)
"""Promises beside those of the presets."""
_ORDERS = {"implicit_euler 1": {"time_order": 1}, "implicit_euler 2": {"time_order": 2}}


def settings(subject: str, quick: bool) -> list[Setting]:
    """All settings of a subject."""
    found: list[Setting] = [("preset", name, {"base": name}) for name in PRESETS]
    if subject != "squares":
        targets = TARGETS[:1] if quick or subject == "skirt" else TARGETS
        found += [("target", f"within {100 * t:g} %", {"base": _base(t), "stretch_error": t}) for t in targets]
    if subject.startswith("sheet"):
        found += _solvers(subject, quick)
    elif subject in ("ball", "drop"):
        found += _solvers_in_contact(quick)
    fields = (_QUICK if quick else _FIELDS).get("sheet" if subject.startswith("sheet") else subject, {})
    for base in tuple(PRESETS) if not quick and subject in ("ball", "table", "drop") else ("balanced",):
        found += _around(base, fields)
    return found


def _base(target: float) -> str:
    """The preset that `Fidelity.for_error` would start from."""
    able = [name for name, preset in PRESETS.items() if preset.stretch_error <= target]
    return max(able, key=lambda name: PRESETS[name].stretch_error) if able else "accurate"


def _solvers(subject: str, quick: bool) -> list[Setting]:
    """Solvers x effort; what a step of a fine sheet makes too dear is left out."""
    fine = subject == "sheet_64"
    found: list[Setting] = []

    def add(label: str, **fields: Any) -> None:
        found.append(("solver", label, fields))

    for sweeps in (1, 8) if quick or fine else (1, 4, 16):
        for substeps in ((4, 16, 64) if quick else (4, 8, 16, 32, 64, 128)) if not fine else (16, 64, 256):
            add(f"xpbd {substeps} x {sweeps}", substeps=substeps, sweeps=sweeps)
    for integrator in ("symplectic_euler",) if fine else ("symplectic_euler", "runge_kutta"):
        add(integrator, integrator=integrator)
        for factor in () if fine or quick else (2, 4):
            add(f"{integrator}, {factor} x finer", integrator=integrator, finer=factor)
    for name, order in _ORDERS.items():
        for substeps in () if fine else (1, 4) if quick else (1, 2, 4, 8, 16):
            add(f"{name}, {substeps}", integrator="implicit_euler", substeps=substeps, **order)
    for steps in (5,) if quick else (5, 20):
        for substeps in (1, 4) if quick else (1, 2, 4, 8):
            more = {} if steps == 5 else {"solver_steps": steps}
            add(f"global, {substeps} x {steps}", integrator="global", substeps=substeps, **more)
    if fine:
        return found
    for substeps in (16, 64) if quick else (8, 16, 32, 64, 128):
        add(f"xpbd continuum {substeps} x 1", substeps=substeps, sweeps=1, membrane="continuum")
    add("implicit_euler 1 continuum, 4", integrator="implicit_euler", substeps=4, time_order=1, membrane="continuum")
    if subject == "sheet_16" and not quick:
        for bending in ("hinge", "quadratic"):
            for substeps in (16, 32, 64):
                add(f"xpbd {bending} {substeps} x 4", substeps=substeps, sweeps=4, bending=bending)
    return found


def _solvers_in_contact(quick: bool) -> list[Setting]:
    found: list[Setting] = []
    for substeps, sweeps in ((8, 8),) if quick else ((4, 4), (8, 4), (8, 8), (8, 16), (16, 4), (16, 8), (32, 4)):
        found.append(("solver", f"xpbd {substeps} x {sweeps}", {"substeps": substeps, "sweeps": sweeps}))
    others: dict[str, dict[str, Any]] = {
        "implicit_euler 2, 4": {"integrator": "implicit_euler", "substeps": 4},
        "implicit_euler 1, 4": {"integrator": "implicit_euler", "substeps": 4, "time_order": 1},
        "global, 4 x 5": {"integrator": "global", "substeps": 4},
        "symplectic_euler": {"integrator": "symplectic_euler"},
    }
    return found + [("solver", label, fields) for label, fields in others.items() if not quick or "2, 4" in label]


_FIELDS: dict[str, dict[str, tuple[Any, ...]]] = {
    "sheet": {"precision": ("float32",)},
    "ball": {
        "map_size": (45, 90, 180, 360, 720),
        "body_faces": (0, 1, 2, 3, 4),
        "body_normals": ("interpolated",),
        "body_response": ("velocity",),
        "contact_substeps": (2, 4, 16),
        "sweeps": (2, 4, 16),
    },
    "table": {"map_size": (90, 180, 360, 720), "body_faces": (0, 1, 2, 3, 4), "contact_substeps": (4, 16)},
    "drop": {
        "k": (6, 8, 14, 26),
        "arity": (2, 8),
        "detection": ("brute_force", "mezger"),
        "flat_check": (False,),
        "continuous": (True,),
        "repair_rounds": (0, 2),
        "contact_substeps": (2, 4, 16, 32),
        "sweeps": (2, 4, 16),
    },
    "squares": {
        "untangling": ("none", "local", "global"),
        "untangling_passes": (1, 10),
        "k": (6, 26),
        "contacts_near_hits": ("keep", "off_both"),
        "rings": (0, 2),
        "h0": (0.3,),
        "contact_substeps": (4, 16),
        "sweeps": (4,),
    },
    "skirt": {"body_faces": (0, 1, 2, 4), "map_size": (180,), "contact_substeps": (4, 16)},
}
"""Field -> other values, by subject; all values of a preset's own are left out."""
_QUICK: dict[str, dict[str, tuple[Any, ...]]] = {
    "sheet": {"precision": ("float32",)},
    "table": {"body_faces": (0, 1, 2)},
    "ball": {"map_size": (90,), "body_faces": (0, 1), "contact_substeps": (4,)},
    "drop": {"k": (6, 26), "detection": ("brute_force",), "contact_substeps": (4,)},
    "squares": {"untangling": ("local",), "untangling_passes": (1, 10)},
}


def _around(base: str, fields: dict[str, tuple[Any, ...]]) -> list[Setting]:
    """A preset with one field changed at a time."""
    found: list[Setting] = []
    for field, values in fields.items():
        for value in values:
            if getattr(PRESETS[base], field) != value:
                found.append(("field", f"{base}, {field} = {_shown(value)}", {"base": base, field: value}))
    return found


def _shown(value: Any) -> str:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)
