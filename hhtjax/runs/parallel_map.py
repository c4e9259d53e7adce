"""Any function of many members, in chunks: in this process, or by the workers of an executor."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import describe, require_integer
from hhtjax.description import Array, PyTree, all_concrete, current, is_array, is_real
from hhtjax.runs.executors import IN_FLIGHT, RETRIES, Chunks, Work, collected, require_executor, sent
from hhtjax.runs.sweep_inputs import axis_of_each


def parallel_map(
    f: Callable[..., Any],
    *arguments: PyTree,
    executor: Executor | None = None,
    chunk: int,
    in_axes: Any = 0,
    in_flight: int = IN_FLIGHT,
    retries: int = RETRIES,
    progress: bool = False,
) -> PyTree:
    """`jax.vmap(f)(*arguments)`, `chunk` members at a time, by the workers of an executor.

    Workers receive the compiled function's program (`jax.export`), the arrays that members share, and those of a chunk.
    So f may be defined anywhere, also in a notebook. Workers need hhtjax and the same version of JAX, and each compiles
    once. With the same `chunk` and processors of one kind, the values are the same as without an executor, bit by bit.

    Args:
        f: a function of one member's arguments, which JAX can trace; it returns any pytree of arrays. Host callbacks do
            not work on workers: progress=True inside f, and sparse systems, whose equations SciPy solves.
        arguments: pytrees of arrays whose leading axis counts the members; keys of `jax.random` too.
        executor: any `concurrent.futures.Executor`: `ProcessPoolExecutor` with
            mp_context=multiprocessing.get_context("spawn"), Dask's `client.get_executor()`, `MPIPoolExecutor` of
            mpi4py. None: this process.
        chunk: largest number of members in a task. Choose it so that a task takes seconds, since submitting one takes a
            millisecond.
        in_axes: for each argument, or for its branches: 0, or None if members share it.
        in_flight: largest number of tasks submitted and not yet finished; use twice the number of workers.
        retries: how often a failed task is tried again.
        progress: shows a progress bar in one line on stderr.

    Returns:
        The results of f, as arrays of NumPy with the axis of members in front.

    Raises:
        TypeError, ValueError: an argument of a wrong kind; leading axes of unequal lengths; tracers.
        NotImplementedError: f calls back to Python, and there is an executor.
        RuntimeError: members failed (the message has their numbers and the last error), or a worker died, which breaks
            its executor. All results are lost then; `map_to_disk` keeps them.

    >>> import jax.numpy as jnp, hhtjax
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, k: -k * q)
    >>> def end(k):
    ...     return hhtjax.simulate(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), k, dt=0.01, num_steps=100).q[-1, 0]
    >>> with ThreadPoolExecutor(2) as executor:                              # on a farm: client.get_executor()
    ...     found = hhtjax.parallel_map(end, jnp.array([1.0, 4.0, 9.0]), executor=executor, chunk=2)
    >>> print(found.round(2))                                                          # cos(1), cos(2), cos(3)
    [ 0.54 -0.42 -0.99]
    """
    caller = "parallel_map"
    work = work_of(caller, f, arguments, in_axes, chunk)
    hands = require_executor(caller, executor, in_flight, retries, progress)
    return collected(work, hands, progress)


def work_of(caller: str, f: Callable, arguments: tuple, in_axes: Any, chunk: int) -> Work:
    """The `Work` of a function of members; raises errors for wrong arguments."""
    if not callable(f):
        raise TypeError(f"{caller}: `f` must be a function of one member's arguments; received {f!r}.")
    try:
        hash(f)
    except TypeError:
        raise TypeError(
            f"{caller}: `f` must be hashable; received {type(f).__name__}. Pass its data as an argument, with "
            "None in `in_axes`."
        ) from None
    chunk = require_integer(caller, "chunk", chunk)
    if not arguments:
        raise TypeError(f"{caller}: give `arguments` after `f`, arrays with a leading axis; received none.")
    if not all_concrete(arguments):
        raise TypeError(f"{caller}: arguments must not be tracers: call it outside jit, vmap and grad.")
    leaves, structure = jax.tree.flatten(arguments)
    for x in leaves:
        if not (is_real(x) or (is_array(x) and (_is_key(x) or x.dtype.kind in "biufc"))):
            raise TypeError(f"{caller}: `arguments` must be pytrees of arrays and numbers; received {x!r}.")
    mapped = _mapped(caller, arguments, in_axes)
    sizes = {jnp.shape(x)[0] if jnp.ndim(x) else 0 for x, flag in zip(leaves, mapped, strict=True) if flag}
    if len(sizes) != 1 or 0 in sizes:
        raise ValueError(
            f"{caller}: `arguments` must have leading axes of one length, not 0, where `in_axes` is 0; received "
            f"{describe(arguments)}, in_axes={in_axes!r}."
        )
    kinds = tuple(str(jax.random.key_impl(x)) if _is_key(x) else None for x in leaves)
    arrays = [jax.random.key_data(x) if kind else x for x, kind in zip(leaves, kinds, strict=True)]
    shared = [sent(x) for x, flag in zip(arrays, mapped, strict=True) if not flag]
    of_members = [np.asarray(x, jnp.result_type(x)) for x, flag in zip(arrays, mapped, strict=True) if flag]

    def own(members: np.ndarray) -> list:
        return [x[members] for x in of_members]

    return Work(_Mapped(current(f), structure, mapped, kinds), shared, own, Chunks.of(sizes.pop(), chunk), {})


@dataclass(frozen=True)
class _Mapped:
    """f over members, as a function of the arrays that they share, and of the arrays of each.

    kinds: the types of keys of `jax.random`, which are sent as numbers; None for other leaves."""

    f: Callable
    structure: Any
    mapped: tuple
    kinds: tuple

    def __call__(self, shared: list, own: list) -> PyTree:
        rows, parts = zip(self.mapped, self.kinds, strict=True), (iter(shared), iter(own))
        leaves = [_as_given(next(parts[flag]), kind) for flag, kind in rows]
        found = jax.vmap(self._one, [0 if flag else None for flag in self.mapped])(*leaves)
        if any(map(_is_key, jax.tree.leaves(found))):
            raise TypeError("`f` must return arrays of numbers; received keys of jax.random: take their key_data.")
        return found

    def _one(self, *leaves: Array) -> PyTree:
        return self.f(*jax.tree.unflatten(self.structure, leaves))


def _mapped(caller: str, arguments: tuple, in_axes: Any) -> tuple:
    """For each leaf whether it has the axis of members."""
    axes = tuple(in_axes) if isinstance(in_axes, (tuple, list)) else (in_axes,) * len(arguments)
    try:
        flags = axis_of_each(axes, arguments)
    except (ValueError, TypeError):
        flags = [1]
    if not all(axis is None or (type(axis) is int and axis == 0) for axis in flags):
        raise ValueError(
            f"{caller}: `in_axes` must be 0 or None for each argument, or a pytree of these for branches of it; "
            f"received {in_axes!r}."
        )
    return tuple(axis == 0 for axis in flags)


def _as_given(x: Array, kind: str | None) -> Array:
    return x if kind is None else jax.random.wrap_key_data(x, impl=kind)


def _is_key(x: Any) -> bool:
    return is_array(x) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
