"""A row written into an array, by batches too, and the loop in the place of a conditional that passes arrays on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from hhtjax.primitives import block_written, compat, largest_in_batch, one_kernel, row_written

BATCHES = {  # axes of array, row and number, the inner batch first
    "one": [],
    "each its own": [(0, 0, 0)],
    "one number": [(0, 0, None)],
    "one array": [(None, 0, 0)],
    "one row, one number": [(0, None, None)],
    "each its own, twice": [(0, 0, 0), (1, 0, 0)],
    "one number for the inner": [(0, 0, None), (0, None, 0)],
    "one number for the outer": [(None, None, 0), (0, 0, None)],
}


def chosen(array, row, number):
    return jnp.where((jnp.arange(array.shape[0], dtype=number.dtype) == number)[:, None], row[None], array)


@pytest.mark.parametrize("batches", BATCHES.values(), ids=BATCHES)
def test_a_row_is_written(batches):
    shapes, f, g = [[4, 3], [3], []], row_written, chosen
    for size, axes in zip((5, 2), batches, strict=False):
        f, g = jax.vmap(f, axes), jax.vmap(g, axes)
        for shape, axis in zip(shapes, axes, strict=True):
            shape[:0] = [] if axis is None else [size]
        if axes[0] == 1:
            shapes[0][:2] = shapes[0][1::-1]
    rng = np.random.default_rng(0)
    array, row = (jnp.asarray(rng.normal(size=shape)) for shape in shapes[:2])
    check_the_same(f, g, array, row, jnp.asarray(rng.integers(0, 4, size=shapes[2]), jnp.int32))


def check_the_same(f, g, array, block, number):
    """Values, which are copied, and derivatives, of array and block; in one program."""
    weights = np.random.default_rng(1).normal(size=jax.eval_shape(g, array, block, number).shape)

    def modes(f, x):
        def square(x):
            return jnp.sum(weights * f(*x, number) ** 2)

        return f(*x, number), jax.grad(square)(x), jax.jacfwd(square)(x)

    found, known = jax.jit(lambda *x: (modes(f, x), modes(g, x)))(array, block)
    np.testing.assert_array_equal(found[0], known[0])
    for x, y in zip(*map(jax.tree.leaves, (found, known)), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-14)


@pytest.mark.parametrize("batches", [[], [(0, 0, 0)], [(0, None, 0), (1, 0, None)]], ids=["one", "a batch", "two"])
def test_a_block_is_written_along_an_axis(batches):
    """Into columns, of which those beyond the last are the last."""

    def known(array, block, number):
        columns = jnp.arange(5, dtype=number.dtype) - jnp.minimum(number, 3)
        return jnp.where(columns == 0, block[:, :1], jnp.where(columns == 1, block[:, 1:], array))

    f, g, numbers = lambda *args: block_written(*args, axis=1), known, jnp.array([0, 4, 2], jnp.int32)
    shapes = [[3, 5], [3, 2]]
    for axes in batches:
        f, g = jax.vmap(f, axes), jax.vmap(g, axes)
    if batches:
        shapes[0][:0] = [3] if len(batches) == 1 else [3, 2]
        shapes[1][:0] = [3] if len(batches) == 1 else [2]
    rng = np.random.default_rng(0)
    array, block = (jnp.asarray(rng.normal(size=shape)) for shape in shapes)
    check_the_same(f, g, array, block, numbers if batches else numbers[1])


def test_a_block_that_does_not_fit():
    with pytest.raises(TypeError, match="block_written: a part of"):
        block_written(jnp.zeros((4, 3)), jnp.zeros((2, 3)), jnp.zeros((), jnp.int32), axis=1)


def test_numbers_have_no_tangents():
    array, row, number = jnp.zeros((4, 3)), jnp.ones(3), jnp.ones((), jnp.int32)
    none = np.zeros((), jax.dtypes.float0)
    value, tangent = jax.jvp(lambda number: row_written(array, row, number), (number,), (none,))
    np.testing.assert_array_equal(value, array.at[1].set(row))
    assert not tangent.any()


def test_a_row_that_does_not_fit():
    with pytest.raises(TypeError, match="row_written: a row like those of"):
        row_written(jnp.zeros((4, 3)), jnp.zeros(2), jnp.zeros((), jnp.int32))


def noted(x, rows):
    """200 steps, of which some write a row of two members."""

    def step(i, carry):
        x, rows, count, sizes = carry
        new = 1.01 * x

        def write(new, x, rows, count, sizes):
            return x / 2, row_written(rows, new, count), count + 1, sizes + new

        asked = largest_in_batch(jnp.max(new) > 2)
        return lax.cond(asked, write, lambda new, x, *rest: (new, *rest), new, x, rows, count, sizes)

    return lax.fori_loop(0, 200, step, (x, rows, jnp.zeros((), jnp.int32), 0 * x))


@pytest.mark.skipif(not compat.is_on(), reason="this JAX makes no kernels")
def test_a_conditional_becomes_a_loop():
    """In a kernel, with the same values; and in its loop nothing of the size of the rows is copied."""
    x, rows = jnp.array([[1.0, 1.2], [0.5, 1.5]]), jnp.zeros((2, 50, 2))
    inside = jax.jit(jax.vmap(lambda *args: one_kernel(noted, *args))).lower(x, rows).compile()
    for found, known in zip(inside(x, rows), jax.vmap(noted)(x, rows), strict=True):
        np.testing.assert_allclose(found, known, rtol=1e-13)
    text = inside.as_text()
    assert "conditional(" not in text
    assert sum(" copy(" in line and "[2,50,2]" in line for line in text.splitlines()) <= 1


def nested(x, y, number):
    """Conditionals within one another, on values from outside, some twice, in another order; integers; a switch."""

    def idle(*x):
        return x[:4]

    def step(i, carry):
        *now, number = carry
        out = jnp.sin(now[0] + y)

        def inner(a, b, c, d):
            return b + out, a * y, c + b, d - a

        def outer(a, b, c, d):
            p, q, r, s = lax.cond(largest_in_batch(a * b > 0.3), inner, idle, a, b, c, d)
            twice = lax.cond(p > q, lambda a, b, c, d: (b, a, d + out, c), idle, p, q, a, a)
            return twice[3] + a, twice[1], r + twice[0], s + 0.01 * i.astype(s.dtype)

        now = lax.cond(largest_in_batch(i % 3 == 1), outer, idle, *now)
        now = lax.cond(now[0] > 0.2, idle, lambda a, b, c, d: (a + 0.1, b - 0.1, c * y, d), *now)
        now = lax.switch(jnp.clip(i - 3, -2, 9).astype(jnp.int32), [idle, lambda *x: tuple(0.9 * x for x in x)], *now)
        whole = lax.cond(
            i % 5 == 4, lambda n: (n + 1, n, n - 1, n), lambda n: (n, jnp.zeros_like(n), jnp.full_like(n, 7), n), number
        )
        return *now[:3], now[3] + 1e-3 * sum(whole[1:]).astype(out.dtype), whole[0]

    return lax.fori_loop(0, 17, step, (x, x / 2, x - 0.2, x * x, number))


@pytest.mark.slow
def test_conditionals_in_conditionals_become_loops():
    """With the same values, also of a batch and of tangents."""
    x, y, number = jnp.array([0.7, -0.4, 1.1]), jnp.array(0.3), jnp.array(3, jnp.int32)

    def tangent(f):
        return lambda x, y, number: jax.jvp(lambda x, y: f(x, y, number)[:4], (x, y), (1 + x, 2 + y))

    for change in (lambda f: f, tangent):
        both = [change(lambda *args, f=f: f(nested, *args)) for f in (one_kernel, lambda f, *args: f(*args))]
        inside, known = (jax.jit(jax.vmap(f, (0, None, None))) for f in both)
        for a, b in zip(*(jax.tree.leaves(f(x, y, number)) for f in (inside, known)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15)
