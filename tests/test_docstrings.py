"""Every public name says what it takes, returns and raises, shows an example, and is in the documentation."""

import importlib
import inspect
import pkgutil
import re
from pathlib import Path
from types import ModuleType

import pytest

import hhtjax
from hhtjax.scenes import InternalScene, Scene

ROOT = Path(__file__).parents[1]
TOP = {name: x for name in hhtjax.__all__ if isinstance(x := getattr(hhtjax, name), ModuleType)}
TOP |= {x.name: importlib.import_module(f"hhtjax.{x.name}") for x in pkgutil.iter_modules(hhtjax.__path__)}
ROOMS = {"hhtjax": hhtjax} | {f"hhtjax.{name}": x for name, x in TOP.items() if hasattr(x, "__all__")}
PAGES = "\n".join(path.read_text() for path in sorted((ROOT / "docs" / "api").glob("*.rst")))
CONSTRUCTED = ("System", "LinearSystem", "FirstOrderSystem", "Gaussian")  # classes that a user calls
SECTION = re.compile(r"^(Args|Attributes|Returns|Raises):(.*(?:\n(?:    .*|$))*)", re.MULTILINE)
NAMED = re.compile(r"(?:^|(?<=\. )|(?<=; ))(\*{0,2}\w+(?:, \*{0,2}\w+)*):", re.MULTILINE)
ELSEWHERE = re.compile(r"(?:those of|as in|as for|as) `([\w.]+)`")


def scenes():
    """Functions that return a scene."""
    for name, module in vars(hhtjax.scenes).items():
        for inner, x in vars(module).items() if isinstance(module, ModuleType) else ():
            if inspect.isfunction(x) and inspect.signature(x).return_annotation in (Scene, InternalScene):
                yield f"hhtjax.scenes.{name}.{inner}", x


PUBLIC = {
    f"{where}.{name}": getattr(room, name)
    for where, room in ROOMS.items()
    for name in room.__all__
    if not isinstance(getattr(room, name), ModuleType)
} | dict(scenes())
CALLED = {
    name: x
    for name, x in PUBLIC.items()
    if (callable(x) and not inspect.isclass(x)) or name.rpartition(".")[2] in CONSTRUCTED
}
PUBLIC |= {"hhtjax.scenes.Scene": Scene, "hhtjax.scenes.InternalScene": InternalScene}
TUPLES = {name: x for name, x in PUBLIC.items() if inspect.isclass(x) and issubclass(x, tuple)}
METHODS = {
    f"{name}.{inner}": getattr(x, inner)
    for name, x in PUBLIC.items()
    if inspect.isclass(x)
    for inner, method in vars(x).items()
    if inner[0] != "_" and isinstance(method, (type(len), type(scenes), classmethod, property))
}


def sections(x):
    return {name: inspect.cleandoc(text) for name, text in SECTION.findall(inspect.getdoc(x) or "")}


def described(x, section="Args"):
    """Names of arguments that a docstring describes, itself or in the place that it refers to."""
    text = sections(x).get(section, "")
    found = {name.lstrip("*") for names in NAMED.findall(text) for name in names.split(", ")}
    for other in ELSEWHERE.findall(text):
        room, _, name = other.rpartition(".")
        candidates = [y for full, y in PUBLIC.items() if full.endswith(f".{name}") and room in full]
        found |= set().union(*(described(y, section) for y in candidates if y is not x))
    return found


@pytest.mark.parametrize("name", CALLED)
def test_what_is_called_says_what_it_takes_and_shows_an_example(name):
    x, is_scene = CALLED[name], name.startswith("hhtjax.scenes.")  # scenes are examples themselves
    assert is_scene or ">>> " in inspect.getdoc(x), "no example"
    arguments = [
        p.name for p in inspect.signature(x).parameters.values() if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    ]
    if not arguments:
        return
    found = sections(x)
    needed = {"Args"} if is_scene else {"Raises"} if inspect.isclass(x) else {"Args", "Returns", "Raises"}
    assert needed <= found.keys()
    assert not set(arguments) - (described(x) | described(x, "Attributes")), "arguments without a word"


@pytest.mark.parametrize("name", TUPLES)
def test_every_field_of_what_is_returned_is_described(name):
    x = TUPLES[name]
    assert set(x._fields) <= described(x, "Attributes")


@pytest.mark.parametrize("name", METHODS)
def test_methods_have_a_docstring(name):
    assert METHODS[name].__doc__


@pytest.mark.parametrize("name", PUBLIC)
def test_the_documentation_has_every_public_name(name):
    if name == "hhtjax.__version__":
        return
    room, _, short = name.rpartition(".")
    if PUBLIC.get(f"hhtjax.{short}") is PUBLIC[name]:  # documented at the top
        room, name = "hhtjax", f"hhtjax.{short}"
    if room.startswith("hhtjax.scenes."):
        pattern = rf"automodule:: {re.escape(room)}\n   :members: .*\b{short}\b"
    else:
        pattern = rf"auto[a-z]+:: {re.escape(name)}\n"
    assert re.search(pattern, PAGES)


@pytest.mark.parametrize("name", ["systems", "steppers", "runs", "scenes", *(x.removeprefix("hhtjax.") for x in ROOMS)])
def test_the_guide_of_every_room_is_in_the_documentation(name):
    room = TOP.get(name, hhtjax)
    assert f".. automodule:: {room.__name__}\n" in PAGES
    assert len(room.__doc__) > 300
