"""Rosenbrock methods: their stability functions, orders, one factorisation, derivatives, wrong arguments."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient
from jax.extend.core import jaxprs_in_params
from zoo import PROBLEMS, ends_of_two, reference, run

import hhtjax

METHODS = {
    "rosenbrock(0)": hhtjax.rosenbrock(),
    "rosenbrock(.5)": hhtjax.rosenbrock(0.5),
    "rosenbrock(1)": hhtjax.rosenbrock(1.0),
    "rowda": hhtjax.rowda(),
    "rodas5p": hhtjax.rodas5p(),
}
RADIUS = {"rosenbrock(0)": 0.0, "rosenbrock(.5)": 0.5, "rosenbrock(1)": 1.0, "rowda": 0.0, "rodas5p": 0.0}


def stability_function(method):
    """Numerator and denominator of R(z), lowest power first: (1 - g z)^s R(z) is (1 - g z)^s e^z up to z^order.

    Beyond that order the numerator is zero: both kinds of method have as many stages, or one more, and that one
    is the stage that makes R(infinity) zero.
    """
    stages, g = len(method.tableau.A), method.tableau.g
    denominator = np.polynomial.Polynomial([1, -g]) ** stages
    exponential = np.polynomial.Polynomial([1, 1, 1 / 2, 1 / 6])
    return (denominator * exponential).coef[: method.order + 1], denominator.coef


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in METHODS if name != "rodas5p"])  # whose R order alone does not fix
def test_an_oscillator_takes_the_stability_function_of_its_matrix(name):
    """Position and velocity after a step are R(h A) (q, v), for (q, v)' = A (q, v)."""
    m, c, k, h = 2.0, 0.6, 50.0, 0.3
    method, system = METHODS[name], hhtjax.System(jnp.array([m]), lambda q, v, t, params: -c * v - k * q)

    def step(x):
        state, _ = method.step(system, method.init(system, x[:1], x[1:], None, h), None, h)
        return jnp.concatenate([state.q, state.v])

    def polynomial(coefficients, z):
        return sum(x * np.linalg.matrix_power(z, i) for i, x in enumerate(coefficients))

    numerator, denominator = stability_function(method)
    z = h * np.array([[0, 1], [-k / m, -c / m]])
    exact = polynomial(numerator, z) @ np.linalg.inv(polynomial(denominator, z))
    np.testing.assert_allclose(jax.jacfwd(step)(jnp.array([0.3, -0.2])), exact, rtol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_radius_at_infinity_and_stability(name):
    """Of the undamped oscillator; eigenvalues by autodiff of the step, from a hundredth of a period to 1e8 of them."""
    method, system = METHODS[name], hhtjax.System(jnp.ones(1), lambda q, v, t, params: -(params**2) * q)

    def matrix(frequency):
        def step(x):
            state = method.init(system, x[:1], frequency * x[1:], frequency, 1.0)
            state, _ = method.step(system, state, frequency, 1.0)
            return jnp.concatenate([state.q, state.v / frequency])

        return jax.jacfwd(step)(jnp.ones(2))

    radii = np.abs(np.linalg.eigvals(jax.vmap(matrix)(jnp.logspace(-2, 8, 81)))).max(axis=1)
    assert np.all(radii <= 1 + 1e-12)
    assert radii[-1] == pytest.approx(RADIUS[name], abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "order"), [("rosenbrock(0)", 2), ("rowda", 3), ("rodas5p", 5)])
def test_order_of_position_and_acceleration_with_a_mass_that_changes(name, order):
    """The acceleration is compared with that of the state it belongs to."""
    problem = PROBLEMS["forced double pendulum"]
    errors = []
    for found, end in ends_of_two(problem, METHODS[name], 100):
        t, q, v, w = (x[end] for x in found[:4])
        exact = jnp.linalg.solve(problem.system.mass(q, problem.params), problem.system.force(q, v, t, problem.params))
        errors.append([np.linalg.norm(q - reference("forced double pendulum")), np.linalg.norm(w - exact)])
    found = np.log2(np.divide(*errors))
    if name == "rodas5p":  # whose last residual falls faster
        assert found[1] > order - 0.15
        found = found[:1]
    assert found == pytest.approx(order, abs=0.15)


@pytest.mark.slow
def test_a_linear_system_equals_the_general_one_with_derivatives_and_factorises_once():
    n = 9
    K = 40 * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    M, C = np.diag(np.linspace(1, 2, n)) + 0.1, 0.002 * K

    def load(t, params):
        return params["f"] * jnp.sin(3 * t) * jnp.linspace(0.0, 1.0, n)

    def force(q, v, t, params):
        return load(t, params) - C @ v - params["k"] * (K @ q)

    def size(system, params):
        path = hhtjax.simulate(
            system, METHODS["rosenbrock(0)"], jnp.ones(n), jnp.zeros(n), params, dt=0.01, num_steps=20, save_every=20
        )
        return jnp.sum(path.q[-1] ** 2)

    linear, general = hhtjax.LinearSystem(M, C, lambda params: params["k"] * K, load), hhtjax.System(M, force)
    params = {"f": 2.0, "k": 1.3}
    results = []
    for system, in_the_loop in ((linear, 0), (general, 1)):
        results.append(jax.jit(jax.value_and_grad(partial(size, system)))(params))
        jaxpr = jax.make_jaxpr(partial(size, system))(params).jaxpr
        assert count(jaxpr, "lu", within="scan") == in_the_loop
        assert count(jaxpr, "lu") == 2  # with the one of M at the start
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-9), *results)


def count(jaxpr, primitive, within=None):
    """Equations of a primitive in a jaxpr and in all that it calls; `within`: only those under this other one."""
    total = 0
    for equation in jaxpr.eqns:
        total += equation.primitive.name == primitive and within is None
        inner = None if equation.primitive.name == within else within
        total += sum(count(x, primitive, inner) for x in jaxprs_in_params(equation.params))
    return total


@pytest.mark.slow
def test_gradient_with_respect_to_rho():
    problem = PROBLEMS["forced Duffing"]

    def loss(rho):
        path = run(problem, hhtjax.rosenbrock(rho), 40)
        return jnp.sum(path.q**2)

    check_gradient(loss, jnp.asarray(0.5))


@pytest.mark.parametrize(("error", "value"), [(ValueError, 1.5), (ValueError, -0.1), (TypeError, "zero")])
def test_wrong_rho(error, value):
    with pytest.raises(error, match="rosenbrock: `rho_inf` must"):
        hhtjax.rosenbrock(value)
