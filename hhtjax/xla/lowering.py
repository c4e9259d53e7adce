"""How XLA:CPU shall cut a program into kernels, decided when it is lowered.

Attributes of a call change what XLA makes of it. One that is not inlined is computed once; one that bears
`xla_cpu_small_call` is compiled into one kernel, with all its loops. Such a kernel must hold only what its emitter
knows: with LAPACK, sort, scatter or a large product, compilation fails.

So the called function is looked through, operation by operation, with vmap and autodiff done, and the attribute is
attached only if all are known. Platforms other than the CPU never see it. The verdict is attached too, for `explain` to
read. A function may come in two forms, one for either case, of which the program keeps one.
"""

from functools import reduce
from typing import Any

import numpy as np
from jax.interpreters import mlir
from jaxlib.mlir import ir
from jaxlib.mlir.dialects import func, stablehlo

from hhtjax.xla.gate import is_possible
from hhtjax.xla.kernels import KERNEL, STAGED, inside_p, structural_p, watch_p

ATTRIBUTES = "mhlo.frontend_attributes"
VERDICT = "hhtjax_kernels"

# operations the emitter knows, whatever their size
KNOWN = {
    *("abs", "add", "and", "atan2", "bitcast_convert", "broadcast_in_dim", "case", "cbrt", "ceil", "clamp", "compare"),
    *("complex", "concatenate", "constant", "convert", "cosine", "count_leading_zeros", "divide", "dynamic_slice"),
    *("dynamic_update_slice", "exponential", "exponential_minus_one", "floor", "gather", "if", "imag", "iota"),
    *("is_finite", "log", "log_plus_one", "logistic", "maximum", "minimum", "multiply", "negate", "not", "or", "pad"),
    *("optimization_barrier", "popcnt", "power", "real", "remainder", "reshape", "return", "reverse"),
    *("round_nearest_afz", "round_nearest_even", "rsqrt", "select", "shift_left", "shift_right_arithmetic"),
    *("shift_right_logical", "sign", "sine", "slice", "sqrt", "subtract", "tan", "tanh", "transpose", "while", "xor"),
}
LARGEST_SUM = 1024  # elements; XLA hands larger ones to another library, and products of matrices
LARGEST_PRODUCT = 7  # rows, columns, and terms of a sum
LARGEST_WRITTEN_OUT = 16  # the same where the product is written as a sum of others
LARGEST_MATRIX = 4096  # elements of one that meets a vector
MOST_OPERATIONS = 5000  # of more, compiling takes long, or fails: gradients of a chain of bodies


def _lower_inside(ctx, x):
    no = mlir.ir_constant(np.bool_(False))
    _attach(no.owner, **{inside_p.name: "unless a kernel takes the other branch"})
    return [no]


def _lower(ctx, x):
    """Decides on the call that gives x, and on those before it whose results go to derivatives only."""
    module = ctx.module_context
    on_cpu = tuple(module.platforms) == ("cpu",)
    if on_cpu and not isinstance(x.owner, ir.Block) and _is_undecided(x.owner.operation):
        before = filter(_is_undecided, _operations(module.module.operation))
        for call in [x.owner.operation, *before]:
            if _is_undecided(call):
                _decide(module, call)
    return [x]


def _decide(module, call):
    found = _Inspection(module, call)
    _attach(call, **{VERDICT: f"plain: {found.objection}" if found.objection else "one kernel"})
    if found.objection is None:
        for choice in found.choices:
            _take_form_inside(choice)
        for product in found.products:
            _write_out(module, product)
        _make_kernel(module, call)


def _operations(op):
    """All in it, itself included."""
    yield op
    for inner in _directly_in(op):
        yield from _operations(inner)


def _directly_in(op):
    return [x.operation for region in op.regions for block in region for x in block]


def _is_undecided(op):
    return op.name == "func.call" and ATTRIBUTES not in op.attributes and _callee(op).startswith(KERNEL)


def _callee(call):
    return ir.FlatSymbolRefAttr(call.attributes["callee"]).value


def _attach(call, **attributes):
    call.attributes[ATTRIBUTES] = ir.DictAttr.get({key: ir.StringAttr.get(x) for key, x in attributes.items()})


def _make_kernel(module, call):
    """Lets `call` find a function that calls the one it called, as a kernel.

    XLA aborts over a parameter of a kernel that nothing uses, or nothing any more once a constant is put in its place.
    So the kernel returns an element of each; the function between drops them, and hides the values.
    """
    name = _callee(call)
    with call.location:
        kernel = module.symbol_table[name].operation.clone(ip=module.ip)
        old_type = ir.FunctionType(ir.TypeAttr(kernel.attributes["function_type"]).value)
        (body,) = kernel.regions[0]
        end = body.operations[len(body.operations) - 1]
        with ir.InsertionPoint(end):
            elements = [stablehlo.slice(x, *_first(x)) if _size(x) else x for x in body.arguments]
            func.ReturnOp([*end.operands, *elements])
        end.erase()
        new_type = ir.FunctionType.get(old_type.inputs, [*old_type.results, *(x.type for x in elements)])
        kernel.attributes["function_type"] = ir.TypeAttr.get(new_type)
        if "res_attrs" in kernel.attributes:
            del kernel.attributes["res_attrs"]
        between = func.FuncOp(name, old_type, ip=module.ip)
        with ir.InsertionPoint(between.add_entry_block()):
            hidden = list(stablehlo.OptimizationBarrierOp(between.arguments).results)
            inner = func.CallOp(new_type.results, _insert(module, kernel), hidden)
            func.ReturnOp(list(inner.results)[: len(old_type.results)])
        _attach(inner.operation, inlineable="false", xla_cpu_small_call="true")
        between.attributes["sym_visibility"] = ir.StringAttr.get("private")
        call.attributes["callee"] = _insert(module, between)


def _is_choice(op):
    """A conditional on `inside_p`, that is, on its value as an integer within bounds."""
    if op.name != "stablehlo.case":
        return False
    index = op.operands[0].owner
    while not isinstance(index, ir.Block) and index.name in ("stablehlo.convert", "stablehlo.clamp"):
        index = index.operands[len(index.operands) // 2].owner
    known = {} if isinstance(index, ir.Block) else index.attributes
    return ATTRIBUTES in known and inside_p.name in known[ATTRIBUTES]


def _form_inside(case):
    """What is done inside a kernel."""
    return list(case.regions[1].blocks[0].operations)


def _take_form_inside(case):
    """It in the place of the conditional."""
    *body, end = _form_inside(case)
    for op in body:
        op.operation.move_before(case)
    for result, value in zip(case.results, end.operands, strict=True):
        result.replace_all_uses_with(value)
    case.erase()


def _insert(module, function):
    """Into the module, under a name that is free: the reference to it."""
    return ir.FlatSymbolRefAttr.get(module.symbol_table.insert(function).value)


def _first(x):
    """Bounds and strides of a slice of one element."""
    rank = ir.RankedTensorType(x.type).rank
    return [ir.DenseI64ArrayAttr.get([n] * rank) for n in (0, 1, 1)]


class _Inspection:
    """Looks through a function and all it calls: what in it cannot be part of one kernel, and what is staged."""

    def __init__(self, module, call):
        self.functions = module.symbol_table
        self.seen = set()
        self.operations = 0
        self.products = []  # to be written out
        self.choices = []  # between the forms of a function
        self.objection = None
        if _is_partitioned(module.axis_context):
            self.object("partitioned over devices; shard_map leaves each its own kernel")
        self.look(call)

    def look(self, op):
        """`objection` becomes the first there is; staged calls are marked as such."""
        self.operations += 1
        dialect, _, name = op.name.partition(".")
        if self.operations > MOST_OPERATIONS:
            self.object(f"more than {MOST_OPERATIONS} operations")
        if op.name == "func.call":
            callee = _callee(op)
            if callee.startswith(STAGED):
                _attach(op, inlineable="false")
            if callee not in self.seen:
                self.seen.add(callee)
                self.look(self.functions[callee].operation)
        elif _is_choice(op):
            self.choices.append(op)
            for inner in _form_inside(op):
                self.look(inner.operation)
        elif name == "custom_call":
            self.object(ir.StringAttr(op.attributes["call_target_name"]).value)
        elif name == "dot_general" and _is_written_out(op):
            self.products.append(op)
        elif dialect == "stablehlo" and name in CHECKS:  # what it holds is scalar
            if not CHECKS[name](op):
                self.object(f"{name} of {' and '.join(str(x.type) for x in op.operands)}")
        elif (dialect == "stablehlo" and name in KNOWN) or dialect in ("chlo", "func"):
            for inner in _directly_in(op):
                self.look(inner)
        else:
            self.object(op.name)

    def object(self, why):
        self.objection = self.objection or why


def _is_partitioned(axes):
    """Whether XLA divides the function among devices, and puts communication into it."""
    if hasattr(axes, "manual_axes"):  # inside shard_map
        return set(axes.manual_axes) != set(axes.mesh.axis_names)
    return (getattr(axes, "num_devices", None) or 1) > 1


def _size(value):
    size = 1
    for n in ir.RankedTensorType(value.type).shape:
        size *= n
    return size


def _small_reduction(op):
    value = op.operands[0]
    return _size(value) <= LARGEST_SUM or str(ir.RankedTensorType(value.type).element_type) == "i1"


def _dimensions(op):
    """Of both operands of a product: (batched, summed over, the others)."""
    dims = stablehlo.DotDimensionNumbers(op.attributes["dot_dimension_numbers"])
    batched = dims.lhs_batching_dimensions, dims.rhs_batching_dimensions
    summed = dims.lhs_contracting_dimensions, dims.rhs_contracting_dimensions
    ranks = [ir.RankedTensorType(x.type).rank for x in op.operands]
    return [
        (list(b), list(s), [i for i in range(rank) if i not in (*b, *s)])
        for b, s, rank in zip(batched, summed, ranks, strict=True)
    ]


def _small_product(op, largest=LARGEST_PRODUCT):
    """Of a vector, batched or not, or of tiny matrices: tiny in rows, columns and what is summed over."""
    dimensions = _dimensions(op)
    if not all(rest for _, _, rest in dimensions):
        return max(map(_size, op.operands)) <= LARGEST_MATRIX
    shapes = [ir.RankedTensorType(x.type).shape for x in op.operands]
    lengths = [shape[i] for shape, (_, over, rest) in zip(shapes, dimensions, strict=True) for i in (*over, *rest)]
    return max(lengths) <= largest


def _is_written_out(op):
    types = {str(ir.RankedTensorType(x.type).element_type) for x in (*op.operands, *op.results)}
    return not _small_product(op) and _small_product(op, LARGEST_WRITTEN_OUT) and len(types) == 1


def _write_out(module, product):
    """The product as a sum over its terms, each a column times a row, in a function of its own.

    XLA would hand the product as such to another library.
    """
    result = ir.RankedTensorType(product.results[0].type)
    types = [x.type for x in product.operands]
    with product.location:
        function = func.FuncOp(STAGED, ir.FunctionType.get(types, [result]), ip=module.ip)
        function.attributes["sym_visibility"] = ir.StringAttr.get("private")
        with ir.InsertionPoint(function.add_entry_block()):
            func.ReturnOp([_sum_of_terms(_dimensions(product), function.arguments, result)])
        with ir.InsertionPoint(product):
            call = func.CallOp([result], _insert(module, function), list(product.operands))
        _attach(call.operation, inlineable="false")
    product.results[0].replace_all_uses_with(call.results[0])
    product.erase()


def _sum_of_terms(dimensions, operands, result):
    shapes = [ir.RankedTensorType(x.type).shape for x in operands]
    (batched, summed, rows), _ = dimensions
    first = len(batched), len(batched) + len(rows)  # of the result, after the batch
    terms = []
    for index in np.ndindex(*(shapes[0][i] for i in summed)):
        factors = []
        for x, shape, (batch, over, rest), start in zip(operands, shapes, dimensions, first, strict=True):
            fixed = dict(zip(over, index, strict=True))
            low = [fixed.get(i, 0) for i in range(len(shape))]
            high = [fixed[i] + 1 if i in fixed else n for i, n in enumerate(shape)]
            kept = [i for i in range(len(shape)) if i not in fixed]
            part = stablehlo.slice(x, *map(ir.DenseI64ArrayAttr.get, (low, high, [1] * len(shape))))
            part = stablehlo.reshape(ir.RankedTensorType.get([shape[i] for i in kept], result.element_type), part)
            place = [batch.index(i) if i in batch else start + rest.index(i) for i in kept]
            factors.append(stablehlo.broadcast_in_dim(result, part, ir.DenseI64ArrayAttr.get(place)))
        terms.append(stablehlo.multiply(*factors))
    return reduce(stablehlo.add, terms)


CHECKS = {"dot_general": _small_product, "reduce": _small_reduction, "reduce_window": _small_reduction}


# a cached lowering would not see the call
uncached: Any = {"cacheable": False} if is_possible else {}
mlir.register_lowering(watch_p, _lower, **uncached)
mlir.register_lowering(inside_p, _lower_inside, **uncached)
mlir.register_lowering(structural_p, lambda ctx, x: [x])
