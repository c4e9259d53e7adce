"""What lies around the sample times, kept while steps are chosen: a run under error control in one pass.

The values are those of a run over the chosen steps, to rounding; a step that was accepted has not failed. Derivatives
and batches are those of that run, in a second pass, as is what happens within steps: events, and dry friction.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.numerics.seldom import choose as either
from hhtjax.runs.loop import as_solution, flaw_at_start, neutral_info, no_failure
from hhtjax.runs.read_off import kept, read_off
from hhtjax.steppers.stepper import join_info


class Record(NamedTuple):
    """Of the steps so far. number: of the samples that they have passed; info: joined since the last of these;
    around: what was kept at the beginning, and at the end, of the step of each sample, and the info to there."""

    number: Any
    info: Any
    around: Any


def recorder(flat, stepper, form, info, times):
    """An empty `Record` at these times for walks in this form, and the function that keeps the next try.

    info: that of a try, for its structure.
    """
    no_info = neutral_info(info)
    keep = form.of(partial(kept, flat, stepper))
    pair = keep(form.tree.state), keep(form.tree.state)
    empty = jax.tree.map(lambda x: jnp.broadcast_to(x, (times.size, *jnp.shape(x))), (*pair, no_info))
    due_times = jnp.append(times, jnp.inf)

    def keep_try(record, begun, state, accepted):
        info = either(accepted, join_info(record.info, begun.info), record.info)

        def due(record):
            here = lax.dynamic_index_in_dim(due_times, record.number, keepdims=False)
            return accepted & (here <= state.t)

        def write(record):
            new = keep(begun.state), keep(state), record.info
            around = jax.tree.map(
                lambda rows, x: lax.dynamic_update_index_in_dim(rows, x, record.number, 0), record.around, new
            )
            return Record(record.number + 1, no_info, around)

        return lax.while_loop(due, write, record._replace(info=info))

    return Record(jnp.zeros((), jnp.int32), no_info, empty), keep_try


def solution(problem, start, around, times, reached):
    """The `Solution` at the times, from what was kept around them."""
    flat, _, _, _, params = problem.flat()
    (first, _), (second, extra), info = around
    flaw, failure = flaw_at_start(problem.system, flat, start, params), no_failure(jax.tree.map(lambda x: x[0], info))
    ends = [as_solution(flat, start, path, None, info, failure, flaw) for path in (first, second)]
    return read_off(flat, ends, extra, times, reached)
