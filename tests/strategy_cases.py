"""Tangled meshes and what strategies propose for them."""

from __future__ import annotations

from functools import cache

import meshes
import numpy as np

import clothgym as cg
from clothgym.mesh import vertex_areas
from clothgym.response import untangling
from clothgym.response.untangling import Context

NAMES = tuple(untangling.STRATEGIES)
MESHES = {
    "crossing": lambda: meshes.crossing_sheets(6, 2),
    "dent": lambda: meshes.poked_sphere(2, 0.08),
    "ribbon": lambda: meshes.strip_through_plane(0.2, 0.3),
    "fold": lambda: meshes.overfolded_sheet(5, 0),
    "crumple": lambda: meshes.crumple(8, 0),
    "sheets": lambda: meshes.many_sheets(5, 3, 2),
    "seam": lambda: meshes.seam_of_three(4, 0),
}


@cache
def mesh_of(name: str) -> meshes.Mesh:
    return MESHES[name]()


def context_of(mesh, h0: float = 0.05, inverse_masses=None, strategy: str = "local", g0: float = 1.0) -> Context:
    hits = cg.intersections(*mesh)
    weights = np.ones(len(mesh[0])) if inverse_masses is None else inverse_masses
    areas = vertex_areas(hits.vertices, hits.surface.faces)
    return Context(hits, weights, areas, h0, g0, untangling.memory(untangling.get(strategy)))


def propose(strategy: str, context: Context) -> np.ndarray:
    return untangling.get(strategy).propose(context).displacements


def fidelity(**settings) -> cg.Fidelity:
    return cg.Fidelity(**({"substeps": 4, "sweeps": 4, "untangling_passes": 1} | settings))
