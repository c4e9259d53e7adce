"""Products as one operation, whatever becomes of them: their derivatives are products, written when the program is."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from hhtjax.xla.gate import is_on


@dataclass(frozen=True, eq=False)
class Bilinear:
    """The bilinear function of two arrays f(x, y), each with as many leading axes more as the other.

    Attributes:
        f: x, y -> z, for any number of leading axes.
        first: z, y -> x, the transpose of x -> f(x, y).
        second: x, z -> y, that of y -> f(x, y).

    >>> inner = Bilinear(lambda x, y: jnp.sum(x * y, axis=-1), lambda z, y: z[..., None] * y, lambda x, z: z[..., None] * x)
    >>> print(jax.grad(inner)(jnp.array([1.0, 2.0]), jnp.array([3.0, 4.0])))
    [3. 4.]
    """

    f: Callable
    first: Callable
    second: Callable

    def __call__(self, x, y):
        if not is_on():
            return self.plain(x, y)
        x, y = jnp.asarray(x), jnp.asarray(y)
        return bilinear_p.bind(x, y, product=self, jaxpr=traced(self, (x.shape, y.shape), (x.dtype, y.dtype)))

    @cached_property
    def plain(self):
        """The same without an operation of its own."""
        return jax.jit(self.f)


@cache
def traced(product, shapes, dtypes):
    """The product, written out."""
    return jax.make_jaxpr(product.f)(*map(jax.ShapeDtypeStruct, shapes, dtypes))


def _shape(x, y, product, jaxpr):
    (z,) = jaxpr.out_avals
    return z.update(weak_type=False)


def _batched(values, axes, product, jaxpr):
    number = next(x.shape[axis] for x, axis in zip(values, axes, strict=True) if axis is not None)
    x, y = (
        jnp.broadcast_to(x, (number, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(values, axes, strict=True)
    )
    return product(x, y), 0


bilinear_p = Primitive("hhtjax_bilinear")
bilinear_p.def_impl(lambda x, y, product, jaxpr: product.plain(x, y))
bilinear_p.def_abstract_eval(_shape)
ad.defbilinear(
    bilinear_p,
    lambda z, x, y, product, jaxpr: product.first(z, y),
    lambda z, x, y, product, jaxpr: product.second(x, z),
)
batching.primitive_batchers[bilinear_p] = _batched
mlir.register_lowering(
    bilinear_p, mlir.lower_fun(lambda x, y, product, jaxpr: jaxpr_as_fun(jaxpr)(x, y), multiple_results=True)
)
