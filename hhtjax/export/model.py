"""A system and a stepper as two functions of flat lists of numbers, begin and step, with or without derivatives."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_params
from hhtjax.description import Array, PyTree, all_concrete, thaw
from hhtjax.primitives import structural
from hhtjax.steppers.friction_switching import is_settled
from hhtjax.steppers.stepper import (
    INTERNAL,
    Stepper,
    behind_jump,
    entered,
    require_capable,
    require_stepper,
    require_system,
)
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.initial_conditions import initial_values, with_known_rows
from hhtjax.systems.linear_system import require_dense
from hhtjax.systems.sampled import Sampled
from hhtjax.systems.system import AnySystem, FirstOrderSystem

if TYPE_CHECKING:
    from hhtjax.steppers.stepper import Info, State, Stepper
    from hhtjax.systems.flat_system import FlatSystem

# ----------------------------------------------------------------------------
# Names in C for the leaves of a pytree: q["arm"]["angle"] is q_arm_angle, an array of numbers if it has a shape.


RESERVED = {  # keywords of C and C++, and what compilers and the headers that are included define
    *("auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum"),
    *("extern", "float", "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return"),
    *("short", "signed", "sizeof", "static", "struct", "switch", "typedef", "union", "unsigned", "void"),
    *("volatile", "while", "_Alignas", "_Alignof", "_Atomic", "_Bool", "_Complex", "_Generic", "_Imaginary"),
    *("_Noreturn", "_Static_assert", "_Thread_local", "alignas", "alignof", "and", "and_eq", "asm", "bitand", "bitor"),
    *("bool", "catch", "char16_t", "char32_t", "char8_t", "class", "co_await", "co_return", "co_yield", "compl"),
    *("concept", "const_cast", "consteval", "constexpr", "constinit", "decltype", "delete", "dynamic_cast", "explicit"),
    *("export", "false", "friend", "mutable", "namespace", "new", "noexcept", "not", "not_eq", "nullptr", "operator"),
    *("or", "or_eq", "private", "protected", "public", "reinterpret_cast", "requires", "static_assert", "static_cast"),
    *("template", "this", "thread_local", "throw", "true", "try", "typeid", "typename", "typeof", "typeof_unqual"),
    *("using", "virtual", "wchar_t", "xor", "xor_eq", "HUGE_VAL", "INFINITY", "NAN", "NULL", "linux", "unix"),
    *("M_E", "M_LOG2E", "M_LOG10E", "M_LN2", "M_LN10", "M_PI", "M_PI_2", "M_PI_4", "M_1_PI", "M_2_PI", "M_2_SQRTPI"),
    *("M_SQRT2", "M_SQRT1_2", "HUGE_VALF", "HUGE_VALL", "SIZE_MAX", "MATH_ERRNO", "MATH_ERREXCEPT"),
}


class Field(NamedTuple):
    """A member of a struct: its name, and the shape of its numbers."""

    name: str
    shape: tuple

    @property
    def size(self) -> int:
        """Number of entries."""
        return int(np.prod(self.shape, dtype=int))

    def places(self, struct: str):
        """The C expression of each number. struct: the C expression of the struct, with its dot or arrow."""
        return [f"{struct}{self.name}" if self.shape == () else f"{struct}{self.name}[{i}]" for i in range(self.size)]

    def declaration(self, real: str, unit=None) -> str:
        """Its declaration in the struct, with unit, and with shape if it has more than one axis."""
        size = f"[{self.size}]" if self.shape else ""
        shape = f"{' x '.join(map(str, self.shape))}, row by row" if len(self.shape) > 1 else None
        told = "; ".join(filter(None, (shape, unit)))
        return f"    {real} {self.name}{size};{f' /* {told} */' if told else ''}"


def fields(tree: PyTree, prefix: str, alone: str):
    """A field for each leaf of a pytree. alone: name of the field if the pytree is a single leaf."""
    return [
        Field(identifier([prefix, *map(_word, path)]) if path or prefix else alone, np.shape(leaf))
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    ]


def identifier(words: list) -> str:
    """Words, joined, as a name that C allows."""
    text = re.sub(r"\W", "_", "_".join(filter(None, words)), flags=re.ASCII)
    text = text if re.match(r"[A-Za-z]|_(?![A-Z_])", text) else f"p{text}"  # __LINE__ and _Bool are the compiler's
    return f"{text}_" if text in RESERVED else text


def units_of(caller: str, units: dict | None, found: list):
    """{name of a field: its unit}. An entry of `units` also applies to all fields whose names begin with it."""
    units = {} if units is None else units
    if not isinstance(units, dict) or not all(isinstance(x, str) for pair in units.items() for x in pair):
        raise TypeError(f"{caller}: `units` must be a dict of names and texts, as {{'q': 'rad'}}; received {units!r}.")
    if wrong := [text for text in units.values() if re.search(r"[*]/|/[*]|[^ -~\u00a1-\uffff]", text)]:
        raise ValueError(f"{caller}: `units` must fit into a comment of C; received {wrong[0]!r}.")
    told, read = {}, set()
    for name in (field.name for field in found):
        keys = [key for key in units if name == key or name.startswith(f"{key}_")]
        if keys:
            key = max(keys, key=len)
            told[name] = units[key]
            read.update(keys)
    if unknown := [key for key in units if key not in read]:
        names = ", ".join(field.name for field in found)
        raise ValueError(f"{caller}: `units` must name fields among {names}; received {unknown[0]!r}.")
    return told


def distinct(found: list, taken: Sequence = ()):
    """The fields with different names: a number is added to a name that is taken, or that an earlier field has."""
    own, given, result = {field.name for field in found}, set(taken), []
    for field in found:
        numbered = (f"{field.name}_{i}" for i in itertools.count(2))
        free = (name for name in numbered if name not in given | own)
        result.append(field._replace(name=next(free) if field.name in given else field.name))
        given.add(result[-1].name)
    return result


def _word(key) -> str:
    return str(next(getattr(key, name) for name in ("key", "idx", "name") if hasattr(key, name)))


# ----------------------------------------------------------------------------

FLAGS = {  # what failed, in bits
    "NOT_FINITE": "a number of the state is infinite or NaN",
    "NOT_CONVERGED": "Newton's iteration did not converge",
    "DEPENDENT": "a constraint depends on those before it",
    "NOT_SOLVED": "the linear solve left more than its tolerance",
    "FRICTION": "a limit of the dry friction is negative or NaN, or joints switch too often in a step",
}


class Given(NamedTuple):
    """The checked arguments of an export. starts: {name in C: tree} of those of q0, v0, z0 that the system has."""

    caller: str
    system: Any
    stepper: Stepper
    starts: dict
    params: PyTree  # without functions that JAX would not take
    dtype: np.dtype

    def flat(self, t0: Array, params: PyTree) -> FlatSystem:
        """The system on vectors."""
        q0, v0, z0 = (self.starts.get(name) for name in ("q0", "v0", "z0"))
        return flatten(self.caller, self.system, q0, v0, t0, params, z0)[0]


def given(
    caller: str, system: AnySystem, stepper: Stepper, q0: PyTree, v0: PyTree, params: PyTree, z0: PyTree
) -> Given:
    """Checks the arguments of an export."""
    require_system(caller, system)
    require_stepper(caller, stepper)
    q0, v0, z0 = initial_values(caller, system, q0, v0, z0)
    require_capable(caller, system, stepper, q0, v0)
    params = require_params(caller, params)
    require_dense(caller, system, params)
    if system.contact is not None:
        raise NotImplementedError(f"{caller}: `system` has contact, which cannot be exported: leave `contact` out.")
    if system.friction is not None:
        system = with_known_rows(caller, system, q0, v0, 0.0, params, z0)
    if not all_concrete((system, stepper, q0, v0, params, z0)):
        raise TypeError(
            f"{caller}: all arguments must be known numbers, to be written into the code; received tracers."
        )
    starts = {name: x for name, x in (("q0", q0), ("v0", v0), ("z0", z0)) if x is not None}
    return Given(caller, system, stepper, starts, params, jax.tree.leaves(q0)[0].dtype)


class Numbers:
    """The params that may change in C: `fields` of floating numbers with their `values`, and `inputs`.

    Every `sampled` is an input, constant during each step. Integers and booleans are constants.
    """

    def __init__(self, params: PyTree, dtype: np.dtype):
        self.leaves, self.structure = jax.tree.flatten(params, is_leaf=_is_input)
        self.places = [i for i, x in enumerate(self.leaves) if not _is_input(x) and _is_floating(x) and np.size(x)]
        self.input_places = [i for i, x in enumerate(self.leaves) if _is_input(x)]
        kept = self._with(dict.fromkeys(set(range(len(self.leaves))) - set(self.places)))
        self.fields = distinct(fields(kept, "", "params"))
        self.values = [self.leaves[i] for i in self.places]
        with_shapes = {i: np.zeros(self.leaves[i].polynomials.shape[2:]) for i in self.input_places}
        rest = dict.fromkeys(set(range(len(self.leaves))) - set(self.input_places))
        self.inputs = distinct(fields(self._with(with_shapes | rest), "", "u"))
        self.dtype = dtype

    def _with(self, changes: dict):
        return self.structure.unflatten([changes.get(i, x) for i, x in enumerate(self.leaves)])

    def params(self, values: list, u: list):
        """The params with other numbers, and with inputs that have the values u, one array for each input."""
        constant = [self.leaves[i].constant(x) for i, x in zip(self.input_places, u, strict=True)]
        changes = dict(zip([*self.places, *self.input_places], [*values, *constant], strict=True))
        return thaw(self._with(changes))

    def first_inputs(self):
        """The values of the inputs at their first samples."""
        return [self.leaves[i].polynomials[0, 0] for i in self.input_places]


def _is_input(x: PyTree) -> bool:
    return isinstance(x, Sampled)


def _is_floating(x):
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


def begin(made: Given, numbers: Numbers):
    """The function (starts, values, u, t0, dt) -> (state on vectors, flags). The time in the state is set elsewhere."""

    def f(starts: dict, values: list, u: list, t0: Array, dt: Array):
        params = numbers.params(values, u)
        q0, v0, z0 = (starts.get(name) for name in ("q0", "v0", "z0"))
        flat, q, v = flatten(made.caller, made.system, q0, v0, t0, params, z0)
        _, state = entered(made.stepper.astype(q.dtype), flat, q, v, t0, params, dt)
        return _kept(made.stepper, state), _flags(state, None)

    return f


def step(made: Given, numbers: Numbers):
    """The function (state, values, u of the step before, u, dt) -> (state, flags)."""

    def f(state: State, values: list, before: list, u: list, dt: Array):
        old, now = numbers.params(values, before), numbers.params(values, u)
        flat, stepper = made.flat(state.t, now), made.stepper.astype(made.dtype)
        if numbers.inputs:
            state = behind_jump(stepper, flat, state, old, now, dt)
        state, info = stepper.bind(flat, now, dt)(state)
        return _kept(stepper, state), _flags(state, info)

    return f


def _kept(stepper: Stepper, state: State) -> State:
    """The state without memory that only dense output reads, because C has no dense output."""
    return state._replace(memory=None) if stepper.dense_term or stepper.reads_series else state


def _flags(state: State, info: Info | None) -> Array:
    """FLAGS as an integer."""
    found = [~jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in _floats(state)]))]
    converged, row, solved, friction = (None,) * 4
    if info is not None:
        converged, row, solved, friction = info.converged, info.dependent_row, info.solved, info.friction
    rubs = None if friction is None else ~is_settled(friction)  # which `converged` tells too
    stalls = None if converged is None else ~converged if rubs is None else ~converged & ~rubs
    found += [stalls, None if row is None else row >= 0, None if solved is None else ~solved, rubs]
    bits = [jnp.where(x, jnp.int32(2**i), jnp.int32(0)) for i, x in enumerate(found) if x is not None]
    return sum(bits[1:], bits[0])


def _floats(tree: PyTree):
    return [x for x in jax.tree.leaves(tree) if _is_floating(x)]


def with_derivatives(f: Callable, rows: list):
    """The function f with derivatives by some numbers of the params. rows: (leaf, index in it) of each number.

    It has an additional first argument. If f takes a state as its first argument, this is a list of the derivatives
    (rows, ...) of each floating leaf of the state except its time; otherwise it is an empty list. Results: state,
    derivatives, flags.
    """

    def g(tangents: list, first: PyTree, values: list, *rest: PyTree):
        moves = bool(tangents)

        def along(tangent: list, units: list):
            def moved(leaves: list, values: list):
                state, flags = f(_replaced(first, leaves) if moves else first, values, *rest)
                return _floats(state)[1:], (state, flags)

            leaves = _floats(first) if moves else []
            zero = [structural(np.zeros((), leaves[0].dtype))] if moves else []
            _, change, told = jax.jvp(moved, (leaves, values), (zero + tangent, units), has_aux=True)
            return change, told

        units = [_units(value, [j if i == leaf else None for leaf, j in rows]) for i, value in enumerate(values)]
        change, (state, flags) = jax.vmap(along, out_axes=(0, None))(tangents, units)
        fine = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in change]))
        return state, change, flags | jnp.where(fine, jnp.int32(0), jnp.int32(1))

    return g


def _units(value: Array, places: list) -> Array:
    """For each place the unit vector, in the shape of `value`; zeros if the place is None."""
    found = np.zeros((len(places), np.size(value)), jnp.result_type(value))
    for row, place in zip(found, places, strict=True):
        row[[] if place is None else [place]] = 1
    return structural(found.reshape(-1, *np.shape(value)))


def _replaced(tree: PyTree, floats) -> State:
    floats, (leaves, structure) = iter(floats), jax.tree.flatten(tree)
    return structure.unflatten([next(floats) if _is_floating(x) else x for x in leaves])


class Layout(NamedTuple):
    """The fields of a state in C, and for each leaf of the state the fields that hold it."""

    fields: list
    leaves: list

    @classmethod
    def of(cls, made: Given, state: State) -> Layout:
        """The layout of a state. state: on vectors, or its shapes."""
        first_order = isinstance(made.system, FirstOrderSystem)
        trees = dict(made.starts)
        q, v, z = trees.get("q0"), trees.get("v0"), trees.get("z0")
        names = {"q": [("q", q)], "v": [("v", v)], "w": [("w", v)], "a": [("a", v)]}
        if first_order:  # q is y, and v is y'
            names = {"q": [], "v": [("q", q)], "w": [("v", q)], "a": [("a", q)]}
        for name, inner in INTERNAL.items():
            names[name] = names[name] + ([(inner, z)] if z is not None else [])
        leaves = []
        for path, leaf in jax.tree_util.tree_leaves_with_path(state):
            name = path[0].name
            if name in names and len(path) == 1:
                leaves.append([field for prefix, tree in names[name] for field in fields(tree, prefix, prefix)])
            else:
                leaves.append(fields(leaf, "_".join([name, *map(_word, path[1:])]), name))
        found = distinct([field for leaf in leaves for field in leaf])
        own = iter(found)
        return cls(found, [[next(own) for _ in leaf] for leaf in leaves])

    def places(self, struct: str):
        """The C expression of every number of the state, leaf by leaf."""
        return [[place for field in leaf for place in field.places(struct)] for leaf in self.leaves]


def derivative_field(field: Field, name: str) -> Field:
    """The field of the derivative of a field by a number of the params."""
    return Field(f"d{field.name}_d{name}", field.shape)
