"""Dressing a body: placement, sewing, the worn test with retries, and gravity until the garment hangs at rest."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from clothgym import body as bodies
from clothgym import fidelity as fidelities
from clothgym import materials, promise, wardrobe
from clothgym.arrays import FloatArray, IntArray, check_number
from clothgym.body import Body
from clothgym.detection.intersections import intersections
from clothgym.detection.openings import Threading
from clothgym.dressing.outcome import REST_MEAN, REST_P99, report
from clothgym.dressing.placement import clear
from clothgym.dressing.placement import fit as fit_placement
from clothgym.dressing.sewing import sew
from clothgym.dressing.worn import expected_limbs, slides, threadings, what_is_wrong
from clothgym.fidelity import Fidelity
from clothgym.garment import Garment, assemble
from clothgym.materials import Material
from clothgym.mesh import Mesh
from clothgym.model import ClothModel
from clothgym.pattern import Pattern
from clothgym.response.body import body_maps
from clothgym.scene import Cloth, Scene
from clothgym.simulation import Simulation

SHIFTS = (0.0, 0.03, 0.06, -0.02, 0.09)
"""[m] lifts of the placement that are tried one after the other until the garment is worn."""

SETTLING = 8.0
"""[1/s] least damping while a garment comes to rest: the drape is wanted, not the way to it. About critical for half a
metre of cloth that swings."""

_WINDOW = 0.1
"""[s] speeds are means over this time: what trembles in place is at rest."""

_ROUGH: dict[str, Any] = {
    "integrator": "xpbd",
    "velocity_modification": "none",
    "substeps": 16,
    "sweeps": 1,
    "body_faces": 1,
}
"""A garment first falls into place at this effort, without self-collision; then it comes to rest as the fidelity promises."""
_LIGHTER = 0.5
"""Share of gravity meanwhile: at a rough effort the full weight stretches a waistband, which slides down, and friction keeps
it there."""
_FALLEN = (0.05, 0.02, 0.1)
"""[s], [m/s]: window and speeds as for rest, at which a fall is over; what moves slower comes to rest in the drape."""
_TANGLED = 40
"""Hits after the fall from which on untangling takes longer than falling again with self-collision,"""
_PATIENCE = 0.5
"""and time after which so many hits will not go away, nor any of cloth at rest [s]."""
_FACE_POINT, _QUAD_POINT = 0.008, 0.012
"""[m] sides of triangles and of quads are cut into parts of this length, whose midpoints are tested against the body: at 12 mm
the tips of a bust come 1 to 2 mm through triangles; with 8 mm a dress of quads takes a third longer. But each side of a face"""
_MOST_PARTS = 4
"""has no more parts than these."""

Progress = Callable[[str, float, float, str], None]


@dataclass(frozen=True, eq=False)
class Draped:
    """A garment on a body.

    Attributes:
        report: worn, at_rest, hits, contour_length [m], strain_p99 (all edges), seam_strain_p99 (edges at seam vertices),
            penetration_p999 and penetration_max [m] (45 points of each triangle below the true body),
            contact_gap_median and contact_gap_p99 [m] (how far from the true body the cloth is that the body carries, see
            `outcome.contact_gaps`), shift [m] (of the placement), seconds (wall; measure_seconds of them went into this
            report), and more; see the keys.
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
    mesher: str = "triangles",
    grid: tuple[int, int] | None = None,
    closing: str = "weld",
    self_collision: bool = True,
    material: str | Material = "cotton",
    seconds: float = 6.0,
    progress: Progress | None = None,
    on_step: Callable[[Simulation], None] | None = None,
) -> Draped:
    """Sews a pattern onto a body and lets it hang until it rests.

    The garment first falls into place at a rough effort and without self-collision; that takes most of the simulated time
    and little of the wall time. Then it comes to rest as the fidelity promises, with substeps of one sweep: cloth that
    hardly moves needs fewer than cloth that falls (`promise.substeps_at_rest`); a fidelity that gives its substeps keeps
    them.

    Args:
        pattern: a pattern, the name of one of the package, or a GarmentCode file. What the package drafts is cut to the
            body, unless `fit` is off.
        body: a body, the name of one of the package, or a mesh file.
        fit: scale a pattern of a file by the girths of the body where it would be too tight or far too wide, and move its
            placement to the body.
        fidelity: how well the drape is simulated.
        edge_length: of the garment's triangles, or of the sides of its quads [m].
        mesher, grid: see `garment.assemble`.
        closing: see `sewing.sew`.
        self_collision: whether the cloth feels itself at the end.
        material: of the cloth.
        seconds: simulated time after which a drape that does not rest ends [s].
        progress: called as (phase, done, total, text) with phase "sew", "settle" or "drape".
        on_step: called with the simulation at the start of the drape, when the garment has fallen into place, and after each
            of its steps.

    Raises:
        ValueError: bad input, in one line.
        SimulationError: the drape diverged.
    """
    started = time.perf_counter()
    check_number(seconds, "seconds", 0.0, 1e4)
    wearer = body if isinstance(body, Body) else bodies.load(body)
    given, said = placed(pattern, wearer, fit)
    cloth_material, how = materials.get(material), fidelities.get(fidelity)
    notes = [*wearer.notes, *said]
    fitting = _Fitting(given, wearer, how, edge_length, mesher, grid, closing)
    clock = {"prepare": time.perf_counter() - started, "sew": 0.0, "settle": 0.0, "drape": 0.0, "measure": 0.0}
    best: Draped | None = None
    for attempt, shift in enumerate(SHIFTS, 1):
        text, last = f"attempt {attempt}, shift {1000 * shift:+.0f} mm", attempt == len(SHIFTS)
        now = time.perf_counter()
        garment, sewn, gap = fitting.sew(shift, _told(progress, "sew", text))
        now = _lap(clock, "sew", now)
        wrong, when = what_is_wrong(fitting.worn(garment, sewn)), "after sewing"
        if not wrong or last:
            scene = _scene(garment, sewn, wearer, cloth_material, seconds)
            effort = _effort(scene, how)
            x = _settled(scene, effort, seconds, _told(progress, "settle", text))
            now = _lap(clock, "settle", now)
            wrong, when = what_is_wrong(fitting.worn(garment, x), slides(garment, sewn, x)), "when it hung"
        if wrong and not last:
            notes.append(f"{text}: not worn {when}, {wrong}")
            continue
        scene, tell = dataclasses.replace(scene, self_collision=self_collision), _told(progress, "drape", text)
        # what is not worn is only shown: to fall again would be of no use, and far from where it belongs may take for ever
        again = not wrong and self_collision and intersections(x, garment.faces).hit_count > _TANGLED
        if not again:
            simulation, speeds = _simulate(_begun(scene, x), effort, seconds, tell, on_step)
            again = not wrong and _hits(simulation) > 0
        if again:
            notes.append(f"{text}: cloth passed through itself as it fell; it falls again and feels itself all the way")
            simulation, speeds = _simulate(_begun(scene, sewn), effort, seconds, tell, on_step, patience=math.inf)
        now = _lap(clock, "drape", now)
        worn, moved = fitting.worn(garment, np.array(simulation.positions)), slides(garment, sewn, simulation.positions)
        found = report(garment, simulation, speeds, worn, moved)
        _lap(clock, "measure", now)
        found |= {"shift": shift, "attempts": attempt, "seam_gap": gap, "seconds": time.perf_counter() - started}
        found |= {f"{phase}_seconds": spent for phase, spent in clock.items()}
        best = Draped(garment, wearer, simulation, found, ())
        if found["worn"]:
            break
        notes.append(f"{text}: not worn at the end, {what_is_wrong(worn, moved)}")
    assert best is not None, "the last attempt is always draped"
    return dataclasses.replace(best, notes=tuple(notes))


def placed(pattern: Pattern | str | os.PathLike[str], body: Body, fit: bool = True) -> tuple[Pattern, tuple[str, ...]]:
    """A pattern around a body, and what was done to it, a line each; see `drape`."""
    if isinstance(pattern, str) and pattern in wardrobe.NAMES and fit:
        try:
            return clear(wardrobe.tailored(pattern, body), body)
        except ValueError as error:
            given, said = fit_placement(Pattern.load(pattern), body)
            return given, (f"{error}; the pattern is that for the female body", *said)
    given = pattern if isinstance(pattern, Pattern) else Pattern.load(pattern)
    return fit_placement(given, body) if fit else (given, ())


def _lap(clock: dict[str, float], phase: str, since: float) -> float:
    """Books the time since then; returns now."""
    now = time.perf_counter()
    clock[phase] += now - since
    return now


class _Fitting:
    """A pattern around a body: sewn at any lift, and asked whether it is worn."""

    def __init__(
        self,
        pattern: Pattern,
        body: Body,
        fidelity: Fidelity,
        edge_length: float,
        mesher: str = "triangles",
        grid: tuple[int, int] | None = None,
        closing: str = "weld",
    ) -> None:
        self.body, self.closing = body, closing
        self.tolerance = fidelity.body_tolerance
        self.maps = body_maps((body,), fidelity)
        self.garment = assemble(pattern, edge_length, mesher, grid)
        self.expected = expected_limbs(self.garment, body)

    def sew(
        self, shift: float, tell: Callable[[float, float], None] | None = None
    ) -> tuple[Garment, FloatArray, float]:
        """The garment lifted by a shift [m], its positions (V, 3) when its seams are closed, and the gap that was left."""
        garment = self.garment.moved((0.0, shift, 0.0)) if shift != 0.0 else self.garment
        return garment, *sew(garment, self.maps, self.tolerance, tell, self.closing)

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
    wearer = body if isinstance(body, Body) else bodies.load(body)
    given, _ = placed(pattern, wearer)
    fitting = _Fitting(given, wearer, Fidelity(), edge_length)
    garment, x, _ = fitting.sew(0.0)
    wrong = what_is_wrong(fitting.worn(garment, x))
    if wrong:
        raise ValueError(f"pattern {given.name!r}: not worn by {wearer.name} after sewing: {wrong}")
    return _scene(garment, x, wearer, materials.get("cotton"), 2.0)


def _told(progress: Progress | None, phase: str, text: str) -> Callable[[float, float], None] | None:
    return None if progress is None else lambda done, total: progress(phase, done, total, text)


def _scene(garment: Garment, x: FloatArray, body: Body, material: Material, seconds: float) -> Scene:
    calm = dataclasses.replace(material, damping=max(material.damping, SETTLING))
    mesh = Mesh(x, np.array(garment.faces), garment.quads)
    cloth = Cloth(mesh, calm, rest=garment.rest_corners, name=garment.name)
    low = float(body.mesh.vertices[:, 1].min())
    return Scene((cloth,), bodies=(body,), ground=low, duration=seconds, name=f"{garment.name} on {body.name}")


def _settled(
    scene: Scene,
    effort: Fidelity,
    seconds: float,
    progress: Callable[[float, float], None] | None,
) -> FloatArray:
    """Positions (V, 3) [m] where the garment hangs without self-collision: it falls into place at a rough effort and a
    share of its weight, then hangs with all of it, with the substeps that it will rest with."""
    alone = dataclasses.replace(scene, self_collision=False)
    gx, gy, gz = scene.gravity
    light = dataclasses.replace(alone, gravity=(_LIGHTER * gx, _LIGHTER * gy, _LIGHTER * gz))
    few = min(effort.body_faces, _ROUGH["body_faces"])
    rough, fine = dataclasses.replace(effort, **_ROUGH), dataclasses.replace(effort, body_faces=few)
    x = scene.start
    for stage, how in ((light, rough), (alone, fine)):
        simulation = Simulation(_begun(stage, x), how)
        rest, steps = Rest(simulation, *_FALLEN), round(seconds / scene.step)
        for step in range(1, steps + 1):
            simulation.step()
            if rest.reached():
                break
            if progress is not None:
                progress(step, steps)
        x = np.array(simulation.positions)
    return x


def _begun(scene: Scene, x: FloatArray) -> Scene:
    """The scene with its garment elsewhere (V, 3) [m]."""
    (cloth,) = scene.cloths
    mesh = Mesh(np.array(x), cloth.mesh.faces, cloth.mesh.quads)
    return dataclasses.replace(scene, cloths=(dataclasses.replace(cloth, mesh=mesh),))


def _effort(scene: Scene, fidelity: Fidelity) -> Fidelity:
    """The fidelity with the substeps that its promise asks for at rest, and points of faces as dense as the body needs."""
    if fidelity.substeps > 0 or fidelity.integrator != "xpbd":
        return fidelity
    model = ClothModel(scene, fidelity)
    point = _FACE_POINT if scene.cloths[0].mesh.quads is None else _QUAD_POINT
    parts = min(math.ceil(model.mean_edge / point), _MOST_PARTS) if fidelity.body_faces else 0
    substeps = max(_ROUGH["substeps"], promise.substeps_at_rest(model, fidelity.stretch_error))
    return dataclasses.replace(fidelity, substeps=substeps, sweeps=1, body_faces=parts)


def _simulate(
    scene: Scene,
    fidelity: Fidelity,
    seconds: float,
    progress: Callable[[float, float], None] | None,
    on_step: Callable[[Simulation], None] | None,
    patience: float = _PATIENCE,
) -> tuple[Simulation, tuple[float, float]]:
    """Gravity until at rest, or until the time is over, or until the cloth has been tangled, or at rest with hits, beyond the
    patience [s]; mean and 99th percentile of the last speeds [m/s]."""
    simulation = Simulation(scene, fidelity)
    if on_step is not None:
        on_step(simulation)
    rest, steps = Rest(simulation), round(seconds / scene.step)
    for step in range(1, steps + 1):
        simulation.step()
        if on_step is not None:
            on_step(simulation)
        resting, hits = rest.reached(), _hits(simulation)
        if resting and hits == 0:
            break
        if step * scene.step > patience and (resting or hits > _TANGLED):  # hits in cloth at rest stay
            break
        if progress is not None:
            progress(step, steps)
    return simulation, rest.speeds


def _hits(simulation: Simulation) -> int:
    return int(simulation.last_intersections.hit_count) if simulation.scene.self_collision else 0


class Rest:
    """Watches a simulation: whether it has been at rest for the time over which speeds are taken.

    Mean and 99th percentile of the speeds tell more than the kinetic energy, which a few trembling vertices dominate.

    Args:
        simulation: what is watched, from now on.
        window: time over which speeds are taken [s].
        mean, p99: both speeds are below these at rest [m/s].
    """

    def __init__(
        self, simulation: Simulation, window: float = _WINDOW, mean: float = REST_MEAN, p99: float = REST_P99
    ) -> None:
        self.simulation, self.mean, self.p99 = simulation, mean, p99
        self.window = max(1, round(window / simulation.scene.step))
        self.past = [np.array(simulation.positions)]

    @property
    def speeds(self) -> tuple[float, float]:
        """Mean and 99th percentile [m/s] over what there is of the window."""
        speeds = self._speeds()
        return float(speeds.mean()), float(np.percentile(speeds, 99))

    def reached(self) -> bool:
        """To be asked after every step."""
        self.past = [*self.past[-self.window :], np.array(self.simulation.positions)]
        if len(self.past) <= self.window:
            return False
        speeds = self._speeds()
        # percentiles take longer than a step of a small garment
        return bool(speeds.mean() < self.mean) and bool(np.percentile(speeds, 99) < self.p99)

    def _speeds(self) -> FloatArray:
        """(V,) [m/s]"""
        way = self.past[-1] - self.past[0]
        seconds = self.simulation.scene.step * max(1, len(self.past) - 1)
        return np.asarray(np.linalg.norm(way, axis=1) / seconds)
