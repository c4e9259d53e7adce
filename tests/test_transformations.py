"""jit = eager, vmap = loop, dtypes and trees kept: for every stepper."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from zoo import EVERY, PROBLEMS, STEPPERS, Problem, as_data, covering, each, run

import hhtjax

every_stepper = pytest.mark.parametrize("name", each(STEPPERS))


ONE_FORM = ("hht predictor", "hht held", "hht state", "hht twice", "newmark", "bossak", "generalized_alpha")  # of hht's
OWN = ("operator_splitting",)  # such tests in a file of its own


def coupled_mass(q, params):
    return jnp.array([[2.0, 0.3], [0.3, 1.0]]) + params["m"] * jnp.diag(q**2)


def coupled_force(q, v, t, params):
    return -params["k"] * (2 * q - q[::-1] + q**3) - 0.1 * v * q[::-1] + jnp.array([jnp.sin(5.0 * t), 0.5])


VECTORS = Problem(
    hhtjax.System(coupled_mass, coupled_force),
    {"m": 0.4, "k": 30.0}, jnp.array([0.3, -0.2]), jnp.array([0.5, -1.0]), 0.2,
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", each(STEPPERS, rest=(*ONE_FORM, *OWN, "wilson", "dopri5")))
def test_jit_equals_eager(name):
    problem, stepper = VECTORS, as_data(STEPPERS[name])
    compiled = run(problem, stepper, 2)  # the program is that of vectors, below
    with jax.disable_jit():
        state = stepper.init(problem.system, problem.q0, problem.v0, problem.params, problem.duration / 2)
        for _ in range(2):
            state, _ = stepper.step(problem.system, state, problem.params, problem.duration / 2)
    np.testing.assert_allclose(compiled.q[-1], state.q, rtol=1e-10)
    np.testing.assert_allclose(compiled.acceleration[-1], state.w, rtol=1e-9)
    assert float(compiled.t[-1]) == pytest.approx(float(state.t), rel=1e-14)


def end(stepper, k, q0, dt):
    problem = PROBLEMS["forced Duffing"]
    params = {**problem.params, "k": k}
    path = hhtjax.simulate(problem.system, stepper, q0, problem.v0, params, dt=dt, num_steps=30)
    return path.q[-1], path.failure.step


ends = jax.jit(jax.vmap(end, (None, 0, 0, 0)))


@pytest.mark.slow
@pytest.mark.parametrize("name", each(STEPPERS, rest=OWN))
def test_vmap_equals_loop(name):
    """Over the stiffness, the start, and the step size; steppers of one family are compiled once."""
    stiffness, start, dts = np.array([0.5, 1.0, 2.0]), np.array([[0.1], [0.5], [-0.4]]), np.array([0.02, 0.05, 0.1])
    stepper = as_data(STEPPERS[name])
    batch, failures = ends(stepper, stiffness, start, dts)
    assert not failures.any()
    # Python numbers: the program is that of the test of dtypes
    members = zip(stiffness.tolist(), jnp.asarray(start), dts.tolist(), strict=True)
    loop = [end(stepper, *member)[0] for member in members]
    np.testing.assert_allclose(batch, jnp.stack(loop), rtol=1e-11)


@pytest.mark.slow
def test_vmap_over_alpha_equals_loop():
    problem = PROBLEMS["forced Duffing"]
    alphas = jnp.array([0.0, -0.1, -0.3])
    batch = jax.vmap(lambda alpha: run(problem, hhtjax.hht(alpha, linearize="predictor"), 50).q[-1])(alphas)
    loop = [run(problem, hhtjax.hht(float(alpha), linearize="predictor"), 50).q[-1] for alpha in alphas]
    np.testing.assert_allclose(batch, jnp.stack(loop), rtol=1e-11)
    assert abs(batch[0] - batch[2]) > 1e-6


@pytest.mark.slow
@every_stepper
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_dtype_is_kept(name, dtype):
    problem = PROBLEMS["forced Duffing"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category=hhtjax.PrecisionWarning)
        path = hhtjax.simulate(
            problem.system,
            as_data(STEPPERS[name]),
            problem.q0.astype(dtype),
            problem.v0.astype(dtype),
            problem.params,
            dt=0.02,
            num_steps=30,
        )
    path.check()
    assert {x.dtype for x in (path.t, path.q, path.v, path.acceleration, path.dt)} == {jnp.dtype(dtype)}
    np.testing.assert_allclose(path.q, run(problem._replace(duration=0.6), as_data(STEPPERS[name]), 30).q, atol=1e-4)


def vector(x):  # rows: a.x, b
    return jnp.append(x["a"]["x"], x["b"])


def tree(x):
    return {"b": x[1], "a": {"x": x[:1]}}


TREES = VECTORS._replace(
    system=hhtjax.System(
        lambda q, params: VECTORS.system.mass(vector(q), params),
        lambda q, v, t, params: tree(VECTORS.system.force(vector(q), vector(v), t, params)),
    ),
    q0=tree(VECTORS.q0),
    v0=tree(VECTORS.v0),
)


@pytest.mark.parametrize("name", each(STEPPERS, quick=(), rest=ONE_FORM))
def test_trees_are_kept_and_rows_follow_the_sorted_keys(name):
    """A dict whose keys sort differently from their insertion, against the same system on a vector."""
    ours, flat = (run(problem, as_data(STEPPERS[name]), 2) for problem in (TREES, VECTORS))
    for x in (ours.q, ours.v, ours.acceleration):
        assert jax.tree.structure(x) == jax.tree.structure(TREES.q0)
    assert ours.q["a"]["x"].shape == (3, 1)
    assert ours.q["b"].shape == (3,)
    np.testing.assert_allclose(ours.q["a"]["x"][:, 0], flat.q[:, 0], rtol=1e-10)
    np.testing.assert_allclose(ours.q["b"], flat.q[:, 1], rtol=1e-10)


def coupled(q, v, t, params):
    return -jnp.array([[2.0, -1.0], [-1.0, 2.0]]) @ q - 0.1 * q**3


MASS = np.array([2.0, 3.0])
DIAGONAL = hhtjax.System(MASS, coupled)
OTHERS = {
    "full": hhtjax.System(np.diag(MASS), coupled),
    "a function": hhtjax.System(lambda q, params: jnp.asarray(MASS), coupled),
    "a full function": hhtjax.System(lambda q, params: jnp.diag(MASS), coupled),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "mass"),
    [
        pytest.param(*x.values, marks=EVERY if x.values[0] in ONE_FORM[1:] else x.marks)
        for x in covering(STEPPERS, OTHERS)
    ],
)
def test_a_diagonal_mass_equals_the_others(name, mass):
    q0, v0, stepper = jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]), as_data(STEPPERS[name])
    ends = [hhtjax.simulate(x, stepper, q0, v0, dt=0.05, num_steps=20).q[-1] for x in (DIAGONAL, OTHERS[mass])]
    np.testing.assert_allclose(*ends, rtol=1e-12)


@pytest.mark.slow
def test_more_unknowns_than_are_unrolled():
    """n = 12 through LAPACK, with a coupled mass, against its modes."""
    n = 12
    K = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    M = np.eye(n) + 0.1 * np.ones((n, n))
    system = hhtjax.System(M, lambda q, v, t, params: -jnp.asarray(K) @ q)
    q0 = jnp.zeros(n).at[0].set(1.0)
    path = hhtjax.simulate(system, hhtjax.hht(alpha=-0.05), q0, jnp.zeros(n), dt=1e-3, num_steps=2000)
    values, vectors = np.linalg.eig(np.linalg.solve(M, K))
    exact = (vectors * np.cos(np.sqrt(values) * 2.0)) @ np.linalg.solve(vectors, np.asarray(q0))
    np.testing.assert_allclose(path.q[-1], exact, atol=1e-6)


@pytest.mark.slow
def test_a_users_solve_is_used():
    calls = []

    def solve(A, b):
        calls.append(A.shape)
        return jnp.linalg.solve(A, b)

    problem = VECTORS
    ours = run(problem, hhtjax.hht(solve=solve, linearize="predictor"), 10)
    assert set(calls) == {(2, 2)}
    np.testing.assert_allclose(ours.q, run(problem, hhtjax.hht(linearize="predictor"), 10).q, rtol=1e-12)
