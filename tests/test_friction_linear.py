"""Dry friction of a linear system: the same motion as of a System, from one factorisation."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax import LinearSystem, System
from hhtjax.numerics.low_rank import Changing, Updated

PARAMS = {"F": 1.0}
STOP = -50.0


def matrices(n):
    K = 40 * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    return np.diag(np.linspace(1, 2, n)) + 0.05, 0.01 * K, K


def rates(q, v, t, params):
    """On a belt, and between two masses."""
    return jnp.stack([v[0] - 0.1, v[3] - v[2]])


def limit(q, v, t, params):
    """Stribeck curves, and loads that depend on where two other masses are."""
    stiction = 0.3 * jnp.exp(-jnp.abs(rates(q, v, t, params)) / 0.05)
    return params["F"] * (1 + stiction + 0.1 * jnp.abs(q[-2:]))


def pair(n, nonlinear=False, joints=2):
    """The same as a LinearSystem and as a System."""
    M, C, K = matrices(n)
    at = [1, n - 2]
    dry = {"friction": lambda *x: limit(*x)[:joints], "sliding": lambda *x: rates(*x)[:joints]}
    local = {"nonlinear": lambda q, v, t, params: STOP * q**3, "at": at} if nonlinear else {}

    def load(t, params):
        return 6 * jnp.sin(3 * t) * jnp.linspace(0.0, 1.0, n)

    def force(q, v, t, params):
        Q = load(t, params) - C @ v - jnp.asarray(K) @ q
        i = jnp.array(at)
        return Q.at[i].add(STOP * q[i] ** 3) if nonlinear else Q

    return LinearSystem(M, C, K, load, **local, **dry), System(M, force, **dry)


def run(system, n, params=PARAMS, dt=0.01, num_steps=400, **options):
    q0 = jnp.linspace(0, 1.0, n)
    return hhtjax.simulate(system, hhtjax.hht(-0.1, **options), q0, 0 * q0, params, dt=dt, num_steps=num_steps)


@cache
def of_pair(n, nonlinear, iterations):
    return [run(system, n, iterations=iterations) for system in pair(n, nonlinear)]


@pytest.mark.slow
@pytest.mark.parametrize(("n", "nonlinear", "iterations"), [(6, False, None), (20, True, 1)])
def test_the_motion_is_that_of_the_general_system(n, nonlinear, iterations):
    linear, general = of_pair(n, nonlinear, iterations)
    linear.check()
    assert np.count_nonzero(np.diff(linear.sticking, axis=0)) > 0
    for name in ("q", "v", "acceleration", "friction"):
        np.testing.assert_allclose(getattr(linear, name), getattr(general, name), rtol=1e-10, atol=1e-11)
    np.testing.assert_array_equal(linear.sticking, general.sticking)


@pytest.mark.slow
def test_derivatives_are_those_of_the_general_system():
    """Of one joint, whose switches are differentiated; those of several are as of any system."""

    def end(system, F):
        found = run(system, 4, {"F": F}, 0.04, 32)  # as many as are not checkpointed
        return jnp.sum(found.q[-1] ** 2), found.friction

    linear, general = (partial(end, system) for system in pair(4, nonlinear=True, joints=1))
    (_, exact, friction), (_, forward, _) = (
        jax.jit(lambda F, end=end: jax.jvp(end, (F,), (1.0,), has_aux=True))(1.0) for end in (general, linear)
    )
    reverse, _ = jax.jit(jax.grad(linear, has_aux=True))(1.0)
    assert np.ptp(np.sign(friction)) == 2
    np.testing.assert_allclose([forward, reverse], [exact, exact], rtol=1e-9)


def test_an_updated_inverse_is_that_of_the_whole_matrix():
    """A0 - E J E^T + H^T D of two joints, and its transpose; no part is symmetric."""
    rng = np.random.default_rng(0)
    A, J, H, D = (jnp.asarray(rng.normal(size=shape)) for shape in ((4, 4), (2, 2), (2, 4), (2, 4)))
    b, at = rng.normal(size=4), jnp.array([3, 0])
    E = jnp.eye(4)[:, at]

    @jax.jit
    def solved():
        known = Changing(A, lambda state: lambda x: J @ x[at], lambda y: E @ y, 2)
        inverse = Updated(known, H, lambda state: lambda x: D @ x).around(None, lambda w: w).of_map(None, b)
        return inverse(b, trans=0), inverse(b, trans=1)

    whole = A - E @ J @ E.T + H.T @ D
    np.testing.assert_allclose(solved(), [np.linalg.solve(M, b) for M in (whole, whole.T)], rtol=1e-10)


@pytest.mark.slow
def test_one_factorisation_outside_the_loop():
    n, system = 20, pair(20, nonlinear=True)[0]

    def end(q0, dt):  # a step that is known is factorised before the program
        options = {"dt": dt, "num_steps": 50, "save_every": 50}
        stepper = hhtjax.hht(start="simple")  # Newton's iteration of the smooth start factorises too, once for a run
        return hhtjax.simulate(system, stepper, q0, 0 * q0, PARAMS, **options).q

    parts = jax.jit(end).lower(jnp.zeros(n), 0.01).compile().as_text().split("\n\n")
    found = [part for part in parts if "lapack_dgetrf" in part]
    assert found
    assert all("ENTRY" in part for part in found)


@pytest.mark.slow
def test_all_modes_slip_as_the_coordinates_do():
    """The reduced system, with as many modes as there are masses."""
    n = 6
    linear = pair(n)[0]
    reduced, q0 = hhtjax.analysis.modal_reduction(linear, n), jnp.linspace(0, 1.0, n)
    x0 = reduced.project(q0)
    stepper = hhtjax.hht(-0.1, iterations=None)
    found = hhtjax.simulate(reduced.system, stepper, x0, 0 * x0, PARAMS, dt=0.01, num_steps=400)
    expected = of_pair(n, False, None)[0]
    np.testing.assert_allclose(reduced.expand(found.q), expected.q, atol=1e-10)
    np.testing.assert_allclose(found.friction, expected.friction, atol=1e-9)


def simulate(**dry):
    system = LinearSystem(np.ones(2), friction=lambda q, v, t, params: jnp.ones(1), **dry)
    return hhtjax.simulate(system, hhtjax.hht(), jnp.ones(2), jnp.ones(2), dt=0.1, num_steps=1)


@pytest.mark.parametrize(
    ("error", "message", "call"),
    [
        (TypeError, "LinearSystem: `friction` must be a function", lambda: LinearSystem(np.ones(1), friction=1.0)),
        (TypeError, r"LinearSystem: `sliding` .* sliding\(q, v, t, params\)", lambda: simulate(sliding=lambda v: v)),
        (ValueError, "LinearSystem: `sliding` must go with `friction`", lambda: LinearSystem(1.0, sliding=rates)),
        (ValueError, "`friction` must return a pytree like v0", simulate),
        (ValueError, "the same derivative in v for all q", lambda: simulate(sliding=lambda q, v, *_: q[:1] * v[:1])),
    ],
)
def test_bad_input_is_named(error, message, call):
    with pytest.raises(error, match=message):
        call()
