"""Explicit Runge-Kutta methods, for the first-order form (q, v)' = (v, M^-1 Q), each given by its tableau.

Stage i starts from y_i = y + h sum_j A_ij k_j, at t + c_i h, c_i = sum_j A_ij, where its rates k_i are taken; the step
ends at y1 = y + h sum_i b_i k_i. The rate there is the first of the next step. A method for error control has weights
of an error, too, e = h sum_i e_i k_i, and one with dense output the weights of what that adds to cubics.

E. Hairer, S. Norsett, G. Wanner, Solving Ordinary Differential Equations I, Sec. II.1 to II.6.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, Real, is_concrete
from hhtjax.numerics.dense_lu import SCALAR
from hhtjax.primitives import staged
from hhtjax.steppers.stepper import Info, State, Stepper
from hhtjax.steppers.variable_step import Embedded, Errors

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem


class ExplicitTableau(NamedTuple):
    """An explicit Runge-Kutta method of s stages.

    Attributes:
        name: of the method.
        A: the rows of the stages 2 to s, those entries that are below the diagonal.
        b: (s,), the end of the step.
        error: (s + 1,), the weights (*b, 0) of the s stages and of the rate at the end of the step, less those of the
            embedded method; many sources print the negative. None without an estimate.
        embedded_order: of that method.
        dense: (s + 1,), the weights d of dense output: s^2 (1 - s)^2 h sum_i d_i k_i beside the cubic Hermite
            polynomial, s in [0, 1] from the start to the end of the step; None for cubics alone.
    """

    name: str
    A: tuple
    b: tuple
    error: tuple | None = None
    embedded_order: int | None = None
    dense: tuple | None = None


@dataclass(frozen=True, eq=False)
class RungeKutta(Embedded, Stepper):
    """A method given by its tableau; made by `rk4` and `dopri5`.

    One of your own is its tableau and its order:

    >>> import hhtjax, jax.numpy as jnp
    >>> tableau = ExplicitTableau("Heun", A=((1.0,),), b=(0.5, 0.5), error=(-0.5, 0.5, 0.0), embedded_order=1)
    >>> heun = RungeKutta(tableau, order=2)
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q)
    >>> run = hhtjax.simulate(spring, heun, jnp.ones(1), jnp.zeros(1), dt=hhtjax.adaptive(1e-4, 1e-6), times=[1.0])
    >>> bool(abs(run.q[-1, 0] - jnp.cos(1.0)) < 1e-3)
    True
    """

    tableau: ExplicitTableau
    order: int

    solves_internal = True
    meets_events = True
    keeps_sparse = True

    @property
    def name(self) -> str:
        """Of the method."""
        return self.tableau.name

    @property
    def estimate_order(self):
        """One more than the order of the embedded method."""
        return None if self.tableau.embedded_order is None else self.tableau.embedded_order + 1

    @property
    def dense_term(self) -> bool:
        """Whether dense output is more than cubics."""
        return self.tableau.dense is not None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name}, order={self.order})"

    def begin(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
        """w0 = M^-1 Q, the first stage of the first step."""
        memory = Errors(0 * q, 0 * v) if self.dense_term else None
        return State(t, q, v, system.acceleration(q, v, t, params), memory=memory)

    def bind(self, system: FlatSystem, params: PyTree, dt: Array):
        """The step without its estimate."""
        step = self.bind_pair(system, params, dt)

        def plain(s: State):
            return step(s)[:2]

        return plain

    def bind_pair(self, system: FlatSystem, params: PyTree, dt: Array):
        """State -> State, Info, Errors; the first stage is the acceleration that the step before ended with."""
        acceleration = staged(lambda q, v, t: system.acceleration(q, v, t, params), system.size)
        rows = *self.tableau.A, self.tableau.b
        run_through = in_a_loop if system.size > SCALAR else written_out

        def stage(s: State, node: Real, weights: PyTree, V: PyTree, W: PyTree):
            """q, v and w of a stage, from the v and w of those before it."""
            q, v = s.q + system.located(dt * mean(weights, V)), s.v + dt * mean(weights, W)
            return q, v, acceleration(q, v, s.t + node * dt)

        def increments(weights: tuple | None, V: list, W: list):
            """What q and v gain by these weights."""
            return None if weights is None else Errors(system.located(dt * mean(weights, V)), dt * mean(weights, W))

        def step(s: State):
            q, V, W = run_through(rows, stage, s)
            end = State(s.t + dt, q, V[-1], W[-1], memory=increments(self.tableau.dense, V, W))
            errors = self.tableau.error
            return end, Info(), None if errors is None else Errors(dt * mean(errors, V), dt * mean(errors, W))

        return step


def written_out(rows: tuple, stage: Callable, s: State):
    """q at the end of a step, and the rates v and w of all stages and of the end."""
    q, V, W = s.q, [s.v], [s.w]
    for row in rows:
        q, v, w = stage(s, sum(row), row, V, W)
        V.append(v)
        W.append(w)
    return q, V, W


def in_a_loop(rows: tuple, stage: Callable, s: State):
    """The same, with one acceleration to compile in the place of several, which may take minutes."""
    number = len(rows) + 1
    nodes = jnp.asarray(np.array([sum(row) for row in rows]), s.v.dtype)
    weights = jnp.asarray(np.array([(*row, *(number - len(row)) * (0.0,)) for row in rows]), s.v.dtype)

    def body(i: Array, carry: tuple):
        _, V, W = carry
        row, node = (lax.dynamic_index_in_dim(x, i, keepdims=False) for x in (weights, nodes))
        q, v, w = stage(s, node, row, V, W)
        here = (jnp.arange(number) == i + 1)[:, None]  # an update at i is a scatter, and no kernel, in a derivative
        return q, *(jnp.where(here, x, X) for X, x in ((V, v), (W, w)))

    V, W = (jnp.pad(x[None], ((0, number - 1), (0, 0))) for x in (s.v, s.w))
    q, V, W = lax.fori_loop(0, number - 1, body, (s.q, V, W))
    return q, list(V), list(W)


def mean(weights: Sequence, rates: Sequence) -> Any:
    """Their weighted sum, without those that are known to be 0; 0 of none."""
    known = [(weight, k) for weight, k in zip(weights, rates, strict=False) if not is_concrete(weight) or weight]
    return sum(weight * k for weight, k in known)


CLASSICAL = ExplicitTableau("RK4", A=((1 / 2,), (0.0, 1 / 2), (0.0, 0.0, 1.0)), b=(1 / 6, 1 / 3, 1 / 3, 1 / 6))

DORMAND_PRINCE = ExplicitTableau(
    "dopri5",
    A=(
        (1 / 5,),
        (3 / 40, 9 / 40),
        (44 / 45, -56 / 15, 32 / 9),
        (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
        (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    ),
    b=(35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
    error=(71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40),
    embedded_order=4,
    dense=(
        *(-12715105075 / 11282082432, 0.0, 87487479700 / 32700410799, -10690763975 / 1880347072),
        *(701980252875 / 199316789632, -1453857185 / 822651844, 69997945 / 29380423),
    ),
)


def rk4() -> RungeKutta:
    """The classical Runge-Kutta method, for the first-order form (q, v)' = (v, M^-1 Q).

    Order 4, explicit: four solves with M per step, and unstable once w h > 2.83 for any natural
    frequency w of the system, resolved or not. The method of choice where nothing is stiff.

    >>> import hhtjax
    >>> hhtjax.rk4().order
    4
    """
    return RungeKutta(CLASSICAL, 4)


def dopri5() -> RungeKutta:
    """Dormand and Prince's pair of order 5(4), for the first-order form (q, v)' = (v, M^-1 Q).

    Explicit: six solves with M per step, and unstable once w h > 1 for any undamped natural frequency w of the system
    (which grows by 1e-4 a step at w h = 1.1, by 3e-2 at 2), or r h > 3.3 for any rate r of a decay. For error control,
    `simulate(..., dt=adaptive(...))`, of what is not stiff; it refuses constraints and rotations.

    References:
        Dormand, Prince, J. Comput. Appl. Math. 6, 1980, 19-26, Table 2; dense output of order 4: Shampine, Math. Comp.
        46, 1986, 135-150.

    >>> import hhtjax
    >>> hhtjax.dopri5().order
    5
    """
    return RungeKutta(DORMAND_PRINCE, 5)
