"""Orders, blocks and colours of sparsity patterns, and the eliminations that follow them, on random graphs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import csr_array

from hhtjax.numerics.block_tridiagonal import block_pivots, factorize_blocks, solve_blocks
from hhtjax.numerics.sparse_lu import LARGEST_BLOCK, plan
from hhtjax.numerics.sparsity import (
    colours,
    condensed,
    dissected,
    groups,
    in_blocks,
    levels,
    longest_levels,
    pattern_of,
    product,
    stacked,
    symmetric,
    union,
)


def line(n):
    i = np.arange(n)
    return np.stack([i[:-1], i[1:]], axis=1)


def lattice(n):
    i = np.arange(n * n).reshape(n, n)
    pairs = (i[:-1], i[1:]), (i[:, :-1], i[:, 1:])
    return np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])


def shuffled(pairs, n, seed=0):
    """The same graph, its nodes in no order."""
    return np.random.default_rng(seed).permutation(n)[pairs]


GRAPHS = {  # the number of nodes, and which of them meet
    "line": (30, shuffled(line(30), 30)),
    "ring": (30, shuffled(np.concatenate([line(30), [[29, 0]]]), 30)),
    "tree": (31, shuffled(np.array([[(i - 1) // 2, i] for i in range(1, 31)]), 31)),
    "parts": (20, shuffled(np.concatenate([line(6), 6 + line(9)]), 20)),  # five nodes meet nobody
    "hub": (40, np.array([[0, i] for i in range(1, 40)])),
    "lattice": (64, shuffled(lattice(8), 64)),
    "random": (40, np.random.default_rng(1).integers(0, 40, size=(90, 2))),
    "single": (1, np.zeros((1, 2), int)),
}


def nodal(name, dofs=2):
    """(n, n) with all unknowns of two nodes that meet, n = dofs N."""
    n, pairs = GRAPHS[name]
    A = np.eye(n, dtype=bool)
    A[pairs[:, 0], pairs[:, 1]] = A[pairs[:, 1], pairs[:, 0]] = True
    return np.kron(A, np.ones((dofs, dofs), bool))


def saddle(name, dofs=2, seed=0):
    """Of the same with a constraint between the nodes of every second pair that shares none: the pattern, and n."""
    N, pairs = GRAPHS[name]
    used, chosen = set(), []
    for a, b in pairs.tolist():
        if a != b and not used & {a, b}:
            used |= {a, b}
            chosen.append((a, b))
    A = nodal(name, dofs)
    B = np.zeros((len(chosen), N, dofs), bool)
    for row, pair in zip(B, chosen, strict=True):
        row[list(pair)] = True
    B = B.reshape(len(chosen), N * dofs)
    return np.block([[A, B.T], [B, np.zeros((len(B), len(B)), bool)]]), len(A)


def matrix_of(pattern, free, seed=0):
    """Numbers for a pattern: unsymmetric, and definite in its upper left part."""
    rng, n = np.random.default_rng(seed), len(pattern)
    A = np.where(pattern, rng.normal(size=(n, n)), 0)
    A[:free, :free] += np.diag(1 + np.abs(A[:free, :free]).sum(axis=1))
    A[:free, free:] = -A[free:, :free].T
    return A


@pytest.mark.parametrize("name", GRAPHS)
def test_columns_of_a_colour_share_no_row(name):
    A, free = saddle(name)
    for order in (None, in_blocks(csr_array(A), free).order):
        colour = colours(csr_array(A), order)
        for row in A:
            assert len(set(colour[row])) == row.sum()
        assert set(colour) == set(range(colour.max() + 1))


def test_few_colours_are_enough_for_a_line():
    A = csr_array(nodal("line"))
    assert colours(A, in_blocks(A, 60).order).max() + 1 == 6  # three nodes of two unknowns
    assert colours(csr_array(np.eye(5, dtype=bool))).max() == 0


@pytest.mark.parametrize("name", GRAPHS)
def test_blocks_meet_their_neighbours_alone(name):
    A, free = saddle(name)
    order, starts, size = in_blocks(csr_array(A), free)
    assert sorted(order) == list(range(len(A)))
    assert starts[0] == 0
    assert starts[-1] == len(A)
    assert np.diff(starts).min() > 0
    assert np.diff(starts).max() == size
    block = np.empty(len(A), int)
    block[order] = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    rows, columns = np.nonzero(A)
    assert np.max(np.abs(block[rows] - block[columns])) <= 1
    for multiplier in range(free, len(A)):  # behind what it holds
        assert block[multiplier] >= block[:free][A[multiplier, :free]].max()


def test_a_constraint_of_unknowns_that_are_far_apart_makes_larger_blocks():
    A = nodal("line", 1)
    end, other = np.flatnonzero(A.sum(axis=1) == 2)
    row = np.zeros((1, 30), bool)
    row[0, [end, other]] = True
    A = np.block([[A, row.T], [row, np.zeros((1, 1), bool)]])
    order, starts, _ = in_blocks(csr_array(A), 30)
    block = np.repeat(np.arange(len(starts) - 1), np.diff(starts))[np.argsort(order)]
    assert np.max(np.abs(block[:, None] - block)[A]) == 1


@pytest.mark.parametrize(("name", "size"), [("line", 4), ("ring", 8), ("parts", 4), ("tree", 24)])
def test_blocks_of_long_mechanisms_are_small(name, size):
    assert in_blocks(csr_array(nodal(name)), len(nodal(name))).size <= size


@pytest.mark.parametrize("name", GRAPHS)
def test_dissection_puts_each_multiplier_behind_what_it_holds(name):
    A, free = saddle(name)
    order = dissected(csr_array(A), free)
    assert sorted(order) == list(range(len(A)))
    place = np.argsort(order)
    for multiplier in range(free, len(A)):
        assert place[multiplier] > place[:free][A[multiplier, :free]].max()


def fill(A, order):
    """Entries below the diagonal of the factors of a symmetric matrix, eliminated in an order."""
    A = A[np.ix_(order, order)].copy()
    for k in range(len(A)):
        later = np.flatnonzero(A[k, k + 1 :]) + k + 1
        A[np.ix_(later, later)] = True
    return int(np.tril(A, -1).sum())


def test_dissection_of_a_lattice_leaves_less_fill_than_its_levels():
    A = np.eye(400, dtype=bool)
    pairs = lattice(20)
    A[pairs[:, 0], pairs[:, 1]] = A[pairs[:, 1], pairs[:, 0]] = True
    by_levels = np.argsort(longest_levels(symmetric(csr_array(A))), kind="stable")
    assert fill(A, dissected(csr_array(A), 400)) < 0.92 * fill(A, by_levels)


def test_levels():
    graph = symmetric(csr_array(nodal("line", 1)))
    n, pairs = GRAPHS["line"]
    end = np.flatnonzero(np.bincount(pairs.ravel(), minlength=n) == 1)[0]
    assert sorted(levels(graph, int(end))) == list(range(n))
    assert longest_levels(graph).max() == n - 1  # from wherever the search begins
    assert (levels(symmetric(csr_array(np.eye(3, dtype=bool))), 1) == [-1, 0, -1]).all()


def test_groups_are_the_unknowns_of_a_node():
    A = symmetric(csr_array(nodal("lattice", 3)))
    group = groups(A)
    assert (group.reshape(-1, 3) == group[::3, None]).all()
    assert group.max() + 1 == 64
    np.testing.assert_array_equal(condensed(A, group).toarray(), nodal("lattice", 1))


def test_algebra_of_patterns():
    rng = np.random.default_rng(2)
    A, B = (rng.random((7, 7)) < 0.3 for _ in range(2))
    a, b = csr_array(A), csr_array(B)
    np.testing.assert_array_equal(union(a, b).toarray(), A | B)
    np.testing.assert_array_equal(product(a, b).toarray(), (A.astype(int) @ B.astype(int)) > 0)
    np.testing.assert_array_equal(symmetric(a).toarray(), A | A.T | np.eye(7, dtype=bool))
    np.testing.assert_array_equal(stacked([[a, b], [b, None]]).toarray(), np.block([[A, B], [B, 0 * B]]))
    np.testing.assert_array_equal(pattern_of(np.where(A, -2.0, 0.0)).toarray(), A)


LAYOUTS = {"line": True, "ring": True, "parts": True, "hub": False, "random": False}  # whether in a row of blocks


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", LAYOUTS)
def test_elimination_of_saddle_points(name, dtype):
    """In whatever units: equations of 1 and of 1e6 in one matrix."""
    pattern, free = saddle(name)
    made = plan(csr_array(pattern), free)
    assert made.is_in_blocks == LAYOUTS[name] == (made.blocks.size <= LARGEST_BLOCK)
    A = matrix_of(pattern, free)
    unit = np.where(np.arange(len(A)) % 3 == 0, 1e3, 1.0)
    A = (unit[:, None] * A * unit[None, :]).astype(dtype)
    x = np.random.default_rng(3).normal(size=len(A)) / unit

    @jax.jit
    def both(A, b, c):
        solve = made.inverse(made.by_products(lambda x: A @ x, b))
        return solve(b), solve(c, trans=1)

    found = both(A, (A @ x).astype(dtype), (A.T @ x).astype(dtype))
    for y in found:
        assert y.dtype == dtype
        np.testing.assert_allclose(unit * np.asarray(y), unit * x, atol=1e3 * np.finfo(dtype).eps)


def test_the_trace_of_products_is_one_vector_for_each_colour():
    pattern, free = saddle("line")
    made, A = plan(csr_array(pattern), free), matrix_of(*saddle("line"))
    found = made.by_products(lambda x: jnp.asarray(A) @ x, jnp.ones(len(A)))
    assert found.values.size == (made.colour.max() + 1) * len(A)
    assert found.values.size < len(A) ** 2 / 5
    entries = np.asarray(found.values)[found.table[0]]
    np.testing.assert_array_equal(csr_array((entries, (made.rows, made.columns)), shape=A.shape).toarray(), A)


@pytest.mark.parametrize("name", ["line", "random"])
def test_pivots_tell_a_row_that_depends_on_others(name):
    """Of B B^T, as sines: their squares; with a row twice one of them is none."""
    pattern, free = saddle(name)
    rng = np.random.default_rng(4)
    B = np.where(pattern[free:, :free], rng.normal(size=(len(pattern) - free, free)), 0)
    B = np.concatenate([B, rng.normal(size=(40, 1)) * B[rng.integers(0, len(B), 40)] + 0.0])
    B[len(pattern) - free :] += np.where(B[len(pattern) - free :] != 0, rng.normal(size=(40, free)), 0)
    made = plan(csr_array((B != 0).astype(int) @ (B != 0).T.astype(int) > 0))
    if name == "line":
        assert made.is_in_blocks
    pivots = jax.jit(lambda G: made.pivots(made.by_products(lambda x: G @ x, G[0]), 1e-12))
    unit = B / np.linalg.norm(B, axis=1, keepdims=True)
    assert np.linalg.matrix_rank(unit) < len(unit)
    assert np.min(pivots(jnp.asarray(B @ B.T))) < 1e-10
    independent = np.arange(len(B)) < len(pattern) - free  # the others have rows of their own
    C = np.where(independent[:, None], B, 0)
    C = np.concatenate([C, np.where(independent, 0, 1.0)[:, None] * np.eye(len(B))], axis=1)
    found = np.asarray(pivots(jnp.asarray(C @ C.T)))
    size = np.linalg.norm(C, axis=1)
    np.testing.assert_allclose(np.prod(found), np.linalg.det(C @ C.T / size[:, None] / size), rtol=1e-9)


def random_blocks(N, b, seed=5):
    rng = np.random.default_rng(seed)
    lower, middle, upper = rng.normal(size=(3, N, b, b))
    middle += 4 * b * np.eye(b)
    A = np.zeros((N * b, N * b))
    for i in range(N):
        for blocks, j in ((lower, i - 1), (middle, i), (upper, i + 1)):
            if 0 <= j < N:
                A[i * b : i * b + b, j * b : j * b + b] = blocks[i]
    return (lower, middle, upper), A


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(("N", "b"), [(1, 3), (7, 1), (9, 4)])
def test_block_elimination_solves_the_matrix_and_its_transpose(N, b, dtype):
    blocks, A = random_blocks(N, b)
    x = np.random.default_rng(6).normal(size=N * b)

    @jax.jit
    def both(blocks, y, z):
        factors = factorize_blocks(*blocks)
        return solve_blocks(factors, y), solve_blocks(factors, z, trans=1)

    right = ((B @ x).reshape(N, b).astype(dtype) for B in (A, A.T))
    found = both(np.stack(blocks).astype(dtype), *right)
    for y in found:
        assert y.dtype == dtype
        np.testing.assert_allclose(y.ravel(), x, atol=100 * np.finfo(dtype).eps)


def test_block_elimination_exchanges_rows_within_a_block():
    middle = np.array([[[0.0, 1.0, 0.0], [0.0, 0.0, 2.0], [3.0, 0.0, 0.0]]])
    factors = factorize_blocks(jnp.zeros((1, 3, 3)), jnp.asarray(middle), jnp.zeros((1, 3, 3)))
    np.testing.assert_allclose(factors.inverse[0], np.linalg.inv(middle[0]), rtol=1e-15)


def test_pivots_of_blocks_are_those_of_an_elimination_in_their_order():
    (lower, middle, upper), _ = random_blocks(4, 3)
    middle = middle + middle.transpose(0, 2, 1)
    lower[1:] = upper[:-1].transpose(0, 2, 1)
    A = np.zeros((12, 12))
    for i in range(4):
        A[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = middle[i]
        if i:
            A[3 * i : 3 * i + 3, 3 * i - 3 : 3 * i] = lower[i]
            A[3 * i - 3 : 3 * i, 3 * i : 3 * i + 3] = lower[i].T
    expected = [np.linalg.det(A[:k, :k]) for k in range(13)]
    found = block_pivots(*(jnp.asarray(x) for x in (lower, middle, upper)), 1e-12)
    np.testing.assert_allclose(found.ravel(), np.divide(expected[1:], expected[:-1]), rtol=1e-10)
