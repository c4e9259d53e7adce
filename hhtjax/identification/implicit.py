"""Derivatives of estimates: those of the minimum, by the implicit function theorem, not of the iterations that find it.

At a minimum x of a cost c(x, d) the slope g = dc/dx is 0, whatever the data d, so that

    H dx + (dg/dd) dd = 0,      H = dg/dx

with the second derivatives of the residuals, which Gauss-Newton leaves out.
"""

import jax
import jax.numpy as jnp
from jax.custom_derivatives import zero_from_primal

from hhtjax.numerics.hoisted import hoisted


def at_minimum(solve, problem_of, p, *data):
    """solve(), with the derivatives of the minimum in `data`.

    Args:
        solve: () -> x, what the problem's `read(x)` returns there, and more, which is constant to derivatives.
        problem_of: the problem, as a function of the data.
        p: how many unknowns are shared by all records; those that belong to one follow in x, record by record.
        data: pytrees of arrays.
    """
    call, closed_over = hoisted(solve)

    @jax.custom_jvp
    def found(closed_over, data):
        return call(closed_over)

    @found.defjvp
    def _(primals, tangents):
        x, values, more = found(*primals)
        data, moved = primals[1], tangents[1]
        dx = _response(problem_of, p, x, data, moved)
        _, change = jax.jvp(lambda x, data: problem_of(*data).read(x), (x, data), (dx, moved))
        return (x, values, more), (dx, change, jax.tree.map(zero_from_primal, more))

    return found(closed_over, data)


def _response(problem_of, p, x, data, moved):
    """dx where the data move so. Own unknowns are eliminated, and perturbed in all records at once."""
    g, along = jax.jvp(lambda data: problem_of(*data).slopes(x), (data,), (moved,))
    count, size = g.shape

    def near(small):
        return problem_of(*data).slopes(x + jnp.concatenate([small[:p], jnp.tile(small[p:], count)]))

    H = jax.jacfwd(near)(jnp.zeros(size, x.dtype))  # (records, slopes, unknowns)
    A, B, C = H[:, :p, :p], H[:, :p, p:], H[:, p:, p:]
    if size == p:
        return -_inverse(jnp.sum(A, axis=0)) @ jnp.sum(along, axis=0)
    C = jax.vmap(_inverse)(C)
    ahead = B @ C
    S = jnp.sum(A - ahead @ jnp.swapaxes(B, 1, 2), axis=0)
    shared = -_inverse(S) @ (jnp.sum(along[:, :p], axis=0) - jnp.einsum("bpk,bk->p", ahead, along[:, p:]))
    own = -jnp.einsum("bkj,bj->bk", C, along[:, p:]) - jnp.einsum("bpk,p->bk", ahead, shared)
    return jnp.concatenate([shared, own.ravel()])


def _inverse(H):
    """Of a symmetric H whose unknowns differ in size; 0 in directions of which it says nothing."""
    D = jnp.sqrt(jnp.abs(jnp.diagonal(H)))
    D = jnp.where(D == 0, 1, D)
    sizes = jnp.outer(D, D)
    return jnp.linalg.pinv(H / sizes, hermitian=True) / sizes
