"""How the loops of a run are compiled."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax

import hhtjax.xla.lowering  # noqa: F401
from hhtjax.description import PyTree, Real
from hhtjax.primitives.interpreter import asked
from hhtjax.xla.first_call import tell_if_long

if TYPE_CHECKING:
    from jax.extend.core import Jaxpr


class Explanation(NamedTuple):
    """Result of `explain`; prints one line for each loop.

    Attributes:
        paths: for each loop over steps "one kernel", or "plain: " followed by the obstacle and its line in your files.
        compile_seconds: time to compile, s.
        temporary_bytes: memory in addition to arguments and results; None if XLA does not report it.
    """

    paths: tuple[str, ...]
    compile_seconds: float
    temporary_bytes: int | None

    def __str__(self):
        lines = [f"loop {i}: {path}" for i, path in enumerate(self.paths, 1)] or ["no loop over steps"]
        memory = "" if self.temporary_bytes is None else f", {self.temporary_bytes / 1e6:.3g} MB of temporaries"
        return "\n".join([*lines, f"compiled in {self.compile_seconds:.2f} s{memory}"])


def explain(f: Callable, *args: Real) -> Explanation:
    """Compiles f(*args), which calls `simulate`, and reports how each of its loops over steps runs.

    On the CPU a loop becomes one kernel if XLA can compile it so. For a small system this is several times faster.
    Otherwise it runs as a list of kernels, as on other platforms; the values differ by rounding. Obstacles to a single
    kernel are:

        LAPACK, which is used for more than 16 unknowns; sort; large products of matrices;
        scatter, `x.at[i].add(y)` or the reverse derivative of `x[i]`, of more than 32 numbers, or in a batch with
        different i;
        callbacks, such as progress=True.

    Inside `hhtjax.plain()`, or with a JAX newer than the tested ones, every path is plain, with this as its reason.

    Args:
        f: any function. Its gradient or vmap has other loops than f itself, so pass `jax.grad(f)` to see those.
        args: pytrees of arrays.

    Returns:
        An `Explanation`.

    Raises:
        whatever compiling f(*args) raises.

    >>> import jax, jax.numpy as jnp, hhtjax
    >>> ball = hhtjax.System(mass=jnp.array([1.0]), force=lambda q, v, t, c: -9.81 - c * v)
    >>> def height(c):
    ...     run = hhtjax.simulate(ball, hhtjax.hht(), jnp.array([9.0]), jnp.array([0.0]), c, dt=0.01, num_steps=50)
    ...     return run.q[-1, 0]
    >>> paths = hhtjax.explain(jax.grad(height), 0.1).paths                     # forward, and back
    >>> set(paths) == {"one kernel"} or paths[0].startswith("plain: JAX")       # too new
    True
    """
    start, paths = time.perf_counter(), {}
    token = asked.set(paths)
    try:
        lowered = jax.jit(lambda *args: f(*args)).lower(*args)  # anew: JAX keeps what it has lowered
    finally:
        asked.reset(token)
    tell_if_long()
    compiled = lowered.compile()
    seconds = time.perf_counter() - start
    memory: Any = compiled.memory_analysis()
    return Explanation(tuple(paths.values()), seconds, None if memory is None else memory.temp_size_in_bytes)


def calls(names, f: Callable, *args: PyTree) -> bool:
    """Whether the trace of f(*args) calls a jitted function with one of these names.

    Args:
        names: names of functions that are compiled by `jax.jit`.
        f: any function.
        args: pytrees of arrays.

    Returns:
        True or False.

    Raises:
        whatever f raises.

    >>> calls({"sine"}, lambda x: jax.vmap(jax.jit(lambda x: x))(x), jax.numpy.ones(2))
    False
    """
    return _calls(names, jax.make_jaxpr(f)(*args).jaxpr, set())


def _calls(names, jaxpr: Jaxpr, seen) -> bool:
    """seen: ids of the jaxprs that have been searched already, because a cached trace may be called often."""
    if id(jaxpr) in seen:
        return False
    seen.add(id(jaxpr))
    inner = []
    for eqn in jaxpr.eqns:
        if eqn.params.get("name") in names:
            return True
        inner += [x for x in jax.tree.leaves(list(eqn.params.values())) if hasattr(x, "eqns")]
    return any(_calls(names, getattr(x, "jaxpr", x), seen) for x in inner)
