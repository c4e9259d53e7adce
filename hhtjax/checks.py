"""Checks of arguments for all folders. Their errors name the caller, the argument, and what was received."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, freeze, is_array, is_concrete, is_real, thaw


def require_number(caller: str, name: str, value, valid: Callable, expectation: str):
    """Returns the value if it is a real scalar within its range; a tracer passes unchecked."""
    if not is_real(value) or getattr(value, "ndim", 0) != 0:
        large = is_array(value) and jnp.ndim(value) and (jnp.size(value) > 4 or not is_concrete(value))
        shown = f"an array of shape {jnp.shape(value)}" if large else repr(value)
        raise TypeError(f"{caller}: `{name}` must be a real number; received {shown}.")
    # a concrete array of JAX inside a jit would make a tracer of every comparison
    if is_concrete(value) and not valid(np.asarray(value)[()]):
        raise ValueError(f"{caller}: `{name}` must {expectation}; received {value}.")
    return value


def require_integer(caller: str, name: str, value, least: int = 1) -> int:
    """Returns the value as a Python integer if it is an integer not less than `least`."""
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
        kind = {0: "an integer, 0 or more", 1: "a positive integer"}.get(least, f"an integer, {least} or more")
        raise ValueError(f"{caller}: `{name}` must be {kind}; received {value!r}.")
    return int(value)


def require_one_of(caller: str, name: str, value, known: tuple):
    """Raises an error unless the value is one of the known values."""
    if value not in known:
        raise ValueError(f"{caller}: `{name}` must be one of {', '.join(map(repr, known))}; received {value!r}.")


def require_function(caller: str, name: str, value, signature: str):
    """Raises an error unless `value` can be called like this, and is hashable, as a static argument of jit must be."""
    if not callable(value):
        raise TypeError(f"{caller}: `{name}` must be a function {signature}; received {value!r}.")
    try:
        hash(value)
    except TypeError:
        raise TypeError(
            f"{caller}: `{name}` must be hashable, because it is static under jit; received {value!r}. "
            "Pass arrays through params."
        ) from None
    expected = signature[signature.index("(") + 1 : -1].split(", ")
    known = _signature(value)
    if known is not None and _in_other_order(list(known.parameters), expected):
        names = ", ".join(known.parameters)
        raise TypeError(
            f"{caller}: `{name}` must be a function {signature}; received one with the arguments ({names})."
        )
    called = _signature(value, follow_wrapped=False)  # a decorator may have filled in some of them
    if expected != ["..."] and called is not None and not _takes(called, len(expected)):
        raise TypeError(f"{caller}: `{name}` is called as {signature}; received a function of {in_words(called)}.")


def positional_names(function):
    """The names of the arguments that can be passed by position; none if the function has no signature."""
    known = _signature(function)
    kinds = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    return [] if known is None else [name for name, x in known.parameters.items() if x.kind in kinds]


def takes(function, count: int) -> bool:
    """Whether a function can be called with `count` arguments; True if it has no signature."""
    called = _signature(function, follow_wrapped=False)
    return called is None or _takes(called, count)


def _signature(function, **options):
    """The signature of a function; None if it has none."""
    try:
        return inspect.signature(function, **options)
    except (TypeError, ValueError):
        return None


def _takes(called, count: int) -> bool:
    """Whether a function of this signature can be called with `count` arguments."""
    try:
        called.bind(*range(count))
    except TypeError:
        return False
    return True


def in_words(called) -> str:
    """The arguments of a signature in words; keyword-only ones are listed separately."""
    named = [name for name, x in called.parameters.items() if x.kind is x.KEYWORD_ONLY]
    first = [name for name in called.parameters if name not in named]
    words = f"{len(first)} positional argument{'s' * (len(first) != 1)} ({', '.join(first)})"
    return words + f" and the keyword{'s' * (len(named) != 1)} {', '.join(named)}" * bool(named)


def _in_other_order(names: list, expected: list) -> bool:
    """Whether the names show a wrong order: a time in another place, or q and v interchanged."""
    names = ["t" if name == "time" else name for name in names[: len(expected)]]
    places = {name: i for i, name in enumerate(names) if name in expected}
    if "t" in places and places["t"] != expected.index("t"):
        return True
    return "q" in places and "v" in places and places["q"] > places["v"]


def require_params(caller: str, params: PyTree):
    """Returns the params as data, with functions in them hidden. Raises an error for leaves that are neither: text,
    objects."""
    if all(map(_is_data, jax.tree.leaves(params))):
        return params
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        where = f"{caller}: `params{jax.tree_util.keystr(path)}`"
        data = _is_data(leaf) or hasattr(leaf, "__jax_array__")
        if callable(leaf) and not data:
            _require_hashable(where, leaf)
        elif not data:
            shown = f"an array of {leaf.dtype}" if isinstance(leaf, np.ndarray) else repr(leaf)
            other = "Put other values into the functions of the system."
            hint = "Write `x.to_numpy()` for a column of pandas." if hasattr(leaf, "to_numpy") else other
            raise TypeError(f"{where} must be an array, a number or a function; received {shown}. {hint}")
    return freeze(params)


def _is_data(leaf) -> bool:
    """Whether a leaf of the params is a number, or an array of them."""
    if isinstance(leaf, np.ndarray):
        return leaf.dtype.kind not in "OUSMm"
    return isinstance(leaf, (bool, int, float, complex)) or is_array(leaf)


def _require_hashable(where: str, function: Callable):
    try:
        hash(function)
    except TypeError:
        raise TypeError(
            f"{where} must be hashable, because a function is static under jit; received {function!r}. Make it a "
            "pytree (an equinox.Module, a jax.tree_util.Partial), so that its arrays are data."
        ) from None


def describe(x):
    """A pytree in words: path, shape and dtype of each leaf."""
    words = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(x):
        known = hasattr(leaf, "shape") or isinstance(leaf, (int, float, complex))
        what = f"shape {jnp.shape(leaf)} {jnp.result_type(leaf)}" if known else repr(leaf)
        words.append(f"{jax.tree_util.keystr(path)}: {what}" if path else what)
    return ", ".join(words) or "nothing"


# ----------------------------------------------------------------------------
# What the functions of a system return: the checks of shapes, structures and dtypes, made while tracing.


def check_matrix(caller: str, name: str, matrix, n: int, dtype: np.dtype, *args: PyTree):
    """Checks a constant matrix, or the result of a function: its shape must fit n, its dtype the state."""
    value = evaluate(caller, name, matrix, *args) if callable(matrix) else matrix
    shapes = [(n, n), (n,)] + [()] * (n == 1)
    if not (hasattr(value, "shape") and value.shape in shapes):
        raise ValueError(
            f"{caller}: `{name}` must give an array of shape ({n}, {n}), or ({n},) for a diagonal; "
            f"received {describe(value)}."
        )
    if callable(matrix):
        check_dtype(caller, name, value, dtype)


def count(caller: str, name: str, function: Callable, most: int | None, dtype: np.dtype, *args: PyTree) -> int:
    """m, for a function that returns (m,); m must not exceed `most`, unless that is None."""
    value = evaluate(caller, name, function, *args)
    if not hasattr(value, "shape") or len(value.shape) != 1 or not 1 <= value.shape[0] <= (most or value.shape[0]):
        sizes = "m >= 1" if most is None else f"1 <= m <= {most}"
        raise ValueError(f"{caller}: `{name}` must return an array (m,) with {sizes}; received {describe(value)}.")
    check_dtype(caller, name, value, dtype)
    return value.shape[0]


def check_like(caller: str, name: str, value, like: PyTree, reference: Array, dtype: np.dtype):
    """Checks what a function returned: its structure, shapes and dtype must fit the state."""
    if jax.tree.structure(value) != jax.tree.structure(reference) or (
        jax.tree.map(jnp.shape, value) != jax.tree.map(jnp.shape, reference)
    ):
        raise ValueError(
            f"{caller}: `{name}` must return a pytree like {like}, {describe(reference)}; received {describe(value)}."
        )
    check_dtype(caller, name, value, dtype)


def check_dtype(caller: str, name: str, value, dtype: np.dtype):
    """Raises an error for leaves whose dtype is not that of the state; integers and Python numbers pass."""
    for leaf in jax.tree.leaves(value):
        found = jnp.result_type(leaf)
        number = jnp.issubdtype(found, jnp.integer) or (leaf.weak_type and jnp.issubdtype(found, jnp.floating))
        if found != dtype and not number:
            raise TypeError(
                f"{caller}: `{name}` returned {found} for a state of {dtype}. Give params, and arrays made "
                f"inside `{name}`, the dtype of q0; or give q0 and v0 the dtype of params."
            )


def evaluate(caller: str, name: str, function, *args: PyTree):
    """Shapes of function(*args); an error that the function raises gets a note with `name`."""
    try:
        return jax.eval_shape(lambda *args: function(*thaw(args)), *freeze(args))
    except Exception as error:
        received = ", ".join(describe(x) for x in args)
        error.add_note(f"{caller}: raised while tracing `{name}` with {len(args)} arguments: {received}.")
        raise


@contextmanager
def telling_of_arguments(caller: str, q0: PyTree, v0: PyTree, params: PyTree):
    """Adds notes to an error of the user's functions about what may be wrong with the arguments."""
    try:
        yield
    except Exception as error:
        for name, tree in (("q0", q0), ("v0", v0), ("params", params)):
            for note in notes_on_lists(caller, name, tree):
                error.add_note(note)
        if isinstance(error, KeyError) and isinstance(params, dict):
            known = ", ".join(sorted(map(repr, params))) or "none"
            error.add_note(f"{caller}: the keys of `params` are {known}; a function of the system asked for {error}.")
        if params is None and isinstance(error, (TypeError, AttributeError)):
            error.add_note(f"{caller}: `params` was left out, so the functions of the system received None.")
        raise


def notes_on_lists(caller: str, name, tree: PyTree):
    """A note on each list or tuple of numbers, which JAX does not take for an array."""

    def is_list(x):
        return type(x) in (list, tuple)

    for path, x in jax.tree_util.tree_leaves_with_path(tree, is_leaf=is_list):
        if is_list(x) and x and all(jnp.ndim(y) == 0 for y in jax.tree.leaves(x)):
            where = f"{name}{jax.tree_util.keystr(path)}"
            yield (
                f"{caller}: `{where}` is a {type(x).__name__} of numbers. JAX treats it as a container of "
                f"{len(x)}, not as an array: if an array is meant, write jnp.array([...])."
            )
