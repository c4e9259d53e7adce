"""A function of scalars in stages: the operands of its sines, the sines, and the rest.

XLA:CPU fuses an operation with all that it comes from, anew for each of its users: for the sine of a difference, its
cosine, and each column of a derivative that takes them, the difference is formed and the sine called again. What a
staged call gives is computed once; and from a sine and a cosine of the same number, next to each other, LLVM makes one
call.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import Literal

from hhtjax.xla.interpreter import alone, evaluate, needed
from hhtjax.xla.kernels import named
from hhtjax.xla.listing import FUNCTIONS
from hhtjax.xla.parameters import ELEMENTWISE, is_understood


class _Stage(NamedTuple):
    """Part of a jaxpr."""

    invars: Any
    eqns: Any
    outvars: Any
    constvars: Any = ()


def in_stages(name, f, *args):
    """f(*args), as calls of functions of this name."""
    closed = jax.make_jaxpr(f)(*args)
    eqns, results = _each_once(closed.jaxpr)
    known = dict(zip([*closed.jaxpr.constvars, *closed.jaxpr.invars], [*closed.consts, *args], strict=True))
    for wanted in [*_layers(eqns), results]:
        stage = _stage(eqns, known, wanted)
        call = named(name, lambda *x, stage=stage: evaluate(stage, x, lambda eqn, x: alone(eqn)(*x)))
        known.update(zip(stage.outvars, call(*(known[x] for x in stage.invars)), strict=True))
    return [jnp.asarray(x.val) if isinstance(x, Literal) else known[x] for x in results]


def _each_once(jaxpr):
    """The operations of a jaxpr without those on numbers that have been done before, and its results."""
    eqns, done, same = [], {}, {}

    def renamed(atoms):
        return [x if isinstance(x, Literal) else same.get(x, x) for x in atoms]

    for eqn in needed(jaxpr):
        eqn = eqn.replace(invars=renamed(eqn.invars))
        key = eqn
        if eqn.primitive.name in ELEMENTWISE and is_understood(eqn):
            operands = [(repr(x.val), x.aval) if isinstance(x, Literal) else x for x in eqn.invars]
            key = (eqn.primitive, *operands, *eqn.params.items())
        before = done.setdefault(key, eqn)
        if before is eqn:
            eqns.append(eqn)
        same.update(zip(eqn.outvars, before.outvars, strict=True))
    return eqns, renamed(jaxpr.outvars)


def _variables(atoms):
    """Each once, in their order."""
    return list(dict.fromkeys(x for x in atoms if not isinstance(x, Literal)))


def _layers(eqns):
    """What is to be known one after the other: operands of functions, their results, operands of functions of those."""
    depth, layers = {}, {}
    for eqn in eqns:
        d = max((depth.get(x, 0) for x in _variables(eqn.invars)), default=0)
        if eqn.primitive.name in FUNCTIONS or eqn.primitive.name not in ELEMENTWISE:
            layers.setdefault(d, []).append(eqn)
            d += 1
        depth.update(dict.fromkeys(eqn.outvars, d))
    for layer in layers.values():
        operands = _variables(x for eqn in layer for x in eqn.invars)
        yield operands
        layer.sort(key=lambda eqn: [operands.index(x) for x in _variables(eqn.invars)])
        yield _variables(x for eqn in layer for x in eqn.outvars)


def _stage(eqns, known, wanted):
    """From what is known to what is wanted."""
    wanted = [x for x in _variables(wanted) if x not in known]
    missing, needed = set(wanted), []
    for eqn in reversed(eqns):
        if not missing.isdisjoint(eqn.outvars):
            needed.insert(0, eqn)
            missing.update(x for x in _variables(eqn.invars) if x not in known)
    return _Stage([x for x in _variables(x for eqn in needed for x in eqn.invars) if x in known], needed, wanted)
