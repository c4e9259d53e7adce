"""Functions of a number whose derivatives are made of others of their family, as one operation, whatever becomes of it.

Autodiff writes a function out anew wherever it differentiates it, and once more in all that it keeps. Of one operation
it asks for nothing but the rule; what the operation computes is written when the program is.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from hhtjax.xla.gate import is_on


@dataclass(frozen=True, eq=False)
class Family:
    """The function (n, x) -> the first n members of a family at a floating array x, a tuple.

    Attributes:
        members: n, x -> the tuple, each like x, element by element.
        rule: this function, n, x, dx -> values and tangents, tuples.

    >>> waves = Family(
    ...     lambda n, x: tuple(jnp.sin(x + k * jnp.pi / 2) for k in range(n)),
    ...     lambda waves, n, x, dx: (waves(n, x), tuple(y * dx for y in waves(n + 1, x)[1:])))
    >>> [round(float(jax.grad(lambda x: waves(2, x)[k])(0.0)), 6) + 0.0 for k in range(2)]
    [1.0, 0.0]
    """

    members: Callable
    rule: Callable

    def __call__(self, n, x):
        if not is_on():
            return self.plain(n, x)
        x = jnp.asarray(x)
        return tuple(family_p.bind(x, n=n, family=self, jaxpr=traced(self, n, x.shape, x.dtype)))

    @cached_property
    def plain(self):
        """The same without an operation of its own."""
        members = jax.custom_jvp(self.members, nondiff_argnums=(0,))
        members.defjvp(lambda n, x, dx: self.rule(self.plain, n, *x, *dx))
        return jax.jit(members, static_argnums=0)


@cache
def traced(family, n, shape, dtype):
    """The members, written out."""
    return jax.make_jaxpr(partial(family.members, n))(jax.ShapeDtypeStruct(shape, dtype))


def _jvp(x, dx, n, family, jaxpr):
    return tuple(map(list, family.rule(family, n, *x, *map(ad.instantiate_zeros, dx))))


def _batched(x, axes, n, family, jaxpr):
    return list(family(n, *x)), [*axes] * n


family_p = Primitive("hhtjax_family")
family_p.multiple_results = True
family_p.def_impl(lambda x, n, family, jaxpr: list(family.plain(n, x)))
family_p.def_abstract_eval(lambda x, n, family, jaxpr: [x.update(weak_type=False)] * n)
ad.primitive_jvps[family_p] = _jvp
batching.primitive_batchers[family_p] = _batched
mlir.register_lowering(
    family_p, mlir.lower_fun(lambda x, n, family, jaxpr: jaxpr_as_fun(jaxpr)(x), multiple_results=True)
)
