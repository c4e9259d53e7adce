"""Explicit Runge-Kutta methods, for the first-order form (q, v)' = (v, M^-1 Q), each given by its tableau.

Stage i starts from y_i = y + h sum_j A_ij k_j, at t + c_i h with c_i = sum_j A_ij, where its rates k_i are evaluated.
The step ends at y1 = y + h sum_i b_i k_i. The rate at the end is the first one of the next step. A method for error
control also has weights of an error, e = h sum_i e_i k_i. A method with dense output has weights of a correction to the
cubic.

E. Hairer, S. Norsett, G. Wanner, Solving Ordinary Differential Equations I, Sec. II.1 to II.6.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array, PyTree, is_concrete
from hhtjax.numerics.dense_lu import SCALAR
from hhtjax.primitives import row_written, staged
from hhtjax.steppers.stepper import Info, State, Stepper
from hhtjax.steppers.tableaus import CLASSICAL, DOP853, DORMAND_PRINCE, TSITOURAS, ExplicitTableau, filled
from hhtjax.steppers.variable_step import Errors, Tabulated

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem


@dataclass(frozen=True, eq=False, repr=False)
class RungeKutta(Tabulated, Stepper):
    """A method given by its tableau; made by `rk4`, `tsit5`, `dopri5` and `dop853`.

    To define your own method, give its tableau and order:

    >>> import hhtjax, jax.numpy as jnp
    >>> from hhtjax.steppers import ExplicitTableau, RungeKutta
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
    def estimate_order(self):
        """One more than the order of the embedded method."""
        return None if self.tableau.embedded_order is None else self.tableau.embedded_order + 1

    def bind_pair(self, system: FlatSystem, params: PyTree, dt: Array, estimating: bool = True):
        """State -> State, Info, Errors; the first stage uses the acceleration at the end of the previous step."""
        tableau = self.tableau
        acceleration = staged(lambda q, v, t: system.acceleration(q, v, t, params), system.size)
        rows = *tableau.A, tableau.b, *tableau.extra
        run_through = in_a_loop if system.size > SCALAR else written_out

        def step(s: State):
            def moved(weights: Sequence, rates: PyTree):
                """q and v after an increment with these weights."""
                x, y = dt * mean(weights, rates)
                return s.q + system.located(x), s.v + y

            def stage(weights: Sequence, rates: PyTree) -> Array:
                """The rates of q and v, (2, N)."""
                q, v = moved(weights, rates)
                return jnp.stack([v, acceleration(q, v, s.t + sum(weights) * dt)])

            rates = run_through(rows, stage, jnp.stack([s.v, s.w]))
            q, _ = moved(tableau.b, rates)
            v, w = rates[len(tableau.b)]
            end = State(s.t + dt, q, v, w, memory=self.dense_terms(s, lambda row: dt * mean(row, rates)))
            return end, Info(), None if tableau.error is None else Errors(*errors_of(tableau, dt, rates))

        return step


def written_out(rows: Sequence, stage: Callable, first: Array) -> PyTree:
    """The rates of all stages, unrolled; first: the rates of the first stage."""
    rates = [first]
    for row in rows:
        rates.append(stage(row, rates))
    return rates


def in_a_loop(rows: Sequence, stage: Callable, first: Array) -> Array:
    """As `written_out`, in a loop: one stage is compiled instead of many, and the tableau is data."""
    number, dtype = len(rows) + 1, first.dtype

    def body(rates: Array, row: tuple):
        i, weights = row
        return row_written(rates, stage(weights, rates), i), None

    begun = jnp.pad(first[None], ((0, number - 1), (0, 0), (0, 0)))
    return lax.scan(body, begun, (jnp.arange(1, number), jnp.asarray(filled(rows, number), dtype)))[0]


def errors_of(tableau: ExplicitTableau, dt: Array, rates: PyTree) -> Array:
    """The errors of q and v, (2, N)."""
    e = dt * mean(tableau.error, rates)
    if tableau.error_of_3 is None:
        return e
    other = 0.1 * dt * mean(tableau.error_of_3, rates)
    largest = jnp.maximum(jnp.abs(e), jnp.abs(other))
    x, y = (z / jnp.where(largest == 0, 1, largest) for z in (e, other))  # whose squares do not underflow
    return jnp.where(largest == 0, 0, largest * x**2 / jnp.sqrt(jnp.where(largest == 0, 1, x**2 + y**2)))


def mean(weights: PyTree, rates: PyTree) -> Any:
    """The weighted sum of the first len(weights) rates, without terms whose weight is known to be 0."""
    known = [(weight, k) for weight, k in zip(weights, rates, strict=False) if not is_concrete(weight) or weight]
    return sum(weight * k for weight, k in known)


def rk4() -> RungeKutta:
    """The classical Runge-Kutta method, for the first-order form (q, v)' = (v, M^-1 Q).

    Order 4, explicit: four solves with M per step. Unstable once w h > 2.83 for any natural frequency w of the system,
    whether it is resolved or not. A good choice if nothing is stiff.

    >>> import hhtjax
    >>> hhtjax.rk4().order
    4
    """
    return RungeKutta(CLASSICAL, 4)


def dopri5() -> RungeKutta:
    """Dormand and Prince's pair of order 5(4), for the first-order form (q, v)' = (v, M^-1 Q).

    Explicit: six solves with M per step. Unstable once w h > 1 for any undamped natural frequency w of the system
    (which then grows by 1e-4 a step at w h = 1.1, by 3e-2 at 2), or r h > 3.3 for any decay rate r. Use it with error
    control, `simulate(..., dt=adaptive(...))`, for motion that is not stiff. It does not support constraints and
    rotations.

    References:
        Dormand, Prince, J. Comput. Appl. Math. 6, 1980, 19-26, Table 2; dense output of order 4: Shampine, Math. Comp.
        46, 1986, 135-150.

    >>> import hhtjax
    >>> hhtjax.dopri5().order
    5
    """
    return RungeKutta(DORMAND_PRINCE, 5)


def tsit5() -> RungeKutta:
    """Tsitouras' pair of order 5(4), for the first-order form (q, v)' = (v, M^-1 Q): as `dopri5`, with smaller errors.

    Explicit: six solves with M per step. An undamped vibration of frequency w grows by 1e-4 a step at w h = 1, by 3e-2
    at 2, and r h must be below 3.5 for any decay rate r. Dense output of order 4.

    References:
        Tsitouras, Computers & Mathematics with Applications 62, 2011, 770-775.

    >>> import hhtjax
    >>> hhtjax.tsit5().order
    5
    """
    return RungeKutta(TSITOURAS, 5)


def dop853() -> RungeKutta:
    """Dormand and Prince's method of order 8(5,3) of Hairer and Wanner, for (q, v)' = (v, M^-1 Q).

    Explicit: fifteen solves with M per step, of which three are for dense output, of order 7. Unstable once w h > 5.9
    for any undamped natural frequency w of the system, or r h > 6.3 for any decay rate r. With error control it is the
    explicit method for seven to ten digits of systems that `taylor` does not support.

    References:
        Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, 2nd ed., Sec. II.5, II.6 and II.10.

    >>> import hhtjax
    >>> hhtjax.dop853().order
    8
    """
    return RungeKutta(DOP853, 8)
