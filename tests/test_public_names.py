"""What users see: names that exist, say what they are, and do not hide one another."""

import importlib
import inspect
import pkgutil
import re
import tomllib
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import get_type_hints

import pytest

import hhtjax

ROOT = Path(__file__).parents[1]
ROOMS = [hhtjax, hhtjax.analysis, hhtjax.identification, hhtjax.interop, hhtjax.rotation, hhtjax.trigonometry]
FUNCTIONS = {
    f"{room.__name__}.{name}": getattr(room, name)
    for room in ROOMS
    for name in room.__all__
    if inspect.isfunction(getattr(room, name))
}


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.__name__)
def test_public_names_exist_once_and_have_a_docstring(room):
    assert len(set(room.__all__)) == len(room.__all__)
    for name in room.__all__:
        assert getattr(room, name).__doc__, name
    shown = {name for name, x in vars(room).items() if not name.startswith("_") and not isinstance(x, ModuleType)}
    if room is hhtjax:  # nothing else to be found by completion
        assert shown <= set(room.__all__)


def test_no_name_hides_a_module():
    """`hhtjax.sweep` is either a function or a module: never one that was the other before an import."""
    modules = {module.name for module in pkgutil.walk_packages(hhtjax.__path__, "hhtjax.")}
    assert not modules & set(FUNCTIONS)
    for name in modules:  # and inside the rooms
        module = importlib.import_module(name)
        for inner in vars(module).values():
            if isinstance(inner, ModuleType) and inner.__name__ in modules:
                parent, _, last = inner.__name__.rpartition(".")
                assert getattr(importlib.import_module(parent), last) is inner, inner.__name__


def test_what_functions_return_is_public():
    """A type that a user holds is found where its function is."""
    for where, function in FUNCTIONS.items():
        result = get_type_hints(function).get("return")
        if inspect.isclass(result) and issubclass(result, tuple) and result is not tuple:
            room = importlib.import_module(where.rpartition(".")[0])
            rooms = [room, hhtjax.identification] if "identification" in function.__module__ else [room]
            assert any(getattr(x, result.__name__, None) is result for x in rooms), (where, result)


FIRST = ["system", "stepper", "q0", "v0", "params"]  # in this order, wherever they occur together


@pytest.mark.parametrize("name", FUNCTIONS)
def test_arguments_of_one_meaning_have_one_name_and_order(name):
    names = list(inspect.signature(FUNCTIONS[name]).parameters)
    assert not {"t_0", "start_time", "h", "step_size", "steps", "parameters", "p", "args"} & set(names) - {"args"}
    if not name.endswith(".windows"):  # there t are the times of the samples
        assert "t" not in names
    found = [x for x in names if x in FIRST]
    assert found == [x for x in FIRST if x in found]


def test_the_version_is_stated_once():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["project"]["dynamic"] == ["version"]
    stated = project["tool"]["hatch"]["version"]["path"].removesuffix("/__init__.py").replace("/", ".")
    assert importlib.import_module(stated).VERSION == hhtjax.__version__ == version("hhtjax")


def test_every_name_in_the_readme_exists():
    names = set(re.findall(r"hhtjax\.([a-zA-Z_0-9]+(?:\.[a-z_]+)?)", (ROOT / "README.md").read_text()))
    assert "simulate" in names
    for name in names:
        x = hhtjax
        for part in name.split("."):
            x = getattr(x, part)


def test_what_has_moved_is_there_for_a_version_with_a_warning():
    from hhtjax.steppers.collocation import collocation

    with pytest.warns(DeprecationWarning, match="hhtjax.collocation is hhtjax.steppers.collocation.collocation"):
        assert hhtjax.collocation is collocation
