"""A fit outside of jit, where NumPy does what is around the residuals: the same as inside, and little to compile."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.identification import problem
from hhtjax.identification.problem import is_on_host
from hhtjax.identification.transforms import bounded, fixed, positive

T = jnp.linspace(0.0, 2.0, 40)
MEASURED = 3.0 * jnp.exp(-1.3 * T) + 0.05 * jnp.sin(40.0 * T) + 0.02 * T


def decay(p):
    """Of two outputs, the second of a few samples."""
    y = p["a"] * jnp.exp(-p["rate"] * T)
    return {"y": y - MEASURED, "few": (y - MEASURED)[::7] * p["gain"]}


START = {"a": 1.0, "rate": 0.5, "gain": 1.0}
WEIGHTS = {"y": 1 / 0.05, "few": jnp.array([1.0, 0.0, 1.0, 2.0, 1.0, 1.0])}
TWO = {"a": None, "rate": None, "gain": fixed}
ONE = TWO | {"rate": fixed}
KINDS = {
    "plain": {"transforms": TWO},
    "one parameter": {"transforms": ONE},
    "transforms": {"transforms": {"a": positive, "rate": bounded(0.0, 2.0), "gain": fixed}},
    "a bound ahead": {"transforms": {"a": positive, "rate": bounded(0.0, 1.0), "gain": fixed}},
    "weights": {"weights": WEIGHTS, "transforms": TWO},
    "loss": {"weights": WEIGHTS, "loss": "cauchy", "transforms": TWO},
    "prior": {"weights": WEIGHTS, "prior": dict.fromkeys(START) | {"gain": hhtjax.Gaussian(1.0, 0.1)}},
    "few iterations": {"max_iterations": 2, "transforms": TWO},
    "no covariance": {"covariance": False, "transforms": TWO},
    "few segments": {"segments": 2, "transforms": TWO},
}

OFFSETS = {"b": jnp.array([0.1, 0.0, -0.3]), "c": jnp.zeros((3, 1))}
RECORDS = jnp.stack([MEASURED + 0.1, MEASURED - 0.02 * T, MEASURED - 0.3]).at[1, 5].set(jnp.nan)
PRESENT = {"y": jnp.isfinite(RECORDS), "few": jnp.array([1.0, 0.5, 2.0])}


def of_record(p, start, record):
    """With an offset and a drift of its own."""
    y = p["a"] * jnp.exp(-p["rate"] * T) + start["b"] + start["c"] * T - record
    return {"y": y, "few": p["gain"] * y[::7] * jnp.ones(6)}


OF_RECORDS = {
    "records": {"transforms": TWO},
    "records, bounds": {"transforms": {"a": positive, "rate": bounded(0.0, 1.2), "gain": fixed}},
    "records, loss": {"transforms": TWO, "loss": "huber"},
    "records, a parameter": {"transforms": ONE, "segments": 2},
    "records, no covariance": {"transforms": TWO, "covariance": False, "max_iterations": 2},
}
OF_RECORDS = {
    kind: {"records": RECORDS, "starts": OFFSETS, "weights": PRESENT} | options for kind, options in OF_RECORDS.items()
}
EVERY = KINDS | OF_RECORDS


@pytest.mark.parametrize("kind", EVERY)
def test_outside_as_inside(kind):
    residuals = of_record if kind in OF_RECORDS else decay
    here = hhtjax.fit(residuals, START, **EVERY[kind])
    there = jax.jit(lambda start: hhtjax.fit(residuals, start, **EVERY[kind]))(START)
    assert (int(here.code), int(here.iterations)) == (int(there.code), int(there.iterations))
    length = int(here.iterations) + 1
    there = there._replace(history=jax.tree.map(lambda x: x[:length], there.history), segments=here.segments)
    assert jax.tree.structure(here) == jax.tree.structure(there)
    numbers = zip(jax.tree.leaves_with_path(here), jax.tree.leaves(there), strict=True)
    for (path, x), y in numbers:
        assert (np.shape(x), jnp.result_type(x)) == (np.shape(y), jnp.result_type(y)), path
        if "history" not in jax.tree_util.keystr(path) and "directions" not in jax.tree_util.keystr(path):
            size = np.max(np.abs(np.nan_to_num(y, posinf=0)), initial=1e-300)
            np.testing.assert_allclose(x, y, rtol=1e-6, atol=1e-8 * size, err_msg=str(path))
    np.testing.assert_allclose(here.history.cost, there.history.cost, rtol=1e-8)


def test_single_precision_stays():
    t, measured = (x.astype(jnp.float32) for x in (T, MEASURED))
    result = hhtjax.fit(lambda p: p[0] * jnp.exp(-p[1] * t) - measured, jnp.ones(2, jnp.float32))
    assert result.converged
    numbers = [x for x in jax.tree.leaves(result) if jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating)]
    assert len(numbers) > 10
    assert {x.dtype for x in numbers if hasattr(x, "dtype")} == {jnp.dtype("float32")}
    precise = hhtjax.fit(lambda p: p[0] * jnp.exp(-p[1] * T) - MEASURED, jnp.ones(2))
    np.testing.assert_allclose(result.params, precise.params, rtol=1e-4)
    np.testing.assert_allclose(result.covariance, precise.covariance, rtol=1e-2)


def test_a_new_function_compiles_its_residuals_and_little_more():
    def compiled(f):
        count = []

        def listen(event, duration, **_):
            count.extend([event] if event.endswith("backend_compile_duration") else [])

        jax.monitoring.register_event_duration_secs_listener(listen)
        f()
        jax.monitoring.unregister_event_duration_listener(listen)
        return len(count)

    def fit(k):
        def residuals(p):
            return p * jnp.exp(-k * T) - MEASURED

        return compiled(lambda: hhtjax.fit(residuals, 1.0)), compiled(lambda: hhtjax.fit(residuals, 2.0))

    fit(1.0)
    assert fit(1.1) == (2, 0)  # the start, and the residuals with their Jacobian


def test_many_residuals_are_one_program(monkeypatch):
    calls, solve = [], problem.solve
    monkeypatch.setattr(problem, "solve", lambda *args: calls.append(args) or solve(*args))
    t = jnp.linspace(0.0, 2.0, problem.MANY // 2 + 1)
    y = 3.0 * jnp.exp(-1.3 * t) + 0.01 * jnp.sin(300.0 * t)

    def residuals(p):
        return p[0] * jnp.exp(-p[1] * t) - y

    expected = hhtjax.fit(residuals, jnp.ones(2))
    assert len(calls) == 1
    monkeypatch.setattr(problem, "MANY", 10**6)
    found = hhtjax.fit(residuals, jnp.ones(2))
    assert len(calls) == 1
    np.testing.assert_allclose(found.params, expected.params, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-7)


def test_what_is_transformed_is_inside():
    options = hhtjax.identification.arguments.check_options("fit", 1.0, None, None, None, None, True, 8, False)
    seen = []

    def look(x):
        seen.append(is_on_host(options, 1.0, x))
        return x

    look(1.0)
    for change in (jax.jit, jax.grad, jax.vmap):
        change(look)(jnp.ones(3) if change is jax.vmap else 1.0)
    jax.jit(lambda x: look(2.0) + x)(1.0)  # what is given is known, and yet it is being traced
    jax.grad(lambda x: look(2.0) + x)(1.0)
    assert seen == [True, False, False, False, False, False]


@pytest.mark.slow
def test_data_that_a_function_closes_over_have_derivatives():
    def estimate(y):
        return hhtjax.fit(lambda p: p * T - y * jnp.ones_like(T), 1.0).params

    expected = float(jnp.sum(T) / jnp.sum(T**2))
    np.testing.assert_allclose(jax.grad(estimate)(2.0), expected, rtol=1e-9)
    np.testing.assert_allclose(jax.vmap(estimate)(jnp.array([1.0, 2.0])), [expected, 2 * expected], rtol=1e-7)


@pytest.mark.parametrize("bad", ["nan", "slope", "none"])
def test_failures_are_told(bad):
    residuals = {
        "nan": lambda p: jnp.log(p - 2.0) * T,
        "slope": lambda p: jnp.sqrt(jnp.abs(p - 1.0)) * T,
        "none": lambda p: 0.0 * p + T,
    }[bad]
    words = "must depend on params" if bad == "none" else "must be finite"
    with pytest.raises(ValueError, match=words):
        hhtjax.fit(residuals, 1.0)


@pytest.mark.parametrize("size", [1e160, 5e307, jnp.inf, jnp.nan])
def test_a_trial_that_blows_up_is_taken_back(size):
    """Gauss-Newton on an arc tangent overshoots: there the residuals, or their squares, are beyond all numbers."""

    def residuals(p):
        x, y = jnp.where(jnp.abs(p[0]) < 4.0, jnp.array([jnp.arctan(p[0]), p[1]]), size * jnp.sin(p))
        return x * jnp.array([0.5, 0.75, 1.0]) + 0.1 * y * jnp.array([1.0, 2.0, 3.0])

    start = jnp.array([3.0, 0.0])
    here = hhtjax.fit(residuals, start)
    there = jax.jit(partial(hhtjax.fit, residuals))(start)
    assert here.converged
    assert (int(here.code), int(here.iterations)) == (int(there.code), int(there.iterations))
    assert float(jnp.min(here.history.step[1:])) == 0  # one was taken back
    np.testing.assert_allclose(here.params, 0.0, atol=1e-8)


def test_progress_is_shown(capsys):
    hhtjax.fit(lambda p: p * T - MEASURED, 1.0, progress=True)
    assert "converged" in capsys.readouterr().err
