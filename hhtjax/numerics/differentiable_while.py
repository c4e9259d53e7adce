"""A loop whose number of iterations depends on data, with forward and reverse derivatives."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import compress
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero, zero_from_primal

from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.numerics.closures import hoisted, opened
from hhtjax.primitives import TwoWays, derivative, row_written, staged, together, traced

SLOTS, LEVELS = 64, 3
LONGEST = SLOTS**LEVELS  # iterations that reverse mode can go back


def repeat(body: Callable, carry: PyTree, count: Real) -> PyTree:
    """carry -> body(i, carry) for i = 0, ..., count - 1, count a traced integer.

    It is a while loop, so another count needs no compilation. Its derivatives are such loops too, with as many
    iterations. Reverse mode stores the parts of the carry that derivatives need, before each of up to SLOTS blocks of
    iterations on each of LEVELS levels. It computes a block again when it reaches it. So up to SLOTS iterations are
    computed twice, up to SLOTS^2 three times. Beyond LONGEST iterations its derivatives are NaN.
    """
    count = jnp.asarray(count)
    call, constants = hoisted(body, jnp.zeros_like(count), carry)
    leaves, structure = jax.tree.flatten(carry)

    def on_leaves(i: Array, leaves: list, constants: list):
        return jax.tree.leaves(call(constants, i, structure.unflatten(leaves)))

    return structure.unflatten(_repeat(on_leaves, count, [jnp.asarray(x) for x in leaves], constants))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _repeat(body: Callable, count: Array, carry: list, constants: list):
    number = len(carry)

    def loop(x: list):
        count, carry, constants = split(x, number)
        return lax.fori_loop(0, count, lambda i, carry: body(i, carry, constants), carry)

    return together(loop, [count, *carry, *constants])


@partial(_repeat.defjvp, symbolic_zeros=True)
def _(body: Callable, primals: tuple, tangents: tuple):
    """Constants without a tangent stay so: a long array of them would cost its length in every reverse iteration."""
    count, carry, constants = primals
    floats = tuple(jnp.issubdtype(x.dtype, jnp.inexact) for x in carry)
    moves = tuple(not isinstance(x, SymbolicZero) for x in tangents[2])
    dots = [*map(_instantiate, compress(tangents[1], floats)), *compress(tangents[2], moves)]
    if not dots:
        out = _repeat(body, count, carry, constants)
        return out, [_none(x) for x in out]
    out, dots = derivative(Loop(body, floats, moves).ways(), [count, *carry, *constants], dots)
    return out, merged(floats, dots, [_none(x) for x in out])


def _none(x: Array) -> np.ndarray:
    return np.zeros(x.shape, jax.dtypes.float0)


def _instantiate(tangent):
    like: Any = tangent.aval if isinstance(tangent, SymbolicZero) else None
    return tangent if like is None else jnp.zeros(like.shape, like.dtype)


def split(x: list, number: int):
    """The count, the carry of so many parts, the constants."""
    return x[0], x[1 : 1 + number], x[1 + number :]


def merged(choices, new, old):
    """The next of `new` wherever the choice is true, what was there elsewhere."""
    new = iter(new)
    return [next(new) if chosen else x for chosen, x in zip(choices, old, strict=True)]


class Loop:
    """Floats: which parts of the carry are floating numbers; moves: which of the constants have tangents."""

    def __init__(self, body: Callable, floats: tuple, moves: tuple):
        self.body, self.floats, self.moves = body, floats, moves

    def ways(self):
        """Its derivative in both modes, of [count, *carry, *constants]."""
        slow = self.forward_by_scans, self.reverse_by_scans
        return TwoWays(len(self.floats), self.values, self.forward, self.reverse, *slow)

    def parts(self, dx: list):
        """Tangents of the carry, and of the constants."""
        number = sum(self.floats)
        return dx[:number], dx[number:]

    def step(self, i: Array, carry: list, constants: list):
        """An iteration as a function of what moves, which also gives the whole carry."""

        def step(x: list, moving: list):
            after = self.body(i, merged(self.floats, x, carry), merged(self.moves, moving, constants))
            return list(compress(after, self.floats)), after

        return step, list(compress(carry, self.floats)), list(compress(constants, self.moves))

    def values(self, x: list):
        return _repeat(self.body, *split(x, len(self.floats)))

    def forward(self, x: list, dx: list):
        count, carry, constants = split(x, len(self.floats))
        dots, moving_dots = self.parts(dx)

        def body(i: Array, now: tuple):
            carry, dots = now
            step, *at = self.step(i, carry, constants)
            _, dots, carry = jax.jvp(step, tuple(at), (dots, moving_dots), has_aux=True)
            return carry, dots

        return lax.fori_loop(0, count, body, (carry, dots))

    def reverse(self, x: list, cotangents: list):
        count, carry, constants = split(x, len(self.floats))
        sums = [jnp.zeros_like(x) for x in compress(constants, self.moves)]
        pull_back, needed = self.reverse_iteration(jnp.zeros_like(count), carry, constants, cotangents)
        unread = [jnp.zeros_like(x) for x in carry]

        def iterate(i: Array, some: list):
            return list(compress(self.body(i, merged(needed, some, unread), constants), needed))

        def turn(i: Array, some: list, found: tuple):
            """Cotangents of the carry, and sums of those of constants, before iteration i."""
            cotangents, more = pull_back(i, merged(needed, some, unread), constants, found[0])
            return cotangents, [x + y for x, y in zip(found[1], more, strict=True)]

        found = backwards(iterate, turn, count, list(compress(carry, needed)), (cotangents, sums))
        return [jnp.where(count <= LONGEST, x, jnp.nan) for x in (*found[0], *found[1])]

    def reverse_iteration(self, i: Array, carry: list, constants: list, cotangents: list):
        """The transpose of an iteration, of the same arguments, and which parts of the carry derivatives are made of:
        those that it reads, in some iteration or the next."""

        def pull_back(i: Array, carry: list, constants: list, cotangents: list):
            step, *at = self.step(i, carry, constants)
            pull = staged(lambda *at: jax.vjp(step, *at, has_aux=True)[1])(*at)
            return staged(pull)(cotangents)

        back = traced(pull_back, i, carry, constants, cotangents)
        body = traced(self.body, i, carry, constants)
        here = slice(1, 1 + len(carry))
        needed = back.reads(None)[here]
        while (more := [x or y for x, y in zip(needed, body.reads(needed)[here], strict=True)]) != needed:
            needed = more
        return back, needed

    def by_scans(self, x):
        """The loop as a nest of scans that skip what is beyond count, a function of what moves, and where it is."""
        count, carry, constants = split(x, len(self.floats))

        def level(depth, first, carry, constants):
            """The carry after SLOTS**depth iterations."""
            if depth == 0:
                return self.body(first, carry, constants)

            @checkpoint
            def visit(carry, j):
                i = first + j * SLOTS ** (depth - 1)
                inner = partial(level, depth - 1)
                return lax.cond(i < count, inner, lambda i, carry, constants: carry, i, carry, constants), None

            return lax.scan(visit, carry, jnp.arange(SLOTS, dtype=count.dtype))[0]

        def run(x, moving):
            given = merged(self.floats, x, carry), merged(self.moves, moving, constants)
            after = level(LEVELS, jnp.zeros_like(count), *given)
            known = [jnp.where(count <= LONGEST, x, jnp.nan) for x in compress(after, self.floats)]
            return known, merged(self.floats, known, after)

        return run, list(compress(carry, self.floats)), list(compress(constants, self.moves))

    def forward_by_scans(self, x, dx):
        run, *at = self.by_scans(x)
        _, dots, values = jax.jvp(run, tuple(at), self.parts(dx), has_aux=True)
        return values, dots

    def reverse_by_scans(self, x, cotangents):
        run, *at = self.by_scans(x)
        found, moving = jax.vjp(run, *at, has_aux=True)[1](cotangents)
        return [*found, *moving]


def backwards(iterate: Callable, turn: Callable, count: Array, carry: list, found: tuple):
    """turn(i, carry before iteration i, found) for i = count - 1, ..., 0.

    carry: before the first. iterate: i, carry -> the next. A row is kept for the carry before each block of
    SLOTS**level iterations within one of SLOTS**(level + 1).
    """
    sizes = jnp.asarray([SLOTS**level for level in range(LEVELS + 1)], count.dtype)

    def row(level: Real, i: Array) -> Array:
        return level * SLOTS + i // sizes[level] % SLOTS

    def read(kept: list, number: Array):
        return [lax.dynamic_index_in_dim(x, number, 0, keepdims=False) for x in kept]

    def keep(kept: list, number: Array, carry: list):
        return [row_written(k, x, number) for k, x in zip(kept, carry, strict=True)]

    def fill(level: Array, last: Array, kept: list):
        """The rows of a level, up to that of iteration `last`, from the one above."""
        size = sizes[level]
        begin = last - last % sizes[level + 1]
        blocks = (last - begin) // size

        def block(j: Array, now: tuple):
            carry, kept = now
            first = begin + j * size
            kept = keep(kept, row(level, first), carry)
            return lax.fori_loop(first, jnp.where(j < blocks, first + size, first), iterate, carry), kept

        return lax.fori_loop(0, blocks + 1, block, (read(kept, row(level + 1, last)), kept))[1]

    def back(j: Array, now: tuple):
        kept, found = now
        i = count - 1 - j
        ends = (j == 0) | ((i + 1) % sizes[1:] == 0)  # the last iteration ends blocks of all levels
        levels = jnp.sum(ends, dtype=count.dtype)
        kept = lax.fori_loop(0, levels, lambda k, kept: fill(levels - 1 - k, i, kept), kept)
        return kept, turn(i, read(kept, row(0, i)), found)

    kept = [jnp.zeros((LEVELS * SLOTS + 1, *x.shape), x.dtype) for x in carry]
    kept = keep(kept, row(LEVELS, jnp.zeros_like(count)), carry)
    return lax.fori_loop(0, count, back, (kept, found))[1]


# ----------------------------------------------------------------------------
# Roots with the derivatives of the implicit function, of every order and in every mode.


def implicit_root(f: Callable, guess: Array, search: Callable, tangent_solve: Callable):
    """(w, more): a root w of f(w) = 0, and further results of the search, which have zero derivatives.

        dw = -A^-1 df,    A = df/dw at the root

    It is like `lax.custom_root`, with one difference. When a scan in reverse mode separates its known part from its
    linear part (`_scan_known_hoisting` of JAX), it loses the rules of `jax.custom_jvp`, and so of `lax.custom_root`. A
    second derivative then goes through the search. Here the root is an operation that is never separated.

    Args:
        f: (n,) -> (n,); differentiated by the values that it closes over.
        guess: (n,), start of the search.
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
    def root(given: list):
        _, in_search, _, guess = structure.unflatten(given)
        return jax.tree.leaves(find(in_search, guess))

    @partial(root.defjvp, symbolic_zeros=True)
    def _(primals: tuple, tangents: tuple):
        (given,), (moved,) = primals, tangents
        found = together(root, given)
        in_residual, _, in_response, _ = structure.unflatten(given)
        w, more = told.unflatten(found)
        constants, inside = jax.tree.flatten(in_residual)
        moves = {i: dx for i, dx in enumerate(moved[: len(constants)]) if not isinstance(dx, SymbolicZero)}

        def of_moving(moving: dict) -> Array:  # what does not move, such as the time, needs no derivative
            return residual(inside.unflatten([moving.get(i, x) for i, x in enumerate(constants)]), w)

        _, change = jax.jvp(of_moving, ({i: constants[i] for i in moves},), (moves,))
        dw = -respond(in_response, w, change)
        return found, jax.tree.leaves((dw, jax.tree.map(zero_from_primal, more)))

    return told.unflatten(root(given))
