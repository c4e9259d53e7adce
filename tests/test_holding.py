"""What several operations use is computed once: counted in the programs that XLA makes."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linked_pendulums import on_cpu

import hhtjax
from hhtjax import primitives
from hhtjax.xla import for_kernel

x = jnp.linspace(0.4, 1.1, 3)
LONG = for_kernel.LEAST_HELD  # products in the chain


def chain(x):
    y = x
    for i in range(LONG):
        y = y * (x + i)
    return y


def used(y, x):
    """By three operations, one of them of two elements."""
    return y[0] - y[1], y + x, y / x


def shared(x):
    return used(chain(x), x)


def in_kernel(x):
    return primitives.one_kernel(shared, x)


def beside_a_sort(x):
    """In what is no kernel, too."""
    return primitives.one_kernel(lambda x: (*shared(x), jnp.sort(x)), x)


def in_a_loop(x):
    """In a loop, of what a function gives that XLA inlines."""
    inner = jax.jit(chain)
    start = used(x, x)
    return primitives.one_kernel(lambda x: jax.lax.fori_loop(0, 2, lambda i, carry: used(inner(carry[1]), x), start), x)


def in_a_function(x):
    """Of a value that a single operation takes, a call of a function that uses it three times."""
    inner = jax.jit(used)
    return primitives.one_kernel(lambda x: inner(chain(x), x), x)


def products(f):
    """Numbers of multiplications, of what XLA compiles."""

    def anew(x):
        return f(x)

    text = jax.jit(anew).lower(x).compile().as_text()
    return len(re.findall(r" multiply\(", text))


@on_cpu
@pytest.mark.parametrize("f", [in_kernel, beside_a_sort, in_a_loop, in_a_function])
def test_what_several_operations_use_is_evaluated_once(monkeypatch, f):
    once = products(f)
    assert LONG <= once < 1.2 * LONG
    monkeypatch.setattr(for_kernel, "LEAST_HELD", np.inf)
    assert products(f) > 1.8 * LONG


@on_cpu
def test_it_changes_no_values():
    for f in in_kernel, beside_a_sort, in_a_loop, in_a_function:
        with hhtjax.plain():
            expected = f(x)
        for value, plain in zip(jax.tree.leaves(jax.jit(f)(x)), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(value, plain, rtol=1e-13)


@on_cpu
def test_large_values_are_handed_on_without_being_divided_among_threads():
    """Beyond what XLA leaves to one thread: a function with a single result would not link."""
    wide = jnp.linspace(0.4, 1.1, 3 * 40_000).reshape(3, -1)
    values = jax.jit(in_kernel)(wide)
    with hhtjax.plain():
        expected = jax.jit(shared)(wide)
    for value, plain in zip(values, expected, strict=True):
        np.testing.assert_allclose(value, plain, rtol=1e-13)
