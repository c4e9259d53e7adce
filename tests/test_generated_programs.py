"""A sample of random programs, the same ones each time: tests/programs.py runs as many as one likes."""

import numpy as np
import pytest
from columns import compare
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from program_writer import function, program, usual_promotion

from hhtjax.xla import gate

pytestmark = [
    pytest.mark.skipif(not gate.is_on(), reason="plain arrays with this version of JAX"),
    pytest.mark.filterwarnings("ignore"),  # NumPy's, about NaN, overflow, and division by zero
]


@pytest.mark.slow
@settings(
    max_examples=100,
    derandomize=True,
    deadline=None,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)  # without shrinking: programs.py does it by lines, in a moment
@given(st.randoms(use_true_random=False), st.integers(3, 10))
def test_same_numbers(rng, lines):
    with usual_promotion(), np.errstate(all="ignore"):
        text, args = program(rng, lines)
        try:
            found = list(compare(function(text), args, rng))
        except NotImplementedError:  # by plain JAX
            return
    assert not found, f"{text}\n{args}\n{found}"
