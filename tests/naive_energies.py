"""Slow, obvious references for membrane and bending: energies that take complex coordinates, meshes, a static solver."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

import clothgym as cg
from clothgym.kernels import bending, elastic, membrane
from clothgym.model import ClothModel

# ---------------------------------------------------------------------------------------------------------------
# meshes of a rectangle in the x-z plane


def one_way(width: float, height: float, columns: int, rows: int) -> cg.Mesh:
    """A grid with all diagonals alike."""
    mesh = cg.grid(width, height, columns, rows)
    q = mesh.quads
    return cg.Mesh(mesh.vertices, np.concatenate([q[:, [0, 1, 2]], q[:, [0, 2, 3]]]).astype(np.int32))


def other_way(width: float, height: float, columns: int, rows: int) -> cg.Mesh:
    """A grid with all diagonals the other way."""
    mesh = cg.grid(width, height, columns, rows)
    q = mesh.quads
    return cg.Mesh(mesh.vertices, np.concatenate([q[:, [0, 1, 3]], q[:, [1, 2, 3]]]).astype(np.int32))


def alternating(width: float, height: float, columns: int, rows: int) -> cg.Mesh:
    """The library's grid as triangles."""
    mesh = cg.grid(width, height, columns, rows)
    return cg.Mesh(mesh.vertices, mesh.faces)


def irregular(width: float, height: float, columns: int, rows: int, straight: int = 1) -> cg.Mesh:
    """Delaunay triangles of a shaken grid; its first `straight` columns, its last one and its border stay in place."""
    mesh = cg.grid(width, height, columns, rows)
    v, rng = mesh.vertices.copy(), np.random.default_rng(5)
    column, row = np.tile(np.arange(columns + 1), rows + 1), np.repeat(np.arange(rows + 1), columns + 1)
    inside = (column >= straight) & (column < columns) & (row > 0) & (row < rows)
    shake = 0.3 * rng.uniform(-1.0, 1.0, v.shape) * [width / columns, 0.0, height / rows]
    v[inside] += shake[inside]
    faces = Delaunay(v[:, [0, 2]]).simplices
    u, w = (v[faces[:, k]] - v[faces[:, 0]] for k in (1, 2))
    area = 0.5 * np.abs(u[:, 0] * w[:, 2] - u[:, 2] * w[:, 0])
    return cg.Mesh(v, faces[area > 1e-6 * width * height / (columns * rows)].astype(np.int32))


MESHES = {"one way": one_way, "other way": other_way, "alternating": alternating, "irregular": irregular}


# ---------------------------------------------------------------------------------------------------------------
# energies


def _norm(a):
    """Length along the last axis, also of complex steps."""
    return np.sqrt((a * a).sum(axis=-1))


def membrane_energy(x, rest, faces, moduli):
    """A/2 (C11 e_u^2 + 2 C12 e_u e_v + C22 e_v^2 + C33 g^2) of triangles of a rest shape in the x-z plane, weft along x."""
    c11, c12, c22, c33 = moduli
    total = 0.0
    for a, b, c in faces:
        flat = np.stack([rest[b] - rest[a], rest[c] - rest[a]], axis=1)[[0, 2]]
        bent = np.stack([x[b] - x[a], x[c] - x[a]], axis=1)
        u, v = (bent @ np.linalg.inv(flat)).T
        e, f, g = _norm(u) - 1.0, _norm(v) - 1.0, u @ v
        area = 0.5 * abs(np.linalg.det(flat))
        total = total + 0.5 * area * (c11 * e * e + 2.0 * c12 * e * f + c22 * f * f + c33 * g * g)
    return total


def hinge_angles(x, vertices):
    """(H,) angles between the normals of triangles (a, b, c) and (b, a, d), signed; less than a right angle."""
    a, b, c, d = (x[vertices[:, k]] for k in range(4))
    n, m, e = np.cross(b - a, c - a), np.cross(d - a, b - a), b - a
    sine = (np.cross(m, n) * e).sum(axis=1) / _norm(e)
    return np.arctan(sine / (n * m).sum(axis=1))


def patch_curvatures(x, hinges):
    """(N, 3): what `kernels.bending` squares."""
    turned = hinge_angles(x, hinges.vertices) - hinges.rest
    return (hinges.weights * turned[hinges.hinges][:, None, :]).sum(axis=2)


def hinge_energy(x, hinges):
    return 0.5 * (patch_curvatures(x, hinges) ** 2).sum()


def quadratic_energy(x, quadratic):
    return 0.5 * (np.einsum("nap,npi->nai", quadratic.weights, x[quadratic.stencils]) ** 2).sum()


def complex_step(energy, x):
    """(V, 3) gradient of an energy that takes complex positions, exact to rounding."""
    gradient = np.zeros_like(x)
    for index in np.ndindex(*x.shape):
        stepped = x.astype(complex)
        stepped[index] += 1e-30j
        gradient[index] = energy(stepped).imag / 1e-30
    return gradient


# ---------------------------------------------------------------------------------------------------------------
# what the kernels say, in plain arrays


def energies(model: ClothModel, x) -> np.ndarray:
    """(3,) springs, membrane and bending [J]."""
    return np.array(elastic.elastic_energy(np.ascontiguousarray(x), model.arrays))


def forces(model: ClothModel, x) -> np.ndarray:
    """(V, 3) [N]."""
    f = np.zeros_like(x)
    elastic.elastic_forces(np.ascontiguousarray(x), model.arrays, f)
    return f


def blocks(model: ClothModel, x) -> dict:
    """Name -> (stencils (N, n), blocks (N, n, n, 3, 3)) of each energy that is there."""
    arrays, found = model.arrays, {}
    for name, stencils in (("springs", arrays.spring_ends), ("membrane", arrays.membrane.faces),
                           ("hinges", arrays.hinges.stencils), ("quadratic", arrays.quadratic.stencils)):  # fmt: skip
        n = stencils.shape[1]
        out = np.full((len(stencils), n, n, 3, 3), np.nan)
        if name == "springs":
            elastic.spring_hessian(x, arrays, out)
        elif name == "membrane":
            membrane.membrane_hessian(x, arrays, out)
        elif name == "hinges":
            bending.hinge_hessian(x, arrays, out)
        else:
            bending.quadratic_hessian(arrays, out)
        if len(stencils):
            found[name] = stencils, out
    return found


def dense(stencils, values) -> np.ndarray:
    """(N, 3 n, 3 n) of blocks (N, n, n, 3, 3)."""
    n = stencils.shape[1]
    return values.transpose(0, 1, 3, 2, 4).reshape(len(stencils), 3 * n, 3 * n)


def hessian(model: ClothModel, x) -> np.ndarray:
    """(3 V, 3 V) sum of all blocks."""
    total = np.zeros((x.size, x.size))
    for stencils, values in blocks(model, x).values():
        ids = (3 * stencils[:, :, None] + np.arange(3)).reshape(len(stencils), -1)
        np.add.at(total, (ids[:, :, None], ids[:, None, :]), dense(stencils, values))
    return total


def differences(model: ClothModel, x, h: float = 1e-6) -> np.ndarray:
    """(3 V, 3 V) second derivatives of the energy, from central differences of the forces."""
    columns = []
    for k in range(x.size):
        step = np.zeros(x.size)
        step[k] = h
        step = step.reshape(x.shape)
        columns.append((forces(model, x - step) - forces(model, x + step)).ravel() / (2.0 * h))
    return np.stack(columns, axis=1)


def at_rest(model: ClothModel, x, load, tolerance: float = 1e-9, most: int = 200) -> np.ndarray:
    """Positions of least energy under constant forces (V, 3) [N], pins held: Newton steps with damping."""
    free = np.repeat(model.inverse_masses > 0.0, 3)
    x, shift = x.copy(), 1e-4

    def energy(y):
        return energies(model, y).sum() - (load * y).sum()

    for _ in range(most):
        residual = (forces(model, x) + load).ravel()[free]
        if np.abs(residual).max() < tolerance:
            return x
        matrix = hessian(model, x)[np.ix_(free, free)]
        before, size = energy(x), np.trace(matrix) / len(matrix)
        while True:
            y = x.copy()
            y.reshape(-1)[free] += np.linalg.solve(matrix + shift * size * np.eye(len(matrix)), residual)
            if energy(y) <= before + 1e-15 * abs(before):
                break
            shift *= 4.0
        x, shift = y, max(0.2 * shift, 1e-13)
    raise AssertionError(f"no equilibrium: {np.abs(residual).max():.3g} N are left")
