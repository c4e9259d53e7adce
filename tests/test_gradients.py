"""Forward mode = reverse mode = central differences, for every stepper and every kind of argument."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient, path_loss, tight
from zoo import EVERY, PROBLEMS, STEPPERS, each

import hhtjax

DAMPING = {
    "hht": lambda x, **options: hhtjax.hht(alpha=x, **options),
    "bossak": lambda x, **options: hhtjax.bossak(alpha=x, **options),
    "generalized_alpha": lambda x, **options: hhtjax.generalized_alpha(rho_inf=x, **options),
    "kim_hht": lambda x, **_: hhtjax.kim_hht(alpha=x),
}


ALIKE = "newmark", "bossak", "generalized_alpha", "dopri5"  # others with other coefficients


@pytest.mark.slow
@pytest.mark.parametrize("name", each(STEPPERS, rest=ALIKE))
def test_gradients_on_the_duffing_oscillator(name):
    """In one plain loop: more steps would be checkpointed, as they are on the double pendulum."""
    problem = PROBLEMS["forced Duffing"]
    arguments = problem.params, problem.q0, problem.v0, 0.02, 0.1
    check_gradient(path_loss(problem, tight(STEPPERS[name]), 30, 1), arguments)


@pytest.mark.slow
def test_gradients_of_the_default_where_it_chooses_the_held_state():
    """Steps so long that both points are chosen; of params that hold integers, too."""

    def force(q, v, t, params):
        stiffness = params["k"] * jnp.where(params["mode"] == 1, 1.0, 2.0)
        return -stiffness * (q**3 + q - q[::-1]) * jnp.array([0.5, 1.0])[params["place"]]

    system = hhtjax.System(jnp.ones(2), force)

    def path(k, **options):
        params = {"k": k, "mode": jnp.array(1), "place": jnp.array(1)}
        start = jnp.array([1.0, -0.7]), jnp.array([0.3, 2.0]), params
        return hhtjax.simulate(system, hhtjax.hht(-0.05, **options), *start, dt=0.35, num_steps=12).q

    chosen = path(4.0)
    assert min(np.max(np.abs(chosen - path(4.0, linearize=x))) for x in ("predictor", "held")) > 0.1
    with hhtjax.plain():
        np.testing.assert_allclose(path(4.0), chosen, rtol=1e-12)
    check_gradient(lambda k: jnp.sum(path(k) ** 2), 4.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", each(["hht auto", "hht state", "hht converged", "kim_hht"], rest=["kim_hht"]))
def test_gradients_on_the_forced_double_pendulum(name):
    problem = PROBLEMS["forced double pendulum"]
    arguments = problem.params, problem.q0, problem.v0, 0.02, 0.1
    check_gradient(path_loss(problem, tight(STEPPERS[name]), 40, 40), arguments)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value", "iterations"),
    [("hht", -0.1, None), ("bossak", -0.1, 1), ("generalized_alpha", 0.7, 1)]
    + [pytest.param(*x, marks=EVERY)
       for x in (("hht", -0.1, 1), ("bossak", -0.1, None), ("generalized_alpha", 0.7, None))],
)  # fmt: skip
def test_gradient_with_respect_to_the_numerical_damping(name, value, iterations):
    problem = PROBLEMS["forced Duffing"]

    def loss(x):
        stepper = DAMPING[name](x, linearize="predictor", iterations=iterations, tolerance=1e-13)
        path = hhtjax.simulate(problem.system, stepper, problem.q0, problem.v0, problem.params, dt=0.05, num_steps=30)
        return jnp.sum(path.q**2)

    check_gradient(loss, jnp.asarray(value))


def test_gradient_with_respect_to_kims_alpha():
    problem = PROBLEMS["forced Duffing"]

    def loss(alpha):
        stepper = hhtjax.kim_hht(alpha)
        path = hhtjax.simulate(problem.system, stepper, problem.q0, problem.v0, problem.params, dt=0.05, num_steps=30)
        return jnp.sum(path.q**2)

    check_gradient(loss, jnp.asarray(-0.1))


@pytest.mark.slow
def test_nested_checkpointing_changes_no_gradient():
    """Against the same steps under one plain scan, which counts the first num_steps."""
    problem = PROBLEMS["forced Duffing"]
    stepper = hhtjax.hht(linearize="predictor")

    @partial(jax.jit, static_argnums=1)
    def nested(k, num_steps):
        def loss(k):
            params = {**problem.params, "k": k}
            run = partial(hhtjax.simulate, problem.system, stepper, problem.q0, problem.v0, params)
            return jnp.sum(run(dt=0.01, num_steps=num_steps).q ** 2)

        # forward mode knows no checkpoints: one length is enough, with two blocks and a rest
        return jax.grad(loss)(k), jax.jvp(loss, (k,), (1.0,))[1] if num_steps == 37 else None

    @jax.jit
    def plain(k, num_steps):
        def loss(k):
            params = {**problem.params, "k": k}
            state = stepper.init(problem.system, problem.q0, problem.v0, params, 0.01)

            def step(state, _):
                state, _ = stepper.step(problem.system, state, params, 0.01)
                return state, state.q

            _, q = jax.lax.scan(step, state, None, 480)
            counted = jnp.arange(480)[:, None] < num_steps
            return jnp.sum(problem.q0**2) + jnp.sum(jnp.where(counted, q**2, 0.0))

        return jax.jvp(loss, (k,), (1.0,))[1]

    for num_steps in (32, 37, 480):
        exact = plain(1.0, num_steps)
        for found in jax.tree.leaves(nested(1.0, num_steps)):
            np.testing.assert_allclose(found, exact, rtol=1e-11)


@pytest.mark.slow
def test_second_derivative_through_the_converged_step():
    problem = PROBLEMS["forced Duffing"]
    stepper = hhtjax.hht(alpha=-0.1, iterations=None, tolerance=1e-13)

    def loss(k):
        params = {**problem.params, "k": k}
        path = hhtjax.simulate(problem.system, stepper, problem.q0, problem.v0, params, dt=0.05, num_steps=20)
        return jnp.sum(path.q**2)

    gradient_and_second = jax.jit(lambda k: jax.jvp(jax.grad(loss), (k,), (1.0,)))  # one program for both
    (after, _), (before, _) = (gradient_and_second(1.0 + step) for step in (1e-4, -1e-4))
    assert float(gradient_and_second(1.0)[1]) == pytest.approx(float(after - before) / 2e-4, rel=1e-6)


@pytest.mark.slow
def test_memory_of_reverse_mode_grows_with_the_square_root():
    """By XLA's own count; the saved path itself is left out by keeping the end only."""
    problem = PROBLEMS["forced Duffing"]

    def temporaries(num_steps):
        def loss(k):
            params = {**problem.params, "k": k}
            run = partial(hhtjax.simulate, problem.system, hhtjax.hht(linearize="predictor"))
            end = run(problem.q0, problem.v0, params, dt=1e-4, num_steps=num_steps, save_every=num_steps)
            return jnp.sum(end.q[-1] ** 2)

        compiled = jax.jit(jax.grad(loss)).lower(1.0).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    small, large = temporaries(1000), temporaries(100_000)
    assert large < 10 * 2 * small
    assert large < 1e6
    assert small > 1000
