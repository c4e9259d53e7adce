"""Observed order of every method, against references by SciPy."""

from functools import partial

import numpy as np
import pytest
from helpers import slope
from zoo import PROBLEMS, STEPPERS

import hhtjax

FAMILIES = {
    "hht(-.05)": partial(hhtjax.hht, alpha=-0.05),
    "hht(-.3)": partial(hhtjax.hht, alpha=-0.3),
    "newmark": hhtjax.newmark,
    "bossak(-.1)": partial(hhtjax.bossak, alpha=-0.1),
    "generalized_alpha(.8)": partial(hhtjax.generalized_alpha, rho_inf=0.8),
}
FORMS = {
    "converged": {"iterations": None, "tolerance": 1e-12},
    **{name: {"linearize": name} for name in ("predictor", "held", "state", "auto")},
    "auto, corrected start": {"linearize": "auto", "start": "corrected"},
}


@pytest.mark.slow
@pytest.mark.parametrize("problem", PROBLEMS)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("family", FAMILIES)
def test_family_is_of_order_two(family, form, problem):
    stepper = FAMILIES[family](**FORMS[form])
    assert stepper.order == 2
    assert slope(problem, stepper) == pytest.approx(2, abs=0.15)


# too smooth a problem to see these: test_rosenbrock.py, test_tableaus.py, test_extrapolated.py
OWN = "rodas5p", "dop853", "extrapolated"


@pytest.mark.parametrize("name", [name for name in STEPPERS if name not in OWN])
def test_stepper_has_the_order_it_states(name):
    assert slope("forced Duffing", STEPPERS[name]) == pytest.approx(STEPPERS[name].order, abs=0.15)


@pytest.mark.parametrize(("alpha", "problem", "order"), [(-0.1, "double pendulum", 1), (0.0, "double pendulum", 2)])
def test_kim_hht_loses_an_order_with_alpha(alpha, problem, order):
    stepper = hhtjax.kim_hht(alpha=alpha)
    assert stepper.order == order
    assert slope(problem, stepper) == pytest.approx(order, abs=0.15)


def test_kim_hht_loses_an_order_with_explicit_time():
    assert slope("forced Duffing", hhtjax.kim_hht(alpha=0.0)) == pytest.approx(1, abs=0.15)


def test_newmark_with_damping_is_of_order_one():
    stepper = hhtjax.newmark(beta=0.3025, gamma=0.6, linearize="predictor")
    assert stepper.order == 1
    assert slope("forced Duffing", stepper) == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize(("start", "order"), [("corrected", 2), ("simple", 1)])
def test_start_decides_the_order_of_the_first_acceleration(start, order):
    """a1 after one step, which w1 = M^-1 Q hides: its error falls with h^2 only from the corrected a0."""
    problem = PROBLEMS["forced Duffing"]
    stepper = hhtjax.hht(alpha=-0.3, iterations=None, start=start)
    fine = hhtjax.rk4()

    def error(dt):
        state = stepper.init(problem.system, problem.q0, problem.v0, problem.params, dt)
        # a approximates the acceleration at t + (alpha_m - alpha_f) h = t + alpha h
        exact = fine.init(problem.system, problem.q0, problem.v0, problem.params, dt)
        exact, _ = fine.step(problem.system, exact, problem.params, stepper.coefficients.alpha_f * -dt)
        return abs(float((state.a - exact.w)[0]))

    assert np.log2(error(2e-2) / error(1e-2)) == pytest.approx(order, abs=0.15)
