"""A function, traced and written as a list of operations on scalars: arrays of any size taken to pieces.

Rules of `scalar_rules.py` move elements, and tell what is done with them; here are calls, branches, loops, and what
reads an array at an index that is not known. No derivative is taken of the list: what it holds is final.
"""

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.xla.interpreter import alone, evaluate
from hhtjax.xla.listing import Block, Listing, Operation, Scalar, everywhere, pruned
from hhtjax.xla.parameters import UNDERSTOOD, is_understood
from hhtjax.xla.pieces import arranged, each, is_known
from hhtjax.xla.recorder import Recorder, as_operand
from hhtjax.xla.recording_arrays import ARRAYS
from hhtjax.xla.recording_loops import in_loops
from hhtjax.xla.scalar_rules import FOLDS, RULES
from hhtjax.xla.source_lines import line_of

UNKNOWN = "unknown"
MOST = 100_000  # operations: of more, a compiler takes minutes
WRITTEN_OUT = 1000  # operations more than those of a loop
INLINED = {  # a function called: the parameter that holds it
    **{"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr", "checkpoint": "jaxpr"},
    **{"remat2": "jaxpr", "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr"},
    **{"custom_vjp_call_jaxpr": "fun_jaxpr", "hhtjax_family": "jaxpr", "hhtjax_bilinear": "jaxpr"},
}


class NotListed(Exception):
    """An operation that cannot be in the list. name: its; line: of the user's that asked for it, or None."""

    def __init__(self, name, line=None):
        super().__init__(name if line is None else f"{name} ({line})")
        self.name, self.line = name, line


def listed(f, *args) -> Listing:
    """f as a list of operations on scalars, with a scalar for each number of its arguments.

    Args:
        f: a function of pytrees of arrays, to one.
        *args: these; shapes and types matter, values do not.

    Returns:
        A `Listing`; its results are the tree that f returns, with object arrays of operands.

    Raises:
        NotListed: with the name of an operation that it does not know, and where it comes from.

    >>> import jax.numpy as jnp
    >>> found = listed(lambda x: 2 * jnp.sin(x), jnp.ones(3))
    >>> len(found.arguments), found.count()
    (3, (6, 3))
    """
    trace, like = jax.make_jaxpr(f, return_shape=True)(*args)
    recorder = Recorder()
    values = [_fresh(recorder, x.aval) for x in trace.jaxpr.invars]
    with np.errstate(all="ignore"):
        results = [each(as_operand, x) for x in _Listing(recorder).run(trace, values)]
    wanted = {x for value in results for x in value.flat if isinstance(x, Scalar)}
    operations = pruned(recorder.blocks[0].operations, wanted)
    for x in everywhere(operations):
        if x.name == UNKNOWN:
            raise NotListed(x.params["what"], x.params["line"])
    if sum(1 for _ in everywhere(operations)) > MOST:
        raise NotListed(f"more than {MOST} operations")
    return Listing([x for value in values for x in value.flat], operations, jax.tree.structure(like).unflatten(results))


def _fresh(recorder, aval):
    """A new scalar for each element."""
    count = int(np.prod(aval.shape, dtype=int))
    dtype = np.dtype(object if jnp.issubdtype(aval.dtype, jax.dtypes.extended) else aval.dtype)
    return arranged([Scalar(dtype, recorder) for _ in range(count)], aval.shape)


def known_pieces(x):
    """An array of numbers, taken to pieces whatever its size."""
    if jnp.issubdtype(getattr(x, "dtype", float), jax.dtypes.extended):
        raise NotListed("random numbers")
    x = np.asarray(x)
    return arranged(list(x.reshape(-1)), x.shape)


class _Listing:
    """The evaluator of a jaxpr on object arrays."""

    def __init__(self, recorder):
        self.recorder, self.lines = recorder, []

    def run(self, closed, values):
        """The values of the results of a closed jaxpr."""
        jaxpr, constants = getattr(closed, "jaxpr", closed), getattr(closed, "consts", ())
        return evaluate(jaxpr, [*map(known_pieces, constants), *values], self.apply, known_pieces)

    def apply(self, eqn, values):
        """The results of one operation; of one that is not known, results that nobody may need."""
        self.lines.append(line_of(eqn))
        results = self._results(eqn, eqn.primitive.name, values)
        line = self.lines.pop() or next(filter(None, reversed(self.lines)), None)  # a cached trace has forgotten it
        if results is None:
            what = {"what": eqn.primitive.name, "line": line}
            results = [_fresh(self.recorder, x.aval) for x in eqn.outvars]
            self.recorder.append(Operation(UNKNOWN, _flat(values), _flat(results), what))
        if eqn.effects:
            raise NotListed(eqn.primitive.name, line)
        results = [x if isinstance(x, np.ndarray) else arranged([x], ()) for x in results]
        return [each(as_operand, x) for x in results]

    def _results(self, eqn, name, values):
        if name in INLINED:
            return self.run(eqn.params[INLINED[name]], values)
        if name in LOOPS:
            return LOOPS[name](self, eqn, *values)
        if name in ("hhtjax_held", "hhtjax_watch", "optimization_barrier", "device_put"):
            return values
        if name == "hhtjax_values":  # a function that autodiff keeps whole, such as a root
            shapes = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in eqn.invars]
            return self.run(jax.make_jaxpr(eqn.params["f"])(shapes), values)
        if name == "hhtjax_inside":  # functions come in two forms: outside of a kernel LAPACK's
            return [known_pieces(np.bool_(False))]
        known = all(is_known(x) for value in values for x in value.flat)
        if is_understood(eqn) and not known and (found := in_loops(self.recorder, eqn, values)) is not None:
            return found
        if (name not in UNDERSTOOD or is_understood(eqn)) and not (known and any(not x.size for x in values)):
            rule = FOLDS.get(name) or RULES.get(name)
            results = None if rule is None else rule(eqn, *values)
            if results is not None:
                return results
        if known and not eqn.effects and not jnp.issubdtype(eqn.outvars[0].aval.dtype, jax.dtypes.extended):
            arrays = [np.asarray(v.tolist(), x.aval.dtype) for v, x in zip(values, eqn.invars, strict=True)]
            arrays = [x.reshape(v.shape) for x, v in zip(arrays, values, strict=True)]
            with jax.ensure_compile_time_eval():
                return [known_pieces(x) for x in alone(eqn)(*map(jnp.asarray, arrays))]
        return ARRAYS[name](self.recorder, eqn, *values) if name in ARRAYS else None


def _flat(values):
    return [x for value in values for x in value.flat]


def _back(elements, avals):
    """Elements as object arrays of such shapes."""
    elements = iter(elements)
    return [arranged([next(elements) for _ in range(int(np.prod(x.shape, dtype=int)))], x.shape) for x in avals]


def _cond(listing, eqn, which, *values):
    which, branches, recorder = which.item(), eqn.params["branches"], listing.recorder
    if is_known(which):
        return listing.run(branches[min(max(int(which), 0), len(branches) - 1)], values)
    blocks = [recorder.inside(lambda closed=closed: _flat(listing.run(closed, values))) for closed in branches]
    results = [Scalar(x.dtype, recorder) for x in _flat(_fresh(recorder, x.aval) for x in eqn.outvars)]
    recorder.append(Operation("cond", [which], results, blocks=blocks))
    return _back(results, [x.aval for x in eqn.outvars])


def _while(listing, eqn, *values):
    params, recorder = eqn.params, listing.recorder
    if params["cond_jaxpr"].out_avals[0].shape:
        return None
    first = params["cond_nconsts"]
    second = first + params["body_nconsts"]
    carry = [_fresh(recorder, x.aval) for x in eqn.outvars]
    blocks = [
        recorder.inside(lambda: _flat(listing.run(params["cond_jaxpr"], [*values[:first], *carry]))),
        recorder.inside(lambda: _flat(listing.run(params["body_jaxpr"], [*values[first:second], *carry]))),
    ]
    start = [as_operand(x) for x in _flat(values[second:])]
    recorder.append(Operation("while", start, _flat(carry), blocks=blocks))
    return carry


def _scan(listing, eqn, *values):
    """Written out, or a loop, where that is long and reads and makes no rows."""
    params = eqn.params
    first = params["num_consts"]
    second = first + params["num_carry"]
    if second == len(values) and params["num_carry"] == len(eqn.outvars):
        loop = _counted(listing, params, values[:first], values[first:], [x.aval for x in eqn.outvars])
        if loop is not None:
            return loop
    carry, rows = list(values[first:second]), []
    steps = range(params["length"])
    for i in reversed(steps) if params["reverse"] else steps:
        inside = [arranged(list(x[i].flat) if x.ndim > 1 else [x[i]], x.shape[1:]) for x in values[second:]]
        found = listing.run(params["jaxpr"], [*values[:first], *carry, *inside])
        carry, row = found[: len(carry)], found[len(carry) :]
        rows.append(row)
    columns = zip(*(rows[::-1] if params["reverse"] else rows), strict=True)
    return [*carry, *_back(_flat(x for column in columns for x in column), [x.aval for x in eqn.outvars[len(carry) :]])]


def _counted(listing, params, constants, start, avals):
    """The same steps again and again as a `while` that counts them; None where that spares little."""
    recorder, carry = listing.recorder, [_fresh(listing.recorder, x) for x in avals]
    body = recorder.inside(lambda: _flat(listing.run(params["jaxpr"], [*constants, *carry])))
    if (params["length"] - 1) * sum(1 for _ in everywhere(body.operations)) <= WRITTEN_OUT:
        return None
    i, one = Scalar(np.dtype(np.int32), recorder), np.int32(1)
    unfinished = recorder.inside(lambda: [recorder.record("lt", bool, i, np.int32(params["length"]))])
    counted = recorder.inside(lambda: [recorder.record("add", np.int32, i, one)])
    body = Block(body.operations + counted.operations, body.results + counted.results)
    operands = [as_operand(x) for x in _flat(start)] + [np.int32(0)]
    recorder.append(Operation("while", operands, [*_flat(carry), i], blocks=[unfinished, body]))
    return carry


def _custom_linear_solve(listing, eqn, *values):
    lengths = eqn.params["const_lengths"]
    start = lengths.matvec + lengths.vecmat
    constants, b = values[start : start + lengths.solve], values[sum(lengths) :]
    return listing.run(eqn.params["jaxprs"].solve, [*constants, *b])


LOOPS = {"cond": _cond, "while": _while, "scan": _scan, "custom_linear_solve": _custom_linear_solve}
