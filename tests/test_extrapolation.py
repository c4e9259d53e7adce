"""Richardson's extrapolation of whole runs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from zoo import PROBLEMS, as_data, ends_of_two, reference, run

import hhtjax
from hhtjax import rotation
from hhtjax.runs.extrapolate import extrapolated
from hhtjax.runs.solution import Events, Failure, Solution
from hhtjax.steppers.stepper import Info

DUFFING = PROBLEMS["forced Duffing"]


def smooth(alpha):
    """The step that is a smooth function of dt, alpha as data."""
    return as_data(hhtjax.hht(alpha, linearize="predictor"))


@pytest.mark.slow
@pytest.mark.parametrize(("alpha", "levels", "order"), [(-0.3, 2, 3), (-0.3, 3, 4), (0.0, 2, 4)])
def test_each_level_adds_an_order_and_the_trapezoidal_rule_two(alpha, levels, order):
    errors = [
        abs(found.q[end] - reference("forced Duffing"))
        for found, end in ends_of_two(DUFFING, smooth(alpha), 40, extrapolate=levels)
    ]
    assert float(np.log2(errors[0] / errors[1])[0]) == pytest.approx(order, abs=0.2)


@pytest.mark.slow
def test_all_quantities_at_the_saved_times_of_the_first_run():
    stepper = hhtjax.hht(iterations=None)
    found = run(DUFFING, stepper, 20, save_every=4, extrapolate=2)
    coarse, fine = (run(DUFFING, stepper, 20 * k, save_every=4 * k) for k in (1, 2))
    np.testing.assert_array_equal(found.t, coarse.t)
    assert float(found.dt) == float(coarse.dt)
    for field in ("q", "v", "acceleration"):
        a, b = getattr(coarse, field), getattr(fine, field)
        np.testing.assert_allclose(getattr(found, field), (4 * b - a) / 3, rtol=1e-13)
    np.testing.assert_array_equal(found.info.iterations, coarse.info.iterations + fine.info.iterations)
    np.testing.assert_array_equal(found.info.residual, np.maximum(coarse.info.residual, fine.info.residual))
    found.check()


@pytest.mark.slow
def test_derivatives_are_those_of_the_extrapolated_value():
    @jax.jit
    def end(k):
        path = run(DUFFING._replace(params={**DUFFING.params, "k": k}), smooth(-0.1), 20, save_every=20, extrapolate=2)
        return path.q[-1, 0]

    reverse, forward = jax.jit(lambda k: (jax.grad(end)(k), jax.jvp(end, (k,), (1.0,))[1]))(1.0)
    assert float(reverse) == pytest.approx(float(forward), rel=1e-12)
    assert float(reverse) == pytest.approx(float(end(1 + 1e-5) - end(1 - 1e-5)) / 2e-5, rel=1e-8)


@pytest.mark.slow
def test_rotations_are_extrapolated_along_a_rotation():
    """Errors of 0.4 k^-2 of a turn, of both of two bodies at three times, are gone: also from {R, x} as a pytree."""
    start = rotation.exp(jnp.array([0.5, -1.0, 2.0]))
    psi = jnp.arange(18.0).reshape(3, 2, 3) / 20

    @jax.jit
    def turned(share):
        return jax.vmap(jax.vmap(lambda x: start @ rotation.exp(share * x)))(psi)

    def run(k):
        q, v = {"R": turned(1 + 0.4 / k**2), "x": psi / k**2}, {"R": psi, "x": psi}
        none = jnp.zeros((), jnp.int32)
        return Solution(jnp.arange(3.0), q, v, v, None, 0.1, Info(), Failure(none, jnp.array(False), none))

    found = extrapolated(run, 2, 2, lambda info, _: info)
    np.testing.assert_allclose(found.q["R"], turned(1.0), atol=1e-14)
    np.testing.assert_allclose(found.q["x"], 0, atol=1e-15)


def test_a_failure_of_the_fine_run_is_named_by_the_step_of_the_coarse_one():
    def force(q, v, t, params):
        return jnp.where(jnp.abs(t - 0.25) < 1e-9, jnp.nan, -q)

    system = hhtjax.System(jnp.ones(1), force)

    def path(levels):
        start = jnp.array([1.0]), jnp.array([0.0])
        return hhtjax.simulate(system, hhtjax.hht(), *start, dt=0.1, num_steps=4, extrapolate=levels)

    path(1).check()
    with pytest.raises(hhtjax.SimulationError, match=r"step 3 \(to t = 0\.3\)"):
        path(2).check()


@pytest.mark.parametrize("levels", [0, 5, True, 1.5, None])
def test_other_numbers_of_levels_are_refused(levels):
    with pytest.raises(ValueError, match="simulate: `extrapolate` must be an integer from 1 to 4; received"):
        run(DUFFING, hhtjax.hht(), 4, extrapolate=levels)


def with_events(t, v, found):
    """A `Solution` at these times of q = 3 t, whose events at the times found turn v back."""
    none, q = jnp.zeros((), jnp.int32), 3.0 * t[:, None]
    told, at = jnp.full(found.shape, 0, jnp.int32), 3.0 * found[:, None]
    events = Events(none + found.size, found, told, at, v[:1] + 0 * at, -v[:1] + 0 * at, None, 0 * found)
    return Solution(
        t,
        q,
        v,
        0 * v,
        None,
        jnp.array(0.5),
        Info(),
        Failure(none, jnp.array(False), none, event=none, guard=none),
        events=events,
    )


def test_the_end_at_a_terminal_event_is_extrapolated_with_its_time():
    """At 1.2, of which the runs miss .1 and .025."""

    def run(k):
        end = 1.2 + 0.1 / k**2
        return with_events(jnp.minimum(jnp.array([0.0, 0.5, 1.0, 1.5]), end), jnp.ones((4, 1)), jnp.array([end]))

    found = extrapolated(run, 2, 2, lambda info, _: info)
    for t, q in ((found.t[-1:], found.q[-1]), (found.events.t, found.events.q[0])):
        np.testing.assert_allclose(np.concatenate([t, q]), [1.2, 3.6], rtol=1e-15)


def test_a_velocity_is_not_made_of_those_before_and_behind_an_impact():
    """Which the long steps meet behind the saved time 1, and the short ones before it."""

    def run(k):
        hit = jnp.array([0.98 + 0.05 / k**2])
        t = jnp.array([0.0, 0.5, 1.0, 1.5])
        return with_events(t, jnp.where(t < hit, 1.0, -1.0)[:, None], hit)

    found = extrapolated(run, 2, 2, lambda info, _: info)
    np.testing.assert_array_equal(found.v[:, 0], [1, 1, -1, -1])
    np.testing.assert_allclose(found.events.t, 0.98, rtol=1e-15)
