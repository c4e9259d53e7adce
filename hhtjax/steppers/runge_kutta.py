"""Explicit baseline: the classical Runge-Kutta method."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import is_concrete
from hhtjax.numerics.dense_lu import SCALAR
from hhtjax.primitives import staged
from hhtjax.steppers.stepper import Info, State, Stepper
from hhtjax.steppers.variable_step import Embedded, Errors


@dataclass(frozen=True, eq=False)
class RK4(Stepper):
    """Classical Runge-Kutta; made by `rk4`."""

    order: int = 4

    solves_internal = True
    meets_events = True
    keeps_sparse = True

    def begin(self, system, q, v, t, params, dt):
        """w0 = M^-1 Q, the first stage of the first step."""
        return State(t, q, v, system.acceleration(q, v, t, params))

    def bind(self, system, params, dt):
        """Four stages; the first is the acceleration that the step before ended with."""
        acceleration = staged(lambda q, v, t: system.acceleration(q, v, t, params), system.size)

        def step(s):
            def stage(t, dq, dv):
                v = s.v + dv
                return v, acceleration(s.q + system.located(dq), v, t)

            v1, w1 = s.v, s.w
            v2, w2 = stage(s.t + dt / 2, dt / 2 * v1, dt / 2 * w1)
            v3, w3 = stage(s.t + dt / 2, dt / 2 * v2, dt / 2 * w2)
            v4, w4 = stage(s.t + dt, dt * v3, dt * w3)
            q = s.q + system.located(dt / 6 * (v1 + 2 * v2 + 2 * v3 + v4))
            v = s.v + dt / 6 * (w1 + 2 * w2 + 2 * w3 + w4)
            return State(s.t + dt, q, v, acceleration(q, v, s.t + dt)), Info()

        return step


def rk4() -> RK4:
    """The classical Runge-Kutta method, for the first-order form (q, v)' = (v, M^-1 Q).

    Order 4, explicit: four solves with M per step, and unstable once w h > 2.83 for any natural
    frequency w of the system, resolved or not. The method of choice where nothing is stiff.

    >>> import hhtjax
    >>> hhtjax.rk4().order
    4
    """
    return RK4()


# ----------------------------------------------------------------------------
# An explicit Runge-Kutta pair with an error estimate and dense output: Dormand and Prince's, of order 5(4).
#
# Coefficients: J. Dormand, P. Prince, J. Comput. Appl. Math. 6, 1980, 19-26, Table 2; dense output of order 4: L.
# Shampine, Math. Comp. 46, 1986, 135-150, in the form of E. Hairer, S. Norsett, G. Wanner, Solving Ordinary
# Differential Equations I, Sec. II.6, which is the cubic Hermite polynomial and one more term, s^2 (1 - s)^2 h sum d_i
# k_i.


A = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (
        35 / 384,
        0.0,
        500 / 1113,
        125 / 192,
        -2187 / 6784,
        11 / 84,
    ),  # the end of the step, and the next one's first stage
)
STAGES = 7
ERROR = 71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40  # order 5 minus order 4
DENSE = (
    *(-12715105075 / 11282082432, 0.0, 87487479700 / 32700410799, -10690763975 / 1880347072),
    *(701980252875 / 199316789632, -1453857185 / 822651844, 69997945 / 29380423),
)


@dataclass(frozen=True, eq=False)
class DormandPrince(Embedded, Stepper):
    """The pair; made by `dopri5`."""

    order: int = 5

    solves_internal = True
    meets_events = True
    keeps_sparse = True
    estimate_order = 5
    dense_term = True

    def begin(self, system, q, v, t, params, dt):
        """w0 = M^-1 Q, the first stage of the first step."""
        return State(t, q, v, system.acceleration(q, v, t, params), memory=Errors(0 * q, 0 * v))

    def bind(self, system, params, dt):
        """The step without its estimate."""
        step = self.bind_pair(system, params, dt)

        def plain(s):
            return step(s)[:2]

        return plain

    def bind_pair(self, system, params, dt):
        """Six stages; the first is the acceleration that the step before ended with."""
        acceleration = staged(lambda q, v, t: system.acceleration(q, v, t, params), system.size)

        def stage(s, node, weights, V, W):
            """q, v and w of a stage, from the v and w of those before it."""
            q, v = s.q + system.located(dt * mean(weights, V)), s.v + dt * mean(weights, W)
            return q, v, acceleration(q, v, s.t + node * dt)

        def step(s):
            q, V, W = (in_a_loop if system.size > SCALAR else written_out)(stage, s)
            v = V[-1]
            dense = Errors(system.located(dt * mean(DENSE, V)), dt * mean(DENSE, W))
            end = State(s.t + dt, q, v, W[-1], memory=dense)
            return end, Info(), Errors(dt * mean(ERROR, V), dt * mean(ERROR, W))

        return step


def written_out(stage, s):
    """q at the end of a step, and the rates v and w of all stages."""
    V, W = [s.v], [s.w]
    for row in A:
        q, v, w = stage(s, sum(row), row, V, W)
        V.append(v)
        W.append(w)
    return q, V, W


def in_a_loop(stage, s):
    """The same, with one acceleration to compile in the place of six, which may take minutes."""
    rows = jnp.asarray(np.array([(*row, *(STAGES - len(row)) * (0.0,)) for row in A]), s.v.dtype)
    nodes = jnp.asarray(np.array([sum(row) for row in A]), s.v.dtype)

    def body(i, carry):
        _, V, W = carry
        row, node = (lax.dynamic_index_in_dim(x, i, keepdims=False) for x in (rows, nodes))
        q, v, w = stage(s, node, row, V, W)
        here = (jnp.arange(STAGES) == i + 1)[:, None]  # an update at i is a scatter, and no kernel, in a derivative
        return q, *(jnp.where(here, x, X) for X, x in ((V, v), (W, w)))

    V, W = (jnp.pad(x[None], ((0, STAGES - 1), (0, 0))) for x in (s.v, s.w))
    q, V, W = lax.fori_loop(0, STAGES - 1, body, (s.q, V, W))
    return q, list(V), list(W)


def mean(weights, rates):
    """Their weighted sum, without those that are known to be 0."""
    known = [(weight, k) for weight, k in zip(weights, rates, strict=True) if not is_concrete(weight) or weight]
    return sum(weight * k for weight, k in known)


def dopri5() -> DormandPrince:
    """Dormand and Prince's pair of order 5(4), for the first-order form (q, v)' = (v, M^-1 Q).

    Explicit: six solves with M per step, and unstable once w h > 1 for any undamped natural frequency w of the system
    (which grows by 1e-4 a step at w h = 1.1, by 3e-2 at 2), or r h > 3.3 for any rate r of a decay. For error control,
    `simulate(..., dt=adaptive(...))`, of what is not stiff; it refuses constraints and rotations.

    References:
        Dormand, Prince, J. Comput. Appl. Math. 6, 1980, 19-26; Shampine, Math. Comp. 46, 1986, 135-150.

    >>> import hhtjax
    >>> hhtjax.dopri5().order
    5
    """
    return DormandPrince()
