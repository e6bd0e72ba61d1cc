"""`clothgym bench features`: what each scene is assembled from, and what each feature costs when it is switched on alone."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh

import clothgym as cg
from clothgym.benchmarks.frame import Benchmark, Case, Row
from clothgym.benchmarks.report import Table
from clothgym.scene import Scene

CELLS = 32
FRAMES = 30
"""Of a hanging sheet, and of a sheet that falls on a ball: enough to hang, or to lie on it."""
_ROUNDS = 3
_EFFORT: dict[str, Any] = {"substeps": 16, "sweeps": 4}
"""The same for every feature, so that only the feature differs; what presets take is in the table of scenes."""
_PLAIN: dict[str, Any] = {"untangling": "none", "contacts_near_hits": "keep", **_EFFORT}
_SLOW = ("tape", "draped", "sheets_on_objects", "table_cloth")
"""Scenes that a quick run leaves out."""
_NOTES = (
    "Scenes: the stages that each ready scene is assembled from at balanced, and what a frame costs. What it does not have "
    "adds no stage. Features: a hanging sheet of 32 x 32 cells and a sheet that falls on a ball, with 16 substeps of 4 sweeps, "
    "each feature switched on alone: processor time over that of the same scene without it, run in turns, the least of three. "
    "Features of contact are switched on beside self-collision, and compared with it."
)

Change = tuple[Callable[[Scene], Scene], dict[str, Any]]


def _same(scene: Scene) -> Scene:
    return scene


def _with(**fields: Any) -> Callable[[Scene], Scene]:
    return lambda scene: dataclasses.replace(scene, **fields)


def _material(**fields: Any) -> Callable[[Scene], Scene]:
    def changed(scene: Scene) -> Scene:
        cloth = scene.cloths[0]
        material = dataclasses.replace(cg.materials.get(cloth.material), **fields)
        return dataclasses.replace(scene, cloths=(dataclasses.replace(cloth, material=material),))

    return changed


def _far_ball(scene: Scene) -> Scene:
    """A body that the cloth does not reach: what looking for it costs."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.2)
    ball.apply_translation((3.0, -3.0, 0.0))
    return dataclasses.replace(scene, bodies=[cg.Body(ball)])


def _on_ball(friction: float | None = None) -> Callable[[Scene], Scene]:
    def placed(scene: Scene) -> Scene:
        start = scene.start
        ball = trimesh.creation.icosphere(subdivisions=4, radius=0.25)
        ball.apply_translation((start[:, 0].mean(), start[:, 1].min() - 0.27, start[:, 2].mean()))
        body = cg.Body(ball) if friction is None else cg.Body(ball, friction=friction)
        return dataclasses.replace(scene, bodies=[body])

    return placed


CONTACT = _with(self_collision=True)
_EULER: dict[str, Any] = {"integrator": "symplectic_euler"}
FEATURES: dict[str, tuple[str, Change]] = {
    "grippers": ("", (_with(grips=(cg.Grip(radius=0.1),)), {})),
    "ground": ("", (_with(ground=-5.0), {})),
    "wind": ("", (_with(wind=(2.0, 0.0, 1.0)), {})),
    "flexion springs": ("", (_material(flexion=1e-2), {})),
    "continuum membrane": ("", (_same, {"membrane": "continuum"})),
    "quadratic bending": ("", (_same, {"bending": "quadratic"})),
    "hinge bending": ("", (_same, {"bending": "hinge"})),
    "float32": ("", (_same, {"precision": "float32"})),
    "body out of reach": ("", (_far_ball, {})),
    "self-collision, flat check": ("", (CONTACT, {})),
    "self-collision": ("", (CONTACT, {"flat_check": False})),
    "looking for intersections": ("self-collision", (CONTACT, {"flat_check": False, "contacts_near_hits": "off_any"})),
    "untangling": ("self-collision", (CONTACT, {"flat_check": False, "untangling": "hybrid"})),
    "continuous tests": ("self-collision", (CONTACT, {"flat_check": False, "continuous": True})),
    "symplectic_euler": ("", (_same, _EULER)),
    "velocity modification": ("symplectic_euler", (_same, {**_EULER, "velocity_modification": "relative"})),
    "position modification": ("symplectic_euler", (_same, {**_EULER, "position_modification": 1})),
}
"""Of the hanging sheet: name -> (feature that is on beside it, change of scene and fidelity)."""
ON_BODY: dict[str, tuple[str, Change]] = {
    "body": ("", (_on_ball(), {"body_faces": 0})),
    "no friction": ("body", (_on_ball(friction=0.0), {"body_faces": 0})),
    "faces against the body, 1 point": ("body", (_on_ball(), {"body_faces": 1})),
    "faces against the body, 9 points": ("body", (_on_ball(), {"body_faces": 3})),
    "maps of 720": ("body", (_on_ball(), {"body_faces": 0, "map_size": 720})),
    "interpolated normals": ("body", (_on_ball(), {"body_faces": 0, "body_normals": "interpolated"})),
    "response of the paper": ("body", (_on_ball(), {"body_faces": 0, "body_response": "velocity"})),
    "self-collision": ("body", (lambda scene: CONTACT(_on_ball()(scene)), {"body_faces": 0})),
}
"""Of a sheet that falls: against the same sheet in the air, or against the one that falls on the ball."""
BASES = {"hanging": FEATURES, "body": ON_BODY}


def _base(name: str) -> Scene:
    scene = cg.scenes.make("hanging_sheet", resolution=CELLS)
    if name == "hanging":
        return scene
    cloth = dataclasses.replace(scene.cloths[0], pins=())
    return dataclasses.replace(scene, cloths=(cloth,))


def cases(quick: bool) -> list[Case]:
    """Every ready scene, then every feature."""
    found = []
    for name in cg.scenes.names():
        if not (quick and name in _SLOW):
            found.append(Case(f"scene/{name}", {"kind": "scene", "name": name}))
    for base, features in BASES.items():
        found += [Case(f"feature/{base}/{name}", {"kind": "feature", "base": base, "name": name}) for name in features]
    return found


def prepare() -> None:
    """Compiles every kernel that a case uses."""
    for case in cases(False):
        p = case.parameters
        if p["kind"] == "scene":
            cg.Simulation(cg.scenes.make(p["name"])).step()
        else:
            cg.Simulation(*setting(p["base"], p["name"])).step()


def setting(base: str, name: str) -> tuple[Scene, cg.Fidelity]:
    """The base scene with a feature, and how it is modelled; without any where the name is empty."""
    scene, fields = _base(base), dict(_PLAIN)
    if name:
        change, more = BASES[base][name][1]
        scene, fields = change(scene), fields | more
    if fields.get("integrator") == "symplectic_euler":
        fields["substeps"] = 0
    return scene, cg.Fidelity(**fields)


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One scene, or one feature; see `_scene` and `_feature`."""
    if parameters["kind"] == "scene":
        return _scene(parameters["name"])
    return _feature(parameters["base"], parameters["name"])


def _scene(name: str) -> dict[str, Any]:
    """Stages at balanced and milliseconds of a frame, the median of the first ones."""
    sim = cg.Simulation(cg.scenes.make(name))
    times = _frames(sim, 12)
    return {
        "vertices": sim.model.vertex_count,
        "faces": len(sim.faces),
        "stages": [stage.name for stage in sim.pipeline.stages],
        "substeps": sim.pipeline.substeps,
        "ms": statistics.median(times[2:]),
    }


def _frames(sim: cg.Simulation, count: int) -> list[float]:
    times = []
    for _ in range(count):
        began = time.process_time()
        sim.step()
        times.append(1e3 * (time.process_time() - began))
    return times


def _feature(base: str, name: str) -> dict[str, Any]:
    """Milliseconds of a frame with and without, in turns, the least of some rounds; stages that came with it."""
    beside = BASES[base][name][0]
    sims = [cg.Simulation(*setting(base, which)) for which in (beside, name)]
    least = [np.inf, np.inf]
    for _ in range(_ROUNDS):
        for number, sim in enumerate(sims):
            sim.reset()
            least[number] = min(least[number], statistics.fmean(_frames(sim, FRAMES)[2:]))
    stages = [[stage.name for stage in sim.pipeline.stages] for sim in sims]
    return {
        "beside": beside,
        "without_ms": float(least[0]),
        "with_ms": float(least[1]),
        "times": float(least[1] / least[0]),
        "new_stages": [stage for stage in stages[1] if stage not in stages[0]],
        "substeps": [sim.pipeline.substeps for sim in sims],
    }


def tables(rows: list[Row]) -> list[Table]:
    """Stages of every scene; cost of every feature."""
    scenes = [row for row in rows if row["parameters"]["kind"] == "scene"]
    features = [row for row in rows if row["parameters"]["kind"] == "feature"]
    found = []
    if scenes:
        cells = [
            (
                row["parameters"]["name"], row["result"]["vertices"], row["result"]["faces"], row["result"]["substeps"],
                row["result"]["ms"], " → ".join(row["result"]["stages"]),
            )
            for row in scenes
        ]  # fmt: skip
        columns = ("scene", "vertices", "triangles", "substeps", "ms a frame", "stages")
        found.append(Table("Scenes and what they are assembled from, at balanced", columns, cells))
    if features:
        found.append(_feature_table(features))
    return found


def _feature_table(rows: list[Row]) -> Table:
    cells = []
    for row in rows:
        p, r = row["parameters"], row["result"]
        cells.append(
            (
                p["base"], p["name"], r["beside"] or "nothing", r["without_ms"], r["with_ms"], r["with_ms"] - r["without_ms"],
                r["times"], ", ".join(r["new_stages"]) or "none",
            )
        )  # fmt: skip
    columns = ("scene", "feature", "beside", "without [ms]", "with [ms]", "costs [ms a frame]", "times", "new stages")
    note = (
        f"{CELLS} x {CELLS} cells; {_EFFORT['substeps']} substeps of {_EFFORT['sweeps']} sweeps; explicit: as needed."
    )
    return Table("Cost of each feature", columns, cells, note)


benchmark = Benchmark(
    name="features",
    title="Model only what a scene requires: stages of scenes, cost of features",
    cases=cases,
    run=run,
    tables=tables,
    prepare=prepare,
    notes=_NOTES,
)
