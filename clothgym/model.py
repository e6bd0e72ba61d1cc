"""The model: immutable arrays built from a scene."""

from __future__ import annotations

import math

import numpy as np

from clothgym import materials
from clothgym.arrays import FloatArray, IntArray
from clothgym.batches import by_colour
from clothgym.kernels.springs import ClothArrays
from clothgym.mesh import Surface
from clothgym.rest import RestShape
from clothgym.scene import Cloth, Scene

STRUCTURAL, SHEAR, FLEXION = 0, 1, 2


class ClothModel:
    """All cloths of a scene as one set of arrays; constant while a simulation lives.

    Attributes:
        surface: topology of all cloths together.
        masses: (V,) [kg]; inverse_masses: (V,) 0 = pinned.
        springs: ends (S, 2), rest lengths (S,) [m], stiffness (S,) [N/m], kinds (S,); sorted by colour, see `batches`.
        edge_rest: (E,) rest length of every mesh edge [m]; mean_edge their mean.
        thickness: (V,) contact distance [m], never more than half the least altitude of the triangles around.
        friction, damping: mean over the cloths (one value acts on all of them).
        ranges: (name, vertex slice, face slice) of each cloth.
        cloth_of_vertex: (V,) number of its cloth.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        faces, masses, ends, rest, stiffness, kinds, thickness, friction, damping = ([] for _ in range(9))
        edge_rest, vertex_areas = [], []
        ranges, offset, face_offset = [], 0, 0
        pinned: list[int] = []
        for cloth in scene.cloths:
            material = materials.get(cloth.material)
            count = len(cloth.mesh.vertices)
            rest_shape = RestShape(cloth.mesh, cloth.rest)
            areas = rest_shape.vertex_areas
            if not (areas > 0).any():
                raise ValueError(f"cloth {cloth.name!r}: every triangle of the rest shape has zero area")
            mass = areas * material.density
            if cloth.equal_masses:
                mass = np.full(count, areas.sum() * material.density / count)
            # a vertex that no triangle gives mass to must not be infinitely light
            mass = np.maximum(mass, 1e-6 * mass.max())
            surface = Surface(cloth.mesh.faces, count)
            spring_ends, spring_rest, spring_stiffness, spring_kinds = _springs(cloth, rest_shape, surface)
            edge_rest.append(rest_shape.edge_lengths(surface))
            vertex_areas.append(areas)
            faces.append(cloth.mesh.faces + offset)
            masses.append(mass)
            pinned.extend(offset + pin for pin in cloth.pins)
            ends.append(spring_ends + offset)
            rest.append(spring_rest)
            stiffness.append(spring_stiffness)
            kinds.append(spring_kinds)
            thickness.append(np.minimum(material.thickness, 0.5 * rest_shape.least_altitudes))
            friction.append(material.friction)
            damping.append(material.damping)
            ranges.append(
                (cloth.name, slice(offset, offset + count), slice(face_offset, face_offset + len(cloth.mesh.faces)))
            )
            offset += count
            face_offset += len(cloth.mesh.faces)
        self.faces: IntArray = np.ascontiguousarray(np.concatenate(faces), np.int32)
        self.surface = Surface(self.faces, offset)
        self.masses: FloatArray = np.concatenate(masses)
        self.inverse_masses = 1.0 / self.masses
        self.inverse_masses[pinned] = 0.0
        all_ends = np.ascontiguousarray(np.concatenate(ends), np.int32)
        order = by_colour(all_ends, offset)  # springs that stand together do not wait for each other
        self.spring_ends: IntArray = np.ascontiguousarray(all_ends[order])
        self.spring_rest: FloatArray = np.concatenate(rest)[order]
        self.spring_stiffness: FloatArray = np.concatenate(stiffness)[order]
        self.spring_kinds: IntArray = np.concatenate(kinds)[order]
        self.thickness: FloatArray = np.ascontiguousarray(np.concatenate(thickness))
        self.friction = float(np.mean(friction))
        self.damping = float(np.mean(damping))
        self.ranges: list[tuple[str, slice, slice]] = ranges
        self.cloth_of_vertex = np.repeat(np.arange(len(ranges)), [r[1].stop - r[1].start for r in ranges])
        # edges are sorted by their ends, so those of all cloths stand one cloth after the other
        self.edge_rest: FloatArray = np.concatenate(edge_rest)
        structural = self.spring_kinds == STRUCTURAL
        self.mean_edge = float(self.spring_rest[structural].mean())
        self.vertex_areas: FloatArray = np.concatenate(vertex_areas)
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


def _springs(
    cloth: Cloth, rest_shape: RestShape, surface: Surface
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """Springs of one cloth: quads give structural, shear and flexion springs as in the paper, triangle meshes edges and
    the vertices opposite an edge."""
    material, quads = materials.get(cloth.material), cloth.mesh.quads
    if quads is not None:
        kinds_pairs = (
            (STRUCTURAL, _unique(np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)]))),
            (SHEAR, _unique(np.concatenate([quads[:, [0, 2]], quads[:, [1, 3]]]))),
            (FLEXION, _skip_one(quads)),
        )
        groups = [(kind, pairs, rest_shape.pair_lengths(pairs)) for kind, pairs in kinds_pairs]
    else:
        groups = [
            (STRUCTURAL, surface.edges, rest_shape.edge_lengths(surface)),
            (FLEXION, *rest_shape.opposite_lengths(surface)),
        ]
    constants = {STRUCTURAL: material.stretch, SHEAR: material.shear, FLEXION: material.flexion}
    ends, rests, stiffness, kinds = [], [], [], []
    for kind, pairs, rest in groups:
        k = constants[kind]
        if k == 0.0 or len(pairs) == 0:
            continue
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
