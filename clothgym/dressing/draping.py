"""Dressing a body: placement, sewing, the worn test with retries, and gravity until the garment hangs at rest."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from clothgym import body as bodies
from clothgym import fidelity as fidelities
from clothgym import materials
from clothgym.arrays import FloatArray, IntArray, check_number
from clothgym.body import Body
from clothgym.detection.body_maps import BodyMaps
from clothgym.detection.openings import Threading
from clothgym.dressing.placement import fit as fit_placement
from clothgym.dressing.sewing import rest_of, sew
from clothgym.dressing.worn import SLIDE_LIMIT, expected_limbs, slides, threadings, what_is_wrong
from clothgym.fidelity import Fidelity
from clothgym.garment import Garment, assemble
from clothgym.materials import Material
from clothgym.mesh import Mesh
from clothgym.pattern import Pattern
from clothgym.response.body import REACH
from clothgym.scene import Cloth, Scene
from clothgym.simulation import Simulation

SHIFTS = (0.0, 0.03, 0.06, -0.02, 0.09)
"""[m] lifts of the placement that are tried one after the other until the garment is worn."""

SETTLING = 4.0
"""[1/s] least damping while a garment comes to rest: the drape is wanted, not the way to it."""

_WINDOW = 0.1
"""[s] speeds are means over this time: what trembles in place is at rest."""
_LEAST_WINDOWS = 5
REST_MEAN, REST_P99 = 0.002, 0.01
"""[m/s] at rest: the mean and the 99th percentile of the speeds of all vertices are below these."""

Progress = Callable[[str, float, float, str], None]


@dataclass(frozen=True, eq=False)
class Draped:
    """A garment on a body.

    Attributes:
        report: worn, at_rest, hits, contour_length [m], strain_p99 (all edges), seam_strain_p99 (edges at seam vertices),
            penetration_p999 and penetration_max [m] (45 points of each triangle below the true body), shift [m] (of
            the placement), seconds (wall), and more; see the keys.
        notes: what was done to the body and the placement, a line each.
    """

    garment: Garment
    body: Body
    simulation: Simulation
    report: dict[str, Any]
    notes: tuple[str, ...]

    @property
    def positions(self) -> FloatArray:
        """(V, 3) [m]."""
        return np.array(self.simulation.positions)

    @property
    def faces(self) -> IntArray:
        """(F, 3)."""
        return np.array(self.garment.faces)


def drape(
    pattern: Pattern | str | os.PathLike[str],
    body: Body | str | os.PathLike[str] = "female",
    *,
    fit: bool = True,
    fidelity: str | Fidelity = "balanced",
    edge_length: float = 0.02,
    material: str | Material = "cotton",
    seconds: float = 6.0,
    progress: Progress | None = None,
    on_step: Callable[[Simulation], None] | None = None,
) -> Draped:
    """Sews a pattern onto a body and lets it hang until it rests.

    Args:
        pattern: a pattern, the name of one of the package, or a GarmentCode file.
        body: a body, the name of one of the package, or a mesh file.
        fit: move the pattern's placement to the body; its sizes stay.
        fidelity: how well the drape is simulated.
        edge_length: of the garment's triangles [m].
        material: of the cloth.
        seconds: simulated time after which a drape that does not rest ends [s].
        progress: called as (phase, done, total, text) with phase "sew" or "drape".
        on_step: called with the simulation at the start of the drape and after each of its steps.

    Raises:
        ValueError: bad input, in one line.
        SimulationError: the drape diverged.
    """
    started = time.perf_counter()
    check_number(seconds, "seconds", 0.0, 1e4)
    given = pattern if isinstance(pattern, Pattern) else Pattern.load(pattern)
    wearer = body if isinstance(body, Body) else bodies.load(body)
    cloth_material, how = materials.get(material), fidelities.get(fidelity)
    notes = list(wearer.notes)
    if fit:
        given, said = fit_placement(given, wearer)
        notes.extend(said)
    fitting = _Fitting(given, wearer, how, edge_length)
    best: Draped | None = None
    for attempt, shift in enumerate(SHIFTS, 1):
        text = f"attempt {attempt}, shift {1000 * shift:+.0f} mm"
        garment, x = fitting.sew(shift, _told(progress, "sew", text))
        wrong = what_is_wrong(fitting.worn(garment, x))
        if wrong and attempt < len(SHIFTS):
            notes.append(f"{text}: not worn after sewing, {wrong}")
            continue
        tell = _told(progress, "drape", text)
        simulation, speeds = _simulate(garment, x, wearer, cloth_material, how, seconds, tell, on_step)
        worn, moved = fitting.worn(garment, np.array(simulation.positions)), slides(garment, x, simulation.positions)
        report = _report(garment, simulation, speeds, worn, moved)
        report |= {"shift": shift, "attempts": attempt, "seconds": time.perf_counter() - started}
        best = Draped(garment, wearer, simulation, report, ())
        if report["worn"]:
            break
        notes.append(f"{text}: not worn at the end, {what_is_wrong(worn, moved)}")
    assert best is not None, "the last attempt is always draped"
    return dataclasses.replace(best, notes=tuple(notes))


class _Fitting:
    """A pattern around a body: sewn at any lift, and asked whether it is worn."""

    def __init__(self, pattern: Pattern, body: Body, fidelity: Fidelity, edge_length: float) -> None:
        self.pattern, self.body, self.edge_length = pattern, body, edge_length
        self.tolerance = fidelity.body_tolerance
        self.maps = BodyMaps(
            [body], fidelity.map_size, self.tolerance + REACH, fidelity.body_normals, fidelity.body_views
        )
        self.garment = assemble(pattern, edge_length)
        self.expected = expected_limbs(self.garment, body)

    def sew(self, shift: float, tell: Callable[[float, float], None] | None = None) -> tuple[Garment, FloatArray]:
        """The garment lifted by a shift [m], and its positions (V, 3) when its seams are closed."""
        lifted = self.pattern.moved((0.0, shift, 0.0))
        garment = self.garment if shift == 0.0 else assemble(lifted, self.edge_length)
        return garment, sew(garment, self.maps, self.tolerance, tell)

    def worn(self, garment: Garment, x: FloatArray) -> list[Threading]:
        return threadings(garment, x, self.body, self.maps, self.expected)


def hung(
    pattern: Pattern | str | os.PathLike[str],
    body: Body | str | os.PathLike[str] = "female",
    edge_length: float = 0.025,
) -> Scene:
    """The scene of a garment that has just been sewn, fitted to a body, at the default tolerance.

    Raises:
        ValueError: bad input; a garment that is not worn after sewing, with the openings that are wrong.
    """
    given = pattern if isinstance(pattern, Pattern) else Pattern.load(pattern)
    wearer = body if isinstance(body, Body) else bodies.load(body)
    fitting = _Fitting(fit_placement(given, wearer)[0], wearer, Fidelity(), edge_length)
    garment, x = fitting.sew(0.0)
    wrong = what_is_wrong(fitting.worn(garment, x))
    if wrong:
        raise ValueError(f"pattern {given.name!r}: not worn by {wearer.name} after sewing: {wrong}")
    return _scene(garment, x, wearer, materials.get("cotton"), 2.0)


def _told(progress: Progress | None, phase: str, text: str) -> Callable[[float, float], None] | None:
    return None if progress is None else lambda done, total: progress(phase, done, total, text)


def _scene(garment: Garment, x: FloatArray, body: Body, material: Material, seconds: float) -> Scene:
    calm = dataclasses.replace(material, damping=max(material.damping, SETTLING))
    cloth = Cloth(Mesh(x, np.array(garment.faces)), calm, rest=garment.rest_corners, name=garment.name)
    low = float(body.mesh.vertices[:, 1].min())
    return Scene((cloth,), bodies=(body,), ground=low, duration=seconds, name=f"{garment.name} on {body.name}")


def _simulate(
    garment: Garment,
    x: FloatArray,
    body: Body,
    material: Material,
    fidelity: Fidelity,
    seconds: float,
    progress: Callable[[float, float], None] | None,
    on_step: Callable[[Simulation], None] | None,
) -> tuple[Simulation, tuple[float, float]]:
    """Gravity until at rest, or until the time is over; mean and 99th percentile of the last speeds [m/s]."""
    scene = _scene(garment, x, body, material, seconds)
    simulation = Simulation(scene, fidelity)
    if on_step is not None:
        on_step(simulation)
    window, steps = max(1, round(_WINDOW / scene.step)), round(seconds / scene.step)
    past = [np.array(simulation.positions)]
    mean = p99 = 0.0
    for step in range(1, steps + 1):
        simulation.step()
        if on_step is not None:
            on_step(simulation)
        past = [*past[-window:], np.array(simulation.positions)]
        mean, p99 = _speeds(past, scene.step)
        if step >= _LEAST_WINDOWS * window and _rests(mean, p99) and simulation.last_intersections.hit_count == 0:
            break
        if progress is not None:
            progress(step, steps)
    return simulation, (mean, p99)


def _rests(mean: float, p99: float) -> bool:
    return mean < REST_MEAN and p99 < REST_P99


def _speeds(past: list[FloatArray], step: float) -> tuple[float, float]:
    """Mean and 99th percentile [m/s] of the vertices' speeds over the kept positions."""
    if len(past) < 2:
        return 0.0, 0.0
    speeds = np.linalg.norm(past[-1] - past[0], axis=1) / (step * (len(past) - 1))
    return float(speeds.mean()), float(np.percentile(speeds, 99))


def _report(
    garment: Garment,
    simulation: Simulation,
    speeds: tuple[float, float],
    worn: list[Threading],
    moved: list[float],
) -> dict[str, Any]:
    x = np.array(simulation.positions)
    surface, rest = rest_of(garment)
    ends = surface.edges
    strain = np.linalg.norm(x[ends[:, 1]] - x[ends[:, 0]], axis=1) / rest - 1.0
    at_seam = np.isin(ends, garment.seam_vertices).any(axis=1)
    depths = simulation.body_mesh.penetration(x, garment.faces)
    hits = simulation.last_intersections
    mean, p99 = speeds
    return {
        "worn": all(w.right for w in worn) and max(moved) <= SLIDE_LIMIT,
        "at_rest": _rests(mean, p99),
        "hits": int(hits.hit_count),
        "contour_length": float(hits.length),
        "strain_p99": float(np.percentile(np.abs(strain), 99)),
        "strain_max": float(np.abs(strain).max()),
        "seam_strain_p99": float(np.percentile(np.abs(strain[at_seam]), 99)) if at_seam.any() else 0.0,
        "penetration_p999": float(np.percentile(depths, 99.9)),
        "penetration_max": float(depths.max()),
        "mean_speed": mean,
        "p99_speed": p99,
        "simulated_seconds": simulation.time,
        "vertices": len(x),
        "faces": len(garment.faces),
        "openings": [
            {"expected": w.expected, "through": list(w.through), "right": w.right, "slide": slide}
            for w, slide in zip(worn, moved)
        ],
    }
