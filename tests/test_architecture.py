"""The house and its floors: imports, stages, and that what a scene does not have costs nothing."""

from __future__ import annotations

import ast
import dataclasses
import json
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym.model import ClothModel
from clothgym.response.contact import Candidates, ContactBuffers

PACKAGE = Path(cg.__file__).parent
FLOORS = {
    0: ("_jit", "arrays", "errors"),
    1: ("kernels",),
    2: (
        *("materials", "fidelity", "state", "mesh", "batches", "rest", "rig", "motion", "torso", "body", "assets"),
        "body_sequence",
        *("pattern", "garmentcode", "panel_mesh", "quad_mesh", "garment", "sizes", "wardrobe"),
    ),
    3: ("scene",),
    4: ("model", "elastic", "bending", "promise"),
    5: ("detection",),
    6: ("response", "metrics"),
    7: ("stages", "pipeline"),
    8: ("simulation",),
    9: ("recording", "scenes", "dressing", "benchmarks"),
    10: ("cli", "commands", "__main__"),
}
FLOOR_OF = {name: floor for floor, names in FLOORS.items() for name in names}


@cache
def sources() -> dict[str, ast.Module]:
    """Dotted module name -> parsed source of everything in clothgym."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = list(path.relative_to(PACKAGE.parent).with_suffix("").parts)
        if parts[-1] == "__init__":
            parts.pop()
        found[".".join(parts)] = ast.parse(path.read_text(), str(path))
    return found


def imports(name: str, top_level_only: bool = False) -> set[str]:
    """Dotted names that a module imports, submodules resolved; without those for type checking only."""
    modules, found = sources(), set()

    def walk(node: ast.AST) -> None:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            return
        if top_level_only and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            return
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative import"
            for alias in node.names:
                longer = f"{node.module}.{alias.name}"
                found.add(longer if longer in modules else str(node.module))
        for child in ast.iter_child_nodes(node):
            walk(child)

    walk(modules[name])
    return found


def unit(module: str) -> str:
    """The name that FLOORS knows: the first part below clothgym."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


def test_every_module_has_a_floor():
    unknown = {unit(m) for m in sources() if unit(m)} - set(FLOOR_OF)
    assert not unknown, f"no floor for {sorted(unknown)}: add to FLOORS and to the architecture"


@pytest.mark.parametrize("module", [m for m in sources() if m != "clothgym"])
def test_modules_import_from_floors_below(module):
    """The same floor is allowed too (kernels call kernels); cycles are looked for below."""
    own = FLOOR_OF[unit(module)]
    for target in imports(module):
        if target == "clothgym":
            assert own >= 9, f"{module} imports the whole package"
        elif target.startswith("clothgym."):
            assert FLOOR_OF[unit(target)] <= own, (
                f"{module} (floor {own}) imports {target} (floor {FLOOR_OF[unit(target)]})"
            )


def test_no_import_cycles():
    graph = {m: {t for t in imports(m, top_level_only=True) if t in sources() and t != m} for m in sources()}
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " -> ".join((*path, module))
        if module in done:
            return
        for target in graph[module]:
            if target != "clothgym":
                visit(target, (*path, module))
        done.add(module)

    for module in graph:
        visit(module, ())


def outside(module: str) -> set[str]:
    return {target.split(".")[0] for target in imports(module)} - {"clothgym", "__future__"}


def test_only_the_door_imports_numba():
    assert {m for m in sources() if {"numba", "llvmlite"} & outside(m)} == {"clothgym._jit"}


def test_kernels_need_numpy_and_the_standard_library_only():
    for module in sources():
        if unit(module) == "kernels":
            assert outside(module) <= {"numpy", "math", "typing", "itertools"}, module
            classes = [n for n in ast.walk(sources()[module]) if isinstance(n, ast.ClassDef)]
            assert all("NamedTuple" in ast.dump(c.bases[0]) for c in classes), f"{module}: kernels have no classes"


def test_kernels_keep_to_scalar_code():
    banned = {"cross", "linalg", "einsum", "dot", "prange", "matmul"}
    for module in sources():
        if unit(module) != "kernels":
            continue
        for node in ast.walk(sources()[module]):
            if isinstance(node, ast.FunctionDef) and node.decorator_list:
                for inner in ast.walk(node):
                    if (
                        isinstance(inner, ast.Attribute)
                        and isinstance(inner.value, ast.Name)
                        and inner.value.id == "np"
                    ):
                        assert inner.attr not in banned, f"{module}.{node.name} uses np.{inner.attr}"


def test_nothing_here_knows_learning_or_viewers():
    for module in sources():
        assert not outside(module) & {
            "gymnasium",
            "stable_baselines3",
            "torch",
            "clothgym_envs",
            "clothgym_baselines",
        }, module
        if unit(module) != "recording":
            assert "rerun" not in outside(module), module


# ---------------------------------------------------------------------------------------------------------------
# stages


def stages(scene, **fidelity) -> list[str]:
    sim = cg.Simulation(scene, cg.Fidelity(**({"substeps": 8, "sweeps": 4} | fidelity)))
    return [stage.name for stage in sim.pipeline.stages]


SHEET = cg.scenes.make("hanging_sheet", resolution=4)
PILE = cg.scenes.make("pile", count=2)


def test_stage_lists():
    assert stages(SHEET) == ["integrate [xpbd 8x4]"]
    assert stages(SHEET, untangling="none", detection="brute_force") == ["integrate [xpbd 8x4]"]
    assert stages(SHEET, integrator="symplectic_euler", substeps=300) == ["integrate [symplectic_euler 300x1]"]
    assert stages(
        SHEET, integrator="symplectic_euler", substeps=300, velocity_modification="literal", stretch_limit=0.15
    ) == ["integrate [symplectic_euler 300x1, velocity modification literal above 0.15]"]
    windy = dataclasses.replace(SHEET, wind=(1.0, 0.0, 0.0))
    assert stages(windy) == ["wind", "integrate [xpbd 8x4]"]
    assert stages(dataclasses.replace(windy, wind_drag=0.0)) == ["integrate [xpbd 8x4]"]
    plain = {"untangling": "none", "contacts_near_hits": "keep"}
    assert stages(PILE, **plain) == ["face pairs", "primitive pairs", "contact substeps [xpbd 8x4]"]
    assert stages(PILE, untangling="none") == [
        "face pairs", "intersections [untangle none x0, contact off_any]", "primitive pairs", "contact substeps [xpbd 8x4]",
    ]  # fmt: skip
    assert stages(PILE, untangling="global", untangling_passes=2, contacts_near_hits="keep", substeps=3, sweeps=2) == [
        "face pairs", "intersections [untangle global x2, contact keep]", "primitive pairs", "contact substeps [xpbd 3x2]",
    ]  # fmt: skip
    limit = ClothModel(PILE).safe_time_step()
    chosen = int(np.ceil(PILE.step / (0.9 * limit)))
    explicit = stages(PILE, integrator="symplectic_euler", substeps=0, **plain)
    assert explicit[:2] == ["face pairs", "primitive pairs"]
    assert explicit[2].startswith(f"contact substeps [symplectic_euler {chosen}x") and len(explicit) == 3


def test_stage_lists_with_a_body():
    sphere = trimesh.creation.icosphere(subdivisions=1, radius=0.3)
    near, label = cg.Body(sphere), "body 64 px along zy, coulomb, 4 points a face"
    coarse = {"map_size": 64, "body_faces": 2}
    assert stages(dataclasses.replace(SHEET, bodies=[near]), **coarse) == [f"integrate [xpbd 8x4, {label}]"]
    names = stages(dataclasses.replace(PILE, bodies=[near]), untangling="none", contacts_near_hits="keep", **coarse)
    assert names == ["face pairs", "primitive pairs", f"contact substeps [xpbd 8x4, {label}]"]
    paper = stages(dataclasses.replace(SHEET, bodies=[near]), map_size=64, body_faces=0, body_response="velocity")
    assert paper == ["integrate [xpbd 8x4, body 64 px along zy, velocity]"]


def test_the_label_tells_the_sweeps_that_contact_makes():
    """With contact, sweeps act with symplectic Euler too: a label of x1 beside sweeps = 4 would be wrong."""
    name = stages(PILE, integrator="symplectic_euler", substeps=0, sweeps=5, untangling="none")[-1]
    assert name.endswith("x5]"), name


@pytest.mark.parametrize("near", ["keep", "off_any"])
@pytest.mark.parametrize("untangling", ["none", "hybrid"])
@pytest.mark.parametrize(
    "scene",
    [
        SHEET,
        PILE,
        dataclasses.replace(PILE, wind=(1.0, 0, 0)),
        dataclasses.replace(PILE, bodies=[cg.Body(trimesh.creation.icosphere(subdivisions=1, radius=0.3))]),
    ],
    ids=["sheet", "pile", "windy", "body"],
)
def test_every_array_read_was_written_before(scene, untangling, near):
    known = {"positions", "velocities"}
    fidelity = cg.Fidelity(untangling=untangling, contacts_near_hits=near)
    for stage in cg.Simulation(scene, fidelity).pipeline.stages:
        assert set(stage.reads) <= known, f"{stage.name} reads {set(stage.reads) - known}"
        known |= set(stage.writes)
        assert stage.writes


def test_describe_names_every_stage_and_the_step():
    sim = cg.Simulation(PILE, cg.Fidelity(substeps=8))
    text = sim.pipeline.describe()
    for stage in sim.pipeline.stages:
        assert stage.name in text
    assert "0.01 s in 8 substeps of 0.00125 s" in text
    assert len(text.splitlines()) == 1 + len(sim.pipeline.stages)


def reachable(*roots) -> list:
    """Every object that hangs on the roots through attributes, tuples, lists and dictionaries."""
    seen: dict[int, object] = {}
    todo = list(roots)
    while todo:
        item = todo.pop()
        if id(item) in seen or isinstance(item, str | bytes | type | int | float):
            continue
        seen[id(item)] = item
        if isinstance(item, dict):
            todo.extend(item.values())
        elif isinstance(item, tuple | list | set):
            todo.extend(item)
        elif type(item).__module__.startswith("clothgym"):
            todo.extend(vars(item).values())
    return list(seen.values())


def test_a_scene_without_collision_allocates_nothing_for_it():
    for fidelity in (cg.Fidelity(), cg.Fidelity(integrator="symplectic_euler", substeps=0)):
        sim = cg.Simulation(SHEET, fidelity)
        sim.step(2)
        objects = reachable(sim)
        assert not [
            o for o in objects if isinstance(o, Candidates | ContactBuffers) or "detection" in type(o).__module__
        ]
        ways = [a for a in objects if isinstance(a, np.ndarray) and a.shape == (sim.model.vertex_count, 3)]
        # rest, start (mesh and rest of the cloth), positions, velocities, predicted; forces with symplectic Euler only
        assert len(ways) <= 7 + (fidelity.integrator == "symplectic_euler")
    step = cg.Simulation(SHEET, cg.Fidelity()).pipeline.stages[0].step
    assert not hasattr(step.integrator, "forces") and step.integrator.multipliers.size > 0
    assert any(isinstance(o, Candidates) for o in reachable(cg.Simulation(PILE, cg.Fidelity()))), (
        "the walk finds nothing"
    )


# ---------------------------------------------------------------------------------------------------------------
# what is imported and compiled, in a process of its own


def in_child(code: str) -> dict:
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent, timeout=120, check=False
    )
    assert run.returncode == 0, run.stderr[-2000:]
    return json.loads(run.stdout.splitlines()[-1])


def test_what_a_hanging_sheet_imports():
    """The packages' own __init__ files, which show the whole public face, are put aside: what the simulation needs counts."""
    code = f"""
import json, sys, types
for name in ("clothgym", "clothgym.scenes"):
    package = types.ModuleType(name)
    package.__path__ = [{str(PACKAGE)!r} + name.removeprefix("clothgym").replace(".", "/")]
    sys.modules[name] = package
from clothgym.scenes.sheets import hanging_sheet
from clothgym.simulation import Simulation
from clothgym.fidelity import Fidelity
sim = Simulation(hanging_sheet(4), Fidelity())
sim.step()
before = sorted(sys.modules)
sim.metrics()
print(json.dumps([before, sorted(sys.modules)]))
"""
    before, after = (set(modules) for modules in in_child(code))
    assert "clothgym.kernels.integrate" in before
    for module in ("clothgym.detection.hierarchy", "clothgym.detection.intersections", "clothgym.response.contact",
                   "clothgym.kernels.contact", "clothgym.kernels.bvh", "clothgym.kernels.wind", "clothgym.kernels.raster",
                   "clothgym.detection.body_maps", "clothgym.detection.body_mesh", "clothgym.response.body",
                   "clothgym.kernels.body_map", "clothgym.kernels.body_contact",
                   "clothgym.response.untangling", "clothgym.recording", "rerun", "matplotlib", "gymnasium", "trimesh",
                   "torch", "scipy.spatial", "rich", "typer"):  # fmt: skip
        assert module not in before, module
    assert "clothgym.detection.intersections" in after


def test_what_a_hanging_sheet_compiles():
    code = """
import json, sys
import clothgym as cg
from clothgym import _jit
def compiled():
    return sorted(k.py_func.__name__ for k in _jit.kernels if k.signatures)
imported = [compiled(), sorted(sys.modules)]
cg.Simulation(cg.scenes.make("hanging_sheet", resolution=16)).step()
one = compiled()
cg.Simulation(cg.scenes.make("pile", count=2), cg.Fidelity(untangling="none", contacts_near_hits="keep")).step()
print(json.dumps([*imported, one, compiled()]))
"""
    at_import, modules, sheet, pile = in_child(code)
    assert at_import == []
    assert sheet == ["colour_springs", "largest_speed", "xpbd_substeps_in_runs"]
    assert {"decide", "gather_quads", "begin"} <= set(pile)
    assert not {"find_hits", "distribute", "cut_regions", "wind_acceleration", "euler_predict"} & set(pile)
    for module in ("rerun", "matplotlib", "gymnasium", "torch", "stable_baselines3", "rich", "typer", "ray"):
        assert module not in modules, f"import clothgym imports {module}"
