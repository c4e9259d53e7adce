"""The options of the generalised-alpha family: listed once, and found by help() and completion."""

import inspect

import pytest

import hhtjax
from hhtjax.steppers.options import Options
from hhtjax.steppers.residual import hht_coefficients

FAMILY = [hhtjax.hht, hhtjax.newmark, hhtjax.bossak, hhtjax.generalized_alpha]


@pytest.mark.parametrize("make", FAMILY)
def test_each_constructor_shows_the_options_by_name(make):
    shown = inspect.signature(make).parameters
    assert set(Options._fields) < set(shown)
    assert shown["linearize"].default is None
    assert "held" in str(shown["linearize"].annotation)
    assert all(x.kind is not inspect.Parameter.VAR_KEYWORD for x in shown.values())


def test_each_option_is_explained():
    for name in Options._fields:
        assert f"\n        {name}: " in inspect.cleandoc(hhtjax.hht.__doc__).replace("\n    ", "\n        ")


@pytest.mark.parametrize("make", FAMILY)
def test_each_constructor_takes_every_option(make):
    options = {"iterations": 2, "linearize": "held", "tolerance": 1e-8, "max_iterations": 7, "start": "simple"}
    options |= {"formulation": "index3", "redundant": "least_squares", "kinematics": "lie", "solve": None}
    assert make(**options).options == Options(**options)
    assert make().options == Options(linearize="auto")


def test_members_of_the_family_meet():
    """HHT, Bossak and Newmark without weights are the trapezoidal rule."""
    trapezoidal = hhtjax.newmark().coefficients
    assert tuple(hht_coefficients(0.0)) == tuple(hhtjax.bossak(alpha=0.0).coefficients) == tuple(trapezoidal)
    assert hht_coefficients(-0.1) == hhtjax.hht(alpha=-0.1).coefficients == (0.0, 0.1, 1.1**2 / 4, 0.6)
