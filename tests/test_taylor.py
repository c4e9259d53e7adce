"""Taylor series: recurrences of all operations, steps, error control, dense output, events, derivatives, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hhtjax
from hhtjax.numerics import power_series
from hhtjax.scenes import double_pendulum, duffing
from hhtjax.steppers.taylor import order_for, series_of, summed
from hhtjax.systems.flat_system import flatten

A = jnp.array([[0.0, 2.0, 1.0], [1.0, 0.3, -1.0], [0.5, 1.0, 3.0]])  # whose first pivot is zero


def moving_matrix(x):
    return A + jnp.diag(x * jnp.array([0.0, 1.0, x])) + jnp.outer(jnp.array([0.0, 1.0, 2.0]), x * jnp.ones(3))


OPERATIONS = {  # of x, from 0.4 on, and of a parameter c = 1.7
    "sums": lambda x, c: c - x + (x - 2.0) - (-x),
    "product": lambda x, c: c * x * x * (x + 1.0),
    "quotient": lambda x, c: x / (1.0 + x * x) + c / x + x / c,
    "powers": lambda x, c: x**3 + x**-2 + x**0.3 + x**c + jnp.power(c, x) + jnp.power(x, x),
    "roots": lambda x, c: jnp.sqrt(x + c) + jax.lax.rsqrt(x) + jnp.cbrt(x - 2.0),
    "exponentials": lambda x, c: jnp.exp(c * x) + jnp.exp2(x) + jnp.expm1(x),
    "logarithms": lambda x, c: jnp.log(x) + jnp.log1p(c * x),
    "sine": lambda x, c: jnp.sin(x) * jnp.cos(c * x),
    "sine by polynomials": lambda x, c: hhtjax.trigonometry.sin(x) + hhtjax.trigonometry.cos(c * x),
    "tangent": lambda x, c: jnp.tan(x),
    "hyperbolic": lambda x, c: jnp.sinh(x) * jnp.cosh(c * x),
    "saturations": lambda x, c: jnp.tanh(x) + jax.nn.sigmoid(c * x) + jax.lax.erf(x),
    "arcs": lambda x, c: jnp.arctan(x) + jnp.arcsin(x - 0.3) + jnp.arccos(x - 0.3),
    "area functions": lambda x, c: jnp.arcsinh(x) + jnp.arccosh(c + x) + jnp.arctanh(x - 0.3),
    "angle": lambda x, c: jnp.arctan2(x, c) + jnp.arctan2(-c, x) + jnp.arctan2(x * x - 1, -x),
    "choice by a parameter": lambda x, c: jnp.where(c > 1, x, x * x) + jnp.abs(c) * x + jnp.maximum(c, 1.0),
    "solve": lambda x, c: jnp.linalg.solve(moving_matrix(x), c * jnp.array([1.0, x, x * x]))[1],
    "solve in a solve": lambda x, c: jnp.linalg.solve(
        jnp.eye(2) + jnp.outer(jnp.array([x, 1.0]), jnp.linalg.solve(moving_matrix(x), jnp.ones(3) * x)[:2]),
        jnp.array([c, x]),
    )[0],
    "constant": lambda x, c: c * c,
}


@pytest.mark.parametrize("most", [power_series.WRITTEN_OUT, 0], ids=["written out", "in a loop"])
def test_every_operation_has_the_series_of_its_function(most, monkeypatch):
    monkeypatch.setattr(power_series, "WRITTEN_OUT", most)

    def rate(y, t, params):
        x = 0.4 + 0.5 * t + 0.2 * t * t
        return jnp.stack([f(x, params["c"]) for f in OPERATIONS.values()])

    params, t0, y0 = {"c": jnp.asarray(1.7)}, 0.1, jnp.zeros(len(OPERATIONS))
    flat, q, y = flatten("test", hhtjax.FirstOrderSystem(rate), y0, None, t0, params)

    @jax.jit
    def both(t0, params):
        return by_both(16, flat, q, y, t0, params, rate)

    found, exact = both(jnp.asarray(t0), params)
    for name, error in zip(OPERATIONS, jnp.max(jnp.abs(found - exact) / (1 + jnp.abs(exact)), axis=0), strict=True):
        assert error < 3e-14, name


def by_both(order, flat, q, y, t0, params, rate):
    """y' near t0 by the series, and by the function itself."""
    series = series_of(order, flat, q, y, t0, params).expansion()
    return jax.vmap(lambda h: (summed(series, h)[2], rate(y, t0 + h, params)))(jnp.array([-0.02, 0.02, 0.04]))


def test_series_of_a_solve_has_derivatives_in_its_matrix():
    def rate(y, t, params):
        x = params["c"] * (0.4 + t)
        return jnp.linalg.solve(moving_matrix(x), jnp.array([1.0, x, x * x]))

    t0, y0 = jnp.asarray(0.1), jnp.zeros(3)

    def both(c):
        flat, q, y = flatten("test", hhtjax.FirstOrderSystem(rate), y0, None, t0, {"c": c})
        return by_both(9, flat, q, y, t0, {"c": c}, rate)

    for derivative in (jax.jacfwd, jax.jacrev):
        found, exact = jax.jit(derivative(both))(1.7)
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-11)


def energy(run, params):
    """Of the free double pendulum."""
    q, v, g = run.q, run.v, params["g"]
    M = jax.vmap(lambda q: double_pendulum.mass(q, params))(q)
    (m1, m2), (l1, l2) = params["m"], params["l"]
    height = (m1 + m2) * l1 * jnp.sin(q[:, 0]) + m2 * l2 * jnp.sin(q[:, 1])
    return jnp.einsum("ki,kij,kj->k", v, M, v) / 2 + g * height


@pytest.mark.parametrize("tolerance", [1e-6, 1e-13])  # order 8, of which two coefficients vanish here, and 16
def test_tolerance_is_met_from_rest_at_a_symmetric_start(tolerance):
    scene, times = double_pendulum.free(), np.linspace(0.0, 2.0, 11)[1:]
    run = hhtjax.simulate(
        scene.system, hhtjax.taylor(), scene.q0, scene.v0, scene.params, dt=hhtjax.adaptive(tolerance, tolerance),
        times=times,
    )  # fmt: skip
    run.check()
    close = hhtjax.simulate(
        scene.system, hhtjax.dopri5(), scene.q0, scene.v0, scene.params, dt=1e-4, num_steps=20_000, save_every=2000
    )
    assert float(jnp.max(jnp.abs(run.q - close.q))) < max(10 * tolerance, 3e-11)
    E = energy(run, scene.params)
    assert float(jnp.max(jnp.abs(E - E[0]))) < max(100 * tolerance, 1e-11)
    assert run.steps.rejected <= 1
    assert run.steps.accepted < (60 if tolerance > 1e-10 else 80)


def test_order_follows_from_the_tolerance_and_samples_are_as_good_as_steps():
    assert [order_for(x) for x in (1e-4, 1e-8, 1e-12)] == [6, 11, 15]
    scene = duffing.driven()
    times = np.linspace(0.0, 5.0, 334)[1:]
    run = hhtjax.simulate(
        scene.system, hhtjax.taylor(), scene.q0, scene.v0, scene.params, dt=hhtjax.adaptive(1e-11, 1e-11), times=times
    )
    rhs = hhtjax.interop.scipy_rhs(scene.system, scene.q0, scene.v0, scene.params)
    close = solve_ivp(rhs.fun, (0.0, 5.0), rhs.y0, "DOP853", times, rtol=1e-13, atol=1e-14)
    rates = np.stack([rhs.fun(t, y) for t, y in zip(times, close.y.T, strict=True)])
    assert np.max(np.abs(run.q[1:, 0] - close.y[0])) < 1e-10
    assert np.max(np.abs(run.v[1:, 0] - close.y[1])) < 1e-10
    assert np.max(np.abs(run.acceleration[1:, 0] - rates[:, 1])) < 3e-9
    assert run.steps.accepted < 100


def rate(y, t, params):
    """y = exp(-k t) + sin t, and its integral."""
    return jnp.stack([-params["k"] * (y[0] - jnp.sin(t)) + jnp.cos(t), y[0]])


def first_order(k, stepper=None, **more):
    start = jnp.stack([jnp.ones_like(k), jnp.zeros_like(k)])
    stepper = hhtjax.taylor(order=9) if stepper is None else stepper
    return hhtjax.simulate(hhtjax.FirstOrderSystem(rate), stepper, start, None, {"k": k}, **more)


def closed_form(k, t):
    return jnp.exp(-k * t) + jnp.sin(t), (1 - jnp.exp(-k * t)) / k + 1 - jnp.cos(t)


def test_first_order_system_with_time_in_batches_and_both_derivatives():
    times, k = jnp.array([0.7, 2.0]), 1.3

    def end(k):
        return first_order(k, dt=hhtjax.adaptive(1e-10, 1e-10), times=times).q[1:]

    exact = jnp.stack([jnp.stack(closed_form(k, t)) for t in times])
    assert float(jnp.max(jnp.abs(end(jnp.asarray(k)) - exact))) < 1e-9
    forward, reverse = jax.jacfwd(end)(k), jax.jacrev(end)(k)
    true = jnp.stack(
        [jnp.stack([jax.grad(lambda k, i=i, t=t: closed_form(k, t)[i])(k) for i in (0, 1)]) for t in times]
    )
    np.testing.assert_allclose(forward, true, rtol=0, atol=1e-8)
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-13)
    batch = jax.vmap(end)(jnp.array([1.3, 0.4]))
    np.testing.assert_allclose(batch[0], exact, rtol=0, atol=1e-9)


def test_single_precision_stays():
    with pytest.warns(hhtjax.PrecisionWarning):
        run = first_order(jnp.asarray(1.3, jnp.float32), dt=0.1, num_steps=20)
    assert run.q.dtype == run.v.dtype == jnp.float32
    np.testing.assert_allclose(run.q[-1], jnp.stack(closed_form(1.3, 2.0)), rtol=3e-6)


def test_internal_states_and_events():
    """A ball that bounces and cools: e = 1/2, z' = -z."""
    system = hhtjax.System(
        jnp.ones(1), lambda q, v, z, t, params: jnp.full(1, -9.81), internal=lambda q, v, z, t, params: -z * params
    )
    ground = hhtjax.Event(lambda q, v, z, t, params: q[0], reset=lambda q, v, z, t, params: -0.5 * v)
    run = hhtjax.simulate(
        system, hhtjax.taylor(order=8), jnp.array([1.0]), jnp.array([0.0]), 0.5, z0=jnp.array([2.0]),
        dt=hhtjax.adaptive(1e-10, 1e-10, dt_max=0.2), times=jnp.array([0.3, 0.6, 1.0]), events=[ground],
    )  # fmt: skip
    run.check()
    fall = np.sqrt(2 / 9.81)
    assert abs(float(run.events.t[0]) - fall) < 1e-14
    s = np.array([0.6, 1.0]) - fall
    q = np.array([1 - 9.81 * 0.3**2 / 2, *(9.81 * fall / 2 * s - 9.81 * s * s / 2 * np.array([1, 1]))])
    inside = s < fall
    np.testing.assert_allclose(run.q[1:3, 0], q[:2], rtol=0, atol=1e-13)
    assert inside[0]
    np.testing.assert_allclose(run.z[:, 0], 2 * np.exp(-0.5 * np.array([0, 0.3, 0.6, 1.0])), rtol=1e-10)


REFUSED = {
    "abs": lambda q: jnp.abs(q),
    "gt": lambda q: jnp.where(q > 0, q, 2 * q),
    "max": lambda q: jnp.maximum(q, 0.1),
    "floor": lambda q: q - jnp.floor(q),
    "while": lambda q: jax.lax.while_loop(lambda x: jnp.sum(x * x) > 1, lambda x: x / 2, q),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_series_is_refused_by_name_and_line(name):
    system = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -REFUSED[name](q))
    with pytest.raises(NotImplementedError, match=rf"taylor: {name}, in test_taylor.py, line \d+.*dopri5\(\)"):
        hhtjax.simulate(system, hhtjax.taylor(order=4), jnp.ones(1), jnp.zeros(1), dt=0.1, num_steps=2)


def test_bad_orders_and_tolerances_are_told():
    spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q)
    start = jnp.ones(1), jnp.zeros(1)
    with pytest.raises(ValueError, match="`order` must be from 2 to 40; received 1"):
        hhtjax.taylor(order=1)
    with pytest.raises(ValueError, match="positive integer; received"):
        hhtjax.taylor(order=2.5)
    with pytest.raises(ValueError, match="taylor: give `order`"):
        hhtjax.simulate(spring, hhtjax.taylor(), *start, dt=0.1, num_steps=2)
    with pytest.raises(ValueError, match="if the tolerance is traced"):
        jax.jit(
            lambda tol: hhtjax.simulate(spring, hhtjax.taylor(), *start, dt=hhtjax.adaptive(tol, tol), times=[1.0])
        )(1e-6)
    table = hhtjax.sampled(jnp.zeros(5), 0.1)
    driven = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q + params(t))
    with pytest.raises(NotImplementedError, match=r"taylor: .* has no Taylor series"):
        hhtjax.simulate(driven, hhtjax.taylor(order=4), *start, table, dt=0.1, num_steps=2)
