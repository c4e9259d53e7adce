"""A loop that cannot be one kernel: its stages are kernels of their own, and its numbers stay what they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from linked_pendulums import on_cpu

import hhtjax
from hhtjax import primitives
from hhtjax.xla import for_kernel, lowering

x = jnp.linspace(-0.4, 1.1, 6)
KERNEL = 'xla_cpu_small_call = "true"'


def smooth(x, y):
    """A stage that is a kernel, with another, a loop and an unused argument in it."""
    z = primitives.staged(lambda x: jnp.sin(x) * x[0] - jnp.cos(x[::-1]) / 3)(x)
    return lax.fori_loop(0, 3, lambda i, z: 0.9 * z + jnp.tanh(z) * x[i], z), x[None] * x[:, None]


smooth_part = primitives.part(smooth)


@primitives.staged
def sorted_stage(x, flag):
    """A stage that is none, and holds one."""
    a, b = smooth_part(x, 2 * x)
    return jnp.sort(a) + jnp.where(flag, jnp.sum(b, axis=0), x)


def step(x, i):
    """Calls the same stage from two places, and one of few operations."""
    y = sorted_stage(x, i > 1)
    z = primitives.staged(lambda y: -y)(y)
    return sorted_stage(jnp.exp(z - 1), i > 0), jnp.sum(y * z)


def run(x):
    return primitives.one_kernel(lambda x: lax.scan(step, x, jnp.arange(3)), x)


def loss(x):
    last, sums = run(x)
    return jnp.sum(last * x) + jnp.sum(sums**2)


def lowered(f, x, name="a_user"):
    """Anew: what has been lowered is kept for each function."""

    def call(x):
        return f(x)

    call.__name__ = name
    return jax.jit(call).lower(x)


@on_cpu
@pytest.mark.compiled
@pytest.mark.parametrize(
    ("f", "x", "number"),
    [(run, x, 1), (jax.grad(loss), x, 4), (jax.vmap(run), jnp.stack([x, x[::-1], x**2]), 1)],
    ids=["values", "reverse", "batch"],
)
def test_stages_as_kernels_give_what_plain_jax_gives(f, x, number):
    program = lowered(f, x)
    assert program.as_text().count(KERNEL) == number
    with hhtjax.plain():
        expected = lowered(f, x).compile()(x)
    for found, known in zip(jax.tree.leaves(program.compile()(x)), jax.tree.leaves(expected), strict=True):
        assert np.allclose(found, known, rtol=1e-12, atol=1e-14)


@on_cpu
@pytest.mark.parametrize(("limit", "value", "number"), [("LEAST", 1000, 0), ("LARGEST", 35, 1)])
def test_short_and_large_stages_are_no_kernels(monkeypatch, limit, value, number):
    """But what a large one holds is."""
    monkeypatch.setattr(for_kernel, limit, value)
    assert lowered(run, x).as_text().count(KERNEL) == number


@on_cpu
def test_nothing_changes_where_fusions_compile_quickly():
    token = lowering.quickly.set(True)
    assert lowered(run, x).as_text().count(KERNEL) == 0
    lowering.quickly.reset(token)
