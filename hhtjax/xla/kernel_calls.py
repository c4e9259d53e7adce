"""What is put in the place of a call, so that XLA makes a kernel of it, or computes its values once."""

from functools import partial

from jaxlib.mlir import ir
from jaxlib.mlir.dialects import func, stablehlo

from hhtjax.xla.inspection import ATTRIBUTES, PROVEN_TYPES, callee
from hhtjax.xla.products import element_type, size


def attach(call, **attributes):
    """Attributes that XLA or this package reads."""
    call.attributes[ATTRIBUTES] = ir.DictAttr.get({key: ir.StringAttr.get(x) for key, x in attributes.items()})


def compute_once(call):
    """Keeps XLA from evaluating it anew in every user."""
    attach(call, inlineable="false")


def may_be_divided(call):
    """Whether XLA may divide the function among threads, and then the kernel does not link: by its only result."""
    return len(call.results) == 1 and size(call.results[0]) > 1


def as_stage(function):
    """The function with a second result, an element that costs nothing to have."""
    (body,) = function.regions[0]
    with function.location:
        given, made = body.arguments, list(body.operations[len(body.operations) - 1].operands)
        _return_also(function, lambda: [_one_of(_cheap(given, made))])
    return function


def call_stage(replaced, reference):
    """A call of the stage in the place of each of these operations."""
    for op in replaced:
        cheap = _cheap(op.operands, op.results)
        with op.location, ir.InsertionPoint(op):
            call = func.CallOp([op.results[0].type, _element(cheap)], reference, list(op.operands))
        compute_once(call.operation)
        op.results[0].replace_all_uses_with(call.results[0])
        op.erase()


def _cheap(operands, results):
    """What is known before all else, where there is such."""
    return next((x for x in operands if size(x)), results[0])


def make_kernel(module, call):
    """Lets `call` find a function that calls the one it called, as a kernel.

    XLA aborts over a parameter of a kernel that nothing uses, or nothing any more once a constant is put in its place.
    So the kernel returns a number that takes an element of each; the function between drops it, and hides the values.
    """
    name = callee(call)
    with call.location:
        kernel = module.symbol_table[name].operation.clone(ip=module.ip)
        old_type = ir.FunctionType(ir.TypeAttr(kernel.attributes["function_type"]).value)
        types = _return_also(kernel, partial(_of_each, kernel.regions[0].blocks[0].arguments))
        between = func.FuncOp(name, old_type, ip=module.ip)
        with ir.InsertionPoint(between.add_entry_block()):
            hidden = list(stablehlo.OptimizationBarrierOp(between.arguments).results)
            inner = func.CallOp(types, insert(module, kernel), hidden)
            func.ReturnOp(list(inner.results)[: len(old_type.results)])
        attach(inner.operation, inlineable="false", xla_cpu_small_call="true")
        call.attributes["callee"] = insert(module, between.operation)


def _of_each(values):
    """A sum of elements of all, and what no sum takes: to return each by itself would take a buffer each."""
    number, sums, rest = ir.RankedTensorType.get([], ir.F32Type.get()), [], []
    for x in values:
        if size(x) and element_type(x) in PROVEN_TYPES:
            scalar = ir.RankedTensorType.get([], ir.RankedTensorType(x.type).element_type)
            sums.append(stablehlo.convert(number, stablehlo.reshape(scalar, _one_of(x))))
        else:
            rest.append(_one_of(x))
    while len(sums) > 1:
        sums = [*map(stablehlo.add, sums[::2], sums[1::2]), *sums[len(sums) // 2 * 2 :]]
    return [*sums, *rest]


def _one_of(x):
    """An element, with as many axes; x where it is empty."""
    return stablehlo.slice(x, *_first(x)) if size(x) else x


def _return_also(function, make):
    """Lets a function return what `make()` makes at its end after what it returned: the types of all."""
    (body,) = function.regions[0]
    end = body.operations[len(body.operations) - 1]
    with ir.InsertionPoint(end):
        more = make()
        func.ReturnOp([*end.operands, *more])
    end.erase()
    old = ir.FunctionType(ir.TypeAttr(function.attributes["function_type"]).value)
    types = [*old.results, *(x.type for x in more)]
    function.attributes["function_type"] = ir.TypeAttr.get(ir.FunctionType.get(old.inputs, types))
    if "res_attrs" in function.attributes:
        del function.attributes["res_attrs"]
    return types


def _element(x):
    """The type of an element of x, with as many axes."""
    return ir.RankedTensorType.get([1] * ir.RankedTensorType(x.type).rank, ir.RankedTensorType(x.type).element_type)


def _first(x):
    """Bounds and strides of a slice of one element."""
    rank = ir.RankedTensorType(x.type).rank
    return [ir.DenseI64ArrayAttr.get([n] * rank) for n in (0, 1, 1)]


def insert(module, function):
    """Into the module, under a name that is free: the reference to it."""
    function.attributes["sym_visibility"] = ir.StringAttr.get("private")
    return ir.FlatSymbolRefAttr.get(module.symbol_table.insert(function).value)
