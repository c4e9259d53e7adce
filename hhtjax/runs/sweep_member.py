"""One member of a sweep: as many steps as it takes, and then at rest, as long as its block works."""

from functools import partial

import jax.numpy as jnp
from jax import lax

from hhtjax.description import thaw
from hhtjax.numerics.checkpointed_scan import checkpoint
from hhtjax.numerics.counted_loop import repeat
from hhtjax.runs.events import loop_with_events, with_told_events
from hhtjax.runs.loop import advance_from, flaw_at_start, loop_of, resting
from hhtjax.runs.output import savings
from hhtjax.systems.flat_system import flatten
from hhtjax.xla import on_scalars, one_kernel, or_alone


def run_member(system, data, dt, substeps, longest, t0, num_samples, times, events, room, output=None, grows=False):
    """One member; it rests from `substeps` to `longest`, where its block still works.

    With `times`, start included, dt, substeps and longest are (K,), and the step is bound anew in each interval, and
    after the first step there, where that is to know of the steps before. grows: of `resized_step`.
    """
    stepper, q0, v0, params, z0 = *data[:3], thaw(data[3]), data[4]
    flat, q, v = flatten("sweep", system, q0, v0, t0, params, z0)
    grows = grows and stepper.throws(flat)
    resizes = times is not None and (stepper.resizes or grows)
    whole = in_two_parts if resizes else lambda *intervals: intervals
    intervals = None if times is None else whole(times[:-1], dt, substeps, longest)
    plain = loop = loop_of(flat, stepper, q, v, t0, params, dt if times is None else dt[0])
    if events is not None:
        loop = loop_with_events(plain, flat, stepper, events, params, *room)
    form = on_scalars(lambda carry: plain.advance(carry[:3]), loop.carry)
    save, as_saved = savings(form, loop, flat, output, params)
    pace = _paces(flat, stepper, params, loop, form, substeps, longest, grows)

    def part(carry, here):
        advance, substeps, longest = pace(carry[0], here)

        def step(i, carry):
            run, info = carry
            return resting(advance, events is not None, run, info, or_alone(i < substeps))

        return repeat(step, carry, longest), None

    @checkpoint
    def interval(run, here):
        carry = run, loop.no_info
        (run, info), _ = lax.scan(part, carry, here) if resizes else part(carry, here)
        last = None if here is None or output is None else here[1].ravel()[0]
        return run, (save(run, last), info)

    def samples(carry):
        return lax.scan(interval, carry, intervals, num_samples)

    (_, _, failure, *met), (path, info) = one_kernel(samples, form.tree)
    flaw = flaw_at_start(system, flat, loop.start, params)
    solution = as_saved(form.joined(path), dt, info, failure, flaw)
    return with_told_events(flat, solution, form.joined(met[0]), room[1]) if met else solution


def _paces(flat, stepper, params, loop, form, substeps, longest, grows):
    """The function of a run and an interval that gives the step, and how many the member takes, and its block."""

    def stepped(bound, sizes):
        """The step, with events one that rests."""
        if loop.past is not None:
            return form.of(loop.past(bound, sizes))
        return form.of(bound(params))

    def pace(run, interval):
        if interval is None:
            return stepped(loop.bound, loop.sizes), substeps, longest
        t, h, mine, most, *part = interval
        taken, last = part or (None, None)
        count = run[1] if taken is None else run[1] - taken

        def bound(params):
            return advance_from(flat, stepper, h.dtype, params, t, h, count, last, grows)

        return stepped(bound, lambda _: (h, h if last is None else last)), mine, most

    return pace


def in_two_parts(t, dt, substeps, longest):
    """The intervals (K, 2), the first step of each apart; behind them the steps before it, and the size of the last."""
    last = jnp.concatenate([dt[:1], dt[:-1]])
    firsts = t, dt, jnp.ones_like(substeps), jnp.ones_like(longest), jnp.zeros_like(substeps), last
    others = t, dt, substeps - 1, longest - 1, jnp.ones_like(substeps), dt
    return tuple(map(partial(jnp.stack, axis=1), zip(firsts, others, strict=True)))
