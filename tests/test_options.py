"""The options of the generalised-alpha family: listed once, and found by help(), completion and type checkers."""

import inspect
from pathlib import Path
from typing import get_type_hints

import jedi
import pytest

import hhtjax
from hhtjax.steppers.options import OPTIONS, Keywords, Options
from hhtjax.steppers.residual import hht_coefficients

FAMILY = [hhtjax.hht, hhtjax.newmark, hhtjax.bossak, hhtjax.generalized_alpha]


@pytest.mark.parametrize("make", FAMILY)
def test_each_constructor_shows_the_options_by_name(make):
    shown = inspect.signature(make).parameters
    assert set(OPTIONS) < set(shown)
    assert shown["linearize"].default is None
    assert "held" in str(shown["linearize"].annotation)
    assert all(x.kind is not inspect.Parameter.VAR_KEYWORD for x in shown.values())


@pytest.mark.slow
@pytest.mark.parametrize("make", FAMILY)
def test_an_editor_that_runs_nothing_finds_them(make):
    """jedi, as in editors; a kernel's completion asks `inspect.signature`, which is tested above."""
    line = f"hhtjax.{make.__name__}(li"
    script = jedi.Script(f"import hhtjax\n{line}", project=jedi.Project(Path(hhtjax.__file__).parents[1]))
    assert "linearize=" in {found.name_with_symbols for found in script.complete(2, len(line))}


def test_type_checkers_are_told_the_same():
    assert get_type_hints(Keywords) == get_type_hints(Options)
    assert list(get_type_hints(Keywords)) == OPTIONS


def test_each_option_is_explained():
    for name in OPTIONS:
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
