"""Mass, inertia and force of Lagrange's equations by autodiff. Classes: equal Lagrangians give equal systems."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from hhtjax.xla import traced


@dataclass(frozen=True)
class LagrangianMass:
    """M(q, t) = d2L/dv2, which no v enters: at v = 0."""

    lagrangian: Callable
    is_lagrangian = True  # knows no rotations

    def __call__(self, q, t, params):
        zero, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, q))
        return jax.hessian(lambda v: self.lagrangian(q, unravel(v), t, params))(zero)


@dataclass(frozen=True)
class LagrangianInertia:
    """M(q, t) w, the derivative of the momentum dL/dv in the direction w: one column of the Hessian, not all."""

    lagrangian: Callable

    def __call__(self, q, w, t, params):
        q, w = (jax.tree.map(jnp.asarray, x) for x in (q, w))
        zero = jax.tree.map(jnp.zeros_like, w)
        return product_at(self.lagrangian, q, zero, w, t, params)


def product_at(lagrangian, q, v, w, t, params):
    """d2L/dv2 w at a velocity."""
    momentum = jax.grad(lambda v: lagrangian(q, v, t, params))
    return jax.jvp(momentum, (v,), (w,))[1]


def mass_reads_velocity(lagrangian, q, v, t, params):
    """Whether d2L/dv2 depends on v, so that L is none of a mass matrix; looked at where v enters it at all."""
    flat, unravel = ravel_pytree(v)
    some = jnp.asarray(1 + 0.618 * np.arange(flat.size) % 0.5, flat.dtype)

    product = traced(lambda v: ravel_pytree(product_at(lagrangian, q, unravel(v), unravel(some), t, params))[0], flat)
    if not product.reads(None)[0]:
        return jnp.array(False)
    rest, far = product(jnp.zeros_like(flat)), 1 + jnp.max(jnp.abs(flat))
    changes = jnp.stack([product(x) - rest for x in (flat, flat + 0.01 * far * some, flat - far * some)])
    rounding = max(1e-6, 1e3 * float(jnp.finfo(flat.dtype).eps))
    return lax.stop_gradient(jnp.any(jnp.abs(changes) > rounding * jnp.max(jnp.abs(rest))))  # not where it is NaN


@dataclass(frozen=True)
class LagrangianForce:
    """Q(q, v, t) = F + dL/dq - d/ds (dL/dv)(q + s v, t + s)."""

    lagrangian: Callable
    force: Callable | None

    def __call__(self, q, v, t, params):
        q, v = (jax.tree.map(jnp.asarray, x) for x in (q, v))
        t = jnp.asarray(t, jnp.result_type(*jax.tree.leaves(q)))

        def momentum(q, t):
            return jax.grad(self.lagrangian, argnums=1)(q, v, t, params)

        _, convective = jax.jvp(momentum, (q, t), (v, jnp.ones_like(t)))
        Q = jax.tree.map(jnp.subtract, jax.grad(self.lagrangian)(q, v, t, params), convective)
        return Q if self.force is None else jax.tree.map(jnp.add, Q, self.force(q, v, t, params))


@dataclass(frozen=True)
class InternalLagrangianForce:
    """The same where F depends on internal states z too."""

    lagrangian: Callable
    force: Callable | None

    def __call__(self, q, v, z, t, params):
        Q = LagrangianForce(self.lagrangian, None)(q, v, t, params)
        return Q if self.force is None else jax.tree.map(jnp.add, Q, self.force(q, v, z, t, params))
