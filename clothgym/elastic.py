"""Arrays of the elastic energies of one cloth: springs, membrane triangles, bending patches."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from clothgym import materials
from clothgym.arrays import LEAST_EDGE, FloatArray, IntArray
from clothgym.batches import by_colour
from clothgym.bending import BendingPatches, flat_corners, proper_faces
from clothgym.fidelity import Fidelity
from clothgym.kernels.bending import NO_HINGES, NO_QUADRATIC, HingeArrays, QuadraticArrays
from clothgym.kernels.membrane import NO_MEMBRANE, MembraneArrays
from clothgym.kernels.springs import ClothArrays
from clothgym.materials import Material
from clothgym.mesh import Surface
from clothgym.rest import RestShape
from clothgym.scene import Cloth

STRUCTURAL, SHEAR, FLEXION = 0, 1, 2


class Springs(NamedTuple):
    """Springs of a cloth."""

    ends: IntArray  # (S, 2)
    rest: FloatArray  # (S,) [m]
    stiffness: FloatArray  # (S,) [N/m]
    kinds: IntArray  # (S,) STRUCTURAL, SHEAR or FLEXION


class Energies(NamedTuple):
    """What a cloth is made of at a fidelity; what is absent has length 0."""

    springs: Springs
    membrane: MembraneArrays
    hinges: HingeArrays
    quadratic: QuadraticArrays
    row_sums: FloatArray  # (V,) [N/m]: bound of sum_j |d^2 E / dx_i dx_j| at small strains


def energies(cloth: Cloth, rest_shape: RestShape, surface: Surface, fidelity: Fidelity) -> Energies:
    """Arrays of one cloth, with its own vertex ids."""
    material = materials.get(cloth.material)
    kinds = []
    if fidelity.membrane == "springs":
        kinds += [STRUCTURAL, SHEAR]
    if fidelity.bending == "flexion":
        kinds += [FLEXION]
    springs = _springs(cloth, rest_shape, surface, kinds)
    membrane, hinges, quadratic, bending = NO_MEMBRANE, NO_HINGES, NO_QUADRATIC, NO_QUADRATIC
    if fidelity.membrane == "continuum":
        membrane = membrane_arrays(rest_shape, material)
    if fidelity.bending in ("hinge", "quadratic") and material.bending > 0.0:
        patches = BendingPatches(rest_shape, surface)
        bending = patches.quadratic_arrays(material)
        if fidelity.bending == "hinge":
            hinges = patches.hinge_arrays(material)
        else:
            quadratic = bending
    sums = _row_sums(rest_shape.count, springs, membrane, bending)
    return Energies(springs, membrane, hinges, quadratic, sums)


def joined(parts: list[Energies], offsets: list[int], inverse_masses: FloatArray) -> tuple[ClothArrays, IntArray]:
    """Energies of all cloths as one, vertex ids moved by the offsets; and the kind of each spring."""

    def ids(arrays: list[IntArray], starts: list[int] = offsets) -> IntArray:
        moved = [a + start for a, start in zip(arrays, starts, strict=True)]
        return np.ascontiguousarray(np.concatenate(moved), np.int32)

    def all_of(arrays: list[Any]) -> Any:
        return np.ascontiguousarray(np.concatenate(arrays))

    hinge_offsets = np.cumsum([0] + [len(e.hinges.vertices) for e in parts[:-1]]).tolist()
    ends = ids([e.springs.ends for e in parts])
    order = by_colour(ends, len(inverse_masses))  # springs that stand together do not wait for each other
    arrays = ClothArrays(
        inverse_masses,
        np.ascontiguousarray(ends[order]),
        all_of([e.springs.rest for e in parts])[order],
        all_of([e.springs.stiffness for e in parts])[order],
        MembraneArrays(
            ids([e.membrane.faces for e in parts]),
            all_of([e.membrane.shape for e in parts]),
            all_of([e.membrane.stiffness for e in parts]),
        ),
        HingeArrays(
            ids([e.hinges.vertices for e in parts]),
            all_of([e.hinges.rest for e in parts]),
            ids([e.hinges.stencils for e in parts]),
            ids([e.hinges.hinges for e in parts], hinge_offsets),
            all_of([e.hinges.local for e in parts]),
            all_of([e.hinges.weights for e in parts]),
            all_of([e.hinges.reach for e in parts]),
        ),
        QuadraticArrays(
            ids([e.quadratic.stencils for e in parts]),
            all_of([e.quadratic.weights for e in parts]),
            all_of([e.quadratic.reach for e in parts]),
        ),
    )
    arrays = arrays._replace(
        has_membrane=True if len(arrays.membrane.faces) else None,
        has_hinges=True if len(arrays.hinges.stencils) else None,
        has_quadratic=True if len(arrays.quadratic.stencils) else None,
    )
    return arrays, np.concatenate([e.springs.kinds for e in parts])[order]


# ---------------------------------------------------------------------------------------------------------------
# springs


def structural_pairs(cloth: Cloth, rest_shape: RestShape, surface: Surface) -> tuple[IntArray, FloatArray]:
    """Ends (P, 2) and rest lengths (P,) [m] of structural springs: sides of quads, or edges of triangles."""
    quads = cloth.mesh.quads
    if quads is None:
        return surface.edges, rest_shape.edge_lengths(surface)
    pairs = _unique(np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)]))
    return pairs, rest_shape.pair_lengths(pairs, surface)


def _springs(cloth: Cloth, rest_shape: RestShape, surface: Surface, kinds: list[int]) -> Springs:
    """Springs of one cloth: quads give structural, shear and flexion springs as in the paper, triangle meshes edges and
    the vertices opposite an edge."""
    material, quads = materials.get(cloth.material), cloth.mesh.quads
    constants = {STRUCTURAL: material.stretch, SHEAR: material.shear, FLEXION: material.flexion}
    parts = [Springs(np.zeros((0, 2), np.int32), np.zeros(0), np.zeros(0), np.zeros(0, int))]
    # shorter ones are vertices that all but coincide
    least = LEAST_EDGE * float(rest_shape.edge_lengths(surface).mean())
    for kind in kinds:
        k = constants[kind]
        if k == 0.0 or (quads is None and kind == SHEAR):
            continue
        if kind == STRUCTURAL:
            pairs, rest = structural_pairs(cloth, rest_shape, surface)
        elif quads is None:
            pairs, rest = rest_shape.opposite_lengths(surface)
        elif kind == SHEAR:
            pairs = _unique(np.concatenate([quads[:, [0, 2]], quads[:, [1, 3]]]))
            rest = rest_shape.pair_lengths(pairs, surface)
        else:
            pairs, middles = _skip_one(quads)
            rest = rest_shape.bent_lengths(pairs, middles, surface)
        proper = rest > least
        count = int(proper.sum())
        parts.append(Springs(pairs[proper], rest[proper], np.full(count, float(k)), np.full(count, kind)))
    return Springs(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _unique(pairs: IntArray) -> IntArray:
    """Each undirected pair once, sorted."""
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _skip_one(quads: IntArray) -> tuple[IntArray, IntArray]:
    """Pairs (P, 2) of vertices two steps apart along a grid line, a-b in one quad and b-c in the next across the edge at
    b, and the vertex b (P,) between them."""
    # each side of each quad: its ends, and beyond each of them the next corner
    ends = np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)]).astype(np.int64)
    beyond = np.concatenate([quads[:, [i - 1, (i + 2) % 4]] for i in range(4)])
    falling = ends[:, 0] > ends[:, 1]
    ends[falling], beyond[falling] = ends[falling][:, ::-1], beyond[falling][:, ::-1]
    _, side, count = np.unique(
        ends[:, 0] * (int(quads.max(initial=0)) + 1) + ends[:, 1], return_inverse=True, return_counts=True
    )
    order = np.argsort(side, kind="stable")
    start = (np.cumsum(count) - count)[count == 2]
    one, two = order[start], order[start + 1]
    across = np.sort(np.stack([beyond[one].ravel(), beyond[two].ravel()], axis=1), axis=1)
    pairs, first = np.unique(across, axis=0, return_index=True)
    proper = pairs[:, 0] != pairs[:, 1]  # a panel sewn to itself beside a fold
    return np.asarray(pairs[proper], np.int32), np.asarray(ends[one].ravel()[first][proper], np.int32)


# ---------------------------------------------------------------------------------------------------------------
# membrane


def membrane_arrays(rest_shape: RestShape, material: Material) -> MembraneArrays:
    """Membrane triangles of all faces with an area at rest."""
    proper = np.flatnonzero(proper_faces(rest_shape))
    flat = flat_corners(rest_shape.corners[proper])
    (p, q), (r, s) = flat[:, 1].T, flat[:, 2].T
    det = p * s - q * r
    shape = np.stack([s / det, -q / det, -r / det, p / det], axis=1)
    moduli = np.array(material.moduli)
    return MembraneArrays(rest_shape.faces[proper], shape, rest_shape.face_areas[proper, None] * moduli)


# ---------------------------------------------------------------------------------------------------------------
# what the stiffness allows


def _row_sums(count: int, springs: Springs, membrane: MembraneArrays, bending: QuadraticArrays) -> FloatArray:
    """(V,) [N/m]: for each vertex, a bound of sum_j |d^2 E / dx_i dx_j| at small strains.

    Springs: 2 k each. Membrane: in the plane the blocks at rest, across it those of fibres stretched without limit.
    Bending: the blocks of the flat patch, which hinges and quadratic bending share.
    """
    sums = 2.0 * np.bincount(springs.ends.ravel(), np.repeat(springs.stiffness, 2), minlength=count)
    if len(membrane.faces):
        s, k = membrane.shape, membrane.stiffness
        u = np.stack([-s[:, 0] - s[:, 1], s[:, 0], s[:, 1]], axis=1)
        v = np.stack([-s[:, 2] - s[:, 3], s[:, 2], s[:, 3]], axis=1)
        uu, vv, uv = (a[:, :, None] * b[:, None, :] for a, b in ((u, u), (v, v), (u, v)))
        vu = uv.transpose(0, 2, 1)
        c11, c12, c22, c33 = (k[:, n, None, None] for n in range(4))
        plane = np.stack([c11 * uu + c33 * vv, c12 * uv + c33 * vu, c12 * vu + c33 * uv, c22 * vv + c33 * uu], axis=-1)
        norms = np.linalg.norm(plane.reshape(*plane.shape[:3], 2, 2), ord=2, axis=(3, 4))
        norms = np.maximum(norms, np.abs(c11 * uu + c22 * vv))
        sums = sums + np.bincount(membrane.faces.ravel(), norms.sum(axis=2).ravel(), minlength=count)
    if len(bending.stencils):
        norms = np.abs(bending.weights.transpose(0, 2, 1) @ bending.weights)
        sums = sums + np.bincount(bending.stencils.ravel(), norms.sum(axis=2).ravel(), minlength=count)
    return np.asarray(sums, np.float64)
