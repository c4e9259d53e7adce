"""What events cost: a step with one declared and none met, an impact, derivatives, compilation, and those of a sweep.

Times are the least of runs in turn, since others use the machine.
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.events.reference import SCENES

STEPS, PAIRS = 4000, 100  # short runs, of which some are undisturbed
FAR = {"ball": {"floor": -1e6}, "double pendulum": {"stop": 1e6}, "pendulum": {"wall": 1e6}}
DT = {"ball": 1e-4, "double pendulum": 1e-3, "pendulum": 1e-3}
GRADIENT_STEPS = 1000
MEMBERS, MEMBER_STEPS, SWEEP_PAIRS = 64, 1000, 100  # of a sweep over a second


def run_of(name, events, num_steps=STEPS):
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
    last = run_of(name, events, GRADIENT_STEPS)
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


WAYS = (  # what is compiled, in the order of the times
    ("plain", run_of, False),
    ("events", run_of, True),
    ("plain gradient", gradient, False),
    ("gradient with events", gradient, True),
)


def least(functions, pairs):
    """The least time of each, all of them in turn."""
    for function in functions:
        function()
    return np.min([[seconds(function) for function in functions] for _ in range(pairs)], axis=0)


def run(report, fast):
    """A row for each scene, and what an impact takes; the smoke run has one scene, and no gradient with events."""
    rows, pairs = [], 3 if fast else PAIRS
    for name in list(FAR)[:1] if fast else FAR:
        params, dt = at(name, FAR[name]), jnp.asarray(DT[name])
        programs, compiling = {}, {}
        for key, make, events in WAYS[:3] if fast else WAYS:
            programs[key], compiling[key] = compiled(make(name, events), params, dt)
        runs = least([partial(x, params, dt) for x in programs.values()], pairs)
        plain, with_events, plain_gradient, gradient_with_events = map(float, [*runs, np.nan][:4])
        apart = jnp.abs(programs["events"](params, dt)[0] - programs["plain"](params, dt)[0])
        rows.append(
            {
                "scene": name, "plain_ns_per_step": 1e9 * plain / STEPS,
                "none_met_over_plain_time": with_events / plain,
                "gradient_over_plain_time": gradient_with_events / plain_gradient,
                "difference_none_met": float(jnp.max(apart)), "compile_time_s": compiling,
            }
        )  # fmt: skip
        report.progress(str(rows[-1]))
    return {
        "steps": STEPS, "rows": rows, "impacts": impacts(report, pairs),
        "sweep": of_sweep(report, 3 if fast else SWEEP_PAIRS),
    }  # fmt: skip


def impacts(report, pairs):
    """The impact oscillator, 50 steps of a period, beside the same without its stop."""
    name = "impact oscillator"
    met, none = at(name, {"W": 2.2}), at(name, {"W": 2.2, "wall": 1e6})
    dt = jnp.asarray(2 * np.pi / 2.2 / 50)
    program, _ = compiled(run_of(name, True), met, dt)
    count = int(program(met, dt)[1])
    with_impacts, without = map(float, least([partial(program, x, dt) for x in (met, none)], pairs))
    found = {
        "scene": name, "impacts": count, "ns_per_step": 1e9 * without / STEPS,
        "ns_per_impact": 1e9 * (with_impacts - without) / count, "run_over_none_met_time": with_impacts / without,
    }  # fmt: skip
    report.progress(str(found))
    return found


def sweep_of(events):
    """Balls from other heights, with other restitutions: last q, and the events, of the height of the floor."""
    scene = SCENES["ball"]
    q0, e = jnp.linspace(0.5, 1.5, MEMBERS)[:, None], jnp.linspace(0.7, 0.9, MEMBERS)
    axes = dict.fromkeys(scene.params) | {"e": 0}

    def last(floor):
        runs = hhtjax.sweep(
            scene.system, hhtjax.hht(), q0, scene.v0, scene.params | {"e": e, "floor": floor},
            dts=np.full(MEMBERS, 1 / MEMBER_STEPS), duration=1.0, num_samples=1, in_axes=(None, 0, None, axes),
            events=scene.events if events else None,
        )  # fmt: skip
        return runs.q[:, -1], runs.events

    return last


def of_sweep(report, pairs):
    """Beside the same without events: with impacts, and with the floor out of reach."""
    floor, far = jnp.zeros(()), jnp.asarray(-1e6)
    plain, events = (compiled(sweep_of(with_events), floor)[0] for with_events in (False, True))
    times = least([partial(plain, floor), partial(events, floor), partial(events, far)], pairs)
    t = np.asarray(events(floor)[1].t)
    found = {
        "members": MEMBERS, "steps": MEMBER_STEPS, "impacts": int(np.isfinite(t).sum()),
        "steps_with_impacts": np.unique(np.floor(t[np.isfinite(t)] * MEMBER_STEPS)).size,
        "plain_ms": 1e3 * float(times[0]), "over_plain_time": float(times[1] / times[0]),
        "none_met_over_plain_time": float(times[2] / times[0]),
    }  # fmt: skip
    report.progress(str(found))
    return found


def at(name, changed):
    """Params of a scene."""
    return jax.tree.map(jnp.asarray, SCENES[name].params | changed)
