"""What a batch does for members that ask, one after the other: as each by itself, in every mode, and in a kernel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from hhtjax.primitives import block_written, compat, in_turn, one_kernel

pytestmark = pytest.mark.skipif(not compat.is_on(), reason="with this JAX all go at once")
BATCHES = {  # axes of the target, the shared scale, the threshold; the inner batch first
    "one": [],
    "each its own": [(0, None, None)],
    "each asks by its own": [(0, None, 0)],
    "one question for all": [(None, 0, None)],
    "twice": [(0, None, None), (0, None, None)],
    "another scale outside": [(0, None, None), (None, 0, None)],
    "one question inside": [(None, 0, None), (0, None, None)],
}


def rooted(turn, target, scale, threshold):
    """The carry (number, root, counter, columns): where the target is large, a root by Newton, and a column of it."""
    asked = target > threshold
    x = scale * target
    carry = {"x": x, "n": jnp.array(3, jnp.int32), "log": jnp.full((2, 40), jnp.nan), "pair": (x / 2, x * jnp.ones(2))}

    def root(carry, target):
        def improve(_, y):
            return (y + scale * target / y) / 2

        y = lax.fori_loop(0, 6, improve, carry["x"])
        log = block_written(carry["log"], jnp.stack([y, x])[:, None], carry["n"], axis=1)
        new = {"x": y, "n": carry["n"] + 1, "log": log, "pair": (carry["x"], carry["pair"][1] * y)}
        return jax.tree.map(lambda new, old: jnp.where(asked, new, old), new, carry)

    after = turn(root, asked, carry, target)
    return after | {"log": jnp.nan_to_num(after["log"])}


def at_once(f, asked, carry, *more):
    return f(carry, *more)


def of_batches(turn, batches):
    """The function of target, scale, threshold, and its arguments."""

    def f(*args):
        return rooted(turn, *args)

    sizes = {"target": jnp.array(2.0), "scale": jnp.array(1.5), "threshold": jnp.array(1.0)}
    for i, axes in enumerate(batches):
        f = jax.vmap(f, axes)
        for (name, x), axis in zip(sizes.items(), axes, strict=True):
            if axis == 0:
                size = 4 - 2 * i
                sizes[name] = x[None] * jnp.linspace(0.2, 2.0, size).reshape(size, *[1] * x.ndim)
    return f, tuple(sizes.values())


@pytest.mark.parametrize("batches", BATCHES.values(), ids=BATCHES)
def test_in_turn_is_at_once(batches):
    (f, args), (g, _) = (of_batches(turn, batches) for turn in (in_turn, at_once))

    def square(f):
        return lambda args: sum(jnp.sum(jnp.cos(x.astype(float))) for x in jax.tree.leaves(f(*args)))

    def modes(f):
        return lambda args: (f(*args), jax.grad(square(f))(args), jax.jacfwd(square(f))(args))

    for x, y in zip(*(jax.tree.leaves(jax.jit(modes(h))(args)) for h in (f, g)), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-15)


@pytest.mark.compiled
def test_only_members_that_ask_are_visited():
    """One that does not leave the others alone shows it; of those that ask, each once."""
    x = jnp.arange(8.0).reshape(2, 4)
    found = jax.jit(jax.vmap(jax.vmap(lambda x: in_turn(lambda x: x + 10, x % 3 == 1, x))))(x)
    np.testing.assert_array_equal(found, jnp.where(x % 3 == 1, x + 10, x))


def test_what_is_returned_is_like_the_carry():
    for f in (lambda x: (x, x), lambda x: x[:1], lambda x: x.astype(int)):
        with pytest.raises(TypeError, match="in_turn: the function returns"):
            in_turn(f, jnp.array(True), jnp.ones(2))


@pytest.mark.compiled
def test_a_kernel_copies_nothing_that_is_written_into():
    """200 steps in one kernel, in some of which a member writes into columns of its own."""

    def run(x, columns):
        def step(i, carry):
            x, columns, count = carry
            asked = 1.01 * x > 2

            def write(carry):
                x, columns, count = carry
                return x / 2, block_written(columns, jnp.stack([x, x])[:, None], count, axis=1), count + 1

            return in_turn(write, asked, (1.01 * x, columns, count))

        return lax.fori_loop(0, 200, step, (x, columns, jnp.zeros((), jnp.int32)))

    x, columns = jnp.array([1.0, 1.2, 1.5]), jnp.zeros((3, 2, 50))
    program = jax.jit(jax.vmap(lambda *args: one_kernel(run, *args))).lower(x, columns).compile()
    text = program.as_text()
    assert "xla_cpu_small_call" in text
    assert sum(" copy(" in line and "[3,2,50]" in line for line in text.splitlines()) <= 1
    _, columns, count = program(x, columns)
    assert count.tolist() == [2, 3, 3]
    np.testing.assert_array_equal(jnp.sum(columns > 0, axis=2), jnp.stack([count, count], axis=1))
