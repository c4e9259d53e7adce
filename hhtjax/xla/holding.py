"""Values of a kernel that several operations use, computed once.

XLA:CPU fuses an operation into all that use it, and evaluates for each of them anew all that it comes from: of the
14,000 operations of a spinning top's gradient it makes 37,000, and LLVM compiles them all. Across a call it fuses
nothing. So what is much to evaluate, and used by several, is handed on by a call that gives it as it is.
"""

from copy import copy

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from hhtjax.xla.consistent import held_p

ONCE = "hhtjax_once"  # name of a function that XLA computes once
LEAST = 40  # operations that are evaluated once more without a call; of fewer, nothing is gained
CALLS = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "checkpoint", "remat2"}
LOOPS = {"cond", "while", "scan", "custom_linear_solve"}
MADE_ONCE = LOOPS | {"dot_general", "hhtjax_held"}  # by XLA in any case
BROADCAST = "broadcast_in_dim"  # handed on before it is one
FREE = {BROADCAST, "convert_element_type", "reshape", "slice", "transpose", "squeeze", "expand_dims", "copy", "split"}


def with_values_held(closed):
    """The closed jaxpr, in which such values are handed on by calls."""
    return ClosedJaxpr(_Holder().held(closed.jaxpr)[0], closed.consts)


class _Holder:
    """Of a jaxpr and of all within it, each once."""

    def __init__(self):
        self.done = {}  # id of a jaxpr: (it, what has become of it, costs of its results, uses of its arguments)

    def held(self, jaxpr):
        if id(jaxpr) not in self.done:
            self.done[id(jaxpr)] = jaxpr, *self._held(jaxpr)
        return self.done[id(jaxpr)][1:]

    def _held(self, jaxpr):
        eqns = [self._inside(eqn) for eqn in jaxpr.eqns]
        uses = {}
        for eqn, _, inner_uses in eqns:
            for i, x in enumerate(eqn.invars):
                if not isinstance(x, Literal):
                    uses[x] = uses.get(x, 0) + (inner_uses[i] if inner_uses else 1)
        for x in jaxpr.outvars:
            if not isinstance(x, Literal):
                uses[x] = uses.get(x, 0) + 1
        new, cost, made = {}, {}, []
        for eqn, costs, _ in eqns:
            if new:
                eqn = eqn.replace(invars=[x if isinstance(x, Literal) else new.get(x, x) for x in eqn.invars])
            name = eqn.primitive.name
            before = sum(cost.get(x, 0) for x in {x for x in eqn.invars if not isinstance(x, Literal)})
            made.append(eqn)
            for i, x in enumerate(eqn.outvars):
                own = 0 if name in MADE_ONCE or costs == "once" else costs[i] if costs else name not in FREE
                taken = 0 if name in MADE_ONCE or costs == "once" else before + own
                if taken and name != BROADCAST and taken * (uses.get(x, 0) - 1) >= LEAST:
                    made.append(_handed_on(eqn, x, new))
                    taken = 0
                    cost[new[x]] = 0
                cost[x] = taken
        outvars = [x if isinstance(x, Literal) else new.get(x, x) for x in jaxpr.outvars]
        after = jaxpr.replace(eqns=made, outvars=outvars)
        return (
            after,
            [0 if isinstance(x, Literal) else cost.get(x, 0) for x in outvars],
            [uses.get(x, 0) for x in jaxpr.invars],
        )

    def _inside(self, eqn):
        """The equation with what is inside done, costs of its results as a call, uses of its arguments."""
        name = eqn.primitive.name
        if name not in CALLS and name not in LOOPS:
            return eqn, None, None
        told = []

        def inner(x):
            if isinstance(x, ClosedJaxpr):
                after, *more = self.held(x.jaxpr)
                told.append(more)
                return ClosedJaxpr(after, x.consts)
            if isinstance(x, Jaxpr):
                after, *more = self.held(x)
                told.append(more)
                return after
            return x

        eqn = eqn.replace(params={key: jax.tree.map(inner, x) for key, x in eqn.params.items()})
        if name in LOOPS:
            return eqn, None, None
        if eqn.params.get("name") == ONCE:
            return eqn, "once", None
        return eqn, *told[0]


def _handed_on(eqn, x, new):
    """An equation that gives x by another name."""
    other = new[x] = copy(x)  # a variable is known by its identity
    return eqn.replace(primitive=held_p, invars=[x], outvars=[other], params={}, effects=frozenset(), ctx=eqn.ctx)
