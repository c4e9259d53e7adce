"""The scenes: as a system for our steppers, as an ODE for everyone else, with a reference to compare with."""

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp
from scipy.special import ellipj

import hhtjax
from experiments.benchmarks.chain import chain
from experiments.cardona_geradin1989.index_1 import unconstrained, violation
from hhtjax.numerics.dense_lu import factorize, matvec
from hhtjax.numerics.linear_solve import reuse, solve
from hhtjax.scenes import Scene, double_pendulum, duffing, squeezer, top

SAMPLES = 50  # times at which positions are compared
TRIGONOMETRY = hhtjax.trigonometry


class Case(NamedTuple):
    """scene: for our steppers. rate: dy/dt of y, `rate(t, y, params)`. size: of the position, the first numbers of y.
    ode: a system that steppers without constraints or rotations can take, and its start. unit: of the position."""

    scene: Scene
    rate: Any
    y0: np.ndarray
    size: int
    ode: Any
    unit: str = "rad"

    @property
    def times(self):
        """The sample times, without the start."""
        return np.linspace(0.0, self.scene.duration, SAMPLES + 1)[1:]


def second_order(scene, unit="rad", system=None):
    """The case of a scene in vectors q and v; system: one without constraints, if it has some."""
    plain = system or scene.system
    flat = hhtjax.interop.flat_ode(plain, scene.q0, scene.v0)
    return Case(scene, flat.rate, np.asarray(flat.y0), scene.q0.size, (plain, scene.q0, scene.v0), unit)


def eliminated(system, n):
    """`unconstrained`, but M is eliminated first, then the multipliers: (B M^-1 B^T) L = -gamma - B M^-1 Q.

    Inside one kernel, where the zeros of M cost nothing, that takes a third of the time; elsewhere it takes longer, so
    that the others have the other form.
    """

    def acceleration(q, v, t, params):
        M, Q, ones = system.mass(q, params), system.force(q, v, t, params), (v, jnp.ones_like(t))
        gamma = jax.jvp(lambda q, t: violation(system, q, v, t, params)[1], (q, t), ones)[1]
        B, known = jax.jacfwd(lambda q: system.constraint(q, t, params))(q), reuse(factorize, factorize(M))
        w, *rows = (solve(M, x, known) for x in (Q, *B))
        L = solve(jnp.stack([matvec(B, x) for x in rows], axis=1), -gamma - matvec(B, w))
        return w + matvec(jnp.stack(rows, axis=1), L)

    return hhtjax.System(jnp.ones(n), acceleration)


def linkage():
    """The squeezer, as an ODE for the others and for ours."""
    scene = squeezer.squeezer()
    n = scene.q0.size
    case = second_order(scene, "rad", unconstrained(scene.system, n))
    return case._replace(ode=(eliminated(scene.system, n), *case.ode[1:]))


def spinning_top():
    """The top as a rotation: for the others as 9 numbers and 3 angular velocities."""
    scene = top.minimal()
    flat = hhtjax.interop.flat_ode(scene.system, scene.q0, scene.v0)
    system = hhtjax.FirstOrderSystem(lambda y, t, params: flat.rate(t, y, params))
    return Case(scene, flat.rate, np.asarray(flat.y0), 9, (system, flat.y0, None), "1")


def at(scene, duration):
    """The scene with another duration."""
    return scene._replace(duration=duration)


@cache
def cases():
    """{name: Case}."""
    return {
        "free double pendulum": second_order(at(double_pendulum.free(TRIGONOMETRY), 5.0)),
        "stiff double pendulum": second_order(at(double_pendulum.stiff(trigonometry=TRIGONOMETRY), 5.0)),
        "stiff double pendulum, torques as printed": second_order(
            at(double_pendulum.stiff(True, trigonometry=TRIGONOMETRY), 5.0)
        ),
        "stiff chain of 8": second_order(chain(8, k=10.0, c=0.3, duration=2.0)),
        "forced Duffing": second_order(duffing.driven(), "m"),
        "hardening spring": second_order(duffing.hardening_spring(), "m"),
        "squeezer": linkage(),
        "top": spinning_top(),
    }


def swing(params, a, t):
    """q = a cn(w t | m) of m q'' + k q + k3 q^3 = 0 from rest at a, with w^2 = (k + k3 a^2)/m, m = k3 a^2/(2 m w^2)."""
    rate2, hardening = ((x / params["m"]) for x in (params["k"] + params["k3"] * a**2, params["k3"] * a**2))
    return a * ellipj(np.sqrt(rate2) * t, hardening / (2 * rate2))[1]


@cache
def reference(name):
    """Positions at the sample times, (SAMPLES, size), by SciPy's DOP853 at a tolerance of 1e-13; good to 3e-13.

    Of the hardening spring, where that is good to 1e-11 alone, by its elliptic function, good to 1e-13.
    """
    case = cases()[name]
    if name == "hardening spring":
        return swing(case.scene.params, case.y0[0], case.times)[:, None]
    system, q0, v0 = case.ode
    rhs = hhtjax.interop.scipy_rhs(system, q0, v0, case.scene.params)
    run = solve_ivp(rhs.fun, (0.0, case.scene.duration), rhs.y0, "DOP853", case.times, rtol=1e-13, atol=1e-14)
    return run.y[: case.size].T


def rms_error(name, positions):
    """Root mean square over times and coordinates; None where it is not finite, or positions is None."""
    if positions is None or np.shape(positions) != (SAMPLES, cases()[name].size):
        return None
    with np.errstate(over="ignore"):
        error = float(np.sqrt(np.mean((np.asarray(positions) - reference(name)) ** 2)))
    return error if np.isfinite(error) else None


def flat(q):
    """A position as a vector."""
    return ravel_pytree(q)[0]
