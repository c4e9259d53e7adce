"""Sparse matrices of a linear system: the motion, derivatives and batches of dense ones, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient, check_message
from scipy import sparse
from zoo import EVERY

import hhtjax
from hhtjax import LinearSystem
from hhtjax.numerics import superlu
from hhtjax.numerics.dense_lu import factorize
from hhtjax.numerics.sparse_matrix import of_scipy

N = 24


def tridiagonal(n, off=-1.0, on=2.0):
    return sparse.diags([np.full(n - 1, off), np.full(n, on), np.full(n - 1, off)], [-1, 0, 1]).tocsr()


K, M = tridiagonal(N), tridiagonal(N, 0.1, 1.5)
GYRO = sparse.diags([np.full(N - 1, -0.3), np.full(N - 1, 0.3)], [-1, 1]) + 0.02 * K  # not symmetric
RAMP = np.linspace(0.0, 1.0, N)
PARAMS = {"k": 40.0, "c": 0.7, "f": 2.0, "stop": 50.0}


def load(t, params):
    return params["f"] * jnp.sin(3 * t) * RAMP.astype(t.dtype)


def stop(q, v, t, params):
    return -params["stop"] * q**3 - 0.5 * v * q[::-1] ** 2


def system(make, local=False):
    """Of matrices that are functions of params, but for M; make: what becomes of SciPy's."""
    k, c = make(K), make(GYRO)
    beside = {"nonlinear": stop, "at": [N - 1, 3]} if local else {}
    return LinearSystem(make(M), lambda p: p["c"] * c + 0.001 * k, lambda p: p["k"] * k, load, **beside)


SPARSE = {local: system(hhtjax.sparse, local) for local in (False, True)}


def run(made, stepper, params=PARAMS, q0=RAMP, **options):
    return hhtjax.simulate(made, stepper, q0, 0 * q0, params, **({"dt": 0.02, "num_steps": 20} | options))


STEPPERS = {
    "hht": hhtjax.hht(),
    "converged": hhtjax.hht(-0.1, iterations=None),
    "rowda": hhtjax.rowda(),
    "rosenbrock": hhtjax.rosenbrock(),
    "rk4": hhtjax.rk4(),
    "banded": hhtjax.hht(linearize="predictor", solve=hhtjax.banded(1)),
}


@pytest.mark.parametrize(
    ("name", "local"),
    [("hht", False), ("hht", True)]
    + [pytest.param(*x, marks=pytest.mark.slow)
       for x in (("converged", True), ("rowda", True), ("rk4", False), ("banded", False))]
    + [pytest.param("rowda", False, marks=EVERY)],
)  # fmt: skip
def test_the_motion_is_that_of_dense_matrices(name, local):
    found = run(SPARSE[local], STEPPERS[name])
    with hhtjax.plain():
        expected = run(system(lambda A: A.toarray(), local), STEPPERS[name])
    found.check()
    for part in ("q", "v", "acceleration"):
        np.testing.assert_allclose(getattr(found, part), getattr(expected, part), rtol=1e-9, atol=1e-11)
    if name in ("hht", "converged"):
        assert found.info.solve_residual.max() < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "local"),
    [
        pytest.param("hht", True, marks=EVERY),  # as Newton, which has one form of the step instead of two
        ("converged", True),
        ("rosenbrock", False),
    ],
)
def test_derivatives(name, local):
    def loss(params):
        end = run(SPARSE[local], STEPPERS[name], params["p"], dt=params["dt"], num_steps=3)
        return jnp.sum(end.q**2) + 0.1 * jnp.sum(end.v**2) + 0.01 * jnp.sum(end.acceleration**2)

    check_gradient(loss, {"p": PARAMS, "dt": 0.03}, rtol=1e-9)


@pytest.mark.slow
def test_batches_of_starts_and_of_matrices():
    """More matrices than factors are kept; and a sweep."""
    number = superlu.KEPT + 2
    ks, scales = jnp.linspace(10.0, 60.0, number), jnp.linspace(0.5, 1.0, number)

    stepper = hhtjax.hht(linearize="predictor")

    @jax.jit
    @jax.vmap
    def ends(k, scale):
        return run(SPARSE[True], stepper, PARAMS | {"k": k}, scale * RAMP, num_steps=3).q[-1]

    @jax.jit
    @jax.vmap
    def starts(scale):
        return run(SPARSE[True], stepper, PARAMS, scale * RAMP, num_steps=3).q[-1]

    alone = [run(SPARSE[True], stepper, PARAMS | {"k": k}, s * RAMP, num_steps=3).q[-1]
             for k, s in [*zip(ks, scales, strict=True), *((PARAMS["k"], s) for s in scales)]]  # fmt: skip
    np.testing.assert_allclose(jnp.concatenate([ends(ks, scales), starts(scales)]), alone, rtol=1e-12, atol=1e-14)
    dts = jnp.array([0.02, 0.01])
    swept = hhtjax.sweep(SPARSE[True], stepper, RAMP, 0 * RAMP, PARAMS, dts=dts, duration=0.06, num_samples=1)
    np.testing.assert_allclose(swept.q[0, -1], alone[-1], rtol=1e-10)


def test_products_and_solves_of_any_pattern():
    """A few long rows, empty ones, several kinds of layers; transposed; multiples and sums."""
    rng = np.random.default_rng(0)
    for n, density in ((1, 1.0), (30, 0.1), (50, 0.9)):
        A = sparse.random_array((n, n), density=density, rng=rng).tolil()
        A[n // 2] = rng.normal(size=n)
        A.setdiag(3.0 * n)
        A, x = A.tocsr(), rng.normal(size=n)
        found, exact = of_scipy(A), A.toarray()
        np.testing.assert_allclose(found @ jnp.asarray(x), exact @ x, rtol=1e-12)
        np.testing.assert_allclose(found.diagonal(), np.diag(exact), rtol=1e-15)
        B = (2 * found - found / 4 + of_scipy(sparse.identity(n))) * jnp.float64(3)
        np.testing.assert_allclose(B.tocoo().toarray(), 3 * (1.75 * exact + np.eye(n)), rtol=1e-14)
        for trans in (0, 1):
            expected = np.linalg.solve(exact.T if trans else exact, x)
            np.testing.assert_allclose(factorize(found)(jnp.asarray(x), trans=trans), expected, rtol=1e-10)


def test_a_step_along_a_gradient_is_one_of_entries():
    """Those that a matrix has: what else is kept beside them is no part of it."""
    A, x = of_scipy(K), jnp.asarray(RAMP)
    assert A.pattern.size > A.nnz
    slope = jax.grad(lambda A: jnp.sum((A @ x) ** 2))(A)
    assert jnp.sum(slope.values**2) == pytest.approx(np.sum(slope.tocoo().data ** 2), rel=1e-14)
    for moved in (jax.tree.map(lambda a, g: a - 0.1 * g, A, slope), jax.tree.map(lambda a: a + 1.0, A)):
        np.testing.assert_allclose(moved @ x, moved.tocoo() @ x, rtol=1e-12, atol=1e-10)


def test_pivots_are_free_where_the_diagonal_is_none():
    """And a factor that is not there any more is made again."""
    A = of_scipy(sparse.csr_array(np.array([[0.0, 2.0, 0.0], [1.0, 0.0, 1e-3], [0.0, 5.0, 1.0]])))
    solve, b = factorize(A), jnp.array([2.0, 1.0, 7.0])
    superlu._factors.clear()
    np.testing.assert_allclose(solve(b), np.linalg.solve(A.tocoo().toarray(), b), rtol=1e-13)


@pytest.mark.slow
def test_single_precision():
    made = LinearSystem(*map(hhtjax.sparse, (M, GYRO, 40 * K)))
    with pytest.warns(hhtjax.PrecisionWarning):
        found = run(made, STEPPERS["hht"], 1.0, RAMP.astype(np.float32), num_steps=4)
    assert found.q.dtype == found.info.solve_residual.dtype == np.float32
    found.check()
    np.testing.assert_allclose(found.q, run(made, STEPPERS["hht"], 1.0, num_steps=4).q, atol=1e-5)


def test_a_singular_matrix_fails_by_name():
    """The stiffness of a spring beside takes the mass away."""
    made = LinearSystem(hhtjax.sparse(sparse.identity(N)), K=lambda p: p * hhtjax.sparse(sparse.identity(N)))
    beta, h = hhtjax.newmark().coefficients.beta, 0.02
    with pytest.raises(hhtjax.SimulationError, match="step 1 "):
        run(made, hhtjax.newmark(), -1 / (beta * h**2), num_steps=2).check()


@pytest.mark.slow
def test_large_ones_stay_sparse_and_are_traced_once():
    n, counted = 2000, []
    x = np.arange(1, n + 1) * np.pi / (n + 1)
    springs = tridiagonal(n)
    made = LinearSystem(sparse.identity(n), 1e-3 * springs, springs, lambda t, p: counted.append(1) or p * jnp.ones(n))
    assert (made.M.shape, made.K.shape, made.K.nnz) == ((n,), (n, n), 3 * n - 2)
    ends = [run(made, hhtjax.hht(), 0.0, k * np.sin(x), dt=5.0, num_steps=40, save_every=40).q[-1] for k in (1.0, 2.0)]
    first = len(counted)
    run(made, hhtjax.hht(), 1.0, np.sin(x), dt=4.0, num_steps=40, save_every=40).check()
    assert len(counted) == first
    mode = LinearSystem(np.ones(1), np.full(1, 1e-3 * (k := 2 - 2 * np.cos(x[0]))), np.full(1, k))
    exact = run(mode, hhtjax.hht(), q0=np.ones(1), dt=5.0, num_steps=40).q[-1]
    for k, end in zip((1.0, 2.0), ends, strict=True):
        np.testing.assert_allclose(end, k * exact * np.sin(x), atol=1e-10)


def full(p):
    return jnp.eye(N)


@pytest.mark.parametrize(
    ("error", "message", "call"),
    [
        (TypeError, "sparse: `matrix` must be a matrix of scipy.sparse; received 3.0.", lambda: hhtjax.sparse(3.0)),
        (ValueError, "sparse: `matrix` must have shape (n, n), or (n,) for a diagonal; received shape (2, 3).",
         lambda: hhtjax.sparse(sparse.csr_array((2, 3)))),
        (ValueError, "sparse: `matrix` must be finite", lambda: hhtjax.sparse(np.nan * K)),
        (TypeError, "sparse: `matrix` must be real; received a sparse matrix of complex128.",
         lambda: hhtjax.sparse(1j * K)),
        (ValueError, "LinearSystem: `K` must have shape (24, 24), or (24,) for a diagonal, to fit `M`",
         lambda: LinearSystem(hhtjax.sparse(M), K=hhtjax.sparse(tridiagonal(9)))),
        (ValueError, "LinearSystem: `M` must be symmetric", lambda: LinearSystem(hhtjax.sparse(M + GYRO))),
        (ValueError, "LinearSystem: `M` must be positive definite", lambda: LinearSystem(hhtjax.sparse(-M))),
        (ValueError, "simulate: `C` must be sparse, too, or a diagonal (n,)",
         lambda: run(LinearSystem(np.ones(N), full, hhtjax.sparse(K)), hhtjax.hht())),
        (NotImplementedError, "simulate: name the coordinates of `nonlinear` by `at`",
         lambda: run(LinearSystem(hhtjax.sparse(M), nonlinear=stop), hhtjax.hht())),
        (NotImplementedError, "simulate: leave out `friction` beside sparse matrices",
         lambda: run(LinearSystem(hhtjax.sparse(M), friction=lambda q, v, t, p: 0 * q), hhtjax.hht())),
        (NotImplementedError, "Houbolt does not support sparse matrices",
         lambda: run(SPARSE[False], hhtjax.houbolt())),
        (NotImplementedError, "hht: leave out `solve` with sparse matrices",
         lambda: run(SPARSE[False], hhtjax.hht(solve=jnp.linalg.solve))),
        (NotImplementedError, "export_c: `M` must be an array; received a sparse matrix of 24 rows",
         lambda: hhtjax.export_c(SPARSE[False], hhtjax.hht(), RAMP, 0 * RAMP, PARAMS)),
        (NotImplementedError, "suggest_step_size: `M` must be an array",
         lambda: hhtjax.analysis.suggest_step_size(SPARSE[False], hhtjax.hht(), RAMP, 0 * RAMP, PARAMS)),
    ],
)  # fmt: skip
def test_what_is_refused(error, message, call):
    check_message(error, message, call)
