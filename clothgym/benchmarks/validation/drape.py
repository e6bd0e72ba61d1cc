"""V8, V10: a strip on edge that buckles sideways, and the Cusick drape of a round specimen."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

import clothgym as cg
from clothgym.arrays import FloatArray, IntArray
from clothgym.benchmarks.frame import Case
from clothgym.benchmarks.validation import bending as bends
from clothgym.benchmarks.validation import measure
from clothgym.benchmarks.validation.solvers import IMPLICIT, simulate, solvers, split
from clothgym.fidelity import MEMBRANES
from clothgym.scenes import validation as scenes

_PIXEL = 2.5e-4
"""[m] of the shadow."""
SELF_WEIGHT = 12.85
"""q L^3 / sqrt(EI GJ) at which a strip on edge buckles under its own weight (Timoshenko, quoted from memory)."""


def cases(quick: bool) -> list[Case]:
    """Drapes from limp to stiff, and one strip on edge, for every stiff bending energy and membrane."""
    lengths = (0.02, 0.05) if quick else (0.015, 0.02, 0.03, 0.05)
    vertices = 150 if quick else 400
    listed = []
    for membrane in MEMBRANES[-1:] if quick else MEMBRANES:
        # all integrators share their rest: the one that is there soonest
        names = solvers(membrane)
        solver = next((name for name in names if split(name)[:2] == ("implicit_euler", "")), names[0])
        for bending in bends.STIFF[:1] if quick else bends.STIFF:
            settings = {"solver": solver, "bending": bending}
            listed += [
                Case(
                    f"drape/{1e3 * c:g} mm/{bending}/{solver}",
                    {"family": "drape", **settings, "bending_length": c, "vertices": vertices},
                )
                for c in lengths
            ]
            if not quick:
                listed += [  # 2 rows wide: the strip gets narrower
                    Case(f"buckling/{rows} rows/{bending}/{solver}", {"family": "buckling", **settings, "rows": rows})
                    for rows in (20, 40)
                ]
    return listed


def shadow(positions: FloatArray, faces: IntArray) -> float:
    """Area [m^2] that triangles cover seen from above."""
    from PIL import Image, ImageDraw

    low = positions[:, [0, 2]].min(axis=0) - 2 * _PIXEL
    size = np.ceil((positions[:, [0, 2]].max(axis=0) + 2 * _PIXEL - low) / _PIXEL).astype(int)
    image = Image.new("1", (int(size[0]), int(size[1])))
    pen = ImageDraw.Draw(image)
    for corners in (positions[faces][:, :, [0, 2]] - low) / _PIXEL:
        pen.polygon([(float(x), float(y)) for x, y in corners], fill=1)
    return float(np.asarray(image).sum()) * _PIXEL**2


def nodes(positions: FloatArray, border: NDArray[np.integer]) -> int:
    """Number of folds: the strongest wave of the border's distance from the axis, over its turn."""
    ring = positions[border]
    turn = np.arctan2(ring[:, 2], ring[:, 0])
    order = np.argsort(turn)
    even = np.linspace(-math.pi, math.pi, 256, endpoint=False)
    radius = np.interp(even, turn[order], np.hypot(ring[order, 0], ring[order, 2]), period=2.0 * math.pi)
    return int(np.argmax(np.abs(np.fft.rfft(radius - radius.mean()))[1:33])) + 1


def drape(solver: str, bending: str, bending_length: float, vertices: int) -> dict[str, Any]:
    """Drape coefficient: the share of the free ring's area that its shadow still covers [percent]; and the nodes."""
    scene = scenes.drape_test(bending_length, vertices)
    dt = 4e-3 if split(solver)[0] in IMPLICIT else 4e-4
    simulation = simulate(scene, solver, dt, 1.0 / 60.0, bending)
    left = measure.settle(simulation, scene.duration, 2e-3)
    x, rest, faces = simulation.positions, scene.cloths[0].rest, simulation.faces
    border = np.flatnonzero(np.hypot(rest[:, 0], rest[:, 2]) > scenes.SPECIMEN - 1e-6)
    disc = math.pi * scenes.DISC**2
    coefficient = 100.0 * (shadow(x, faces) - disc) / (shadow(rest, faces) - disc)
    return {
        "quantities": [
            measure.quantity("drape coefficient [%]", coefficient, None),
            measure.quantity("nodes", float(nodes(x, border)), None),
        ],
        "coefficient": coefficient,
        "speed_left": left,
        "max_strain": simulation.metrics()["max_strain"],
    }


def buckling(solver: str, bending: str, rows: int) -> dict[str, Any]:
    """Weight at which a strip on edge, clamped at one end, buckles sideways, from how its answer to a small push grows.

    The push bends the tip by d, without limit at q_cr: 1 / d over q^2, nearly a line, leads to zero there. EI and GJ are
    measured on the same strip, from the energy that a bend and a twist take.
    """
    length, columns, rigidity, modulus = 0.2, 2, 1e-3, 5e3
    width = length / rows * columns
    mesh = cg.grid(width, length, columns, rows)
    along, up = 0.5 * length - mesh.vertices[:, 2], mesh.vertices[:, 0]
    start = np.stack([along, up, 0.0 * up], axis=1)
    pins = np.flatnonzero(along < 1.5 * length / rows)
    free = length * (rows - 0.5) / rows
    material = scenes.fabric(modulus, columns, 0.5 * modulus, rigidity, damping=8.0)
    cloth = cg.Cloth(cg.Mesh(start, mesh.faces, mesh.quads), material, pins.tolist(), mesh.vertices)
    dt = 2e-3 if split(solver)[0] in IMPLICIT else 5e-5
    still = cg.Scene([cloth], gravity=(0.0, 0.0, 0.0), self_collision=False)
    simulation = simulate(still, solver, dt, 1.0 / 60.0, bending)
    twist = 1e-2
    taken = bends.energy(simulation, start + np.outer(twist * along * up, (0.0, 0.0, 1.0)))
    torsion = 2.0 * taken / (twist**2 * length)
    bend = rigidity * width
    critical = SELF_WEIGHT * math.sqrt(bend * torsion) / free**3
    shares, answers = (0.0, 0.5, 0.7, 0.85, 1.0), []
    for share in shares:
        g = share * critical / (scenes.DENSITY * width)
        pushed = dataclasses.replace(still, gravity=(0.0, -g, 1e-3 * critical / (scenes.DENSITY * width)))
        simulation = simulate(pushed, solver, dt, 1.0 / 60.0, bending)
        measure.settle(simulation, 6.0, 1e-7)
        answers.append(float(simulation.positions[along > length - 1e-9, 2].mean()))
    falling = np.polyfit(np.square(shares), 1.0 / np.asarray(answers), 2)
    zeros = [z.real for z in np.roots(falling) if abs(z.imag) < 1e-9 and z.real > 0.0]
    found = math.sqrt(min(zeros)) * SELF_WEIGHT if zeros else None
    return {
        "quantities": [
            measure.quantity("q L^3 / sqrt(EI GJ)", found, SELF_WEIGHT),
            measure.quantity("GJ / EI", torsion / bend, None),
        ],
        "answers": answers,
    }
