"""Checks of arguments that every floor makes: they name the caller, the argument, and what was received."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import freeze, is_array, is_concrete, is_real


def require_number(caller, name, value, valid, expectation):
    """The value as it is, if it is a real scalar within its range; a tracer passes unchecked."""
    if not is_real(value) or jnp.ndim(value) != 0:
        large = is_array(value) and jnp.ndim(value) and (jnp.size(value) > 4 or not is_concrete(value))
        shown = f"an array of shape {jnp.shape(value)}" if large else repr(value)
        raise TypeError(f"{caller}: `{name}` must be a real number; received {shown}.")
    if is_concrete(value) and not valid(value):
        raise ValueError(f"{caller}: `{name}` must {expectation}; received {value}.")
    return value


def require_integer(caller, name, value, least=1):
    """The value as a Python integer, if it is one and not less than `least`."""
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
        kind = {0: "an integer, 0 or more", 1: "a positive integer"}.get(least, f"an integer, {least} or more")
        raise ValueError(f"{caller}: `{name}` must be {kind}; received {value!r}.")
    return int(value)


def require_function(caller, name, value, signature, count=None):
    """An error unless `value` can be called, and is hashable, as a static argument of jit has to be.

    count: of its arguments, where another number is likely.
    """
    if not callable(value):
        raise TypeError(f"{caller}: `{name}` must be a function {signature}; received {value!r}.")
    try:
        hash(value)
    except TypeError:
        raise TypeError(
            f"{caller}: `{name}` must be hashable, because it is static under jit; received {value!r}. "
            "Pass arrays through params."
        ) from None
    names = _argument_names(value)
    expected = signature[signature.index("(") + 1 : -1].split(", ")
    if _in_other_order(names, expected) or (count is not None and not _takes(value, count)):
        raise TypeError(
            f"{caller}: `{name}` must be a function {signature}; received one with the arguments ({', '.join(names)})."
        )


def _argument_names(function):
    try:
        return list(inspect.signature(function).parameters)
    except (TypeError, ValueError):  # it does not tell
        return []


def _takes(function, count):
    """Whether a function can be called with so many arguments; True where it does not tell."""
    try:
        inspect.signature(function).bind(*range(count))
    except ValueError:
        return True
    except TypeError:
        return False
    return True


def _in_other_order(names, expected):
    """Whether a time, by its name, is in the place of something else, or q and v change places."""
    names = ["t" if name == "time" else name for name in names[: len(expected)]]
    places = {name: i for i, name in enumerate(names) if name in expected}
    if "t" in places and places["t"] != expected.index("t"):
        return True
    return "q" in places and "v" in places and places["q"] > places["v"]


def require_params(caller, params):
    """The params as data, functions among them hidden; an error that names what is neither: text, objects."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        data = is_array(leaf) or hasattr(leaf, "__jax_array__") or isinstance(leaf, (bool, int, float, complex))
        where = f"{caller}: `params{jax.tree_util.keystr(path)}`"
        if callable(leaf) and not data:
            _require_hashable(where, leaf)
        elif not data or (isinstance(leaf, np.ndarray) and leaf.dtype.kind in "OUSMm"):
            shown = f"an array of {leaf.dtype}" if isinstance(leaf, np.ndarray) else repr(leaf)
            raise TypeError(
                f"{where} must be an array, a number or a function; received {shown}. What is none of them belongs "
                "into the functions of the system."
            )
    return freeze(params)


def _require_hashable(where, function):
    try:
        hash(function)
    except TypeError:
        raise TypeError(
            f"{where} must be hashable, because a function is static under jit; received {function!r}. Make it a "
            "pytree (an equinox.Module, a jax.tree_util.Partial), whose arrays are data."
        ) from None


def describe(x):
    """A pytree in words: path, shape and dtype of each leaf."""
    words = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(x):
        known = hasattr(leaf, "shape") or isinstance(leaf, (int, float, complex))
        what = f"shape {jnp.shape(leaf)} {jnp.result_type(leaf)}" if known else repr(leaf)
        words.append(f"{jax.tree_util.keystr(path)}: {what}" if path else what)
    return ", ".join(words) or "nothing"
