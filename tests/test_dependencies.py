"""The sparsity pattern of a Jacobian, against the nonzeros of dense ones at points drawn by chance."""

import random
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.flatten_util import ravel_pytree
from program_writer import function, program, usual_promotion

import hhtjax
from hhtjax.jaxpr import TooDense, dependencies
from hhtjax.primitives import choose, consistent, in_turn, one_kernel, row_written, structural, together, traced

POINTS = 30


def nonzeros(f, n, points=POINTS, derivative=jax.jacfwd):
    """Of the dense Jacobians at some points together."""
    jacobian, rng = jax.jit(derivative(f)), np.random.default_rng(0)
    found = [np.asarray(jacobian(jnp.asarray(rng.normal(size=n)))) for _ in range(points)]
    return np.any([np.nan_to_num(x) != 0 for x in found], axis=0)


def pattern(f, n, *others):
    found = dependencies(f, jax.ShapeDtypeStruct((n,), float), *others)
    assert found.dtype == bool
    assert found.has_sorted_indices
    assert found.shape[1] == n
    return found.toarray()


# ----------------------------------------------------------------------------
# Functions whose pattern is exact.

SIDE = 5
GRID = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
EDGES = np.concatenate([
    np.stack([GRID[:-1].ravel(), GRID[1:].ravel()], 1),
    np.stack([GRID[:, :-1].ravel(), GRID[:, 1:].ravel()], 1),
])  # fmt: skip
BAND = np.diag(np.full(7, 2.0)) - np.diag(np.ones(6), 1) - np.diag(np.ones(6), -1)


def springs(x):
    stretch = jnp.diff(x, prepend=0.0, append=0.0)
    return jnp.diff(stretch + stretch**3)


def lattice_by_slices(x):
    u = jnp.pad(x.reshape(SIDE, SIDE), 1)
    forces = [jnp.sin(v - u[1:-1, 1:-1]) for v in (u[2:, 1:-1], u[:-2, 1:-1], u[1:-1, 2:], u[1:-1, :-2])]
    return sum(forces[1:], forces[0]).ravel()


def lattice_by_edges(x):
    stretch = x[EDGES[:, 0]] - x[EDGES[:, 1]]
    force = stretch + stretch**3
    ends = jax.ops.segment_sum(-force, EDGES[:, 0], SIDE * SIDE), jax.ops.segment_sum(force, EDGES[:, 1], SIDE * SIDE)
    return ends[0] + ends[1]


def turned(w):
    """A rotation of some vector, (3,) -> (3, 3)."""
    zero = jnp.zeros(())
    hat = jnp.stack([jnp.stack([zero, -w[2], w[1]]), jnp.stack([w[2], zero, -w[0]]), jnp.stack([-w[1], w[0], zero])])
    angle = jnp.linalg.norm(w)
    return jnp.eye(3) + jnp.sin(angle) / angle * hat + (1 - jnp.cos(angle)) / angle**2 * hat @ hat


def chain_of_rotations(x):
    R = jax.vmap(turned)(x.reshape(-1, 3))
    relative = jnp.einsum("nji,njk->nik", R[:-1], R[1:])
    return jnp.concatenate([jnp.cross(relative[:, 0], relative[:, 1]).ravel(), jnp.linalg.norm(R[:, 0], axis=1)])


def rotations_of_the_library(x):
    R = jax.vmap(hhtjax.rotation.exp)(x.reshape(-1, 3))
    turned = jax.vmap(hhtjax.rotation.log)(jnp.einsum("nij,nkj->nik", R[1:], R[:-1]))
    return jax.vmap(hhtjax.rotation.cross)(R[:-1, 0], turned).ravel()


def pendulum_links(x):
    """Each link at the end of all before it."""
    q, v = jnp.split(x, 2)
    place = jnp.cumsum(jnp.sin(q))
    return jnp.concatenate([place * v, lax.cumsum(q * v, reverse=True)])


def element(a, b):
    d = b - a
    length = jnp.sqrt(d @ d)
    return (length - 1) * d / length


def vmapped_elements(x):
    q = x.reshape(-1, 2)
    force = jax.vmap(element)(q[:-1], q[1:])
    return jnp.zeros_like(q).at[:-1].add(force).at[1:].add(-force).ravel()


def scanned_chain(x):
    def step(carry, row):
        carry = jnp.sin(carry) + row
        return carry, carry * row

    last, rows = lax.scan(step, 0.0, x)
    return jnp.append(rows, last)


def written_one_by_one(x):
    def step(i, y):
        return y.at[i].set(x[i] * x[(i + 1) % 6])

    return lax.fori_loop(0, 6, step, jnp.zeros(6))


def long_scan(x):
    """Too long to be written out; two numbers that do not meet."""

    def step(carry, row):
        return (carry[0] + row[0], carry[1] * row[1]), carry[0]

    (a, b), rows = lax.scan(step, (0.0, 1.0), x.reshape(-1, 2), reverse=True)
    return jnp.concatenate([rows, jnp.stack([a, b])])


def second_before(x):
    """A carry that is forgotten after two steps, with a number for each step."""

    def step(carry, row):
        return (carry[1], row[0]), carry[0] * row[0] + row[1]

    return lax.scan(step, (x[1], x[2]), (x, jnp.zeros_like(x)))[1]


def places_in_a_long_loop(x):
    return lax.fori_loop(0, 80, lambda i, y: y.at[i].add(x[i + 1] * x[i]), jnp.zeros(81))


def while_stencil(x):
    """Each step spreads by one on each side, and the number of steps is data."""

    def step(now):
        i, y = now
        return i + 1, y.at[1:3].set(y[:2] * y[1:3])

    return lax.while_loop(lambda now: now[0] < jnp.where(x[0] > 0, 5, 7), step, (0, x))[1]


@jax.custom_jvp
def rounded(x):
    return jnp.round(x)


rounded.defjvp(lambda x, dx: (rounded(*x), dx[0]))


@jax.custom_jvp
def shifted(x):
    return lax.stop_gradient(x)


shifted.defjvp(lambda x, dx: (shifted(*x), jnp.roll(dx[0], 1)))


def solved_in_batches(x):
    A = x[:12].reshape(3, 2, 2) + 4 * jnp.eye(2)[None]
    return jnp.linalg.solve(A, x[12:].reshape(3, 2, 1)).ravel()


def sorted_rows(x):
    return jnp.sort(x.reshape(3, 3), axis=1).ravel()


def branches(x):
    return lax.cond(x[0] > 0, lambda y: y * y, lambda y: y + y[::-1], x)


def where_and_max(x):
    return jnp.concatenate([jnp.where(x[:3] > 0, x[3:], x[:3] * 2), jnp.maximum(x[:3], x[3:]), jnp.abs(x)])


def assembled_matrix(x):
    """A banded matrix of functions of the unknowns, times the unknowns."""
    K = jnp.diag(x * x) + jnp.diag(jnp.sin(x[1:]), 1)
    return K.at[6, 0].add(x[3]) @ x


def structure_of_an_inner_jacobian(x):
    return jax.jacfwd(springs)(x).T @ x


LOCAL = {
    "springs": (springs, 8),
    "lattice by slices": (lattice_by_slices, SIDE * SIDE),
    "lattice by edges": (lattice_by_edges, SIDE * SIDE),
    "rotations": (chain_of_rotations, 12),
    "rotations of the library": (rotations_of_the_library, 9),
    "links": (pendulum_links, 10),
    "vmapped elements": (vmapped_elements, 10),
    "scan with a carry": (scanned_chain, 6),
    "map": (lambda x: lax.map(lambda row: row[0] * row[1:], x.reshape(-1, 3)).ravel(), 9),
    "loop with known places": (written_one_by_one, 6),
    "long scan": (long_scan, 140),
    "long scan that forgets": (second_before, 100),
    "long loop with known places": (places_in_a_long_loop, 81),
    "while": (while_stencil, 5),
    "constant band": (lambda x: BAND @ jnp.sin(x), 7),
    "constant band in einsum": (lambda x: jnp.einsum("ij,bj->bi", BAND, x.reshape(2, 7)).ravel(), 14),
    "assembled matrix": (assembled_matrix, 7),
    "inner Jacobian": (structure_of_an_inner_jacobian, 6),
    "energy": (jax.grad(lambda x: jnp.sum(jnp.diff(x) ** 4)), 7),
    "masked": (lambda x: x * np.array([1.0, 0.0, 1.0]) + jnp.roll(x, 1), 3),
    "reductions": (lambda x: jnp.concatenate([x.reshape(2, 3).max(1), x.reshape(2, 3).prod(0), x[:2] ** 2]), 6),
    "sort": (sorted_rows, 9),
    "branches": (branches, 4),
    "where and max": (where_and_max, 6),
    "rows": (lambda x: row_written(x.reshape(2, 3), x[:3] * 2, jnp.array(1)).ravel(), 6),
    "slices": (lambda x: lax.dynamic_update_slice(x, lax.dynamic_slice(x, (1,), (2,)) ** 2, (3,))[::-1], 6),
    "set": (lambda x: x.at[np.array([2, 9, -1])].set(x[:3], mode="drop").at[0].set(1.0), 5),
    "solve in batches": (solved_in_batches, 18),
    "a derivative of its own": (rounded, 3),
    "a derivative elsewhere": (shifted, 3),
    "no derivative": (lambda x: jnp.round(x) + jnp.sign(x) + lax.stop_gradient(x) + x.astype(int).astype(float), 3),
    "index from an integer": (lambda x: jax.vmap(lambda i: x[i] * x[0])(jnp.arange(4) // 2 * 2), 4),
    "triu": (lambda x: (jnp.triu(jnp.outer(x, x[::-1]))).ravel(), 3),
}


@pytest.mark.parametrize("name", LOCAL)
def test_exact(name):
    f, n = LOCAL[name]
    np.testing.assert_array_equal(pattern(f, n), nonzeros(f, n))


# ----------------------------------------------------------------------------
# Supersets.


def newton(x):
    """A root of each member of a batch."""

    def root(a):
        return lax.while_loop(lambda y: jnp.abs(y * y - a) > 1e-3, lambda y: (y + a / y) / 2, a)

    return jax.vmap(root)(1 + x**2)


def solved(x):
    A = jnp.diag(4 + x**2) + 0.1 * jnp.outer(x, x)
    return jax.scipy.linalg.lu_solve(jax.scipy.linalg.lu_factor(A), x)


def by_data(x):
    """An index that is computed from an unknown."""
    i = jnp.argmax(x[:3])
    return jnp.concatenate([x.at[i].set(x[4]), x[i][None], lax.dynamic_slice(x.reshape(3, 2), (i, 0), (1, 2)).ravel()])


SUPERSETS = {
    "newton": (newton, 4),
    "lu": (solved, 4),
    "data": (by_data, 6),
    "cholesky": (lambda x: jnp.linalg.cholesky(jnp.diag(3 + x**2) + 0.1 * jnp.outer(x, x)).ravel(), 3),
    "eigenvalues": (lambda x: jnp.linalg.eigvalsh(jnp.diag(x) + 1), 3),
    "convolution": (lambda x: jnp.convolve(x, x[:2]), 5),
}


@pytest.mark.parametrize("name", SUPERSETS)
def test_superset(name):
    f, n = SUPERSETS[name]
    assert (pattern(f, n) | ~nonzeros(f, n)).all()


def test_local_where_only_members_meet():
    """A loop of a batch: each member depends on its own unknown, though all of them go on while one does."""
    np.testing.assert_array_equal(pattern(newton, 4), np.eye(4, dtype=bool))


def test_steps_that_are_not_told_apart(monkeypatch):
    """Where a carry of each step would be too much."""
    monkeypatch.setattr(sys.modules["hhtjax.jaxpr.row_sets"], "MOST", 5000)
    found = pattern(lambda x: lax.scan(lambda y, _: (jnp.roll(y, 2) * y, None), x, None, length=100)[0], 20)
    expected = (np.arange(20)[:, None] - np.arange(20)) % 2 == 0
    np.testing.assert_array_equal(found, expected)


def test_machinery_that_has_been_traced():
    """Functions traced before keep the operations of the library, of which a plain trace has none."""

    def f(x):
        x = one_kernel(lambda x: lax.fori_loop(0, 3, lambda i, y: jnp.sin(y) * y, x), x)
        x = choose(lambda x: x + x, lambda x: 2 * x, structural(np.eye(6)) @ x)
        x = jax.vmap(lambda v: in_turn(lambda v: jnp.where(v > 0, v * v, v), v > 0, v))(x)
        x = jax.vmap(consistent(lambda v: jnp.where(v > 0.5, v, v * v)))(x)
        (x,) = together(lambda x: [x[0] * 2], [x])
        return jax.vmap(hhtjax.rotation.cross)(x.reshape(2, 3), jnp.ones((2, 3))).ravel()

    before = traced(f, jax.ShapeDtypeStruct((6,), float))
    expected = np.kron(np.eye(2), 1 - np.eye(3)) > 0
    np.testing.assert_array_equal(pattern(lambda x: before(x), 6), expected)
    np.testing.assert_array_equal(pattern(f, 6), expected)


def test_reverse_rules_are_transposed():
    @jax.custom_vjp
    def f(x):
        return lax.stop_gradient(x[:2])

    f.defvjp(lambda x: (f(x), None), lambda _, dy: (jnp.pad(dy, (1, 0)),))
    np.testing.assert_array_equal(pattern(lambda x: f(x) * 2, 3), nonzeros(f, 3, 1, jax.jacrev))


def of_vectors(f, args):
    """A program of arrays as a function of one vector: its floating arguments."""
    x, back = ravel_pytree([a for a in args if a.dtype.kind == "f"])

    def g(x):
        floats = iter(back(x))
        values = jax.tree.leaves(f(*(next(floats) if a.dtype.kind == "f" else a for a in args)))
        kept = [jnp.ravel(y).astype(float) for y in values if jnp.issubdtype(jnp.result_type(y), np.floating)]
        return jnp.concatenate([jnp.zeros(0), *kept])

    return g, x.size


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seed", [3, 11, 26, 41, 77])
def test_random_programs(seed):
    """Many more were compared by hand."""
    rng = random.Random(seed)
    text, args = program(rng, rng.randint(3, 12))
    with usual_promotion():
        f, n = of_vectors(function(text), args)
        assert (pattern(f, n) | ~nonzeros(f, n, points=1)).all(), text


# ----------------------------------------------------------------------------
# The interface.


def test_others_count_as_any_number():
    def f(x, c):
        return c * x + jnp.diag(c) @ x[::-1]

    expected = np.eye(3, dtype=bool) | np.eye(3, dtype=bool)[::-1]
    np.testing.assert_array_equal(pattern(f, 3, jnp.zeros(3)), expected)
    assert not pattern(lambda x: f(x, np.zeros(3)), 3).any()


def test_inside_jit():
    """What is traced is not known."""

    @jax.jit
    def f(c):
        np.testing.assert_array_equal(pattern(lambda x: c * x, 2), np.eye(2, dtype=bool))
        return c

    f(jnp.zeros(2))


def test_nothing_to_depend_on():
    assert pattern(lambda x: jnp.ones(3), 2).shape == (3, 2)
    assert pattern(lambda x: x[:0], 2).shape == (0, 2)
    assert pattern(lambda x: x, 0).shape == (0, 0)
    assert not pattern(lambda x: jnp.argsort(x), 2).any()


def test_errors():
    with pytest.raises(TypeError, match=r"x must be a floating vector .* int64"):
        dependencies(lambda x: x, jnp.arange(3))
    with pytest.raises(TypeError, match=r"f must return one vector .*\(2, 1\)"):
        dependencies(lambda x: x[:, None], jnp.zeros(2))
    with pytest.raises(TooDense, match="100000000"):
        dependencies(lambda x: x * jnp.sum(x), jax.ShapeDtypeStruct((20_000,), float))


def test_large():
    """Linear in the number of unknowns: with n^2 numbers, memory would end."""
    n = 100_000
    found = dependencies(springs, jax.ShapeDtypeStruct((n,), float))
    assert found.nnz == 3 * n - 2


def test_the_library_does_without_scipy_until_then():
    code = "import sys, hhtjax.jaxpr; assert 'scipy.sparse' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
