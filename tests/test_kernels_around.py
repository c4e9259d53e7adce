"""Kernels with all that is around their loops; and what of a run is for batches only."""

import os
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import SPRING, ZERO
from linked_pendulums import on_cpu, paths

import hhtjax
from hhtjax import primitives

x = jnp.linspace(0.1, 1.0, 4)
KERNEL = 'xla_cpu_small_call = "true"'


@on_cpu
@pytest.mark.compiled
def test_a_kernel_around_others():
    """It is one with what is around them, where it can be, and is told of by them alone."""

    def around(f, x):
        def whole(x):
            return f(primitives.one_kernel(lambda x: 2 * x, x)) + 1

        return primitives.one_kernel(whole, x, around=True)

    for f in (jnp.cos, jnp.sort):
        assert jax.jit(partial(around, f)).lower(-x).as_text().count(KERNEL) == 1
        assert paths(partial(around, f), -x) == ("one kernel",)
        np.testing.assert_allclose(jax.jit(partial(around, f))(-x), f(-2 * x) + 1, rtol=1e-15)


@pytest.mark.slow
@on_cpu
@pytest.mark.parametrize(("derivative", "number"), [(lambda f: f, 1), (jax.grad, 3)])
def test_kernels_of_a_controlled_run_hold_all_that_is_around_their_loops(derivative, number):
    """One, which keeps samples while it chooses steps; of a gradient the choice, the run over the steps, and back."""

    def end(q):
        dt = hhtjax.adaptive(1e-3, 1e-6, max_steps=100)
        return hhtjax.simulate(SPRING, hhtjax.hht(), q[None], ZERO, dt=dt, times=np.ones(1)).q[-1, 0]

    lowered = jax.jit(derivative(end)).lower(1.0).as_text()
    assert lowered.count(KERNEL) == number


def in_order(q, v, t, params):
    return -jnp.sort(q)


@on_cpu
def test_the_users_line_that_stands_against_a_kernel_is_told():
    """Of the default step, which takes the force apart; and not in the program, whose key on disk it would change."""

    def end(q):
        return hhtjax.simulate(hhtjax.System(np.ones(2), in_order), hhtjax.hht(), q, q, dt=0.1, num_steps=2).q[-1]

    line = in_order.__code__.co_firstlineno + 1
    assert paths(end, x[:2]) == (f"plain: sort, test_kernels_around.py, line {line}, in in_order",)
    assert "test_kernels_around" not in jax.jit(end).lower(x[:2]).as_text()


def test_who_is_alone_goes_on():
    some = jnp.array([True, False])
    assert jax.jit(primitives.or_alone)(False)
    for batch in (jax.vmap(primitives.or_alone), jax.jit(jax.vmap(primitives.or_alone))):
        assert batch(some).tolist() == some.tolist()
    assert jax.vmap(jax.vmap(primitives.or_alone))(some[None]).tolist() == [some.tolist()]


SHARDED = """
import jax, jax.numpy as jnp
from jax.sharding import NamedSharding, PartitionSpec
from hhtjax import explain, primitives
mesh = jax.make_mesh((2,), ("b",))
x = jnp.arange(8.0)
def f(c):
    return primitives.one_kernel(lambda c: jax.lax.scan(lambda c, _: (c - jnp.mean(c) / 2, None), c, None, 3)[0], c)
sharded = jax.device_put(x, NamedSharding(mesh, PartitionSpec("b")))
assert jnp.allclose(jax.jit(f)(sharded), f(x))
assert explain(f, sharded).paths[0].startswith("plain: partitioned"), explain(f, sharded).paths
by_hand = jax.shard_map(f, mesh=mesh, in_specs=PartitionSpec("b"), out_specs=PartitionSpec("b"), check_vma=False)
assert explain(by_hand, sharded).paths == ("one kernel",)
"""


@pytest.mark.slow
@on_cpu
def test_a_program_divided_among_devices_is_plain():
    """In a process of its own, for there are two devices."""
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    run = subprocess.run([sys.executable, "-c", SHARDED], env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr[-2000:]
