"""What the library says to wrong constraints, and to steppers that do not know them."""

import math
import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax

simulate = partial(hhtjax.simulate, dt=0.01, num_steps=1)


def constrained(phi):
    return hhtjax.System(jnp.ones(2), lambda q, v, t, params: -q, phi)


def run_from(phi, q0, v0):
    return lambda: simulate(constrained(phi), hhtjax.hht(), jnp.array(q0), jnp.array(v0))


def project(phi, params=None, t0=0.0):
    return lambda: hhtjax.consistent_initial(constrained(phi), jnp.ones(2), jnp.ones(2), params, t0)


def level(q, t, params):
    return q[:1] - 1.0


ONE, ZERO = (1.0, 1.0), (0.0, 0.0)
AWAY = "1 away from consistent values; hhtjax.consistent_initial gives them."
SHAPE = "simulate: `constraint` must return an array (m,) with m >= 1"
BAD = [
    (SHAPE, run_from(lambda q, t, params: q[0], ONE, ONE)),
    ("simulate: `constraint` rows [0, 2] depend", run_from(lambda q, t, params: jnp.tile(q - 1, 2)[:3], ONE, ZERO)),
    (f"simulate: `q0` violates the constraint: max|Phi| = 1, {AWAY}", run_from(level, (2.0, 2.0), ZERO)),
    ("simulate: `q0` violates the constraint: max|Phi| = 1, 1 away", run_from(level, (2.0, 1e8), ZERO)),
    (f"simulate: `v0` violates the constraint: max|dPhi/dt| = 1, {AWAY}", run_from(level, ONE, ONE)),
    (
        "simulate: `constraint` rows [1] have no gradient in q",
        run_from(lambda q, t, params: jnp.array([q[0] - 1.0, 0.0 * t]), ONE, ZERO),
    ),
    ("consistent_initial: no q with Phi(q, t) = 0 found", project(lambda q, t, params: q[:1] ** 2 + 1.0)),
    ("consistent_initial: `system` must have a constraint", project(None)),
    ("consistent_initial: `t0` must be finite; received nan", project(level, t0=math.nan)),
    ("consistent_initial: `params['l']` must be an array, a number or a function", project(level, {"l": "2 m"})),
    ('hht: `formulation` must be "ggl" or "index3"', lambda: hhtjax.hht(formulation="index2")),
]


def bead(size, off, origin=0.0):
    """On a circle of this radius, and off it by that part of it; q counts from the origin."""
    center = jnp.array([origin, 0.0])

    def circle(q, t, params):
        return jnp.sqrt(jnp.sum((q - center) ** 2, keepdims=True)) - size

    return run_from(circle, (origin, -size * (1 + off)), ZERO)


@pytest.mark.slow
@pytest.mark.parametrize(("size", "off"), [(1e-6, 5e-3), (1.0, 1e-5)])
def test_a_small_mechanism_is_off_by_its_own_measure(size, off):
    bead(size, off / 10)().check()
    beside = "" if size == 1 else ", which is much in so small a mechanism"
    with pytest.raises(ValueError, match=f"`q0` violates .* away from consistent values{beside}; hhtjax"):
        bead(size, off)()
    run_from(lambda q, t, params: q[:1] - 1e-9, ZERO, ZERO)().check()  # of a plane nothing tells the size


@pytest.mark.parametrize(("message", "call"), BAD, ids=lambda x: x[:40] if isinstance(x, str) else "")
def test_bad_input(message, call):
    with pytest.raises((ValueError, TypeError), match=re.escape(message)):
        call()


@pytest.mark.slow
def test_initial_values_known_while_tracing_are_checked_there():
    good, bad, rest, system = jnp.ones(2), 2 * jnp.ones(2), jnp.zeros(2), constrained(level)

    def end(start, dt):
        return hhtjax.simulate(system, hhtjax.hht(), start, rest, dt=dt, num_steps=1).q[-1]

    assert np.allclose(jax.jit(partial(end, good))(0.1), end(good, 0.1), rtol=1e-12)
    with pytest.raises(ValueError, match="`q0` violates the constraint"):
        jax.jit(partial(end, bad))(0.1)


@pytest.mark.parametrize("where", ["held", "state"])
def test_other_points_of_linearisation_are_refused(where):
    with pytest.raises(ValueError, match=f"hht: with constraints, leave `linearize` out.*; received {where!r}"):
        simulate(constrained(level), hhtjax.hht(linearize=where), jnp.ones(2), jnp.zeros(2))


@pytest.mark.parametrize("name", ["kim_hht", "rk4"])
def test_other_steppers_refuse(name):
    with pytest.raises(
        NotImplementedError, match=r"simulate: .* cannot solve the `constraint`; use extrapolated\(\), hht\(\)"
    ):
        simulate(constrained(level), getattr(hhtjax, name)(), jnp.ones(2), jnp.zeros(2))
