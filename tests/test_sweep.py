"""Sweeps: the runs of `simulate`, in one compiled call, whatever the step sizes; a member that fails is alone."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zoo
from jax import lax

import hhtjax
from hhtjax.numerics.differentiable_while import repeat
from hhtjax.runs.sweep import run_sweep
from hhtjax.scenes import pendulum

DTS = np.array([0.1, 0.013, 0.0017, 0.02, 0.05])
STEPPER = hhtjax.hht(alpha=-0.05, linearize="predictor")
ONE, ZERO = np.ones(1), np.zeros(1)


def force(q, v, t, params):
    """A softening spring, without a bottom beyond q = 2 for params["k"] < 0, and a damper."""
    return -params["k"] * jnp.sin(q) - params["c"] * v


SPRING = hhtjax.System(ONE, force)
PARAMS = {"k": 4.0, "c": 0.1}
sweep = partial(hhtjax.sweep, SPRING, STEPPER, ONE, ZERO, dts=DTS, duration=1.0, num_samples=4)


@pytest.mark.slow
def test_each_member_is_its_own_run_sampled_at_common_times():
    runs = sweep(PARAMS, t0=2.0)
    runs.check()
    np.testing.assert_allclose(runs.dt, 0.25 / np.ceil(0.25 / DTS), rtol=1e-14)
    assert np.all(runs.dt <= DTS * (1 + 1e-12))
    np.testing.assert_array_equal(runs.t, np.tile(2 + 0.25 * np.arange(5), (5, 1)))
    for i, dt in enumerate(runs.dt):
        n = round(1 / float(dt))
        alone = hhtjax.simulate(
            SPRING, STEPPER, ONE, ZERO, PARAMS, dt=float(dt), num_steps=n, save_every=n // 4, t0=2.0
        )
        for name in ("q", "v", "acceleration"):
            np.testing.assert_allclose(getattr(runs, name)[i], getattr(alone, name), atol=1e-13)


@pytest.mark.slow
def test_members_of_one_block_rest_when_they_are_done():
    """70 members run 4 at a time, 5 one by one."""
    many = sweep(PARAMS, dts=np.logspace(-2, -1, 70))
    few = sweep(PARAMS, dts=np.asarray(many.dt)[::14])
    np.testing.assert_allclose(many.q[::14], few.q, rtol=1e-12)
    np.testing.assert_array_equal(many.dt[::14], few.dt)


def test_new_values_are_not_compiled_anew():
    sweep(PARAMS)
    compiled = run_sweep.number()
    sweep({"k": 9.0, "c": 0.3}, dts=DTS[::-1] / 7, duration=2.0, t0=1.0)
    assert run_sweep.number() == compiled


@pytest.mark.slow
def test_the_work_is_about_the_sum_over_the_members():
    system, counted = zoo.counting_oscillator()
    dts = np.logspace(-3, -1, 31)
    runs = hhtjax.sweep(system, hhtjax.rk4(), ONE, ZERO, dts=dts, duration=1.0, num_samples=2)
    jax.effects_barrier()
    iterations, steps = len(counted) / 4, np.sum(1 / np.asarray(runs.dt))
    assert steps <= iterations < 1.05 * steps


@pytest.mark.slow
@pytest.mark.compiled
def test_derivatives_forward_and_reverse_are_those_of_the_runs():
    def loss(params, t0):
        return jnp.sum(sweep(params, t0=t0, dts=DTS[:3]).q[:, 1:] ** 2)

    at = jax.tree.map(jnp.asarray, PARAMS), 0.0
    reverse, forward = jax.jit(lambda *x: (jax.grad(loss)(*x), jax.jacfwd(loss)(*x)))(*at)
    h = 1e-5
    for key in PARAMS:
        np.testing.assert_allclose(reverse[key], forward[key], rtol=1e-10)
        up, down = (loss(at[0] | {key: at[0][key] + d}, 0.0) for d in (h, -h))
        np.testing.assert_allclose(reverse[key], (up - down) / (2 * h), rtol=1e-7)


def test_branches_of_members_have_derivatives():
    """One member takes x k in the first step, the other x + k; a branch that is not taken is kept from derivatives."""

    def end(k, x):
        def step(i, x):
            return lax.cond(x > 0.3, lambda x: x * k, lambda x: x + k, x)

        return repeat(step, x, jnp.array(3))

    def both(k):
        return jax.vmap(end, (None, 0))(k, jnp.array([0.1, 0.5]))

    expected = np.array([1.1 + 2 * 0.3, 3 * 0.3])  # of (.1 + k) k + k and (.5 k + k) k
    np.testing.assert_allclose(jax.jacfwd(both)(0.3), expected, rtol=1e-14)
    np.testing.assert_allclose(jax.jacrev(both)(0.3), expected, rtol=1e-14)


@pytest.mark.slow
def test_a_sweep_with_a_branch_in_its_force():
    def force(q, v, t, k):
        return lax.cond(q[0] > 0.3, lambda q: -k * (q - 0.3) - q, lambda q: -q, q)

    def end(k):
        dts = np.array([0.1, 0.05])
        system = hhtjax.System(ONE, force)
        return jnp.sum(hhtjax.sweep(system, STEPPER, ONE, ZERO, k, dts=dts, duration=1.5, num_samples=1).q)

    found = jax.grad(end)(2.0)
    assert abs(found - jax.jacfwd(end)(2.0)) < 1e-13
    assert abs(found - (end(2.0 + 1e-6) - end(2.0 - 1e-6)) / 2e-6) < 1e-8


@pytest.mark.slow
def test_a_member_that_blows_up_is_flagged_and_leaves_the_others_alone():
    system = hhtjax.System(ONE, lambda q, v, t, k: k * q**3)
    runs = partial(
        hhtjax.sweep, system, hhtjax.rk4(), ONE, ZERO, dts=np.full(70, 0.05), duration=4.0, num_samples=2,
        in_axes=(None, None, None, 0),
    )  # fmt: skip
    others = np.arange(70) != 3
    fine, bad = runs(-np.ones(70)), runs(np.where(others, -1.0, 9.0))
    alone = hhtjax.simulate(system, hhtjax.rk4(), ONE, ZERO, 9.0, dt=0.05, num_steps=80)
    first = int(np.argmin(np.isfinite(alone.acceleration[:, 0]) & np.isfinite(alone.q[:, 0])))
    np.testing.assert_array_equal(bad.failure.step, np.where(others, 0, first))
    with pytest.raises(hhtjax.SimulationError, match=rf"member 3 \(1 of 70 failed\), step {first} "):
        bad.check()
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[others], y[others]), bad, fine)


@pytest.mark.slow
def test_coefficients_starts_and_parameters_are_data():
    alphas, starts, k = np.array([-0.3, 0.0, -0.1]), np.array([[1.0], [0.5], [0.2]]), np.array([4.0, 1.0, 9.0])
    steppers = jax.vmap(lambda alpha: hhtjax.hht(alpha, linearize="predictor"))(alphas)
    axes = (0, 0, None, {"k": 0, "c": None})
    runs = hhtjax.sweep(
        SPRING, steppers, starts, ZERO, {"k": k, "c": 0.1}, dts=[0.1, 0.1, 0.05], duration=1.0, num_samples=1,
        in_axes=axes,
    )  # fmt: skip
    for i in range(3):
        alone = hhtjax.simulate(
            SPRING, hhtjax.hht(alphas[i], linearize="predictor"), starts[i], ZERO, {"k": k[i], "c": 0.1},
            dt=float(runs.dt[i]), num_steps=round(1 / float(runs.dt[i])),
        )  # fmt: skip
        np.testing.assert_allclose(runs.q[i, -1], alone.q[-1], rtol=1e-13)


def test_under_jit_and_vmap_and_what_a_traced_step_size_may_be():
    both = jax.jit(jax.vmap(lambda k, dts: sweep({"k": k, "c": 0.1}, dts=dts), (0, None)))
    dts = np.concatenate([DTS[:3], [0.3, -1.0]])  # the last two fit no sample
    runs = both(np.array([4.0, 5.0]), dts)
    assert runs.q.shape == (2, 5, 5, 1)
    np.testing.assert_array_equal(runs.failure.step > 0, [[False] * 3 + [True] * 2] * 2)
    np.testing.assert_array_equal(runs.failed, runs.failure.step > 0)
    np.testing.assert_allclose(runs.q[1, :3], sweep({"k": 5.0, "c": 0.1}, dts=DTS).q[:3], rtol=1e-12)
    told = r"simulate: member 0, 3 \(4 of 10 failed\), `dt` must be positive and finite, and in a sweep at most the dis"
    with pytest.raises(hhtjax.SimulationError, match=told):
        runs.check()


@pytest.mark.parametrize("dts", [DTS, jnp.asarray(DTS), DTS.tolist()], ids=["NumPy", "JAX", "list"])
def test_step_sizes_known_inside_a_jit(dts):
    """An array of JAX around a jitted function is known, and what is done to it in there would be traced."""
    shape = jax.eval_shape(jax.jit(lambda params: sweep(params, dts=dts).q), PARAMS)
    assert shape.shape == (5, 5, 1)


@pytest.mark.slow
def test_constrained_members_and_those_that_violate_their_constraint():
    scene = pendulum.cartesian()
    starts = np.asarray(scene.q0) * np.array([[1.0], [1.0], [-1.0]])
    runs = partial(
        hhtjax.sweep, scene.system, hhtjax.hht(), v0=np.zeros((3, 2)), params=scene.params, dts=[0.1, 0.05, 0.1],
        duration=0.2, num_samples=1, in_axes=(None, 0, 0, None),
    )  # fmt: skip
    found = runs(starts)
    found.check()
    assert found.multipliers.shape == (3, 2, 1)
    starts[1] *= 1.1
    with pytest.raises(ValueError, match="sweep: member 1: `q0` violates the constraint"):
        runs(starts)


WRONG = {
    "more than a sample apart": ({"dts": [0.1, 0.3]}, "must be positive, and at most 0.25, .* received dts.1. = 0.3"),
    "negative": ({"dts": [0.1, -0.1]}, "must be positive"),
    "not a number": ({"dts": [0.1, np.nan]}, "must be positive"),
    "a scalar": ({"dts": 0.1}, "must have shape"),
    "none": ({"dts": []}, "must have shape"),
    "text": ({"dts": ["a"]}, "must be real numbers"),
    "too many steps": ({"dts": [1e-10]}, "fewer than 2.31 steps"),
    "samples as times": ({"num_samples": [0.1, 0.1]}, "`num_samples` must be a positive integer"),
    "no time": ({"duration": 0.0}, "`duration` must be positive"),
    "axes of another form": ({"in_axes": (0, 0)}, "`in_axes` must be a tuple of four"),
    "axes of another structure": (
        {"in_axes": (None, None, None, {"m": 0})},
        r"`in_axes` for params must be a prefix of its structure, PyTreeDef\(.*\); received PyTreeDef\({'m': \*}\).",
    ),
    "no axes": ({"params": PARAMS | {"k": np.ones(5)}}, r"`in_axes` must say .* as params\['k'\] may"),
    "a list": (
        {"params": PARAMS | {"k": [1.0] * 5}, "in_axes": (None, None, None, {"c": None, "k": 0})},
        r"`params\['k'\]\[0\]` must have",
    ),
    "another axis": ({"in_axes": (None, 1, None, None)}, "must hold 0 and None"),
    "too few members": ({"in_axes": (None, 0, 0, None)}, "`q0` must have a leading axis of 5 members"),
    "mixed dtypes": ({"v0": np.zeros(1, np.float32)}, "must share one dtype"),
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_input_is_named(name):
    changed, message = WRONG[name]
    arguments = {"q0": ONE, "v0": ZERO, "params": PARAMS, "dts": DTS, "duration": 1.0, "num_samples": 4} | changed
    with pytest.raises((ValueError, TypeError), match=f"sweep: .*{message}|{message}"):
        hhtjax.sweep(SPRING, STEPPER, **arguments)


@pytest.mark.slow
def test_progress_is_shown(capfd):
    sweep(PARAMS, progress=True)
    jax.effects_barrier()
    assert "block 5 of 5" in capfd.readouterr().err
