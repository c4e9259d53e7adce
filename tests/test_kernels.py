"""How a run is cut into kernels changes the compiled program, and nothing else."""

import os
import subprocess
import sys
from functools import partial

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.xla import gate, inspection, kernels

on_cpu = pytest.mark.skipif(
    jax.default_backend() != "cpu" or not gate.is_on(),
    reason="kernels are cut on the CPU only, by JAX 0.10.2 or newer",
)
N = 5
x = jnp.linspace(0.1, 1.0, 4)
order = jnp.array([1, 0, 3, 2])
EIGHTS = jnp.sin(jnp.arange(3.0 * 4 * 5 * 8)).reshape(3, 4, 5, 8)


def links(q, v, t, params):
    """Five pendulums, coupled."""
    return -jnp.sin(q[:, None] - q[None, :]) @ v**2 - params * jnp.sin(q)


def end(params, q0=None):
    """Of a short run of the links; all of it new for JAX, which would take the program of the last call."""
    system = hhtjax.System(jnp.arange(1.0, N + 1), lambda *args: links(*args))
    q0 = jnp.linspace(0.1, 1.0, N) if q0 is None else q0
    return hhtjax.simulate(system, hhtjax.hht(), q0, 0 * q0, params, dt=0.05, num_steps=20, save_every=20).q[-1]


def loss(params):
    return jnp.sum(end(params) ** 2)


def paths(f, *args):
    return hhtjax.explain(f, *args).paths


@on_cpu
def test_one_kernel_gives_what_the_plain_path_gives(monkeypatch):
    one = jax.jit(jax.value_and_grad(loss))(2.0)
    monkeypatch.setattr(inspection, "PROVEN", set())
    assert paths(jax.grad(loss), 2.0)[0].startswith("plain: stablehlo.")
    assert np.allclose(one, jax.jit(jax.value_and_grad(loss))(2.0), rtol=1e-12, atol=0)


@on_cpu
def test_a_conditional_on_an_argument_stays():
    def f(i, x):
        return kernels.one_kernel(lambda i, x: jax.lax.switch(i, [jnp.sin, jnp.cos], x), i, x)

    assert [float(jax.jit(f)(i, 0.5)) for i in (0, 1)] == pytest.approx([np.sin(0.5), np.cos(0.5)], rel=1e-15)
    assert paths(f, 1, 0.5) == ("one kernel",)


@on_cpu
def test_derivatives_and_batches_are_one_kernel_too():
    assert paths(jax.grad(loss), 2.0) == ("one kernel", "one kernel")
    assert paths(lambda p: jax.jvp(loss, (p,), (p,)), 2.0) == ("one kernel",)
    assert paths(jax.vmap(end), jnp.ones(3)) == ("one kernel",)


SUPPORTED = {
    "elementwise": lambda c: jnp.tanh(c) + jnp.arctan2(c, 1 + c) + jax.scipy.special.erf(c) + c**0.3,
    "control flow": lambda c: jax.lax.cond(c[0] > 0.5, lambda c: c / 2, lambda c: c + 1, c),
    "a loop": lambda c: jax.lax.while_loop(lambda c: c[0] < 3, lambda c: c + 0.5, c) / 10,
    "indices": lambda c: c[order] + c[(3 * c).astype(int) % 4],
    "matrices of 7": lambda c: ((jnp.ones((7, 7)) * c[0]) @ (jnp.ones((7, 7)) * c[1]))[:4, :4] @ c / 99,
    "nine rows": lambda c: jax.vmap(lambda b: jnp.eye(4) @ b)(jnp.outer(jnp.ones(9), c))[3] / 2,
    "eight terms": lambda c: (EIGHTS[0, 0, :4] * c[0]) @ (EIGHTS[1, :, 1].T * c[1]) @ c / 99,
    "products of blocks": lambda c: (
        jnp.einsum("abij,cbdj->baicd", EIGHTS * c[0], EIGHTS[::-1])[1, 1, 2, 2, :4] * c / 99
    ),
    "small products and sums": lambda c: jnp.outer(c, c) @ c / 9 + jnp.sum(c) / 9 + jnp.cumsum(c) / 9,
    "interpolation": lambda c: jnp.interp(c, jnp.arange(10.0), jnp.arange(10.0) ** 2) / 9,
    "random numbers": lambda c: c / 2 + jax.random.normal(jax.random.key(3), (4,)),
    "float32": lambda c: jnp.sin(c.astype(jnp.float32)).astype(c.dtype),
}
UNSUPPORTED = {
    "sort": lambda c: jnp.sort(c) / 2,
    "scatter": lambda c: c.at[order].add(c) / 3,
    "lapack": lambda c: jnp.linalg.solve(jnp.eye(4) + jnp.outer(c, c), c),
    "fft": lambda c: jnp.abs(jnp.fft.fft(c)) / 9,
    "callback": lambda c: jax.pure_callback(np.sin, jax.ShapeDtypeStruct(c.shape, c.dtype), c),
    "dot_general": lambda c: jnp.sum(jnp.ones((40, 40)) @ jnp.ones((40, 40)) * c[0], 1)[:4] / 999,
    "reduce": lambda c: c / 2 + jnp.sum(jnp.ones(5000) * c[0]) / 9999,
    "gather, in reverse": lambda c: c[(3 * c).astype(int) % 4] / 2,
}


@on_cpu
@pytest.mark.parametrize("name", [*SUPPORTED, *UNSUPPORTED])
def test_what_xla_cannot_compile_into_one_kernel_runs_plainly(name):
    body = (SUPPORTED | UNSUPPORTED)[name]

    def loop(c):
        return jax.lax.scan(lambda c, _: (body(c), None), c, None, 3)[0]

    def f(c):
        return kernels.one_kernel(loop, c)

    def run(f, c):
        return jax.grad(lambda c: jnp.sum(f(c)))(c) if name == "gather, in reverse" else f(c)

    assert np.allclose(jax.jit(run, static_argnums=0)(f, x), jax.jit(run, static_argnums=0)(loop, x), rtol=1e-12)
    verdict = paths(partial(run, f), x)[-1]
    assert verdict == "one kernel" if name in SUPPORTED else verdict.startswith("plain")
    if name.strip() in ("sort", "dot_general", "reduce"):
        assert name.strip() in verdict


@on_cpu
def test_a_batch_of_thousands_compiles():
    q0 = jnp.outer(jnp.linspace(-1, 1, 5000), jnp.ones(N))
    assert jnp.all(jnp.isfinite(jax.vmap(partial(end, 2.0))(q0)))


def test_a_program_for_several_platforms_is_plain():
    def f(c):
        return kernels.one_kernel(lambda c: jax.lax.scan(lambda c, _: (jnp.sin(c), None), c, None, 3)[0], c)

    exported = jax.export.export(jax.jit(f), platforms=("cpu", "cuda"))(x)
    assert "xla_cpu_small_call" not in exported.mlir_module()
    assert np.allclose(exported.call(x), f(x))


SHARDED = """
import jax, jax.numpy as jnp
from jax.sharding import NamedSharding, PartitionSpec
from hhtjax import explain
from hhtjax.xla import gate, kernels
mesh = jax.make_mesh((2,), ("b",))
x = jnp.arange(8.0)
def f(c):
    return kernels.one_kernel(lambda c: jax.lax.scan(lambda c, _: (c - jnp.mean(c) / 2, None), c, None, 3)[0], c)
sharded = jax.device_put(x, NamedSharding(mesh, PartitionSpec("b")))
assert jnp.allclose(jax.jit(f)(sharded), f(x))
assert explain(f, sharded).paths[0].startswith("plain: partitioned"), explain(f, sharded).paths
by_hand = jax.shard_map(f, mesh=mesh, in_specs=PartitionSpec("b"), out_specs=PartitionSpec("b"), check_vma=False)
assert explain(by_hand, sharded).paths == ("one kernel",)
"""


@on_cpu
def test_a_program_divided_among_devices_is_plain():
    """In a process of its own, for there are two devices."""
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    run = subprocess.run([sys.executable, "-c", SHARDED], env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr[-2000:]


@on_cpu
def test_shared_values_are_computed_once():
    def sines(barrier):
        def body(x, _):
            y = barrier(jnp.sin)(x)
            return jnp.cumsum(y * x) + y[::-1] * x, None

        def run(x):
            return kernels.one_kernel(lambda x: jax.lax.scan(body, x, None, 99)[0], x)

        return jax.jit(run).lower(jnp.ones(N)).compile().as_text().count(" sine(")

    assert sines(partial(kernels.staged, size=N)) == 1
    assert sines(partial(kernels.staged, size=1)) == 2  # fused into both users
