"""A continuum membrane of triangles with stiffness along weft and warp: energy, forces, XPBD projection, Hessian blocks.

With the deformation gradient [w_u w_v] of a triangle (images of the unit weft and warp), the strains are

    e_u = |w_u| - 1,    e_v = |w_v| - 1,    g = w_u . w_v

and a triangle of rest area A holds A/2 (C11 e_u^2 + 2 C12 e_u e_v + C22 e_v^2 + C33 g^2): the measures of [Baraff 1998,
section 4], as one energy with moduli [N/m] and with the coupling C12. For small strains they are the engineering strains,
so that this is orthotropic linear elasticity in plane stress. Why these: stretch is linear in the length of the fibres,
as it is for springs, so the membrane does not go soft in compression (as Green's strain does, whose force vanishes at
half the length and below); fibres of constant length cost nothing but shear, as in a woven cloth, which shears like a
trellis (a corotated strain would charge a part of order g^2 / 8 to the stiff fibres); and g has no singular place.
The price: at large stretch l, shear is stiffer by l^4.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import device, kernel
from clothgym.kernels.vec3 import dot, solve3, unit


class MembraneArrays(NamedTuple):
    """Triangles with area at rest; constant while a simulation lives."""

    faces: NDArray  # (M, 3) int32
    shape: NDArray  # (M, 4) [1/m]: w_u = s0 (x1 - x0) + s1 (x2 - x0), w_v = s2 (x1 - x0) + s3 (x2 - x0)
    stiffness: NDArray  # (M, 4) [N m]: rest area times C11, C12, C22, C33


_FARTHEST = 0.5
"""Share of its length by which a projection moves a fibre at most; at rest corrections go to zero and nothing is cut."""

NO_MEMBRANE = MembraneArrays(np.zeros((0, 3), np.int32), np.zeros((0, 4)), np.zeros((0, 4)))


@device
def fibres(x, a, b, c, s):
    """Images w_u and w_v of the unit weft and warp of triangle (a, b, c) with shape s (4,): six numbers."""
    px = x[b, 0] - x[a, 0]
    py = x[b, 1] - x[a, 1]
    pz = x[b, 2] - x[a, 2]
    qx = x[c, 0] - x[a, 0]
    qy = x[c, 1] - x[a, 1]
    qz = x[c, 2] - x[a, 2]
    return (
        s[0] * px + s[1] * qx, s[0] * py + s[1] * qy, s[0] * pz + s[1] * qz,
        s[2] * px + s[3] * qx, s[2] * py + s[3] * qy, s[2] * pz + s[3] * qz,
    )  # fmt: skip


@device
def membrane_energy(x, membrane):
    """[J]."""
    total = 0.0
    for m in range(membrane.faces.shape[0]):
        face = membrane.faces[m]
        k = membrane.stiffness[m]
        ux, uy, uz, vx, vy, vz = fibres(x, face[0], face[1], face[2], membrane.shape[m])
        eu = math.sqrt(ux * ux + uy * uy + uz * uz) - 1.0
        ev = math.sqrt(vx * vx + vy * vy + vz * vz) - 1.0
        g = dot(ux, uy, uz, vx, vy, vz)
        total += 0.5 * (k[0] * eu * eu + 2.0 * k[1] * eu * ev + k[2] * ev * ev + k[3] * g * g)
    return total


@device
def add_membrane_forces(x, membrane, f):
    """Adds minus the gradient of the energy to f (V, 3) [N]; a fibre without length pulls in no direction."""
    for m in range(membrane.faces.shape[0]):
        a = membrane.faces[m, 0]
        b = membrane.faces[m, 1]
        c = membrane.faces[m, 2]
        s = membrane.shape[m]
        k = membrane.stiffness[m]
        ux, uy, uz, vx, vy, vz = fibres(x, a, b, c, s)
        dux, duy, duz, lu = unit(ux, uy, uz)
        dvx, dvy, dvz, lv = unit(vx, vy, vz)
        su = k[0] * (lu - 1.0) + k[1] * (lv - 1.0)
        sv = k[1] * (lu - 1.0) + k[2] * (lv - 1.0)
        sg = k[3] * dot(ux, uy, uz, vx, vy, vz)
        # derivatives by w_u and w_v
        gux = su * dux + sg * vx
        guy = su * duy + sg * vy
        guz = su * duz + sg * vz
        gvx = sv * dvx + sg * ux
        gvy = sv * dvy + sg * uy
        gvz = sv * dvz + sg * uz
        bx = s[0] * gux + s[2] * gvx
        by = s[0] * guy + s[2] * gvy
        bz = s[0] * guz + s[2] * gvz
        cx = s[1] * gux + s[3] * gvx
        cy = s[1] * guy + s[3] * gvy
        cz = s[1] * guz + s[3] * gvz
        f[a, 0] += bx + cx
        f[a, 1] += by + cy
        f[a, 2] += bz + cz
        f[b, 0] -= bx
        f[b, 1] -= by
        f[b, 2] -= bz
        f[c, 0] -= cx
        f[c, 1] -= cy
        f[c, 2] -= cz


@device
def project_membrane(p, membrane, w, dt, multipliers, first):
    """One Gauss-Seidel sweep of XPBD [Macklin 2016]; the three strains of a triangle are solved together.

    The stiffness form (1 + dt^2 K J W J^T) change = -(multipliers + dt^2 K strains) of the block allows moduli of zero.

    Args:
        p: (V, 3) [m], changed.
        w: (V,) inverse masses [1/kg].
        multipliers: (C,) [N m s^2]; three a triangle from `first` on.
    """
    square = dt * dt
    for m in range(membrane.faces.shape[0]):
        a = membrane.faces[m, 0]
        b = membrane.faces[m, 1]
        c = membrane.faces[m, 2]
        wa = w[a]
        wb = w[b]
        wc = w[c]
        if wa + wb + wc == 0.0:
            continue
        s = membrane.shape[m]
        k = membrane.stiffness[m]
        ux, uy, uz, vx, vy, vz = fibres(p, a, b, c, s)
        dux, duy, duz, lu = unit(ux, uy, uz)
        dvx, dvy, dvz, lv = unit(vx, vy, vz)
        g = dot(ux, uy, uz, vx, vy, vz)
        ta = -s[0] - s[1]
        ra = -s[2] - s[3]
        uu = wa * ta * ta + wb * s[0] * s[0] + wc * s[1] * s[1]
        vv = wa * ra * ra + wb * s[2] * s[2] + wc * s[3] * s[3]
        uv = wa * ta * ra + wb * s[0] * s[2] + wc * s[1] * s[3]
        # J W J^T; a fibre without length has no direction
        m00 = uu if lu > 0.0 else 0.0
        m11 = vv if lv > 0.0 else 0.0
        m01 = uv * dot(dux, duy, duz, dvx, dvy, dvz)
        m02 = uu * dot(dux, duy, duz, vx, vy, vz) + uv * lu
        m12 = uv * lv + vv * dot(dvx, dvy, dvz, ux, uy, uz)
        m22 = uu * lv * lv + vv * lu * lu + 2.0 * uv * g
        k00 = square * k[0]
        k01 = square * k[1]
        k11 = square * k[2]
        k22 = square * k[3]
        at = first + 3 * m
        eu = lu - 1.0
        ev = lv - 1.0
        r0, r1, r2 = solve3(
            1.0 + k00 * m00 + k01 * m01, k00 * m01 + k01 * m11, k00 * m02 + k01 * m12,
            k01 * m00 + k11 * m01, 1.0 + k01 * m01 + k11 * m11, k01 * m02 + k11 * m12,
            k22 * m02, k22 * m12, 1.0 + k22 * m22,
            -multipliers[at] - k00 * eu - k01 * ev,
            -multipliers[at + 1] - k01 * eu - k11 * ev,
            -multipliers[at + 2] - k22 * g,
        )  # fmt: skip
        gux = r0 * dux + r2 * vx
        guy = r0 * duy + r2 * vy
        guz = r0 * duz + r2 * vz
        gvx = r1 * dvx + r2 * ux
        gvy = r1 * dvy + r2 * uy
        gvz = r1 * dvz + r2 * uz
        # shear is a product of fibres: where both move far, what is linear in them overshoots, and a sweep would add to it
        share = _share(uu, uv, vv, lu, lv, gux, guy, guz, gvx, gvy, gvz)
        multipliers[at] += share * r0
        multipliers[at + 1] += share * r1
        multipliers[at + 2] += share * r2
        gux *= share
        guy *= share
        guz *= share
        gvx *= share
        gvy *= share
        gvz *= share
        p[a, 0] += wa * (ta * gux + ra * gvx)
        p[a, 1] += wa * (ta * guy + ra * gvy)
        p[a, 2] += wa * (ta * guz + ra * gvz)
        p[b, 0] += wb * (s[0] * gux + s[2] * gvx)
        p[b, 1] += wb * (s[0] * guy + s[2] * gvy)
        p[b, 2] += wb * (s[0] * guz + s[2] * gvz)
        p[c, 0] += wc * (s[1] * gux + s[3] * gvx)
        p[c, 1] += wc * (s[1] * guy + s[3] * gvy)
        p[c, 2] += wc * (s[1] * guz + s[3] * gvz)


@device
def _share(uu, uv, vv, lu, lv, gux, guy, guz, gvx, gvy, gvz):
    """Share of a correction by which no fibre moves more than `_FARTHEST` of its length, or of its rest length."""
    sux = uu * gux + uv * gvx
    suy = uu * guy + uv * gvy
    suz = uu * guz + uv * gvz
    svx = uv * gux + vv * gvx
    svy = uv * guy + vv * gvy
    svz = uv * guz + vv * gvz
    du = math.sqrt(sux * sux + suy * suy + suz * suz) / max(lu, 1.0)
    dv = math.sqrt(svx * svx + svy * svy + svz * svz) / max(lv, 1.0)
    return min(1.0, _FARTHEST / max(du, dv, _FARTHEST))


@device
def _positive_part(a, b, c):
    """The symmetric matrix [[a, b], [b, c]] without its negative eigenvalue: three numbers."""
    middle = 0.5 * (a + c)
    radius = math.sqrt(0.25 * (a - c) * (a - c) + b * b)
    if middle - radius >= 0.0:
        return a, b, c
    if middle + radius <= 0.0:
        return 0.0, 0.0, 0.0
    # the larger eigenvalue times its projector
    scale = (middle + radius) / (2.0 * radius)
    return scale * (a - middle + radius), scale * b, scale * (c - middle + radius)


@kernel
def membrane_hessian(x, cloth, blocks):
    """Second derivatives of the membrane energy, positive semi-definite, as blocks of triangles.

    The Gauss-Newton part C_ab grad e_a grad e_b^T, and of the part that stress adds what keeps it positive: across the
    triangle the whole stress without its compressive part (exact where the stress is tension, which is what makes a taut
    cloth stiff), in its plane the tension of the fibres. Exact for unstrained triangles, and under tension without shear.

    Args:
        x: (V, 3) [m].
        cloth: `ClothArrays`; stencils are cloth.membrane.faces (M, 3).
        blocks: (M, 3, 3, 3, 3) [N/m], written: blocks[m, i, j] = d^2 E / dx_i dx_j.
    """
    membrane = cloth.membrane
    unit_u = np.zeros(3)
    unit_v = np.zeros(3)
    wu = np.zeros(3)
    wv = np.zeros(3)
    normal = np.zeros(3)
    bu = np.zeros(3)
    bv = np.zeros(3)
    for m in range(membrane.faces.shape[0]):
        face = membrane.faces[m]
        s = membrane.shape[m]
        k = membrane.stiffness[m]
        wu[0], wu[1], wu[2], wv[0], wv[1], wv[2] = fibres(x, face[0], face[1], face[2], s)
        unit_u[0], unit_u[1], unit_u[2], lu = unit(wu[0], wu[1], wu[2])
        unit_v[0], unit_v[1], unit_v[2], lv = unit(wv[0], wv[1], wv[2])
        bu[0] = -s[0] - s[1]
        bu[1] = s[0]
        bu[2] = s[1]
        bv[0] = -s[2] - s[3]
        bv[1] = s[2]
        bv[2] = s[3]
        normal[0] = unit_u[1] * unit_v[2] - unit_u[2] * unit_v[1]
        normal[1] = unit_u[2] * unit_v[0] - unit_u[0] * unit_v[2]
        normal[2] = unit_u[0] * unit_v[1] - unit_u[1] * unit_v[0]
        normal[0], normal[1], normal[2], size = unit(normal[0], normal[1], normal[2])
        su = k[0] * (lu - 1.0) + k[1] * (lv - 1.0)
        sv = k[1] * (lu - 1.0) + k[2] * (lv - 1.0)
        sg = k[3] * dot(wu[0], wu[1], wu[2], wv[0], wv[1], wv[2])
        tu = su / lu if lu > 0.0 else 0.0
        tv = sv / lv if lv > 0.0 else 0.0
        nuu, nuv, nvv = _positive_part(tu, sg, tv)
        tu = max(tu, 0.0)
        tv = max(tv, 0.0)
        if size == 0.0:  # fibres on one line: no plane, so tension acts in all directions across each fibre
            nuu = 0.0
            nuv = 0.0
            nvv = 0.0
        for i in range(3):
            for j in range(3):
                across = nuu * bu[i] * bu[j] + nuv * (bu[i] * bv[j] + bv[i] * bu[j]) + nvv * bv[i] * bv[j]
                for r in range(3):
                    gi = bu[i] * wv[r] + bv[i] * wu[r]
                    for q in range(3):
                        gj = bu[j] * wv[q] + bv[j] * wu[q]
                        value = k[0] * bu[i] * bu[j] * unit_u[r] * unit_u[q]
                        value += k[2] * bv[i] * bv[j] * unit_v[r] * unit_v[q]
                        value += k[1] * (bu[i] * bv[j] * unit_u[r] * unit_v[q] + bv[i] * bu[j] * unit_v[r] * unit_u[q])
                        value += k[3] * gi * gj
                        same = 1.0 if r == q else 0.0
                        nn = normal[r] * normal[q]
                        value += across * nn
                        value += tu * bu[i] * bu[j] * (same - unit_u[r] * unit_u[q] - nn)
                        value += tv * bv[i] * bv[j] * (same - unit_v[r] * unit_v[q] - nn)
                        blocks[m, i, j, r, q] = value
