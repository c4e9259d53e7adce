"""What the functions of a system return: the checks of shapes, structures and dtypes, made while tracing."""

from contextlib import contextmanager

import jax
import jax.numpy as jnp

from hhtjax.checks import describe
from hhtjax.description import freeze, thaw


def check_matrix(caller, name, matrix, n, dtype, *args):
    """A constant matrix, or the result of a function, of a shape that fits n and a dtype that fits the state."""
    value = evaluate(caller, name, matrix, *args) if callable(matrix) else matrix
    shapes = [(n, n), (n,)] + [()] * (n == 1)
    if not (hasattr(value, "shape") and value.shape in shapes):
        raise ValueError(
            f"{caller}: `{name}` must give an array of shape ({n}, {n}), or ({n},) for a diagonal; "
            f"received {describe(value)}."
        )
    if callable(matrix):
        check_dtype(caller, name, value, dtype)


def count(caller, name, function, most, dtype, *args):
    """m, for a function that returns (m,) with m <= most."""
    value = evaluate(caller, name, function, *args)
    if not hasattr(value, "shape") or len(value.shape) != 1 or not 1 <= value.shape[0] <= most:
        raise ValueError(
            f"{caller}: `{name}` must return an array (m,) with 1 <= m <= {most}; received {describe(value)}."
        )
    check_dtype(caller, name, value, dtype)
    return value.shape[0]


def check_like(caller, name, value, like, reference, dtype):
    """What a function returned, of the structure, the shapes and a dtype that fit the state."""
    if jax.tree.structure(value) != jax.tree.structure(reference) or (
        jax.tree.map(jnp.shape, value) != jax.tree.map(jnp.shape, reference)
    ):
        raise ValueError(
            f"{caller}: `{name}` must return a pytree like {like}, {describe(reference)}; received {describe(value)}."
        )
    check_dtype(caller, name, value, dtype)


def check_dtype(caller, name, value, dtype):
    """An error for leaves of another dtype than that of the state; integers and Python numbers pass."""
    for leaf in jax.tree.leaves(value):
        found = jnp.result_type(leaf)
        number = jnp.issubdtype(found, jnp.integer) or (leaf.weak_type and jnp.issubdtype(found, jnp.floating))
        if found != dtype and not number:
            raise TypeError(
                f"{caller}: `{name}` returned {found} for a state of {dtype}; give params, and arrays made "
                f"inside `{name}`, the dtype of q0, or q0 and v0 the dtype of params."
            )


def evaluate(caller, name, function, *args):
    """Shape of function(*args); `name` is added to what the function raises."""
    try:
        return jax.eval_shape(lambda *args: function(*thaw(args)), *freeze(args))
    except Exception as error:
        received = ", ".join(describe(x) for x in args)
        error.add_note(f"{caller}: raised while tracing `{name}` with {len(args)} arguments: {received}.")
        raise


@contextmanager
def telling_of_arguments(caller, q0, v0, params):
    """Adds to an error of the user's functions, or of what they return, what may be wrong with the arguments."""
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
            error.add_note(f"{caller}: `params` was left out, so that the functions of the system received None.")
        raise


def notes_on_lists(caller, name, tree):
    """A note on each list or tuple of numbers, which is no array to JAX."""

    def is_list(x):
        return type(x) in (list, tuple)

    for path, x in jax.tree_util.tree_leaves_with_path(tree, is_leaf=is_list):
        if is_list(x) and x and all(jnp.ndim(y) == 0 for y in jax.tree.leaves(x)):
            where = f"{name}{jax.tree_util.keystr(path)}"
            yield (
                f"{caller}: `{where}` is a {type(x).__name__} of numbers, which to JAX is no array but a container of "
                f"{len(x)}: if an array is meant, write jnp.array([...])."
            )
