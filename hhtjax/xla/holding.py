"""Values of a kernel that several operations use, computed once.

XLA:CPU fuses an operation into all that use it, and evaluates for each of them anew all that it comes from: of the
14,000 operations of a spinning top's gradient it makes 37,000, and LLVM compiles them all. Across a call it fuses
nothing. So what is much to evaluate, and used by several, is handed on by a call that gives it as it is: of this
gradient 25,000 are left; it compiles in three quarters of the time, and runs in two thirds.
"""

from jaxlib.mlir import ir
from jaxlib.mlir.dialects import func

from hhtjax.xla.inspection import ATTRIBUTES, callee
from hhtjax.xla.kernel_calls import as_stage, compute_once, insert
from hhtjax.xla.kernels import STAGED
from hhtjax.xla.products import size

LEAST = 40  # operations that are evaluated once more without a call; of fewer, nothing is gained
WITH_REGIONS = {"stablehlo.case", "stablehlo.if", "stablehlo.while"}
MADE_ONCE = WITH_REGIONS | {"stablehlo.custom_call", "stablehlo.dot_general"}  # by XLA in any case
BROADCAST = "stablehlo.broadcast_in_dim"  # handed on before it is one
FREE = {BROADCAST, *(f"stablehlo.{x}" for x in ("constant", "convert", "reshape", "slice", "transpose"))}
SHORT = 512  # numbers; XLA divides no work on so few among threads


def hold(module, names):
    """Hands values on by calls in the functions of these names, each of which comes after those that it calls."""
    calls, costs, uses = {}, {}, {}
    for name in names:
        (body,) = module.symbol_table[name].operation.regions[0]
        costs[name] = _hold_in(module, body, calls, costs, uses)
        uses[name] = [_number_of_uses(x, uses) for x in body.arguments]


def _number_of_uses(x, uses):
    """Operations that take x, those in functions called with it too. uses: of arguments of these, by names."""
    number = {}
    for use in x.uses:
        op = use.owner
        is_open = op.name == "func.call" and ATTRIBUTES not in op.attributes and callee(op) in uses
        number[op] = number.get(op, 0) + uses[callee(op)][use.operand_number] if is_open else 1
    return sum(number.values())


def _hold_in(module, block, calls, costs, uses):
    """The same in a block: what each of its results takes where it is evaluated anew, in operations.

    calls: those that hand on, by types; costs, uses: of results and arguments of the functions before, by names.
    """
    cost = {}
    for op in [x.operation for x in block]:
        if op.name in WITH_REGIONS:
            for region in op.regions:
                for inner in region:
                    _hold_in(module, inner, calls, costs, uses)
        for x, taken in zip(op.results, _costs_of(op, cost, costs), strict=True):
            if taken and op.name != BROADCAST and taken * (_number_of_uses(x, uses) - 1) >= LEAST:
                _hand_on(module, op, x, calls)
                taken = 0
            cost[x] = taken
    return [cost.get(x, 0) for x in op.operands]


def _costs_of(op, cost, costs):
    """Of its results, where it is evaluated anew with all that its operands take."""
    is_call = op.name == "func.call"
    if op.name in MADE_ONCE or (is_call and (ATTRIBUTES in op.attributes or callee(op).startswith(STAGED))):
        return [0] * len(op.results)
    before = sum(cost.get(x, 0) for x in {*op.operands})
    one_each = [op.name not in FREE] * len(op.results)
    own = costs.get(callee(op), one_each) if is_call else one_each
    return [before + x for x in own]


def _hand_on(module, op, x, calls):
    """A call in the place of the value x of op, for all that use it."""
    uses = [(use.owner, use.operand_number) for use in x.uses]
    if x.type not in calls:
        calls[x.type] = _identity(module, x)
    types, reference = calls[x.type]
    with op.location, ir.InsertionPoint.after(op):
        call = func.CallOp(types, reference, [x])
    compute_once(call.operation)
    for owner, i in uses:
        owner.operands[i] = call.results[0]


def _identity(module, x):
    """A function that gives values like x as they are: the types of its results, and the reference to it."""
    with x.owner.location:
        function = func.FuncOp("hhtjax_held", ir.FunctionType.get([x.type], [x.type]), ip=module.ip)
        with ir.InsertionPoint(function.add_entry_block()):
            func.ReturnOp(function.arguments)
    if size(x) > SHORT:
        as_stage(function.operation)
    types = ir.FunctionType(ir.TypeAttr(function.attributes["function_type"]).value).results
    return types, insert(module, function.operation)
