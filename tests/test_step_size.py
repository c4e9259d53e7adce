"""The step size suggested for a system, or for a motion."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import hht_roots
from zoo import as_data

import hhtjax
from hhtjax import analysis
from hhtjax.scenes import duffing, pendulum

COUPLED = hhtjax.System(
    jnp.array([[2.0, 0.5], [0.5, 1.0]]),
    lambda q, v, t, params: -params["K"] @ q - params["c"] * v,
)
PARAMS = {"K": jnp.array([[900.0, -400.0], [-400.0, 500.0]]), "c": 2.0}


def coupled_rates():
    """lambda with a positive imaginary part, of M lambda^2 + C lambda + K."""
    M = np.asarray(COUPLED.mass)
    lower = -np.linalg.solve(M, np.hstack([PARAMS["K"], PARAMS["c"] * np.eye(2)]))
    rates = np.linalg.eigvals(np.vstack([np.eye(2, 4, k=2), lower]))
    return sorted(rates[rates.imag > 0], key=abs)


def relative_error(rate, dt):
    """|log(mu)/(lambda h) - 1| of hht(-.05), by closed form."""
    roots = hht_roots(-0.05)(abs(rate) * dt, -rate.real / abs(rate))
    return abs(np.log(max(roots, key=lambda root: root.imag)) / (rate * dt) - 1)


@pytest.mark.slow
def test_suggested_step_is_the_largest_that_resolves_the_modes():
    slow, fast = coupled_rates()
    suggest = partial(
        analysis.suggest_step_size, COUPLED, as_data(hhtjax.hht(-0.05)), jnp.zeros(2), jnp.zeros(2), PARAMS
    )
    for rate, found in ((fast, suggest()), (slow, suggest(highest=1.1 * abs(slow)))):
        assert relative_error(rate, found.dt) <= 1e-2 < relative_error(rate, 1.06 * found.dt)
        assert found.modes[0].resolved
        assert found.modes[1].resolved == (rate is fast)
        for mode, exact in zip(found.modes, (slow, fast), strict=True):
            assert mode.frequency == pytest.approx(abs(exact), rel=1e-9)
            assert mode.damping_ratio == pytest.approx(-exact.real / abs(exact), rel=1e-9)
        lines = str(found).splitlines()
        assert f"{abs(rate):.4g} rad/s" in lines[0]
        assert len(lines) == 4
        assert max(map(len, lines)) <= 95
        hertz, period = lines[2].split()[1:3]
        assert float(hertz) == pytest.approx(found.modes[0].frequency / (2 * np.pi), rel=5e-3)
        assert float(period) == pytest.approx(2 * np.pi / found.modes[0].frequency, rel=5e-3)


def test_suggested_step_of_an_explicit_method_is_a_stable_one():
    rates = coupled_rates()
    found = analysis.suggest_step_size(
        COUPLED, hhtjax.rk4(), jnp.zeros(2), jnp.zeros(2), PARAMS, tolerance=0.3, highest=1.1 * abs(rates[0])
    )
    assert "grows" in found.reason
    z = rates[1] * found.dt * np.array([1.0, 1.06])
    stable, unstable = abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24)
    assert stable <= 1 < unstable


@pytest.mark.slow
def test_a_duration_asks_for_the_error_of_the_motion(capsys):
    """The step at which the motion of a hardening spring is off by 2 %, whatever its mode at the start."""
    scene = duffing.hardening_spring()
    stepper = as_data(hhtjax.hht(-0.05))
    suggest = partial(
        analysis.suggest_step_size, scene.system, stepper, scene.q0, scene.v0, scene.params, duration=scene.duration
    )
    found = suggest(tolerance=0.02)
    reference = hhtjax.simulate(
        scene.system, hhtjax.rk4(), scene.q0, scene.v0, scene.params, dt=scene.duration / 2**14, num_steps=2**14
    ).q
    steps = round(scene.duration / found.dt)
    path = hhtjax.simulate(
        scene.system, hhtjax.hht(-0.05), scene.q0, scene.v0, scene.params, dt=scene.duration / steps, num_steps=steps
    )
    exact = np.interp(np.asarray(path.t), np.linspace(0, scene.duration, 2**14 + 1), np.asarray(reference)[:, 0])
    error = np.std(np.asarray(path.q)[1:, 0] - exact[1:]) / np.std(exact)
    assert error == pytest.approx(0.02, rel=0.2)
    assert "0.02 of its motion over 2 s" in found.reason
    assert len(found.modes) == 1
    short = suggest(tolerance=0.5, duration=0.05, progress=True)  # a few runs might agree by damping out the same
    assert "suggest_step_size: run 8, 1024 steps over 0.05 s" in capsys.readouterr().err
    assert short.reason.endswith("by runs of up to 1024 steps")


def test_modes_of_a_constrained_system_satisfy_its_constraints():
    """Of the pendulum at its lowest point, the tension held: one, of m l w^2 = m g + m v^2/l."""
    scene = pendulum.cartesian(speed=2.5)
    found = analysis.suggest_step_size(scene.system, as_data(hhtjax.hht(-0.05)), scene.q0, scene.v0, scene.params)
    assert [mode.frequency for mode in found.modes] == [pytest.approx((9.81 / 0.5 + 25) ** 0.5, rel=1e-9)]
    assert found.dt == found.modes[0].largest_dt
    assert found.modes[0].resolved


def test_modes_that_only_decay_are_no_answer_for_a_nonlinear_system():
    """10 rad/s, at rest within steep friction: linearised there it creeps, and a step of seconds would resolve that."""

    def force(q, v, t, params):
        return -100 * q - 50 * jnp.tanh(v / 1e-3)

    system, start = hhtjax.System(np.ones(1), force), (jnp.ones(1), jnp.zeros(1))
    with pytest.raises(ValueError, match=r"no mode of the `system` oscillates or grows at q0, v0.*give a `duration`"):
        analysis.suggest_step_size(system, hhtjax.hht(), *start)
    moving = analysis.suggest_step_size(system, hhtjax.hht(), start[0], jnp.ones(1))
    assert moving.dt < 0.1
