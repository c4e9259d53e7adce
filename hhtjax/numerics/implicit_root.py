"""Roots with the derivatives of the implicit function, of every order and in every mode."""

from functools import partial

import jax
from jax.custom_derivatives import SymbolicZero, zero_from_primal

from hhtjax.numerics.hoisted import opened
from hhtjax.xla import together


def implicit_root(f, guess, search, tangent_solve):
    """A root w of f(w) = 0, and what else the search tells, which is constant to derivatives.

        dw = -A^-1 df,    A = df/dw at the root

    As `lax.custom_root`. But in reverse mode a scan leaves out the rules of `jax.custom_jvp`, and so of
    `lax.custom_root`, where it divides what is known from what is linear (`_scan_known_hoisting` of JAX): a second
    derivative then goes through the search. Here the rule gives the root as an operation that is never divided.

    Args:
        f: (n,) -> (n,); differentiated in what it closes over.
        guess: (n,), where the search begins.
        search: guess -> (w, more); more are floats.
        tangent_solve: g, y -> x with g(x) = y, for the linear map g of dw; differentiable.

    Returns:
        w (n,) and more.

    >>> import jax, jax.numpy as jnp
    >>> def root(a):
    ...     search = lambda w: (jax.lax.fori_loop(0, 40, lambda _, w: (w + a / w) / 2, w), None)
    ...     return implicit_root(lambda w: w * w - a, a, search, lambda g, y: y / g(1.0))[0]
    >>> [float(f(4.0)) for f in (root, jax.grad(root), jax.grad(jax.grad(root)))]
    [2.0, 0.25, -0.03125]
    """
    residual, in_residual = opened(f, guess)
    find, in_search = opened(search, guess)
    respond, in_response = opened(lambda w, y: tangent_solve(jax.linearize(f, w)[1], y), guess, guess)
    given, structure = jax.tree.flatten((in_residual, in_search, in_response, guess))
    told = jax.tree.structure(jax.eval_shape(find, in_search, guess))

    @jax.custom_jvp
    def root(given):
        _, in_search, _, guess = structure.unflatten(given)
        return jax.tree.leaves(find(in_search, guess))

    @partial(root.defjvp, symbolic_zeros=True)
    def _(primals, tangents):
        (given,), (moved,) = primals, tangents
        found = together(root, given)
        in_residual, _, in_response, _ = structure.unflatten(given)
        w, more = told.unflatten(found)
        constants, inside = jax.tree.flatten(in_residual)
        moves = {i: dx for i, dx in enumerate(moved[: len(constants)]) if not isinstance(dx, SymbolicZero)}

        def of_moving(moving):  # what does not move, such as the time, needs no derivative
            return residual(inside.unflatten([moving.get(i, x) for i, x in enumerate(constants)]), w)

        _, change = jax.jvp(of_moving, ({i: constants[i] for i in moves},), (moves,))
        dw = -respond(in_response, w, change)
        return found, jax.tree.leaves((dw, jax.tree.map(zero_from_primal, more)))

    return told.unflatten(root(given))
