"""The model: immutable arrays built from a scene."""

from __future__ import annotations

import math

import numpy as np

from clothgym import materials
from clothgym.arrays import FloatArray, IntArray
from clothgym.kernels.springs import ClothArrays
from clothgym.mesh import Surface, smallest_altitudes, vertex_areas
from clothgym.scene import Cloth, Scene

STRUCTURAL, SHEAR, FLEXION = 0, 1, 2


class ClothModel:
    """All cloths of a scene as one set of arrays; constant while a simulation lives.

    Attributes:
        surface: topology of all cloths together.
        masses: (V,) [kg]; inverse_masses: (V,) 0 = pinned.
        springs: ends (S, 2), rest lengths (S,) [m], stiffness (S,) [N/m], kinds (S,).
        edge_rest: (E,) rest length of every mesh edge [m]; mean_edge their mean.
        thickness: (V,) contact distance [m], never more than half the least altitude of the triangles around.
        friction, damping: mean over the cloths (one value acts on all of them).
        ranges: (name, vertex slice, face slice) of each cloth.
        cloth_of_vertex: (V,) number of its cloth.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        vertices, faces, masses, ends, rest, stiffness, kinds, thickness, friction, damping = ([] for _ in range(10))
        ranges, offset, face_offset = [], 0, 0
        pinned: list[int] = []
        for cloth in scene.cloths:
            material = materials.get(cloth.material)
            count = len(cloth.mesh.vertices)
            areas = vertex_areas(cloth.rest, cloth.mesh.faces)
            used = areas > 0
            if not used.any():
                raise ValueError(f"cloth {cloth.name!r}: every triangle of the rest shape has zero area")
            mass = areas * material.density
            if cloth.equal_masses:
                mass = np.full(count, areas.sum() * material.density / count)
            # a vertex that no triangle gives mass to must not be infinitely light
            mass = np.maximum(mass, 1e-6 * mass.max())
            spring_ends, spring_rest, spring_stiffness, spring_kinds = _springs(cloth)
            vertices.append(cloth.rest)
            faces.append(cloth.mesh.faces + offset)
            masses.append(mass)
            pinned.extend(offset + pin for pin in cloth.pins)
            ends.append(spring_ends + offset)
            rest.append(spring_rest)
            stiffness.append(spring_stiffness)
            kinds.append(spring_kinds)
            thickness.append(np.minimum(material.thickness, 0.5 * smallest_altitudes(cloth.rest, cloth.mesh.faces)))
            friction.append(material.friction)
            damping.append(material.damping)
            ranges.append(
                (cloth.name, slice(offset, offset + count), slice(face_offset, face_offset + len(cloth.mesh.faces)))
            )
            offset += count
            face_offset += len(cloth.mesh.faces)
        self.rest_vertices: FloatArray = np.concatenate(vertices)
        self.faces: IntArray = np.ascontiguousarray(np.concatenate(faces), np.int32)
        self.surface = Surface(self.faces, offset)
        self.masses: FloatArray = np.concatenate(masses)
        self.inverse_masses = 1.0 / self.masses
        self.inverse_masses[pinned] = 0.0
        self.spring_ends: IntArray = np.ascontiguousarray(np.concatenate(ends), np.int32)
        self.spring_rest: FloatArray = np.concatenate(rest)
        self.spring_stiffness: FloatArray = np.concatenate(stiffness)
        self.spring_kinds: IntArray = np.concatenate(kinds)
        self.thickness: FloatArray = np.ascontiguousarray(np.concatenate(thickness))
        self.friction = float(np.mean(friction))
        self.damping = float(np.mean(damping))
        self.ranges: list[tuple[str, slice, slice]] = ranges
        self.cloth_of_vertex = np.repeat(np.arange(len(ranges)), [r[1].stop - r[1].start for r in ranges])
        e = self.surface.edges
        self.edge_rest: FloatArray = np.linalg.norm(self.rest_vertices[e[:, 1]] - self.rest_vertices[e[:, 0]], axis=1)
        structural = self.spring_kinds == STRUCTURAL
        self.mean_edge = float(self.spring_rest[structural].mean())
        self.vertex_areas: FloatArray = vertex_areas(self.rest_vertices, self.faces)
        self.arrays = ClothArrays(self.inverse_masses, self.spring_ends, self.spring_rest, self.spring_stiffness)

    @property
    def vertex_count(self) -> int:
        return len(self.masses)

    def safe_time_step(self) -> float:
        """Largest time step [s] for which symplectic Euler is provably stable for small strains.

        Gershgorin: w^2 <= max_i sum_j 2 k_ij / m_i; with viscous damping c the limit is (w dt)^2 < 4 - 2 c dt. [Vassilev
        2001, eq. 4] gives 0.4 pi sqrt(m/K), which lies above the true limit of its own scheme.
        """
        sums = np.bincount(self.spring_ends.ravel(), np.repeat(self.spring_stiffness, 2), minlength=self.vertex_count)
        square = float((2.0 * sums * self.inverse_masses).max())
        if square == 0.0:
            return math.inf
        c = self.damping
        return (-c + math.sqrt(c * c + 4.0 * square)) / square


def _springs(cloth: Cloth) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """Springs of one cloth: quads give structural, shear and flexion springs as in the paper, triangle meshes edges and
    the vertices opposite an edge."""
    material, mesh = materials.get(cloth.material), cloth.mesh
    if mesh.quads is not None:
        groups = [
            (
                STRUCTURAL,
                material.stretch,
                _unique(np.concatenate([mesh.quads[:, [i, (i + 1) % 4]] for i in range(4)])),
            ),
            (SHEAR, material.shear, _unique(np.concatenate([mesh.quads[:, [0, 2]], mesh.quads[:, [1, 3]]]))),
            (FLEXION, material.flexion, _skip_one(mesh.quads)),
        ]
    else:
        surface = Surface(mesh.faces, len(mesh.vertices))
        groups = [
            (STRUCTURAL, material.stretch, surface.edges),
            (FLEXION, material.flexion, _opposite(surface)),
        ]
    ends, rests, stiffness, kinds = [], [], [], []
    for kind, k, pairs in groups:
        if k == 0.0 or len(pairs) == 0:
            continue
        rest = np.linalg.norm(cloth.rest[pairs[:, 1]] - cloth.rest[pairs[:, 0]], axis=1)
        proper = rest > 0.0
        ends.append(pairs[proper])
        rests.append(rest[proper])
        stiffness.append(np.full(int(proper.sum()), float(k)))
        kinds.append(np.full(int(proper.sum()), kind))
    return np.concatenate(ends), np.concatenate(rests), np.concatenate(stiffness), np.concatenate(kinds)


def _unique(pairs: IntArray) -> IntArray:
    """Each undirected pair once, sorted."""
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _skip_one(quads: IntArray) -> IntArray:
    """Pairs of vertices two steps apart along a grid line: a-b in one quad, b-c in the next across the edge at b."""
    sides: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for quad in quads.tolist():
        for i in range(4):
            before, a, b, after = quad[i - 1], quad[i], quad[(i + 1) % 4], quad[(i + 2) % 4]
            key, ends = ((a, b), (before, after)) if a < b else ((b, a), (after, before))
            sides.setdefault(key, []).append(ends)
    pairs = [
        (one[k], two[k]) for across in sides.values() if len(across) == 2 for one, two in [across] for k in range(2)
    ]
    return _unique(np.asarray(pairs, np.int32)) if pairs else np.zeros((0, 2), np.int32)


def _opposite(surface: Surface) -> IntArray:
    """Pairs of vertices opposite an edge that two faces share."""
    two = np.flatnonzero(surface.edge_face_count == 2)
    if len(two) == 0:
        return np.zeros((0, 2), np.int32)
    first = surface.faces[surface.edge_face_ids[surface.edge_face_start[two]]]
    second = surface.faces[surface.edge_face_ids[surface.edge_face_start[two] + 1]]
    sums = surface.edges[two].sum(axis=1)
    pairs = np.stack([first.sum(axis=1) - sums, second.sum(axis=1) - sums], axis=1)
    return _unique(pairs[pairs[:, 0] != pairs[:, 1]])
