"""What a step across events is made of: how to step, what the run carries along, and what is left of the step."""

from typing import Any, NamedTuple

from hhtjax.systems import held


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

    def params(self, params, modes):
        """Those with these modes, as they are in this step."""
        params = self.events.with_modes(params, modes)
        return params if self.middle is None else held.held_at(params, self.middle)


class Met(NamedTuple):
    """What a run with events carries along: numbers that switches changed, whether it has ended, what went wrong (code
    and event), the `Log`, and, where it is read off between its steps, the pieces of the last."""

    modes: list
    ended: Any
    code: Any
    event: Any
    log: Any = None
    pieces: Any = None


class Part(NamedTuple):
    """What is left of a step: from `start` to `end`, of the size `rest`; `last` is the size start.a is made for."""

    start: Any
    end: Any
    info: Any
    rest: Any
    last: Any
    met: Met
    divided: Any  # whether an event came before
    asked: Any  # whether there may be one
