"""`clothgym warmup`: compiles the kernels once, so that later runs start at once."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import typer

from clothgym.benchmarks.report import Table
from clothgym.commands import JsonOption, answer, progress_bar, reserved_stdout

_HELP = """Compiles the kernels by running every feature on tiny inputs; what is compiled already is loaded.

Environment: CLOTHGYM_CACHE_DIR names the folder in which compiled kernels are kept.
"""


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("warmup", help=_HELP)(warmup)


def warmup(as_json: JsonOption = False) -> None:
    with reserved_stdout(as_json):
        document = compile_kernels()
    rows = [(part["name"], part["seconds"], part["kernels"]) for part in document["parts"]]
    rows.append(("all", document["seconds"], document["compiled"]))
    note = f"{document['compiled']} of {document['kernels']} kernels are ready in {document['cache']}"
    if document["not_compiled"]:
        note += f"; not reached: {', '.join(document['not_compiled'])}"
    answer(document, [Table("Kernels", ("part", "seconds", "new kernels"), rows, note)], as_json)


def compile_kernels() -> dict[str, Any]:
    """Runs every part and counts the kernels that it brought: compiled, or loaded from the cache."""
    from clothgym import _jit, kernels

    parts: list[dict[str, Any]] = []
    started = time.perf_counter()
    with progress_bar("compiling kernels", len(PARTS)) as bar:
        for number, (name, part) in enumerate(PARTS.items()):
            bar(number, name)
            before, clock = _jit.compiled_count()[0], time.perf_counter()
            part()
            seconds = time.perf_counter() - clock
            parts.append({"name": name, "seconds": seconds, "kernels": _jit.compiled_count()[0] - before})
    seconds = time.perf_counter() - started
    for module in pkgutil.iter_modules(kernels.__path__):  # kernels that no part has touched count as not reached
        importlib.import_module(f"{kernels.__name__}.{module.name}")
    compiled, known = _jit.compiled_count()
    return {
        "seconds": seconds,
        "compiled": compiled,
        "kernels": known,
        "not_compiled": sorted(f"{k.__module__.split('.')[-1]}.{k.__name__}" for k in _jit.kernels if not k.signatures),
        "cache": str(_jit.cache_folder),
        "parts": parts,
    }


def _geometry() -> None:
    import clothgym as cg
    from clothgym.detection.hierarchy import Hierarchy
    from clothgym.detection.intersections import Intersections
    from clothgym.response import untangling

    vertices, faces = _crossing_sheets()
    hits = cg.intersections(vertices, faces)
    hits.gradient()
    _ = hits.contours, hits.points, hits.pairs
    cg.proximities(vertices, faces, 0.05)
    surface = cg.Surface(faces)
    tree = Hierarchy(surface, vertices)
    tree.refit(vertices, vertices, 0.0)
    Intersections(vertices, surface, tree.edges_against_faces())
    for strategy in untangling.STRATEGIES:
        cg.untangle(vertices, faces, strategy=strategy, passes=2)
    poked = vertices[:25] + np.array([0.013, 0.01, 0.007])
    poked[12, 1] -= 0.03  # through the other sheet, so that the contour cuts off a region
    cg.untangle(np.concatenate([vertices[:25], poked]), faces, strategy="gia", passes=2)


def _crossing_sheets() -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) and (F, 3): a sheet of 4 x 4 cells that another one cuts at a slant."""
    import clothgym as cg

    flat = cg.grid(0.4, 0.4, 4, 4)
    first = np.asarray(flat.vertices)
    other = first + np.array([0.013, 0.007, 0.031])
    other[:, 1] += 0.4 * other[:, 0]
    faces = np.asarray(flat.faces)
    return np.concatenate([first, other]), np.concatenate([faces, faces + len(first)])


def _steps(scene: Any, fidelity: Any, count: int = 2) -> Any:
    import clothgym as cg

    simulation = cg.Simulation(scene, fidelity=fidelity)
    simulation.reset(seed=0)
    for _ in range(count):
        simulation.step()
    simulation.metrics()
    return simulation


def _sheet() -> None:
    import clothgym as cg

    scene = cg.scenes.make("hanging_sheet", resolution=6)
    draft = cg.Fidelity.preset("draft")
    wide = cg.scenes.make("hanging_sheet", resolution=16)  # grids that are wide enough have their springs in runs
    _steps(wide, draft)
    _steps(dataclasses.replace(wide, self_collision=True), draft)
    _steps(wide, dataclasses.replace(draft, precision="float32"))
    vertices, faces = _crossing_sheets()
    _steps(cg.Scene([cg.Cloth((vertices, faces))], self_collision=False), draft)
    euler = dataclasses.replace(cg.Fidelity.preset("draft"), integrator="symplectic_euler", substeps=0)
    _steps(scene, euler)


def _other_integrators() -> None:
    import trimesh

    import clothgym as cg
    from clothgym.kernels import implicit, quasi_newton

    scene = cg.scenes.make("hanging_sheet", resolution=6)
    vertices, faces = _crossing_sheets()
    ball = cg.Body(trimesh.creation.icosphere(subdivisions=1, radius=0.15))
    resting = cg.Scene([cg.Cloth((vertices + np.array([0.0, 0.151, 0.0]), faces))], bodies=[ball], self_collision=False)
    base = cg.Fidelity.preset("draft")
    _steps(scene, dataclasses.replace(base, integrator="runge_kutta", substeps=0))
    for order in (1, 2):
        fidelity = dataclasses.replace(base, integrator="implicit_euler", substeps=1, time_order=order)
        solver = _steps(scene, fidelity).pipeline.stages[0].step.integrator
    implicit.solve_linear(solver.matrix, solver.weights, solver.search, 0.1, 1)
    solver = (
        _steps(scene, dataclasses.replace(base, integrator="global", substeps=1)).pipeline.stages[0].step.integrator
    )
    quasi_newton.solve_factored(solver.factor, scene.start, scene.start.copy(), solver.memory.sorted)
    for integrator in ("runge_kutta", "implicit_euler"):
        _steps(resting, dataclasses.replace(base, integrator=integrator, substeps=0), 1)
    held = cg.Simulation(dataclasses.replace(scene, grips=[cg.Grip(radius=0.5)]), fidelity)
    held.place_grip(0, scene.start[0])
    held.grasp(0)
    held.step()


def _energies() -> None:
    import clothgym as cg
    from clothgym.kernels import bending, elastic, membrane

    scene = cg.scenes.make("hanging_sheet", resolution=6)
    for kind in ("hinge", "quadratic"):
        fidelity = dataclasses.replace(cg.Fidelity.preset("draft"), membrane="continuum", bending=kind)
        simulation = _steps(scene, fidelity, 1)  # compiled for what is there: springs alone are another type
        x, arrays = scene.start, simulation.model.arrays
        elastic.elastic_forces(x, arrays, np.zeros_like(x))
        elastic.spring_hessian(x, arrays, np.zeros((len(arrays.spring_ends), 2, 2, 3, 3)))
        membrane.membrane_hessian(x, arrays, np.zeros((len(arrays.membrane.faces), 3, 3, 3, 3)))
        bending.hinge_hessian(x, arrays, np.zeros((len(arrays.hinges.stencils), 12, 12, 3, 3)))
        bending.hinge_rows(x, arrays, np.zeros((len(arrays.hinges.stencils), 3, 12, 3)))
        bending.quadratic_hessian(arrays, np.zeros((len(arrays.quadratic.stencils), 12, 12, 3, 3)))


def _contact() -> None:
    import clothgym as cg

    scene = cg.scenes.make("squares", count=2)
    draft = cg.Fidelity.preset("draft")
    mezger = {"detection": "mezger", "lazy": 1e-4, "rebuild_growth": 1e-3}
    for settings in (
        {}, {"rebuild_growth": 1e-3}, {"detection": "brute_force"}, {"continuous": True}, mezger,
        {**mezger, "coherence": 1e-3},
    ):  # fmt: skip
        _steps(scene, dataclasses.replace(draft, **settings))
    vertices, faces = _crossing_sheets()
    crossing = cg.Scene(cloths=[cg.Cloth((vertices, faces))], ground=float(vertices[:, 1].min()) - 0.01)
    for near_hits in ("keep", "off_any", "off_both", "limited"):
        _steps(crossing, dataclasses.replace(cg.Fidelity.preset("draft"), contacts_near_hits=near_hits))
    euler = dataclasses.replace(cg.Fidelity.preset("draft"), integrator="symplectic_euler", substeps=0)
    _steps(crossing, euler, 1)
    _strays(scene)
    flat = cg.grid(0.4, 0.4, 4, 4)
    walls = [flat.vertices + np.array([0.0, 0.001 * n, 0.0]) for n in range(3)]
    pins = [range(len(flat.vertices)), (), range(len(flat.vertices))]
    layers = [
        cg.Cloth((x, flat.faces), pins=held, name=f"{n}") for n, (x, held) in enumerate(zip(walls, pins, strict=True))
    ]
    _steps(cg.Scene(layers), "accurate")  # clamped, and tested continuously
    sheet = dataclasses.replace(cg.scenes.make("hanging_sheet", resolution=6), self_collision=True)
    for fidelity in ("draft", euler):
        _steps(sheet, fidelity, 1)


def _strays(scene: Any) -> None:
    """A vertex that strays from its way, which so small a mesh does not look for by itself."""
    import clothgym as cg
    from clothgym.response.strays import Strays

    simulation = cg.Simulation(scene, "draft")
    candidates = simulation.pipeline.stages[-1].candidates  # type: ignore[attr-defined]
    candidates.strays = Strays(simulation.model.surface, 1)
    x = scene.start.copy()
    candidates.expect(x, np.zeros_like(x))
    candidates.gather()
    x[0, 0] += 1.01 * candidates.slack[0]
    candidates.widen(x, 1.0)


def _wind_and_grips() -> None:
    import clothgym as cg

    vertices, faces = _crossing_sheets()
    scene = cg.Scene(cloths=[cg.Cloth((vertices, faces))], wind=(1.0, 0.0, 0.5), grips=[cg.Grip(radius=0.2)])
    simulation = cg.Simulation(scene, fidelity="draft")
    simulation.reset(seed=0)
    simulation.place_grip(0, vertices[0])
    simulation.grasp(0)
    simulation.step()


def _sides() -> None:
    from clothgym.detection.sides import signed_sides

    vertices, faces = _crossing_sheets()
    signed_sides(vertices[::3] + 0.01, vertices, faces)


def _body() -> None:
    import trimesh

    import clothgym as cg
    from clothgym.detection.body_boxes import BodyBoxes

    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.15)
    vertices, faces = _crossing_sheets()
    lifted = vertices + np.array([0.0, 0.151, 0.0])
    body = cg.Body(ball)
    for self_collision in (True, False):
        scene = cg.Scene([cg.Cloth((lifted, faces))], bodies=[body], self_collision=self_collision)
        for integrator in ("xpbd", "symplectic_euler"):
            fidelity = dataclasses.replace(cg.Fidelity.preset("draft"), integrator=integrator, substeps=0)
            simulation = _steps(scene, fidelity, 1)
        for collider in ("boxes", "dop"):
            _steps(scene, dataclasses.replace(cg.Fidelity.preset("draft"), body_collider=collider), 1)
        _steps(scene, dataclasses.replace(cg.Fidelity.preset("draft"), body_texels=True), 1)
    simulation.body_mesh.penetration(lifted, faces)
    simulation.pipeline.stages[0].body.maps.query(lifted, 0.01)
    BodyBoxes(ball.vertices, ball.faces).query(lifted, 0.01)


def _dressing() -> None:
    import clothgym as cg
    from clothgym.rig import Limb

    post = np.array([[x, y, z] for x in (-0.04, 0.04) for y in (-0.3, 0.3) for z in (-0.04, 0.04)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([[s[0], *s[n : n + 2]] for s in sides for n in (1, 2)])
    limb = Limb("head", np.array([[0.0, -0.3, 0.0], [0.0, 1.3, 0.0]]), 0)
    cg.drape("cuff", cg.Body((post, faces), limbs=(limb,)), fit=False, edge_length=0.06, fidelity="draft", seconds=0.02)


def _hierarchies() -> None:
    from clothgym.detection.dop_scene import DopScene

    vertices, faces = _crossing_sheets()
    chosen: tuple[dict[str, Any], ...] = ({"cones": "exact"}, {"lazy": 0.01}, {"coherence": True})
    for settings in chosen:
        scene = DopScene(**settings)
        number = scene.add(vertices, faces)
        for _ in range(2):
            scene.update(number, vertices, vertices, 0.01)
            scene.misses(scene.collide(0.05), 0.05)


def _pictures() -> None:
    from clothgym.recording import frames

    vertices, faces = _crossing_sheets()
    camera = frames.Camera.framing(vertices)
    lines = [frames.Lines(vertices[:2].reshape(1, 2, 3))]
    drawable = frames.Drawable(vertices, faces)
    frames.render([drawable], camera, 32, 32, lines, ground=float(vertices[:, 1].min()), antialias=2)
    frames.render_depth([drawable], camera, 32, 32, ground=float(vertices[:, 1].min()))


PARTS: dict[str, Callable[[], None]] = {
    "geometry": _geometry,
    "sheet": _sheet,
    "other integrators": _other_integrators,
    "energies": _energies,
    "contact": _contact,
    "wind and grippers": _wind_and_grips,
    "sides": _sides,
    "body": _body,
    "dressing": _dressing,
    "hierarchies": _hierarchies,
    "pictures": _pictures,
}
"""Every feature on a tiny input, in this order."""
