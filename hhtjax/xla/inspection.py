"""What a function holds that cannot be part of one kernel, and what in it is to be changed first."""

from jaxlib.mlir import ir

from hhtjax.xla.kernels import STAGED, inside_p
from hhtjax.xla.products import is_small_product, is_small_sum, is_to_write_out
from hhtjax.xla.scatters import is_of_few_windows
from hhtjax.xla.source_lines import asked, line_in

ATTRIBUTES = "mhlo.frontend_attributes"

# operations the emitter knows, whatever their size
PROVEN = {
    *("abs", "add", "and", "atan2", "bitcast_convert", "broadcast_in_dim", "case", "ceil", "clamp", "compare"),
    *("concatenate", "constant", "convert", "cosine", "divide", "dynamic_slice", "dynamic_update_slice", "exponential"),
    "exponential_minus_one",
    *("floor", "gather", "if", "iota", "is_finite", "log", "log_plus_one", "logistic", "maximum", "minimum"),
    *("multiply", "negate", "not", "optimization_barrier", "or", "pad", "power", "remainder", "reshape", "return"),
    *("reverse", "round_nearest_afz", "round_nearest_even", "rsqrt", "select"),
    *("shift_left", "shift_right_logical", "sign", "sine", "slice", "sqrt"),  # in sines, and random numbers
    *("subtract", "tan", "tanh", "transpose", "while", "xor"),
}
# those it should know: a kernel that holds one is compiled on trial
KNOWN = {
    *("cbrt", "complex", "count_leading_zeros", "imag", "popcnt", "real", "shift_right_arithmetic"),
}
# in other dialects; those of CHLO become elementwise operations, but for top_k, a sort
ELSEWHERE = {
    "chlo": {
        *("acos", "acosh", "asin", "asinh", "atan", "atanh", "bessel_i1e", "cosh", "digamma", "erf", "erf_inv"),
        *("erfc", "lgamma", "next_after", "sinh", "square", "zeta"),
    },
    "func": {"func", "return"},
}
IDLE = {"stablehlo.return", "stablehlo.constant", "stablehlo.broadcast_in_dim"}
MANY = 4  # values of a conditional: of fewer, a loop is no better
# those it knows if they are small
CHECKS = {"dot_general": is_small_product, "reduce": is_small_sum, "reduce_window": is_small_sum}
PROVEN_TYPES = {"f32", "f64", "i1", "i32", "i64", "ui32", "ui64"}
# of more, compiling takes long, or fails: LLVM takes 20 s for a gradient of 12,500, as long as for its list of kernels
MOST_OPERATIONS = 15_000
MOST_IN_BRANCH = 12_500  # of more in one branch, minutes; of 10,000 some 3 s more, for runs up to 10 times as fast
MOST_IN_BRANCHES = 15_000  # of all together, minutes too


class Inspection:
    """Looks through a function and all it calls.

    objection: the first thing that cannot be in one kernel, in words, or None; line: of the user's, where it is, while
    `explain` asks; is_proven: all else is known to compile; finished: names of the functions, each after those that it
    calls; stages: {name of a staged function: its calls}; products, scatters: to be written out; choices: between two
    forms of a function; seldom: conditionals with nothing to do in one branch.
    """

    def __init__(self, functions, call, is_partitioned=False):
        self.functions = functions
        self.seen, self.finished = set(), []
        self.operations = self.in_branches = 0
        self.most = MOST_OPERATIONS
        self.stages, self.products, self.scatters, self.choices, self.seldom = {}, [], [], [], []
        self.is_proven, self.types = True, set()
        self.line = None
        self.objection = "partitioned over devices; shard_map leaves each its own kernel" if is_partitioned else None
        self.look(call)
        named = {str(x.element_type) for x in self.types if isinstance(x, ir.RankedTensorType)}
        self.is_proven &= named <= PROVEN_TYPES

    def look(self, op):
        """Notes what `op` is, and looks into it."""
        none_before = self.objection is None
        self._look(op)
        if none_before and self.objection and self.line is None and asked.get() is not None:
            self.line = line_in(op.location)  # of the innermost operation that knows

    def _look(self, op):
        self.operations += 1
        if self.operations > self.most:
            self.object(f"more than {self.most} operations", "")
        dialect, _, name = op.name.partition(".")
        if op.name == "func.call":
            self._look_into_call(op)
        elif is_choice(op):
            self.choices.append(op)
            self._look_at_all(form_inside(op))
        elif name == "custom_call":
            self.look_into_custom_call(op)
        elif name == "dot_general" and is_to_write_out(op):
            self.products.append(op)
        elif name == "scatter" and is_of_few_windows(op):
            self.scatters.append(op)
            self._note_types(op)
        elif dialect == "stablehlo" and name in CHECKS:  # what it holds is scalar
            if not CHECKS[name](op):
                self.object(f"{name} of {' and '.join(str(x.type) for x in op.operands)}")
            self._note_types(op)
        elif _is_known(dialect, name):
            self.is_proven &= name not in KNOWN
            self._note_types(op)
            if name in ("case", "if"):
                self._look_into_branches(op)
                if has_idle_branch(op):
                    self.seldom.append(op)
            else:
                self._look_at_all(directly_in(op))
        else:
            self.object(op.name)

    def _look_into_call(self, op):
        if callee(op).startswith(STAGED):
            self.stages.setdefault(callee(op), []).append(op)
        if callee(op) not in self.seen:
            self.seen.add(callee(op))
            self.look(self.functions[callee(op)].operation)
            self.finished.append(callee(op))

    def look_into_custom_call(self, op):
        self.object(ir.StringAttr(op.attributes["call_target_name"]).value)

    def _look_into_branches(self, op):
        """Counted apart, each and together: what is seldom taken, as at events, may be longer than all the rest."""
        around, self.most = (self.operations, self.most), min(self.most, MOST_IN_BRANCH)
        for region in op.regions:
            self.operations = 0
            self._look_at_all(x.operation for block in region for x in block)
            self.in_branches += self.operations
        self.operations, self.most = around
        if self.in_branches > MOST_IN_BRANCHES:
            self.object(f"more than {MOST_IN_BRANCHES} operations in branches", "")

    def _look_at_all(self, operations):
        for op in operations:
            self.look(op)

    def _note_types(self, op):
        """Of its results and operands, to be named once each: a type's text takes longer to write than all the rest."""
        self.types.update(x.type for x in (*op.operands, *op.results))

    def object(self, why, line=None):
        """Keeps the first reason; line: "" of what is of no single operation."""
        if self.objection is None:
            self.objection, self.line = why, line


def _is_known(dialect, name):
    return name in PROVEN or name in KNOWN if dialect == "stablehlo" else name in ELSEWHERE.get(dialect, ())


def directly_in(op):
    """The operations one level below."""
    return [x.operation for region in op.regions for block in region for x in block]


def callee(call):
    """Name of the function called."""
    return ir.FlatSymbolRefAttr(call.attributes["callee"]).value


def is_choice(op):
    """A conditional on `inside_p`, that is, on its value as an integer within bounds."""
    if op.name != "stablehlo.case":
        return False
    index = op.operands[0].owner
    while not isinstance(index, ir.Block) and index.name in ("stablehlo.convert", "stablehlo.clamp"):
        index = index.operands[len(index.operands) // 2].owner
    known = {} if isinstance(index, ir.Block) else index.attributes
    return ATTRIBUTES in known and inside_p.name in known[ATTRIBUTES]


def has_idle_branch(case):
    """Whether a conditional on a boolean has nothing to do where that is false, and many values to pass on."""
    if case.name != "stablehlo.case" or len(case.regions) != 2 or len(case.results) < MANY:
        return False
    return {x.operation.name for x in case.regions[0].blocks[0]} <= IDLE


def form_inside(case):
    """What is done inside a kernel, the return at its end included."""
    return [x.operation for x in case.regions[1].blocks[0]]
