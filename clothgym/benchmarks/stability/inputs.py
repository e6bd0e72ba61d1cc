"""Every place where a number enters the library, given one that is none."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.mesh import Mesh

BAD = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def simulation() -> cg.Simulation:
    """A small sheet with contact and a gripper that holds a corner, two steps old."""
    mesh = cg.grid(0.4, 0.4, 3, 3)
    scene = cg.Scene((cg.Cloth(mesh, pins=(0,)),), grips=(cg.Grip(),), ground=-1.0)
    sim = cg.Simulation(scene, cg.Fidelity(substeps=2, sweeps=2))
    sim.place_grip(0, sim.positions[15])
    sim.grasp(0, [15])
    sim.step(2)
    return sim


def _with(array: Any, value: float) -> np.ndarray:
    """A copy with one entry changed."""
    out = np.array(array, float)
    out[(out.shape[0] // 2,) + (1,) * (out.ndim - 1)] = value
    return out


def _mesh(value: float) -> tuple[np.ndarray, np.ndarray]:
    mesh = cg.grid(1.0, 1.0, 2, 2)
    return _with(mesh.vertices, value), mesh.faces


def _body(value: float) -> cg.Body:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    return cg.Body((_with(corners, value), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])))


def _ball(field: str) -> Callable[[float], Any]:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    made: Any = cg.Body
    return lambda value: made((corners, faces), **{field: value})


def _restored(field: str) -> Callable[[cg.Simulation, float], None]:
    def restore(sim: cg.Simulation, value: float) -> None:
        state = sim.snapshot()
        now = getattr(state, field)
        setattr(state, field, value if np.ndim(now) == 0 else np.full_like(now, value))
        sim.restore(state)

    return restore


def _square() -> Mesh:
    return cg.grid(1.0, 1.0, 2, 2)


def _fields(prefix: str, kind: Any) -> dict[str, Callable[[float], Any]]:
    """Every field of a dataclass, so that new ones are asked too."""

    def maker(name: str) -> Callable[[float], Any]:
        return lambda value: kind(**{name: value})

    return {f"{prefix}.{field.name}": maker(field.name) for field in dataclasses.fields(kind)}


def _scene(name: str) -> Callable[[float], Any]:
    made: Any = cg.Scene
    return lambda value: made((cg.Cloth(_square()),), **{name: value})


MADE: dict[str, Callable[[float], Any]] = {
    **_fields("fidelity", cg.Fidelity),
    **_fields("material", cg.Material),
    **_fields("grip", cg.Grip),
    **{
        f"scene.{name}": _scene(name)
        for name in ("ground", "wind_drag", "step", "duration", "self_collision", "ignored")
    },
    "scene.gravity": lambda value: cg.Scene((cg.Cloth(_square()),), gravity=(0.0, value, 0.0)),
    "scene.wind": lambda value: cg.Scene((cg.Cloth(_square()),), wind=(0.0, 0.0, value)),
    "cloth.vertices": lambda value: cg.Cloth(_mesh(value)),
    "cloth.rest": lambda value: cg.Cloth(_square(), rest=_mesh(value)[0]),
    "cloth.rest corners": lambda value: cg.Cloth(_square(), rest=_with(_square().vertices[_square().faces], value)),
    "cloth.faces": lambda value: cg.Cloth((_square().vertices, _with(_square().faces, value))),
    "cloth.pins": lambda value: cg.Cloth(_square(), pins=[value]),  # type: ignore[list-item]
    "body.vertices": _body,
    **{f"body.{name}": _ball(name) for name in ("friction", "slide", "rebound")},
    "grid.width": lambda value: cg.grid(value, 1.0, 2, 2),
    "grid.columns": lambda value: cg.grid(1.0, 1.0, value, 2),  # type: ignore[arg-type]
    "intersections": lambda value: cg.intersections(*_mesh(value)),
    "proximities": lambda value: cg.proximities(*_mesh(value), 0.1),
    "proximities.distance": lambda value: cg.proximities(_square().vertices, _square().faces, value),
    "untangle": lambda value: cg.untangle(*_mesh(value)),
    "untangle.passes": lambda value: cg.untangle(_square().vertices, _square().faces, passes=value),  # type: ignore[arg-type]
    "scenes.resolution": lambda value: cg.scenes.make("hanging_sheet", resolution=value),
}
"""What makes something of a value; must refuse."""

GIVEN: dict[str, Callable[[cg.Simulation, float], Any]] = {
    "set_positions": lambda sim, value: sim.set_positions(_with(sim.positions, value)),
    "set_velocities": lambda sim, value: sim.set_velocities(_with(sim.velocities, value)),
    "place_grip": lambda sim, value: sim.place_grip(0, (0.0, value, 0.0)),
    "move_grip": lambda sim, value: sim.move_grip(0, (value, 0.0, 0.0)),
    "grasp": lambda sim, value: sim.grasp(0, [value]),
    "held": lambda sim, value: sim.held(value),  # type: ignore[arg-type]
    "release": lambda sim, value: sim.release(value),  # type: ignore[arg-type]
    "step": lambda sim, value: sim.step(value),  # type: ignore[arg-type]
    "reset": lambda sim, value: sim.reset(value),  # type: ignore[arg-type]
    "set_measured_forces": lambda sim, value: sim.set_measured_forces((np.full((1, 3), value), np.zeros((0, 3)))),
    **{
        f"restore.{field}": _restored(field)
        for field in ("positions", "velocities", "time", "grip_positions", "grip_velocities", "held_offsets")
    },
}
"""What gives a value to a running simulation; must refuse and leave everything as it was."""


def run(name: str, word: str) -> dict[str, Any]:
    """Gives one bad number to one place.

    Returns:
        outcome: "refused", or "taken"; error: the one line; unchanged: whether the state is what it was; named: whether
        the line shows the value.
    """
    value = BAD[word]
    sim = simulation() if name in GIVEN else None
    before = sim.state_hash() if sim is not None else ""
    try:
        if sim is not None:
            GIVEN[name](sim, value)
        else:
            MADE[name](value)
    except ValueError as error:
        line = str(error)
        return {
            "outcome": "refused",
            "error": f"ValueError: {line}",
            "unchanged": sim is None or sim.state_hash() == before,
            "named": "\n" not in line and any(part in line.lower() for part in (word, "integer")),
        }
    return {"outcome": "taken", "error": "", "unchanged": False, "named": False}
