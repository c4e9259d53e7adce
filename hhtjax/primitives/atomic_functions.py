"""Functions that stay a single operation of the program under autodiff and vmap.

Autodiff and vmap write out the operations of a function again each time they transform it. For a primitive they only
use its rule; its operations are written once, when the program is lowered. This saves tracing: finite rotations and
cross products had been a quarter of all operations that JAX traced for the gradient of a chain of bodies.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jax.sharding import AxisType

from hhtjax.description import Array
from hhtjax.primitives.compat import is_on
from hhtjax.primitives.interpreter import holds_jaxprs
from hhtjax.primitives.two_mode_derivative import batch_size, in_front

if TYPE_CHECKING:
    from jax.extend.core import ClosedJaxpr


@dataclass(frozen=True, eq=False)
class Family:
    """The function (n, x) -> (the first n functions of a family at a floating array x), a tuple, as one operation.

    Attributes:
        members: (n, x) -> the tuple; each entry is like x and computed elementwise.
        rule: (this function, n, x, dx) -> tuples of values and tangents, computed with other members of the family.

    >>> waves = Family(
    ...     lambda n, x: tuple(jnp.sin(x + k * jnp.pi / 2) for k in range(n)),
    ...     lambda waves, n, x, dx: (waves(n, x), tuple(y * dx for y in waves(n + 1, x)[1:])))
    >>> [round(float(jax.grad(lambda x: waves(2, x)[k])(0.0)), 6) + 0.0 for k in range(2)]
    [1.0, 0.0]
    """

    members: Callable
    rule: Callable

    def __call__(self, n: int, x: Array):
        x = jnp.asarray(x)
        if not _is_one(x):
            return self.plain(n, x)
        return tuple(family_p.bind(x, n=n, family=self, jaxpr=self.plain.trace(n, x).jaxpr))

    @cached_property
    def plain(self):
        """The same on plain JAX."""
        members = jax.custom_jvp(self.members, nondiff_argnums=(0,))
        members.defjvp(lambda n, x, dx: self.rule(self.plain, n, *x, *dx))
        return jax.jit(members, static_argnums=0)


@dataclass(frozen=True, eq=False)
class Bilinear:
    """The bilinear function f of two arrays as one operation. Both arrays have the same number of leading batch axes.

    Attributes:
        f: (x, y) -> z, for any number of leading axes.
        first: (z, y) -> x, the transpose of x -> f(x, y).
        second: (x, z) -> y, the transpose of y -> f(x, y).

    >>> inner = Bilinear(
    ...     lambda x, y: jnp.sum(x * y, axis=-1), lambda z, y: z[..., None] * y, lambda x, z: z[..., None] * x)
    >>> print(jax.grad(inner)(jnp.array([1.0, 2.0]), jnp.array([3.0, 4.0])))
    [3. 4.]
    """

    f: Callable
    first: Callable
    second: Callable

    def __call__(self, x: Array, y: Array) -> Array:
        dtype = jnp.result_type(x, y)
        x, y = (jnp.asarray(z, dtype) for z in (x, y))
        if not _is_one(x, y):
            return self.plain(x, y)
        return bilinear_p.bind(x, y, product=self, jaxpr=self.plain.trace(x, y).jaxpr)

    @cached_property
    def plain(self):
        """The same on plain JAX."""
        return jax.jit(self.f)


@dataclass(frozen=True, eq=False)
class Linear:
    """The linear function f of an array as one operation, with its transpose, for any number of leading batch axes.

    Attributes:
        f: x -> y.
        transposed: y -> x.

    >>> first = Linear(lambda x: x[..., :1], lambda y: jnp.concatenate([y, 0 * y], axis=-1))
    >>> print(jax.grad(lambda x: 3 * first(x)[0])(jnp.array([1.0, 2.0])))
    [3. 0.]
    """

    f: Callable
    transposed: Callable

    def __call__(self, x: Array) -> Array:
        x = jnp.asarray(x)
        if not _is_one(x):
            return self.plain(x)
        return linear_p.bind(x, map=self, jaxpr=self.plain.trace(x).jaxpr)

    @cached_property
    def transpose(self) -> Linear:
        """The transpose, whose own is this."""
        found = Linear(self.transposed, self.f)
        vars(found)["transpose"] = self
        return found

    @cached_property
    def plain(self):
        """The same on plain JAX."""
        return jax.jit(self.f)


def _is_one(*arrays: Array) -> bool:
    """Whether to use one operation: not if types say how arrays are distributed over devices (needs JAX's rules)."""
    return is_on() and not any(map(_is_spread, map(jax.typeof, arrays)))


def _is_spread(kind) -> bool:
    manual, mesh = getattr(kind, "manual_axis_type", None), kind.sharding.mesh  # older ones do not know of it
    return (manual is not None and not manual.empty) or AxisType.Explicit in getattr(mesh, "axis_types", ())


def _jvp_of_family(x: tuple, dx: tuple, n: int, family: Family, jaxpr: ClosedJaxpr):
    return tuple(map(list, family.rule(family, n, *x, *map(ad.instantiate_zeros, dx))))


def _batch_of_families(x: tuple, axes: tuple, n: int, family: Family, jaxpr: ClosedJaxpr):
    return list(family(n, *x)), [*axes] * n


def _batch_of_products(values: tuple, axes: tuple, product: Bilinear, jaxpr: ClosedJaxpr):
    size = batch_size(values, axes)
    return product(*(in_front(x, axis, size) for x, axis in zip(values, axes, strict=True))), 0


family_p = holds_jaxprs(Primitive("hhtjax_family"))
family_p.multiple_results = True
family_p.def_impl(lambda x, n, family, jaxpr: list(family.plain(n, x)))
family_p.def_abstract_eval(lambda x, n, family, jaxpr: [x.update(weak_type=False)] * n)
ad.primitive_jvps[family_p] = _jvp_of_family
batching.primitive_batchers[family_p] = _batch_of_families


bilinear_p = holds_jaxprs(Primitive("hhtjax_bilinear"))
bilinear_p.def_impl(lambda x, y, product, jaxpr: product.plain(x, y))
bilinear_p.def_abstract_eval(lambda x, y, product, jaxpr: jaxpr.out_avals[0])
ad.defbilinear(
    bilinear_p,
    lambda z, x, y, product, jaxpr: product.first(z, y),
    lambda z, x, y, product, jaxpr: product.second(x, z),
)
batching.primitive_batchers[bilinear_p] = _batch_of_products


linear_p = holds_jaxprs(Primitive("hhtjax_map"))
linear_p.def_impl(lambda x, map, jaxpr: map.plain(x))
linear_p.def_abstract_eval(lambda x, map, jaxpr: jaxpr.out_avals[0])
ad.deflinear2(linear_p, lambda z, x, map, jaxpr: [map.transpose(z)])
batching.primitive_batchers[linear_p] = lambda x, axes, map, jaxpr: (map(jnp.moveaxis(x[0], axes[0], 0)), 0)


for operation in (family_p, bilinear_p, linear_p):
    mlir.register_lowering(
        operation, mlir.lower_fun(lambda *x, jaxpr, **_: jaxpr_as_fun(jaxpr)(*x), multiple_results=True)
    )
