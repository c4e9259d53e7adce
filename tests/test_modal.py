"""Normal modes and systems reduced to them: closed forms, sparse matrices, files, and the motion of the full system."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import io, sparse

import hhtjax
from hhtjax import LinearSystem
from hhtjax.analysis import modal_reduction, modes

RNG = np.random.default_rng(5)


def chain(n, k=100.0):
    """Masses between two walls: w_j = 2 sqrt(k) sin(j pi/(2 (n + 1)))."""
    return k * sparse.diags([-np.ones(n - 1), 2 * np.ones(n), -np.ones(n - 1)], [-1, 0, 1]).tocsr()


def free_chain(n, k=100.0):
    """Without walls: w_j = 2 sqrt(k) sin(j pi/(2 n)), j = 0 rigid."""
    K = chain(n, k).tolil()
    K[0, 0] = K[-1, -1] = k
    return K.tocsc()


def bent(n, k):
    """A chain that one spring to the ground, of a negative stiffness, makes unstable, far from its lowest modes."""
    K = chain(n).tolil()
    K[n // 2, n // 2] = k
    return K.tocsc()


@pytest.mark.parametrize("n", [12, 3000])
def test_frequencies_of_chains(n):
    """12: dense; 3000: Lanczos, also of a K that is singular."""
    j = np.arange(1, 6)
    found = modes(sparse.identity(n), chain(n), 5)
    np.testing.assert_allclose(found.frequencies, 20 * np.sin(j * np.pi / (2 * (n + 1))), rtol=1e-8)
    shape = np.sin(np.outer(np.arange(1, n + 1), j) * np.pi / (n + 1))
    np.testing.assert_allclose(np.abs(found.shapes.T @ shape), np.sqrt((n + 1) / 2) * np.eye(5), atol=1e-5 * np.sqrt(n))
    free = modes(np.ones(n), free_chain(n), 5)
    np.testing.assert_allclose(free.frequencies, 20 * np.sin((j - 1) * np.pi / (2 * n)), rtol=1e-6, atol=1e-6)


def test_a_full_mass_matrix_and_all_modes():
    B = RNG.standard_normal((7, 7))
    M, K = B @ B.T + 7 * np.eye(7), np.asarray(chain(7).todense())
    found = modes(M, K)
    np.testing.assert_allclose(found.shapes.T @ M @ found.shapes, np.eye(7), atol=1e-12)
    np.testing.assert_allclose(found.shapes.T @ K @ found.shapes, np.diag(found.frequencies**2), atol=1e-9)
    assert np.all(np.diff(found.frequencies) > 0)


def test_sparse_matrices_and_matrix_market_files(tmp_path):
    """The same system, as arrays, from a file of a symmetric matrix, and with diagonals recognised."""
    K = chain(6)
    io.mmwrite(tmp_path / "K.mtx", K, symmetry="symmetric")
    system = LinearSystem(sparse.identity(6, format="csr"), sparse.coo_array(0.1 * K), io.mmread(tmp_path / "K.mtx"))
    assert (system.M.shape, system.C.shape, system.K.shape) == ((6,), (6, 6), (6, 6))
    np.testing.assert_array_equal(system.K, K.toarray())
    np.testing.assert_allclose(system.C, 0.1 * K.toarray(), rtol=1e-15)
    assert hhtjax.System(sparse.identity(3), lambda q, v, t, params: -q).mass.shape == (3,)


def test_large_sparse_matrices():
    def force(q, v, t, params):
        return -q

    with pytest.raises(ValueError, match=r"System: `mass` must have at most 5000 rows .*20000, which takes 3\.0 GiB.*"):
        hhtjax.System(chain(20000), force)
    kept = LinearSystem(sparse.identity(20000), None, chain(20000))
    np.testing.assert_allclose(modes(kept.M, kept.K, 1).frequencies, 20 * np.sin(np.pi / 40002), rtol=1e-6)
    reduced = modal_reduction((sparse.identity(20000), 1e-3 * chain(20000), chain(20000)), 3)
    np.testing.assert_allclose(reduced.system.C, 1e-3 * reduced.system.K, rtol=1e-6)
    assert reduced.system.K.shape == (3,)


N = 20
DIRECTION = np.linspace(0.0, 1.0, N)


def load(t, params):
    return params["f"] * jnp.sin(2 * t) * DIRECTION


def end(system, start):
    def run(params):
        return hhtjax.simulate(system, hhtjax.hht(-0.1), *start, params, dt=0.02, num_steps=60)

    return run


@pytest.mark.slow
def test_all_modes_are_the_system_itself_and_few_are_near():
    """With damping that couples the modes, an initial shape, and a stiffness fitted through the reduced system."""
    K = jnp.asarray(chain(N).toarray())
    C = np.diag(RNG.uniform(0, 0.5, N))
    full = LinearSystem(np.linspace(1, 2, N), C, lambda params: params["k"] * K, load)
    params, other = {"f": 2.0, "k": 1.0}, {"f": 2.0, "k": 1.2}
    q0, v0 = 0.1 * np.sin(np.pi * (np.arange(N) + 1) / (N + 1)), np.zeros(N)
    exact = end(full, (q0, v0))(other)
    for count, tolerance in ((N, 1e-9), (8, 2e-2)):
        reduced = modal_reduction(full, count, params)
        run = end(reduced.system, (reduced.project(q0), reduced.project(v0)))(other)
        assert run.q.shape == (61, count)
        np.testing.assert_allclose(reduced.expand(run.q), exact.q, atol=tolerance * np.max(np.abs(exact.q)))
        if count == N:
            np.testing.assert_allclose(reduced.expand(run.acceleration), exact.acceleration, atol=1e-7)


@pytest.mark.slow
def test_proportional_damping_stays_uncoupled_and_local_forces_stay():
    K = chain(N).toarray()
    at = [N - 1]

    def stop(q, v, t, params):
        return -params["s"] * jnp.maximum(q - 0.05, 0.0) ** 2

    full = LinearSystem(np.ones(N), 0.01 * K + 0.1 * np.eye(N), K, nonlinear=stop, at=at)
    reduced = modal_reduction(full, N)
    assert reduced.system.C.shape == (N,)
    np.testing.assert_allclose(reduced.system.C, 0.01 * reduced.frequencies**2 + 0.1, rtol=1e-10)
    q0, v0 = np.zeros(N), np.ones(N)
    params = {"s": 2e3}
    ours = end(reduced.system, (reduced.project(q0), reduced.project(v0)))(params)
    exact = end(full, (q0, v0))(params)
    assert np.max(exact.q[:, -1]) > 0.06
    np.testing.assert_allclose(reduced.expand(ours.q), exact.q, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_modes_are_uncoupled_but_for_rounding(dtype):
    """Few of many, free ones, and damped in proportion to M and K; a damper at one end couples them."""
    K = chain(200).toarray()
    K[0, 0], K[-1, -1] = -K[0, 1], -K[-1, -2]
    M, K = np.linspace(1.0, 2.0, 200).astype(dtype), K.astype(dtype)
    C = (0.01 * K + 0.1 * np.diag(M)).astype(dtype)
    assert modal_reduction((M, C, K), 5).system.C.shape == (5,)
    C[0, 0] += 0.1
    reduced = modal_reduction((M, C, K), 5)
    assert reduced.system.C.shape == (5, 5)
    assert reduced.system.C.dtype == reduced.shapes.dtype == dtype


def test_under_jit_the_reduced_system_is_data():
    reduced = modal_reduction(LinearSystem(np.ones(4), None, chain(4).toarray(), lambda t, p: p * jnp.ones(4)), 2)
    run = jax.jit(lambda system, q: hhtjax.simulate(system, hhtjax.hht(), q, q, 1.0, dt=0.1, num_steps=3).q)
    found = run(reduced.system, jnp.zeros(2))
    twice = jax.tree.map(lambda x: x, reduced.system)
    assert twice == reduced.system
    np.testing.assert_array_equal(run(twice, jnp.zeros(2)), found)


@pytest.mark.parametrize(
    ("error", "message", "call"),
    [
        (ValueError, r"`count` must be at most 3", lambda: modes(np.ones(3), np.ones(3), 4)),
        (ValueError, r"`count` must be a positive integer; received 0", lambda: modes(np.ones(3), np.ones(3), 0)),
        (ValueError, r"`K` must have the shape of M, 3 rows; received 2", lambda: modes(np.ones(3), np.ones(2))),
        (ValueError, r"`K` must be symmetric", lambda: modes(np.ones(2), np.array([[1.0, 0.5], [0.0, 1.0]]))),
        (ValueError, r"`K` must be positive semidefinite; .* = -1", lambda: modes(np.ones(2), np.array([1.0, -1.0]))),
        (ValueError, r"`K` must be positive semidefinite", lambda: modes(np.ones(1001), bent(1001, 1.5), 2)),
        (ValueError, r"`M` must be positive definite", lambda: modes(np.array([1.0, 0.0]), np.ones(2))),
        (ValueError, r"`K` must have shape \(n, n\)", lambda: modes(np.ones(2), sparse.csr_matrix(np.ones((2, 3))))),
        (TypeError, r"`K` must be known", lambda: jax.jit(lambda K: modes(np.ones(2), K))(np.ones(2))),
        (TypeError, r"`system` must be a LinearSystem", lambda: modal_reduction(np.ones(2), 1)),
        (ValueError, r"`system` must have a stiffness", lambda: modal_reduction(LinearSystem(np.ones(2)), 1)),
    ],
)
def test_arguments_are_checked(error, message, call):
    with pytest.raises(error, match=message):
        call()
