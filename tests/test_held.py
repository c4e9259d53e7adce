"""Held inputs: steps that end on the jumps keep the order of the method."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from zoo import as_data

import hhtjax
from hhtjax.scenes import pendulum
from hhtjax.steppers.stepper import behind_jump
from hhtjax.systems.flat_system import flatten

LIGHT = hhtjax.hht(-0.3, linearize="predictor")  # half the program of "auto"
VALUES = 3 * np.random.default_rng(0).normal(size=6)
STEPPERS = {
    "alpha = 0": hhtjax.hht(0.0),
    "alpha = -.05": hhtjax.hht(-0.05),
    "alpha = -.3": hhtjax.hht(-0.3),
    "converged": hhtjax.hht(-0.3, iterations=None),
    "newmark": hhtjax.newmark(),
    "generalized_alpha": hhtjax.generalized_alpha(0.5),
    "wilson": hhtjax.wilson(),
    "conventional_hht": hhtjax.conventional_hht(),
    "rowda": hhtjax.rowda(),
    "rk4": hhtjax.rk4(),
}


def mass(q, params):
    c = jnp.cos(q[0] - q[1])
    return jnp.stack([jnp.stack([2.0 + 0 * c, c]), jnp.stack([c, 1.0 + 0 * c])])


def force(q, v, t, params):
    return jnp.stack([params["u"](t) - 9 * jnp.sin(q[0]) - 0.3 * v[0], -20 * q[1] - q[1] ** 3])


SYSTEM = hhtjax.System(mass, force)


def pushed(scene):
    """A pendulum pushed by a force, u(t) in both directions."""

    def force(q, v, t, params):
        return scene.system.force(q, v, t, scene.params) + params["u"](t)

    return hhtjax.System(
        lambda q, p: scene.system.mass(q, scene.params),
        force,
        lambda q, t, p: scene.system.constraint(q, t, scene.params),
    )


def path(stepper, steps, values=VALUES):
    """The run over five samples, each of so many steps."""
    params = {"u": hhtjax.sampled(jnp.asarray(values), 0.1, order=0)}
    start = jnp.array([0.4, -0.3]), jnp.array([0.0, 1.0])
    return hhtjax.simulate(SYSTEM, stepper, *start, params, dt=0.1 / steps, num_steps=5 * steps, save_every=steps)


def end(stepper, steps, values=VALUES):
    """Its q and v at the end."""
    run = path(stepper, steps, values)
    return jnp.concatenate([run.q[-1], run.v[-1]])


def order(system, stepper, start, steps, fine):
    """Observed after five samples, each of so many steps, and of twice as many. One program: the run with long steps
    goes on. fine: a stepper, and its number of steps, for what is exact."""
    params = {"u": hhtjax.sampled(jnp.asarray(VALUES), 0.1, order=0)}
    run = partial(hhtjax.simulate, system)
    exact = run(fine[0], *start, params=params, dt=0.1 / fine[1], num_steps=5 * fine[1], save_every=fine[1])
    errors = []
    for k in (1, 2):
        sizes = {"dt": 0.1 / (k * steps), "num_steps": 10 * steps, "save_every": steps}
        found = run(as_data(stepper), *start, params=params, **sizes)
        pairs = [(x, y) for x, y in ((found.q, exact.q), (found.v, exact.v)) if x is not None]
        errors.append(max(np.abs(x[5 * k] - y[-1]).max() for x, y in pairs))
    return np.log2(errors[0] / errors[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPPERS)
def test_order_is_kept(name):
    stepper, start = STEPPERS[name], (jnp.array([0.4, -0.3]), jnp.array([0.0, 1.0]))
    found = order(SYSTEM, stepper, start, 4 if name == "rk4" else 16, (hhtjax.rk4(), 128))
    assert abs(found - stepper.order) < 0.15


@pytest.mark.slow
def test_first_order_systems_too():
    system = hhtjax.FirstOrderSystem(lambda y, t, params: params["u"](t) - y - y**3)
    assert abs(order(system, hhtjax.hht(-0.3), (jnp.array(0.3),), 16, (hhtjax.rk4(), 64)) - 2) < 0.15


@pytest.mark.slow
def test_with_constraints_multipliers_jump_too():
    """The position after each sample, of second order."""
    scene = pendulum.cartesian()
    found = order(pushed(scene), LIGHT, (scene.q0, scene.v0), 8, (LIGHT, 256))
    assert abs(found - 2) < 0.15


def test_a_jump_leads_to_the_start_under_the_new_force():
    scene = pendulum.cartesian()
    system = pushed(scene)
    stepper, params = hhtjax.hht(-0.3), [{"u": lambda t, u=u: jnp.asarray(u)} for u in VALUES[:2]]

    @jax.jit
    def states():
        old, new = (stepper.init(system, scene.q0, scene.v0, p, dt=0.1) for p in params)
        flat, _, _ = flatten("test", system, scene.q0, scene.v0, 0.0, params[0])
        return old, new, behind_jump(stepper, flat, old, *params, 0.1)

    old, new, found = states()
    for name in ("w", "L"):
        np.testing.assert_allclose(getattr(found, name), getattr(new, name), rtol=1e-12)
        assert not np.allclose(getattr(old, name), getattr(new, name), rtol=0.01)


@pytest.mark.slow
def test_step_by_step_a_sweep_and_a_batch_are_the_run():
    stepper, start = LIGHT, (jnp.array([0.4, -0.3]), jnp.array([0.0, 1.0]))
    params = {"u": hhtjax.sampled(jnp.asarray(VALUES), 0.1, order=0)}
    run = path(stepper, 2)
    state = stepper.init(SYSTEM, *start, params, dt=0.05)
    step = jax.jit(lambda state: stepper.step(SYSTEM, state, params, 0.05)[0])
    for _ in range(10):
        state = step(state)
    np.testing.assert_allclose(state.q, run.q[-1], rtol=1e-12)
    runs = hhtjax.sweep(SYSTEM, stepper, *start, params, dts=jnp.array([0.05, 0.1]), times=jnp.array([0.1, 0.3, 0.5]))
    np.testing.assert_allclose(runs.q[0], run.q[np.array([0, 1, 3, 5])], rtol=1e-12)
    batch = jax.jit(jax.vmap(lambda scale: end(stepper, 2, scale * VALUES)))(jnp.array([1.0, 0.5]))
    np.testing.assert_allclose(batch[0], jnp.concatenate([run.q[-1], run.v[-1]]), rtol=1e-12)
    np.testing.assert_allclose(batch[1], end(stepper, 2, 0.5 * VALUES), rtol=1e-12)


@pytest.mark.slow
def test_derivatives_in_the_values():
    def f(values):
        return jnp.sum(end(LIGHT, 2, values))

    gradient = jax.jit(jax.grad(f))(VALUES)
    along = jax.jit(lambda x: jax.jvp(f, (x,), (jnp.ones(6),)))
    _, tangent = along(VALUES)
    np.testing.assert_allclose(gradient.sum(), tangent, rtol=1e-10)
    shift = 1e-5
    difference = (along(VALUES + shift)[0] - along(VALUES - shift)[0]) / (2 * shift)
    np.testing.assert_allclose(tangent, difference, rtol=1e-7)


def test_energy_balance_sees_one_value_in_each_interval():
    """A free mass: the work of a held force is exact, because v is linear in time between the samples."""
    params = {"u": hhtjax.sampled(jnp.asarray(VALUES), 0.1, order=0)}
    system = hhtjax.System(np.ones(1), lambda q, v, t, params: params["u"](t)[None])
    run = hhtjax.simulate(system, hhtjax.hht(), jnp.zeros(1), jnp.ones(1), params, dt=0.1, num_steps=5)
    v = 1 + 0.1 * np.concatenate([[0], np.cumsum(VALUES[:5])])
    np.testing.assert_allclose(run.v[:, 0], v, rtol=1e-12)
    found = hhtjax.analysis.energy_balance(system, run, params)
    np.testing.assert_allclose(found.error, 0, atol=1e-14)


@pytest.mark.slow
def test_jumps_within_steps_are_told():
    """By `simulate` and `sweep`, for steps of one size and of several; not where steps end on them, nor inside jit."""
    system = hhtjax.System(jnp.ones(1), lambda q, v, t, params: params(t)[None])
    u, uneven = (
        hhtjax.sampled(jnp.arange(4.0), order=0, **at)
        for at in ({"dt": 0.1}, {"times": jnp.array([0, 0.1, 0.25, 0.4])})
    )
    run = partial(hhtjax.simulate, system, hhtjax.rk4(), jnp.zeros(1), jnp.zeros(1))
    runs = partial(hhtjax.sweep, system, hhtjax.rk4(), jnp.zeros(1), jnp.zeros(1))
    off = [
        (lambda: run(u, dt=0.04, num_steps=5), "simulate: a held input.* at t = 0.1,"),
        (lambda: run(uneven, dt=0.1, num_steps=5), "simulate: .* at t = 0.25,"),
        (lambda: run(u, dt=jnp.array([0.1, 0.05, 0.1])), "at t = 0.2,"),
        (lambda: run(u, dt=0.04, times=[0.07, 0.15]), "simulate: .* at t = 0.1,"),
        (lambda: runs(u, dts=[0.05, 0.04], duration=0.4, num_samples=2), "sweep: .* at t = 0.1,"),
        (lambda: runs(uneven, dts=[0.1], times=[0.1, 0.3]), "sweep: .* at t = 0.25,"),
    ]
    for call, message in off:
        with pytest.warns(hhtjax.JumpWarning, match=message):
            call()
    run(u, dt=0.1 / 3, num_steps=12)  # warnings are errors here
    run(u, dt=0.04, num_steps=2)  # ends before
    run(u, dt=0.05, times=[0.07, 0.16])
    run(uneven, dt=jnp.array([0.1, 0.15, 0.15, 0.3]))
    runs(uneven, dts=[0.1, jnp.inf], times=[0.1, 0.25, 0.4])
    jax.jit(lambda dt: run(u, dt=dt, num_steps=5).q)(0.04)
