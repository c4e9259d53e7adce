"""Standard errors against the scatter of the estimates, and the names of what is not determined."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.identification.identifiability import undetermined_combinations

k = jnp.arange(1600.0)
X = jnp.stack([jnp.ones(1600), jnp.sin(0.02 * k), jnp.cos(0.9 * k)], axis=1)


def coloured(key, size):
    """AR(1) noise of correlation time 1/(1 - 0.9)."""
    white = jax.random.normal(key, (size,))
    return jax.lax.scan(lambda x, e: ((0.9 * x + e),) * 2, 0.0, white)[1]


@pytest.mark.slow
def test_cluster_errors_are_the_scatter_where_residuals_are_correlated():
    """Of a slow and a fast regressor: naive errors are too small for the one and too large for the other."""

    def estimate(key):
        noise = coloured(key, 1600)
        result = hhtjax.fit(lambda p: X @ p - noise, jnp.zeros(3))
        u = result.uncertainty
        return result.params, *(jnp.diagonal(C) for C in (u.cluster, u.naive, u.autocorrelated))

    params, *variances = jax.jit(jax.vmap(estimate))(jax.random.split(jax.random.key(0), 200))
    cluster, naive, autocorrelated = (np.sqrt(v.mean(axis=0)) / params.std(axis=0) for v in variances)
    np.testing.assert_allclose(cluster, 1, atol=0.12)
    assert naive[0] < 0.4
    assert naive[2] > 1.5
    assert autocorrelated[0] == pytest.approx(1, abs=0.2)


@pytest.mark.slow
def test_intervals_cover_the_truth_where_few_segments_say_most():
    """A constant, seen in the first 5 % of the record alone, and the frequency of a wave that decays within as much."""
    present = k < 80
    wave = jnp.exp(-k / 80)

    def estimate(key):
        noise = 0.1 * jax.random.normal(key, (1600,))
        ends = []
        for residuals, start, weights in (
            (lambda p: p - noise, 0.0, present),
            (lambda p: wave * (jnp.cos(p * k) - jnp.cos(0.05 * k)) - noise, 0.05, True),
        ):
            ends.append(jnp.stack(hhtjax.fit(residuals, start, weights=weights).interval()))
        return jnp.stack(ends)

    ends = np.asarray(jax.jit(jax.vmap(estimate))(jax.random.split(jax.random.key(0), 400)))
    inside = (ends[:, :, 0] < np.array([0.0, 0.05])) & (ends[:, :, 1] > np.array([0.0, 0.05]))
    assert np.all(inside.mean(axis=0) > 0.93)  # 0.71 and 0.88 by as many degrees of freedom as there are segments
    noise = 0.1 * jax.random.normal(jax.random.key(0), (1600,))
    text = hhtjax.fit(lambda p: p - noise, 0.0, weights=present).summary()
    assert "(cluster sandwich); effective number of segments: 2 for params" in text


@pytest.mark.slow
def test_what_a_single_segment_determines_has_an_error_too():
    """A jump seen by the first segment alone: its score vanishes there, and the white variance stands in."""
    first = jnp.where(k < 40, 1.0, 0.0)
    noise = jax.random.normal(jax.random.key(1), (1600,))
    result = hhtjax.fit(lambda p: p[0] * first + p[1] - noise, jnp.zeros(2))
    assert float(result.standard_errors[0]) == pytest.approx(1 / np.sqrt(40), rel=0.15)
    assert float(result.standard_errors[1]) == pytest.approx(1 / 40, rel=0.4)


def test_outputs_may_come_before_the_samples():
    """Two outputs with the same error: their parts of one time are one segment, in whatever order the axes are."""
    noise = np.tile(np.random.default_rng(0).normal(size=(400, 1)), 2)

    def errors(residuals):
        return hhtjax.fit(residuals, jnp.zeros(2)).standard_errors

    first = errors(lambda p: (X[:400, 1] * p[0] + p[1])[:, None] - noise)
    last = errors(lambda p: ((X[:400, 1] * p[0] + p[1])[:, None] - noise).T)
    np.testing.assert_allclose(last, first, rtol=1e-9)


@pytest.mark.parametrize(
    ("directions", "values", "phrases"),
    [
        ([[1.0, 1.0, 0.0]], [2.0, 2.0, 1.0], ["k1, k2 only through their difference or ratio"]),
        ([[2.0, 3.0, 0.0]], [2.0, 3.0, 1.0], ["k1, k2 only through their ratio"]),
        ([[1.0, 1.0, 0.0]], [2.0, 3.0, 1.0], ["k1, k2 only through their difference"]),
        ([[1.0, -1.0, 0.0]], [2.0, 3.0, 1.0], ["k1, k2 only through their sum"]),
        ([[1.0, -1.0, 0.0]], [0.0, 3.0, 1.0], ["k1, k2 only through their sum"]),
        ([[1.0, -1.0, 0.0]], [2.0, 2.0, 1.0], ["k1, k2 only through their sum or product"]),
        ([[2.0, -3.0, 0.0]], [2.0, 3.0, 1.0], ["k1, k2 only through their product"]),
        ([[2.0, 3.0, -1.0]], [2.0, 3.0, -1.0], ["k1, k2, c only through their ratios"]),
        ([[0.0, 0.0, 1.0]], [2.0, 3.0, 0.0], ["c not at all"]),
        ([[1.0, 0.0, -0.5]], [1.0, 3.0, 0.0], ["k1, c not along +1 dk1/k1 -0.5 dc"]),
        (
            [[1.0, 1.0, 1.0], [1.0, 1.0, -1.0]],
            [1.0, 1.0, 1.0],
            ["k1, k2 only through their difference or ratio", "c not at all"],
        ),
    ],
)
def test_the_combination_is_named(directions, values, phrases):
    p = len(values)
    s = [1.0] * (p - len(directions)) + [0.0] * len(directions)
    rows = [[1.0, 0.0, 0.0]] * (p - len(directions)) + directions
    found = undetermined_combinations(["k1", "k2", "c"], values, s, np.array(rows), 100)
    assert sorted(found) == sorted(phrases)
