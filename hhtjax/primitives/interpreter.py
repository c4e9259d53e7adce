"""Evaluation of traced functions with values other than arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import jax
from jax.core import eval_jaxpr
from jax.extend.core import ClosedJaxpr, Literal, Primitive
from jax.extend.source_info_util import user_context
from jax.interpreters import partial_eval as pe

from hhtjax.description import PyTree, Real

if TYPE_CHECKING:
    from jax.extend.core import Jaxpr, JaxprEqn, Var


def evaluate(jaxpr, values: Sequence, apply: Callable, of_literal: Callable = lambda x: x):
    """The values of a jaxpr's results.

    values: values of its constants and arguments. apply: (operation, values) -> values of its results. of_literal: a
    number in the program -> its value.
    """
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], values, strict=True))

    def read(atom: Literal | Var) -> Real:
        return of_literal(atom.val) if isinstance(atom, Literal) else known[atom]

    for eqn in needed(jaxpr):
        known.update(zip(eqn.outvars, apply(eqn, [read(x) for x in eqn.invars]), strict=True))
    return [read(x) for x in jaxpr.outvars]


def needed(jaxpr):
    """The operations on which the results depend. Others may have no derivative, and must not be evaluated."""
    wanted, found = {x for x in jaxpr.outvars if not isinstance(x, Literal)}, []
    for eqn in reversed(jaxpr.eqns):
        if eqn.effects or not wanted.isdisjoint(eqn.outvars):
            found.append(eqn)
            wanted.update(x for x in eqn.invars if not isinstance(x, Literal))
    return found[::-1]


def alone(eqn: JaxprEqn) -> Callable:
    """One operation of a jaxpr as a function of its arrays, to a list."""

    found = eqn.primitive.get_bind_params(eqn.params)
    functions, params = found if isinstance(found, tuple) else ((), found)  # an older JAX gives functions apart

    def f(*arrays: Real):
        with eqn.ctx.manager, user_context(eqn.source_info.traceback):  # `explain` names the line that it comes from
            results = eqn.primitive.bind(*functions, *arrays, **params)
        return results if eqn.primitive.multiple_results else [results]

    return f


# ----------------------------------------------------------------------------
# A function that is traced once: without what nobody asks for, and with word of what it reads.


class Traced(NamedTuple):
    """A function that has been traced; made by `traced`.

    Attributes:
        jaxpr: the function as a jaxpr.
        constants: the values that it closes over.
        result: shapes and dtypes of its results.
    """

    jaxpr: Jaxpr
    constants: list
    result: PyTree

    def __call__(self, *args):
        found = eval_jaxpr(self.jaxpr, self.constants, *jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(self.result), found)

    def reads(self, needed: list | None):
        """Which arrays in the arguments the needed results depend on: lists of Booleans.

        Args:
            needed: a Boolean for each array in the results; None: all are needed.

        Returns:
            A Boolean for each array in the arguments.

        Raises:
            AssertionError: there are fewer or more results.
        """
        needed = [True] * len(self.jaxpr.outvars) if needed is None else list(needed)
        return pe.dce_jaxpr(self.jaxpr, needed)[1]


def traced(f: Callable, *like: PyTree) -> Traced:
    """Traces f once for arguments like these, and removes operations on which no result depends.

    XLA would remove them too, but not from a stage, and only after they have been traced and lowered. Each operation
    keeps the source line from which it comes. An inlined jit would lose it.

    Args:
        f: a function of pytrees of arrays.
        *like: such pytrees, or tracers of them.

    Returns:
        `Traced`, a function with the same values.

    Raises:
        whatever f raises.

    >>> import jax.numpy as jnp
    >>> f = traced(lambda x, y: {"double": 2 * x, "y": y}, jnp.array(1.0), jnp.array(1.0))
    >>> float(f(jnp.array(3.0), jnp.array(1.0))["double"]), f.reads(None), f.reads([True, False])
    (6.0, [True, True], [True, False])
    """
    trace, result = jax.make_jaxpr(f, return_shape=True)(*like)
    needed, _ = pe.dce_jaxpr(trace.jaxpr, [True] * len(trace.out_avals), instantiate=True)
    return Traced(needed, trace.consts, result)


# ----------------------------------------------------------------------------
# JAX >= 0.12 has operations of a higher kind, such as the search of `jnp.interp`, which become others when derivatives
# and batches have been made. It does so itself, but for what stands in jaxprs that operations of ours hold.


def lowered(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The closed jaxpr without operations of a higher kind: itself where it has none."""
    return getattr(pe, "lower_jaxpr2")(closed) if getattr(closed, "is_high", False) else closed  # noqa: B009


def holds_jaxprs(primitive: Primitive) -> Primitive:
    """The primitive, which has closed jaxprs for parameters, with a rule by which JAX asks for lower ones."""

    def to_lower(*args: Real, **params: PyTree):
        params = {name: lowered(x) if isinstance(x, ClosedJaxpr) else x for name, x in params.items()}
        return primitive.bind(*args, **params)

    primitive.to_lojax = to_lower  # asked of nobody by an older JAX
    return primitive


# ----------------------------------------------------------------------------
# Where in a user's files an operation comes from.


OURS = str(Path(__file__).parents[1])
THEIRS = str(Path(str(jax.__file__)).parent)
# {loop: what has become of it}, while `explain` asks
asked: ContextVar = ContextVar("hhtjax_paths", default=None)


def line_of(eqn: JaxprEqn):
    """ "file.py, line 12, in force" of the innermost function that is neither JAX's nor ours; None where none is."""
    traceback = getattr(eqn.source_info, "traceback", None)
    for frame in getattr(traceback, "frames", ()):
        if not frame.file_name.startswith((OURS, THEIRS, "<")):
            return f"{Path(frame.file_name).name}, line {frame.line_num}, in {frame.function_name}"
    return None
