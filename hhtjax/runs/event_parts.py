"""What a step across events is made of: how to step, what the run carries along, and what is left of the step."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from hhtjax.description import freeze, thaw
from hhtjax.numerics.seldom import choose
from hhtjax.runs.loop import resized_step
from hhtjax.systems import held
from hhtjax.xla import staged

SHORT = 1e-6  # part of a step: a rest that needs no step


class Ways(NamedTuple):
    """How to step, and what to look for."""

    flat: Any
    stepper: Any
    events: Any
    max_events: int
    no_info: Any
    reach: Any  # of `reaching`
    keep: int = 0  # how many events are noted
    middle: Any = None  # of the step, where inputs are held

    def during(self, params, t, h):
        """The same in a step h from t on."""
        return self._replace(middle=t + h / 2) if held.holds(params) else self

    @property
    def slots(self):
        """How often a step is looked at. Between events that divide it, of which there may be max_events, each noted
        one may happen once, and one that only seemed to touch its guard; in the end there is none."""
        return (self.max_events + 1) * (2 + sum(self.events.noted))

    def params(self, params, modes):
        """Those with these modes, as they are in this step."""
        params = self.events.with_modes(params, modes)
        return params if self.middle is None else held.held_at(params, self.middle)


class Met(NamedTuple):
    """What a run with events carries along: numbers that switches changed, whether it has ended, what went wrong (code
    and event), the `Log`, where it is read off between its steps the pieces of the last, and of each event with known
    times how many of them are over."""

    modes: list
    ended: Any
    code: Any
    event: Any
    log: Any = None
    pieces: Any = None
    over: Any = ()


class Part(NamedTuple):
    """What is left of a step: from `start` to `end`, of the size `rest`; `last` is the size start.a is made for.

    Of each event: whether it is behind the motion, though the guard may not say so; whether it was met at the start,
    beside others; whether it is still to happen there."""

    start: Any
    end: Any
    info: Any
    rest: Any
    last: Any
    met: Met
    divided: Any  # number of events that came before and divided the step
    asked: Any  # whether there may be one
    passed: Any
    beside: Any
    due: Any

    @classmethod
    def whole(cls, ways, start, end, info, h, last, met, asked=False):
        """A step."""
        none, no = jnp.zeros(len(ways.events.noted), bool), jnp.zeros_like(met.ended)
        return cls(start, end, info, h, last, met, jnp.zeros_like(met.event), no | asked, none, none, none)


def go(ways, params, s, tau, last, h):
    """The step tau from a state, and its `Info`; a Taylor polynomial where tau is very short, 0 or a rounding below."""
    return ways.reach(freeze(params), s, tau, last, h)


def reaching(flat, stepper, no_info):
    """What `go` calls: one function for all places of a program, so that it is traced once."""

    @staged
    def reach(params, s, tau, last, h):
        short = tau <= SHORT * h
        s1, info = resized_step(flat, stepper, thaw(params), jnp.maximum(tau, SHORT * h), last)(s)
        return choose(short, drifted(flat, s, tau), s1), choose(short, no_info, info)

    return reach


def drifted(flat, s, h):
    """The state a very short time h later."""
    s1 = s._replace(t=s.t + h, q=flat.move(s.q, h * (s.v + h / 2 * s.w)), v=s.v + h * s.w)
    return flat.tidy(s1)
