"""A sample of random programs, the same ones each time: tests/programs.py runs as many as one likes."""

import jax.numpy as jnp
import numpy as np
import pytest
from columns import compare
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from jax import lax
from program_writer import function, program, usual_promotion
from verdicts import judge

from hhtjax.primitives import compat

pytestmark = [
    pytest.mark.skipif(not compat.is_on(), reason="plain arrays with this version of JAX"),
    pytest.mark.filterwarnings("ignore"),  # NumPy's, about NaN, overflow, and division by zero
]


def examples(number):
    """So many, the same each time; without shrinking: programs.py does it by lines, in a moment."""
    options: dict = {"deadline": None, "database": None, "phases": [Phase.generate]}
    chosen = settings(max_examples=number, derandomize=True, suppress_health_check=list(HealthCheck), **options)
    return lambda test: chosen(given(st.randoms(use_true_random=False), st.integers(3, 10))(test))


@pytest.mark.slow
@examples(40)
def test_same_numbers(rng, lines):
    check_same_numbers(rng, lines)


@pytest.mark.slow
@pytest.mark.every
@examples(100)
def test_same_numbers_of_more(rng, lines):
    check_same_numbers(rng, lines)


def check_same_numbers(rng, lines):
    with usual_promotion(), np.errstate(all="ignore"):
        text, args = program(rng, lines)
        try:
            found = list(compare(function(text), args, rng))
        except NotImplementedError:  # by plain JAX
            return
    assert not found, f"{text}\n{args}\n{found}"


def test_zeros_that_reverse_mode_makes_numbers():
    """Where a stage ends: zero times an infinite derivative. There alone NaN may stand for infinity."""

    def f(y):
        a = lax.rsqrt(y)
        return a, jnp.sort(a + np.array([0.5, 0.0]))

    assert not list(compare(f, [np.array([4.0, 0.0])]))
    numbers, infinite = [np.ones(1)] * 2, np.array([np.inf])
    for found, ahead, verdict in ((np.nan, 2, "same"), (np.nan, 3, "different"), (1, 2, "different")):
        results = [*numbers, np.array([float(found)])]
        assert judge(results, lambda _: [*numbers, infinite], 1, 1e-12, False, ahead)[0] == verdict
