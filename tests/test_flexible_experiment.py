"""The beam of the flexible experiment: here, in C and in exudyn, and its closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from experiments.flexible import aims, beam, four_bar, models, native_beam, scaling, statics

ALPHA, DT, STEPS = -0.05, 1e-3, 300
HUNG = beam.Beam(10, gravity=9.81, hub="clamped")
native = pytest.mark.skipif(native_beam.library() is None, reason="needs a C compiler")


def ours(described, stepper):
    system, q0, v0 = beam.scene(described)
    run = hhtjax.simulate(system, stepper, q0, v0, {}, dt=DT, num_steps=STEPS, save_every=STEPS)
    run.check()
    return run.q[-1], run.v[-1]


@native
@pytest.mark.parametrize("described", [beam.pendulum(10), HUNG, beam.Beam(10)], ids=["pinned", "clamped", "spun"])
def test_c_source_takes_the_same_steps(described):
    stepper = hhtjax.hht(ALPHA, linearize="predictor", start="simple", solve=hhtjax.banded(5))
    q, v = ours(described, stepper)
    assert q.size == described.unknowns
    for flags in (native_beam.PLAIN,), (native_beam.FAST,), (native_beam.PLAIN, "plain_beam"):
        end, speed = native_beam.Run(native_beam.library(*flags), described, DT, STEPS, ALPHA)()
        assert np.max(np.abs(end.ravel()[described.held :] - q)) < 1e-12
        assert np.max(np.abs(speed.ravel()[described.held :] - v)) < 1e-10


@native
def test_c_source_goes_on_from_sample_to_sample():
    run = native_beam.Run(native_beam.library(), beam.Beam(4), DT, 100)
    tip = run.tip(25)
    assert tip.shape == (4, 3)
    np.testing.assert_array_equal(tip[-1], run()[0][-1])


def test_c_source_asks_for_an_even_number():
    with pytest.raises(ValueError, match="`beam` must have an even number of elements; received 3"):
        native_beam.Run(None, beam.Beam(3), DT, 1)


@native
def test_spin_up():
    """The largest lag of a finer beam, and the closed form of the stretch."""
    spun = beam.Beam(32)
    tip = native_beam.Run(native_beam.library(), spun, 1e-3, 20_000).tip(50)
    times = 0.05 * np.arange(1, 401)
    lag, stretch = beam.in_hub(spun, tip, times)
    assert abs(lag.min() - beam.LARGEST_LAG[0]) < 5e-4
    assert abs(times[lag.argmin()] - beam.LARGEST_LAG[1]) < 1e-6
    assert abs(stretch[times > beam.SECONDS].mean() - beam.STRETCH) < 1e-6


def test_stiffness_and_weight_of_the_beam():
    """A cantilever under a small load at its tip: F L^3/(3 EI) (1 - 1/(4 E^2)) + F L/GA."""
    clamped, load = beam.Beam(8, hub="clamped"), 1e-3
    system, q0, v0 = beam.scene(clamped)
    K = -jax.jacfwd(lambda q: system.force(q, v0, 0.0, {}))(q0)
    tip = np.linalg.solve(K, load * jnp.zeros_like(q0).at[-2].set(1.0))[-2]
    bent, sheared = 10.0**3 / (3 * clamped.EI) * (1 - 1 / (4 * 8**2)), 10.0 / clamped.GA
    np.testing.assert_allclose(tip, load * (bent + sheared), rtol=1e-9)
    assert abs(np.sum(system.force(q0, v0, 0.0, {"gravity": 1.0})) + 12.0 * (1 - 1 / 16)) < 1e-9


def test_exudyn_has_the_same_beam():
    pytest.importorskip("exudyn")
    from experiments.flexible import by_exudyn

    pinned = beam.pendulum(4)
    M, K, _ = by_exudyn.built(pinned).system.ComputeLinearizedSystem()
    np.testing.assert_allclose(np.array(M), np.diag(beam.masses(pinned).ravel()), atol=1e-15)
    straight = jnp.asarray(beam.straight(pinned))
    ours = -jax.jacfwd(lambda q: beam.elastic_force(q.reshape(-1, 3), pinned).ravel())(straight.ravel())
    np.testing.assert_allclose(np.array(K), ours, atol=1e-14 * pinned.EA * 4)
    for t in 0.3, 14.0, 16.0:
        angle = by_exudyn.hub_angle(None, t, 0, 0.0)
        assert abs(angle - beam.hub_angle(beam.Beam(4), t)) < 1e-12
        rate = (by_exudyn.hub_angle(None, t + 1e-5, 0, 0.0) - by_exudyn.hub_angle(None, t - 1e-5, 0, 0.0)) / 2e-5
        assert abs(by_exudyn.hub_rate(None, t, 0, 0.0) - rate) < 1e-9


@native
def test_exudyn_moves_alike():
    pytest.importorskip("exudyn")
    from experiments.flexible import by_exudyn

    for row in by_exudyn.fall(fast=True) + by_exudyn.spin_up(fast=True):
        assert row["seconds"] > 0
        assert row["tip_error_m"] < 1e-3
    for row in by_exudyn.speeds(fast=True):
        assert row["ns_per_step_and_unknown"] > 0
    with pytest.raises(ValueError, match="`beam` must be pinned or clamped"):
        by_exudyn.cable(beam.Beam(2))


def marched(model, steps=100):
    stepper = hhtjax.hht(ALPHA, linearize="predictor", start="simple")
    run = hhtjax.simulate(
        model.system, stepper, model.q0, model.v0, model.params, dt=DT, num_steps=steps, save_every=steps
    )
    run.check()
    return run


@native
@pytest.mark.parametrize("described", [beam.pendulum(6), beam.Beam(6)], ids=["pinned", "spun"])
def test_elements_take_the_steps_of_the_c_source(described):
    run = marched(models.beam(described))
    end, _ = native_beam.Run(native_beam.library(native_beam.PLAIN, "plain_beam"), described, DT, 100, ALPHA)()
    np.testing.assert_allclose(run.q["r"][-1], end[:, :2], atol=1e-12)
    np.testing.assert_allclose(run.q["theta"][-1], end[:, 2], atol=1e-12)


def test_chain_of_springs_is_the_plain_one():
    here, plain = marched(models.spring_chain(8)), models.plain_chain(8)
    there = marched(plain)
    np.testing.assert_allclose(here.q[-1, 1:], there.q[-1], atol=1e-13)


def test_matrix_of_the_lattice():
    """Beside that of its force: the first step of a run is solved with it."""
    model, C = models.lattice(4), scaling.stepper().coefficients

    def force(x):
        return model.system.force({"r": x.reshape(-1, 2)}, model.v0, 0.0, model.params)["r"].ravel()

    K = -jax.jacfwd(force)(model.q0["r"].ravel())
    wanted = np.eye(32) + (1 - C.alpha_f) * C.beta * scaling.DT**2 * K
    np.testing.assert_allclose(scaling.step_matrix(model, 4).toarray(), wanted, atol=1e-14)


@pytest.mark.parametrize("model", [models.links(3), models.rods_in_space(3), four_bar.four_bar(2)])
def test_joints_hold_at_first(model):
    found = model.system.constraint(model.q0, 0.0, model.params)
    assert found.size >= 4
    np.testing.assert_allclose(found, 0.0, atol=1e-14)


def test_bend_of_a_link():
    r = np.array([[0.0, 0.0], [0.5, 0.1], [1.0, 0.0]])
    assert abs(four_bar.deflection(r, 0, 2) - 0.1) < 1e-15


def test_cantilever_settles():
    q, left = statics.settled(statics.cantilever(4))
    assert left < 1e-6
    np.testing.assert_allclose(q["r"][-1] - [2.0, 0.0], statics.ELASTICA, atol=2e-3)


def test_aims_and_exponents():
    rows = [{"scene": "beam", "way": "elements", "unknowns": n, "us_per_step": 2 * n} for n in (10, 100)]
    rows += [{"scene": "spring chain", "way": "elements", "unknowns": n, "us_per_step": n**2} for n in (10, 100)]
    found = {"rows": rows, "exponents": scaling.exponents(rows)}
    assert abs(found["exponents"]["spring chain"]["elements"] - 2) < 1e-12
    wanted = {name: aim for name, aim in aims.AIMS.items() if "exponent" in name}
    met = [of(found) <= limit for limit, of in wanted.values()]
    assert met == [True, False]
