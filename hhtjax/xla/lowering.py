"""How XLA:CPU shall cut a program into kernels, decided when it is lowered.

Attributes of a call change what XLA makes of it. One that is not inlined is computed once; one that bears
`xla_cpu_small_call` is compiled into one kernel, with all its loops. Such a kernel must hold only what its emitter
knows: with LAPACK, sort, a large scatter or product, compilation fails.

So the called function is looked through, operation by operation, with vmap and autodiff done, and the attribute is
attached only if all are known; where one is not proven, and XLA refuses the kernel on trial, it is not either. Where
a fusion outside a kernel takes long to compile, the stages of a function that is none become kernels, as far as they
can. Platforms other than the CPU never see it. The verdict is attached too, for `explain` to read. A function may come
in two forms, one for either case, of which the program keeps one. The sines of a kernel are those of sines.py.
"""

from typing import Any

import numpy as np
from jax.interpreters import mlir
from jaxlib.mlir import ir
from jaxlib.mlir.dialects import stablehlo

from hhtjax.xla.gate import is_possible
from hhtjax.xla.holding import hold
from hhtjax.xla.inspection import ATTRIBUTES, Inspection, callee, directly_in, form_inside
from hhtjax.xla.kernel_calls import (
    as_stage,
    attach,
    call_stage,
    compute_once,
    insert,
    make_kernel,
    may_be_divided,
)
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
from hhtjax.xla.products import size, written_out
from hhtjax.xla.scatters import write_out
from hhtjax.xla.sines import write_sines
from hhtjax.xla.source_lines import asked
from hhtjax.xla.trial import Module

VERDICT = "hhtjax_kernels"
UNTOLD = "hhtjax_around"
LEAST = 6  # operations of a stage that is a kernel; fewer are one fusion or two anyway
LARGEST = 8192  # numbers of an array; XLA may divide the work on larger ones among threads


def _lower_inside(ctx, x):
    no = mlir.ir_constant(np.bool_(False))
    attach(no.owner, **{inside_p.name: "unless a kernel takes the other branch"})
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
    attach(call, **{told: f"plain: {objection}" if objection else "one kernel"})
    if found.line and (lines := asked.get()) is not None:
        lines[callee(call)] = found.line
    if not objection:
        return _cut(module, found, call)
    hold(module, found.finished)
    if is_partitioned or QUICKLY in str(module.module.operation.attributes["sym_name"]):
        for stage in (x for calls in found.stages.values() for x in calls):
            compute_once(stage)
    else:
        _cut_stages(module, call, set(), {})


def _cut_stages(module, call, seen, made):
    """Makes kernels of the stages in the function called, of which values have been handed on. With sines of XLA's own:
    polynomials, of which a kernel takes many at a time, take longer to compile.

    seen: names of functions looked into; made: {name of a stage: its kernel}.
    """
    seen.add(callee(call))
    for inner in _operations(module.symbol_table[callee(call)].operation):
        if inner.name != "func.call" or ATTRIBUTES in inner.attributes:
            continue
        name = callee(inner)
        if name not in made and (found := _kernel_alone(module, inner)):
            _cut(module, found, inner, whole=False)
            made[name] = inner.attributes["callee"]
        if name in made:
            inner.attributes["callee"] = made[name]
            continue
        if name not in seen:
            _cut_stages(module, inner, seen, made)
        if name.startswith(STAGED):
            compute_once(inner)


def _kernel_alone(module, stage):
    """The `Inspection` of a stage that makes a kernel for certain, and is worth one; None of all else."""
    if not callee(stage).startswith((STAGED, PART)) or not len(stage.results):
        return None
    found = Inspection(module.symbol_table, stage)
    if not found.is_proven or found.objection or found.operations < LEAST:
        return None
    functions = (module.symbol_table[name].operation for name in found.finished)
    if any(size(x) > LARGEST for function in functions for op in _operations(function) for x in op.results):
        return None
    found.stages.pop(callee(stage), None)
    return found


def _refusal(module, found, call):
    """XLA's, of the kernel alone, or None."""
    alone = Module(module.symbol_table, sorted(found.seen), call)
    _cut(alone, Inspection(alone.symbol_table, alone.call), alone.call)
    return alone.refusal()


def _cut(module, found, call, whole=True):
    """Makes the function called a kernel. whole: and not a stage of one that is none."""
    for choice in found.choices:
        _take_form_inside(choice)
    for case in found.seldom:
        _loop_at_most_once(case)
    for scatter in found.scatters:
        write_out(scatter)
    for product in found.products:
        call_stage([product], insert(module, as_stage(written_out(module, product))))
    if whole:
        write_sines(module, found.finished)
        hold(module, found.finished)
    for name in found.finished:  # what a stage calls comes before it
        stages = found.stages.get(name, [])
        if stages and may_be_divided(stages[0]):
            copy = module.symbol_table[name].operation.clone(ip=module.ip)
            call_stage(stages, insert(module, as_stage(copy)))
        else:
            for stage in stages:
                compute_once(stage)
    make_kernel(module, call)


def _operations(op):
    """All in it, itself included."""
    yield op
    for inner in directly_in(op):
        yield from _operations(inner)


def _is_undecided(op):
    return op.name == "func.call" and ATTRIBUTES not in op.attributes and callee(op).startswith(KERNEL)


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
