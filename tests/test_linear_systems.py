"""Algebra that must hold exactly: linear systems, where every form of a method is the same map."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from zoo import as_data

import hhtjax

FAMILIES = {
    "trapezoidal": (hhtjax.newmark, {}, (0.0, 0.0, 0.25, 0.5)),
    "hht(0)": (hhtjax.hht, {"alpha": 0.0}, (0.0, 0.0, 0.25, 0.5)),
    "hht(-.05)": (hhtjax.hht, {"alpha": -0.05}, (0.0, 0.05, 1.05**2 / 4, 0.55)),
    "hht(-.3)": (hhtjax.hht, {"alpha": -0.3}, (0.0, 0.3, 1.3**2 / 4, 0.8)),
    "bossak(-.1)": (hhtjax.bossak, {"alpha": -0.1}, (-0.1, 0.0, 1.1**2 / 4, 0.6)),
    "generalized_alpha(.5)": (hhtjax.generalized_alpha, {"rho_inf": 0.5}, (0.0, 1 / 3, (4 / 3) ** 2 / 4, 5 / 6)),
}
FORMS = [{"linearize": x} for x in ("predictor", "held", "state", "auto")] + [{"iterations": 2}, {"iterations": None}]


def closed_form(coefficients, m, c, k, h):
    """The step as a matrix on (q, v, w, a): four linear equations in the four new values."""
    am, af, beta, gamma = coefficients
    new = np.array(
        [
            [1, 0, 0, -beta * h**2],
            [0, 1, 0, -gamma * h],
            [k, c, m, 0],
            [0, 0, -(1 - af), 1 - am],
        ]
    )
    old = np.array([[1, h, 0, (0.5 - beta) * h**2], [0, 1, 0, (1 - gamma) * h], [0, 0, 0, 0], [0, 0, af, -am]])
    return np.linalg.solve(new, old)


@jax.jit
def jacobian(stepper, system, h, params):
    """Of the library's own step, in (q, v, w, a)."""

    def step(x):
        state = stepper.init(system, x[:1], x[1:2], params, h)
        state = state._replace(q=x[:1], v=x[1:2], w=x[2:3], a=x[3:])
        state, _ = stepper.step(system, state, params, h)
        return jnp.concatenate([state.q, state.v, state.w, state.a])

    return jax.jacfwd(step)(jnp.array([0.3, -0.2, 0.1, 0.4]))


def by_autodiff(stepper, system, h, params):
    """The matrix of `closed_form`; compiled once for a family."""
    return jacobian(as_data(stepper), system, h, params)


def spring_and_damper(q, v, t, params):
    return -params["c"] * v - params["k"] * q


def stiffness(params):
    return jnp.array([params])


@pytest.mark.parametrize("form", FORMS, ids=str)
@pytest.mark.parametrize("family", FAMILIES)
def test_every_form_has_the_closed_form_amplification_matrix(family, form):
    make, arguments, coefficients = FAMILIES[family]
    m, c, k, h = 2.0, 0.6, 50.0, 0.3
    exact = closed_form(coefficients, m, c, k, h)
    if form == {"linearize": "state"}:
        exact[2] = -(k * exact[0] + c * exact[1]) / m  # the refreshed acceleration obeys the equation of motion
    system = hhtjax.System(jnp.array([m]), spring_and_damper)
    found = by_autodiff(make(**arguments, **form), system, h, {"c": c, "k": k})
    np.testing.assert_allclose(found, exact, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_linear_system_factorised_once_takes_the_same_step(family):
    make, arguments, coefficients = FAMILIES[family]
    m, c, k, h = 2.0, 0.6, 50.0, 0.3
    system = hhtjax.LinearSystem(jnp.array([m]), jnp.array([c]), stiffness)
    exact = closed_form(coefficients, m, c, k, h)
    np.testing.assert_allclose(by_autodiff(make(**arguments), system, h, k), exact, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("family", "radius"), [("hht(-.05)", 0.95 / 1.05), ("hht(-.3)", 0.7 / 1.3), ("bossak(-.1)", 0.9 / 1.1)]
)
def test_spectral_radius_at_infinity(family, radius):
    make, arguments, _ = FAMILIES[family]
    system = hhtjax.System(jnp.array([1.0]), spring_and_damper)
    A = by_autodiff(make(**arguments, linearize="predictor"), system, 1.0, {"c": 0.0, "k": 1e14})
    assert max(abs(np.linalg.eigvals(A))) == pytest.approx(radius, rel=1e-6)


def test_trapezoidal_rule_conserves_the_energy_of_an_oscillator():
    system = hhtjax.LinearSystem(jnp.array([1.0]), None, jnp.array([1e4]))
    path = hhtjax.simulate(system, hhtjax.hht(alpha=0.0), jnp.array([1.0]), jnp.array([0.0]), dt=0.05, num_steps=10_000)
    energy = path.v[:, 0] ** 2 / 2 + 1e4 * path.q[:, 0] ** 2 / 2
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)


def matrices(n):
    rng = np.random.default_rng(1)
    K = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    return np.diag(rng.uniform(1, 2, n)) + 0.1, 0.02 * K + 0.01 * np.eye(n), 40 * K


def end_of_linear_and_general(n, **form):
    """Functions of the parameters: the end of a run of the same system, described in both ways, on a dict."""
    M, C, K = matrices(n)
    direction = jnp.linspace(0.0, 1.0, n)
    zero = {"x": jnp.zeros(n)}

    def load(t, params):
        return {"x": params["f"] * jnp.sin(3 * t) * direction}

    def force(q, v, t, params):
        return {"x": load(t, params)["x"] - C @ v["x"] - params["k"] * (jnp.asarray(K) @ q["x"])}

    def end(system, params):
        stepper = hhtjax.hht(alpha=-0.1, **form)
        return hhtjax.simulate(system, stepper, zero, zero, params, dt=0.03, num_steps=32).q["x"][-1]

    linear = hhtjax.LinearSystem(M, C, lambda params: params["k"] * jnp.asarray(K), load)
    return partial(end, linear), partial(end, hhtjax.System(M, force))


PARAMS = {"f": 2.0, "k": 1.3}


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, 12])
@pytest.mark.parametrize("form", [{}, {"iterations": None, "tolerance": 1e-11}], ids=str)
def test_linear_system_equals_the_general_one(n, form):
    linear, general = end_of_linear_and_general(n, **form)
    np.testing.assert_allclose(linear(PARAMS), general(PARAMS), rtol=1e-9)


@pytest.mark.slow
def test_linear_system_has_the_gradient_of_the_general_one():
    linear, general = end_of_linear_and_general(3)
    weights = jnp.array([1.0, -0.7, 0.4])

    @jax.jit
    def derivatives(p):
        reverse = jax.grad(lambda p: weights @ linear(p))(p)
        return jax.jacfwd(linear)(p), reverse, jax.jacfwd(general)(p)

    ours, reverse, theirs = derivatives(PARAMS)
    for name in PARAMS:
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(reverse[name], weights @ theirs[name], rtol=1e-7, atol=1e-12)


@pytest.mark.slow
def test_diagonal_and_missing_matrices_equal_the_full_ones():
    n = 3
    K = jnp.array([4.0, 9.0, 16.0])
    ends = [
        hhtjax.simulate(
            hhtjax.LinearSystem(M, C, stiffness), hhtjax.hht(), jnp.ones(n), jnp.zeros(n), dt=0.05, num_steps=40
        ).q[-1]
        for M, C, stiffness in (
            (jnp.ones(n), None, K),
            (jnp.eye(n), jnp.zeros((n, n)), jnp.diag(K)),
            (lambda params: jnp.eye(n), jnp.zeros(n), lambda params: K),
        )
    ]
    for end in ends[1:]:
        np.testing.assert_allclose(end, ends[0], rtol=1e-12)


def short_runs(system, q0, load, dt):
    """The ends of 20 runs of 5 steps, one after the other."""

    def period(carry, t0):
        run = hhtjax.simulate(system, hhtjax.hht(), *carry, load, t0=t0, dt=dt, num_steps=5, save_every=5)
        return (run.q[-1], run.v[-1]), run.q[-1]

    return jax.lax.scan(period, (q0, jnp.zeros_like(q0)), 0.05 * jnp.arange(20.0))[1]


def loaded(K, n):
    M, C, _ = matrices(n)
    return hhtjax.LinearSystem(M, C, K, force=lambda t, load: load * jnp.cos(3 * t) * jnp.linspace(0.0, 1.0, n))


@pytest.mark.slow
def test_linear_systems_are_factorised_outside_of_loops():
    """Of their steps, and of the user's around short runs: what is constant is so before XLA sees it, else M, and the
    matrices of the start and of the step, once."""
    n = 12
    K = jnp.asarray(matrices(n)[2])

    def text(f, *args):
        return jax.jit(f).lower(*args).compile().as_text()

    constant = text(lambda q0: short_runs(loaded(K, n), q0, 1.0, 0.01), jnp.ones(n))
    assert "getrf" not in constant
    traced = text(lambda q0, K: short_runs(loaded(K, n), q0, 1.0, 0.01), jnp.ones(n), K)
    (entry,) = (part for part in traced.split("\n\n") if "ENTRY" in part)
    assert traced.count('"lapack_dgetrf_ffi"') == entry.count('"lapack_dgetrf_ffi"') == 3


@pytest.mark.slow
def test_factors_made_before_change_no_value_and_no_derivative():
    n = 12
    K = jnp.asarray(matrices(n)[2])

    @jax.jit
    def both(q0, load, dt, K):
        def known(load):
            return short_runs(loaded(np.asarray(matrices(n)[2]), n), q0, load, 0.01)[-1]

        def traced(load):
            return short_runs(loaded(K, n), q0, load, dt)[-1]

        return [known(load), jax.jacfwd(known)(load), jax.grad(lambda x: known(x).sum())(load)], traced(load)

    (end, tangent, gradient), other = both(jnp.ones(n), 2.0, 0.01, K)
    np.testing.assert_allclose(end, other, rtol=1e-9, atol=1e-11)
    h = 1e-3
    difference = (both(jnp.ones(n), 2.0 + h, 0.01, K)[1] - both(jnp.ones(n), 2.0 - h, 0.01, K)[1]) / (2 * h)
    np.testing.assert_allclose(tangent, difference, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(gradient, jnp.sum(tangent), rtol=1e-9)


@pytest.mark.slow
def test_diagonal_systems_are_stepped_without_a_matrix():
    """Also beside a force at few coordinates: no array (n, n) anywhere in the program of a run."""
    n = 37
    k = jnp.linspace(1.0, 100.0, n)
    systems = [
        hhtjax.LinearSystem(jnp.ones(n), 0.01 * k, lambda params: params * k),
        hhtjax.LinearSystem(jnp.ones(n), None, k, nonlinear=lambda q, v, t, params: -params * q**3, at=[3]),
    ]
    for system in systems:
        for stepper in (hhtjax.hht(), hhtjax.hht(iterations=None), hhtjax.rosenbrock()):
            run = partial(hhtjax.simulate, system, stepper, jnp.ones(n), jnp.zeros(n), dt=0.01, num_steps=3)
            assert f"[{n},{n}]" not in str(jax.make_jaxpr(lambda p, run=run: run(params=p).q)(1.0))


def end_of_diagonal(form, stepper, beside, params):
    """Of a run of the same system, its matrices as vectors or in full."""
    n = 3
    k = jnp.array([4.0, 9.0, 160.0])
    system = hhtjax.LinearSystem(form(jnp.ones(n)), form(0.01 * k), lambda p: form(p * k), **beside)
    return hhtjax.simulate(system, stepper, jnp.ones(n), jnp.zeros(n), params, dt=0.05, num_steps=20).q[-1]


EVERYWHERE = {"nonlinear": lambda q, v, t, params: -params * q**3}
RUBBING = {"friction": lambda q, v, t, params: 0.1 * jnp.ones(3)}
MADE = {
    "a solve of one's own": ({}, hhtjax.hht(solve=lambda A, b: jnp.linalg.inv(A) @ b)),
    "rowda": ({}, hhtjax.rowda()),
    "nonlinear": (EVERYWHERE, hhtjax.hht()),
    "friction": (RUBBING, hhtjax.hht(linearize="predictor")),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", MADE)
def test_diagonal_systems_move_as_full_ones(case):
    beside, stepper = MADE[case]
    ours, theirs = (end_of_diagonal(form, stepper, beside, 1.3) for form in (jnp.asarray, jnp.diag))
    np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_diagonal_systems_have_the_derivatives_of_full_ones():
    weights = jnp.array([1.0, -0.7, 0.4])

    @jax.jit
    def derivatives(p):
        """Forward of both, reverse of ours: of one weighted sum."""
        ours, theirs = (partial(end_of_diagonal, form, hhtjax.hht(), {}) for form in (jnp.asarray, jnp.diag))
        return [jax.jvp(f, (p,), (1.0,)) for f in (ours, theirs)], jax.grad(lambda p: weights @ ours(p))(p)

    (ours, theirs), reverse = derivatives(1.3)
    for x, y in zip((*ours, reverse), (*theirs, weights @ theirs[1]), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-10, atol=1e-12)
