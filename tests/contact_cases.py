"""Sheets above each other, and contacts narrowed from given pairs, for the tests of contact."""

from __future__ import annotations

from types import SimpleNamespace

import naive_mechanics as naive
import numpy as np

import clothgym as cg
from clothgym.kernels import near_pairs
from clothgym.response.contact import ContactBuffers, watched_pairs

CONTACT_ONLY = cg.Fidelity(untangling="none", substeps=4, flat_check=False)


def stack(count: int = 3, cells: int = 3, gap: float = 0.03, pinned=(), **settings) -> cg.Scene:
    """Level sheets of 30 cm above each other, a little shifted; no gravity unless asked for."""
    scene = {"gravity": (0.0, 0.0, 0.0)} | {k: settings.pop(k) for k in ("gravity", "ground", "step") if k in settings}
    material = cg.Material(**({"thickness": 0.01, "damping": 0.0} | settings))
    mesh = cg.grid(0.3, 0.3, cells, cells)
    cloths = []
    for k in range(count):
        placed = mesh.transformed(translation=(0.011 * k, gap * (k + 1), 0.007 * k))
        cloths.append(cg.Cloth(placed, material, (0, cells) if k in pinned else (), mesh.vertices, f"sheet {k}"))
    return cg.Scene(cloths, **scene)


def narrowed(x, p, quads, kinds, thickness, apart=None, w=None) -> tuple[ContactBuffers, near_pairs.Watched]:
    """Contacts on the way from x to p, and what is known of every given pair."""
    w = np.ones(len(x)) if w is None else w
    pairs = SimpleNamespace(
        watched=watched_pairs(len(quads), len(x)), count=len(quads), model=SimpleNamespace(inverse_masses=w)
    )
    pairs.watched.quads[:], pairs.watched.kinds[:], pairs.watched.rest[:] = quads, kinds, thickness
    # nothing is known of any distance: every pair is measured
    near_pairs.begin(x + 1.0, pairs.watched, len(quads))
    buffers = ContactBuffers(16)
    apart = np.zeros(len(x), np.bool_) if apart is None else apart
    buffers.narrow(x, p, pairs, apart, False, 0.0)
    return buffers, pairs.watched


def every_quad(faces) -> tuple[np.ndarray, np.ndarray]:
    points, lines = naive.all_quads(faces)
    return np.concatenate([points, lines]), np.r_[np.zeros(len(points), np.uint8), np.ones(len(lines), np.uint8)]
