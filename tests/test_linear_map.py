"""The matrix of a linear map: against unit vectors one by one, and how much work it takes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zoo
from jax import lax

from experiments.benchmarks.chain import FORMULATIONS, chain
from hhtjax.jaxpr import linear_map, linear_maps
from hhtjax.primitives import compat

N = 6
A = jnp.asarray(np.random.default_rng(0).standard_normal((N, N)))
B = jnp.asarray(np.random.default_rng(1).standard_normal((N, N, 3)))
C = A[0]
old = pytest.mark.skipif(not compat.is_on(), reason="this JAX takes unit vectors one by one")

MAPS = {
    "itself": lambda x: x,
    "scaled, in both orders": lambda x: 2 * x * C - C * x / C,
    "what depends on nothing": lambda x: x + 0 * C,
    "nothing": lambda x: jnp.zeros(4),
    "product": lambda x: A @ (C * x),
    "product from the left": lambda x: (C * x) @ A,
    "product of a matrix of differences": lambda x: (A * (x[:, None] - x[None, :])) @ C,
    "product over two axes": lambda x: jnp.einsum("ij,ij,k->k", A, x[:, None] + x[None, :], C),
    "product of a batch": lambda x: jnp.einsum("ij,ijk->ik", x[:, None] * A - x[None, :], B).sum(1),
    "product of a batch, the other way round": lambda x: jnp.einsum("ijk,ij->ki", B, A * x[None, :]).sum(0),
    "product over the batch of a row": lambda x: jnp.einsum("ijk,jl->k", B, A * x[:, None]),
    "product over the first axes": lambda x: lax.dot_general(A * x[None, :], A, (((0,), (0,)), ((), ())))[:, 0],
    "axes in another order": lambda x: (B * x[None, :, None]).transpose(2, 0, 1)[1].sum(0),
    "broadcast by a difference": jax.linearize(lambda x: x[1:2] - x, C)[1],
    "outer product": lambda x: jnp.outer(C[:3], x).sum(0),
    "sums": lambda x: (
        (A * x[None, :]).sum(0) + (A * x[None, :]).sum(1) + (A * x[None, :]).sum() + (A * x[:, None]).sum(0)
    ),
    "sum over three axes": lambda x: (B * x[:, None, None] - B * x[None, :, None]).sum((0, 2)),
    "differences": lambda x: jnp.diff(C * x) @ A[1:],
    "springs between neighbours": lambda x: jnp.diff(C * jnp.append(jnp.diff(x), 0.0), prepend=0.0),
    "parts": lambda x: jnp.concatenate([x[3:], C[:2], 3 * x[:2], x[4:], (A @ x)[1:3]]),
    "parts of two ranks": lambda x: jnp.concatenate([x.reshape(2, 3) @ A[:3, :3], x[:3][None]]).ravel(),
    "split": lambda x: jnp.concatenate(jnp.split(C * x, [2, 3])[::-1]),
    "every other": lambda x: x[::2],
    "one": lambda x: x[2] * C + x[-1],
    "a row from its column": lambda x: (x[:, None] * A).T.reshape(1, N, N)[0] @ C,
    "joined axes": lambda x: (x[:, None] * A).reshape(-1),
    "among zeros": lambda x: lax.pad(x, 0.0, [(2, -1, 1)]),
    "cut by negative padding": lambda x: lax.pad(x, 0.0, [(-2, 3, 0)]),
    "broadcast along a new axis": lambda x: jnp.broadcast_to(x[1:2], (N,)) + jnp.broadcast_to(x, (3, N)).sum(0),
    "chosen": lambda x: jnp.where(C > 0, 2 * x, A @ x) + jnp.where(C > 0.5, 0.0, x) + lax.select(True, x, -x),
    "chosen by number": lambda x: lax.select_n(jnp.arange(N) % 3, x, 2 * x, x[::-1]),
    "many neighbours": lambda x: sum(c * jnp.roll(x, i) for i, c in enumerate(C)),
    "gathered": lambda x: x[jnp.array([4, 0, 4])],
    "scattered": lambda x: jnp.zeros(8).at[jnp.array([1, 1, 5, 2, 0, 7])].add(C * x),
    "cumulative": lambda x: jnp.cumsum(C * x),
    "loop": lambda x: lax.scan(lambda s, a: (s + a * x, x[0] + s[1]), x, C),
    "function": lambda x: jax.jit(lambda x, c: c * jnp.cumsum(x) + x)(x, C),
    "solve": lambda x: jnp.linalg.solve(A, C * x),
}


@pytest.mark.parametrize("name", MAPS)
def test_matrix_of(name):
    def f(x):
        return jnp.concatenate([jnp.ravel(y) for y in jax.tree.leaves(MAPS[name](x))])

    found, expected = jax.jit(lambda: (linear_map(f, C), jax.vmap(f, out_axes=1)(jnp.eye(N))))()
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


def test_one_unknown_and_single_precision():
    assert linear_map(lambda x: 3 * x, jnp.ones(1)).tolist() == [[3.0]]
    found = linear_map(lambda x: jnp.diff(x) * jnp.float32(2), jnp.ones(3, jnp.float32))
    assert found.dtype == jnp.float32
    assert found.tolist() == [[-2, 2, 0], [0, -2, 2]]


def largest_array(f, *args):
    """Elements of the largest array in a program, functions within it included."""
    program = jax.make_jaxpr(f)(*args).jaxpr
    return max(1, *(x.aval.size for eqn in zoo.everywhere(program) for x in eqn.outvars))


@pytest.mark.slow
@old
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_work_of_a_chain(formulation, monkeypatch):
    """No array has more than N^2 elements, no product more than N^2 terms, and nothing takes whole columns."""
    scene = chain(9, k=1.0, c=0.1, formulation=formulation)

    def stiffness(q):
        tangent = jax.linearize(lambda q: scene.system.force(q, 0.1 * q, 0.0, scene.params), q)[1]
        return linear_map(tangent, q)

    def refuse(eqn, values):
        raise AssertionError(f"{eqn.primitive} on whole columns")

    expected = jax.jacfwd(lambda q: scene.system.force(q, 0.1 * q, 0.0, scene.params))(scene.q0)
    monkeypatch.setattr(linear_maps, "_by_columns", refuse)
    np.testing.assert_allclose(stiffness(scene.q0), expected, rtol=1e-12, atol=1e-12)
    assert largest_array(stiffness, scene.q0) == 9**2
    cost = jax.jit(stiffness).lower(scene.q0).compile().cost_analysis()
    assert cost["flops"] < 60 * 9**2
