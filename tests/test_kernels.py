"""How a run is cut into kernels changes the compiled program, and nothing else."""

import gc
import weakref
from functools import partial

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import ClosedJaxpr
from linked_pendulums import LIGHT, N, end, loss, on_cpu, paths, run

import hhtjax
from hhtjax import primitives
from hhtjax.xla import fit_for_kernel
from hhtjax.xla.for_kernel import computed_once
from hhtjax.xla.lowering import _as_kernel

x = jnp.linspace(0.1, 1.0, 4)
order = jnp.array([1, 0, 3, 2])
BATCH = jnp.cos(jnp.arange(6.0 * 3 * 3)).reshape(6, 3, 3)
EIGHTS = jnp.sin(jnp.arange(3.0 * 4 * 5 * 8)).reshape(3, 4, 5, 8)


@pytest.mark.slow
@on_cpu
@pytest.mark.compiled
def test_one_kernel_gives_what_the_plain_path_gives(monkeypatch):
    one, verdicts = run(jax.value_and_grad(loss), 2.0)
    assert verdicts == ("one kernel", "one kernel")
    monkeypatch.setattr(fit_for_kernel, "KNOWN", set())
    plain, verdicts = run(jax.value_and_grad(loss), 2.0)
    assert verdicts[0].startswith("plain: ")
    assert np.allclose(one, plain, rtol=1e-12, atol=0)


@on_cpu
@pytest.mark.compiled
def test_a_loop_of_which_only_an_integer_is_used():
    def count(x):
        def halved(carry):
            return carry[0] / 2, carry[1] + 1

        return primitives.one_kernel(lambda x: jax.lax.while_loop(lambda carry: carry[0] > 0.1, halved, (x, 0)), x)[1]

    assert int(jax.jit(count)(1.0)) == 4
    assert paths(count, 1.0) == ("one kernel",)


@on_cpu
@pytest.mark.compiled
def test_a_conditional_on_an_argument_stays():
    def f(i, x):
        return primitives.one_kernel(lambda i, x: jax.lax.switch(i, [jnp.sin, jnp.cos], x), i, x)

    assert [float(jax.jit(f)(i, 0.5)) for i in (0, 1)] == pytest.approx([np.sin(0.5), np.cos(0.5)], rel=1e-15)
    assert paths(f, 1, 0.5) == ("one kernel",)


@pytest.mark.slow
@on_cpu
def test_derivatives_and_batches_are_one_kernel_too():
    assert paths(jax.grad(partial(loss, stepper=hhtjax.hht())), 2.0) == ("one kernel", "one kernel")
    assert paths(lambda p: jax.jvp(loss, (p,), (p,)), 2.0) == ("one kernel",)
    assert paths(jax.vmap(end), jnp.ones(3)) == ("one kernel",)


@on_cpu
@pytest.mark.compiled
def test_a_constrained_run_that_returns_all_is_one_kernel():
    """A search for dependent rows, which only `info` shows, asked for the platform: such runs were plain."""

    def length(q, t, params):
        return jnp.array([q @ q - 1])

    pendulum = hhtjax.System(jnp.ones(2), lambda q, v, t, params: jnp.array([0.0, -9.81]), constraint=length)

    def run(x):
        return hhtjax.simulate(pendulum, hhtjax.hht(), jnp.array([1.0, 0.0]) * x, jnp.zeros(2), dt=0.01, num_steps=20)

    assert paths(run, 1.0) == ("one kernel",)


SPECIAL = [
    *("acos", "asin", "asinh", "atan", "atanh", "bessel_i1e", "cosh", "digamma", "erf", "erf_inv", "erfc", "lgamma"),
    *("sinh", "square"),
]
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
    "batched products": lambda c: jnp.sum(BATCH * c[0] @ jnp.swapaxes(BATCH, 1, 2), (0, 1))[:1] * c / 99,
    "one factor batched": lambda c: jnp.sum(BATCH * c[0] @ BATCH[0], (0, 1))[:1] * c / 99,
    "a chain of transforms": lambda c: jax.lax.associative_scan(jnp.matmul, BATCH * c[0])[-1, 0, :1] * c / 99,
    "sums over several axes": lambda c: jnp.sum(EIGHTS[:, :, :, None] * c[0], (0, 2, 3))[:, 0] * c / 99,
    "4095 numbers": lambda c: c / 2 + jnp.sum(jnp.sin(jnp.arange(4095.0) * c[0])) / 9999,
    "4096 numbers": lambda c: c / 2 + jnp.sum(jnp.sin(jnp.arange(4096.0) * c[0])) / 9999,
    "a product of 4096": lambda c: c / 2 + jnp.arange(4096.0) @ jnp.sin(jnp.arange(4096.0) * c[0]) / 1e8,
    "cube roots": lambda c: jnp.cbrt(c) / 2,
    "small products and sums": lambda c: jnp.outer(c, c) @ c / 9 + jnp.sum(c) / 9 + jnp.cumsum(c) / 9,
    "special functions": lambda c: c / 2 + sum(getattr(jax.lax, f)(jnp.tanh(c) / 2) for f in SPECIAL) / 99,
    "and of two": lambda c: (
        c / 2 + (jnp.arccosh(2 + c) + jax.lax.zeta(c + 2, c + 1) + jax.lax.nextafter(c, c + 1)) / 99
    ),
    "gather, in reverse": lambda c: c[(3 * c).astype(int) % 4] / 2,
    "scatter": lambda c: c.at[order].add(c) / 3,
    "scatter of numbers twice": lambda c: c.at[jnp.array([1, 3, 1])].set(c[:3] / 2).at[0].multiply(0.9),
    "scatter of blocks": lambda c: jnp.ones((6, 6)).at[1:5, :3].set(c[:, None]).at[:2].min(c[1])[:4].sum(1) / 9,
    "scatter that drops": lambda c: c.at[(9 * c).astype(int) - 2].add(-c / 3, mode="drop", wrap_negative_indices=False),
    "interpolation": lambda c: jnp.interp(c, jnp.arange(10.0), jnp.arange(10.0) ** 2) / 9,
    "random numbers": lambda c: c / 2 + jax.random.normal(jax.random.key(3), (4,)),
    "float32": lambda c: jnp.sin(c.astype(jnp.float32)).astype(c.dtype),
}
UNSUPPORTED = {
    "sort": lambda c: jnp.sort(c) / 2,
    "top_k": lambda c: jax.lax.top_k(c, 4)[0] / 2,
    "a scatter into 4097": lambda c: c / 2 + jnp.zeros(4097).at[(3 * c).astype(int)].add(c / 9)[:4],
    "a scatter of 33": lambda c: c / 2 + jnp.zeros(4).at[jnp.arange(33) % 4].add(c[0]) / 99,
    "a scatter that computes": lambda c: c.at[1].apply(jnp.sin) / 2,
    "lapack": lambda c: jnp.linalg.solve(jnp.eye(4) + jnp.outer(c, c), c),
    "fft": lambda c: jnp.abs(jnp.fft.fft(c)) / 9,
    "callback": lambda c: jax.pure_callback(np.sin, jax.ShapeDtypeStruct(c.shape, c.dtype), c),
    "dot_general": lambda c: jnp.sum(jnp.ones((40, 40)) @ jnp.ones((40, 40)) * c[0], 1)[:4] / 999,
    "an index of 4096": lambda c: c / 2 + jnp.argmax(jnp.sin(jnp.arange(4096.0) * c[0])) / 9999,
    "a long product of another dtype": lambda c: (
        c / 2 + jnp.dot(*[(jnp.arange(4096.0) * c[0]).astype("float32")] * 2, preferred_element_type=float) / 1e12
    ),
    "4096 running sums": lambda c: c / 2 + jnp.cumsum(jnp.sin(jnp.arange(4096.0) * c[0]))[-1] / 9999,
}


@on_cpu
@pytest.mark.parametrize("name", [*SUPPORTED, *UNSUPPORTED])
@pytest.mark.compiled
def test_what_xla_cannot_compile_into_one_kernel_runs_plainly(name):
    body = (SUPPORTED | UNSUPPORTED)[name]

    def loop(c):
        return jax.lax.scan(lambda c, _: (body(c), None), c, None, 3)[0]

    def f(c):
        return primitives.one_kernel(loop, c)

    def run(f, c):
        return jax.grad(lambda c: jnp.sum(f(c)))(c) if name == "gather, in reverse" else f(c)

    assert np.allclose(jax.jit(run, static_argnums=0)(f, x), jax.jit(run, static_argnums=0)(loop, x), rtol=1e-12)
    verdict = paths(partial(run, f), x)[-1]
    assert verdict == "one kernel" if name in SUPPORTED else verdict.startswith("plain")
    if name.strip() in ("sort", "top_k", "dot_general", "reduce"):
        assert name.strip() in verdict


DIMENSIONS = [
    # batch, terms, rows, columns: every axis of its own, or several
    ((), (3,), (3,), (3,)),
    ((6,), (3,), (3,), (3,)),
    ((), (6,), (2, 6), (6,)),
    ((2, 5), (4,), (4,), (9, 4)),
    ((3,), (2, 3), (5, 2), (7,)),
    ((1,), (1,), (9,), (9,)),
    ((), (9,), (1,), (4, 2)),
    ((4,), (33,), (2,), (3,)),
    ((50,), (20,), (20,), ()),
    ((70,), (60,), (), ()),
    ((), (), (40,), (40,)),
    ((), (), (3,), (2, 3)),
]


def product(lengths):
    """einsum over such axes, in another order in the factors, and factors for it."""
    batch, terms, rows, columns = ["abcdefgh"[2 * i : 2 * i + len(x)] for i, x in enumerate(lengths)]
    sizes = dict(zip(batch + terms + rows + columns, sum(lengths, ()), strict=True))
    names = rows[::-1] + terms + batch, columns + batch + terms[::-1]
    shapes = [[sizes[i] for i in x] for x in names]
    factors = [jnp.sin(jnp.arange(1.0, 1.0 + np.prod(shape))).reshape(shape) for shape in shapes]
    return partial(jnp.einsum, f"{names[0]},{names[1]}->{batch}{rows}{columns}"), factors


@pytest.mark.slow
@on_cpu
@pytest.mark.compiled
def test_every_product_compiles_in_value_and_reverse():
    """Batched or not; and what autodiff and vmap make of it."""

    def all_of(cut):
        found = []
        for f, (A, B) in map(product, DIMENSIONS):
            f = partial(cut, f)
            found += [f(A, B), jax.vmap(f, (0, None))(jnp.stack([A, 2 * A]), B)]
            found += jax.grad(lambda A, B, f=f: jnp.sum(jnp.sin(f(A, B))), (0, 1))(A, B)
        return found

    one, verdicts = run(all_of, primitives.one_kernel)
    for x, y in zip(one, run(all_of, lambda f, *args: f(*args))[0], strict=True):
        assert np.allclose(x, y, rtol=1e-12, atol=1e-12)
    assert sum(verdict == "one kernel" for verdict in verdicts) >= 36, verdicts  # not three that are too large


def rotations(angles):
    """About the third axis, (k, 3, 3)."""
    c, s, zero, one = jnp.cos(angles), jnp.sin(angles), jnp.zeros_like(angles), jnp.ones_like(angles)
    return jnp.stack([jnp.stack(row, -1) for row in ([c, -s, zero], [s, c, zero], [zero, zero, one])], -2)


def force(q, v, t, p):
    """Of what forward kinematics is made."""
    R = rotations(q)
    end = R[0] @ R[1] @ R[2] @ jnp.ones(3)
    ones = jnp.sum(jnp.ones((2, 6, 6)) @ (jnp.ones((6, 6)) * q[0]))
    return -p * (jnp.sum(R @ jnp.swapaxes(R, 1, 2)[::-1], (1, 2)) + end + q * ones / 999)


@on_cpu
@pytest.mark.compiled
def test_forces_with_products_of_matrices_are_one_kernel():
    system = hhtjax.System(jnp.ones(3), force)

    def end(p, q0):
        return jnp.sum(hhtjax.simulate(system, LIGHT, q0, 0 * q0, p, dt=0.02, num_steps=9).q[-1] ** 2)

    def all_of(p):
        return jax.value_and_grad(end, (0, 1))(p, q0), jax.vmap(end, (0, None))(jnp.array([1.0, p]), q0)

    q0 = jnp.linspace(0.1, 1.0, 3)
    one, verdicts = run(all_of, 2.0)
    assert set(verdicts) == {"one kernel"}
    with hhtjax.plain():
        expected, verdicts = run(all_of, 2.0)
    assert set(verdicts) == {"plain: inside hhtjax.plain()"}
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(expected), strict=True):
        assert np.allclose(x, y, rtol=1e-11, atol=1e-13)


SUMS = [  # shapes, and axes that are summed over: few terms of many results, and many of few
    ((3000, 2), 1),
    ((2, 3000), 0),
    ((4, 700, 3), (0, 2)),
    ((1500, 3, 2), (1,)),
    ((3000, 8), 1),
    ((10_001,), 0),
    ((3, 5001), 1),
]


@on_cpu
@pytest.mark.compiled
def test_large_sums_are_written_in_parts():
    """In value, in slopes, and in batches."""

    def sums(p):
        arrays = [p * jnp.cos(jnp.arange(1.0 * np.prod(shape))).reshape(shape) for shape, _ in SUMS]
        sums = [jnp.sum(x, axis=axes) for x, (_, axes) in zip(arrays, SUMS, strict=True)]
        long = arrays[-2]
        product = jnp.prod(1 + 1e-4 * long)
        return [*sums, product, jnp.max(long), jnp.min(arrays[-1], axis=1), long @ jnp.sin(long), long[None] @ long]

    def all_of(cut):
        slope = lambda p: jax.jvp(sums, (p,), (p,))  # noqa: E731
        return cut(sums, 2.0), cut(jax.vmap(sums), jnp.array([1.0, 2.0])), cut(slope, 2.0)

    one, verdicts = run(all_of, primitives.one_kernel)
    assert set(verdicts) == {"one kernel"}
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(run(all_of, lambda f, *args: f(*args))[0]), strict=True):
        assert np.allclose(x, y, rtol=1e-12, atol=1e-12)


@on_cpu
@pytest.mark.compiled
def test_a_stage_of_a_large_batch_is_not_divided_among_threads():
    """XLA would call what kernels are not linked with."""
    c = jnp.linspace(0.1, 1.0, 10**5)

    def f(c):
        def body(c, _):
            return primitives.staged(lambda c: jnp.sin(c) * c)(c) + c / 2, None

        return primitives.one_kernel(lambda c: jax.lax.scan(body, c, None, 2)[0], c)

    assert jnp.all(jnp.isfinite(jax.jit(f)(c)))


@pytest.mark.slow
@on_cpu
@pytest.mark.compiled
def test_a_batch_of_thousands_compiles():
    q0 = jnp.outer(jnp.linspace(-1, 1, 5000), jnp.ones(N))
    assert jnp.all(jnp.isfinite(jax.vmap(partial(end, 2.0))(q0)))


def test_a_program_for_several_platforms_is_plain():
    def f(c):
        return primitives.one_kernel(lambda c: jax.lax.scan(lambda c, _: (jnp.sin(c), None), c, None, 3)[0], c)

    exported = jax.export.export(jax.jit(f), platforms=("cpu", "cuda"))(x)
    assert "xla_cpu_small_call" not in exported.mlir_module()
    assert np.allclose(exported.call(x), f(x))


@on_cpu
@pytest.mark.compiled
def test_shared_values_are_computed_once():
    def sines(barrier):
        def body(x, _):
            y = barrier(jnp.sin)(x)
            return jnp.cumsum(y * x) + y[::-1] * x, None

        def run(x):
            return primitives.one_kernel(lambda x: jax.lax.scan(body, x, None, 99)[0], x)

        return str(jax.jit(run).lower(jnp.ones(N, jnp.float32)).compile().as_text()).count(" sine(")

    assert sines(partial(primitives.staged, size=N)) == 1
    assert sines(partial(primitives.staged, size=1)) == 2  # fused into both users


@pytest.mark.parametrize("f", [lambda x: jnp.sin(x) + x, jnp.sort], ids=["a kernel", "none"])
def test_what_is_known_of_a_jaxpr_ends_with_it(f):
    made = jax.make_jaxpr(f)(jnp.ones(3))
    closed = ClosedJaxpr(made.jaxpr, made.consts)  # JAX keeps its own
    computed_once(closed)
    _as_kernel(closed)
    alive = weakref.ref(closed)
    del closed
    gc.collect()
    assert alive() is None
