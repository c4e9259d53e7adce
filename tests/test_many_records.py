"""Fits whose records are evaluated elsewhere, and fits from starts that workers take: the same estimates."""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax

PENDULUM = hhtjax.System(np.ones(1), lambda q, v, t, p: -p["k"] * jnp.sin(q) - p["c"] * v)
TRUE, GUESS = {"k": 4.0, "c": 0.3}, {"k": 2.0, "c": 0.1}
RNG = np.random.default_rng(0)
ANGLES = RNG.uniform(0.3, 1.2, 11)
NOISE = 0.01 * RNG.normal(size=(11, 31))


def motion(params, angle, dt=0.1):
    """Angles of a run."""
    run = hhtjax.simulate(PENDULUM, hhtjax.hht(), angle[None], jnp.zeros(1), params, dt=dt, num_steps=30)
    return run.q[:, 0]


def residuals(params, start, record):
    """Of a record."""
    return motion(params, start) - record


RECORDS = np.asarray(jax.vmap(lambda angle: motion(TRUE, angle))(ANGLES)) + NOISE
FIT = {"records": RECORDS, "starts": RECORDS[:, 0].copy(), "weights": 100.0, "transforms": {"k": hhtjax.positive}}
LOSSES = {"least squares": {}, "a loss": {"loss": "huber"}, "no covariance": {"covariance": False}}


@pytest.fixture(scope="module")
def threads():
    """Workers of this process."""
    with ThreadPoolExecutor(2) as executor:
        yield executor


@pytest.mark.slow
@pytest.mark.parametrize("name", LOSSES)
def test_records_of_workers_give_the_same_estimates(threads, name):
    options = FIT | LOSSES[name]
    alone = hhtjax.fit(residuals, GUESS, **options)
    ways = {"executor": threads, "chunk": 4}, {"mesh": jax.make_mesh((jax.device_count(),), ("records",))}
    for way in ways[: 1 if name == "no covariance" else 2]:
        found = hhtjax.fit(residuals, GUESS, **options, **way)
        assert found.converged
        assert found.segments == alone.segments
        for a, b in ((found.params, alone.params), (found.standard_errors, alone.standard_errors)):
            jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5), a, b)
        np.testing.assert_allclose(found.starts, alone.starts, rtol=1e-6)
        np.testing.assert_allclose(found.cost, alone.cost, rtol=1e-10)
        np.testing.assert_allclose(found.residual, alone.residual, atol=1e-6)


def test_the_triangles_are_those_of_the_rows(threads):
    """A step from them is that from rows: R^T R = J^T J, to rounding; what comes back does not grow with samples."""
    from hhtjax.identification import many_records
    from hhtjax.identification.bordered_least_squares import Arrow
    from hhtjax.identification.losses import Objective

    x, own = np.array([1.0, 2.0]), np.array([[0.5], [0.7], [0.9]])
    t = np.linspace(0, 1, 40)
    records = np.sin(np.outer([1, 2, 3], t))

    def f(x, own, record):
        return x[0] * jnp.sin(x[1] * t + own[0]) - record

    problem = Arrow(f, Objective(jnp.full(120, 2.0), None, 120), records, 2, None)
    both = jnp.concatenate([x, own.ravel()])
    seen = problem.see(both)
    rows = np.concatenate([seen.J, seen.r[:, :, None]], axis=2)
    triangles = many_records.triangles(seen)
    assert triangles.shape == (3, 4, 4)
    np.testing.assert_allclose(
        np.einsum("bij,bik->bjk", triangles, triangles), np.einsum("bij,bik->bjk", rows, rows), rtol=1e-12
    )


@pytest.mark.slow
def test_a_task_may_hold_fewer_residuals_than_there_are_parameters(threads):
    records = RNG.normal(size=(12, 3))

    def line(params, start, record):
        return params["a"] * jnp.arange(3.0) + params["b"] * jnp.array([0.0, 0.0, 1.0]) + start - record

    guess = {"a": 0.0, "b": 0.0, "c": 1.0}
    options = {"records": records, "starts": records[:, 0].copy(), "transforms": {"c": hhtjax.fixed}}
    found = hhtjax.fit(line, guess, **options, executor=threads)
    np.testing.assert_allclose(found.params["a"], hhtjax.fit(line, guess, **options).params["a"], rtol=1e-8)


def test_what_cannot_be_shared_out_is_refused(threads):
    def refused(words, error=ValueError, **options):
        with pytest.raises(error, match=words):
            hhtjax.fit(residuals, GUESS, **(FIT | {"executor": threads} | options))

    mesh = jax.make_mesh((1,), ("records",))
    refused("give an `executor` or a `mesh`, not both", mesh=mesh)
    refused("`mesh` must be a jax.sharding.Mesh; received 3", TypeError, mesh=3, executor=None)
    refused("`chunk` must be a positive integer", chunk=0)
    with pytest.raises(ValueError, match="needs `records` and Levenberg-Marquardt"):
        hhtjax.fit(lambda params: params["k"] - np.ones(3), {"k": 1.0}, executor=threads)
    with pytest.raises(TypeError, match="call it outside jit, vmap and grad, on the CPU"):
        jax.jit(lambda k: hhtjax.fit(residuals, GUESS | {"k": k}, **FIT, executor=threads).params)(2.0)

    def adaptive(params, start, record):
        control = hhtjax.adaptive(rtol=1e-4, atol=1e-4)
        times = 0.1 * np.arange(1, 31)
        run = hhtjax.simulate(PENDULUM, hhtjax.hht(), start[None], jnp.zeros(1), params, dt=control, times=times)
        return run.q[1:, 0] - record[1:]

    with pytest.raises(NotImplementedError, match="must not simulate under error control"):
        hhtjax.fit(adaptive, GUESS, **FIT, executor=threads)


@pytest.mark.slow
def test_starts_of_workers(threads):
    measured = RECORDS[0]
    starts = {"k": np.array([1.0, 3.0, 6.0]), "c": np.full(3, 0.1)}

    def one(params):
        return motion(params, measured[0]) - measured

    alone = hhtjax.multistart(one, starts)
    found = hhtjax.multistart(one, starts, executor=threads, chunk=2)
    np.testing.assert_allclose(found.best.params["k"], alone.best.params["k"], rtol=1e-9)
    np.testing.assert_allclose(found.all.cost, alone.all.cost, rtol=1e-9)
    assert found.best.summary().splitlines()[1:4] == alone.best.summary().splitlines()[1:4]
    with pytest.raises(TypeError, match="multistart: with an `executor`, all arguments must be known: call it outside"):
        jax.jit(lambda k: hhtjax.multistart(one, starts | {"k": k}, executor=threads).best.cost)(starts["k"])
