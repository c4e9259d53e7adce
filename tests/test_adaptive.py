"""Error control: errors follow the tolerance, steps follow the motion, and what goes wrong is named with its time."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zoo
from helpers import ONE, SPRING, ZERO, run
from scipy.integrate import solve_ivp

import hhtjax
from hhtjax.runs.controlled_run import chosen_steps, run_recorded
from hhtjax.scenes import pendulum, top

SAMPLES = 32
FREE = zoo.PROBLEMS["forced double pendulum"]
CONTACT = hhtjax.System(ONE, lambda q, v, t, k: -9.81 + k * jnp.maximum(-q, 0.0) ** 1.5)  # a ball on a hard floor
CASES = {  # system, start, params, duration
    "double pendulum": (FREE.system, (FREE.q0, FREE.v0), FREE.params, 3.0),
    "contact": (CONTACT, (np.full(1, 0.3), ZERO), 1e6, 1.2),
    "van der Pol": (hhtjax.System(ONE, lambda q, v, t, mu: mu * (1 - q**2) * v - q), (2 * ONE, ZERO), 1000.0, 1800.0),
}
METHODS = {
    "hht": hhtjax.hht(alpha=-0.05),
    "newmark": hhtjax.newmark(),
    "bossak": hhtjax.bossak(alpha=-0.3),
    "generalized_alpha": hhtjax.generalized_alpha(0.5),
    "converged": hhtjax.hht(alpha=-0.3, iterations=None),
    "rosenbrock": hhtjax.rosenbrock(),
    "rowda": hhtjax.rowda(),
    "rodas5p": hhtjax.rodas5p(),
    "dopri5": hhtjax.dopri5(),
}
LIGHT = hhtjax.hht(alpha=-0.05, linearize="predictor")  # a smaller program


def times_of(case):
    return CASES[case][-1] * np.arange(1, SAMPLES + 1) / SAMPLES


def controlled(case, stepper, rtol, **options):
    system, start, params, _ = CASES[case]
    dt = hhtjax.adaptive(rtol, 1e-3 * rtol, **{"max_steps": 40_000} | options)
    return hhtjax.simulate(system, zoo.as_data(stepper), *start, params, dt=dt, times=times_of(case))


@pytest.fixture(scope="module")
def references():
    """q at the samples, by SciPy's Radau or DOP853."""
    found = {}
    for case, (system, (q0, v0), params, duration) in CASES.items():
        n = len(q0)

        @jax.jit
        def rate(t, y, system=system, params=params, n=n):
            M = system.mass(y[:n], params) if callable(system.mass) else jnp.diag(jnp.asarray(system.mass))
            return jnp.concatenate([y[n:], jnp.linalg.solve(M, system.force(y[:n], y[n:], t, params))])

        jac = jax.jit(jax.jacfwd(rate, 1))
        stiff = {"jac": lambda t, y, jac=jac: np.asarray(jac(t, y)), "rtol": 1e-9} if case == "van der Pol" else {}
        options = {"method": "Radau" if stiff else "DOP853", "rtol": 1e-12, "atol": 1e-12} | stiff
        y = solve_ivp(
            lambda t, y, rate=rate: np.asarray(rate(t, y)), (0, duration), np.concatenate([q0, v0]),
            t_eval=times_of(case), **options,
        )  # fmt: skip
        found[case] = y.y[:n].T
    return found


def error_of(found, reference):
    """In q, relative to its largest value."""
    return np.max(abs(found.q[1:] - reference)) / np.max(abs(reference))


@pytest.mark.slow
@pytest.mark.parametrize("name", zoo.each(METHODS, quick=("hht", "rowda", "dopri5"), rest=("rosenbrock",)))
def test_the_error_follows_the_tolerance(name, references):
    for rtol in (1e-2, 1e-4, 1e-6):
        found = controlled("double pendulum", METHODS[name], rtol)
        found.check()
        assert 0.02 < error_of(found, references["double pendulum"]) / rtol < 10
        assert found.dt.shape == (found.steps.accepted,)
        assert found.steps.reached == 3.0
        np.testing.assert_allclose(np.sum(found.dt), 3.0, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most"), [("hht", 351), ("rowda", 194), ("rosenbrock", 351)])
def test_contact_takes_small_steps_where_it_is_and_nowhere_else(name, most, references):
    """For an error of 1e-3 equal steps take 3443, and 3345. Without the defect the ball goes through the floor."""
    coarse = controlled("contact", METHODS[name], 1e-2)
    assert np.max(abs(coarse.q)) < 0.35
    for rtol in (1e-2, 1e-3, 1e-4):
        found = controlled("contact", METHODS[name], rtol)
        found.check()
        assert 0.02 < error_of(found, references["contact"]) / rtol < 10
        if error_of(found, references["contact"]) > 1e-3:
            assert found.steps.accepted + found.steps.rejected < most


@pytest.mark.slow
@pytest.mark.parametrize(("name", "rtol", "most"), [("hht", 5e-4, 1400), ("rowda", 5e-4, 420)])
def test_van_der_pol(name, rtol, most, references):
    found = controlled("van der Pol", METHODS[name], rtol)
    assert error_of(found, references["van der Pol"]) < 1e-3
    assert found.steps.accepted + found.steps.rejected <= most


@pytest.mark.slow
def test_constraints(references):
    """In GGL form, against the angle."""
    flat, long = pendulum.minimal(), pendulum.cartesian()
    times, rtol = np.linspace(0, 2, 21)[1:], 1e-4
    found = hhtjax.simulate(
        long.system, LIGHT, long.q0, long.v0, long.params, dt=hhtjax.adaptive(rtol, 1e-7), times=times
    )
    found.check()
    start = flat.q0, flat.v0, flat.params
    exact = hhtjax.simulate(flat.system, hhtjax.rk4(), *start, dt=1e-3, num_steps=2000, save_every=100)
    length = float(np.linalg.norm(long.q0))
    np.testing.assert_allclose(np.linalg.norm(found.q, axis=1), length, atol=1e-4)
    x = length * np.sin(np.asarray(exact.q)[:, 0])
    assert 0.02 < min(np.max(abs(found.q[:, 0] - s * x)) for s in (1, -1)) / length / rtol < 10
    assert np.all(np.isfinite(found.multipliers))


@pytest.mark.slow
def test_rotations():
    """Against the same at 1e-5, whose order is tested elsewhere."""
    scene, times, rtol = top.minimal(), np.linspace(0, 0.2, 5)[1:], 1e-3
    found, fine = (
        hhtjax.simulate(
            scene.system, LIGHT, scene.q0, scene.v0, scene.params, dt=hhtjax.adaptive(x, 1e-3 * x), times=times
        )
        for x in (rtol, 1e-2 * rtol)
    )
    found.check()
    assert fine.steps.accepted > 5 * found.steps.accepted
    assert 0.02 < np.max(abs(found.q - fine.q)) / rtol < 10


@pytest.mark.slow
def test_first_order_systems_and_internal_states():
    """y'' = -4 y - z with z' = -3 z + v, as it is, and as a system of first order; scales are those of y and of z."""

    def rate(y, t, params):
        return {"q": y["v"], "v": -4 * y["q"] - y["z"], "z": -3 * y["z"] + y["v"]}

    y0 = {"q": ONE, "v": ZERO, "z": ONE}
    A = np.array([[0, 1, 0], [-4, 0, -1], [0, 1, -3.0]])
    times = np.linspace(0, 4, 9)[1:]
    exact = np.array([jax.scipy.linalg.expm(A * t) @ np.array([1.0, 0, 1]) for t in times])
    internal = hhtjax.System(ONE, lambda q, v, z, t, p: -4 * q - z, internal=lambda q, v, z, t, p: -3 * z + v)
    for other in (METHODS["hht"], METHODS["dopri5"]):
        for rtol in (1e-3, 1e-5):
            dt = hhtjax.adaptive(rtol, 1e-8)
            first = hhtjax.simulate(hhtjax.FirstOrderSystem(rate), METHODS["hht"], y0, dt=dt, times=times)
            second = hhtjax.simulate(internal, other, ONE, ZERO, z0=ONE, dt=dt, times=times)
            found = [first.q["q"], first.q["z"], second.q, second.z]
            for x, y in zip(found, exact.T[[0, 2, 0, 2]], strict=True):
                assert 0.001 < np.max(abs(x[1:, 0] - y)) / rtol < 10


@pytest.mark.slow
def test_derivatives_are_those_of_the_accepted_steps():
    """Reverse by differences over the same steps, and forward along a direction; of what a force closes over, too."""
    stepper, times = hhtjax.hht(linearize="predictor"), np.array([0.7, 0.9, 2.0])
    system = hhtjax.System(ONE, lambda q, v, t, params: -params["k"] * jnp.sin(q) - params["c"] * v**3)
    params = {"k": jnp.asarray(4.0), "c": jnp.asarray(0.3)}
    control = hhtjax.adaptive(1e-3, 1e-6, max_steps=500)

    def loss(params):
        by_closure = hhtjax.System(ONE, lambda q, v, t, k: system.force(q, v, t, params | {"k": k}))
        return jnp.sum(hhtjax.simulate(by_closure, stepper, ONE, ZERO, params["k"], dt=control, times=times).q ** 2)

    steps = hhtjax.choose_steps(system, stepper, ONE, ZERO, params, times=times, rtol=1e-3, atol=1e-6, max_steps=500)
    whole = hhtjax.simulate(system, stepper, ONE, ZERO, params, dt=control, times=times)
    np.testing.assert_array_equal(whole.dt, steps.dt)

    @jax.jit
    def frozen(params):
        path = hhtjax.simulate(system, stepper, ONE, ZERO, params, dt=steps.dt)
        return jnp.sum(hhtjax.interpolate(path, times).q ** 2)

    along, h = {"k": 1.0, "c": 0.5}, 1e-5
    reverse = jax.grad(jax.jit(loss))(params)  # where a derivative is not known of when steps are chosen
    value, forward = jax.jit(lambda x: jax.jvp(loss, (x,), (along,)))(params)
    for found in (value, jnp.sum(whole.q**2)):
        assert float(found) == pytest.approx(float(frozen(params)) + 1.0, rel=1e-12)  # and the start
    for name in params:
        at = [float(frozen(params | {name: params[name] + s * h})) for s in (-1, 1)]
        assert float(reverse[name]) == pytest.approx((at[1] - at[0]) / (2 * h), rel=1e-7)
    assert float(forward) == pytest.approx(sum(along[name] * float(reverse[name]) for name in params), rel=1e-10)


@pytest.mark.slow
def test_tolerances_and_all_else_are_data():
    def go(rtol, k, q0):
        dt, times = hhtjax.adaptive(rtol, 1e-6), np.array([0.2, 0.287])  # from 0.4 the latter is in contact
        return hhtjax.simulate(CONTACT, hhtjax.rowda(), jnp.full(1, q0), ZERO, k, dt=dt, times=times)

    def choose(times):
        hhtjax.choose_steps(CONTACT, hhtjax.rowda(), jnp.full(1, 0.3), ZERO, 1e5, times=times, rtol=1e-2, atol=1e-6)

    go(1e-3, 1e5, 0.3)
    choose([0.4])
    compiled = run_recorded.number(), chosen_steps.number()
    for times in ([0.3], [0.1, 0.2, 0.4]):  # of the steps alone any number
        choose(times)
    few, many = (go(rtol, 2e5, 0.4) for rtol in (1e-2, 1e-5))
    assert (run_recorded.number(), chosen_steps.number()) == compiled
    assert few.steps.accepted < many.steps.accepted
    go_all, rtol = jax.jit(jax.vmap(lambda rtol: go(rtol, 2e5, 0.4))), np.array([1e-2, 1e-5])
    program = go_all.lower(rtol).as_text().splitlines()
    assert sum("select" in x and "2x10000xf64" in x for x in program) == 1  # behind the loop, of `dt`; not in each try
    (batch := go_all(rtol)).check()
    np.testing.assert_allclose(batch.q, [few.q, many.q], rtol=1e-9)
    assert np.sum(np.isfinite(batch.dt), 1).tolist() == batch.steps.accepted.tolist()


def test_single_precision():
    single = [x.astype(np.float32) for x in (ONE, ZERO)]
    dt, times = hhtjax.adaptive(1e-3, 1e-6), np.array([0.5, 1.0])
    with pytest.warns(hhtjax.PrecisionWarning):
        found = hhtjax.simulate(SPRING, hhtjax.hht(), *single, dt=dt, times=times)
    assert {x.dtype for x in (found.t, found.q, found.dt)} == {np.dtype(np.float32)}
    assert abs(float(found.q[-1, 0]) - np.cos(2.0)) < 5e-3


def test_order_of_the_pair_its_estimate_and_its_dense_output():
    errors, counts, between = [], [], []
    for n in (16, 64):
        found = run(stepper=hhtjax.dopri5(), dt=1.0 / n, num_steps=n)
        errors.append(abs(float(found.v[-1, 0]) + 2 * np.sin(2.0)))
    assert np.log2(errors[0] / errors[1]) / 2 == pytest.approx(5, abs=0.2)
    for rtol in (1e-4, 1e-9):
        times = np.linspace(0, 3, 100)[1:]
        found = hhtjax.simulate(SPRING, hhtjax.dopri5(), ONE, ZERO, dt=hhtjax.adaptive(rtol, 1e-3 * rtol), times=times)
        between.append(np.max(abs(found.q[1:, 0] - np.cos(2 * times))))
        counts.append(float(found.steps.accepted))
    order = np.log(between[0] / between[1]) / np.log(counts[1] / counts[0])
    assert order > 4.3


@pytest.mark.slow
def test_the_stages_of_many_unknowns_are_a_loop():
    """With the numbers and derivatives that each unknown has alone, where they are written out."""
    k = np.linspace(1.0, 4.0, 6)
    system = hhtjax.System(np.ones(1), lambda q, v, t, k: -k * jnp.sin(q) - 0.1 * v**3 + jnp.cos(3 * t))
    decay = hhtjax.FirstOrderSystem(lambda y, t, k: -k * y**3 + jnp.sin(t))
    row = hhtjax.System(np.ones(6), system.force)

    def end(system, k):
        start = jnp.ones_like(k), *([] if system is decay else [jnp.zeros_like(k)])
        q = hhtjax.simulate(system, hhtjax.dopri5(), *start, params=k, dt=0.2, num_steps=5).q[-1]
        return jnp.sum(q**2), q

    for many, one in ((row, system), (decay, decay)):
        both = jax.value_and_grad(lambda k, one=one: end(one, k[None]), has_aux=True)
        (_, alone), slopes = jax.jit(jax.vmap(both))(k)
        (_, found), found_slopes = jax.jit(jax.value_and_grad(partial(end, many), has_aux=True))(k)
        np.testing.assert_allclose(found, alone[:, 0], rtol=1e-13)
        np.testing.assert_allclose(found_slopes, slopes, rtol=1e-11)


@pytest.mark.slow
def test_the_error_of_the_whole_run(references):
    """Of a resolved motion it is stated to a tenth; where no estimate of a step sees it, as here, `check` does."""
    found = controlled("double pendulum", METHODS["hht"], 1e-3, verify=True)
    found.check()
    assert (found.error.shape, found.error[0], found.failed) == ((SAMPLES + 1,), 0, False)
    true = float(np.max(abs(found.q[1:] - references["double pendulum"])))
    assert float(np.max(found.error)) == pytest.approx(true, rel=0.1)
    assert float(found.allowed) == pytest.approx(10 * (1e-3 * float(np.max(abs(found.q))) + 1e-6))
    spring = hhtjax.System(ONE, lambda q, v, t, p: -100 * q - 1e4 * q**3)  # undamped, some 30 periods
    times = np.linspace(0, 2, 65)[1:]
    programs = set()
    for verify in (True, "tolerance"):
        run = hhtjax.simulate(
            spring, METHODS["hht"], ONE, ZERO, dt=hhtjax.adaptive(1e-3, 1e-6, verify=verify), times=times
        )
        with pytest.raises(
            hhtjax.SimulationError, match=r"at t = 0.\d+ the error of the run is 0.01\d+, by a finer run"
        ):
            run.check()
        assert 0.1 < float(np.max(run.error)) * bool(run.failed) < 0.3
        programs.add((run_recorded.number(), chosen_steps.number()))
    assert len(programs) == 1


@pytest.mark.slow
def test_a_quarter_of_the_tolerance_gives_no_false_alarm(references):
    """Jumps move by more than a step: with halved steps the error is 1e4 times what it was."""
    found = controlled("van der Pol", METHODS["rowda"], 1e-3, verify="tolerance")
    found.check()
    true = float(np.max(abs(found.q[1:] - references["van der Pol"])))
    assert float(np.max(found.error)) == pytest.approx(true, rel=0.2)
