"""Taylor series: explicit steps of any order, whose coefficients follow from recurrences.

With v' = w = M^-1 Q(q, v, t) as a program of few kinds of operations on power series (`numerics/series_program.py`),
the coefficients of y(t + s) = sum_k y_k s^k follow one after the other from the state,

    w_k from q_0 .. q_k and v_0 .. v_k,    v_{k+1} = w_k / (k + 1),    q_{k+1} = v_k / (k + 1)

and a step is the sum of its series. Nothing is differentiated, and only M is solved for. The series is valid in the
whole step, so values within the step cost nothing.

A. Jorba, M. Zou, Experimental Mathematics 14 (2005) 99-117.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import eval_jaxpr

from hhtjax.checks import require_integer
from hhtjax.description import Array, PyTree, Real, is_concrete
from hhtjax.jaxpr import NotListed, listed
from hhtjax.numerics.approximate_math import approximate_log
from hhtjax.numerics.power_series import coefficients, rates
from hhtjax.numerics.series_program import SeriesProgram, series_program
from hhtjax.primitives import staged
from hhtjax.steppers.stepper import Info, State, Stepper
from hhtjax.steppers.variable_step import Errors

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem

SHARE = 0.1  # of the tolerance, that the last term of a step may be; theirs is exp(-2.7)
LAST = 3  # coefficients that tell the radius of convergence: of motions with a symmetry two of them may vanish
HIGHEST = 40


class Expansion(NamedTuple):
    """A series sum_k v_k s^k: (order + 1, N)."""

    coefficients: Array


@dataclass(frozen=True, eq=False)
class Taylor(Stepper):
    """Taylor series of the motion; made by `taylor`."""

    order: Any = None

    solves_internal = True
    meets_events = True
    reads_series = True
    proposes = True

    @property
    def name(self) -> str:
        """The name of the method."""
        return "taylor"

    @property
    def estimate_order(self):
        """The order of the method."""
        return 1 if self.order is None else self.order

    def for_tolerance(self, rtol: Real) -> Taylor:
        """The method with the best order for a tolerance, unless an order was given."""
        if self.order is not None:
            return self
        if not is_concrete(rtol):
            raise ValueError(
                "taylor: give `order`, such as taylor(order=12), if the tolerance is traced: the default order "
                "follows from `rtol`, and is part of the program."
            )
        return replace(self, order=order_for(float(np.min(rtol))))

    def begin(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
        """The state with w = M^-1 Q, and space for the series of a step."""
        order = self._number()
        none = Expansion(jnp.zeros((order + 1, system.size), v.dtype))
        return State(t, q, v, series_of(order, system, q, v, t, params).rates(), memory=none)

    def bind(self, system: FlatSystem, params: PyTree, dt: Array):
        """The sum of the series; the state at the end of the step keeps the series."""

        def step(s: State):
            return self.moved(system, s, params, self.expansion(system, s, params), dt), Info()

        return step

    def expansion(self, system: FlatSystem, s: State, params: PyTree) -> Expansion:
        """The series about a state."""
        return series_of(self._number(), system, s.q, s.v, s.t, params).expansion()

    def moved(self, system: FlatSystem, s: State, params: PyTree, series: Expansion, dt: Array) -> State:
        """The state at the end of a step."""
        change, v, _ = summed(series, dt)
        q, t = s.q + system.located(change), s.t + dt
        return State(t, q, v, series_of(self._number(), system, q, v, t, params).rates(), memory=series)

    def begin_estimates(self, system: FlatSystem, state: State):
        """Empty: estimates need no memory."""
        return ()

    def bind_estimated(self, system: FlatSystem, params: PyTree, dt: Array, past: tuple):
        """State -> State, Info, Errors, (). The error is estimated from the defect of the series in the equation of
        motion at the end of the step.

        past: the series, if it is known."""
        k = self._number() + 1

        def estimated(s: State):
            series = past if isinstance(past, Expansion) else self.expansion(system, s, params)
            s1 = self.moved(system, s, params, series, dt)
            e_v = (s1.w - summed(series, dt)[2]) * (dt / k)
            return s1, Info(), Errors(e_v * (dt / (k + 1)), e_v), ()

        return estimated

    def proposed(self, system: FlatSystem, s: State, params: PyTree, rtol: Array, q_size: Array, v_size: Array):
        """The series about a state, and the step from its radius of convergence R, after Jorba and Zou:

            h = R (SHARE rtol)^(1/p),    R = min_k (size / |v_k|)^(1/k)

        over the last k. sizes: (n,) and (N,), with which coefficients are compared."""
        series = self.expansion(system, s, params)
        p, V = self._number(), series.coefficients
        last = range(max(p - LAST, 0) + 1, p + 1)
        parts = [(k, jnp.max(jnp.abs(V[k]) / v_size)) for k in last]
        if system.positions:
            parts += [(k + 1, jnp.max(jnp.abs(system.located(V[k])) / q_size) / (k + 1)) for k in last]
        orders, x = (jnp.stack([jnp.asarray(y[i], V.dtype) for y in parts]) for i in (0, 1))
        tiny = float(jnp.finfo(V.dtype).tiny)
        logarithm = jnp.max(approximate_log(jnp.maximum(x, tiny)) / orders)
        return series, jnp.exp(approximate_log(SHARE * rtol) / p - logarithm)

    def _number(self) -> int:
        """The order."""
        if self.order is None:
            raise ValueError(
                "taylor: give `order`, such as taylor(order=12), or a tolerance, `dt=adaptive(rtol, atol)`, from which "
                "the order follows."
            )
        return self.order


def summed(series: Expansion, h: Array):
    """q(h) - q, v(h) and w(h), by Horner's scheme."""
    V = series.coefficients
    top = len(V) - 1
    q, v, w = V[top] * (1 / (top + 1)), V[top], V[top] * top
    for k in reversed(range(1, top)):
        q, v, w = q * h + V[k] * (1 / (k + 1)), v * h + V[k], w * h + V[k] * k
    return h * (V[0] + h * q), V[0] + h * v, w


def order_for(rtol: float) -> int:
    """The order with the least work for a tolerance, after Jorba and Zou: 1 - ln(rtol) / 2."""
    return min(max(math.ceil(1 - math.log(rtol) / 2), 2), HIGHEST)


# ----------------------------------------------------------------------------
# The series of a system at a state.


PROGRAMS: WeakKeyDictionary = WeakKeyDictionary()  # {force of a system: {what else the program depends on: it}}


class Known(NamedTuple):
    """The functions of a program on numbers (the series, and the rates alone), and the values they take in addition."""

    series: Callable
    first: Callable
    constants: list


class At(NamedTuple):
    """The functions at a state."""

    known: Known
    numbers: list

    def expansion(self) -> Expansion:
        """The series."""
        return Expansion(self.known.series(*self.numbers))

    def rates(self) -> Array:
        """w."""
        return self.known.first(*self.numbers)


def series_of(order: int, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree) -> At:
    """The series of the motion at a state."""
    leaves, structure = jax.tree.flatten(params)
    leaves = [jnp.asarray(x) for x in leaves]
    shapes = tuple((x.shape, x.dtype) for x in (q, v, t, *leaves))
    known = PROGRAMS.setdefault(system.force, {})
    key = system.mass, id(system.massless), structure, shapes, order
    if key not in known:
        program, constants = _known(system, q, v, t, leaves, structure)
        known[key] = Known(*_functions(program, system.positions, order, v.dtype), constants)
    return At(known[key], [q, v, t, *leaves, *known[key].constants])


def _functions(program: SeriesProgram, positions: int, order: int, dtype: np.dtype):
    """The functions for the series and the rates, on numbers. They do not refer to the system, which `PROGRAMS` would
    keep alive."""

    def series(*arrays: Array) -> Array:
        return coefficients(program, positions, _scalars(arrays), order, dtype)

    def first(*arrays: Array) -> Array:
        return rates(program, _scalars(arrays), dtype)

    return staged(series), staged(first)


def _known(system: FlatSystem, q: Array, v: Array, t: Array, leaves: list, structure: Any):
    """The accelerations, traced and written as a program on series, and the values that their functions close over."""

    def acceleration(q: Array, v: Array, t: Array, *leaves: Array) -> Array:
        return system.acceleration(q, v, t, structure.unflatten(leaves))

    trace = jax.make_jaxpr(acceleration)(q, v, t, *leaves)
    moving = [not is_concrete(x) for x in trace.consts]
    constants = [x for x, here in zip(trace.consts, moving, strict=True) if here]
    fixed = [np.asarray(x) for x, here in zip(trace.consts, moving, strict=True) if not here]

    def of_all(q: Array, v: Array, t: Array, leaves: list, constants: list) -> Array:
        others = iter(constants), iter(fixed)
        return eval_jaxpr(trace.jaxpr, [next(others[not here]) for here in moving], q, v, t, *leaves)[0]

    try:
        like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), (q, v, t, leaves, constants))
        with jax.ensure_compile_time_eval():  # what is known of numbers, in a program too
            listing = listed(of_all, *like, whole=True)
        return series_program(listing, list(listing.results.flat), q.size + v.size + 1), constants
    except NotListed as error:
        raise NotImplementedError(
            f"taylor: {error.name}{'' if error.line is None else f', in {error.line},'} has no Taylor series; take "
            "dopri5(), or another stepper, for a system with it."
        ) from None


def _scalars(arrays: Sequence) -> list:
    """The numbers of arrays."""
    return [x[i] for x in (y.reshape(-1) for y in arrays) for i in range(x.size)]


def taylor(order: int | None = None) -> Taylor:
    """Taylor series of the motion, of any order: explicit, for smooth motion at small tolerances.

        q(t + h) = sum_k q_k h^k,    v(t + h) = sum_k v_k h^k,    k = 0 .. order

    The coefficients follow from recurrences over the traced `mass` and `force`, at a cost of order^2 and without
    derivatives. With error control, `simulate(..., dt=adaptive(rtol, atol))`, the default order is 1 - ln(rtol)/2, 11
    for 1e-8, and a step is a fraction of the radius of convergence: its size is known in advance, and steps are hardly
    ever rejected. Samples within steps are as accurate as the ends of steps. The method is explicit like `dopri5`, and
    no better where something is stiff.

    The functions of a system may use sums, products, quotients, powers, roots, exponentials, logarithms, trigonometric
    and hyperbolic functions, their inverses, the error function, and linear solves. Operations without a Taylor series
    raise an error: `abs`, `where` with a condition that changes, tables of `sampled`, a `while_loop`. Derivatives are
    those of the steps. Custom derivative rules (`jax.custom_jvp`, `lax.stop_gradient`) in `mass` or `force` are
    ignored: what they compute is differentiated.

    Args:
        order: from 2 to 40; None: from the tolerance.

    Returns:
        A stepper.

    Raises:
        TypeError, ValueError: an order that is not an integer, or below 2 or above 40.
        NotImplementedError: in the first call, for an operation without a Taylor series; it is named with its line.

    References:
        Jorba, Zou, Experimental Mathematics 14, 2005, 99-117.

    >>> import hhtjax, jax.numpy as jnp
    >>> pendulum = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -jnp.sin(q))
    >>> start = jnp.array([3.0]), jnp.array([0.0])
    >>> run = hhtjax.simulate(pendulum, hhtjax.taylor(), *start, dt=hhtjax.adaptive(1e-12, 1e-12), times=[5.0, 10.0])
    >>> energy = run.v[:, 0] ** 2 / 2 - jnp.cos(run.q[:, 0])
    >>> bool(jnp.max(jnp.abs(energy - energy[0])) < 1e-11)
    True
    """
    if order is not None:
        order = require_integer("taylor", "order", order)
        if not 2 <= order <= HIGHEST:
            raise ValueError(f"taylor: `order` must be from 2 to {HIGHEST}; received {order}.")
    return Taylor(order)
