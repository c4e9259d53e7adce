"""The generalised-alpha step with constraints, in index-3 form and stabilised (GGL).

The residual of the step gets rows for the constraints, scaled so that their size does not depend on h:

    r(w1, L1, eta) = [ M(q1) w1 - Q1 - B1^T L1;  Phi(q1, t1)/(beta h^2);  (B1 v1 + Phi_t)/(gamma h) ]
    q1 = (Newmark's) - beta h^2 D eta,    D = diag(M_n)^-1 B_n^T

Index 3 has neither the last row nor eta. With both, velocities satisfy their constraint too, and the spectrum at
infinite frequency has no Jordan block, so multipliers do not grow even with the trapezoidal rule. D may have any
weights. The diagonal of M separates units, needs no solve, and gave 10 % less error on the squeezer than M.

C. Gear, B. Leimkuhler, G. Gupta, J. Comput. Appl. Math. 12-13, 1985; A. Cardona, M. Geradin, Computers & Structures 33,
1989; M. Arnold, O. Bruls, Multibody Syst. Dyn. 18, 2007.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array, PyTree
from hhtjax.numerics.dense_lu import diagonal, matvec
from hhtjax.primitives import part, staged
from hhtjax.steppers.implicit_solve import linearized_solve, newton
from hhtjax.steppers.stepper import State, join_info
from hhtjax.systems.constraints import (
    acceleration_and_multipliers,
    dependent_row,
    gradient_maps,
    jacobian,
    sparse_dependent_row,
    violation,
    violation_and_reaction,
)

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem


def begin_constrained(method, system, q: Array, v: Array, t: Array, params: PyTree) -> State:
    """w0 and L0 of the index-1 system."""
    where = method.options.linearize
    if where in ("held", "state"):
        raise ValueError(f"hht: with constraints, leave `linearize` out: it is at the predictor; received {where!r}.")
    w, L = acceleration_and_multipliers(system, q, v, t, params, method.factorize_for(system))
    return State(t, q, v, w, w, L)


def directions(system: FlatSystem, M: Array, B: Array) -> Array:
    """D: (n, m)."""
    d = system.with_ones(diagonal(M))
    return B.T / jnp.where(d == 0, 1, d)[:, None]


def sparse_directions(system: FlatSystem, params: PyTree, s: State):
    """D as a map."""
    d = system.with_ones(diagonal(system.mass(s.q, s.t, params)))
    _, pull = gradient_maps(system, s.q, s.t, params)
    return staged(lambda eta: pull(eta) / jnp.where(d == 0, 1, d))


def equations(method, system, params: PyTree, dt, s):
    """The residual of a step from s as a function of the state, the state as a function of z = (w, L, eta), and the
    initial z.

    Also the correction of the displacement by eta, as a function, and B at the start.
    """
    c, n, m = method.coefficients, system.size, system.num_constraints
    ggl = method.options.formulation == "ggl"
    sparse = system.sparse is not None
    B = None if sparse else jacobian(system, s.q, s.t, params)
    D: Any = None  # the map of eta
    if ggl and sparse:
        D = sparse_directions(system, params, s)
    elif ggl:
        D = partial(matvec, part(lambda q, B: directions(system, system.mass(q, s.t, params), B))(s.q, B))
    unit = (1 - c.alpha_m) / (1 - c.alpha_f)  # of w, by which it moves x as much as eta does

    def r(s: State) -> Array:
        force = system.residual(s.q, s.v, s.w, s.t, params)
        position, rate, pull = violation_and_reaction(system, s.q, s.v, s.t, params, s.L)
        rows = [force - pull, position / (c.beta * dt**2)]
        return jnp.concatenate(rows + [rate / (c.gamma * dt)] * ggl)

    def shift(eta: Array):
        return None if D is None else c.beta * dt**2 * D(eta)

    def path(z: Array):
        w, L, eta = z[:n], z[n : n + m], z[n + m :]
        if ggl and sparse:  # in unknowns in which eta moves nothing: see step_sparsity.py
            w = w + unit * D(eta)
        return method.arrive(system, s, dt, w, shift(eta))._replace(L=L)

    z = jnp.concatenate([s.w, s.L] + [jnp.zeros(m, s.q.dtype)] * ggl)
    return r, path, z, shift, B


def bind_constrained(method, system, params: PyTree, dt: Array):
    """The step: one Newton step from the predictor (w, L, 0), or Newton until done."""
    options, factorize = method.options, method.factorize_for(system)

    def step(s):
        r, path, z, _, B = equations(method, system, params, dt, s)
        if options.iterations is None:
            z, info = newton(system, r, path, z, s, factorize, options.tolerance, options.max_iterations)
        else:
            z, info = linearized_solve(r, path, z, factorize, again=method.estimating)
            for _ in range(options.iterations - 1):
                z, more = linearized_solve(r, path, z, factorize, again=method.estimating)
                info = join_info(info, more)
        s1 = part(lambda z: system.tidy(path(z)))(z)
        return s1, report_constraints(method, system, params, dt, s, s1, info, B)

    return step


def report_constraints(method, system, params, dt, s, s1, info, B):
    """The report of constraints: violations, and the first dependent row."""

    def dependent() -> Array:
        """The row at the start; if the step failed, at its predicted end."""
        worked = jnp.all(jnp.isfinite(s1.w))
        predicted = method.arrive(system, s, dt, s.w)
        if B is None:
            q, t = (jnp.where(worked, x, y) for x, y in ((s.q, predicted.q), (s.t, predicted.t)))
            return sparse_dependent_row(system, q, t, params)
        at_end = lambda: dependent_row(jacobian(system, predicted.q, predicted.t, params))  # noqa: E731
        return lax.cond(worked, lambda: dependent_row(B), at_end)

    constraint, rate = (jnp.max(jnp.abs(x)) for x in violation(system, s1.q, s1.v, s1.t, params))
    row = None if method.redundant else dependent()
    return info._replace(constraint=constraint, constraint_rate=rate, dependent_row=row)
