"""What a function reads from outside, and whether it has changed.

JAX identifies a traced function by its identity. It does not notice a global variable with a new value, another value
in a closure's cell, or an array that is changed in place. `current(f)` returns f itself as long as everything that it
reads is the same. When something differs it returns another object that does the same. So JAX reuses a program of f
only while it is correct.

The check covers cells, globals, defaults, the arguments of partials, attributes of modules, classes and objects, and
entries of lists and dicts, for f and for all functions of the user that it can reach. For functions of installed
packages only closure variables are checked. Functions inside a `jit` of the user follow JAX's own rule.
"""

import dis
import sys
import sysconfig
import types
import weakref
from collections import Counter
from dataclasses import fields, is_dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

MOST_VALUES = 10_000  # that one function reads; of what lies behind, identity counts
PLAIN = (int, float, complex, str, bytes, type(None), type(Ellipsis), np.generic)
CONTAINERS = (list, tuple, dict, set, frozenset)
INSTALLED = tuple(
    f"{Path(folder)}/"
    for folder in {sysconfig.get_path("stdlib"), sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    | {str(Path(__file__).parents[1])}
)
GLOBAL = {"LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"}
STORED = {"STORE_GLOBAL", "DELETE_GLOBAL", "STORE_DEREF", "DELETE_DEREF"}


class Names(NamedTuple):
    """The names that the code of a function, and of functions inside it, uses: globals and attributes that it reads,
    and the globals and cells that it writes, which are not data."""

    read: tuple
    attributes: frozenset
    written: frozenset


@lru_cache(maxsize=4096)
def names_in(code) -> Names:
    """The `Names` of a code object."""
    read, attributes, written = {}, set(), set()
    for step in dis.get_instructions(code):
        if step.opname in GLOBAL:
            read[step.argval] = None
        elif step.opname in STORED:
            written.add(step.argval)
        elif step.opcode in dis.hasname:
            attributes.add(step.argval)
    written -= set(code.co_cellvars)  # its own
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            names = names_in(inner)
            read |= dict.fromkeys(names.read)
            attributes |= names.attributes
            written |= names.written - set(code.co_cellvars)
    return Names(tuple(name for name in read if name not in written), frozenset(attributes), frozenset(written))


@lru_cache(maxsize=4096)
def _is_installed(path):
    return path.startswith(("<frozen", *INSTALLED))


def is_users(x):
    """Whether a function, a class or a module belongs to the user, and not to an installed package."""
    if isinstance(x, types.FunctionType):
        return not _is_installed(x.__code__.co_filename)
    module = x if isinstance(x, types.ModuleType) else sys.modules.get(getattr(x, "__module__", None) or "")
    if module is None or getattr(module, "__name__", "") in sys.builtin_module_names:
        return False
    return not _is_installed(getattr(module, "__file__", None) or "")


def _is_fixed(x):
    """Whether it is an installed module, such as jax.numpy, which is never replaced."""
    return isinstance(x, types.ModuleType) and not is_users(x)


class Same:
    """An object as a key, by its identity, without keeping it alive."""

    __slots__ = ("hash", "ref")

    def __init__(self, x):
        self.hash = id(x)
        try:
            self.ref: Any = weakref.ref(x)
        except TypeError:
            self.ref = lambda: x

    def __hash__(self):
        return self.hash

    def __eq__(self, other):
        return type(other) is Same and (x := self.ref()) is not None and x is other.ref()


def held(x):
    """The present contents of a container, an object or an array."""
    if isinstance(x, np.ndarray):
        return x.tobytes()
    x = x if isinstance(x, CONTAINERS) else vars(x)
    return list(map(id, _entries(x)))


def _entries(x):
    return [*x, *x.values()] if isinstance(x, dict) else [*x]


@lru_cache(maxsize=4096)
def _reader(suffix):
    return eval(f"lambda x: x{suffix}")


def _no(f):
    return None


class Look:
    """Everything that a function reads, and a program that checks whether it is unchanged.

    Every call of `simulate` makes this check. It is therefore generated as Python code with one line for each value,
    which takes 0.1 us per value; walking over all values takes 0.7.

    holds: returns the things that the function reads and could change itself, and its `arrays`; None if something
    differs. key: equal keys mean that JAX's programs of the function are the same.
    """

    def __init__(self, f, unread=()):
        """unread: containers that the function itself changes, such as a list to which it appends."""
        self.unread = unread
        self.values, self.names, self.lines = [f], ["f"], []
        self.given = set()  # ids of the keywords of partials, of which the function gets copies
        self.space, self.may_change = {}, []  # what the lines know by name; names of what the function may change
        self.arrays = {}  # of floats: name -> id, later number of places at which it is read; and where in key it is
        self.key: Any = []
        self._seen, self._kept = {}, []
        i = 0
        while i < min(len(self.values), MOST_VALUES):
            self._visit(i, self.values[i])
            i += 1
        self.key = (*self.key, *map(Same, self.values[i:]))
        places = Counter(map(id, self.values))
        self.arrays = {name: (places[x], at) for name, (x, at) in self.arrays.items()} if i == len(self.values) else {}
        self.is_empty = not self.lines
        self.holds = self._program()
        self._watch()
        del self.values, self.names, self.lines, self.space, self._seen

    def _program(self):
        """Compiles the lines. A value of another type than before may raise any error, which counts as a difference."""
        changed, arrays = ("".join(f"{name}, " for name in names) for names in (self.may_change, self.arrays))
        body = "".join(f"  {line}\n" for line in [*self.lines, f"return ({changed}), ({arrays})"])
        exec(f"def holds(f):\n try:\n{body} except Exception:\n  return None", self.space)
        return self.space["holds"]

    def _read(self, i, *suffixes):
        """The values inside the one at i: an expression for each."""
        first = len(self.values)
        for n, suffix in enumerate(suffixes, first):
            x = _reader(suffix)(self.values[i])
            self.lines.append(f"if id(x{n} := {self.names[i]}{suffix}) != {id(x)}: return None")
            self.names.append(f"x{n}")
            self.values.append(x)
        self.key.append(suffixes)
        return first

    def _read_entries(self, i, x, suffix="", may_change=True):
        """Everything inside a container; with suffix, inside a container that belongs to the value at i."""
        found, n, name = _entries(x), len(self.lines), self.names[i] + suffix  # an empty one adds no value, but a line
        entries = f"[*{name}, *{name}.values()]" if isinstance(x, dict) else f"[*{name}]"
        self.lines.append(f"if [*map(id, y{n} := {entries})] != known{n}: return None")
        self.space[f"known{n}"] = list(map(id, found))
        self.names += [f"y{n}[{k}]" for k in range(len(found))]
        self.values += found
        self.key += type(x), len(found)
        if may_change:
            self.may_change.append(self.names[i])

    def _visit(self, i, x):
        if isinstance(x, PLAIN):
            self.key.append((type(x), repr(x)))
        elif id(x) in self._seen:
            self.key.append(("seen", self._seen[id(x)]))
        else:
            self._seen[id(x)] = len(self._seen)
            self._visit_new(i, x)

    def _visit_new(self, i, x):
        if isinstance(x, (np.ndarray, jax.Array)) and x.ndim and np.issubdtype(x.dtype, np.floating):
            self.arrays[self.names[i]] = id(x), len(self.key)
        if Same(x) in self.unread:
            self.key.append(Same(x))
        elif isinstance(x, np.ndarray) and x.dtype != object:
            self._visit_array(i, x)
        elif isinstance(x, types.FunctionType):
            self._visit_function(i, x)
        elif isinstance(x, types.MethodType):
            self._read(i, ".__func__", ".__self__")
        elif isinstance(x, partial):
            self._read(i, ".func", ".args", ".keywords")
            self.given.add(id(x.keywords))
        elif isinstance(x, CONTAINERS):
            fixed = isinstance(x, (tuple, frozenset)) or id(x) in self.given
            self._read_entries(i, x, may_change=not fixed)
        elif isinstance(x, property):
            self._read(i, ".fget")
        elif isinstance(x, (staticmethod, classmethod)):
            self._read(i, ".__func__")
        elif isinstance(x, (types.ModuleType, jax.Array, JITTED)):
            self.key.append(Same(x))
        elif isinstance(x, type):
            self._visit_class(i, x)
        else:
            self._visit_object(i, x)

    def _visit_array(self, i, x):
        data = x.tobytes()
        self.key.append((type(x), x.shape, x.dtype.str, data))
        self.space[f"data{i}"] = data
        self.lines.append(f"if {self.names[i]}.tobytes() != data{i}: return None")
        self.may_change.append(self.names[i])

    def _visit_function(self, i, f):
        self.key.append(Same(f.__code__))
        if f.__closure__:
            written = names_in(f.__code__).written if is_users(f) else ()
            cells = enumerate(zip(f.__code__.co_freevars, f.__closure__, strict=True))
            places = [k for k, (name, cell) in cells if name not in written and _is_filled(cell)]
            self._read(i, *(f".__closure__[{k}].cell_contents" for k in places))
        if f.__defaults__:
            self._read(i, ".__defaults__")
        if f.__kwdefaults__:
            self._read(i, ".__kwdefaults__")
        if vars(f):
            self._read_entries(i, vars(f), ".__dict__")
        if is_users(f):
            names = names_in(f.__code__)
            read = [name for name in names.read if name in f.__globals__ and not _is_fixed(f.__globals__[name])]
            self._read_attributes(self._read(i, *(f".__globals__[{name!r}]" for name in read)), names.attributes)

    def _read_attributes(self, first, names, depth=3):
        """The values of the user's modules that may be read, among the latest values, by the names that a function
        mentions."""
        for i in range(first, len(self.values)):
            x = self.values[i]
            if depth and isinstance(x, types.ModuleType) and is_users(x):
                mine = sorted(name for name in names if name in vars(x))
                self._read_attributes(self._read(i, *_in_dict(mine)), names, depth - 1)

    def _visit_class(self, i, x):
        self.key.append(Same(x))
        if is_users(x):
            mine = [
                name
                for name, y in vars(x).items()
                if name == "__call__" or not (name.startswith("__") or isinstance(y, types.MemberDescriptorType))
            ]
            bases = [f".__bases__[{k}]" for k, base in enumerate(x.__bases__) if is_users(base)]
            self._read(i, *_in_dict(mine), *bases)

    def _visit_object(self, i, x):
        kind = type(x)
        self.key.append(Same(kind))
        if is_dataclass(x):
            self._read(i, *(f".{field.name}" for field in fields(x) if hasattr(x, field.name)))
        elif is_users(kind) and hasattr(x, "__dict__"):
            self._read_entries(i, vars(x), ".__dict__")
        elif callable(x) and isinstance(getattr(x, "__wrapped__", None), types.FunctionType) and hasattr(x, "__dict__"):
            self._read_entries(i, vars(x), ".__dict__", may_change=False)  # such as `jax.custom_jvp`
        else:
            self.key.append(Same(x))
            return
        if is_users(kind):
            self._read(i, ".__class__")

    def _watch(self):
        """Ids are compared. Objects are kept alive only if they could die without this; an object that has died makes
        the check fail."""
        me = weakref.ref(self)

        def broken(_):
            if (look := me()) is not None:
                look.holds = _no

        for x in self.values[1:]:
            if isinstance(x, PLAIN):
                self._kept.append(x)
            elif not isinstance(x, CONTAINERS):  # whose contents are compared
                try:
                    self._kept.append(weakref.ref(x, broken))
                except TypeError:
                    self._kept.append(x)


def _in_dict(names):
    return [f".__dict__[{name!r}]" for name in names]


def _is_filled(cell):
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:
        return False
    return True


JITTED = type(jax.jit(_is_filled))
