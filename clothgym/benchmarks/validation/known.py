"""Known answers: closed forms, roots, and the elastica as a boundary value problem. Nothing here looks at a simulation."""

from __future__ import annotations

import cmath
import math
from functools import lru_cache

import numpy as np
from scipy.integrate import solve_bvp, solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipk, jn_zeros, roots_laguerre

from clothgym.arrays import FloatArray

# One mass on a spring: z = i w dt


def growth(method: str, phase: float) -> complex:
    """Factor by which a step of `phase` = w dt multiplies the complex amplitude of an undamped linear oscillator.

    For symplectic Euler the eigenvalue of its map; for the implicit methods of order 1 that of implicit Euler, since one
    spring converges; for the one of order 2 that of its two diagonally implicit stages.

    Raises:
        KeyError: a method without a formula here.
    """
    z = 1j * phase
    stage = 1.0 - math.sqrt(0.5)
    return {
        "symplectic_euler": lambda: cmath.exp(2j * math.asin(0.5 * phase)),
        "runge_kutta": lambda: 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24,
        "xpbd": lambda: 1 / (1 - z),
        "implicit_euler": lambda: 1 / (1 - z),
        "implicit_euler:2": lambda: (1 + (1 - 2 * stage) * z) / (1 - stage * z) ** 2,
        "global": lambda: 1 / (1 - z),
    }[_method(method)]()


def order(solver: str) -> int:
    """Order of convergence of a solver in the time step."""
    return {"runge_kutta": 4, "implicit_euler:2": 2}.get(_method(solver), 1)


def _method(solver: str) -> str:
    """Integrator of a solver's name, and its variant where that changes the answer."""
    return solver.partition("+")[0].removesuffix(":float32")


def symplectic_energy_range(phase: float) -> tuple[float, float]:
    """Least and largest energy over that of the start, from rest: v^2 + w^2 x^2 - dt w^2 x v is conserved exactly."""
    return 1.0 / (1.0 + 0.5 * phase), 1.0 / (1.0 - 0.5 * phase)


# Pendulum, chain, column, catenary


def pendulum_ratio(angle: float) -> float:
    """Period over 2 pi sqrt(l / g) from an amplitude in degrees: 2 K(sin^2(angle / 2)) / pi."""
    return float(2.0 * ellipk(math.sin(0.5 * math.radians(angle)) ** 2) / math.pi)


def chain_frequency(links: int, mode: int, length: float, gravity: float) -> float:
    """[rad/s] of a chain of equal masses on massless links: w^2 l / g are the roots of the Laguerre polynomial."""
    return math.sqrt(float(roots_laguerre(links)[0][mode - 1]) * gravity * links / length)


def hanging_chain_frequency(mode: int, length: float, gravity: float) -> float:
    """[rad/s] of a continuous chain: j_{0,n} / 2 sqrt(g / L)."""
    return 0.5 * float(jn_zeros(0, mode)[-1]) * math.sqrt(gravity / length)


def column_elongations(masses: FloatArray, stiffness: float, gravity: float) -> FloatArray:
    """[m] of each spring from the top, for masses from the top: all below it over the stiffness."""
    return np.cumsum(masses[::-1])[::-1] * gravity / stiffness


def catenary_sag(slack: float) -> float:
    """Sag over span of an inextensible strip `slack` times as long as its span: 2 a sinh(d / 2a) = l."""
    half = brentq(lambda t: math.sinh(t) / t - slack, 1e-6, 20.0, xtol=1e-15)
    return (math.cosh(half) - 1.0) / (2.0 * half)


# Waves


def spring_wave(stiffness: float, mass: float, phase: float) -> float:
    """[rad/s] of a wave along equal masses and springs, `phase` = wave number times spacing: 2 sqrt(k / m) |sin(q a / 2)|."""
    return 2.0 * math.sqrt(stiffness / mass) * abs(math.sin(0.5 * phase))


def membrane_frequency(tension: float, density: float, modes: tuple[int, int], sides: tuple[float, float]) -> float:
    """[1/s] of a rectangular membrane: 1/2 sqrt(T / rho) sqrt((m / a)^2 + (n / b)^2)."""
    return 0.5 * math.sqrt(tension / density) * math.hypot(modes[0] / sides[0], modes[1] / sides[1])


def lattice_membrane_frequency(pull: float, mass: float, phases: tuple[float, float]) -> float:
    """[1/s] of a square lattice of masses whose neighbours are drawn towards each other by `pull` [N per m of offset]."""
    return math.sqrt(4.0 * pull / mass * sum(math.sin(0.5 * phase) ** 2 for phase in phases)) / (2.0 * math.pi)


# Bending


@lru_cache(maxsize=64)
def elastica(load: float) -> tuple[float, float]:
    """Depth and reach of the tip over the length of a cantilever under its own weight.

    theta'' = -Gamma (1 - s) cos(theta), theta(0) = 0, theta'(1) = 0, Gamma = w L^3 / B; solved with growing load.
    """
    s = np.linspace(0.0, 1.0, 401)
    guess = np.zeros((4, len(s)))
    guess[3] = s
    loads = [load] if load <= 1.0 else list(np.geomspace(1.0, load, 2 + int(4 * math.log10(load))))
    for gamma in loads:
        answer = solve_bvp(
            lambda s, y, gamma=gamma: np.stack([y[1], -gamma * (1.0 - s) * np.cos(y[0]), np.sin(y[0]), np.cos(y[0])]),
            lambda a, b: np.array([a[0], b[1], a[2], a[3]]),
            s,
            guess,
            tol=1e-9,
            max_nodes=100_000,
        )
        s, guess = answer.x, answer.y
    if not answer.success:
        raise ValueError(f"elastica: load = {load:g}: {answer.message}")
    return float(answer.y[2, -1]), float(answer.y[3, -1])


def flexion_moment(stiffness: float, spacing: float, curvature: float) -> float:
    """[N m] of a line of springs that skip one vertex, at small angles: k a^5 kappa^3 / 8 (and so none when flat)."""
    return stiffness * spacing**5 * curvature**3 / 8.0


# Lattice of springs in its plane: structural springs k, both diagonals kd


def lattice_modulus(structural: float, diagonal: float, angle: float) -> float:
    """[N/m] resistance of a square lattice to a stretch in one direction that nothing across accompanies, by its angle
    [degrees] to the springs: C11 = k + kd along them, C12 = C66 = kd."""
    c, s = math.cos(math.radians(angle)) ** 2, math.sin(math.radians(angle)) ** 2
    c11, c12, c66 = structural + diagonal, diagonal, diagonal
    return c11 * (c * c + s * s) + 2.0 * (c12 + 2.0 * c66) * c * s


def orthotropic_modulus(weft: float, warp: float, shear: float, angle: float) -> float:
    """[N/m] the same of a membrane with moduli along its threads and no contraction across (isotropic: shear = half)."""
    c, s = math.cos(math.radians(angle)) ** 2, math.sin(math.radians(angle)) ** 2
    return weft * c * c + warp * s * s + 4.0 * shear * c * s


# Friction and rebound


def slide_distance(angle: float, friction: float, time: float, gravity: float) -> float:
    """[m] down a slope from rest; 0 below the angle of friction."""
    a = math.radians(angle)
    return 0.5 * max(0.0, gravity * (math.sin(a) - friction * math.cos(a))) * time**2


def creep_speed(slide: float, angle: float, dt: float, gravity: float) -> float:
    """[m/s] at which [Vassilev 2001] eq. 12 lets a sheet creep down any slope: v = C (v + g dt sin)."""
    return slide * gravity * math.sin(math.radians(angle)) * dt / (1.0 - slide)


def capstan_ratio(friction: float, radius: float, length: float) -> float:
    """Length of one hanging end over the other's at which a strip begins to slide over half a cylinder.

    dT / dphi = friction (T + w R cos(phi)) - w R sin(phi) from T = w L at phi = -90 degrees; without the weight of what lies
    on the cylinder exp(pi friction). T must come out as w times the other end's length.
    """
    answer = solve_ivp(
        lambda phi, t: friction * (t + radius * math.cos(phi)) - radius * math.sin(phi),
        (-0.5 * math.pi, 0.5 * math.pi),
        [length],
        rtol=1e-10,
        atol=1e-14,
    )
    return float(answer.y[0, -1] / length)
