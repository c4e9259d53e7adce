"""Checks of what the analyses are given."""

import jax.numpy as jnp
import numpy as np

from hhtjax.description import is_array, is_concrete, is_real


def require_real(caller, name, value, valid, expectation):
    """A real scalar or array, of a float dtype, its values checked unless it is a tracer."""
    value = value if is_array(value) else np.asarray(value)
    if not is_real(value):
        raise TypeError(f"{caller}: `{name}` must be real; received {value!r}.")
    if is_concrete(value) and not np.all(valid(np.asarray(value))):
        raise ValueError(f"{caller}: `{name}` must {expectation}; received {value!r}.")
    value = jnp.asarray(value)
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(jnp.result_type(float))


def require_matrix(caller, matrix):
    """A square, finite matrix of real numbers, as a NumPy array."""
    A = np.asarray(matrix)
    if not is_real(A):
        raise TypeError(f"{caller}: `matrix` must be real; received {matrix!r}.")
    if A.ndim != 2 or A.shape[0] != A.shape[1] or not A.size or not np.all(np.isfinite(A)):
        raise ValueError(f"{caller}: `matrix` must be square and finite; received shape {A.shape}: {matrix!r}.")
    return A
