"""A run under error control in one pass is that in two, to rounding; test_adaptive looks at its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ONE, ZERO

import hhtjax
from hhtjax.runs.controlled_run import in_two_passes, run_recorded
from hhtjax.runs.inputs import Problem

SWING = hhtjax.System(ONE, lambda q, v, t, k: -k * jnp.sin(q) - 0.1 * v)
CASES = {  # system, stepper, q0, v0, params
    "converged": (SWING, hhtjax.hht(iterations=None), ONE, ZERO, 9.0),
    "first order": (hhtjax.FirstOrderSystem(lambda y, t, k: -k * y**3), hhtjax.rowda(), ONE, None, 4.0),
}
TIMES = np.sort(np.append(np.linspace(0, 0.6, 40)[1:], [0.07 + 1e-4, 0.07 + 2e-4, 0.2501]))  # several in one step too
CONTROL = hhtjax.adaptive(1e-3, 1e-6, max_steps=2000)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_all_that_a_run_tells(name):
    problem = Problem.checked("test", *CASES[name], 0.0, None)
    (run, steps, _), (other, same_steps, _) = (f(problem, TIMES, CONTROL) for f in (run_recorded, in_two_passes))
    assert int(steps.accepted) > 10
    assert jax.tree.structure((run, steps)) == jax.tree.structure((other, same_steps))
    for x, y in zip(jax.tree.leaves((run, steps)), jax.tree.leaves((other, same_steps)), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-11)


@pytest.mark.slow
def test_what_a_system_closes_over():
    """Of that derivatives and batches may be made too, inside a jit or around one."""

    def end(k):
        system = hhtjax.System(ONE, lambda q, v, t, p: -k * jnp.sin(q))
        return hhtjax.simulate(system, hhtjax.rowda(), ONE, ZERO, dt=CONTROL, times=TIMES[-1:]).q[-1, 0]

    less, same, more = jax.vmap(jax.jit(end))(jnp.array([8.99, 9.0, 9.01]))
    value, slope = jax.jvp(end, (9.0,), (1.0,))
    assert float(value) == pytest.approx(float(same), rel=1e-9)
    assert float(slope) == pytest.approx(float(more - less) / 0.02, rel=1e-2)
