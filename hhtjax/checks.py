"""Checks of arguments that every floor makes: they name the caller, the argument, and what was received."""

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import is_concrete, is_real


def require_number(caller, name, value, valid, expectation):
    """The value as it is, if it is a real scalar within its range; a tracer passes unchecked."""
    if not is_real(value) or jnp.ndim(value) != 0:
        raise TypeError(f"{caller}: `{name}` must be a real number; received {value!r}.")
    if is_concrete(value) and not valid(value):
        raise ValueError(f"{caller}: `{name}` must {expectation}; received {value}.")
    return value


def require_integer(caller, name, value, least=1):
    """The value as a Python integer, if it is one and not less than `least`."""
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < least:
        kind = {0: "an integer, 0 or more", 1: "a positive integer"}.get(least, f"an integer, {least} or more")
        raise ValueError(f"{caller}: `{name}` must be {kind}; received {value!r}.")
    return int(value)


def require_function(caller, name, value, signature):
    """An error unless `value` can be called, and is hashable, as a static argument of jit has to be."""
    if not callable(value):
        raise TypeError(f"{caller}: `{name}` must be a function {signature}; received {value!r}.")
    try:
        hash(value)
    except TypeError:
        raise TypeError(
            f"{caller}: `{name}` must be hashable, because it is static under jit; received {value!r}. "
            "Pass arrays through params."
        ) from None


def describe(x):
    """A pytree in words: path, shape and dtype of each leaf."""
    words = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(x):
        known = hasattr(leaf, "shape") or isinstance(leaf, (int, float, complex))
        what = f"shape {jnp.shape(leaf)} {jnp.result_type(leaf)}" if known else repr(leaf)
        words.append(f"{jax.tree_util.keystr(path)}: {what}" if path else what)
    return ", ".join(words) or "nothing"
