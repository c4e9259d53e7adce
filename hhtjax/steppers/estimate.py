"""The error of a step, estimated without a further factorisation: what error control is made of.

Local errors of the generalised-alpha family, s = alpha_m - alpha_f (for the next two lines see Arnold, Bruls 2007):

    e_q = c_q h^2 (w1 - w),    c_q = beta + s/2 - 1/6
    e_v = c_v h^3 w'',         c_v = 1/12 - s^2/2 + s (alpha_m + alpha_f - 1)/2

w'' is the second divided difference of w over this step and the one before. Both take the end of the step at its word.
A linearisation may have missed what is there, a contact say; so the residual at the end goes through the same factors,

    d = -S^-1 r(q1, v1, w1, t1),    e_q := |e_q| + beta k h^2 |d|,  e_v := |e_v| + gamma k h |d|,
    k = (1 - alpha_f)/(1 - alpha_m)

for one more residual and substitution. Where dry friction switches, w jumps: the jump is taken off w1 first, which so
belongs to the branch of w, and r has the friction that the step found. What stays is the change of the other forces
over the step: it must be resolved on both sides of the switch, whose time is found by lines. At a jump of a held input
w jumps between two steps; its slope, of which w'' is made, does not, but for dampers.

Methods of several stages have an embedded one of lower order instead, and those with a matrix g h d and g^2 h^2 d
besides.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp

from hhtjax.steppers.residual import Coefficients
from hhtjax.steppers.unequal import Resizing


class Errors(NamedTuple):
    """Of a step, (N,): of the displacement, whose entries beyond the positions mean nothing, and of the rates."""

    q: Any
    v: Any


class Past(NamedTuple):
    """What the estimate of the family remembers of the step before: (w1 - w)/h, and h, which is 0 before the first."""

    slope: Any
    h: Any


class Controlled(Resizing):
    """The generalised-alpha family under error control."""

    coefficients: Coefficients
    order: int
    options: Any

    @property
    def estimate_order(self):
        """3, for methods of order 2."""
        return 3 if self.order == 2 else None

    def begin_estimates(self, system, state):
        """No step before."""
        return Past(jnp.zeros_like(state.w), jnp.zeros_like(state.t))

    def bind_estimated(self, system, params, dt, past):
        """State -> State, Info, Errors, Past, by the formulas above."""
        asks = not system.linear and self.options.iterations is not None  # else nothing is left at the end
        asks = asks or system.friction is not None  # what switched
        step = replace(self, estimating=asks).bind(system, params, dt)  # pyright: ignore[reportArgumentType, reportCallIssue]

        def estimated(s):
            s1, info = step(s)
            w1 = s1.w if info.switched is None else s1.w - info.switched
            errors, now = family_errors(self.coefficients, dt, s.w, w1, past, info.defect)
            return s1, info._replace(defect=None, switched=None), errors, now

        return estimated


def family_errors(c, h, w, w1, past, d):
    """The errors of a step from the accelerations w to w1, and what is to be remembered; d: S^-1 r, or None."""
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
    """A method of several stages, among which is one of lower order: their difference is the estimate."""

    def begin_estimates(self, system, state):
        """Nothing is remembered."""
        return ()

    def bind_estimated(self, system, params, dt, past):
        """State -> State, Info, Errors, ()."""
        step = self.bind_pair(system, params, dt)

        def estimated(s):
            s1, info, errors = step(s)
            return s1, info, errors, ()

        return estimated

    def bind_pair(self, system, params, dt) -> Any:
        """State -> State, Info, Errors."""
        raise NotImplementedError
