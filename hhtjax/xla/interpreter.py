"""A traced function, evaluated anew with other values than arrays."""

from collections.abc import Callable

from jax.extend.core import Literal
from jax.extend.source_info_util import user_context


def evaluate(jaxpr, values, apply, of_literal=lambda x: x):
    """The values of a jaxpr's results.

    values: of its constants and arguments; apply: (operation, values) -> values of its results; of_literal: number in
    the program -> value.
    """
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], values, strict=True))

    def read(atom):
        return of_literal(atom.val) if isinstance(atom, Literal) else known[atom]

    for eqn in needed(jaxpr):
        known.update(zip(eqn.outvars, apply(eqn, [read(x) for x in eqn.invars]), strict=True))
    return [read(x) for x in jaxpr.outvars]


def needed(jaxpr):
    """The operations that the results come from: what nobody asks for may have no derivative."""
    wanted, found = {x for x in jaxpr.outvars if not isinstance(x, Literal)}, []
    for eqn in reversed(jaxpr.eqns):
        if eqn.effects or not wanted.isdisjoint(eqn.outvars):
            found.append(eqn)
            wanted.update(x for x in eqn.invars if not isinstance(x, Literal))
    return found[::-1]


def alone(eqn) -> Callable:
    """One operation of a jaxpr as a function of its arrays, to a list."""

    found = eqn.primitive.get_bind_params(eqn.params)
    functions, params = found if isinstance(found, tuple) else ((), found)  # an older JAX gives functions apart

    def f(*arrays):
        with eqn.ctx.manager, user_context(eqn.source_info.traceback):  # `explain` names the line that it comes from
            results = eqn.primitive.bind(*functions, *arrays, **params)
        return results if eqn.primitive.multiple_results else [results]

    return f
