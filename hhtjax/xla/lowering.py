"""Decides how XLA:CPU divides a program into kernels, when the program is lowered.

XLA compiles a call with the attribute `xla_cpu_small_call` into one kernel, with all its loops. Compilation fails if
the call contains operations that the emitter of such kernels does not support: LAPACK, sort, a large scatter or
product. So the function is first brought into the form of a kernel (for_kernel.py), after vmap and autodiff, and
checked (fit_for_kernel.py). If it contains an obstacle, it runs as a list of kernels, and the functions in it that may
be kernels are checked one by one. On platforms other than the CPU nothing of this happens.
"""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.export
import numpy as np
from jax.extend.core import jaxpr_as_fun
from jax.interpreters import mlir

from hhtjax.description import PyTree, is_concrete, programs
from hhtjax.primitives.compat import is_on, or_plain
from hhtjax.primitives.interpreter import asked, line_of
from hhtjax.primitives.kernel_primitive import kernel_p, of_jaxpr
from hhtjax.primitives.kernels import AROUND, alone_p, inside_p, largest_p, structural_p, told_p
from hhtjax.primitives.two_mode_derivative import is_in_program
from hhtjax.xla.first_call import tell_if_long, telling_if_long
from hhtjax.xla.fit_for_kernel import inner, verdict
from hhtjax.xla.for_kernel import for_kernel, for_list, kernel

if TYPE_CHECKING:
    from jax.extend.core import ClosedJaxpr, Jaxpr

quickly: ContextVar = ContextVar("hhtjax_quickly", default=False)  # compiled by XLA's older way
DIVIDED = "partitioned over devices; shard_map leaves each its own kernel"


@of_jaxpr
def _as_kernel(closed: ClosedJaxpr):
    """The jaxpr in the form for a kernel, and the verdict on that; no form, where it is none in any."""
    if (hopeless := verdict(closed.jaxpr, before=True)).objection:
        return None, hopeless
    form = for_kernel(closed)
    return form, verdict(form.jaxpr)


@of_jaxpr
def _as_list(closed: ClosedJaxpr, stages_are_kernels: bool) -> ClosedJaxpr:
    """The jaxpr in the form for a list of kernels."""
    return for_list(closed, stages_are_kernels)


def _lower(ctx, *args, closed: ClosedJaxpr, name: str):
    tell_if_long()  # a jit of the user's, or of reverse mode, does not say when it begins
    if tuple(ctx.module_context.platforms) != ("cpu",) or not closed.jaxpr.eqns:
        return mlir.lower_fun(jaxpr_as_fun(closed), multiple_results=True)(ctx, *args)
    form, (objection, eqns, _) = _as_kernel(closed)
    is_divided = _is_partitioned(ctx.module_context.axis_context)
    if is_divided:
        objection, eqns = DIVIDED, ()
    if name == AROUND and not objection and asked.get() is not None:
        for _ in range(_number_of_kernels(closed.jaxpr)):
            _tell(object(), "one kernel")
    if name != AROUND:
        line = next(filter(None, map(line_of, eqns)), None) if asked.get() is not None else None
        _tell(object(), f"plain: {objection}{', ' if line else ''}{line or ''}" if objection else "one kernel")
    run = jaxpr_as_fun(_as_list(closed, not (is_divided or quickly.get()))) if objection else kernel(form)
    return mlir.lower_fun(run, multiple_results=True)(ctx, *args)


def _number_of_kernels(jaxpr: Jaxpr) -> int:
    """In a jaxpr."""
    number = 0
    for eqn in jaxpr.eqns:
        is_one = eqn.primitive is kernel_p and eqn.params["name"] != AROUND
        number += 1 if is_one else sum(map(_number_of_kernels, inner(eqn)))
    return number


def _tell(loop, path: str):
    """For `explain`, while it asks."""
    if (paths := asked.get()) is not None:
        paths[loop] = path


def _lower_told(ctx, x, why: str, loop):
    _tell(loop, f"plain: {why}")
    return [x]


def _is_partitioned(axes) -> bool:
    """Whether XLA divides the function among devices, and puts communication into it."""
    if hasattr(axes, "manual_axes"):  # inside shard_map
        return set(axes.manual_axes) != set(axes.mesh.axis_names)
    return (getattr(axes, "num_devices", None) or 1) > 1


mlir.register_lowering(kernel_p, _lower, cacheable=False)  # a cached lowering would tell `explain` nothing
mlir.register_lowering(told_p, _lower_told, cacheable=False)
mlir.register_lowering(inside_p, lambda ctx, x: [mlir.ir_constant(np.bool_(False))])
mlir.register_lowering(structural_p, lambda ctx, x: [x])
mlir.register_lowering(largest_p, lambda ctx, x, kept: [x])
mlir.register_lowering(alone_p, lambda ctx, x: [mlir.ir_constant(np.bool_(True))])


# ----------------------------------------------------------------------------
# Compiler options of programs that start here. Inside a user's jit, the options of that jit apply.
#
# QUICK: XLA:CPU compiles each fusion outside a kernel by a pipeline of MLIR. This takes some 10 ms for a few sums, and
# gradients of mechanisms have hundreds of fusions. The older emitter, which also compiles kernels, takes a third of
# that time. Without QUICK stages become kernels (lowering.py), to be compiled by it; with QUICK that would take longer.
# For matrices of more than 32 unknowns its code is slower by a fifth, so their runs and sweeps do not use QUICK. Since
# JAX 0.11.1 there is no such option, and QUICK is empty.
#
# WIDE: vectors of 512 bits for loops over the members of a batch. By default XLA:CPU uses vectors of half this length.
# With WIDE a batch of double pendulums takes half the time.
#
# For a user's jit: `jax.jit(f, compiler_options=hhtjax.xla.QUICK)`, or `hhtjax.xla.QUICK | hhtjax.xla.WIDE`.


QUICK: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11, 1) else {}
MOST_QUICK = 32  # rates; with 40, steps of a beam take 1.2 times as long
WIDE = {"xla_cpu_prefer_vector_width": 512}  # bits; no effect on processors without such vectors
MOST_WIDE = 4  # coordinates; loops over more of them fit wide vectors badly: a chain of 7 takes 1.3 times as long


class Programs:
    """A function of arrays, compiled with options that depend on where it is called and on the size of the system.

    >>> twice = Programs(lambda x: 2 * x)
    >>> float(twice(2.0)), float(twice(3.0, rates=2, numbers=2)), float(jax.jit(twice)(3.0))
    (4.0, 6.0, 6.0)
    """

    are_refused = False  # the options, by an XLA that does not know one

    def __init__(self, f: Callable, **static: PyTree):
        """static: of `jax.jit`."""
        f = telling_if_long(f)
        self.usual: Any = jax.jit(f, **static)
        self.quick: Any = jax.jit(f, compiler_options=QUICK, **static) if QUICK else self.usual
        self.wide: Any = jax.jit(f, compiler_options=QUICK | WIDE, **static)
        programs.update((self.usual, self.quick, self.wide))

    def of(self, rates: int = 0, numbers: int | None = None):
        """The program for a system.

        rates: number of rates of the system, 0 if unknown. numbers: number of coordinates of a member of a batch; None
        without a batch.
        """
        if Programs.are_refused or rates > MOST_QUICK or not is_on() or jax.default_backend() != "cpu":
            return self.usual
        if is_in_program():
            return self.usual
        return self.wide if numbers is not None and numbers <= MOST_WIDE else self.quick

    def __call__(self, *args: PyTree, rates: int = 0, numbers: int | None = None, **keywords: PyTree):
        """The values of the function. They come from plain JAX if XLA refuses the program, or has refused it before."""

        def known_by():  # what JAX keeps the program by, and what is being made of it
            made = frozenset(type(x) for x in jax.tree.leaves((args, keywords)) if not is_concrete(x))
            return self.usual.trace(*args, **keywords).jaxpr, made

        return or_plain(partial(self._chosen, lambda program: program(*args, **keywords), rates, numbers), known_by)

    def lower(self, *args: PyTree, rates: int = 0, numbers: int | None = None, **keywords: PyTree):
        """The lowered program of a call, as `jax.jit(f).lower`."""
        return self._chosen(lambda program: program.lower(*args, **keywords), rates, numbers)

    def exported(self, *args: PyTree, rates: int = 0, numbers: int | None = None, **keywords: PyTree):
        """The program in a form that can be sent to other processes (`jax.export`), and its compiler options."""

        def use(program):
            options = {id(self.wide): QUICK | WIDE, id(self.quick): QUICK, id(self.usual): {}}
            return jax.export.export(program)(*args, **keywords), options[id(program)]

        return self._chosen(use, rates, numbers)

    def _chosen(self, use: Callable, rates: int, numbers: int | None):
        program = self.of(rates, numbers)
        token = quickly.set(bool(QUICK) and program is not self.usual)
        try:
            return use(program)
        except ValueError as error:  # there are options inside a jit of the user's
            if "compiler_options" not in str(error):
                raise
        except jax.errors.JaxRuntimeError as error:
            if "No such compile option" not in str(error):
                raise
            Programs.are_refused = True
        finally:
            quickly.reset(token)
        return use(self.usual)

    def number(self) -> int:
        """Of all that have been compiled."""
        return sum(program._cache_size() for program in {self.usual, self.quick, self.wide})
