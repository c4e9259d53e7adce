"""Dry friction of joints whose directions depend on each other, or on constraints: loops, driven cranks, gears."""

import warnings
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_c import Library, needs_compiler, numbers
from four_bar import CRANK, FREE, LIMITS, PARAMS, angles, motion, ratios, reduced
from friction_problems import free_vibration_exact
from scipy.integrate import solve_ivp
from zoo import EVERY

import hhtjax
from hhtjax.systems.friction_rows import slides_in_box

ONE, TWO, ZERO = jnp.ones(1), jnp.ones(2), jnp.zeros(2)
ALONG = np.array([1.0, 0.8, -0.7, 0.5])  # of forward derivatives


def row(runs, i):
    """One run of a batch, or a slice of them."""
    return jax.tree.map(lambda x: np.asarray(x)[i], runs)


def points(x, step=1e-6):
    """Where differences in each of x take a function: x itself, one and two steps onwards and back."""
    h = np.diag(step * x)
    return np.concatenate([x[None], x + h, x - h, x + 2 * h, x - 2 * h])


def check_three_ways(reverse, values, rates, x, along, step=1e-6):
    """The derivative of reverse mode, by forward mode and by differences of fourth order, of a batch at `points`."""
    assert np.all(np.isfinite(reverse))
    assert abs(rates[0] - reverse @ along) < 1e-10 * np.max(np.abs(reverse * along))
    on, back, on_2, back_2 = values[1:].reshape(4, -1)
    central = (8 * (on - back) - (on_2 - back_2)) / (12 * step * x)
    size = np.maximum(np.abs(reverse), 1e-3 * np.max(np.abs(reverse)))
    assert np.all(np.abs(central - reverse) < 1e-6 * size), (central, reverse)


def all_choices(K, load, f):
    """The least of tau' K tau/2 - load' tau in the box, and the smallest tau there, by trial of all sets of bounds."""
    best, found = np.inf, 0 * f
    for trial in product((0.0, 1.0, -1.0), repeat=len(f)):
        tau, free = np.array(trial) * f, np.array(trial) == 0
        inner = K[np.ix_(free, free)]
        unit = np.sqrt(np.diag(inner))
        pull = (load - K @ tau)[free]
        if free.any():  # of all minima that of least sum of K_ii tau_i^2
            tau[free] = np.linalg.lstsq(inner / unit / unit[:, None], pull / unit, rcond=1e-9)[0] / unit
        if np.any(np.abs(tau) > f * (1 + 1e-12) + 1e-14):
            continue
        cost, size = tau @ K @ tau / 2 - load @ tau, np.diag(K) @ tau**2
        scale = np.abs(load) @ f + 1e-300
        if cost < best - 1e-11 * scale or (cost < best + 1e-11 * scale and size < np.diag(K) @ found**2):
            best, found = min(cost, best), tau
    return best, found


@pytest.mark.slow
@pytest.mark.parametrize(("m", "rank"), [(2, 1), (4, 1), (4, 2), (6, 3)])
def test_the_box_problem_is_that_of_all_choices(m, rank):
    """Forces of semi-definite matrices, limits of 0 among them: the motion, who slides, and the smallest forces."""
    rng, N = np.random.default_rng(m + rank), 25
    B = rng.normal(size=(N, m, rank))
    K, f = B @ B.transpose(0, 2, 1), 10 ** rng.uniform(-1, 1, (N, m)) * (rng.random((N, m)) < 0.8)
    load = np.einsum("nij,nj->ni", B, rng.normal(size=(N, rank)) * 10 ** rng.uniform(-1, 1.5, (N, 1)))
    least = 1e-10 * np.einsum("nii->ni", K)
    given = (*map(jnp.asarray, (K, least)), jnp.ones((N, m), bool), *map(jnp.asarray, (load, f)))
    sig, tau = map(np.asarray, jax.jit(jax.vmap(slides_in_box))(*given))
    for i in range(N):
        _, exact = all_choices(K[i], load[i], f[i])
        rate = load[i] - K[i] @ exact
        size = np.abs(load[i]) + np.abs(K[i]) @ np.abs(exact)
        assert np.all(np.abs(K[i] @ (tau[i] - exact)) < 1e-9 * size)
        moves = np.abs(rate) > 1e-6 * size
        np.testing.assert_array_equal(np.where(moves, np.sign(rate), 0), sig[i] * moves)
        assert np.all(np.abs(rate[~moves]) < 1e-9 * size[~moves])
        d = np.diag(K[i])
        assert d @ tau[i] ** 2 <= d @ exact**2 * (1 + 1e-5) + 1e-14
    assert {-1, 0, 1} == set(np.unique(sig))


def gear(q, t, params):
    """The first turns twice as fast as the second."""
    return q[:1] - 2 * q[1:]


GEAR = hhtjax.System(
    jnp.array([0.5, 2.0]), lambda q, v, t, p: jnp.array([-p["k"], 0.0]) * q, gear, friction=lambda q, v, L, t, p: p["F"]
)
GEARED = {"k": 100.0, "F": jnp.array([1.5, 5.0])}  # 1.5 + 5/2 at the first, which feels a mass of 1


def turned(F=GEARED["F"], dt=2.2 / 400, num_steps=400, dtype=float):
    q0 = jnp.array([0.5, 0.25], dtype)
    params = {"k": jnp.asarray(100.0, dtype), "F": jnp.asarray(F, dtype)}
    return hhtjax.simulate(GEAR, hhtjax.hht(), q0, 0 * q0, params, dt=dt, num_steps=num_steps)


def turned_to(F, dt, index, num_steps):
    """A number of the state at a sample; the run."""
    run = turned(F, dt, num_steps)
    return jnp.sum(run.q[index] * jnp.array([1.0, 0.3])), run


@pytest.fixture(scope="module")
def all_gears():
    """One program: runs of all that follows, their numbers, and derivatives of these. Of each a step and a sample.

    Limits of both sides, of one side, and none; the limits of which three derivatives are compared; and two derivatives
    where one limit is 0.
    """
    near = points(np.asarray(GEARED["F"]))
    limits = np.concatenate([[[1.5, 5.0], [4.0, 0.0], [0.0, 8.0], [0.0, 0.0]], near, [[4.0, 0.0]] * 2])
    rates = np.concatenate([np.zeros((4, 2)), np.tile(ALONG[:2], (len(near), 1)), np.eye(2)])
    counts, samples = (np.repeat(x, [4, len(near), 2]) for x in ([400, 32, 128], [400, 30, 117]))

    @jax.jit
    @jax.vmap
    def run(F, along, dt, index):
        return jax.jvp(lambda F: turned_to(F, dt, index, 400), (F,), (along,), has_aux=True)

    values, slopes, runs = run(limits, rates, 2.2 / counts, samples)
    return runs, np.asarray(values), np.asarray(slopes)


@pytest.fixture(scope="module")
def gears(all_gears):
    return row(all_gears[0], slice(4))


@pytest.mark.slow
def test_both_sides_of_a_gear_rub(gears):
    """The same motion, whichever side has how much of it; and none of it stays where it is 0."""
    gears.check()
    exact, _ = free_vibration_exact(np.asarray(gears.t[0]))
    np.testing.assert_allclose(gears.q[:3, :, 0], np.tile(exact, (3, 1)), atol=1e-3)
    np.testing.assert_allclose(gears.q[..., 0], 2 * gears.q[..., 1], atol=1e-13)
    np.testing.assert_allclose(gears.q[3, :, 0], 0.5 * np.cos(10 * gears.t[3]), atol=2e-2)
    assert gears.sticking[:3, -1].tolist() == [[True, True], [True, False], [False, True]]
    slides = ~np.asarray(gears.sticking[0]).any(axis=1)
    np.testing.assert_allclose(np.abs(gears.friction[0])[slides], np.tile([1.5, 5.0], (slides.sum(), 1)), rtol=1e-12)


@pytest.mark.slow
def test_what_sticks_stays_and_shares_its_load_within_the_limits(gears):
    stuck = np.asarray(gears.sticking[0]).all(axis=1)
    q, tau = np.asarray(gears.q[0])[stuck], np.asarray(gears.friction[0])[stuck]
    assert np.ptp(q[:, 0]) < 1e-15
    assert np.all(np.abs(gears.v[0])[stuck] < 1e-15)
    assert np.all(np.abs(tau) <= [1.5, 5.0])
    np.testing.assert_allclose(tau[1:] @ [1, 0.5], -100 * q[1:, 0], rtol=1e-9)


@pytest.mark.slow
def test_gears_in_single_precision_and_in_batches(gears):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hhtjax.PrecisionWarning)
        rough = turned(dtype=jnp.float32)
    rough.check()
    assert {x.dtype for x in (rough.q, rough.friction)} == {np.dtype("float32")}
    np.testing.assert_allclose(rough.q, gears.q[0], atol=1e-4)
    np.testing.assert_allclose(turned().q, gears.q[0], atol=1e-13)


@pytest.mark.slow
def test_derivatives_in_the_limits_of_a_gear(all_gears):
    """Through reversals; also where a limit is 0: there it would brake as much as the other side does."""
    F, (_, values, rates) = np.asarray(GEARED["F"]), all_gears
    reverse = np.asarray(jax.jit(jax.grad(lambda F: turned_to(F, 2.2 / 32, 30, 32)[0]))(F))
    check_three_ways(reverse, values[4:-2], rates[4:-2], F, ALONG[:2])
    # a joint without a limit switches with the step, so that its derivative is of first order
    np.testing.assert_allclose(rates[-1], rates[-2] / 2, rtol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("m", [3, 16])
def test_many_pads_on_one_disc(m):
    """As many as rub, with their limits' sum; one of them on a belt that moves gives its part of the motion."""
    share = jnp.arange(1.0, m + 1) / sum(range(1, m + 1))
    disc = hhtjax.System(
        ONE,
        lambda q, v, t, p: -100 * q,
        friction=lambda q, v, t, p: 4 * share,
        sliding=lambda q, v, t, p: v * jnp.ones(m),
    )
    run = hhtjax.simulate(disc, hhtjax.hht(), 0.5 * ONE, 0 * ONE, dt=2.2 / 400, num_steps=400)
    run.check()
    np.testing.assert_allclose(run.q[:, 0], free_vibration_exact(np.asarray(run.t))[0], atol=1e-3)
    assert run.sticking[-1].all()
    np.testing.assert_allclose(np.sum(run.friction[-1]), -100 * run.q[-1, 0], rtol=1e-9)
    if m == 3:
        found = hhtjax.analysis.energy_balance(disc, run, potential=lambda q, t, params: 50 * jnp.sum(q**2))
        assert np.max(np.abs(found.error)) < 5e-3 * 12.5
        assert found.work[-1] < -0.9 * 12.5


def test_more_than_sixteen_are_refused():
    system = hhtjax.System(
        jnp.ones(1),
        lambda q, v, t, p: -q,
        friction=lambda *_: jnp.ones(17),
        sliding=lambda q, v, t, p: v * jnp.ones(17),
    )
    with pytest.raises(ValueError, match=r"`sliding` must return an array \(m,\) with 1 <= m <= 16"):
        hhtjax.simulate(system, hhtjax.hht(), ONE, ONE, dt=0.1, num_steps=1)


@pytest.mark.slow
def test_two_belts_pull_one_block():
    """Of other speeds: s2 = s1 - 1 depends on s1 but for what is prescribed. Against tanh with less and less width."""
    block = hhtjax.System(
        ONE,
        lambda q, v, t, p: -4.0 * q,
        friction=lambda q, v, t, p: jnp.array([1.0, 1.5]),
        sliding=lambda q, v, t, p: v * TWO - jnp.array([0.3, -0.5 * jnp.cos(2 * t)]),
    )
    run = hhtjax.simulate(block, hhtjax.hht(), 0 * ONE, ONE, dt=2e-3, num_steps=2000, save_every=100)
    run.check()

    def error(width):
        def rate(t, y):
            return [
                y[1],
                -4 * y[0] - np.tanh((y[1] - 0.3) / width) - 1.5 * np.tanh((y[1] + 0.5 * np.cos(2 * t)) / width),
            ]

        exact = solve_ivp(rate, (0, 4), [0, 1], "Radau", np.asarray(run.t), rtol=1e-9, atol=1e-10)
        return np.max(np.abs(exact.y[0] - run.q[:, 0]))

    wide, narrow = error(1e-3), error(1e-4)
    assert narrow < 1e-4
    assert narrow < wide / 6


@pytest.mark.slow
def test_a_driven_crank_bears_all_four_joints():
    """Sum of F_i |ds_i/dq| beside the torque without friction; nothing moves otherwise."""
    t = np.linspace(0, 2, 801)
    x, rate = motion(t)
    q0, v0 = angles(x[:1])[:, 0], ratios(angles(x[:1])[:, 0]) * rate[0]

    @jax.jit
    @jax.vmap
    def run(F):
        return hhtjax.simulate(CRANK, hhtjax.hht(), q0, v0, {**PARAMS, "F": F}, dt=2 / 800, num_steps=800)

    found = run(jnp.stack([LIMITS, 0 * LIMITS]))
    found.check()
    torque = np.asarray(found.multipliers[0] - found.multipliers[1])[:, 2]
    slopes = np.array([ratios(q) for q in angles(x).T])
    rates = np.stack([slopes[:, 0], slopes[:, 1] - slopes[:, 0], slopes[:, 2] - slopes[:, 1], slopes[:, 2]])
    exact = np.sign(rate) * (np.asarray(LIMITS) @ np.abs(rates))
    away = np.abs(torque - exact)
    turning = np.any(np.diff(np.sign(rates * rate), axis=1) != 0, axis=0)
    clear = ~np.concatenate([[False], turning])
    assert np.max(away[clear]) < 1e-6
    assert np.count_nonzero(~clear) == 3
    np.testing.assert_allclose(found.q[0], found.q[1], atol=1e-12)
    np.testing.assert_allclose(np.abs(found.friction[0]), np.tile(LIMITS, (801, 1)))


LOADED = {**PARAMS, "A": 40.0, "W": 5.0, "F": 15 * LIMITS}


T, SAMPLES, SIZES = 3.0, 30, np.array([480, 1920])


def swung_to(F, dt, num_steps):
    """A number of the state after 32 steps; the run."""
    q0 = angles(np.array([0.7]))[:, 0]
    run = hhtjax.simulate(FREE, hhtjax.hht(), q0, 0 * q0, {**LOADED, "F": F}, dt=dt, num_steps=num_steps)
    return run.q[32, 0] + 0.1 * run.v[32, 0] + 0.01 * run.multipliers[32, 0], run


@pytest.fixture(scope="module")
def swings():
    """One program: runs of two step sizes, of which the longer goes on, and those of which derivatives are compared."""
    F = np.asarray(LOADED["F"])
    near = points(F)

    @jax.jit
    @jax.vmap
    def run(F, dt):
        return jax.jvp(lambda F: swung_to(F, dt, SIZES[1]), (F,), (ALONG,), has_aux=True)

    dts = np.concatenate([T / SIZES, np.full(len(near), 1 / 32)])
    values, rates, runs = run(np.concatenate([[F, F], near]), dts)
    return row(runs, slice(2)), np.asarray(values)[2:], np.asarray(rates)[2:]


@pytest.mark.slow
def test_four_joints_of_a_four_bar_rub(swings):
    """Order 2 against one freedom, solved from switch to switch, through rest, reversals and turns of single joints."""
    exact, switches = reduced(LOADED, np.linspace(0, T, SAMPLES + 1))
    assert len(switches) == 6
    runs = swings[0]
    runs.check()
    at = np.outer(SIZES // SAMPLES, np.arange(SAMPLES + 1))
    found = [np.take_along_axis(np.asarray(x[..., 0]), at, axis=1) for x in (runs.q, runs.v)]
    error = np.stack([np.max(np.abs(x - y), axis=1) for x, y in zip(found, exact, strict=True)])
    order = np.log(error[:, 0] / error[:, 1]) / np.log(4)
    assert np.all(order > 1.85), order
    assert np.all(error[:, 1] < [1e-3, 4e-3]), error
    one = row(runs, 1)
    assert 0.02 < np.mean(one.sticking[at[1]]) < 0.2
    balance = hhtjax.analysis.energy_balance(FREE, one, LOADED)
    assert np.max(np.abs(balance.error)) < 1e-3 * np.max(np.abs(balance.kinetic))


@pytest.mark.slow
def test_derivatives_in_all_four_limits(swings):
    F, (_, values, rates) = np.asarray(LOADED["F"]), swings
    reverse = np.asarray(jax.jit(jax.grad(lambda F: swung_to(F, 1 / 32, 32)[0]))(F))
    check_three_ways(reverse, values, rates, F, ALONG)


def twins(limit=lambda q, v, t, p: p * TWO):
    """Two pads on the first of three masses: fewer rows than freedoms, so that only the start shows what they are."""
    return hhtjax.System(
        jnp.ones(3), lambda q, v, t, p: -100 * q, friction=limit, sliding=lambda q, v, t, p: v[0] * TWO
    )


@pytest.mark.slow
def test_what_a_start_shows_and_what_a_tracer_hides():
    """Inside a batch of limits rows are not known: there the stepper is told, else the run fails by name."""
    q0 = jnp.array([0.5, 0.1, 0.1])

    def run(F, stepper=hhtjax.hht()):  # noqa: B008 (frozen)
        return hhtjax.simulate(twins(lambda q, v, t, p: p * TWO), stepper, q0, 0 * q0, F, dt=2.2 / 400, num_steps=400)

    known = run(2.0)
    known.check()
    np.testing.assert_allclose(known.q[:, 0], free_vibration_exact(np.asarray(known.t))[0], atol=1e-3)

    def hidden(c, stepper):
        system = hhtjax.System(
            jnp.ones(3), lambda q, v, t, p: -100 * q, friction=lambda q, v, t, p: 2.0 * TWO,
            sliding=lambda q, v, t, c: v[0] * jnp.stack([c, 1.0]),
        )  # fmt: skip
        return hhtjax.simulate(system, stepper, q0, 0 * q0, c, dt=2.2 / 400, num_steps=400)

    told = jax.vmap(lambda c: hidden(c, hhtjax.hht(redundant="least_squares")))(TWO)
    np.testing.assert_allclose(told.q[0], known.q, atol=1e-12)
    with pytest.raises(
        hhtjax.SimulationError, match=r"directions of dry friction came to depend on each other.*least_squares"
    ):
        jax.vmap(lambda c: hidden(c, hhtjax.hht()))(TWO).check()


@pytest.mark.slow
def test_joints_break_away_within_a_step():
    """Where the load that grows is beyond their sum: order 2 of the motion, and of its derivative in the limit."""
    pads = hhtjax.System(
        ONE,
        lambda q, v, t, p: 3 * jnp.sin(t) - 2 * q,
        friction=lambda q, v, t, p: p * jnp.array([0.3, 0.7]),
        sliding=lambda q, v, t, p: v * TWO,
    )
    limits, T = 1.1 + np.linspace(0, 0.3, 13), 1.5

    def exact(F):
        def rate(t, y):
            return [y[1], 3 * np.sin(t) - 2 * y[0] - F]

        return solve_ivp(rate, (np.arcsin(F / 3), T), [0, 0], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]

    def found(F, N):  # one program: the run with long steps goes on
        run = hhtjax.simulate(pads, hhtjax.hht(), 0 * ONE, 0 * ONE, F, dt=T / N, num_steps=200)
        return jnp.stack([run.q[N, 0], run.v[N, 0]])

    values = np.array([exact(F) for F in limits])
    slopes = np.array([(exact(F + 1e-4) - exact(F - 1e-4)) / 2e-4 for F in limits])
    errors = []
    both = jax.jit(jax.vmap(lambda F, N: jax.jvp(lambda F: found(F, N), (F,), (1.0,)), (0, None)))
    for N in (50, 200):
        computed = both(jnp.asarray(limits), N)
        errors.append([np.max(np.abs(x - y), axis=0) for x, y in zip(computed, (values, slopes), strict=True)])
    order = np.log2(np.divide(*errors)) / 2
    assert np.all(np.abs(order - 2) < 0.1), order
    assert np.max(errors[1]) < 5e-5


def pulled_gear(push):
    """Stuck by 4 in all: the limit of the first, and half that of the second."""
    return hhtjax.System(
        GEAR.mass, lambda q, v, t, p: jnp.stack([push(p, t), 0.0 * t]), gear, friction=lambda q, v, L, t, p: GEARED["F"]
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "steps",
    [
        {"dt": 0.1, "num_steps": 30},
        # under error control a jump of an input breaks it away below, and events act in other files
        pytest.param({"dt": hhtjax.adaptive(1e-4, 1e-7), "times": [2.5, 3.0]}, marks=EVERY),
    ],
    ids=["fixed", "adaptive"],
)
def test_a_load_at_a_known_time_breaks_a_gear_away(steps):
    """(u - 4) t^2/2 from then on: exact, since all is constant between."""
    load, T = hhtjax.Event(at=2.013, switch=lambda u: u + 2.1), 3.0 - 2.013
    system = pulled_gear(lambda u, t: u)
    run = hhtjax.simulate(system, hhtjax.hht(0.0), ZERO, ZERO, jnp.asarray(3.9), events=[load], **steps)
    run.check()
    np.testing.assert_allclose([run.q[-1, 0], run.v[-1, 0]], [T**2, 2 * T], rtol=1e-12)


@needs_compiler
@pytest.mark.slow
def test_a_gear_in_c(tmp_path):
    arguments = hhtjax.hht(), jnp.array([0.5, 0.25]), ZERO, GEARED
    library = Library(hhtjax.export_c(GEAR, *arguments), tmp_path)
    dt = 2.2 / 400
    state, flags = library.begin(*arguments[1:3], dt=dt)
    assert flags == 0
    assert library.run(state, 400, dt) == 0
    run = turned()
    assert numbers(state, "q") == pytest.approx(np.asarray(run.q[-1]), rel=1e-10)
    assert numbers(state, "friction_tau") == pytest.approx(np.asarray(run.friction[-1]), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "steps",
    [{"dt": 0.25, "num_steps": 11}, {"dt": hhtjax.adaptive(1e-4, 1e-7), "times": 0.25 * np.arange(1, 12)}],
    ids=["fixed", "adaptive"],
)
def test_a_held_torque_breaks_a_gear_away_at_its_jump(steps):
    """(u - 4) t^2/2 from the jump on: exact, since all is constant between."""
    u = hhtjax.sampled(jnp.array([1.0, 3.9, 6.0, 6.0]), dt=1.0, order=0)
    run = hhtjax.simulate(pulled_gear(lambda u, t: u(t)), hhtjax.hht(0.0), ZERO, ZERO, u, **steps)
    run.check()
    t = np.maximum(np.asarray(run.t) - 2, 0)
    np.testing.assert_allclose(run.v[:, 0], 2 * t, atol=1e-12)
    np.testing.assert_allclose(run.q[:, 0], t**2, atol=1e-12)
    assert run.sticking[np.asarray(run.t) <= 2].all()
