"""Copies of functions, with copies of the functions that they call, or with other arrays in the place of theirs."""

import types
from collections import Counter
from functools import partial
from typing import Any

from hhtjax.description.reads import is_users, names_in

COPIED = types.FunctionType, types.MethodType, partial


def again(f):
    """The same function as another object, and so are the user's functions that it calls: JAX keeps what a loop or a
    branch makes of a function by its identity, too."""
    if not isinstance(f, COPIED):
        f = types.MethodType(type(f).__call__, f)
    return Copies().of(f)


class _Globals(dict):
    """Those of a function, some of them others."""

    def __init__(self, usual):
        super().__init__({name: usual[name] for name in ("__name__", "__builtins__") if name in usual})
        self.usual = usual

    def __missing__(self, name):
        return self.usual[name]


class Copies:
    """Of functions, as they are made.

    others: by the id of an array, what the copies read in its place; placed: in how many places they do.
    """

    def __init__(self, others=None):
        self.others: Any = others or {}
        self.placed = Counter()
        self.made = {}  # by id: the copy, and the function, which keeps its id

    def of(self, x):
        """The copy of a function, or what stands for an array; anything else as it is."""
        if id(x) in self.others:
            self.placed[id(x)] += 1
            return self.others[id(x)]
        if id(x) in self.made:
            return self.made[id(x)][0]
        if isinstance(x, types.FunctionType):
            return self._of_function(x)
        if isinstance(x, types.MethodType):
            f = self.of(x.__func__)
            return x if f is x.__func__ else types.MethodType(f, x.__self__)
        if isinstance(x, partial):
            return type(x)(self.of(x.func), *map(self.of, x.args), **{k: self.of(y) for k, y in x.keywords.items()})
        return x

    def _differs(self, x):
        return isinstance(x, COPIED) or id(x) in self.others

    def _of_function(self, f):
        code, usual, contents = f.__code__, f.__globals__, _contents(f)
        names, read = names_in(code), []
        if is_users(f):
            writes_globals = names.written - set(code.co_freevars)  # and has to find its own
            read = [] if writes_globals else [x for x in names.read if x in usual and self._differs(usual[x])]
        elif not any(map(self._differs, contents)):
            return f
        space = _Globals(usual) if read else usual
        named = zip(code.co_freevars, contents, strict=True)
        own = [self._differs(x) and name not in names.written for name, x in named]
        cells = [types.CellType() if mine else cell for mine, cell in zip(own, f.__closure__ or (), strict=True)]
        new = types.FunctionType(code, space, f.__name__, f.__defaults__, tuple(cells))
        new.__kwdefaults__, new.__qualname__, new.__module__ = f.__kwdefaults__, f.__qualname__, f.__module__
        new.__dict__.update(f.__dict__)
        self.made[id(f)] = new, f  # before those inside, of which one may call it
        for name in read:
            space[name] = self.of(usual[name])
        for mine, cell, x in zip(own, cells, contents, strict=True):
            if mine:
                cell.cell_contents = self.of(x)
        return new


def _contents(f):
    """Of its cells, None of an empty one."""
    found = []
    for cell in f.__closure__ or ():
        try:
            found.append(cell.cell_contents)
        except ValueError:
            found.append(None)
    return found
