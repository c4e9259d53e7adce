"""The house: imports run downwards, the machinery has one door, and a file holds one subject."""

import ast
from pathlib import Path

import pytest

import hhtjax.jaxpr
import hhtjax.primitives
import hhtjax.xla

ROOT = Path(__file__).parents[1]
HOUSE = ROOT / "hhtjax"
FLOORS = [  # each imports from those before it, and from its own room
    ["description", "checks"],
    ["primitives"],
    ["jaxpr"],
    ["xla"],
    ["numerics", "trigonometry"],
    ["rotation"],
    ["systems"],
    ["elements"],
    ["bodies"],
    ["steppers"],
    ["runs"],
    ["analysis", "export"],
    ["identification"],
    ["scenes"],
    ["plot"],
    ["__init__"],
]
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
NEIGHBOURS = {("checks", "description")}  # on one floor
INTERNALS = ("jax.extend", "jax.interpreters", "jax._src", "jaxlib")  # of JAX, for the machinery alone
PRIVATE = ("jax._src", "jaxlib")  # for nobody
MACHINERY = {"primitives": hhtjax.primitives, "jaxpr": hhtjax.jaxpr, "xla": hhtjax.xla}  # each with a door
FILES = sorted(HOUSE.rglob("*.py"))
EVERYWHERE = [path for folder in ("hhtjax", "experiments", "tests") for path in sorted((ROOT / folder).rglob("*.py"))]


def room(path):
    return path.relative_to(HOUSE).parts[0].removesuffix(".py")


def imports(tree):
    """Dotted names of all that is imported, anywhere in a file: a.b for `import a.b`, a.b.c for `from a.b import c`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{'.' * node.level}{node.module or ''}.{name.name}" for name in node.names)


def within(name, parents):
    return any(name == parent or name.startswith(f"{parent}.") for parent in parents)


def allowed(here, there):
    """Whether a file of one room may import from another room."""
    return here == there or FLOOR[there] < FLOOR[here] or (here, there) in NEIGHBOURS


def is_at_the_door(there, names):
    """Whether a room of the machinery gives a name itself, and not one of its files."""
    found = MACHINERY[there]
    return len(names) == 1 and not isinstance(getattr(found, names[0], found), type(found))


def breaches(path, tree):
    """What a file imports against the order of the house."""
    here = room(path)
    for name in imports(tree):
        first, *rest = name.split(".")
        if first == "hhtjax":
            there = rest[0] if rest and rest[0] in FLOOR else "__init__"
            if not allowed(here, there):
                yield f"{here} is below {there}: {name}"
            if here not in MACHINERY and there in MACHINERY and not is_at_the_door(there, rest[1:]):
                yield f"past the door of {there}: {name}"
        elif (here not in MACHINERY and within(name, INTERNALS)) or within(name, PRIVATE):
            yield f"inside JAX: {name}"
    for node in ast.walk(tree):
        written = ast.unparse(node) if isinstance(node, ast.Attribute) else ""
        if here not in MACHINERY and (written == "jax.__version__" or within(written, INTERNALS)):
            yield f"inside JAX: {written}"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(HOUSE)))
def test_imports_run_downwards_and_through_the_door(path):
    assert not list(breaches(path, ast.parse(path.read_text())))


@pytest.mark.parametrize(
    ("where", "line"),
    [
        ("description.py", "from hhtjax.checks import require_integer"),
        ("checks.py", "from hhtjax.primitives import staged"),
        ("numerics/new.py", "from hhtjax import rotation"),
        ("rotation.py", "def f():\n    import hhtjax"),
        ("systems/new.py", "from hhtjax.steppers.stepper import State"),
        ("scenes/new.py", "from hhtjax.plot import style"),
        ("identification/new.py", "from hhtjax.plot import fit_overview"),
        ("runs/new.py", "from hhtjax import __version__"),
        ("runs/new.py", "from hhtjax.primitives.kernels import staged"),
        ("runs/new.py", "import hhtjax.primitives.kernels"),
        ("steppers/new.py", "from jax.extend.core import primitives"),
        ("steppers/new.py", "from jax.interpreters import mlir"),
        ("steppers/new.py", "import jax\n\nx = jax.interpreters.mlir.ir"),
        ("analysis/new.py", "import jaxlib"),
        ("runs/new.py", "from hhtjax.xla import lowering"),
        ("primitives/new.py", "from hhtjax.xla.lowering import QUICK"),
        ("jaxpr/new.py", "from hhtjax.xla import Programs"),
        ("xla/new.py", "from jaxlib.mlir import ir"),
        ("xla/new.py", "from jax._src import core"),
        ("analysis/new.py", "import jax\n\nold = jax.__version__ < '0.10'"),
    ],
)
def test_a_breach_is_seen(where, line):
    assert list(breaches(HOUSE / where, ast.parse(line)))


def test_the_top_of_the_house_is_small():
    entries = {path.name for path in HOUSE.iterdir() if path.name != "__pycache__"}
    assert len(entries) <= 20, entries
    assert {name.removesuffix(".py") for name in entries} == FLOOR.keys() | {"py.typed"}


def test_files_hold_one_subject():
    """At most 600 lines; experiments are scripts, and the text of notebooks is comments. Length of functions is free,
    their branches are counted by ruff."""
    large = []
    for path in EVERYWHERE:
        notebook = path.parent.name == "notebooks"
        lines = sum(not (notebook and line.startswith("#")) for line in path.read_text().splitlines())
        if lines > 600:
            large.append(f"{path.relative_to(ROOT)}: {lines} lines")
    assert not large, "\n".join(large)
