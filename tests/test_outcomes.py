"""What a run says about failed steps, and that all its arguments may be tracers."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import INF, NAN, ONE, ZERO, check_message, run
from zoo import STEPPERS

import hhtjax
from hhtjax import SimulationError, System
from hhtjax.runs.driver import first_failure, no_failure
from hhtjax.steppers.stepper import Info, State


def push(q, v, t, params):
    """A force that drives q to infinity in finite time."""
    return params * q**3


def bounded(q, v, t, params):
    """A force that is not a number beyond q = 1."""
    return jnp.sqrt(1 - q)


BLOW_UP = System(ONE, push)


# ---------------------------------------------------------------------------------------------- check


def first_not_finite(path):
    """Number of the first step after which something is not finite, from a path that holds every step; 0 if none."""
    finite = np.isfinite(np.concatenate([path.q, path.v, path.acceleration], axis=1)).all(axis=1)
    return 0 if finite.all() else int(np.argmin(finite))


def what_failed(path, step):
    """What a message says of that step: the first quantity that is not finite there."""
    names = {"position q": path.q, "velocity v": path.v, "acceleration": path.acceleration}
    return f"the {next(name for name, x in names.items() if not np.isfinite(x[step]).all())} is not finite."


BREAKING = [(push, "rk4")] + [(bounded, name) for name in ("rk4", "hht state", "kim_implicit_euler")]


@pytest.mark.parametrize(("force", "name"), BREAKING)
def test_check_names_the_first_step_that_is_not_finite(force, name):
    arguments = System(ONE, force), STEPPERS[name], 0.2 * ONE, ONE, 4000.0
    path = run(*arguments, num_steps=20)
    step = first_not_finite(path)
    assert 1 < step < 20
    assert step % 5 != 0
    for save_every in (1, 5):
        solution = run(*arguments, t0=3.0, num_steps=20, save_every=save_every)
        message = f"simulate: step {step} (to t = {3 + 0.1 * step:.6g}) failed: {what_failed(path, step)}"
        check_message(SimulationError, message, solution.check)


def test_check_is_silent_when_all_is_well():
    assert run().check() is None
    assert jax.vmap(lambda q0: run(q0=q0))(jnp.ones((3, 1))).check() is None


@pytest.mark.parametrize(("q", "step"), [([1e308, 1e308], 0), ([jnp.inf, -jnp.inf], 3), ([jnp.nan, 0.0], 3)])
def test_numbers_with_a_sum_too_large_are_no_failure(q, step):
    state = State(jnp.zeros(()), jnp.array(q), jnp.zeros(2), jnp.zeros(2), jnp.zeros(2))
    flat, count = SimpleNamespace(positions=2, size=2), jnp.asarray(3, jnp.int32)
    noted = first_failure(flat, no_failure(Info()), count, state, Info())
    assert (noted.step, noted.newton) == (step, False)


def test_check_names_the_bad_member_of_a_batch():
    """Members differ in dt, t0 and stiffness; the times in the message are those of the bad one."""

    def member(k, dt, t0, save_every=1):
        return run(BLOW_UP, params=k, dt=dt, t0=t0, num_steps=20, save_every=save_every)

    k, dt, t0 = jnp.array([1e-3, 1e3, 1e-3]), jnp.array([0.1, 0.04, 0.2]), jnp.array([0.0, 2.0, 0.0])
    steps = [first_not_finite(member(*x)) for x in zip(k, dt, t0, strict=True)]
    assert steps[0] == steps[2] == 0
    assert 1 < steps[1] < 20
    why = what_failed(member(*(x[1] for x in (k, dt, t0))), steps[1])
    message = f"member 1 (1 of 3 failed), step {steps[1]} (to t = {2 + 0.04 * steps[1]:.6g}) failed: {why}"
    for save_every in (1, 5):
        batch = jax.vmap(lambda *x, save_every=save_every: member(*x, save_every))(k, dt, t0)
        check_message(SimulationError, message, batch.check)


def test_check_names_the_first_of_several_bad_members_in_two_axes():
    k = jnp.array([[1e-3, 1e-3, 1e3], [1e3, 1e-3, 1e-3]])
    batch = jax.vmap(jax.vmap(lambda k: run(BLOW_UP, params=k, num_steps=20)))(k)
    step = first_not_finite(run(BLOW_UP, params=1e3, num_steps=20))
    check_message(SimulationError, f"simulate: member 0, 2 (2 of 6 failed), step {step} (to t = ", batch.check)


@pytest.mark.slow
def test_check_names_where_a_run_that_stays_finite_gets_too_far():
    """exp(t) of w = q, from 1: beyond 1 + reach at the saved time after log(1 + reach). Of a batch, the first."""

    def grow(q, v, t, params):
        return jax.tree.map(lambda x: params * x, q)

    start = {"a": ONE, "b": jnp.zeros((2, 2))}

    def member(k, save_every=1):
        return run(System(jnp.ones(5), grow), hhtjax.rk4(), start, start, params=k, num_steps=20, save_every=save_every)

    for save_every, step in ((1, 11), (4, 12)):  # exp(1.1) = 3.004
        solution = member(1.0, save_every)
        solution.check(reach=6.5)  # exp(2) = 7.39
        message = f"simulate: step {step} (to t = {step / 10}) failed: the position q is farther than 2 from its start."
        check_message(SimulationError, message, partial(solution.check, reach=2.0))
    batch = jax.vmap(member)(jnp.array([-1.0, 1.0]))
    check_message(SimulationError, "member 1 (1 of 2 failed), step 11", partial(batch.check, reach=2))
    with pytest.raises(ValueError, match="check: `reach` must be positive; received 0"):
        batch.check(reach=0)


def test_what_comes_first_is_named():
    """A run that is too far before it stops being finite, and one that never is."""
    path = run(BLOW_UP, STEPPERS["rk4"], 0.2 * ONE, ONE, 4000.0, num_steps=20)
    step = first_not_finite(path)
    far = int(np.argmax(np.abs(path.q[:, 0] - 0.2) > 1e3))
    assert 0 < far < step
    check_message(SimulationError, f"step {far} (to t = {far / 10:.6g}) failed: the position", lambda: path.check(1e3))
    check_message(SimulationError, f"step {step} (", lambda: path.check(1e306))
    later = path._replace(q=path.q.at[step + 1 :].set(jnp.inf))  # beyond any reach, but that is not what came first
    check_message(SimulationError, f"step {step} (", lambda: later.check(1e306))


def kick(q, v, t, params):
    """A spring with a blow around t = 0.7 and t = 1.1, too hard for two iterations."""
    struck = (jnp.abs(t - 0.7) < 0.01) | (jnp.abs(t - 1.1) < 0.01)
    return -q + jnp.where(struck, -params * q**3, jnp.zeros_like(q))


KICKED = System(ONE, kick)
TWO_ITERATIONS = hhtjax.hht(iterations=None, max_iterations=2)


def first_unbalanced(path, params):
    """Number of the first step after which M w - Q exceeds Newton's tolerance; from a path that holds every step."""
    Q = jax.jit(jax.vmap(kick, in_axes=(0, 0, 0, None)))(path.q, path.v, path.t, params)
    unbalanced = np.max(np.abs(np.asarray(path.acceleration) - np.asarray(Q)), axis=1) > 1e-9
    return int(np.argmax(unbalanced)), int(unbalanced.sum())


@pytest.mark.slow
def test_check_names_the_first_failed_newton_iteration():
    path = run(KICKED, TWO_ITERATIONS, params=1e3, num_steps=16)
    step, failures = first_unbalanced(path, 1e3)
    assert failures == 2  # both blows; the steps between them and after them succeed
    assert 1 < step < 16
    assert step % 4 != 0
    assert np.isfinite(path.q).all()
    message = f"step {step} (to t = {0.1 * step:.6g}) failed: Newton's iteration did not converge; the state is still"
    check_message(SimulationError, f"simulate: {message}", path.check)
    check_message(SimulationError, message, run(KICKED, TWO_ITERATIONS, params=1e3, num_steps=16, save_every=8).check)

    def member(k):
        return run(KICKED, TWO_ITERATIONS, params=k, num_steps=16, save_every=4)

    batch = jax.vmap(member)(jnp.array([0.0, 0.0, 1e3]))
    check_message(SimulationError, f"simulate: member 2 (1 of 3 failed), {message}", batch.check)


def test_a_failed_newton_iteration_is_named_before_what_follows_it():
    """Newton fails at t = 0.7; later the force is not a number."""

    def force(q, v, t, params):
        return kick(q, v, t, 1e3) + jnp.where(t > 1.15, jnp.nan * q, jnp.zeros_like(q))

    solution = run(System(ONE, force), hhtjax.hht(iterations=None, max_iterations=2), num_steps=16)
    check_message(SimulationError, "step 7 (to t = 0.7) failed: Newton's iteration did not converge", solution.check)


def test_an_acceleration_that_is_not_finite_is_a_failure():
    """q and v are finite at the end, its acceleration is not: the force is defined for q < 1.05 only."""
    system = System(ONE, lambda q, v, t, params: jnp.sqrt(1.05 - q))
    solution = run(system, STEPPERS["hht state"], ZERO, ONE, dt=0.2, num_steps=4)
    assert not np.isfinite(solution.acceleration[-1]).all()
    check_message(SimulationError, "simulate: step 4 (to t = 0.8) failed", solution.check)


@pytest.mark.parametrize("transform", [jax.jit, jax.vmap], ids=["jit", "vmap"])
def test_check_refuses_tracers(transform):
    def inside(q0):
        run(q0=q0).check()
        return q0

    message = "check: the solution is a tracer: call check() outside jit, vmap and grad."
    check_message(TypeError, message, lambda: transform(inside)(jnp.ones((2, 1)) if transform is jax.vmap else ONE))


@pytest.mark.parametrize("name", ["dt", "params"])
def test_check_inside_grad_refuses_or_names_the_step(name):
    """Whether a step failed has no derivative, so grad alone leaves it known."""
    step = first_not_finite(run(BLOW_UP, params=1e3, num_steps=20))

    def inside(x):
        solution = run(BLOW_UP, **{"params": 1e3, "num_steps": 20, name: x})
        solution.check()
        return jnp.sum(solution.q)

    with pytest.raises(
        (TypeError, SimulationError), match=rf"^(check: the solution is a tracer|simulate: step {step} )"
    ):
        jax.grad(inside)({"dt": 0.1, "params": 1e3}[name])


# ---------------------------------------------------------------------------------------------- tracers

TRACED = {"dt": 0.1, "t0": 0.3, "q0": np.array([0.7]), "v0": np.array([-0.4]), "params": 2.5, "alpha": np.float64(-0.1)}


def hard_spring(q, v, t, params):
    """Depends on everything."""
    return -params * jnp.sin(q) - 0.1 * v + jnp.cos(2 * t)


HARD_SPRING = System(ONE, hard_spring)


def outcome(alpha, **arguments):
    """A number that depends on all arguments of a run."""
    solution = run(HARD_SPRING, hhtjax.hht(alpha=alpha, linearize="predictor"), num_steps=8, **arguments)
    return jnp.sum(solution.q**2) + jnp.sum(solution.v) + jnp.sum(solution.t * solution.acceleration[:, 0])


def test_all_arguments_may_be_tracers_of_jit():
    assert np.allclose(jax.jit(lambda x: outcome(**x))(TRACED), outcome(**TRACED), rtol=1e-13, atol=0)


@pytest.mark.slow
def test_all_arguments_may_be_tracers_of_vmap():
    batch = {name: np.stack([value, 0.9 * np.asarray(value)]) for name, value in TRACED.items()}
    f = jax.jit(lambda x: outcome(**x))
    results = jax.jit(jax.vmap(f))(batch)
    for i in range(2):
        assert np.allclose(results[i], f({name: x[i] for name, x in batch.items()}), rtol=1e-13, atol=0)
    assert results[0] != results[1]


@pytest.mark.slow
def test_all_arguments_may_be_tracers_of_grad():
    f = jax.jit(lambda x: outcome(**x))
    gradient = jax.grad(f)(TRACED)
    for name, value in TRACED.items():
        h = 1e-5
        change = f({**TRACED, name: value + h}) - f({**TRACED, name: value - h})
        assert np.allclose(gradient[name], change / (2 * h), rtol=1e-6, atol=1e-7), name


@pytest.mark.parametrize("arguments", [{"dt": -0.1}, {"dt": 0.0}, {"q0": np.array([INF])}, {"t0": NAN}], ids=repr)
def test_values_of_tracers_are_not_checked_but_their_failure_is_seen(arguments):
    ((name, value),) = arguments.items()
    system = System(ONE, lambda q, v, t, params: -q + t)
    solution = jax.jit(lambda x: run(system, **{name: x}))(value)
    if name == "dt":
        check_message(SimulationError, "simulate: `dt` must be positive and finite; it was", solution.check)
        assert solution.t[-1] == 4 * value
    else:
        check_message(SimulationError, "simulate: step 1 (to t = ", solution.check)


def test_shapes_of_tracers_are_checked():
    with pytest.raises(TypeError, match="simulate: `t0` must be a real number; received "):
        jax.jit(lambda x: run(t0=x))(jnp.ones(2))
    with pytest.raises(ValueError, match="simulate: `dt` must be a number, or of shape"):
        jax.jit(lambda x: run(dt=x))(jnp.ones((2, 2)))
    with pytest.raises(TypeError, match="hht: `alpha` must be a real number; received "):
        jax.jit(lambda x: outcome(**{**TRACED, "alpha": x}))(jnp.ones(2))
