"""Small dense solves: against NumPy in value, and against jnp.linalg.solve in every derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matrices import (
    KINDS,
    SIZES,
    backward_error,
    bad_rows,
    compiled,
    cyclic,
    permuted,
    random_matrix,
    spd,
    zero_diagonal,
)

from hhtjax import explain, primitives
from hhtjax.numerics.dense_lu import UNROLLED, factorize, matvec
from hhtjax.numerics.linear_solve import factorize_with, solve, solve_map
from hhtjax.primitives import compat


@pytest.mark.parametrize("n", SIZES)
def test_solutions(n):
    """Backward stable row by row where rows are alike, and as good as LAPACK where they are not."""
    for kind in KINDS:
        A, b = kind(n)
        x, lapack = np.asarray(compiled(A, b)), np.linalg.solve(A, b)
        assert x.dtype == np.float64
        assert backward_error(A, x, b) <= max(1e-14, 10 * backward_error(A, lapack, b)), kind.__name__
        size = np.abs(np.linalg.inv(A)) @ (np.abs(A) @ np.abs(lapack))
        assert np.all(np.abs(x - lapack) <= 1e-13 * size), kind.__name__


@pytest.mark.parametrize("n", SIZES)
def test_a_scaled_permutation_is_solved_exactly(n):
    A, b = cyclic(n)
    assert np.array_equal(A @ np.asarray(compiled(A, b)), b)


@pytest.mark.parametrize("n", [2, 5, 8])
def test_the_largest_pivot_is_taken_and_not_just_a_nonzero_one(n):
    """Without the exchange of rows a pivot of 1e-20 would lose the solution."""
    A, b = random_matrix(n)
    A[0, 0] = 1e-20
    assert np.allclose(compiled(A, b), np.linalg.solve(A, b), rtol=1e-12)


@pytest.mark.parametrize("n", [4, 9])
def test_float32_stays_float32(n):
    A, b = spd(n)
    x = compiled(A.astype(np.float32), b.astype(np.float32))
    assert x.dtype == jnp.float32
    assert backward_error(A, np.asarray(x, float), b) < 1e-6


@pytest.mark.parametrize("n", [1, 2, 3, 8, 9, 12])
def test_a_singular_matrix_gives_no_number(n):
    A, b = random_matrix(n)
    A[:, -1] = 0
    assert not np.all(np.isfinite(compiled(A, b)))
    assert not np.any(np.isfinite(compiled(0 * A, b)))


@pytest.mark.parametrize("n", [3, 9])
def test_under_vmap(n):
    matrices = np.stack([kind(n)[0] for kind in KINDS[:5]])
    vectors = np.stack([kind(n)[1] for kind in KINDS[:5]])

    def batches(matrices, vectors):
        one_matrix = jax.vmap(factorize(matrices[0]))(vectors)
        one_vector = jax.vmap(solve, in_axes=(0, None))(matrices, vectors[0])
        return jax.vmap(solve)(matrices, vectors), one_matrix, one_vector

    expected = (
        [np.linalg.solve(A, b) for A, b in zip(matrices, vectors, strict=True)],
        [np.linalg.solve(matrices[0], b) for b in vectors],
        [np.linalg.solve(A, vectors[0]) for A in matrices],
    )
    for x, y in zip(jax.jit(batches)(matrices, vectors), expected, strict=True):
        assert np.allclose(x, y, rtol=1e-10, atol=1e-12)


# ---------------------------------------------------------------------------------------------- derivatives


def curved(solver):
    """A function of A and b with second derivatives of all kinds."""
    return lambda A, b: jnp.sum(jnp.sin(solver(A, b)))


def jnp_solve(A, b):
    """The reference."""
    return jnp.linalg.solve(A, b)


def all_gradients(A, b):
    """With respect to A and b: reverse, forward, and the reference."""
    return (
        jax.grad(curved(solve), argnums=(0, 1))(A, b),
        jax.jacfwd(curved(solve), argnums=(0, 1))(A, b),
        jax.grad(curved(jnp_solve), argnums=(0, 1))(A, b),
    )


@pytest.mark.parametrize("n", [1, 5, 9])
def test_gradients(n):
    """Forward = reverse = those of jnp.linalg.solve."""
    derivatives = jax.jit(all_gradients)
    for kind in (zero_diagonal, permuted, spd):
        for reverse, forward, expected in zip(*jax.device_get(derivatives(*kind(n))), strict=True):
            size = np.max(np.abs(expected))
            assert size > 0
            assert np.max(np.abs(reverse - forward)) < 1e-11 * size, kind.__name__
            assert np.max(np.abs(reverse - expected)) < 1e-11 * size, kind.__name__


def test_gradients_under_vmap():
    arguments = [np.stack(x) for x in zip(zero_diagonal(3), permuted(3), spd(3), strict=True)]
    for reverse, forward, expected in zip(*jax.jit(jax.vmap(all_gradients))(*arguments), strict=True):
        assert np.allclose(reverse, forward, rtol=1e-10, atol=1e-12)
        assert np.allclose(reverse, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("n", "outer", "inner"),
    [
        (2, jax.jacfwd, jax.jacrev),
        (9, jax.jacrev, jax.jacfwd),
    ],
)
def test_second_derivatives(n, outer, inner):
    """Those of jnp.linalg.solve, in several combinations of modes."""
    A, b = permuted(n)

    def hessian(solver):
        return outer(inner(lambda x: curved(solver)(A + x[0] * A.T + x[1] ** 2, b + x[1])))

    H, expected = jax.jit(lambda x: (hessian(solve)(x), hessian(jnp_solve)(x)))(jnp.array([0.1, 0.2]))
    assert np.all(np.abs(expected) > 1e-3)
    assert np.max(np.abs(H - expected)) < 1e-11 * np.max(np.abs(expected))


# ---------------------------------------------------------------------------------------------- factorize


def count_primitives(function, *args):
    """How often each primitive occurs in the program of a function, inner programs included."""
    counts = {}

    def visit(jaxpr):
        for equation in jaxpr.eqns:
            counts[equation.primitive.name] = counts.get(equation.primitive.name, 0) + 1
            for inner in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "jaxpr") or hasattr(x, "eqns")):
                if hasattr(inner, "jaxpr"):
                    visit(inner.jaxpr)
                elif hasattr(inner, "eqns"):
                    visit(inner)

    visit(jax.make_jaxpr(function)(*args).jaxpr)
    return counts


FACTORS = [(factorize, 3), (factorize, UNROLLED + 1), (factorize_with(jnp_solve), 3)]


@pytest.mark.parametrize(("factors", "n"), FACTORS)
def test_one_factorisation_serves_many_right_hand_sides_and_the_transpose(factors, n):
    A, b = zero_diagonal(n)

    def many(A, b):
        inverse = factors(A)
        return inverse(b) + inverse(jnp.sin(b)), inverse(b, trans=1)

    plain, transposed = jax.jit(many)(A, b)
    assert np.allclose(plain, np.linalg.solve(A, b + np.sin(b)), rtol=1e-11, atol=1e-12)
    assert np.allclose(transposed, np.linalg.solve(A.T, b), rtol=1e-11, atol=1e-12)


@pytest.mark.slow
@pytest.mark.skipif(not compat.is_on(), reason="this JAX makes no kernels")
@pytest.mark.parametrize("made", [zero_diagonal, permuted, bad_rows])
def test_elimination_is_a_loop_inside_a_kernel_and_lapack_s_elsewhere(made):
    """Both forms, both directions, a batch, and the derivatives; none leaves the other's traces in the program."""

    def many(A, b):
        inverse = factorize(A)
        return inverse(b), inverse(b, trans=1), jax.grad(lambda b: jnp.sum(solve(A, b) ** 3) / 3)(b)

    def inside(A, b):
        return primitives.one_kernel(many, A, b)

    A, b = made(UNROLLED + 4)
    x = np.linalg.solve(A, b)
    expected = x, np.linalg.solve(A.T, b), np.linalg.solve(A.T, x**2)
    for f in (many, inside):
        compiled = jax.jit(f).lower(A, b).compile()
        assert ("getrf" in compiled.as_text()) == (f is many)
        assert "conditional" not in compiled.as_text()
        for found, known in zip(compiled(A, b), expected, strict=True):
            np.testing.assert_allclose(found, known, rtol=1e-9, atol=1e-9 * np.abs(known).max())
    batch = jax.jit(jax.vmap(inside))(np.stack([A, A.T, A]), np.stack([b, b, 2 * b]))
    np.testing.assert_allclose(batch[0][1], expected[1], rtol=1e-9, atol=1e-9 * np.abs(expected[1]).max())
    np.testing.assert_allclose(batch[0][2], 2 * x, rtol=1e-9, atol=1e-9 * np.abs(x).max())
    assert explain(jax.vmap(inside), A[None], b[None]).paths == ("one kernel",)


@pytest.mark.parametrize(("n", "name", "once"), [(3, "abs", 6), (5, "abs", 14), (UNROLLED + 1, "lu", 1)])
def test_the_factors_are_computed_once_also_for_derivatives(n, name, once):
    """Only the search for pivots takes absolute values: n (n - 1) of scalars, (n - 1) (n + 2)/2 of columns."""
    A, b = zero_diagonal(n)

    def many(A, b):
        inverse = factorize(A)
        return jnp.sum(inverse(b) * inverse(jnp.sin(b)))

    assert count_primitives(many, A, b)[name] == once
    assert count_primitives(jax.grad(many, argnums=1), A, b)[name] == once
    for derivative in (jax.grad, jax.jacfwd):
        assert count_primitives(derivative(curved(solve), argnums=(0, 1)), A, b)[name] == once


@pytest.mark.parametrize("n", [3, 9])
def test_the_matrix_of_factors_is_constant_to_autodiff_and_the_right_hand_side_is_not(n):
    A, b = permuted(n)

    def derivatives(A, b):
        return (
            jax.grad(lambda A: jnp.sum(factorize(A)(b)))(A),
            jax.jacfwd(lambda b: factorize(A)(b))(b),
            jax.jacrev(lambda b: factorize(A)(b))(b),
        )

    zero, forward, reverse = jax.jit(derivatives)(A, b)
    assert np.all(zero == 0)
    assert np.allclose(forward, np.linalg.inv(A), rtol=1e-12, atol=1e-13)
    assert np.allclose(reverse, np.linalg.inv(A), rtol=1e-12, atol=1e-13)


# ---------------------------------------------------------------------------------------------- solve_map


@pytest.mark.parametrize(("factors", "n"), [(factorize, 3), (factorize_with(jnp_solve), 3)])
def test_a_linear_map_is_solved_and_differentiated_through_the_map(factors, n):
    """The matrix serves to find x only: derivatives with respect to what the map depends on come through the map."""
    A, b = permuted(n)

    def by_map(scale, b):
        return jnp.sum(jnp.sin(solve_map(lambda x: matvec(A + scale * A.T, x), b, factors)))

    def by_matrix(scale, b):
        return jnp.sum(jnp.sin(jnp.linalg.solve(A + scale * A.T, b)))

    def derivatives(scale, b):
        return (
            (
                by_map(scale, b),
                jax.grad(by_map, argnums=(0, 1))(scale, b),
                jax.jacfwd(by_map, argnums=(0, 1))(scale, b),
            ),
            (by_matrix(scale, b), *2 * (jax.grad(by_matrix, argnums=(0, 1))(scale, b),)),
        )

    found, expected = jax.jit(derivatives)(0.1, b)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert np.allclose(x, y, rtol=1e-10, atol=1e-12)
