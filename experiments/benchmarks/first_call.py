"""The first call: CPU seconds until a result is there, each in a process of its own; with a cache on disk, its second.

    python -m experiments benchmarks --parts first_call             # the table, some ten minutes
    python -m experiments.benchmarks.first_call simulate pendulum   # one number of it, in this process

It is what all threads compute, imports apart, divided into tracing (Python: the system's functions, JAX, the
rewriting), lowering (to MLIR) and compiling (XLA and LLVM) as elapsed times are.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from functools import partial

import jax
import jax.numpy as jnp

import hhtjax
from experiments.benchmarks import obvious
from experiments.sweeps import large
from hhtjax.scenes import body_chain, double_pendulum, pendulum, squeezer, top

NUM_STEPS = 50
SHORT = 5.0  # s; of what takes less, the least of two
EVENTS = {"lowering": "jaxpr_to_mlir_module_duration", "compiling": "backend_compile_duration"}


def beam():
    """(system, params, q0, v0), the step, the stepper."""
    system, q0, v0, dt = large.beam(50)
    return (system, {"k": 1.0}, q0, v0), dt, hhtjax.hht()


def of_scene(make, dt):
    """The same of a scene."""
    return make()[:4], dt, hhtjax.hht()


SCENES = {
    "pendulum": partial(of_scene, pendulum.minimal, 1e-3),
    "double pendulum": partial(of_scene, double_pendulum.stiff, 1e-3),
    "squeezer": partial(of_scene, squeezer.squeezer, 1e-5),
    "top": partial(of_scene, top.minimal, 1e-4),
    "chain of 4 bodies": partial(of_scene, partial(body_chain.body_chain, 4), 1e-3),
    "beam of 50": beam,
}
FITTED = {"pendulum": "l", "double pendulum": "g", "squeezer": "moment", "top": "g", "chain of 4 bodies": "g"}


def simulate(scene):
    """As users write it."""
    (system, params, q0, v0), dt, stepper = SCENES[scene]()
    run = hhtjax.simulate(system, stepper, q0, v0, params, dt=dt, num_steps=NUM_STEPS)
    run.check()
    return run.q


def gradient(scene, options=None):
    """In all params, reverse, in a jit of the user's."""
    (system, params, q0, v0), dt, stepper = SCENES[scene]()

    def loss(params):
        run = hhtjax.simulate(system, stepper, q0, v0, params, dt=dt, num_steps=NUM_STEPS)
        return sum(jnp.sum(x**2) for x in jax.tree.leaves(run.q))

    return jax.jit(jax.grad(loss), compiler_options=options)(params)


def path_of(scene, num_steps=NUM_STEPS):
    """The same motion in plain JAX, as one writes it down first, as a function of params and dt; these."""
    (system, params, q0, v0), dt, stepper = SCENES[scene]()
    is_flat = system.constraint is None and q0.shape == v0.shape
    run = obvious.run if is_flat else obvious.run_bodies
    return lambda params, dt: run(stepper, system, params, q0, v0, dt, num_steps)[1], params, dt


def obvious_simulate(scene):
    """What a first call takes at the least."""
    path, params, dt = path_of(scene)
    return jax.jit(path)(params, dt)


def obvious_gradient(scene):
    """Its gradient."""
    path, params, dt = path_of(scene)
    return jax.jit(jax.grad(lambda p: sum(jnp.sum(x**2) for x in jax.tree.leaves(path(p, dt)))))(params)


def obvious_sweep(scene):
    """Of eight step sizes, each with as many steps as the smallest needs."""
    path, params, dt = path_of(scene, 2 * NUM_STEPS)
    return jax.jit(jax.vmap(path, (None, 0)))(params, sizes(dt))


def quick(scene):
    """The same, compiled as `simulate` is."""
    return gradient(scene, hhtjax.xla.QUICK)


def fit(scene):
    """Of one parameter, to a run with another value of it."""
    (system, params, q0, v0), dt, stepper = SCENES[scene]()
    name = FITTED.get(scene, "k")

    def residuals(x):
        run = hhtjax.simulate(system, stepper, q0, v0, params | {name: x}, dt=dt, num_steps=NUM_STEPS)
        return jax.tree.map(lambda now, then: now[1:] - then, run.q, q0)

    return hhtjax.fit(residuals, params[name], max_iterations=2).params


def sizes(dt):
    """Of the steps in a sweep."""
    return dt * jnp.linspace(0.5, 1.0, 8)


def sweep(scene):
    """Of eight step sizes."""
    (system, params, q0, v0), dt, stepper = SCENES[scene]()
    runs = hhtjax.sweep(system, stepper, q0, v0, params, dts=sizes(dt), duration=NUM_STEPS * dt, num_samples=10)
    runs.check()
    return runs.q


CALLS = {f.__name__: f for f in (simulate, gradient, fit, sweep)} | {"gradient, QUICK": quick}
OBVIOUS = {"simulate": obvious_simulate, "gradient": obvious_gradient, "sweep": obvious_sweep}
PROGRAMS = CALLS | {f.__name__: f for f in OBVIOUS.values()}


def first(call, scene):
    """Seconds in this process: {total, tracing, lowering, compiling}."""
    spent = dict.fromkeys(EVENTS, 0.0)

    def listen(event, duration_secs, **_):
        for name, ending in EVENTS.items():
            if event.endswith(ending):
                spent[name] += duration_secs

    jnp.zeros(1).block_until_ready()
    jax.monitoring.register_event_duration_secs_listener(listen)
    start, cpu = time.perf_counter(), time.process_time()
    jax.block_until_ready(PROGRAMS[call](scene))
    elapsed, cpu = time.perf_counter() - start, time.process_time() - cpu
    found = {name: cpu * seconds / elapsed for name, seconds in spent.items()}
    return {"total": cpu, "tracing": cpu - sum(found.values()), **found}


def apart(call, scene, cache):
    """`first` in a new process, with a cache on disk."""
    command = [sys.executable, "-m", "experiments.benchmarks.first_call", call, scene]
    keep = {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    done = subprocess.run(command, env=os.environ | keep, check=True, stdout=subprocess.PIPE)
    return json.loads(done.stdout.decode().splitlines()[-1])


def pair(call, scene):
    """What the first call takes, and the first of a second process."""
    with tempfile.TemporaryDirectory() as cache:
        return [apart(call, scene, cache) for _ in range(2)]


def least(rows):
    """Of these the one with the least total."""
    return min(rows, key=lambda row: row["total"])


def measured(call, scene):
    """Both, the least of two where that takes little."""
    pairs = [pair(call, scene)]
    if pairs[0][0]["total"] < SHORT:
        pairs.append(pair(call, scene))
    return map(least, zip(*pairs, strict=True))


def cell(report, call, scene):
    """A row of the table."""
    once, again = measured(call, scene)
    row = {"scene": scene, "call": call, "cpu_time_s": once, "with_cache_cpu_time_s": again["total"]}
    if call in OBVIOUS:
        plain, cached = measured(OBVIOUS[call].__name__, scene)
        row |= {"obvious_cpu_time_s": plain["total"], "obvious_with_cache_cpu_time_s": cached["total"]}
    report.progress(str(row))
    return row


def run(report, fast):
    """A row for each scene and call."""
    cells = [(call, scene) for scene in SCENES for call in CALLS][: 1 if fast else None]
    rows = [cell(report, *x) for x in cells]
    header = ["scene", "call", *rows[0]["cpu_time_s"], "total with a cache"]
    lines = [[r["scene"], r["call"], *r["cpu_time_s"].values(), r["with_cache_cpu_time_s"]] for r in rows]
    report.table(header, lines)
    return {"num_steps": NUM_STEPS, "rows": rows}


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(first(*sys.argv[1:])))
