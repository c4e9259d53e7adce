"""The matrix of the step of a linear system, or of the linear part of one, factorised once for a whole run."""

from functools import partial

import jax
import jax.numpy as jnp

from hhtjax.numerics import panels
from hhtjax.numerics.elimination import by_factors
from hhtjax.numerics.linear_solve import reuse
from hhtjax.numerics.low_rank import Constant
from hhtjax.numerics.sparse_solve import changing, kept
from hhtjax.steppers.residual import residual
from hhtjax.steppers.stepper import State
from hhtjax.systems.flat_system import Factors


def factorized_once(method, system, params, dt):
    """The factorised matrix of a linear system, in the place of `factorize`."""
    if system.knows_matrices and method.options.solve is None:
        return kept(step_matrix(method, system, params, dt))
    known = known_inverse(system)
    return reuse(method.factorize, known or method.factorize(step_matrix(method, system, params, dt)))


def known_inverse(system):
    """The solve with the matrix of the step, where its factors are known."""
    return None if system.factors is None else by_factors(system.factors.step)


def factors_of(method, start, system, dt):
    """The `Factors` of a linear system of constant matrices; start: the method with whose matrix a run starts."""
    if method.options.solve is not None:
        return None
    step, first = (panels.lu(step_matrix(x, system, None, dt)) for x in (method, start))
    M = system.mass(jnp.zeros(system.size, dt.dtype), 0 * dt, None)
    return Factors(None if M.ndim == 1 else panels.lu(M), first, step)


def linear_part(method, system, params, dt):
    """A `Changing` that knows the linear part, and adds the Jacobian of a force beside it at each state.

    None where there is no such part to be kept; also of a linear system without friction, for which it is all.
    """
    local = system.local
    if method.options.solve is not None:
        return None
    if local is not None:
        return with_local(step_matrix(method, local.linear, params, dt), local, params, known_inverse(system))
    if system.linear and system.friction is not None:
        return Constant(step_matrix(method, system, params, dt), known_inverse(system))
    return None


def with_local(A, local, params, inverse=None):
    """The `Changing` of the matrix of the linear part, and the Jacobian of the force beside it."""

    def slope(s):
        return jax.linearize(lambda s: local.force(s.q, s.v, s.t, params), s)[1]

    if A.ndim == 1 and local.size is None:  # the force beside it has a full Jacobian
        A = jnp.diag(A)
    return changing(A, slope, local.spread, local.size, inverse)


def step_matrix(method, system, params, dt):
    """The matrix of the step of a linear system; a diagonal one (n,)."""
    zero = jnp.zeros(1 if system.knows_matrices else system.size, dt.dtype)
    rest = State(jnp.zeros_like(dt), zero, zero, zero, zero)
    path = partial(method.arrive, system, rest, dt)
    if system.knows_matrices:
        _, change = jax.jvp(path, (zero,), (jnp.ones_like(zero),))  # the same for every unknown
        return system.step_matrix(params, change.w[0], change.v[0], change.q[0])
    return jax.jacfwd(lambda w: residual(system, params, path(w)))(zero)
