"""Scenes with known answers: pendulum, chain, column, catenary, cantilever, incline, bounce, Cusick drape.

Strips are grids of square cells whose vertices weigh the same, so that a strip of one cell is a row of equal masses; springs
and membranes get constants that give a row of cells the same stiffness. `clothgym bench validation` compares the scenes with
their answers.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay
from scipy.special import eval_laguerre, roots_laguerre

from clothgym.arrays import FloatArray
from clothgym.body import Body
from clothgym.materials import Material
from clothgym.mesh import Mesh, grid
from clothgym.scene import Cloth, Scene

G = 9.81
"""Gravity [m/s^2]."""
DENSITY = 0.2
"""Mass per area of all cloths here [kg/m^2]."""
DISC, SPECIMEN = 0.09, 0.15
"""Radii of the disc and of the specimen of a Cusick drape test [m]."""
CLEARANCE = 3e-3
"""Distance from a body at which sheets start [m]: the default of `Fidelity.body_tolerance`."""

Pins = NDArray[np.integer]


def fabric(modulus: float, columns: int, shear: float = 0.0, bending: float = 0.0, **others: float) -> Material:
    """A material that gives strips of so many columns of square cells the stiffness `modulus` [N/m] (force per width and
    strain), and the shear modulus `shear` [N/m], with springs as with a membrane; `bending` rigidity [N m].

    A border column of springs carries as much as an inner one, so n columns of cells have n + 1 columns of springs.
    """
    values: dict[str, float] = {"density": DENSITY, "flexion": 0.0, "damping": 0.0, "friction": 0.3}
    values |= {"stretch": modulus * columns / (columns + 1), "shear": shear, "bending": bending}
    values |= {"weft": modulus, "warp": modulus, "coupling": 0.0, "shear_modulus": shear}
    return Material(**(values | others))


def _strip(length: float, columns: int, rows: int) -> tuple[Mesh, FloatArray, FloatArray]:
    """A strip of square cells: flat mesh, and of each vertex the distance from the first row and the place across [m]."""
    mesh = grid(length * columns / rows, length, columns, rows)
    return mesh, 0.5 * length - mesh.vertices[:, 2], mesh.vertices[:, 0]


def _bias_strip(length: float, columns: int, rows: int) -> tuple[Mesh, FloatArray, FloatArray]:
    """As `_strip`, cut at 45 degrees to the sides of its cells: `rows` half diagonals long, `columns` diagonals wide; cells
    at the border are halved. The coordinates of the flat mesh follow the cells; a triangle mesh, since springs of quads would
    not hold its corners."""
    half = length / rows
    j, i = (n.ravel() for n in np.meshgrid(np.arange(rows + 1), np.arange(2 * columns + 1), indexing="ij"))
    on = (i + j) % 2 == 0
    number = np.full(((rows + 1), 2 * columns + 1), -1)
    number[j[on], i[on]] = np.arange(on.sum())
    faces = []
    for cj, ci in zip(j[~on].tolist(), i[~on].tolist()):
        west, east = (number[cj, k] if 0 <= k <= 2 * columns else -1 for k in (ci - 1, ci + 1))
        north, south = (number[k, ci] if 0 <= k <= rows else -1 for k in (cj - 1, cj + 1))
        ring = [west, south, east, north]
        if -1 in ring:
            gap = ring.index(-1)
            faces.append([ring[gap - 3], ring[gap - 2], ring[gap - 1]])
            continue
        turn = (ci // 2 + cj) % 2
        faces += [[ring[turn], ring[turn + 1], ring[turn + 2]], [ring[turn + 2], ring[turn - 1], ring[turn]]]
    along, across = half * j[on], half * (i[on] - columns)
    flat = math.sqrt(0.5) * np.stack([along + across, np.zeros(len(along)), along - across], axis=1)
    return Mesh(flat, np.array(faces, np.int32)), along, across


def _cloth(
    mesh: Mesh, start: tuple[FloatArray, ...], material: Material, pins: NDArray[np.integer], equal: bool = True
) -> Cloth:
    """A cloth that starts at (x, y, z); the mesh is its rest shape."""
    placed = Mesh(np.stack(start, axis=1), mesh.faces, mesh.quads)
    return Cloth(placed, material, pins.tolist(), mesh.vertices, "strip", equal_masses=equal)


def _vertex_weight(length: float, rows: int) -> float:
    """Weight of each vertex of a strip of one cell across [N]."""
    return DENSITY * length * (length / rows) / (2 * (rows + 1)) * G


def pendulum(angle: float = 30.0, length: float = 1.0) -> Scene:
    """Two masses on rods, a strip of one cell hung by its upper side, let go at an angle from the vertical without damping.
    The rods stretch by 1e-5 under their weight. The period grows with the angle: 1.00191 times 2 pi sqrt(l / g) at 10
    degrees, 1.01741 at 30, 1.07318 at 60, 1.18034 at 90."""
    mesh, along, across = _strip(length, 1, 1)
    material = fabric(2e5 * _vertex_weight(length, 1) / length, 1)
    a = math.radians(angle)
    cloth = _cloth(mesh, (across, -math.cos(a) * along, math.sin(a) * along), material, np.arange(2))
    return Scene((cloth,), self_collision=False, duration=6.0 * math.sqrt(length), name="pendulum")


def chain(links: int = 16, mode: int = 1, length: float = 1.0) -> Scene:
    """A hanging chain, a limp strip of one cell across, let go without damping in the shape of one of its small swings (1e-3
    of its length). Equal masses swing with the frequencies sqrt(x g links / length), x the roots of the Laguerre polynomial
    of order `links`; a chain of many with 1.2024, 2.7600, 4.3269 sqrt(g / length)."""
    mesh, along, across = _strip(length, 1, links)
    weight, mode = _vertex_weight(length, links), min(mode, links)
    stiffness = 1e3 * links * weight * links / length  # the first link stretches by 1e-3
    row = np.rint(along / length * links).astype(int)
    stretched = np.concatenate([[0.0], np.cumsum(weight / stiffness * np.arange(links, 0, -1))])
    shape = np.where(row == 0, 0.0, eval_laguerre(links - row, roots_laguerre(links)[0][mode - 1]))
    start = (across, -along - stretched[row], 1e-3 * length * shape)
    cloth = _cloth(mesh, start, fabric(2.0 * stiffness, 1), np.arange(2))
    return Scene((cloth,), self_collision=False, duration=8.0 * math.sqrt(length) / mode, name="chain")


def column(rows: int = 20, strain: float = 1e-3, length: float = 1.0) -> Scene:
    """A strip hung by its upper side comes to rest under its own weight at the given mean strain. Spring i from the top
    stretches by the weight of the n - i + 1 masses below it over its stiffness, all by n (n + 1) / 2 weights."""
    mesh, along, across = _strip(length, 1, rows)
    stiffness = _vertex_weight(length, rows) * rows * (rows + 1) / (2.0 * strain * length)
    slowest = 0.5 * math.pi * math.sqrt(0.5 * G / (strain * length))  # [rad/s], damped critically
    material = fabric(2.0 * stiffness, 1, damping=2.0 * slowest)
    cloth = _cloth(mesh, (across, -along, 0.0 * along), material, np.arange(2))
    return Scene((cloth,), self_collision=False, duration=20.0 / slowest, name="column")


def catenary(slack: float = 1.25, links: int = 40, span: float = 1.0) -> Scene:
    """A limp strip, hung by both ends at one height, `slack` times as long as they are apart, comes to rest from an arc of a
    circle; it stretches too little to change the sag. Sag over span: 0.0615 at 1.01, 0.1393 at 1.05, 0.2003 at 1.1, 0.3318
    at 1.25, 0.5026 at 1.5, 0.7964 at 2."""
    length = slack * span
    mesh, along, across = _strip(length, 1, links)
    strain = 1e-3 * min(slack - 1.0, 0.1)
    stiffness = links * _vertex_weight(length, links) * links / (length * strain)
    low, high = 1e-9, math.pi  # half the angle of the arc: sin(a) / a = 1 / slack
    for _ in range(60):
        half = 0.5 * (low + high)
        low, high = (half, high) if math.sin(half) / half > 1.0 / slack else (low, half)
    radius, turn = 0.5 * length / half, half * (2.0 * along / length - 1.0)
    start = (across, radius * (math.cos(half) - np.cos(turn)), radius * np.sin(turn))
    ends = np.array([0, 1, 2 * links, 2 * links + 1])
    cloth = _cloth(mesh, start, fabric(2.0 * stiffness, 1, damping=8.0), ends)
    return Scene((cloth,), self_collision=False, duration=6.0 * math.sqrt(span), name="catenary")


def cantilever(load: float = 10.0, rows: int = 32, columns: int = 2, length: float = 0.2, grain: str = "0") -> Scene:
    """A strip, clamped level at one end, bends down under its own weight and comes to rest [Romero 2021]. `load` is w L^3 / B,
    its weight over its bending rigidity; at 10 the tip of the elastica ends 0.7002 L below the clamp and 1.0668 times as deep
    as far. Two rows are held, and the clamp lies in the middle between them; the grain is the angle between strip and
    cells."""
    whole = length * rows / (rows - 0.5)
    mesh, along, across = (_bias_strip if grain == "45" else _strip)(whole, columns, rows)
    if grain == "90":
        mesh = mesh.transformed(rotation=[[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    weight = DENSITY * G
    modulus, held = 1e4 * weight * length, np.flatnonzero(along < 1.5 * whole / rows)
    rigidity = weight * length**3 / load
    material = fabric(modulus, columns, 0.5 * modulus, rigidity, damping=2.0 * math.sqrt(G / length))
    free = along - 0.5 * whole / rows
    cloth = _cloth(mesh, (across, 0.0 * free, free), material, held, equal=False)
    return Scene((cloth,), self_collision=False, duration=20.0 * math.sqrt(length / G), name="cantilever")


def _square(side: float, cells: int, friction: float, thickness: float = 2e-3) -> tuple[Mesh, Material]:
    material = fabric(2e2, cells, 1e2, friction=friction, thickness=thickness)
    return grid(side, side, cells, cells), material


def _slab(normal: FloatArray, friction: float, rebound: float = 0.0, slide: float = 0.99) -> Body:
    """A slab of 4 m x 4 m whose upper side goes through the origin."""
    n = normal / np.linalg.norm(normal)
    x = np.array([1.0, 0.0, 0.0])
    axes = np.stack([x, n, np.cross(x, n)])
    corners = np.array([[i, j, k] for i in (-2.0, 2.0) for j in (-0.3, 0.0) for k in (-2.0, 2.0)]) @ axes
    sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = np.array([[s[0], s[n], s[n + 1]] for s in sides for n in (1, 2)], np.int32)
    return Body((corners, faces), "slab", friction, slide, rebound)


def incline(angle: float = 20.0, friction: float = 0.3, plane: str = "body", slide: float = 0.99) -> Scene:
    """A sheet on a slope, which it touches from the start. It stays where tan(angle) is below the coefficient of friction,
    and slides with g (sin - friction cos) above it. The slope is a slab ("body"), or the ground under gravity that is tilted
    ("ground"). `slide` is C_fric of [Vassilev 2001] eq. 12, which creeps with C g sin(angle) dt / (1 - C) instead."""
    mesh, material = _square(0.2, 4, friction)
    a = math.radians(angle)
    if plane == "ground":
        up = np.full(len(mesh.vertices), 0.5 * material.thickness)
        cloth = _cloth(mesh, (mesh.vertices[:, 0], up, mesh.vertices[:, 2]), material, np.zeros(0, int))
        gravity = (0.0, -G * math.cos(a), G * math.sin(a))
        return Scene((cloth,), ground=0.0, gravity=gravity, self_collision=False, duration=1.0, name="incline")
    normal, down = np.array([0.0, math.cos(a), math.sin(a)]), np.array([0.0, -math.sin(a), math.cos(a)])
    start = CLEARANCE * normal + mesh.vertices[:, 2:] * down
    cloth = _cloth(mesh, (mesh.vertices[:, 0], start[:, 1], start[:, 2]), material, np.zeros(0, int))
    bodies = (_slab(normal, friction, slide=slide),)
    return Scene((cloth,), bodies, self_collision=False, duration=1.0, name="incline")


def capstan(ratio: float = 2.0, friction: float = 0.3, short: float = 0.3) -> Scene:
    """A strip lies over half a cylinder, one end hangs `ratio` times as deep as the other. It slides where the ratio is above
    exp(pi friction), 2.566 at 0.3, but for the weight of what lies on the cylinder. Gravity draws along -z, and the cylinder
    lies along x."""
    radius, cell = 0.05, 0.01
    around = math.pi * (radius + CLEARANCE)
    rows = round((short * (1.0 + ratio) + around) / cell)
    mesh, along, across = _strip(rows * cell, 1, rows)
    turn = np.clip((along - short) / (radius + CLEARANCE), 0.0, math.pi)
    down = np.maximum(short - along, 0.0) + np.maximum(along - short - around, 0.0)
    y, z = -(radius + CLEARANCE) * np.cos(turn), (radius + CLEARANCE) * np.sin(turn) - down
    material = fabric(3e2, 1, 1.5e2, damping=5.0)
    cloth = _cloth(mesh, (across, y, z), material, np.zeros(0, int))
    angles = 2.0 * math.pi * np.arange(192) / 192
    ring = np.stack([0.0 * angles, radius * np.cos(angles), radius * np.sin(angles)], axis=1)
    ends = [ring + np.array([x, 0.0, 0.0]) for x in (-0.1, 0.1)]
    here, on = np.arange(192), (np.arange(192) + 1) % 192
    sides = [np.stack(f, axis=1) for f in ((here, on, 192 + here), (on, 192 + on, 192 + here))]
    caps = [np.stack(f, axis=1) for f in ((on, here, 0 * here + 384), (192 + here, 192 + on, 0 * here + 385))]
    points = np.concatenate([*ends, [[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]])
    body = Body((points, np.concatenate(sides + caps).astype(np.int32)), "cylinder", friction)
    gravity = (0.0, 0.0, -G)
    return Scene((cloth,), (body,), gravity=gravity, self_collision=False, duration=1.0, name="capstan")


def bounce(height: float = 0.1, rebound: float = 0.7) -> Scene:
    """A sheet falls flat on a level slab that gives back `rebound` of its speed where `Fidelity.body_response` is "velocity":
    it rises to rebound^2 of the height again."""
    mesh, material = _square(0.2, 4, 0.0)
    up = np.full(len(mesh.vertices), CLEARANCE + height)
    cloth = _cloth(mesh, (mesh.vertices[:, 0], up, mesh.vertices[:, 2]), material, np.zeros(0, int))
    bodies = (_slab(np.array([0.0, 1.0, 0.0]), 0.0, rebound),)
    duration = (1.0 + 2.0 * rebound) * math.sqrt(2.0 * height / G)
    return Scene((cloth,), bodies, self_collision=False, duration=duration, name="bounce")


def drape_test(bending_length: float = 0.03, vertices: int = 1200) -> Scene:
    """A round specimen of 30 cm hangs over a disc of 18 cm that holds it, the Cusick drape test of BS 5058 and ISO 9073-9; it
    folds into nodes. The bending length (B / w)^(1/3) says how stiff it is: at 1 cm it hangs limp, at 6 cm it stands out."""
    border = max(12, round(2.0 * math.pi * SPECIMEN / math.sqrt(math.pi * SPECIMEN**2 / vertices)))
    count = np.arange(max(vertices - border, 8))
    # points of a sunflower: even, and no direction stands out
    radius = (SPECIMEN - 0.5 * math.sqrt(math.pi / vertices) * SPECIMEN) * np.sqrt((count + 0.5) / len(count))
    turn = math.pi * (3.0 - math.sqrt(5.0)) * count
    rim = 2.0 * math.pi * np.arange(border) / border
    x = np.concatenate([radius * np.cos(turn), SPECIMEN * np.cos(rim)])
    z = np.concatenate([radius * np.sin(turn), SPECIMEN * np.sin(rim)])
    faces = Delaunay(np.stack([x, z], axis=1)).simplices.astype(np.int32)
    mesh = Mesh(np.stack([x, np.zeros(len(x)), z], axis=1), faces)
    weight = DENSITY * G
    material = fabric(2e2, len(x), 0.0, weight * bending_length**3, damping=4.0)
    up = 1e-4 * np.random.default_rng(0).uniform(-1.0, 1.0, len(x))
    cloth = _cloth(mesh, (x, up, z), material, np.flatnonzero(np.hypot(x, z) <= DISC), equal=False)
    return Scene((cloth,), self_collision=False, duration=3.0, name="drape_test")


MAKERS = {
    "pendulum": pendulum,
    "chain": chain,
    "column": column,
    "catenary": catenary,
    "cantilever": cantilever,
    "incline": incline,
    "capstan": capstan,
    "bounce": bounce,
    "drape_test": drape_test,
}
_LENGTH = ("m", 0.01, 10.0, "length")
PARAMETERS = {
    "pendulum": {"angle": ("degrees", 0.1, 179.0, "from the vertical at the start"), "length": _LENGTH},
    "chain": {
        "links": ("", 1, 200, "number of links"),
        "mode": ("", 1, 200, "which of its small swings, 1 = the slowest"),
        "length": _LENGTH,
    },
    "column": {
        "rows": ("cells", 1, 500, "along the strip"),
        "strain": ("", 1e-6, 1.0, "mean strain at rest"),
        "length": _LENGTH,
    },
    "catenary": {
        "slack": ("", 1.001, 5.0, "length over the distance of the ends"),
        "links": ("cells", 2, 500, "along the strip"),
        "span": ("m", 0.01, 10.0, "distance of the ends"),
    },
    "cantilever": {
        "load": ("", 0.01, 1e4, "w L^3 / B: weight of an area times length cubed over bending rigidity"),
        "rows": ("cells", 4, 500, "along the strip"),
        "columns": ("cells", 1, 100, "across the strip"),
        "length": _LENGTH,
        "grain": ("degrees", 0, 0, "between the strip and its cells", ("0", "45", "90")),
    },
    "incline": {
        "angle": ("degrees", 0.0, 60.0, "of the slope"),
        "friction": ("", 0.0, 2.0, "Coulomb coefficient"),
        "plane": ("", 0, 0, "a slab, or the ground under tilted gravity", ("body", "ground")),
        "slide": ("", 0.0, 1.0, "share of the sliding speed kept a substep, for body_response velocity"),
    },
    "capstan": {
        "ratio": ("", 1.0, 10.0, "of the hanging ends"),
        "friction": ("", 0.0, 2.0, "Coulomb coefficient"),
        "short": ("m", 0.02, 1.0, "length of the shorter end"),
    },
    "bounce": {
        "height": ("m", 0.001, 10.0, "of the fall"),
        "rebound": ("", 0.0, 1.0, "share of the speed that the slab gives back, for body_response velocity"),
    },
    "drape_test": {
        "bending_length": ("m", 1e-3, 0.3, "(B / w)^(1/3), 0.01 limp to 0.06 stiff"),
        "vertices": ("", 100, 20_000, "of the specimen, about"),
    },
}
