"""How XLA:CPU shall cut a program into kernels, decided when it is lowered.

Attributes of a call change what XLA makes of it. One that is not inlined is computed once; one that bears
`xla_cpu_small_call` is compiled into one kernel, with all its loops. Such a kernel must hold only what its emitter
knows: with LAPACK, sort, scatter or a large product, compilation fails.

So the called function is looked through, operation by operation, with vmap and autodiff done, and the attribute is
attached only if all are known; where one is not proven, and XLA refuses the kernel on trial, it is not either. Where
a fusion outside a kernel takes long to compile, the stages of a function that is none become kernels, as far as they
can. Platforms other than the CPU never see it. The verdict is attached too, for `explain` to read. A function may come
in two forms, one for either case, of which the program keeps one. The sines of a kernel are those of sines.py.
"""

from functools import partial
from typing import Any

import numpy as np
from jax.interpreters import mlir
from jaxlib.mlir import ir
from jaxlib.mlir.dialects import func, stablehlo

from hhtjax.xla.gate import is_possible
from hhtjax.xla.inspection import ATTRIBUTES, PROVEN_TYPES, Inspection, callee, directly_in, form_inside
from hhtjax.xla.kernels import (
    AROUND,
    KERNEL,
    PART,
    QUICKLY,
    STAGED,
    alone_p,
    inside_p,
    largest_p,
    structural_p,
    watch_p,
)
from hhtjax.xla.products import element_type, size, written_out
from hhtjax.xla.sines import write_sines
from hhtjax.xla.trial import Module

VERDICT = "hhtjax_kernels"
UNTOLD = "hhtjax_around"
LEAST_IN_STAGE = 6  # operations; fewer are one fusion or two anyway
LARGEST_IN_STAGE = 8192  # numbers of an array; XLA may divide the work on larger ones among threads


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
    is_partitioned = _is_partitioned(module.axis_context)
    found = Inspection(module.symbol_table, call, is_partitioned)
    refusal = None if found.objection or found.is_proven else _refusal(module, found, call)
    objection = f"XLA refused: {refusal}" if refusal else found.objection
    told = UNTOLD if callee(call).startswith(AROUND) else VERDICT
    _attach(call, **{told: f"plain: {objection}" if objection else "one kernel"})
    if not objection:
        _cut(module, found, call)
    elif is_partitioned or QUICKLY in str(module.module.operation.attributes["sym_name"]):
        for stage in (x for calls in found.stages.values() for x in calls):
            _compute_once(stage)
    else:
        _cut_stages(module, call, set())


def _cut_stages(module, call, seen):
    """Makes kernels of the stages in the function called. With sines of XLA's own: polynomials, of which a kernel takes
    many at a time, take longer to compile."""
    seen.add(callee(call))
    for inner in _operations(module.symbol_table[callee(call)].operation):
        if inner.name != "func.call" or ATTRIBUTES in inner.attributes:
            continue
        if found := _kernel_alone(module, inner):
            _cut(module, found, inner, with_sines=False)
            continue
        if callee(inner) not in seen:
            _cut_stages(module, inner, seen)
        if callee(inner).startswith(STAGED):
            _compute_once(inner)


def _kernel_alone(module, stage):
    """The `Inspection` of a stage that makes a kernel for certain, and is worth one; None of all else."""
    if not callee(stage).startswith((STAGED, PART)) or not len(stage.results):
        return None
    found = Inspection(module.symbol_table, stage)
    functions = [module.symbol_table[name].operation for name in found.finished]
    sizes = [size(x) for function in functions for op in _operations(function) for x in op.results]
    if not found.is_proven or found.objection or found.operations < LEAST_IN_STAGE:
        return None
    found.stages.pop(callee(stage), None)
    return found if max(sizes) <= LARGEST_IN_STAGE else None


def _refusal(module, found, call):
    """XLA's, of the kernel alone, or None."""
    alone = Module(module.symbol_table, sorted(found.seen), call)
    _cut(alone, Inspection(alone.symbol_table, alone.call), alone.call)
    return alone.refusal()


def _cut(module, found, call, with_sines=True):
    """Makes the function called a kernel."""
    for choice in found.choices:
        _take_form_inside(choice)
    for case in found.seldom:
        _loop_at_most_once(case)
    for product in found.products:
        _call_stage([product], _insert(module, _as_stage(written_out(module, product))))
    if with_sines:
        write_sines(module, found.finished)
    for name in found.finished:  # what a stage calls comes before it
        stages = found.stages.get(name, [])
        if stages and _may_be_divided(stages[0]):
            copy = module.symbol_table[name].operation.clone(ip=module.ip)
            _call_stage(stages, _insert(module, _as_stage(copy)))
        else:
            for stage in stages:
                _compute_once(stage)
    _make_kernel(module, call)


def _operations(op):
    """All in it, itself included."""
    yield op
    for inner in directly_in(op):
        yield from _operations(inner)


def _is_undecided(op):
    return op.name == "func.call" and ATTRIBUTES not in op.attributes and callee(op).startswith(KERNEL)


def _attach(call, **attributes):
    call.attributes[ATTRIBUTES] = ir.DictAttr.get({key: ir.StringAttr.get(x) for key, x in attributes.items()})


def _compute_once(call):
    _attach(call, inlineable="false")


def _may_be_divided(call):
    """Whether XLA may divide the function among threads, and then the kernel does not link: by its only result."""
    return len(call.results) == 1 and size(call.results[0]) > 1


def _as_stage(function):
    """The function with a second result, an element that costs nothing to have."""
    (body,) = function.regions[0]
    with function.location:
        given, made = body.arguments, list(body.operations[len(body.operations) - 1].operands)
        _return_also(function, lambda: [_one_of(x) for x in _cheap(given, made)])
    return function


def _call_stage(replaced, reference):
    """A call of the stage in the place of each of these operations."""
    for op in replaced:
        (cheap,) = _cheap(op.operands, op.results)
        with op.location, ir.InsertionPoint(op):
            call = func.CallOp([op.results[0].type, _element(cheap)], reference, list(op.operands))
        _compute_once(call.operation)
        op.results[0].replace_all_uses_with(call.results[0])
        op.erase()


def _cheap(operands, results):
    return [next((x for x in operands if size(x)), results[0])]


def _make_kernel(module, call):
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
            inner = func.CallOp(types, _insert(module, kernel), hidden)
            func.ReturnOp(list(inner.results)[: len(old_type.results)])
        _attach(inner.operation, inlineable="false", xla_cpu_small_call="true")
        call.attributes["callee"] = _insert(module, between.operation)


def _of_each(values):
    """A sum of elements of all, and what no sum takes: to return each by itself would take a buffer each."""
    real = [x for x in values if size(x) and element_type(x) in PROVEN_TYPES]
    number, rest = ir.RankedTensorType.get([], ir.F32Type.get()), [x for x in values if x not in real]
    sums = [stablehlo.convert(number, stablehlo.reshape(_scalar(x), _one_of(x))) for x in real]
    while len(sums) > 1:
        sums = [*map(stablehlo.add, sums[::2], sums[1::2]), *sums[len(sums) // 2 * 2 :]]
    return [*sums, *map(_one_of, rest)]


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


def _scalar(x):
    return ir.RankedTensorType.get([], ir.RankedTensorType(x.type).element_type)


def _element(x):
    """The type of an element of x, with as many axes."""
    return ir.RankedTensorType.get([1] * ir.RankedTensorType(x.type).rank, ir.RankedTensorType(x.type).element_type)


def _first(x):
    """Bounds and strides of a slice of one element."""
    rank = ir.RankedTensorType(x.type).rank
    return [ir.DenseI64ArrayAttr.get([n] * rank) for n in (0, 1, 1)]


def _insert(module, function):
    """Into the module, under a name that is free: the reference to it."""
    function.attributes["sym_visibility"] = ir.StringAttr.get("private")
    return ir.FlatSymbolRefAttr.get(module.symbol_table.insert(function).value)


def _take_form_inside(case):
    """It in the place of the conditional."""
    *body, end = form_inside(case)
    for op in body:
        op.move_before(case)
    for result, value in zip(case.results, end.operands, strict=True):
        result.replace_all_uses_with(value)
    case.erase()


def _loop_at_most_once(case):
    """A loop in the place of a conditional: XLA copies what that passes on, in either branch; what a loop carries stays
    where it is."""
    idle, taken = ([x.operation for x in region.blocks[0]] for region in case.regions)
    for op in idle[:-1]:
        op.move_before(case)
    with case.location, ir.InsertionPoint(case):
        zero = mlir.ir_constant(np.int32(0))
        asked = stablehlo.compare(case.operands[0], zero, stablehlo.ComparisonDirectionAttr.get("NE"))
        start = [asked, *idle[-1].operands]
        types, places = [x.type for x in start], [case.location] * len(start)
        loop = stablehlo.WhileOp(types, start)
        around, inside = (region.blocks.append(*types, arg_locs=places) for region in loop.regions)
        with ir.InsertionPoint(around):
            stablehlo.ReturnOp([around.arguments[0]])
        with ir.InsertionPoint(inside):
            end = stablehlo.ReturnOp([mlir.ir_constant(np.bool_(False)), *taken[-1].operands])
    carried = dict(zip(start[1:], list(inside.arguments)[1:], strict=True))
    for op in taken[:-1]:
        op.move_before(end)
    for op in (inner for x in directly_in(loop.operation) for inner in _operations(x)):
        for i, x in enumerate(op.operands):
            if x in carried:
                op.operands[i] = carried[x]
    for old, new in zip(case.results, list(loop.results)[1:], strict=True):
        old.replace_all_uses_with(new)
    case.erase()


def _is_partitioned(axes):
    """Whether XLA divides the function among devices, and puts communication into it."""
    if hasattr(axes, "manual_axes"):  # inside shard_map
        return set(axes.manual_axes) != set(axes.mesh.axis_names)
    return (getattr(axes, "num_devices", None) or 1) > 1


# a cached lowering would not see the call
uncached: Any = {"cacheable": False} if is_possible else {}
mlir.register_lowering(watch_p, _lower, **uncached)
mlir.register_lowering(inside_p, _lower_inside, **uncached)
mlir.register_lowering(structural_p, lambda ctx, x: [x])
mlir.register_lowering(largest_p, lambda ctx, x, kept: [x])
mlir.register_lowering(alone_p, lambda ctx, x: [mlir.ir_constant(np.bool_(True))])
