"""How XLA:CPU shall cut a program into kernels, decided when it is lowered.

A call that bears `xla_cpu_small_call` is compiled into one kernel, with all its loops. Such a kernel must hold only what
its emitter knows: with LAPACK, sort, a large scatter or product, compilation fails. So the function is looked through
first (fit_for_kernel.py), in the form that it has as a kernel (for_kernel.py), with vmap and autodiff done. Where
something stands against it, the function runs as a list of kernels, and the functions in it that may be kernels are
asked anew. Platforms other than the CPU never see it.
"""

from functools import reduce
from inspect import signature
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import eval_jaxpr
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import jaxpr_as_fun
from jax.interpreters import mlir

from hhtjax.xla.fit_for_kernel import DTYPES, verdict
from hhtjax.xla.for_kernel import for_kernel, for_list
from hhtjax.xla.kernel_primitive import kernel_p, of_jaxpr
from hhtjax.xla.kernels import AROUND, alone_p, inside_p, largest_p, structural_p, told_p
from hhtjax.xla.source_lines import asked, line_of

DIVIDED = "partitioned over devices; shard_map leaves each its own kernel"


@of_jaxpr
def _as_kernel(closed):
    """The jaxpr in the form for a kernel, and the verdict on that."""
    form = for_kernel(closed)
    return form, verdict(form.jaxpr)


@of_jaxpr
def _as_list(closed):
    """The jaxpr in the form for a list of kernels."""
    return for_list(closed)


def _lower(ctx, *args, closed, name):
    form, (objection, eqn) = _as_kernel(closed)
    if _is_partitioned(ctx.module_context.axis_context):
        objection, eqn = DIVIDED, None
    if name != AROUND:
        line = eqn and line_of(eqn)
        _tell(object(), f"plain: {objection}{', ' if line else ''}{line or ''}" if objection else "one kernel")
    run = jaxpr_as_fun(_as_list(closed)) if objection else _kernel(form)
    return mlir.lower_fun(run, multiple_results=True)(ctx, *args)


def _tell(loop, path):
    """For `explain`, while it asks."""
    if (paths := asked.get()) is not None:
        paths[loop] = path


def _lower_told(ctx, x, why, loop):
    _tell(loop, f"plain: {why}")
    return [x]


def _kernel(form):
    """The function of a closed jaxpr as a kernel.

    XLA aborts over a parameter of a kernel that nothing uses, or nothing any more once a constant is put in its place.
    So the kernel returns a number that takes an element of each, and the values are hidden from XLA."""
    number = len(form.out_avals)

    def kernel(*args):
        return [*eval_jaxpr(form.jaxpr, form.consts, *args), *_of_each(args)]

    def call(*args):
        hidden = lax.optimization_barrier(args)
        with set_xla_metadata(inlineable="false", xla_cpu_small_call="true"):
            return jax.jit(kernel)(*hidden)[:number]

    return call


def _of_each(values):
    """A sum of elements of all, and what no sum takes: to return each by itself would take a buffer each."""
    terms, rest = [], []
    for x in values:
        if x.size and x.dtype in DTYPES:
            terms.append(lax.slice(x, [0] * x.ndim, [1] * x.ndim).reshape(()).astype(np.float32))
        else:
            rest.append(x)
    return [*([reduce(jnp.add, terms)] if terms else []), *rest]


def _is_partitioned(axes):
    """Whether XLA divides the function among devices, and puts communication into it."""
    if hasattr(axes, "manual_axes"):  # inside shard_map
        return set(axes.manual_axes) != set(axes.mesh.axis_names)
    return (getattr(axes, "num_devices", None) or 1) > 1


# a cached lowering would tell `explain` nothing; an older JAX keeps none
UNCACHED: Any = {"cacheable": False} if "cacheable" in signature(mlir.register_lowering).parameters else {}
PLAIN = mlir.lower_fun(lambda *args, closed, name: jaxpr_as_fun(closed)(*args), multiple_results=True)
mlir.register_lowering(kernel_p, PLAIN)
mlir.register_lowering(kernel_p, _lower, platform="cpu", **UNCACHED)
mlir.register_lowering(told_p, _lower_told, **UNCACHED)
mlir.register_lowering(inside_p, lambda ctx, x: [mlir.ir_constant(np.bool_(False))])
mlir.register_lowering(structural_p, lambda ctx, x: [x])
mlir.register_lowering(largest_p, lambda ctx, x, kept: [x])
mlir.register_lowering(alone_p, lambda ctx, x: [mlir.ir_constant(np.bool_(True))])
