"""Arrays of the elastic energies of one cloth: springs, membrane triangles, bending patches."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from clothgym import materials
from clothgym.arrays import FloatArray, IntArray
from clothgym.fidelity import Fidelity
from clothgym.kernels.bending import NO_HINGES, NO_QUADRATIC, HingeArrays, QuadraticArrays
from clothgym.kernels.membrane import NO_MEMBRANE, MembraneArrays
from clothgym.kernels.springs import ClothArrays
from clothgym.materials import Material
from clothgym.mesh import Surface
from clothgym.rest import RestShape
from clothgym.scene import Cloth

STRUCTURAL, SHEAR, FLEXION = 0, 1, 2
_LEAST_SINGULAR = 0.1
"""Of the angles of a patch as functions of its curvatures; below, the six vertices lie nearly on one conic, and the
curvature that they do not tell is taken as the least one."""


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
        patches = Patches(rest_shape, surface)
        bending = patches.quadratic(material)
        if fidelity.bending == "hinge":
            hinges = patches.hinges(material)
        else:
            quadratic = bending
    sums = _row_sums(rest_shape.count, springs, membrane, bending)
    return Energies(springs, membrane, hinges, quadratic, sums)


def joined(parts: list[Energies], offsets: list[int], inverse_masses: FloatArray) -> tuple[ClothArrays, IntArray]:
    """Energies of all cloths as one, vertex ids moved by the offsets; and the kind of each spring."""

    def ids(arrays: list[IntArray]) -> IntArray:
        moved = [a + o for a, o in zip(arrays, offsets, strict=True)]
        return np.ascontiguousarray(np.concatenate(moved), np.int32)

    def all_of(arrays: list[FloatArray]) -> FloatArray:
        return np.ascontiguousarray(np.concatenate(arrays))

    arrays = ClothArrays(
        inverse_masses,
        ids([e.springs.ends for e in parts]),
        all_of([e.springs.rest for e in parts]),
        all_of([e.springs.stiffness for e in parts]),
        MembraneArrays(
            ids([e.membrane.faces for e in parts]),
            all_of([e.membrane.shape for e in parts]),
            all_of([e.membrane.stiffness for e in parts]),
        ),
        HingeArrays(
            ids([e.hinges.stencils for e in parts]),
            all_of([e.hinges.stiffness for e in parts]),
            all_of([e.hinges.rest for e in parts]),
        ),
        QuadraticArrays(ids([e.quadratic.stencils for e in parts]), all_of([e.quadratic.weights for e in parts])),
    )
    return arrays, np.concatenate([e.springs.kinds for e in parts])


# ---------------------------------------------------------------------------------------------------------------
# springs


def structural_pairs(cloth: Cloth, rest_shape: RestShape, surface: Surface) -> tuple[IntArray, FloatArray]:
    """Ends (P, 2) and rest lengths (P,) [m] of structural springs: sides of quads, or edges of triangles."""
    quads = cloth.mesh.quads
    if quads is None:
        return surface.edges, rest_shape.edge_lengths(surface)
    pairs = _unique(np.concatenate([quads[:, [i, (i + 1) % 4]] for i in range(4)]))
    return pairs, rest_shape.pair_lengths(pairs)


def _springs(cloth: Cloth, rest_shape: RestShape, surface: Surface, kinds: list[int]) -> Springs:
    """Springs of one cloth: quads give structural, shear and flexion springs as in the paper, triangle meshes edges and
    the vertices opposite an edge."""
    material, quads = materials.get(cloth.material), cloth.mesh.quads
    constants = {STRUCTURAL: material.stretch, SHEAR: material.shear, FLEXION: material.flexion}
    parts = [Springs(np.zeros((0, 2), np.int32), np.zeros(0), np.zeros(0), np.zeros(0, int))]
    for kind in kinds:
        k = constants[kind]
        if k == 0.0 or (quads is None and kind == SHEAR):
            continue
        if kind == STRUCTURAL:
            pairs, rest = structural_pairs(cloth, rest_shape, surface)
        elif quads is None:
            pairs, rest = rest_shape.opposite_lengths(surface)
        else:
            pairs = _unique(np.concatenate([quads[:, [0, 2]], quads[:, [1, 3]]])) if kind == SHEAR else _skip_one(quads)
            rest = rest_shape.pair_lengths(pairs)
        proper = rest > 0.0
        count = int(proper.sum())
        parts.append(Springs(pairs[proper], rest[proper], np.full(count, float(k)), np.full(count, kind)))
    return Springs(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


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


# ---------------------------------------------------------------------------------------------------------------
# triangles with weft and warp


def flat_corners(corners: FloatArray) -> FloatArray:
    """(F, 3, 2) corners of faces (F, 3, 3) along weft and warp [m].

    The weft runs along the x axis of the rest shape, which is the first axis of a panel's plane, laid onto the face (of
    faces that stand across it, the z axis); the warp lies in the face at a right angle to it.
    """
    e, f = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e, f)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    weft = np.array([1.0, 0.0, 0.0]) - normal * normal[:, :1]
    across = np.linalg.norm(weft, axis=1) < 1e-3
    weft[across] = np.array([0.0, 0.0, 1.0]) - normal[across] * normal[across, 2:]
    weft /= np.maximum(np.linalg.norm(weft, axis=1, keepdims=True), 1e-300)
    warp = np.cross(normal, weft)
    from_first = corners - corners[:, :1]
    return np.stack([np.einsum("fci,fi->fc", from_first, axis) for axis in (weft, warp)], axis=2)


def proper_faces(rest_shape: RestShape) -> FloatArray:
    """(F,) bool: faces of the rest shape with an area, beyond rounding errors."""
    sides = rest_shape.corners - np.roll(rest_shape.corners, 1, axis=1)
    return rest_shape.face_areas > 1e-10 * (sides * sides).sum(axis=(1, 2))


def membrane_arrays(rest_shape: RestShape, material: Material) -> MembraneArrays:
    """Membrane triangles of all faces with an area at rest."""
    proper = np.flatnonzero(proper_faces(rest_shape))
    flat = flat_corners(rest_shape.corners[proper])
    (p, q), (r, s) = flat[:, 1].T, flat[:, 2].T
    det = p * s - q * r
    shape = np.stack([s / det, -q / det, -r / det, p / det], axis=1)
    moduli = np.array(material.moduli)
    return MembraneArrays(rest_shape.faces[proper], shape, rest_shape.face_areas[proper, None] * moduli)


class Patches:
    """Every face with the faces across its edges, laid into its plane.

    Attributes:
        stencils: (N, 6) int32, see `kernels.bending.HingeArrays`.
        jumps: (N, 3, 6) [1/m]: applied to heights, the angles of the three hinges; zero rows for what is no hinge.
        curvatures: (N, 3, 3) [1/m]: applied to the angles, (k_uu, k_vv, 2^(1/2) k_uv).
        areas: (N,) [m^2].
        angles: (N, 3) of the rest shape [rad].
    """

    def __init__(self, rest_shape: RestShape, surface: Surface) -> None:
        proper = proper_faces(rest_shape)[surface.face_ids]
        own = np.flatnonzero(proper)
        triangles, count = surface.faces[own], len(own)
        self.areas: FloatArray = rest_shape.face_areas[surface.face_ids[own]]
        self.stencils: IntArray = np.repeat(triangles[:, :1], 6, axis=1)
        self.stencils[:, :3] = triangles
        flat = flat_corners(rest_shape.corners[surface.face_ids[own]])
        points = np.concatenate([flat, np.zeros_like(flat)], axis=1)
        self.jumps: FloatArray = np.zeros((count, 3, 6))
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            edges = surface.face_edges[own, i]
            start = surface.edge_face_start[edges]
            two = surface.edge_face_start[edges + 1] - start == 2
            pair = surface.edge_face_ids[np.stack([start, start + two], axis=1)]
            other = np.where(pair[:, 0] == own, pair[:, 1], pair[:, 0])
            across = surface.faces[other].sum(axis=1) - triangles[:, i] - triangles[:, j]
            there = np.flatnonzero(two & proper[other] & (across != triangles[:, k]))
            self.stencils[there, 3 + i] = across[there]
            laid = rest_shape.laid_out(surface, other[there], triangles[there][:, [i, j]])
            a, b, c = points[there, i], points[there, j], points[there, k]
            edge = b - a
            size = np.linalg.norm(edge, axis=1)
            e = edge / size[:, None]
            share = ((c - a) * e).sum(axis=1)
            height = 2.0 * self.areas[there] / size
            outward = -((c - a) - share[:, None] * e) / height[:, None]
            points[there, 3 + i] = 0.5 * (a + b) + laid[:, :1] * e + laid[:, 1:] * outward
            tc, td = share / size, laid[:, 0] / size + 0.5
            self.jumps[there, i, i] = -(1.0 - tc) / height - (1.0 - td) / laid[:, 1]
            self.jumps[there, i, j] = -tc / height - td / laid[:, 1]
            self.jumps[there, i, k] = 1.0 / height
            self.jumps[there, i, 3 + i] = 1.0 / laid[:, 1]
        x, y = points[:, :, 0], points[:, :, 1]
        heights = np.stack([0.5 * x * x, 0.5 * y * y, np.sqrt(0.5) * x * y], axis=2)
        rows = self.jumps @ heights
        sizes = np.linalg.norm(rows, axis=2, keepdims=True)
        sizes[sizes == 0.0] = 1.0
        inverse = np.linalg.pinv(rows / sizes, rcond=_LEAST_SINGULAR) if count else rows
        hinge = self.jumps.any(axis=2)[:, None, :]
        self.curvatures: FloatArray = np.where(hinge, inverse / sizes.transpose(0, 2, 1), 0.0)
        self.angles: FloatArray = np.zeros((count, 3))
        if rest_shape.places is not None:
            self.angles = _angles(rest_shape.places[self.stencils]) * self.jumps.any(axis=2)

    def _rigidity(self, material: Material) -> FloatArray:
        """(N, 3) [N m^3] for the squares of the three curvatures."""
        weft, warp = material.bending, material.bending_along_warp
        return self.areas[:, None] * np.array([weft, warp, np.sqrt(weft * warp)])

    def hinges(self, material: Material) -> HingeArrays:
        """Arrays of `bending` = "hinge"."""
        p = self.curvatures
        q = np.einsum("nai,na,naj->nij", p, self._rigidity(material), p)
        return HingeArrays(
            self.stencils, np.ascontiguousarray(q[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]), self.angles
        )

    def quadratic(self, material: Material) -> QuadraticArrays:
        """Arrays of `bending` = "quadratic", which is flat at rest."""
        weights = np.sqrt(self._rigidity(material))[:, :, None] * (self.curvatures @ self.jumps)
        return QuadraticArrays(self.stencils, np.ascontiguousarray(weights))


def _angles(x: FloatArray) -> FloatArray:
    """(N, 3) hinge angles [rad] of patches (N, 6, 3), signed as in `kernels.bending.hinge_angle`."""
    found = np.zeros((len(x), 3))
    for i in range(3):
        a, b, c, d = (x[:, k] for k in (i, (i + 1) % 3, (i + 2) % 3, 3 + i))
        n, m = np.cross(b - a, c - a), np.cross(d - a, b - a)
        size = np.maximum(np.linalg.norm(b - a, axis=1), 1e-300)
        found[:, i] = np.arctan2((np.cross(m, n) * (b - a)).sum(axis=1) / size, (n * m).sum(axis=1))
    return found


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
    return sums
