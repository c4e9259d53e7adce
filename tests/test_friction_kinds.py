"""Dry friction in systems of all kinds: order 2 against motions solved from switch to switch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from friction_problems import CASES, arm_force, arm_mass
from friction_reference import Motion
from zoo import each

import hhtjax

ALPHAS = 0.0, -0.05, -0.3
NUM_STEPS = 800, 6400
SAMPLES = 50
SWITCHES = {"stick-slip, Coulomb": 20, "stick-slip, Stribeck": 20, "two masses on a belt": 25}


def errors(case, exact, **options):
    """Of q, v and z, for each of ALPHAS and of NUM_STEPS."""
    steppers = jax.vmap(lambda alpha: hhtjax.hht(alpha, **options))(jnp.repeat(jnp.array(ALPHAS), len(NUM_STEPS)))
    dts = case.duration / np.tile(NUM_STEPS, len(ALPHAS))
    found = hhtjax.sweep(
        case.system, steppers, case.q0, case.v0, case.params, z0=case.z0,
        dts=dts, duration=case.duration, num_samples=SAMPLES, in_axes=(0, None, None, None),
    )  # fmt: skip
    found.check()
    pairs = [(x, y) for x, y in zip((found.q, found.v, found.z), exact, strict=True) if x is not None]
    sizes = [np.max(np.abs(np.asarray(x) - y), axis=tuple(range(1, x.ndim))) for x, y in pairs]
    return np.reshape(sizes, (-1, len(ALPHAS), len(NUM_STEPS)))


def reference(case):
    """q, v and z at the samples, and the times of switches."""
    q0, v0 = map(np.asarray, case.start or (case.q0, case.v0))
    motion = Motion(case.free or case.system, case.params, q0, v0, case.z0 if case.z0 is None else np.asarray(case.z0))
    q, v, z, stuck, switches = motion.at(np.linspace(0, case.duration, SAMPLES + 1))
    q, v = case.exact(q, v) if case.exact else (q, v)
    return (q, v, z), stuck, switches


def check_order(name, **options):
    case = CASES[name]
    exact, stuck, switches = reference(case)
    assert len(switches) >= SWITCHES.get(name, 4)
    assert stuck.any()
    error = errors(case, exact, **options)
    order = np.log(error[..., 0] / error[..., 1]) / np.log(NUM_STEPS[1] / NUM_STEPS[0])
    assert np.all(order > 1.85), order
    assert np.all(error[..., 1] < 5e-4), error


@pytest.mark.parametrize("name", each(CASES, quick=("an internal state",)))
def test_order_two_through_every_switch(name):
    check_order(name)


@pytest.mark.slow
def test_order_two_in_index_3():
    check_order("a constraint, H(q), a load", formulation="index3")


@pytest.mark.slow
def test_a_mass_that_turns_is_not_linearised_about_what_stops_it():
    """A joint that slides by a rounding, and a limit of 100 times the load: its accelerations do not enter M(q) w."""

    def limit(q, v, t, F):
        return F + 0 * v[1:]

    system = hhtjax.System(arm_mass, arm_force, friction=limit, sliding=lambda q, v, t, F: v[1:])

    def end(dt, slides=0.0):
        start = jnp.array([1.0, -0.5]), jnp.array([2.0, slides])
        return hhtjax.simulate(system, hhtjax.hht(), *start, 1e3, dt=dt, num_steps=100).q

    error = [np.max(np.abs(end(dt, 1e-9) - end(dt))[: n + 1]) for dt, n in ((1e-2, 50), (5e-3, 100))]
    assert error[0] < 0.05
    assert np.log2(error[0] / error[1]) == pytest.approx(2, abs=0.15)
