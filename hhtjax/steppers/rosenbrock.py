"""Rosenbrock methods in the form of a second-order system: several solves with one factorisation, no iteration.

With the acceleration w as an unknown, a system is  q' = v,  v' = w,  0 = r(q, v, w, t) = M(q) w - Q(q, v, t). Stage i
starts from y_i = y + h sum_j A_ij k_j, y = (q, v, w), and its rates k solve, with z = h sum_j G_ij k_j,

    k_q = v_i + z_v + g h k_v,    k_v = w_i + z_w + g h k_w
    r(y_i, t + c_i h) + r_y (z + g h k) + g_i h r_t = 0,    c_i = sum_j A_ij,    g_i = g + sum_j G_ij

which leaves, for k_v, a matrix that is the same in all stages: M + g h C + g^2 h^2 K with K = (M w - Q)_q, C = -Q_v.
The derivatives are taken at (q, v, w, t), once. Then y1 = y + h sum_i b_i k_i.

E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, Sec. IV.7 and VI.3-4.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.checks import require_number
from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.dense_lu import SCALAR, factorize
from hhtjax.numerics.linear_solve import factorize_map
from hhtjax.numerics.low_rank import around
from hhtjax.numerics.sparse_solve import kept
from hhtjax.primitives import row_written, staged
from hhtjax.steppers.implicit_solve import linearized, with_local
from hhtjax.steppers.residual import residual
from hhtjax.steppers.runge_kutta import mean
from hhtjax.steppers.stepper import Info, State, Stepper
from hhtjax.steppers.tableaus import RODAS5P, ROWDA, RosenbrockTableau, filled
from hhtjax.steppers.variable_step import Errors, Tabulated

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem

FEW = 4  # stages


@dataclass(frozen=True, eq=False, repr=False)
class Rosenbrock(Tabulated, Stepper):
    """A method given by its tableau; made by `rosenbrock`, `rowda` and `rodas5p`.

    To define your own method, give its tableau and order. Here: the linearly implicit trapezoidal rule, with Euler's
    method embedded:

    >>> import hhtjax, jax.numpy as jnp
    >>> from hhtjax.steppers import Rosenbrock, RosenbrockTableau
    >>> tableau = RosenbrockTableau("mine", g=0.5, A=((), (1.0,)), G=((), (-1.0,)), b=(0.5, 0.5), embedded=(1.0, 0.0))
    >>> mine = Rosenbrock(tableau, order=2)
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q)
    >>> run = hhtjax.simulate(spring, mine, jnp.ones(1), jnp.zeros(1), dt=0.01, num_steps=100)
    >>> bool(abs(run.q[-1, 0] - jnp.cos(1.0)) < 1e-4)
    True
    """

    tableau: RosenbrockTableau
    order: int

    solves_internal = True
    meets_events = True
    keeps_sparse = True

    @property
    def estimate_order(self) -> int:
        """One more than the order of the embedded method, which is one below the order of this method."""
        return self.order

    def bind_pair(self, system: FlatSystem, params: PyTree, dt: Array, estimating: bool = True):
        """State -> State, Info, Errors; for a linear system the matrix is factorised here, once."""
        system = system.settled(params)
        g, r = self.tableau.g, partial(residual, system, params)
        zero, instant = jnp.zeros(system.size, dt.dtype), jnp.zeros_like(dt)

        ways = factorize
        if system.knows_matrices:
            A, local = system.step_matrix(params, jnp.ones_like(dt), g * dt, (g * dt) ** 2), system.local
            ways = kept(A) if local is None else with_local(A, local, params)

        def along(x: Array) -> State:
            return State(instant, system.located((g * dt) ** 2 * x), g * dt * x, x)

        def factorized(tangent: Callable, s: State | None = None):
            return factorize_map(lambda x: tangent(along(x)), zero, around(ways, lambda: (s, along)))

        if system.linear:
            once = factorized(jax.linearize(r, State(instant, zero, zero, zero))[1])

        def step(s: State):
            s = s._replace(memory=None)  # of the step before
            value, tangent = staged(partial(linearized, r), system.size)(s)
            solve = once if system.linear else factorized(tangent, s)
            end, errors = stages(system, self, s, dt, r, value, tangent, solve)
            if estimating and not system.linear:  # what the derivatives at the start do not know of the end
                d = g * dt * jnp.abs(solve(r(end)))
                errors = Errors(jnp.abs(errors.q) + g * dt * d, jnp.abs(errors.v) + d)
            return end, Info(), errors

        return step


def stages(
    system: FlatSystem,
    method: Rosenbrock,
    s: State,
    dt: Array,
    r: Callable,
    value: Array,
    tangent: Callable,
    solve: Callable,
):
    """The state at t + dt, by the formulas at the top of this file, and its errors.

    value, tangent: of r at s. The rates of a stage are those of q, v and w, (3, N).
    """
    tableau = method.tableau
    gh, none = tableau.g * dt, jnp.zeros((3, system.size), s.v.dtype)

    def increment(weights: Sequence, rates: PyTree) -> Array:
        """dt times the weighted sum of the rates."""
        return dt * (none + mean(weights, rates))

    def moved(h: Array, weights: Sequence, rates: PyTree) -> State:
        """The state after an increment with these weights, at the time t + h."""
        dq, dv, dw = increment(weights, rates)
        return State(s.t + h, s.q + system.located(dq), s.v + dv, s.w + dw)

    def start(a: Sequence, rates: PyTree):
        """The point at which a stage starts, and r there."""
        at = moved(sum(a) * dt, a, rates)
        return at, r(at)

    def stage(c: Sequence, rates: PyTree, at: State, value: Array) -> Array:
        """The rates of a stage."""
        zq, zv, zw = increment(c, rates)
        kq = at.v + zv
        shift = State(gh + sum(c) * dt, system.located(zq + gh * kq), zv, -at.w)
        kv = -solve(value + tangent(shift))
        return jnp.stack([kq + gh * kv, kv, (kv - at.w - zw) / gh])

    run_through = written_out if len(tableau.b) <= FEW or system.size <= SCALAR else in_a_loop
    rates = run_through(tableau, start, stage, (s, value))
    e_q, e_v, _ = increment([x - y for x, y in zip(tableau.b, tableau.embedded, strict=True)], rates)
    memory = method.dense_terms(s, lambda row: increment(row, rates))
    return moved(dt, tableau.b, rates)._replace(memory=memory), Errors(e_q, e_v)


def written_out(tableau: RosenbrockTableau, start: Callable, stage: Callable, first: tuple) -> PyTree:
    """The rates of all stages, unrolled. first: the point where the first stage starts, and r there."""
    started, before, rates = first, tableau.A[0], []
    for a, c in zip(tableau.A, tableau.G, strict=True):
        if a != before:
            started, before = staged(partial(start, a))(rates), a
        rates.append(staged(partial(stage, c))(rates, *started))
    return rates


def in_a_loop(tableau: RosenbrockTableau, start: Callable, stage: Callable, first: tuple) -> PyTree:
    """As `written_out`, in a loop: one stage is compiled instead of many, and the tableau is data."""
    number, size, dtype = len(tableau.b), first[1].size, first[1].dtype
    A, G = (jnp.asarray(filled(rows, number), dtype) for rows in (tableau.A, tableau.G))

    def body(rates: Array, row: tuple):
        i, a, c = row
        new = staged(lambda rates: stage(c, rates, *start(a, rates)))(rates)
        return row_written(rates, new, i), None

    return lax.scan(body, jnp.zeros((number, 3, size), dtype), (jnp.arange(number), A, G))[0]


def rosenbrock(rho_inf: Real = 0.0) -> Rosenbrock:
    """The two-stage Rosenbrock method of order 2: one Jacobian, one factorisation, two solves per step.

        g = (1/2)/(1 + sqrt((1 + rho)/2)),  A21 = g,  G21 = -2 g^2,  b = (1 - 1/(2 g), 1/(2 g))

    Order 2, A-stable; L-stable for rho = 0. rho = (1 + alpha)/(1 - alpha) damps the highest frequencies as `hht(alpha)`
    does. `solution.acceleration` has order 2 too, but order 1 for rho = 1. On linear systems its error is half (rho =
    0) to a quarter (rho = 1) of that of the trapezoidal rule.

    Where it fails: its Jacobian is evaluated at the start of the step. If a stiff direction turns (an elastic pendulum
    on its slow manifold), or a contact begins within the step, it can need steps up to 18 times shorter than `hht`
    (`python -m experiments stability`). It does not support constraints.

    Args:
        rho_inf: rho, the spectral radius at infinite frequency, in [0, 1]; a number, or a tracer to differentiate.

    Returns:
        A `Stepper`.

    Raises:
        ValueError, TypeError: rho_inf out of its range or not a real number.

    References:
        Hairer, Wanner, Solving Ordinary Differential Equations II, Sec. IV.7 (the formulas and their conditions).

    >>> import hhtjax
    >>> round(hhtjax.rosenbrock(rho_inf=0.0).tableau.g, 6)                    # 1 - 1/sqrt(2)
    0.292893
    """
    rho = require_number("rosenbrock", "rho_inf", rho_inf, lambda x: 0 <= x <= 1, "lie in [0, 1]")
    g = 0.5 / (1 + ((1 + rho) / 2) ** 0.5)
    A, G, b = ((), (g,)), ((), (-2 * g**2,)), (1 - 0.5 / g, 0.5 / g)
    return Rosenbrock(RosenbrockTableau("rosenbrock", g, A, G, b, (1.0, 0.0)), 2)


def rowda() -> Rosenbrock:
    """ROWDAIND2, the four-stage Rosenbrock method of order 3 of Lubich and Roche: one Jacobian, one factorisation.

    Order 3, L-stable, g = 0.3; four solves and three residuals per step. Where the motion is resolved, its error is an
    eighth of that of converged HHT, or less. It fails where `rosenbrock` does, and does not support constraints.

    References:
        Lubich, Roche, Computing 43, 1990, 325-342.

    >>> import hhtjax
    >>> hhtjax.rowda().order
    3
    """
    return Rosenbrock(ROWDA, 3)


def rodas5p() -> Rosenbrock:
    """Rodas5P, Steinebach's eight-stage Rosenbrock method of order 5: one Jacobian, one factorisation, eight solves.

    Order 5, L-stable, g = 0.2119; its error estimate and its dense output have order 4. Use it for stiff motion to six
    digits and more, best with error control, `simulate(..., dt=adaptive(...))`: a step costs as much as some nine steps
    of `hht`. It does not support constraints and rotations. If steps do not resolve a stiff direction that turns, it
    fails as `rosenbrock` does.

    Returns:
        A `Stepper`.

    References:
        Steinebach, BIT Numerical Mathematics 63, 2023, article 27 (coefficients, dense output).

    >>> import hhtjax, jax.numpy as jnp
    >>> def force(q, v, t, params):                                     # which draws q to cos(t) within microseconds
    ...     return -1e8 * (q - jnp.cos(t)) - 1e6 * (v + jnp.sin(t)) - jnp.cos(t)
    >>> dt = hhtjax.adaptive(rtol=1e-8, atol=1e-10)
    >>> start = jnp.ones(1), jnp.zeros(1)
    >>> run = hhtjax.simulate(hhtjax.System(jnp.ones(1), force), hhtjax.rodas5p(), *start, dt=dt, times=[1.0])
    >>> bool(abs(run.q[-1, 0] - jnp.cos(1.0)) < 1e-8), int(run.steps.accepted) < 150
    (True, True)
    """
    return Rosenbrock(RODAS5P, 5)
