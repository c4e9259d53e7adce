"""`current`: the form of a function in the programs of JAX: itself, or another object if the data that it reads have
changed."""

import functools
import types
import weakref
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from typing import Any

from hhtjax.description.reads import JITTED, Look, Same, held, is_users, names_in

MOST_STATES = 16  # of what a function reads, for which its programs are found again
KINDS = {"isinstance", "type", "hasattr", "getattr"}
programs = weakref.WeakSet()  # jitted functions of the library: they keep what they compiled, and so what stands for f


def current(f) -> Any:
    """f, as long as everything that it reads from outside is unchanged; otherwise a function that does the same, but is
    not equal to f.

    Call it where a function becomes part of the key under which JAX keeps a program.

    >>> gain = [1.0]
    >>> force = lambda q: gain[0] * q
    >>> before, again = current(force), current(force)
    >>> gain[0] = 2.0
    >>> before is again, current(force) is before, current(force)(3.0)
    (True, False, 6.0)
    """
    entry = _entries.get(id(f))
    if entry is None:
        return _first(f)
    _, known, origin = entry
    return f if known is None else known.current(f if origin is None else origin)


# by the id of a function: weak reference to it, `Known`, None of what reads nothing, and what it stands for
_entries: dict[int, tuple] = {}
_methods: dict[tuple, tuple] = {}  # by those of an object and its function


def _first(f):
    """`current` for a function that has not been seen before."""
    if isinstance(f, types.MethodType):
        return _known_method(f).current(f)
    if isinstance(f, (types.FunctionType, partial)):
        return _enter_first(f)
    if isinstance(f, (JITTED, type, types.BuiltinFunctionType)):
        return f
    if is_dataclass(f) and type(f).__hash__ is not object.__hash__:  # equal ones share programs
        return _with_current_call(_with_current_fields(f))
    if is_users(type(f)) and type(f).__hash__ is object.__hash__:
        return _enter_first(f)
    return f


def _enter_first(f):
    known = Known()
    form = known.current(f)
    _enter(f, None if known.look.is_empty else known)
    return form


def _enter(f, known, origin=None):
    key = id(f)

    def gone(ref):
        if (entry := _entries.get(key)) is not None and entry[0] is ref:
            del _entries[key]

    with suppress(TypeError):  # an object that does not allow it is known for one call
        _entries[key] = weakref.ref(f, gone), known, origin


def _known_method(f):
    """A key from its object and its function, because every access to a method makes a new object."""
    key = id(f.__self__), id(f.__func__)
    if (entry := _methods.get(key)) is not None:
        return entry[1]
    known = Known()
    with suppress(TypeError):
        _methods[key] = weakref.ref(f.__self__, lambda _: _methods.pop(key, None)), known
    return known


def _with_current_fields(f):
    """A dataclass of functions, such as a force from a Lagrangian, with the current form of each."""
    changed = {}
    for field in fields(f):
        x = getattr(f, field.name)
        if callable(x) and (now := current(x)) is not x:
            changed[field.name] = now
    if not changed:
        return f
    new = object.__new__(type(f))
    for name, value in {**vars(f), **changed}.items():
        object.__setattr__(new, name, value)
    return new


def _with_current_call(f):
    """As `_parts`; equal dataclasses are identified by the function of their class."""
    call = type(f).__call__
    if not is_users(type(f)) or not isinstance(call, types.FunctionType) or (now := current(call)) is call:
        return f
    return _Called(now, f)


@dataclass(frozen=True)
class _Called:
    call: Any
    f: Any

    def __call__(self, *args, **keywords):
        return self.call(self.f, *args, **keywords)


class Known:
    """The forms of a function, one for each state of what it reads."""

    def __init__(self):
        self.unread = set()
        self.states = []  # (key, weak reference to what stands for the function, None for itself), the latest last
        self.look: Any = None
        self.kinds = weakref.WeakValueDictionary()  # `Kind`s, by the key without arrays
        self.are_data = True  # arrays, as far as is known

    def current(self, f):
        """The form of f for the present state."""
        if self.look is None or self.look.holds(f) is None:
            return self._found(f)
        form = self.states[-1][1]
        return f if form is None else form() or self._found(f)

    def _form(self, state, f):
        return f if state[1] is None else state[1]()

    def _found(self, f):
        self.look = Look(f, self.unread)
        key, form = self.look.key, None
        alive = [state for state in self.states if self._form(state, f) is not None]
        same = [state for state in alive if state[0] == key]
        if same:
            state, form = same[0], self._form(same[0], f)
        else:
            form = again(f) if self.states else f
            if self.look.may_change:
                form = Reading(form, f, self, self.look)
            if form is not f:
                _enter(form, self, f)
            state = key, None if form is f else weakref.ref(form)
        self.states = [*(x for x in alive if x is not state), state]
        if len(self.states) > MOST_STATES:  # as in a loop over records: JAX would keep the programs of all
            self.states = [state]
            for program in programs:
                program.clear_cache()
        return form

    def ignore(self, changed, form, f):
        """Stops comparing what the function changes itself. form: the form of f that has been called."""
        self.unread |= set(map(Same, changed))
        self.look = Look(f, self.unread)
        self.states = [(self.look.key, weakref.ref(form))]


class Reading:
    """A function that reads lists, dicts or arrays. When it is traced, it notes which of them it changes itself."""

    def __init__(self, form, f, known, look):
        functools.update_wrapper(self, f, updated=())
        self._form, self._f, self._known, self._look = form, f, known, look

    def __call__(self, *args, **keywords):
        read = self._look.holds(self._f)
        before = [(x, held(x)) for x in read[0]] if read else []
        try:
            return self._form(*args, **keywords)
        finally:
            if changed := [x for x, known in before if held(x) != known]:
                self._known.ignore(changed, self, self._f)
                self._look = self._known.look


class Kind:
    """A function for any values of some arrays that it reads, which are data of its programs. Made by `with_data`."""

    def __init__(self, f, known):
        self.f, self.known, self.arrays = f, known, []

    def of(self, arrays):
        """The function that reads these arrays, which may be tracers."""
        return Copies(dict(zip(map(id, self.arrays), arrays, strict=True))).of(self.f)

    def refuse(self):
        """Marks arrays that cannot be traced: they are not data, now and later."""
        self.known.are_data = False


def with_data(f) -> tuple[Kind, list] | None:
    """The form of f, and the float arrays that it reads and that differ from those of its first program, which become
    data. None if there are none: what a function reads stays part of its program as long as nothing changes.

    Everything computed from the data is traced with them. An array therefore stays part of the program if f could reach
    or keep it in another way: through anything but globals, cells and partials, or if f changes what it reads. It also
    stays if a tracer could behave differently from an array: if types are checked.
    """
    current(f)
    known = _entries.get(id(f), (None, None))[1]
    if known is None or known.unread or not known.are_data or (found := known.look.holds(f)) is None:
        return None
    copies = Copies(dict(zip(map(id, found[1]), found[1], strict=True)))
    copies.of(f)
    if any(not KINDS.isdisjoint(names_in(x.__code__).read) for _, x in copies.made.values() if hasattr(x, "__code__")):
        return None
    key, data, before = list(known.look.key), [], known.states[0][0]
    for x, (number, at) in zip(found[1], known.look.arrays.values(), strict=True):
        if copies.placed[id(x)] == number and len(before) == len(key) and before[at] != key[at]:
            data.append(x)
            key[at] = type(x), x.shape, x.dtype.str
    if not data:
        return None
    kind = known.kinds.setdefault(tuple(key), Kind(f, known))
    kind.arrays = data
    return kind, data


# ----------------------------------------------------------------------------
# Copies of functions, with copies of the functions that they call, or with other arrays in the place of theirs.


COPIED = types.FunctionType, types.MethodType, partial


def again(f):
    """The function as a new object, together with new objects for the user's functions that it calls. JAX also keeps
    the bodies of loops and branches by the identity of functions."""
    if not isinstance(f, COPIED):
        f = types.MethodType(type(f).__call__, f)
    return Copies().of(f)


class _Globals(dict):
    """The cells of a function, some of them replaced."""

    def __init__(self, usual):
        super().__init__({name: usual[name] for name in ("__name__", "__builtins__") if name in usual})
        self.usual = usual

    def __missing__(self, name):
        return self.usual[name]


class Copies:
    """Copies of functions, made on demand.

    others: by the id of an array, what the copies read instead; placed: in how many places they do so.
    """

    def __init__(self, others=None):
        self.others: Any = others or {}
        self.placed = Counter()
        self.made = {}  # by id: the copy, and the function, which keeps its id

    def of(self, x):
        """The copy of a function, or the replacement of an array; anything else unchanged."""
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
    """The content of a cell; None if it is empty."""
    found = []
    for cell in f.__closure__ or ():
        try:
            found.append(cell.cell_contents)
        except ValueError:
            found.append(None)
    return found
