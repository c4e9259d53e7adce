"""Methods as numbers: their conditions of order, a rooted tree each, and those of estimates and dense output."""

from functools import cache
from math import prod

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ONE, SPRING, ZERO, run
from scipy.integrate import solve_ivp

import hhtjax
from hhtjax.scenes import double_pendulum
from hhtjax.steppers import tableaus

EXPLICIT = {  # tableau: order, of the embedded methods, and of dense output
    tableaus.CLASSICAL: (4, (), 3),
    tableaus.TSITOURAS: (5, (4,), 4),
    tableaus.DORMAND_PRINCE: (5, (4,), 4),
    tableaus.DOP853: (8, (5, 3), 7),
}
IMPLICIT = {tableaus.ROWDA: (3, (2,), 3), tableaus.RODAS5P: (5, (4,), 4)}


@cache
def trees(order):
    """Rooted trees with so many vertices, each the sorted tuple of the trees that hang from its root."""
    return [()] if order == 1 else sorted({x for tree in trees(order - 1) for x in with_a_leaf(tree)})


def with_a_leaf(tree):
    """The trees with one more leaf, at each of the vertices."""
    yield tuple(sorted((*tree, ())))
    for i, child in enumerate(tree):
        yield from (tuple(sorted((*tree[:i], x, *tree[i + 1 :]))) for x in with_a_leaf(child))


def vertices(tree):
    return 1 + sum(map(vertices, tree))


def density(tree):
    return vertices(tree) * prod(map(density, tree))


def weights_of(tree, A, of_one):
    """(stages,) of a tree; of_one: the matrix behind a vertex from which a single tree hangs."""
    children = [(of_one if len(tree) == 1 else A) @ weights_of(x, A, of_one) for x in tree]
    return np.prod(children, axis=0) if tree else np.ones(len(A))


def defects(b, A, of_one, order, s=1.0):
    """What the conditions of order up to this are off by at the part s of a step."""
    found = [b @ weights_of(tree, A, of_one) - s**n / density(tree) for n in range(1, order + 1) for tree in trees(n)]
    return np.abs(found)


def filled(rows, size):
    return np.array(tableaus.filled(rows, size))


def dense_weights(tableau, s, b, first, last):
    """Those of the state at the part s of a step. b, first, last: of its end, and of the rates at its start and end."""
    cubic = s**2 * (3 - 2 * s) * b + s * (1 - s) ** 2 * first - s**2 * (1 - s) * last
    rows = () if tableau.dense is None else filled(tableau.dense, b.size)
    return cubic + (s * (1 - s)) ** 2 * sum((s**k * row for k, row in enumerate(rows)), 0 * b)


def test_numbers_of_trees():
    assert [len(trees(n)) for n in range(1, 9)] == [1, 1, 2, 4, 9, 20, 48, 115]


@pytest.mark.parametrize(("tableau", "orders"), EXPLICIT.items(), ids=lambda x: getattr(x, "name", ""))
def test_explicit_methods_satisfy_their_conditions(tableau, orders):
    order, embedded, dense = orders
    number = len(tableau.b) + 1 + len(tableau.extra)
    A = filled(((), *tableau.A, tableau.b, *tableau.extra), number)
    (b, first), last = filled((tableau.b, (1.0,)), number), np.eye(number)[len(tableau.b)]
    assert np.max(defects(b, A, A, order)) < 1e-13
    assert np.max(defects(b, A, A, order + 1)) > 1e-6  # and no more
    for error, of in zip((tableau.error, tableau.error_of_3), embedded, strict=False):
        other = b - filled((error,), number)[0]
        assert np.max(defects(other, A, A, of)) < 1e-13
        assert np.max(defects(other, A, A, of + 1)) > 1e-6
    for s in (0.3, 0.8):
        weights = dense_weights(tableau, s, b, first, last)
        assert np.max(defects(weights, A, A, dense, s)) < 1e-13
        assert np.max(defects(weights, A, A, dense + 1, s)) > 1e-7


@pytest.mark.parametrize(("tableau", "orders"), IMPLICIT.items(), ids=lambda x: getattr(x, "name", ""))
def test_rosenbrock_methods_satisfy_theirs(tableau, orders):
    """A vertex from which one tree hangs takes a derivative of the first order, which the Jacobian knows, too."""
    order, (embedded,), _ = orders
    number = len(tableau.b)
    A = filled(tableau.A, number)
    both = A + filled(tableau.G, number) + tableau.g * np.eye(number)
    for b, of in ((tableau.b, order), (tableau.embedded, embedded)):
        assert np.max(defects(np.array(b), A, both, of)) < (1e-13 if tableau.name == "rodas5p" else 1e-8)
        assert np.max(defects(np.array(b), A, both, of + 1)) > 1e-6


@pytest.fixture(scope="module")
def swinging():
    """The free double pendulum, and its states at some times by SciPy."""
    scene, times = double_pendulum.free(hhtjax.trigonometry), np.array([0.3, 0.77, 1.2, 1.9, 2.5])
    rhs = hhtjax.interop.scipy_rhs(scene.system, scene.q0, scene.v0, scene.params)
    found = solve_ivp(rhs.fun, (0, 2.5), rhs.y0, "DOP853", times, rtol=1e-13, atol=1e-14)
    return scene, times, found.y.T


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [hhtjax.tsit5(), hhtjax.dop853(), hhtjax.rodas5p()], ids=lambda x: x.name)
def test_errors_between_steps_follow_the_tolerance(stepper, swinging):
    """At times that lie within steps, of q and v, from 1e-4 to 1e-10: one program."""
    (system, params, q0, v0, _), times, exact = swinging
    for rtol in (1e-4, 1e-7, 1e-10):
        dt = hhtjax.adaptive(jnp.asarray(rtol), jnp.asarray(1e-2 * rtol))
        found = hhtjax.simulate(system, stepper, q0, v0, params, dt=dt, times=times)
        error = np.max(abs(np.concatenate([found.q[1:], found.v[1:]], axis=1) - exact))
        assert 1e-3 < error / rtol < 10


@pytest.mark.slow
def test_dense_output_of_a_rosenbrock_method_is_of_its_order():
    """Between equal steps: of order 4, where cubics alone are of order 3 in the local error, and larger."""
    times = np.linspace(0.0, 2.0, 64)[1:]

    def errors(stepper, dt):
        found = run(SPRING, stepper, dt=dt, num_steps=None, times=times)
        return np.array([
            np.max(abs(found.q[1:, 0] - np.cos(2 * times))), np.max(abs(found.v[1:, 0] + 2 * np.sin(2 * times)))
        ])  # fmt: skip

    method = hhtjax.rodas5p()
    coarse, fine = errors(method, 0.1), errors(method, 0.05)
    assert np.all(np.log2(coarse / fine) > 4)
    cubics = hhtjax.steppers.Rosenbrock(method.tableau._replace(dense=None), 5)
    assert np.all(20 * fine < errors(cubics, 0.05))


def test_an_error_of_two_estimates():
    """e^2 / (e^2 + e3^2 / 100)^(1/2), 0 where both are, and no square that underflows."""
    from hhtjax.steppers.runge_kutta import errors_of

    tableau = tableaus.ExplicitTableau("", ((1.0,),), (0.5, 0.5), (1.0, 0.0, 0.0), 1, error_of_3=(0.0, 10.0))
    rates = [jnp.array([[3.0, 0.0, 3e-200]]), jnp.array([[4.0, 0.0, 4e-200]]), jnp.zeros((1, 3))]
    np.testing.assert_allclose(errors_of(tableau, jnp.ones(()), rates), [[9 / 5, 0.0, 9e-200 / 5]], rtol=1e-14)


@pytest.mark.slow
def test_a_method_of_ones_own_is_its_numbers():
    """Kutta's third-order method: of order 3 as its class runs it, with an acceleration of M^-1 Q."""
    tableau = hhtjax.steppers.ExplicitTableau("Kutta", A=((0.5,), (-1.0, 2.0)), b=(1 / 6, 2 / 3, 1 / 6))
    kutta = hhtjax.steppers.RungeKutta(tableau, order=3)
    errors = [abs(run(SPRING, kutta, ONE, ZERO, dt=1 / n, num_steps=n).q[-1, 0] - np.cos(2.0)) for n in (20, 40)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(3, abs=0.15)
