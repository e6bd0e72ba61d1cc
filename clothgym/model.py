"""The model: immutable arrays built from a scene."""

from __future__ import annotations

import math

import numpy as np

from clothgym import elastic, materials
from clothgym.arrays import FARTHEST, LEAST_EDGE, FloatArray, IntArray
from clothgym.elastic import FLEXION, SHEAR, STRUCTURAL
from clothgym.fidelity import Fidelity
from clothgym.mesh import Surface
from clothgym.rest import RestShape
from clothgym.scene import Scene

__all__ = ["FLEXION", "SHEAR", "STRUCTURAL", "ClothModel"]


class ClothModel:
    """All cloths of a scene as one set of arrays; constant while a simulation lives.

    Args:
        scene: what exists.
        fidelity: whose membrane and bending the cloths have; default: springs, as the paper.

    Attributes:
        surface: topology of all cloths together.
        masses: (V,) [kg]; inverse_masses: (V,) 0 = pinned.
        springs: ends (S, 2), rest lengths (S,) [m], stiffness (S,) [N/m], kinds (S,); sorted by colour, see `batches`.
        arrays: all energies, as the kernels read them; what the fidelity leaves out has length 0.
        constraint_count: multipliers of an XPBD substep.
        edge_rest: (E,) rest length of every mesh edge [m]; mean_edge: mean over the edges that a structural spring
            stands for.
        thickness: (V,) contact distance [m], never more than half the least altitude of the triangles around.
        friction, damping: mean over the cloths (one value acts on all of them).
        ranges: (name, vertex slice, face slice) of each cloth.
        cloth_of_vertex: (V,) number of its cloth.
    """

    def __init__(self, scene: Scene, fidelity: Fidelity | None = None) -> None:
        self.scene = scene
        fidelity = fidelity or Fidelity()
        faces, masses, energies, thickness, friction, damping = ([] for _ in range(6))
        edge_rest, structural, vertex_areas = [], [], []
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
            edge_rest.append(_proper_lengths(rest_shape.edge_lengths(surface), cloth.name))
            energies.append(elastic.energies(cloth, rest_shape, surface, fidelity))
            lengths = elastic.structural_pairs(cloth, rest_shape, surface)[1]
            structural.append(lengths[lengths > 0.0])
            vertex_areas.append(areas)
            faces.append(cloth.mesh.faces + offset)
            masses.append(mass)
            pinned.extend(offset + pin for pin in cloth.pins)
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
        self.arrays, self.spring_kinds = elastic.joined(
            energies, [vertices.start for _, vertices, _ in ranges], self.inverse_masses
        )
        self.spring_ends: IntArray = self.arrays.spring_ends
        self.spring_rest: FloatArray = self.arrays.spring_rest
        self.spring_stiffness: FloatArray = self.arrays.spring_stiffness
        self.row_sums: FloatArray = np.concatenate([e.row_sums for e in energies])
        self.thickness: FloatArray = np.ascontiguousarray(np.concatenate(thickness))
        self.friction = float(np.mean(friction))
        self.damping = float(np.mean(damping))
        self.ranges: list[tuple[str, slice, slice]] = ranges
        self.cloth_of_vertex = np.repeat(np.arange(len(ranges)), [r[1].stop - r[1].start for r in ranges])
        # edges are sorted by their ends, so those of all cloths stand one cloth after the other
        self.edge_rest: FloatArray = np.concatenate(edge_rest)
        self.mean_edge = float(np.concatenate(structural).mean())
        self.vertex_areas: FloatArray = np.concatenate(vertex_areas)

    @property
    def vertex_count(self) -> int:
        return len(self.masses)

    @property
    def constraint_count(self) -> int:
        a = self.arrays
        patches = 3 * len(a.hinges.stencils) + 9 * len(a.quadratic.stencils)
        return len(a.spring_ends) + 3 * len(a.membrane.faces) + patches

    def safe_time_step(self) -> float:
        """Largest time step [s] for which symplectic Euler is provably stable for small strains.

        Gershgorin: w^2 <= max_i sum_j |d^2 E / dx_i dx_j| / m_i, for springs max_i sum_j 2 k_ij / m_i; with viscous
        damping c the limit is (w dt)^2 < 4 - 2 c dt. [Vassilev 2001, eq. 4] gives 0.4 pi sqrt(m/K), which lies above the
        true limit of its own scheme.
        """
        square = float((self.row_sums * self.inverse_masses).max())
        if square == 0.0:
            return math.inf
        c = self.damping
        return (-c + math.sqrt(c * c + 4.0 * square)) / square


def _proper_lengths(lengths: FloatArray, name: str) -> FloatArray:
    """Rest lengths (E,) [m], 0 where vertices all but coincide: a strain by so small a length says nothing.

    Raises:
        ValueError: the cloth is smaller than numbers can tell.
    """
    mean = float(lengths.mean())
    if not mean >= LEAST_EDGE:
        raise ValueError(f"cloth {name!r}: rest: mean edge = {mean:g} m: out of range [{LEAST_EDGE:g}, {FARTHEST:g}]")
    return np.where(lengths > LEAST_EDGE * mean, lengths, 0.0)
