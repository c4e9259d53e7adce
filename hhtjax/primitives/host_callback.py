"""A function of NumPy arrays inside a program, like `jax.pure_callback`, but without copies of its arguments.

The copies would take longer than many solves. With 1e5 numbers a call costs 0.3 ms here and 1 ms by
`jax.pure_callback`; with 300 numbers, some 10 and 300 microseconds.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

from hhtjax.description import Array, PyTree, Real
from hhtjax.primitives.compat import is_on
from hhtjax.primitives.two_mode_derivative import batch_size


def on_host(f: Callable, like: PyTree, *args: Real) -> Array:
    """f(*args), an array like `like`, computed by a function f of NumPy arrays whenever the program gets there.

    A batch is passed to f as a whole. Then every argument has a leading axis, of length 1 if it is not batched, and the
    result has one too. There are no derivatives.

    Args:
        f: a function of NumPy arrays. It may be called more often than needed, or not at all.
        like: a `jax.ShapeDtypeStruct` of the result.
        *args: arrays.

    Returns:
        The result of f, as an array.

    Raises:
        jax.errors.JaxRuntimeError: f raises.

    >>> x = jnp.ones(3)
    >>> float(jax.jit(lambda x: on_host(lambda x: np.cumsum(x, axis=-1), x, x))(x)[-1])
    3.0
    """
    if not is_on():
        return jax.pure_callback(f, jax.ShapeDtypeStruct(like.shape, like.dtype), *args, vmap_method="expand_dims")
    return host_p.bind(*args, f=f, shape=tuple(like.shape), dtype=np.dtype(like.dtype))


def _call(*args: np.ndarray, f: Callable, shape: tuple, dtype: np.dtype) -> np.ndarray:
    found = np.asarray(f(*map(np.asarray, args)), dtype)
    assert found.shape == shape, (found.shape, shape)
    return found


def _lower(ctx, *args, **params: PyTree):
    found, _, _ = mlir.emit_python_callback(
        ctx, lambda *x: (_call(*x, **params),), None, list(args), ctx.avals_in, ctx.avals_out, has_side_effect=False
    )
    return found


def _batch(args, axes, f, shape, dtype):
    size = batch_size(args, axes)
    args = [x[None] if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(args, axes, strict=True)]
    return host_p.bind(*args, f=f, shape=(size, *shape), dtype=dtype), 0


host_p = Primitive("hhtjax_host")
host_p.def_impl(lambda *args, **params: jax.jit(partial(host_p.bind, **params))(*args))
host_p.def_abstract_eval(lambda *args, f, shape, dtype: ShapedArray(shape, dtype))
batching.primitive_batchers[host_p] = _batch
mlir.register_lowering(host_p, _lower)
