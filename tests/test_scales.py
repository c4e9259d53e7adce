"""Units do not matter: a mechanism in metres or micrometres, of kilograms or nanograms, gets the same verdicts, and to
rounding the same numbers; in float32 too."""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.scenes import four_bars, slider_crank

UNITS = [(1.0, 1.0, 1.0), (1e-3, 1e-9, 1.0), (1e-3, 1e-9, 0.03), (1e-6, 1e-18, 1e-3), (1e3, 1e9, 30.0)]
FORMS = [("ggl", None), ("ggl", 1), ("index3", None), ("index3", 1)]


def bars(length, mass, time):
    """Four bars; params, q0, v0, and the sizes of the coordinates."""
    scene = four_bars.four_bars()
    params = {"m": mass, "l": length, "g": scene.params["g"] * length / time**2}
    return scene.system, params, scene.q0 * length, scene.v0 * length / time, length


def crank(length, mass, time):
    """A slider-crank: two angles and a length."""
    scene, sizes = slider_crank.driven(), np.array([1.0, 1.0, length])
    p, force = scene.params, mass * length / time**2
    params = {
        "m": jnp.array(p["m"]) * mass, "l": jnp.array(p["l"]) * length, "g": p["g"] * length / time**2,
        "rest": p["rest"] * length, "moment": p["moment"] * force * length,
        "k": p["k"] * force / length, "c": p["c"] * force * time / length,
    }  # fmt: skip
    return scene.system, params, scene.q0 * sizes, scene.v0, sizes


def path(units, mechanism, dtype, formulation, iterations):
    """q over the sizes of the coordinates, of a run that `check` has nothing against; one program for all units."""
    system, *start, sizes = mechanism(*units)
    params, q0, v0 = jax.tree.map(lambda x: jnp.asarray(x, dtype), start)
    stepper = hhtjax.hht(formulation=formulation, iterations=iterations)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hhtjax.PrecisionWarning)
        run = hhtjax.simulate(system, stepper, q0, v0, params, dt=jnp.asarray(1e-3 * units[2], dtype), num_steps=100)
    run.check()
    return np.asarray(run.q, float) / sizes


QUICK = (bars, np.float32, "ggl", None)
CASES = [
    (mechanism, dtype, *form) for mechanism in (bars, crank) for dtype in (np.float32, np.float64) for form in FORMS
]


@pytest.mark.slow
@pytest.mark.parametrize("case", [pytest.param(x, marks=[] if x == QUICK else pytest.mark.slow) for x in CASES])
def test_runs(case):
    """Converged ones to what the tolerance leaves."""
    paths, eps = [path(units, *case) for units in UNITS], np.finfo(case[1]).eps
    atol = 100 * eps if case[-1] else max(100 * eps, 1e-11)
    np.testing.assert_allclose(paths, np.broadcast_to(paths[0], np.shape(paths)), rtol=0, atol=atol)


def linked(q, params):
    c = 0.5 * jnp.cos(q[0] - q[1])
    return params["J"] * (jnp.eye(2, dtype=q.dtype) + c * jnp.array([[1.0, 1.0], [1.0, 0.0]], q.dtype))


def stiffening(q, v, t, params):
    return -params["k"] * jnp.stack([q[0] ** 3, jnp.sin(q[1])])


LINKED = hhtjax.System(linked, stiffening)


def linked_run(inertia, dt, **options):
    """Of 12 steps in float32."""
    params = {"J": jnp.float32(inertia), "k": jnp.float32(10 * inertia)}
    q0 = jnp.array([3.0, -0.5], jnp.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hhtjax.PrecisionWarning)
        return hhtjax.simulate(LINKED, hhtjax.hht(**options), q0, 0 * q0, params, dt=jnp.float32(dt), num_steps=12)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.02, 0.3])
def test_inertias_whose_squares_are_no_numbers_in_float32(dt):
    """Of links of micrometres, 8e-28 kg m^2: neither the solve may square them, nor what "auto" compares in long steps.
    Powers of 2, which round nothing, as steps so long make all of a difference."""
    runs = [linked_run(inertia, dt) for inertia in (1.0, 2.0**-90, 2.0**80)]
    for run in runs:
        run.check()
        np.testing.assert_allclose(run.q, runs[0].q, rtol=1e-6)


@pytest.mark.parametrize("inertia", [1.0, 1e-27])
def test_a_solve_that_solves_nothing_is_told_in_float32(inertia):
    run = linked_run(inertia, 0.02, linearize="predictor", solve=lambda A, b: 0 * b)
    with pytest.raises(hhtjax.SimulationError, match="solve"):
        run.check()


def circle(q, t, length):
    return (jnp.sum(q**2, keepdims=True) - length**2) / 2


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_consistent_initial(dtype):
    bead = hhtjax.System(jnp.ones(2, dtype), lambda q, v, t, p: -q, circle)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hhtjax.PrecisionWarning)
        for length in (1.0, 1e-3, 1e-6, 1e3):
            q0 = jnp.array([0.9, -1.2], dtype) * length
            found = hhtjax.consistent_initial(bead, q0, 0 * q0, dtype(length))
            np.testing.assert_allclose(found.q / length, [0.6, -0.8], rtol=4 * np.finfo(dtype).eps)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_gradients_that_are_rounding(size):
    """A bead at rest on a circle, and a crank in the one position in which it cannot push."""
    start = partial(hhtjax.simulate, dt=1e-3, num_steps=1)

    def crank(q, t, length):
        return length * (jnp.sin(q[1:]) - 1)

    one = hhtjax.System(jnp.ones(2), lambda q, v, t, p: 0 * q, circle)
    start(one, hhtjax.hht(), jnp.array([0.0, -size]), jnp.zeros(2), size).check()
    other = hhtjax.System(jnp.ones(2), lambda q, v, t, p: 0 * q, crank)
    with pytest.raises(ValueError, match=r"rows \[0\] have no gradient in q"):
        start(other, hhtjax.hht(), jnp.array([0.0, np.pi / 2]), jnp.zeros(2), size)


@pytest.mark.slow
@pytest.mark.parametrize(("size", "off"), [(1e-6, 5e-3), (1.0, 1e-5)])
def test_velocities_that_violate_the_constraint(size, off):
    """By so much of the mechanism's size in a second, and of the velocity."""
    bead = hhtjax.System(jnp.ones(2), lambda q, v, t, p: 0 * q, circle)

    def start(off):
        q0, v0 = jnp.array([0.0, -size]), jnp.array([0.1 * size, off * size])
        return hhtjax.simulate(bead, hhtjax.hht(), q0, v0, size, dt=1e-3, num_steps=1)

    start(off / 100).check()
    with pytest.raises(ValueError, match=r"`v0` violates the constraint"):
        start(off)
