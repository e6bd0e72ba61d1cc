"""`clothgym bench tradeoff`: what accuracy costs, by solver and setting, and where the presets stand.

Three kinds of cases: "reference" (converged runs), "run" (a scene with a setting, against its reference) and "strain"
(the ways against super-elasticity).
"""

from __future__ import annotations

from typing import Any

import clothgym as cg
from clothgym.benchmarks.frame import Benchmark, Case
from clothgym.benchmarks.tradeoff import measure, pictures, show, strain
from clothgym.benchmarks.tradeoff.settings import settings
from clothgym.benchmarks.tradeoff.subjects import SUBJECTS, scene_of

_QUICK = ("sheet_16", "ball", "table", "drop", "squares")
_NOTES = (
    "Cost is processor time of the steps on one core, a single run each: differences below a tenth say nothing. Errors are "
    "distances to a converged run of the same material and mesh, positions and heights until buckling makes it chaotic (see "
    "References, which also tells how far two runs at high effort are apart). Settings are a preset with some fields "
    "changed: promises of Fidelity.for_error ('within 1 %'), solvers at several efforts, one field at a time "
    "('balanced, k = 6'). "
    "A run has blown up when a spring is three times as long as at rest, when energy rises by more than weight x size, or "
    "with SimulationError. Peaks are over all frames, never the end. Memory: most that Python and numpy held while "
    "assembling and for two steps."
)


def cases(quick: bool) -> list[Case]:
    """Of every subject its references, then its settings; then strain limiting. A quick run does not ask how far its
    references can be trusted."""
    found = []
    for name in _QUICK if quick else SUBJECTS:
        chosen = settings(name, quick)
        models = {(fields.get("membrane", "springs"), fields.get("bending", "flexion")) for _, _, fields in chosen}
        if SUBJECTS[name].reference is not None:
            for membrane, bending in sorted(models, reverse=True):
                parameters = {"kind": "reference", "subject": name, "membrane": membrane, "bending": bending}
                parameters["checked"] = not quick and (membrane, bending) == ("springs", "flexion")
                found.append(Case(f"reference/{name}/{membrane}/{bending}", parameters))
        for group, label, fields in chosen:
            parameters = {"kind": "run", "subject": name, "group": group, "label": label, "fields": fields}
            found.append(Case(f"run/{name}/{label}", parameters))
    for place in strain.PLACES:
        found += [Case(f"strain/{place}/{arm}", {"kind": "strain", "place": place, "arm": arm}) for arm in strain.ARMS]
    return found


def prepare() -> None:
    """Compiles every kernel that a case uses."""
    done = set()
    for case in cases(False):
        p = case.parameters
        if p["kind"] != "run" or p["subject"] in ("sheet_32", "sheet_64"):
            continue
        kind = (p["subject"], *(p["fields"].get(key) for key in ("integrator", "membrane", "bending", "precision")))
        if kind not in done:
            done.add(kind)
            scene = scene_of(p["subject"])
            cg.Simulation(scene, measure.fidelity_of(p["fields"], scene)).step()


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One case; see `measure.run`, `measure.reference` and `strain.run` for what it returns."""
    p = parameters
    if p["kind"] == "strain":
        return strain.run(p["arm"], p["place"])
    if p["kind"] == "reference":
        return measure.reference(p["subject"], p["membrane"], p["bending"], p["checked"])
    return measure.run(p["subject"], p["fields"])


benchmark = Benchmark(
    name="tradeoff",
    title="Speed against accuracy: solvers, settings and presets",
    cases=cases,
    run=run,
    tables=show.tables,
    plots=pictures.plots,
    prepare=prepare,
    notes=_NOTES,
)
