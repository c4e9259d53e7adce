"""What lies around the sample times, kept while steps are chosen: a run under error control in one pass.

The values are those of a run over the chosen steps, to rounding; a step that was accepted has not failed. Derivatives
and batches are those of that run, in a second pass, as is what happens within steps: events, and dry friction.
"""

from functools import partial
from typing import Any, NamedTuple

import jax

from hhtjax.numerics.seldom import choose as either
from hhtjax.runs.loop import as_solution, flaw_at_start, neutral_info, no_failure, saved
from hhtjax.runs.read_off import kept, read_off
from hhtjax.steppers.stepper import join_info


class Since(NamedTuple):
    """Of the steps since the last sample. first: what was saved at the beginning of the last; info: theirs, joined."""

    first: Any
    info: Any


class Recorder(NamedTuple):
    """How walks in one form are recorded. none: `Since` before the first try; begin, end: what is kept of a state."""

    none: Since
    begin: Any
    end: Any

    @classmethod
    def of(cls, flat, stepper, form, info):
        """info: that of a try, for its structure."""
        begin, end = form.of(partial(saved, flat)), form.of(partial(kept, flat, stepper))
        return cls(Since(begin(form.tree.state), neutral_info(info)), begin, end)

    def add(self, since, begun, accepted):
        """Since, with a try; of one that is rejected the beginning too: it is that of the next."""
        return Since(self.begin(begun.state), either(accepted, join_info(since.info, begun.info), since.info))

    def sample(self, since, state):
        """Since a sample before this state, and what lies around it: in a step, whose end this is."""
        return since._replace(info=self.none.info), (since.first, self.end(state), since.info)


def solution(problem, start, around, times, reached):
    """The `Solution` at the times, from what was kept around them."""
    flat, _, _, _, params = problem.flat()
    first, (second, extra), info = around
    flaw, failure = flaw_at_start(problem.system, flat, start, params), no_failure(jax.tree.map(lambda x: x[0], info))
    ends = [as_solution(flat, start, path, None, info, failure, flaw) for path in (first, second)]
    return read_off(flat, ends, extra, times, reached)
