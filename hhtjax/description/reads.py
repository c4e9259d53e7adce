"""What a function reads from outside, and whether that is still what it was.

JAX keeps a traced function by its identity: a global variable that is bound anew, another value in a closure's cell, or
an array that is changed in place goes unnoticed. `current(f)` gives f itself as long as all that it reads is the same,
and another function that does the same, of another identity, when something differs; so what JAX keeps of f is found
again only where it is still right.

Looked at are cells, globals, defaults, the arguments of partials, attributes of modules, of classes and of objects,
entries of lists and dicts, of f and of all of the user's functions that it can reach. Functions of installed packages
are looked into for what they close over alone. What a `jit` of the user's holds is JAX's affair.
"""

import dis
import sys
import sysconfig
import types
import weakref
from dataclasses import fields, is_dataclass
from functools import lru_cache, partial
from itertools import count
from operator import itemgetter
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
    """What the code of a function, and of those inside it, calls by name: globals that it reads, attributes, and the
    globals and cells that it writes, which are no data."""

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
    """Whether a function, a class or a module is the user's, and of no installed package."""
    if isinstance(x, types.FunctionType):
        return not _is_installed(x.__code__.co_filename)
    module = x if isinstance(x, types.ModuleType) else sys.modules.get(getattr(x, "__module__", None) or "")
    if module is None or getattr(module, "__name__", "") in sys.builtin_module_names:
        return False
    return not _is_installed(getattr(module, "__file__", None) or "")


def _is_fixed(x):
    """Whether it is an installed module, such as jax.numpy, which nobody replaces by another."""
    return isinstance(x, types.ModuleType) and not is_users(x)


class Same:
    """An object as a key, by its identity, which keeps nothing alive."""

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


# ------------------------------------------------------------------------------------- from a value to what it reads


def _globals(f, getter):
    return getter(f.__globals__)


def _cells(f, places):
    return [f.__closure__[i].cell_contents for i in places]


def _defaults(f, _):
    return [*(f.__defaults__ or ()), *(f.__kwdefaults__ or {}).values()]


def _partial(f, _):
    return [f.func, *f.args, *f.keywords, *f.keywords.values()]


def _method(f, _):
    return [f.__func__, f.__self__]


def _attributes(x, names):
    return [vars(x)[name] for name in names]


def _fields(x, names):
    return [getattr(x, name) for name in names]


def _entries(x, _):
    return [*x, *x.values()] if isinstance(x, dict) else list(x)


def _vars(x, _):
    return [*vars(x), *vars(x).values()]


def _property(x, _):
    return [x.fget]


def _inside(x, _):
    return [x.__func__]


class Look:
    """All that a function reads, as a walk from it that can be repeated.

    values: found so far, the function first; steps: (what, i, with which), each appending what it finds at values[i];
    key: the same where programs are.
    """

    def __init__(self, f, unread=()):
        """unread: containers that the function itself changes, such as a list that it appends to."""
        self.unread = unread
        self.values, self.steps, self.arrays, self.contents = [f], [], [], []
        self.key: Any = []
        self._seen, self._kept, self.is_broken = {}, [], False
        i = 0
        while i < min(len(self.values), MOST_VALUES):
            self._visit(i, self.values[i])
            i += 1
        self.key = (*self.key, *map(Same, self.values[i:]))
        self._watch()
        self.ids = list(map(id, self.values))
        del self.values, self._seen

    def still_holds(self, f):
        """Whether f reads now what it did."""
        if not self.steps:
            return True
        try:
            values = self.walk(f)
        except Exception:  # something is of another kind than it was
            return False
        if self.is_broken or list(map(id, values)) != self.ids:
            return False
        return not self.arrays or all(values[i].tobytes() == known for i, known in self.arrays)

    def walk(self, f):
        """All values now."""
        values = [f]
        for step, i, given in self.steps:
            values += step(values[i], given)
        return values

    def may_change(self):
        """Whether there is something that the function itself could change."""
        return bool(self.contents or self.arrays)

    def changeable(self, f):
        """The containers and the arrays, each with what tells what it holds."""
        try:
            values = self.walk(f)
        except Exception:  # something is of another kind than it was
            return []
        entries = [(values[i], partial(_ids_inside, step)) for step, i in self.contents]
        return entries + [(values[i], np.ndarray.tobytes) for i, _ in self.arrays]

    def _step(self, step, i, given=None):
        self.steps.append((step, i, given))
        found = step(self.values[i], given)
        self.values += found
        self.key.append(len(found))
        return found

    def _visit(self, i, x):
        if isinstance(x, PLAIN):
            self.key.append((type(x), repr(x)))
        elif id(x) in self._seen:
            self.key.append(("seen", self._seen[id(x)]))
        else:
            self._seen[id(x)] = len(self._seen)
            self._visit_new(i, x)

    def _visit_new(self, i, x):
        if Same(x) in self.unread:
            self.key.append(Same(x))
        elif isinstance(x, np.ndarray) and x.dtype != object:
            data = x.tobytes()
            self.arrays.append((i, data))
            self.key.append((type(x), x.shape, x.dtype.str, data))
        elif isinstance(x, types.FunctionType):
            self._visit_function(i, x)
        elif isinstance(x, types.MethodType):
            self._step(_method, i)
        elif isinstance(x, partial):
            self._step(_partial, i)
        elif isinstance(x, CONTAINERS):
            self._visit_container(i, x, _entries, not isinstance(x, (tuple, frozenset)))
        elif isinstance(x, property):
            self._step(_property, i)
        elif isinstance(x, (staticmethod, classmethod)):
            self._step(_inside, i)
        elif isinstance(x, (types.ModuleType, jax.Array, JITTED)):
            self.key.append(Same(x))
        elif isinstance(x, type):
            self._visit_class(i, x)
        else:
            self._visit_object(i, x)

    def _visit_function(self, i, f):
        self.key.append(Same(f.__code__))
        if f.__closure__:
            written = names_in(f.__code__).written if is_users(f) else ()
            places = [
                k
                for k, (name, cell) in enumerate(zip(f.__code__.co_freevars, f.__closure__, strict=True))
                if name not in written and _is_filled(cell)
            ]
            self._step(_cells, i, places)
        if f.__defaults__ or f.__kwdefaults__:
            self._step(_defaults, i)
        if vars(f):
            self._visit_container(i, f, _vars, True)
        if not is_users(f):
            return
        names = names_in(f.__code__)
        read = [name for name in names.read if name in f.__globals__ and not _is_fixed(f.__globals__[name])]
        if read:
            getter = itemgetter(*read, read[0])  # of two at least, which is a tuple
            self._visit_attributes(len(self.values), self._step(_globals, i, getter), names.attributes)

    def _visit_attributes(self, first, found, names, depth=3):
        """What may be read of the user's modules among these values, by the names that a function mentions."""
        for i, x in zip(count(first), found):
            if depth and isinstance(x, types.ModuleType) and is_users(x):
                mine = sorted(name for name in names if name in vars(x))
                if mine:
                    self._visit_attributes(len(self.values), self._step(_attributes, i, mine), names, depth - 1)

    def _visit_class(self, i, x):
        self.key.append(Same(x))
        if is_users(x):
            mine = [
                name
                for name, y in vars(x).items()
                if name == "__call__" or not (name.startswith("__") or isinstance(y, types.MemberDescriptorType))
            ]
            self._step(_attributes, i, mine)
            self._step(_fields, i, ["__bases__"])

    def _visit_object(self, i, x):
        kind = type(x)
        if is_dataclass(x):
            self.key.append(Same(kind))
            self._step(_fields, i, [field.name for field in fields(x) if hasattr(x, field.name)])
        elif is_users(kind) and hasattr(x, "__dict__"):
            self.key.append(Same(kind))
            self._visit_container(i, x, _vars, True)
        elif callable(x) and isinstance(getattr(x, "__wrapped__", None), types.FunctionType) and hasattr(x, "__dict__"):
            self._visit_container(i, x, _vars, False)  # such as `jax.custom_jvp`
        else:
            self.key.append(Same(x))
            return
        if is_users(kind):
            self._step(_fields, i, ["__class__"])

    def _visit_container(self, i, x, step, may_change):
        self.key.append(type(x))
        self._step(step, i)
        if may_change:
            self.contents.append((step, i))

    def _watch(self):
        """Ids are compared, and nothing kept alive that could not die for it: who dies breaks the look."""

        me = weakref.ref(self)

        def broken(_):
            if (look := me()) is not None:
                look.is_broken = True

        for x in self.values[1:]:
            if isinstance(x, PLAIN):
                self._kept.append(x)
            elif not isinstance(x, CONTAINERS):  # whose contents are compared
                try:
                    self._kept.append(weakref.ref(x, broken))
                except TypeError:
                    self._kept.append(x)


def _ids_inside(step, x):
    return list(map(id, step(x, None)))


def _is_filled(cell):
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:
        return False
    return True


JITTED = type(jax.jit(_is_filled))
