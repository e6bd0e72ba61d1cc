"""Membrane and bending energies: references, known answers, second derivatives, rest shapes, safe steps."""

from __future__ import annotations

import dataclasses

import naive_energies as naive
import numpy as np
import pytest
from energy_cases import FABRIC, KINDS, G, built, rolled, rotation, shaken

import clothgym as cg
from clothgym.bending import BendingPatches
from clothgym.kernels import bending, integrate
from clothgym.kernels.integrate import Grips, Ground, Motion
from clothgym.model import ClothModel
from clothgym.rest import RestShape


@pytest.fixture(params=naive.MESHES)
def make(request):
    return naive.MESHES[request.param]


# ---------------------------------------------------------------------------------------------------------------
# against references


def test_membrane_equals_the_naive_energy_and_its_complex_step(make):
    mesh = make(1.0, 0.8, 4, 3)
    model, x = built(mesh, "membrane"), shaken(mesh, 0.1)
    terms = mesh.vertices, mesh.faces, FABRIC.moduli
    assert naive.energies(model, x) == pytest.approx([0.0, naive.membrane_energy(x, *terms), 0.0], rel=1e-12)
    gradient = naive.complex_step(lambda y: naive.membrane_energy(y, *terms), x)
    assert np.abs(gradient).max() > 1.0
    assert naive.forces(model, x) == pytest.approx(-gradient, abs=1e-11 * np.abs(gradient).max())


@pytest.mark.parametrize("kind", ["hinge", "quadratic"])
def test_bending_equals_the_naive_energy_and_its_complex_step(make, kind):
    mesh = make(1.0, 0.8, 4, 3)
    model, x = built(mesh, kind), shaken(mesh, 0.04)
    if kind == "hinge":
        arrays, energy = model.arrays.hinges, naive.hinge_energy
        assert np.abs(naive.hinge_angles(x, arrays.vertices)).max() < 1.5, "the reference holds below a right angle"
    else:
        arrays, energy = model.arrays.quadratic, naive.quadratic_energy
    plain = built(mesh, "membrane")
    assert naive.energies(model, x)[2] == pytest.approx(energy(x, arrays), rel=1e-12)
    gradient = naive.complex_step(lambda y: energy(y, arrays), x)
    assert np.abs(gradient).max() > 0.1
    found = naive.forces(model, x) - naive.forces(plain, x)
    assert found == pytest.approx(-gradient, abs=1e-11 * np.abs(naive.forces(model, x)).max())


@pytest.mark.parametrize("kind", KINDS)
def test_energies_do_not_feel_rigid_motion(make, kind):
    mesh = make(1.0, 0.8, 4, 3)
    model, x, q = built(mesh, kind), shaken(mesh), rotation()
    f = naive.forces(model, x)
    assert np.abs(f).max() > 0.1
    assert f.sum(axis=0) == pytest.approx(0.0, abs=1e-11)
    assert np.cross(x, f).sum(axis=0) == pytest.approx(0.0, abs=1e-11)
    moved = x @ q.T + [3.0, -2.0, 1.0]
    assert naive.energies(model, moved) == pytest.approx(naive.energies(model, x), rel=1e-11)
    assert naive.forces(model, moved) == pytest.approx(f @ q.T, abs=1e-10 * np.abs(f).max())
    rest = mesh.vertices @ q.T
    assert naive.energies(model, rest) == pytest.approx(0.0, abs=1e-25)
    assert np.abs(naive.forces(model, rest)).max() < 1e-11


@pytest.mark.parametrize("kind", ["membrane", "hinge", "quadratic"])
def test_the_order_of_vertices_and_the_sides_of_faces_do_not_matter(kind):
    mesh, rng = naive.irregular(1.0, 0.8, 5, 4), np.random.default_rng(2)
    x = rolled(mesh.vertices, 2.0, 30.0) + 0.02 * rng.normal(size=mesh.vertices.shape)
    expected = naive.energies(built(mesh, kind), x)
    order = rng.permutation(len(x))
    faces = np.argsort(order)[mesh.faces]
    flipped = rng.random(len(faces)) < 0.5
    faces[flipped] = faces[flipped][:, [1, 0, 2]]
    faces = np.stack([np.roll(face, rng.integers(3)) for face in faces])[rng.permutation(len(faces))]
    model = built(cg.Mesh(mesh.vertices[order], faces.astype(np.int32)), kind)
    assert expected[1:].max() > 1e-3
    assert naive.energies(model, x[order]) == pytest.approx(expected, rel=1e-10)


# ---------------------------------------------------------------------------------------------------------------
# membrane: known answers


@pytest.mark.parametrize("gradient", [[[1.1, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, 0.9]], [[1.0, 0.1], [0.1, 1.0]],
                                      [[1.2, -0.1], [0.05, 0.8]]])  # fmt: skip
def test_patch_test(make, gradient):
    """An affine map gives every triangle the same strain: exact energy, and forces at the border only."""
    mesh = make(1.0, 0.8, 5, 4)
    model = built(mesh, "membrane")
    u, v = (np.insert(column, 1, 0.0) for column in np.array(gradient).T)
    x = np.outer(mesh.vertices[:, 0], u) + np.outer(mesh.vertices[:, 2], v)
    e, f, g = np.linalg.norm(u) - 1.0, np.linalg.norm(v) - 1.0, u @ v
    c11, c12, c22, c33 = FABRIC.moduli
    density = 0.5 * (c11 * e * e + 2.0 * c12 * e * f + c22 * f * f + c33 * g * g)
    assert naive.energies(model, x @ rotation().T)[1] == pytest.approx(0.8 * density, rel=1e-10)
    border = np.abs(mesh.vertices / [0.5, 1.0, 0.4]).max(axis=1) > 0.999
    found = np.linalg.norm(naive.forces(model, x), axis=1)
    assert found[border].max() > 1.0
    assert found[~border].max() < 1e-11


@pytest.mark.parametrize(("strain", "modulus"), [((1e-4, 0, 0), 0), ((0, 1e-4, 0), 2), ((0, 0, 1e-4), 3)])
def test_weft_warp_and_shear_each_have_their_modulus(strain, modulus):
    mesh = naive.irregular(1.0, 1.0, 4, 4)
    values = {"weft": 700.0, "coupling": 30.0, "warp": 200.0, "shear_modulus": 50.0}
    model = built(mesh, "membrane", cg.Material(**values))
    e, f, g = strain
    x = mesh.vertices @ np.array([[1.0 + e, 0.0, 0.5 * g], [0.0, 1.0, 0.0], [0.5 * g, 0.0, 1.0 + f]])
    assert naive.energies(model, x)[1] == pytest.approx(0.5 * list(values.values())[modulus] * 1e-8, rel=1e-3)


def test_uniaxial_tension_narrows_as_linear_elasticity_says():
    """Pulled along the warp: strain s C11 / (C11 C22 - C12^2), and across it -C12 / C11 of that."""
    mesh = naive.irregular(0.2, 0.2, 4, 4)
    c11, c12, c22, _ = FABRIC.moduli
    top, bottom = (np.flatnonzero(np.isclose(mesh.vertices[:, 2], z)) for z in (0.1, -0.1))
    model = built(mesh, "membrane", pins=[0])
    stress, load = 1e-3, np.zeros_like(mesh.vertices)
    for ids, sign in ((top, 1.0), (bottom, -1.0)):
        widths = np.full(len(ids), 0.05)
        widths[[np.argmin(mesh.vertices[ids, 0]), np.argmax(mesh.vertices[ids, 0])]] *= 0.5
        load[ids, 2] = sign * stress * widths
    x = naive.at_rest(model, mesh.vertices, load, 1e-12)
    along = stress * c11 / (c11 * c22 - c12 * c12)
    flat = mesh.vertices[:, [0, 2]] - mesh.vertices[0, [0, 2]]
    u, v = np.linalg.lstsq(flat, x - x[0], rcond=None)[0]
    assert np.linalg.norm(v) - 1.0 == pytest.approx(along, rel=1e-5)
    assert np.linalg.norm(u) - 1.0 == pytest.approx(-c12 / c11 * along, rel=1e-5)
    assert u @ v == pytest.approx(0.0, abs=1e-4 * along)


def test_squeezed_fibres_push_back_harder_the_more_they_are_squeezed():
    mesh = cg.grid(1.0, 1.0, 1, 1)
    model = built(cg.Mesh(mesh.vertices, mesh.faces), "membrane", dataclasses.replace(FABRIC, coupling=0.0))
    pushes = [naive.forces(model, mesh.vertices * [share, 1.0, 1.0])[1, 0] for share in (0.9, 0.6, 0.3, 1e-3)]
    assert pushes == pytest.approx([200.0 * (1.0 - share) for share in (0.9, 0.6, 0.3, 1e-3)], rel=1e-9)
    collapsed = naive.forces(model, np.zeros((4, 3)))
    assert (collapsed == 0.0).all(), "without a direction there is no force, and no error"


@pytest.mark.parametrize(("stretch", "shear"), [(300.0, 120.0), (200.0, 0.0)])
def test_springs_and_moduli_are_equivalent_for_small_strains(stretch, shear):
    n, mesh = 5, cg.grid(1.0, 1.0, 5, 5)
    material = cg.Material(stretch=stretch, shear=shear, flexion=0.0)
    assert material.moduli == (stretch + shear, shear, stretch + shear, shear)
    for e, f, g in np.random.default_rng(1).normal(0.0, 1e-4, (5, 3)):
        x = mesh.vertices @ np.array([[1.0 + e, 0.0, 0.5 * g], [0.0, 1.0, 0.0], [0.5 * g, 0.0, 1.0 + f]])
        springs, membrane = (naive.energies(built(mesh, kind, material), x).sum() for kind in ("springs", "membrane"))
        # n + 1 lines of structural springs stand for the stiffness of n cells
        border = 0.5 * stretch * (e * e + f * f) / n
        assert springs - border == pytest.approx(membrane, rel=2e-3)


def test_springs_equivalent_to_moduli():
    both = cg.Material(stretch=5.0, shear=2.0).with_equivalent_springs()
    assert (both.stretch, both.shear) == (5.0, 2.0)
    odd = cg.Material(weft=100.0, warp=60.0, coupling=7.0, shear_modulus=20.0).with_equivalent_springs()
    assert (odd.stretch, odd.shear) == (60.0, 20.0)
    with pytest.raises(ValueError, match=r"material\.shear_modulus = 90"):
        cg.Material(weft=100.0, warp=60.0, coupling=7.0, shear_modulus=90.0).with_equivalent_springs()


# ---------------------------------------------------------------------------------------------------------------
# bending: known answers


def test_curvatures_are_those_of_a_quadratic_surface(make):
    """Exact on every mesh for every face inside; sides of faces may be mixed."""
    mesh, rng = make(1.0, 1.0, 6, 6), np.random.default_rng(7)
    faces = mesh.faces.copy()
    flipped = rng.random(len(faces)) < 0.5
    faces[flipped] = faces[flipped][:, [0, 2, 1]]
    patches = BendingPatches(RestShape(cg.Mesh(mesh.vertices, faces), mesh.vertices), cg.Surface(faces))
    inside = (patches.curvatures[:, :, :3] != 0.0).any(axis=1).all(axis=1)
    assert inside.sum() > 20
    x = mesh.vertices.copy()
    a, b, c = 1e-4 * rng.normal(size=3)
    x[:, 1] = 0.5 * a * x[:, 0] ** 2 + 0.5 * b * x[:, 2] ** 2 + c * x[:, 0] * x[:, 2]
    angles = naive.hinge_angles(x, patches.hinges.vertices)
    found = np.einsum("nah,nh->na", patches.curvatures, angles[patches.numbers])
    corners = mesh.vertices[patches.stencils[:, :3]]
    up = np.sign(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 1])
    # seen from the face's normal; the warp is the normal times the weft, so the twist does not change sign with it
    expected = np.stack([up * a, up * b, np.full(len(up), -np.sqrt(2.0) * c)], axis=1)
    assert found[inside] == pytest.approx(expected[inside], abs=1e-10)


@pytest.mark.parametrize("kind", ["hinge", "quadratic"])
def test_constant_curvature_is_in_equilibrium(make, kind):
    """The patch test of bending: far from the border no vertex feels a force."""
    mesh = make(1.0, 1.0, 10, 10)
    material = cg.Material(weft=1e-6, warp=1e-6, coupling=0.0, shear_modulus=0.0, bending=1.0)
    model, x = built(mesh, kind, material), mesh.vertices.copy()
    x[:, 1] = 1e-4 * (x[:, 0] ** 2 - 0.4 * x[:, 2] ** 2 + 0.7 * x[:, 0] * x[:, 2])
    found = np.abs(naive.forces(model, x)[:, 1])
    inside = np.abs(mesh.vertices).max(axis=1) < 0.16
    assert inside.sum() >= 9
    assert found[inside].max() < 1e-6 * found.max()


@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0, 90.0, 135.0])
def test_a_cylinder_holds_half_the_rigidity_times_curvature_squared(make, degrees):
    mesh, kappa, rigidity = make(1.0, 1.0, 10, 10), 1.0, 0.02
    model = built(mesh, "hinge", cg.Material(bending=rigidity))
    hinges, x = model.arrays.hinges, rolled(mesh.vertices, kappa, degrees)
    patches = BendingPatches(RestShape(mesh, mesh.vertices), model.surface)
    inside = (patches.curvatures[:, :, :3] != 0.0).any(axis=1).all(axis=1)
    held = 0.5 * (naive.patch_curvatures(x, hinges) ** 2).sum(axis=1)
    assert held[inside].sum() / patches.areas[inside].sum() == pytest.approx(0.5 * rigidity * kappa**2, rel=5e-3)
    # at the border a free edge bears no moment: the whole sheet holds less, by less than its outer half cells
    assert 0.89 < naive.energies(model, x)[2] / (0.5 * rigidity * kappa**2) < 1.0


def test_weft_and_warp_have_rigidities_of_their_own():
    mesh = naive.irregular(1.0, 1.0, 10, 10)
    one, half = (built(mesh, "hinge", cg.Material(bending=b)) for b in (0.3, 0.1))
    both = built(mesh, "hinge", cg.Material(bending=0.3, bending_warp=0.1))
    for degrees, plain in ((0.0, one), (90.0, half)):
        x = rolled(mesh.vertices, 1.0, degrees)
        assert naive.energies(both, x)[2] == pytest.approx(naive.energies(plain, x)[2], rel=2e-3)


def test_quadratic_bending_is_hinge_bending_at_small_curvature(make):
    mesh = make(1.0, 1.0, 10, 10)
    hinge, quadratic = built(mesh, "hinge"), built(mesh, "quadratic")
    for kappa in (0.1, 0.5, 2.0):
        x = rolled(mesh.vertices, kappa, 20.0)
        assert naive.energies(quadratic, x)[2] == pytest.approx(naive.energies(hinge, x)[2], rel=2e-3 * kappa**2)


def test_bent_at_rest():
    """Hinges remember the angles of a rest shape in space; quadratic bending is flat at rest."""
    mesh = naive.irregular(1.0, 0.8, 5, 4)
    rest = rolled(mesh.vertices, 2.0, 40.0) + 0.03 * np.random.default_rng(0).normal(size=mesh.vertices.shape)
    hinge = built(mesh, "hinge", rest=rest)
    assert naive.energies(hinge, rest @ rotation().T) == pytest.approx(0.0, abs=1e-25)
    assert np.abs(naive.forces(hinge, rest)).max() < 1e-11
    assert naive.energies(hinge, mesh.vertices)[2] > 0.01
    assert naive.energies(built(mesh, "quadratic", rest=rest), rest)[2] > 0.01


def clamped(make, columns: int, gamma: float, kind: str) -> tuple[ClothModel, cg.Mesh, float]:
    """A strip of length 1 from the middle of its first cells on, whose two first columns of vertices are held."""
    cell, rigidity = 1.0 / (columns - 0.5), 1e-2
    more = {"straight": 2} if make is naive.irregular else {}
    mesh = make(columns * cell, 3.0 * cell, columns, 3, **more)
    weight = gamma * rigidity
    stiff = 3e3 * weight
    material = cg.Material(
        density=weight / G, weft=stiff, warp=stiff, coupling=0.0, shear_modulus=0.5 * stiff, bending=rigidity
    )
    held = np.flatnonzero(mesh.vertices[:, 0] < mesh.vertices[:, 0].min() + 1.01 * cell)
    return built(mesh, kind, material, pins=held), mesh, cell


@pytest.mark.parametrize(("name", "kind"), [*((name, "hinge") for name in naive.MESHES), ("irregular", "quadratic")])
def test_cantilever_under_its_own_weight(name, kind):
    """Drop and reach of the elastica for Gamma = w L^3 / B = 5 [Romero 2021's test]."""
    model, mesh, cell = clamped(naive.MESHES[name], 12, 5.0, kind)
    load = np.zeros_like(mesh.vertices)
    load[:, 1] = -G * model.masses
    x = naive.at_rest(model, mesh.vertices, load, 1e-8)
    tip = mesh.vertices[:, 0] > mesh.vertices[:, 0].max() - 1e-9
    drop, reach = -x[tip, 1].mean(), x[tip, 0].mean() - mesh.vertices[:, 0].min() - 0.5 * cell
    assert drop == pytest.approx(0.49591, rel=0.01)
    assert drop / reach == pytest.approx(0.58572, rel=0.01)


# ---------------------------------------------------------------------------------------------------------------
# Hessian blocks


@pytest.mark.parametrize("kind", KINDS)
def test_blocks_are_symmetric_positive_and_all_written(make, kind):
    mesh = make(1.0, 0.8, 4, 3)
    model = built(mesh, kind)
    for x in (mesh.vertices, shaken(mesh, 0.2), 0.5 * shaken(mesh, 0.02), np.zeros_like(mesh.vertices)):
        found = naive.blocks(model, x)
        assert set(found) == {"springs": {"springs"}, "membrane": {"membrane"}}.get(
            kind, {"membrane", kind.replace("hinge", "hinges")}
        )
        for stencils, values in found.values():
            matrices = naive.dense(stencils, values)
            scale = max(np.abs(matrices).max(), 1e-300)
            assert np.abs(matrices - matrices.transpose(0, 2, 1)).max() <= 1e-14 * scale
            assert np.linalg.eigvalsh(matrices).min() >= -1e-13 * scale


@pytest.mark.parametrize("kind", KINDS)
def test_blocks_are_the_second_derivatives_where_the_energy_is_convex(make, kind):
    mesh = make(1.0, 0.8, 4, 3)
    model = built(mesh, kind)
    for x in (mesh.vertices @ rotation().T, mesh.vertices * [1.2, 1.0, 1.1]):
        expected = naive.differences(model, x)
        assert naive.hessian(model, x) == pytest.approx(expected, abs=1e-7 * np.abs(expected).max())


def test_blocks_of_a_bent_rest_shape():
    mesh = naive.irregular(1.0, 0.8, 4, 3)
    rest = rolled(mesh.vertices, 1.5, 30.0)
    model = built(mesh, "hinge", rest=rest)
    expected = naive.differences(model, rest)
    assert naive.hessian(model, rest) == pytest.approx(expected, abs=1e-7 * np.abs(expected).max())


def test_tension_stiffens_across_also_with_shear():
    """A taut triangle with shear: blocks lack nothing across its plane."""
    mesh = naive.one_way(1.0, 1.0, 1, 1)
    model = built(cg.Mesh(mesh.vertices[[0, 1, 2]], np.array([[0, 1, 2]], np.int32)), "membrane")
    x = mesh.vertices[[0, 1, 2]] @ np.array([[1.2, 0.0, 0.1], [0.0, 1.0, 0.0], [0.15, 0.0, 1.15]])
    expected, found = naive.differences(model, x), naive.hessian(model, x)
    across = np.arange(1, 9, 3)
    assert np.abs(expected[np.ix_(across, across)]).max() > 1.0
    assert found[across] == pytest.approx(expected[across], abs=1e-6)


def test_rows_are_factors_of_the_blocks():
    mesh = naive.irregular(1.0, 0.8, 4, 3)
    model, x = built(mesh, "hinge"), shaken(mesh)
    stencils, values = naive.blocks(model, x)["hinges"]
    rows = np.full((len(stencils), 3, 12, 3), np.nan)
    bending.hinge_rows(x, model.arrays, rows)
    assert np.einsum("nair,najs->nijrs", rows, rows) == pytest.approx(values, rel=1e-12, abs=1e-12)


# ---------------------------------------------------------------------------------------------------------------
# rest shapes: seams, faces without area


@pytest.mark.parametrize("kind", ["membrane", "hinge", "quadratic"])
def test_panels_sewn_together_are_one_cloth(kind):
    """The same sheet with each face's corners in a plane of its own: where panels lie does not matter, only how the weft
    runs in them."""
    mesh = naive.irregular(1.0, 0.8, 5, 4)
    corners = mesh.vertices[mesh.faces][:, :, [0, 2]]
    right = corners.mean(axis=1)[:, 0] > 0.0
    corners[right] += [5.0, -2.0]
    x = rolled(mesh.vertices, 2.0, 30.0) * [1.02, 1.0, 0.97]
    one, sewn = built(mesh, kind), built(mesh, kind, rest=corners)
    assert naive.energies(one, x)[1:].max() > 1e-3
    assert naive.energies(sewn, x) == pytest.approx(naive.energies(one, x), rel=1e-10)
    assert naive.forces(sewn, x) == pytest.approx(naive.forces(one, x), abs=1e-9)
    turned = corners[:, :, ::-1] * [1.0, -1.0]
    swapped = dataclasses.replace(
        FABRIC, weft=FABRIC.warp, warp=FABRIC.weft, bending=FABRIC.bending_warp, bending_warp=FABRIC.bending
    )
    crosswise = built(mesh, kind, swapped, turned)
    assert naive.energies(crosswise, x) == pytest.approx(naive.energies(one, x), rel=1e-10)


def test_faces_without_area_add_nothing():
    mesh = cg.grid(1.0, 1.0, 3, 3)
    doubled = np.concatenate([mesh.vertices, mesh.vertices[[5]]])
    faces = np.concatenate([mesh.faces, [[0, 1, 2], [5, 16, 6], [4, 4, 5]]]).astype(np.int32)
    plain = cg.Mesh(mesh.vertices, mesh.faces)
    x = rolled(mesh.vertices, 1.0, 0.0) * 1.05
    more = np.concatenate([x, x[[5]]])
    for kind in ("membrane", "hinge", "quadratic"):
        one, two = built(plain, kind), built(cg.Mesh(doubled, faces), kind)
        assert np.isfinite(naive.forces(two, more)).all()
        assert naive.energies(two, more)[1] == pytest.approx(naive.energies(one, x)[1], rel=1e-12)
        assert np.isfinite(naive.energies(two, more)).all()


def test_collapsed_triangles_give_finite_answers():
    mesh = naive.irregular(1.0, 0.8, 4, 3)
    for kind in KINDS:
        model = built(mesh, kind)
        for x in (np.zeros_like(mesh.vertices), mesh.vertices * [1.0, 0.0, 0.0], mesh.vertices * [0.0, 0.0, 1.0]):
            assert np.isfinite(naive.energies(model, x)).all()
            assert np.isfinite(naive.forces(model, x)).all()
            assert np.isfinite(naive.hessian(model, x)).all()


# ---------------------------------------------------------------------------------------------------------------
# safe time steps


@pytest.mark.parametrize("kind", ["membrane", "hinge", "quadratic"])
@pytest.mark.parametrize("rigidity", [1e-4, 1.0])
def test_the_safe_time_step_is_safe_and_not_far_from_the_limit(make, kind, rigidity):
    """Just below it nothing grows; the true limit, 2 / w of the stiffest mode, is less than 1.8 of it, and above that a
    small disturbance grows without bounds."""
    mesh = make(1.0, 1.0, 6, 6)
    material = dataclasses.replace(FABRIC, bending=rigidity, bending_warp=0.5 * rigidity)
    model = built(mesh, kind, material, equal_masses=True)
    safe = model.safe_time_step()
    limit = 2.0 * np.sqrt(model.masses[0] / np.linalg.eigvalsh(naive.hessian(model, mesh.vertices)).max())
    assert safe <= limit < 1.8 * safe
    growth = []
    for dt in (0.99 * safe, 1.05 * limit):
        x = mesh.vertices + 1e-9 * np.random.default_rng(0).normal(size=mesh.vertices.shape)
        v, p, f = (np.zeros_like(x) for _ in range(3))
        motion = Motion(dt, 1, np.zeros(3), 0.0, np.zeros((0, 3)), -1.0, True)
        grips = Grips(np.zeros(0, np.int32), *(np.zeros((0, 3)) for _ in range(2)), np.zeros(0), np.zeros(0),
                      np.zeros((0, 3)), np.zeros((0, 3)))  # fmt: skip
        ground = Ground(-np.inf, 0.0)
        integrate.euler_substeps(x, v, p, f, model.arrays, np.zeros(len(x)), motion, ground, grips, 0, 400)
        growth.append(np.abs(x - mesh.vertices).max())
    assert growth[0] < 1e-6
    assert not growth[1] < 1e-4


def test_taut_cloth_is_as_safe():
    """Tension adds stiffness across the cloth; the bound has room for it."""
    mesh = cg.grid(1.0, 1.0, 6, 6)
    model = built(cg.Mesh(mesh.vertices, mesh.faces), "hinge", equal_masses=True)
    for share in (1.1, 1.3):
        square = np.linalg.eigvalsh(naive.hessian(model, mesh.vertices * [share, 1.0, share])).max() / model.masses[0]
        assert model.safe_time_step() < 2.0 / np.sqrt(square)
