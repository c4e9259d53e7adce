"""Batches of 1 to 65536 double pendulums: per step and member, on one core and on both, in one call and in blocks."""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.benchmarks.against_c import ALPHA, DT, c_runs
from experiments.benchmarks.measure import least_seconds, one_core
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import legend, subplots
from hhtjax.scenes import double_pendulum

BLOCK = 256
MEMBERS = 1, 8, 64, 256, 1024, 8192, 65536
OVER = {  # what differs between members
    "initial states": (0, None, None, None),
    "stiffness": (None, 0, None, None),
    "dt": (None, None, 0, None),
    "alpha": (None, None, None, 0),
}


def end(num_steps, q0, stiffness, dt, alpha):
    """The last position of one member; springs in both joints."""
    scene = double_pendulum.free(hhtjax.trigonometry)
    params = {**scene.params, "k": (stiffness, stiffness)}
    stepper = hhtjax.hht(alpha, linearize="predictor")
    return hhtjax.simulate(
        scene.system, stepper, q0, scene.v0, params, dt=dt, num_steps=num_steps, save_every=num_steps
    ).q[-1]


@partial(jax.jit, static_argnums=0)
def together(num_steps, q0):
    """All members in one vmap."""
    return jax.vmap(lambda q: end(num_steps, q, 0.0, DT, ALPHA))(q0)


@partial(jax.jit, static_argnums=0)
def in_blocks(num_steps, q0):
    """Blocks one after the other."""
    return jax.lax.map(lambda q: end(num_steps, q, 0.0, DT, ALPHA), q0, batch_size=BLOCK)


@partial(jax.jit, static_argnums=(0, 1))
def over(what, num_steps, q0, stiffness, dt, alpha):
    """A batch over one argument."""
    return jax.vmap(partial(end, num_steps), OVER[what])(q0, stiffness, dt, alpha)


def on_all_cores(num_steps, parts):
    """A part of the members in each thread; XLA lets Python's lock go while it computes."""
    with ThreadPoolExecutor(len(parts)) as pool:
        return list(pool.map(lambda q: jax.block_until_ready(in_blocks(num_steps, q)), parts))


def measure(members, num_steps, repeats):
    """ns per step and member, in every way."""
    q0 = jnp.asarray(np.random.default_rng(0).normal(size=(members, 2)))
    functions = {"one call": partial(together, num_steps, q0)}
    if members > BLOCK:
        functions["in blocks"] = partial(in_blocks, num_steps, q0)
    with one_core():
        times = {f"{name}, one core": x for name, x in least_seconds(functions, repeats).items()}
    if members > BLOCK:
        parts = jnp.array_split(q0, os.cpu_count() or 1)
        functions["in blocks, a thread per core"] = partial(on_all_cores, num_steps, parts)
    c = least_seconds(c_runs(double_pendulum.free(), q0[0] if members == 1 else q0.T, num_steps), repeats)
    if c:
        times["best C, one core"] = min(c.values())
    times |= least_seconds(functions, repeats)
    return {name: 1e9 * x / num_steps / members for name, x in times.items()}


def by_argument(num_steps, repeats):
    """ns per step and member of a batch over states, stiffness, dt and alpha."""
    arguments = {
        "initial states": jnp.asarray(np.random.default_rng(0).normal(size=(BLOCK, 2))),
        "stiffness": jnp.linspace(0.0, 10.0, BLOCK),
        "dt": jnp.linspace(0.5, 1.0, BLOCK) * DT,
        "alpha": jnp.linspace(-0.3, 0.0, BLOCK),
    }
    single = {"initial states": jnp.array([0.3, -0.2]), "stiffness": 1.0, "dt": DT, "alpha": ALPHA}
    functions = {what: partial(over, what, num_steps, *(single | {what: arguments[what]}).values()) for what in OVER}
    return {what: 1e9 * x / num_steps / BLOCK for what, x in least_seconds(functions, repeats).items()}


def run(report, fast):
    """All sizes."""
    rows = []
    for members in (2,) if fast else MEMBERS:
        num_steps = 1024 if members <= 1024 else 64
        rows.append({"members": members, "num_steps": num_steps, **measure(members, num_steps, 2 if fast else 4)})
        report.progress(f"batch of {members}")
    columns = list(dict.fromkeys(key for row in rows for key in row))
    report.table(columns, [[row.get(key, "-") for key in columns] for row in rows])
    arguments = {} if fast else by_argument(1024, 5)
    report.table([f"batch of {BLOCK} over", "ns per step and member"], list(arguments.items()))
    if not fast:
        report.figure("benchmarks_batches", figure(rows, columns[2:]))
    return {"block": BLOCK, "rows": rows, "over": arguments}


def figure(rows, columns):
    """Time per step and member against the size of the batch."""
    drawn, axes = subplots(width=85, height=75)
    for i, name in enumerate(columns):
        mine = [row for row in rows if name in row]
        style = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 4, "lw": 1}
        axes.loglog([row["members"] for row in mine], [row[name] for row in mine], **style, label=name)
    axes.set(xlabel="members of the batch", ylabel="time per step and member (ns)")
    legend(axes)
    return drawn
