"""A loop of as many iterations as data say: its derivatives against those of the same iterations written out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hhtjax.numerics import differentiable_while
from hhtjax.numerics.differentiable_while import LONGEST, SLOTS, repeat
from hhtjax.primitives import one_kernel, row_written

AT = 1e-2, 1.3
COUNT = 5


def iterate(i, carry, a):
    x, k, y = carry
    x = jax.lax.cond(x > 1.31, lambda x: (1 + a * jnp.cos(x + i / 1)) * x, lambda x: x + a, x)
    return x, k + 1, y + a * x * (k / 1)


def looped(a, x, count=COUNT):
    """With an integer in what the loop carries."""
    x, _, y = repeat(lambda i, carry: iterate(i, carry, a), (x, jnp.asarray(0), 0.3 * x), count)
    return jnp.sin(x) + y


def unrolled(a, x):
    carry = x, 0, 0.3 * x
    for i in range(COUNT):
        carry = iterate(i, carry, a)
    return jnp.sin(carry[0]) + carry[2]


def in_a_scan(f):
    """As part of a longer run, which reverse mode computes again."""
    part = jax.checkpoint(lambda x, _: (f(AT[0], x), None))
    return lambda a, x: jax.lax.scan(part, x, None, 3)[0] + f(a, x)


def every(f):
    return jax.grad(f, (0, 1))


DERIVATIVES = {
    "reverse": every,
    "forward": lambda f: jax.jacfwd(f, (0, 1)),
    "forward over reverse": lambda f: jax.jacfwd(every(f), (0, 1)),
    "reverse over reverse": lambda f: jax.jacrev(every(f), (0, 1)),
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f, (0, 1)), (0, 1)),
    "reverse in a checkpoint": lambda f: every(jax.checkpoint(f)),
    "reverse in a scan": lambda f: every(in_a_scan(f)),
    "forward in a scan": lambda f: jax.jacfwd(in_a_scan(f), (0, 1)),
    "reverse of a kernel": lambda f: every(lambda *x: one_kernel(f, *x)),
    "a batch of reverse": lambda f: lambda a, x: jax.vmap(every(f), (0, None))(jnp.array([a, 2 * a]), x),
    "reverse of a batch": lambda f: every(lambda a, x: jnp.sum(jax.vmap(f, (0, None))(jnp.array([a, 2 * a]), x))),
    "forward of a batch": lambda f: jax.jacfwd(lambda a, x: jax.vmap(f, (0, None))(jnp.array([a, 2 * a]), x), (0, 1)),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if "over" in name else name for name in DERIVATIVES]
)
def test_derivatives_are_those_of_the_iterations_written_out(name):
    found, expected = (jax.jit(DERIVATIVES[name](f))(*AT) for f in (looped, unrolled))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-14), found, expected)


@pytest.mark.parametrize("count", [0, 1, SLOTS - 1, SLOTS, SLOTS**2 + 5])
def test_any_count_that_is_data(count):
    """x -> (1 + a) x, count times: derivatives by hand, beside an integer the loop closes over."""
    every = jnp.asarray(3)

    def value(a, n):
        return repeat(lambda i, x: jnp.where(i % every.astype(i.dtype) == 0, (1 + a) * x, x), 1.0 + 0 * a, n)

    value = jax.jit(jax.value_and_grad(value))
    power = -(-count // 3)
    found, slope = value(1e-4, count)
    np.testing.assert_allclose([found, slope], [1.0001**power, power * 1.0001 ** (power - 1)], rtol=1e-10)
    if count == 0:
        assert np.isnan(value(0.0, LONGEST + 1)[1])


@pytest.mark.slow
def test_members_of_a_batch_with_counts_of_their_own():
    found = jax.jit(jax.vmap(every(looped), (None, None, 0)))(*AT, jnp.array([0, COUNT]))
    expected = every(unrolled)(*AT)
    np.testing.assert_allclose([x[1] for x in found], expected, rtol=1e-12)
    np.testing.assert_allclose([x[0] for x in found], [0, np.cos(AT[1]) + 0.3], atol=1e-14)


def test_blocks_of_every_level_end_wherever_they_may(monkeypatch):
    """Two iterations to a block, two blocks to the next: all counts of three levels."""
    monkeypatch.setattr(differentiable_while, "SLOTS", 2)
    monkeypatch.setattr(differentiable_while, "LONGEST", 8)

    def step(i, x, a):
        return x + a * jnp.sin(x + i)

    found = jax.jit(jax.value_and_grad(lambda a, count: repeat(lambda i, x: step(i, x, a), 0.7 + 0 * a, count)))
    for count in range(9):
        expected = jax.value_and_grad(lambda a, count=count: _written_out(step, 0.7, a, count))(0.3)
        np.testing.assert_allclose(found(0.3, count), expected, rtol=1e-13)


def _written_out(step, x, a, count):
    for i in range(count):
        x = step(i, x, a)
    return x


def test_one_copy_of_the_iteration_for_all_levels_and_nothing_kept_that_is_only_written():
    """In reverse mode, where nobody asks for values: one that goes forward, and the transposed one."""
    rows = jnp.zeros((7, 11))

    def loss(a, count):
        def step(i, now):
            x, log = now
            return x + a * jnp.sin(x), row_written(log, x + jnp.zeros(11), i)

        x, log = repeat(step, (0.7 + 0 * a, rows), count)
        return x + jnp.sum(log)

    found = jax.jit(jax.grad(loss))
    program = found.lower(0.3, 5).as_text()
    assert program.count("stablehlo.sine") == 2
    assert f"tensor<{differentiable_while.LEVELS * SLOTS + 1}xf64>" in program
    assert f"tensor<{differentiable_while.LEVELS * SLOTS + 1}x7x11xf64>" not in program
    h = 1e-6
    central = (loss(0.3 + h, 5) - loss(0.3 - h, 5)) / (2 * h)
    np.testing.assert_allclose(found(0.3, 5), central, rtol=1e-8)
