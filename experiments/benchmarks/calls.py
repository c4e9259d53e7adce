"""The cost of a call: a run of fifty steps, eager and in a jit, beside the same steps in a compiled loop alone.

    python -m experiments benchmarks --parts calls

So short a run takes as long as what is around it: checks of the arguments, the dispatch of a compiled function, and
the arrays that come out. What cannot be less is the dispatch of a function with as many arguments and results that
does nothing. Times are the least of many calls one after the other, the ways in turns within one process.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

import hhtjax
from experiments.benchmarks.measure import least_seconds
from experiments.work_precision.cases import SAMPLES, march
from hhtjax.primitives import one_kernel
from hhtjax.scenes import double_pendulum

TURNS, CALLS = 100, 30
DURATION = 5.0  # s
STEPPER = hhtjax.hht()
CONTROL = hhtjax.adaptive(1e-4, 1e-6)


def spring(q, v, t, params):
    """Of a mass in the plane, whose position is a dict."""
    return {axis: -params["k"] * q[axis] - params["c"] * v[axis] for axis in q}


def decay(y, t, params):
    """Of first order."""
    return -params["k"] * (y - jnp.sin(t))


def systems():
    """{name: (system, params, q0, v0)}."""
    place, rest = {"x": jnp.ones(()), "y": jnp.zeros(())}, {"x": jnp.zeros(()), "y": jnp.ones(())}
    masses = hhtjax.System(mass=jnp.ones(2), force=spring)
    return {
        "stiff double pendulum": double_pendulum.stiff()[:4],
        "first order": (hhtjax.FirstOrderSystem(decay), {"k": 4.0}, jnp.ones(2), None),
        "position as a dict": (masses, {"k": 4.0, "c": 0.1}, place, rest),
    }


def equal_steps(system, params, q0, v0):
    """The run with equal steps."""
    return hhtjax.simulate(system, STEPPER, q0, v0, params, dt=DURATION / SAMPLES, num_steps=SAMPLES)


def controlled(system, params, q0, v0):
    """The run under error control, read off as often."""
    times = DURATION / SAMPLES * jnp.arange(1, SAMPLES + 1)
    return hhtjax.simulate(system, STEPPER, q0, v0, params, dt=CONTROL, times=times)


def loop(system, params, q0, v0):
    """The steps of the former alone: positions at their ends."""
    unravel = jax.vmap(ravel_pytree(q0)[1])
    return one_kernel(lambda params: unravel(march(system, STEPPER, q0, v0, params, DURATION, 1)[0]), params)


def ways(simulate, scene, alone):
    """{name: a function without arguments} for each way to call a run; alone: its compiled loop, None where none."""
    system, params, q0, v0 = scene
    data = jax.tree.map(jnp.asarray, params)
    whole = jax.jit(lambda params: simulate(system, params, q0, v0))
    like = [jnp.zeros(x.shape, x.dtype) for x in jax.tree.leaves(jax.eval_shape(whole, data))]
    found = {
        "eager": partial(simulate, *scene),
        "all in a jit": partial(whole, data),
        "q in a jit": partial(jax.jit(lambda params: simulate(system, params, q0, v0).q), data),
        "dispatch of all": partial(jax.jit(lambda params: [x + 0 for x in like]), data),
        "dispatch of one": partial(jax.jit(lambda params: like[1] + 0), data),
    }
    return found if alone is None else {"loop": partial(jax.jit(lambda p: alone(system, p, q0, v0)), data), **found}


def seconds_of(functions, turns):
    """{name: least wall time of a call} of some calls in each turn, as in a user's loop."""
    found = [{name: least_seconds({name: f}, CALLS)[name] for name, f in functions.items()} for _ in range(turns)]
    return {name: min(turn[name] for turn in found) for name in functions}


def row(name, steps, functions, turns):
    """The times of all, and ratios over the loop alone; under error control, over the jit that returns q."""
    seconds = seconds_of(functions, turns)
    least = seconds.get("loop", seconds["q in a jit"])
    ratios = {f"{way}, ratio": seconds[way] / least for way in ("eager", "all in a jit", "q in a jit")}
    return {"system": name, "steps": steps, **ratios, "us": {way: 1e6 * x for way, x in seconds.items()}}


def run(report, fast):
    """A row for each system with equal steps, and one for error control."""
    turns = 1 if fast else TURNS
    scenes = systems()
    rows = [row(name, "equal", ways(equal_steps, x, loop), turns) for name, x in scenes.items()]
    name, scene = next(iter(scenes.items()))
    rows.append(row(name, "adaptive", ways(controlled, scene, None), turns))
    names, columns = list(rows[0]["us"]), [key for key in rows[0] if key != "us"]
    lines = [[*(r[key] for key in columns), *(r["us"].get(way, "-") for way in names)] for r in rows]
    report.table([*columns, *(f"{way} (us)" for way in names)], lines)
    return {"num_steps": SAMPLES, "jax": jax.__version__, "rows": rows}
