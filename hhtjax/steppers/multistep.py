"""Houbolt's and Park's methods: backward differences over four times, solved by Newton. Classical baselines.

J. Houbolt, J. Aeronautical Sciences 17, 1950, 540-550; K. Park, J. Applied Mechanics 42, 1975, 464-470.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics.dense_lu import factorize
from hhtjax.steppers.implicit_solve import newton
from hhtjax.steppers.options import Options, check_options
from hhtjax.steppers.residual import residual
from hhtjax.steppers.rosenbrock import rosenbrock
from hhtjax.steppers.stepper import Info, State, Stepper

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem

STARTER = rosenbrock(rho_inf=0.0)  # of the first two steps: order 2 and damped at infinity, as what follows


class Memory(NamedTuple):
    """q, v: (2, n), their changes in the last step and in the one before; count: the number of steps taken."""

    q: PyTree
    v: PyTree
    count: Array


@dataclass(frozen=True, eq=False)
class Multistep(Stepper):
    """Base class of both methods, which differ only in `advance`."""

    order: int
    options: Options

    needs_equal_steps = True
    first_steps = 2

    def advance(self, system: FlatSystem, s, past, dt: Array, w):
        """q and v at t + dt, given the acceleration there."""
        raise NotImplementedError

    def begin(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
        """w0 = M^-1 Q, with an empty memory."""
        unknown = jnp.zeros((2, v.size), v.dtype)
        memory = Memory(unknown[:, : q.size], unknown, jnp.zeros((), jnp.int32))
        return State(t, q, v, system.acceleration(q, v, t, params), memory=memory)

    def jumped(self, system: FlatSystem, before, after, old, new, dt: Array, answer):
        """`after`, where held inputs jump, with an empty memory, because w is different before the jump."""
        return after._replace(memory=after.memory._replace(count=jnp.zeros_like(after.memory.count)))

    def bind(self, system: FlatSystem, params: PyTree, dt: Array):
        """Newton on M(q1) w1 = Q(q1, v1, t1); the first two steps are taken by the starting method."""
        r = partial(residual, system, params)
        start = STARTER.bind(system, params, dt)

        def first(s: State):
            s1, _ = start(s)
            return s1, Info(jnp.max(jnp.abs(r(s1))), jnp.zeros((), jnp.int32), jnp.array(True))

        def later(s: State, past: Memory):
            def path(w: Array):
                q, v = self.advance(system, s, past, dt, w)
                return State(s.t + dt, q, v, w)

            w, info = newton(system, r, path, s.w, s, factorize, self.options.tolerance, self.options.max_iterations)
            return path(w), info

        def step(s: State):
            past, now = s.memory, s._replace(memory=None)
            s1, info = lax.cond(past.count < self.first_steps, lambda: first(now), lambda: later(now, past))
            q, v = jnp.stack([s1.q - s.q, past.q[0]]), jnp.stack([s1.v - s.v, past.v[0]])
            return s1._replace(memory=Memory(q, v, past.count + 1)), info

        return step


class Houbolt(Multistep):
    """Houbolt's method; made by `houbolt`."""

    def advance(self, system: FlatSystem, s: State, past: Memory, dt: Array, w: Array):
        """Uses differences, which lose less to rounding than the values of q."""
        if not system.positions:
            return s.q, s.v + (6 * dt * w + 7 * past.v[0] - 2 * past.v[1]) / 11
        dq = (dt**2 * w + 3 * past.q[0] - past.q[1]) / 2
        return s.q + dq, (11 * dq - 7 * past.q[0] + 2 * past.q[1]) / (6 * dt)


class Park(Multistep):
    """Park's method; made by `park`."""

    def advance(self, system: FlatSystem, s: State, past: Memory, dt: Array, w: Array):
        """The same formula gives v from w, and q from v."""
        v = s.v + (6 * dt * w + 5 * past.v[0] - past.v[1]) / 10
        return s.q + (system.located(6 * dt * v) + 5 * past.q[0] - past.q[1]) / 10, v


def houbolt(tolerance: Real = 1e-10, max_iterations: int = 20) -> Houbolt:
    """Houbolt's method: velocity and acceleration at t1 are the derivatives of the cubic through q1, q, q_-1, q_-2.

        w1 = (2 q1 - 5 q + 4 q_-1 - q_-2)/h^2,   v1 = (11 q1 - 18 q + 9 q_-1 - 2 q_-2)/(6 h)
        M(q1) w1 = Q(q1, v1, t1)

    Order 2, unconditionally stable, spectral radius 0 at infinite frequency. It damps low frequencies more than any
    other method of order 2 here: the damping ratio is 5e-4 for omega h = 0.1. v is a difference quotient of q, so it
    has a rounding error of 1e-16 |q|/h. A first-order system is solved by BDF3, y1' = (11 y1 - 18 y + 9 y_-1 - 2
    y_-2)/(6 h), of order 3.

    The first two steps, and two steps after each jump of a held input, are taken by `rosenbrock(rho_inf=0)`. Steps must
    be equal.

    Args:
        tolerance, max_iterations: of Newton's iteration, as in `hht`.

    Returns:
        A `Stepper`.

    Raises:
        ValueError, TypeError: an argument out of its range or of the wrong kind.

    References:
        Houbolt (1950); Cardona, Geradin (1989), Sec. 2.

    >>> import hhtjax
    >>> hhtjax.houbolt().order
    2
    """
    return Houbolt(2, check_options("houbolt", iterations=None, tolerance=tolerance, max_iterations=max_iterations))


def park(tolerance: Real = 1e-10, max_iterations: int = 20) -> Park:
    """Park's method: the mean of the two-step and three-step backward differentiation formulas.

        v1 = (10 q1 - 15 q + 6 q_-1 - q_-2)/(6 h),   w1 = (10 v1 - 15 v + 6 v_-1 - v_-2)/(6 h)
        M(q1) w1 = Q(q1, v1, t1)

    Order 2, unconditionally stable, spectral radius 0 at infinite frequency, with little damping at low frequencies:
    the damping ratio is 8e-7 for omega h = 0.1. The first two steps, and two steps after each jump of a held input, are
    taken by `rosenbrock(rho_inf=0)`. Steps must be equal.

    Args:
        tolerance, max_iterations: of Newton's iteration, as in `hht`.

    Returns:
        A `Stepper`.

    Raises:
        ValueError, TypeError: an argument out of its range or of the wrong kind.

    References:
        Park (1975); Cardona, Geradin (1989), Sec. 2.

    >>> import hhtjax
    >>> hhtjax.park().order
    2
    """
    return Park(2, check_options("park", iterations=None, tolerance=tolerance, max_iterations=max_iterations))
