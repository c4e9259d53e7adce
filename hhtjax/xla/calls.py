"""Calls that bear attributes for XLA:CPU: what is called is compiled into one kernel, or computed once."""

from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import eval_jaxpr
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import jaxpr_as_fun

from hhtjax.xla.fit_for_kernel import DTYPES
from hhtjax.xla.holding import ONCE
from hhtjax.xla.kernel_primitive import of_jaxpr


def kernel(form):
    """The function of a closed jaxpr as one kernel.

    XLA aborts over a parameter of a kernel that nothing uses, or nothing any more once a constant is put in its place.
    So the kernel returns a number that takes an element of each, and the values are hidden from XLA."""
    number = len(form.out_avals)

    def body(*args):
        return [*eval_jaxpr(form.jaxpr, form.consts, *args), *_of_each(args)]

    body = _with_attributes(body, inlineable="false", xla_cpu_small_call="true")
    return lambda *args: body(*lax.optimization_barrier(args))[:number]


def _with_attributes(f, **attributes):
    """f, which returns a list, as a call that bears these."""
    call = jax.jit(f, keep_unused=True)

    def bearing(*args):
        found = call(*args)
        return [set_xla_metadata(found[0], **attributes), *found[1:]]  # it finds what made the value

    return bearing


def _of_each(values):
    """A sum of elements of all, and what no sum takes: to return each by itself would take a buffer each."""
    terms, rest = [], []
    for x in values:
        if x.size and x.dtype in DTYPES:
            terms.append(_first(x).reshape(()).astype(np.float32))
        else:
            rest.append(x)
    return [*([reduce(jnp.add, terms)] if terms else []), *rest]


def _first(x):
    """An element, with as many axes."""
    return lax.slice(x, [0] * x.ndim, [1] * x.ndim)


@of_jaxpr
def computed_once(closed):
    """The closed jaxpr as a call that XLA does not inline, and so computes once, however many users its values have.

    What has a single result XLA may divide among threads, and then the kernel does not link: it gets a second one."""
    number = len(closed.out_avals)
    if not number:
        return closed

    def body(*args):
        found = jaxpr_as_fun(closed)(*args)
        if number > 1 or found[0].size <= 1:
            return found
        return [*found, _first(next((x for x in args if x.size), found[0]))]  # of what is known before all else

    body.__name__ = ONCE
    call = _with_attributes(body, inlineable="false")
    return jax.make_jaxpr(lambda *args: call(*args)[:number])(*closed.in_avals)
