"""What events cost: a step with one declared and none met, a run with impacts, their derivatives, and compilation.

Times are medians of ratios, each of two runs one after the other, since others use the machine.
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.events.reference import SCENES

STEPS, PAIRS = 20_000, 21
FAR = {"ball": {"floor": -1e6}, "double pendulum": {"stop": 1e6}, "pendulum": {"wall": 1e6}}
DT = {"ball": 1e-4, "double pendulum": 1e-3, "pendulum": 1e-3}
GRADIENT_STEPS = 1000


def program(name, events, num_steps=STEPS):
    """The run's last q, of params and dt."""
    scene = SCENES[name]

    def last(params, dt):
        run = hhtjax.simulate(
            scene.system, hhtjax.hht(), scene.q0, scene.v0, params, dt=dt, num_steps=num_steps, save_every=num_steps,
            events=scene.events if events else None,
        )  # fmt: skip
        return run.q[-1], None if run.events is None else run.events.count

    return last


def gradient(name, events):
    """Of the sum of the last q in the params, by reverse mode."""
    last = program(name, events, GRADIENT_STEPS)
    return lambda params, dt: jax.grad(lambda params: jnp.sum(last(params, dt)[0]))(params)


def compiled(function, *arguments):
    """It, and the seconds to trace and to compile it."""
    begun = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, time.perf_counter() - begun


def seconds(function):
    """Of a call."""
    begun = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - begun


def ratio(function, plain, pairs):
    """The median of the ratios of their times, and of the plain one's."""
    function(), plain()
    times = np.array([(seconds(function), seconds(plain)) for _ in range(pairs)])
    return float(np.median(times[:, 0] / times[:, 1])), float(np.median(times[:, 1]))


def run(report, fast):
    """A row for each scene."""
    rows, pairs = [], 3 if fast else PAIRS
    for name in list(FAR)[:1] if fast else FAR:
        params = jax.tree.map(jnp.asarray, SCENES[name].params)
        params |= {key: jnp.asarray(value) for key, value in FAR[name].items()}
        near = jax.tree.map(jnp.asarray, SCENES[name].params)
        dt, long = jnp.asarray(DT[name]), jnp.asarray(10 * DT[name])
        plain, plain_compile = compiled(program(name, False), params, dt)
        with_events, events_compile = compiled(program(name, True), params, dt)
        backward, backward_compile = compiled(gradient(name, True), params, dt)
        plain_backward, plain_backward_compile = compiled(gradient(name, False), params, dt)
        none_met, own = ratio(partial(with_events, params, dt), partial(plain, params, dt), pairs)
        size = SCENES[name].duration / STEPS
        impacts = int(with_events(near, jnp.asarray(size))[1])
        some, _ = ratio(partial(with_events, near, jnp.asarray(size)), partial(plain, near, jnp.asarray(size)), pairs)
        back, _ = ratio(partial(backward, params, dt), partial(plain_backward, params, dt), pairs)
        apart = float(jnp.max(jnp.abs(with_events(params, long)[0] - plain(params, long)[0])))
        rows.append(
            {
                "scene": name, "plain_ns_per_step": 1e9 * own / STEPS, "none_met_over_plain_time": none_met,
                "impacts": impacts, "with_impacts_over_plain_time": some, "gradient_over_plain_time": back,
                "difference_none_met": apart,
                "compile_time_s": {
                    "plain": plain_compile, "events": events_compile, "plain gradient": plain_backward_compile,
                    "gradient with events": backward_compile,
                },
            }
        )  # fmt: skip
        report.progress(str(rows[-1]))
    return {"steps": STEPS, "rows": rows}
