"""Error control that fails, or is asked for what it cannot give: errors that name what, and when."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ONE, ZERO, check_message, run

import hhtjax


def failing(force, **options):
    dt = hhtjax.adaptive(**{"rtol": 1e-3, "atol": 1e-6} | options)
    return hhtjax.simulate(hhtjax.System(ONE, force), hhtjax.hht(), ONE, ZERO, dt=dt, times=np.array([0.02, 2.0]))


FAILURES = {
    "not finite": (
        lambda q, v, t, p: jnp.where(t > 0.5, jnp.nan, -q), {"dt_min": 1e-6},
        "stopped at t = 0.(49|5).*: the step is not finite, at dt_min=1e-06",
    ),
    "too many": (lambda q, v, t, p: -q, {"max_steps": 20}, r"stopped at t = 0.\d+: max_steps=20 used up"),
    "too short": (
        lambda q, v, t, p: jnp.where(t > 0.5, 1e3, -q), {"dt_min": 1e-2},
        r"stopped at t = 0.\d+: the step size fell below dt_min=0.01, the error estimate being \d.* times",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FAILURES)
def test_failures_are_named_with_their_time(name):
    force, options, message = FAILURES[name]
    found = failing(force, **options)
    with pytest.raises(hhtjax.SimulationError, match=f"simulate: {message}"):
        found.check()
    assert np.isfinite(found.q[:, 0]).tolist() == [True, True, False]
    with pytest.raises(hhtjax.SimulationError, match=message):
        found.steps.check()


TIMES = np.array([[0.2, 0.1, 0.3], [-0.2, 0.1, 0.3], [0.1, 0.2, np.nan]])


def test_traced_times_that_do_not_increase_are_named():
    """Nothing is known before t0, or behind a time that is not a number; what lies between is."""

    @jax.jit
    def at(times):
        dt = hhtjax.adaptive(1e-3, 1e-6, max_steps=200)
        return hhtjax.simulate(hhtjax.System(ONE, lambda q, v, t, p: -q), hhtjax.rowda(), ONE, ZERO, dt=dt, times=times)

    for times in TIMES:
        found = at(times)
        with pytest.raises(
            hhtjax.SimulationError, match="`times` must increase, and lie after t0; with t0 in front they were"
        ):
            found.check()
        known = np.isfinite(found.q[1:, 0])
        assert not known[~(times > 0)].any()
        np.testing.assert_allclose(found.q[1:, 0][known], np.cos(times[known]), atol=1e-3)


WRONG = {
    "no times": ({}, {"times": None}, "simulate: with dt=adaptive(...), give `times`"),
    "the start": ({}, {"times": [0.0, 1.0]}, "Leave t0 out: the start is saved in any case."),
    "times back": ({}, {"times": [1.0, 0.5]}, "simulate: `times` must be strictly increasing"),
    "steps too": ({}, {"num_steps": 4}, "simulate: with dt=adaptive(...), leave `num_steps` out; received 4."),
    "extrapolate": ({}, {"extrapolate": 2}, "simulate: with dt=adaptive(...), leave `extrapolate` out; received 2."),
    "uneven": ({}, {"dt": np.full(9, 0.1)}, "with `times`, `dt` must be a number or adaptive(...); received (9,)."),
    "no estimate": ({}, {"stepper": hhtjax.kim_hht()}, "as a number, or take hht, newmark (gamma = 1/2), bossak, "),
    "gamma": ({}, {"stepper": hhtjax.newmark(0.3025, 0.6)}, "simulate: GeneralizedAlpha has no estimate of its error"),
    "rtol": ({"rtol": 0.0}, {}, "adaptive: `rtol` must be positive and finite; received 0.0."),
    "atol": ({"atol": -1.0}, {}, "adaptive: `atol` must be positive and finite; received -1.0."),
    "verify": (
        {"verify": "yes"}, {}, 'adaptive: `verify` must be True, False, "tolerance" or "tighten"; received \'yes\'.'
    ),
    "bounds": ({"dt_min": 0.2, "dt_max": 0.1}, {}, "adaptive: `dt_min` must not exceed dt_max=0.1; received 0.2."),
    "max_steps": ({"max_steps": 0}, {}, "adaptive: `max_steps` must be a positive integer; received 0."),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_bad_input_is_named(name):
    tolerances, changed, message = WRONG[name]

    def call():
        dt = hhtjax.adaptive(**{"rtol": 1e-3, "atol": 1e-6} | tolerances)
        run(**{"num_steps": None, "dt": dt, "times": [0.5, 1.0], "stepper": hhtjax.hht()} | changed)

    check_message((ValueError, TypeError, NotImplementedError), message, call)


@pytest.mark.parametrize("verify", [True, "tolerance", "tighten"])
def test_steps_alone_have_no_error_to_verify(verify):
    def call():
        hhtjax.choose_steps(hhtjax.LinearSystem(ONE), hhtjax.hht(), ONE, ZERO, times=[1.0], **tolerances)

    tolerances = {"rtol": 1e-3, "atol": 1e-6, "verify": verify}
    check_message(ValueError, f"choose_steps: leave `verify` out; received {verify!r}. It takes runs", call)
