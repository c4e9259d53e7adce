"""Operator splitting: its order, its identities with other methods, its limits of stability."""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient, path_loss
from zoo import EVERY, PROBLEMS, Problem, run

import hhtjax
from hhtjax import operator_splitting

ALPHAS = (0.0, -0.05, -0.3)
every_form = pytest.mark.parametrize("modified", [False, True], ids=["standard", "modified"])
every_alpha = pytest.mark.parametrize("alpha", ALPHAS)

M = jnp.array([[2.0, 0.3], [0.3, 1.0]])
C = jnp.array([[0.9, -0.2], [-0.2, 0.5]])
K = jnp.array([[20.0, -5.0], [-5.0, 8.0]])


def problem(force, mass=M):
    """Two degrees of freedom, `force(q, v, t)`."""
    system = hhtjax.System(mass, lambda q, v, t, params: force(q, v, t))
    return Problem(system, None, jnp.array([0.5, -0.3]), jnp.array([0.5, -1.0]), 1.0)


# orders of the standard form, and of the modified one for alpha other than 0
ORDERS = {
    "damping": (problem(lambda q, v, t: -K @ q - C @ v), 2, 1),
    "stiffness, input": (problem(lambda q, v, t: -K @ q - 10 * q**3 + jnp.sin(5 * t)), 2, 2),
    "stiffness, input, damping": (PROBLEMS["forced Duffing"], 2, 1),
    "nonlinear damping": (problem(lambda q, v, t: -K @ q - C @ v - v**3), 1, 1),
    "damping that depends on q": (problem(lambda q, v, t: -K @ q - (1 + 20 * q**2) * v), 1, 1),
    "M(q) and the forces of its velocity": (PROBLEMS["double pendulum"], 1, 1),
}


@partial(jax.jit, static_argnames="modified")
def ends(problem, num_steps, modified=False):
    """q at the end for each of ALPHAS; one compilation for every num_steps."""
    system, params, q0, v0, duration = problem

    def end(alpha):
        stepper = operator_splitting(alpha, modified)
        start = stepper.init(system, q0, v0, params, duration / num_steps)
        step = partial(stepper.step, system, params=params, dt=duration / num_steps)
        return jax.lax.fori_loop(0, num_steps, lambda i, state: step(state)[0], start).q

    return jax.vmap(end)(jnp.array(ALPHAS))


def slopes(problem, modified=False):
    """Observed order for each of ALPHAS."""
    exact = run(problem, hhtjax.rk4(), 2000, save_every=2000).q[-1:]
    fine, finer = (np.linalg.norm(ends(problem, n, modified) - exact, axis=1) for n in (1000, 2000))
    return np.log2(fine / finer)


@pytest.mark.slow
@every_form
@pytest.mark.parametrize("name", ORDERS)
def test_order(name, modified):
    problem, standard, with_modified = ORDERS[name]
    expected = [with_modified if modified and alpha else standard for alpha in ALPHAS]
    np.testing.assert_allclose(slopes(problem, modified), expected, atol=0.15)


@every_form
def test_stated_order_is_the_one_for_constant_mass_and_damping(modified):
    _, standard, with_modified = ORDERS["stiffness, input, damping"]
    for alpha in ALPHAS:
        assert operator_splitting(alpha, modified).order == (with_modified if modified and alpha else standard)


def test_mass_alone_costs_an_order_with_alpha():
    """M(q) without the forces that it brings: M(q~) multiplies an acceleration of the time t + alpha h."""
    varying = problem(lambda q, v, t: -K @ q, lambda q, params: M + 4 * jnp.diag(q**2))
    np.testing.assert_allclose(slopes(varying)[[0, 2]], [2, 1], atol=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("linear", [False, True])
def test_a_linear_system_moves_as_with_hht(linear):
    def load(t, params):
        return jnp.array([0.0, 1.0]) * jnp.sin(3 * t)

    if linear:
        system = hhtjax.LinearSystem(M, lambda params: params * C, K, load)
    else:
        system = hhtjax.System(M, lambda q, v, t, params: load(t, params) - K @ q - params * C @ v)

    @partial(jax.jit, static_argnames="method")
    def path(method, alpha, damping):
        q0, v0 = jnp.array([0.5, -0.3]), jnp.array([0.5, -1.0])
        return hhtjax.simulate(system, method(alpha), q0, v0, damping, dt=0.1, num_steps=60)

    for alpha in ALPHAS:
        for damping in (0.0, 1.0):
            ours, theirs = (path(method, alpha, damping) for method in (operator_splitting, hhtjax.hht))
            np.testing.assert_allclose(ours.q, theirs.q, atol=1e-12)
            np.testing.assert_allclose(ours.v, theirs.v, atol=1e-12)
            w = theirs.acceleration
            # from the second step on: the first begins with what the saved w0 is not
            np.testing.assert_allclose(ours.acceleration[2:], (1 + alpha) * w[2:] - alpha * w[1:-1], atol=1e-11)


@every_alpha
def test_modified_form_weighs_no_damping(alpha):
    """On a linear system M a1 = -(1 + alpha) K q1 + alpha K q - C v1, and its path tells all of these."""
    system = hhtjax.LinearSystem(M, C, K)
    q0, v0 = jnp.array([0.5, -0.3]), jnp.array([0.5, -1.0])
    stepper = operator_splitting(jnp.asarray(alpha), modified=True)
    _, q, v, a, *_ = hhtjax.simulate(system, stepper, q0, v0, dt=0.1, num_steps=60)
    force = -(1 + alpha) * q[2:] @ K + alpha * q[1:-1] @ K - v[2:] @ C  # the first step begins with another a0
    np.testing.assert_allclose(a[2:] @ M, force, atol=1e-11)


def test_a_linear_first_order_system_moves_as_with_hht():
    decay = hhtjax.FirstOrderSystem(lambda y, t, params: -3.0 * y + jnp.sin(t))
    ours, theirs = (
        hhtjax.simulate(decay, stepper, jnp.array([1.0]), dt=0.1, num_steps=20).q
        for stepper in (operator_splitting(-0.1), hhtjax.hht(-0.1))
    )
    np.testing.assert_allclose(ours, theirs, atol=1e-13)


@every_form
def test_alpha_zero_is_velocity_verlet_with_a_heavier_mass(modified):
    """Second differences of q~ = q - h^2 a/4: (m + h^2 k0/4) dd q~ = h^2 Q(q~)."""
    scene = hhtjax.scenes.duffing.hardening_spring()
    h = 2e-3
    path = hhtjax.simulate(
        scene.system, operator_splitting(0.0, modified), scene.q0, scene.v0, scene.params, dt=h, num_steps=200
    )
    q = np.asarray(path.q - h**2 / 4 * path.acceleration)[:, 0]
    left = (1 + h**2 * 30100 / 4) * (q[2:] - 2 * q[1:-1] + q[:-2])
    np.testing.assert_allclose(left[1:], -(h**2) * (100 * q + 1e4 * q**3)[2:-1], atol=1e-12)


# of stiffness 1 at the start, and another as soon as t > 0
STIFFENED = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -jnp.where(t > 0, params, 1.0) * q)


def amplitudes(stiffness, alpha, dt):
    """In the first and in the last tenth of 20000 steps."""
    stepper = operator_splitting(jnp.asarray(alpha))
    path = hhtjax.simulate(STIFFENED, stepper, jnp.ones(1), jnp.zeros(1), stiffness, dt=dt, num_steps=20_000)
    q = np.abs(np.asarray(path.q)[:, 0])
    return q[:2000].max(), q[-2000:].max()


@pytest.mark.parametrize(("alpha", "stiffness"), [(0.0, 1.5), (0.0, 50.0), (-0.05, 3.0), (-0.3, 1.3)])
def test_limit_of_the_step_size(alpha, stiffness):
    limit = 2 / np.sqrt((1 - 4 * alpha**2) * (stiffness - 1) - (1 + 2 * alpha) * alpha**2)
    early, late = amplitudes(stiffness, alpha, 0.99 * limit)
    assert late < 1.01 * early
    early, late = amplitudes(stiffness, alpha, 1.01 * limit)
    assert not late < 10 * early


@pytest.mark.parametrize(("alpha", "small"), [(-0.05, 0.4), (-0.05, 0.6), (-0.3, 0.2), (-0.3, 0.3)])
def test_stiffening_beyond_a_bound_excites_however_small_the_step(alpha, small):
    """Growth, and below the bound decay, by alpha h^2 k (beta h^2 k0 + alpha h^2 k)/2 in a step."""
    bound = (1 - alpha) ** 2 / (-4 * alpha)
    for fraction in (0.7, 1.3):
        stiffness, dt = fraction * bound, small / np.sqrt(bound)
        early, late = amplitudes(stiffness, alpha, dt)
        rate = alpha * dt**4 * stiffness * ((1 - alpha) ** 2 / 4 + alpha * stiffness) / 2
        assert np.log(late / early) == pytest.approx(18_000 * rate, rel=0.15)


@every_alpha
def test_softening_is_stable_for_every_step_size(alpha):
    for dt in (1.0, 30.0, 1000.0):
        early, late = amplitudes(0.5, alpha, dt)
        assert late < 2 * early


@pytest.mark.slow
@every_form
def test_gradients(modified):
    problem = PROBLEMS["forced Duffing"]

    def loss(arguments):
        alpha, rest = arguments
        return path_loss(problem, operator_splitting(alpha, modified), 30, 1)(rest)

    check_gradient(loss, (-0.1, (problem.params, problem.q0, problem.v0, 0.02, 0.1)))


@pytest.mark.slow
@pytest.mark.parametrize("modified", [False, pytest.param(True, marks=EVERY)])
def test_gradients_on_the_double_pendulum(modified):
    problem = PROBLEMS["double pendulum"]
    arguments = problem.params, problem.q0, problem.v0, 0.02, 0.1
    check_gradient(path_loss(problem, operator_splitting(-0.1, modified), 40, 40), arguments)


@pytest.mark.slow
@every_form
def test_jit_equals_eager_through_init_and_step(modified):
    problem = PROBLEMS["forced double pendulum"]
    stepper = operator_splitting(-0.1, modified)
    compiled = run(problem, stepper, 2)
    with jax.disable_jit():
        state = stepper.init(problem.system, problem.q0, problem.v0, problem.params, problem.duration / 2)
        for _ in range(2):
            state, _ = stepper.step(problem.system, state, problem.params, problem.duration / 2)
    np.testing.assert_allclose(compiled.q[-1], state.q, rtol=1e-10)
    np.testing.assert_allclose(compiled.acceleration[-1], state.w, rtol=1e-9)


@pytest.mark.slow
@every_form
def test_vmap_equals_loop(modified):
    problem = PROBLEMS["forced Duffing"]
    alphas, starts, dts = jnp.array([0.0, -0.1, -0.3]), jnp.array([[0.1], [0.5], [-0.4]]), jnp.array([0.02, 0.05, 0.1])

    def end(alpha, q0, dt):
        stepper = operator_splitting(alpha, modified)
        return hhtjax.simulate(problem.system, stepper, q0, problem.v0, problem.params, dt=dt, num_steps=30).q[-1]

    loop = [end(float(alpha), q0, dt) for alpha, q0, dt in zip(alphas, starts, dts, strict=True)]
    np.testing.assert_allclose(jax.vmap(end)(alphas, starts, dts), jnp.stack(loop), rtol=1e-11)


@pytest.mark.slow
@every_form
def test_float32_is_kept(modified):
    problem = PROBLEMS["forced Duffing"]
    q0, v0 = (x.astype(jnp.float32) for x in (problem.q0, problem.v0))
    stepper = operator_splitting(-0.1, modified)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category=hhtjax.PrecisionWarning)
        path = hhtjax.simulate(problem.system, stepper, q0, v0, problem.params, dt=0.02, num_steps=100)
        state = stepper.init(problem.system, q0, v0, problem.params, dt=0.02)
        state, _ = stepper.step(problem.system, state, problem.params, dt=0.02)
    path.check()
    assert {x.dtype for x in jax.tree.leaves((path[:4], state))} == {jnp.dtype("float32")}
    np.testing.assert_allclose(path.q, run(problem, stepper, 100).q, atol=1e-4)


@pytest.mark.slow
def test_trees_are_kept():
    def force(q, v, t, params):
        return {"b": -9.0 * q["b"] - 0.5 * v["b"] - q["a"][0] ** 3, "a": -4.0 * q["a"] - q["b"]}

    system = hhtjax.System(jnp.array([2.0, 3.0]), force)  # a diagonal mass, rows: a, b
    full = hhtjax.System(jnp.diag(jnp.array([2.0, 3.0])), force)
    q0, v0 = {"b": jnp.asarray(0.2), "a": jnp.array([0.5])}, {"b": jnp.asarray(-1.0), "a": jnp.array([0.0])}

    @jax.jit
    def two_steps():
        stepper = operator_splitting()
        state = stepper.init(system, q0, v0, None, dt=0.02)
        for _ in range(2):
            state, _ = stepper.step(system, state, None, dt=0.02)
        return state

    state = two_steps()
    path = hhtjax.simulate(full, operator_splitting(), q0, v0, dt=0.02, num_steps=2)
    for ours, theirs in ((state.q, path.q), (state.v, path.v), (state.w, path.acceleration)):
        assert jax.tree.structure(ours) == jax.tree.structure(theirs) == jax.tree.structure(q0)
        for x, y in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
            np.testing.assert_allclose(x, y[-1], rtol=1e-12)


def test_a_constant_mass_is_factorised_outside_the_loop():
    """Counted in the compiled run: the LU of the step stands outside every loop, though the system is nonlinear."""
    n = 24
    system = hhtjax.System(jnp.eye(n) + 0.1, lambda q, v, t, params: -q - q**3)

    def end(q0):
        return hhtjax.simulate(system, operator_splitting(), q0, jnp.zeros(n), dt=0.01, num_steps=1000).q[-1]

    text = jax.jit(end).lower(jnp.zeros(n)).compile().as_text()
    factorisation = 'custom_call_target="lapack_dgetrf'
    assert factorisation in text
    assert not [part for part in text.split("\n\n") if factorisation in part and "ENTRY" not in part]


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"alpha": 0.1}, ValueError, r"operator_splitting: `alpha` must lie in \[-1/3, 0\]; received 0.1"),
        ({"alpha": -0.34}, ValueError, r"must lie in \[-1/3, 0\]; received -0.34"),
        ({"alpha": float("nan")}, ValueError, "received nan"),
        ({"alpha": "small"}, TypeError, "operator_splitting: `alpha` must be a real number; received 'small'"),
        ({"modified": 1}, TypeError, "operator_splitting: `modified` must be True or False; received 1"),
    ],
)
def test_bad_arguments(arguments, error, words):
    with pytest.raises(error, match=words):
        operator_splitting(**arguments)
