"""`clothgym bench stability`: where a simulation is stable, where it degrades and says so, where it stops, what is refused.

Four kinds of cases: "map" (time step x stiffness, per integrator), "extreme" (one quantity driven to the absurd),
"limit" (the largest stable step of explicit integration, measured and predicted) and "input" (numbers that are none).
"""

from __future__ import annotations

from typing import Any

import clothgym as cg
from clothgym import fidelity as fidelities
from clothgym.benchmarks.frame import Benchmark, Case
from clothgym.benchmarks.stability import extremes, inputs, limits, show, watch

STEP_FACTORS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
STIFFNESS_FACTORS = tuple(10.0**power for power in range(-3, 7))
AMPLITUDES = (1e-6, 0.2)
DAMPINGS = (0.25, 0.5, 1.0)
_SECONDS, _LEAST_STEPS = 1.0, 20
_LENGTHS = {True: (5, 200), False: (24, 1200)}
"""Steps, and most substeps, of an extreme in a quick and in a full run."""

_NOTES = (
    "Stable: nothing below happened. Degraded: an edge longer than 1.5 or shorter than half of its rest length, kinetic "
    "energy and height beyond the energy of the start by a tenth of weight x size, a cloth that does not fall (less than "
    "5 % of free fall with damping), or any flag of the library; peaks of the whole run count. Stopped: SimulationError. "
    "Refused: ValueError before the first step. Silent counts what was found wrong without a flag of "
    "Simulation.flags(); not finite counts runs in which any position, velocity, force or metric was no finite number, or "
    "an error did not keep the last finite state: both must be 0."
)


def cases(quick: bool) -> list[Case]:
    """Inputs, limits, map and extremes, each over every integrator that takes part in it."""
    found = [Case(f"input/{name}", {"kind": "input", "name": name}) for name in (*inputs.MADE, *inputs.GIVEN)]
    grids = ("1, 0, 0", "1, 1, 1") if quick else tuple(limits.GRIDS)
    usual = {"kind": "limit", "integrator": "symplectic_euler", "damping": 0.0}
    for grid in grids:
        for amplitude in AMPLITUDES:
            for modification in ("none", "literal", "relative"):
                key = f"limit/{grid.replace(' ', '')}/{amplitude:g}/{modification}"
                found.append(Case(key, usual | {"grid": grid, "amplitude": amplitude, "modification": modification}))
    for damping in DAMPINGS[-1:] if quick else DAMPINGS:
        small = {"grid": "1, 1, 1", "amplitude": AMPLITUDES[0], "modification": "none", "damping": damping}
        found.append(Case(f"limit/damped/{damping:g}", usual | small))
    steps = STEP_FACTORS[::3] if quick else STEP_FACTORS
    factors = STIFFNESS_FACTORS[::3] if quick else STIFFNESS_FACTORS
    for variant, fields in watch.variants(everything=not quick).items():
        for step in steps:
            for factor in factors:
                settings = {"kind": "map", "variant": variant, "fields": fields, "step": step, "stiffness": factor}
                found.append(Case(f"map/{variant}/dt{step:g}/k{factor:g}", settings))
        # extremes of the integrators; in full also with modifications, and other forces with the usual integrator
        others = set(fields) - {"integrator", *(() if quick else ("velocity_modification",))}
        if others and (quick or fields["integrator"] != fidelities.INTEGRATORS[0]):
            continue
        length, budget = _LENGTHS[quick]
        for name, extreme in extremes.EXTREMES.items():
            for value in extreme.chosen(quick):
                settings = {"kind": "extreme", "variant": variant, "fields": fields, "name": name, "value": value}
                settings |= {"steps": length, "budget": budget}
                found.append(Case(f"extreme/{variant}/{name}/{value:g}", settings))
    return found


def prepare() -> None:
    """Compiles every kernel that a case uses."""
    for fields in watch.variants().values():
        for name in ("gripper speed", "thrown at a ball"):
            extreme = {"kind": "extreme", "fields": fields, "name": name, "steps": 1, "budget": 1}
            run(extreme | {"value": extremes.EXTREMES[name].values[0]})
        run({"kind": "map", "fields": fields, "step": 1.0, "stiffness": 1e-3, "steps": 1})


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One case; see `watch.run`, `limits.run` and `inputs.run` for what it returns."""
    settings = dict(parameters)
    kind = settings.pop("kind")
    if kind == "input":
        return {word: inputs.run(settings["name"], word) for word in inputs.BAD}
    if kind == "limit":
        return limits.run(**settings)
    fields = settings["fields"]
    if kind == "map":
        step, stiffness = settings["step"], settings["stiffness"]
        scene = extremes.map_scene(step, stiffness)
        result = watch.run(
            lambda: cg.Simulation(scene, cg.Fidelity(**{"substeps": 1, **fields})),
            settings.get("steps", max(_LEAST_STEPS, round(_SECONDS / scene.step))),
            falls=True,
        )
        springs = cg.Simulation(scene, cg.Fidelity()).model
        return result | {"dt": scene.step, "limit": springs.safe_time_step()}
    extreme, value = extremes.EXTREMES[settings["name"]], settings["value"]
    act = extreme.act
    return watch.run(
        lambda: cg.Simulation(extreme.build(value), cg.Fidelity(**{"substeps": 0, **fields})),
        settings["steps"],
        None if act is None else lambda simulation: act(simulation, value),
        extreme.worked,
        extreme.falls,
        settings["budget"],
    )


benchmark = Benchmark(
    name="stability",
    title="Stability: time step, stiffness and every other extreme",
    cases=cases,
    run=run,
    tables=show.tables,
    plots=show.plots,
    prepare=prepare,
    notes=_NOTES,
)
