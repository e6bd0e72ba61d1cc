"""How much work a promise about stretch takes: substeps and sweeps of XPBD from the loads that a scene can put on cloth.

A spring under tension T, projected once a substep, comes to rest where its correction makes up for what the substep adds:
C = T (1 / k + dt^2 (w_i + w_j)) before it, T / k after it, and its neighbours' corrections lengthen it again. What it is too
long by, up to about T dt^2 (w_i + w_j), is that of any material; over its length it is the excess stretch. Substeps divide
it by their square; m sweeps in each of them only by about m^0.9, so they have one each.

The tension is that of the cloth at rest, times a measured factor for its motion. Cloth hangs from what is held: vertices n
edges away carry in equal shares all that is further and can hang, and share it out among their springs by stiffness and
direction. Cloth that nothing holds counts as hung by its full width.

With bodies, too, substeps of one sweep are the cheapest: on a ball 64 of them cost less than 8 of 17 sweeps and leave half the
excess.

Measured for hanging sheets of 8 to 64 cells a side, of 0.3 to 2 m, 0.03 to 0.75 kg/m2, 1e3 to 1e5 N/m, quads and triangles,
held by one corner, two, four, a side, the middle of a side, every fourth vertex of a side. Not foreseen: grippers, which
hold nothing when the work is chosen, and bodies that move.
"""

from __future__ import annotations

import math

import numpy as np

from clothgym.arrays import BoolArray, FloatArray, IntArray
from clothgym.fidelity import MOST_SUBSTEPS, Fidelity
from clothgym.model import ClothModel

MOTION = 6.5
"""Excess of a moving cloth over that of the same at rest, at an excess of 3 %: cloth falls from level to hanging, snaps taut
and swings through. It is greater where less is allowed, by the fourth root: 10 at 0.5 %, 4.8 at 10 %."""
MOTION_IN_CONTACT = 20.0
"""The same where bodies are in its way: cloth is pulled taut over them, by what slides down their sides. Measured for sheets
of 12 to 40 cells on a ball and a skirt on a body: their promises take 2 to 4.6 times the substeps of the cloth at rest, these
are 4.5."""
IMPACT = 28.5
"""Substeps of one sweep in a time in which loose cloth that falls to the ground goes one edge, at an excess of 10 %: of what
meets the ground first, all that a substep moves it comes too late for its neighbours."""
_IMPACT_POWER = 0.65
"""Less excess takes as many more of them, by this power: between 1 / 2, of a load that lasts, and 1, of a blow."""
_IMPACT_CELLS = 16.0
_FINER_POWER = 0.5
"""Cloth of more cells across takes as many more of them, by this power: at the corner that is hit, as at the tip of a crack,
stress grows by the root of how finely it is looked at."""
SPANNED = 3.0
"""Between held vertices that are not on one line cloth is taut like a drum: more than its weight pulls."""
LEAST = 2.2
"""Substeps in 1/60 s, over the root of the stretch, below which heights of a falling sheet are off by centimetres."""
_GAIN = 0.9
"""m sweeps of a substep divide its excess by m to this power."""
_LEVEL = 0.02
"""Held vertices whose extent across their line is more than this of that along it span an area."""


def effort(model: ClothModel, fidelity: Fidelity) -> tuple[int, int]:
    """Substeps of a step and sweeps of a substep: those of the fidelity, or as many as its promise takes.

    Substeps of one sweep are the cheapest, with contact too: no fewer than hold stretch as well as what the fidelity asks for
    at least.

    Raises:
        ValueError: more of them than a fidelity may ask for; a step would take minutes.
    """
    if fidelity.substeps > 0:
        return fidelity.substeps, fidelity.sweeps
    scene, stretch = model.scene, fidelity.stretch_error
    motion = MOTION_IN_CONTACT if scene.bodies else MOTION
    single = float(substeps_for(model, stretch, motion))
    if scene.bodies or scene.self_collision:
        single = max(single, fidelity.contact_substeps * fidelity.sweeps ** (0.5 * _GAIN))
    if scene.self_collision and not scene.bodies:
        single = max(single, impact_substeps(model, stretch))
    return _bounded(math.ceil(single), stretch), 1


def _bounded(substeps: int, stretch: float) -> int:
    if substeps > MOST_SUBSTEPS:
        raise ValueError(
            f"fidelity.stretch_error = {stretch:g}: takes {substeps:.3g} substeps in this scene, more than {MOST_SUBSTEPS}; "
            "allow more stretch, give the substeps, or take shorter steps of the scene"
        )
    return substeps


def substeps_for(model: ClothModel, stretch: float, motion: float = MOTION) -> int:
    """Substeps of one sweep in a step, for an excess stretch of cloth that moves so much.

    Substeps also damp the motion, by a share that falls with their length; a promise of little stretch takes more of them
    than stretch itself may need: 7, 13 and 32 in 1/60 s for 10, 3 and 0.5 %.
    """
    step = model.scene.step
    least = 60.0 * step * LEAST / math.sqrt(stretch)
    return max(math.ceil(step / _longest(model, stretch, motion)), math.ceil(least))


def impact_substeps(model: ClothModel, stretch: float) -> float:
    """Substeps of one sweep in a step, for an excess stretch when cloth that nothing holds falls to the ground.

    Measured for sheets of 8 to 64 cells that fall on a corner (`clothgym bench crumple`); excess falls with the number of
    substeps to the power of 1.2 to 1.6.
    """
    scene, components = model.scene, model.surface.components
    if scene.ground is None:
        return 0.0
    held = np.zeros(components.max() + 1, np.bool_)
    held[components[model.inverse_masses == 0.0]] = True
    loose = ~held[components]
    if not loose.any():
        return 0.0
    lowest = np.full(components.max() + 1, math.inf)
    np.minimum.at(lowest, components[loose], scene.start[loose, 1])
    height = max(0.0, float(lowest[np.isfinite(lowest)].max()) - scene.ground)
    gravity = float(np.linalg.norm(scene.gravity))
    speed = math.sqrt(2.0 * gravity * height)
    if model.damping > 0.0:
        speed = min(speed, gravity / model.damping)  # no fall is faster
    across = math.sqrt(float(np.bincount(components, model.vertex_areas)[~held].max())) / model.mean_edge
    finer = max(1.0, across / _IMPACT_CELLS) ** _FINER_POWER
    return IMPACT * finer * speed * scene.step / model.mean_edge * (0.1 / stretch) ** _IMPACT_POWER


def substeps_at_rest(model: ClothModel, stretch: float) -> int:
    """Substeps of one sweep in a step, for an excess stretch of cloth that hardly moves: what comes to rest on a body."""
    return _bounded(math.ceil(model.scene.step / _longest(model, stretch, 1.0)), stretch)


def _longest(model: ClothModel, stretch: float, motion: float) -> float:
    """Longest substep [s] of one sweep for an excess stretch."""
    rate = motion * (0.03 / stretch) ** 0.25 * excess_rate(model)
    return math.sqrt(stretch / max(rate, 1e-30))


def excess_rate(model: ClothModel) -> float:
    """Excess stretch of the cloth at rest [1/s^2] for a squared substep [s^2], where it is greatest, with one sweep each."""
    gravity = float(np.linalg.norm(model.scene.gravity))
    components = model.surface.components
    held = model.inverse_masses == 0.0
    hanging = np.zeros(components.max() + 1, np.bool_)
    hanging[components[held]] = True
    ends = _ends(model)
    free = ~hanging[components[ends[:, 0]]]
    rate = 0.0
    if free.any():
        rate = _rate_of_free_cloth(model, components, ends[free])
    if held.any():
        rate = max(rate, _rate_below(model, components, held))
    return gravity * rate


def _ends(model: ClothModel) -> IntArray:
    return model.spring_ends if len(model.spring_ends) else model.surface.edges


def _clearance(model: ClothModel, vertices: BoolArray) -> float:
    """How far cloth can hang down from the highest of some vertices [m]."""
    if model.scene.ground is None:
        return math.inf
    return max(0.0, float(model.scene.start[vertices, 1].max()) - model.scene.ground)


def _rate_of_free_cloth(model: ClothModel, components: IntArray, ends: IntArray) -> float:
    size = np.sqrt(np.maximum(np.bincount(components, model.vertex_areas), 1e-30))
    density = np.bincount(components, model.masses) / size**2
    hangs = np.minimum(size, _clearance(model, np.ones(model.vertex_count, np.bool_)))
    load = density * hangs  # [kg/m] along a width
    return float((load[components[ends[:, 0]]] * model.inverse_masses[ends].sum(axis=1)).max())


def _rate_below(model: ClothModel, components: IntArray, held: BoolArray) -> float:
    """Of cloth below held vertices, the greatest over all cuts between a distance from them and the next."""
    ends, x = _ends(model), model.scene.start
    springs = len(model.spring_ends) > 0
    rest = model.spring_rest if springs else model.edge_rest
    stiffness = model.spring_stiffness if springs else np.ones(len(ends))
    distance = _distances(ends, held)
    # each spring from its end nearer to what is held
    turn = distance[ends[:, 0]] > distance[ends[:, 1]]
    near = np.where(turn, ends[:, 1], ends[:, 0])
    far = np.where(turn, ends[:, 0], ends[:, 1])
    cut = (distance[near] >= 0) & (distance[far] == distance[near] + 1) & (rest > 0.0)
    if not cut.any():
        return 0.0
    near, far, length = near[cut], far[cut], rest[cut]
    way = _units(x[far] - x[near])
    # the load at a vertex acts along its springs together
    pull = _units(np.stack([np.bincount(near, way[:, c], minlength=len(x)) for c in range(3)], axis=1))
    along = np.maximum(np.einsum("ij,ij->i", way, pull[near]), 0.0)
    tension = stiffness[cut] * length * along**2
    capacity = np.bincount(near, tension * along, minlength=len(x))
    share = tension / np.maximum(capacity[near], 1e-30)
    load = _loads(model, components, distance, near, length)[near]
    rate = load * share * (model.inverse_masses[near] + model.inverse_masses[far]) / length
    spanned = np.array([_spans(model, held & (components == c)) for c in range(components.max() + 1)])
    return float((rate * np.where(spanned[components[near]], SPANNED, 1.0)).max())


def _units(vectors: FloatArray) -> FloatArray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-30)[:, None]


def _loads(
    model: ClothModel, components: IntArray, distance: IntArray, near: IntArray, length: FloatArray
) -> FloatArray:
    """(V,) mass [kg] that each vertex carries: of its component what is further and can hang, in equal shares."""
    levels = int(distance.max()) + 1
    steps = np.bincount(distance[near], length, minlength=levels) / np.maximum(
        np.bincount(distance[near], minlength=levels), 1
    )
    depth = np.concatenate([[0.0], np.cumsum(steps)[:-1]])  # [m] from what is held
    place = components * levels + np.maximum(distance, 0)
    hangs = (distance >= 0) & (depth[np.maximum(distance, 0)] <= _clearance(model, distance == 0))
    groups = (int(components.max()) + 1) * levels
    mass = np.bincount(place[hangs], model.masses[hangs], minlength=groups).reshape(-1, levels)
    further = (mass[:, ::-1].cumsum(axis=1)[:, ::-1] - mass).ravel()
    carriers = np.zeros(len(distance), np.bool_)
    carriers[near] = True
    count = np.bincount(place[carriers], minlength=groups)
    return further[place] / np.maximum(count[place], 1)


def _distances(ends: IntArray, held: BoolArray) -> IntArray:
    """(V,) springs to the nearest held vertex; -1 = none is connected."""
    distance = np.where(held, 0, -1).astype(np.int32)
    i, j = ends[:, 0], ends[:, 1]
    level = 0
    while True:
        new = np.zeros(len(held), np.bool_)
        new[j[distance[i] == level]] = True
        new[i[distance[j] == level]] = True
        new &= distance < 0
        if not new.any():
            return distance
        level += 1
        distance[new] = level


def _spans(model: ClothModel, held: BoolArray) -> bool:
    """Whether held vertices span an area, where they start."""
    points = model.scene.start[held]
    if len(points) < 3:
        return False
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extent[1] > _LEVEL * extent[0])
