"""What `fit` is handed over, and what it says of it."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax

GOOD = jnp.zeros(4)


def rooted(p):
    return {"a": GOOD, "b": jnp.sqrt(p) * jnp.ones(3)}


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: hhtjax.fit(3, 1.0), TypeError, r"`residuals` must be a function residuals\(params\); received 3"),
        (lambda: hhtjax.fit(lambda p: GOOD, 1.0, "adam"), TypeError, "`optimizer` must be an optax .* received 'adam'"),
        (lambda: hhtjax.fit(lambda p: GOOD, {}), ValueError, "`params0` must hold at least one number; received {}"),
        (lambda: hhtjax.fit(lambda p: GOOD, np.ones(0)), ValueError, "`params0` must hold at least one number"),
        (lambda: hhtjax.fit(lambda p: GOOD, {"k": 1j}), TypeError, r"`params0\['k'\]` must be a real .* received 1j"),
        (lambda: hhtjax.fit(lambda p: GOOD, {"k": "1"}), TypeError, r"`params0\['k'\]` must be a real .* received '1'"),
        (
            lambda: hhtjax.fit(lambda p: GOOD, np.array(["k"])),
            TypeError,
            r"`params0` must be a real .* received array",
        ),
        (lambda: hhtjax.fit(lambda p: GOOD, {"k": len}), TypeError, r"`params0\['k'\]` must be a real .* function len"),
        (lambda: hhtjax.fit(lambda p: {"r": "4"}, 1.0), TypeError, r"return real arrays; received '4' at \['r'\]"),
        (
            lambda: hhtjax.fit(lambda p: np.sin(p) + GOOD, 1.0),
            TypeError,
            "traceable by JAX: use jax.numpy instead of",
        ),
        (lambda: hhtjax.fit(lambda p: math.sin(p) + GOOD, 1.0), TypeError, "`residuals` must be traceable by JAX"),
        (lambda: hhtjax.fit(lambda p: p if p > 0 else -p, 1.0), TypeError, "`residuals` must be traceable by JAX"),
        (lambda: hhtjax.fit(lambda p: GOOD, jnp.ones(2, complex)), TypeError, "`params0` must be real; received compl"),
        (lambda: hhtjax.fit(lambda p: GOOD, {"k": jnp.nan}), ValueError, r"`params0\['k'\]` must be finite; .* nan"),
        (lambda: hhtjax.fit(lambda p: GOOD, 1.0, max_iterations=0), ValueError, "`max_iterations` .* received 0"),
        (lambda: hhtjax.fit(lambda p: GOOD, 1.0, tolerance=-1.0), ValueError, "`tolerance` must be positive; .* -1.0"),
        (lambda: hhtjax.fit(lambda p: GOOD, {"k": 1.0}, scale=2.0), ValueError, "`scale` must be a pytree structured"),
        (
            lambda: hhtjax.fit(lambda p: GOOD, {"k": 1.0}, scale={"k": 0.0}),
            ValueError,
            r"`scale\['k'\]` must be positive; received 0.0",
        ),
        (
            lambda: hhtjax.fit(lambda p: GOOD, jnp.ones(2), scale=jnp.ones(3)),
            ValueError,
            r"`scale` must have the shape of its parameter, \(2,\); received \(3,\)",
        ),
        (
            lambda: hhtjax.fit(lambda p: p[:2], jnp.ones(3)),
            ValueError,
            "`residuals` must return at least as many numbers as there are parameters, 3; received 2",
        ),
        (
            lambda: hhtjax.fit(lambda p: jax.lax.complex(p, p) * jnp.ones(4, complex), 1.0),
            TypeError,
            "`residuals` must return real floats; .* complex",
        ),
        (
            lambda: hhtjax.fit(rooted, -1.0, covariance=False),
            ValueError,
            r"`residuals` must be finite at params0; received nan at residuals\['b'\]\[0\] \(3 of 7 entries\); give "
            "missing samples the weight False",
        ),
        (
            lambda: hhtjax.fit(rooted, -1.0, covariance=False, weights={"a": 1.0, "b": np.array([0.0, 1.0, 1.0])}),
            ValueError,
            r"`residuals` must be finite at params0; received nan at residuals\['b'\]\[1\] \(2 of 7 entries\)\.",
        ),
        (
            lambda: hhtjax.fit(rooted, 0.0, covariance=False),
            ValueError,
            r"received a finite residual whose derivative is not finite: .* use max\(x, 1e-12\) for x there\.$",
        ),
        (
            lambda: hhtjax.fit(lambda p: 1e200 * p * jnp.ones(4), 2.0, covariance=False),
            ValueError,
            r"`residuals` must be finite at params0; received values up to 2e\+200, whose squares overflow; take other",
        ),
    ],
)
def test_bad_input_is_named(call, error, message):
    with pytest.raises(error, match=message):
        call()


CLOCK = jnp.linspace(0.0, 1.0, 21)


def column_less_row(p):
    return {"q": 3 * ((p * CLOCK)[:, None] - jnp.sin(CLOCK)) / 2}


def of_a_record(p, start, record):
    return (start + p * CLOCK)[:, None] - record


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit])
def test_every_sample_less_every_other_is_refused(wrap):
    """(n, 1) less (n,), of which JAX and NumPy make (n, n)."""
    message = r"fit: `residuals` must be one for each sample; received \(21, 21\).* \(21, 1\) and \(21,\)"
    with jax.numpy_rank_promotion("allow"):
        with pytest.raises(ValueError, match=message):
            hhtjax.fit(wrap(column_less_row), 1.0, covariance=False)
        records = jnp.stack([jnp.sin(CLOCK)] * 2)
        with pytest.raises(ValueError, match=message):
            hhtjax.fit(wrap(of_a_record), 1.0, records=records, starts=jnp.zeros(2), covariance=False)


@pytest.mark.parametrize(
    "residuals",
    [
        lambda p: p * CLOCK[:, None] * CLOCK - 0.5 * jnp.outer(CLOCK, CLOCK) * jnp.ones((21, 21)),
        lambda p: p * CLOCK[:, None] - 0.5 * CLOCK[:, None] + 0 * CLOCK[None, :],
        lambda p: p * jnp.ones((21, 21)) * CLOCK - 0.5 * CLOCK,
    ],
)
def test_square_residuals_on_purpose_are_none_of_it(residuals):
    """Of a matrix of measurements, or with both ranks written out."""
    matrix = jnp.arange(441.0).reshape(21, 21) / 441
    with jax.numpy_rank_promotion("allow"):
        found = hhtjax.fit(lambda p: residuals(p) + 0 * matrix, 1.0, covariance=False)
    assert float(found.params) == pytest.approx(0.5)


def test_a_missing_sample_of_a_record_is_named():
    records = jnp.stack([CLOCK, CLOCK.at[7].set(jnp.nan)])
    message = r"received nan at residuals\[1, 7\], record 1, sample 7 \(1 of 42 entries\); give missing samples"
    with pytest.raises(ValueError, match=message):
        hhtjax.fit(lambda p, start, record: start + p * CLOCK - record, 1.0, records=records, starts=jnp.zeros(2))
