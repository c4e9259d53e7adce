"""What the library says to wrong samples."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import INF, NAN

from hhtjax import sampled

VALUES, DT, T0 = np.random.default_rng(7).standard_normal(9), 0.25, -1.5

REAL = "must be a real number; received"
ERRORS = [
    *(
        (ValueError, f"`order` must be 0 (held), 1 (linear) or 3 (cubic); received {x!r}.", {"order": x})
        for x in (True, 2, None, "3")
    ),
    (TypeError, "`values` must be real numbers; received an array of complex128.", {"values": 1j * VALUES}),
    (TypeError, "`values` must be real numbers; received an array of bool.", {"values": VALUES > 0}),
    (ValueError, "`values` must hold at least 4 samples for order=3; received shape (3,).", {"values": VALUES[:3]}),
    (ValueError, "`values` must hold at least 4 samples for order=3; received shape ().", {"values": 1.0}),
    (
        ValueError,
        "`values` must hold at least 4 samples for order=3; received shape (3, 9).",
        {"values": np.ones((3, 9))},
    ),
    (ValueError, "at least 2 samples for order=1; received shape (1,).", {"values": VALUES[:1], "order": 1}),
    (ValueError, "`values` must be finite; received nan at sample 2.", {"values": [0.0, 1.0, NAN, 3.0, INF]}),
    (ValueError, "`values` must be finite; received", {"values": np.array([[0, 0], [0, 0], [0, 0], [1, INF]])}),
    *((ValueError, f"`dt` must be positive and finite; received {x}.", {"dt": x}) for x in (0, -0.1, NAN, INF)),
    *((TypeError, f"`dt` {REAL} {x!r}.", {"dt": x}) for x in ("slow", None, True, 1j, np.array([0.1]))),
    (TypeError, "`dt` must be a number; received one for each sample: give times as `times=`.", {"dt": VALUES}),
    *((ValueError, f"`t0` must be finite; received {x}.", {"t0": x}) for x in (NAN, INF, -INF)),
    *((TypeError, f"`t0` {REAL} {x!r}.", {"t0": x}) for x in ("now", None, True, 1j, np.array([0.1]))),
]
UNEVEN = np.arange(9.0) ** 1.5
TIMES = [
    (ValueError, "must be given without dt and t0; received dt=0.25, t0=0.0 too.", {"dt": DT}),
    (ValueError, "must be given without dt and t0; received dt=None, t0=1.0 too.", {"t0": 1.0}),
    (TypeError, "`times` must be real numbers; received an array of complex128.", {"times": 1j * UNEVEN}),
    (ValueError, "`times` must have shape (9,), one for each sample; received shape (8,).", {"times": UNEVEN[:-1]}),
    (ValueError, "`times` must have shape (9,), one for each sample; received shape ().", {"times": 0.1}),
    (
        ValueError,
        "strictly increase; received 2.0 and 2.0 at samples 1 and 2.",
        {"times": [1.0, 2.0, 2.0, *range(3, 9)]},
    ),
    (ValueError, "strictly increase; received 6.0 and nan at samples 7 and 8.", {"times": [*range(-1, 7), NAN]}),
    (ValueError, "strictly increase; received -inf and 0.0 at samples 0 and 1.", {"times": [-INF, *range(8)]}),
]


@pytest.mark.parametrize(("error", "message", "arguments"), ERRORS)
def test_arguments_are_checked(error, message, arguments):
    with pytest.raises(error, match=re.escape(message)) as caught:
        sampled(**{"values": VALUES, "dt": DT, **arguments})
    assert str(caught.value).startswith("sampled: ")


@pytest.mark.parametrize(("error", "message", "arguments"), TIMES)
def test_times_are_checked(error, message, arguments):
    with pytest.raises(error, match=re.escape(message)) as caught:
        sampled(VALUES, **{"times": UNEVEN, **arguments})
    assert str(caught.value).startswith("sampled: `times` must ")


def test_the_sample_that_is_not_finite_is_named():
    values = np.zeros((6, 3))
    values[4, 1] = INF
    with pytest.raises(ValueError, match=r"`values` must be finite; received .*inf.* at sample 4"):
        sampled(values, DT)


@pytest.mark.parametrize(
    "values",
    [
        "sine",
        None,
        np.array(["a"] * 4),
        np.ones(4, object),
        {"u": VALUES},
        np.ones(4, np.float16),
        jnp.ones(4, jnp.bfloat16),
        np.zeros((4, 0)),
    ],
    ids=repr,
)
def test_values_that_are_no_signal_are_named(values):
    with pytest.raises((TypeError, ValueError), match=r"sampled: `values` must .*; received"):
        sampled(values, DT)


def test_values_of_tracers_are_not_checked():
    bad = np.where(np.arange(9) == 4, NAN, VALUES)
    assert np.isnan(jax.jit(lambda values: sampled(values, DT, T0, 1)(-0.5))(bad))
    assert np.isfinite(jax.jit(lambda values: sampled(values, DT, T0, 1)(-1.0))(bad))
    with pytest.raises(ValueError, match=r"sampled: `values` must hold at least 4 samples .*received shape \(3,\)"):
        jax.jit(lambda values: sampled(values, DT)(0.0))(VALUES[:3])
