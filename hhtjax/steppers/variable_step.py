"""Steps of unequal size with order 2: the generalised-alpha family after a change of the step size.

The algorithmic acceleration a_n is the acceleration at the time t_n + s h_old, where s = alpha_m - alpha_f and h_old is
the previous step. A step h = r h_old assumes that it is the one at t_n + s h. This is an error of O(h) in a, and gives
order 1 in the end. Two rules correct it without a solve; both do nothing for r = 1:

    r <= 1    a is moved:  a := w + r (a - w)
    r > 1     a stays, and the coefficients of this step account for its time, with sigma = s/r:
              gamma = (1/2 - sigma)/(1 + s - sigma),  beta = (gamma + 1/2)^2/4,
              alpha_f := alpha_f + alpha_m (s - sigma)

The first rule alone makes alternately growing and shrinking steps unstable. The second alone loses half an order with
index 3. At r = 1, where the rules meet, a derivative in the step sizes is one-sided, with an error of O(h^3). For s = 0
(Newmark, the trapezoidal rule) no correction is needed. Steps that grow by more than 2 at once can make strongly
damping methods (rho near 0) unstable. If steps change, multipliers have only order 1.4 in index-3 form; in GGL form,
the default, they have order 2.

Without damping (alpha = 0, rho_inf = 1) constraints leave w and the multipliers one weakly stable mode: a step from
known v has w1 = -w + 2 (v1 - v)/h, with errors e1 = -e - h^2 w''/6. Equal steps keep e near -h^2 w''/12. Each change of
h^2 adds to the alternating part, which does not decay. For random steps this is a random walk: with 80 % of jitter (a
pendulum in GGL form, 100 to 6400 steps) w has order 1.47 and L 1.43; q and v have order 2.03, as have the means of w
and L over both ends of a step (2.01, 2.02). With alpha = -0.05 w and L have orders 1.98 and 1.97: use damping if they
matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from hhtjax.description import Array, PyTree, is_concrete
from hhtjax.numerics.batched_cond import call_where
from hhtjax.steppers.residual import Coefficients, weighted
from hhtjax.steppers.stepper import State, bound
from hhtjax.systems import zero_order_hold

if TYPE_CHECKING:
    from hhtjax.steppers.stepper import Stepper
    from hhtjax.systems.flat_system import FlatSystem

GROWTH = 2.05  # of a step, up to which the recursion follows


class Resizing:
    """The behaviour of the family when the step size changes: the two rules above."""

    coefficients: Coefficients

    @property
    def resizes(self) -> bool:
        """Whether a correction is needed, alpha_m != alpha_f; True for a tracer."""
        shift = self.coefficients.alpha_m - self.coefficients.alpha_f
        return not (is_concrete(shift) and shift == 0)

    def resized(self, state: State, r: Array):
        """The method and the state for a step r times as long as the previous one."""
        if not self.resizes:
            return self, state
        return replace(self, coefficients=adapted(self.coefficients, r)), moved(state, r)  # pyright: ignore[reportArgumentType]


def moved(state: State, r: Array) -> State:
    """The state with a moved to where a step r times as long expects it, for r <= 1; for vectors or pytrees."""
    shrunk = jnp.minimum(r, 1) - 1

    def move(a: Array, w: Array) -> Array:
        return a + shrunk.astype(jnp.result_type(a)) * (a - w)

    w = state.v if state.w is None else state.w  # of a first-order system as its user sees it
    a = jax.tree.map(move, state.a, w)
    return state._replace(a=a, za=None if state.za is None else jax.tree.map(move, state.za, state.zdot))


def adapted(c: Coefficients, r: Array) -> Coefficients:
    """The coefficients of a step r times as long as the previous one, for r > 1."""
    s = c.alpha_m - c.alpha_f
    grown = jnp.maximum(r, 1)
    gamma = (grown / 2 - s) / (grown * (1 + s) - s)  # not through sigma, a division to wait for
    new = Coefficients(c.alpha_m, c.alpha_f + weighted(c.alpha_m, s - s / grown), (gamma + 0.5) ** 2 / 4, gamma)
    return c._replace(**{
        name: jnp.where(grown > 1, getattr(new, name), getattr(c, name)) for name in ("alpha_f", "beta", "gamma")
    })  # fmt: skip


def drifted(flat: FlatSystem, s: State, h: Array) -> State:
    """The state a very short time h later."""
    s1 = s._replace(t=s.t + h, q=flat.move(s.q, h * (s.v + h / 2 * s.w)), v=s.v + h * s.w)
    return flat.tidy(s1)


def resized_step(flat: FlatSystem, stepper: Stepper, params: PyTree, dt: Array, last: Array, grows: bool = False):
    """State -> (State, Info) for a step dt after a step of another size; grows: whether dt may be far longer."""

    def step(state: State):
        resized, state = stepper.resized(state, dt / last)
        if grows and stepper.throws(flat):

            def begin(state: State, params: PyTree, dt: Array) -> State:
                return resized.grown(flat, state, zero_order_hold.before(params, state.t, last), dt)

            state = call_where(begin, dt > GROWTH * last, state, params, dt)
        return bound(resized, flat, params, dt, last)(state)

    return step


# ----------------------------------------------------------------------------
# The error of a step, estimated without a further factorisation: what error control is made of.
#
# Local errors of the generalised-alpha family, s = alpha_m - alpha_f (for the next two lines see Arnold, Bruls 2007):
#
#     e_q = c_q h^2 (w1 - w),    c_q = beta + s/2 - 1/6
#     e_v = c_v h^3 w'',         c_v = 1/12 - s^2/2 + s (alpha_m + alpha_f - 1)/2
#
# w'' is the second divided difference of w over this step and the one before. Both take the end of the step at its
# word. A linearisation may have missed what is there, a contact say; so the residual at the end goes through the same
# factors,
#
#     d = -S^-1 r(q1, v1, w1, t1),    e_q := |e_q| + beta k h^2 |d|,  e_v := |e_v| + gamma k h |d|,
#     k = (1 - alpha_f)/(1 - alpha_m)
#
# for one more residual and substitution. Where dry friction switches, w jumps: the jump is taken off w1 first, which so
# belongs to the branch of w, and r has the friction that the step found. What stays is the change of the other forces
# over the step: it must be resolved on both sides of the switch, whose time is found by lines. At a jump of a held
# input w jumps between two steps; its slope, of which w'' is made, does not, but for dampers.
#
# Methods of several stages have an embedded one of lower order instead, and those with a matrix g h d and g^2 h^2 d
# besides.


class Errors(NamedTuple):
    """The errors of a step, (N,): of the displacement (entries without positions have no meaning), and of the rates."""

    q: PyTree
    v: PyTree


class DenseTerm(NamedTuple):
    """The correction of dense output to cubics: s^2 (1 - s)^2 sum_k s^k e_k, s in [0, 1] from the start to the end of a
    step.

    q, v: e_k of the positions, (terms, n), and of the rates, (terms, N). Kept in `State.memory`, for the previous
    step."""

    q: Array
    v: Array


class Past(NamedTuple):
    """What the error estimate keeps of the previous step: (w1 - w)/h, and h, which is 0 before the first step."""

    slope: Any
    h: Array


class Controlled(Resizing):
    """The generalised-alpha family under error control."""

    coefficients: Coefficients
    order: int
    options: Any

    @property
    def estimate_order(self):
        """3, for methods of order 2."""
        return 3 if self.order == 2 else None

    def begin_estimates(self, system: FlatSystem, state: State) -> Past:
        """The memory before the first step."""
        return Past(jnp.zeros_like(state.w), jnp.zeros_like(state.t))

    def bind_estimated(self, system: FlatSystem, params: PyTree, dt: Array, past: Past):
        """State -> State, Info, Errors, Past, by the formulas above."""
        asks = not system.linear and self.options.iterations is not None  # else nothing is left at the end
        asks = asks or system.friction is not None  # what switched
        step = replace(self, estimating=asks).bind(system, params, dt)  # pyright: ignore[reportArgumentType, reportCallIssue]

        def estimated(s: State):
            s1, info = step(s)
            w1 = s1.w if info.switched is None else s1.w - info.switched
            errors, now = family_errors(self.coefficients, dt, s.w, w1, past, info.defect)
            return s1, info._replace(defect=None, switched=None), errors, now

        return estimated


def family_errors(c: Coefficients, h: Array, w: Array, w1: Array, past: Past, d: Array | None):
    """The errors of a step with accelerations from w to w1, and the memory for the next step; d: S^-1 r, or None."""
    s = c.alpha_m - c.alpha_f
    rate = 1 / h
    slope = (w1 - w) * rate
    jerk = jnp.where(past.h > 0, 2 / (h + past.h), rate / 2) * (slope - past.slope)  # which is 0 before the first
    e_q = jnp.abs((c.beta + s / 2 - 1 / 6) * h**2 * (w1 - w))
    e_v = jnp.abs((1 / 12 - s**2 / 2 + s * (c.alpha_m + c.alpha_f - 1) / 2) * h**3 * jerk)
    if d is not None:
        k = (1 - c.alpha_f) / (1 - c.alpha_m) * jnp.abs(d[: w.size])  # multipliers are behind
        e_q, e_v = e_q + c.beta * h**2 * k, e_v + c.gamma * h * k
    return Errors(e_q, e_v), Past(slope, h)


class Embedded:
    """A method of several stages whose error estimate is the difference from an embedded method of lower order."""

    def begin_estimates(self, system: FlatSystem, state: State):
        """Empty: estimates need no memory."""
        return ()

    def bind(self, system: FlatSystem, params: PyTree, dt: Array):
        """The step without its estimate."""
        step = self.bind_pair(system, params, dt, estimating=False)

        def plain(s: State):
            return step(s)[:2]

        return plain

    def bind_estimated(self, system: FlatSystem, params: PyTree, dt: Array, past: tuple):
        """State -> State, Info, Errors, ()."""
        step = self.bind_pair(system, params, dt)

        def estimated(s: State):
            s1, info, errors = step(s)
            return s1, info, errors, ()

        return estimated

    def bind_pair(self, system: FlatSystem, params: PyTree, dt: Array, estimating: bool = True) -> Any:
        """State -> State, Info, Errors; estimating: whether the errors are used."""
        raise NotImplementedError


class Tabulated(Embedded):
    """An embedded method that is given by its tableau."""

    tableau: Any  # with `dense`, rows of weights, or None for cubics alone
    order: int

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name}, order={self.order})"

    @property
    def name(self) -> str:
        """The name of the method."""
        return self.tableau.name

    @property
    def dense_term(self) -> bool:
        """Whether dense output has terms beyond cubics."""
        return self.tableau.dense is not None

    def begin(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
        """w0 = M^-1 Q."""
        memory = None
        if self.dense_term:
            terms = len(self.tableau.dense)
            memory = DenseTerm(jnp.zeros((terms, *q.shape), q.dtype), jnp.zeros((terms, *v.shape), v.dtype))
        return State(t, q, v, system.acceleration(q, v, t, params), memory=memory)

    def dense_terms(self, s: State, increment: Callable) -> DenseTerm | None:
        """The correction of the dense output of a step from s to cubics. increment: weights -> changes of q and of the
        rates."""
        if not self.dense_term:
            return None
        e = jnp.stack([increment(row) for row in self.tableau.dense])
        return DenseTerm(e[:, 0, : s.q.size], e[:, 1])
