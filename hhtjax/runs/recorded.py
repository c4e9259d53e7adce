"""What lies around the sample times, kept while steps are chosen: a run under error control in one pass.

The values are those of a run over the chosen steps, to rounding; a step that was accepted has not failed. Derivatives
and batches are those of that run, in a second pass, as is what happens within steps: events, and dry friction.
"""

from functools import partial
from typing import Any, NamedTuple

import jax

from hhtjax.numerics.seldom import choose as either
from hhtjax.runs.loop import flaw_at_start, neutral_info, no_failure, saved, with_flaw
from hhtjax.runs.output import output_at_start
from hhtjax.runs.read_off import kept, output_between, solution_at, with_output
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
    read: Any = None
    alone: bool = False  # whether that is all that is kept

    @classmethod
    def of(cls, flat, stepper, form, info, output=None, params=None, long=None):
        """info: that of a try, for its structure. output: what is read off, with params; long: of `read_between`."""
        begin, end = form.of(partial(saved, flat)), form.of(partial(kept, flat, stepper))
        since = Since(begin(form.tree.state), neutral_info(info))
        if output is None:
            return cls(since, begin, end)

        def read(first, second, time):
            return output_between(flat, output, params, ((first, None), second), time, long)

        return cls(since, begin, end, form.of(read), not output.beside_path)

    def add(self, since, begun, accepted):
        """Since, with a try; of one that is rejected the beginning too: it is that of the next."""
        return Since(self.begin(begun.state), either(accepted, join_info(since.info, begun.info), since.info))

    def sample(self, since, state, time):
        """Since a sample before this state, and what lies around it: in a step, whose end this is."""
        end = self.end(state)
        found = None if self.read is None else self.read(since.first, end, time)
        return since._replace(info=self.none.info), (
            None if self.alone else ((since.first, None), end),
            found,
            since.info,
        )


def solution(problem, start, around, times, reached):
    """The `Solution` at the times, from what was kept around them."""
    flat, _, _, _, params = problem.flat()
    around, found, info = around
    flaw, failure = flaw_at_start(problem.system, flat, start, params), no_failure(jax.tree.map(lambda x: x[0], info))
    run = solution_at(flat, start, around, times, reached, info, with_flaw(failure, flaw))
    if problem.output is None:
        return run
    at_start = output_at_start(flat, problem.output, params, start, (times[-1] - start.t) / 100)
    return with_output(run, at_start, found, times, reached)
