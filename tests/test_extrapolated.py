"""The extrapolated mid-point rule: orders, constraints, rotations, internal states, tolerances, derivatives, flags."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient
from internal_problems import arm, filtered_top, reference, rod
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

import hhtjax
from hhtjax.scenes import double_pendulum, pendulum, squeezer, top

STEPPER = hhtjax.extrapolated(levels=3)
HELD = pendulum.cartesian()


@cache
def angle(duration):
    """Of the pendulum from its lowest point, by SciPy, in one coordinate and without constraints."""
    p = HELD.params
    start = [0.0, float(HELD.v0[0]) / p["l"]]
    rate = lambda t, y: [y[1], -p["g"] / p["l"] * np.sin(y[0])]  # noqa: E731
    return solve_ivp(rate, (0, duration), start, "DOP853", rtol=1e-13, atol=1e-14).y[0, -1]


def place(duration):
    """x and y."""
    at = angle(duration)
    return HELD.params["l"] * np.array([np.sin(at), -np.cos(at)])


TURN = 0.1  # s, of the top: two turns about its rod


@cache
def turned():
    """The rotation of the top after so long, by SciPy."""
    scene = top.minimal()
    flat = hhtjax.interop.flat_ode(scene.system, scene.q0, scene.v0)
    rate = jax.jit(lambda t, y: flat.rate(t, y, scene.params))
    return solve_ivp(rate, (0, TURN), flat.y0, "DOP853", rtol=1e-13, atol=1e-14).y[:9, -1].reshape(3, 3)


def two_ends(scene, stepper, duration, steps, **options):
    """(q, v, z, multipliers) at the end after so many equal steps, and after twice as many, and the `Info` of the
    second. One program: the run with long steps goes on."""
    more = {"num_steps": 2 * steps, "save_every": steps} | options
    start = scene.system, stepper, scene.q0, scene.v0, scene.params
    runs = [hhtjax.simulate(*start, dt=duration / (k * steps), **more) for k in (1, 2)]
    ends = [jax.tree.map(lambda x, k=k: x[k], (run.q, run.v, run.z, run.multipliers)) for k, run in enumerate(runs, 1)]
    return ends, runs[1].info


def order(errors):
    """From errors of which each has half the steps of the next."""
    return np.log2(errors[0] / errors[1])


@pytest.mark.parametrize("levels", [2, 3, 4])
def test_order_with_a_constraint(levels):
    """And the ends of steps are on it to rounding, its rate included."""
    stepper = hhtjax.extrapolated(levels)
    ends, info = two_ends(HELD, stepper, 1.0, 16)
    assert order([np.abs(q - place(1.0)).max() for q, *_ in ends]) == pytest.approx(stepper.order, abs=0.15)
    assert info.constraint.max() < 1e-14
    assert info.constraint_rate.max() < 1e-14
    assert (info.dependent_row == -1).all()


@pytest.mark.parametrize("levels", [2, 3, 4])
def test_order_without_constraints(levels):
    """In one angle. On the forced Duffing oscillator of zoo.py the leading error is so small that the next is seen: of
    levels=2 h^3.9 to h^3.3 between 10 and 640 steps, of levels=3 h^5.4 to h^5.2, and then rounding."""
    scene, stepper = pendulum.minimal(), hhtjax.extrapolated(levels)
    errors = [abs(q[0] - angle(1.0)) for q, *_ in two_ends(scene, stepper, 1.0, 16)[0]]
    assert order(errors) == pytest.approx(stepper.order, abs=0.15)


@pytest.mark.parametrize("levels", [2, 3, 4])
@pytest.mark.parametrize("scene", [top.minimal(), top.constrained()], ids=["free", "held"])
def test_order_of_rotations(scene, levels):
    stepper = hhtjax.extrapolated(levels)
    steps = 16 if levels == 4 and scene.system.constraint is not None else 32  # before rounding
    ends, _ = two_ends(scene, stepper, TURN, steps)
    R = [q["R"] if isinstance(q, dict) else q for q, *_ in ends]
    assert order([np.abs(x - turned()).max() for x in R]) == pytest.approx(stepper.order, abs=0.15)
    assert np.abs(R[1].T @ R[1] - np.eye(3)).max() < 1e-14


@pytest.mark.parametrize("case", [arm(0.1), rod(0.1), filtered_top(0.1)], ids=["free", "held", "rotation"])
def test_internal_states(case):
    """The order of q, v and z together, and multipliers of the same."""
    exact, errors = reference(case), []
    for end in two_ends(case, STEPPER, case.duration, 32, z0=case.z0)[0]:
        found = [ravel_pytree(x)[0] for x in end]
        errors.append(np.array([np.abs(x - y).max() for x, y in zip(found, exact, strict=True) if y is not None]))
    assert errors[1].max() < 1e-5
    assert order([np.linalg.norm(x) for x in errors]) == pytest.approx(5, abs=0.5)


def test_multipliers_are_those_of_the_motion():
    run = hhtjax.simulate(HELD.system, STEPPER, HELD.q0, HELD.v0, HELD.params, dt=1 / 64, num_steps=64)
    p, q, v = HELD.params, run.q, run.v
    tension = p["m"] * (jnp.sum(v**2, axis=1) - p["g"] * q[:, 1]) / p["l"]  # m v^2/l - m g y/l
    np.testing.assert_allclose(-p["l"] * run.multipliers[:, 0], tension, rtol=1e-13)


def controlled(params, tolerance=1e-8, scene=HELD, times=(0.3, 0.77, 1.0), **options):
    dt = hhtjax.adaptive(tolerance, tolerance)
    return hhtjax.simulate(
        scene.system, hhtjax.extrapolated(), scene.q0, scene.v0, params, dt=dt, times=np.array(times), **options
    )


@pytest.mark.parametrize("tolerance", [1e-5, 1e-8])
def test_error_control_keeps_the_tolerance_at_each_of_the_times(tolerance):
    run = controlled(HELD.params, tolerance)
    run.check()
    found = np.array([place(t) for t in (0.3, 0.77, 1.0)])
    assert np.abs(run.q[1:] - found).max() < 5 * tolerance
    ends = np.cumsum(run.steps.dt[: int(run.steps.accepted)])
    assert all(np.abs(ends - t).min() < 1e-12 for t in (0.3, 0.77, 1.0))


def test_steps_are_few():
    """Nine digits of the stiff double pendulum; `rowda` takes thousands."""
    scene = double_pendulum.stiff()
    run = controlled(scene.params, 1e-9, scene, (1.0,))
    assert int(run.steps.accepted) < 300
    assert int(run.steps.rejected) <= 3


@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-8])
def test_a_squeezer_keeps_the_tolerance(tolerance):
    """At ten times; angles to 16 rad, whose rates are to 1200 rad/s; after 0.03 s by the test set for IVP solvers."""
    run = squeezed(tolerance)
    run.check()
    error = np.abs(run.q[1:] - squeezed(1e-12).q[1:])
    size = np.abs(run.q).max(axis=0)
    assert np.all(error < 1.5 * tolerance * (1 + size))
    assert run.info.constraint.max() < 1e-15
    assert run.info.constraint_rate.max() < 1e-13


def test_a_squeezer_ends_where_the_test_set_says():
    end = [15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948, 0.5244099658805304,
           0.5347301163226948, 1.048080741042263]  # fmt: skip
    np.testing.assert_allclose(squeezed(1e-12).q[-1], end, rtol=1e-9)


@cache
def squeeze():
    scene = squeezer.squeezer()
    start = scene.system, STEPPER, scene.q0, scene.v0, scene.params

    def run(tolerance):
        dt = hhtjax.adaptive(tolerance, tolerance, atol_v=1e3 * tolerance)
        return hhtjax.simulate(*start, dt=dt, times=np.linspace(0.003, 0.03, 10))

    return jax.jit(run)


@cache
def squeezed(tolerance):
    """The run of the squeezer."""
    return squeeze()(tolerance)


def swing(params, **options):
    """The pendulum from its lowest point, with the speed and the length of params."""
    q0, v0 = params["l"] * jnp.array([0.0, -1.0]), params["speed"] * jnp.array([1.0, 0.0])
    of_system = {name: params[name] for name in HELD.params}
    return hhtjax.simulate(HELD.system, STEPPER, q0, v0, of_system, **options)


def test_derivatives():
    """Forward, reverse and central differences over steps of given sizes; and the same under error control, over the
    steps that were accepted."""
    params = {name: jnp.asarray(x) for name, x in HELD.params.items()} | {"speed": jnp.asarray(2.5)}
    controlled = {"dt": hhtjax.adaptive(1e-5, 1e-5, max_steps=100), "times": np.array([0.3, 0.4])}
    run = swing(params, **controlled)
    dt = np.asarray(run.steps.dt)[: int(run.steps.accepted)]

    def loss(params, **options):
        run = swing(params, **options)
        q, v, w, L = (x[-1] for x in (run.q, run.v, run.acceleration, run.multipliers))
        return q @ q[::-1] + v[0] + 0.1 * w[1] + 0.1 * L[0]

    frozen = check_gradient(partial(loss, dt=dt), params)
    found = jax.jit(jax.grad(partial(loss, **controlled)))(params)
    np.testing.assert_allclose(ravel_pytree(found)[0], frozen, rtol=1e-9)


def test_derivatives_of_a_rotation_at_rest():
    """Where the displacement in a step is zero, or nearly."""
    scene = top.minimal()

    def last(spin):
        more = {"dt": 0.01, "num_steps": 1}
        start = scene.q0, spin * scene.v0, scene.params
        return hhtjax.simulate(scene.system, hhtjax.extrapolated(levels=2), *start, **more).q[-1, 2, 0]

    @jax.jit
    def ways(spin):
        return *jax.jvp(last, (spin,), (1.0,)), jax.grad(last)(spin)

    (_, forward, reverse), more, less = ([float(x) for x in ways(spin)] for spin in (0.0, 1e-4, -1e-4))
    assert forward == pytest.approx(reverse, rel=1e-10)
    assert forward == pytest.approx((more[0] - less[0]) / 2e-4, rel=1e-6)


@pytest.mark.filterwarnings("ignore::hhtjax.PrecisionWarning")
def test_single_precision():
    """At constant steps and under error control: its dtype, and an error of some roundings."""
    single = [np.asarray(x, np.float32) for x in (HELD.q0, HELD.v0)]
    for how in ({"dt": 1 / 32, "num_steps": 32}, {"dt": hhtjax.adaptive(1e-4, 1e-4), "times": [0.5, 1.0]}):
        run = hhtjax.simulate(HELD.system, STEPPER, *single, HELD.params, **how)
        run.check()
        assert {x.dtype for x in (run.q, run.v, run.acceleration, run.multipliers, run.t)} == {np.dtype(np.float32)}
        assert np.abs(np.asarray(run.q[-1], float) - place(1.0)).max() < 1e-5
        assert run.info.constraint_rate.max() < 1e-6


def test_batch_is_what_its_members_are():
    masses = jnp.array([0.8, 1.3])
    one = partial(controlled, tolerance=1e-6)
    weights = {"m": HELD.params["m"], "l": HELD.params["l"]}
    both = jax.vmap(lambda g: one(HELD.params | weights | {"g": 9.81 * g}).q)(masses)
    single = one(HELD.params | weights | {"g": 9.81 * 1.3}).q
    np.testing.assert_allclose(both[1], single, atol=1e-9)


def test_sweep_lands_too():
    dts, times = hhtjax.adaptive(np.array([1e-6, 1e-8]), 1e-8), np.array([0.3, 1.0])
    start = HELD.system, hhtjax.extrapolated(), HELD.q0, HELD.v0, HELD.params
    runs = hhtjax.sweep(*start, dts=dts, times=times)
    assert np.abs(runs.q[1, 1:] - np.array([place(t) for t in times])).max() < 5e-8


def test_levels_are_checked():
    with pytest.raises(ValueError, match="levels"):
        hhtjax.extrapolated(levels=1)


@pytest.mark.parametrize("how", [{"dt": 1e-3, "num_steps": 4}, {"dt": hhtjax.adaptive(1e-4, 1e-4), "times": [0.1]}])
def test_events_are_refused(how):
    scene = double_pendulum.stopped()
    with pytest.raises(NotImplementedError, match="Extrapolated does not support events; use hht"):
        hhtjax.simulate(scene.system, STEPPER, scene.q0, scene.v0, scene.params, events=scene.events, **how)
